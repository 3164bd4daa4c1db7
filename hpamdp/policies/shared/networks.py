"""Networks that several learners share, and what bounds their output."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp.policies.shared.options import InitialParameters
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

# Initial squashed parameters are clamped to the first bound, past which tanh has hardly any gradient. Targets of an
# actor's squashed parameters are clamped to the second.
_LARGEST_INITIAL = 0.99
_LARGEST_DRAWN_TO = 0.97

# Passes of multi-pass critics that are computed at once: bounds the memory where there are many discrete actions.
_MAX_PASSES = 1 << 13


def in_float32(layer: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Apply a layer in float32, also where autocast computes products in bfloat16.

    bfloat16 has steps of 0.25 near 50. So network outputs are computed in float32, from hidden layers in bfloat16.
    """
    if x.is_meta or not torch.is_autocast_enabled(x.device.type):
        return layer(x)
    with torch.autocast(x.device.type, enabled=False):
        return layer(x.float())


class OutputLinear(nn.Linear):
    """The last layer of a network, see `in_float32`."""

    def reset_parameters(self) -> None:
        """Draw the initial weights, if there are any. Actions without parameters have none."""
        if self.out_features:
            super().reset_parameters()

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layer in float32."""
        return in_float32(super().forward, x)


class EnsembleLinear(nn.Module):
    """`num_members` independent linear layers as one batched product, `[E, B, in]` -> `[E, B, out]`."""

    def __init__(self, num_members: int, in_dim: int, out_dim: int) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(in_dim)  # as in nn.Linear
        # Registered first and filled afterwards, so that weights of a wrong size are refused before they take memory.
        self.weight = nn.Parameter(torch.empty(num_members, in_dim, out_dim, dtype=torch.float32))
        self.bias = nn.Parameter(torch.empty(num_members, 1, out_dim, dtype=torch.float32))
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.uniform_(self.bias, -bound, bound)

    def forward(self, x: Tensor) -> Tensor:
        """Apply each member to its own slice of `x`; if there are fewer slices, apply the first members alone."""
        is_whole = len(x) == len(self.weight)
        weight = self.weight if is_whole else self.weight[: len(x)]
        bias = self.bias if is_whole else self.bias[: len(x)]
        if weight.shape[-1] == 1:
            # A batched product with one column takes two to four times as long on the CPU.
            return (x * weight.mT).sum(-1, keepdim=True) + bias
        return torch.baddbmm(bias, x, weight)


class EnsembleMLP(nn.Module):
    """`num_members` independent ReLU networks on the same input `[B, in]`, output `[E, B, out]`.

    Forward and backward of two members of 128 x 128 units take 1.2 ms of CPU time on a batch of 256, and 0.46 ms on 64.
    `torch.func.stack_module_state` under vmap and TorchRL's vmapped parameters take 1.6 and 0.83 ms.

    Args:
        num_members: E.
        in_dim: entries of the input.
        hidden_dims: widths of the hidden layers.
        out_dim: entries of the output.
        layer_norm: normalise the hidden layers before ReLU. This bounds the output for inputs far from the training
            data (Ball et al. 2023, *Efficient Online Reinforcement Learning with Offline Data*, arXiv 2302.02948,
            section 4.2).
    """

    def __init__(
        self, num_members: int, in_dim: int, hidden_dims: Sequence[int], out_dim: int, *, layer_norm: bool = False
    ) -> None:
        super().__init__()
        dims = [in_dim, *hidden_dims, out_dim]
        self.num_members = num_members
        self.layer_norm = layer_norm
        self.layers = nn.ModuleList(EnsembleLinear(num_members, size, next_size) for size, next_size in pairwise(dims))

    def forward(self, x: Tensor, num_members: int | None = None) -> Tensor:
        """Apply all members, or the first `num_members`."""
        x = x.expand(num_members or self.num_members, *x.shape)
        for layer in self.layers[:-1]:
            x = self.activated(layer(x))
        return in_float32(self.layers[-1], x)

    def activated(self, x: Tensor) -> Tensor:
        """Return the activations of a hidden layer's output `[*B, width]`, which is overwritten."""
        return (F.layer_norm(x, x.shape[-1:]) if self.layer_norm else x).relu_()


