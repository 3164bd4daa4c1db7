"""The settings and the cards of collectors."""

from __future__ import annotations

from pydantic import NonNegativeInt, PositiveInt

from hpamdp.cards import CollectorCard
from hpamdp.settings import Settings


class WorkerOptions(Settings):
    """Settings of collections in several processes."""

    num_workers: PositiveInt = 2
    """Number of processes, each with an equal part of `num_envs` and a CPU thread."""
    ahead: bool = False
    """Collect the next batch, with the earlier policy, while the agent learns from the last batch."""
    max_restarts: NonNegativeInt = 0
    """Number of dead workers that are replaced over the whole run. If another worker dies, the run ends."""


class RayOptions(WorkerOptions):
    """Settings of `RayCollection`; the workers are Ray actors, each with a CPU."""

    address: str | None = None
    """Address of a running cluster, as for `ray.init`. If null, Ray runs on this machine for the time of the run."""


CARDS = {
    "SingleCollection": CollectorCard(),
    "MultiCollection": CollectorCard(options=WorkerOptions, has_workers=True),
    "RayCollection": CollectorCard(options=RayOptions, guarded_settings=("address",), package="ray", has_workers=True),
}
