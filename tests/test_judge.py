"""Judging agents by recorded transitions: the model, its order of agents, and what it says that it cannot tell."""

import pytest
import torch
from conftest import compose_config, make_config

import hpamdp
from hpamdp import keys
from hpamdp.commands import judge
from hpamdp.commands.judge import judged
from hpamdp.commands.recorded_problem import RecordedProblem, starts_of
from hpamdp.config.errors import ConfigError
from hpamdp.data.human.demonstrations import HumanDemonstrations
from hpamdp.run.assemble import assemble
from hpamdp.run.players import load_agent
from hpamdp.run.train import run

WORDS = ["data=human", "data.checksum=null", "offline.updates=400", "low.batch_size=32"]
SMALL_BATCH = ["num_envs=10", "steps_per_batch=1", "total_frames=100", "eval.layouts=4"]


@pytest.fixture(scope="module")
def path(people_file) -> str:
    return str(people_file)


@pytest.fixture(scope="module")
def clone(path, tmp_path_factory) -> str:
    """Return the folder of a clone that has not learned from person 1."""
    folder = tmp_path_factory.mktemp("clone") / "bc"
    given = ["mode=offline", "data=human", "data.checksum=null", f"data.path={path}", "data.held_out=[1]", "low=bc"]
    given += ["high=linucb", "offline.updates=2", "offline.eval_every=0", "eval.layouts=4", "low.batch_size=16"]
    assert run(compose_config(given), folder, given) == 0
    return str(folder)


def test_a_model_of_recorded_steps_shows_all_that_the_environment_shows(path):
    given = ["mode=offline", "low=pets", "high=uniform", f"data.path={path}", *WORDS, "eval.layouts=4"]
    parts = assemble(make_config(given))
    rows = parts.data.batch.squeeze(0)
    specs = parts.agent.specs
    torch.manual_seed(0)
    problem = RecordedProblem(parts.agent.learners[0], specs, rows, 400)
    goes_on = ~rows["next", keys.TERMINATED].squeeze(-1)
    acted = rows[goes_on][: goes_on.sum() // 5 * 5]
    after, _, _, ends = problem.step(acted)
    error = (after - acted["next", keys.OBSERVATION]).abs().mean(0)
    change = (acted[keys.OBSERVATION] - acted["next", keys.OBSERVATION]).abs().mean(0)
    assert (error <= 0.4 * change + 1e-3).all() and ends.mean() < 0.25
    assert problem.is_covered(acted).float().mean() > 0.85
    strange = acted.clone()
    strange[keys.OBSERVATION][:, -2:] += 5.0
    assert not problem.is_covered(strange).any()


def test_agents_are_ordered_as_their_environment_orders_them(path, clone):
    rows = judged(["linucb_hppo", clone], [*WORDS, f"data.path={path}"], episodes=20)
    assert [row["agent"] for row in rows] == ["linucb_hppo", clone]
    best, worst = rows
    assert best["return"] > worst["return"] + 1.0
    low, high = best["interval"]
    assert low < best["return"] < high and best["between_members"] > 0.0
    # The good agent knows nothing of the data; the clone has not seen person 1, whose steps judge both.
    assert not any("learned" in doubt for row in rows for doubt in row["doubts"])


def test_an_agent_that_learned_from_the_steps_that_judge_it_is_doubted(path, clone):
    rows = hpamdp.judge(clone, data="human", episodes=5, **_settings(path), **{"data.people": [0, 2]})
    assert any("may have learned from the transitions that judge it" in doubt for doubt in rows[0]["doubts"])


def test_what_agents_held_out_of_other_data_is_not_held_out_here(path, clone, monkeypatch):
    def of_other_data(*arguments):
        loaded = load_agent(*arguments)
        loaded.progress["config"] |= {"data": {"held_out": 0.5}, "choices": {"data": "minari"}}
        return loaded

    monkeypatch.setattr(judge, "load_agent", of_other_data)
    rows = hpamdp.judge(clone, data="human", episodes=5, **_settings(path))
    assert not any("learned" in doubt for doubt in rows[0]["doubts"])


def _settings(path):
    return {"data.path": path, "data.checksum": None, "offline.updates": 5, "low.batch_size": 16}


REFUSED = [
    ([], ["data=human"], "nobody to judge"),
    (["linucb_hppo"], [], "no recorded transitions; name a data set, such as data=human"),
    (["linucb_hppo", "hppo_platform"], ["data=human"], "hppo_platform is of another problem than linucb_hppo"),
    (["hppo_platform"], ["data=human"], "people docked boats"),
    (["/nowhere"], ["data=human"], "/nowhere"),
]


@pytest.mark.parametrize(("paths", "words", "line"), REFUSED, ids=[line for *_, line in REFUSED])
def test_what_cannot_be_judged_is_refused_in_one_line(paths, words, line):
    with pytest.raises(ConfigError, match=line) as refusal:
        judged(paths, words, episodes=5)
    assert "\n" not in str(refusal.value)


def test_an_agent_that_asks_its_environment_cannot_be_judged(tmp_path):
    given = ["high=human", "low=random", "num_envs=4", "steps_per_batch=4", "total_frames=16", "eval.layouts=4"]
    assert run(compose_config(given), tmp_path / "run", given) == 0
    with pytest.raises(ConfigError, match="high=human asks the environment itself"):
        judged([str(tmp_path / "run")], ["data=human"], episodes=5)


def test_starts_are_first_observations_of_recorded_episodes(path):
    env = load_agent("linucb_hppo", []).env
    rows = HumanDemonstrations(env, path=path, checksum=None).batch.squeeze(0)
    starts, people = starts_of(rows, 7, seed=0)
    firsts = rows[rows[keys.IS_DECISION].squeeze(-1)][keys.OBSERVATION]
    assert len(people) == 7 and all((firsts == start).all(-1).any() for start in starts)


def test_a_model_that_predicts_the_whole_observation_stands_for_the_problem():
    parts = assemble(make_config(["env=platform", "low=pets", "high=none", "low.batch_size=32", *SMALL_BATCH]))
    learner, specs = parts.agent.learners[0], parts.agent.specs
    torch.manual_seed(0)
    steps = parts.env.rollout(40, break_when_any_done=False).flatten()
    problem = RecordedProblem(learner, specs, steps, 2)
    assert problem.rest == [] and problem.step(steps[:10])[0].shape == (10, specs.observation_dim)