def mlp(in_dim: int, hidden_dims: Sequence[int], out_dim: int) -> nn.Sequential:
    """Return a ReLU network with linear output, which is float32."""
    dims = [in_dim, *hidden_dims]
    layers: list[nn.Module] = []
    for size, next_size in pairwise(dims):
        layers += [nn.Linear(size, next_size, dtype=torch.float32), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers, OutputLinear(dims[-1], out_dim, dtype=torch.float32))


def as_preactivations(output: Tensor) -> Tensor:
    """Return a network's output, to which tanh will be applied, in float32.

    In bfloat16 tanh is 1 from 3.3 on, and has no gradient there.
    """
    return output.float()


def unsquashed(squashed: Tensor, largest: float = _LARGEST_DRAWN_TO) -> Tensor:
    """Return the inverse tanh, after clamping to [-largest, largest]."""
    return squashed.clamp(-largest, largest).atanh()


def with_clipped_noise(unit_actions: Tensor, scale: float, clip: float) -> Tensor:
    """Return actions in [-1, 1] with Gaussian noise, itself clipped: the target policy smoothing of TD3.

    Source: Fujimoto, van Hoof and Meger 2018, arXiv 1802.09477, section 5.3.

    Args:
        unit_actions: the actions, of any shape.
        scale: standard deviation of the noise; 0 is none, and draws no random numbers.
        clip: bound of the noise.
    """
    if scale == 0.0:
        return unit_actions
    noise = (scale * torch.randn_like(unit_actions)).clamp(-clip, clip)
    return (unit_actions + noise).clamp(-1.0, 1.0)


def polyak_update(target: nn.Module, source: nn.Module, tau: float) -> None:
    """Move a target network's parameters the fraction `tau` of the way towards the source network's."""
    targets, sources = tuple(target.parameters()), tuple(source.parameters())
    if targets:  # a plain perception has none
        with torch.no_grad():
            torch._foreach_lerp_(targets, sources, tau)


class VectorProducts(nn.Module):
    """Append to an observation the scalar and the cross product of every two of its vectors in the plane.

    The distance by which a heading misses a target is a sum of such products. Without them a network has to learn to
    multiply, and learns it only roughly.

    Args:
        specs: of the problem, whose geometry says which entries are vectors.

    Attributes:
        num_outputs: entries of the observation and products together.

    Raises:
        ValueError: the problem declares fewer than two vectors.
    """

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__()
        geometry = specs.geometry
        if geometry is None or len(geometry.vectors) < 2:
            raise SettingError(
                "vector_products=true: the problem declares no two vectors of the plane; use vector_products=false"
            )
        self.entries = nn.Buffer(torch.tensor(geometry.vectors), persistent=False)
        origins = (
            torch.tensor(geometry.origins, dtype=torch.float32)
            if geometry.origins
            else torch.zeros(self.entries.shape, dtype=torch.float32)
        )
        self.origins = nn.Buffer(origins, persistent=False)
        self.pairs = nn.Buffer(torch.combinations(torch.arange(len(self.entries))).mT, persistent=False)
        self.num_outputs = specs.observation_dim + 2 * self.pairs.shape[-1]

    def forward(self, observation: Tensor) -> Tensor:
        """Return `[*B, num_outputs]` for observations `[*B, observation_dim]`."""
        vectors = observation[..., self.entries] - self.origins
        (first_x, first_y), (second_x, second_y) = (vectors[..., places, :].unbind(-1) for places in self.pairs)
        scalar = first_x * second_x + first_y * second_y
        cross = first_x * second_y - first_y * second_x
        return torch.cat([observation, scalar, cross], -1)


