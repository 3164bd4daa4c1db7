"""The settings and the card of environments made with Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import SOURCE_SETTINGS, ProblemFacts, ProblemOptions
from hpamdp.settings import PositiveFraction, Settings

ActionForm = Literal["auto", "components"]
MaskSource = Literal["info", "ignore"]
OutOfBounds = Literal["refuse", "clip", "allow"]
Scaling = Literal["bounds", "running", "none"]


class GymnasiumOptions(Settings):
    """Settings of `GymnasiumEnv`."""

    id: str | None = None
    """The registered name, as `gymnasium.make` takes it; `module:Name-v0` imports the module, which registers it."""
    entry_point: str | None = None
    """Instead of `id`, a class or function `package.module:name` that returns the environment."""
    kwargs: dict[str, Any] | None = None
    """Arguments of the environment's constructor, as in `env.kwargs={size:5}`."""
    max_steps: PositiveInt | None = None
    """Steps after which an episode is truncated. If null, the limit of the `TimeLimit` wrapper or of the spec.

    An environment without either must end a random episode within 1,000 steps; then the limit is 10,000.
    """
    action_form: ActionForm = "auto"
    """How the action space is read. `auto`: a `Discrete` and boxes beside it can be one choice with its parameters.

    `components`: all parts are independent, so that a `Box` beside a `Discrete` counts whatever is chosen. Only a
    `OneOf` is then a choice with parameters of its own.
    """
    parameter_dims: list[int] | None = None
    """How many parameters each discrete action takes of one box for all, as in [1, 1, 0]. If null, the whole box."""
    option_key: int | str | None = None
    """The option's name in a `Dict` of actions or its number in a `Tuple`. If null, the entry `option`, if any."""
    action_mask: MaskSource | None = None
    """Where the environment says which actions it forbids. `info`: `action_mask` and `option_mask` in each info.

    `ignore`: masks are ignored. If null, the entries `action_mask` and `option_mask` of a `Dict` of observations, or
    else of the infos if a first reset gives them. A method `action_masks()` is then refused.
    """
    pair_mask: MaskSource | None = None
    """Where the environment says which discrete actions of different components go together, `pair_mask`.

    `info`: in each info; `ignore`: it is ignored. If null, the entry of a `Dict` of observations, or else of the infos
    if a first reset gives it.
    """
    parameter_bounds: MaskSource | None = None
    """Where the environment gives bounds of the current state, `parameter_low` and `parameter_high`.

    `info`: in each info; `ignore`: they are ignored. If null, entries of a `Dict` of observations, or else of the infos
    if a first reset gives them.
    """
    observation_keys: list[int | str] | None = None
    """Entries of a `Tuple` or `Dict` to observe, as in [0] or [position, speed]. If null, all but masks and bounds."""
    observation_scaling: Scaling = "bounds"
    """`bounds`: to [-1, 1], if the space has bounds; `running`: to mean 0 and standard deviation 1; `none`: not.

    Pictures stay as they are; an encoder divides them by 255.
    """
    raw_observations: list[int | str] | None = None
    """Entries that stay unscaled: names in a `Dict`, numbers in a `Tuple` or of the vector. If null, all are scaled."""
    reward_scaling: PositiveFraction | None = None
    """Divide rewards in training by the running standard deviation of the return with this discount.

    If null, rewards are not scaled.
    """
    reward_clip: PositiveFloat = 10.0
    """Largest absolute value of a scaled reward.

    A reward that comes once in an episode of T steps is about sqrt(T) deviations. A lower limit hides how large it is.
    """
    out_of_bounds: OutOfBounds = "refuse"
    """If a number is outside the bounds of its `Box`, `refuse` ends the run, `clip` moves it, and `allow` keeps it."""
    staggered: bool = False
    """Truncate the first episode of each copy in training after another number of steps.

    Otherwise copies whose episodes all have the same length stay at the same step. Batches that are shorter than an
    episode then hold only a part of it: the day, or the night.
    """
    terminates_at_limit: bool = False
    """Terminate episodes at the time limit, which then belongs to the problem: no value follows.

    Otherwise they are truncated, and learners bootstrap from the value of the next state. If the observation shows the
    time, training never visits such a state, so its value is never corrected.
    """
    num_workers: NonNegativeInt = 0
    """Processes that step the copies at the same time, for slow environments. If 0, this process steps them."""


class SimulatorOptions(ProblemOptions):
    """Settings of every `SimulatorEnv`.

    Tables begin with the settings of the simulator if its model is named second, as in
    `class TrafficOptions(SimulatorOptions, TrafficRules)`.
    """

    render: bool = False
    """Draw the environment, for films; steps then take longer."""
    reward_scaling: PositiveFraction | None = None
    """Divide rewards in training by the running standard deviation of the return with this discount.

    If null, rewards are not scaled.
    """
    num_workers: NonNegativeInt = 0
    """Processes that step the environments in parallel. If 0, this process steps them."""

    @property
    def default_options(self) -> Mapping[str, Sequence[int | str]]:
        """Options to begin with; none unless a subclass suggests some."""
        return {}

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem, which errors call `title`."""
        return ProblemFacts(
            title=title,
            is_shardable=self.num_workers == 0,
            has_statistics=self.reward_scaling is not None,
            default_options=self.default_options,
        )


CARDS = {"GymnasiumEnv": ProblemCard(options=GymnasiumOptions, guarded_settings=SOURCE_SETTINGS)}
