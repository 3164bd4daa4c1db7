"""Sessions of trips with boats that the agent does not know: families, trips, what is seen, kernel and tensor form."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from scripts import load_script
from tensordict import TensorDict

import hpamdp
from hpamdp import keys
from hpamdp.env.boatdock import task
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock_unseen import fleet, rules
from hpamdp.env.boatdock_unseen.environment import UnseenBoatsEnv
from hpamdp.env.boatdock_unseen.options import FAMILIES, FleetRules
from hpamdp.run.evaluate import Evaluation
from hpamdp.settings import SettingError


def presses(env: UnseenBoatsEnv, td: TensorDict, seed: int, longest: float = 1.2) -> TensorDict:
    """Return the tensordict with random presses, and random boats where they are chosen."""
    generator, n = torch.Generator().manual_seed(seed), env.num_envs
    key = torch.randint(0, 3, (n,), generator=generator)
    td[keys.ACTION] = {"discrete": key, "parameters": torch.rand(n, 3, generator=generator) * longest}
    if env.has_choice:
        td[keys.OPTION] = torch.randint(0, 2, (n,), generator=generator)
    return td


def entry(td: TensorDict, name: str) -> torch.Tensor:
    return td[keys.OBSERVATION][:, rules.OBSERVATION_NAMES.index(name)]


# Families.


def drawn(family: fleet.Family, num: int = 2000, **settings: float) -> fleet.Boats:
    bits = torch.arange(num, dtype=torch.int32) * 7919
    return fleet.boats(bits, FleetRules(family, **settings))


def angles_between(boats: fleet.Boats) -> torch.Tensor:
    """Return the angles between each two keys, degrees `[N, 3]`."""
    pairs = [(0, 1), (1, 2), (0, 2)]
    cosines = [(boats.directions[:, a] * boats.directions[:, b]).sum(-1) for a, b in pairs]
    return torch.rad2deg(torch.stack(cosines, -1).clamp(-1.0, 1.0).acos())


@pytest.mark.parametrize("family", ["turned", "strength"])
def test_turned_boats_have_peoples_directions_turned_by_any_angle_with_keys_in_any_order(family):
    boats = drawn(family)
    torch.testing.assert_close(angles_between(boats), torch.full((2000, 3), 120.0), atol=0.02, rtol=0.0)
    angle = torch.atan2(boats.directions[..., 1], boats.directions[..., 0])
    shares = torch.histc(angle[:, 0], bins=12, min=-torch.pi, max=torch.pi) / 2000
    assert (shares - 1 / 12).abs().max() < 0.025
    is_next = (((angle[:, 1] - angle[:, 0]) % (2 * torch.pi) - 2 * torch.pi / 3).abs() < 0.01).float().mean()
    assert 0.45 < is_next < 0.55  # the second key pushes a third of a turn further, or one back


def test_any_three_directions_have_at_least_the_separation_and_otherwise_any_gaps():
    between = angles_between(drawn("any", separation=np.radians(60.0)))
    assert between.min() > 59.9 and between.max() > 178.0
    assert (between > 120.0).any(-1).float().mean() > 0.99 and (between.min(-1).values < 62.0).any()


def test_strength_draws_speed_and_glide_within_their_spread_and_the_other_families_have_peoples():
    boats = drawn("strength", spread=0.3)
    for values in (boats.strength, boats.glide):
        assert 0.7 <= values.min() < 0.71 and 1.29 < values.max() <= 1.3
    assert torch.corrcoef(torch.stack([boats.strength, boats.glide]))[0, 1].abs() < 0.06
    for family in ("turned", "any"):
        assert drawn(family).strength.eq(1.0).all() and drawn(family).glide.eq(1.0).all()


@pytest.mark.parametrize("fleet_size", [None, 1000])
def test_no_training_meets_a_test_boat(fleet_size):
    training, test = (UnseenBoatsEnv(4096, fleet_size=fleet_size, seed=1) for _ in range(2))
    test.seed_evaluation(1)
    training.reset(), test.reset()
    assert (training.state.first_boat % 2 == 0).all() and (test.state.first_boat % 2 == 1).all()
    assert len(test.state.first_boat.unique()) > 4090


@pytest.mark.parametrize("boats", [1, 2])
def test_a_fleet_has_as_many_boats_as_it_says_whatever_the_seed_of_the_training(boats):
    met = []
    for seed in (0, 5):
        env = UnseenBoatsEnv(2000, boats=boats, fleet_size=4, fleet_seed=3, seed=seed)
        env.reset()
        both = torch.stack([env.state.first_boat, env.state.second_boat], -1)
        assert boats == 1 or (both[:, 0] != both[:, 1]).all()
        met.append(set(both[:, :boats].flatten().tolist()))
    assert met[0] == met[1] and len(met[0]) == 4
    scored = UnseenBoatsEnv(2000, boats=boats, fleet_size=4, fleet_seed=3, scored_boats="training")
    scored.seed_evaluation(9)
    scored.reset()
    assert set(scored.state.first_boat.tolist()) == met[0]
    other = UnseenBoatsEnv(2000, boats=boats, fleet_size=4, fleet_seed=4)
    other.reset()
    assert met[0].isdisjoint(other.state.first_boat.tolist())


# Trips.


@pytest.mark.parametrize("boats", [1, 2])
def test_a_trip_is_an_episode_of_the_boats_task_with_the_sessions_boat(boats):
    env = UnseenBoatsEnv(200, boats=boats, trips=3, seed=2)
    td = env.reset()
    for step in range(20):
        state = env.state
        td = presses(env, td, step)
        trip_boat = torch.zeros(200, dtype=torch.long) if boats == 1 else td[keys.OPTION]
        trip_boat = torch.where(state.boat >= 0, state.boat.long(), trip_boat)
        directions = torch.stack([each.directions for each in env.known_boats(state)], 1)[range(200), trip_boat]
        reward = env.step(td.clone())["next", keys.REWARD].squeeze(-1)
        after = env.state
        # The same press in the task itself, with one controller that has this boat's directions.
        for row in range(0, 200, 40):
            if state.outcome[row] != 0:
                continue
            degrees = torch.rad2deg(torch.atan2(directions[row, :, 1], directions[row, :, 0])).tolist()
            same = BoatDockEnv(1, boats=("own",), controllers={"own": tuple(degrees)}, controller="own")
            same.reset()
            known = {name: getattr(state, name)[row : row + 1] for name in ("start_x", "start_y", "goal_x", "goal_y")}
            known |= {name: getattr(state, name)[row : row + 1] for name in ("x", "y", "fuel", "presses")}
            same.state = same.state._replace(**known)
            action = {"discrete": td[keys.DISCRETE][row : row + 1]}
            action["parameters"] = td[keys.PARAMETERS][row : row + 1].clamp(min=0.15)
            step_td = TensorDict({keys.ACTION: action}, batch_size=[1])
            expected = same.step(step_td)["next"]
            assert reward[row].item() == pytest.approx(expected[keys.REWARD].item(), abs=2e-3)
            assert bool(after.trip_ended[row]) == bool(same.state.outcome[0] != task.SAILING)
            if after.trip_ended[row]:
                score = same.results(expected)["score"].item()
                assert after.last_score[row].item() == pytest.approx(score, abs=2e-3)
        td = env.reset() if env.state.outcome.ne(0).all() else env.read()


def test_a_session_ends_with_its_last_trip_and_each_trip_has_a_layout_of_its_own():
    env = UnseenBoatsEnv(100, trips=4, seed=1)
    td, layouts, ended = env.reset(), [env.state.goal_x], torch.zeros(100)
    for step in range(100):
        td = env.step(presses(env, td, step))["next"]
        ended += td[keys.TRIP_ENDED].squeeze(-1) & (env.state.steps == step + 1)
        layouts.append(env.state.goal_x)
        assert (td[keys.DONE].squeeze(-1) == (ended == 4)).all()
        if td[keys.DONE].all():
            break
    assert td[keys.TERMINATED].all() and (ended == 4).all()
    assert all(len(goals.unique()) == 4 for goals in torch.stack(layouts, -1))
    assert (env.played()["trip_score"].mean(-1) - env.results(td)["score"]).abs().max() < 1e-5
    docked = (env.played()["trip_score"] > -1.0).float().mean(-1)
    assert docked.equal(env.results(td)["success"]) and 0.0 < docked.mean() < 1.0
    assert env.played()["trip_presses"].sum(-1).equal(env.state.steps)


def test_the_boat_stays_over_a_sessions_trips_and_changes_with_the_session():
    env = UnseenBoatsEnv(50, trips=2)
    td = env.reset()
    first = env.state.first_boat
    for step in range(40):
        td = env.step(presses(env, td, step))["next"]
        assert env.state.first_boat.equal(first)
    env.reset()
    assert (env.state.first_boat != first).all()


def test_a_chosen_boat_is_held_until_its_trip_ends():
    env = UnseenBoatsEnv(300, boats=2, trips=3)
    td = env.reset()
    assert (entry(td, "boat") == -1).all() and (entry(td, "last_boat") == -1).all()
    for step in range(12):
        before = env.state.boat
        td = presses(env, td, step)
        expected = torch.where(before >= 0, before, td[keys.OPTION].int())
        td = env.step(td)["next"]
        goes_on = env.state.trip_ended == 0
        assert (entry(td, "last_boat") == expected)[env.state.steps == step + 1].all()
        assert (env.state.boat == expected)[goes_on & (env.state.steps == step + 1)].all()
        begins = (env.state.trip_ended == 1) & (env.state.outcome == 0)
        assert (entry(td, "boat")[begins] == -1).all()


def test_a_press_is_at_least_the_shortest_one():
    env = UnseenBoatsEnv(2, shortest_press=0.5)
    td = env.reset()
    td[keys.ACTION] = {"discrete": torch.tensor([0, 0]), "parameters": torch.tensor([[0.0] * 3, [0.5] * 3])}
    after = env.step(td)["next"]
    lengths = torch.stack([entry(after, "moved_x"), entry(after, "moved_y")], -1).norm(dim=-1)
    assert lengths[0] == pytest.approx(lengths[1].item(), abs=1e-6) and lengths[0] > 0.05
    assert (entry(after, "last_duration") == 0.25).all()


# What is seen.


def test_nothing_of_the_boat_is_seen_before_the_first_press_and_its_displacement_after():
    one, other = (UnseenBoatsEnv(20, seed=4) for _ in range(2))
    first = one.reset()
    other.reset()
    other.state = other.state._replace(first_boat=other.state.first_boat + 2)
    assert other.read()[keys.OBSERVATION].equal(first[keys.OBSERVATION])
    before = one.state
    after = one.step(presses(one, first, 0, longest=0.4))["next"]
    state = one.state
    at_sea = state.trip_ended == 0
    moved = torch.stack([state.x - before.x, state.y - before.y], -1)[at_sea] / task.HARBOUR_RADIUS
    seen = torch.stack([entry(after, "moved_x"), entry(after, "moved_y")], -1)[at_sea]
    torch.testing.assert_close(seen, moved, atol=1e-6, rtol=0.0)
    keys_seen = torch.stack([entry(after, f"last_key_{number}") for number in (1, 2, 3)], -1).argmax(-1)
    assert keys_seen.equal(first[keys.DISCRETE])


def test_in_the_frame_of_the_first_press_all_vectors_are_turned_so_that_this_press_points_along_x():
    screen, own = (UnseenBoatsEnv(500, frame=frame, seed=2) for frame in ("screen", "first_press"))
    seen = {env: [env.reset()] for env in (screen, own)}
    assert (entry(seen[own][0], "goal_y") - entry(seen[own][0], "start_y")).abs().max() < 1e-5
    for step in range(8):
        for env, readings in seen.items():
            readings.append(env.step(presses(env, readings[-1].clone(), step, longest=0.5))["next"])
    at_sea = (own.state.steps == 8) & (own.state.outcome == 0)
    assert at_sea.sum() > 400
    axis = torch.atan2(entry(seen[screen][1], "moved_y"), entry(seen[screen][1], "moved_x"))
    for name in ("start", "goal", "boat", "to_goal", "velocity", "moved"):
        x, y = (entry(seen[screen][8], f"{name}_{each}") for each in "xy")
        turned = torch.stack([x * axis.cos() + y * axis.sin(), y * axis.cos() - x * axis.sin()], -1)
        ours = torch.stack([entry(seen[own][8], f"{name}_{each}") for each in "xy"], -1)
        torch.testing.assert_close(ours[at_sea], turned[at_sea], atol=1e-4, rtol=0.0)
    assert entry(seen[own][1], "moved_y").abs().max() < 1e-5 and (entry(seen[own][1], "moved_x") > 0.0).all()


def test_sensor_noise_disturbs_what_is_seen_and_not_the_boat():
    noisy, exact = (UnseenBoatsEnv(3000, sensor_noise=noise, seed=1) for noise in (12.0, 0.0))
    seen = [env.step(presses(env, env.reset(), 0))["next"][keys.OBSERVATION] for env in (noisy, exact)]
    for name, state in noisy.state._asdict().items():
        assert state.equal(getattr(exact.state, name)) or name in ("frame_x", "frame_y")
    error = seen[0] - seen[1]
    for name in ("start_x", "goal_y", "boat_x", "moved_x", "moved_y"):
        assert error[:, rules.OBSERVATION_NAMES.index(name)].std() == pytest.approx(0.1, abs=0.005)
    assert error[:, rules.OBSERVATION_NAMES.index("fuel")].abs().max() == 0.0


def test_the_ceiling_is_the_best_plans_mean_score_and_two_boats_raise_it():
    ceilings = []
    for boats in (1, 2):
        env = UnseenBoatsEnv(100, boats=boats, trips=3)
        env.seed_evaluation(0)
        env.reset()
        optimum = env.describe()["optimum"]
        assert optimum.shape == (100, 3) and optimum.min() > 2.0 and optimum.max() < 5.0
        ceilings.append(optimum.mean().item())
    assert ceilings[0] == pytest.approx(3.43, abs=0.08) and 0.1 < ceilings[1] - ceilings[0] < 0.25


# Forms.


@pytest.mark.parametrize("is_evaluation", [False, True])
@pytest.mark.parametrize(
    "settings",
    [
        {"family": "turned"},
        {"family": "any", "boats": 2, "fleet_size": 5, "frame": "first_press"},
        {"family": "strength", "reward": "sparse", "trips": 1},
    ],
    ids=FAMILIES,
)
def test_the_kernel_does_what_the_tensor_functions_do(settings, is_evaluation):
    settings = {"seed": 3, "sensor_noise": 2.0, "motor_noise": 0.1, **settings}
    study = load_script(Path(__file__).resolve().parent.parent / "experiments" / "generalisation" / "session_rules.py")
    kernel, tensors = (env(64, first_env=5, **settings) for env in (UnseenBoatsEnv, study.TensorSessions))
    if is_evaluation:
        kernel.seed_evaluation(7), tensors.seed_evaluation(7)
    ours, theirs = kernel.reset(), tensors.reset()
    for step in range(30):
        torch.testing.assert_close(ours[keys.OBSERVATION], theirs[keys.OBSERVATION], atol=1e-4, rtol=1e-4)
        ours, theirs = (env.step(presses(env, td, step))["next"] for env, td in ((kernel, ours), (tensors, theirs)))
        for name in (keys.DONE, keys.TRIP_ENDED, keys.OUTCOME):
            assert ours[name].equal(theirs[name])
        for name in (keys.REWARD, "session_score", "session_success"):
            torch.testing.assert_close(ours[name], theirs[name], atol=1e-3, rtol=1e-3)
        if step % 10 == 9:
            is_over = ours[keys.DONE]
            again = TensorDict({"_reset": is_over}, batch_size=[64])
            ours, theirs = kernel.reset(again.clone()), tensors.reset(again)


def test_gymnasium_accepts_the_ids():
    for family in ("", "Any", "Strength"):
        env = gymnasium.make(f"hpamdp/BoatDockUnseen{family}-v0")
        observation, _ = env.reset(seed=0)
        assert observation in env.observation_space
        observation, _, terminated, _, _ = env.step(env.action_space.sample())
        assert observation in env.observation_space and not terminated


@pytest.mark.parametrize("boats", [1, 2])
def test_in_gymnasium_infos_tell_where_trips_end_and_the_sessions_score(boats):
    env = hpamdp.make_gymnasium("boatdock_unseen", boats=boats, trips=2)
    _, info = env.reset(seed=1)
    assert info["trip_ended"] is False and "score" not in info
    ended, is_over = 0, False
    while not is_over:
        _, _, is_over, _, info = env.step(env.action_space.sample())
        ended += info["trip_ended"]
    assert ended == 2 and -1.0 <= info["score"] <= 5.0 and info["success"] in (0.0, 0.5, 1.0)
    many = hpamdp.make_gymnasium("boatdock_unseen", num_envs=3, boats=boats, trips=2)
    many.reset(seed=1)
    infos = many.step(many.action_space.sample())[-1]
    assert infos["trip_ended"].dtype == bool and infos["trip_ended"].shape == (3,)


@pytest.mark.parametrize(
    ("column", "number", "message"),
    [
        ("trip", 4, "a session is in its trip 5, but env.trips=3; set at least 5"),
        ("docked", 4, "docked has 0 to 4, not 0 to 3"),
    ],
)
def test_a_saved_state_of_other_sessions_is_refused_in_one_line(column, number, message):
    env = UnseenBoatsEnv(4, trips=3)
    env.reset()
    state = env.env_state()
    env.check_env_state(state)
    state[column][1] = number
    with pytest.raises(ValueError, match=message):
        env.check_env_state(state)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"scored_boats": "training"}, "scored_boats=training: needs a fleet_size"),
        ({"fleet_size": 1, "boats": 2}, "fleet_size=1: a session has boats=2"),
        ({"shortest_press": 0.95}, "shortest_press=0.95: it leads to 85 px/s, but boats dock at no more than 74"),
        ({"fleet_size": 4, "fleet_seed": 2**32}, "fleet_seed=4294967296: must be less than 4294967296"),
    ],
)
def test_impossible_sessions_are_refused_in_one_line(settings, message):
    with pytest.raises(SettingError, match=message) as raised:
        UnseenBoatsEnv(1, **settings)
    assert "\n" not in str(raised.value)


def test_scores_say_whether_they_are_of_a_trip_or_of_a_boat():
    env = UnseenBoatsEnv(2, boats=2, trips=3)
    trips = {"trip_score": np.ones((2, 3)), "trip_presses": np.ones((2, 3)), "optimum": np.ones((2, 3))}
    played = {"score": np.ones(2), "option": np.zeros(2, int), "option_scores": np.ones((2, 2)), **trips}
    means = Evaluation.measure(SimpleNamespace(env=env), played)
    scores = {name for name in means if name.startswith("score_")}
    assert scores == {"score_trip_1", "score_trip_2", "score_later", "score_boat_1", "score_boat_2"}
