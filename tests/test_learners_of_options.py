"""Each option may have a learner of another class: `low.per_option`."""

from __future__ import annotations

import pytest
from conftest import make_config
from test_assemble import QUICK_CRITIC, make, train
from test_grid import SHORT, SMALL

from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.config.saved import read_saved
from hpamdp.policies.low_level.hppo import HPPO
from hpamdp.policies.low_level.paddpg import PADDPG
from hpamdp.run.compatibility import check

WORDS = [*SMALL, "env=platform", "+env.grouping=default", *QUICK_CRITIC, "low=hppo", *SHORT["hppo"]]
PER_OPTION = "+low.per_option={jump: {name: paddpg, hidden_dims: [16], warmup_steps: 10, batch_size: 16}}"


def test_learners_of_two_classes_train_side_by_side(tmp_path):
    config = make_config([*WORDS, PER_OPTION, "agent.termination=steps", "agent.option_length=2"])
    parts = train(config, tmp_path / "run")
    assert [type(learner) for learner in parts.agent.learners] == [HPPO, PADDPG]
    assert parts.agent.learners[1].updates > 0
    batch = parts.env.rollout(30, parts.policy, break_when_any_done=False)
    jumps = batch[keys.OPTION] == 1
    assert jumps.any() and (~jumps).any()
    assert (batch["scores"][jumps].abs().sum(-1) > 0).all()
    assert parts.evaluation.run_agent(parts.agent)["option_scores"].shape[1] == 2


def test_the_other_options_keep_the_learner_of_the_run():
    config = make_config([*WORDS, "+low.per_option={jump: random}"])
    assert config.low.name == "hppo" and {name: low.name for name, low in config.low_of.items()} == {"jump": "random"}
    assert read_saved(config.to_dict()) == config


def test_the_learner_of_an_option_gets_the_recipe_of_the_problem_and_the_length_of_the_run():
    words = ["env=goal", "high=ucb", "low=pdqn", "+env.grouping=default", "total_frames=1234"]
    own = "+low.per_option={shoot: {name: hppo, clip: 0.3}, kick: qpamdp, dribble: pdqn}"
    config = make_config([*words, own])
    recipe = make_config(["env=goal", "high=none", "low=qpamdp"]).low.settings
    assert config.low_of["kick"].settings == recipe != make_config(["low=qpamdp"]).low.settings
    assert config.low_of["dribble"].settings == config.low.settings
    hppo = make_config(["env=goal", "high=none", "low=hppo", "low.clip=0.3", "total_frames=1234"]).low.settings
    assert config.low_of["shoot"].settings == hppo and hppo["anneal_steps"] == 1234
    assert read_saved(config.to_dict()) == config


STEPS = ["agent.termination=steps", "agent.option_length=2"]
SCALED = "+low.per_option={jump: {name: paddpg, reward_scale: 0.1}}"


def test_values_on_different_scales_are_not_compared():
    with pytest.raises(ConfigError) as error:
        check(make_config([*SMALL, "env=platform", "+env.grouping=default", "low=hppo", "high=value", SCALED]))
    assert str(error.value) == (
        "low.per_option: high=value needs the same reward_scale in all learners, whose values it compares; "
        "low=hppo has 1.0, low=paddpg 0.1"
    )


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ([SCALED, *STEPS], "low.per_option: agent.termination=steps needs the same reward_scale in all learners,"),
        (["+low.per_option={jump: random}", *STEPS], "bootstrap from each other, but low=random has no value"),
        (["+low.per_option={jump: dlpa}", *STEPS], "but low=dlpa has no value without end_values=true"),
        (
            ["+low.per_option={run: {name: hyar, latent_dim: 4}, jump: {name: hyar, latent_dim: 6}}"],
            "low.per_option: latent_dim must be the same in all learners, as steps hold one size, but is 4 and 6",
        ),
        (["+low.per_option={jump: pets}", *STEPS], "low.per_option: agent.termination=steps lets learners bootstrap"),
        (["+low.per_option={fly: random}"], "low.per_option: env=platform has no option fly; it has run, jump"),
        (["+low.per_option={jump: nothing}"], "low.per_option.jump=nothing: no such file in conf/low; it has bc, "),
        (["+low.per_option={jump: {lr: 3}}"], 'low.per_option.jump={"lr": 3}: must be the name of a learner, or its'),
        (["+low.per_option={jump: {name: random, lr: 3}}"], "low.per_option.jump.lr: no such setting of Random"),
        (["+low.per_option={jump: ../low/random}"], 'low.per_option.jump="../low/random": must be the name of a'),
        (["+low.per_option={jump: {name: random, _target_: os.PathLike}}"], "low.per_option.jump._target_: a yaml"),
        (["+low.per_option={jump: {name: random, budget: {num_envs: 3}}}"], "low.per_option.jump.budget: a run has"),
        (["+low.per_option={jump: {name: random, checkpoint: a}}"], "low.per_option.jump.checkpoint: a checkpoint"),
        (["+low.per_option={jump: bc}"], "mode=train: low=bc learns from data sets only"),
        (["+low.per_option={jump: random}", "agent.sharing=shared"], "low.per_option: agent.sharing=shared has one"),
    ],
)
def test_a_learner_that_an_option_cannot_have_is_told_in_one_line(words, complaint, tmp_path):
    with pytest.raises(ConfigError) as error:
        make(make_config([*WORDS, *words]), tmp_path)
    assert complaint in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    "words",
    [
        ["+low.per_option={jump: random}"],
        ["+low.per_option={jump: {name: paddpg, reward_scale: 0.01}}"],
        ["low=random", "+low.per_option={jump: dlpa}", *STEPS],
        ["+low.per_option={jump: {name: dlpa, end_values: true}}", *STEPS],
        ["low=pdqn", "low.reward_scale=0.1", "+low.per_option={jump: {name: paddpg, reward_scale: 0.1}}", *STEPS],
    ],
)
def test_learners_that_ask_each_other_nothing_or_have_values_in_one_unit_go_together(words):
    check(make_config([*SMALL, "env=platform", "+env.grouping=default", *QUICK_CRITIC, "low=hppo", *words]))
