"""Hybrid LunarLander as a batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial, update_wrapper
from typing import Any, ClassVar

import torch

from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.env.gymnasium.options import GymnasiumOptions
from hpamdp.env.lunar_lander.lander import SOLVED, HybridLunarLander
from hpamdp.env.lunar_lander.options import CARDS, LanderRules, LunarLanderOptions
from hpamdp.settings import Settings

# Mean return, fraction of solved episodes and length of Gymnasium's own hand-written player, over 500 episodes with the
# default settings; experiments/hybrid_control/study.py measures it.
HEURISTIC = {"score": 282.8, "success": 0.998, "steps": 200.7}
_RULES = ("max_steps", "gravity", "enable_wind")  # settings on which these figures depend


class LunarLanderEnv(GymnasiumEnv):
    """Land `num_envs` landers at once, with two components: the main engine and the side engines.

    Action leaves:

    - `("action", "discrete")` int64 `[N, 2]`: main engine 0 off, 1 on; side engines 0 off, 1 left, 2 right;
    - `("action", "parameters")` float32 `[N, 3]`: the throttles of `main`, `left` and `right`, in [0.5, 1].

    The dynamics, the observations and the rewards are those of Gymnasium's LunarLanderContinuous-v3; observations are
    not scaled. See `HybridLunarLander`, and `GymnasiumEnv` for the arguments and the errors.
    """

    Options: ClassVar[type[Settings]] = LunarLanderOptions
    card = CARDS["LunarLanderEnv"]
    observation_names = ("x", "y", "x_speed", "y_speed", "angle", "angular_speed", "left_leg", "right_leg")
    discrete_names = ("main off", "main on", "side off", "left", "right")

    def __init__(
        self,
        num_envs: int = 1,
        *,
        options: LunarLanderOptions | None = None,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
        **settings: Any,
    ) -> None:
        given = LunarLanderOptions.of(options, settings)
        self._has_default_rules = all(getattr(given, name) == getattr(LunarLanderOptions(), name) for name in _RULES)
        rules = {name: getattr(given, name) for name in LanderRules.model_fields}
        # LunarLander's observations are already of order 1, and sometimes exceed the bounds that it declares.
        reading = GymnasiumOptions(
            max_steps=given.max_steps,
            observation_scaling="none",
            out_of_bounds="allow",
            reward_scaling=given.reward_scaling,
            num_workers=given.num_workers,
        )
        make = partial(HybridLunarLander, render_mode="rgb_array" if given.render else None, **rules)
        update_wrapper(make, HybridLunarLander)  # so that errors name HybridLunarLander
        super().__init__(
            num_envs,
            make=make,
            options=reading,
            device=device,
            seed=seed,
            first_env=first_env,
        )

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the return that Gymnasium counts as solved and, with the default rules, its hand-written player."""
        known = {"solved": {"score": SOLVED}}
        return {**known, "heuristic": HEURISTIC} if self._has_default_rules else known
