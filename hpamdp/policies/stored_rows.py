"""Check the stored rows of a checkpoint.

Numbers must be finite. Choices must exist, because they index tables and the outputs of networks.
"""

from __future__ import annotations

from collections.abc import Mapping

from tensordict import TensorDictBase
from torch import Tensor

from hpamdp.specs import PAMDPSpecs


def check_choices(rows: Mapping[str, Tensor], specs: PAMDPSpecs) -> None:
    """Refuse rows whose `discrete`, `option` or `next_option` does not exist; missing columns are skipped.

    Raises:
        ValueError: the message has the column and its numbers.
    """
    limits = {"option": specs.num_options, "next_option": specs.num_options}
    if specs.components.is_single:
        limits["discrete"] = specs.num_discrete
    elif (discrete := rows.get("discrete")) is not None and not specs.components.exists(discrete).all():
        most = ", ".join(str(size - 1) for size in specs.components.sizes)
        raise ValueError(
            f"discrete holds {discrete.amin(0).tolist()} to {discrete.amax(0).tolist()}, but must be 0 to {most}"
        )
    for name, limit in limits.items():
        column = rows.get(name)
        if column is not None and column.numel() and not 0 <= int(column.min()) <= int(column.max()) < limit:
            raise ValueError(f"{name} holds {int(column.min())} to {int(column.max())}, but must be 0 to {limit - 1}")


def check_stored_rows(rows: TensorDictBase, specs: PAMDPSpecs, may_be_nan: frozenset[str] = frozenset()) -> None:
    """Refuse stored rows with numbers that are not finite or with choices that do not exist.

    Raises:
        ValueError: the message names the column.
    """
    for name, column in rows.items():
        is_wrong = column.isinf() if name in may_be_nan else ~column.isfinite()
        if is_wrong.any():
            raise ValueError(f"{name} is not finite")
    check_choices(rows, specs)
