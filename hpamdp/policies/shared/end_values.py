"""The value of the last state of a plan, for learners that plan a few steps ahead in a model.

A plan counts the rewards of its own steps. If options end inside episodes, that is too little: the rewards may come
under the next option. So networks learn the values of states from the stored steps, as model-free learners do.

Sources: Lowrey et al. 2019, *Plan Online, Learn Offline*, arXiv 1811.01848: plans that end in a learned value;
Kostrikov, Nair and Levine 2021, *Offline Reinforcement Learning with Implicit Q-Learning*, arXiv 2110.06169, equation
5: the expectile, which gives little weight to the returns of the worse stored actions.

Differs from the sources: the expectile is that of reward + discounted next value, without a Q. So where steps are
random, lucky ones count as good actions.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hpamdp.policies.shared.gradients import adam, expectile_loss
from hpamdp.policies.shared.networks import mlp
from hpamdp.policies.shared.options import EndValueOptions


class EndValues(nn.Module):
    """Two values of a state: `of_own`, if this learner acts there, and `forward`, if a plan ends there.

    Each value has its own network. The latter is the value under the option that holds after the step, which is another
    option if this learner's has ended. So a policy's copy in another process needs neither the selector nor the other
    learners. If observations do not tell whether the option ends, it is the mean of both cases. A plan of several steps
    goes on past the end of its option.

    Args:
        observation_dim: of the states.
        hidden_dims: of both networks.
        options: their learning rate, the rate of the target network and the expectile.
    """

    def __init__(self, observation_dim: int, hidden_dims: Sequence[int], options: EndValueOptions) -> None:
        super().__init__()
        self.options = options
        self.own = mlp(observation_dim, hidden_dims, 1)
        self.end = mlp(observation_dim, hidden_dims, 1)
        self.target_own = copy.deepcopy(self.own).requires_grad_(False)

    def forward(self, state: Tensor) -> Tensor:
        """Return the values `[*B]` of states `[*B, observation_dim]` at the end of a plan."""
        return self.end(state).squeeze(-1)

    def of_own(self, state: Tensor) -> Tensor:
        """Return the target network's values `[*B]` of states `[*B, observation_dim]` in which this learner acts."""
        return self.target_own(state).squeeze(-1)

    def loss(
        self, state: Tensor, next_state: Tensor, reward: Tensor, discount: Tensor, next_value: Tensor
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of both networks on stored steps, a scalar, and its parts `own_value` and `end_value`.

        Args:
            state, next_state: `[B, observation_dim]`.
            reward: `[B]`.
            discount: of the next state's value, 0 after a termination, `[B]`.
            next_value: of the next states under the option that follows, `[B]`.
        """
        excess = reward + discount * next_value - self.own(state).squeeze(-1)
        own = expectile_loss(excess, self.options.end_value_expectile)
        end = ((self(next_state) - next_value).square() * (discount > 0.0)).mean()
        return own + end, {"own_value": own, "end_value": end}

    def optimizer(self) -> torch.optim.Optimizer:
        """Return the optimizer of the learned networks, which is the learner's optimizer `end_values`."""
        return adam(self.options.end_value_lr, self.own, self.end)
