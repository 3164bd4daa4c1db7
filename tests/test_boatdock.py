"""BoatDockEnv keeps TorchRL's contract, also for invalid inputs."""

from __future__ import annotations

import itertools
import math
import random

import numpy as np
import pytest
import torch
from conftest import global_generators_unmoved
from tensordict import TensorDict, TensorDictBase
from torchrl.envs.utils import check_env_specs

from hpamdp import keys
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.task import FUEL, SCALED_NAMES

CENTRE = torch.tensor(harbour.CENTRE)
NOISE = {"motor_noise": 0.2, "sensor_noise": 3.0, "slip": 0.3}
MODES = list(
    itertools.product(
        ("choose", "congruent", "incongruent", "random"), (1, 2, "random"), ("paper", "sparse"), ("scaled", "pixels")
    )
)


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


def random_action(env: BoatDockEnv, generator: torch.Generator, longest: float = 1.0) -> TensorDict:
    num = env.num_envs
    key = torch.randint(3, (num,), generator=generator)
    option = torch.randint(2, (num,), generator=generator) if env.has_choice else None
    return action(key, longest * torch.rand(num, 3, generator=generator), option)


def layout(start, goal, num: int = 1, **rest) -> TensorDict:
    """Return a layout given in px from the harbour's centre, the same for every boat."""
    td = TensorDict(batch_size=[num])
    td["start"] = (torch.tensor(start) + CENTRE).expand(num, 2)
    td["goal"] = (torch.tensor(goal) + CENTRE).expand(num, 2)
    for name, value in rest.items():
        td[name] = torch.full((num,), value)
    return td


def snapshot(env: BoatDockEnv) -> list[torch.Tensor]:
    return [column.clone() for column in env.state]


def is_unchanged(env: BoatDockEnv, before: list[torch.Tensor], rows=slice(None)) -> bool:
    return all(torch.equal(now[rows], then[rows]) for now, then in zip(env.state, before, strict=True))


def play(env: BoatDockEnv, num_presses: int, longest: float = 1.0) -> list[TensorDictBase]:
    """Reset and press random keys, also in finished episodes; return everything that was returned."""
    generator = torch.Generator().manual_seed(0)
    readings = [env.reset()]
    for _ in range(num_presses):
        readings.append(env.step(random_action(env, generator, longest))["next"])
    return readings


@pytest.mark.parametrize(("controller", "keymap", "reward", "observation"), MODES)
def test_all_tensors_are_as_the_specs_say_in_every_mode(controller, keymap, reward, observation):
    noise = NOISE if keymap == "random" else {}
    env = BoatDockEnv(2, controller=controller, keymap=keymap, reward=reward, observation=observation, **noise)
    check_env_specs(env, return_contiguous=True)


@pytest.mark.parametrize("noise", [{}, NOISE])
def test_a_seed_fixes_layouts_and_noise(noise):
    first, second, other = (BoatDockEnv(8, controller="random", **noise, seed=seed) for seed in (3, 0, 4))
    second.set_seed(3)
    readings = [play(env, 5) for env in (first, second, other)]
    assert all((one == same).all() for one, same in zip(*readings[:2], strict=True))
    assert not torch.equal(readings[0][0]["observation"], readings[2][0]["observation"])
    first.set_seed(3)
    assert all((again == once).all() for again, once in zip(play(first, 5), readings[0], strict=True))
    assert not torch.equal(first.reset()["observation"], readings[0][0]["observation"])


def test_global_generators_are_neither_moved_nor_read():
    env = BoatDockEnv(8, controller="random", keymap="random", **NOISE)
    press_all = action([0, 1, 2, 0, 1, 2, 0, 1], [0.3] * 8)

    def run() -> TensorDictBase:
        env.set_seed(5)
        env.reset()
        return env.step(press_all.clone())["next"]

    with global_generators_unmoved():
        once = run()
    torch.rand(3)
    np.random.rand()
    random.random()
    assert (run() == once).all()


def test_a_partial_reset_leaves_the_other_boats_alone():
    env = BoatDockEnv(4, controller="choose")
    env.reset()
    press(env, [0, 1, 2, 0], [0.2] * 4, [0, 1, 0, 1])
    before = snapshot(env)
    mask = torch.tensor([[False], [True], [False], [True]])
    reading = env.reset(TensorDict({"_reset": mask}, batch_size=[4]))
    kept = ~mask[:, 0]
    fresh = mask[:, 0]
    assert is_unchanged(env, before, kept)
    assert env.state.episode.tolist() == [0, 1, 0, 1]
    assert (env.state.presses[fresh] == 0).all()
    assert not torch.isclose(env.state.start_x, before[0])[fresh].any()
    assert (reading[FUEL][fresh] == 1.0).all()


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


