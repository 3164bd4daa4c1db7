"""Networks that several learners share, and sampling from their output."""

import torch

from hpamdp.policies.shared.networks import EnsembleMLP, sample_index


def test_indices_are_sampled_with_their_probabilities():
    torch.manual_seed(0)
    pi = torch.tensor([0.5, 0.3, 0.2])
    sampled = sample_index(pi.log().expand(20_000, 3))
    torch.testing.assert_close(sampled.bincount() / 20_000, pi, rtol=0.0, atol=0.015)


def test_the_first_members_of_an_ensemble_give_alone_what_they_give_among_all():
    net = EnsembleMLP(3, 4, [8], 2)
    x = torch.randn(5, 4)
    torch.testing.assert_close(net(x, 2), net(x)[:2])
