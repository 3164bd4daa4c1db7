"""The boat-docking task as a batched TorchRL environment: the key-press PAMDP with the controller choice as a leaf.

Source: *A Benchmark for Hierarchical Parameterized Action Markov Decision Process*, with constants measured on its
human data. What a user gives and reads are screen px; the state inside is px from the harbour's centre.
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
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.base import Metric, PAMDPEnv
from hpamdp.env.boatdock import episode, harbour, physics, planner
from hpamdp.env.boatdock.episode import BoatState
from hpamdp.env.boatdock.fleet import Fleet, Readings
from hpamdp.env.boatdock.human_shares import human_shares, human_spec
from hpamdp.env.boatdock.layouts import layout_columns
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.oracle import BoatDockOracle, oracle_spec
from hpamdp.env.boatdock.reference import human_normalised, human_references
from hpamdp.env.boatdock.scores import measure_boats
from hpamdp.env.boatdock.task import invalid_press
from hpamdp.env.facts import ProblemFacts
from hpamdp.env.state_columns import check_range, cloned, from_arrays, overwrite, where
from hpamdp.geometry import PlaneGeometry, Symmetries, as_directions, make_symmetries, on_observations, plane_maps

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hpamdp.env.boatdock.play.boat_page import BoatPage

_PLAN = "plan_"  # before the names of the oracle's columns in an `env_state`
_MOST_SWAPPED = 4  # boats; of more, symmetries swap none

_CONTROLLER_ENTRY = episode.OBSERVATION_NAMES.index("controller")
# What a tensordict has whose next root holds nothing else.
_PLAIN_KEYS = {
    keys.OBSERVATION,
    keys.OUTCOME,
    episode.FUEL,
    keys.DONE,
    keys.TERMINATED,
    keys.TRUNCATED,
    keys.OPTION,
    keys.ACTION,
}
_LAYOUT_KEYS = {"start", "goal", "controller", "keymap"}


class BoatDockEnv(PAMDPEnv):
    """Dock boats in `num_envs` harbours at once.

    Action leaves:
    - `("action", "discrete")` int64 `[N]` in {0, 1, 2}: the key to press;
    - `("action", "parameters")` float32 `[N, 3]`: how long to press each key, seconds in [0, 2], of which only the
      pressed key's counts; values outside are clipped, NaN and infinite ones refused;
    - with `controller="choose"`, `option` int64 `[N]` (0 incongruent, 1 congruent, or the number in `boats`): read at
      an episode's first press and held until its end; with a `switch_cost`, read at every press.

    Args:
        num_envs: number of boats.
        options: the settings; None for the defaults.
        oracle: also write what the planner knows under `oracle` (`option` `[N]`; `discrete`, `parameters`
            `[N, num_options]`).
        human: also write how often people choose each option under `human` (`option` `[N, num_options]`).
        device: where the boats live.
        seed: of layouts, random controllers and noise; the global generators are neither read nor moved.
        first_env: number of the first boat, if other processes have those before it.
        settings: single settings by name, in place of those in `options`.

    On the CPU the boats are moved by the kernel of `hpamdp.env.boatdock.kernel`; other devices, compiled rules, and
    gradients (from the first durations that require them on) have the tensor functions of `episode`. Numbers agree to
    rounding.

    `reset` also takes layouts to play: a tensordict with `start` and `goal` `[N, 2]` in screen px and, optionally,
    `controller` and `keymap` int `[N]`.

    Raises:
        ValueError: an argument, action or layout that is out of range; the boats are left as they were.
        RuntimeError: a step before the first reset, or before the one after `set_seed`.
    """

    Options = BoatDockOptions
    guarded_settings = ("recording",)
    parameter_dims = (1,) * harbour.NUM_KEYS
    max_steps = episode.MAX_PRESSES
    result_keys = (keys.OUTCOME, episode.FUEL)
    reset_returns_all_rows = True
    choice_setting: ClassVar[str] = "env.controller=choose"
    change_setting: ClassVar[str] = "env.switch_cost=0.2"
    no_choice_setting: ClassVar[str] = "env.controller=congruent, incongruent, random"
    table_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "score"),
        Metric("human_normalised", "random 0, people 1"),
        Metric("success", "success", "share"),
        Metric("too_fast", "too fast", "share"),
        Metric("out_of_bounds", "out of bounds", "share"),
        Metric("out_of_fuel", "out of fuel", "share"),
        Metric("time_limit", "time limit", "share"),
        Metric("steps", "presses an episode", "count"),
        Metric("option_congruent", "congruent boat", "share"),
        Metric("option_changes", "changes of boats an episode", "count"),
        Metric("oracle_agreement", "oracle's choice", "share"),
        Metric("optimality_gap", "gap to the ceiling"),
    )
    curve_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "Score"),
        Metric("success", "Episodes that succeed", "share"),
        Metric("oracle_agreement", "Better boat chosen", "share"),
        Metric("option_congruent", "Congruent boat chosen", "share"),
    )

    def __init__(
        self,
        num_envs: int = 1,
        *,
        options: BoatDockOptions | None = None,
        oracle: bool = False,
        human: bool = False,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
        **settings: Any,
    ) -> None:
        options = self.options = BoatDockOptions.of(options, settings)
        if num_envs < 1:
            raise ValueError(f"BoatDockEnv: {num_envs=}, but must be at least 1")
        if human and not options.are_peoples:
            raise ValueError(
                f"{options.unlike_peoples()}: people kept one of their two boats, so what they chose says nothing "
                "here; leave it out"
            )
        facts, rules, compile_rules = self.facts(options), options.rules, options.compile_rules
        self.option_names = facts.option_names
        self.can_change_option = facts.can_change_option
        self.plans_change_options = facts.plans_change_options
        self._played = None if options.recording is None else _figures_of(options.recording, options.controller)
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs = num_envs
        self.rules = rules
        is_on_cpu = self.device is None or self.device.type == "cpu"
        self._fleet = Fleet(num_envs, rules, first_env) if is_on_cpu and not compile_rules else None
        self._pure_step = episode.step
        self._pure_reset = episode.reset
        self._pure_read = episode.read
        if compile_rules:
            arguments: Any = counter_rng.COMPILE_ARGUMENTS
            self._pure_step = torch.compile(episode.step, **arguments)
            self._pure_reset = torch.compile(episode.reset, **arguments)
            self._pure_read = torch.compile(episode.read, **arguments)
        self._environment = torch.arange(first_env, first_env + num_envs, dtype=torch.int32, device=self.device)
        self._make_specs()
        self._has_human, self._oracle = human, None
        if human:
            self.observation_spec["human"] = human_spec(num_envs, self.device)
        if oracle:
            self._oracle = BoatDockOracle(num_envs, rules, self.device)
            self.observation_spec["oracle"] = oracle_spec(num_envs, rules, self.device)
        self._set_seed(seed)

    @classmethod
    def facts(cls, options: Any) -> ProblemFacts:
        """Return what these settings tell of the problem."""
        return options.facts(cls.__name__)

    @property
    def has_choice(self) -> bool:
        """Whether the agent picks the controller."""
        return self.rules.controller == "choose"

    @property
    def state(self) -> BoatState:
        """The boats as they are; assign a state to put them elsewhere (checkpoints do)."""
        return self._columns if self._fleet is None else cloned(self._state)

    @state.setter
    def state(self, state: BoatState) -> None:
        self._put(BoatState(*(column.to(self.device) for column in state)))
        self._has_layouts = True

    @property
    def _state(self) -> BoatState:
        """The boats as they are; where the kernel moves them, the columns change with them."""
        if self._fleet is None:
            return self._columns
        return from_arrays(BoatState, (*self._fleet.floats, *self._fleet.integers))

    def _put(self, state: BoatState) -> None:
        if self._fleet is None:
            self._columns = state
        else:
            overwrite(self._state, state)

    @property
    def position(self) -> Tensor:
        """Where the boats are, px from the harbour's centre, `[N, 2]`."""
        return torch.stack([self._state.x, self._state.y], -1)

    @property
    def symmetries(self) -> Symmetries:
        """The turns and mirrors of the plane that permute a boat's directions or swap boats that occur.

        Of people's two boats, six maps keep each, and six more swap it for the other, whose directions are the opposite
        ones. With a random key map, which is not observed, only those remain that permute the keys of both key maps
        alike; with motor noise that differs between boats, those that keep them.
        """
        tables = self._directions()
        found = []  # the map, which boats the boats become, and which keys their keys become
        for each in plane_maps(6):
            for order in self._orders(len(tables)):
                rows = [_as_one_table(each, own, tables[other]) for own, other in zip(tables, order, strict=True)]
                mapped = [row for row in rows if row is not None]
                if len(mapped) == len(rows):
                    found.append((each, order, torch.stack(mapped)))
                    break
        kept = torch.stack([each for each, _, _ in found])
        weight, offset = on_observations(kept, self._observation_dim, *self._vectors())
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

    def _orders(self, num_boats: int) -> list[tuple[int, ...]]:
        """Return which boats the boats may become under a map: with the same noise, and few enough to try them all."""
        orders = itertools.permutations(range(num_boats)) if num_boats <= _MOST_SWAPPED else [range(num_boats)]
        noise = self.rules.motor_noise
        allowed = [tuple(order) for order in orders]
        return [order for order in allowed if num_boats == 1 or [noise[boat] for boat in order] == list(noise)]

    @property
    def geometry(self) -> PlaneGeometry:
        """The places and the velocity, and where the keys point, unless a random key map leaves that open.

        Every press begins at rest, so that the velocity tells nothing; where the start was shows in the distances
        alone. The harbour is always the same. With the goal's offset, the goal itself is known, too.
        """
        names = ["start_x", "start_y", "centre_x", "centre_y", "radius", "velocity_x", "velocity_y"]
        if self.rules.observation == "scaled" and self.rules.sensor_noise == 0.0:
            names += ["goal_x", "goal_y"]
        tables = self._directions()
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
            redundant=tuple(episode.OBSERVATION_NAMES.index(name) for name in names),
        )

    def _directions(self) -> list[list[Tensor]]:
        """Return for each boat that occurs the possible tables of its keys' directions, float64 `[3, 2]`."""
        boats = self.rules.boats
        if boats is not None:
            each_boat = [[table] for table in torch.tensor(boats.directions, dtype=torch.float64)]
            is_fixed = self.rules.controller in boats.names
            return [each_boat[boats.names.index(self.rules.controller)]] if is_fixed else each_boat
        maps = (1, 2) if self.rules.keymap == "random" else (self.rules.keymap,)
        table = torch.tensor(harbour.DIRECTIONS, dtype=torch.float64)
        both = [[table[number - 1] for number in maps], [table[2]]]
        if self.rules.controller in harbour.CONTROLLERS:
            return [both[harbour.CONTROLLERS.index(self.rules.controller)]]
        return both

    @property
    def _observation_dim(self) -> int:
        return self.observation_spec_unbatched[keys.OBSERVATION].shape[-1]

    def _vectors(self) -> tuple[tuple[tuple[int, int], ...], tuple[tuple[float, float], ...]]:
        """Return which entries of the observation are vectors, and from where on they are measured."""
        places: tuple[tuple[int, int], ...] = ((0, 1), (2, 3), (8, 9))
        if self.rules.observation == "pixels":
            return (*places, (10, 11)), (*[harbour.CENTRE] * len(places), (0.0, 0.0))
        return (*places, (10, 11), (14, 15)), ()

    def fixed_episodes(self, seed: int) -> TensorDict:
        """Return layouts to `reset` with, one for each boat, that no training episode meets, whatever its seed."""
        layout = harbour.fixed_layouts(self.num_envs, seed)
        centre = torch.tensor(harbour.CENTRE, dtype=torch.float32)
        points = {"start": torch.stack(layout[:2], -1) + centre, "goal": torch.stack(layout[2:], -1) + centre}
        return TensorDict(points, batch_size=self.batch_size, device=self.device)

    def seed_evaluation(self, seed: int) -> None:
        """Seed episodes and noise as `set_seed` does, but from streams that training never meets, whatever its seed."""
        self.set_seed(seed)
        self.rules = self.rules._replace(is_evaluation=True)
        if self._fleet is not None:
            self._fleet.set_streams(is_evaluation=True)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `outcome`, `fuel` (fraction), `score` and `success` `[M]` of finished (or abandoned) episodes."""
        outcome, fuel = last.get(keys.OUTCOME), last.get(episode.FUEL).squeeze(-1)
        score = harbour.score(outcome, fuel)
        return {"outcome": outcome, "fuel": fuel, "score": score, "success": outcome == physics.SUCCESS}

    def describe(self) -> dict[str, Tensor]:
        """Return the boats' layouts for evaluation, px from the harbour's centre.

        `start`, `goal` `[N, 2]`, `bearing_offset` `[N]` (degrees) and `optimum` `[N, num_boats]`: the best possible
        score with each boat from a full tank, with a `switch_cost` of beginning with it; `controller` `[N]` where it is
        not chosen.
        """
        state = self.state
        layout = harbour.Layout(state.start_x, state.start_y, state.goal_x, state.goal_y)
        known = {
            "start": torch.stack(layout[:2], -1),
            "goal": torch.stack(layout[2:], -1),
            "bearing_offset": harbour.bearing_offset(layout),
            "optimum": planner.best_scores(self.rules, layout, state.keymap),
        }
        return known if self.has_choice else {**known, "controller": state.controller}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the means of `measure_boats`."""
        return measure_boats(played, self._controller_of_run, self.rules)

    @property
    def _controller_of_run(self) -> str:
        """`chosen`, where the agent chooses, else as set."""
        return "chosen" if self.has_choice else self.rules.controller

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the figures of the ceiling and, with people's two boats, of people and the best, or of a recording."""
        ceiling = {**super().references(measured)["ceiling"], "success": measured.get("ceiling_success", 1.0)}
        if self.has_choice:
            ceiling["oracle_agreement"] = 1.0
        if self.rules.boats is not None:
            return {"ceiling": ceiling}
        ceiling["human_normalised"] = human_normalised(ceiling["score"], self._controller_of_run)
        if self._played is not None:
            return {"you": self._played, "ceiling": ceiling}
        return {**human_references(self._controller_of_run), "ceiling": ceiling}

    def summary_entries(self) -> dict[str, Any]:
        """Return which `controller` the boats have, `chosen` where the agent chooses, and the `boats`, if set."""
        entries = {"controller": self._controller_of_run}
        return entries if self.rules.boats is None else {**entries, "boats": list(self.rules.names)}

    @classmethod
    def curves(cls, summary: Mapping[str, Any]) -> tuple[Metric, ...]:
        """Return the panels of the learning curves: where there are `boats`, with the share of each."""
        if not summary.get("boats"):
            return cls.curve_metrics
        shares = (Metric(f"option_{name}", f"{name} chosen", "share") for name in summary["boats"])
        return (*(metric for metric in cls.curve_metrics if not metric.name.startswith("option_")), *shares)

    @classmethod
    def draw_figures(cls, evaluation: Mapping[str, np.ndarray], summary: Mapping[str, Any]) -> dict[str, Figure]:
        """Return `trajectories.png` and, where the agent chose its boat, `choices.png`."""
        from hpamdp.env.boatdock import figures  # matplotlib takes long to import

        return figures.draw(evaluation, summary)

    def film(self, track: Sequence[Mapping[str, Tensor]], fps: float, size: int) -> Iterator[np.ndarray]:
        """Return the pictures of one episode, in which the boat moves as it does in the task."""
        from hpamdp.env.boatdock import film  # only films need it

        return film.film(track, fps, size, self.rules)

    def page(self, seed: int) -> BoatPage:
        """Return the page on which people dock boats.

        Raises:
            ValueError: the settings are not those of the page, which has people's two boats without noise.
        """
        from hpamdp.env.boatdock.play.boat_page import BoatPage

        return BoatPage(seed, self.rules)

    def env_state(self) -> dict[str, Tensor]:
        """Return the boats' columns and, where there is an oracle, its plans, first dimension `N`."""
        plans = {} if self._oracle is None else {_PLAN + name: plan for name, plan in self._oracle.plans().items()}
        return {**self.state._asdict(), **plans}

    def check_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Refuse controllers, keymaps and outcomes that do not exist.

        Raises:
            ValueError: a number is invalid.
        """
        super().check_env_state(columns)
        limits = {"controller": (-1, len(self.rules.names)), "outcome": (0, len(physics.OUTCOMES))}
        check_range(columns, {**limits, "keymap": (0, 3), "presses": (0, 2**30), "episode": (-1, 2**30)})

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Continue from an `env_state`.

        Raises:
            ValueError: it is not the state of this many boats.
        """
        plans = {name.removeprefix(_PLAN): plan for name, plan in columns.items() if name.startswith(_PLAN)}
        boats = {name: column for name, column in columns.items() if not name.startswith(_PLAN)}
        if len(boats["episode"]) != self.num_envs:
            raise ValueError(f"BoatDockEnv: the state of {len(boats['episode'])} boats, but there are {self.num_envs}")
        self.state = BoatState(**boats)
        if self._oracle is not None and plans:
            self._oracle.set_plans(plans)

    def _make_specs(self) -> None:
        n, device = self.num_envs, self.device
        names = episode.OBSERVATION_NAMES if self.rules.observation == "pixels" else episode.SCALED_NAMES
        self.observation_spec = Composite(
            observation=Unbounded(shape=(n, len(names)), device=device, dtype=torch.float32),
            outcome=Categorical(len(physics.OUTCOMES), shape=(n,), device=device),
            fuel=Bounded(0.0, 1.0, shape=(n, 1), device=device, dtype=torch.float32),
            shape=(n,),
        )
        longest = torch.full((harbour.NUM_KEYS,), physics.MAX_DURATION, dtype=torch.float32)
        self.action_spec = self.make_action_spec(torch.zeros_like(longest), longest, has_option=self.has_choice)
        self.reward_spec = Unbounded(shape=(n, 1), device=device, dtype=torch.float32)
        self.done_spec = self.make_done_spec()

    def _set_seed(self, seed: int | None) -> None:
        self.rules = self.rules._replace(is_evaluation=False)
        self._seed = counter_rng.seed_tensor(0 if seed is None else seed, self.device)
        self._has_layouts = False
        if self._fleet is not None:
            self._fleet.set_seed(0 if seed is None else seed, is_evaluation=False)
            return
        floats = torch.zeros(self.num_envs, device=self.device, dtype=torch.float32)
        integers = torch.zeros(self.num_envs, dtype=torch.int32, device=self.device)
        columns = [floats] * 9 + [integers] * 4 + [integers - 1]
        self._columns = BoatState(*columns)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = self.reset_mask(tensordict)
        given = None
        if tensordict is not None and _LAYOUT_KEYS & set(tensordict.keys()):
            given = self._given_layout(tensordict)
        readings = None
        if self._fleet is None:
            self._columns = self._pure_reset(self._columns, mask, self._seed, self._environment, self.rules)
        else:
            readings = self._fleet.restart(mask.numpy())
        if given is not None:
            state = self._state
            self._put(where(mask, state._replace(**given), state))
            readings = None
        if self._oracle is not None:
            self._oracle.plan(self._state, mask)
        self._has_layouts = True
        return self._read() if readings is None else self._reading(readings)

    def _given_layout(self, given: TensorDictBase) -> dict[str, Tensor]:
        """Check a user's layout and return the state's columns that it sets."""
        arrays = {name: given.get(name).cpu().numpy() for name in _LAYOUT_KEYS & set(given.keys())}
        columns = layout_columns(arrays, self.num_envs, self.rules)
        return {name: torch.from_numpy(column).to(self.device) for name, column in columns.items()}

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        key, durations, option = self._read_action(tensordict)
        mask = tensordict.get("_step", None)
        mask = None if mask is None else mask.reshape(self.num_envs)
        if self._fleet is not None:
            return self._reading(*self._press(key, durations, option, mask))
        chosen = self._columns.controller if option is None else option
        state, reward, is_action = self._pure_step(
            self._columns, chosen, key, durations, self._seed, self._environment, self.rules
        )
        if not is_action.all():
            raise self._invalid(int((~is_action).nonzero()[0]), key, durations, chosen)
        if mask is not None:
            state, reward = where(mask, state, self._columns), torch.where(mask, reward, 0.0)
        self._columns = state
        return self._read().set(keys.REWARD, reward.unsqueeze(-1))

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        is_plain = self._fleet is not None and self._oracle is None and not self._has_human
        if not is_plain or tensordict.device != self.device or not _PLAIN_KEYS.issuperset(tensordict.keys()):
            return super()._step_and_maybe_reset(tensordict)
        # The same in one pass: TorchRL's own steps between ours take longer than the boats.
        key, durations, option = self._read_action(tensordict)
        if self._fleet is None:  # the durations require gradients
            return super()._step_and_maybe_reset(tensordict)
        readings, rewards = self._press(key, durations, option, None, restarts=True)
        # TorchRL keeps the action, too; in a tensordict of its own, since an update of the root changes it in place.
        action = TensorDict._new_unsafe(
            dict(tensordict.get(keys.ACTION).items()), batch_size=self.batch_size, device=self.device
        )
        kept: dict[str, Any] = {keys.ACTION: action}
        if keys.OPTION in tensordict.keys():
            kept[keys.OPTION] = tensordict.get(keys.OPTION)
        return tensordict.set("next", self._reading(readings, rewards)), self._reading(readings, number=1, kept=kept)

    def _read_action(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return keys, durations and, where the agent chooses, options; their values are still to be checked."""
        if not self._has_layouts:
            raise RuntimeError("BoatDockEnv: the boats have no layouts yet; call reset before step")
        self.check_action(tensordict)
        action = tensordict.get(keys.ACTION)
        key, durations = action.get("discrete"), action.get("parameters").float()
        if self._fleet is not None and durations.requires_grad and torch.is_grad_enabled():
            self._columns, self._fleet = self.state, None
        return key, durations, tensordict.get(keys.OPTION) if self.has_choice else None

    def _press(
        self, key: Tensor, durations: Tensor, option: Tensor | None, mask: Tensor | None, *, restarts: bool = False
    ) -> tuple[Readings, np.ndarray]:
        """Press a key with the kernel."""
        assert self._fleet is not None
        result = self._fleet.press(
            None if option is None else _array(option.long()),
            _array(key.long()),
            _array(durations),
            mask=None if mask is None else _array(mask),
            restarts=restarts,
        )
        if isinstance(result, int):
            raise self._invalid(result, key, durations, self._state.controller if option is None else option)
        return result

    def _invalid(self, row: int, key: Tensor, durations: Tensor, option: Tensor) -> ValueError:
        values = option[row].item(), key[row].item(), durations[row].tolist()
        return invalid_press(row, *values, len(self.option_names))

    def _read(self) -> TensorDict:
        if self._fleet is not None:
            return self._reading(self._fleet.read())
        reading = self._pure_read(self._columns, self._seed, self._environment, self.rules)
        return self._with_knowledge(TensorDict(reading._asdict(), batch_size=self.batch_size, device=self.device))

    def _reading(
        self,
        readings: Readings,
        rewards: np.ndarray | None = None,
        number: int = 0,
        kept: Mapping[str, Any] | None = None,
    ) -> TensorDict:
        """Return one of the kernel's readings, with rewards or other leaves."""
        flags = torch.from_numpy(readings.flags[number]).unsqueeze(-1)
        leaves: dict[str, Any] = {
            **(kept or {}),
            keys.OBSERVATION: torch.from_numpy(readings.observations[number]),
            keys.OUTCOME: torch.from_numpy(readings.outcomes[number]),
            episode.FUEL: torch.from_numpy(readings.fuel[number]).unsqueeze(-1),
            keys.DONE: flags[0],
            keys.TERMINATED: flags[1],
            keys.TRUNCATED: flags[2],
        }
        if rewards is not None:
            leaves[keys.REWARD] = torch.from_numpy(rewards).unsqueeze(-1)
        # The checks of the constructor would take longer than a hundred boats.
        return self._with_knowledge(TensorDict._new_unsafe(leaves, batch_size=self.batch_size, device=self.device))

    def _with_knowledge(self, seen: TensorDict) -> TensorDict:
        """Add what people and the planner know."""
        if self._has_human:
            seen.set(keys.HUMAN_OPTION, human_shares(self._state))
        return seen if self._oracle is None else seen.set("oracle", self._oracle.read(self._state))


def _figures_of(recording: str, controller: str) -> dict[str, float]:
    """Return the means of a recording, of the episodes with this controller where it is fixed."""
    from hpamdp.env.boatdock.play import episodes  # only recordings need it

    of_controller = controller if controller in harbour.CONTROLLERS else None
    means = episodes.figures([*episodes.read(Path(recording)).values()], of_controller)
    return {
        **means,
        "human_normalised": human_normalised(means["score"], "chosen" if of_controller is None else controller),
    }


def _as_one_table(plane: Tensor, tables: list[Tensor], targets: list[Tensor]) -> Tensor | None:
    """Return which keys the keys become, int64 `[3]`, if a map makes every table the target of its number.

    None: some direction becomes none of the targets, or another key with another key map.
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


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()
