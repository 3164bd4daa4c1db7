"""Kernels: loops over the rows of a batch that Numba compiles for one core of the CPU.

Each tensor operation reads and writes whole columns, and takes microseconds even for one row. A kernel states the rules
for one row, and takes each row through a whole step. So it is fast with one environment and with a million.

The problems have their kernels alone (`KernelEnv`). Tests compare them with tensor functions under experiments/.

Random numbers equal those of `counter_rng` bit for bit. Numba caches the machine code on disk, so only the first run on
a machine compiles.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numba import int32, njit, uint32, uint64

from hpamdp.env.rng_streams import STEPS

_STREAM_STEPS = tuple(step & 0xFFFFFFFF for step in STEPS)
# The multipliers of `counter_rng`.
_FIRST, _SECOND = np.uint32(0x7FEB352D), np.uint32(0x846CA68B)

ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
TURN = np.float32(2.0 * math.pi)
_UNIT = np.float32(2.0**-23)
_MINUS_TWO = np.float32(-2.0)

# For `sin_cos`: 2/pi, and pi/2 in two parts, so that the remainder is exact. The series are those of Cephes.
_QUARTERS = np.float32(2.0 / math.pi)
_QUARTER_HIGH = np.float32(1.5703125)
_ROUNDING = np.float32(1.5 * 2.0**23)  # adding and subtracting it rounds to an integer
_QUARTER_LOW = np.float32(math.pi / 2.0 - 1.5703125)
_SIN_3, _SIN_5, _SIN_7 = np.float32(-1.6666654611e-1), np.float32(8.3321608736e-3), np.float32(-1.9515295891e-4)
_COS_4, _COS_6, _COS_8 = np.float32(4.1666645683e-2), np.float32(-1.3887316255e-3), np.float32(2.4433157118e-5)
# For `atan2`: a polynomial in s^2 that approximates (arctan(s) - s) / s^3 for s in [0, 1]. The error relative to the
# arc tangent is below 2e-8.
_ATAN_3, _ATAN_5, _ATAN_7 = np.float32(-0.33333153), np.float32(0.19993773), np.float32(-0.14211056)
_ATAN_9, _ATAN_11, _ATAN_13 = np.float32(0.106660046), np.float32(-0.07552215), np.float32(0.043211862)
_ATAN_15, _ATAN_17 = np.float32(-0.016367929), np.float32(0.0029206923)
_PI, _QUARTER = np.float32(math.pi), np.float32(math.pi / 2.0)
_TINY = np.float32(1e-38)


@cache
def sources() -> tuple[str]:
    """Return a hash of all source files that kernels may depend on."""
    digest = sha256()
    for path in sorted(Path(__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return (digest.hexdigest(),)


# Division by 0 follows NumPy. Wrappers for calls from C or Python are left out where possible, because LLVM takes as
# long for a wrapper as for the function itself.
_OPTIONS: Any = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
_PART_OPTIONS: Any = {**_OPTIONS, "no_cpython_wrapper": True}


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call and keep the machine code on disk."""
    try:
        compiled: Any = njit(function, cache=True, **_OPTIONS)
    except RuntimeError:  # there is no writable folder for the cache
        return njit(function, **_OPTIONS)
    if compiled is function:
        # NUMBA_DISABLE_JIT is set. Integers overflow silently in machine code, so NumPy must not warn either.
        return np.errstate(over="ignore")(function)
    # By default Numba reuses cached code while the function's own file is unchanged, although functions that it calls
    # in other files may have changed. This stamp covers hpamdp/env. A kernel from elsewhere keeps its own file's, too.
    file = compiled._cache._cache_file
    is_here = Path(function.__code__.co_filename).is_relative_to(Path(__file__).parent)
    file._source_stamp = sources() if is_here else (*sources(), file._source_stamp)
    return compiled


