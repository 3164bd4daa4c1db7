"""The codec of HyAR: an embedding table and a conditional VAE, which turn an action into a latent action and back.

Source: Li et al. 2022, arXiv 2109.05490, section 4.1; see `hyar.py`, also for the differences from the source.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hpamdp.policies.low_level.hyar_options import HyAROptions
from hpamdp.policies.masks import masked_values
from hpamdp.policies.shared.networks import OutputLinear, as_preactivations, mlp
from hpamdp.specs import PAMDPSpecs


class HybridCodec(nn.Module):
    """The embedding table and the conditional VAE with its dynamics head.

    Shapes: states `[B, observation_dim]`, discrete actions `[B]`, parameters `[B, num_parameters]` in [-1, 1],
    e `[B, embedding_dim]`, z `[B, latent_dim]`.
    """

    def __init__(self, specs: PAMDPSpecs, latent_dim: int, options: HyAROptions) -> None:
        super().__init__()
        self.latent_dim = latent_dim
        self.is_change_bounded = options.predicted_change == "bounded"
        embedding_dim, hidden_dim = options.embedding_dim, options.codec_hidden_dim
        self.table = nn.Parameter(
            torch.empty(specs.num_discrete, embedding_dim, dtype=torch.float32).uniform_(-1.0, 1.0)
        )
        condition_dim = specs.observation_dim + embedding_dim
        self.encoder: nn.Module
        self.decoder: nn.Module
        if options.codec_inputs == "multiplied":
            encoder = mlp(hidden_dim, [hidden_dim, hidden_dim], 2 * latent_dim)
            decoder = two_layers(hidden_dim, hidden_dim)
            self.encoder = MultipliedNetwork((specs.num_parameters, condition_dim), hidden_dim, encoder)
            self.decoder = MultipliedNetwork((latent_dim, condition_dim), hidden_dim, decoder)
        else:
            self.encoder = mlp(specs.num_parameters + condition_dim, [hidden_dim, hidden_dim], 2 * latent_dim)
            self.decoder = two_layers(latent_dim + condition_dim, hidden_dim)
        self.parameter_head = OutputLinear(hidden_dim, specs.num_parameters, dtype=torch.float32)
        self.dynamics_head = mlp(hidden_dim, [hidden_dim], specs.observation_dim)
        self.mask = nn.Buffer(specs.parameter_mask.float())
        self.change_scale = nn.Buffer(torch.ones(specs.observation_dim, dtype=torch.float32))
        # The central range of the encoded z, onto which the actor's [-1, 1] is mapped.
        self.z_low = nn.Buffer(-torch.ones(latent_dim, dtype=torch.float32))
        self.z_high = nn.Buffer(torch.ones(latent_dim, dtype=torch.float32))

    @property
    def embeddings(self) -> Tensor:
        """The embedding of each discrete action, `[num_discrete, embedding_dim]` in (-1, 1)."""
        return self.table.tanh()

    def nearest_discrete(self, e: Tensor, allowed: Tensor | None = None) -> Tensor:
        """Return the discrete action `[B]` whose embedding is nearest to e.

        Args:
            e: `[B, embedding_dim]`.
            allowed: the discrete actions to choose from, bool `[B, num_discrete]`. If None, all.
        """
        return masked_values(-torch.cdist(e, self.embeddings), allowed).argmax(-1)

    def of_allowed(self, proposals: Tensor, allowed: Tensor | None) -> Tensor:
        """Return latent actions whose e stands for an allowed discrete action, `[B, N, embedding_dim + latent_dim]`.

        If e stands for a forbidden discrete action, it is replaced by the embedding of the nearest allowed one. The
        gradient passes as if e was unchanged.
        """
        if allowed is None:
            return proposals
        e, z = proposals.split([self.table.shape[-1], self.latent_dim], -1)
        is_allowed = allowed.unsqueeze(1).expand(-1, e.shape[1], -1).flatten(0, 1)
        rows = e.flatten(0, 1).detach()
        nearest = self.nearest_discrete(rows, is_allowed)
        is_moved = self.nearest_discrete(rows) != nearest
        moved = torch.where(is_moved.unsqueeze(-1), self.embeddings.detach()[nearest], rows)
        return torch.cat([e + (moved - rows).unflatten(0, e.shape[:2]), z], -1)

    def encode(self, state: Tensor, discrete: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean and log-variance of z, each `[B, latent_dim]`."""
        own = parameters * self.mask[discrete]
        mean, log_variance = self._joined(self.encoder, own, state, discrete).chunk(2, -1)
        return mean, log_variance.clamp(-10.0, 4.0)

    def decode(self, state: Tensor, discrete: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return the parameters `[B, num_parameters]` in [-1, 1] and the predicted change of the state, scaled."""
        hidden = self._joined(self.decoder, z, state, discrete)
        return as_preactivations(self.parameter_head(hidden)).tanh(), self._change(hidden)

    def change(self, state: Tensor, discrete: Tensor, z: Tensor) -> Tensor:
        """Return the predicted change of the state alone, scaled, `[B, observation_dim]`."""
        return self._change(self._joined(self.decoder, z, state, discrete))

    def scaled_change(self, state: Tensor, next_state: Tensor) -> Tensor:
        """Return the change of the state that is to be predicted, `[B, observation_dim]`."""
        return (next_state - state) / self.change_scale

    def set_change_scale(self, scale: Tensor) -> None:
        """Set the unit `[observation_dim]` of the predicted change, and keep what is predicted."""
        last = self.dynamics_head[-1]
        assert isinstance(last, nn.Linear)
        ratio = self.change_scale / scale
        with torch.no_grad():
            last.weight.mul_(ratio.unsqueeze(-1))
            last.bias.mul_(ratio)
        self.change_scale.copy_(scale)

    def _change(self, hidden: Tensor) -> Tensor:
        output = self.dynamics_head(hidden)
        return as_preactivations(output).tanh() if self.is_change_bounded else output

    def _joined(self, net: nn.Module, variable: Tensor, state: Tensor, discrete: Tensor) -> Tensor:
        """Return a network's output for parameters or z, given a state and the embedding of a discrete action."""
        condition = torch.cat([state, self.embeddings[discrete]], -1)
        if isinstance(net, MultipliedNetwork):
            return net(variable, condition)
        return net(torch.cat([variable, condition], -1))

    def z_from_unit(self, unit_z: Tensor) -> Tensor:
        """Map the actor's [-1, 1] onto the central range of the encoded z."""
        return self.z_low + (unit_z + 1.0) * 0.5 * (self.z_high - self.z_low)

    def z_to_unit(self, z: Tensor) -> Tensor:
        """Map z back to the actor's [-1, 1], clipped."""
        return (2.0 * (z - self.z_low) / (self.z_high - self.z_low) - 1.0).clamp(-1.0, 1.0)


def two_layers(in_dim: int, hidden_dim: int) -> nn.Sequential:
    """Return two ReLU layers, for heads to stand on."""
    first = nn.Linear(in_dim, hidden_dim, dtype=torch.float32)
    second = nn.Linear(hidden_dim, hidden_dim, dtype=torch.float32)
    # Nested, as the names in saved states are.
    return nn.Sequential(nn.Sequential(first, nn.ReLU(inplace=True), second), nn.ReLU())


class MultipliedNetwork(nn.Module):
    """A ReLU network of two inputs: each goes through a layer of its own, and the layers' outputs are multiplied.

    Args:
        dims: entries of the two inputs.
        hidden_dim: width of all layers.
        rest: maps the product `[B, hidden_dim]` to the output.
    """

    def __init__(self, dims: tuple[int, int], hidden_dim: int, rest: nn.Module) -> None:
        super().__init__()
        self.inputs = nn.ModuleList(nn.Linear(dim, hidden_dim, dtype=torch.float32) for dim in dims)
        self.rest = rest

    def forward(self, first: Tensor, second: Tensor) -> Tensor:
        """Return the output for two inputs `[B, dim]`."""
        of_first, of_second = self.inputs
        return self.rest(of_first(first).relu() * of_second(second).relu())
