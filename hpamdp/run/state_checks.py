"""Compare the contents of a checkpoint with a run before the run changes."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

import torch
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import ReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from hpamdp import keys
from hpamdp.acting import acting
from hpamdp.messages import first_line
from hpamdp.policies.shared.sized_by_data import SizedByData
from hpamdp.run.tensor_archive import SavedTensor

# A float holds all whole numbers up to this one exactly.
_LARGEST_COUNT = 2**53
Count = Annotated[int, Field(ge=0, le=_LARGEST_COUNT)]
Amount = Annotated[FiniteFloat, Field(ge=0.0)]
# Settings that training changes in an optimizer, and settings that choose between equivalent implementations.
_SCHEDULED, _IMPLEMENTATION = ("lr", "weight_decay"), ("foreach", "fused", "capturable", "differentiable")
# Settings that earlier versions of torch lack.
_MAY_LACK = (*_IMPLEMENTATION, "decoupled_weight_decay")
_MOST_SCHEDULED = 1e6
Model = TypeVar("Model", bound=BaseModel)


class SavedPart(BaseModel):
    """Contents of a file by their names. Values of other types are refused."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, arbitrary_types_allowed=True)


class Progress(SavedPart):
    """Progress of a run. Entries of later versions are ignored."""

    model_config = ConfigDict(strict=True, extra="ignore", frozen=True)

    config: dict[str, Any]
    option_names: list[str]
    config_dirs: list[str] | None = None
    frames: Count
    wall_s: Amount
    cpu_s: Amount
    last_score: FiniteFloat | None
    evaluation_due: bool = False


class _OptimizerState(SavedPart):
    state: dict[int, dict[str, Tensor | SavedTensor]]
    param_groups: list[dict[str, Any]]


class _Writer(SavedPart):
    cursor: Count = Field(alias="_cursor")
    write_count: Count = Field(alias="_write_count")


class _ReplayState(SavedPart):
    rows: dict[str, Any]
    num_rows: Count
    writer: _Writer


