"""The settings and the card of P-DQN."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt, model_validator
from typing_extensions import Self

from hpamdp.cards import ActionFeature
from hpamdp.policies.shared.options import REPLAY_CARD, InitialParameters, ReplayMemoryOptions, SearchingActorOptions
from hpamdp.settings import OnlyWith, OwnSteps, PositiveFraction, Schedule


class PDQNOptions(ReplayMemoryOptions, SearchingActorOptions):
    """Settings of `PDQN`; `python run.py low=pdqn --help` shows them together with those of all replay learners."""

    multipass: bool = True
    """Show the value of a discrete action its own parameters alone, as in MP-DQN; else all parameters, as in P-DQN."""
    double_q: bool = False
    """Choose the next action by the learned critics; the target critics evaluate it either way."""
    n_step: PositiveInt = 1
    """Rewards summed before bootstrapping. A sum also ends with its batch, so long sums need long batches."""
    bounding: Literal["tanh", "inverting_gradients"] = "tanh"
    """How the parameters are kept within their bounds: by `tanh`, or clipped, with `inverting_gradients`."""
    initial_parameters: InitialParameters = "domain"
    """Initial parameters: `domain` adds the problem's own by a frozen layer, if it has any; `none` adds nothing."""
    actor_tau: PositiveFraction = 0.01
    """Fraction of the way to the actor that its target network moves at each actor update."""
    critic_tau: PositiveFraction = 0.01
    """Fraction of the way to the critics that their target networks move at each actor update."""
    max_grad_norm: PositiveFloat | None = None
    """Largest gradient norm of a gradient step; if null, there is no limit."""
    random_parameters: Literal["uniform", "actor"] = "uniform"
    """Parameters of a random action: drawn uniformly from their bounds, or those of the actor, with its noise."""
    noise_process: Literal["gaussian", "ornstein_uhlenbeck"] = "gaussian"
    """The noise on parameters: independent at each step, or a process that returns to 0 by 0.15 of its size a step.

    With `ornstein_uhlenbeck`, `parameter_noise` is the standard deviation of what is added in a step. The process goes
    on from episode to episode.
    """
    epsilon_steps: Annotated[NonNegativeInt, OnlyWith("epsilon_episodes", None), OwnSteps(), Schedule()] = 40_000
    epsilon_episodes: Annotated[PositiveInt | None, OwnSteps()] = None
    """Episodes that end with the learner's own steps, within which the probability of a random action falls.

    They are counted from the start, those of the warm-up too, and take the place of `epsilon_steps`.
    """

    @model_validator(mode="after")
    def _check_pdqn(self) -> Self:
        if self.preactivation_penalty > 0.0 and self.bounding != "tanh":
            raise ValueError(
                f"preactivation_penalty={self.preactivation_penalty}: needs bounding=tanh; bounding={self.bounding!r}"
            )
        if self.memory == "gru" and self.n_step > 1:
            raise ValueError(f"n_step={self.n_step}: does not go with memory=gru; use n_step=1 or memory=stack")
        if self.memory == "gru" and self.double_q:
            raise ValueError("double_q=true: does not go with memory=gru, whose states differ between both critics")
        if self.search_samples > 0 and not self.multipass:
            raise ValueError(
                f"search_samples={self.search_samples}: needs multipass=true, as values else depend on other actions' "
                "parameters"
            )
        return self


CARDS = {
    "PDQN": replace(
        REPLAY_CARD,
        options=PDQNOptions,
        takes=frozenset({ActionFeature.COMPONENTS, ActionFeature.PARAMETER_BOUNDS}),
        takes_pictures=True,
        has_value=True,
    )
}