def part(function: Callable[..., Any]) -> Any:
    """Compile a function that kernels call for many rows. Python cannot call it."""
    return njit(function, **_PART_OPTIONS)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function that kernels call for one row.

    The function is inlined, because LLVM does not vectorise loops that contain calls.
    """
    return njit(function, forceinline=True, **_PART_OPTIONS)


@inlined
def unsigned(index: Any) -> Any:
    """Return a nonnegative index as an unsigned integer.

    Numba cannot know that a signed sum is nonnegative, so it tests whether to count from the array's end. That test
    keeps a loop from being vectorised.
    """
    return uint64(index)


@inlined
def _mix(h: Any) -> Any:
    h = uint32(h)
    h = uint32(uint32(h ^ (h >> uint32(16))) * _FIRST)
    h = uint32(uint32(h ^ (h >> uint32(15))) * _SECOND)
    return uint32(h ^ (h >> uint32(16)))


@inlined
def stream_hash(seed: Any, stream: Any) -> Any:
    """Return the hash of a folded seed and a stream, from which the keys of all episodes derive."""
    return _mix(uint32(seed) ^ uint32(0x2545F491 + 0x01234567 * stream))


@inlined
def stream_step(stream: Any) -> Any:
    """Return the step of a stream, for `uniform` and `normal`."""
    return uint32(_STREAM_STEPS[stream])


@inlined
def episode_hash(key: Any, environment: Any, episode: Any) -> Any:
    """Return the bits of an episode's key, from a `stream_hash`."""
    return _mix(_mix(key ^ uint32(environment)) ^ uint32(episode))


@inlined
def uniform(bits: Any, step: Any, index: Any) -> Any:
    """Return uniform number `index` of a key, float32 in (0, 1)."""
    drawn = _mix(uint32(bits + uint32(uint32(index) * step))) >> uint32(9)
    return (np.float32(int32(drawn)) + HALF) * _UNIT


@inlined
def normal(bits: Any, step: Any, index: Any) -> Any:
    """Return a standard normal float32, from the uniform numbers `2 index` and `2 index + 1`."""
    radius = math.sqrt(_MINUS_TWO * math.log(uniform(bits, step, 2 * index)))
    return radius * math.cos(TURN * uniform(bits, step, 2 * index + 1))


@inlined
def sin_cos(angle: Any) -> Any:
    """Return sine and cosine of a float32 angle of up to a few turns, to float32 accuracy.

    The function has no branch and no call, so that loops over it are vectorised.
    """
    quarters = (angle * _QUARTERS + _ROUNDING) - _ROUNDING
    rest = (angle - quarters * _QUARTER_HIGH) - quarters * _QUARTER_LOW
    square = rest * rest
    sine = rest + rest * square * (_SIN_3 + square * (_SIN_5 + square * _SIN_7))
    cosine = ONE - HALF * square + square * square * (_COS_4 + square * (_COS_6 + square * _COS_8))
    quadrant = int32(quarters)
    swapped = quadrant & 1 != 0
    of_sine = cosine if swapped else sine
    of_cosine = sine if swapped else cosine
    return (-of_sine if quadrant & 2 != 0 else of_sine), (-of_cosine if (quadrant + 1) & 2 != 0 else of_cosine)


@inlined
def atan2(y: Any, x: Any) -> Any:
    """Return the angle of a finite float32 vector, within 2.5 units in the last place.

    The function has no branch and no call, so that loops over it are vectorised.
    """
    width, height = abs(x), abs(y)
    ratio = min(width, height) / max(max(width, height), _TINY)
    # Evaluated in pairs of terms, which the processor can compute in parallel.
    square = ratio * ratio
    fourth = square * square
    low = (_ATAN_3 + square * _ATAN_5) + fourth * (_ATAN_7 + square * _ATAN_9)
    high = (_ATAN_11 + square * _ATAN_13) + fourth * (_ATAN_15 + square * _ATAN_17)
    series = low + fourth * fourth * high
    angle = ratio + ratio * square * series
    angle = _QUARTER - angle if height > width else angle
    angle = _PI - angle if np.signbit(x) else angle
    return -angle if np.signbit(y) else angle


# All kernels share the following: the modes, the first places of the settings, and the last rows of the integers.
#
# Each kernel has its own loop over the rows. A factory that closes over the problem's functions would compile the loop
# again in every process: Numba's cache on disk never hits for closures over compiled functions.
ACT, ACT_OR_RESTART, ACT_AND_RESTART, RESTART = range(4)
SEED, EPISODE_STREAM, NOISE_STREAM, FIRST_ENV, MAX_STEPS, NUM_OPTIONS, OWN = range(7)
STEPS_ROW, OUTCOME_ROW, EPISODE_ROW = -3, -2, -1

_FEW = 16  # number of parameters that fit one cache line


@part
def all_below(numbers: Any, limit: Any) -> Any:
    """Return whether all numbers `[N]` lie in [0, limit)."""
    are_below = True
    for row in range(len(numbers)):
        are_below &= (numbers[row] >= 0) & (numbers[row] < limit)
    return are_below


@part
def all_finite(values: Any) -> Any:
    """Return whether all values `[N, P]`, contiguous in memory, are finite."""
    are_finite = True
    given = values.reshape(-1)
    for place in range(len(given)):
        are_finite &= math.isfinite(given[place])
    return are_finite


