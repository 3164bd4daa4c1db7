"""Layouts and controllers are as specified, and so are the counter-based random numbers behind them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from hpamdp.env import counter_rng
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.harbour import CONGRUENT, INCONGRUENT, Layout
from hpamdp.env.boatdock.task import BoatState

NUM = 200_000


def counter(num: int) -> torch.Tensor:
    return torch.arange(num, dtype=torch.int32)


def keys_for(num: int, stream: int = counter_rng.TRAINING, seed: int = 0, episode: int = 0) -> counter_rng.RngKey:
    """Return the random keys of the environments 0 to num - 1, `[num]`."""
    episodes = torch.full_like(counter(num), episode)
    return counter_rng.rng_key(counter_rng.seed_tensor(seed), stream, counter(num), episodes)


def distance_between_distributions(a: np.ndarray, b: np.ndarray) -> float:
    """Return the Kolmogorov-Smirnov statistic; with 200,000 samples of the same distribution 99.9 % are under 0.006."""
    both = np.sort(np.concatenate([a, b]))
    cumulative = [np.searchsorted(np.sort(x), both, side="right") / len(x) for x in (a, b)]
    return float(np.abs(cumulative[0] - cumulative[1]).max())


@pytest.fixture(scope="module")
def layouts() -> Layout:
    return harbour.sample_layout(keys_for(NUM))


@pytest.fixture(scope="module")
def rejection_sampled_layouts() -> np.ndarray:
    """Sample pairs in the square and keep those in the disc and 30 px apart, `[NUM, 4]`."""
    rng = np.random.default_rng(1)
    pairs = rng.uniform(-110.0, 110.0, (3 * NUM, 2, 2))
    pairs = pairs[(np.hypot(*pairs.T).T < 110.0).all(1)]
    pairs = pairs[np.hypot(*(pairs[:, 0] - pairs[:, 1]).T) >= 30.0]
    return pairs[:NUM].reshape(-1, 4)


def test_starts_and_goals_lie_in_the_disc_and_30_px_apart(layouts):
    assert torch.hypot(layouts.start_x, layouts.start_y).max() < 110.0 + 1e-3
    assert torch.hypot(layouts.goal_x, layouts.goal_y).max() < 110.0 + 1e-3
    assert harbour.separation(layouts).min() > 30.0 - 1e-3


def test_layouts_have_the_distribution_of_rejection_sampling(layouts, rejection_sampled_layouts):
    for ours, theirs in zip(layouts, rejection_sampled_layouts.T, strict=True):
        assert distance_between_distributions(ours.numpy(), theirs) < 0.006
    both = [column.numpy() for column in layouts], rejection_sampled_layouts.T
    for measure in (
        lambda x, y, *_: np.hypot(x, y),
        lambda *point: np.hypot(*point[2:]),
        lambda x, y, goal_x, goal_y: np.hypot(goal_x - x, goal_y - y),
        lambda x, y, goal_x, goal_y: np.arctan2(goal_y - y, goal_x - x),
    ):
        assert distance_between_distributions(*(measure(*points) for points in both)) < 0.006


@pytest.mark.parametrize("keymap", [1, 2])
@pytest.mark.parametrize("key", [0, 1, 2])
def test_direction_follows_the_table(key, keymap):
    key = torch.tensor([key])
    keymap = torch.tensor([keymap])
    for controller, row in ((INCONGRUENT, keymap.item() - 1), (CONGRUENT, 2)):
        direction = torch.cat(harbour.direction(torch.tensor([controller]), keymap, key))
        assert direction.tolist() == pytest.approx(harbour.DIRECTIONS[row][key.item()], abs=1e-6)


def test_the_layouts_of_an_environment_depend_neither_on_the_batch_nor_on_other_resets():
    def after_resets(num: int, *resets: list[int]) -> BoatState:
        env = BoatDockEnv(num, seed=5, controller="random", keymap="random")
        env.reset()
        for rows in resets:
            mask = torch.zeros(num, 1, dtype=torch.bool)
            mask[rows] = True
            env.reset(TensorDict({"_reset": mask}, [num]))
        return env.state

    small, large = after_resets(3, [1], [1]), after_resets(10, [0, 1, 7], [0, 2], [1, 9])
    assert small.episode.tolist() == [0, 2, 0]
    assert large.episode[1] == 2
    for one, other in zip(small, large, strict=True):
        assert one[1] == other[1]
    for one, other in zip(after_resets(1), small, strict=True):
        assert one[0] == other[0]


def test_bearing_offset_is_0_along_a_congruent_direction_and_60_along_an_incongruent_one():
    for bearing, offset in ((30, 0), (150, 0), (270, 0), (90, 60), (210, 60), (330, 60), (0, 30), (60, 30), (40, 10)):
        goal = [torch.tensor([50.0 * f(math.radians(bearing))]) for f in (math.cos, math.sin)]
        start = torch.tensor([7.0]), torch.tensor([-3.0])
        layout = Layout(*start, start[0] + goal[0], start[1] + goal[1])
        assert harbour.bearing_offset(layout).item() == pytest.approx(offset, abs=1e-3)
    for controller, offset in ((2, 0), (0, 60), (1, 60)):
        for x, y in harbour.DIRECTIONS[controller]:
            layout = Layout(*(torch.tensor([value]) for value in (0.0, 0.0, 40.0 * x, 40.0 * y)))
            assert harbour.bearing_offset(layout).item() == pytest.approx(offset, abs=1e-3)


def test_evaluation_layouts_are_fixed_by_their_seed_and_absent_from_training_with_that_seed():
    evaluation = torch.stack(harbour.fixed_layouts(1000, seed=3), -1)
    assert torch.equal(evaluation[:10], torch.stack(harbour.fixed_layouts(10, seed=3), -1))
    assert not torch.equal(evaluation, torch.stack(harbour.fixed_layouts(1000, seed=4), -1))
    training = set()
    for e in range(20):
        layouts = harbour.sample_layout(keys_for(1000, seed=3, episode=e))
        training |= {tuple(row) for row in torch.stack(layouts, -1).tolist()}
    assert len(training) == 20_000
    assert not training & {tuple(row) for row in evaluation.tolist()}


def test_the_published_evaluation_layouts_stay_as_they_are():
    layouts = torch.stack(harbour.fixed_layouts(1000, seed=0), -1).double()
    assert layouts[999].tolist() == pytest.approx([18.513914, -41.269749, -35.586502, 69.864418], abs=1e-4)
    assert layouts.mean(0).tolist() == pytest.approx([-0.772767, 1.584678, 0.730998, -1.543051], abs=1e-5)


@pytest.mark.parametrize("stream", [counter_rng.TRAINING, counter_rng.NOISE, counter_rng.EVALUATION_NOISE])
def test_no_seed_makes_another_stream_repeat_the_numbers_of_evaluation(stream):
    num, indices = 1000, torch.arange(16, dtype=torch.int32)
    evaluation = keys_for(num, counter_rng.EVALUATION)
    # The seed whose hash equals that of evaluation with seed 0: the stream is mixed in by an exclusive or.
    twin = keys_for(num, stream, seed=(0x2545F491 + 0x01234567) ^ (0x2545F491 + 0x01234567 * stream))
    assert torch.equal(evaluation.bits, twin.bits)
    numbers, twins = (counter_rng.uniform(k._replace(bits=k.bits.unsqueeze(-1)), indices) for k in (evaluation, twin))
    assert ((numbers == twins).sum(-1) <= 1).all()
    assert torch.stack([numbers[:, 1:].flatten(), twins[:, 1:].flatten()]).corrcoef()[0, 1].abs() < 0.03
    evaluation_layouts, twin_layouts = harbour.sample_layout(evaluation), harbour.sample_layout(twin)
    for ours, theirs in zip(evaluation_layouts, twin_layouts, strict=True):
        assert (ours != theirs).float().mean() > 0.99
    assert (torch.stack(evaluation_layouts) != torch.stack(twin_layouts)).any(0).all()


def test_the_steps_of_two_streams_meet_at_most_once_in_two_to_the_thirty():
    for one, other in itertools.combinations(counter_rng.STEPS, 2):
        assert one % 2 == other % 2 == 1
        assert (one - other) % 8 != 0


def test_random_controllers_and_key_maps_are_uniform_and_independent_of_the_layout():
    env = BoatDockEnv(100_000, controller="random", keymap="random")
    env.reset()
    state = env.state
    columns = torch.stack(
        [state.controller, state.keymap - 1, state.start_x, state.start_y, state.goal_x, state.goal_y]
    )
    assert set(state.controller.tolist()) == {0, 1}
    assert set(state.keymap.tolist()) == {1, 2}
    assert (columns[:2].mean(1) - 0.5).abs().max() < 0.006
    assert columns.corrcoef()[:2].sub(torch.eye(2, 6)).abs().max() < 0.012


def test_uniform_numbers_are_uniform_and_independent_of_every_counter():
    key = keys_for(NUM)
    numbers = [counter_rng.uniform(key, index) for index in (0, 1, 2, 15, 400)]
    numbers += [counter_rng.uniform(keys_for(NUM, *at), 0) for at in ((1,), (2,), (0, 1), (0, 0, 1), (0, 0, 2))]
    for number in numbers:
        assert number.dtype == torch.float32
        assert number.min() > 0.0
        assert number.max() < 1.0
        assert distance_between_distributions(number.numpy(), (np.arange(NUM) + 0.5) / NUM) < 0.006
    between = torch.stack([*numbers, numbers[0].roll(1)]).corrcoef() - torch.eye(len(numbers) + 1)
    assert between.abs().max() < 0.012
    per_row = counter_rng.uniform(key, torch.full_like(key.bits, 15))
    assert torch.equal(per_row, numbers[3])


@pytest.mark.parametrize("bits", [0, -1])
def test_uniform_numbers_lie_inside_the_open_interval_even_for_extreme_bits(bits, monkeypatch):
    monkeypatch.setattr(counter_rng, "_mix", lambda h: torch.full_like(h, bits))
    assert 0.0 < counter_rng.uniform(keys_for(1), 0).item() < 1.0
    assert abs(counter_rng.normal(keys_for(1), 0).item()) < 5.8


def test_normal_numbers_have_the_moments_of_the_normal_distribution():
    key = keys_for(NUM)
    first, second = counter_rng.normal(key, 0), counter_rng.normal(key, 1)
    for number in (first, second):
        moments = [number.double().pow(k).mean().item() for k in (1, 2, 3, 4)]
        assert moments == pytest.approx([0.0, 1.0, 0.0, 3.0], abs=0.06)
        assert moments[:2] == pytest.approx([0.0, 1.0], abs=0.015)
        assert (number.abs() < 1.0).float().mean().item() == pytest.approx(0.6827, abs=0.005)
    assert torch.stack([first, second]).corrcoef()[0, 1].abs() < 0.012


def test_seeds_of_any_size_are_accepted_and_large_ones_do_not_stand_for_small_ones():
    for seed in (-1, 2**32, 2**63 - 1, 12345678901234567890):
        assert counter_rng.seed_tensor(seed).dtype == torch.int32
    seeds = [0, 1, 2, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**32 + 1, 2**33, 2**64, 2**64 + 1]
    assert len({counter_rng.seed_tensor(seed).item() for seed in seeds}) == len(seeds)


def test_the_score_is_five_times_the_fuel_on_success_and_minus_one_otherwise():
    outcome = torch.arange(len(physics.OUTCOMES))
    score = harbour.score(outcome, harbour.fuel_fraction(torch.full((len(outcome),), 4.5)))
    assert score.tolist() == [-1.0, 3.75, -1.0, -1.0, -1.0, -1.0]
