"""A base for problems that are stepped as one batch of independent environments.

The state is a tuple of columns, with one row for each environment. Random numbers are counter-based: each depends only
on the seed, the number of the environment, the episode, and the place of the draw in it. See `counter_rng`.

A subclass hands over three pure functions: how an episode starts, what an action does, and what is observed. Or it is a
`KernelEnv`, and hands over a kernel. The rest is the same for all of them: specs, checks of actions, masked steps and
resets, the time limit, seeds and checkpoints.
"""

from __future__ import annotations

import itertools
import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import torch
from PIL import Image
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, TensorSpec, Unbounded

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.base import PAMDPEnv, ProblemError
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.facts import ProblemFacts
from hpamdp.env.kernel_rows import Advance, KernelRows, Results, invalid_choice
from hpamdp.env.kernels import OUTCOME_ROW
from hpamdp.env.planning_oracle import PlanningOracle
from hpamdp.env.state_columns import Columns, check_range, cloned, from_arrays, overwrite, replaced, restored, where
from hpamdp.settings import SettingError, Settings
from hpamdp.unchecked import unchecked

# If a tensordict has only these keys and the problem's extra ones, there is nothing else to carry into its next root.
_PLAIN_KEYS = {keys.OBSERVATION, keys.OUTCOME, keys.DONE, keys.TERMINATED, keys.TRUNCATED, keys.OPTION, keys.ACTION}
_RULES = ("start", "act", "observe")
_PLAN = "plan_"  # before the names of an oracle's columns in an `env_state`
# The first two of a problem's outcomes; the last one is the time limit.
GOING_ON, SUCCESS = 0, 1


class EpisodeColumns(Columns, Protocol):
    """A `NamedTuple` of columns `[N]`; the last three are, in this order, int32 `steps`, `outcome` and `episode`."""

    @property
    def steps(self) -> Tensor:
        """Number of actions of the episode so far."""

    @property
    def outcome(self) -> Tensor:
        """How the episode ended, or GOING_ON."""

    @property
    def episode(self) -> Tensor:
        """Number of the environment's episode."""


class StateArrays(Protocol):
    """The columns of a state as arrays, in their order."""

    @property
    def floats(self) -> np.ndarray:
        """The float32 columns, `[F, N]`."""

    @property
    def integers(self) -> np.ndarray:
        """The int32 columns, `[I, N]`."""


EpisodeState = TypeVar("EpisodeState", bound=EpisodeColumns)


class Action(NamedTuple):
    """An action in every environment.

    Attributes:
        discrete: the chosen actions, int64 `[N]`.
        parameters: of the chosen actions, within their bounds, `[N, D]`, where D is the largest number of parameters
            that an action has. Parameters that an action does not have are 0.
        option: the chosen options, int64 `[N]`; None if the agent does not choose.
    """

    discrete: Tensor
    parameters: Tensor
    option: Tensor | None


