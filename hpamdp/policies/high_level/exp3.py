"""Exp3: exponential weights over importance-weighted rewards, for rewards that change in any way.

Source: Auer, Cesa-Bianchi, Freund and Schapire 2002, *The nonstochastic multiarmed bandit problem*, figure 1.

Differs from the source:
- rewards are scaled to [0, 1] by the range seen so far. When it grows, the earlier rewards are scaled by the new range.
  Until two rewards differ, all gains are 0;
- the range is that of all rewards, also of forgotten ones;
- gains may be discounted or limited to a window (see `RewardStatistics`), whereas Exp3.S mixes the weights;
- many decisions are due at the same time; each reward is divided by the probability of its choice;
- if the policy is greedy, it chooses the highest gain and does not sample.
"""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.policies.high_level.options import CARDS, Exp3Options
from hpamdp.policies.shared.bandit import Bandit, RewardStatistics
from hpamdp.specs import PAMDPSpecs

PROBABILITY = "option_probability"  # of the held option at its decision, float32 [*B]


class Exp3(Bandit):
    """Choose with probability (1 - exploration) softmax(exploration / K x gains) + exploration / K, for K options."""

    Options = Exp3Options
    card = CARDS["Exp3"]
    options: Exp3Options

    def __init__(self, specs: PAMDPSpecs, options: Exp3Options | None = None, **settings: Any) -> None:
        super().__init__(specs, options, **settings)
        self.out_keys = [*self.out_keys, PROBABILITY]
        # `weighted` sums reward / probability, and `inverse` sums 1 / probability. `gains` scales both, because the
        # range of the rewards may still grow.
        self.weighted = RewardStatistics(specs.num_options, self.options)
        self.inverse = RewardStatistics(specs.num_options, self.options)
        self.low: Tensor = nn.Buffer(torch.tensor(torch.inf, dtype=torch.float64))
        self.high: Tensor = nn.Buffer(torch.tensor(-torch.inf, dtype=torch.float64))

    @property
    def gains(self) -> Tensor:
        """Sum of each option's scaled rewards, each divided by the probability of its choice, `[num_options]`."""
        if not self.high > self.low:
            return torch.zeros_like(self.weighted.sums)
        return (self.weighted.sums - self.low * self.inverse.sums) / (self.high - self.low)

    @property
    def probabilities(self) -> Tensor:
        """Probabilities of an exploring choice, `[num_options]`."""
        num = self.specs.num_options
        exploration = self.options.exploration
        weights = (exploration / num * self.gains).softmax(0)
        return (1.0 - exploration) * weights + exploration / num

    @property
    def greedy_values(self) -> Tensor:
        """The gains, which order the options as their weights do."""
        return self.gains

    def sample(self, num: int, allowed: Tensor | None = None) -> Tensor:
        """Return `num` choices, with the probabilities of the allowed options in proportion."""
        if num == 0:  # which `multinomial` refuses
            return torch.zeros(0, dtype=torch.long, device=self.low.device)
        probabilities = self.probabilities if allowed is None else self.probabilities * allowed
        return probabilities.multinomial(num, replacement=True)

    def held_with(self, td: TensorDictBase, option: Tensor) -> dict[str, Tensor]:
        """Return the probabilities `[*B]` with which the options practise or are chosen."""
        own = self.probabilities.float().expand(*option.shape, -1)
        mask = td.get(keys.OPTION_MASK, None)
        if mask is not None:
            own = own * mask
        probabilities = self.exploring_probabilities(td, own / own.sum(-1, keepdim=True))
        return {PROBABILITY: probabilities.gather(-1, option.unsqueeze(-1)).squeeze(-1)}

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Add the importance-weighted rewards of finished decisions to the gains.

        Return each option's unweighted mean reward and its probability.
        """
        scalars = super().learn(decisions)
        rewards = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1).double()
        self.low = torch.minimum(self.low, rewards.min())
        self.high = torch.maximum(self.high, rewards.max())
        option, inverse = decisions.get(keys.OPTION), 1.0 / decisions.get(PROBABILITY).double()
        self.weighted.add(option, rewards * inverse)
        self.inverse.add(option, inverse)
        for name, probability in zip(self.specs.option_names, self.probabilities.tolist(), strict=True):
            scalars[f"probability_{name}"] = probability
        return scalars
