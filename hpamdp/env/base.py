"""What an environment tells the framework beyond TorchRL's own contract."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, MultiCategorical
from torchrl.envs import EnvBase

from hpamdp import keys
from hpamdp.cards import ProblemCard
from hpamdp.components import MAX_PAIRED, Components
from hpamdp.devices import checked_device
from hpamdp.env.errors import ProblemError as ProblemError  # part of what a problem may use
from hpamdp.env.facts import ProblemFacts, ProblemOptions
from hpamdp.env.gymnasium_form import GymnasiumForm, VectorForm
from hpamdp.geometry import PlaneGeometry, Symmetries
from hpamdp.messages import as_code
from hpamdp.observation_entries import ObservationEntry
from hpamdp.settings import SettingError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hpamdp.env.play_page import PlayPage
    from hpamdp.settings import Settings

OBSERVATION_ENTRIES = (
    "observation_entries"  # in `ranges`: checksums of the names of the observation's entries, in order
)
# Separates the seeds of an evaluation from the small ones that people give to training.
_EVALUATION = 0x5EED0000


@dataclass(frozen=True)
class Metric:
    """A figure of an evaluation, as tables and plots show it.

    Attributes:
        name: in the summary, and with the prefix `eval/` in `metrics.csv`.
        title: what people read.
        kind: a `number`, a `share`, that is a fraction of the episodes (shown in percent), or a `count` (two digits).
    """

    name: str
    title: str
    kind: Literal["number", "share", "count"] = "number"


class PAMDPEnv(EnvBase):
    """`num_envs` copies of a problem with parameterised actions, in one batch dimension.

    A subclass has these specs:
    - `observation` float32 `[N, observation_dim]`; uint8 if all `observation_entries` are pictures;
    - the action leaves `("action", "discrete")` int64 `[N]` and `("action", "parameters")` float32
      `[N, num_parameters]`: the bounded parameters of all discrete actions side by side. Only those of the chosen
      action count;
    - if the agent chooses options, the action leaf `option` int64 `[N]`;
    - if some choices are forbidden at times, `action_mask` bool `[N, num_discrete]` and `option_mask` bool
      `[N, num_options]` beside the observation: what may be chosen in the current state;
    - if the action has several components, see `hpamdp.components`: `("action", "discrete")` int64
      `[N, num_components]`. If the choice in one forbids discrete actions of later ones, `pair_mask` bool
      `[N, num_discrete, num_discrete]` beside the observation: whether the column's action may follow the row's;
    - if parameters have other bounds in each state, `parameter_low` and `parameter_high` float32 `[N, num_parameters]`
      beside the observation, within the bounds of the spec;
    - if an episode is a session of several trips (`ProblemCard.has_trips`), `trip_ended` bool `[N, 1]` beside the
      observation: whether the step ended a trip. It is also true where `done`, and false after a reset. The next trip
      begins at once: the observation of the same step is its first one;
    - if steps take different times, `duration` float32 `[N, 1]` beside the observation: how long the step took, in
      units of one discount. `policies.base.step_discounts` says which learners count it. It is 0 after a reset;
    - `reward`, `done`, `terminated`, `truncated` `[N, 1]`; a time limit is `truncated` only.

    A step does not change an episode that is over, and its reward is 0.

    The other attributes and methods tell the framework how an episode went, what is best possible, and which tables and
    figures show it. All of them have defaults.
    """

    options: Any = None  # the problem's settings, if its class lists them
    # The entries of the observation, in their order, if any of them is a picture. Pixels are integers from 0 to 255.
    # Empty if the constructor gets `flatten_pictures=True`, since pictures are then part of the vector.
    observation_entries: tuple[ObservationEntry, ...] = ()
    option_names: tuple[str, ...] = ()
    discrete_names: tuple[str, ...] = ()  # of the discrete actions, if they have names
    option_actions: tuple[tuple[bool, ...], ...] | None = None  # what `group_actions` has made of the options
    can_change_option: bool = True  # whether an option may end before its episode
    plans_change_options: bool = False  # whether the plans under `oracle` change options within an episode
    parameter_dims: tuple[int, ...]  # number of parameters of each discrete action
    component_sizes: tuple[int, ...] = ()  # number of discrete actions of each component; empty: one component
    integer_parameters: tuple[bool, ...] = ()  # whether each parameter is a whole number; empty: none is
    # Place in the observation from which `parameter_low` and then `parameter_high` stand, both on one scale.
    bounds_place: int | None = None
    max_steps: int  # steps of the longest episode
    result_keys: tuple[str, ...] = ()  # leaves of an episode's last step that `results` reads

    # Whether a reset of some environments returns the others unchanged. If so, TorchRL's merge of the two changes
    # nothing and is left out, since it takes longer than simple physics of 65,536 environments.
    reset_returns_all_rows: ClassVar[bool] = False

    # What the class declares; see `ProblemCard`.
    card: ClassVar[ProblemCard] = ProblemCard()
    # Width and height of the pictures of `film`, in units of its `size`.
    film_shape: ClassVar[tuple[float, float]] = (1.0, 1.0)

    # Rows of the closing table, and panels of the learning curves.
    table_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "score"),
        Metric("success", "success", "share"),
        Metric("steps", "steps an episode", "count"),
        Metric("optimality_gap", "gap to the ceiling"),
    )
    curve_metrics: ClassVar[tuple[Metric, ...]] = (
        Metric("score", "Score"),
        Metric("success", "Episodes that succeed", "share"),
    )

    def __init__(self, *, device: torch.device | str | None = None, **arguments: Any) -> None:
        super().__init__(device=None if device is None else checked_device(self, device), **arguments)

    @classmethod
    def checked_numbers(cls, num_envs: int, seed: int, first_env: int) -> tuple[int, int, int]:
        """Return these arguments of a constructor.

        Raises:
            SettingError: one is no whole number, or too small.
        """
        given = {"num_envs": (num_envs, 1), "seed": (seed, 0), "first_env": (first_env, 0)}
        numbers = [checked_number(f"{cls.__name__}: {name}", *value) for name, value in given.items()]
        return numbers[0], numbers[1], numbers[2]

    @classmethod
    def facts(cls, options: Settings) -> ProblemFacts | None:
        """Return what these settings tell of the problem; None if only a built environment knows it."""
        return options.facts(cls.__name__) if isinstance(options, ProblemOptions) else None

    @property
    def title(self) -> str:
        """What errors call the problem."""
        return type(self).__name__

    @property
    def default_options(self) -> Mapping[str, Sequence[int | str]]:
        """Options to begin with, as for `group_actions`; empty if the problem suggests none."""
        facts = None if self.options is None else self.facts(self.options)
        return {} if facts is None else facts.default_options

    def group_actions(self, options: Mapping[str, Sequence[int | str]]) -> None:
        """Let the agent choose among options that allow some of the discrete actions each.

        The action spec then has the leaf `option`. A step refuses an action that the option does not allow. An action
        may belong to several options or to none.

        Args:
            options: for each option's name its discrete actions, by number or name, with _ for a space.

        Raises:
            ValueError: the problem has options of its own, an option has no action or has one twice, or an action does
                not exist.
        """
        if self.has_choice or self.option_names:
            raise ValueError(f"{self.title} has options of its own: {', '.join(self.option_names)}")
        if not options:
            raise ValueError("name at least one option")
        num_discrete = len(self.parameter_dims)
        rows = []
        for name, actions in options.items():
            if not actions:
                raise ValueError(f"option {name} allows no action; name at least one")
            numbers = [self._number_of_action(action) for action in actions]
            if len({*numbers}) < len(numbers):
                raise ValueError(f"option {name} has an action twice: {', '.join(map(str, actions))}")
            row = [number in numbers for number in range(num_discrete)]
            if not self.components.any_of_each(torch.tensor(row)):
                raise ValueError(f"option {name} allows no action of some component; name at least one of each")
            rows.append(tuple(row))
        self.option_names = tuple(options)
        self.option_actions = tuple(rows)
        n, device = self.batch_size, self.device
        leaf = {keys.OPTION: Categorical(len(rows), shape=n, device=device)}
        self.action_spec = Composite(**leaf, **self.full_action_spec, shape=n)
        self._allowed_by_option = torch.tensor(rows, device=device)

    @property
    def grouping(self) -> dict[str, list[int]] | None:
        """Return the discrete actions of each option that `group_actions` made, by number; None if it made none."""
        if self.option_actions is None:
            return None
        rows = zip(self.option_names, self.option_actions, strict=True)
        return {name: [number for number, allowed in enumerate(row) if allowed] for name, row in rows}

    def _number_of_action(self, action: int | str) -> int:
        num_discrete = len(self.parameter_dims)
        names = [name.replace(" ", "_") for name in self.discrete_names]
        if isinstance(action, int):
            if 0 <= action < num_discrete:
                return action
        elif action.replace(" ", "_") in names:
            return names.index(action.replace(" ", "_"))
        named = f" or {', '.join(names)}" if names else ""
        raise ValueError(f"{self.title} has no discrete action {action}; it has 0 to {num_discrete - 1}{named}")

    def step_and_restart(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase] | None:
        """Step all environments, and begin new episodes where one ends, faster than by a step and a reset.

        Args:
            tensordict: the states with their actions, `[N]`.

        Returns:
            What followed the step, with its reward, and the states to go on from; or None, with nothing done, if step
            and reset must be called instead.
        """
        return None

    def check_masks(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the result of a step or a reset with masks that allow something in every row.

        If an episode is over and its mask allows nothing, the mask becomes one that allows everything.

        Raises:
            ProblemError: an episode goes on, but its mask allows nothing.
        """
        for name in (keys.ACTION_MASK, keys.OPTION_MASK):
            mask = tensordict.get(name, None)
            if mask is None:
                continue
            is_empty = ~(mask.any(-1) if name == keys.OPTION_MASK else self.components.any_of_each(mask))
            self._refuse_stuck(is_empty, tensordict, f"an {name} that allows nothing")
            tensordict.set(name, mask | is_empty.unsqueeze(-1))
        pair_mask = tensordict.get(keys.PAIR_MASK, None)
        if pair_mask is not None:
            components = self.components
            if (num := math.prod(components.sizes)) > MAX_PAIRED:
                raise ProblemError(
                    f"{self.title}: a {keys.PAIR_MASK} takes at most {MAX_PAIRED:,} combinations of components, but "
                    f"there are {num:,}"
                )
            mask = tensordict.get(keys.ACTION_MASK, torch.ones_like(pair_mask[..., 0]))
            is_empty = ~components.leaves_any(mask, pair_mask)
            self._refuse_stuck(is_empty, tensordict, f"a {keys.PAIR_MASK} that allows no action")
            tensordict.set(keys.PAIR_MASK, pair_mask | is_empty[..., None, None])
        return tensordict

    def _refuse_stuck(self, is_empty: Tensor, tensordict: TensorDictBase, what: str) -> None:
        """Refuse empty masks, bool `[N]`, of episodes that go on; `what` names the mask."""
        is_stuck = is_empty & ~tensordict.get(keys.DONE).squeeze(-1)
        if is_stuck.any():
            raise ProblemError(f"{self.title}: environment {int(is_stuck.nonzero()[0])} gave {what}")

    @property
    def components(self) -> Components:
        """The components of the action."""
        return Components(tuple(self.component_sizes) or (len(self.parameter_dims),))

    @property
    def has_choice(self) -> bool:
        """Whether the agent chooses an option."""
        return keys.OPTION in self.full_action_spec.keys()

    @property
    def is_shardable(self) -> bool:
        """Whether several processes can each step some of the environments, since these share no state."""
        return True

    @property
    def position(self) -> Tensor | None:
        """Positions of the agents for drawing, `[N, 2]`; None if agents have no position."""
        return None

    @property
    def symmetries(self) -> Symmetries | None:
        """The maps that leave dynamics and reward unchanged; None if none is known."""
        return None

    @property
    def geometry(self) -> PlaneGeometry | None:
        """Which entries of the observation are vectors, and where the actions point; None if there are no vectors."""
        return None

    def fixed_episodes(self, seed: int) -> TensorDict | None:
        """Return the argument of `reset` for the evaluation episodes of a seed, one for each environment.

        If None, `seed_evaluation(seed)` and a reset without arguments begin these episodes.
        """
        return None

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Set the seed, and return the next one; see TorchRL's `EnvBase.set_seed`.

        Raises:
            ValueError: the seed is no whole number of at least 0.
        """
        return super().set_seed(None if seed is None else checked_number("seed", seed), static_seed)

    def seed_evaluation(self, seed: int) -> None:
        """Seed the episodes and the noise of an evaluation.

        They should differ from those of training, whatever its seed.

        The default is `set_seed` with another seed. With random numbers from `counter_rng`, draw them from the streams
        EVALUATION and EVALUATION_NOISE until the next `set_seed`.
        """
        self.set_seed(checked_number("seed", seed) ^ _EVALUATION)

    def warn_if_seed_is_ignored(self, seed: int) -> None:
        """Warn if episodes with the same seed begin differently, which only somebody else's environment can do."""

    def describe(self) -> dict[str, Tensor]:
        """Return facts about the episodes that have just begun, first dimension `N`. A run asks once."""
        return {}

    def initial_parameters(self) -> tuple[Tensor, Tensor] | None:
        """Return the initial parameters that learners of this problem conventionally start with; None if none are.

        They are linear in the observation that the learner sees. Returned are weights `[num_parameters,
        observation_dim]` and a bias `[num_parameters]`, in units in which the parameters' bounds are [-1, 1].
        """
        return None

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        """Return results of episodes, `[M]` each, from the leaves `result_keys` of their last steps.

        Comparisons of agents use `score`, if there is one, instead of the return. `success` is bool, or a fraction.
        """
        return {}

    def played(self) -> dict[str, Tensor]:
        """Return what the environment has noted of an evaluation's episodes, `[N, ...]` each, once all are over."""
        return {}

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return further means of an evaluation, beside score and success, from the arrays of `Evaluation.run`.

        `ceiling` is the best possible mean score on the same episodes, if it is known.
        """
        return {}

    def references(self, measured: Mapping[str, float]) -> dict[str, dict[str, float]]:
        """Return figures to compare with the agent's own, by the name of the player who reached them.

        Args:
            measured: the means of the agent's evaluation. `random`, the uniformly random agent, is added by the run.
        """
        if "ceiling" not in measured:
            return {}
        return {"ceiling": {"score": measured["ceiling"], "optimality_gap": 0.0}}

    def summary_entries(self) -> dict[str, Any]:
        """Return JSON values about the problem for a run's summary."""
        return {}

    @classmethod
    def curves(cls, summary: Mapping[str, Any]) -> tuple[Metric, ...]:
        """Return the panels of the learning curves of a run with this summary: `curve_metrics` by default."""
        return cls.curve_metrics

    @classmethod
    def draw_figures(cls, evaluation: Mapping[str, np.ndarray], summary: Mapping[str, Any]) -> dict[str, Figure]:
        """Return figures of the final evaluation by their file names, such as `trajectories.png`.

        Args:
            evaluation: the arrays of `evaluation.npz`, any of which may be missing.
            summary: of the run; `references` has the figures to compare with.
        """
        return {}

    def film_state(self, num: int) -> dict[str, Tensor]:
        """Return what `film` needs to know of the first `num` environments now, columns `[num, ...]` on the CPU.

        By default this is their `env_state`. It is empty if the problem has no pictures.
        """
        return {name: column[:num].cpu().clone() for name, column in self.env_state().items()}

    def film(self, track: Sequence[Mapping[str, Tensor]], fps: float, size: int) -> Iterable[np.ndarray]:
        """Return the pictures of one episode, uint8 `[height, width, 3]` each; none if the problem has no pictures.

        Height and width are those of `film_shape`.

        Args:
            track: its `film_state` at the start and after every step, columns `[1, ...]`.
            fps: pictures a second.
            size: height and width of square pictures, px.
        """
        return ()

    def gymnasium_form(self) -> GymnasiumForm:
        """Return how one environment of the problem looks to Gymnasium."""
        return VectorForm(self)

    def page(self, seed: int) -> PlayPage | None:
        """Return the page on which people play this problem in a browser; None if there is none.

        Args:
            seed: of its episodes.
        """
        return None

    @property
    def keeps_episodes(self) -> bool:
        """Whether `env_state` holds the state of the episodes, so that a resumed run continues them."""
        return bool(self.env_state())

    def env_state(self) -> dict[str, Tensor]:
        """Return the state of the episodes for a checkpoint, `[N, ...]` each; empty if it is unknown."""
        return {}

    def check_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Refuse an `env_state` with invalid numbers; its names, dtypes and shapes have already been checked.

        By default all numbers must be finite. Override it if other numbers are valid, or if a column holds an index.

        Raises:
            ValueError: a number is invalid.
        """
        for name, column in columns.items():
            if not column.isfinite().all():
                raise ValueError(f"{name} is not finite")

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Continue from an `env_state`; an empty one starts new episodes.

        Raises:
            ValueError: the state is of another number of environments.
        """

    def statistics(self) -> dict[str, Tensor]:
        """Return the part of `env_state` that scales observations and rewards; empty if nothing is learned of it."""
        return {}

    def take_new_statistics(self) -> dict[str, Tensor]:
        """Return the statistics of the steps since the last call alone, as `statistics`."""
        return {}

    def add_statistics(self, columns: Mapping[str, Tensor]) -> None:
        """Add what another process has taken by `take_new_statistics`."""

    def set_statistics(self, columns: Mapping[str, Tensor]) -> None:
        """Set only these scales, from `statistics` or a whole `env_state`, to use a saved agent."""

    def file_checksums(self) -> dict[str, Tensor]:
        """Return the checksum int64 `[1]` of each file of one's own that describes the problem.

        The name is that of the setting that gives the file, and `_checksum`. Saved agents and `env_state` hold the
        checksums, so that an edited file is noticed.
        """
        return {}

    @property
    def observation_bounds(self) -> tuple[Sequence[float], Sequence[float]] | None:
        """The lowest and the highest observation that the agent sees, `[observation_dim]` each; None if unknown."""
        return None

    def ranges(self) -> dict[str, list[float]]:
        """Return the numbers that give actions and observations their meaning, by name: the parameters' bounds.

        Saved agents hold them, so that an edited environment is noticed.
        """
        space = self.full_action_spec_unbatched[keys.PARAMETERS].space
        return {"parameter_low": space.low.flatten().tolist(), "parameter_high": space.high.flatten().tolist()}

    def set_scaling_from(self, other: PAMDPEnv) -> None:
        """Scale observations as the other environment does, now and later, if their scale is learned.

        Raises:
            ProblemError: the other one scales observations, and this problem does not.
        """
        scaling = getattr(other, "scaling", None)
        if scaling is not None and not scaling.is_unscaled:
            raise ProblemError(
                f"{self.title}: the agent has learned with scaled observations, which this problem does not have; "
                "give it in Gymnasium's form"
            )

    def make_action_spec(self, low: Tensor, high: Tensor, *, has_option: bool = False) -> Composite:
        """Return the spec of the action leaves, given the bounds `[num_parameters]` of all parameters.

        Raises:
            ProblemError: `option_names` is not a list of different names.
        """
        self.option_names = checked_option_names(self.option_names)
        n, device = self.batch_size, self.device
        low, high = (side.to(device, torch.float32).expand(*n, -1) for side in (low, high))
        components = self.components
        action = Composite(
            discrete=Categorical(components.sizes[0], shape=n, device=device)
            if components.is_single
            else MultiCategorical(components.sizes, shape=(*n, *components.shape), device=device),
            parameters=Bounded(low, high, shape=low.shape, dtype=torch.float32, device=device),
            shape=n,
        )
        option = {keys.OPTION: Categorical(len(self.option_names), shape=n, device=device)} if has_option else {}
        return Composite(**option, action=action, shape=n)

    def reset_mask(self, tensordict: TensorDictBase | None) -> Tensor:
        """Return which environments `_reset` must reset, bool `[N]`: all, unless its argument says otherwise."""
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            return torch.ones(self.batch_size, dtype=torch.bool, device=self.device)
        return mask.reshape(self.batch_size)

    def _reset_proc_data(self, tensordict: TensorDictBase | None, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if not self.reset_returns_all_rows:
            return super()._reset_proc_data(tensordict, tensordict_reset)
        if tensordict is None:
            return tensordict_reset
        tensordict.pop("_reset", None)
        return tensordict.update(tensordict_reset)

    def check_action(self, tensordict: TensorDictBase) -> None:
        """Check the action leaves' shapes and types; their values are the subclass's to check.

        Raises:
            ValueError: a leaf is missing, or has another shape or type.
        """
        size = self.batch_size
        self._check_leaf(tensordict, keys.DISCRETE, (*size, *self.components.shape), is_integer=True)
        self._check_leaf(tensordict, keys.PARAMETERS, (*size, sum(self.parameter_dims)), is_integer=False)
        if self.has_choice:
            self._check_leaf(tensordict, keys.OPTION, size, is_integer=True)
        if self.option_actions is not None:
            self._check_option(tensordict.get(keys.OPTION), tensordict.get(keys.DISCRETE))

    def _check_option(self, option: Tensor, discrete: Tensor) -> None:
        """Refuse an option that does not exist, `[N]`, and an action `[N, ...]` that its option does not allow."""
        components = self.components
        is_action = components.exists(discrete)
        exists = (option >= 0) & (option < len(self._allowed_by_option)) & is_action
        places = components.places(torch.where(is_action.reshape(-1, *[1] * (discrete.ndim - 1)), discrete, 0))
        allowed = self._allowed_by_option[torch.where(exists, option, 0)].gather(-1, places.long())
        is_valid = exists & allowed.all(-1)
        if is_valid.all():
            return
        row = int((~is_valid).nonzero()[0])
        given = f"option={option[row].item()}, discrete={discrete[row].tolist()}"
        listed = (
            f"{name}: {[number for number, is_allowed in enumerate(allowed) if is_allowed]}"
            for name, allowed in zip(self.option_names, self._allowed_by_option.tolist(), strict=True)
        )
        raise ValueError(f"step: environment {row} got {given} (the options allow {', '.join(listed)})")

    @staticmethod
    def _check_leaf(
        tensordict: TensorDictBase, name: str | tuple[str, str], shape: tuple[int, ...], *, is_integer: bool
    ) -> None:
        value = tensordict.get(name)
        if value is None or value.shape != shape:
            given_shape = None if value is None else list(value.shape)
            raise ValueError(f"step: {name} has shape {given_shape}, but must be {list(shape)}")
        is_number = not (value.is_complex() or value.dtype == torch.bool)
        if not is_number or (is_integer and value.is_floating_point()):
            given_type = str(value.dtype).removeprefix("torch.")
            raise ValueError(
                f"step: {name} has type {given_type}, but must be {'integer' if is_integer else 'a number'}"
            )

    def make_done_spec(self) -> Composite:
        """Return the spec of `done`, `terminated` and `truncated`, bool `[N, 1]`."""
        flag = Binary(n=1, shape=(*self.batch_size, 1), dtype=torch.bool, device=self.device)
        flags = {name: flag.clone() for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED)}
        return Composite(flags, shape=self.batch_size, device=self.device)


def checked_option_names(given: object) -> tuple[str, ...]:
    """Return the names of options as a tuple.

    Raises:
        ProblemError: the value is not a list of names, or a name occurs twice.
    """
    if not isinstance(given, list | tuple) or not all(isinstance(name, str) for name in given):
        raise ProblemError(f"option_names is {as_code(given)}, but must be a list of names")
    if len({*given}) < len(given):
        raise ProblemError(f"option_names has a name twice: {', '.join(given)}")
    return tuple(given)


def checked_number(name: str, value: Any, least: int = 0) -> int:
    """Return an argument that is a whole number of at least `least`.

    Raises:
        SettingError: it is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise SettingError(f"{name}={as_code(value)}: must be a whole number of at least {least}")
    return int(value)
