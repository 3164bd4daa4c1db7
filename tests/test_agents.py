"""The agents that come with the code: small, complete, and as good as their summaries say."""

import json
import shutil
from pathlib import Path

import hydra
import pytest
import yaml
from conftest import SIMULATORS, choices, compose_config

import hpamdp
from hpamdp.commands.play import own_agents
from hpamdp.config.errors import ConfigError
from hpamdp.config.saved import upgraded
from hpamdp.run import checkpoint
from hpamdp.run.players import load_agent
from hpamdp.run.train import run

FOLDER = Path(__file__).resolve().parent.parent / "agents"
# Those of others have none, the released rules are there for comparisons, and pictures are another view of a problem.
PROBLEMS = {*choices("env")} - {"gymnasium", "rddl", "boatdock_released", "catch_point_picture"}
AGENTS = sorted(folder.name for folder in FOLDER.iterdir() if folder.is_dir())


def config_of(name: str) -> dict:
    return yaml.safe_load((FOLDER / name / "config.yaml").read_text())


def test_there_is_an_agent_for_each_problem_each_boat_and_the_whole_task():
    configs = [config_of(name) for name in AGENTS]
    assert {config["choices"]["env"] for config in configs} >= PROBLEMS
    controllers = {config["env"]["controller"] for config in configs if config["choices"]["env"] == "boatdock"}
    assert controllers == {"choose", "congruent", "incongruent"}


def test_the_agents_are_small_complete_and_listed():
    listed = (FOLDER / "README.md").read_text()
    for name in AGENTS:
        files = {file.name: file.stat().st_size for file in (FOLDER / name).iterdir()}
        assert {"policy.safetensors", "config.yaml", "summary.json"} <= files.keys(), name
        assert files["policy.safetensors"] < 300_000 and f"`{name}`" in listed, name


def with_slow_ones(names: list[str]) -> list:
    """Return agents as parameters of a test that is slow but for two of them."""
    quick = ("linucb_hppo", "hppo_platform")
    return [pytest.param(name, marks=[] if name in quick else [pytest.mark.slow]) for name in names]


def skip_without_simulator(name: str) -> None:
    problem = config_of(name)["choices"]["env"]
    if problem in SIMULATORS:
        pytest.importorskip(SIMULATORS[problem])


@pytest.mark.parametrize("name", with_slow_ones(AGENTS))
def test_an_agent_scores_as_its_summary_says(name):
    skip_without_simulator(name)
    num_layouts = min(200, config_of(name)["eval"]["layouts"])
    player = load_agent(str(FOLDER / name), [f"eval.layouts={num_layouts}", "film=false"])
    score = player.evaluation().run(player.agent.policy)["score"]
    summary = json.loads((FOLDER / name / "summary.json").read_text())
    # A subset of the episodes of the summary: four standard errors. Networks are stored in half precision after they
    # are scored. All episodes of Pinball are the same, and its walls amplify rounding.
    rounding = 1e-3 * max(1.0, abs(summary["score"]))
    assert score.mean() == pytest.approx(summary["score"], abs=float(4.0 * score.std() / len(score) ** 0.5 + rounding))


def test_those_on_boats_can_be_played_against_and_the_others_are_not_even_built(monkeypatch):
    config = load_agent(str(FOLDER / "linucb_hppo"), ["eval.layouts=1"]).config
    built = []
    monkeypatch.setattr(
        "hpamdp.commands.play.load_agent", lambda path, words: built.append(path) or load_agent(path, words)
    )
    agents = own_agents(config)
    on_boats = [name for name in AGENTS if config_of(name)["choices"]["env"] == "boatdock"]
    assert [agent["name"] for agent in agents] == [Path(path).name for path in built] == on_boats
    assert all(agent["score"] > 3.0 for agent in agents)


def test_the_networks_of_an_agent_start_a_run(tmp_path):
    words = ["env=goal", "high=none", "low=pdqn", f"low.checkpoint={FOLDER / 'pdqn_goal'}", "total_frames=1024"]
    words += ["eval.layouts=50", "eval.every=0", "num_envs=64", "low.warmup_steps=1000", "film=false"]
    words += ["low.updates_per_step=0.001"]
    assert run(compose_config(words), tmp_path, words) == 0
    assert json.loads((tmp_path / "summary.json").read_text())["success"] > 0.6


def test_the_files_of_the_agents_have_todays_form():
    for name in AGENTS:
        config = checkpoint.progress_of(FOLDER / name / "policy.safetensors")["config"]
        assert config == config_of(name) == upgraded(config), name


@pytest.mark.parametrize("name", with_slow_ones(AGENTS))
def test_an_agent_is_loaded_without_further_compositions(name, monkeypatch):
    skip_without_simulator(name)
    composing: list[object] = []
    compose = hydra.compose
    monkeypatch.setattr(hydra, "compose", lambda *args, **kw: composing.append(args) or compose(*args, **kw))
    hpamdp.load(name)
    assert len(composing) == 1


def test_networks_alone_are_scored_but_not_resumed():
    folder = str(FOLDER / "linucb_hppo")
    assert checkpoint.find(folder, "checkpoint").name == "policy.safetensors"
    assert checkpoint.find(folder, "low.checkpoint").name == "policy.safetensors"
    with pytest.raises(ConfigError, match="networks alone, which cannot be resumed"):
        checkpoint.find(folder, "resume")
    with pytest.raises(ConfigError, match=r"policy\.safetensors: networks alone, which cannot be resumed; give a"):
        hpamdp.train(resume=f"{folder}/policy.safetensors", progress=False)


def test_an_agent_is_found_by_its_name_by_every_command(command, tmp_path):
    assert command("watch", "hppo_platform", "--episodes=1", "--size=40", "--fps=5")[0] == 0
    assert command("mode=eval", "checkpoint=hppo_platform", "eval.layouts=4", "film=false")[0] == 0
    code, _, err = command("play", "--agent", "hppo_congruent", "--export", "site")
    assert code == 0, err
    assert '"name":"hppo_congruent","title":"hppo","score":3.257' in (tmp_path / "site/data.js").read_text()
    file = checkpoint.find("pdqn_goal", "low.checkpoint")
    assert file == FOLDER / "pdqn_goal/policy.safetensors"


def test_an_existing_folder_precedes_the_agent_of_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pdqn_goal").mkdir()
    shutil.copy(FOLDER / "hppo_platform/policy.safetensors", "pdqn_goal")
    assert hpamdp.load("pdqn_goal").specs.num_discrete == 3
    assert checkpoint.find("pdqn_goal", "checkpoint") == tmp_path / "pdqn_goal/policy.safetensors"


@pytest.mark.parametrize("words", [["watch", "hppo_plat"], ["mode=eval", "checkpoint=hppo_plat"]])
def test_a_wrong_name_is_refused_in_one_line_with_all_names(words, command):
    code, _, err = command(*words)
    assert (code, err.count("\n")) == (2, 1)
    assert all(name in err for name in AGENTS)
