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

from hpamdp.data import DataError, memmap
from hpamdp.data.export import write_memmap
from hpamdp.data.human.episodes import check_conditions, select
from hpamdp.data.human.options import SHA256
from hpamdp.data.human.released_file import check_sum, default_path, load_bytes, read
from hpamdp.data.human.transitions import transitions
from hpamdp.data.row_checks import TRAJECTORY, check_actions, check_transitions
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.task import MAX_PRESSES, ObservationForm, RewardForm
from hpamdp.messages import as_code, reason_of
from hpamdp.specs import PAMDPSpecs

_FORMAT = 1  # increase it if the transitions of the same file change


def slices(length: int) -> SliceSampler:
    """Return a sampler of `batch_size // length` slices, each of `length` successive presses of one episode.

    Shorter episodes are sampled whole, so a batch can have fewer than `batch_size` rows.
    """
    return SliceSampler(slice_len=length, traj_key=TRAJECTORY, strict_length=False, cache_values=True)


def whole_episodes() -> SliceSampler:
    """Return a sampler of `batch_size // MAX_PRESSES` whole episodes, one after another."""
    return slices(MAX_PRESSES)


class HumanExperienceReplay(BaseDatasetExperienceReplay):
    """The recorded presses, sampled by press, slice or episode, in the keys and observations of BoatDockEnv.

    The rows come from `hpamdp.data.human.transitions`, which also explains the values that it fills in. The first use
    makes memory-mapped files. All processes that ask for the same rows share them.

    Args:
        batch_size: rows in a sample.
        path: the released file, which must exist if it is given. If None, `released_file.default_path`, which is read
            if there are no memory-mapped files yet.
        root: folder of the memory-mapped files. If None, the user's cache.
        complete, successes, best_people, controller: conditions on episodes, as in
            `hpamdp.data.human.episodes.select`.
        reward, observation, has_choice: as in `hpamdp.data.human.transitions.transitions`.
        sampler: a TorchRL sampler. If None, it samples presses at random. `slices(length)` and `whole_episodes()` keep
            successive presses together.
        transform: a TorchRL transform, applied to every sample.
        checksum: the SHA-256 that the file must have. If None, any file is accepted.
        buffer_arguments: further arguments of TorchRL's TensorDictReplayBuffer.

    Raises:
        DataError: the file is missing or has another checksum; an argument is of another type or out of range; no
            episode or no press is left; or `root` has files with other rows.
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
        reward: RewardForm = "paper",
        observation: ObservationForm = "scaled",
        has_choice: bool = True,
        sampler: Sampler | None = None,
        transform: Callable[[TensorDict], TensorDict] | None = None,
        checksum: str | None = SHA256,
        **buffer_arguments: Any,
    ) -> None:
        check_conditions(complete, successes, best_people, controller)
        if not isinstance(has_choice, bool):
            raise DataError(f"has_choice={as_code(has_choice)}, but must be True or False")
        for name, given in (("path", path), ("root", root)):
            if not isinstance(given, str | Path | None):
                raise DataError(f"{name}={as_code(given)}, but must be a path or None")
        self.root = user_cache_path("hpamdp") / "datasets" if root is None else Path(root)
        if checksum is None:
            checksum = hashlib.sha256(load_bytes(default_path() if path is None else Path(path))).hexdigest()
        elif path is not None:
            check_sum(load_bytes(Path(path)), checksum, Path(path))
        self._name = _name(
            checksum=checksum,
            complete=complete,
            successes=successes,
            best_people=best_people,
            controller=controller,
            reward=reward,
            observation=observation,
            has_choice=has_choice,
        )
        if not self._is_downloaded():
            data = select(
                read(path, checksum=checksum, one_frame=True),
                complete=complete,
                successes=successes,
                best_people=best_people,
                controller=controller,
            )
            rows = transitions(data, reward=reward, observation=observation, has_choice=has_choice)
            try:
                write_memmap(rows, self.data_path)
            except DataError:
                if not self._is_downloaded():  # otherwise another process has just written the files
                    raise
        super().__init__(
            storage=TensorStorage(self._checked_rows(reward, observation, has_choice)),
            sampler=sampler,
            writer=ImmutableDatasetWriter(),
            batch_size=batch_size,
            transform=transform,
            **buffer_arguments,
        )

    @property
    def data_path_root(self) -> Path:
        """Folder of all data sets."""
        return self.root

    @property
    def data_path(self) -> Path:
        """Folder of this data set's files."""
        return self.root / self._name

    def _checked_rows(self, reward: RewardForm, observation: ObservationForm, has_choice: bool) -> TensorDict:
        """Load and check the rows, because another program may have written the files."""
        controller = "choose" if has_choice else "random"
        env = BoatDockEnv(1, controller=controller, reward=reward, observation=observation)
        try:
            rows = memmap.load(self.data_path)
            check_transitions(rows)
            check_actions(rows, PAMDPSpecs.from_env(env))
        except DataError as error:
            raise DataError(f"{error}; remove {self.data_path}, and the next call makes it again") from error
        return rows

    def _is_downloaded(self) -> bool:
        try:
            return self.data_path.exists()
        except OSError as error:
            raise DataError(f"{self.data_path}: {reason_of(error)}") from error


def _name(**settings: Any) -> str:
    """Return the name of the folder for the rows of these settings."""
    text = json.dumps({**settings, "format": _FORMAT}, sort_keys=True)
    return f"human-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
