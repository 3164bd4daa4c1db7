"""People's transitions as a TorchRL data set: a replay buffer over memory-mapped files."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from platformdirs import user_cache_path
from tensordict import TensorDict
from torchrl.data import ImmutableDatasetWriter, SliceSampler, TensorStorage
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.data.replay_buffers import Sampler

from hpamdp.data.human.episodes import select
from hpamdp.data.human.errors import HumanDataError
from hpamdp.data.human.export import write_memmap
from hpamdp.data.human.released_file import SHA256, default_path, load_bytes, read
from hpamdp.data.human.transitions import TRAJECTORY, transitions
from hpamdp.env.boatdock.episode import MAX_PRESSES

_FORMAT = 1  # raise it when the transitions of the same file come out differently


def slices(length: int) -> SliceSampler:
    """Return a sampler of `batch_size // length` runs of presses from one episode each.

    An episode of fewer than `length` presses is taken whole, so a batch has `batch_size` rows at most.
    """
    return SliceSampler(slice_len=length, traj_key=TRAJECTORY, strict_length=False, cache_values=True)


def whole_episodes() -> SliceSampler:
    """Return a sampler of `batch_size // MAX_PRESSES` whole episodes, one after another."""
    return slices(MAX_PRESSES)


class HumanExperienceReplay(BaseDatasetExperienceReplay):
    """What people did, sampled by press, slice or episode, in the keys and observations of BoatDockEnv.

    The memory-mapped files are made at first use and shared by every process that asks for the same. Their rows are
    those of `hpamdp.data.human.transitions.transitions`, which says what was filled in where the recording is silent.

    Args:
        batch_size: rows a sample.
        path: the released file; None: where `released_file.default_path` expects it.
        root: folder of the memory-mapped files; None: the user's cache.
        complete, successes, best_people, controller: which episodes, as in `hpamdp.data.human.episodes.select`.
        reward, observation, has_choice: as in `hpamdp.data.human.transitions.transitions`.
        sampler: TorchRL's; None draws presses at random. `slices(length)` and `whole_episodes()` keep them together.
        transform: TorchRL's, run on every sample.
        checksum: the SHA-256 that the file must have; None: any.
        options: further arguments of TorchRL's TensorDictReplayBuffer.

    Raises:
        HumanDataError: the file is not there or not the right one, an argument is wrong, or nothing is left.
    """

    def __init__(
        self,
        batch_size: int | None = None,
        *,
        path: Path | str | None = None,
        root: Path | str | None = None,
        complete: bool = False,
        successes: bool = False,
        best_people: int | None = None,
        controller: str | None = None,
        reward: str = "paper",
        observation: str = "scaled",
        has_choice: bool = True,
        sampler: Sampler | None = None,
        transform: Callable[[TensorDict], TensorDict] | None = None,
        checksum: str | None = SHA256,
        **options: Any,
    ) -> None:
        self.root = user_cache_path("hpamdp") / "datasets" if root is None else root
        which = dict(complete=complete, successes=successes, best_people=best_people, controller=controller)
        form = dict(reward=reward, observation=observation, has_choice=has_choice)
        if checksum is None:
            checksum = hashlib.sha256(load_bytes(default_path() if path is None else Path(path))).hexdigest()
        self._name = _name(checksum=checksum, **which, **form)
        if not self._is_downloaded():
            made = transitions(select(read(path, checksum=checksum, one_frame=True), **which), **form)
            try:
                write_memmap(made, self.data_path)
            except HumanDataError:
                if not self._is_downloaded():  # else another process was faster
                    raise
        storage = TensorStorage(TensorDict.load_memmap(self.data_path))
        super().__init__(
            storage=storage,
            sampler=sampler,
            writer=ImmutableDatasetWriter(),
            batch_size=batch_size,
            transform=transform,
            **options,
        )

    @property
    def data_path_root(self) -> Path:
        """Folder of all data sets."""
        return self.root

    @property
    def data_path(self) -> Path:
        """Folder of this data set's files."""
        return self.root / self._name

    def _is_downloaded(self) -> bool:
        return self.data_path.exists()


def _name(**settings: Any) -> str:
    said = json.dumps({**settings, "format": _FORMAT}, sort_keys=True)
    return f"human-{hashlib.sha256(said.encode()).hexdigest()[:16]}"
