"""BoatDockEnv follows the rules of the task: rewards, ends of episodes, noise and observations."""

from __future__ import annotations

import math

import pytest
import torch
from tensordict import TensorDictBase
from test_boatdock import CENTRE, layout, press

from hpamdp import keys
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.task import MAX_PRESSES, OBSERVATION_NAMES


def play(env: BoatDockEnv, num_presses: int) -> list[TensorDictBase]:
    """Reset and press random keys, also in finished episodes; return the result of each press."""
    generator = torch.Generator().manual_seed(0)
    env.reset()
    results = []
    for _ in range(num_presses):
        key = torch.randint(3, (env.num_envs,), generator=generator)
        duration = torch.rand(env.num_envs, 3, generator=generator)
        results.append(press(env, key, duration))
    return results


def test_only_the_pressed_keys_duration_counts():
    env = BoatDockEnv(2, controller="congruent")
    for durations in ([[0.3, 9.0, -1.0]] * 2, [[0.3, math.nan, math.inf]] * 2):
        env.reset(layout([0.0, 0.0], [90.0, 0.0], 2))
        press(env, [0, 0], durations)
        assert env.state.fuel.tolist() == pytest.approx([5.7, 5.7])


@pytest.mark.parametrize("motor_noise", [0.0, 0.5])
def test_durations_are_clipped_before_noise_too(motor_noise):
    num = 200
    env = BoatDockEnv(num, controller="congruent", motor_noise=motor_noise)
    results = []
    for duration in (2.0, 50.0, 0.0, -3.0):
        env.set_seed(0)
        env.reset(layout([-110.0, 0.0], [0.0, 110.0], num))
        press(env, [2] * num, [duration] * num)
        results.append(torch.stack([env.state.x, env.state.y, env.state.fuel]))
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[2], results[3])
    assert (results[3][2] == physics.TANK).all()


