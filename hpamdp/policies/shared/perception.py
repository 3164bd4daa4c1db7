"""What a learner's networks see of an observation: the observation itself, or features of it and of its history."""

from __future__ import annotations

from dataclasses import replace

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.policies.base import States
from hpamdp.policies.encoders.base import JoinedEncoders
from hpamdp.policies.shared.known_directions import KnownDirections
from hpamdp.policies.shared.memory import GRU, Stack
from hpamdp.policies.shared.options import MemoryOptions, StackOptions
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs


class Perception(nn.Module):
    """Turns a learner's observations into the features that its networks see.

    An encoder makes features of pictures, and a memory adds what it remembers of earlier observations. Without pictures
    and memory, features are the observations themselves, and nothing is computed. Features end as the observation does,
    so a shared learner's one-hot option stays at the end. The networks are built from `specs`.

    An on-policy learner trains it with its whole loss. A learner with a replay buffer trains it with the critics' loss
    alone, and has a target copy beside the target critics; actors see detached features.

    The history that a memory remembers begins with the option if each option has its own learner. The policy of a
    semi-Markov option depends on what happened since the option began (Sutton, Precup and Singh 1999, *Between MDPs and
    semi-MDPs*). If one learner serves all options, or the problem has no options, the history begins with the episode.

    Args:
        specs: of the problem, as the learner sees it.
        options: settings of the memory. If None, there is no memory.
        prefix: of the key of the memory's state in a step.
        knows_directions: whether it remembers the directions of actions that the problem reveals, for an episode.
            Another memory must not be set.

    Attributes:
        specs: those of the problem, with the features as observation.
        is_plain: whether features are the observations themselves.
        encoder: encodes pictures; None without pictures.
        memory: remembers earlier observations; None without a memory.
        memory_key: key of the memory's state in a step; None without a memory.
        in_keys: what `see` reads of a step.
        out_keys: what `see` writes.
    """

    def __init__(
        self,
        specs: PAMDPSpecs,
        options: StackOptions | None = None,
        prefix: str = "",
        *,
        knows_directions: bool = False,
    ) -> None:
        super().__init__()
        self.memory: Stack | GRU | KnownDirections | None = None
        self.memory_key: str | None = None
        self.encoder = JoinedEncoders(specs) if specs.has_pictures else None
        self.specs = specs if self.encoder is None else self.encoder.feature_specs
        self.in_keys: list[NestedKey] = [keys.OBSERVATION]
        self.out_keys: list[NestedKey] = []
        is_shared = specs.num_options > 0 and specs.held_option is None
        self._begins_key = keys.EPISODE_STEPS if is_shared else keys.IS_DECISION
        if options is not None and options.memory != "none":
            num = self.specs.observation_dim
            if options.memory == "stack" and self.encoder is not None:
                raise SettingError(
                    "memory=stack: does not go with pictures, whose encoder changes in training; use memory=gru, or "
                    "stack pictures in the environment (gymnasium.wrappers.FrameStackObservation)"
                )
            if isinstance(options, MemoryOptions) and options.memory == "gru":
                self.memory = GRU(num, options.memory_size)
            else:
                self.memory = Stack(num, options.stack_steps)
        elif knows_directions:
            self.memory = KnownDirections(specs)
            self._begins_key = keys.EPISODE_STEPS
        if self.memory is not None:
            self.memory_key = prefix + self.memory.name
            self.in_keys += [self._begins_key, self.memory_key]
            self.out_keys += [self.memory_key]
            self.specs = _of_features(self.specs, self.memory.num_features)
        self.is_plain = self.memory is None and self.encoder is None

    @property
    def lasts_an_episode(self) -> bool:
        """Whether a history is an episode, and not an option."""
        return self._begins_key == keys.EPISODE_STEPS

    def check_traceable(self) -> None:
        """Refuse a recurrent memory in compiled updates.

        Raises:
            ValueError: there is one.
        """
        if self.is_recurrent:
            raise ValueError("memory=gru is PyTorch's GRU, which torch.compile cannot trace; use memory=stack")

    @property
    def is_recurrent(self) -> bool:
        """Whether gradients flow back in time."""
        return self.memory is not None and self.memory.is_recurrent

    def see(self, td: TensorDictBase) -> Tensor:
        """Return the features `[*B, specs.observation_dim]` of a step, and write the memory's new state into it."""
        features, states = self.features_and_memory(td)
        for name, state in states.items():
            td.set(name, state)
        return features

    def features_and_memory(self, td: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the features of a step, and the memory's new state under `memory_key`; empty without a memory."""
        encoded = self.encoded(td.get(keys.OBSERVATION))
        if self.memory is None or self.memory_key is None:
            return encoded, {}
        held = td.get(self.memory_key, None)
        if held is not None and self._begins_key in td.keys():
            held = torch.where(self.begins(td).unsqueeze(-1), 0.0, held)
        state = self._after(encoded, held)
        return self.memory.features(encoded, state), {self.memory_key: state}

    def encoded(self, observation: Tensor) -> Tensor:
        """Return what the memory sees of observations `[*B, *]`: the encoder's features, or the observations."""
        return observation if self.encoder is None else self.encoder(observation)

    def begins(self, td: TensorDictBase) -> Tensor:
        """Return where a history begins, bool `[*B]`."""
        begins = td.get(self._begins_key).squeeze(-1)
        return begins == 0 if self.lasts_an_episode else begins

    def forward(self, observation: Tensor, memory: Tensor | None = None, *, has_seen: bool = False) -> Tensor:
        """Return the features `[*B, specs.observation_dim]` of observations `[*B, *]`.

        Args:
            observation: the observations.
            memory: the memory's states `[*B, size]`. If None, an empty memory.
            has_seen: whether `memory` holds the states after the observations, as steps do. If false, it holds the
                states before them.
        """
        encoded = self.encoded(observation)
        if self.memory is None:
            return encoded
        state = memory if has_seen and memory is not None else self._after(encoded, memory)
        return self.memory.features(encoded, state)

    def of_states(self, states: States) -> Tensor:
        """Return the features `[N, specs.observation_dim]` of states `[N]`."""
        return self(states.observation, states.memory, has_seen=states.has_seen)

    def after(self, observation: Tensor, memory: Tensor | None = None) -> Tensor:
        """Return the memory's states `[*B, size]` after observations `[*B, *]`, given the states before.

        Without states before, the memory is empty.
        """
        return self._after(self.encoded(observation), memory)

    def imagined(self, features: Tensor, observation: Tensor) -> Tensor:
        """Return the features `[*B, specs.observation_dim]` that follow from others when observations `[*B, *]` come.

        A model predicts these observations, so they have no pictures.
        """
        if self.memory is None:
            return observation
        if isinstance(self.memory, KnownDirections):
            return self.memory.imagined(features, observation)
        return self.memory.features(observation, self._after(observation, self.memory.state_in(features)))

    def _after(self, encoded: Tensor, memory: Tensor | None = None) -> Tensor:
        """Return what `after` does, given encoded observations `[*B, *]`."""
        assert self.memory is not None
        if memory is None:
            memory = encoded.new_zeros(*encoded.shape[:-1], self.memory.size, dtype=torch.float32)
        shape = encoded.shape[:-1]
        state = self.memory.step(encoded.reshape(-1, encoded.shape[-1]), memory.reshape(-1, self.memory.size))
        return state.reshape(*shape, self.memory.size)

    def states(self, observations: Tensor, memory: Tensor, has_seen: Tensor) -> Tensor:
        """Return a recurrent memory's states `[N, L, size]` after each step of sequences.

        Args:
            observations: `[N, L, observation_dim]`.
            memory: the states to start from, `[N, size]`.
            has_seen: whether these are the states after the first observation, or before it; bool `[N]`.
        """
        return self._states(self.encoded(observations), memory, has_seen)

    def _states(self, encoded: Tensor, memory: Tensor, has_seen: Tensor) -> Tensor:
        assert isinstance(self.memory, GRU)
        first = self.memory.step(encoded[:, 0], memory)
        first = torch.where(has_seen.unsqueeze(-1), memory, first)
        if encoded.shape[1] == 1:
            return first.unsqueeze(1)
        return torch.cat([first.unsqueeze(1), self.memory.unrolled(encoded[:, 1:], first)], 1)

    def of_sequences(self, observation: Tensor, memory: Tensor, begins: Tensor, starts: Tensor) -> Tensor:
        """Return the features `[N, specs.observation_dim]` of rows that form sequences, one sequence after another.

        A sequence starts from the stored state of its first row, or from an empty memory if a history begins there.

        Args:
            observation: `[N, observation_dim]`.
            memory: the stored states after these observations, `[N, size]`.
            begins: where a history begins, bool `[N]`.
            starts: where a sequence starts, bool `[N]`; true for the first row.
        """
        assert self.memory is not None
        # Of each row, the number of its sequence and its place in it.
        sequence = starts.long().cumsum(0) - 1
        lengths = sequence.bincount()
        first = lengths.cumsum(0) - lengths
        place = torch.arange(len(sequence), device=sequence.device) - first[sequence]
        encoded = self.encoded(observation)
        padded = encoded.new_zeros(len(lengths), int(lengths.max()), encoded.shape[-1])
        padded[sequence, place] = encoded
        is_fresh = begins[first]
        states = self._states(padded, torch.where(is_fresh.unsqueeze(-1), 0.0, memory[first]), ~is_fresh)
        return self.memory.features(encoded, states[sequence, place])


def _of_features(specs: PAMDPSpecs, num_features: int) -> PAMDPSpecs:
    """Return the specs of features that end in the observation."""
    weight, num_more = specs.initial_weight, num_features - specs.observation_dim
    if weight is not None:
        weight = tuple((*[0.0] * num_more, *row) for row in weight)
    return replace(specs, observation_dim=num_features, initial_weight=weight, symmetries=None, geometry=None)
