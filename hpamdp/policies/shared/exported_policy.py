"""Policies as JSON values, for programs without torch, such as a page in a browser.

A layer is `{"in": n, "out": m, "weight": ..., "bias": ...}`: y = Wx + b, the weight row by row, both as base64 of
little-endian float32. Forms of a selector or learner, by their `kind`:

- `hybrid_actor`: `encoder`, layers each followed by ReLU, and two heads on it. The largest output of `discrete` is the
  discrete action. The outputs of `parameters` are clipped to [-1, 1] and mapped linearly to the bounds `low` and
  `high`;
- `ensemble`: `members`, each a list of layers with ReLU between them; the largest mean output is the option;
- `polynomial`: monomials of the observation's entries `inputs`, with a constant 1 after them. Each of `factors` lists
  the entries to multiply. The option is the one whose row of `coefficients` has the largest product with the monomials;
- `projections`: of `vectors`, pairs of the observation's entries from their `origins` on, on the `directions` of each
  option's actions. Those on the actions of each list in `kinds` are sorted, the largest first; all of one vector come
  before those of the next, and a constant 1 last. `coefficients` are as above, each row for its option's own numbers.
"""

from __future__ import annotations

import base64
from typing import Any

from torch import Tensor, nn

from hpamdp.policies.shared.hybrid_actor import HybridActor
from hpamdp.policies.shared.networks import EnsembleLinear, EnsembleMLP
from hpamdp.specs import PAMDPSpecs


def exported_actor(actor: HybridActor, specs: PAMDPSpecs) -> dict[str, Any] | None:
    """Return a `hybrid_actor`; None if the actor has something that the form lacks.

    The form lacks initial parameters, products of vectors, several components, whole numbers and bounds that depend on
    the state.
    """
    lacks_action = not specs.components.is_single or specs.has_integers or specs.has_parameter_bounds
    if lacks_action or actor.initial.exists or actor.products is not None or type(actor) is not HybridActor:
        return None
    num, head = specs.num_parameters, actor.parameter_head
    return {
        "kind": "hybrid_actor",
        "encoder": [_layer(part.weight, part.bias) for part in actor.encoder if isinstance(part, nn.Linear)],
        "discrete": _layer(actor.discrete_head.weight, actor.discrete_head.bias),
        "parameters": _layer(head.weight[:num], head.bias[:num]),
        "low": list(specs.parameter_low),
        "high": list(specs.parameter_high),
    }


def exported_ensemble(net: EnsembleMLP) -> dict[str, Any]:
    """Return an `ensemble`."""
    layers = [layer for layer in net.layers if isinstance(layer, EnsembleLinear)]
    members = [[_layer(layer.weight[i].T, layer.bias[i, 0]) for layer in layers] for i in range(net.num_members)]
    return {"kind": "ensemble", "members": members}


def _layer(weight: Tensor, bias: Tensor) -> dict[str, Any]:
    num_out, num_in = weight.shape
    return {"in": num_in, "out": num_out, "weight": _encoded(weight), "bias": _encoded(bias)}


def _encoded(values: Tensor) -> str:
    return base64.b64encode(values.detach().cpu().float().contiguous().numpy().astype("<f4").tobytes()).decode()
