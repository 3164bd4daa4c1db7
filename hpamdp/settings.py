"""Base class of every class's `Options`, which define each setting's type, bounds, default and meaning.

A class lists its settings once. Those of this package stand in modules without torch, see `hpamdp.cards`::

    class UCBOptions(Settings):
        exploration: NonNegativeFloat = 2.0
        \"\"\"Width of the confidence bounds, in standard deviations of the rewards.\"\"\"

    class UCB(Selector):
        Options = UCBOptions

        def __init__(self, specs: PAMDPSpecs, options: UCBOptions | None = None, **settings: Any) -> None:
            super().__init__(specs)
            self.options = UCBOptions.of(options, settings)

Then `UCB(specs)`, `UCB(specs, exploration=1.0)` and `UCB(specs, options=UCB.Options(exploration=1.0))` all work. The
yaml file names the class and holds the values that differ from these defaults. The command line, its error messages,
`--help` and the pages read the same model.
"""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Mapping
from contextlib import suppress
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveInt,
    ValidationError,
)
from typing_extensions import Self

from hpamdp.complaints import complaints
from hpamdp.messages import as_code

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
PositiveFraction = Annotated[float, Field(gt=0.0, le=1.0)]
# Environments, steps or episodes that are in memory at once.
NumAtOnce = Annotated[PositiveInt, Field(le=10_000_000)]
Expectile = Annotated[float, Field(ge=0.5, lt=1.0)]  # 0.5 is the mean
ScheduleShape = Literal["linear", "cosine", "constant"]


LearningRate = PositiveFraction


def _as_tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


# For a tuple that Python code may give as a list, but not as anything without an order.
FromList = BeforeValidator(_as_tuple)
# Tuples, so that the model cannot change.
Widths = Annotated[tuple[PositiveInt, ...], FromList]
Indices = Annotated[tuple[NonNegativeInt, ...], FromList]


class OwnSteps:
    """Says, as a part of a setting's type, that the setting counts the agent's own steps or decisions.

    Settings of a schedule over these have it, too. A setting of the type `Annotated[NonNegativeInt, OwnSteps()]` has no
    effect on what is learned with `mode=offline`. A run warns if such a setting is given.
    """


class Schedule:
    """Says, as a part of a setting's type, that the setting is the length of a schedule, in steps or decisions."""


class OnlyWith:
    """Says, as a part of a setting's type, with which values of another setting it counts.

    `Annotated[PositiveInt, OnlyWith("memory", "gru")]` is a setting that counts with `memory=gru` alone. Without
    values, it counts if the other setting is neither null, 0 nor false.

    Args:
        name: of the other setting.
        values: those with which this one counts.
    """

    def __init__(self, name: str, *values: Any) -> None:
        self.name = name
        self.values = values

    def holds(self, settings: Mapping[str, Any]) -> bool:
        """Return whether the setting counts beside the other settings of its class."""
        value = settings[self.name]
        return value in self.values if self.values else bool(value)

    def __str__(self) -> str:
        """Return when the setting counts."""
        if not self.values:
            return f"if {self.name} is set"
        return f"with {self.name}={' or '.join('null' if value is None else str(value) for value in self.values)}"


class SettingError(ValueError):
    """Raised by a constructor to refuse a setting. Users see the message in one line, without a traceback."""


class Settings(BaseModel):
    """Settings of a class. They are frozen and flat, and refuse unknown names, infinite numbers and other types."""

    model_config = ConfigDict(
        strict=True,
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        protected_namespaces=(),
        defer_build=True,
    )

    @classmethod
    def of(cls, options: Self | None, settings: Mapping[str, Any]) -> Self:
        """Return a constructor's options: the given options or the defaults, changed by single settings.

        Args:
            options: the constructor's argument `options`.
            settings: its other keyword arguments, by the names of settings.

        Raises:
            SettingError: a setting does not exist, or has a wrong value.
            TypeError: the options are of another class.
        """
        if options is not None and not isinstance(options, cls):
            raise TypeError(f"options: must be {cls.__name__}, not {type(options).__name__}")
        if options is not None and not settings:
            return options
        values = {**({} if options is None else dict(options)), **settings}
        try:
            return cls(**values)
        except ValidationError as error:
            raise SettingError(complaints(error, cls, values, f"setting of {cls.__name__}", show=as_code)) from error


def meanings_of(model: type[BaseModel]) -> dict[str, str]:
    """Return the docstring below each setting, or else its description, by the names of settings.

    Only help and pages need them. With pydantic's `use_attribute_docstrings` every start would parse the sources.
    """
    found: dict[str, str] = {}
    for each in reversed(model.__mro__):
        if not issubclass(each, Settings):
            continue
        found |= {name: field.description for name, field in each.model_fields.items() if field.description}
        with suppress(OSError, TypeError, SyntaxError):  # no file has its source, or not as it stands
            tree: Any = ast.parse(textwrap.dedent(inspect.getsource(each)))
            for statement, below in pairwise(tree.body[0].body):
                match statement, below:
                    case ast.AnnAssign(target=setting), ast.Expr(value=ast.Constant(value=str(meaning))):
                        found[ast.unparse(setting)] = meaning
    return found
