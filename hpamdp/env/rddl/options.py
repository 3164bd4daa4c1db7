"""The settings and the card of RDDL problems."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Field, PositiveInt

from hpamdp.cards import ProblemCard
from hpamdp.env.facts import ProblemFacts
from hpamdp.env.gymnasium.options import SimulatorOptions
from hpamdp.settings import OnlyWith, PositiveFraction, Settings

Pair = Field(min_length=2, max_length=2)


class RDDLRules(Settings):
    """Settings of `RDDLProblem`."""

    domain: Annotated[str, OnlyWith("files", None)] = "Reservoir_ippc2023"
    """A domain of rddlrepository."""
    instance: Annotated[int | str | None, OnlyWith("files", None)] = None
    """An instance of the domain. If null, its first one."""
    files: Annotated[list[str], Pair] | None = None
    """Instead of `domain` and `instance`, two files of your own, as in [domain.rddl,instance.rddl]."""
    bounds: dict[str, Annotated[list[float], Pair]] | None = None
    """Lowest and highest values of action fluents that the domain leaves unbounded, as in {ship:[0,100]}.

    A name stands for all fluents of this name, or for one of them, as in {ship___w1:[0,50]}. Where the domain has
    bounds, too, the narrower ones count.
    """
    max_actions: PositiveInt | None = None
    """How many action fluents may differ from their default values. If null, as the instance says."""


class RDDLOptions(SimulatorOptions, RDDLRules):
    """Settings of `RDDLEnv`."""

    max_steps: PositiveInt | None = None
    """Steps after which an episode is truncated. If null, the horizon of the instance, which is also the most."""
    observation_scaling: Literal["running", "none"] = "running"
    """`running`: to mean 0 and standard deviation 1; `none`: not."""
    reward_scaling: PositiveFraction | None = 0.99
    staggered: bool = False
    """Truncate the first episode of each copy in training after another number of steps.

    Otherwise copies whose episodes all have the same length stay at the same step.
    """

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem, which errors call `title`."""
        facts = super().facts(title)
        return replace(facts, has_statistics=facts.has_statistics or self.observation_scaling == "running")


CARDS = {"RDDLEnv": ProblemCard(options=RDDLOptions, guarded_settings=("files",))}
