"""What is known of a problem before it is built, from its settings alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from hpamdp.settings import Settings

# Settings of `GymnasiumEnv` that name the environment, and all that say which environment it is.
NAMING_SETTINGS = ("id", "entry_point")
SOURCE_SETTINGS = (*NAMING_SETTINGS, "kwargs")


@dataclass(frozen=True)
class ProblemFacts:
    """What a run must know of a problem to check settings of other groups against it.

    Attributes:
        title: what errors call the problem.
        option_names: the problem's own options.
        has_choice: whether the agent chooses among these options.
        can_change_option: whether an option may end before its episode.
        plans_change_options: whether the planned actions under `oracle` assume such changes.
        is_shardable: whether several processes can each step some of the environments.
        has_statistics: whether the scale of observations or rewards is learned.
        default_options: options to begin with, as for `PAMDPEnv.group_actions`; empty if the problem suggests none.
        has_oracle: whether the problem knows its best actions, for `oracle`; the constructor may still refuse some
            settings.
        has_human: whether the problem knows what people choose, which the selector `human` needs.
        has_pictures: whether an entry of the observation is a picture, unless pictures are flattened.
    """

    title: str
    option_names: tuple[str, ...] = ()
    has_choice: bool = False
    can_change_option: bool = True
    plans_change_options: bool = False
    is_shardable: bool = True
    has_statistics: bool = False
    default_options: Mapping[str, Sequence[int | str]] = field(default_factory=dict)
    has_oracle: bool = False
    has_human: bool = False
    has_pictures: bool = False


class ProblemOptions(Settings):
    """Base of the settings of problems whose facts follow from their settings."""

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem, which errors call `title`."""
        return ProblemFacts(title=title)
