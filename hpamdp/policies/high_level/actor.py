"""An option policy trained together with the low level by policy gradient.

Source: Bacon, Harb and Precup 2017, *The Option-Critic Architecture*, arXiv 1609.05140, section on the policy over
options; clipped surrogate: Schulman et al. 2017, arXiv 1707.06347, equation 7.

Differs from the sources: the options' ends are the environment's or a fixed length, not learned; the advantage is the
option's return, bootstrapped where its episode goes on, less a learned value of the state.
"""

from __future__ import annotations

import math

import torch
from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector, is_greedy
from hpamdp.policies.shared.fractions import PositiveFraction
from hpamdp.policies.shared.networks import mlp, sample_index
from hpamdp.policies.shared.on_policy import OnPolicy
from hpamdp.specs import PAMDPSpecs

LOG_PROB = "option_log_prob"  # of the held option when it was chosen


class Actor(OnPolicy, Selector):
    """Draw the option from a softmax over a network of the observation.

    Args:
        specs: of the problem.
        device: where the networks live.
        hidden_dims: of policy and value.
        gamma: discount of a step, for options that end before their episode.
        entropy: weight of the entropy bonus.
        lr: of the steps.
        epochs, minibatch_size, clip, max_grad_norm: as in `OnPolicy`, whose rows are decisions.
    """

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        hidden_dims: list[PositiveInt],
        gamma: PositiveFraction,
        epochs: PositiveInt,
        minibatch_size: PositiveInt,
        clip: PositiveFloat,
        entropy: NonNegativeFloat,
        lr: PositiveFloat,
        max_grad_norm: PositiveFloat,
    ) -> None:
        super().__init__(specs, epochs=epochs, minibatch_size=minibatch_size, clip=clip, max_grad_norm=max_grad_norm)
        self.out_keys = [*self.out_keys, LOG_PROB]
        self.gamma, self.entropy = gamma, entropy
        self.logits = mlp(specs.observation_dim, hidden_dims, specs.num_options)
        self.critic = mlp(specs.observation_dim, hidden_dims, 1)
        self.to(device)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr, eps=1e-5, fused=True)

    @torch.no_grad()
    def choose(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return options and log-probabilities `[*B]`: the likeliest where the policy is greedy, else draws."""
        log_probs = self.logits(td.get(keys.OBSERVATION)).log_softmax(-1)
        option = log_probs.argmax(-1) if is_greedy() else sample_index(log_probs)
        return {keys.OPTION: option, LOG_PROB: log_probs.gather(-1, option.unsqueeze(-1)).squeeze(-1)}

    def choose_uniformly(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return uniformly random options and their log-probabilities, `[*B]` each."""
        chosen = super().choose_uniformly(td)
        uniform = -math.log(self.specs.num_options)
        return chosen | {LOG_PROB: torch.full_like(chosen[keys.OPTION], uniform, dtype=torch.float32)}

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Gather decisions; from a minibatch of them on, make `epochs` passes over them."""
        rows = self.gather(self._rows(decisions))
        if rows is None:
            return {}
        rows["advantage"] = rows["target"] - self.critic(rows["state"]).squeeze(-1).detach()
        return self.make_passes(rows, self._update)

    @torch.no_grad()
    def _rows(self, decisions: TensorDictBase) -> TensorDict:
        after = decisions.get("next")
        goes_on = ~after.get(keys.TERMINATED).squeeze(-1)
        discount = self.gamma ** after.get(keys.OPTION_STEPS).squeeze(-1) * goes_on
        following = self.critic(after.get(keys.OBSERVATION)).squeeze(-1)
        rows = {
            "state": after.get(keys.DECISION_OBSERVATION),
            "option": decisions.get(keys.OPTION),
            "log_prob": decisions.get(LOG_PROB),
            "target": after.get(keys.OPTION_RETURN).squeeze(-1) + discount * following,
        }
        return TensorDict(rows, batch_size=decisions.shape)

    def _update(self, rows: TensorDictBase) -> dict[str, Tensor]:
        log_probs = self.logits(rows["state"]).log_softmax(-1)
        log_ratio = log_probs.gather(-1, rows["option"].unsqueeze(-1)).squeeze(-1) - rows["log_prob"]
        gain = self.surrogate(log_ratio, rows["advantage"]).mean()
        entropy = -(log_probs.exp() * log_probs).sum(-1).mean()
        critic_loss = (self.critic(rows["state"]).squeeze(-1) - rows["target"]).square().mean()
        self.optimizer_step(0.5 * critic_loss - gain - self.entropy * entropy)
        return {"critic": critic_loss.detach(), "entropy": entropy.detach()}
