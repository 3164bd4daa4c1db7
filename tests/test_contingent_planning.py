"""Plans under hypotheses: finding out is worth what can be chosen better afterwards."""

import pytest
import torch

from hpamdp.policies.shared import contingent_planning
from hpamdp.policies.shared.contingent_planning import ContingentSearch
from hpamdp.policies.shared.options import SequenceSearchOptions
from hpamdp.policies.shared.planning import SequenceSearch, absolute_temperature

ASKS, GUESSES = 1, 0
TARGETS = torch.tensor([-0.5, 0.5])  # of the second step's parameter, under either hypothesis
BLIND_LOSS = 0.25  # of the best that serves both


def planned(price: float, shows: tuple[bool, bool] = (False, True), allowed: torch.Tensor | None = None):
    """Plan where the first action 1 costs a price, and the second step should hit what only the truth tells."""
    torch.manual_seed(0)
    options = SequenceSearchOptions(horizon=1, num_samples=40, num_iterations=6)
    num = 3

    def returns(steps):
        first, second = steps
        times = second.own.shape[1] // first.own.shape[1]
        target = TARGETS.repeat(num)[:, None, None]
        cost = price * (first.discrete.repeat_interleave(times, 1) == ASKS).float()
        return -(second.own[..., 0] - target).square() - cost[..., None]

    search = ContingentSearch((1, 1), options)
    return search(returns, torch.tensor(shows).expand(num, -1), 2, allowed, is_greedy=True)


@pytest.mark.parametrize(("price", "best", "value"), [(0.1, ASKS, -0.1), (0.4, GUESSES, -BLIND_LOSS)])
def test_a_plan_finds_out_what_is_worth_its_price(price, best, value):
    plan = planned(price)
    assert (plan.discrete == best).all()
    torch.testing.assert_close(plan.value, torch.full_like(plan.value, value), atol=0.01, rtol=0.0)


def test_an_action_that_shows_nothing_gains_nothing():
    plan = planned(0.0, shows=(False, False))
    torch.testing.assert_close(plan.value, torch.full_like(plan.value, -BLIND_LOSS), atol=0.01, rtol=0.0)


def test_a_forbidden_action_finds_nothing_out():
    allowed = torch.ones(3, 1, 2, dtype=torch.bool)
    allowed[..., ASKS] = False
    assert (planned(0.0, allowed=allowed).discrete == GUESSES).all()


def test_the_temperature_does_not_count_what_is_forbidden(monkeypatch):
    seen = []

    def temperature(*given):
        seen.append(absolute_temperature(*given))
        return seen[-1]

    monkeypatch.setattr(contingent_planning, "absolute_temperature", temperature)
    allowed = torch.ones(3, 1, 2, dtype=torch.bool)
    allowed[..., ASKS] = False
    for price in (0.0, 1000.0):
        planned(price, allowed=allowed)
    torch.testing.assert_close(seen[0], seen[1])
    assert (seen[0] < 1.0).all()


def test_the_first_action_is_the_best_one_for_all_hypotheses():
    torch.manual_seed(0)

    def returns(steps):
        return -(steps[0].own[..., 0] - torch.tensor([0.0, 0.8]).repeat(2)[:, None, None]).square()

    options = SequenceSearchOptions(horizon=1, num_samples=40, num_iterations=6, max_sequences=4)
    search = ContingentSearch((1,), options)
    plan = search(returns, torch.ones(2, 1, dtype=torch.bool), 2, is_greedy=True)
    torch.testing.assert_close(plan.own, torch.full((2, 1), 0.4), atol=0.05, rtol=0.0)


def test_a_forbidden_action_is_below_the_lowest_returns():
    torch.manual_seed(0)
    search = SequenceSearch((1, 1), SequenceSearchOptions(horizon=1))
    allowed = torch.tensor([True, False]).expand(3, 1, 2)
    plan = search(lambda steps: -1e12 - steps[0].own[..., 0].square(), 3, torch.device("cpu"), allowed)
    assert (plan.discrete == GUESSES).all()
