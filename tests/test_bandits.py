"""Context-free bandits: their statistics and choices, and that they find the better option and follow its changes."""

import math

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_bandits import SPECS, constant, due, paid, play

from hpamdp import keys
from hpamdp.policies.high_level.epsilon_greedy import EpsilonGreedy
from hpamdp.policies.high_level.exp3 import PROBABILITY, Exp3
from hpamdp.policies.high_level.thompson import Thompson
from hpamdp.policies.high_level.ucb import UCB
from hpamdp.policies.shared.bandit import Bandit, RewardStatistics
from hpamdp.policies.shared.bandit_options import BanditOptions

MEMORIES = ("all", "discounted", "sliding_window")
BANDITS = {
    "epsilon_greedy": (EpsilonGreedy, {"epsilon_scale": 30.0, "epsilon_final": 0.1}),
    "ucb": (UCB, {"exploration": 0.3}),
    "thompson": (Thompson, {"exploration": 1.0}),
    "exp3": (Exp3, {"exploration": 0.2}),
}
every_bandit = pytest.mark.parametrize("name", BANDITS)
every_memory = pytest.mark.parametrize("memory", MEMORIES)


def make(name: str, memory: str = "all", **changes: float) -> Bandit:
    cls, options = BANDITS[name]
    return cls(SPECS, **{**options, "memory": memory, "discount": 0.998, "window": 500, **changes})


def share_of_right(options: torch.Tensor) -> float:
    """Return how often the second option, `right`, was chosen."""
    return options.float().mean().item()


# Statistics.


def test_with_memory_all_every_reward_has_the_same_weight():
    statistics = RewardStatistics(2, BanditOptions(memory="all", discount=0.9, window=3))
    for option, reward in ((0, 1.0), (1, 2.5), (0, 2.0), (0, 3.0)):
        statistics.add(torch.tensor([option]), torch.tensor([reward]))
    assert statistics.counts.tolist() == [3, 1] and statistics.means.tolist() == [2.0, 2.5]
    assert statistics.deviation.item() == pytest.approx(torch.tensor([1.0, 2.5, 2.0, 3.0]).std(correction=0).item())
    assert statistics.known_means.argmax() == 1


@pytest.mark.parametrize("at_once", [1, 3])
def test_discounted_rewards_are_weighted_by_their_age_in_decisions(at_once):
    options, rewards = torch.tensor([0, 1, 0, 0, 1, 0]), torch.tensor([1.0, 2.0, -3.0, 4.0, 5.0, -6.0])
    statistics = RewardStatistics(2, BanditOptions(memory="discounted", discount=0.9, window=3))
    for some_options, some_rewards in zip(options.split(at_once), rewards.split(at_once), strict=True):
        statistics.add(some_options, some_rewards)
    weights = 0.9 ** torch.arange(5, -1, -1).double()
    for option in (0, 1):
        own = options == option
        assert statistics.counts[option].item() == pytest.approx(weights[own].sum().item())
        mean = (weights * rewards)[own].sum() / weights[own].sum()
        assert statistics.means[option].item() == pytest.approx(mean.item())


@pytest.mark.parametrize("at_once", [1, 3, 6])
def test_a_sliding_window_holds_only_the_last_decisions(at_once):
    statistics = RewardStatistics(2, BanditOptions(memory="sliding_window", discount=0.9, window=4))
    options, rewards = torch.tensor([0, 0, 1, 1, 0, 0]), torch.tensor([9.0, 9.0, 1.0, 2.0, 3.0, 5.0])
    for some_options, some_rewards in zip(options.split(at_once), rewards.split(at_once), strict=True):
        statistics.add(some_options, some_rewards)
    assert statistics.counts.tolist() == [2, 2] and statistics.means.tolist() == [4.0, 1.5]


def test_an_option_that_left_the_window_is_untried_again():
    statistics = RewardStatistics(2, BanditOptions(memory="sliding_window", discount=0.9, window=2))
    statistics.add(torch.tensor([1, 0, 0]), torch.tensor([5.0, -1.0, -1.0]))
    assert statistics.is_untried.tolist() == [False, True] and statistics.known_means.argmax() == 0


# Choices.


@every_bandit
@every_memory
def test_greedy_choices_are_the_best_option_everywhere(name, memory):
    torch.manual_seed(0)
    bandit = make(name, memory)
    bandit.learn(paid([0, 1] * 50, [1.0, 0.0] * 50, **{PROBABILITY: torch.full((100,), 0.5)}))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert bandit.select(due(20)).tolist() == [0] * 20
    bandit.learn(paid([1] * 300, [3.0] * 300, **{PROBABILITY: torch.full((300,), 0.5)}))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert bandit.select(due(20)).tolist() == [1] * 20


