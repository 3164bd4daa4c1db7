"""Selectors: what each one chooses, and that the bandits find the better arm."""

import math

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.policies.high_level.fixed import Fixed
from hpamdp.policies.high_level.oracle import Oracle
from hpamdp.policies.high_level.ucb import UCB
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.specs import PAMDPSpecs

SPECS = PAMDPSpecs(2, ("left", "right"), (1, 1), (0.0, 0.0), (1.0, 1.0))
UCB_VARIANTS = ("ucb1", "discounted", "sliding_window")


def due(num: int, **more: torch.Tensor) -> TensorDict:
    """Return a root at which every environment decides."""
    is_decision = torch.ones(num, 1, dtype=torch.bool)
    return TensorDict({keys.OBSERVATION: torch.zeros(num, 2), keys.IS_DECISION: is_decision, **more}, [num])


def ended(options: torch.Tensor, payoffs: torch.Tensor) -> TensorDict:
    return TensorDict({keys.OPTION: options, "next": {keys.OPTION_RETURN: payoffs.unsqueeze(-1)}}, options.shape)


def make_ucb(variant: str = "ucb1", exploration: float = 1.0, discount: float = 0.99, window: int = 500) -> UCB:
    return UCB(SPECS, exploration=exploration, variant=variant, discount=discount, window=window)


def play(selector: UCB, means: tuple[float, float], num_rounds: int, batch: int = 1) -> torch.Tensor:
    """Let the selector play a two-armed Gaussian bandit; return its choices `[num_rounds * batch]`."""
    choices = []
    for _ in range(num_rounds):
        options = selector.select(due(batch))
        payoffs = torch.tensor(means)[options] + torch.randn(batch)
        selector.learn(ended(options, payoffs))
        choices.append(options)
    return torch.cat(choices)


def test_the_held_option_stays_where_no_decision_is_due():
    td = due(4, option=torch.tensor([0, 1, 0, 1]))
    td[keys.IS_DECISION][:] = torch.tensor([[True], [False], [False], [True]])
    assert Fixed(SPECS, option="right")(td)[keys.OPTION].tolist() == [1, 1, 0, 1]


@pytest.mark.parametrize(("option", "number"), [("left", 0), ("right", 1), (1, 1)])
def test_fixed_chooses_by_name_or_number(option, number):
    assert Fixed(SPECS, option=option).select(due(3)).tolist() == [number] * 3


def test_fixed_refuses_an_unknown_option_and_names_the_known_ones():
    with pytest.raises(ValueError, match="left, right"):
        Fixed(SPECS, option="up")


def test_uniform_chooses_both_options_about_equally():
    torch.manual_seed(0)
    assert Uniform(SPECS).select(due(10_000)).float().mean().item() == pytest.approx(0.5, abs=0.02)


def test_oracle_passes_on_what_the_environment_knows():
    assert Oracle(SPECS).select(due(3, oracle={"option": torch.tensor([1, 0, 1])})).tolist() == [1, 0, 1]


def test_ucb1_counts_and_bounds_equal_the_formula():
    ucb = make_ucb(exploration=0.7)
    options, payoffs = torch.tensor([0, 0, 0, 1]), torch.tensor([1.0, 2.0, 3.0, 2.5])
    ucb.learn(ended(options, payoffs))
    assert ucb.counts.tolist() == [3, 1] and ucb.means.tolist() == [2.0, 2.5]
    deviation = payoffs.double().std(correction=0).item()
    bounds = [m + 0.7 * deviation * math.sqrt(2 * math.log(5) / n) for m, n in ((2.0, 3), (2.5, 1))]
    assert ucb.select(due(1)).item() == bounds.index(max(bounds))


def test_simultaneous_decisions_are_served_as_if_one_after_another():
    ucb = make_ucb()
    ucb.learn(ended(torch.tensor([0] * 30 + [1] * 10), torch.randn(40)))
    counts, means = ucb.counts.clone(), ucb.means.clone()
    mean = ucb.sums.sum() / 40
    deviation = (ucb.squares.sum() / 40 - mean**2).sqrt()
    for _ in range(64):
        bounds = means + deviation * (2 * math.log(40 + 64) / counts).sqrt()
        counts[bounds.argmax()] += 1
    chosen = ucb.select(due(64))
    assert torch.bincount(chosen, minlength=2).tolist() == (counts - ucb.counts).tolist()


@pytest.mark.parametrize("variant", UCB_VARIANTS)
def test_untried_options_are_tried_first_and_shared_evenly(variant):
    assert make_ucb(variant).select(due(100)).sum().item() == 50


@pytest.mark.parametrize("variant", UCB_VARIANTS)
@pytest.mark.parametrize("batch", [1, 64])
def test_ucb_finds_the_better_option(variant, batch):
    torch.manual_seed(0)
    choices = play(make_ucb(variant, exploration=0.5), (0.0, 1.0), 2000 // batch, batch)
    assert choices[-500:].float().mean() > 0.85


def test_forgetting_forms_follow_an_option_that_becomes_the_better_one_and_ucb1_lags():
    shares = {}
    for variant in UCB_VARIANTS:
        torch.manual_seed(0)
        ucb = make_ucb(variant, exploration=0.2)
        play(ucb, (1.0, 0.0), 3000)
        shares[variant] = play(ucb, (0.0, 1.0), 2000)[-500:].float().mean().item()
    assert shares["discounted"] > 0.85 and shares["sliding_window"] > 0.85
    assert shares["ucb1"] < shares["discounted"]


def test_greedy_ucb_takes_the_best_mean_everywhere():
    ucb = make_ucb()
    ucb.learn(ended(torch.tensor([0, 1] * 50), torch.tensor([1.0, 0.0] * 50)))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert ucb.select(due(20)).tolist() == [0] * 20


@pytest.mark.parametrize("variant", UCB_VARIANTS)
def test_what_ucb_knows_survives_a_state_dict(variant):
    torch.manual_seed(0)
    source, target = make_ucb(variant), make_ucb(variant)
    play(source, (0.0, 1.0), 50)
    target.load_state_dict(source.state_dict())
    torch.manual_seed(1)
    expected = play(source, (0.0, 1.0), 50)
    torch.manual_seed(1)
    assert torch.equal(play(target, (0.0, 1.0), 50), expected)
