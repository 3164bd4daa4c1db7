"""Exp3: exponential weights over importance-weighted payoffs, which holds against payoffs that drift in any way.

Source: Auer, Cesa-Bianchi, Freund and Schapire 2002, *The nonstochastic multiarmed bandit problem*, figure 1.

Differs from the source:
- payoffs are scaled to [0, 1] by the range seen so far;
- the gains may be discounted or limited to a window (see `Payoffs`), where Exp3.S mixes the weights;
- many decisions are due at once; each payoff counts with the probability under which its option was chosen.
"""

from __future__ import annotations

import torch
from pydantic import PositiveInt
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.shared.bandit_statistics import Bandit, Discount, Memory, RewardStatistics
from hpamdp.policies.shared.fractions import PositiveFraction
from hpamdp.specs import PAMDPSpecs

PROBABILITY = "option_probability"  # of the held option when it was chosen


class Exp3(Bandit):
    """Choose by p = (1 - exploration) softmax(exploration / K x gains) + exploration / K.

    Args:
        specs: of the problem.
        exploration: gamma of the source, which also scales the gains.
        memory, discount, window: which payoffs count, as in `Payoffs`.
    """

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
        self.gains = RewardStatistics(specs.num_options, memory, discount, window)
        self.register_buffer("low", torch.tensor(torch.inf, dtype=torch.float64))
        self.register_buffer("high", torch.tensor(-torch.inf, dtype=torch.float64))

    @property
    def probabilities(self) -> Tensor:
        """The exploring choice's distribution, `[num_options]`."""
        num = self.specs.num_options
        weights = (self.exploration / num * self.gains.sums).softmax(0)
        return (1.0 - self.exploration) * weights + self.exploration / num

    def best(self) -> int:
        """Return the option with the largest weight."""
        return int(self.gains.sums.argmax())

    def sample(self, num: int) -> Tensor:
        """Return `num` choices."""
        return self.probabilities.multinomial(num, replacement=True) if num else self.gains.recent_options.new_zeros(0)

    def choose(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return the choices and the probabilities that they had."""
        option = self.select(td)
        return {keys.OPTION: option, PROBABILITY: self.probabilities.float()[option]}

    def choose_uniformly(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return uniformly random options and their probabilities, `[*B]` each."""
        chosen = super().choose_uniformly(td)
        uniform = 1.0 / self.specs.num_options
        return chosen | {PROBABILITY: torch.full_like(chosen[keys.OPTION], uniform, dtype=torch.float32)}

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Add to the gains what the finished decisions earned over the probability of their choice."""
        scalars = super().learn(decisions)
        rewards = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1).double()
        self.low, self.high = torch.minimum(self.low, rewards.min()), torch.maximum(self.high, rewards.max())
        scaled = (rewards - self.low) / (self.high - self.low).clamp(min=1e-12)
        self.gains.add(decisions.get(keys.OPTION), scaled / decisions.get(PROBABILITY))
        named = zip(self.specs.option_names, self.probabilities.tolist(), strict=True)
        chances = {f"probability_{name}": probability for name, probability in named}
        return scalars | chances
