"""The agents that come with the code: small, complete, and as good as their summaries say."""

import json
from pathlib import Path

import pytest
from conftest import compose_config

from hpamdp.config import ConfigError
from hpamdp.run import checkpoint
from hpamdp.run.play import own_agents
from hpamdp.run.players import load_player
from hpamdp.run.resume import resolve

FOLDER = Path(__file__).resolve().parent.parent / "agents"
AGENTS = sorted(folder.name for folder in FOLDER.iterdir() if folder.is_dir())


def test_there_are_agents_for_one_boat_and_for_the_whole_task():
    assert {"linucb_hppo", "hppo_congruent"} <= {*AGENTS}


@pytest.mark.parametrize("name", AGENTS)
def test_an_agent_is_small_and_scores_as_its_summary_says(name):
    assert {"policy.pt", "config.yaml", "summary.json"} <= {file.name for file in (FOLDER / name).iterdir()}
    assert (FOLDER / name / "policy.pt").stat().st_size < 300_000
    player = load_player(str(FOLDER / name), ["eval.layouts=300", "film=false"])
    played = player.evaluation.run(player.agent.policy)
    summary = json.loads((FOLDER / name / "summary.json").read_text())
    # A subset of the layouts of the summary; the standard error is about .04.
    assert played["score"].mean() == pytest.approx(summary["score"], abs=0.15)
    assert f"`{name}`" in (FOLDER / "README.md").read_text()


def test_all_of_them_can_be_played_against():
    config = load_player(str(FOLDER / "linucb_hppo"), ["eval.layouts=1"]).config
    agents = own_agents(config)
    assert [agent["name"] for agent in agents] == AGENTS and all(agent["score"] > 3.0 for agent in agents)


def test_networks_alone_are_scored_but_not_resumed():
    folder = str(FOLDER / "linucb_hppo")
    assert checkpoint.find(folder, "checkpoint").name == "policy.pt"
    assert checkpoint.find(folder, "low.checkpoint").name == "policy.pt"
    with pytest.raises(ConfigError, match="networks alone, which cannot be resumed"):
        checkpoint.find(folder, "resume")


def test_the_words_of_eval_take_the_agent_from_its_folder():
    words = ["mode=eval", f"checkpoint={FOLDER / 'linucb_hppo'}", "eval.layouts=7"]
    config, file = resolve(compose_config(words), words)
    assert (config.high.name, config.low.name, config.run.eval.layouts) == ("linucb", "hppo", 7)
    assert file == FOLDER / "linucb_hppo" / "policy.pt"
