"""An option policy trained together with the low level by policy gradient.

Source: Bacon, Harb and Precup 2017, *The Option-Critic Architecture*, arXiv 1609.05140, section on the policy over
options; clipped surrogate: Schulman et al. 2017, arXiv 1707.06347, equation 7.

Differs from the sources: the options' ends are the environment's or a fixed length, not learned; the advantage is the
option's return, bootstrapped where its episode goes on, less a learned value of the state.
"""

from __future__ import annotations

from typing import Annotated, Any

import torch
from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.policies.base import Selector, is_greedy
from hpamdp.policies.nets import draw_index, mlp
from hpamdp.specs import PAMDPSpecs

LOG_PROB = "option_log_prob"  # of the held option when it was chosen


class Actor(Selector):
    """Draw the option from a softmax over a network of the observation.

    Args:
        specs: of the problem.
        device: where the networks live.
        hidden_dims: of policy and value.
        gamma: discount of a step, for options that end before their episode.
        epochs, minibatch_size: passes over the decisions of an update, and decisions a step of them takes.
        clip: the surrogate stops rewarding ratios further from 1.
        entropy: weight of the entropy bonus.
        lr, max_grad_norm: of the steps.
    """

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        hidden_dims: list[PositiveInt],
        gamma: Annotated[float, Field(gt=0.0, le=1.0)],
        epochs: PositiveInt,
        minibatch_size: PositiveInt,
        clip: PositiveFloat,
        entropy: NonNegativeFloat,
        lr: PositiveFloat,
        max_grad_norm: PositiveFloat,
    ) -> None:
        super().__init__(specs)
        self.out_keys = [*self.out_keys, LOG_PROB]
        self.gamma, self.epochs, self.minibatch_size = gamma, epochs, minibatch_size
        self.clip, self.entropy, self.max_grad_norm = clip, entropy, max_grad_norm
        self.logits = mlp(specs.observation_dim, hidden_dims, specs.num_options)
        self.critic = mlp(specs.observation_dim, hidden_dims, 1)
        self.waiting: list[TensorDict] = []
        self.to(device)
        self.optimiser = torch.optim.Adam(self.parameters(), lr=lr, eps=1e-5, fused=True)

    def stateful(self) -> dict[str, Any]:
        """Return the optimiser."""
        return {"optimiser": self.optimiser}

    def get_extra_state(self) -> list[dict[str, Tensor]]:
        """Return the decisions that wait for the next update, for the state dict."""
        return [dict(rows.items()) for rows in self.waiting]

    def set_extra_state(self, state: list[dict[str, Tensor]]) -> None:
        """Take the decisions back from a state dict."""
        self.waiting = [TensorDict(rows, batch_size=rows["option"].shape) for rows in state]

    @torch.no_grad()
    def choose(self, td: TensorDictBase) -> dict[str, Tensor]:
        """Return options and log-probabilities `[*B]`: the likeliest where the policy is greedy, else draws."""
        log_probs = self.logits(td.get(keys.OBSERVATION)).log_softmax(-1)
        option = log_probs.argmax(-1) if is_greedy() else draw_index(log_probs)
        return {keys.OPTION: option, LOG_PROB: log_probs.gather(-1, option.unsqueeze(-1)).squeeze(-1)}

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Gather decisions; from a minibatch of them on, make `epochs` passes over them."""
        self.waiting.append(self._rows(decisions))
        if sum(len(rows) for rows in self.waiting) < self.minibatch_size:
            return {}
        rows, self.waiting = torch.cat(self.waiting), []
        advantage = rows["target"] - self.critic(rows["state"]).squeeze(-1).detach()
        rows["advantage"] = (advantage - advantage.mean()) / (advantage.std(correction=0) + 1e-6)
        steps = []
        for _ in range(self.epochs):
            order = torch.randperm(len(rows), device=rows.device).tensor_split(len(rows) // self.minibatch_size)
            steps += [self._update(rows[indices]) for indices in order]
        return {name: torch.stack([step[name] for step in steps]).mean().item() for name in steps[0]}

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
        ratio = (log_probs.gather(-1, rows["option"].unsqueeze(-1)).squeeze(-1) - rows["log_prob"]).exp()
        advantage = rows["advantage"]
        gain = torch.minimum(ratio * advantage, ratio.clamp(1.0 - self.clip, 1.0 + self.clip) * advantage).mean()
        entropy = -(log_probs.exp() * log_probs).sum(-1).mean()
        critic_loss = (self.critic(rows["state"]).squeeze(-1) - rows["target"]).square().mean()
        self.optimiser.zero_grad(set_to_none=True)
        (0.5 * critic_loss - gain - self.entropy * entropy).backward()
        torch.nn.utils.clip_grad_norm_(self.parameters(), self.max_grad_norm)
        self.optimiser.step()
        return {"critic": critic_loss.detach(), "entropy": entropy.detach()}
