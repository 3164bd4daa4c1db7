"""The traffic lights of a crossing or a corridor, as a Gymnasium environment."""

from __future__ import annotations

from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium import spaces

from hpamdp.env.gymnasium_checks import check_render_mode, reset_options, single_action
from hpamdp.env.traffic.demand import HELD_OUT, NUM_DEMANDS
from hpamdp.env.traffic.network import MAX_GREEN, MIN_GREEN, NETWORKS, network_file
from hpamdp.env.traffic.options import PHASES, PLAYERS, TrafficRules
from hpamdp.env.traffic.process import SimulationProcess
from hpamdp.env.traffic.simulation import Seen, Task, observation_names

_NONE = spaces.Box(0.0, 1.0, (0,), np.float32)


class TrafficLights(gymnasium.Env):
    """Choose at each decision which phase of a signal comes next, and for how many seconds it stays green.

    In the corridor the agent sets one of three signals at each decision: the one whose green has ended. Between
    different phases there are 3 s of yellow. An episode lasts `minutes`, and is then truncated.

    The action is `Tuple(Discrete(4), Tuple(Box, Box, Box, Box))`: the phase, and the green of each phase. With
    `strategies` there are four more discrete actions without parameters: what fixed times by Webster's formula, SUMO's
    actuated signals, max-pressure and the longest queue would do now.

    `reset(seed=n)` begins the demand number n, below 2**31. Without a seed, the demand is drawn from those below 2**30;
    so all others are unknown in training. The info of the last step has `delay`, `queue`, `stops` and `throughput`.

    Args:
        render_mode: None or `rgb_array`.
        settings: those of `TrafficRules`, by name.

    Attributes:
        own_time_limit: most decisions of an episode.
        results: of the last episode that ended, as in the info.

    Raises:
        SettingError: an argument is wrong, or SUMO is not installed.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}  # noqa: RUF012 (Gymnasium's own declaration)

    def __init__(self, *, render_mode: Literal["rgb_array"] | None = None, **settings: Any) -> None:
        rules = TrafficRules.of(None, settings)
        network, seconds = rules.network, 60 * rules.minutes
        check_render_mode("TrafficLights", render_mode)
        self.render_mode = render_mode
        file = str(network_file(network))
        self._task = Task(network, rules.demand, file, seconds, rules.traffic, rules.reward, render_mode is not None)
        green = spaces.Box(MIN_GREEN, MAX_GREEN, (1,), np.int64 if rules.whole_seconds else np.float32)
        boxes = (*(green for _ in PHASES), *(_NONE for _ in PLAYERS if rules.strategies))
        self._parameter_dims = [*(1 for _ in PHASES), *(0 for _ in PLAYERS if rules.strategies)]
        self.action_space = spaces.Tuple([spaces.Discrete(len(boxes)), spaces.Tuple(boxes)])
        num_entries = len(observation_names(network))
        self.observation_space = spaces.Box(-np.inf, np.inf, (num_entries,), np.float32)
        self.own_time_limit = (seconds // MIN_GREEN + 1) * len(NETWORKS[network])
        self.results: dict[str, float] = {}
        self._last: Seen | None = None
        self._simulation: SimulationProcess | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        reset_options(options)
        super().reset(seed=seed)
        number = int(self.np_random.integers(HELD_OUT)) if seed is None else seed
        if not 0 <= number < NUM_DEMANDS:
            raise ValueError(f"reset: seed={seed}, but demands have numbers from 0 to {NUM_DEMANDS - 1}")
        if self._simulation is None:
            self._simulation = SimulationProcess(self._task)
        self._last = self._simulation.begin(number)
        return self._last.observation, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Set the signal that is due, and simulate until the next decision. Greens are clipped to their bounds.

        Raises:
            ValueError: there is no such action, or its green is not finite.
            ResetNeeded: no episode has begun, or the last one is over.
        """
        if self._simulation is None or self._last is None or self._last.is_over:
            raise gymnasium.error.ResetNeeded("step: call reset first")
        chosen, own = single_action(action, self._parameter_dims)
        if chosen < len(PHASES):
            self._last = self._simulation.act(chosen, min(max(float(own[0]), MIN_GREEN), MAX_GREEN))
        else:
            self._last = self._simulation.follow(PLAYERS[chosen - len(PHASES)])
        if self._last.is_over:
            self.results = self._last.results
        return self._last.observation, self._last.reward, False, self._last.is_over, self._last.results

    def last_results(self) -> dict[str, float]:
        """Return the attribute `results`."""
        return self.results

    def last_seconds(self) -> int:
        """Return how long the last step took, in simulated s."""
        if self._last is None:
            raise gymnasium.error.ResetNeeded("last_seconds: call reset first")
        return self._last.seconds

    def play(self, player: str) -> dict[str, float]:
        """Return the results of a hand-written player on the demand of the last episode, whose rest is not played."""
        if self._simulation is None:
            raise gymnasium.error.ResetNeeded("play: call reset first")
        return self._simulation.play(player)

    def render(self) -> np.ndarray:
        """Return a picture of the network, uint8 `[height, width, 3]`."""
        from hpamdp.env.traffic.rendering import draw

        if self._last is None or self._last.scene is None:
            raise ValueError("render: needs render_mode='rgb_array', and a reset first")
        return draw(self._task.network, self._last.scene)

    def close(self) -> None:
        """End the process of the simulation, which the first reset starts."""
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = self._last = None
