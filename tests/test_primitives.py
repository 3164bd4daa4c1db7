"""Primitives of an arm move it where their arguments say, and six Meta-World tasks can be solved with five of them."""

from __future__ import annotations

import importlib.util
from typing import get_args

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.env.primitives import players
from hpamdp.env.primitives.environment import PrimitivesEnv
from hpamdp.env.primitives.manipulation import OBSERVED, Manipulation
from hpamdp.env.primitives.options import ACTIONS, Task
from hpamdp.env.primitives.primitives import OPENING_STEPS, STEPS, phases
from hpamdp.env.registration import register
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

register()
needs_simulator = pytest.mark.skipif(importlib.util.find_spec("metaworld") is None, reason="needs hpamdp[robots]")
TASKS = get_args(Task)
ALL = {action.name: action for action in ACTIONS["all"]}


class PerfectHand:
    """A hand that is always where its target is."""

    def __init__(self) -> None:
        self.place = np.array([0.0, 0.6, 0.2])
        self.efforts: list[float] = []

    def position(self):
        return self.place.copy()

    def holding_effort(self):
        return 0.25

    def act(self, name, *arguments):
        """Return the displacement of each phase of an action."""
        displacements = []
        for phase in phases(ALL[name], np.array(arguments)):
            before = self.position()
            for command in phase.commands(self):
                assert command.dtype == np.float32 and np.abs(command).max() <= 1.0
                self.place = self.place + 0.01 * command[:3]
                self.efforts.append(float(command[3]))
            displacements.append(self.place - before)
        return displacements


@pytest.mark.parametrize(
    ("name", "arguments", "expected"),
    [
        ("move", (0.2, -0.1, 0.05), (0.2, -0.1, 0.05)),
        ("lift", (0.2,), (0.0, 0.0, 0.2)),
        ("left", (0.3,), (-0.3, 0.0, 0.0)),
        ("forward", (0.15,), (0.0, 0.15, 0.0)),
        ("open", (), (0.0, 0.0, 0.0)),
        ("small step open", (0.01, 0.0, -0.005), (0.01, 0.0, -0.005)),
        ("large step closed", (0.1, 0.02, -0.05), (0.1, 0.02, -0.05)),
    ],
)
def test_an_action_moves_the_hand_by_its_arguments(name, arguments, expected):
    (moved,) = PerfectHand().act(name, *arguments)
    np.testing.assert_allclose(moved, expected, atol=2e-3)


def test_a_grasp_opens_moves_by_y_then_x_then_z_and_closes():
    hand = PerfectHand()
    moved = hand.act("grasp", 0.1, 0.2, -0.15)
    expected = [(0, 0, 0), (0, 0.2, 0), (0.1, 0, 0), (0, 0, -0.15), (0, 0, 0)]
    np.testing.assert_allclose(moved, expected, atol=2e-3)
    assert hand.efforts == [-1.0] * OPENING_STEPS + [0.25] * (3 * STEPS) + [1.0] * STEPS


@pytest.mark.parametrize(
    ("name", "effort"), [("move", 0.25), ("lift", 1.0), ("left", 1.0), ("open", -1.0), ("small step open", -1.0)]
)
def test_fingers_stay_in_a_move_and_are_closed_along_an_axis(name, effort):
    hand = PerfectHand()
    hand.act(name, *[0.01] * ALL[name].num_arguments)
    assert {*hand.efforts} == {effort}


def test_the_options_suggested_hold_every_action_once():
    for actions in ("primitives", "all"):
        facts = PrimitivesEnv.facts(PrimitivesEnv.Options(actions=actions))
        members = [name for names in facts.default_options.values() for name in names]
        assert sorted(members) == sorted(action.name for action in ACTIONS[actions])


def test_every_task_has_a_measured_player():
    assert {*players.MEASURED} == {*TASKS}


