"""The boat-docking task as a batched TorchRL environment: the key-press PAMDP with the controller choice as a leaf.

Source: *A Benchmark for Hierarchical Parameterized Action Markov Decision Process*, with constants measured on its
human data. What a user gives and reads are screen px; the state inside is px from the harbour's centre.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.actions import invalid_action
from hpamdp.env.base import Metric, PAMDPEnv
from hpamdp.env.boatdock import episode, harbour, physics, planner
from hpamdp.env.boatdock.episode import BoatState, Rules
from hpamdp.env.boatdock.human_shares import human_shares, human_spec
from hpamdp.env.boatdock.oracle import BoatDockOracle, oracle_spec
from hpamdp.env.boatdock.reference import human_normalised, human_references
from hpamdp.env.boatdock.scores import measure_boats
from hpamdp.env.columns import where

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Pair = Annotated[list[float], Field(min_length=2, max_length=2)]

_PLAN = "plan_"  # before the names of the oracle's columns in an `env_state`
_LAYOUT_KEYS = {"start", "goal", "controller", "keymap"}


class BoatDockEnv(PAMDPEnv):
    """Dock boats in `num_envs` harbours at once.

    Action leaves:
    - `("action", "discrete")` int64 `[N]` in {0, 1, 2}: the key to press;
    - `("action", "parameters")` float32 `[N, 3]`: how long to press each key, seconds in [0, 2], of which only the
      pressed key's counts; values outside are clipped, NaN and infinite ones refused;
    - with `controller="choose"`, `option` int64 `[N]` (0 incongruent, 1 congruent): read at an episode's first press
      and held until its end.

    Args:
        num_envs: how many boats.
        controller: `choose` (the agent picks), `congruent`, `incongruent`, or `random` (drawn for each episode).
        keymap: of the incongruent boat: 1, 2 or `random`.
        reward: `paper` (progress, 5 x fuel fraction on success, -1 on failure) or `sparse` (the success term alone).
        observation: `scaled` to about [-1, 1] with goal - boat appended (`[N, 16]`), or the paper's `pixels`
            (`[N, 14]`).
        motor_noise: standard deviation of the log of the executed duration; two of them: of the incongruent and of the
            congruent boat.
        sensor_noise: standard deviation (px) of the observed positions.
        slip: probability that a uniformly random key is pressed.
        compile_rules: compile the pure step, reset and observation functions (takes about half a minute).
        oracle: also write what the planner knows under `oracle` (`option` `[N]`; `discrete`, `parameters`
            `[N, num_options]`).
        human: also write how often people choose each option under `human` (`option` `[N, num_options]`).
        device: where the boats live.
        seed: of layouts, random controllers and noise; the global generators are neither read nor moved.
        first_env: number of the first boat, where other processes have those before.

    `reset` also takes layouts to play: a tensordict with `start` and `goal` `[N, 2]` in screen px and, optionally,
    `controller` and `keymap` int `[N]`.

    Raises:
        ValueError: an argument, action or layout that is out of range; the boats are left as they were.
        RuntimeError: a step before the first reset, or before the one after `set_seed`.
    """

    option_names = harbour.CONTROLLERS
    can_change_option: ClassVar[bool] = False
    parameter_dims = (1,) * harbour.NUM_KEYS
    max_steps = episode.MAX_PRESSES
    result_keys = (keys.OUTCOME, episode.FUEL)
    reset_returns_all_rows = True
    choice_setting: ClassVar[str] = "env.controller=choose"
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
        controller: Literal["choose", "congruent", "incongruent", "random"] = "choose",
        keymap: Literal[1, 2, "random"] = 1,
        reward: Literal["paper", "sparse"] = "paper",
        observation: Literal["scaled", "pixels"] = "scaled",
        motor_noise: float | Pair = 0.0,
        sensor_noise: float = 0.0,
        slip: float = 0.0,
        compile_rules: bool = False,
        oracle: bool = False,
        human: bool = False,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
    ) -> None:
        motor_noises = [motor_noise, motor_noise] if isinstance(motor_noise, int | float) else motor_noise
        if len(motor_noises) != 2:
            raise ValueError(f"BoatDockEnv: motor_noise={motor_noises}, but must be one number or two")
        incongruent, congruent = motor_noises
        rules = Rules(controller, keymap, reward, observation, (incongruent, congruent), sensor_noise, slip)
        _check_arguments(num_envs, rules)
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs = num_envs
        self.rules = rules
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

    @property
    def has_choice(self) -> bool:
        """Whether the agent picks the controller."""
        return self.rules.controller == "choose"

    @property
    def state(self) -> BoatState:
        """The boats as they are; assign a state to put them elsewhere (checkpoints do)."""
        return self._state

    @state.setter
    def state(self, state: BoatState) -> None:
        self._state = BoatState(*(column.to(self.device) for column in state))
        self._has_layouts = True

    @property
    def position(self) -> Tensor:
        """Where the boats are, px from the harbour's centre, `[N, 2]`."""
        return torch.stack([self._state.x, self._state.y], -1)

    def fixed_episodes(self, seed: int) -> TensorDict:
        """Return layouts to `reset` with, one for each boat, that no training episode meets, whatever its seed."""
        layout = harbour.fixed_layouts(self.num_envs, seed)
        centre = torch.tensor(harbour.CENTRE)
        points = {"start": torch.stack(layout[:2], -1) + centre, "goal": torch.stack(layout[2:], -1) + centre}
        return TensorDict(points, batch_size=self.batch_size, device=self.device)

    def seed_evaluation(self, seed: int) -> None:
        """Seed episodes and noise as `set_seed` does, but from streams that training never meets, whatever its seed."""
        self.set_seed(seed)
        self.rules = self.rules._replace(is_evaluation=True)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `outcome`, `fuel` (fraction), `score` and `success` `[M]` of finished (or abandoned) episodes."""
        outcome, fuel = last.get(keys.OUTCOME), last.get(episode.FUEL).squeeze(-1)
        score = harbour.score(outcome, fuel)
        return {"outcome": outcome, "fuel": fuel, "score": score, "success": outcome == physics.SUCCESS}

    def describe(self) -> dict[str, Tensor]:
        """Return the boats' layouts for evaluation, px from the harbour's centre.

        `start`, `goal` `[N, 2]`, `bearing_offset` `[N]` (degrees) and `optimum` `[N, 2]`: the best possible score with
        the incongruent and the congruent boat from a full tank; `controller` `[N]` where it is not chosen.
        """
        state = self._state
        layout = harbour.Layout(state.start_x, state.start_y, state.goal_x, state.goal_y)
        known = {
            "start": torch.stack(layout[:2], -1),
            "goal": torch.stack(layout[2:], -1),
            "bearing_offset": harbour.bearing_offset(layout),
            "optimum": planner.best_plans(layout, state.keymap).score,
        }
        return known if self.has_choice else {**known, "controller": state.controller}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the means of `measure_boats`."""
        return measure_boats(played, self._controller_of_run)

    @property
    def _controller_of_run(self) -> str:
        """`chosen`, where the agent chooses, else as set."""
        return "chosen" if self.has_choice else self.rules.controller

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return the figures of people, of the best of them and of the ceiling on the same layouts."""
        ceiling = {**super().references(measured)["ceiling"], "success": 1.0}
        ceiling["human_normalised"] = human_normalised(ceiling["score"], self._controller_of_run)
        if self.has_choice:
            ceiling["oracle_agreement"] = 1.0
        return {**human_references(self._controller_of_run), "ceiling": ceiling}

    def summary_entries(self) -> dict[str, str]:
        """Return which `controller` the boats have, `chosen` where the agent chooses."""
        return {"controller": self._controller_of_run}

    @classmethod
    def draw_figures(cls, evaluation: Mapping[str, np.ndarray], summary: Mapping[str, Any]) -> dict[str, Figure]:
        """Return `trajectories.png` and, where the agent chose its boat, `choices.png`."""
        from hpamdp.env.boatdock import figures  # matplotlib takes long to import

        return figures.draw(evaluation, summary)

    def env_state(self) -> dict[str, Tensor]:
        """Return the boats' columns and, where there is an oracle, its plans, first dimension `N`."""
        plans = {} if self._oracle is None else {_PLAN + name: plan for name, plan in self._oracle.plans().items()}
        return {**self._state._asdict(), **plans}

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
            observation=Unbounded(shape=(n, len(names)), device=device),
            outcome=Categorical(len(physics.OUTCOMES), shape=(n,), device=device),
            fuel=Bounded(0.0, 1.0, shape=(n, 1), device=device),
            shape=(n,),
        )
        longest = torch.full((harbour.NUM_KEYS,), physics.MAX_DURATION)
        self.action_spec = self.make_action_spec(torch.zeros_like(longest), longest, has_option=self.has_choice)
        self.reward_spec = Unbounded(shape=(n, 1), device=device)
        self.done_spec = self.make_done_spec()

    def _set_seed(self, seed: int | None) -> None:
        self.rules = self.rules._replace(is_evaluation=False)
        self._seed = counter_rng.seed_tensor(0 if seed is None else seed, self.device)
        floats = torch.zeros(self.num_envs, device=self.device)
        integers = torch.zeros(self.num_envs, dtype=torch.int32, device=self.device)
        columns = [floats] * 9 + [integers] * 4 + [integers - 1]
        self._state = BoatState(*columns)
        self._has_layouts = False

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = self.reset_mask(tensordict)
        given = None
        if tensordict is not None and _LAYOUT_KEYS & set(tensordict.keys()):
            given = self._given_layout(tensordict)
        self._state = self._pure_reset(self._state, mask, self._seed, self._environment, self.rules)
        if given is not None:
            self._state = where(mask, self._state._replace(**given), self._state)
        if self._oracle is not None:
            self._oracle.plan(self._state, mask)
        self._has_layouts = True
        return self._read()

    def _given_layout(self, given: TensorDictBase) -> dict[str, Tensor]:
        """Check a user's layout and return the state's columns that it sets."""
        centre = torch.tensor(harbour.CENTRE, device=self.device)
        points = {}
        for name in ("start", "goal"):
            point = given.get(name, None)
            if point is None or point.shape != (self.num_envs, 2):
                shape = None if point is None else list(point.shape)
                raise ValueError(f"reset: {name} has shape {shape}, but must be [{self.num_envs}, 2] (screen px)")
            points[name] = point.to(self.device, torch.float32) - centre
            if not (points[name].norm(dim=-1) < physics.HARBOUR_RADIUS).all():
                radius = f"{physics.HARBOUR_RADIUS:g} px"
                raise ValueError(f"reset: a {name} lies outside the harbour: centre {harbour.CENTRE}, radius {radius}")
        if not ((points["start"] - points["goal"]).norm(dim=-1) > physics.DOCK_RADIUS).all():
            raise ValueError(f"reset: a start lies within the dock's {physics.DOCK_RADIUS:g} px of its goal")
        (start_x, start_y), (goal_x, goal_y) = (points[name].unbind(-1) for name in ("start", "goal"))
        columns = dict(start_x=start_x, start_y=start_y, goal_x=goal_x, goal_y=goal_y, x=start_x, y=start_y)
        for name, allowed in (("controller", (0, 1)), ("keymap", (1, 2))):
            value = given.get(name, None)
            if value is None:
                continue
            if name == "controller" and self.has_choice:
                raise ValueError('reset: controller is given, but with controller="choose" it comes from the option')
            if value.shape != (self.num_envs,) or not ((value == allowed[0]) | (value == allowed[1])).all():
                raise ValueError(f"reset: {name} must be {allowed[0]} or {allowed[1]} in shape [{self.num_envs}]")
            columns[name] = value.to(self.device, torch.int32)
        return columns

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if not self._has_layouts:
            raise RuntimeError("BoatDockEnv: the boats have no layouts yet; call reset before step")
        self.check_action(tensordict)
        key, durations = tensordict.get(keys.DISCRETE), tensordict.get(keys.PARAMETERS).float()
        option = tensordict.get(keys.OPTION) if self.has_choice else self._state.controller
        state, reward, is_action = self._pure_step(
            self._state, option, key, durations, self._seed, self._environment, self.rules
        )
        if not is_action.all():
            row = int((~is_action).nonzero()[0])
            raise invalid_action(
                row,
                {
                    "option": (option[row].item(), "allowed 0 to 1"),
                    "key": (key[row].item(), "allowed 0 to 2"),
                    "durations": (durations[row].tolist(), "the pressed key's must be finite"),
                },
            )
        mask = tensordict.get("_step", None)
        if mask is not None:
            mask = mask.reshape(self.num_envs)
            state, reward = where(mask, state, self._state), torch.where(mask, reward, 0.0)
        self._state = state
        return self._read().set(keys.REWARD, reward.unsqueeze(-1))

    def _read(self) -> TensorDict:
        reading = self._pure_read(self._state, self._seed, self._environment, self.rules)
        seen = TensorDict(reading._asdict(), batch_size=self.batch_size, device=self.device)
        if self._has_human:
            seen.set(keys.HUMAN_OPTION, human_shares(self._state))
        return seen if self._oracle is None else seen.set("oracle", self._oracle.read(self._state))


def _check_arguments(num_envs: int, rules: Rules) -> None:
    choices = {
        "controller": ("choose", *harbour.CONTROLLERS[::-1], "random"),
        "keymap": (1, 2, "random"),
        "reward": ("paper", "sparse"),
        "observation": ("scaled", "pixels"),
    }
    for name, allowed in choices.items():
        value = getattr(rules, name)
        if value not in allowed:
            raise ValueError(f"BoatDockEnv: {name}={value!r}, but must be one of {', '.join(map(str, allowed))}")
    if num_envs < 1:
        raise ValueError(f"BoatDockEnv: num_envs={num_envs}, but must be at least 1")
    if not 0.0 <= rules.slip <= 1.0:
        raise ValueError(f"BoatDockEnv: slip={rules.slip}, but must be a probability")
    noises = (("motor_noise", rules.motor_noise, 10), ("sensor_noise", (rules.sensor_noise,), 1000))
    for name, values, largest in noises:
        for value in values:
            if not 0.0 <= value <= largest:
                raise ValueError(f"BoatDockEnv: {name}={value}, but must lie between 0 and {largest}")
