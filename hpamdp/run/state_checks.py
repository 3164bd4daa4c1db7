"""Compare names, types and shapes in a checkpoint with a run before the run changes.

The values need no comparison: the file's checksums say that they are as a run wrote them.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from hpamdp.policies.shared.sized_by_data import SizedByData

_SCHEDULED = ("lr", "weight_decay")  # settings of an optimizer that training changes


def check_form(where: str, saved: object, own: Tensor, *, any_size: bool = False) -> None:
    """Refuse a value unless it is a tensor with the dtype and shape of `own`; float16 may stand for float32.

    Args:
        where: name of the value in the error.
        saved: the value.
        own: the tensor of the run.
        any_size: whether only the number of dimensions must be the same.

    Raises:
        ValueError: the value is refused.
    """
    if not isinstance(saved, Tensor):
        raise ValueError(f"{where} is {type(saved).__name__}, but must be a tensor")
    fits = saved.ndim == own.ndim and (any_size or saved.shape == own.shape)
    if not fits or (saved.dtype != own.dtype and (saved.dtype, own.dtype) != (torch.float16, torch.float32)):
        raise ValueError(f"{where} is {_form(saved)}, but must be {_form(own)}")


def _form(tensor: Tensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"


def check_like(where: str, saved: Any, own: Any) -> None:
    """Refuse nested values whose names, types, dtypes or shapes differ from `own`.

    Args:
        where: name of the values in the error.
        saved: the values.
        own: the values of the run.

    Raises:
        ValueError: the values differ; the message names the first difference.
    """
    if isinstance(own, Tensor):
        check_form(where, saved, own)
    elif isinstance(own, Mapping):
        for name, value in check_names(saved, own, where).items():
            check_like(f"{where}.{name}", value, own[name])
    elif type(saved) is not type(own):
        raise ValueError(f"{where} is {type(saved).__name__}, but must be {type(own).__name__}")


def check_names(saved: object, own: Mapping[str, Any], where: str = "a state dict") -> Mapping[str, Any]:
    """Return nested values if their names are the names of `own`.

    Raises:
        ValueError: the names differ, or `saved` is no mapping.
    """
    if not isinstance(saved, Mapping):
        raise ValueError(f"{where} is {type(saved).__name__}, but must be a mapping")
    for word, names in (("without", own.keys() - saved.keys()), ("with", saved.keys() - own.keys())):
        if names:
            raise ValueError(f"{where} {word} {', '.join(sorted(map(str, names))[:3])}")
    return saved


def buffers_sized_by_data(module: nn.Module) -> set[int]:
    """Return the ids of a module's buffers whose sizes depend on data."""
    sized = [part for part in module.modules() if isinstance(part, SizedByData)]
    return {id(buffer) for part in sized for buffer in part.buffers(recurse=False)}


def _state_after_a_step(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return the state of a copy of an optimizer after a step. Only dtypes and shapes of its tensors matter."""
    another = copy.deepcopy(optimizer)
    for group in another.param_groups:
        for parameter in group["params"]:
            parameter.grad = torch.zeros_like(parameter)
    another.step()
    return another.state_dict()


def checked_optimizer(where: str, saved: Mapping[str, Any], optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return a saved state that an optimizer can load. Torch's fused optimizers compare no shapes themselves.

    Args:
        where: name of the state in the error.
        saved: the saved state.
        optimizer: the optimizer.

    Raises:
        ValueError: the state is of another optimizer.
    """
    own = _state_after_a_step(optimizer)
    for group, theirs in zip(own["param_groups"], saved["param_groups"], strict=True):
        group |= {name: theirs[name] for name in _SCHEDULED}
    for number, moments in saved["state"].items():
        check_like(f"{where}.{number}", moments, own["state"].get(number, {}))
    return {**own, "state": saved["state"]}
