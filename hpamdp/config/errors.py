"""Word a user's mistakes in one line: the given value, the allowed values and the place of the setting."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeAlias, TypeVar

from pydantic import BaseModel, ValidationError

from hpamdp.config.renamed import elsewhere, renamed

_MOST_COMPLAINTS = 3
_MOST_GUESSES = 3
_ABOUT_AS_CLOSE = 0.1  # difference of two names' similarities to a third, for which both are guesses
_LONGEST_VALUE = 300  # letters of a value in a message
# Larger numbers leave the range that a computation can hold; infinity is refused as well.
_LARGEST_FLOAT, _LARGEST_INT = 1e12, 2**63 - 1

# The class or the file that defines a value, and where the value was set if that is known.
Where: TypeAlias = Callable[[str | None], str]

ModelT = TypeVar("ModelT", bound=BaseModel)


class ConfigError(ValueError):
    """Raised for a user's mistake; the message is one line."""


class MissingChoiceError(ConfigError):
    """Raised if a choice has no yaml file in the searched folders.

    Attributes:
        known: the names that exist in the group.
    """

    def __init__(self, choice: str, known: Iterable[str]) -> None:
        super().__init__(f"the saved run chose {choice}, which is not there; is a --config-dir missing?")
        self.known = tuple(known)


def as_json(value: object) -> str:
    """Return a value as JSON, for a message; a long one is cut short."""
    text = json.dumps(value, default=str)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


def no_such(what: str, name: str, known: Iterable[str]) -> str:
    """Return a message that a name does not exist, with the likely ones and all known names."""
    known = sorted(known)
    guesses = elsewhere(name, known) or _close(name, known)
    guess = f"did you mean {' or '.join(guesses)}? It" if guesses else "it"
    return f"no such {what}; {guess} has {', '.join(known) or 'none'}"


def _close(name: str, known: list[str]) -> list[str]:
    """Return the known names that are closest to a name, best first; several if they are about as close."""
    close = difflib.get_close_matches(name, known, n=_MOST_GUESSES)
    similarity = [difflib.SequenceMatcher(None, each, name).ratio() for each in close]
    return [each for each, ratio in zip(close, similarity, strict=True) if ratio >= similarity[0] - _ABOUT_AS_CLOSE]


def validated(model: type[ModelT], values: dict[str, Any], prefix: str, what: str, where: Where | str) -> ModelT:
    """Return the values as the model.

    Args:
        model: the pydantic model.
        values: plain values by name.
        prefix: the names' prefix on the command line, such as `low.`.
        what: kind of the values, such as `setting of HPPO`.
        where: for the end of a complaint. A function gets the value's name on the command line, or None for a check of
            several values.

    Raises:
        ConfigError: some values are wrong; the message lists all of them in one line.
    """

    def place(setting: str | None) -> str:
        return where if isinstance(where, str) else where(setting)

    try:
        # As JSON, in which the strict mode takes what a yaml can hold: a list where a tuple is wanted, 1 for 1.0.
        checked = model.model_validate_json(json.dumps(values, default=str))
    except ValidationError as error:
        raise ConfigError(_in_one_line(error, model, values, prefix, what, place)) from error
    _refuse_huge(model, values, prefix, place)
    return checked


def _in_one_line(
    error: ValidationError,
    model: type[BaseModel],
    values: dict[str, Any],
    prefix: str,
    what: str,
    where: Where,
) -> str:
    unknown: list[str] = []
    wrong: dict[str, dict[str, None]] = {}
    place: dict[str, str] = {}
    for problem in error.errors(include_url=False):
        path, value = _locate(problem["loc"], values)
        setting = prefix + ".".join(path)
        if problem["type"] == "extra_forbidden":
            known = _fields(model, path[:-1])
            unknown.append(f"{setting}: {renamed(setting, known) or no_such(what, path[-1], known)}")
        elif problem["type"] == "missing":
            wrong[setting] = {"missing": None}
            place[setting] = where(setting)
        elif not path:  # a check of several fields, whose message names them
            complaint = prefix.replace(".", ": ") + _reworded(problem["msg"], value)
            wrong[complaint] = {"": None}
            place[complaint] = where(None)
        else:
            # A union complains once for each of its types.
            given = f"{setting}={as_json(value)}"
            wrong.setdefault(given, {})[_reworded(problem["msg"], value)] = None
            place[given] = where(setting)
    complaints = [
        f"{given}: {' or '.join(messages)} ({place[given]})" if any(messages) else f"{given} ({place[given]})"
        for given, messages in wrong.items()
    ]
    return "; ".join([*_shortened(unknown), *complaints])


def _reworded(message: str, value: Any) -> str:
    """Return pydantic's message in the words of a yaml file."""
    message = message.removeprefix("Value error, ").replace("valid array", "list").replace("valid tuple", "list")
    message = message.replace("an object", "a mapping").replace(" or None", " or null")
    length = len(value) if isinstance(value, list) else None
    message = message.removesuffix(f" after validation, not {length}")
    return re.sub("^(Input|String|List|Tuple|Value) should", "must", message)


def _shortened(complaints: list[str]) -> list[str]:
    """Return the first complaints, and the number of the others; all settings may be wrong if the class is."""
    num_more = len(complaints) - _MOST_COMPLAINTS
    return complaints if num_more <= 0 else [*complaints[:_MOST_COMPLAINTS], f"and {num_more} more like this"]


def _refuse_huge(model: type[BaseModel], values: Mapping[str, Any], prefix: str, where: Where) -> None:
    """Refuse numbers that are too large to compute with, in a model's fields and in lists there."""
    for name in model.model_fields:
        value = values.get(name)
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            largest = _LARGEST_INT if isinstance(number, int) else _LARGEST_FLOAT
            if abs(number) > largest:
                setting = f"{prefix}{name}"
                raise ConfigError(
                    f"{setting}={as_json(value)}: must lie between -{largest} and {largest} ({where(setting)})"
                )


def _locate(location: tuple[int | str, ...], values: dict[str, Any]) -> tuple[list[str], Any]:
    """Return the path of names to a wrong value, and the value."""
    path: list[str] = []
    value: Any = values
    for part in location:
        # The other parts name the type of a union that was tried.
        if isinstance(value, dict):
            path.append(str(part))
            value = value.get(part)
        elif isinstance(value, list) and isinstance(part, int):
            path.append(str(part))
            value = value[part]
    return path, value


def _fields(model: type[BaseModel], path: list[str]) -> Iterable[str]:
    for name in path:
        inner = model.model_fields[name].annotation
        assert isinstance(inner, type)
        model = inner
    return model.model_fields
