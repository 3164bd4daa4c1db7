"""Make Gymnasium environments that return values outside their spaces, judged by a separate rule."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from tensordict import TensorDict

from hpamdp.env.gymnasium.environment import GymnasiumEnv

from .case import ACCEPTED, SILENT, Case

LEAVES: dict[str, spaces.Space] = {
    "Box of float32": spaces.Box(-1.0, 1.0, (2,), np.float32),
    "Box of float64": spaces.Box(-5.0, 5.0, (2,), np.float64),
    "Box of float16": spaces.Box(-8.0, 8.0, (2,), np.float16),
    "Box of int8": spaces.Box(-100, 100, (2,), np.int8),
    "Box of uint8": spaces.Box(0, 255, (2,), np.uint8),
    "Box of int64": spaces.Box(-(10**6), 10**6, (2,), np.int64),
    "Box of bool": spaces.Box(0, 1, (2,), np.bool_),
    "Box without bounds": spaces.Box(-np.inf, np.inf, (2,), np.float32),
    "Box of two dimensions": spaces.Box(-1.0, 1.0, (2, 2), np.float32),
    "Discrete": spaces.Discrete(5),
    "Discrete from 3 on": spaces.Discrete(4, start=3),
    "MultiDiscrete": spaces.MultiDiscrete([3, 4]),
    "MultiBinary": spaces.MultiBinary(2),
}
VALUES: list[Any] = [
    0, 1, 2, 3, 5, -1, 0.0, 0.5, 1.0, 0.7, 300, 256, 255, -101, 1e6, 1e7, 70000.0, 3e38, 1e300, 2**63, 10**400,
    float("nan"), float("inf"), float("-inf"), True, None, "0.5", "word", b"x", 1 + 1j, object(),
    np.float16(0.5), np.float64(0.1), np.int8(3), np.bool_(True), np.str_("1"), [0], [], [0, 0], [0.5, 0.5], [1, 1],
    [0.7, 300], [0, float("nan")], [1, None], ["0", "0"], [[0, 0]], [[0], [0]], [[0, 0], [0, 0]], [0, 0, 0], (0, 1),
    {"a": 0}, [True, False], [1e9, 0], np.zeros(2, np.complex64), np.array([0, 1], object), np.zeros((2, 1)),
    np.zeros((1, 2)), np.zeros((2, 2)), np.zeros(0), np.array(["1", "2"]), np.array([1, 2], "datetime64[D]"),
    np.ma.masked_array([0.5, 0.5], [True, False]), np.full(2, 200, np.uint8), np.array([0.1, -0.1], np.float16),
    np.array([2, 3]), np.array([3, 4]), np.array([-1, 0]), np.array([1, 0], bool), np.array(3), np.array([3]),
    np.array(2.0), np.array(2.5), range(2), {0, 1}, np.zeros(10**6),
]  # fmt: skip
PLACES = ("alone", "in a Dict", "in a Tuple in a Dict")
FLAGS: list[Any] = [
    float("nan"), "False", "", "yes", None, [], [True], [True, False], np.array([1]), np.array([0.5]), np.zeros(2), 2,
    -1, 0.5, 1.0, np.bool_(False), np.float64("nan"), object(), {"success": True}, True, False, 0, 1, 1 + 0j, b"1",
]  # fmt: skip
REWARDS: list[Any] = [
    None, "1", "", float("nan"), float("inf"), 1e39, -1e300, 10**400, 1 + 1j, [1.0], [1.0, 2.0], np.zeros(0),
    np.array([[0.5]]), object(), {"reward": 1}, True, np.float16(2.0), np.bool_(True), np.array("1"), b"1", 3, -2.5,
]  # fmt: skip
MASK_NAMES = (
    "action_masks",
    "action_mask",
    "avail_actions",
    "legal_actions",
    "valid_actions",
    "available_actions",
    "mask",
)
MASKS: list[Any] = [
    np.array([1, 0], np.int8), [True, False], [1.0, 0.0], np.array([0, 0]), [1], [1, 0, 1], [2, 0], [-1, 1], [0.5, 1],
    None, "10", [float("nan"), 1], np.array([[1, 0]]), {"0": 1}, 1,
]  # fmt: skip


class Strange(gymnasium.Env):
    """An environment whose observation has a leaf `leaf`, with a given value from a given step on."""

    def __init__(
        self,
        leaf: spaces.Space,
        place: str = "alone",
        late: int = 0,
        returns: dict[str, Any] | None = None,
        reset_info: dict[str, Any] | None = None,
    ) -> None:
        self.leaf = leaf
        self.place = place
        self.late = late
        self.returns = returns or {}
        self.reset_info = reset_info or {}
        self.observation_space = self._placed(leaf, spaces.Tuple, spaces.Dict, spaces.Discrete(3))
        self.action_space = spaces.Tuple(
            (spaces.Discrete(2), spaces.Tuple((spaces.Box(-1, 1, (1,)), spaces.Box(-1, 1, (1,)))))
        )
        self.num_steps = 0

    def _placed(self, value: Any, as_tuple: Any, as_dict: Any, other: Any) -> Any:
        if self.place == "alone":
            return value
        if self.place == "in a Dict":
            return as_dict({"leaf": value, "other": other})
        return as_dict({"inner": as_tuple((other, value)), "other": other})

    def _look(self) -> Any:
        self.leaf.seed(0)
        value = self.leaf.sample()
        if self.num_steps >= self.late and "observation" in self.returns:
            value = self.returns["observation"]
        return self._placed(value, tuple, dict, 1)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> Any:
        super().reset(seed=seed)
        self.num_steps = 0
        return self._look(), dict(self.reset_info)

    def step(self, action: Any) -> Any:
        self.num_steps += 1
        is_late = self.num_steps >= self.late
        given = self.returns if is_late else {}
        terminated, truncated = given.get("terminated", False), given.get("truncated", False)
        return self._look(), given.get("reward", 0.25), terminated, truncated, given.get("info", {})


def holds(leaf: spaces.Space, value: Any) -> bool | None:
    """Return whether a leaf's space holds a value; None if reasonable programs differ.

    The comparison is made in the value's own type, before anything is cast.
    """
    if isinstance(value, np.ma.MaskedArray):
        return None
    array = _as_array(value)
    if array is None:
        return False
    return _holds_one(leaf, array) if isinstance(leaf, spaces.Discrete) else _holds_all(leaf, array)


def _as_array(value: Any) -> np.ndarray | None:
    try:
        array = np.asarray(value)
    except (ValueError, OverflowError):
        return None
    return array if array.dtype.kind in "biuf" and not isinstance(value, dict | set | str | bytes) else None


def _holds_one(leaf: spaces.Discrete, array: np.ndarray) -> bool | None:
    if array.size != 1 or (array.dtype.kind == "f" and not float(array.item()).is_integer()):
        return False
    is_inside = bool(leaf.start <= int(array.item()) < leaf.start + leaf.n)
    return None if is_inside and (array.ndim or array.dtype.kind in "fb") else is_inside


def _holds_all(leaf: Any, array: np.ndarray) -> bool | None:
    if array.shape != leaf.shape:
        return False
    numbers = array.astype(np.float64)
    is_whole = leaf.dtype.kind == "f" or bool((numbers == np.rint(numbers)).all())
    if not np.isfinite(numbers).all() or not is_whole:
        return False
    if isinstance(leaf, spaces.Box):
        low, high = leaf.low.astype(np.float64), leaf.high.astype(np.float64)
    elif isinstance(leaf, spaces.MultiDiscrete):
        low, high = leaf.start.astype(np.float64), (leaf.start + leaf.nvec - 1).astype(np.float64)
    else:
        low, high = np.zeros(leaf.shape), np.ones(leaf.shape)
    if ((numbers >= low) & (numbers <= high)).all():
        return True if array.dtype.kind == leaf.dtype.kind else None
    is_rounding = np.allclose(np.clip(numbers, low, high), numbers, rtol=1e-3)
    return None if is_rounding else False


def cases(seed: int) -> Iterator[Case]:
    """Yield all cases: leaves by values by places, flags and rewards, and masks."""
    yield from _observations(random.Random(seed))
    yield from _flags_and_rewards()
    for name in MASK_NAMES:
        for value in MASKS:
            for where in ("info of the reset", "info of a step", "an entry of a Dict", "a method", "an attribute"):
                what = f"{name} in {where} is {_written(value)}"
                yield Case("masks", what, _Masked(name, value, where), False, (ValueError,))


def _observations(chance: random.Random) -> Iterator[Case]:
    for name, leaf in LEAVES.items():
        for number, value in enumerate(VALUES):
            place = chance.choice(PLACES)
            late = chance.choice((0, 1, 3))
            wanted = holds(leaf, value)
            yield Case(
                "observations",
                f"{name} {place} returns {_written(value)} (number {number}) from step {late} on",
                _Play(leaf, place, late, {"observation": value}, is_fine=wanted is True),
                must_be_refused=wanted is False,
                refusals=(ValueError,),
            )


def _flags_and_rewards() -> Iterator[Case]:
    for key in ("terminated", "truncated"):
        for value in FLAGS:
            yield _of_step(key, value, is_wrong=not _is_flag(value), is_fine=isinstance(value, bool | np.bool_))
    for value in REWARDS:
        is_number = isinstance(value, int | float | np.generic) and np.isfinite(np.float64(_small(value)))
        yield _of_step("reward", value, is_wrong=False, is_fine=is_number and abs(_small(value)) < 1e38)
    for name in ("is_success", "success"):
        for value in FLAGS:
            is_fine = isinstance(value, bool | np.bool_)
            info = {name: value}
            yield _of_step("info", info, is_wrong=not _is_flag(value) and value is not None, is_fine=is_fine)
            yield _of_step("info", {**info, "success": True}, is_wrong=False, is_fine=False)


def _small(value: Any) -> float:
    try:
        return float(value)
    except (OverflowError, TypeError, ValueError):
        return float("inf")


def _is_flag(value: Any) -> bool:
    try:
        array = np.asarray(value)
    except ValueError:
        return False
    return array.dtype.kind in "biuf" and array.size == 1 and array.item() in (0, 1)


def _of_step(key: str, value: Any, *, is_wrong: bool, is_fine: bool) -> Case:
    leaf = LEAVES["Box of float32"]
    return Case(
        "rewards, flags and infos",
        f"{key} is {_written(value)}",
        _Play(leaf, "alone", 1, {key: value}, is_fine=is_fine),
        must_be_refused=is_wrong,
        refusals=(ValueError,),
    )


def _written(value: Any) -> str:
    return f"{type(value).__name__} {str(value)[:40]}"


@dataclass(frozen=True)
class _Play:
    """Play some steps; a value in the space must be accepted."""

    leaf: spaces.Space
    place: str
    late: int
    returns: dict[str, Any]
    is_fine: bool

    def __call__(self, folder: Path) -> str:
        kwargs = {"leaf": self.leaf, "place": self.place, "late": self.late, "returns": self.returns}
        try:
            _steps(kwargs)
        except Exception as error:
            if self.is_fine:
                return f"{SILENT}: a right value was refused: {str(error)[:100]}"
            raise
        return ACCEPTED


def _steps(kwargs: dict[str, Any]) -> tuple[GymnasiumEnv, TensorDict]:
    gymnasium.register("hostile/Strange-v0", Strange)
    env = GymnasiumEnv(2, id="hostile/Strange-v0", kwargs=kwargs, max_steps=6)
    return env, env.rollout(6, break_when_any_done=False)


@dataclass(frozen=True)
class _Masked:
    """Play an environment that forbids the second action, which must not be taken without a message."""

    name: str
    value: Any
    where: str

    def __call__(self, folder: Path) -> str:
        name, value, where = self.name, self.value, self.where
        taken = []

        class Masked(Strange):
            def __init__(self) -> None:
                late = {"info of a step": {"info": {name: value}}}.get(where, {})
                super().__init__(
                    LEAVES["Box of float32"], "alone", 1, late, {name: value} if where == "info of the reset" else None
                )
                if where == "an entry of a Dict":
                    self.observation_space = spaces.Dict(
                        {
                            "state": self.leaf,
                            "inner": spaces.Dict({name: spaces.Box(0, 1, (2,), np.int8), "x": spaces.Discrete(2)}),
                        }
                    )
                if where == "an attribute":
                    setattr(self, name, value)
                if where == "a method":
                    setattr(self, name, lambda: value)

            def _look(self) -> Any:
                look = super()._look()
                return {"state": look, "inner": {name: value, "x": 0}} if where == "an entry of a Dict" else look

            def step(self, action: Any) -> Any:
                taken.append(int(action[0]))
                return super().step(action)

        gymnasium.register("hostile/Masked-v0", Masked)
        env = GymnasiumEnv(4, id="hostile/Masked-v0", max_steps=6)
        env.rollout(12, break_when_any_done=False)
        # A name such as `mask` means something else if the lengths differ.
        is_mask = value is not None and np.asarray(value).reshape(-1).tolist() in ([1, 0], [True, False])
        if is_mask and 1 in taken and "action_mask" not in env.observation_spec.keys():
            return f"{SILENT}: {np.mean(np.array(taken) == 1):.0%} forbidden actions"
        return ACCEPTED