class BatchedEnv(PAMDPEnv, Generic[EpisodeState]):
    """`num_envs` copies of a problem in one batch dimension.

    A subclass sets the attributes below, in its class or in `_prepare`, and defines `start`, `act` and `observe`. This
    class implements the setting `max_steps`. The parameters of the chosen action are clipped to their bounds; NaN and
    infinite ones are refused, and so are unknown actions. The parameters of the other actions are never read.

    The scripted action of `oracle` is always a tensor function. It is one plan, or one for each option that the agent
    chooses (P plans).

    Random numbers depend on the seed, the number of the environment and the episode. Training and evaluation draw
    theirs from separate streams, and so do the starts of episodes and the noise within them.

    Args:
        num_envs: number of environments.
        options: the problem's settings; None for the defaults.
        device: of the tensors.
        seed: of all random numbers; the global generators are neither read nor moved.
        first_env: number of the first environment, if other processes have those before it.
        oracle: whether to write the action of the problem's scripted player under `oracle`: `discrete` and
            `parameters`, `[N, P]`.
        human: whether to write what people would choose under `human`; refused if the problem does not know it.
        flatten_pictures: whether pictures, if there are any, are float32 numbers in [0, 1], a vector like any other.
        settings: single settings by name, in place of those in `options`.

    Raises:
        ValueError: an argument or an action is invalid; the state is unchanged.
    """

    Options: ClassVar[type[Settings]]
    outcomes: ClassVar[tuple[str, ...]]  # names: going on, success, ..., time limit
    observation_names: tuple[str, ...]
    extra_names: tuple[str, ...] = ()  # of values `[N, 1]` beside the observation and the outcome, see `extra_spec`
    start_keys: frozenset[str] = frozenset()  # keys of a tensordict that `reset` takes, to start from
    action_names: ClassVar[tuple[str, str]] = ("discrete", "parameters")  # what errors call an action
    # Bounds of the parameters of all discrete actions, side by side.
    parameter_low: Sequence[float]
    parameter_high: Sequence[float]
    result_keys: tuple[str, ...] = (keys.OUTCOME,)
    reset_returns_all_rows = True
    num_envs: int
    rows: KernelRows | None  # the state that a kernel moves; None if the tensor functions do
    planning_oracle: PlanningOracle | None = None  # which `_prepare` makes, if `_has_oracle` asks for it
    _state: EpisodeState
    limit_terminates = False  # whether the time limit terminates an episode instead of truncating it
    float_type = torch.float32  # of observations and rewards
    seconds_per_step: ClassVar[float] = 0.25  # in films

    def __init__(
        self,
        num_envs: int = 1,
        *,
        options: Settings | None = None,
        device: torch.device | str | None = "cpu",
        seed: int = 0,
        first_env: int = 0,
        oracle: bool = False,
        human: bool = False,
        flatten_pictures: bool = False,
        **settings: Any,
    ) -> None:
        self.options = self.Options.of(options, settings)
        num_envs, seed, first_env = self.checked_numbers(num_envs, seed, first_env)
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs = num_envs
        self._is_on_cpu = self.device is None or self.device.type == "cpu"  # each step asks
        facts = self.facts(self.options)
        if oracle and not facts.has_oracle:
            raise SettingError(f"oracle={oracle}: {self.title} has no planner to ask")
        if human and not facts.has_human:
            raise SettingError(f"human={human}: {self.title} does not know what people choose")
        self._has_oracle, self._has_human, self._flattens = oracle, human, flatten_pictures
        self._chooses = facts.has_choice
        self.option_names = facts.option_names
        self.can_change_option = facts.can_change_option
        self.plans_change_options = facts.plans_change_options
        if hasattr(self.options, "max_steps"):
            self.max_steps = self.options.max_steps
        self._prepare()
        self._environment = torch.arange(first_env, first_env + num_envs, dtype=torch.int32, device=self.device)
        low, high = (
            torch.tensor(side, device=self.device, dtype=torch.float32)
            for side in (self.parameter_low, self.parameter_high)
        )
        self._make_specs(low, high)
        self._place_parameters(low, high)
        self.rows = self._make_rows()
        self._set_seed(seed)

    @classmethod
    def facts(cls, options: Any) -> ProblemFacts:
        """Return what these settings tell of the problem; by default that all its facts are the usual ones."""
        return super().facts(options) or ProblemFacts(title=cls.__name__)

    def _prepare(self) -> None:
        """Set what follows from the settings, such as the bounds of the parameters, before the specs are made."""

    @property
    def training_begins_elsewhere(self) -> bool:
        """Whether episodes of training begin in other states than those of evaluation, or in another world."""
        return False

    def kernel_settings(self) -> Sequence[float]:
        """Return the problem's own numbers for its kernel."""
        return ()

    def _make_rows(self) -> KernelRows | None:
        """Return the rows of a problem that a kernel moves."""
        return None

    @abstractmethod
    def start(self, episode: Tensor, rng: RngKey) -> EpisodeState:
        """Return the states in which episodes begin.

        Args:
            episode: their numbers, int32 `[N]`.
            rng: keys for `counter_rng.uniform` and `normal`, `[N]`.
        """

    @abstractmethod
    def act(self, state: EpisodeState, action: Action, rng: RngKey, is_idle: Tensor) -> tuple[EpisodeState, Tensor]:
        """Return the states after one action in every environment, and the rewards `[N]`.

        Args:
            state: before the action.
            action: what is done.
            rng: keys of the episodes' noise, `[N]`.
            is_idle: bool `[N]`: environments that do not step, because their episode is over or
                their step is masked; their result is discarded.
        """

    @abstractmethod
    def observe(self, state: EpisodeState) -> Tensor:
        """Return the observations `[N, observation_dim]`."""

    def extras(self, state: EpisodeState) -> Sequence[Tensor]:
        """Return the values `extra_names` that the environment writes beside the observation, `[N]` each."""
        return ()

    def start_columns(self, given: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """Check what `reset` was given to start from, and return the columns `[N]` of the state that it sets.

        Args:
            given: the values of some of the `start_keys`.

        Raises:
            ValueError: an entry is missing, or has another shape or a value that is not allowed.
        """
        return {}

    def scripted_action(self, state: EpisodeState) -> tuple[Tensor, Tensor]:
        """Return the action of a hand-written player and its one parameter, `[N]` each, for comparison with learners.

        If the agent chooses among P options, return `[N, P]` each. A subclass that has a player says so in its `facts`.
        """
        raise NotImplementedError(f"{type(self).__name__} has no hand-written player")

    def draw(self, track: Sequence[EpisodeState]) -> np.ndarray:
        """Return a picture of an episode so far, uint8 `[height, width, 3]`.

        Args:
            track: the states of one environment from the start on, columns `[1]`.
        """
        raise NotImplementedError(f"{type(self).__name__} has no pictures")

    def film(self, track: Sequence[Mapping[str, Tensor]], fps: float, size: int) -> Iterator[np.ndarray]:
        """Yield the pictures of `draw`, each for `seconds_per_step`; nothing if the problem has no pictures."""
        if type(self).draw is BatchedEnv.draw:
            return
        states = [type(self._state)(**columns) for columns in track]
        for i in range(1, len(states) + 1):
            shape = [round(size * edge) for edge in self.film_shape]
            picture = np.array(Image.fromarray(self.draw(states[:i])).resize(shape, Image.Resampling.LANCZOS))
            yield from itertools.repeat(picture, max(1, round(fps * self.seconds_per_step)))

    @property
    def position(self) -> Tensor | None:
        """The columns `x` and `y` of the state, `[N, 2]`; None if it has none."""
        columns = self._state._asdict()
        return torch.stack([columns["x"], columns["y"]], -1) if {"x", "y"} <= columns.keys() else None

    @property
    def has_choice(self) -> bool:
        """Whether the agent chooses an option."""
        return self._chooses or self.option_actions is not None

    @property
    def state(self) -> EpisodeState:
        """The columns of the state, `[N]` each; assign others to put the environments elsewhere."""
        return self._state if self.rows is None else cloned(self._state)

    @state.setter
    def state(self, state: EpisodeState) -> None:
        self._put(state)
        self._on_start(torch.ones(self.num_envs, dtype=torch.bool, device=self.device))

    def _put(self, state: EpisodeState) -> None:
        self._state = type(state)(*(column.to(self.device) for column in state))
        self._has_episodes = True

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]]:
        """The lowest and the highest observation, `[observation_dim]` each."""
        dim = len(self.observation_names)
        return [-math.inf] * dim, [math.inf] * dim

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return `success` bool `[M]`."""
        return {"success": last.get(keys.OUTCOME) == SUCCESS}

    def trip_ends(self, rows: StateArrays) -> np.ndarray:
        """Return whether a trip ended with the last step, bool `[N]`, for Gymnasium's infos."""
        raise NotImplementedError(f"{type(self).__name__} has no trips")

    def final_infos(self, rows: StateArrays) -> dict[str, np.ndarray]:
        """Return what Gymnasium's infos tell of episodes that are over, `[N]` each: whether they succeeded."""
        return {"is_success": rows.integers[OUTCOME_ROW] == SUCCESS}

    def masks(self) -> dict[str, Tensor]:
        """Return what the current states allow, `action_mask` or `option_mask`, bool `[N, K]`; by default nothing.

        Gymnasium's infos have them. A subclass also writes them beside the observation, by `_knowledge`.
        """
        return {}

    def env_state(self) -> dict[str, Tensor]:
        """Return the columns of the state, the checksums of files and the oracle's plans, first dimension `N`."""
        checksums = {name: checksum.repeat(self.num_envs) for name, checksum in self.file_checksums().items()}
        plans = {} if self.planning_oracle is None else self.planning_oracle.plans()
        return self.state._asdict() | checksums | {_PLAN + name: plan for name, plan in plans.items()}

    def film_state(self, num: int) -> dict[str, Tensor]:
        """Return the columns of the state alone, of the first `num` environments."""
        return {name: column[:num].cpu().clone() for name, column in self.state._asdict().items()}

    def check_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Refuse counters and outcomes that do not exist, and the state of another version of a file.

        Raises:
            ValueError: a number is invalid, or a file was edited since.
        """
        super().check_env_state(columns)
        for name, checksum in self.file_checksums().items():
            if (columns[name] != checksum).any():
                setting = name.removesuffix("_checksum")
                file = getattr(self.options, setting)
                raise ValueError(f"the file env.{setting}={file!r} is no longer the one of this state")
        # Any number of an episode is valid: after 2^31 - 1 comes -2^31, with random numbers of its own.
        steps, outcome, _ = self._state._fields[-3:]
        check_range(columns, {steps: (0, 2**30), outcome: (0, len(self.outcomes))})

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Continue from an `env_state`; an empty one starts new episodes.

        Raises:
            ValueError: they are not the columns of a state of this many environments.
        """
        if not columns:
            self._reset()
            return
        plans = {name.removeprefix(_PLAN): plan for name, plan in columns.items() if name.startswith(_PLAN)}
        others = self.file_checksums().keys() | {_PLAN + name for name in plans}
        own = {name: column for name, column in columns.items() if name not in others}
        self._put(restored(own, self._state, type(self).__name__))
        if self.planning_oracle is not None and plans:
            self.planning_oracle.set_plans(plans)

    def seed_evaluation(self, seed: int) -> None:
        """Begin with the episodes of an evaluation, which training never has, whatever its seed."""
        self.set_seed(seed)
        self._streams = (counter_rng.EVALUATION, counter_rng.EVALUATION_NOISE)
        self._begin()

    def close(self, *, raise_if_closed: bool = True) -> None:
        """End the episodes; the environments must be reset before they are used again."""
        self._has_episodes = False
        super().close(raise_if_closed=raise_if_closed)

    def _make_specs(self, low: Tensor, high: Tensor) -> None:
        n, device = self.num_envs, self.device
        extras = {name: self.extra_spec(name) for name in self.extra_names}
        self._extra_types = [spec.dtype for spec in extras.values()]
        observation = self.observed_spec()
        outcome = Categorical(len(self.outcomes), shape=(n,), device=device)
        knowledge = self._knowledge_specs()
        self._has_knowledge = bool(knowledge)
        ways = ("_step", "_reset", "_on_start")
        self._steps_plainly = not knowledge and all(getattr(type(self), n) is getattr(BatchedEnv, n) for n in ways)
        self._plain_keys = _PLAIN_KEYS.union(self.extra_names)
        self.observation_spec = Composite(
            {keys.OBSERVATION: observation, keys.OUTCOME: outcome, **extras, **knowledge}, shape=(n,), device=device
        )
        self.action_spec = self.make_action_spec(low, high, has_option=self._chooses)
        self.reward_spec = Unbounded(shape=(n, 1), device=device, dtype=self.float_type)
        self.done_spec = self.make_done_spec()

    def extra_spec(self, name: str) -> TensorSpec:
        """Return the spec of one of the `extra_names`: float32 `[N, 1]` in [0, 1]."""
        return Bounded(0.0, 1.0, shape=(self.num_envs, 1), device=self.device, dtype=torch.float32)

    def observed_spec(self) -> TensorSpec:
        """Return the spec of the observations; override it together with `shown`."""
        shape = (self.num_envs, len(self.observation_names))
        return Unbounded(shape=shape, device=self.device, dtype=self.float_type)

    def shown(self, vectors: Tensor) -> Tensor:
        """Return the observations for the vectors `[N, D]` that `observe` returns: the vectors themselves."""
        return vectors

    def _knowledge_specs(self) -> dict[str, TensorSpec]:
        """Return the specs of what is known beside the observation, such as the action of a scripted player."""
        if self.planning_oracle is not None:
            return {"oracle": self.planning_oracle.spec()}
        if not self._has_oracle:
            return {}
        shape, device = self._shape_of_plans, self.device
        oracle = Composite(
            discrete=Categorical(len(self.parameter_dims), shape=shape, device=device),
            parameters=Unbounded(shape=shape, device=device, dtype=torch.float32),
            shape=shape[:1],
        )
        return {"oracle": oracle}

    def _knowledge(self) -> dict[str, Any]:
        """Return what `_knowledge_specs` describes, for the current states."""
        if self.planning_oracle is not None:
            return {"oracle": self.planning_oracle.read(self._state)}
        if not self._has_oracle:
            return {}
        plan = zip(("discrete", "parameters"), self.scripted_action(self._state), strict=True)
        return {"oracle": {name: self._plans(name, leaf) for name, leaf in plan}}

    def _plans(self, name: str, leaf: Tensor) -> Tensor:
        """Return a leaf of the scripted player's actions, `[N]` or `[N, P]`, as `[N, P]`.

        Raises:
            ProblemError: it has another shape.
        """
        num_envs, num_plans = self._shape_of_plans
        if leaf.shape == (num_envs,) and num_plans == 1:
            return leaf.unsqueeze(-1)
        if leaf.shape != (num_envs, num_plans):
            given = f"{name} of shape {list(leaf.shape)}, but must give [{num_envs}, {num_plans}]"
            raise ProblemError(f"{type(self).__name__}: scripted_action gave {given}")
        return leaf

    @property
    def _shape_of_plans(self) -> tuple[int, int]:
        return self.num_envs, len(self.option_names) if self._chooses else 1

    def _place_parameters(self, low: Tensor, high: Tensor) -> None:
        """Note where the parameters of each discrete action lie, and their bounds, `[K, D]` each."""
        dims = torch.tensor(self.parameter_dims, device=self.device).unsqueeze(-1)
        number = torch.arange(max(self.parameter_dims), device=self.device)
        self._has_parameter = number < dims
        place = (dims.cumsum(0) - dims + number).clamp(max=len(low) - 1)
        self._parameter_place = place
        self._parameter_low, self._parameter_high = low[place], high[place]

    def _set_seed(self, seed: int | None) -> None:
        self._seed = counter_rng.seed_tensor(0 if seed is None else seed, self.device)
        self._streams = (counter_rng.TRAINING, counter_rng.NOISE)
        self._begin()

    def _begin(self) -> None:
        """Put every environment before its first episode."""
        self._has_episodes = False
        if self.rows is None:
            self._state = self._start(torch.full_like(self._environment, -1))
        else:
            self.rows.begin(int(self._seed), self._streams)

    def _start(self, episode: Tensor) -> EpisodeState:
        return self.start(episode, counter_rng.rng_key(self._seed, self._streams[0], self._environment, episode))

    def _noise_rng(self, state: EpisodeState) -> RngKey:
        """Return the keys of the episodes' noise, `[N]`."""
        return counter_rng.rng_key(self._seed, self._streams[1], self._environment, state.episode)

    def restart(self, state: EpisodeState, mask: Tensor) -> EpisodeState:
        """Return the states with new episodes in the rows of `mask` `[N]`."""
        return where(mask, self._start(state.episode + 1), state)

    def advance(
        self, state: EpisodeState, option: Tensor | None, discrete: Tensor, parameters: Tensor, is_idle: Tensor
    ) -> tuple[EpisodeState, Tensor, Tensor]:
        """Return the states after one action, with the time limit, the rewards, and whether the actions are valid.

        Idle rows stay as they are. The other results of an invalid action are meaningless.
        """
        action, is_valid = self._chosen(option, discrete, parameters)
        after, reward = self.act(state, action, self._noise_rng(state), is_idle)
        is_out_of_time = (after.steps >= self.max_steps) & (after.outcome == GOING_ON)
        after = replaced(after, outcome=torch.where(is_out_of_time, len(self.outcomes) - 1, after.outcome))
        return where(is_idle, state, after), torch.where(is_idle, 0.0, reward), is_valid

    def _chosen(self, option: Tensor | None, discrete: Tensor, parameters: Tensor) -> tuple[Action, Tensor]:
        """Return the actions as `act` takes them, and whether they are valid `[N]`."""
        exists = (discrete >= 0) & (discrete < len(self.parameter_dims))
        action = torch.where(exists, discrete, 0)
        own = parameters.to(self._parameter_low.dtype).gather(-1, self._parameter_place[action])
        has_parameter = self._has_parameter[action]
        is_finite = own.isfinite()
        is_valid = exists & (is_finite | ~has_parameter).all(-1)
        if option is not None:
            is_valid = is_valid & (option >= 0) & (option < len(self.option_names))
        own = torch.where(has_parameter & is_finite, own, 0.0)
        own = own.clamp(self._parameter_low[action], self._parameter_high[action])
        return Action(action, torch.where(has_parameter, own, 0.0), option), is_valid

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = self.reset_mask(tensordict)
        given = self._given_columns(tensordict)
        results = None
        if self.rows is not None:
            results = self.rows.restart(mask.numpy(force=True))
        else:
            self._state = self.restart(self._state, mask)
        if given:
            state = self._state
            self._state = where(mask, replaced(state, **given), state)
            results = None
        self._has_episodes = True
        self._on_start(mask)
        return self.read() if results is None else self._reading(results)

    def _on_start(self, mask: Tensor) -> None:
        """Prepare what episodes that have just begun or were put elsewhere, in the rows of `mask` `[N]`, need."""
        if self.planning_oracle is not None:
            self.planning_oracle.plan(self._state, mask)

    def _given_columns(self, tensordict: TensorDictBase | None) -> dict[str, Tensor]:
        """Return the columns of the state that `reset` was given."""
        names = () if tensordict is None else self.start_keys & set(tensordict.keys())
        if tensordict is None or not names:
            return {}
        columns = self.start_columns({name: tensordict.get(name).cpu().numpy() for name in names})
        return {name: torch.from_numpy(column).to(self.device) for name, column in columns.items()}

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_step", None)
        mask = None if mask is None else mask.reshape(self.num_envs)
        leaves = self.action_leaves(tensordict)
        if self.rows is not None:
            return self._reading(self._act(leaves, mask), has_reward=True)
        before = self._state
        is_idle = before.outcome != GOING_ON
        if mask is not None:
            is_idle = is_idle | ~mask
        after, reward, is_valid = self.advance(before, *leaves, is_idle)
        if not is_valid.all():
            raise self.invalid_action(int((~is_valid).nonzero()[0]), leaves)
        self._state = after
        return self.read().set(keys.REWARD, reward.unsqueeze(-1))

    def _step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        is_plain = self._plain_keys.issuperset(tensordict.keys())
        results = self._act_and_restart(tensordict) if is_plain else None
        if results is None:
            return super()._step_and_maybe_reset(tensordict)
        # As in TorchRL, the root keeps the action, in a tensordict of its own, since updates of the root change it.
        action = unchecked(dict(tensordict.get(keys.ACTION).items()), self)
        kept: dict[str, Any] = {keys.ACTION: action}
        if keys.OPTION in tensordict.keys():
            kept[keys.OPTION] = tensordict.get(keys.OPTION)
        root = self._reading(results, number=1, kept=kept)
        return tensordict.set("next", self._reading(results, has_reward=True)), root

    def step_and_restart(self, tensordict: TensorDictBase) -> tuple[TensorDict, TensorDict] | None:
        """Step and reset with one call of the kernel, see `PAMDPEnv.step_and_restart`."""
        results = self._act_and_restart(tensordict)
        if results is None:
            return None
        return self._reading(results, has_reward=True), self._reading(results, number=1)

    def _act_and_restart(self, tensordict: TensorDictBase) -> Results | None:
        """Act with the kernel, and begin new episodes where one ends; None if this takes TorchRL's way.

        One pass, because TorchRL's work between step and reset takes longer than the kernel.
        """
        is_plain = self._steps_plainly and self.rows is not None and tensordict.device == self.device
        if not is_plain or "_step" in tensordict.keys():
            return None
        return self._act(self.action_leaves(tensordict), None, restarts=True)

    def action_leaves(self, tensordict: TensorDictBase) -> tuple[Tensor | None, Tensor, Tensor]:
        """Return option, discrete actions and parameters, whose values are still to be checked.

        Raises:
            RuntimeError: no episode has begun since the last seed.
        """
        if not self._has_episodes:
            raise RuntimeError(f"{self.title}: no episode has begun; call reset before step")
        self.check_action(tensordict)
        action = tensordict.get(keys.ACTION)
        option = tensordict.get(keys.OPTION).long() if self._chooses else None
        return option, action.get("discrete").long(), action.get("parameters").float()

    def _act(
        self, leaves: tuple[Tensor | None, Tensor, Tensor], mask: Tensor | None, *, restarts: bool = False
    ) -> Results:
        """Act with the kernel."""
        assert self.rows is not None
        option, discrete, parameters = leaves
        results = self.rows.act(
            None if option is None else _array(option),
            _array(discrete),
            _array(parameters),
            mask=None if mask is None else _array(mask),
            restarts=restarts,
        )
        if isinstance(results, int):
            raise self.invalid_action(results, leaves)
        return results

    def invalid_action(self, row: int, leaves: tuple[Any, Any, Any]) -> ValueError:
        """Return the error for the action of a row, given the tensors or arrays of all rows."""
        return invalid_choice(row, leaves, self.parameter_dims, len(self.option_names), self.action_names)

    def read(self) -> TensorDict:
        """Return what is seen of the states, without a reward."""
        if self.rows is not None:
            return self._reading(self.rows.read())
        state = self._state
        outcome = state.outcome.long()
        done = (outcome != GOING_ON).unsqueeze(-1)
        truncated = (outcome == len(self.outcomes) - 1).unsqueeze(-1)
        leaves = {
            keys.OBSERVATION: self.shown(self.observe(state)),
            keys.OUTCOME: outcome,
            **{name: extra.unsqueeze(-1) for name, extra in zip(self.extra_names, self.extras(state), strict=True)},
            **self._flags(done, done & ~truncated, truncated),
        }
        return self._with_knowledge(TensorDict(leaves, batch_size=self.batch_size, device=self.device))

    def _reading(
        self, results: Results, *, number: int = 0, has_reward: bool = False, kept: Mapping[str, Any] | None = None
    ) -> TensorDict:
        """Return one of the kernel's readings, with rewards or other leaves."""
        flags = torch.from_numpy(results.flags[number]).unsqueeze(-1)
        leaves: dict[str, Any] = {
            **(kept or {}),
            keys.OBSERVATION: self.shown(torch.from_numpy(results.observations[number])),
            keys.OUTCOME: torch.from_numpy(results.outcomes[number]),
            **self._flags(*flags.unbind(0)),
        }
        for place, (name, dtype) in enumerate(zip(self.extra_names, self._extra_types, strict=True)):
            leaves[name] = torch.from_numpy(results.extras[number, place]).unsqueeze(-1).to(dtype)
        if has_reward:
            leaves[keys.REWARD] = torch.from_numpy(results.rewards).unsqueeze(-1)
        if not self._is_on_cpu:
            leaves = {name: leaf.to(self.device) for name, leaf in leaves.items()}
        return self._with_knowledge(unchecked(leaves, self))

    def _flags(self, done: Tensor, terminated: Tensor, truncated: Tensor) -> dict[Any, Tensor]:
        """Return the flags `[N, 1]` as leaves."""
        if self.limit_terminates:
            terminated, truncated = done.clone(), torch.zeros_like(done)
        return {keys.DONE: done, keys.TERMINATED: terminated, keys.TRUNCATED: truncated}

    def _with_knowledge(self, seen: TensorDict) -> TensorDict:
        if self._has_knowledge:
            for name, leaf in self._knowledge().items():
                seen.set(name, leaf)
        return seen


