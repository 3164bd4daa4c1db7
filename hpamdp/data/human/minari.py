"""People's transitions to and from Minari, the Gymnasium world's offline data sets (extra `minari`)."""

from __future__ import annotations

import re
import shutil
import warnings
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.data.human.errors import HumanDataError
from hpamdp.data.human.transitions import TRAJECTORY
from hpamdp.env.boatdock import physics
from hpamdp.env.boatdock.episode import FUEL, SCALED_NAMES
from hpamdp.env.registration import BOAT_DOCK_ID

if TYPE_CHECKING:
    import minari

_NOTE = (
    "People docking boats with one of two controllers, from BDtrajectory40.mat. Rows are logged presses; presses that "
    "overlapped another are missing; the observation after a final press is filled in. Infos: outcome, fuel."
)


def _minari() -> Any:
    try:
        import minari
    except ImportError as error:
        raise HumanDataError("Minari is not installed; pip install 'hpamdp[minari]'") from error
    return minari


def export(batch: TensorDict, dataset_id: str) -> minari.MinariDataset:
    """Write transitions from `hpamdp.data.human.transitions` as a Minari data set and return it.

    Actions are the dicts of `hpamdp/BoatDock-v0`; `outcome` (a code of `physics.OUTCOMES`) and `fuel` are infos.

    Args:
        batch: `[N]`, in the order of episodes and presses.
        dataset_id: such as `hpamdp/people-v0`; it must not exist yet.

    Raises:
        HumanDataError: Minari is missing or refuses, or there is such a data set.
    """
    library = _minari()
    from minari.data_collector import EpisodeBuffer
    from minari.storage import get_dataset_path

    if not re.fullmatch(r"([\w-]+/)*[\w-]+-v\d+", dataset_id):
        raise HumanDataError(f"{dataset_id}: no name for a Minari data set; it must be like hpamdp/people-v0")
    if get_dataset_path(dataset_id).exists():
        raise HumanDataError(f"{dataset_id}: Minari has such a data set; delete it first: minari delete {dataset_id}")
    has_choice = keys.OPTION in batch.keys()
    form = "scaled" if batch[keys.OBSERVATION].shape[-1] == len(SCALED_NAMES) else "pixels"
    ends = batch["next", keys.DONE].squeeze(-1).nonzero().squeeze(-1) + 1
    episodes = batch.split(ends.diff(prepend=ends.new_zeros(1)).tolist())
    controller = "choose" if has_choice else "random"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # asks for an author and a link
            return library.create_dataset_from_buffers(
                dataset_id,
                [EpisodeBuffer(id=i, **_episode(rows, has_choice)) for i, rows in enumerate(episodes)],
                env=gymnasium.make(BOAT_DOCK_ID, controller=controller, observation=form),
                algorithm_name="people",
                description=_NOTE,
            )
    except (ValueError, OSError) as error:
        shutil.rmtree(get_dataset_path(dataset_id), ignore_errors=True)
        raise HumanDataError(f"{dataset_id}: Minari refuses it ({error})") from error


def _episode(rows: TensorDict, has_choice: bool) -> dict[str, Any]:
    """Return one episode's arrays: observations and infos have a row more than the rest."""

    def with_last(name: str) -> np.ndarray:
        return torch.cat([rows[name], rows["next", name][-1:]]).numpy()

    actions = {"key": rows[keys.DISCRETE].numpy(), "duration": rows[keys.PARAMETERS].numpy()}
    return {
        "observations": with_last(keys.OBSERVATION),
        "actions": {"option": rows[keys.OPTION].numpy(), **actions} if has_choice else actions,
        "rewards": rows["next", keys.REWARD].squeeze(-1).numpy(),
        "terminations": rows["next", keys.TERMINATED].squeeze(-1).numpy(),
        "truncations": rows["next", keys.TRUNCATED].squeeze(-1).numpy(),
        "infos": {keys.OUTCOME: with_last(keys.OUTCOME), FUEL: with_last(FUEL)},
    }


def load(dataset_id: str) -> TensorDict:
    """Return a Minari data set that `export` wrote as the transitions that it was made of, `[N]`.

    Raises:
        HumanDataError: Minari is missing, or there is no such data set or none of this kind.
    """
    library = _minari()
    try:
        episodes = list(library.load_dataset(dataset_id).iterate_episodes())
        return torch.cat([_rows(episode, number) for number, episode in enumerate(episodes)])
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise HumanDataError(f"{dataset_id}: no data set of people's presses ({error})") from error


def _rows(episode: minari.EpisodeData, number: int) -> TensorDict:
    num = len(episode.rewards)
    column = {name: torch.as_tensor(value) for name, value in episode.infos.items()}
    column[keys.OBSERVATION] = torch.as_tensor(episode.observations)
    now = {name: column[name][:-1] for name in (keys.OBSERVATION, keys.OUTCOME, FUEL)}
    then = {name: column[name][1:] for name in now}
    terminated, truncated = (torch.as_tensor(end)[:, None] for end in (episode.terminations, episode.truncations))
    ends = {keys.TERMINATED: terminated, keys.TRUNCATED: truncated, keys.DONE: terminated | truncated}
    then |= {**ends, keys.IS_DECISION: ends[keys.DONE].clone()}
    then[keys.REWARD] = torch.as_tensor(episode.rewards, dtype=torch.float32)[:, None]
    action = {name: torch.as_tensor(value) for name, value in episode.actions.items()}
    press = {"discrete": action["key"], "parameters": action["duration"]}
    now |= {name: torch.zeros_like(end) for name, end in ends.items()}
    now[keys.IS_DECISION] = (torch.arange(num) == 0)[:, None]
    if keys.OPTION in action:
        now[keys.OPTION] = action[keys.OPTION]
    rows = TensorDict({**now, keys.ACTION: press, "next": then}, batch_size=[num])
    if not (rows["next", keys.OUTCOME] < len(physics.OUTCOMES)).all():
        raise ValueError("an outcome that there is not")
    return rows.set(TRAJECTORY, torch.full((num,), number))
