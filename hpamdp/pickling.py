"""Tell whether objects and classes of Python code can be sent to worker processes."""

from __future__ import annotations

import pickle
from typing import Any

from hpamdp.messages import first_line


def why_unsendable(value: Any) -> str | None:
    """Return why a value cannot be sent to another process, as text; None if it can.

    Classes and functions that another process cannot import, such as those of a notebook, are sent by value. So what
    they refer to is sent, too.
    """
    from gymnasium.vector.utils import CloudpickleWrapper  # as TorchRL and Gymnasium send values; takes long to import

    try:
        pickle.dumps(CloudpickleWrapper(value))
    except Exception as error:
        return f"{type(error).__name__}: {first_line(error)}"
    return None
