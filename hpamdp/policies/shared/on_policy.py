"""What the on-policy learners of both levels share: gather rows, then update from them with a clipped surrogate."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from hpamdp.policies.shared.gradients import Descent, Inputs, LossFunction
from hpamdp.policies.shared.options import OnPolicyOptions
from hpamdp.specs import PAMDPSpecs

# PyTorch's name of an extra state in a state dict: the waiting rows. A saved learner for a new run is read without it.
WAITING = "_extra_state"


class OnPolicy(nn.Module):
    """Base class for proximal policy optimisation; list it before `Selector` or `Learner` among the bases.

    A subclass sets `options`, creates `optimizer` for its parameters and calls the methods below.
    """

    options: OnPolicyOptions
    optimizer: torch.optim.Optimizer
    specs: PAMDPSpecs

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.waiting: list[TensorDict] = []
        self.descent = Descent()

    def stateful(self) -> dict[str, Any]:
        """Return the optimizer, for the checkpoint."""
        return {"optimizer": self.optimizer}

    def get_extra_state(self) -> list[dict[str, Tensor]]:
        """Return the rows that wait for the next update, for the state dict."""
        return [dict(rows.items()) for rows in self.waiting]

    def set_extra_state(self, state: list[dict[str, Tensor]]) -> None:
        """Restore the waiting rows from a state dict."""
        self.waiting = [TensorDict(rows).auto_batch_size_(1) for rows in state]

    def gather(self, rows: TensorDict) -> TensorDict | None:
        """Add rows `[N]` to those waiting; once there are `minibatch_size` or more, hand over all of them.

        Returns:
            All waiting rows `[M]`, after which none wait, or None if there are too few.
        """
        self.waiting.append(rows)
        if sum(len(waiting) for waiting in self.waiting) < self.options.minibatch_size:
            return None
        gathered = torch.cat(self.waiting)
        self.waiting = []
        return gathered

    def minibatches(self, rows: TensorDict, epochs: int | None = None) -> Iterator[dict[str, Tensor]]:
        """Yield random minibatches of the gathered rows `[M]`, in `epochs` passes over them.

        Without `epochs`, the setting of that name says how many. If the rows are sequences, one after another, with a
        column `starts`, minibatches have whole ones.
        """
        columns = dict(rows.items())
        starts = columns.get("starts")
        sequence = None if starts is None else starts.long().cumsum(0) - 1
        num = len(rows) if sequence is None else int(sequence[-1]) + 1
        for _ in range(self.options.epochs if epochs is None else epochs):
            order = torch.randperm(num, device=rows.device)
            for indices in order.tensor_split(min(num, len(rows) // self.options.minibatch_size)):
                if sequence is not None:
                    is_chosen = torch.zeros(num, dtype=torch.bool, device=rows.device).index_fill(0, indices, True)
                    indices = is_chosen[sequence].nonzero().squeeze(-1)
                yield {name: column.index_select(0, indices) for name, column in columns.items()}

    def surrogate(self, log_ratio: Tensor, advantage: Tensor) -> Tensor:
        """Return the clipped surrogate `[B]` of one policy head from its log-ratios and the advantages, each `[B]`."""
        ratio = log_ratio.exp()
        clipped_ratio = ratio.clamp(1.0 - self.options.clip, 1.0 + self.options.clip)
        return torch.minimum(ratio * advantage, clipped_ratio * advantage)

    def gradient_step(self, loss_of: LossFunction, *inputs: Inputs) -> dict[str, Tensor]:
        """Take one step of the optimizer down the gradient of a loss, see `Descent.step`; return its scalars."""
        limit, apart = self.options.max_grad_norm, self.clipped_apart()
        return self.descent.step(self.optimizer, loss_of, *inputs, max_grad_norm=limit, clipped_apart=apart)

    def clipped_apart(self) -> Sequence[Iterable[Tensor]]:
        """Return the groups of parameters whose gradients are clipped separately, see `Descent.step`."""
        return ()


def generalised_advantages(
    value: Tensor,
    next_value: Tensor,
    reward: Tensor,
    done: Tensor,
    terminated: Tensor,
    *,
    gamma: float | Tensor,
    gae_lambda: float,
) -> tuple[Tensor, Tensor]:
    """Return generalised advantages, and the targets of V, each in the shape of the values.

    TorchRL's function of this kind computes in torch's default dtype, and this one in that of the values.

    Source: Schulman et al. 2016, arXiv:1506.02438, equation 16.

    Args:
        value, next_value: V of the states before and after the steps, `[*B, T, 1]`.
        reward: rewards of the steps.
        done: whether the trace stops after the step, bool.
        terminated: whether the step has no value after it, bool.
        gamma: discount of rewards, or that of each step, `[*B, T, 1]`.
        gae_lambda: further discount of the trace.
    """
    error = reward + gamma * (~terminated).to(value.dtype) * next_value - value
    decay = gae_lambda * gamma * (~done).to(value.dtype)
    trace = torch.zeros_like(error[..., 0, :])
    traces = []
    for of_step, kept in zip(reversed(error.unbind(-2)), reversed(decay.unbind(-2)), strict=True):
        trace = of_step + kept * trace
        traces.append(trace)
    advantage = torch.stack(traces[::-1], -2)
    return advantage, advantage + value


def normalised(advantage: Tensor, weight: Tensor | None = None, *, least: float = 0.0) -> Tensor:
    """Return advantages `[M]` or `[M, components]` with mean 0 and standard deviation 1, or less.

    Args:
        advantage: the advantages.
        weight: 1 for the rows whose mean and deviation count, else 0, `[M]`. If None, all rows count.
        least: a smaller standard deviation counts as this one.
    """
    counted = advantage if weight is None or not weight.any() else advantage[weight > 0.0]
    return (advantage - counted.mean()) / (counted.std(correction=0) + 1e-6).clamp(min=least)


def mean_scalars(steps: Sequence[Mapping[str, Tensor]]) -> dict[str, float]:
    """Return the scalars of gradient steps, averaged over the steps."""
    return {name: torch.stack([step[name] for step in steps]).mean().item() for name in steps[0]}
