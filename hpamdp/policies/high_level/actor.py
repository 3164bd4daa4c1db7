"""A policy over options, trained together with the low level by policy gradient.

Source: Bacon, Harb and Precup 2017, *The Option-Critic Architecture*, arXiv 1609.05140, section on the policy over
options; clipped surrogate: Schulman et al. 2017, *Proximal Policy Optimization Algorithms*, arXiv 1707.06347,
equation 7.

Differs from the sources:
- the environment or a fixed length ends options; the ends are not learned;
- decisions with uniform options are weighted by the ratio of the policy's probability to the uniform one. The clip is
  around the policy at the time of the decision (the decoupled objective of Hilton, Cobbe and Schulman 2021, *Batch
  size-invariance for policy optimization*, arXiv 2110.00641);
- the gradients of policy, critic and their common perception are clipped separately, since returns may be of any size;
- with `memory` policy and value also see the observations at earlier decisions of the episode;
- the advantage is the option's return minus a learned value of the state. It bootstraps if the episode goes on, but not
  past a time limit;
- the advantages of the decisions in an update are normalised to mean 0 and standard deviation 1;
- if the policy is greedy, it chooses the most likely option.

TorchRL's `ClipPPOLoss` computes the same loss and gradients. It needs both networks wrapped as tensordict modules and
takes 1.3 times as long for an update of 1,024 decisions on one CPU core (1.6 times for 256). H-PPO needs
`OnPolicy.surrogate` anyway, to clip the ratios of two policies separately.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.devices import Device, checked_device
from hpamdp.policies.high_level.options import CARDS, ActorOptions
from hpamdp.policies.masks import masked_logits, sample_index
from hpamdp.policies.shared.networks import mlp
from hpamdp.policies.shared.on_policy import OnPolicy, mean_scalars, normalised
from hpamdp.policies.shared.selector_memory import RemembersDecisions
from hpamdp.policies.shared.sequences import sequence_starts
from hpamdp.specs import PAMDPSpecs

# Of the held option at its decision, float32 [*B] each.
LOG_PROB = "option_log_prob"  # by the policy, also if the option was chosen uniformly
WEIGHT = "option_weight"  # ratio of its probability by the policy to the probability with which it was chosen
ALLOWED = "option_allowed"  # the options that were allowed, bool [*B, num_options], if the problem has an option mask


class Actor(OnPolicy, RemembersDecisions):
    """Sample the option from a softmax over the outputs of a network."""

    Options = ActorOptions
    card = CARDS["Actor"]

    def __init__(self, specs: PAMDPSpecs, *, device: Device = "cpu", options: Any = None, **settings: Any) -> None:
        super().__init__(specs)
        self.options: ActorOptions = ActorOptions.of(options, settings)
        self.out_keys = [*self.out_keys, LOG_PROB, WEIGHT, *([ALLOWED] if specs.has_option_mask else [])]
        self.gamma = self.options.gamma
        self.set_perception(self.options)
        num_inputs = self.perception.specs.observation_dim
        self.logits = mlp(num_inputs, self.options.hidden_dims, specs.num_options)
        self.critic = mlp(num_inputs, self.options.hidden_dims, 1)
        self.to(checked_device(self, device))
        self.optimizer = torch.optim.Adam(self.parameters(), lr=self.options.lr, eps=1e-5, fused=True)

    @torch.no_grad()
    def select(self, td: TensorDictBase) -> Tensor:
        """Return the most likely options `[*B]` if the policy is greedy, else samples."""
        log_probs = self._log_probs(td)
        return log_probs.argmax(-1) if is_greedy() else sample_index(log_probs)

    @torch.no_grad()
    def held_with(self, td: TensorDictBase, option: Tensor) -> dict[str, Tensor]:
        """Return the log-probabilities and weights of the options, `[*B]` each, and what is remembered."""
        log_probs, place = self._log_probs(td), option.unsqueeze(-1)
        policy = log_probs.exp()
        weights = policy / self.exploring_probabilities(td, policy)
        held = {LOG_PROB: log_probs.gather(-1, place).squeeze(-1), WEIGHT: weights.gather(-1, place).squeeze(-1)}
        if self.specs.has_option_mask:
            held[ALLOWED] = td.get(keys.OPTION_MASK).clone()
        return {**held, **super().held_with(td, option)}

    @torch.no_grad()
    def option_probabilities(self, td: TensorDictBase) -> Tensor:
        """Return the policy's probabilities of the options, `[*B, num_options]`."""
        return self._log_probs(td).exp()

    def _log_probs(self, td: TensorDictBase) -> Tensor:
        """Return the policy's log-probabilities `[*B, num_options]`."""
        logits = masked_logits(self.logits(self.seen(td)), td.get(keys.OPTION_MASK, None))
        return logits.log_softmax(-1)

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Gather decisions; as soon as there is a minibatch of them, make `epochs` passes over them."""
        return self._learn(self.rows(decisions))

    def learn_from_options(self, steps: TensorDictBase) -> dict[str, float]:
        """Do as `learn` does. With a recurrent memory, sequences need the decisions of each environment."""
        is_end = steps.get(("next", keys.IS_DECISION)).squeeze(-1)
        if not self.perception.is_recurrent or not is_end.any():
            return super().learn_from_options(steps)
        decisions = steps[is_end]
        rows = self.rows(decisions)
        rows["begins"] = self.begins(decisions)
        rows["starts"] = sequence_starts(self.begins(steps), is_end, self.options.sequence_length)
        return self._learn(rows)

    def _learn(self, new: TensorDict) -> dict[str, float]:
        rows = self.gather(new)
        if rows is None:
            return {}
        rows["advantage"] = rows["target"] - self.critic(self.features(rows)).squeeze(-1).detach()
        rows["advantage"] = normalised(rows["advantage"])
        return mean_scalars([self.gradient_step(self.loss, minibatch) for minibatch in self.minibatches(rows)])

    def clipped_apart(self) -> Sequence[Iterable[Tensor]]:
        """Return what the critic's loss reaches, which grows with the returns."""
        return self.critic.parameters(), self.perception.parameters()

    @torch.no_grad()
    def rows(self, decisions: TensorDictBase) -> TensorDict:
        """Return what an update needs of decisions `[N]`; `target` is that of the value."""
        after = decisions.get("next")
        held = self.held(decisions)
        next_value = self.critic(self.perception(after.get(keys.OBSERVATION), held)).squeeze(-1)
        rows = {
            "state": after.get(keys.DECISION_OBSERVATION),
            "option": decisions.get(keys.OPTION),
            "log_prob": decisions.get(LOG_PROB),
            "weight": decisions.get(WEIGHT),
            "target": after.get(keys.OPTION_RETURN).squeeze(-1) + self.next_discount(decisions) * next_value,
        }
        if held is not None:
            rows["memory"] = held
        if self.specs.has_option_mask:
            rows["allowed"] = decisions.get(ALLOWED)
        return TensorDict(rows, batch_size=decisions.shape)

    def features(self, rows: Mapping[str, Tensor]) -> Tensor:
        """Return what policy and critic see of rows `[N]`, `[N, perception.specs.observation_dim]`."""
        if self.perception.is_recurrent:
            return self.perception.of_sequences(*(rows[name] for name in ("state", "memory", "begins", "starts")))
        return self.perception(rows["state"], rows.get("memory", None), has_seen=True)

    def loss(self, rows: Mapping[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of policy and critic on decisions `[B]`, and scalars to log."""
        features = self.features(rows)
        log_probs = masked_logits(self.logits(features), rows.get("allowed", None)).log_softmax(-1)
        log_prob = log_probs.gather(-1, rows["option"].unsqueeze(-1)).squeeze(-1)
        surrogate = (rows["weight"] * self.surrogate(log_prob - rows["log_prob"], rows["advantage"])).mean()
        entropy = -(log_probs.exp() * log_probs).sum(-1).mean()
        critic_loss = (rows["weight"] * (self.critic(features).squeeze(-1) - rows["target"]).square()).mean()
        loss = 0.5 * critic_loss - surrogate - self.options.entropy * entropy
        return loss, {"critic": critic_loss, "entropy": entropy}
