"""Every selector runs over every learner, and every one of them survives a checkpoint: the lists are those of conf/."""

import itertools
import json
from pathlib import Path
from typing import Literal

import pytest
import torch
import yaml
from conftest import CONF, OF_EACH_KIND, TRAINED, choices, compose_config, make_config
from tensordict import TensorDict

from hpamdp.config.components import SUPPLIED_ARGUMENTS, load_class, settings_model
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.shared.symmetry import RandomSymmetry
from hpamdp.run import checkpoint
from hpamdp.run.assemble import assemble
from hpamdp.run.train import run

# What makes a learner's training short; a learner that is not named needs nothing.
SHORT = {
    "dlpa": [
        *("low.warmup_steps=64", "low.updates_per_step=0.05", "low.batch_size=16", "low.hidden_dims=[16,16]"),
        *("low.num_samples=16", "low.num_elites=4", "low.num_iterations=2"),
    ],
    "hppo": ["low.minibatch_size=16", "low.epochs=2"],
    "hppo_published": ["low.minibatch_size=16", "low.critic_epochs=1"],
    "iql": ["low.warmup_steps=64", "low.updates_per_step=0.05", "low.batch_size=16"],
    "td3_bc": ["low.warmup_steps=64", "low.updates_per_step=0.05", "low.batch_size=16"],
    "hsac": ["low.warmup_steps=64", "low.updates_per_step=0.05", "low.batch_size=16"],
    "hyar": ["low.warmup_steps=64", "low.codec_pretrain_updates=2", "low.updates_per_step=0.05", "low.batch_size=16"],
    "hyar_published": [
        *("low.warmup_steps=64", "low.codec_pretrain_updates=2", "low.updates_per_step=0.05", "low.batch_size=16"),
        *("low.codec_episodes=8", "low.codec_first_episode=0", "low.codec_batch_size=16"),
    ],
    "paddpg": ["low.warmup_steps=64", "low.updates_per_step=0.05", "low.batch_size=16"],
    "pets": [
        *("low.warmup_steps=64", "low.updates_per_step=0.1", "low.batch_size=16", "low.transition_dims=[16]"),
        *(
            "low.outcome_dims=[16]",
            "low.num_members=2",
            "low.num_samples=4",
            "low.greedy_samples=4",
            "low.num_elites=2",
            "low.num_iterations=2",
        ),
        "low.max_sequences=8",
    ],
    "pdqn": ["low.warmup_steps=64", "low.updates_per_step=0.05", "low.batch_size=16"],
    "pdqn_published": ["low.warmup_steps=64", "low.updates_per_step=0.05", "low.batch_size=16"],
    "qpamdp": ["low.warmup_steps=32", "low.initial_episodes=8", "low.relearning_episodes=8", "low.rollouts=8"],
}
# The same for selectors.
SHORT_SELECTORS = {
    "actor": ["high.minibatch_size=16"],
    "meta_critic": ["high.warmup_decisions=20", "high.updates_per_decision=0.1", "high.batch_size=16"],
    "option_critic": ["high.warmup_steps=64", "high.updates_per_step=0.05", "high.batch_size=16"],
}
# What has nothing to learn.
FIXED = ("planner", "random")
SMALL = ["num_envs=16", "steps_per_batch=4", "total_frames=256", "eval.layouts=10", "eval.every=0", "log_every=0"]


def words(high: str, low: str) -> list[str]:
    controller = "random" if high == "none" else "choose"
    return [
        f"high={high}",
        f"low={low}",
        f"env.controller={controller}",
        *SHORT.get(low, []),
        *SHORT_SELECTORS.get(high, []),
        *SMALL,
    ]


def make(high: str, low: str, tmp_path):
    torch.manual_seed(0)
    return assemble(make_config(words(high, low)))


def weights(agent: HierarchicalAgent) -> dict[str, torch.Tensor]:
    """Return what the learners have learned, without their counters and schedules."""
    state = agent.learners.state_dict()
    tensors = {name: value for name, value in state.items() if isinstance(value, torch.Tensor)}
    return {name: value.clone() for name, value in tensors.items() if value.is_floating_point() and value.ndim > 0}


def assert_it_updated(given: list[str], folder: Path) -> None:
    """Assert that the learners of a run in a folder are no longer those that the run began with."""
    torch.manual_seed(0)
    parts = assemble(make_config(given))
    before = weights(parts.agent)
    checkpoint.load(folder / checkpoint.FILE_NAME, parts.agent, parts.device, with_training=False)
    after = weights(parts.agent)
    assert any(before[name].shape != value.shape or not before[name].equal(value) for name, value in after.items())


# `high=value` is refused with these, which have no value to compare.
WITHOUT_VALUE = ("bc", "dlpa", "planner", "random")
# Quick: selectors over H-PPO that no quick test of resumptions trains. `test_every_learner_works_on_other_problems` has
# the learners.
KINDS = ("human", "none", "option_critic", "value")
PAIRS = [
    pytest.param(high, low, marks=[] if low == "hppo" and high in KINDS else [pytest.mark.slow])
    for high, low in itertools.product(choices("high"), TRAINED)
    if high != "value" or low not in WITHOUT_VALUE
]


