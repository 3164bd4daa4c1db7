"""What goes together: pairs that cannot be are refused in one line, and those that can do what they are for."""

import math
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest
import torch
from conftest import make_config
from test_grid import SHORT, SMALL
from toy_options import Crossing

from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config
from hpamdp.env.base import ProblemError
from hpamdp.env.facts import ProblemFacts
from hpamdp.env.option_choice import OptionChoiceEnv
from hpamdp.env.rooms.options import RoomsOptions
from hpamdp.run.assemble import AssembledRun, assemble
from hpamdp.run.trainer import Trainer

QUICK_CRITIC = ["high=meta_critic", "high.warmup_decisions=0", "high.updates_per_decision=0.2", "high.batch_size=16"]


def make(config: Config, folder: Path) -> AssembledRun:
    torch.manual_seed(0)
    return assemble(config)


def train(config: Config, folder: Path) -> AssembledRun:
    """Train and leave the checkpoint in the folder."""
    folder.mkdir()
    parts = make(config, folder)
    assert not Trainer(config, parts, folder).train()
    return parts


def crossing(*words: str) -> Config:
    """Return a config with options that may change within an episode, and learners that know the way."""
    return make_config([*SMALL, "env=crossing", "low=stepper", *words])


def test_a_ceiling_with_changes_that_options_never_make_is_told_in_one_line(capsys):
    assemble(make_config(["env.switch_cost=0.2", "high=ucb", "low=random", "eval.layouts=4"]))
    assert capsys.readouterr().err == (
        "env=boatdock: its plans, and so the ceiling, change options, but agent.termination=episode keeps them; use "
        "agent.termination=steps agent.option_length=1 to change them\n"
    )


def words_of(low: str) -> list[str]:
    return [*SMALL, "high=uniform", f"low={low}", *SHORT[low]]


@pytest.fixture(scope="module")
def run_of(tmp_path_factory) -> Callable[[str], tuple[Path, AssembledRun]]:
    """Return a function that trains a learner in a tiny run, once, and returns the run's folder and its parts."""

    @cache
    def trained(low: str) -> tuple[Path, AssembledRun]:
        folder = tmp_path_factory.mktemp("runs") / low
        return folder, train(make_config(words_of(low)), folder)

    return trained


@pytest.fixture
def trained(run_of) -> Path:
    """The output folder of a tiny run of H-PPO."""
    return run_of("hppo")[0]


@pytest.mark.parametrize("words", ["low=random", "low=hppo low.hidden_dims=[8]", "low=hppo agent.sharing=shared"])
def test_learners_of_another_kind_or_size_are_refused_in_one_line(words, trained, tmp_path):
    with pytest.raises(ConfigError) as error:
        make(make_config([*SMALL, "total_frames=20000", *words.split(), f"low.checkpoint={trained}"]), tmp_path)
    line = str(error.value)
    assert line.startswith(f"low.checkpoint={trained / 'checkpoint.safetensors'}: ")
    assert "it holds 2 learners, but this agent has 1" in line or "of another class or size than low (" in line
    assert "\n" not in str(error.value)


def copied(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in module.state_dict().items() if isinstance(value, torch.Tensor)}


def is_same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[name], other[name]) for name in one)


def test_frozen_learners_of_another_run_stay_as_they_are_while_the_selector_learns(trained, tmp_path):
    words = [*SMALL, "low=hppo", *SHORT["hppo"], "agent.sharing=per_option"]
    fresh = copied(make(make_config([*words, "high=ucb"]), tmp_path / "fresh").agent.learners)
    words += [*QUICK_CRITIC, f"low.checkpoint={trained}", "low.freeze=true"]
    parts = make(make_config(words), tmp_path / "before")
    assert isinstance(parts.env.base_env, OptionChoiceEnv)
    start, selector = copied(parts.agent.learners), copied(parts.agent.selector)
    assert not is_same(start, fresh)
    parts = train(make_config(words), tmp_path / "after")
    assert is_same(copied(parts.agent.learners), start)
    now = copied(parts.agent.selector)
    assert int(now["num_decisions"]) == 256, "a frame is a decision"
    assert not torch.equal(now["critics.layers.0.weight"], selector["critics.layers.0.weight"])