@every_bandit
@pytest.mark.parametrize("rewards", [[], [5.0], [1e30] * 5])
def test_untried_options_get_tried(name, rewards):
    torch.manual_seed(0)
    bandit = make(name, **({"epsilon_scale": 1e-3, "epsilon_final": 0.0} if name == "epsilon_greedy" else {}))
    if rewards:
        bandit.learn(paid([0] * len(rewards), rewards, **{PROBABILITY: torch.full((len(rewards),), 0.5)}))
    tried = bandit.select(due(100)).sum().item()
    assert tried >= 20 if rewards else 20 <= tried <= 80


@every_bandit
def test_only_decisions_that_are_due_are_sampled(name):
    torch.manual_seed(0)
    root = due(100)
    root[keys.IS_DECISION][:50] = False
    bandit = make(name)
    sampled = []
    bandit.sample = lambda num: sampled.append(num) or torch.ones(num, dtype=torch.long)
    assert bandit.select(root)[50:].tolist() == [1] * 50
    assert sampled == [50]


def test_no_reward_is_logged_for_an_option_that_was_never_tried():
    names = SPECS.option_names
    assert make("ucb").learn(paid([1, 1], [-1.0, -2.0])) == {f"reward_{names[1]}": -1.5}


@pytest.mark.parametrize("at_once", [100, 10_000])
def test_epsilon_falls_as_one_over_the_decisions_that_were_made_to_its_lower_bound(at_once):
    torch.manual_seed(0)
    bandit = make("epsilon_greedy", epsilon_scale=100.0, epsilon_final=0.05)
    bandit.learn(paid([0, 1] * 200, [1.0, 0.0] * 200))
    chosen = torch.cat([bandit.select(due(at_once)) for _ in range(10_000 // at_once)])  # no reward in between
    # At decisions 401 to 10,400; with 2 options, half of the random choices are wrong.
    expected = sum(max(0.05, 100.0 / t) for t in range(401, 10_401)) / 2
    assert chosen.sum().item() == pytest.approx(expected, abs=4 * math.sqrt(expected))
    assert bandit.pending.tolist() == torch.bincount(chosen).tolist()


def test_the_clock_of_epsilon_greedy_does_not_count_decisions_of_a_data_set():
    torch.manual_seed(0)
    bandit = make("epsilon_greedy", epsilon_scale=1000.0, epsilon_final=0.0)
    bandit.add_demonstrations(paid([0, 1] * 5000, [1.0, 0.0] * 5000))
    assert bandit.num_decisions == 0 and bandit.best() == 0
    assert bandit.select(due(1000)).sum().item() == pytest.approx(500, abs=4 * math.sqrt(250))


def test_ucb_counts_choices_whose_rewards_are_not_yet_known():
    torch.manual_seed(0)
    ucb = make("ucb", exploration=1.0)
    rewards = torch.randn(40)
    ucb.learn(paid([0] * 30 + [1] * 10, rewards.tolist()))
    means = torch.stack([rewards[:30].mean(), rewards[30:].mean()])
    counts = torch.tensor([30.0, 10.0], dtype=torch.float64)
    for _ in range(4):
        time = counts.sum() + 16
        for _ in range(16):
            bounds = means + ucb.statistics.deviation * (2 * torch.log(time) / counts).sqrt()
            counts[bounds.argmax()] += 1
        ucb.select(due(16))
        assert ucb.pending.tolist() == (counts - torch.tensor([30.0, 10.0])).tolist()


@pytest.mark.parametrize("tried", [(30, 10), (30, 0), (0, 0)])
def test_ucb_serves_simultaneous_decisions_as_if_they_came_one_after_another(tried):
    torch.manual_seed(0)
    ucb = make("ucb", exploration=1.0)
    rewards = torch.randn(sum(tried))
    if sum(tried):
        ucb.learn(paid([0] * tried[0] + [1] * tried[1], rewards.tolist()))
    means = [part.mean() if len(part) else rewards.mean() for part in rewards.split(list(tried))]
    means = torch.stack(means) if sum(tried) else torch.zeros(2)
    counts = torch.tensor(tried, dtype=torch.float64)
    for _ in range(64):
        bounds = means + ucb.statistics.deviation * (2 * math.log(sum(tried) + 64) / counts).sqrt()
        counts[bounds.argmax()] += 1
    chosen = torch.bincount(ucb.select(due(64)), minlength=2)
    assert chosen.tolist() == (counts - torch.tensor(tried)).tolist()


def test_thompson_chooses_an_option_as_often_as_it_is_likely_to_be_the_best():
    torch.manual_seed(0)
    thompson = make("thompson", exploration=0.8)
    thompson.learn(paid([0] * 8 + [1] * 2, [1.0, 0.0] * 4 + [1.2, 0.0]))
    deviation = 0.8 * thompson.statistics.deviation * math.sqrt(1 / 8 + 1 / 2)
    likely = torch.distributions.Normal(0.0, 1.0).cdf(0.1 / deviation).item()
    assert share_of_right(thompson.select(due(40_000))) == pytest.approx(likely, abs=0.01)


def test_exp3_weights_rewards_by_the_probability_of_their_choice():
    exp3 = make("exp3", exploration=0.5)
    exp3.learn(paid([0, 1, 1], [4.0, 2.0, 3.0], **{PROBABILITY: torch.tensor([0.8, 0.2, 0.25])}))
    gains = torch.tensor([1.0 / 0.8, 0.0 / 0.2 + 0.5 / 0.25])  # scaled by the range, 2 to 4
    weights = (0.5 / 2 * gains).exp()
    expected = (1 - 0.5) * weights / weights.sum() + 0.5 / 2
    torch.testing.assert_close(exp3.probabilities.float(), expected)
    torch.manual_seed(0)
    td = exp3(due(20_000))
    assert share_of_right(td[keys.OPTION]) == pytest.approx(expected[1].item(), abs=0.015)
    torch.testing.assert_close(td[PROBABILITY], expected[td[keys.OPTION]])


@every_memory
def test_the_gains_of_exp3_are_those_of_the_range_seen_so_far(memory):
    options, rewards = torch.tensor([0, 1, 1, 0, 1, 0]), torch.tensor([4.0, 2.0, 3.0, 40.0, -10.0, 5.0])
    probability = torch.tensor([0.8, 0.2, 0.25, 0.5, 0.5, 0.6])
    at_once, one_by_one = make("exp3", memory), make("exp3", memory)
    at_once.learn(paid(options.tolist(), rewards.tolist(), **{PROBABILITY: probability}))
    for i in range(6):
        one_by_one.learn(paid([options[i].item()], [rewards[i].item()], **{PROBABILITY: probability[i : i + 1]}))
    torch.testing.assert_close(one_by_one.probabilities, at_once.probabilities)


# What the bandits achieve.


@every_bandit
@pytest.mark.parametrize("batch", [1, 64])
def test_the_better_option_is_found(name, batch):
    torch.manual_seed(0)
    num = 400 if batch == 1 else 3200
    options, _ = play(make(name), constant(0.0, 1.0), num, batch, noise=0.5)
    assert share_of_right(options[-200:]) > 0.8


@every_bandit
def test_bandits_that_forget_follow_a_change_of_the_better_option_and_others_lag(name):
    share = {}
    for memory in MEMORIES:
        torch.manual_seed(0)
        bandit = make(name, memory)
        before, _ = play(bandit, constant(1.0, 0.0), 3000, 50, noise=0.5)
        after, _ = play(bandit, constant(0.0, 1.0), 2000, 50, noise=0.5)
        assert share_of_right(before[-500:]) < 0.2
        share[memory] = share_of_right(after)
        assert memory == "all" or share_of_right(after[-500:]) > 0.8
    assert share["all"] < min(share["discounted"], share["sliding_window"]) - 0.15


@every_bandit
@every_memory
def test_a_copy_made_from_a_state_dict_continues_identically(name, memory):
    torch.manual_seed(0)
    source, target = make(name, memory), make(name, memory)
    play(source, constant(0.0, 1.0), 50)
    target.load_state_dict(source.state_dict())
    torch.manual_seed(1)
    expected, _ = play(source, constant(1.0, 0.0), 60, 2)
    torch.manual_seed(1)
    assert torch.equal(play(target, constant(1.0, 0.0), 60, 2)[0], expected)


# Regret after T and after 4 T decisions with stationary rewards, whose means are 1 apart.

T = 2000


def growth(name: str, batch: int = 16, **changes: float) -> tuple[float, float]:
    """Return the mean regret after T decisions, and the factor by which it grows until 4 T."""
    curves = []
    for seed in range(5):
        torch.manual_seed(seed)
        curves.append(play(make(name, **changes), constant(1.0, 0.0), 4 * T, batch)[1].cumsum(0))
    regret = torch.stack(curves).mean(0)
    return regret[T - 1].item(), (regret[-1] / regret[T - 1]).item()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "changes"),
    [("epsilon_greedy", {"epsilon_final": 0.0}), ("ucb", {"exploration": 1.0}), ("thompson", {"exploration": 1.0})],
)
def test_regret_grows_with_the_logarithm_of_time(name, changes):
    regret, factor = growth(name, **changes)
    assert regret < 0.08 * T and factor < 1.8  # log(4 T) / log(T) = 1.2


@pytest.mark.slow
def test_the_regret_of_exp3_tuned_to_the_horizon_grows_with_the_square_root_of_time():
    regret = {}
    for horizon in (T, 4 * T):
        gamma = math.sqrt(2 * math.log(2) / ((math.e - 1) * horizon))  # corollary 3.2 of the source
        total = 0.0
        for seed in range(3):
            torch.manual_seed(seed)
            bandit = make("exp3", exploration=gamma)
            total += play(bandit, constant(1.0, 0.0), horizon, 10, noise=0.5)[1].sum().item() / 3
        regret[horizon] = total
        reward_range = bandit.high - bandit.low
        assert total < 2.63 * reward_range * math.sqrt(horizon * 2 * math.log(2))
    assert regret[4 * T] / regret[T] < 2.6  # sqrt(4 T) / sqrt(T) = 2
