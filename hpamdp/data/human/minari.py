"""People's transitions to and from Minari (extra `minari`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tensordict import TensorDict

from hpamdp import keys
from hpamdp.data import DataError
from hpamdp.data import minari as generic
from hpamdp.env.boatdock import physics
from hpamdp.env.boatdock.task import SCALED_NAMES

if TYPE_CHECKING:
    import minari

LAYOUT = generic.MinariLayout(discrete="key", parameters="duration", infos=("outcome", "fuel"))

_DESCRIPTION = (
    "People docking boats with one of two controllers, from BDtrajectory40.mat. Rows are logged presses. Presses that "
    "overlapped another are missing. The observation after a final press is filled in. Infos: outcome, fuel."
)


def export(batch: TensorDict, dataset_id: str) -> minari.MinariDataset:
    """Write transitions from `hpamdp.data.human.transitions` as a Minari data set and return it.

    Actions are the dicts of `hpamdp/BoatDock-v0`; `outcome` (an index of `physics.OUTCOMES`) and `fuel` are infos.

    Args:
        batch: transitions `[N]`, in the order of episodes and presses.
        dataset_id: name of the new data set, such as `hpamdp/people-v0`.

    Raises:
        DataError: Minari is missing or rejects the data, or the data set already exists.
    """
    is_scaled = batch[keys.OBSERVATION].shape[-1] == len(SCALED_NAMES)
    return generic.export(
        batch,
        dataset_id,
        LAYOUT,
        env_id="hpamdp/BoatDock-v0",
        env_kwargs={
            "controller": "choose" if keys.OPTION in batch.keys() else "random",
            "observation": "scaled" if is_scaled else "pixels",
        },
        algorithm_name="people",
        description=_DESCRIPTION,
    )


def load(dataset_id: str) -> TensorDict:
    """Load a Minari data set that `export` wrote, as transitions `[N]`.

    Raises:
        DataError: Minari is missing, the data set does not exist, or it has other contents.
    """
    batch = generic.load(dataset_id, LAYOUT)
    if not (batch["next", keys.OUTCOME] < len(physics.OUTCOMES)).all():
        raise DataError(f"{dataset_id}: an outcome is not one of {', '.join(physics.OUTCOMES)}")
    return batch