def test_a_finished_episode_stays_finished_and_earns_nothing():
    env = BoatDockEnv(64, controller="congruent")
    env.reset()
    generator = torch.Generator().manual_seed(0)
    env.step(random_action(env, generator, 2.0))
    over = env.state.outcome != physics.SAILING
    assert 0 < over.sum() < 64
    before = snapshot(env)
    after = env.step(random_action(env, generator, 2.0))["next"]
    assert is_unchanged(env, before, over)
    assert after[keys.DONE][over].all()
    assert (after[keys.REWARD][over] == 0.0).all()
    assert (env.state.presses[~over] == 2).all()


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
    "inf": layout([0.0, 0.0], [50.0, math.inf], 2),
    "no goal": layout([0.0, 0.0], [50.0, 0.0], 2).exclude("goal"),
    "one coordinate": TensorDict(start=torch.zeros(2, 1), goal=torch.zeros(2, 2), batch_size=[2]),
    "no such controller": layout([0.0, 0.0], [50.0, 0.0], 2, controller=2),
    "no such keymap": layout([0.0, 0.0], [50.0, 0.0], 2, keymap=0),
}


@pytest.mark.parametrize("name", BAD_LAYOUTS)
def test_an_invalid_layout_is_refused_and_changes_nothing(name):
    env = BoatDockEnv(2, controller="random")
    env.reset()
    before = snapshot(env)
    with pytest.raises(ValueError, match="reset: "):
        env.reset(BAD_LAYOUTS[name].clone())
    assert is_unchanged(env, before)


def test_a_controller_is_refused_where_the_agent_chooses_it():
    env = BoatDockEnv(2, controller="choose")
    env.reset()
    before = snapshot(env)
    with pytest.raises(ValueError, match="option"):
        env.reset(layout([0.0, 0.0], [50.0, 0.0], 2, controller=1))
    assert is_unchanged(env, before)


BAD_ACTIONS = {
    "nan": action([0, 1], [0.1, math.nan], [0, 0]),
    "inf": action([0, 1], [math.inf, 0.1], [0, 0]),
    "key too large": action([0, 3], [0.1, 0.1], [0, 0]),
    "key negative": action([-1, 0], [0.1, 0.1], [0, 0]),
    "no such option": action([0, 0], [0.1, 0.1], [0, 2]),
    "key of another shape": action([[0], [1]], [0.1, 0.1], [0, 0]),
    "one duration a boat": action([0, 1], [[0.1], [0.1]], [0, 0]),
    "fractional key": action([0.5, 1.0], [0.1, 0.1], [0, 0]),
    "no option": action([0, 1], [0.1, 0.1]),
    "no key": action([0, 1], [0.1, 0.1], [0, 0]).exclude(keys.DISCRETE),
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


@pytest.mark.parametrize("noise", [{}, NOISE])
def test_returned_tensors_never_change_later(noise):
    env = BoatDockEnv(16, controller="choose", **noise)
    returned = []
    copies = []

    def keep(reading: TensorDictBase) -> None:
        returned.append(reading)
        copies.append(reading.clone())

    generator = torch.Generator().manual_seed(0)
    keep(env.reset())
    given = layout([0.0, 0.0], [90.0, 0.0], 16)
    for _ in range(4):
        keep(env.step(random_action(env, generator))["next"])
        keep(env.reset(TensorDict({"_reset": torch.rand(16, 1, generator=generator) < 0.5}, batch_size=[16])))
    keep(env.reset(given))
    keep(env.step(random_action(env, generator))["next"])
    assert all((now == then).all() for now, then in zip(returned, copies, strict=True))


def test_a_restored_state_continues_as_the_original():
    env, copy = (BoatDockEnv(8, controller="congruent", **NOISE) for _ in range(2))
    play(env, 1, 0.3)
    copy.state = env.state
    for _ in range(2):
        results = [press(e, [0, 1, 2, 0, 1, 2, 0, 1], [0.3] * 8) for e in (env, copy)]
        assert (results[0] == results[1]).all()


BAD_ARGUMENTS = [
    {"controller": "both"},
    {"keymap": 3},
    {"reward": "dense"},
    {"observation": "image"},
    {"slip": 1.5},
    {"motor_noise": -0.1},
    {"motor_noise": [0.1, 0.2, 0.3]},
    {"motor_noise": [0.1, math.nan]},
    {"motor_noise": 1e30},
    {"sensor_noise": math.inf},
    {"sensor_noise": 1e30},
    {"num_envs": 0},
]


@pytest.mark.parametrize("arguments", BAD_ARGUMENTS, ids=str)
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


def test_float64_durations_leave_rewards_and_observations_float32():
    env, doubled = (BoatDockEnv(2, controller="congruent") for _ in range(2))
    env.reset()
    doubled.reset()
    single = action([0, 1], 0.5)
    expected = env.step(single.clone())["next"]
    single[keys.PARAMETERS] = single[keys.PARAMETERS].double()
    following = doubled.step(single)["next"]
    for leaf in (keys.OBSERVATION, keys.REWARD):
        assert following[leaf].dtype == torch.float32
        assert torch.equal(following[leaf], expected[leaf])
