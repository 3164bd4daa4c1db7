"""Word a user's mistakes in settings in one line: the given value, the allowed values and the class of the setting."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from hpamdp.renamed import elsewhere, renamed

_MOST_COMPLAINTS = 3
_MOST_GUESSES = 3
_ABOUT_AS_CLOSE = 0.1  # difference of two names' similarities to a third, for which both are guesses
_LONGEST_VALUE = 300  # letters of a value in a message


def as_json(value: object) -> str:
    """Return a value as JSON, for a message; a long one is cut short."""
    text = json.dumps(value, default=str)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


def no_such(
    what: str, name: str, known: Iterable[str], *, guesses: Sequence[str] = (), where: str | None = None
) -> str:
    """Return a message that a name does not exist, with the likely ones and all known names.

    Args:
        what: kind of the name, such as `setting of HPPO`.
        name: the name.
        known: the names that exist.
        guesses: what the name probably means. If empty, the known names that are closest.
        where: what has these names, such as `conf/low`; None for the owner that `what` names.
    """
    known = sorted(known)
    guesses = guesses or elsewhere(name, known) or close_names(name, known)
    guess = f"did you mean {' or '.join(guesses)}? " if guesses else ""
    owner = where or ("It" if guesses else "it")
    return f"no such {what}; {guess}{owner} has {', '.join(known) or 'none'}"


def close_names(name: str, known: Sequence[str]) -> list[str]:
    """Return the known names that are closest to a name in any case, best first; several if they are about as close."""
    name, by_lower = name.lower(), {each.lower(): each for each in known}
    close = difflib.get_close_matches(name, by_lower, n=_MOST_GUESSES)
    ratios = [difflib.SequenceMatcher(None, each, name).ratio() for each in close]
    return [by_lower[each] for each, ratio in zip(close, ratios, strict=True) if ratio >= ratios[0] - _ABOUT_AS_CLOSE]


def complaints(
    error: ValidationError,
    model: type[BaseModel],
    values: Mapping[str, Any],
    what: str,
    *,
    prefix: str = "",
    where: str = "",
    show: Callable[[Any], str] = as_json,
) -> str:
    """Return what is wrong with the values of a model, in one line.

    Args:
        error: what pydantic found.
        model: the model.
        values: the values by name.
        what: kind of the values, such as `setting of HPPO`.
        prefix: of the names, such as `low.`.
        where: what defines the values, for the end of a complaint about a value; an empty text for nothing.
        show: writes a value.
    """
    unknown: list[str] = []
    wrong: dict[str, dict[str, None]] = {}
    for problem in error.errors(include_url=False):
        path, value = _locate(problem["loc"], values, is_missing=problem["type"] == "missing")
        setting = prefix + ".".join(path)
        if problem["type"] == "extra_forbidden":
            known = _fields(model, path[:-1])
            unknown.append(f"{setting}: {renamed(setting, known) or no_such(what, path[-1], known)}")
        elif problem["type"] == "missing":
            wrong[setting] = {"missing": None}
        elif not path:  # a check of several fields, whose message names them
            wrong[prefix.replace(".", ": ") + _reworded(problem["msg"], value, show)] = {"": None}
        else:
            # A union complains once for each of its types.
            wrong.setdefault(f"{setting}={show(value)}", {})[_reworded(problem["msg"], value, show)] = None
    end = f" ({where})" if where else ""
    lines = [
        (f"{given}: {' or '.join(messages)}" if any(messages) else given) + end for given, messages in wrong.items()
    ]
    return "; ".join([*_shortened(unknown), *lines])


def _reworded(message: str, value: Any, show: Callable[[Any], str]) -> str:
    """Return pydantic's message in the words of a user, who knows lists and mappings."""
    message = message.removeprefix("Value error, ").replace("valid array", "list").replace("valid tuple", "list")
    message = message.replace("an object", "a mapping").replace(" or None", f" or {show(None)}")
    length = len(value) if isinstance(value, list | tuple) else None
    message = message.removesuffix(f" after validation, not {length}")
    return re.sub("^(Input|String|List|Tuple|Value) should", "must", message)


def _shortened(complaints: list[str]) -> list[str]:
    """Return the first complaints, and the number of the others; all settings may be wrong if the class is."""
    num_more = len(complaints) - _MOST_COMPLAINTS
    return complaints if num_more <= 0 else [*complaints[:_MOST_COMPLAINTS], f"and {num_more} more like this"]


def _locate(location: tuple[int | str, ...], values: Mapping[str, Any], *, is_missing: bool) -> tuple[list[str], Any]:
    """Return the path of names to a wrong value, and the value. `is_missing`: whether a mapping lacks the last name."""
    path: list[str] = []
    value: Any = values
    for part in location:
        # The other parts name the type of a union that was tried.
        if isinstance(value, Mapping) and (part in value or is_missing):
            path.append(str(part))
            value = value.get(part)
        elif isinstance(value, list | tuple) and isinstance(part, int):
            path.append(str(part))
            value = value[part] if part < len(value) else None  # the list may be too short
    return path, value


def _fields(model: type[BaseModel], path: list[str]) -> Iterable[str]:
    for name in path:
        inner = model.model_fields[name].annotation
        assert isinstance(inner, type)
        model = inner
    return model.model_fields
