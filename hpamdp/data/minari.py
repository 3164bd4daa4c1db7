"""Transitions to and from Minari, the offline data sets of the Gymnasium ecosystem (extra `minari`).

TorchRL's `MinariExperienceReplay` reads Minari data sets too, but keeps Minari's names of the actions and infos, and
has no `is_decision`, which selectors learn from.

Actions are a Dict with the names of a `MinariLayout`, or the field's nested tuple, `(discrete action, (parameters of
action 0, ..., of action K-1))`, where the environment has that. Observations are vectors, also those of pictures, since
Minari stores pictures as JPEG, which changes them.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.data import DataError
from hpamdp.data.demonstrations import Demonstrations
from hpamdp.data.export import check_room
from hpamdp.data.options import CARDS, MinariOptions
from hpamdp.data.row_checks import TRAJECTORY, check_transitions
from hpamdp.env.registration import problem_of
from hpamdp.files import read_regular
from hpamdp.json_lines import MAX_LINE_BYTES, read_json
from hpamdp.messages import first_line, reason_of

if TYPE_CHECKING:
    import minari

    from hpamdp.env.base import PAMDPEnv

_LAYOUT = "hpamdp_layout"  # in the metadata
_BYTES_AN_EPISODE = 40_000  # upper bound of the names and descriptions in HDF5
_SPACES = ("observation_space", "action_space")  # in the metadata
# What learners read of a state beside its observation. It is kept as an info if the transitions have it.
_OF_STATES = (keys.ACTION_MASK, keys.OPTION_MASK, keys.PAIR_MASK, keys.PARAMETER_LOW, keys.PARAMETER_HIGH)


@dataclass(frozen=True)
class MinariLayout:
    """Under which names the columns of a problem's transitions stand in its Minari data sets.

    Attributes:
        discrete, parameters, option: the parts of the environment's Dict action; transitions without an option have
            no such part. A nested tuple has no names.
        infos: columns, at the root and under `next`, that are kept as infos. Masks, the bounds of parameters and
            `duration` are kept besides, if the transitions have them.
    """

    discrete: str = "discrete"
    parameters: str = "parameters"
    option: str = "option"
    infos: tuple[str, ...] = ()


def _import_minari() -> Any:
    try:
        import minari
    except ImportError as error:
        raise DataError("Minari is not installed; pip install 'hpamdp[minari]'") from error
    return minari


def export(
    batch: TensorDict,
    dataset_id: str,
    layout: MinariLayout,
    *,
    env_id: str,
    env_kwargs: Mapping[str, Any] | None = None,
    algorithm_name: str | None = None,
    description: str | None = None,
    reference_scores: tuple[float, float] | None = None,
) -> minari.MinariDataset:
    """Write transitions as a Minari data set and return it.

    Args:
        batch: `[N]`, one episode after another, each up to its `done`; keys as in `hpamdp.data.demonstrations`.
            Options last a whole episode.
        dataset_id: such as `namespace/name-v0`; it must not exist yet.
        layout: names of the actions' parts and of the infos.
        env_id: Gymnasium's id of the environment, whose action space is a Dict of the layout's parts or a nested tuple.
        env_kwargs: arguments of the environment.
        algorithm_name: what acted.
        description: what a user should know of the data.
        reference_scores: the scores that `minari.get_normalized_score` maps to 0 and to 1.

    Raises:
        DataError: Minari is missing or refuses the data, the data set exists, or there is no such environment. Or an
            option ends inside an episode, or a mask or bound is not given for all states.
    """
    library = _import_minari()
    from minari.data_collector import EpisodeBuffer

    if not re.fullmatch(r"([\w-]+/)*[\w-]+-v\d+", dataset_id):
        raise DataError(f"{dataset_id}: not a name of a Minari data set; it must be like namespace/name-v0")
    folder = _folder_of(dataset_id)
    if folder.exists():
        raise DataError(f"{dataset_id}: Minari has this data set already; delete it first: minari delete {dataset_id}")
    _check_episodes(batch, dataset_id)
    if not batch["next", keys.IS_DECISION].equal(batch["next", keys.DONE]):
        raise DataError(f"{dataset_id}: Minari has no place for options that end inside an episode")
    for name in _OF_STATES:
        if name in batch.keys() and name not in batch["next"].keys():
            raise DataError(f"{dataset_id}: the transitions have {name}, but lack next.{name}, which Minari keeps, too")
    try:
        env = gymnasium.make(env_id, **(env_kwargs or {}))
    except gymnasium.error.Error as error:
        raise DataError(f"{dataset_id}: {error}") from error
    ends = batch["next", keys.DONE].squeeze(-1).nonzero().squeeze(-1) + 1
    lengths = ends.diff(prepend=ends.new_zeros(1)).tolist()
    try:
        # The library of HDF5 prints hundreds of tracebacks on a full disk.
        num_bytes = sum(values.nbytes for values in batch.values(True, True))
        check_room(folder.parent, 2 * num_bytes + _BYTES_AN_EPISODE * len(lengths))
        lowest, highest = reference_scores or (None, None)
        dims = _parameter_dims(env.action_space)
        buffers = [EpisodeBuffer(id=i, **_episode(rows, layout, dims)) for i, rows in enumerate(batch.split(lengths))]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # asks for an author and a link
            dataset = library.create_dataset_from_buffers(
                dataset_id,
                buffers,
                env=env,
                observation_space=spaces.flatten_space(env.observation_space),
                algorithm_name=algorithm_name,
                description=description,
                ref_min_score=lowest,
                ref_max_score=highest,
            )
        dataset.storage.update_metadata({_LAYOUT: asdict(layout)})
        return dataset
    except Exception as error:  # Minari asserts what fits its environment, among others
        shutil.rmtree(folder, ignore_errors=True)
        raise DataError(f"{dataset_id}: Minari refuses the data ({first_line(error)})") from error


def _folder_of(dataset_id: str) -> Path:
    """Return the folder of a data set.

    Raises:
        DataError: Minari's folder cannot be made.
    """
    from minari.storage import get_dataset_path

    try:
        return Path(get_dataset_path(dataset_id))
    except OSError as error:
        raise DataError(f"MINARI_DATASETS_PATH: Minari's folder cannot be used ({reason_of(error)})") from error


def _check_episodes(batch: TensorDict, dataset_id: str) -> None:
    """Refuse transitions that `load` would refuse, too, or cut."""
    names = (keys.OBSERVATION, keys.DISCRETE, keys.PARAMETERS, ("next", keys.REWARD), ("next", keys.IS_DECISION))
    fault = next((f"they have no {name}" for name in names if name not in batch.keys(True)), None)
    if fault is None and (batch.ndim != 1 or len(batch) == 0):
        fault = f"they have shape {list(batch.shape)}, but must be [N], at least one"
    if fault is None and not batch["next", keys.DONE][-1]:
        fault = "their last episode has no end"
    for name, values in batch.items(True, True) if fault is None else ():
        if values.is_floating_point() and not values.isfinite().all():
            fault = f"{name} is not finite"
    if fault is not None:
        raise DataError(f"{dataset_id}: the transitions cannot be exported: {fault}")


def _parameter_dims(space: Any) -> list[int] | None:
    """Return the number of parameters of each discrete action of a nested tuple; None if the action is a Dict."""
    is_tuple = isinstance(space, spaces.Tuple)
    return [part.shape[0] for part in space[-1]] if is_tuple else None


def _episode(rows: TensorDict, layout: MinariLayout, dims: list[int] | None) -> dict[str, Any]:
    """Return one episode's arrays; observations and infos have one row more than the rest."""

    def with_last(name: str) -> np.ndarray:
        return torch.cat([rows[name], rows["next", name][-1:]]).numpy()

    parts = {layout.discrete: rows[keys.DISCRETE].numpy(), layout.parameters: rows[keys.PARAMETERS].numpy()}
    if keys.OPTION in rows.keys():
        parts[layout.option] = rows[keys.OPTION].numpy()
    actions: Any = parts
    if dims is not None:
        each = tuple(part.numpy() for part in rows[keys.PARAMETERS].split(dims, -1))
        actions = (*([parts[layout.option]] if layout.option in parts else []), parts[layout.discrete], each)
    infos = {name: with_last(name) for name in (*layout.infos, *_OF_STATES) if name in rows.keys()}
    if keys.DURATION in rows["next"].keys():
        duration = rows["next", keys.DURATION]
        infos[keys.DURATION] = torch.cat([torch.zeros_like(duration[:1]), duration]).numpy()
    return {
        "observations": with_last(keys.OBSERVATION),
        "actions": actions,
        "rewards": rows["next", keys.REWARD].squeeze(-1).numpy(),
        "terminations": rows["next", keys.TERMINATED].squeeze(-1).numpy(),
        "truncations": rows["next", keys.TRUNCATED].squeeze(-1).numpy(),
        "infos": infos,
    }


