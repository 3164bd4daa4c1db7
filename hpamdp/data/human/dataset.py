"""People's transitions as a TorchRL data set: a replay buffer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tensordict import TensorDict
from torchrl.data import ImmutableDatasetWriter, SliceSampler, TensorDictReplayBuffer, TensorStorage
from torchrl.data.replay_buffers import Sampler

from hpamdp.data.human.episodes import select
from hpamdp.data.human.options import SHA256
from hpamdp.data.human.released_file import read
from hpamdp.data.human.transitions import transitions
from hpamdp.data.row_checks import TRAJECTORY
from hpamdp.env.boatdock.task import MAX_PRESSES, ObservationForm, RewardForm


def slices(length: int) -> SliceSampler:
    """Return a sampler of `batch_size // length` slices, each of `length` successive presses of one episode.

    Shorter episodes are sampled whole, so a batch can have fewer than `batch_size` rows.
    """
    return SliceSampler(slice_len=length, traj_key=TRAJECTORY, strict_length=False, cache_values=True)


def whole_episodes() -> SliceSampler:
    """Return a sampler of `batch_size // MAX_PRESSES` whole episodes, one after another."""
    return slices(MAX_PRESSES)


class HumanExperienceReplay(TensorDictReplayBuffer):
    """The recorded presses, sampled by press, slice or episode, in the keys and observations of BoatDockEnv.

    The rows come from `hpamdp.data.human.transitions`, which also explains the values that it fills in.

    Args:
        batch_size: rows in a sample.
        path: the released file. If None, `released_file.default_path`.
        complete, successes, best_people, controller: conditions on episodes, as in
            `hpamdp.data.human.episodes.select`.
        reward, observation, has_choice: as in `hpamdp.data.human.transitions.transitions`.
        sampler: a TorchRL sampler. If None, it samples presses at random. `slices(length)` and `whole_episodes()` keep
            successive presses together.
        transform: a TorchRL transform, applied to every sample.
        checksum: the SHA-256 that the file must have. If None, any file is accepted.
        buffer_arguments: further arguments of TorchRL's TensorDictReplayBuffer.

    Raises:
        DataError: the file is missing or has another checksum; an argument is out of range; or no episode or no
            press is left.
    """

    def __init__(
        self,
        batch_size: int | None = None,
        *,
        path: Path | str | None = None,
        complete: bool = False,
        successes: bool = False,
        best_people: int | None = None,
        controller: str | None = None,
        reward: RewardForm = "paper",
        observation: ObservationForm = "scaled",
        has_choice: bool = True,
        sampler: Sampler | None = None,
        transform: Callable[[TensorDict], TensorDict] | None = None,
        checksum: str | None = SHA256,
        **buffer_arguments: Any,
    ) -> None:
        data = select(
            read(path, checksum=checksum, one_frame=True),
            complete=complete,
            successes=successes,
            best_people=best_people,
            controller=controller,
        )
        rows = transitions(data, reward=reward, observation=observation, has_choice=has_choice)
        super().__init__(
            storage=TensorStorage(rows),
            sampler=sampler,
            writer=ImmutableDatasetWriter(),
            batch_size=batch_size,
            transform=transform,
            **buffer_arguments,
        )