def checked(model: type[Model], values: Any) -> Model:
    """Return values as a model.

    Raises:
        ValueError: a value is wrong; the message names the first one in one line.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ValueError(_first_wrong(error)) from error


def checked_as(kind: Any, values: Any) -> Any:
    """Check values as `checked` does, for a type that is no model."""
    try:
        return TypeAdapter(kind, config=ConfigDict(strict=True, arbitrary_types_allowed=True)).validate_python(values)
    except ValidationError as error:
        raise ValueError(_first_wrong(error)) from error


def _first_wrong(error: ValidationError) -> str:
    wrong = error.errors()[0]
    return f"{'.'.join(map(str, wrong['loc']))}: {wrong['msg']}"


def check_form(where: str, saved: object, own: Tensor, *, any_size: bool = False, any_rows: bool = False) -> None:
    """Refuse a value unless it is a tensor with the dtype and shape of `own`; float16 may stand for float32.

    Args:
        where: name of the value in the error.
        saved: the value, read or not.
        own: the tensor of the run.
        any_size: whether only the number of dimensions must be the same.
        any_rows: whether the first dimension may differ.

    Raises:
        ValueError: the value is refused.
    """
    if not isinstance(saved, Tensor | SavedTensor):
        raise ValueError(f"{where} is {type(saved).__name__}, but must be a tensor")
    fits = len(saved.shape) == own.ndim if any_size else tuple(saved.shape) == tuple(own.shape)
    if any_rows:
        fits = len(saved.shape) == own.ndim and tuple(saved.shape[1:]) == tuple(own.shape[1:])
    if not fits or (saved.dtype != own.dtype and (saved.dtype, own.dtype) != (torch.float16, torch.float32)):
        raise ValueError(f"{where} is {_form(saved)}, but must be {_form(own)}")


def _form(tensor: Tensor | SavedTensor) -> str:
    return f"{str(tensor.dtype).removeprefix('torch.')} {list(tensor.shape)}"


def check_values(where: str, value: Tensor, own: Tensor) -> None:
    """Refuse NaN and inf, unless `own` has them, integers below both -1 and all of `own`, and integers above 2^53.

    Raises:
        ValueError: a number is invalid.
    """
    if value.is_floating_point():
        if value.isnan().any() and not own.isnan().any():
            raise ValueError(f"{where} holds NaN")
        if value.isinf().any() and not own.isinf().any():
            raise ValueError(f"{where} holds inf")
    elif value.dtype != torch.bool and value.numel():
        least = min(-1, int(own.min())) if own.numel() else -1
        if not least <= int(value.min()) <= int(value.max()) <= _LARGEST_COUNT:
            found = f"{int(value.min())} to {int(value.max())}"
            raise ValueError(f"{where} holds {found}, but must be from {least} to {_LARGEST_COUNT}")


def check_columns(where: str, saved: Any, own: Mapping[str, Any], *, any_rows: bool = False) -> None:
    """Refuse nested columns whose names, dtypes or shapes differ from `own`.

    Raises:
        ValueError: the columns differ; the message names the first difference.
    """
    if not isinstance(saved, Mapping):
        raise ValueError(f"{where} is {type(saved).__name__}, but must be a mapping")
    if saved.keys() != own.keys():
        names = sorted(map(str, saved.keys() ^ own.keys()))
        raise ValueError(f"{where} has other entries: {', '.join(names)}")
    for name, value in own.items():
        if isinstance(value, Mapping):
            check_columns(f"{where}.{name}", saved[name], value, any_rows=any_rows)
        else:
            check_form(f"{where}.{name}", saved[name], value, any_rows=any_rows)


def check_like(where: str, saved: Any, own: Any) -> None:
    """Refuse nested values whose names, types or shapes differ from `own`.

    Raises:
        ValueError: the values differ; the message names the first difference.
    """
    if isinstance(own, Tensor):
        check_form(where, saved, own)
    elif isinstance(own, Mapping):
        for name, value in check_names(saved, own).items():
            check_like(f"{where}.{name}", value, own[name])
    elif type(saved) is not type(own):
        raise ValueError(f"{where} is {type(saved).__name__}, but must be {type(own).__name__}")


def check_numbers(where: str, saved: Any, own: Any) -> None:
    """Refuse nested tensors and numbers whose names or types differ from `own`, and NaN. Sizes of tensors may differ.

    Raises:
        ValueError: the values are refused; the message names the first one.
    """
    if isinstance(own, Mapping):
        for name, value in check_names(saved, own).items():
            check_numbers(f"{where}.{name}", value, own[name])
    elif isinstance(own, Tensor):
        check_form(where, saved, own, any_size=True)
        check_values(where, saved, own)
    elif not isinstance(saved, int | float) or math.isnan(saved):
        raise ValueError(f"{where} is {saved!r:.40}, but must be a number")


def check_names(saved: object, own: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a state dict if its names are the names of `own`.

    Raises:
        ValueError: the names differ, or `saved` is no state dict.
    """
    if not isinstance(saved, Mapping):
        raise ValueError(f"a state dict is {type(saved).__name__}")
    missing, unknown = (sorted(map(str, names)) for names in (own.keys() - saved.keys(), saved.keys() - own.keys()))
    if missing or unknown:
        both = (("without", missing), ("with", unknown))
        differences = [f"{word} {', '.join(names[:3])}" for word, names in both if names]
        raise ValueError(f"a state dict {' and '.join(differences)}")
    return saved


def buffers_sized_by_data(module: nn.Module) -> set[int]:
    """Return the ids of a module's buffers whose sizes depend on data."""
    sized = [part for part in module.modules() if isinstance(part, SizedByData)]
    return {id(buffer) for part in sized for buffer in part.buffers(recurse=False)}


def state_after_a_step(optimizer: torch.optim.Optimizer) -> dict[str, Any]:
    """Return the state of a copy of an optimizer after a step. Only dtypes and shapes of its tensors matter."""
    another = copy.deepcopy(optimizer)
    for group in another.param_groups:
        for parameter in group["params"]:
            parameter.grad = torch.zeros_like(parameter)
    another.step()
    return another.state_dict()