def load(dataset_id: str, layout: MinariLayout | None = None) -> TensorDict:
    """Return a Minari data set that `export` wrote as the transitions `[N]` that it was made of.

    Episodes are numbered from 0. The data set may be somebody else's, so nothing that it names is imported.

    Args:
        dataset_id: as for `export`.
        layout: names of the actions' parts and of the infos. If None, those of `export`.

    Raises:
        DataError: Minari is missing, there is no such data set, it has another layout, or a value is wrong.
    """
    library = _import_minari()
    try:
        metadata = _checked_metadata(dataset_id)
        layout = layout or MinariLayout(**metadata.get(_LAYOUT, {}))
        episodes = list(library.load_dataset(dataset_id).iterate_episodes())
        if not episodes:
            raise DataError(f"has no episodes, as after an interrupted export; delete it: minari delete {dataset_id}")
        rows = torch.cat([_transitions(episode, number, layout) for number, episode in enumerate(episodes)])
        check_transitions(rows)
    except DataError as error:
        raise DataError(f"{dataset_id}: {error}") from error
    except Exception as error:  # Minari and its storage raise any class of error about files of another kind
        raise DataError(f"{dataset_id}: cannot be read as transitions ({first_line(error)})") from error
    return rows


def _checked_metadata(dataset_id: str) -> dict[str, Any]:
    """Return a data set's metadata; refuse those without spaces: Minari would build the environment that they name."""
    folder = _folder_of(dataset_id)
    if not folder.exists():
        advice = f"`hpamdp datasets` makes those of the package, `minari download {dataset_id}` fetches others"
        raise DataError(f"is not in {folder.parent}; {advice}")
    metadata = read_json(read_regular(folder / "data" / "metadata.json", MAX_LINE_BYTES))
    for name in _SPACES:
        if not isinstance(metadata.get(name), str):
            raise DataError(f"its metadata have no {name}")
    if metadata.get("data_format") != "hdf5":
        raise DataError(f"its format is {metadata.get('data_format')}, but must be hdf5")
    return metadata


