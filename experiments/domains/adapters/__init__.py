"""Adapters for replays. The module of a domain has the names of its recordings, `DOMAINS`, and a `DomainAdapter`."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

SCHEMA = 1  # of the files


class Adapter(Protocol):
    """The interface of a domain's rules for replays. N is the number of rows, each of another episode or step.

    Attributes:
        outcomes: the recordings' name of each of our outcomes, "" while an episode continues.
        angles: columns that count modulo 2 pi.
        float32_tolerance: the largest rounding error of a single step in float32.
    """

    outcomes: tuple[str, ...]
    angles: tuple[str, ...]
    float32_tolerance: float

    def __init__(self, recording: dict[str, Any]) -> None: ...

    def states(self, rows: Sequence[Sequence[float]], taken: Sequence[int], dtype: torch.dtype) -> Any:
        """Return our states from recorded ones, in the order of `state_names`, after `taken` actions each."""

    def act(self, state: Any, steps: Sequence[dict[str, Any]]) -> tuple[Any, dict[str, Tensor]]:
        """Return the states after the recorded steps, with the recorded random numbers, and the steps' results.

        The results are tensors `[N]` by their names in the recording: `reward` and, if an action has ticks, `ticks`.
        """

    def observe(self, state: Any) -> Tensor:
        """Return the observations `[N, observation_dim]`, as they are recorded."""

    def named(self, state: Any) -> dict[str, Tensor]:
        """Return the columns `[N]` to compare."""

    def columns(self, rows: Sequence[Sequence[float]]) -> dict[str, Tensor]:
        """Return the same columns of recorded states, float64 `[N]`."""


class DirectAdapter:
    """The parts of an adapter whose recorded columns equal ours, one by one.

    A subclass gives `state_type`, and the recorded names of columns if they differ.
    """

    angles: tuple[str, ...] = ()
    float32_tolerance = 2e-6
    state_type: type[Any]
    recorded_names: dict[str, str]  # by our own; columns that are not recorded are left out
    integers: tuple[str, ...] = ("misses", "steps", "outcome", "episode")

    def __init__(self, recording: dict[str, Any]) -> None:
        self.state_names: list[str] = recording["state_names"]

    def columns(self, rows: Sequence[Sequence[float]]) -> dict[str, Tensor]:
        """Return our recorded columns, float64 `[N]`."""
        table = torch.tensor(rows, dtype=torch.float64).reshape(len(rows), len(self.state_names))
        return {ours: table[:, self.state_names.index(name)] for ours, name in self.recorded_names.items()}

    def states(self, rows: Sequence[Sequence[float]], taken: Sequence[int], dtype: torch.dtype) -> Any:
        """Return our states, with 0 in columns that are not recorded."""
        recorded = self.columns(rows)
        zeros = torch.zeros(len(rows), dtype=torch.float64)
        columns = {name: recorded.get(name, zeros) for name in self.state_type._fields}
        types = {name: torch.int32 if name in self.integers else dtype for name in columns}
        return self.state_type(*(column.to(types[name]) for name, column in columns.items()))

    def named(self, state: Any) -> dict[str, Tensor]:
        """Return the columns that are recorded."""
        return {name: getattr(state, name) for name in self.recorded_names}


def chosen(steps: Sequence[dict[str, Any]], like: Tensor, size: int = 1) -> tuple[Tensor, Tensor]:
    """Return the discrete actions int64 `[N]` of steps, and their parameters `[N, size]`, filled with zeros.

    Args:
        steps: the recorded steps.
        like: a tensor of the state's dtype.
        size: the largest number of parameters of an action.
    """
    rows = [[*step["parameters"], *[0.0] * (size - len(step["parameters"]))] for step in steps]
    parameters = torch.tensor(rows, dtype=torch.float64).to(like.dtype)
    return torch.tensor([step["action"] for step in steps]), parameters


def limited(state: Any, max_steps: int, limit: int) -> Any:
    """Return the states with the outcome `limit` for unfinished episodes after their last step."""
    is_late = (state.outcome == 0) & (state.steps >= max_steps)
    return state._replace(outcome=torch.where(is_late, limit, state.outcome))


def load(recording: dict[str, Any]) -> Adapter:
    """Return the adapter of a recording.

    Raises:
        ValueError: the file is no recording, or its domain has no adapter.
    """
    if not isinstance(recording, dict) or "domain" not in recording or "episodes" not in recording:
        raise ValueError("it has no domain and episodes")
    if recording.get("schema", SCHEMA) != SCHEMA:
        raise ValueError(f"schema {recording['schema']!r}, but must be {SCHEMA}")
    known: dict[str, type[Any]] = {}
    for found in pkgutil.iter_modules(__path__, "adapters."):
        module = importlib.import_module(found.name)
        known |= dict.fromkeys(module.DOMAINS, module.DomainAdapter)
    if recording["domain"] not in known:
        raise ValueError(f"domain {recording['domain']!r}, but must be one of {', '.join(known)}")
    return known[recording["domain"]](recording)
