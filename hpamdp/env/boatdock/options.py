"""The settings and the card of the boats."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator
from typing_extensions import Self

from hpamdp.cards import ProblemCard
from hpamdp.env.boatdock.task import (
    CONTROLLER_DEGREES,
    CONTROLLERS,
    NUM_KEYS,
    TANK,
    Boats,
    ObservationForm,
    RewardForm,
)
from hpamdp.env.facts import ProblemFacts, ProblemOptions
from hpamdp.settings import Fraction, FromList

Degrees = Annotated[tuple[float, ...], FromList]
_MOST_MOTOR_NOISE = 10.0
_RESERVED = ("choose", "random")  # other values of `controller`


class BoatDockOptions(ProblemOptions):
    """Settings of `BoatDockEnv`."""

    controller: str = "choose"
    """Which controller: `choose` lets the agent choose, `random` draws one for each episode, or a controller's name.

    All but `choose` need high=none.
    """
    keymap: Literal[1, 2, "random"] = 1
    """Key map of the incongruent controller, which says where its keys push it; `random` draws one for each episode."""
    reward: RewardForm = "paper"
    """`paper`: progress at each press, 5 x the fuel left on success, -1 on failure. `sparse`: only the success term."""
    observation: ObservationForm = "scaled"
    """`scaled` to about [-1, 1] with goal - boat appended, `[N, 16]`, or `pixels` as in the paper, `[N, 14]`."""
    motor_noise: float | Annotated[tuple[float, ...], FromList] = 0.0
    """Standard deviation of the log of the executed duration; [a, b]: a for the first controller, b for the second."""
    sensor_noise: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    """Standard deviation of the observed positions, in pixels."""
    slip: Fraction = 0.0
    """Probability that a uniformly random key is pressed instead."""
    boats: Annotated[tuple[str, ...], Field(min_length=1), FromList] | None = None
    """Controllers to choose from, named as in `controllers`. If null, incongruent (with `keymap`) and congruent."""
    controllers: dict[str, Degrees] = CONTROLLER_DEGREES
    """For each controller the directions in which its three keys push, in degrees: 0 to the right, 90 down.

    Add one with +env.controllers.NAME=[0,120,240], and name it in `boats`.
    """
    switch_cost: Annotated[float, Field(ge=0.0, le=TANK)] | None = None
    """Seconds of fuel for changing the controller at a press. If null, the controller is kept for the episode.

    It goes with agent.termination=steps, learned or chosen.
    """
    recording: str | None = None
    """A file of `hpamdp play`, whose figures replace people's in tables and curves. If null, people's."""

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the controllers to choose from, in the order of their numbers."""
        return CONTROLLERS if self.boats is None else self.boats

    @property
    def are_peoples(self) -> bool:
        """Whether the task is that of the recording: its two controllers, of which one is kept for the episode."""
        return self.boats is None and self.switch_cost is None

    @property
    def own_boats(self) -> Boats | None:
        """The controllers with their directions; None: people's."""
        if self.boats is None:
            return None
        known = CONTROLLER_DEGREES | self.controllers
        return Boats(self.boats, tuple(known[name] for name in self.boats))

    @property
    def noises(self) -> tuple[float, ...]:
        """The `motor_noise` of each controller."""
        return self.motor_noise if isinstance(self.motor_noise, tuple) else (self.motor_noise,) * len(self.names)

    def facts(self, title: str) -> ProblemFacts:
        """Return what these settings tell of the problem, which errors call `title`."""
        can_change = self.switch_cost is not None
        return ProblemFacts(
            title=title,
            option_names=self.names,
            has_choice=self.controller == "choose",
            can_change_option=can_change,
            plans_change_options=can_change,
            has_oracle=True,
            has_human=True,
        )

    def unlike_peoples(self) -> str:
        """Return the setting with which the task differs from that of the recording."""
        return f"boats={list(self.names)}" if self.boats is not None else f"switch_cost={self.switch_cost}"

    @model_validator(mode="after")
    def _check_controllers(self) -> Self:
        for name, degrees in self.controllers.items():
            given = f"controllers.{name}={list(degrees)}"
            if name in _RESERVED:
                raise ValueError(f"{given}: {name} cannot name a controller; take another name")
            if len(degrees) != NUM_KEYS or not all(math.isfinite(each) for each in degrees):
                raise ValueError(f"{given}: must be {NUM_KEYS} directions in degrees, one for each key")
            if degrees != CONTROLLER_DEGREES.get(name, degrees):
                raise ValueError(f"{given}: {name} is {list(CONTROLLER_DEGREES[name])}; take another name")
        return self

    @model_validator(mode="after")
    def _check_boats(self) -> Self:
        names = list(self.names)
        known = CONTROLLER_DEGREES | self.controllers
        if self.boats is not None:
            unknown = [name for name in names if name not in known]
            if unknown:
                raise ValueError(f"boats={names}: no controller {unknown[0]}; controllers has {', '.join(known)}")
            if len({*names}) < len(names):
                raise ValueError(f"boats={names}: must be different controllers")
            if self.keymap != 1:
                raise ValueError(f"keymap={self.keymap}: the controllers in boats={names} have none; leave it out")
        choices = ("choose", *(names[::-1] if self.boats is None else names), "random")
        if self.controller not in choices:
            raise ValueError(f"controller={self.controller}: must be one of {', '.join(choices)}")
        if self.controller == "choose" and len(names) < 2:
            raise ValueError(f"boats={names}: nothing to choose; name more, or use controller={names[0]}")
        if self.switch_cost is not None and self.controller != "choose":
            raise ValueError(
                f"switch_cost={self.switch_cost}: controller={self.controller} never changes; "
                "use controller=choose or leave switch_cost out"
            )
        if self.recording is not None and not self.are_peoples:
            raise ValueError(
                f"{self.unlike_peoples()}: people kept one of their two controllers, "
                f"so recording={self.recording} does not fit; leave it out"
            )
        return self

    @model_validator(mode="after")
    def _check_noise(self) -> Self:
        given, num = self.motor_noise, len(self.names)
        noises = given if isinstance(given, tuple) else (given,)
        if isinstance(given, tuple) and len(given) != num:
            allowed = "one number or two" if num == 2 else f"one number or {num}, one for each controller"
            raise ValueError(f"motor_noise={list(given)}: must be {allowed}")
        for noise in noises:
            if not 0.0 <= noise <= _MOST_MOTOR_NOISE:
                raise ValueError(f"motor_noise={noise}: must lie between 0 and {_MOST_MOTOR_NOISE:g}")
        return self


CARDS = {
    "BoatDockEnv": ProblemCard(
        options=BoatDockOptions,
        guarded_settings=("recording",),
        choice_setting="env.controller=choose",
        change_setting="env.switch_cost=0.2",
        no_choice_setting="env.controller=congruent (or incongruent, random)",
    )
}
