"""One-step problems for selectors: two options, whose rewards may depend on the observation."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector
from hpamdp.specs import PAMDPSpecs

SPECS = PAMDPSpecs(2, ("left", "right"), (1, 1), (0.0, 0.0), (1.0, 1.0))
CPU = torch.device("cpu")

Means = Callable[[Tensor], Tensor]  # from observations [B, 2] to the options' mean rewards [B, 2]


def constant(left: float, right: float) -> Means:
    """Return mean rewards that do not depend on the observation."""
    return lambda observation: torch.tensor([left, right]).expand(len(observation), 2)


def by_sign(observation: Tensor) -> Tensor:
    """Return 1 for right and -1 for left where the first entry is positive, elsewhere the reverse.

    Always the same option has a mean reward of 0.
    """
    right = observation[:, 0].sign()
    return torch.stack([-right, right], -1)


def against_sign(observation: Tensor) -> Tensor:
    """Return the negative of `by_sign`."""
    return -by_sign(observation)


def due(observation: Tensor | int, **more: object) -> TensorDict:
    """Return a tensordict in which a decision is due in every environment, given the observations or their number."""
    if isinstance(observation, int):
        observation = torch.zeros(observation, SPECS.observation_dim)
    is_decision = torch.ones(len(observation), 1, dtype=torch.bool)
    return TensorDict({keys.OBSERVATION: observation, keys.IS_DECISION: is_decision, **more}, [len(observation)])


def ended(chosen: TensorDict, rewards: Tensor) -> TensorDict:
    """Return choices as finished decisions `[N]`: each got its reward after one step, which ended its episode."""
    is_end = torch.ones(len(chosen), 1, dtype=torch.bool)
    after = {
        keys.OBSERVATION: torch.zeros_like(chosen[keys.OBSERVATION]),
        keys.TERMINATED: is_end,
        keys.DONE: is_end.clone(),
        keys.IS_DECISION: is_end,
        keys.OPTION_RETURN: rewards.unsqueeze(-1),
        keys.OPTION_STEPS: is_end.long(),
        keys.DECISION_OBSERVATION: chosen[keys.OBSERVATION],
    }
    return chosen.copy().set("next", TensorDict(after, chosen.batch_size))


def paid(options: list[int], rewards: list[float], **more: object) -> TensorDict:
    """Return finished decisions for these options with these rewards, all made at the observation 0."""
    return ended(due(len(options), option=torch.tensor(options), **more), torch.tensor(rewards))


def play(selector: Selector, means: Means, num: int, batch: int = 1, noise: float = 1.0) -> tuple[Tensor, Tensor]:
    """Let the selector choose and learn for `num` decisions, `batch` at a time; return the options and the regrets.

    Observations are uniform in [-1, 1]; rewards are normal with standard deviation `noise`.
    """
    options, regrets = [], []
    for _ in range(num // batch):
        chosen = selector(due(2.0 * torch.rand(batch, SPECS.observation_dim) - 1.0))
        offered = means(chosen[keys.OBSERVATION])
        earned = offered.gather(-1, chosen[keys.OPTION].unsqueeze(-1)).squeeze(-1)
        selector.learn(ended(chosen, earned + noise * torch.randn(batch)))
        selector.pending.zero_()  # as the agent does where every option has ended
        options.append(chosen[keys.OPTION])
        regrets.append(offered.amax(-1) - earned)
    return torch.cat(options), torch.cat(regrets)
