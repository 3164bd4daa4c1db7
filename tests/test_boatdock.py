"""BoatDockEnv keeps TorchRL's contract, also for invalid inputs."""

from __future__ import annotations

import math

import pytest
import torch
from batched_players import is_unchanged, snapshot
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.env.boatdock import harbour
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.task import SCALED_NAMES

CENTRE = torch.tensor(harbour.CENTRE)
NOISE = {"motor_noise": 0.2, "sensor_noise": 3.0, "slip": 0.3}


def action(key, duration, option=None) -> TensorDict:
    """Return actions: `key` and `option` are lists or `[N]`, `duration` has a number for each boat or is `[N, 3]`."""
    key = torch.as_tensor(key)
    duration = torch.as_tensor(duration, dtype=torch.float32)
    num = len(key)
    duration = duration if duration.ndim == 2 else duration.reshape(-1, 1).expand(num, 3)
    td = TensorDict({keys.ACTION: TensorDict(discrete=key, parameters=duration, batch_size=[num])}, batch_size=[num])
    if option is not None:
        td[keys.OPTION] = torch.as_tensor(option)
    return td


def press(env: BoatDockEnv, key, duration, option=None) -> TensorDictBase:
    return env.step(action(key, duration, option))["next"]


def layout(start, goal, num: int = 1, **rest) -> TensorDict:
    """Return a layout given in px from the harbour's centre, the same for every boat."""
    td = TensorDict(batch_size=[num])
    td["start"] = (torch.tensor(start) + CENTRE).expand(num, 2)
    td["goal"] = (torch.tensor(goal) + CENTRE).expand(num, 2)
    for name, value in rest.items():
        td[name] = torch.full((num,), value)
    return td


@pytest.mark.parametrize("observation", ["scaled", "pixels"])
@pytest.mark.parametrize("controller", ["choose", "congruent", "random"])
def test_all_tensors_are_as_the_specs_say(controller, observation):
    noise = NOISE if controller == "random" else {}
    check_env_specs(BoatDockEnv(2, controller=controller, observation=observation, **noise), return_contiguous=True)


def test_the_option_is_read_at_the_first_press_and_held():
    env = BoatDockEnv(2, controller="choose")
    env.reset(layout([0.0, 0.0], [90.0, 0.0], 2))
    assert env.state.controller.tolist() == [-1, -1]
    for option in ([0, 1], [1, 0], [1, 1]):
        reading = press(env, [2, 1], [0.1, 0.1], option)
        assert env.state.controller.tolist() == [0, 1]
        assert reading["observation"][:, SCALED_NAMES.index("controller")].tolist() == [0.0, 1.0]
    # The incongruent controller's third key goes down, the congruent controller's second key up.
    assert env.state.y[0] > 0.0 > env.state.y[1]
    assert torch.allclose(env.state.y[0], -env.state.y[1])
    env.reset()
    assert env.state.controller.tolist() == [-1, -1]


def test_given_layouts_are_played_with_their_controllers_and_keymaps():
    env = BoatDockEnv(3, controller="random", keymap="random", observation="pixels")
    given = layout([-20.0, 10.0], [40.0, 50.0], 3)
    given["controller"] = torch.tensor([1, 0, 0])
    given["keymap"] = torch.tensor([1, 1, 2])
    reading = env.reset(given)
    assert reading["observation"][:, :4].tolist() == [[620.0, 522.0, 680.0, 562.0]] * 3
    press(env, [0, 0, 0], [0.5] * 3)
    moved = torch.stack([env.state.x + 20.0, env.state.y - 10.0], -1)
    expected = torch.tensor([harbour.DIRECTIONS[row][0] for row in (2, 0, 1)])
    torch.testing.assert_close(moved / moved.norm(dim=-1, keepdim=True), expected)


BAD_LAYOUTS = {
    "start in the dock": layout([0.0, 0.0], [10.0, 0.0], 2),
    "start outside": layout([0.0, 121.0], [10.0, 0.0], 2),
    "goal outside": layout([0.0, 0.0], [121.0, 0.0], 2),
    "nan": layout([0.0, math.nan], [50.0, 0.0], 2),
    "no goal": layout([0.0, 0.0], [50.0, 0.0], 2).exclude("goal"),
    "one coordinate": TensorDict(start=torch.zeros(2, 1), goal=torch.zeros(2, 2), batch_size=[2]),
    "no such controller": layout([0.0, 0.0], [50.0, 0.0], 2, controller=2),
    "no such keymap": layout([0.0, 0.0], [50.0, 0.0], 2, keymap=0),
    "a controller that the agent chooses": layout([0.0, 0.0], [50.0, 0.0], 2, controller=1),
}


@pytest.mark.parametrize("name", BAD_LAYOUTS)
def test_an_invalid_layout_is_refused_and_changes_nothing(name):
    env = BoatDockEnv(2, controller="choose" if name == "a controller that the agent chooses" else "random")
    env.reset()
    before = snapshot(env)
    with pytest.raises(ValueError, match="reset: "):
        env.reset(BAD_LAYOUTS[name].clone())
    assert is_unchanged(env, before)


BAD_ACTIONS = {
    "no such option": action([0, 0], [0.1, 0.1], [0, 2]),
    "no option": action([0, 1], [0.1, 0.1]),
    "option of another shape": action([0, 1], [0.1, 0.1], [[0], [1]]),
}


@pytest.mark.parametrize("name", BAD_ACTIONS)
def test_an_invalid_action_is_refused_and_changes_nothing(name):
    env = BoatDockEnv(2, controller="choose")
    env.reset()
    before = snapshot(env)
    with pytest.raises(ValueError, match="step: "):
        env.step(BAD_ACTIONS[name].clone())
    assert is_unchanged(env, before)


@pytest.mark.parametrize(
    "arguments", [{"slip": 1.5}, {"motor_noise": [0.1, 0.2, 0.3]}, {"motor_noise": [0.1, math.nan]}], ids=str
)
def test_an_invalid_argument_is_refused_by_name(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        BoatDockEnv(**arguments)


@pytest.mark.parametrize("name", ["new", "seeded anew"])
def test_a_step_before_the_reset_is_refused(name):
    env = BoatDockEnv(2, controller="congruent")
    if name == "seeded anew":
        env.reset()
        env.set_seed(1)
    with pytest.raises(RuntimeError, match="call reset before step"):
        press(env, [0, 1], 0.5)