class KernelEnv(BatchedEnv[EpisodeState]):
    """A `BatchedEnv` whose rules are its `row_kernel` alone, which runs on the CPU whatever the device.

    Actions move to the CPU, and what is observed to the device. Nothing has gradients.
    """

    row_kernel: ClassVar[Advance | None]  # None in a subclass that has tensor functions after all
    state_type: type[EpisodeState]
    num_columns: tuple[int, int]  # of the state: float32 columns, which come first, and int32 columns

    def _make_rows(self) -> KernelRows | None:
        if self.row_kernel is None:
            return None
        owner = next(cls for cls in type(self).__mro__ if "row_kernel" in vars(cls))
        replaced = [rule for rule in _RULES if getattr(type(self), rule) is not getattr(owner, rule)]
        if replaced:
            name, rules = type(self).__name__, ", ".join(replaced)
            raise TypeError(f"{name}: overrides {rules}, but only the kernel of {owner.__name__} has rules")
        bounds = self.full_action_spec_unbatched[keys.PARAMETERS].space
        return KernelRows(
            self.row_kernel,
            self.num_envs,
            num_columns=self.num_columns,
            reading_dims=(len(self.observation_names), len(self.extra_names)),
            parameter_dims=self.parameter_dims,
            bounds=torch.stack([bounds.low.reshape(-1), bounds.high.reshape(-1)]).numpy(force=True),
            settings=[self.max_steps, len(self.option_names) if self._chooses else 0, *self.kernel_settings()],
            first_env=int(self._environment[0]),
        )

    @property
    def _state(self) -> EpisodeState:
        """The columns, which the kernel changes in place."""
        if self.rows is None:
            return self._columns
        return self.state_type(*(column.to(self.device) for column in self._shared_columns(self.rows)))

    @_state.setter
    def _state(self, state: EpisodeState) -> None:
        if self.rows is None:
            self._columns = state
        else:
            overwrite(self._shared_columns(self.rows), state)

    def _shared_columns(self, rows: KernelRows) -> EpisodeState:
        """Return the kernel's columns, which share its memory."""
        return from_arrays(self.state_type, (*rows.floats, *rows.integers))

    def start(self, episode: Tensor, rng: RngKey) -> EpisodeState:
        """Refuse: the kernel starts episodes."""
        raise NotImplementedError

    def act(self, state: EpisodeState, action: Action, rng: RngKey, is_idle: Tensor) -> tuple[EpisodeState, Tensor]:
        """Refuse: the kernel acts."""
        raise NotImplementedError

    def observe(self, state: EpisodeState) -> Tensor:
        """Refuse: the kernel observes."""
        raise NotImplementedError


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()