@part
def invalid_row(option: Any, discrete: Any, parameters: Any, integers: Any, settings: Any, mode: Any) -> Any:
    """Return the first row with an unknown option, an unknown action or a parameter that is not finite, or -1.

    Args:
        option: options, int64 `[N]`, read only if the agent chooses among options.
        discrete: discrete actions, int64 `[N]`.
        parameters: parameters of all actions, their places and their bounds; see `hpamdp.env.kernel_rows`.
        integers: integer columns of the state.
        settings: settings of the problem.
        mode: with ACT_OR_RESTART, rows that start an episode may have any action. With RESTART, all rows may.
    """
    if mode == RESTART:
        return -1
    given, places, _ = parameters
    # First check all rows at once: a branch on each row's action took a sixth of Catch Point's step. The loop below
    # finds the row.
    num_options = settings[NUM_OPTIONS]
    are_known = all_below(discrete, len(places) - 1) and (num_options == 0 or all_below(option, num_options))
    if given.shape[1] <= _FEW and are_known and all_finite(given):
        return -1
    for row in range(len(discrete)):
        is_valid = (discrete[row] >= 0) & (discrete[row] < len(places) - 1)
        if is_valid:
            for place in range(places[discrete[row]], places[discrete[row] + 1]):
                is_valid &= math.isfinite(given[row, place])
        is_valid &= (num_options == 0) | ((option[row] >= 0) & (option[row] < num_options))
        if not is_valid and not (mode == ACT_OR_RESTART and integers[OUTCOME_ROW, row] != 0):
            return row
    return -1


@inlined
def parameter(parameters: Any, row: Any, number: Any, action: Any) -> Any:
    """Return a parameter of the chosen action, clipped to its bounds, or 0 if it has no such parameter."""
    given, places, bounds = parameters
    place = places[action] + number
    if place >= places[action + 1]:
        return ZERO
    return min(max(given[row, place], bounds[0, place]), bounds[1, place])


@inlined
def _row_rng(settings: Any, stream_place: Any, row: Any, episode: Any) -> Any:
    stream = int32(settings[stream_place])
    base = stream_hash(settings[SEED], stream)
    return episode_hash(base, int32(settings[FIRST_ENV]) + row, episode), stream_step(stream)


@inlined
def noise_rng(settings: Any, row: Any, episode: Any) -> Any:
    """Return bits and step of the random numbers within an episode, for `uniform` and `normal`."""
    return _row_rng(settings, NOISE_STREAM, row, episode)


@inlined
def new_episode(integers: Any, row: Any, settings: Any) -> Any:
    """Begin a row's next episode and return bits and step of the random numbers of its start."""
    episode = integers[EPISODE_ROW, row] + 1
    integers[STEPS_ROW, row], integers[OUTCOME_ROW, row], integers[EPISODE_ROW, row] = 0, 0, episode
    return _row_rng(settings, EPISODE_STREAM, row, episode)


@inlined
def end_step(integers: Any, row: Any, outcome: Any, num_outcomes: Any, settings: Any) -> None:
    """Count a row's step and store its outcome, which is the time limit if an unfinished episode reaches it."""
    steps = integers[STEPS_ROW, row] + 1
    is_late = (outcome == 0) & (steps >= settings[MAX_STEPS])
    integers[STEPS_ROW, row], integers[OUTCOME_ROW, row] = steps, num_outcomes - 1 if is_late else outcome


@inlined
def report(outcome: Any, num_outcomes: Any, row: Any, outcomes: Any, flags: Any) -> None:
    """Write a row's outcome, int64 `[N]`, and flags, bool `[3, N]`: done, terminated, truncated."""
    outcomes[row] = outcome
    is_late = outcome == num_outcomes - 1
    flags[0, row] = outcome != 0
    flags[1, row] = (outcome != 0) & (not is_late)
    flags[2, row] = is_late


@inlined
def must_restart(mode: Any, reading: Any, was_over: Any, outcome: Any, is_marked: Any) -> Any:
    """Return whether a row starts a new episode before a reading.

    Args:
        mode: mode of the kernel.
        reading: number of the reading, 0 or 1.
        was_over: whether the row's episode was over before the action.
        outcome: outcome of the row now.
        is_marked: whether the caller asked the row to restart.
    """
    if mode == RESTART:
        return is_marked
    if mode == ACT_OR_RESTART:
        return was_over
    return (reading == 1) & (outcome != 0)
