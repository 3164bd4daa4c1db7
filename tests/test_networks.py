"""Networks that several learners share, and sampling from their output."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from hpamdp import DLPA, HPPO, HSAC, IQL, PADDPG, PDQN, TD3BC
from hpamdp.geometry import PlaneGeometry
from hpamdp.policies.masks import sample_index
from hpamdp.policies.shared import networks
from hpamdp.policies.shared.networks import (
    EnsembleMLP,
    HybridCritics,
    InitialLayer,
    OutputLinear,
    VectorProducts,
    mlp,
    polyak_update,
    with_clipped_noise,
)
from hpamdp.specs import PAMDPSpecs


def specs_of(*dims: int) -> PAMDPSpecs:
    return PAMDPSpecs(4, (), dims, (-1.0,) * sum(dims), (1.0,) * sum(dims))


def passes_one_by_one(critics: HybridCritics, specs: PAMDPSpecs, state: Tensor, unit: Tensor) -> Tensor:
    """Return output k of a whole pass that sees the state and the own parameters of k, for every k."""
    own = (unit * mask for mask in specs.parameter_mask.float())
    return torch.stack([critics.net(torch.cat([state, x], -1))[..., k] for k, x in enumerate(own)], -1)


@pytest.mark.parametrize("dims", [(1, 1, 1), (2, 0, 1), (0, 3), (0, 0), (1,) * 40])
@pytest.mark.parametrize("hidden_dims", [[], [16], [16, 8]])
@pytest.mark.parametrize("layer_norm", [False, True])
def test_multi_pass_values_and_their_gradients_are_those_of_separate_passes(dims, hidden_dims, layer_norm):
    torch.manual_seed(0)
    specs = specs_of(*dims)
    critics = HybridCritics(specs, 2, hidden_dims, is_multipass=True, layer_norm=layer_norm)
    state, unit = torch.randn(7, 4), (torch.rand(7, sum(dims)) * 2 - 1).requires_grad_()
    inputs = [unit, *critics.parameters()]
    results = []
    for q in (critics(state, unit), passes_one_by_one(critics, specs, state, unit)):
        gradients = torch.autograd.grad(q.square().sum(), inputs, allow_unused=True)
        results.append((q, [None if gradient is None else gradient for gradient in gradients]))
    torch.testing.assert_close(results[0][0], results[1][0])
    for shared, separate in zip(results[0][1], results[1][1], strict=True):
        if shared is not None and separate is not None:
            torch.testing.assert_close(shared, separate, rtol=1e-4, atol=1e-5)


def test_many_discrete_actions_are_passed_in_pieces_with_the_same_values(monkeypatch):
    specs = specs_of(*(1,) * 50)
    critics = HybridCritics(specs, 2, [16], is_multipass=True)
    state, unit = torch.randn(20, 4), torch.rand(20, 50) * 2 - 1
    whole = critics(state, unit)
    monkeypatch.setattr(networks, "_MAX_PASSES", 150)
    torch.testing.assert_close(critics(state, unit), whole)


WEIGHT = ((0.5, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0))
INITIAL = replace(specs_of(1, 1), initial_weight=WEIGHT, initial_bias=(0.1, -0.8))


def test_the_initial_layer_is_linear_and_frozen():
    layer = InitialLayer(INITIAL, "domain", is_squashed=False)
    state = torch.randn(9, 4)
    expected = torch.stack([0.1 + 0.5 * state[:, 0], -0.8 + 2.0 * state[:, 3]], -1)
    torch.testing.assert_close(layer(state), expected)
    assert not list(layer.parameters())


def test_squashing_the_initial_layers_output_gives_the_initial_parameters_short_of_the_bounds():
    layer = InitialLayer(INITIAL, "domain", is_squashed=True)
    state = torch.rand(9, 4)
    expected = torch.stack([0.1 + 0.5 * state[:, 0], -0.8 + 2.0 * state[:, 3]], -1).clamp(-0.99, 0.99)
    torch.testing.assert_close(layer(state).tanh(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("specs", "choice"), [(INITIAL, "none"), (specs_of(1, 1), "domain"), (specs_of(1), "none")])
def test_without_initial_parameters_the_network_stays_as_it_is(specs, choice):
    layer = InitialLayer(specs, choice, is_squashed=False)
    assert layer(torch.randn(9, 4)) == 0.0
    output = torch.nn.Linear(3, 1)
    before = output.weight.clone()
    layer.shrink(output)
    assert torch.equal(output.weight, before)


def test_indices_are_sampled_with_their_probabilities():
    torch.manual_seed(0)
    pi = torch.tensor([0.5, 0.3, 0.2])
    sampled = sample_index(pi.log().expand(20_000, 3))
    torch.testing.assert_close(sampled.bincount() / 20_000, pi, rtol=0.0, atol=0.015)


def test_the_first_members_of_an_ensemble_give_alone_what_they_give_among_all():
    net = EnsembleMLP(3, 4, [8], 2)
    x = torch.randn(5, 4)
    torch.testing.assert_close(net(x, 2), net(x)[:2])


def test_clipped_noise_keeps_to_its_bound_and_to_the_actions_and_no_noise_draws_nothing():
    unit = torch.rand(1000) * 2 - 1
    noisy = with_clipped_noise(unit, 10.0, 0.2)
    assert noisy.abs().max() <= 1.0
    assert (noisy - unit).abs().max() <= 0.2 + 1e-6
    assert ((noisy - unit).abs() > 0.1).float().mean() > 0.8
    before = torch.get_rng_state()
    assert with_clipped_noise(unit, 0.0, 0.2) is unit
    assert torch.equal(torch.get_rng_state(), before)


def test_a_target_network_moves_the_fraction_tau_of_the_way_and_has_no_gradient():
    source, target = mlp(3, [5], 2), mlp(3, [5], 2).requires_grad_(False)
    before = [parameter.clone() for parameter in target.parameters()]
    polyak_update(target, source, 0.1)
    for old, parameter, aim in zip(before, target.parameters(), source.parameters(), strict=True):
        torch.testing.assert_close(parameter, old + 0.1 * (aim - old))
        assert parameter.grad_fn is None and not aim.equal(parameter)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("learner", [HPPO, PDQN, PADDPG, HSAC, IQL, TD3BC, DLPA])
def test_networks_for_actions_without_parameters_warn_of_nothing(learner):
    assert learner(specs_of(0, 0)).policy is not None


def test_a_layer_without_outputs_draws_no_random_numbers():
    torch.manual_seed(0)
    OutputLinear(3, 0)
    drawn = torch.rand(3)
    torch.manual_seed(0)
    torch.testing.assert_close(drawn, torch.rand(3), rtol=0.0, atol=0.0)


def test_a_network_leaves_its_input_as_it_is():
    state = -torch.rand(4, 3)
    kept = state.clone()
    mlp(3, [5, 5], 2)(state).sum().backward()
    assert state.equal(kept)


def test_products_of_vectors_say_how_far_a_heading_misses_a_target():
    geometry = PlaneGeometry(vectors=((1, 2), (3, 0)), origins=((1.0, 1.0), (0.0, 0.0)))
    products = VectorProducts(replace(specs_of(1), geometry=geometry))
    observation = torch.randn(5, 3, 4)
    seen = products(observation)
    first, second = observation[..., [1, 2]] - 1.0, observation[..., [3, 0]]
    length = first.norm(dim=-1) * second.norm(dim=-1)
    angle = torch.atan2(second[..., 1], second[..., 0]) - torch.atan2(first[..., 1], first[..., 0])
    torch.testing.assert_close(seen[..., :4], observation)
    torch.testing.assert_close(seen[..., 4], length * angle.cos())
    torch.testing.assert_close(seen[..., 5], length * angle.sin())
    assert seen.shape[-1] == products.num_outputs == 6


@pytest.mark.parametrize("geometry", [None, PlaneGeometry(vectors=((0, 1),))])
def test_products_are_refused_where_there_are_no_two_vectors(geometry):
    with pytest.raises(ValueError, match="declares no two vectors of the plane; use vector_products=false"):
        VectorProducts(replace(specs_of(1), geometry=geometry))