def check_optimizer(where: str, saved: Any, own: Mapping[str, Any]) -> None:
    """Refuse the saved state of another optimizer, whether or not its tensors have been read.

    Args:
        where: name of the state in the error.
        saved: the saved state.
        own: the optimizer's own state after a step.

    Raises:
        ValueError: the states differ; the message names the first difference.
    """
    state = checked(_OptimizerState, saved)
    if len(state.param_groups) != len(own["param_groups"]):
        raise ValueError(
            f"{where} has {len(state.param_groups)} param_groups, but must have {len(own['param_groups'])}"
        )
    for group, own_group in zip(state.param_groups, own["param_groups"], strict=True):
        for name, value in own_group.items():
            if name in group or name not in _MAY_LACK:
                _check_setting(f"{where}.{name}", name, group.get(name), value)
    for number, moments in state.state.items():
        check_columns(f"{where}.{number}", moments, own["state"].get(number, {}))


def _check_setting(where: str, name: str, value: Any, own: Any) -> None:
    if name in _SCHEDULED:
        is_right = type(value) in (int, float) and 0.0 <= value <= _MOST_SCHEDULED
        what = f"from 0 to {_MOST_SCHEDULED:g}"
    elif name in _IMPLEMENTATION:
        is_right, what = value is None or type(value) is bool, "true, false or null"
    else:
        is_right, what = value == own and type(value) is type(own), repr(own)
    if not is_right:
        raise ValueError(f"{where} is {value!r:.40}, but must be {what}")


def scheduled(own: Mapping[str, Any], saved: Mapping[str, Any]) -> dict[str, Any]:
    """Return an optimizer's settings, with saved values for the settings that training changes."""
    return {**own, **{name: saved[name] for name in _SCHEDULED if name in saved}}


def check_moments(where: str, state: Mapping[int, Mapping[str, Tensor]]) -> None:
    """Refuse moments with which an optimizer cannot make a step.

    Raises:
        ValueError: a number is invalid.
    """
    for number, moments in state.items():
        for name, value in moments.items():
            check_values(f"{where}.{number}.{name}", value, torch.zeros((), dtype=torch.float32))
            if (name == "step" or name.endswith("_sq")) and (value < 0.0).any():
                raise ValueError(f"{where}.{number}.{name} is negative")


def check_replay(where: str, saved: Any, buffer: ReplayBuffer) -> _ReplayState:
    """Check and return the state of a replay buffer before its rows are read.

    Raises:
        ValueError: the state is of another buffer.
    """
    state = checked(_ReplayState, saved)
    num, capacity = state.num_rows, buffer._storage.max_size
    if num > capacity:
        raise ValueError(f"{where} has {num:,} rows, but the buffer {capacity:,}")
    if state.writer.cursor != state.writer.write_count % capacity or num != min(state.writer.write_count, capacity):
        raise ValueError(f"{where}.writer does not fit {num:,} rows")
    return state


def check_num_rows(where: str, saved: Any, own: Mapping[str, Any], num: int) -> None:
    """Refuse columns that do not have `num` rows, or whose dtypes or shapes differ from `own`.

    Raises:
        ValueError: the message names the first difference.
    """
    check_columns(where, saved, own, any_rows=True)
    for name, column in saved.items():
        if column.shape[0] != num:
            raise ValueError(f"{where}.{name} has {column.shape[0]:,} rows, but must have {num:,}")


def check_generator(state: Tensor) -> None:
    """Refuse a tensor that is not a state of torch's CPU generator.

    Raises:
        ValueError: the tensor is refused.
    """
    own = torch.Generator()
    if state.dtype != torch.uint8 or state.shape != own.get_state().shape:
        raise ValueError("a random generator's state has another size")
    try:
        own.set_state(state.cpu())
    except RuntimeError as error:
        raise ValueError(f"a random generator's state is wrong: {first_line(error)}") from error


@torch.no_grad()
def example_steps(env: EnvBase, policy: TensorDictModuleBase) -> TensorDictBase:
    """Return steps `[N]` of a run as an example. Only their names, shapes and dtypes matter."""
    steps = env.fake_tensordict()
    for name in (keys.ACTION_MASK, keys.OPTION_MASK):
        for mask in (steps.get(name, None), steps.get(("next", name), None)):
            if mask is not None:
                mask.fill_(True)
    before = {name: buffer.clone() for name, buffer in policy.named_buffers()}
    with acting(ExplorationType.DETERMINISTIC), torch.random.fork_rng():
        steps = policy(steps)
    for name, buffer in policy.named_buffers():
        buffer.copy_(before[name])
    return steps
