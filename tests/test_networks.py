"""Networks that several learners share, and sampling from their output."""

import torch

from hpamdp.policies.shared.networks import sample_index


def test_indices_are_sampled_with_their_probabilities():
    torch.manual_seed(0)
    pi = torch.tensor([0.5, 0.3, 0.2])
    sampled = sample_index(pi.log().expand(20_000, 3))
    torch.testing.assert_close(sampled.bincount() / 20_000, pi, rtol=0.0, atol=0.015)