def _parts(actions: object, layout: MinariLayout) -> dict[str, Any]:
    """Return the parts of a Dict action or of a nested tuple by the names of the layout."""
    if isinstance(actions, tuple):
        *options, discrete, parameters = actions
        actions = {layout.discrete: discrete, layout.parameters: np.concatenate(parameters, -1)}
        actions |= {layout.option: options[0]} if options else {}
    if not isinstance(actions, dict) or not {layout.discrete, layout.parameters} <= actions.keys():
        raise DataError(f"its actions have no {layout.discrete} and {layout.parameters}")
    return actions


def _transitions(episode: minari.EpisodeData, number: int, layout: MinariLayout) -> TensorDict:
    """Return the transitions of one episode, the inverse of `_episode`."""
    actions = _parts(episode.actions, layout)
    num = len(episode.rewards)
    rows = TensorDict(batch_size=[num])
    following = TensorDict(batch_size=[num])
    infos = [*layout.infos, *(name for name in (*_OF_STATES, keys.DURATION) if name in episode.infos)]
    columns = {keys.OBSERVATION: episode.observations, **{name: episode.infos[name] for name in infos}}
    for name, values in columns.items():
        column = torch.as_tensor(values)
        rows[name] = column[:-1]
        following[name] = column[1:]
    terminated = torch.as_tensor(episode.terminations).unsqueeze(-1)
    truncated = torch.as_tensor(episode.truncations).unsqueeze(-1)
    ends = {keys.TERMINATED: terminated, keys.TRUNCATED: truncated, keys.DONE: terminated | truncated}
    for name, end in ends.items():
        rows[name] = torch.zeros_like(end)
        following[name] = end
    rows[keys.IS_DECISION] = (torch.arange(num) == 0).unsqueeze(-1)
    following[keys.IS_DECISION] = ends[keys.DONE].clone()
    following[keys.REWARD] = torch.as_tensor(episode.rewards, dtype=torch.float32).unsqueeze(-1)
    rows[keys.DISCRETE] = torch.as_tensor(actions[layout.discrete])
    rows[keys.PARAMETERS] = torch.as_tensor(actions[layout.parameters])
    if layout.option in actions:
        rows[keys.OPTION] = torch.as_tensor(actions[layout.option])
    rows[TRAJECTORY] = torch.full((num,), number)
    rows["next"] = following
    return rows