def test_paper_rewards_sum_to_the_progress_plus_the_final_term():
    env, sparse = (BoatDockEnv(2048, controller="congruent", reward=reward) for reward in ("paper", "sparse"))
    total, sparse_total = (torch.stack([r[keys.REWARD] for r in play(e, 25)]).sum(0)[:, 0] for e in (env, sparse))
    state = env.state
    outcomes = {name: (state.outcome == number) for number, name in enumerate(physics.OUTCOMES)}
    assert all(outcomes[name].any() for name in ("success", "too_fast", "out_of_bounds"))
    start = torch.hypot(state.goal_x - state.start_x, state.goal_y - state.start_y)
    end = torch.hypot(state.goal_x - state.x, state.goal_y - state.y)
    success = torch.where(outcomes["success"], 5.0 * state.fuel / 6.0, 0.0)
    failed = outcomes["too_fast"] | outcomes["out_of_bounds"] | outcomes["out_of_fuel"]
    torch.testing.assert_close(total, (start - end) / start + success - failed.float(), atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(sparse_total, success)


def test_an_empty_tank_ends_the_episode_with_minus_one():
    env = BoatDockEnv(1, controller="congruent", reward="paper")
    env.reset(layout([0.0, 0.0], [0.0, 100.0]))
    env.state = env.state._replace(fuel=torch.tensor([0.4]))
    after = press(env, [0], [1.0])
    assert physics.OUTCOMES[after[keys.OUTCOME].item()] == "out_of_fuel"
    assert after[keys.TERMINATED].item()
    assert after[keys.REWARD].item() == pytest.approx(
        (100.0 - math.hypot(env.state.x, 100.0 - env.state.y)) / 100 - 1.0
    )


def test_the_25th_press_truncates_and_does_not_terminate():
    env = BoatDockEnv(1, controller="congruent")
    env.reset(layout([0.0, 0.0], [90.0, 0.0]))
    for number in range(1, MAX_PRESSES + 1):
        after = press(env, [number % 3], [0.05])
        is_last = number == MAX_PRESSES == 25
        assert [after[key].item() for key in (keys.DONE, keys.TRUNCATED, keys.TERMINATED)] == [is_last, is_last, False]
    assert physics.OUTCOMES[after[keys.OUTCOME].item()] == "time_limit"
    assert abs(after[keys.REWARD].item()) < 0.01


def test_motor_noise_is_lognormal_in_the_executed_duration():
    num = 20_000
    env = BoatDockEnv(num, controller="congruent", motor_noise=0.2)
    env.reset(layout([0.0, 0.0], [90.0, 0.0], num))
    logs = []
    for _ in range(2):
        before = env.state.fuel
        press(env, [1] * num, [0.3] * num)
        logs.append(((before - env.state.fuel) / 0.3).log())
    for log in logs:
        assert abs(log.mean()) < 0.006
        assert log.std().item() == pytest.approx(0.2, rel=0.03)
        assert ((log / 0.2).abs() < 1.0).float().mean().item() == pytest.approx(0.683, abs=0.015)
    assert abs(torch.stack(logs).corrcoef()[0, 1]) < 0.03


def test_motor_noise_may_differ_between_the_controllers():
    num = 20_000
    env = BoatDockEnv(num, controller="random", motor_noise=[0.1, 0.3])
    env.reset(layout([0.0, 0.0], [90.0, 0.0], num))
    before = env.state.fuel
    press(env, [1] * num, [0.3] * num)
    log = ((before - env.state.fuel) / 0.3).log()
    for controller, deviation in enumerate((0.1, 0.3)):
        assert log[env.state.controller == controller].std().item() == pytest.approx(deviation, rel=0.05)


def test_sensor_noise_is_independent_at_every_observation_and_moves_no_boat():
    num = 20_000
    env, exact = (BoatDockEnv(num, controller="congruent", observation="pixels", sensor_noise=s) for s in (4.0, 0.0))
    errors = []
    for read in (lambda e: e.reset(), lambda e: press(e, [1] * num, [0.2] * num)):
        errors.append((read(env)["observation"] - read(exact)["observation"])[:, [0, 1, 2, 3, 8, 9]])
        assert all(torch.equal(*columns) for columns in zip(exact.state, env.state, strict=True))
    errors = torch.cat(errors, -1)
    assert errors.mean(0).abs().max() < 0.12
    assert (errors.std(0) - 4.0).abs().max() < 0.1
    assert (errors.T.corrcoef() - torch.eye(12)).abs().max() < 0.03
    assert errors.abs().max() < 24.0


def test_evaluation_has_other_noise_than_training_with_the_same_seed():
    env = BoatDockEnv(100, controller="congruent", motor_noise=0.5, sensor_noise=5.0)
    layouts = env.fixed_episodes(0)

    def observed() -> torch.Tensor:
        seen = env.reset(layouts.copy())["observation"]
        return torch.stack([seen, press(env, [0] * 100, [0.2] * 100)["observation"]])

    env.seed_evaluation(0)
    evaluation = observed()
    env.set_seed(0)
    training = observed()
    env.seed_evaluation(0)
    assert torch.equal(observed(), evaluation)
    start_x, boat_x = (OBSERVATION_NAMES.index(name) for name in ("start_x", "boat_x"))
    assert (evaluation[0, :, start_x] != training[0, :, start_x]).all()
    assert (evaluation[1, :, boat_x] != training[1, :, boat_x]).all()


def test_the_first_episodes_of_an_evaluation_are_its_fixed_layouts():
    env = BoatDockEnv(50)
    env.seed_evaluation(4)
    env.reset()
    # The kernel draws the one, the tensor function the other.
    assert torch.allclose(torch.stack(env.state[:4]), torch.stack(harbour.fixed_layouts(50, 4)), atol=1e-4)


def test_slip_presses_a_uniformly_random_key():
    num = 30_000
    env = BoatDockEnv(num, controller="congruent", slip=0.3)
    env.reset(layout([0.0, 0.0], [90.0, 0.0], num))
    press(env, [1] * num, [0.2] * num)
    moved = torch.stack([env.state.x, env.state.y], -1)
    pressed = (moved @ torch.tensor(harbour.DIRECTIONS[2]).T).argmax(-1)
    shares = torch.bincount(pressed, minlength=3) / num
    assert shares.tolist() == pytest.approx([0.1, 0.8, 0.1], abs=0.008)


def test_the_pixel_observation_has_the_entries_of_the_paper():
    env = BoatDockEnv(1, controller="incongruent", observation="pixels")
    env.reset(layout([-50.0, 20.0], [40.0, -30.0]))
    shown = dict(zip(OBSERVATION_NAMES, press(env, [2], [0.5])["observation"][0].tolist(), strict=True))
    state = env.state
    travelled = 1.95 * (100.0 / 3.0 * 0.5**3 - 5.0 / 3.0 * 0.5**4)
    to_goal = math.hypot(90.0, -50.0 - travelled)
    expected = {"start_x": 590.0, "start_y": 532.0, "goal_x": 680.0, "goal_y": 482.0, "boat_x": 590.0}
    expected |= {"centre_x": 640.0, "centre_y": 512.0, "radius": 120.0, "controller": 0.0, "fuel": 5.5 / 6.0}
    expected |= {"boat_y": 532.0 + travelled, "velocity_x": 0.0, "velocity_y": 25.0 - 20.0 / 3.0 * 0.125}
    expected |= {"distance": to_goal / math.hypot(90.0, 50.0)}
    assert shown == pytest.approx(expected, abs=1e-3)
    assert state.presses.item() == 1


def test_the_scaled_observation_is_in_units_of_radius_and_top_speed_and_adds_the_vector_to_the_goal():
    pixels, scaled = (BoatDockEnv(64, controller="random", observation=kind) for kind in ("pixels", "scaled"))
    seen = play(pixels, 3)[-1]["observation"]
    small = play(scaled, 3)[-1]["observation"]
    points = (seen[:, [0, 1, 2, 3, 8, 9]].unflatten(-1, (3, 2)) - CENTRE).flatten(1) / 120.0
    torch.testing.assert_close(small[:, [0, 1, 2, 3, 8, 9]], points, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(small[:, 10:12], seen[:, 10:12] / (400.0 - 160.0 / 3.0))
    torch.testing.assert_close(small[:, [7, 12, 13]], seen[:, [7, 12, 13]], atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(small[:, 14:], small[:, 2:4] - small[:, 8:10])
    assert small[:, :13].abs().max() <= 1.0
