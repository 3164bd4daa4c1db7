"""Where a TorchRL collector stands: its environments, and the tensordict from which it makes the next step.

TorchRL resets all environments when a collector is built and offers no way to continue from a state: its
`Collector.state_dict` holds the policy and the environment's modules. So the collector's own root is replaced here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDict
from torchrl.collectors import Collector


def collector_state(collector: Collector) -> dict[str, Any]:
    """Return the environments' `env_state` and, where it holds their episodes, the root as a nested dictionary."""
    env = collector.env
    state: dict[str, Any] = {"env": {name: column.clone() for name, column in env.env_state().items()}}
    if env.keeps_episodes:
        state["root"] = collector._carrier.exclude("collector").clone().to_dict()
    return state


def set_collector_state(collector: Collector, state: Mapping[str, Any]) -> None:
    """Continue from a `collector_state`.

    Raises:
        ValueError: the state is of another number of environments.
    """
    if state["env"]:  # else the episodes that the collector has just begun go on
        collector.env.set_env_state(state["env"])
    root = state.get("root")
    if root is not None and collector.env.keeps_episodes:
        collector._carrier.update(TensorDict(root, batch_size=collector._carrier.batch_size))