def is_there(dataset_id: str) -> bool:
    """Return whether Minari's folder has a data set."""
    _import_minari()
    return _folder_of(dataset_id).exists()


def checksum(rows: TensorDict) -> str:
    """Return a checksum of transitions `[N]`, whatever files they lie in: the first 16 digits of a SHA-256.

    The numbers of the episodes do not count.
    """
    digest = hashlib.sha256()
    for name in sorted(rows.exclude(TRAJECTORY).keys(True, True), key=str):
        digest.update(f"{name}".encode() + rows[name].contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


class MinariDemonstrations(Demonstrations):
    """The transitions of a Minari data set, see `load`.

    Args:
        env: the environment whose transitions they are.

    Raises:
        DataError: the data set is missing, is of another kind, has a wrong value, or too few episodes to hold one out.
    """

    Options = MinariOptions
    card = CARDS["MinariDemonstrations"]

    def __init__(self, env: PAMDPEnv, options: MinariOptions | None = None, **settings: Any) -> None:
        self.options: MinariOptions = MinariOptions.of(options, settings)
        if not self.options.dataset:
            raise DataError("data.dataset: names no data set; `hpamdp datasets` lists those of the package")
        super().__init__(load(self.options.dataset), env.device)
        spec = str(_checked_metadata(self.options.dataset).get("env_spec"))
        found = re.search(r'"id": *"(hpamdp/\w+-v0)"', spec)
        problem = None if found is None else problem_of(found[1])
        if found is not None and problem not in (None, f"{type(env).__module__}:{type(env).__name__}"):
            raise DataError(f"{self.options.dataset}: was recorded in {found[1]}, which is another problem")
        if self.options.held_out:
            self._hold_out(self.options.held_out)

    def _hold_out(self, fraction: float) -> None:
        """Move a fraction of the episodes, each after equally many others, from `batch` to `held_out`."""
        rows = self.batch.squeeze(0)
        number = rows[TRAJECTORY].double()
        is_held_out = ((number + 1) * fraction).floor() > (number * fraction).floor()
        if not is_held_out.any():
            raise DataError(f"data.held_out={fraction}: is less than one of {int(number[-1]) + 1} episodes")
        self.batch, self.held_out = rows[~is_held_out].unsqueeze(0), rows[is_held_out].unsqueeze(0)
