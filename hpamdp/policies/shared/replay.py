"""The base class of the off-policy and offline learners: store transitions, then update from samples of them."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, ReplayBuffer, RoundRobinWriter

from hpamdp import keys
from hpamdp.devices import Device, checked_device
from hpamdp.messages import warn
from hpamdp.observation_entries import packed, unpacked
from hpamdp.policies.base import Bonus, Learner, States, step_discounts
from hpamdp.policies.shared.gradients import Descent, Inputs, LossFunction
from hpamdp.policies.shared.options import REPLAY_CARD, MemoryOptions, ReplayMemoryOptions, ReplayOptions
from hpamdp.policies.shared.perception import Perception
from hpamdp.policies.shared.sequences import HistoryLinks, sample_with_past, states_of_past
from hpamdp.policies.shared.symmetry import RandomSymmetry
from hpamdp.specs import PAMDPSpecs

_STATES = ("state", "next_state")


class ReplayLearner(Learner):
    """A learner with its own replay buffer, which makes `updates_per_step` updates for each step that it stores.

    `learn` stores the steps and calls `update`, which samples and calls `update_once`. A subclass implements this
    method: the algorithm box of its paper. It calls `gradient_step` for each optimizer step. The subclass also makes
    its networks and optimizers, and may extend the other methods:

    - `transitions` or `store`: what the buffer holds;
    - `sample_batches`: what an update sees;
    - `start` and `on_progress`: what happens at the end of the warm-up, and with every batch after it.

    A loss is a method that maps tensors to the loss and to scalars to log. For `compile_updates`, `torch.compile` must
    be able to trace it in one piece, with dicts in place of TensorDicts. A subclass whose losses cannot be traced has
    to refuse it.

    The `target` of a value is `reward + discount * next_value(sample)`, which asks `value`.

    Attributes:
        perception: what the networks see of an observation, if `set_perception` was called; its target copy beside it.
        links: which stored rows precede others, if the memory is recurrent.
        symmetry: maps samples by random symmetries of the problem, with `augment`; else None.
        stores_own_parameters: true if the buffer holds only the parameters of the discrete action that was taken. This
            saves memory where there are many; samples then have 0 for the others. With several components the buffer
            holds all parameters.
        slots: for each discrete action the places of its parameters among all, int64 `[num_discrete, D]`. D is the
            largest of `parameter_dims`; unused places are those of other actions' parameters.
        owner: the discrete action that each parameter belongs to, int64 `[num_parameters]`.
        catches_up: true if the first updates make up for the steps of the warm-up.
        max_grad_norm: largest gradient norm of a gradient step; if None, there is no limit.
        critics: the critics, of learners that have some.
    """

    card = REPLAY_CARD

    progress: ClassVar[frozenset[str]] = Learner.progress | {"last_rows"}
    stores_own_parameters: bool = False
    catches_up: bool = False
    max_grad_norm: float | None = None

    Options: ClassVar[Any]
    options: ReplayOptions
    optimizers: dict[str, torch.optim.Optimizer]
    perception: Perception
    target_perception: Perception
    links: HistoryLinks | None
    critics: Any

    def __init__(self, specs: PAMDPSpecs, *, device: Device = "cpu", options: Any = None, **settings: Any) -> None:
        super().__init__(specs)
        device = checked_device(self, device)
        options = self.options = self.read_options(options, settings)
        self.stores_own_parameters = self.stores_own_parameters and specs.components.is_single
        remembers = isinstance(options, MemoryOptions) and options.memory != "none"
        augment = options.augment
        if augment == "auto":
            augment = specs.symmetries is not None and not remembers
        self.symmetry = RandomSymmetry(specs, device) if augment else None
        self.frames: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))
        self.updates: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))
        self.slots = nn.Buffer(specs.parameter_slots, persistent=False)
        self.owner = nn.Buffer(specs.parameter_owner, persistent=False)
        self.buffer = replay_buffer(options.buffer_size, device)
        self.descent = Descent()
        self.links = None
        self.make_networks(specs)
        self.to(device)
        self.optimizers = self.make_optimizers()

    def read_options(self, options: Any, settings: Mapping[str, Any]) -> ReplayOptions:
        """Return the settings that the constructor was given, as `Settings.of` does."""
        return self.Options.of(options, settings)

    @abstractmethod
    def make_networks(self, specs: PAMDPSpecs) -> None:
        """Make the networks and the policy, from `options`."""
        raise NotImplementedError

    @abstractmethod
    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Return the optimizers of the networks, which are on their device now, by the names of what they learn."""
        raise NotImplementedError

    def set_perception(self, options: ReplayMemoryOptions, *, knows_directions: bool = False) -> None:
        """Make the perception and its target copy; call it before the networks, which are built from its specs."""
        self.perception = Perception(self.specs, options, knows_directions=knows_directions)
        self.target_perception = copy.deepcopy(self.perception).requires_grad_(False)
        self.memory_key = self.perception.memory_key
        self.memory_lasts_an_episode = self.perception.lasts_an_episode
        if self.perception.is_recurrent:
            self.links = HistoryLinks()
            self.burn_in = options.burn_in
            self.num_past = options.burn_in + options.sequence_length

    def stateful(self) -> dict[str, Any]:
        """Return the optimizers and the replay buffer."""
        return {**self.optimizers, "buffer": self.buffer}

    def learn(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Store the batch's transitions; after the warm-up, make the updates that are due."""
        num_steps = int(mask.sum())
        if num_steps == 0:
            return {}
        self.store(batch, mask)
        before, warmup = int(self.frames), self.options.warmup_steps
        steps = before + num_steps
        self.frames = self.frames + num_steps
        if steps < warmup:
            return {}
        if before < max(1, warmup) and int(self.updates) == 0:  # a learner of an earlier run has started already
            self.start()
        self.on_progress(steps - warmup)
        if self.catches_up and before < warmup:
            before = 0
        rate = self.options.updates_per_step
        return self.update(int(steps * rate) - int(before * rate))

    def add_demonstrations(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Store the transitions in `mask`, if there are any; warn if the buffer is too small for all."""
        num, capacity = int(mask.sum()), self.options.buffer_size
        if num > capacity:
            warn(f"low.buffer_size={capacity} keeps the last {capacity:,} of {num:,} steps of the data set")
        if num:
            self.store(batch, mask)

    def update(self, num_updates: int) -> dict[str, float]:
        """Make updates from the stored transitions; do nothing if the buffer is empty."""
        if len(self.buffer) == 0:
            return {}
        if int(self.frames) == int(self.updates) == 0:
            self.start()
        history: dict[str, list[Tensor]] = {}
        for sample in self.sample_batches(num_updates) if num_updates > 0 else ():
            if self.bonus is not None and self.card.novelty_by == "sample":
                sample = self.with_bonus(sample, self.bonus)
            self.updates += 1
            for name, value in self.update_once(sample).items():
                history.setdefault(name, []).append(value.detach())
        scalars = {name: torch.stack(values).mean().item() for name, values in history.items()}
        return {**scalars, "updates": self.updates.item()}

    def with_bonus(self, sample: TensorDictBase, bonus: Bonus) -> TensorDictBase:
        """Return a sample whose rewards include the bonus of the next states, computed with the current novelty."""
        assert bonus.of is not None
        more = self.options.reward_scale * bonus.weight * bonus.of(sample["next_state"])
        return sample.set("reward", sample["reward"] + more)

    @abstractmethod
    def update_once(self, sample: TensorDictBase) -> dict[str, Tensor]:
        """Make one update from a sample of `sample_batches`; return scalars to log."""
        raise NotImplementedError

    def gradient_step(self, name: str, loss_of: LossFunction, *inputs: Inputs) -> dict[str, Tensor]:
        """Take one step of the named optimizer down the gradient of a loss; return the scalars of the loss.

        The settings of the run say whether it is compiled or computed in bfloat16; the gradient is clipped to
        `max_grad_norm`. See `Descent.step`.
        """
        return self.descent.step(self.optimizers[name], loss_of, *inputs, max_grad_norm=self.max_grad_norm)

    def critic_loss(self, sample: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the squared TD error, summed over the critics, and scalars.

        The target is r + discount * V(s'), where V is `value`. A subclass may override `target`, which returns
        it as `[B]`, given a sample with `state`, `discrete`, `unit` (the executed parameters in [-1, 1]), `reward`,
        `next_state` and `discount`. `sample` also has the masks if the problem has any, and the options.
        """
        q = self.critics.of_discrete(self.features(sample), sample["discrete"], sample["unit"])
        loss = (q - self.target(sample)).square().mean(-1).sum()  # q is [num_critics, B]
        return loss, {"critic": loss, "q": q.mean()}

    def compile_updates(self) -> None:
        """Compile the gradients of each loss, at the first gradient step that needs it.

        Raises:
            ValueError: a loss cannot be traced, or this machine cannot compile.
        """
        if self.links is not None:
            self.perception.check_traceable()
        self.descent.compile(self.frames.device, any_size=False, while_compiling=lambda: self.while_compiling())

    def lower_precision(self) -> None:
        """Compute the matrix products of losses and gradients in bfloat16."""
        self.descent.lower_precision()

    def start(self) -> None:
        """Prepare for the first update, from the transitions that the warm-up stored."""

    def on_progress(self, steps: int) -> None:
        """Set what changes with the number of steps after the warm-up, such as exploration and learning rates."""

    def is_untrained(self) -> bool:
        """Return whether no update was made."""
        return int(self.updates) == 0

    def num_updates(self, steps: int) -> int:
        """Return the number of updates within this many steps, the first of which are the warm-up."""
        warmup = self.options.warmup_steps
        if steps < warmup:
            return 0
        return int(self.options.updates_per_step * (steps if self.catches_up else steps - warmup))

    def store(self, batch: TensorDictBase, mask: Tensor) -> None:
        """Add the transitions in `mask` bool `[*B, T]` of a batch `[*B, T]` to the buffer."""
        rows = packed_states(self.linked(self.transitions(batch), batch, mask)[mask], self.specs)
        if self.stores_own_parameters:
            rows["unit"] = rows["unit"].gather(-1, self.slots[rows["discrete"]])
        self.buffer.extend(rows)

    def linked(self, rows: TensorDict, batch: TensorDictBase, mask: Tensor) -> TensorDict:
        """Return the rows `[*B, T]` of a batch with their links, which a recurrent memory follows backwards.

        Call it once for each batch, before those of its rows that are in `mask` are stored in their order.
        """
        if self.links is not None:
            begins = self.perception.begins(batch)
            rows["begins"] = begins
            rows["previous"] = self.links(begins, mask, self.buffer.write_count)
        return rows

    @contextmanager
    def _storing_only(self, batch: TensorDictBase, mask: Tensor) -> Iterator[None]:
        """Let the buffer hold only the transitions in `mask` of a batch `[*B, T]` while the block runs."""
        own = self.buffer
        self.buffer = replay_buffer(batch.numel(), self.frames.device)
        try:
            self.store(batch, mask)
            yield
        finally:
            self.buffer = own

    @torch.no_grad()
    def held_out_losses(self, batch: TensorDictBase, mask: Tensor) -> dict[str, float]:
        """Return the losses of `stored_losses` on transitions that the buffer does not hold, named `held_out_...`."""
        if self.memory_key is not None or not mask.any():
            return {}
        with self._storing_only(batch, mask):
            return {f"held_out_{name}": value.item() for name, value in self.stored_losses().items()}

    def stored_losses(self) -> dict[str, Tensor]:
        """Return the loss on all stored transitions, and its parts. A subclass may implement it; it has no memory."""
        return {}

    def sample_batches(self, num_batches: int) -> Iterator[TensorDictBase]:
        """Yield samples for `num_batches` updates, each with transitions `[batch_size]`."""
        # One call for all updates: the buffer's overhead is as long as a forward pass.
        num = num_batches * self.options.batch_size
        drawn = self.buffer.sample(num) if self.links is None else sample_with_past(self.buffer, num, self.num_past)
        for sample in drawn.split(self.options.batch_size):
            yield self.augmented(self.with_all_parameters(sample))

    def with_all_parameters(self, rows: TensorDictBase) -> TensorDictBase:
        """Return stored rows `[B]` with their states as observations and all actions' parameters, changed in place."""
        rows = unpacked_states(rows, self.specs)
        if self.stores_own_parameters:
            rows["unit"] = self._all_parameters(rows["discrete"], rows["unit"])
        return rows

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

        `unit` holds the parameters, mapped from their bounds to [-1, 1]. `discount` is 0 if the step terminated;
        otherwise it is the discount from `step_discounts`, or `gamma` if the learner does not count durations.
        """
        goes_on = (~batch["next", keys.TERMINATED]).float()
        discount = step_discounts(batch, self.options.gamma) if self.card.counts_durations else self.options.gamma
        rows = TensorDict(
            {
                "state": batch[keys.OBSERVATION],
                "discrete": batch[keys.DISCRETE],
                "unit": self.specs.to_unit(batch[keys.PARAMETERS], batch),
                "reward": self.options.reward_scale * batch["next", keys.REWARD].squeeze(-1),
                "next_state": batch["next", keys.OBSERVATION],
                "discount": (discount * goes_on).squeeze(-1),
            },
            batch_size=batch.shape,
        )
        if self.specs.has_action_mask:
            everything = torch.ones(*batch.shape, self.specs.num_discrete, dtype=torch.bool, device=self.frames.device)
            rows["action_mask"] = batch.get(keys.ACTION_MASK, everything)
            rows["next_action_mask"] = batch.get(("next", keys.ACTION_MASK), everything)
        if self.specs.has_pair_mask:
            rows["pair_mask"] = batch[keys.PAIR_MASK]
        if self.memory_key is not None:
            rows["memory"] = batch.get(self.memory_key)
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
        learner: the selector has learned since. If the selector's policy is stochastic, it is the expected value.
        """
        mask = sample["next_action_mask"] if self.specs.has_action_mask else None
        states = States(sample["next_state"], mask, self.last_memory(sample), self.memory_key)
        value = self.value(states, is_target=True)
        if "option_ended" not in sample.keys():
            return value
        is_ended = sample["option_ended"] | self.next_options.decides_ends
        if is_ended.any():
            states, held = states.at(is_ended), sample["option"][is_ended]

            def value_under(option: Tensor) -> Tensor:
                memory = None if states.memory is None else self._memory_of_next(states.memory, option == held)
                return self.next_options.value(states._replace(memory=memory), option)

            probabilities = self.next_options.probabilities(states.observation)
            if probabilities is None:
                chosen = self.next_options.choose(states.observation, sample["next_option"][is_ended], held)
                value[is_ended] = value_under(chosen)
            else:
                options = (torch.full_like(held, i) for i in range(probabilities.shape[-1]))
                values = torch.stack([value_under(option) for option in options], -1)
                value[is_ended] = (probabilities * values).sum(-1)
        return value

    def last_memory(self, sample: TensorDictBase) -> Tensor | None:
        """Return the target's memory before a sample's next states, `[B, size]`; None without memory."""
        if "last_memory" in sample.keys():
            return sample["last_memory"]
        return self.memory_of(sample, self.target_perception) if self.memory_key is not None else None

    def _memory_of_next(self, memory: Tensor, is_same: Tensor) -> Tensor:
        """Return the memories with which the next options begin: empty ones, if each option has its own learner.

        Args:
            memory: the target's memories before, `[N, size]`.
            is_same: whether the next option is the held one, bool `[N]`. If the selector decides where options end,
                such an option continues, and keeps its memory.
        """
        if self.perception.lasts_an_episode:
            return memory
        goes_on = is_same if self.next_options.decides_ends else torch.zeros_like(is_same)
        return torch.where(goes_on.unsqueeze(-1), memory, 0.0)

    def features(self, sample: TensorDictBase) -> Tensor:
        """Return what the networks see of a sample's states, `[B, perception.specs.observation_dim]`."""
        memory = self.memory_of(sample, self.perception)
        return self.perception(sample["state"], memory, has_seen=True)

    def memory_of(self, sample: TensorDictBase, perception: Perception) -> Tensor | None:
        """Return the memory's states after a sample's states, `[B, size]`, by a perception; None without memory."""
        if self.links is not None:
            return states_of_past(sample, perception, self.burn_in)
        return None if self.memory_key is None else sample["memory"]

    @torch.no_grad()
    def detached(self, sample: TensorDictBase) -> Tensor:
        """Return `features` for an actor, whose loss does not train the perception."""
        return self.features(sample)

    def allowed(self, sample: TensorDictBase) -> Tensor | None:
        """Return which discrete actions may be taken in a sample's states, bool `[B, num_discrete]`. If None, all."""
        return self.specs.allowed(sample["state"], sample.get("action_mask", None))

    def fixed(self, sample: TensorDictBase) -> Tensor | None:
        """Return which parameters have a single value in a sample's states, see `PAMDPSpecs.is_fixed`."""
        return self.specs.is_fixed(sample["state"])

    def pairs(self, sample: TensorDictBase) -> Tensor | None:
        """Return which discrete actions go together in a sample's states, as in `pair_mask`. If None, all do."""
        return sample.get("pair_mask", None)


def replay_buffer(capacity: int, device: torch.device) -> ReplayBuffer:
    """Return an empty ring buffer.

    By default TorchRL counts the stored rows in 32 bits. After 2^31 rows the count would be negative, and with it the
    numbers of the rows that `HistoryLinks` follows and that a checkpoint restores. A compilable writer has no limit.
    """
    return ReplayBuffer(storage=LazyTensorStorage(capacity, device=device), writer=RoundRobinWriter(compilable=True))


def packed_states(rows: TensorDictBase, specs: PAMDPSpecs) -> TensorDictBase:
    """Return rows with their states in the form to store; they are changed in place.

    Pictures beside vectors come as float32. As bytes they take a quarter of the memory.
    """
    if _packs(specs):
        for name in _STATES:
            rows.set(name, packed(rows[name], specs.entries))
    return rows


def unpacked_states(rows: TensorDictBase, specs: PAMDPSpecs) -> TensorDictBase:
    """Return stored rows with their states as observations; they are changed in place."""
    if _packs(specs):
        for name in (*_STATES, "past"):
            if name in rows.keys():
                rows.set(name, unpacked(rows[name], specs.entries))
    return rows


def _packs(specs: PAMDPSpecs) -> bool:
    return specs.has_pictures and specs.observation_dtype == torch.float32