@pytest.mark.parametrize(("high", "low"), PAIRS)
def test_every_pair_trains_and_is_scored(high, low, tmp_path):
    assert run(compose_config(words(high, low)), tmp_path, words(high, low)) == 0
    assert (tmp_path / "summary.json").is_file()
    if low not in FIXED:
        assert_it_updated(words(high, low), tmp_path)


# Keys with two, no and one parameter, in odd bounds; and the other built-in problems.
ELSEWHERE = {
    "gymnasium": ["env.entry_point=toy_environments:Toy", "env.kwargs={length:4}", "env.max_steps=6"],
    "platform": [],
    # Whoever idles there would idle for 999 steps.
    "boatdock_released": ["env.max_steps=30"],
}


# Quick: every learner on one other problem, and H-PPO on all of them.
ELSEWHERE_PAIRS = [
    pytest.param(low, env, marks=[] if env == "gymnasium" or low == "hppo" else [pytest.mark.slow])
    for low, env in itertools.product(TRAINED, ELSEWHERE)
    if low != "planner"
]


@pytest.mark.parametrize(("low", "env"), ELSEWHERE_PAIRS)
def test_every_learner_works_on_other_problems(low, env, tmp_path):
    given = [f"env={env}", "high=none", f"low={low}", *ELSEWHERE[env], *SHORT.get(low, []), *SMALL]
    assert run(compose_config(given), tmp_path, given) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["env"] == env and not {"human", "human_normalised"} & {*summary, *summary["references"]}
    if low not in FIXED:
        assert_it_updated(given, tmp_path)


@pytest.mark.parametrize("sharing", ["per_option", "shared"])
def test_learners_work_for_each_option_and_shared(sharing, tmp_path):
    assert run(compose_config([*words("ucb", "hyar"), f"agent.sharing={sharing}"]), tmp_path) == 0


# Quick: each selector, and a learner of each kind.
RELOADED = [
    *((high, "hppo" if high == "value" else "random") for high in choices("high")),
    *(pytest.param("uniform", low, marks=[] if low in OF_EACH_KIND else [pytest.mark.slow]) for low in TRAINED),
]


@pytest.mark.parametrize(("high", "low"), RELOADED)
def test_an_agent_reloaded_from_a_checkpoint_goes_on_as_if_it_had_never_stopped(high, low, tmp_path):
    parts = make(high, low, tmp_path)
    collected = parts.env.rollout(20, parts.agent.policy, break_when_any_done=False).contiguous()
    parts.agent.learn(collected)
    file = tmp_path / checkpoint.FILE_NAME
    states = {"collection": {"env": parts.env.env_state()}, "recorder": {}, "callbacks": {}}
    progress = {"frames": 320, "config": {}, "option_names": [], "wall_s": 1.0, "cpu_s": 1.0, "last_score": None}
    checkpoint.save(file, parts.agent, states, progress)

    other = make(high, low, tmp_path)
    torch.manual_seed(99)
    saved = checkpoint.load(file, other.agent, other.device, with_training=True)
    other.env.set_env_state(saved.states["collection"]["env"])
    assert checkpoint.progress_of(file) == progress
    results = []
    for one in (other, parts):
        torch.manual_seed(5)
        one.agent.learn(collected)
        td: TensorDict = one.env.rollout(5, one.agent.policy, break_when_any_done=False)
        results.append(td)
    for key in ("observation", ("action", "discrete"), ("action", "parameters")):
        torch.testing.assert_close(results[0][key], results[1][key])


def can_augment(low: str) -> bool:
    """Return whether the setting `augment` of a learner's class can be true."""
    target = yaml.safe_load((CONF / "low" / f"{low}.yaml").read_text())["_target_"]
    field = settings_model(load_class(target), SUPPLIED_ARGUMENTS["low"]).model_fields.get("augment")
    return field is not None and field.annotation != Literal[False]


AUGMENTED = [low for low in choices("low") if can_augment(low)]


@pytest.mark.parametrize("low", AUGMENTED)
def test_a_learner_with_augment_learns_from_steps_under_the_problems_symmetries(low, monkeypatch):
    given = [*words("uniform", low), "low.augment=true"]
    if low != "pets":  # which learns from all maps of a step at once
        calls = []
        mapped = RandomSymmetry.mapped
        monkeypatch.setattr(
            RandomSymmetry, "mapped", lambda self, *rows: calls.append(len(self.maps)) or mapped(self, *rows)
        )
    torch.manual_seed(0)
    parts = assemble(make_config(given))
    before = weights(parts.agent)
    collected = parts.env.rollout(20, parts.agent.policy, break_when_any_done=False).contiguous()
    parts.agent.learn(collected)
    assert any(not before[name].equal(value) for name, value in weights(parts.agent).items())
    if low != "pets":
        assert calls and set(calls) == {6}, "each boat's learner has the maps that keep the boat"


@pytest.mark.slow
@pytest.mark.parametrize("low", sorted({*TRAINED} - {*FIXED, "qpamdp"}))
def test_every_learner_makes_updates_in_bfloat16(low, tmp_path):
    given = [*words("ucb", low), "update_precision=bfloat16"]
    assert run(compose_config(given), tmp_path, given) == 0
    assert_it_updated(given, tmp_path)
