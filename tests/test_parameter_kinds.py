"""Parameters that are whole numbers, and bounds of parameters that depend on the state."""

from __future__ import annotations

from itertools import pairwise

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.env.decisions import with_decisions
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.policies.base import States
from hpamdp.policies.low_level.dlpa.learner import DLPA
from hpamdp.policies.low_level.hppo import HPPO
from hpamdp.policies.low_level.hsac import HSAC
from hpamdp.policies.low_level.hyar import HyAR
from hpamdp.policies.low_level.iql import IQL
from hpamdp.policies.low_level.paddpg import PADDPG
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.policies.low_level.pets.learner import PETS
from hpamdp.policies.low_level.qpamdp import QPAMDP
from hpamdp.policies.low_level.random import Random
from hpamdp.policies.low_level.td3_bc import TD3BC
from hpamdp.specs import PAMDPSpecs

SPECS = PAMDPSpecs(1, (), (2, 1), (2.0, -1.0, 0.0), (6.0, 1.0, 9.0), integer_parameters=(True, False, True))
REPLAY = {"warmup_steps": 16, "batch_size": 8, "hidden_dims": (8,), "updates_per_step": 0.25}
BOUNDS = (keys.PARAMETER_LOW, keys.PARAMETER_HIGH)
PLANS = {"warmup_steps": 16, "updates_per_step": 0.25, "horizon": 1, "num_iterations": 2, "num_elites": 2}
LEARNERS = {
    Random: {},
    HPPO: {"minibatch_size": 8, "hidden_dims": (8,), "epochs": 1},
    **dict.fromkeys((PDQN, HSAC, PADDPG, IQL, TD3BC), REPLAY),
    HyAR: REPLAY | {"codec_pretrain_updates": 1},
    QPAMDP: {},
    DLPA: PLANS | {"num_samples": 8, "batch_size": 8, "hidden_dims": (8,)},
    PETS: PLANS | {"num_samples": 4, "greedy_samples": 4, "batch_size": 8},
}


class Orders(gymnasium.Env):
    """Order one of seven goods, which are in no order, or pay by a number; good 5 pays 1, good 4 pays -1, others 0."""

    action_space = spaces.Tuple([spaces.Discrete(2), spaces.Tuple([spaces.Discrete(7), spaces.Box(0.0, 1.0, (1,))])])
    observation_space = spaces.Box(0.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert self.action_space.contains(action)
        choice, (good, number) = action
        reward = {5: 1.0, 4: -1.0}.get(int(good), 0.0) if choice == 0 else 0.4 * float(number[0])
        return np.zeros(1, np.float32), reward, True, False, {}


class Stock(gymnasium.Env):
    """Sell, or order whole pieces, at most what is in stock or fits in; the best is to sell all, half of it pays half.

    Refuses what lies outside the bounds of the state.
    """

    action_space = spaces.Tuple([spaces.Discrete(2), spaces.Tuple([spaces.Box(0.0, 10.0, (1,)), spaces.Discrete(11)])])
    bounds = spaces.Box(0.0, 10.0, (2,))
    observation_space = spaces.Dict(stock=spaces.Box(0.0, 10.0, (1,)), parameter_low=bounds, parameter_high=bounds)

    def _observation(self):
        high = np.float32([self.stock, np.floor(10.0 - self.stock)])
        return {"stock": np.float32([self.stock]), "parameter_low": np.zeros(2, np.float32), "parameter_high": high}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.stock = self.np_random.choice([0.0, self.np_random.uniform(0.0, 10.0)])
        return self._observation(), {}

    def step(self, action):
        choice, (sold, ordered) = action
        assert 0.0 <= float(sold[0]) <= np.float32(self.stock)
        assert 0 <= ordered <= 10.0 - self.stock
        reward = float(sold[0]) / max(self.stock, 1e-6) if choice == 0 and self.stock > 0.0 else 0.0
        return self._observation(), reward, True, False, {}


def rollout(learner, env, num, mode=ExplorationType.RANDOM):
    with set_exploration_type(mode):
        return with_decisions(env).rollout(num, learner.policy, break_when_any_done=False)


def greedy_steps_after_training(make):
    torch.manual_seed(0)
    env = GymnasiumEnv(256, make=make, max_steps=1)
    learner = HPPO(PAMDPSpecs.from_env(env), minibatch_size=128, lr=3e-3, hidden_dims=(32,), anneal_steps=10_000)
    for _ in range(30):
        batch = rollout(learner, env, 1)
        learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))
    return rollout(learner, env, 1, ExplorationType.DETERMINISTIC)


def test_each_whole_number_has_a_cell_of_the_same_width():
    unit = torch.linspace(-1.0, 1.0, 100_001).unsqueeze(-1).expand(-1, 3)
    first, middle, last = SPECS.from_unit(unit).unbind(-1)
    for values, num in ((first, 5), (last, 10)):
        shares = torch.unique(values, return_counts=True)[1] / len(values)
        torch.testing.assert_close(shares, torch.full((num,), 1.0 / num), atol=1e-4, rtol=0.0)
    torch.testing.assert_close(middle, unit[:, 1])
    exact = SPECS.from_unit(SPECS.to_unit(torch.tensor([[2.0, 0.5, 9.0], [6.0, -1.0, 0.0]])))
    assert exact.tolist() == [[2.0, 0.5, 9.0], [6.0, -1.0, 0.0]]


