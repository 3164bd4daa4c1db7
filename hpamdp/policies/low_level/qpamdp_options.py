"""The settings and the card of Q-PAMDP."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator
from typing_extensions import Self

from hpamdp.cards import ActionFeature, LearnerCard
from hpamdp.policies.shared.options import InitialParameters
from hpamdp.settings import Fraction, FromList, OnlyWith, PositiveFraction, Settings


class QPAMDPOptions(Settings):
    """Settings of `QPAMDP`. Means and standard deviations are in units where the parameters' bounds are [-1, 1]."""

    features: Annotated[tuple[NonNegativeInt, ...], FromList] | None = None
    """Entries of the observation that the features see, as in [8, 9]. If null, all entries that vary in the warm-up.

    With `agent.sharing=shared` add the entries of the one-hot option, which come last.
    """
    feature_range: Annotated[tuple[float, float], FromList] | None = None
    """Range to which these entries are clipped and scaled, as in [-1, 1]. If null, the range seen in the warm-up.

    Give it if random actions do not lead everywhere: states beyond the warm-up's range all look the same.
    """
    phi_order: PositiveInt = 5
    """Highest order of the Fourier basis of the discrete actions' values."""
    phi_max_coupled: PositiveInt = 2
    """Largest number of observation entries that one feature of the values depends on. Fewer give fewer features."""
    psi_order: PositiveInt = 3
    """Highest order of the Fourier basis of the mean parameters."""
    psi_max_coupled: PositiveInt = 2
    """Largest number of observation entries that one feature of the mean parameters depends on."""
    warmup_steps: PositiveInt = 2_000
    """Steps of the initial policy, from which the ranges of the entries are taken."""
    initial_episodes: PositiveInt = 1_000
    """Finished episodes in the first phase of Sarsa(lambda)."""
    relearning_episodes: PositiveInt = 500
    """Finished episodes in each later phase of Sarsa(lambda)."""
    gamma: PositiveFraction = 0.99
    """Discount of a step in the values of the discrete actions."""
    trace_decay: Fraction = 0.5
    """Lambda: the decay of the eligibility traces, besides the discount."""
    step_size: PositiveFloat = 1.0
    """Largest step size of the values; Dabney and Barto's bound lowers it."""
    step_scaling: bool = False
    """Divide the step of each weight by the norm of its Fourier feature's coefficients, as published."""
    step_bound: Literal["each_step", "non_increasing"] = "each_step"
    """Bound on the step size: recomputed for every update, or the smallest so far of updates that reduce the error.

    `non_increasing` is the published one; `each_step` allows a large step if traces and next features nearly cancel.
    """
    envs_per_update: PositiveInt | None = None
    """Environments over which an update of the values is averaged. If null, all of them. Published: 1.

    Small groups learn more from the same steps, because each group makes updates of its own, but take longer.
    """
    temperature: PositiveFloat = 0.1
    """Temperature of the softmax over the discrete actions' values at the start. Published: 1."""
    temperature_final: PositiveFloat = 0.01
    """Smallest temperature."""
    temperature_decay: PositiveFraction = 1.0
    """Factor on the temperature for each of the learner's episodes while the values are learned. Published: 0.995."""
    samples_in_parameter_phase: bool = True
    """Sample discrete actions also while the parameters are learned; if false, as published, take the best ones."""
    parameter_updates: PositiveInt | None = 10
    """Parameter updates in a phase: the k of Q-PAMDP(k). If null, that is Q-PAMDP(infinity), see `patience`."""
    patience: Annotated[PositiveInt, OnlyWith("parameter_updates", None)] = 5
    """Number of windows without a new best mean return after which a phase ends. Used if `parameter_updates` is null.

    A window is a parameter update, or `relearning_episodes` of Sarsa(lambda).
    """
    rollouts: PositiveInt = 200
    """Whole episodes in the regression of a parameter update."""
    natural_step_size: PositiveFloat = 5.0
    """Largest step size along the natural gradient."""
    max_divergence: PositiveFloat = 0.2
    """Largest divergence of the new policy from the old one, in nats an episode; it shortens the step."""
    ridge: NonNegativeFloat = 1e-4
    """Ridge penalty of the regression, in units of its regressors' mean square."""
    initial_parameters: InitialParameters = "domain"
    """Initial means: `domain` takes the problem's own initial parameters, if it has any; `none` takes none."""
    initial_mean: Annotated[float, Field(ge=-1.0, le=1.0)] = 0.0
    """Mean parameters at the start, without initial parameters."""
    sigma: PositiveFloat = 0.1
    """Standard deviation of the parameters at the start."""
    sigma_final: PositiveFloat = 0.04
    """Smallest standard deviation of the parameters."""
    sigma_decay: PositiveFraction = 0.99
    """Factor on the standard deviation at each parameter update of the learner. Published: 1."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.features is not None and len(set(self.features)) < len(self.features):
            raise ValueError(f"features={list(self.features)}: names an entry twice")
        if self.feature_range is not None and not self.feature_range[0] < self.feature_range[1]:
            raise ValueError(f"feature_range={list(self.feature_range)}: the first number must be less than the second")
        if self.sigma_final > self.sigma:
            raise ValueError(f"sigma_final={self.sigma_final}: must be at most sigma={self.sigma}")
        return self


CARDS = {
    "QPAMDP": LearnerCard(
        options=QPAMDPOptions,
        takes=frozenset({ActionFeature.PARAMETER_BOUNDS}),
        has_value=True,
        needs_current_policy=True,
        explores_with=frozenset({"actions", "rewards"}),
    )
}