class InvertingGradients(torch.autograd.Function):
    """Clips to [-1, 1]; scales the gradient by the fraction of the range that is left in its direction.

    Past a bound this fraction is negative, so that the gradient points back into the range.

    Source: Hausknecht and Stone 2016, *Deep Reinforcement Learning in Parameterized Action Space*, arXiv 1511.04143,
    equation 11.
    """

    @staticmethod
    def forward(ctx: Any, raw: Tensor) -> Tensor:
        """Return the clipped parameters."""
        ctx.save_for_backward(raw)
        return raw.clamp(-1.0, 1.0)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """Return the scaled gradient of a loss; where it is negative, descent increases the parameter."""
        (raw,) = ctx.saved_tensors
        return gradient * torch.where(gradient < 0.0, 1.0 - raw, 1.0 + raw) * 0.5


class InitialLayer(nn.Module):
    """A problem's initial parameters as a frozen linear layer, whose output is added to a network's parameters.

    Source: the code of Bester, James and Konidaris 2019, arXiv 1905.04388 (`action_parameters_passthrough_layer`).

    Args:
        specs: of the problem.
        choice: `domain`: the problem's convention, if it has one; `none`: no layer, which adds 0.
        is_squashed: whether the sum is squashed by tanh, and not clipped, into the bounds.
    """

    def __init__(self, specs: PAMDPSpecs, choice: InitialParameters, *, is_squashed: bool) -> None:
        super().__init__()
        self.exists = choice == "domain" and specs.initial_weight is not None
        self.is_squashed = is_squashed
        if self.exists:
            self.weight = nn.Buffer(torch.tensor(specs.initial_weight, dtype=torch.float32))
            self.bias = nn.Buffer(torch.tensor(specs.initial_bias, dtype=torch.float32))

    def forward(self, observation: Tensor) -> Tensor | float:
        """Return what to add for observations `[*B, observation_dim]`: `[*B, num_parameters]`, or 0."""
        if not self.exists:
            return 0.0
        unit_parameters = in_float32(lambda x: nn.functional.linear(x, self.weight, self.bias), observation)
        return unsquashed(unit_parameters, _LARGEST_INITIAL) if self.is_squashed else unit_parameters

    def shrink(self, output: nn.Module, rows: slice = slice(None)) -> None:
        """Bring the parameters' rows of a network's linear output near 0 where this layer adds something."""
        assert isinstance(output, nn.Linear)
        if self.exists:
            with torch.no_grad():
                output.weight[rows].mul_(0.01)
                output.bias[rows].zero_()


