"""What the on-policy learners of both levels have in common: gather rows, then make clipped updates from them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from hpamdp.specs import PAMDPSpecs


class OnPolicy:
    """Proximal policy optimisation, for a `Selector` or a `Learner` to inherit before it.

    A subclass makes the `optimiser` of its parameters and calls the methods below.

    Args:
        specs: of the problem.
        epochs, minibatch_size: passes over the rows of an update, and rows a step of them takes.
        clip: the surrogate stops rewarding ratios further from 1.
        max_grad_norm: of the steps.
    """

    optimizer: torch.optim.Optimizer

    def __init__(
        self, specs: PAMDPSpecs, *, epochs: int, minibatch_size: int, clip: float, max_grad_norm: float
    ) -> None:
        super().__init__(specs)
        self.epochs, self.minibatch_size, self.clip, self.max_grad_norm = epochs, minibatch_size, clip, max_grad_norm
        self.waiting: list[TensorDict] = []

    def stateful(self) -> dict[str, Any]:
        """Return the optimiser."""
        return {"optimiser": self.optimizer}

    def get_extra_state(self) -> list[dict[str, Tensor]]:
        """Return the rows that wait for the next update, for the state dict."""
        return [dict(rows.items()) for rows in self.waiting]

    def set_extra_state(self, state: list[dict[str, Tensor]]) -> None:
        """Take the rows back from a state dict."""
        self.waiting = [TensorDict(rows).auto_batch_size_(1) for rows in state]

    def gather(self, rows: TensorDict) -> TensorDict | None:
        """Let rows `[N]` wait; from a minibatch of them on, return all that waited."""
        self.waiting.append(rows)
        if sum(len(each) for each in self.waiting) < self.minibatch_size:
            return None
        gathered, self.waiting = torch.cat(self.waiting), []
        return gathered

    def make_passes(self, rows: TensorDict, update: Callable[[TensorDictBase], dict[str, Tensor]]) -> dict[str, float]:
        """Make `epochs` passes over gathered rows, with their `advantage` normalised; return the updates' mean scalars.

        `update` makes a step from a minibatch and returns scalars.
        """
        advantage = rows["advantage"]
        rows["advantage"] = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-6)
        steps: list[dict[str, Tensor]] = []
        for _ in range(self.epochs):
            order = torch.randperm(len(rows), device=rows.device).tensor_split(len(rows) // self.minibatch_size)
            steps += [update(rows[indices]) for indices in order]
        return {name: torch.stack([step[name] for step in steps]).mean().item() for name in steps[0]}

    def surrogate(self, log_ratio: Tensor, advantage: Tensor) -> Tensor:
        """Return the clipped surrogate of one policy, `[B]`."""
        ratio = log_ratio.exp()
        return torch.minimum(ratio * advantage, ratio.clamp(1.0 - self.clip, 1.0 + self.clip) * advantage)

    def optimizer_step(self, loss: Tensor) -> None:
        """Take a step of the optimiser."""
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.parameters(), self.max_grad_norm)
        self.optimizer.step()