@needs_simulator
def test_all_tensors_are_as_the_specs_say():
    from torchrl.envs.utils import check_env_specs

    env = PrimitivesEnv(2)
    check_env_specs(env, return_contiguous=True)
    specs = PAMDPSpecs.from_env(env)
    assert specs.parameter_dims == (3, 3, 1, 1, 1, 1, 1, 1, 0, 0) and specs.observation_dim == len(OBSERVED)
    assert specs.parameter_low == (-1.0,) * 12 and env.max_steps == 5


@needs_simulator
@pytest.mark.parametrize("task", TASKS)
def test_the_player_solves_the_task(task):
    played = players.measure(task, [900])
    assert played["success"] == 1.0 and played["score"] >= 1.0


@needs_simulator
def test_the_hand_of_the_simulator_arrives_where_a_move_ends():
    env = gymnasium.make("hpamdp/PegUnplugSide-v0").unwrapped
    env.reset(seed=0)
    before = env.position()
    env.step(players.as_action(env, ("move", (0.2, 0.1, 0.05))))
    np.testing.assert_allclose(env.position() - before, (0.2, 0.1, 0.05), atol=5e-3)


@needs_simulator
def test_a_seed_begins_the_same_episode_whatever_was_played_before():
    first, second = Manipulation("soccer"), Manipulation("soccer")
    played = [first.reset(seed=3)[0]]
    second.reset(seed=4)
    second.step(players.as_action(second, ("move", (0.1, 0.1, 0.0))))
    again = [second.reset(seed=3)[0]]
    for env, seen in ((first, played), (second, again)):
        seen.append(env.step(players.as_action(env, players.choose("soccer", seen[0])))[0])
        seen.append(env.reset()[0])
    np.testing.assert_allclose(played, again, atol=1e-6)
    assert np.abs(played[0] - played[2]).max() > 0.01


@needs_simulator
def test_no_episode_of_an_evaluation_is_one_of_training():
    env = PrimitivesEnv(4, task="assembly", seed=7)
    training = env.reset()[keys.OBSERVATION]
    evaluation = env.reset(env.fixed_episodes(7))[keys.OBSERVATION]
    goal = [OBSERVED.index("goal_x"), OBSERVED.index("goal_y")]
    assert (training[:, None, goal] - evaluation[None, :, goal]).abs().amax(-1).min() > 1e-3


@needs_simulator
@pytest.mark.parametrize(
    ("actions", "decisions", "steps"), [("primitives", 2, 2), ("large_steps", 1, 6), ("all", 1, 60)]
)
def test_an_episode_terminates_after_its_time(actions, decisions, steps):
    env = PrimitivesEnv(1, actions=actions, decisions=decisions)
    assert env.max_steps == steps
    td = env.reset()
    action = env.full_action_spec.zero()
    action[keys.DISCRETE].fill_(len(ACTIONS[actions]) - 3 if actions == "all" else 0)  # the small step that closes
    for number in range(steps):
        td = env.step(td.update(action))["next"]
        assert td["done"].item() == td["terminated"].item() == (number == steps - 1)
        assert td[keys.OBSERVATION][0, -1].item() == pytest.approx(1.0 - 2.0 * (number + 1) / steps, abs=1e-5)


@needs_simulator
def test_no_step_is_taken_before_an_episode_begins_or_after_it_ended():
    env = Manipulation(decisions=1)
    for begin in (lambda: None, lambda: (env.reset(seed=0), env.step(env.action_space.sample()))):
        begin()
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(env.action_space.sample())


@needs_simulator
@pytest.mark.parametrize("settings", [{}, {"reach": 0.3, "negative_distances": False}])
def test_initial_parameters_lead_grasps_to_the_object_and_pulls_towards_the_goal(settings):
    env = PrimitivesEnv(1, task="disassemble", actions="all", **settings)
    seen = env.reset()[keys.OBSERVATION][0]
    weight, bias = env.initial_parameters()
    space = env.full_action_spec_unbatched[keys.PARAMETERS].space
    unit = weight @ seen + bias
    metres = (space.low + (unit + 1.0) / 2.0 * (space.high - space.low)).flatten()
    object_offset, goal_offset = seen[4:7] / 2.0, seen[11:14] / 2.0
    for first in (0, 3):
        torch.testing.assert_close(metres[first : first + 3], object_offset)
    # A pull that leads away from the goal has a negative distance, which counts as 0.
    x, y, z = goal_offset.tolist()
    torch.testing.assert_close(metres[6:12], torch.tensor([z, -z, -x, x, y, -y]))
    assert not metres[12:].any()  # position steps begin at rest