class HybridCritics(nn.Module):
    """`num_members` independent networks for Q(s, k, x), the value of discrete action k with parameters x.

    With `is_multipass`, the value of k comes from a forward pass that sees only its own parameters x_k; the others are
    0. The passes of a state share their first layer but for the columns of x_k, and pass k computes only output k. So K
    passes of H units take memory `[B, K, H]`, and not `[B, K, K]`, unless there is no hidden layer.

    If an action has several components, its value is the sum of the values of what each component chose (Sunehag et al.
    2018, *Value-Decomposition Networks for Cooperative Multi-Agent Learning*, arXiv 1706.05296). So the best choice of
    each component is the best action. Values in which components depend on each other cannot be represented.

    Parameters that are whole numbers are moved to the middle of their cells, see `PAMDPSpecs.in_cells`.

    Shapes: states `[B, observation_dim]`, parameters `[B, num_parameters]` in [-1, 1].
    """

    def __init__(
        self,
        specs: PAMDPSpecs,
        num_members: int,
        hidden_dims: Sequence[int],
        is_multipass: bool,
        *,
        layer_norm: bool = False,
    ) -> None:
        super().__init__()
        self.is_multipass = is_multipass
        self.components = specs.components
        self.in_cells = specs.in_cells
        self.num_discrete = specs.num_discrete
        self.observation_dim = specs.observation_dim
        input_dim = specs.observation_dim + specs.num_parameters
        self.net = EnsembleMLP(num_members, input_dim, hidden_dims, specs.num_discrete, layer_norm=layer_norm)
        owner, slots = specs.parameter_owner, specs.parameter_slots
        self.owner = nn.Buffer(owner, persistent=False)
        self.slots = nn.Buffer(slots, persistent=False)
        self.is_own = nn.Buffer(
            (owner[slots] == torch.arange(self.num_discrete).unsqueeze(-1)).float(), persistent=False
        )

    def forward(self, state: Tensor, unit_parameters: Tensor) -> Tensor:
        """Return the values of all discrete actions, `[E, B, num_discrete]`."""
        unit_parameters = self.in_cells(unit_parameters)
        if not self.is_multipass:
            return self.net(torch.cat([state, unit_parameters], -1))
        num_rows = max(1, _MAX_PASSES // self.num_discrete)
        if state.shape[0] <= num_rows:  # not len(), which would make the size of a traced batch a constant
            return self._passes(state, unit_parameters)
        pieces = zip(state.split(num_rows), unit_parameters.split(num_rows), strict=True)
        return torch.cat([self._passes(*piece) for piece in pieces], 1)

    def of_discrete(self, state: Tensor, discrete: Tensor, unit_parameters: Tensor) -> Tensor:
        """Return the values `[E, B]` of the given discrete actions `[B]`, summed over several components."""
        if not self.components.is_single:
            q = self(state, unit_parameters)
            return self.components.of_choice(q, discrete.expand(q.shape[0], *discrete.shape)).sum(-1)
        own = unit_parameters * (self.owner == discrete.unsqueeze(-1)) if self.is_multipass else unit_parameters
        q = self.net(torch.cat([state, own], -1))
        return q.gather(-1, discrete.expand(q.shape[0], -1).unsqueeze(-1)).squeeze(-1)

    def _passes(self, state: Tensor, unit_parameters: Tensor) -> Tensor:
        """Return output k of pass k for every discrete action k, `[E, B, num_discrete]`."""
        first, last = self.net.layers[0], self.net.layers[-1]
        assert isinstance(first, EnsembleLinear) and isinstance(last, EnsembleLinear)
        of_state, of_parameters = first.weight.split([self.observation_dim, unit_parameters.shape[-1]], 1)

        def of_states(x: Tensor) -> Tensor:
            return torch.baddbmm(first.bias, x.expand(len(of_state), *x.shape), of_state)

        x = (in_float32(of_states, state) if first is last else of_states(state)).unsqueeze(2)
        for slot, is_own in zip(self.slots.unbind(-1), self.is_own.unbind(-1), strict=True):
            # Add the next parameter of each discrete action, `[B, K]`, to its own pass.
            x = torch.addcmul(x, (unit_parameters[:, slot] * is_own).unsqueeze(-1), of_parameters[:, slot].unsqueeze(1))
        if first is last:
            return x.expand(-1, -1, self.num_discrete, -1).diagonal(dim1=-2, dim2=-1)
        x = self.net.activated(x.expand(-1, -1, self.num_discrete, -1).contiguous())
        shape = x.shape[1:3]
        x = x.flatten(1, 2)
        for layer in self.net.layers[1:-1]:
            x = self.net.activated(layer(x))
        # One column for each pass, so no product either: see EnsembleLinear.
        return (x.unflatten(1, shape) * last.weight.mT.unsqueeze(1)).sum(-1) + last.bias


class JointCritics(nn.Module):
    """`num_members` independent networks for the value of an action of several components as a whole.

    They see the state, what each component chose (one-hot), and the chosen parameters. So the value of a component's
    choice may depend on the others.

    Shapes: states `[B, observation_dim]`, choices `[B, num_components]`, parameters `[B, num_parameters]` in [-1, 1].
    """

    def __init__(self, specs: PAMDPSpecs, num_members: int, hidden_dims: Sequence[int]) -> None:
        super().__init__()
        self.components = specs.components
        self.in_cells = specs.in_cells
        num_inputs = specs.observation_dim + specs.num_discrete + specs.num_parameters
        self.net = EnsembleMLP(num_members, num_inputs, hidden_dims, 1)
        self.owner = nn.Buffer(specs.parameter_owner, persistent=False)

    def of_discrete(self, state: Tensor, discrete: Tensor, unit_parameters: Tensor) -> Tensor:
        """Return the values `[E, B]` of actions."""
        is_chosen = self.components.is_chosen(discrete)
        own = self.in_cells(unit_parameters) * is_chosen.index_select(-1, self.owner)
        return self.net(torch.cat([state, is_chosen.to(state.dtype), own], -1)).squeeze(-1)
