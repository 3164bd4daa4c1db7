"""The base class of the off-policy and offline learners: store transitions, then update from samples of them."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import LazyTensorStorage, ReplayBuffer

from hpamdp import keys
from hpamdp.policies.base import Learner
from hpamdp.policies.shared.frame import RandomSymmetry
from hpamdp.policies.shared.gradients import Descent, Inputs, LossFunction
from hpamdp.specs import PAMDPSpecs


class ReplayLearner(Learner):
    """A learner with its own replay buffer, which makes `updates_per_frame` updates for each step that it stores.

    A subclass fills `optimizers` and implements `train_step`. It may extend the other methods:

    - `transitions` or `store`: what the buffer holds;
    - `sample_batches`: what an update sees;
    - `start` and `explore`: what happens at the end of the warm-up, and with every batch after it;
    - `updates_due`: when updates are made.

    Losses are given to `minimise` as methods. For `compile_updates` they must be such that `torch.compile` can trace
    them in one piece, with dicts in the place of TensorDicts; a subclass with others has to refuse it.

    The `target` of a value is `reward + discount * next_value(sample)`, which asks `value`.

    Attributes:
        symmetry: maps samples by random symmetries of the problem, with `augment`; else None.
        stores_own_parameters: whether the buffer holds the parameters of the discrete action taken alone, which is less
            where there are many; samples then have 0 for the others.
        reward_scale: factor on the rewards that are stored.
    """

    modes: ClassVar[tuple[str, ...]] = ("train", "offline")
    stores_own_parameters: bool = False
    reward_scale: float = 1.0

    optimizers: dict[str, torch.optim.Optimizer]
    frames: Tensor
    updates: Tensor
    slots: Tensor
    owner: Tensor

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
        augment: bool = False,
    ) -> None:
        if batch_size > buffer_size:
            raise ValueError(f"batch_size={batch_size}: must be at most {buffer_size=}")
        if updates_per_frame > 1000.0:
            raise ValueError(f"updates_per_frame={updates_per_frame}: must be at most 1000")
        super().__init__(specs)
        self.gamma = gamma
        self.warmup_frames = warmup_frames
        self.batch_size = batch_size
        self.updates_per_frame = updates_per_frame
        self.symmetry = RandomSymmetry(specs, device) if augment else None
        self.register_buffer("frames", torch.zeros((), dtype=torch.long))
        self.register_buffer("updates", torch.zeros((), dtype=torch.long))
        self.register_buffer("slots", specs.parameter_slots, persistent=False)
        self.register_buffer("owner", specs.parameter_owner, persistent=False)
        self.buffer = ReplayBuffer(storage=LazyTensorStorage(buffer_size, device=device))
        self.descent = Descent()

    def stateful(self) -> dict[str, Any]:
        """Return the optimizers and the replay buffer."""
        return {**self.optimizers, "buffer": self.buffer}

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Store the batch's transitions; after the warm-up, make the updates that are due."""
        num_steps = int(mask.sum())
        if num_steps == 0:
            return {}
        self.store(batch, mask)
        before = int(self.frames)
        frames = before + num_steps
        self.frames = self.frames + num_steps
        if frames < self.warmup_frames:
            return {}
        if before < self.warmup_frames and int(self.updates) == 0:  # a learner of an earlier run has started already
            self.start()
        self.explore(frames - self.warmup_frames)
        return self._make_updates(self.updates_due(before, frames))

    def compile_updates(self) -> None:
        """Compile what `minimise` does but for the optimizer's step, each loss at the first update that needs it."""
        self.descent.compile(self.frames.device, any_size=False)

    def lower_precision(self) -> None:
        """Have the matrix products of what `minimise` does in bfloat16."""
        self.descent.lower_precision()

    def add_demonstrations(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Store the transitions in `mask`, if there are any."""
        if mask.any():
            self.store(batch, mask)

    def update(self, num_updates: int) -> dict[str, float]:
        """Make updates from the stored transitions; none if a data set has no transitions for this learner."""
        if len(self.buffer) == 0:
            return {}
        if int(self.frames) == int(self.updates) == 0:
            self.start()
        return self._make_updates(num_updates)

    def _make_updates(self, num_updates: int) -> dict[str, float]:
        history: dict[str, list[Tensor]] = {}
        if num_updates > 0:
            for sample in self.sample_batches(num_updates):
                self.updates += 1
                for name, value in self.train_step(sample).items():
                    history.setdefault(name, []).append(value.detach())
        scalars = {name: torch.stack(values).mean().item() for name, values in history.items()}
        return {**scalars, "updates": self.updates.item()}

    def is_untrained(self) -> bool:
        """Return whether no update was made."""
        return int(self.updates) == 0

    def steps_to_update(self) -> dict[str, int]:
        """Return the length of the warm-up and the number of steps for one update."""
        needed = {"warmup_frames": self.warmup_frames}
        if self.updates_per_frame > 0.0:
            needed["updates_per_frame"] = first_multiple(self.updates_per_frame)
        return needed

    def updates_due(self, before: int, frames: int) -> int:
        """Return how many updates to make when the number of stored steps has risen from `before` to `frames`."""
        return int(frames * self.updates_per_frame) - int(before * self.updates_per_frame)

    def store(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Add the transitions in `mask` bool `[*B, T]` of a batch `[*B, T]` to the buffer."""
        rows = self.transitions(batch)[mask]
        if self.stores_own_parameters:
            rows["unit"] = rows["unit"].gather(-1, self.slots[rows["discrete"]])
        self.buffer.extend(rows)

    def replay_rows(self, batch: TensorDictBase) -> dict[str, TensorDictBase]:
        """Return the rows that the buffer would store of a batch `[*B, T]`."""
        own = self.buffer
        self.buffer = ReplayBuffer(storage=LazyTensorStorage(batch.numel(), device=self.frames.device))
        try:
            self.store(batch, torch.ones(batch.shape, dtype=torch.bool, device=self.frames.device))
            return {"buffer": self.buffer[:]}
        finally:
            self.buffer = own

    def sample_batches(self, num_batches: int) -> Iterator[TensorDictBase]:
        """Yield samples for `num_batches` updates, each with transitions `[batch_size]`."""
        # One call for all updates: the buffer's overhead is as long as a forward pass.
        for sample in self.buffer.sample(num_batches * self.batch_size).split(self.batch_size):
            if self.stores_own_parameters:
                sample = sample.set("unit", self._all_parameters(sample["discrete"], sample["unit"]))
            yield self.augmented(sample)

    def augmented(self, sample: TensorDictBase) -> TensorDictBase:
        """Return a sample `[N, *]` with each row mapped by a random symmetry of the problem, if `augment` is set."""
        return sample if self.symmetry is None else self.symmetry(sample)

    def _all_parameters(self, discrete: Tensor, own: Tensor) -> Tensor:
        """Return parameters `[B, num_parameters]`, 0 but for the discrete actions' own `[B, max(parameter_dims)]`."""
        slots = self.slots[discrete]
        is_own = self.owner[slots] == discrete.unsqueeze(-1)
        return own.new_zeros(len(own), self.specs.num_parameters).scatter(-1, slots, own * is_own)

    def transitions(self, batch: TensorDictBase) -> TensorDict:
        """Return what is stored of a batch `[*B, T]`, with scaled rewards.

        `discount` is 0 where the step terminated, else gamma.
        """
        rows = TensorDict(
            {
                "state": batch[keys.OBSERVATION],
                "discrete": batch[keys.DISCRETE],
                "unit": self.specs.to_unit(batch[keys.PARAMETERS]),
                "reward": self.reward_scale * batch["next", keys.REWARD].squeeze(-1),
                "next_state": batch["next", keys.OBSERVATION],
                "discount": self.gamma * (~batch["next", keys.TERMINATED]).squeeze(-1).float(),
            },
            batch_size=batch.shape,
        )
        if self.specs.has_action_mask:
            everything = torch.ones(*batch.shape, self.specs.num_discrete, dtype=torch.bool, device=self.frames.device)
            rows["action_mask"] = batch.get(keys.ACTION_MASK, everything)
            rows["next_action_mask"] = batch.get(("next", keys.ACTION_MASK), everything)
        option_ended = batch.get(("next", keys.OPTION_ENDED), None)
        if option_ended is not None:
            rows["option_ended"] = option_ended.squeeze(-1)
            rows["option"] = batch[keys.OPTION]
            rows["next_option"] = batch[keys.NEXT_OPTION]
        return rows

    @torch.no_grad()
    def target(self, sample: TensorDictBase) -> Tensor:
        """Return r + discount V(s'), `[B]`, where the discount is 0 after a termination."""
        return sample["reward"] + sample["discount"] * self.next_value(sample)

    def next_value(self, sample: TensorDictBase) -> Tensor:
        """Return the values `[B]` of a sample's next states.

        Where an option has ended, it is the value under the option that the selector would choose now, by that option's
        learner: the selector has learned since.
        """
        state = sample["next_state"]
        masks = [sample["next_action_mask"]] if self.specs.has_action_mask else []
        value = self.value(state, *masks)
        if "option_ended" not in sample.keys():
            return value
        is_ended = sample["option_ended"] | self.next_options.decides_ends
        if is_ended.any():
            state = state[is_ended]
            option = self.next_options.choose(state, sample["next_option"][is_ended], sample["option"][is_ended])
            value[is_ended] = self.next_options.value(state, option, *(mask[is_ended] for mask in masks))
        return value

    def allowed(self, sample: TensorDictBase) -> Tensor | None:
        """Return which discrete actions may be taken in a sample's states, bool `[B, num_discrete]`; None: all."""
        return self.specs.allowed(sample["state"], sample.get("action_mask", None))

    def start(self) -> None:
        """Prepare for the first update, from the transitions that the warm-up stored."""

    def explore(self, frames: int) -> None:
        """Set the policy's exploration for `frames` steps after the warm-up."""

    @abstractmethod
    def train_step(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Make one update from a sample of `sample_batches`; return scalars to log."""
        raise NotImplementedError

    def minimise(
        self, name: str, loss_of: LossFunction, *inputs: Inputs, max_grad_norm: float | None = None
    ) -> dict[str, Tensor]:
        """Take one step of the named optimizer down the gradient of a loss, see `Descent.step`; return its scalars."""
        return self.descent.step(self.optimizers[name], loss_of, *inputs, max_grad_norm=max_grad_norm)


def set_learning_rates(
    optimizers: Mapping[str, torch.optim.Optimizer], rates: Mapping[str, float], fraction: float
) -> None:
    """Set the learning rate of each optimizer to a fraction of the rate of the same name."""
    for name, rate in rates.items():
        for group in optimizers[name].param_groups:
            group["lr"] = rate * fraction


def first_multiple(updates_per_step: float) -> int:
    """Return the number of steps, or of decisions, at which the first update is due."""
    return math.ceil(1.0 / updates_per_step - 1e-9)


def linear_schedule(time: int, over: int, final: float) -> float:
    """Return a fraction that falls linearly from 1 to `final` within a time `over`, in steps or decisions."""
    return 1.0 + (final - 1.0) * min(1.0, time / max(1, over))
