"""Exp3: exponential weights over importance-weighted rewards, for rewards that change in any way.

Source: Auer, Cesa-Bianchi, Freund and Schapire 2002, *The nonstochastic multiarmed bandit problem*, figure 1.

Differs from the source:
- rewards are scaled to [0, 1] by the range seen so far;
- gains may be discounted or limited to a window (see `RewardStatistics`), whereas Exp3.S mixes the weights;
- many decisions are due at the same time; each reward is weighted by the probability its option was chosen with.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import PositiveInt
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.masks import masked_values
from hpamdp.policies.shared.bandit import Bandit, Discount, Memory, RewardStatistics
from hpamdp.settings import PositiveFraction
from hpamdp.specs import PAMDPSpecs

PROBABILITY = "option_probability"  # of the held option at its decision, float32 [*B]


class Exp3(Bandit):
    """Choose with probability (1 - exploration) softmax(exploration / K x gains) + exploration / K, for K options.

    Args:
        specs: of the problem.
        exploration: gamma of the source: the fraction of uniform choices, and the scale of the gains.
        memory, discount, window: which rewards count, as in `RewardStatistics`.
    """

    modes: ClassVar[tuple[str, ...]] = ("train",)

    low: Tensor
    high: Tensor

    def __init__(
        self,
        specs: PAMDPSpecs,
        *,
        exploration: PositiveFraction,
        memory: Memory,
        discount: Discount,
        window: PositiveInt,
    ) -> None:
        super().__init__(specs, memory, discount, window)
        self.out_keys = [*self.out_keys, PROBABILITY]
        self.exploration = exploration
        # Of the scaled rewards over their probabilities, where `statistics` has the rewards themselves.
        self.gains = RewardStatistics(specs.num_options, memory, discount, window)
        self.register_buffer("low", torch.tensor(torch.inf, dtype=torch.float64))
        self.register_buffer("high", torch.tensor(-torch.inf, dtype=torch.float64))

    @property
    def probabilities(self) -> Tensor:
        """Probabilities of an exploring choice, `[num_options]`."""
        num = self.specs.num_options
        weights = (self.exploration / num * self.gains.sums).softmax(0)
        return (1.0 - self.exploration) * weights + self.exploration / num

    def best(self, allowed: Tensor | None = None) -> int:
        """Return the option with the largest weight, among the allowed ones."""
        return int(masked_values(self.gains.sums, allowed).argmax())

    def sample(self, num: int, allowed: Tensor | None = None) -> Tensor:
        """Return `num` choices, with the probabilities of the allowed options in proportion."""
        if num == 0:  # which `multinomial` refuses
            return torch.zeros(0, dtype=torch.long, device=self.gains.sums.device)
        probabilities = self.probabilities if allowed is None else self.probabilities * allowed
        return probabilities.multinomial(num, replacement=True)

    def choose(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return the options and the probabilities they were chosen with, `[*B]` each."""
        option = self.select(td)
        probability = self.probabilities.float()[option]
        mask = td.get(keys.OPTION_MASK, None)
        if mask is not None:
            probability = probability / (self.probabilities.float() * mask).sum(-1)
        return {keys.OPTION: option, PROBABILITY: probability}

    def choose_uniformly(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return uniformly random options and their probabilities, `[*B]` each."""
        chosen = super().choose_uniformly(td)
        uniform = 1.0 / self.specs.num_options
        chosen[PROBABILITY] = torch.full_like(chosen[keys.OPTION], uniform, dtype=torch.float32)
        mask = td.get(keys.OPTION_MASK, None)
        if mask is not None:
            chosen[PROBABILITY] = 1.0 / mask.sum(-1)
        return chosen

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Add the importance-weighted rewards of finished decisions to the gains.

        Return each option's mean reward, unweighted, and its probability.
        """
        scalars = super().learn(decisions)
        rewards = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1).double()
        self.low = torch.minimum(self.low, rewards.min())
        self.high = torch.maximum(self.high, rewards.max())
        scaled = (rewards - self.low) / (self.high - self.low).clamp(min=1e-12)
        self.gains.add(decisions.get(keys.OPTION), scaled / decisions.get(PROBABILITY))
        for name, probability in zip(self.specs.option_names, self.probabilities.tolist(), strict=True):
            scalars[f"probability_{name}"] = probability
        return scalars
