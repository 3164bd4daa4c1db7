"""The boat-docking task as a batched TorchRL environment: the key-press PAMDP with the controller choice as a leaf.

Source: *A Benchmark for Hierarchical Parameterized Action Markov Decision Process*, with constants measured on its
human data. Layouts given to `reset` and `pixels` observations are in screen px. The state, `position` and `describe`
are in px from the harbour's centre.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec

from hpamdp import keys
from hpamdp.env.base import Metric
from hpamdp.env.batched_env import KernelEnv
from hpamdp.env.boatdock import harbour, kernel, planner, task
from hpamdp.env.boatdock.form import BoatForm
from hpamdp.env.boatdock.human_choices import choice_probabilities, human_spec
from hpamdp.env.boatdock.layouts import layout_columns
from hpamdp.env.boatdock.options import CARDS, BoatDockOptions
from hpamdp.env.boatdock.oracle import BoatDockOracle
from hpamdp.env.boatdock.reference import human_normalised, human_references
from hpamdp.env.boatdock.scores import measure_boats
from hpamdp.env.boatdock.task import BoatState
from hpamdp.env.play_page import EpisodeError
from hpamdp.env.state_columns import check_range
from hpamdp.geometry import PlaneGeometry, Symmetries, as_directions, make_symmetries, on_observations, plane_maps
from hpamdp.settings import SettingError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hpamdp.env.boatdock.play.boat_page import BoatPage

_MOST_SWAPPED = 4  # controllers; if there are more, symmetries swap none

_CONTROLLER_ENTRY = task.OBSERVATION_NAMES.index("controller")


class BoatDockEnv(KernelEnv[BoatState]):
    """Dock boats in `num_envs` harbours at once.

    Action leaves:
    - `("action", "discrete")` int64 `[N]` in {0, 1, 2}: the key to press;
    - `("action", "parameters")` float32 `[N, 3]`: seconds in [0, 2] to press each key. Only the pressed key's value
      counts. Values outside are clipped; NaN and infinite values are refused.
    - with `controller="choose"`, `option` int64 `[N]` (0 incongruent, 1 congruent, or the number in `boats`): read at
      an episode's first press and held until its end; with a `switch_cost`, read at every press.

    Args:
        num_envs: number of environments.
        options: the settings; None for the defaults.
        oracle: also write what the planner knows under `oracle` (`option` `[N]`; `discrete`, `parameters`
            `[N, num_options]`, or `[N, 1]` if the agent does not choose the controller).
        human: also write how often people choose each controller under `human` (`option` `[N, 2]`).
        device: of the tensors.
        seed: of layouts, random controllers and noise; the global generators are neither read nor moved.
        first_env: number of the first environment, if other processes have those before it.
        settings: single settings by name, in place of those in `options`.

    `reset` also takes layouts to play: a tensordict with `start` and `goal` `[N, 2]` in screen px and, optionally,
    `controller` and `keymap` int `[N]`.

    Raises:
        ValueError: an argument, action or layout that is out of range; no environment has changed.
        RuntimeError: a step before the first reset, or before the one after `set_seed`.
    """

    Options = BoatDockOptions
    card = CARDS["BoatDockEnv"]
    options: BoatDockOptions
    parameter_dims = (1,) * task.NUM_KEYS
    parameter_low = (0.0,) * task.NUM_KEYS
    parameter_high = (task.MAX_DURATION,) * task.NUM_KEYS
    max_steps = task.MAX_PRESSES
    outcomes = task.OUTCOMES
    extra_names = (task.FUEL,)
    result_keys = (keys.OUTCOME, task.FUEL)
    start_keys = frozenset({"start", "goal", "controller", "keymap"})
    action_names = ("key", "durations")
    row_kernel = staticmethod(kernel.advance)
    state_type = BoatState
    num_columns = (9, 5)
    table_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "score"),
        Metric("human_normalised", "human-normalised score"),
        *(Metric(name, name.replace("_", " "), "share") for name in task.OUTCOMES[1:]),
        Metric("steps", "presses an episode", "count"),
        Metric("option_congruent", "congruent controller", "share"),
        Metric("option_changes", "controller changes an episode", "count"),
        Metric("oracle_agreement", "oracle's choice", "share"),
        Metric("optimality_gap", "gap to the ceiling"),
    )
    curve_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "Score"),
        Metric("success", "Episodes that succeed", "share"),
        Metric("oracle_agreement", "Better controller chosen", "share"),
        Metric("option_congruent", "Congruent controller chosen", "share"),
    )

    def _prepare(self) -> None:
        options = self.options
        if self._has_human and not options.are_peoples:
            raise SettingError(
                f"{options.unlike_peoples()}: people kept one of their two controllers, so what they chose says "
                "nothing here; leave it out"
            )
        self.observation_names = task.observation_names(self.options.observation)
        self._played = None if options.recording is None else _figures_of(options.recording, options.controller)
        if self._has_oracle:
            self.planning_oracle = BoatDockOracle(self.num_envs, self.options, self.device)

    def kernel_settings(self) -> Sequence[float]:
        """Return the rules in numbers."""
        return kernel.settings_of(self.options)

    def start_columns(self, given: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """Check a layout and return the columns of the state that it sets."""
        return layout_columns(given, self.num_envs, self.options)

    def gymnasium_form(self) -> BoatForm:
        """Return the form of `hpamdp/BoatDock-v0`."""
        return BoatForm(self, self.options)

    @property
    def symmetries(self) -> Symmetries:
        """The rotations and reflections of the plane that permute the directions of a controller or swap controllers.

        Six maps keep each of the two controllers. Six more swap it for the other one, whose directions are opposite. A
        random key map is not observed, so only maps remain that permute the keys of both key maps alike. If motor noise
        differs between controllers, only maps remain that keep the controllers.
        """
        tables = self._directions()
        found = []  # (map, permutation of the controllers, permutation of the keys)
        for each in plane_maps(6):
            for order in self._orders(len(tables)):
                rows = [_as_one_table(each, own, tables[other]) for own, other in zip(tables, order, strict=True)]
                mapped = [row for row in rows if row is not None]
                if len(mapped) == len(rows):
                    found.append((each, order, torch.stack(mapped)))
                    break
        kept = torch.stack([each for each, _, _ in found])
        weight, offset = on_observations(kept, len(self.observation_names), *self._vectors())
        keys_after = torch.stack([mapped for _, _, mapped in found])
        contexts = torch.tensor([order for _, order, _ in found])
        return make_symmetries(
            weight,
            offset=offset,
            discrete=keys_after,
            source=keys_after.argsort(-1),  # key k has parameter k
            contexts=contexts,
            context_entry=_CONTROLLER_ENTRY if len(tables) > 1 else None,
            num_parameters=harbour.NUM_KEYS,
        )

    def _orders(self, num_controllers: int) -> list[tuple[int, ...]]:
        """Return the permutations of the controllers that a map may cause.

        Only controllers of equal noise swap. With more than `_MOST_SWAPPED`, none do.
        """
        same = tuple(range(num_controllers))
        orders = list(itertools.permutations(same)) if num_controllers <= _MOST_SWAPPED else [same]
        noise = self.options.noises
        return [order for order in orders if num_controllers == 1 or [noise[number] for number in order] == list(noise)]

    @property
    def geometry(self) -> PlaneGeometry:
        """The places and the velocity, and where the keys point, unless the key map is random.

        Some entries are redundant. Every press begins at rest, so the velocity does not matter. The start affects only
        the distance. The harbour is always the same. The goal follows from its offset.
        """
        names = ["start_x", "start_y", "centre_x", "centre_y", "radius", "velocity_x", "velocity_y"]
        if self.options.observation == "scaled" and self.options.sensor_noise == 0.0:
            names += ["goal_x", "goal_y"]
        tables = self._directions()
        if len(tables) == 1:
            names.append("controller")  # always the same one
        vectors, origins = self._vectors()
        is_known = all(len(table) == 1 for table in tables)
        return PlaneGeometry(
            num_contexts=len(tables),
            context_entry=_CONTROLLER_ENTRY if len(tables) > 1 else None,
            vectors=vectors,
            origins=origins,
            directions=torch.stack([table[0] for table in tables]).float() if is_known else None,
            kinds=(0,) * harbour.NUM_KEYS if is_known else (),
            has_mirror=True,
            redundant=tuple(task.OBSERVATION_NAMES.index(name) for name in names),
        )

    def _directions(self) -> list[list[Tensor]]:
        """Return the possible tables of the keys' directions for each controller, float64 `[3, 2]`."""
        boats = self.options.own_boats
        if boats is not None:
            of_each = [[table] for table in torch.tensor(boats.directions, dtype=torch.float64)]
            is_fixed = self.options.controller in boats.names
            return [of_each[boats.names.index(self.options.controller)]] if is_fixed else of_each
        maps = (1, 2) if self.options.keymap == "random" else (self.options.keymap,)
        table = torch.tensor(harbour.DIRECTIONS, dtype=torch.float64)
        both = [[table[number - 1] for number in maps], [table[2]]]
        if self.options.controller in harbour.CONTROLLERS:
            return [both[harbour.CONTROLLERS.index(self.options.controller)]]
        return both

    def _vectors(self) -> tuple[tuple[tuple[int, int], ...], tuple[tuple[float, float], ...]]:
        """Return which entries of the observation are vectors, and from where on they are measured."""
        places: tuple[tuple[int, int], ...] = ((0, 1), (2, 3), (8, 9))
        if self.options.observation == "pixels":
            return (*places, (10, 11)), (*[harbour.CENTRE] * len(places), (0.0, 0.0))
        return (*places, (10, 11), (14, 15)), ()

    def fixed_episodes(self, seed: int) -> TensorDict:
        """Return layouts to `reset` with, one for each environment. No training episode has them, whatever its seed."""
        layout = harbour.fixed_layouts(self.num_envs, seed, first=int(self._environment[0]))
        centre = torch.tensor(harbour.CENTRE, dtype=torch.float32)
        points = {"start": torch.stack(layout[:2], -1) + centre, "goal": torch.stack(layout[2:], -1) + centre}
        return TensorDict(points, batch_size=self.batch_size, device=self.device)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `outcome`, `fuel` (fraction), `score` and `success` `[M]` of finished (or abandoned) episodes."""
        outcome, fuel = last.get(keys.OUTCOME), last.get(task.FUEL).squeeze(-1)
        score = harbour.score(outcome, fuel)
        return {"outcome": outcome, "fuel": fuel, "score": score, "success": outcome == task.SUCCESS}

    def describe(self) -> dict[str, Tensor]:
        """Return the layouts of an evaluation, px from the harbour's centre.

        `start` and `goal` `[N, 2]`, `bearing_offset` `[N]` in degrees, and `optimum` `[N, num_controllers]`: the best
        possible score from a full tank with each controller; with a `switch_cost`, the best that begins with it. If the
        agent does not choose, also `controller` `[N]`.
        """
        state = self.state
        layout = harbour.Layout(state.start_x, state.start_y, state.goal_x, state.goal_y)
        known = {
            "start": torch.stack(layout[:2], -1),
            "goal": torch.stack(layout[2:], -1),
            "bearing_offset": harbour.bearing_offset(layout),
            "optimum": planner.best_scores(self.options, layout, state.keymap),
        }
        return known if self.has_choice else {**known, "controller": state.controller}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the means of `measure_boats`."""
        return measure_boats(played, self._controller_of_run, self.options)

    @property
    def _controller_of_run(self) -> str:
        """`chosen` if the agent chooses, otherwise the setting `controller`."""
        return "chosen" if self.has_choice else self.options.controller

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the figures of the ceiling and, with the two standard controllers, of people or of a recording."""
        ceiling = {**super().references(measured)["ceiling"], "success": measured.get("ceiling_success", 1.0)}
        if self.has_choice:
            ceiling["oracle_agreement"] = 1.0
        if self.options.boats is not None:
            return {"ceiling": ceiling}
        ceiling["human_normalised"] = human_normalised(ceiling["score"], self._controller_of_run)
        if self._played is not None:
            return {"you": self._played, "ceiling": ceiling}
        return {**human_references(self._controller_of_run), "ceiling": ceiling}

    def summary_entries(self) -> dict[str, Any]:
        """Return the `controller`, `chosen` if the agent chooses, and the setting `boats`, if given."""
        values = {"controller": self._controller_of_run}
        return values if self.options.boats is None else {**values, "boats": list(self.options.names)}

    @classmethod
    def curves(cls, summary: Mapping[str, Any]) -> tuple[Metric, ...]:
        """Return the panels of the learning curves; with `boats`, also how often each controller is chosen."""
        if not summary.get("boats"):
            return cls.curve_metrics
        choices = (Metric(f"option_{name}", f"{name} chosen", "share") for name in summary["boats"])
        return (*(metric for metric in cls.curve_metrics if not metric.name.startswith("option_")), *choices)

    @classmethod
    def draw_figures(cls, evaluation: Mapping[str, np.ndarray], summary: Mapping[str, Any]) -> dict[str, Figure]:
        """Return `trajectories.png` and, if the agent chose its controller, `choices.png`."""
        from hpamdp.env.boatdock import figures  # matplotlib takes long to import

        return figures.draw(evaluation, summary)

    def film(self, track: Sequence[Mapping[str, Tensor]], fps: float, size: int) -> Iterator[np.ndarray]:
        """Return the pictures of one episode, in which the boat moves as it does in the task."""
        from hpamdp.env.boatdock import film  # only films need it

        return film.film(track, fps, size, self.options.own_boats, self.options.switch_cost)

    def page(self, seed: int) -> BoatPage:
        """Return the page on which people dock boats.

        Raises:
            ValueError: the settings are not those of the page, which has the two standard controllers without noise.
        """
        from hpamdp.env.boatdock.play.boat_page import BoatPage

        return BoatPage(seed, self.options)

    def check_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Refuse controllers, key maps, counters and outcomes that do not exist.

        Raises:
            ValueError: a number is invalid.
        """
        super().check_env_state(columns)
        check_range(columns, {"controller": (-1, len(self.options.names)), "keymap": (0, 3)})

    def _knowledge_specs(self) -> dict[str, TensorSpec]:
        human = {"human": human_spec(self.num_envs, self.device)} if self._has_human else {}
        return human | super()._knowledge_specs()

    def _knowledge(self) -> dict[str, Any]:
        """Return how often people choose each controller, and what the planner knows."""
        human = {"human": {"option": choice_probabilities(self._state)}} if self._has_human else {}
        return human | super()._knowledge()


def _figures_of(recording: str, controller: str) -> dict[str, float]:
    """Return a recording's mean results. If the controller is fixed, only its episodes count."""
    from hpamdp.env.boatdock.play import episodes  # only recordings need it

    of_controller = controller if controller in harbour.CONTROLLERS else None
    try:
        means = episodes.figures([*episodes.read(Path(recording)).values()], of_controller)
    except EpisodeError as error:
        raise SettingError(str(error)) from error
    return {
        **means,
        "human_normalised": human_normalised(means["score"], "chosen" if of_controller is None else controller),
    }


def _as_one_table(plane: Tensor, tables: list[Tensor], targets: list[Tensor]) -> Tensor | None:
    """Return which keys the keys become, int64 `[3]`, if a map turns every table into the target of its number.

    Return None if a mapped direction is not among the targets, or if the two key maps need different keys.
    """
    if len(tables) != len(targets):
        return None
    found = None
    for table, target in zip(tables, targets, strict=True):
        keys_after = as_directions(plane.unsqueeze(0), table, target)[0]
        is_exact = torch.allclose(table @ plane.T, target[keys_after], atol=1e-6)
        if not is_exact or (found is not None and not keys_after.equal(found)):
            return None
        found = keys_after
    return found
