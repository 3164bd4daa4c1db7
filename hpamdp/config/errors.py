"""Refuse a user's mistakes in one line: the given value, the allowed values and the class of the setting."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from hpamdp.complaints import complaints
from hpamdp.messages import ProblemError, first_line

ModelT = TypeVar("ModelT", bound=BaseModel)


class ConfigError(ValueError):
    """Raised for a user's mistake; the message is one line."""


@contextmanager
def problems_explained() -> Iterator[None]:
    """Turn an error about the problem into the user's mistake that it is.

    Raises:
        ConfigError: the block raised a `ProblemError`.
    """
    try:
        yield
    except ProblemError as error:
        raise ConfigError(f"env: {first_line(error)}") from error


class MissingChoiceError(ConfigError):
    """Raised if a choice has no yaml file in the searched folders.

    Attributes:
        known: the names that exist in the group.
    """

    def __init__(self, choice: str, known: Iterable[str]) -> None:
        super().__init__(
            f"the saved run chose {choice}, which is not there; is a --config-dir missing? Pass a class from Python "
            f"again, as {choice.partition('/')[0]}"
        )
        self.known = tuple(known)


def validated(model: type[ModelT], values: dict[str, Any], prefix: str, what: str, where: str) -> ModelT:
    """Return the values as the model.

    Args:
        model: the pydantic model.
        values: plain values by name.
        prefix: the names' prefix on the command line, such as `low.`.
        what: kind of the values, such as `setting of HPPO`.
        where: the class or the file that defines the values, for the end of a complaint.

    Raises:
        ConfigError: some values are wrong; the message lists all of them in one line.
    """
    try:
        # As JSON, in which the strict mode takes what a yaml can hold: a list for a tuple, 1 for 1.0.
        return model.model_validate_json(json.dumps(values, default=_plain))
    except ValidationError as error:
        raise ConfigError(complaints(error, model, values, what, prefix=prefix, where=where)) from error


def _plain(value: Any) -> Any:
    """Return NumPy's numbers and truth values as Python's, and what else JSON does not know as text."""
    plain = value.item() if getattr(value, "shape", None) == () else value
    return plain if isinstance(plain, bool | int | float) else str(value)
