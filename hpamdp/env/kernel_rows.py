"""The rows of a `BatchedEnv` as NumPy arrays that a kernel moves; see `hpamdp.env.kernels`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from hpamdp.env import kernels
from hpamdp.env.kernels import ACT, ACT_AND_RESTART, ACT_OR_RESTART, RESTART
from hpamdp.env.rng_streams import NOISE, TRAINING, folded
from hpamdp.messages import invalid_action

# A kernel `advance(state, option, discrete, parameters, mask, settings, mode, results)` that moves all rows:
# - state: the float32 columns `[F, N]` and the int32 columns `[I, N]`, changed in place.
# - option, discrete: options and discrete actions, int64 `[N]`.
# - parameters: those of all discrete actions side by side, float32 `[N, P]`; their places, int64 `[K + 1]`, where
#   those of action k lie from `places[k]` to before `places[k + 1]`; and their bounds, float32 `[2, P]`.
# - mask: rows that move, or that restart, bool `[N]`.
# - settings, mode: see `hpamdp.env.kernels`.
# - results: the arrays of `Results`, to be filled.
# It returns -1, or the number of the first row with an invalid action; then nothing has changed.
# The tuples are plain: for named ones, Numba takes 5 us more a call.
Advance = Callable[..., int]


class Results(NamedTuple):
    """R readings of N rows. R is 2 if finished rows were restarted: one reading before, one after.

    Attributes:
        observations: float32 `[R, N, D]`.
        outcomes: int64 `[R, N]`.
        extras: values that a problem reports beside the observation, float32 `[R, E, N]`.
        flags: done, terminated and truncated, bool `[R, 3, N]`.
        rewards: float32 `[N]`.
    """

    observations: np.ndarray
    outcomes: np.ndarray
    extras: np.ndarray
    flags: np.ndarray
    rewards: np.ndarray


class KernelRows:
    """The state of N rows, and the kernel that moves them.

    Args:
        advance: the kernel of the problem.
        num_rows: number of rows N.
        num_columns: number of float32 columns and number of int32 columns of the state.
        reading_dims: D and E of `Results`.
        parameter_dims: number of parameters of each discrete action.
        bounds: lowest and highest values of all parameters, `[2, P]`.
        settings: MAX_STEPS, NUM_OPTIONS (0 if the agent does not choose) and the problem's own settings.
        first_env: number of the first row. It is above 0 if other processes hold earlier rows.
    """

    def __init__(
        self,
        advance: Advance,
        num_rows: int,
        *,
        num_columns: tuple[int, int],
        reading_dims: tuple[int, int],
        parameter_dims: Sequence[int],
        bounds: np.ndarray | Sequence[Sequence[float]],
        settings: Sequence[float],
        first_env: int = 0,
    ) -> None:
        self.floats = np.zeros((num_columns[0], num_rows), np.float32)
        self.integers = np.zeros((num_columns[1], num_rows), np.int32)
        self.integers[kernels.EPISODE_ROW] = -1
        self._advance = advance
        self._state = self.floats, self.integers
        self._num_rows = num_rows
        self._observation_dim, self._num_extras = reading_dims
        self._parameter_offsets = np.concatenate([[0], np.cumsum(parameter_dims)]).astype(np.int64)
        self._bounds = np.ascontiguousarray(bounds, np.float32)
        self._settings = np.array([0.0, 0.0, 0.0, first_env, *settings])
        self._all = np.ones(num_rows, np.bool_)
        # Stand-ins for the action when rows restart.
        self._no_choice = np.zeros(num_rows, np.int64)
        self._no_parameters = np.zeros((num_rows, sum(parameter_dims)), np.float32)

    def begin(self, seed: int, streams: tuple[int, int] = (TRAINING, NOISE)) -> None:
        """Put every row before its first episode with this seed and these streams of episodes and of noise."""
        self.floats[:] = 0.0
        self.integers[:] = 0
        self.integers[kernels.EPISODE_ROW] = -1
        self._settings[kernels.SEED] = folded(seed)
        self._settings[kernels.EPISODE_STREAM], self._settings[kernels.NOISE_STREAM] = streams

    def act(
        self,
        option: np.ndarray | None,
        discrete: np.ndarray,
        parameters: np.ndarray,
        *,
        mask: np.ndarray | None = None,
        restarts: bool = False,
    ) -> Results | int:
        """Take an action in every row. Rows whose episode is over stay unchanged.

        Args:
            option: options, int64 `[N]`, or None if the agent does not choose.
            discrete: discrete actions, int64 `[N]`.
            parameters: parameters of all discrete actions side by side, float32 `[N, P]`.
            mask: rows that move, bool `[N]`. If None, all rows.
            restarts: whether to restart finished rows and read all rows again.

        Returns:
            The results. If an action is invalid, the number of the first such row, and the state is unchanged.
        """
        return self.advance(ACT_AND_RESTART if restarts else ACT, option, discrete, parameters, mask)

    def act_or_restart(self, option: np.ndarray | None, discrete: np.ndarray, parameters: np.ndarray) -> Results | int:
        """Take an action in every row, but start a new episode in finished rows, whose actions are ignored."""
        return self.advance(ACT_OR_RESTART, option, discrete, parameters, None)

    def restart(self, mask: np.ndarray | None = None) -> Results:
        """Start new episodes in the rows of `mask`, bool `[N]`. If None, in all rows."""
        results = self.advance(RESTART, None, self._no_choice, self._no_parameters, mask)
        assert not isinstance(results, int)
        return results

    def read(self) -> Results:
        """Return a reading of all rows, which stay unchanged."""
        return self.restart(~self._all)

    def put(self, columns: Mapping[int, np.ndarray], mask: np.ndarray | None) -> None:
        """Set columns of the state in the rows of `mask`. If None, in all rows.

        Args:
            columns: new values by the column's place. Places count the floats first, then the integers.
            mask: bool `[N]`.
        """
        state = [*self.floats, *self.integers]
        for place, column in columns.items():
            np.copyto(state[place], column, where=True if mask is None else mask)

    def advance(
        self,
        mode: int,
        option: np.ndarray | None,
        discrete: np.ndarray,
        parameters: np.ndarray,
        mask: np.ndarray | None,
    ) -> Results | int:
        """Call the kernel and return its results, or the number of the first row with an invalid action."""
        num_readings, n = 2 if mode == ACT_AND_RESTART else 1, self._num_rows
        results = (
            np.empty((num_readings, n, self._observation_dim), np.float32),
            np.empty((num_readings, n), np.int64),
            np.empty((num_readings, self._num_extras, n), np.float32),
            np.empty((num_readings, 3, n), np.bool_),
            np.zeros(n, np.float32),
        )
        invalid = self._advance(
            self._state,
            self._no_choice if option is None else option,
            discrete,
            (parameters, self._parameter_offsets, self._bounds),
            self._all if mask is None else mask,
            self._settings,
            mode,
            results,
        )
        return Results(*results) if invalid < 0 else invalid


def invalid_choice(
    row: int,
    leaves: tuple[Any, Any, Any],
    parameter_dims: Sequence[int],
    num_options: int,
    names: tuple[str, str],
) -> ValueError:
    """Return the error for an invalid action of a row.

    Args:
        row: number of the row.
        leaves: option or None, discrete actions, and parameters of all discrete actions; tensors or arrays of all rows.
        parameter_dims: number of parameters of each discrete action.
        num_options: number of options.
        names: names of `discrete` and `parameters` in the message.
    """
    of_row: list[Any] = [None if leaf is None else leaf[row].tolist() for leaf in leaves]
    option, discrete, parameters = of_row
    values: dict[str, tuple[object, str]] = {}
    if option is not None:
        values["option"] = option, f"allowed 0 to {num_options - 1}"
    values[names[0]] = discrete, f"allowed 0 to {len(parameter_dims) - 1}"
    if 0 <= discrete < len(parameter_dims):
        first = sum(parameter_dims[:discrete])
        own = parameters[first : first + parameter_dims[discrete]]
        values[names[1]] = own, "those of the chosen action must be finite"
    return invalid_action(row, values)
