"""Hybrid LunarLander as a batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from hpamdp.env.gymnasium.environment import SimulatorEnv
from hpamdp.env.lunar_lander.lander import SOLVED, HybridLunarLander
from hpamdp.env.lunar_lander.options import CARDS, LanderRules, LunarLanderOptions

# Mean return, fraction of solved episodes and length of Gymnasium's own hand-written player, over 500 episodes with the
# default settings; experiments/hybrid_control/study.py measures it.
HEURISTIC = {"score": 282.8, "success": 0.998, "steps": 200.7}
_RULES = ("max_steps", "gravity", "enable_wind")  # settings on which these figures depend


class LunarLanderEnv(SimulatorEnv):
    """Land `num_envs` landers at once, with two components: the main engine and the side engines.

    Action leaves:

    - `("action", "discrete")` int64 `[N, 2]`: main engine 0 off, 1 on; side engines 0 off, 1 left, 2 right;
    - `("action", "parameters")` float32 `[N, 3]`: the throttles of `main`, `left` and `right`, in [0.5, 1].

    The dynamics, the observations and the rewards are those of Gymnasium's LunarLanderContinuous-v3; observations are
    not scaled. See `HybridLunarLander`, and `GymnasiumEnv` for the arguments and the errors.
    """

    Options = LunarLanderOptions
    card = CARDS["LunarLanderEnv"]
    simulator = HybridLunarLander
    simulator_options = LanderRules
    # LunarLander's observations are already of order 1, and sometimes exceed the bounds that it declares.
    reading: ClassVar[dict[str, Any]] = {"observation_scaling": "none", "out_of_bounds": "allow"}
    observation_names = ("x", "y", "x_speed", "y_speed", "angle", "angular_speed", "left_leg", "right_leg")
    discrete_names = ("main off", "main on", "side off", "left", "right")

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the return that Gymnasium counts as solved and, with the default rules, its hand-written player."""
        known = {"solved": {"score": SOLVED}}
        has_default_rules = all(getattr(self.options, name) == getattr(LunarLanderOptions(), name) for name in _RULES)
        return {**known, "heuristic": HEURISTIC} if has_default_rules else known
