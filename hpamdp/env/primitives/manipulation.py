"""A robot's arm in a Meta-World task as a Gymnasium environment, whose actions are primitives or position steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces

from hpamdp.env.gymnasium_checks import check_render_mode, reset_options, single_action
from hpamdp.env.primitives.options import ACTIONS, ManipulationRules, Task
from hpamdp.env.primitives.primitives import (
    STEPS,
    phases,
)
from hpamdp.messages import one_line
from hpamdp.settings import SettingError

_XYZ = ("x", "y", "z")
OBSERVED = (
    *(f"hand_{axis}" for axis in _XYZ),
    "opening",
    *(f"object_{axis}" for axis in _XYZ),
    *(f"object_rotation_{number}" for number in range(4)),
    *(f"goal_{axis}" for axis in _XYZ),
    "time_left",
)
# The workspace of Meta-World's hand, in metres; `object` and `goal` are offsets, from the hand and from the object.
LOWEST = np.array([-0.5, 0.4, 0.0, 0.0, *[-0.5] * 3, *[-1.0] * 4, *[-0.5] * 3, 0.0], np.float32)
HIGHEST = np.array([0.5, 1.0, 0.5, 1.0, *[0.5] * 3, *[1.0] * 4, *[0.5] * 3, 1.0], np.float32)

_CAMERA, _PIXELS = "corner2", 320
_NO_LIMIT = 2**62  # Meta-World refuses steps after its own limit; the episode's length is counted here


class Manipulation(gymnasium.Env):
    """Act with primitives, position steps or both in one of six tasks.

    The simulator is Meta-World's (McLean et al. 2025, *Meta-World+*, arXiv 2505.11289), version 3: its scenes, its
    rewards, its `success` and its random places of object and goal, which every reset draws anew.

    - Action: `Tuple(Discrete(K), Tuple(K Boxes))`, distances in metres. See `hpamdp.env.primitives.primitives`.
    - Observation: float32 `[15]`, see `OBSERVED`. `object` is the object's offset from the hand, `goal` is the goal's
      offset from the object. Numbers beyond the bounds are clipped.
    - Reward: that of the setting `reward`, multiplied by the time that the action takes, in primitives. A return is at
      most 10 times `decisions` if it is dense, and `decisions` if not.
    - An episode terminates after `decisions` primitives; 60 small or 6 large position steps take as long as one.

    The info of a step has `is_success`: whether any low-level step of the episode so far was a success. It also has
    `low_level_steps`: how many of Meta-World's steps the action took.

    Args:
        task: the task.
        render_mode: None or `rgb_array`.
        settings: the others of `ManipulationRules`, by name.

    Attributes:
        own_time_limit: most actions of an episode.
        on_low_level_step: None, or called after every low-level step, such as to draw it.

    Raises:
        SettingError: a setting is invalid, Meta-World is not installed, or MuJoCo cannot draw.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}  # noqa: RUF012

    def __init__(
        self, task: Task = "drawer_close", *, render_mode: Literal["rgb_array"] | None = None, **settings: Any
    ) -> None:
        rules = ManipulationRules.of(None, {"task": task, **settings})
        check_render_mode("Manipulation", render_mode)
        self.render_mode = render_mode
        self.actions = ACTIONS[rules.actions]
        self._parameter_dims = [each.num_arguments for each in self.actions]
        self._is_dense = rules.reward == "dense"
        self._ticks = rules.decisions * STEPS
        self._arm = _make_arm(rules.task, render_mode)
        self.observation_space = spaces.Box(LOWEST, HIGHEST, dtype=np.float32)
        boxes = []
        for action in self.actions:
            largest = rules.reach if action.reach is None else action.reach
            is_one_sided = action.num_arguments == 1 and not rules.negative_distances
            low = 0.0 if is_one_sided else -largest
            boxes.append(spaces.Box(low, largest, (action.num_arguments,), np.float32))
        self._boxes = boxes
        self.own_time_limit = self._ticks // min(action.ticks for action in self.actions)
        self.action_space = spaces.Tuple([spaces.Discrete(len(boxes)), spaces.Tuple(boxes)])
        self.on_low_level_step: Callable[[], None] | None = None
        self._ticks_left = 0
        self._is_success = False

    def position(self) -> np.ndarray:
        """Return where the hand is, in metres, `[3]`."""
        return self._arm.get_endeff_pos().copy()

    def holding_effort(self) -> float:
        """Return the effort at which the fingers' actuators exert no force."""
        right, left = self._arm.data.qpos[7:9]
        return float(right - left) / 2.0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode with new places of object and goal."""
        reset_options(options)
        super().reset(seed=seed)
        if seed is not None:
            self._arm.seed(seed)
        seen, _ = self._arm.reset()
        self._ticks_left = self._ticks
        self._is_success = False
        return self._observation(seen), {}

    def step(self, action: tuple[Any, Any]) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Carry out an action, in all its low-level steps. Arguments are clipped to their bounds.

        Raises:
            ValueError: there is no such action, or its arguments are not finite.
            ResetNeeded: no episode has begun, or the last one is over.
        """
        if self._ticks_left == 0:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        number, own = single_action(action, self._parameter_dims)
        chosen, box = self.actions[number], self._boxes[number]
        arguments = np.clip(own.astype(float), box.low, box.high)
        rewards, is_success = [], False
        for phase in phases(chosen, arguments):
            for command in phase.commands(self):
                seen, reward, _, _, info = self._arm.step(command)
                rewards.append(float(reward))
                is_success |= bool(info["success"])
                if self.on_low_level_step is not None:
                    self.on_low_level_step()
        self._is_success |= is_success
        self._ticks_left = max(self._ticks_left - chosen.ticks, 0)
        earned = float(np.mean(rewards)) if self._is_dense else float(is_success)
        info = {"is_success": self._is_success, "low_level_steps": len(rewards)}
        return self._observation(seen), earned * chosen.ticks / STEPS, self._ticks_left == 0, False, info

    def _observation(self, seen: np.ndarray) -> np.ndarray:
        """Return the observation of what Meta-World has observed."""
        hand, opening, place, rotation = seen[:3], seen[3:4], seen[4:7], seen[7:11]
        left = [self._ticks_left / self._ticks]
        observed = np.concatenate([hand, opening, place - hand, rotation, self._arm._target_pos - place, left])
        return np.clip(observed, LOWEST, HIGHEST).astype(np.float32)

    def render(self) -> np.ndarray | None:
        """Return a picture, uint8 `[320, 320, 3]`, if the `render_mode` is `rgb_array`."""
        # This camera of Meta-World's stands on its head.
        return None if self.render_mode is None else np.ascontiguousarray(self._arm.render()[::-1])

    def close(self) -> None:
        """End the episode and close the simulator."""
        self._ticks_left = 0
        self._arm.close()


def _make_arm(task: Task, render_mode: str | None) -> Any:
    """Return Meta-World's own environment, whose resets draw places from the generator that `seed` seeds."""
    try:
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS
    except ImportError as error:
        raise SettingError("Meta-World is not installed; pip install 'hpamdp[robots]'") from error
    except RuntimeError as error:  # of MuJoCo, which reads MUJOCO_GL
        raise SettingError(f"MuJoCo: {one_line(error)}") from error
    drawing = {} if render_mode is None else {"camera_name": _CAMERA, "width": _PIXELS, "height": _PIXELS}
    arm: Any = ALL_V3_ENVIRONMENTS[f"{task.replace('_', '-')}-v3"](render_mode=render_mode, **drawing)
    # As `metaworld.make_mt_envs` does, which however draws 50 places in advance.
    arm._set_task_called, arm._freeze_rand_vec, arm.seeded_rand_vec = True, False, True
    arm.max_path_length = _NO_LIMIT
    if render_mode is not None:
        try:
            arm.reset()
            arm.render()
        except Exception as error:
            raise SettingError("MuJoCo cannot draw here; without a display, set MUJOCO_GL=egl or osmesa") from error
    return arm
