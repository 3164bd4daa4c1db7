"""Boats that nobody has sailed, as a batched TorchRL environment: an episode is a session of trips with one boat.

People were never told where the keys push. This is their task with boats that the agent has not met, either. It finds
out on the first trips what the keys do, and uses it on the later ones. Duan et al. 2016, *RL^2*, arXiv:1611.02779, call
a session a trial.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, TensorSpec, Unbounded

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.base import Metric
from hpamdp.env.batched_env import KernelEnv, StateArrays
from hpamdp.env.boatdock import harbour, task
from hpamdp.env.boatdock_unseen import fleet, kernel, planner, rules
from hpamdp.env.boatdock_unseen.options import CARDS, FAMILIES, UnseenBoatsOptions
from hpamdp.env.boatdock_unseen.rules import SessionState
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.rng_streams import folded
from hpamdp.env.state_columns import check_range
from hpamdp.geometry import PlaneGeometry, RevealedDirections

if TYPE_CHECKING:
    from hpamdp.env.boatdock_unseen.play.session_page import SessionPage

SESSION_SCORE, SESSION_SUCCESS = "session_score", "session_success"  # entries of the tensordict
_FIRST_TRIPS = 2  # whose scores have metrics of their own


class UnseenBoatsEnv(KernelEnv[SessionState]):
    """Dock unknown boats in `num_envs` harbours at once.

    An episode is a session of `trips` trips. Each trip is an episode of the boats' task, with a layout and a tank of
    its own; the session's boat stays. The press that ends a trip is followed by the start of the next.

    Action leaves:
    - `("action", "discrete")` int64 `[N]` in {0, 1, 2}: the key to press;
    - `("action", "parameters")` float32 `[N, 3]`: seconds in [`shortest_press`, 2] to press each key. Only the pressed
      key's value counts. Values outside are clipped; NaN and infinite values are refused.
    - with `boats=2`, `option` int64 `[N]`: the boat, 0 or 1, read at a trip's first press and held until its end.

    What the keys do is not observed. The observation shows what the last press did, see
    `hpamdp.env.boatdock_unseen.rules.OBSERVATION_NAMES`.

    Entries beside it: `trip_ended` bool `[N, 1]`, whether a trip ended with the last press; `session_score` float32
    `[N, 1]`, the sum of the scores of the trips that have ended, divided by `trips`; `session_success` `[N, 1]`, the
    fraction of the session's trips that have ended at the dock.

    For the constructor's arguments and errors see `BatchedEnv`.
    """

    Options = UnseenBoatsOptions
    card = CARDS["UnseenBoatsEnv"]
    options: UnseenBoatsOptions
    parameter_dims = (1,) * task.NUM_KEYS
    outcomes = rules.OUTCOMES
    observation_names = rules.OBSERVATION_NAMES
    extra_names = (keys.TRIP_ENDED, SESSION_SCORE, SESSION_SUCCESS)
    result_keys = (keys.OUTCOME, SESSION_SCORE, SESSION_SUCCESS)
    action_names = ("key", "durations")
    row_kernel = staticmethod(kernel.advance)
    state_type = SessionState
    num_columns = (16, 12)
    table_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "score of a trip"),
        Metric("score_trip_1", "score of the first trip"),
        Metric("score_trip_2", "score of the second trip"),
        Metric("score_later", "score of the later trips"),
        Metric("success", "trips that dock", "share"),
        Metric("presses", "presses a trip", "count"),
        Metric("optimality_gap", "gap to the ceiling"),
    )
    curve_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "Score of a trip"),
        Metric("score_trip_1", "Score of the first trip"),
        Metric("score_later", "Score of the later trips"),
        Metric("success", "Trips that dock", "share"),
    )

    def _prepare(self) -> None:
        options = self.options
        self.max_steps = options.trips * task.MAX_PRESSES
        self.parameter_low = (options.shortest_press,) * task.NUM_KEYS
        self.parameter_high = (task.MAX_DURATION,) * task.NUM_KEYS
        self._trip_scores = torch.full(
            (self.num_envs, options.trips), torch.nan, device=self.device, dtype=torch.float32
        )
        self._trip_presses = torch.zeros(self.num_envs, options.trips, dtype=torch.int32, device=self.device)

    @property
    def training_begins_elsewhere(self) -> bool:
        """Whether training has a fixed fleet while evaluation draws boats outside of it."""
        return self.options.fleet_size is not None and self.options.scored_boats == "new"

    def kernel_settings(self) -> Sequence[float]:
        """Return the rules in numbers."""
        options = self.options
        return [
            options.trips,
            options.reward == "sparse",
            options.motor_noise,
            options.sensor_noise,
            FAMILIES.index(options.family),
            options.fleet.separation,
            options.spread,
            options.fleet_size or 0,
            folded(options.fleet_seed),
            options.scored_boats == "new",
            options.frame == "first_press",
        ]

    def extra_spec(self, name: str) -> TensorSpec:
        """Return the spec of one of the values beside the observation."""
        shape = (self.num_envs, 1)
        if name == keys.TRIP_ENDED:
            return Binary(1, shape=shape, device=self.device, dtype=torch.bool)
        if name == SESSION_SCORE:
            return Unbounded(shape=shape, device=self.device, dtype=torch.float32)
        return Bounded(0.0, 1.0, shape=shape, device=self.device, dtype=torch.float32)

    def _session_rng(self, episode: Tensor, number: Tensor | int) -> RngKey:
        """Return one of the random-number keys of each session, `[N]`."""
        numbered = episode * rules.NUMBERS_PER_SESSION + number
        return counter_rng.rng_key(self._seed, self._streams[0], self._environment, numbered)

    @property
    def geometry(self) -> PlaneGeometry:
        """The places and displacements, and what reveals where the keys of each boat push.

        A mirrored boat is as likely as the boat itself, so the mirror holds for all families. Every press begins at
        rest, so the velocity moves nothing. The start affects only the distance.
        """
        names = ["start_x", "start_y", "trip", "boat", "last_boat", "last_key_1", "last_key_2", "last_key_3"]
        names += ["last_duration", "moved_x", "moved_y", "last_score"]
        if self.options.sensor_noise == 0.0:
            # The boat's place and the goal's offset tell the goal, and the displacement the velocity's direction.
            names += ["goal_x", "goal_y", "velocity_x", "velocity_y"]
        entry = {name: number for number, name in enumerate(rules.OBSERVATION_NAMES)}
        vectors = ("start", "goal", "boat", "to_goal", "velocity", "moved")
        return PlaneGeometry(
            vectors=tuple((entry[f"{name}_x"], entry[f"{name}_y"]) for name in vectors),
            revealed=RevealedDirections(
                last_action=tuple(entry[f"last_key_{number}"] for number in range(1, task.NUM_KEYS + 1)),
                moved=(entry["moved_x"], entry["moved_y"]),
                sums_to_zero=self.options.family != "any",
                last_option=entry["last_boat"] if self._chooses else None,
            ),
            num_contexts=self.options.boats,
            kinds=(0,) * task.NUM_KEYS,
            has_mirror=True,
            redundant=tuple(entry[name] for name in names),
        )

    def film(self, track: Sequence[Mapping[str, Tensor]], fps: float, size: int) -> Iterator[np.ndarray]:
        """Return the pictures of one session, in which boats move as they do in the task."""
        from hpamdp.env.boatdock_unseen import film  # only films need it

        return film.film(track, fps, size, self.options)

    def page(self, seed: int) -> SessionPage:
        """Return the page on which people sail sessions.

        Raises:
            ValueError: the settings are not those of the page, which has new boats and no noise.
        """
        from hpamdp.env.boatdock_unseen.play.session_page import SessionPage  # only the page needs it

        return SessionPage(seed, self.options)

    def known_boats(self, state: SessionState) -> list[fleet.Boats]:
        """Return what the boats of each session do, which no agent is told: the first and, with two, the second."""
        bits = (state.first_boat, state.second_boat)[: self.options.boats]
        return [fleet.boats(each, self.options.fleet) for each in bits]

    def _on_start(self, mask: Tensor) -> None:
        self._trip_scores[mask] = torch.nan
        self._trip_presses[mask] = 0

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Step, and note how trips ended, for `played`."""
        before = self.state
        td = super()._step(tensordict)
        moved = (self._state.steps > before.steps).nonzero().squeeze(-1)
        trip = before.trip[moved].long()
        self._trip_presses[moved, trip] += 1
        ended = moved[self._state.trip_ended[moved] > 0]
        self._trip_scores[ended, before.trip[ended].long()] = self._state.last_score[ended]
        return td

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return the mean `score` and `success` of the trips of finished (or abandoned) sessions, `[M]`."""
        return {"score": last.get(SESSION_SCORE).squeeze(-1), "success": last.get(SESSION_SUCCESS).squeeze(-1)}

    def check_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Refuse boats, keys, counters and outcomes that do not exist, and trips past the end of a session.

        Raises:
            ValueError: a number is invalid, or the state is of longer sessions.
        """
        super().check_env_state(columns)
        trips, boats = self.options.trips, self.options.boats
        latest = int(columns["trip"].max())
        if latest >= trips:
            raise ValueError(f"a session is in its trip {latest + 1}, but env.trips={trips}; set at least {latest + 1}")
        limits = {"trip": (0, trips), "docked": (0, trips + 1), "presses": (0, task.MAX_PRESSES + 1)}
        limits |= {"boat": (-1, boats), "last_boat": (-1, boats), "last_key": (-1, task.NUM_KEYS), "trip_ended": (0, 2)}
        check_range(columns, limits)

    def trip_ends(self, rows: StateArrays) -> np.ndarray:
        """Return whether a trip ended with the last press, bool `[N]`."""
        return rows.integers[kernel.AT.trip_ended] != 0

    def describe(self) -> dict[str, Tensor]:
        """Return `optimum` `[N, trips]` of the sessions that have just begun: the best score of a plan in each trip.

        It knows the boats, and with two takes the better one.
        """
        state = self.state
        boats, shortest = self.known_boats(state), self.options.shortest_press
        layouts = (harbour.sample_layout(self._session_rng(state.episode, trip)) for trip in range(self.options.trips))
        return {"optimum": torch.stack([planner.best_scores(layout, boats, shortest) for layout in layouts], -1)}

    def final_infos(self, rows: StateArrays) -> dict[str, np.ndarray]:
        """Return `score` and `success`, the fraction of trips that docked, of sessions `[N]`."""
        trips = np.float32(self.options.trips)
        return {"score": rows.floats[kernel.AT.total_score] / trips, "success": rows.integers[kernel.AT.docked] / trips}

    def played(self) -> dict[str, Tensor]:
        """Return `trip_score` and `trip_presses` `[N, trips]` of the sessions of an evaluation."""
        return {"trip_score": self._trip_scores.clone(), "trip_presses": self._trip_presses.clone()}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the mean score by number of the trip, the mean number of presses of a trip, and the best plans' score.

        The `ceiling` is that of plans that know the boats. Nobody reaches it in a first trip.
        """
        score = played["trip_score"].mean(0)
        means = {f"score_trip_{number}": float(each) for number, each in enumerate(score[:_FIRST_TRIPS], start=1)}
        if len(score) > _FIRST_TRIPS:
            means["score_later"] = float(score[_FIRST_TRIPS:].mean())
        return means | {"presses": float(played["trip_presses"].mean()), "ceiling": float(played["optimum"].mean())}