def test_values_in_cells_pass_the_gradient_on():
    unit = torch.tensor([[0.9, 0.3, -0.95]], requires_grad=True)
    moved = SPECS.in_cells(unit)
    torch.testing.assert_close(moved, torch.tensor([[0.8, 0.3, -0.9]]))
    moved.sum().backward()
    assert unit.grad.tolist() == [[1.0, 1.0, 1.0]]


def test_values_without_an_order_are_learned_by_a_categorical_head():
    steps = greedy_steps_after_training(Orders)
    assert steps["next", "reward"].mean() > 0.99
    assert (steps[keys.PARAMETERS][..., 0] == 5.0).all()


def test_the_likelihood_of_values_sums_to_one():
    torch.manual_seed(0)
    learner = HPPO(SPECS)
    distribution = learner.actor(torch.zeros(5, 1))
    discrete = torch.zeros(5, dtype=torch.long)
    raw = SPECS.to_unit(torch.tensor([[float(value), 0.0, 3.0] for value in range(2, 7)]))
    own = distribution._replace(log_scale=torch.zeros(5, 3), mean=torch.zeros(5, 3)).log_prob(discrete, raw)[1]
    gaussian = -0.5 * np.log(2 * np.pi)
    assert (own - gaussian).exp().sum().item() == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("learner_class", LEARNERS)
def test_actions_lie_within_bounds_that_depend_on_the_state(learner_class):
    torch.manual_seed(0)
    env = GymnasiumEnv(4, make=Stock, max_steps=1)
    learner = learner_class(PAMDPSpecs.from_env(env), **LEARNERS[learner_class])
    for _ in range(3):
        batch = rollout(learner, env, 8)
        low, high = batch[keys.PARAMETER_LOW], batch[keys.PARAMETER_HIGH]
        assert ((batch[keys.PARAMETERS] >= low) & (batch[keys.PARAMETERS] <= high)).all()
        learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))
    rollout(learner, env, 4, ExplorationType.DETERMINISTIC)


def test_a_learner_sells_all_where_the_stock_is_the_bound():
    steps = greedy_steps_after_training(Stock)
    has_stock = steps[keys.PARAMETER_HIGH][..., 0] > 0.0
    assert steps["next", "reward"].squeeze(-1)[has_stock].mean() > 0.95


def test_a_parameter_with_equal_bounds_has_their_value_and_is_stored_as_zero():
    specs = PAMDPSpecs(
        1, (), (2,), (0.0, 0.0), (10.0, 10.0), integer_parameters=(False, True), has_parameter_bounds=True
    )
    step = TensorDict(
        {keys.PARAMETER_LOW: torch.tensor([[3.0, 4.0]]), keys.PARAMETER_HIGH: torch.tensor([[3.0, 4.0]])}, [1]
    )
    for unit in (-1.0, 0.2, 1.0):
        parameters = specs.from_unit(torch.full((1, 2), unit), step)
        assert parameters.tolist() == [[3.0, 4.0]]
        assert specs.to_unit(parameters, step).tolist() == [[0.0, 0.0]]


def test_relative_numbers_move_with_the_bounds_of_the_state():
    specs = PAMDPSpecs(1, (), (1,), (0.0,), (10.0,), has_parameter_bounds=True)
    highs = [2.0, 4.0, 8.0]
    step = {keys.PARAMETER_LOW: torch.zeros(3, 1), keys.PARAMETER_HIGH: torch.tensor(highs).unsqueeze(-1)}
    parameters = specs.from_unit(torch.full((3, 1), 0.5), step)
    assert parameters.flatten().tolist() == [0.75 * high for high in highs]
    assert all(low < high for low, high in pairwise(parameters.flatten().tolist()))
    with pytest.raises(ValueError, match="pass the step"):
        specs.from_unit(torch.zeros(3, 1))


@pytest.mark.parametrize(
    ("learner_class", "settings"),
    [
        (PDQN, {}),
        (PDQN, {"search_samples": 4, "greedy_samples": 4, "memory": "stack"}),
        (HSAC, {}),
        (HSAC, {"autoregressive": True}),
        (PADDPG, {"twin": True}),
        (TD3BC, {}),
    ],
)
def test_critics_are_asked_about_zero_where_a_parameter_has_a_single_value(learner_class, settings):
    """So what critics make of the other numbers, which they never saw there, changes nothing."""
    torch.manual_seed(0)
    env = GymnasiumEnv(32, make=Stock, max_steps=1)
    learner = learner_class(PAMDPSpecs.from_env(env), **REPLAY | {"warmup_steps": 32} | settings)
    batch = rollout(learner, env, 1)
    learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))
    empty = batch[(batch[keys.PARAMETER_HIGH][..., 0] == 0.0).squeeze(-1)]
    rows = learner.transitions(empty).flatten()
    assert len(rows) > 5

    def results():
        torch.manual_seed(0)
        value = learner.value(States(rows["state"], memory=rows.get("memory", None)))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action = learner.policy(empty.select(*learner.policy.in_keys, *BOUNDS).clone())[keys.ACTION]
        given = (rows, None) if learner_class is TD3BC else (rows["state"], None)
        if learner_class in (PDQN, HSAC):
            given = learner.detached(rows), None, learner.fixed(rows)
        return [value, action["discrete"], action["parameters"], learner.actor_loss(*given)[0]]

    before = results()
    with torch.no_grad():
        for critics in (learner.critics, learner.target_critics):
            net = critics if learner_class is PADDPG else critics.net
            net.layers[0].weight[:, -2] += 5.0
    for one, other in zip(before, results(), strict=True):
        torch.testing.assert_close(one, other)
