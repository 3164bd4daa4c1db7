"""Updates compiled by `torch.compile`, which merges the many small operations around their matrix products."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a function that is compiled at its first call for each loss, in a few seconds of CPU time.

    What was compiled is kept on disk by PyTorch (`TORCHINDUCTOR_CACHE_DIR`), so that the same losses compile faster in
    later runs. Compiled code draws other random numbers from the same seed, and sums in another order.

    Args:
        function: computes gradients by `torch.autograd.grad`; all its code is traced in one piece.

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
    fast = torch.compile(function, dynamic=False, fullgraph=True)

    def with_plain_inputs(*inputs: Any) -> Any:
        # A TensorDict would have to be traced, too.
        return fast(*(dict(each.items()) if isinstance(each, TensorDictBase) else each for each in inputs))

    return with_plain_inputs
