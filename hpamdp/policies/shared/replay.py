"""What the off-policy and offline learners have in common: store transitions, then update from samples of them."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer

from hpamdp import keys
from hpamdp.policies.base import Learner
from hpamdp.specs import PAMDPSpecs


class ReplayLearner(Learner):
    """A learner with a replay buffer of its own, from which it makes `updates_per_frame` updates for each press.

    A subclass fills `optimisers` and writes `update`; the other methods are there to be extended.
    """

    modes: ClassVar[tuple[str, ...]] = ("train", "offline")

    optimizers: dict[str, torch.optim.Optimizer]

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        gamma: float,
        warmup_frames: int,
        buffer_size: int,
        batch_size: int,
        updates_per_frame: float,
    ) -> None:
        super().__init__(specs)
        self.gamma, self.warmup_frames = gamma, warmup_frames
        self.batch_size, self.updates_per_frame = batch_size, updates_per_frame
        self.register_buffer("frames", torch.zeros((), dtype=torch.long))
        self.register_buffer("updates", torch.zeros((), dtype=torch.long))
        self.buffer = ReplayBuffer(storage=LazyTensorStorage(buffer_size, device=device))

    def stateful(self) -> dict[str, Any]:
        """Return the optimisers and the replay buffer."""
        return {**self.optimizers, "buffer": self.buffer}

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Store the batch's transitions; once the warm-up is over, make the updates that are due."""
        rows = self.transitions(batch)[mask]
        if not len(rows):
            return {}
        self.buffer.extend(rows)
        before, self.frames = int(self.frames), self.frames + len(rows)
        frames = int(self.frames)
        if frames < self.warmup_frames:
            return {}
        if before < self.warmup_frames:
            self.start()
        self.explore(frames - self.warmup_frames)
        return self._updates(int(frames * self.updates_per_frame) - int(before * self.updates_per_frame))

    def add_demonstrations(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Store the transitions in `mask`."""
        self.buffer.extend(self.transitions(batch)[mask])

    def update(self, num_updates: int) -> dict[str, float]:
        """Make updates from what is stored."""
        if int(self.frames) == int(self.updates) == 0:
            self.start()
        return self._updates(num_updates)

    def _updates(self, num_updates: int) -> dict[str, float]:
        losses: dict[str, list[Tensor]] = {}
        if num_updates:
            # One draw for all updates: the buffer's own overhead is as long as a forward pass.
            for sample in self.buffer.sample(num_updates * self.batch_size).split(self.batch_size):
                self.updates += 1
                for name, value in self.train_step(sample).items():
                    losses.setdefault(name, []).append(value.detach())
        scalars = {name: torch.stack(values).mean().item() for name, values in losses.items()}
        return {**scalars, "updates": self.updates.item()}

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return what is stored of a batch `[*B, T]`; `discount` is 0 where the step terminated, else gamma."""
        return TensorDict(
            {
                "state": batch[keys.OBSERVATION],
                "discrete": batch[keys.DISCRETE],
                "unit": self.specs.to_unit(batch[keys.PARAMETERS]),
                "reward": batch["next", keys.REWARD].squeeze(-1),
                "next_state": batch["next", keys.OBSERVATION],
                "discount": self.gamma * ~batch["next", keys.TERMINATED].squeeze(-1),
            },
            batch_size=batch.shape,
        )

    def start(self) -> None:
        """Prepare the first update, from what the warm-up stored."""

    def explore(self, frames: int) -> None:
        """Set the policy's exploration, `frames` presses after the warm-up."""

    def train_step(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Make one update from transitions `[batch_size]`; return scalars to log."""
        raise NotImplementedError

    def optimizer_step(self, name: str, loss: Tensor, max_grad_norm: float | None = None) -> None:
        """Take a step of an optimiser, with gradients scaled down to a norm where one is given."""
        optimizer = self.optimizers[name]
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        if max_grad_norm is not None:
            parameters = (parameter for group in optimizer.param_groups for parameter in group["params"])
            nn.utils.clip_grad_norm_(parameters, max_grad_norm)
        optimizer.step()


def linear_schedule(time: int, over: int, final: float) -> float:
    """Return a share that falls in a line from 1 to `final` within a time `over`, in frames or decisions."""
    return 1.0 + (final - 1.0) * min(1.0, time / max(1, over))
