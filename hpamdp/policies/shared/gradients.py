"""Optimizer steps, with gradients that `torch.compile` can compile.

Compiled code merges the many small operations around the matrix products.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

if TYPE_CHECKING:
    from torch._dynamo.guards import GuardFilterEntry

Inputs: TypeAlias = Tensor | Mapping[str, Tensor] | TensorDictBase | None
# Maps what an update sees to the loss and to scalars to log; a function or a method, which has a name.
LossFunction = Callable[..., tuple[Tensor, dict[str, Tensor]]]
# The largest norm of a gradient, and the places of the parameters whose gradients are clipped together.
Limits: TypeAlias = tuple[float, tuple[tuple[int, ...], ...]]
Gradients = Callable[..., tuple[dict[str, Tensor], tuple[Tensor | None, ...]]]


class Descent:
    """Take steps of optimizers down the gradients of losses: plain, compiled, or with matrix products in bfloat16."""

    def __init__(self) -> None:
        self._gradients_of: Gradients = gradients_of
        self._while_compiling: Callable[[], AbstractContextManager] = nullcontext
        self._compiled_losses: set[str] = set()  # names of the losses whose gradients are compiled
        self.precision = torch.float32

    def compile(
        self,
        device: torch.device,
        *,
        any_size: bool,
        while_compiling: Callable[[], AbstractContextManager] = nullcontext,
    ) -> None:
        """Compile the gradients of each loss at the first step down it; see `compiled`.

        Args:
            device: of the parameters.
            any_size: whether the inputs of a loss change their size.
            while_compiling: gives a context for the steps that compile, which take seconds.
        """
        self._gradients_of = compiled(device, any_size=any_size)
        self._while_compiling = while_compiling

    def lower_precision(self) -> None:
        """Compute matrix products in bfloat16, except for last layers; parameters and long sums stay in float32."""
        self.precision = torch.bfloat16

    def same_precision(self, device: torch.device) -> AbstractContextManager:
        """Return a context in which products have the precision of those in `step`."""
        return matmul_precision(device, self.precision)

    def step(
        self,
        optimizer: torch.optim.Optimizer,
        loss_of: LossFunction,
        *inputs: Inputs,
        max_grad_norm: float | None = None,
        clipped_apart: Sequence[Iterable[Tensor]] = (),
    ) -> dict[str, Tensor]:
        """Take one step of an optimizer down the gradient of a loss; return the scalars of the loss.

        Nothing but the parameters of the optimizer changes, whatever else the loss depends on.

        Args:
            optimizer: of the parameters to learn.
            loss_of: maps the inputs to the loss and to scalars to log.
            inputs: tensors, tensors by name, or None.
            max_grad_norm: largest norm of the gradient; if None, there is no limit.
            clipped_apart: groups of parameters, the gradient of each of which is clipped separately.
        """
        groups = optimizer.param_groups
        parameters = [parameter for group in groups for parameter in group["params"] if parameter.requires_grad]
        limits = None if max_grad_norm is None else (max_grad_norm, _clipped_together(parameters, clipped_apart))
        is_first = self._gradients_of is not gradients_of and loss_of.__qualname__ not in self._compiled_losses
        with self._while_compiling() if is_first else nullcontext():
            scalars, gradients = self._gradients_of(
                loss_of, parameters, *inputs, precision=self.precision, limits=limits
            )
        if is_first:
            self._compiled_losses.add(loss_of.__qualname__)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        optimizer.step()
        return scalars


def adam(rate: float, *modules: nn.Module, weight_decay: float | None = None) -> torch.optim.Optimizer:
    """Return Adam for the parameters of these modules; with a weight decay, AdamW."""
    learned = [parameter for module in modules for parameter in module.parameters()]
    if weight_decay is None:
        return torch.optim.Adam(learned, lr=rate, fused=True)
    return torch.optim.AdamW(learned, lr=rate, weight_decay=weight_decay, fused=True)


def descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> Tensor:
    """Take one step of an optimizer down the gradient of a loss; return the loss without its graph."""
    optimizer.zero_grad(set_to_none=True)
    loss.backward()
    optimizer.step()
    return loss.detach()


def set_learning_rates(
    optimizers: Mapping[str, torch.optim.Optimizer], rates: Mapping[str, float], fraction: float
) -> None:
    """Set the learning rate of each optimizer to a fraction of the rate of the same name."""
    for name, rate in rates.items():
        for group in optimizers[name].param_groups:
            group["lr"] = rate * fraction


def expectile_loss(excess: Tensor, expectile: float) -> Tensor:
    """Return a scalar, least where a prediction is the expectile of its targets: Kostrikov et al. 2021, equation 5.

    Args:
        excess: of the targets over the predictions, `[B]`.
        expectile: 0.5 gives the mean of the targets; towards 1 it approaches their maximum.
    """
    return (torch.where(excess > 0.0, expectile, 1.0 - expectile).float() * excess.square()).mean()


def matmul_precision(device: torch.device, precision: torch.dtype) -> AbstractContextManager:
    """Return a context in which matrix products have this precision."""
    return nullcontext() if precision == torch.float32 else torch.autocast(device.type, precision)


def gradients_of(
    loss_of: LossFunction,
    parameters: Sequence[Tensor],
    *inputs: Inputs,
    precision: torch.dtype = torch.float32,
    limits: Limits | None = None,
) -> tuple[dict[str, Tensor], tuple[Tensor | None, ...]]:
    """Return the scalars of a loss and its gradients, None for parameters that it does not depend on.

    With `limits` the gradients are clipped. This is part of the function so that it is compiled with it.
    """
    with matmul_precision(parameters[0].device, precision):
        loss, scalars = loss_of(*inputs)
    gradients = torch.autograd.grad(loss, parameters, allow_unused=True)
    # A fused optimizer requires that gradients lie in memory as their parameters do.
    in_order = [None if gradient is None else gradient.contiguous() for gradient in gradients]
    if limits is not None:
        largest, places = limits
        for part in places:
            own = {place: in_order[place] for place in part if in_order[place] is not None}
            # The compiler has no code for a foreach norm; it would call PyTorch's, with a warning.
            norm = nn.utils.get_total_norm(list(own.values()), foreach=False)
            factor = (largest / (norm + 1e-6)).clamp(max=1.0)
            for place, gradient in own.items():
                in_order[place] = gradient * factor
    return {name: value.detach() for name, value in scalars.items()}, tuple(in_order)


def _clipped_together(parameters: Sequence[Tensor], apart: Sequence[Iterable[Tensor]]) -> tuple[tuple[int, ...], ...]:
    """Return the places of the parameters whose gradients are clipped together, those in no group of `apart` first."""
    group_of = {id(parameter): number for number, group in enumerate(apart, start=1) for parameter in group}
    groups: list[list[int]] = [[] for _ in range(len(apart) + 1)]
    for place, parameter in enumerate(parameters):
        groups[group_of.get(id(parameter), 0)].append(place)
    return tuple(map(tuple, groups))


def _kept_guards(guards: Sequence[GuardFilterEntry]) -> list[bool]:
    """Return which conditions of compiled code to check at every call.

    The checks left out are two thirds of all: that functions, modules and classes are still those of their names, and
    that no module got a hook or a method of its own. Nothing here does that in the middle of a run.
    """
    never_changes = ("EMPTY_NN_MODULE_HOOKS_DICT", "NOT_PRESENT_IN_GENERIC_DICT")
    return [not guard.is_global and guard.guard_type not in never_changes for guard in guards]


def compiled(device: torch.device, *, any_size: bool) -> Gradients:
    """Return `gradients_of` compiled at its first call for each loss, in a few seconds of CPU time.

    PyTorch keeps compiled code on disk (`TORCHINDUCTOR_CACHE_DIR`), so that the same losses compile faster in later
    runs. Compiled code draws other random numbers from the same seed, and sums in another order.

    Args:
        device: of the parameters.
        any_size: true if the inputs of a loss change in size from call to call.

    Raises:
        ValueError: there is no C++ compiler, or this PyTorch cannot compile gradients.
    """
    from torch._dynamo import config
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    if not hasattr(config, "trace_autograd_ops"):
        raise ValueError(f"PyTorch {torch.__version__} cannot compile gradients; PyTorch 2.13 can")
    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        raise ValueError("there is no C++ compiler; install g++ or name one in the variable CXX") from error
    config.trace_autograd_ops = True
    # Each loss of each kind of learner is another version of the same function.
    config.recompile_limit = max(config.recompile_limit, 64)
    # A wrapper in C++ calls the products and kernels sooner than one in Python. For a GPU it would take a CUDA toolkit.
    options: dict[str, str | int | bool | Callable[..., Any]] = {
        "cpp_wrapper": device.type == "cpu",
        "guard_filter_fn": _kept_guards,
    }
    fast = torch.compile(gradients_of, dynamic=any_size, fullgraph=True, options=options)

    def with_plain_inputs(
        loss_of: LossFunction, parameters: Sequence[Tensor], *inputs: Inputs, **given: Any
    ) -> tuple[dict[str, Tensor], tuple[Tensor | None, ...]]:
        # A TensorDict would have to be traced, too.
        plain = (dict(each.items()) if isinstance(each, TensorDictBase) else each for each in inputs)
        return fast(loss_of, parameters, *plain, **given)

    return with_plain_inputs