@pytest.mark.parametrize("low", ["hppo", "pdqn"])
def test_learners_of_another_run_bring_their_networks_and_begin_their_schedules_afresh(low, run_of, tmp_path):
    folder, first = run_of(low)
    words, trained = words_of(low), copied(first.agent.learners)
    fresh = copied(make(make_config(words), tmp_path / "fresh").agent.learners)
    parts = make(make_config([*words, f"low.checkpoint={folder}"]), tmp_path / "second")
    loaded = copied(parts.agent.learners)
    assert trained["0.frames"] > 0
    progress = parts.agent.learners[0].progress
    restarted = {name for name in loaded if name.rpartition(".")[2] in progress}
    assert "0.frames" in restarted
    for name, value in loaded.items():
        assert torch.equal(value, (fresh if name in restarted else trained)[name]), name


def test_a_learner_of_another_run_fills_its_replay_before_it_updates(run_of, tmp_path):
    folder, first = run_of("pdqn")
    frames = min(int(learner.frames) for learner in first.agent.learners)
    again = [*words_of("pdqn"), f"low.checkpoint={folder}", f"low.warmup_steps={frames}"]
    parts = make(make_config(again), tmp_path / "second")
    before = [int(learner.updates) for learner in parts.agent.learners]
    batch = parts.env.rollout(2, parts.policy, break_when_any_done=False)
    assert batch.numel() < frames
    parts.agent.learn(batch)
    assert max(before) > 0
    assert [int(learner.updates) for learner in parts.agent.learners] == before


def test_frozen_learners_that_need_no_training_need_no_checkpoint(tmp_path):
    words = [*SMALL, "high=ucb", "low=random", "low.freeze=true"]
    parts = train(make_config(words), tmp_path / "out")
    assert parts.agent.selector.num_decisions.item() == 256


def test_options_of_a_fixed_length_are_chosen_and_discounted_as_the_selector_asks(tmp_path):
    parts = make(
        crossing(*QUICK_CRITIC, "high.gamma=0.9", "agent.termination=steps", "agent.option_length=2"), tmp_path
    )
    batch = parts.env.rollout(40, parts.policy, break_when_any_done=False)
    is_cut = batch["next", keys.IS_DECISION] & ~batch["next", keys.DONE]
    assert is_cut.any() and batch["next", keys.OPTION_STEPS].max() == 2
    paid = batch["next", keys.REWARD] > 0.0
    expected = 0.9 ** (batch["next", keys.OPTION_STEPS][paid] - 1.0)
    torch.testing.assert_close(batch["next", keys.OPTION_RETURN][paid], expected)
    assert (expected < 1.0).any() and (expected == 1.0).any()
    assert parts.evaluation.env.transform.option_length == 2
    assert "high/critic" in parts.agent.learn(batch.contiguous())
    played = parts.evaluation.run_agent(parts.agent)
    assert played["option_scores"].shape == (10, 2) and played["steps"].max() <= Crossing.max_steps


def test_returns_over_frozen_learners_are_discounted_by_the_step_of_the_episode(tmp_path):
    parts = make(crossing(*QUICK_CRITIC, "high.gamma=0.9", "low.freeze=true"), tmp_path)
    after = parts.env.rollout(1, parts.policy)["next"]
    arrived = after[keys.REWARD] > 0.0
    steps = 1 + torch.log(after[keys.REWARD][arrived]) / math.log(0.9)
    assert arrived.any() and (steps >= 3 - 1e-3).all()
    torch.testing.assert_close(steps, steps.round(), atol=1e-3, rtol=0.0)


@pytest.mark.parametrize("names", [5, ("a", "a")])
def test_names_of_options_that_are_no_list_of_names_are_refused_for_every_environment(names, tmp_path, monkeypatch):
    facts = ProblemFacts(title="rooms", option_names=names, has_choice=True)
    monkeypatch.setattr(Crossing, "option_names", names)
    monkeypatch.setattr(RoomsOptions, "facts", lambda options, title: facts)
    for words in (["env=crossing", "low=stepper"], ["env=rooms", "low=random", "high=uniform"]):
        with pytest.raises((ProblemError, ConfigError), match=r"option_names (is .* a list|has a name twice)"):
            make(make_config([*SMALL, *words]), tmp_path)
