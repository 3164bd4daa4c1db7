"""The settings and the card of HyAR."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt, model_validator
from typing_extensions import Self

from hpamdp.cards import ActionFeature
from hpamdp.policies.shared.options import REPLAY_CARD, SearchingActorOptions, TargetRateOptions
from hpamdp.settings import LearningRate, OnlyWith, PositiveFraction, Schedule


class HyAROptions(TargetRateOptions, SearchingActorOptions):
    """Settings of `HyAR`. Noise is in units where the latent action's bounds are [-1, 1].

    The published settings are those of `low=hyar_published`.
    """

    twin: bool = True
    """Train by TD3 (HyAR-TD3). If false, train by DDPG (HyAR-DDPG): one critic, no delay, no target smoothing."""
    discrete: Literal["greedy", "nearest"] = "greedy"
    """Discrete action: the one with the highest value (`greedy`), or with the embedding nearest to e (`nearest`).

    `nearest` is the published form. With `greedy`, updates take longer the more discrete actions there are.
    """
    warmup_steps: PositiveInt = 2000
    """Random steps of a learner before its first update; the codec is trained on them."""
    critic_window: PositiveInt | None = None
    """Newest steps after the warm-up that the critics and the actor learn from; if null, all that are stored."""
    inverting_gradients: bool = False
    """Scale the gradient of a latent action by the range that is left to its bound, as published, in addition to tanh.

    The range is that in the direction of the gradient (Hausknecht and Stone 2016, arXiv 1511.04143).
    """
    actor_max_grad_norm: PositiveFloat | None = None
    """Largest gradient norm of an update of the actor; if null, there is no limit."""
    noise_initial: PositiveFloat | None = None
    """Scale of the exploring noise after the warm-up; it falls to `parameter_noise`. If null, it is constant."""
    noise_episodes: Annotated[PositiveInt, OnlyWith("noise_initial")] = 1000
    """The learner's own episodes, after its warm-up, within which the scale of the noise falls linearly."""
    correction_factor: Annotated[PositiveFloat, OnlyWith("parameter_tolerance", None)] = 5.0
    """Encode a stored z again if the error of its predicted change is this many times the codec's error."""
    correction_error: Annotated[Literal["mean", "latest"], OnlyWith("parameter_tolerance", None)] = "mean"
    """The codec's error: its mean over the last hundred or so updates of the codec, or the `latest`, as published.

    The latest error is that of the 4,096 stored transitions from which the range of z was estimated last.
    """
    parameter_tolerance: NonNegativeFloat | None = None
    """Encode a stored z again if its decoded parameters differ from the executed ones by more than this.

    If null, the predicted change decides (`correction_factor`). If the next state is hard to predict, the parameters
    are the surer sign.
    """
    relabelling: Literal["mean", "sample"] = "sample"
    """Latent action in place of an outdated or random one: the encoder's mean, or a sample as published.

    The means lie on a line in the latent space. Off that line, where the actor goes, only samples teach the critics.
    """
    lr_final_fraction: PositiveFraction = 0.1
    """Fraction of the three learning rates that is left after `lr_steps`; 1 keeps them constant."""
    epsilon_steps: Annotated[NonNegativeInt, Schedule()] = 15_000
    embedding_dim: PositiveInt = 6
    """Dimension of a discrete action's embedding e."""
    latent_dim: PositiveInt | None = None
    """Dimension of the latent variable z of the VAE; if null, the largest number of parameters of a discrete action."""
    codec_hidden_dim: PositiveInt = 128
    """Width of the codec's layers."""
    codec_inputs: Literal["concatenated", "multiplied"] = "concatenated"
    """How the codec's networks join the state and e with the parameters or z: `concatenated`, or `multiplied`.

    `multiplied` is the published form: each of the two goes through a layer of its own, and their outputs are
    multiplied.
    """
    predicted_change: Literal["standardised", "bounded"] = "standardised"
    """Predicted change of the state: in standard deviations over `change_unit` (`standardised`), or `bounded`.

    `bounded` is the published form: the tanh of the output, in the units of the observation. It cannot represent
    changes larger than 1.
    """
    change_unit: Literal["warmup", "stored"] = "warmup"
    """Steps whose changes have a standard deviation of 1: those of the warm-up, or all that are stored.

    Random steps may leave some entries of the observation nearly constant. When the agent then changes these entries,
    their errors in units of the warm-up outweigh those of the parameters. With `stored`, the unit follows at each new
    estimate of the range of z.
    """
    codec_loss: Literal["sum", "mean"] = "sum"
    """Sum the squared errors over an action's parameters, and the KL divergence over the dimensions of z; or average.

    `mean` is the published form.
    """
    reconstruction_weight: NonNegativeFloat = 1.0
    """Weight of the decoded parameters' squared error in the codec's loss."""
    kl_weight: NonNegativeFloat = 1e-4
    """Weight of the KL divergence in the codec's loss."""
    dynamics_weight: NonNegativeFloat = 0.1
    """Weight of the predicted change of the state in the codec's loss."""
    codec_lr: LearningRate = 1e-3
    """Learning rate of the codec."""
    codec_batch_size: PositiveInt | None = None
    """Transitions in an update of the codec, from all that are stored; if null, it shares those of the critics."""
    codec_pretrain_updates: PositiveInt = 2000
    """Updates of the codec alone at the end of the warm-up."""
    codec_every: Annotated[PositiveInt, OnlyWith("codec_episodes", None)] = 10
    """Critic updates for each update of the codec, after the warm-up."""
    codec_episodes: PositiveInt | None = None
    """The learner's own episodes, after its warm-up, for each update of the codec. If null, `codec_every` decides."""
    codec_first_episode: Annotated[NonNegativeInt, OnlyWith("codec_episodes")] = 0
    """The learner's own episodes, after its warm-up, before `codec_episodes` begins to count."""
    latent_coverage: PositiveFraction = 0.96
    """Central fraction of the encoded z that the actor can reach: the latent-space constraint of the paper."""
    latent_range_every: PositiveInt = 100
    """Updates of the codec for each new estimate of the range of z, from 4,096 stored transitions."""

    @model_validator(mode="after")
    def _check_hyar(self) -> Self:
        if self.critic_window is not None and self.critic_window < self.batch_size:
            raise ValueError(f"critic_window={self.critic_window}: must be at least batch_size={self.batch_size}")
        if self.noise_initial is not None and self.noise_initial < self.parameter_noise:
            raise ValueError(
                f"noise_initial={self.noise_initial}: must be at least parameter_noise={self.parameter_noise}"
            )
        return self


CARDS = {
    "HyAR": replace(
        REPLAY_CARD,
        options=HyAROptions,
        modes=("train",),
        takes=frozenset({ActionFeature.PARAMETER_BOUNDS}),
        has_value=True,
        step_sizes=("embedding_dim", "latent_dim"),
    )
}
