"""The settings and the cards of people's recorded actions."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, PositiveInt

from hpamdp.cards import DataCard
from hpamdp.settings import Indices, Settings

SHA256 = "9de16874b43de9e377c2c10749cb2bd435a6db3ca7cead445b826d64ec399d20"


class PeoplesOptions(Settings):
    """Settings that select people's episodes and the form of their presses."""

    successes: bool = False
    """Take only episodes that ended in the dock."""
    people: Annotated[Indices, Field(min_length=1)] | None = None
    """Take only episodes of the people with these numbers, such as [0, 7]. If null, of all people."""
    best_people: PositiveInt | None = None
    """Of these, take only this many people with the highest mean scores. If null, all of them."""
    worst_people: PositiveInt | None = None
    """Of these, take only this many people with the lowest mean scores. If null, all of them."""
    held_out: Indices = ()
    """Numbers of people from whom nothing learns. `metrics.csv` shows the learners' losses on their presses."""
    presses: PositiveInt | None = None
    """Take only each person's first episodes, with at most this many logged presses together. If null, all."""
    rest_to_rest: Literal["clean"] | bool = True
    """Convert interrupted presses to rest-to-rest presses, the only presses that the environment has.

    `clean` takes only presses after which the boat was within 3 px of where such a press leads. Other presses of the
    log were followed by presses that are not in the log.
    """


class HumanOptions(PeoplesOptions):
    """Settings of `HumanDemonstrations`."""

    path: str | None = None
    """The released file. If null, the path in $HPAMDP_HUMAN_DATA, or else the downloaded file."""
    checksum: str | None = SHA256
    """The SHA-256 that the file must have, by default the released file's. If null, any file is accepted."""
    complete: bool = False
    """Take only episodes with a complete log of presses."""


class PlayedOptions(PeoplesOptions):
    """Settings of `PlayedDemonstrations`."""

    path: str = "played.jsonl"
    """The file of episodes. Lines without a valid episode are left out, with a warning."""
    practice: bool = False
    """Also take practice episodes."""


CARDS = {
    "HumanDemonstrations": DataCard(options=HumanOptions),
    "PlayedDemonstrations": DataCard(options=PlayedOptions),
}