def with_initial_parameters(env, state, name):
    """Return the states after every arm takes this primitive with its initial parameters."""
    weight, bias = env.initial_parameters()
    unit = (state[keys.OBSERVATION] @ weight.T + bias).clamp(-1.0, 1.0)
    number = torch.full((env.num_envs,), env.discrete_names.index(name))
    parameters = PAMDPSpecs.from_env(env).from_unit(unit)
    action = TensorDict({"discrete": number, "parameters": parameters}, batch_size=env.batch_size)
    return env.step(state.set("action", action))["next"]


@needs_simulator
@pytest.mark.parametrize("task", ["soccer", "assembly"])
def test_the_players_choices_with_the_initial_parameters_succeed(task):
    env = PrimitivesEnv(1, task=task, reach=0.4, negative_distances=False)
    state = env.reset()
    for _ in range(5):
        name, _ = players.choose(task, state[keys.OBSERVATION][0].numpy() / 2.0)  # offsets in metres
        state = with_initial_parameters(env, state, name)
    assert state["success"].item()


@needs_simulator
def test_a_small_step_is_a_step_of_metaworld():
    from metaworld.env_dict import ALL_V3_ENVIRONMENTS

    env = Manipulation("assembly", actions="small_steps", reward="dense")
    own = ALL_V3_ENVIRONMENTS["assembly-v3"]()
    own._set_task_called, own._freeze_rand_vec, own.seeded_rand_vec = True, False, True
    own.seed(5)
    own.reset()
    env.reset(seed=5)
    nothing = np.zeros(3, np.float32)
    for _ in range(3):
        _, reward, *_ = env.step((1, (nothing, np.array([0.004, -0.01, 0.002], np.float32))))
        _, expected, *_ = own.step(np.array([0.4, -1.0, 0.2, 1.0], np.float32))
        assert reward == pytest.approx(expected / STEPS, rel=1e-5)
        np.testing.assert_allclose(env.position(), own.get_endeff_pos(), atol=1e-6)


@needs_simulator
def test_sparse_rewards_count_primitives_with_success_and_dense_ones_average():
    rewards = {}
    for reward in ("sparse", "dense"):
        env = Manipulation("peg_unplug_side", reward=reward)
        observation, _ = env.reset(seed=1)
        rewards[reward] = []
        for _ in range(3):
            choice = players.choose("peg_unplug_side", observation)
            observation, earned, _, _, info = env.step(players.as_action(env, choice))
            rewards[reward].append(earned)
    assert rewards["sparse"] == [0.0, 1.0, 0.0]  # the peg passes the goal in the second, and is away in the third
    assert info["is_success"] and all(0.0 < earned < 10.0 for earned in rewards["dense"])


@needs_simulator
def test_the_ways_of_steering_are_options_that_refuse_the_actions_of_others():
    env = PrimitivesEnv(1, actions="all")
    env.group_actions(env.default_options)
    assert env.option_names == ("small_steps", "large_steps", "primitives")
    td = env.reset().update(env.full_action_spec.zero())
    with pytest.raises(ValueError, match="option=0, discrete=0"):
        env.step(td)


@needs_simulator
def test_it_is_drawn_or_says_in_one_line_what_to_set():
    try:
        env = PrimitivesEnv(1, render=True)
    except SettingError as error:
        assert "MUJOCO_GL=egl" in str(error) and "\n" not in str(error)
        return
    env.reset()
    (picture,) = env.film_state(1).values()
    assert picture.dtype == torch.uint8 and picture.shape == (1, 320, 320, 3)
