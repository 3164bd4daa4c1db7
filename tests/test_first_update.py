"""A run that has learned nothing says so."""

import json

import pytest
import torch
from conftest import UPDATES_THAT_PAY, compose_config, make_config
from test_grid import SHORT

from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.run.assemble import make_agent, make_env, set_up_updates
from hpamdp.run.summary import short_sight
from hpamdp.run.train import run
from hpamdp.specs import PAMDPSpecs

TINY = ["num_envs=16", "steps_per_batch=4", "eval.layouts=4", "eval.every=0"]


@pytest.mark.parametrize(
    ("words", "without"),
    [
        (["high=ucb", "low=hppo", *SHORT["hppo"]], []),
        (
            ["high=fixed", "low=pets", *SHORT["pets"], "high.option=congruent", "agent.sharing=per_option"],
            ["low/incongruent"],
        ),
        (["high=none", "env=platform", "low=hppo"], ["low"]),
        (["high=meta_critic", "high.warmup_decisions=60", "high.updates_per_decision=0.1", "low=random"], ["high"]),
    ],
)
def test_a_run_names_the_parts_without_an_update(words, without, tmp_path, capsys):
    given = [*TINY, "total_frames=128", *words]
    assert run(compose_config(given), tmp_path, given) == 0
    assert json.loads((tmp_path / "summary.json").read_text())["without_update"] == without
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("no update was made")]
    assert lines == ([f"no update was made: {', '.join(without)}"] if without else [])


def test_the_closing_table_names_learners_that_look_far_less_ahead_than_episodes_last():
    config = make_config(["env=platform", "low=pdqn", "low.gamma=0.5"])
    assert short_sight(config.learners, 9.0) == [
        "low=pdqn: low.gamma=0.5 counts about 2 steps, but episodes have 9 on average"
    ]
    assert short_sight(config.learners, 8.0) == []
    planner = make_config(["env=platform", "low=dlpa", "low.horizon=3"])
    assert short_sight(planner.learners, 30.0) == [
        "low=dlpa: plans see low.horizon=3 steps, but episodes have 30 on average"
    ]


def test_updates_are_compiled_by_default_if_the_run_makes_many(monkeypatch):
    asked = []
    monkeypatch.setattr(PDQN, "compile_updates", lambda self: asked.append(self))
    monkeypatch.setattr("hpamdp.run.assemble._UPDATES_THAT_PAY", UPDATES_THAT_PAY)
    few, many = (f"total_frames={steps}" for steps in (20_000, 400_000))
    for words, is_compiled in (([few], False), ([many], True), ([many, "compile_updates=false"], False)):
        asked.clear()
        config = make_config(["env=platform", "low=pdqn", "low.updates_per_step=0.1", *words])
        env = make_env(config, 1, torch.device("cpu"), 0)
        agent = make_agent(config, PAMDPSpecs.from_env(env), torch.device("cpu"))
        set_up_updates(config, agent)
        assert bool(asked) is is_compiled, words
