"""A critic Q(s, option) of the options' returns, learned off-policy: semi-MDP Q-learning.

Source: Sutton, Precup and Singh 1999, *Between MDPs and semi-MDPs*, section 3.2. Exploration by the upper confidence
bounds of an ensemble: Chen, Sidor, Abbeel and Schulman 2017, arXiv 1706.01502.

If the selector decides when options end, it interrupts an option as soon as another one has a higher value (section 4
of the first source).

Differs from the sources:
- Q is an ensemble of networks, learned from a replay buffer of decisions, with target networks;
- values do not bootstrap past the end of an episode, also if a time limit ended it;
- while exploring, options are also interrupted at random, with the probability of a random option;
- updates draw from the later half of the decisions, except with a recurrent memory: learners were weaker before;
- which decisions a member of the ensemble learns from is drawn again at every update, not once for each decision;
- all members share one target, the mean of the target members;
- with `memory` the critics also see the observations at earlier decisions of the episode.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.devices import Device, checked_device
from hpamdp.policies.high_level.options import CARDS, MetaCriticOptions
from hpamdp.policies.masks import masked_values
from hpamdp.policies.shared.exploration import schedule
from hpamdp.policies.shared.exported_policy import exported_ensemble
from hpamdp.policies.shared.gradients import descend
from hpamdp.policies.shared.networks import EnsembleMLP, polyak_update
from hpamdp.policies.shared.perception import Perception
from hpamdp.policies.shared.replay import packed_states, replay_buffer, unpacked_states
from hpamdp.policies.shared.selector_memory import RemembersDecisions
from hpamdp.policies.shared.sequences import HistoryLinks, sample_with_past, states_of_past
from hpamdp.specs import PAMDPSpecs


class MetaCritic(RemembersDecisions):
    """Choose the option with the highest mean Q of an ensemble."""

    Options = MetaCriticOptions
    card = CARDS["MetaCritic"]

    def __init__(self, specs: PAMDPSpecs, *, device: Device = "cpu", options: Any = None, **settings: Any) -> None:
        super().__init__(specs)
        device = checked_device(self, device)
        self.options: MetaCriticOptions = MetaCriticOptions.of(options, settings)
        self.gamma = self.options.gamma
        self.set_perception(self.options)
        num_inputs = self.perception.specs.observation_dim
        self.critics = EnsembleMLP(self.options.num_members, num_inputs, self.options.hidden_dims, specs.num_options)
        self.target_perception = copy.deepcopy(self.perception).requires_grad_(False)
        self.links = HistoryLinks() if self.perception.is_recurrent else None
        self.target_critics = copy.deepcopy(self.critics).requires_grad_(False)
        self.num_decisions: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))
        self.to(device)
        self.optimizer = torch.optim.Adam(
            [*self.critics.parameters(), *self.perception.parameters()], lr=self.options.lr, fused=True
        )
        self.buffer = replay_buffer(self.options.buffer_size, device)

    def stateful(self) -> dict[str, Any]:
        """Return the optimizer and the replay buffer."""
        return {"critics": self.optimizer, "buffer": self.buffer}

    def exported(self) -> dict[str, Any] | None:
        """Return the critics, unless they see features: see `hpamdp.policies.shared.exported_policy`."""
        return exported_ensemble(self.critics) if self.perception.is_plain else None

    @property
    def epsilon(self) -> float:
        """Probability of a random option."""
        decisions_after_warmup = int(self.num_decisions) - self.options.warmup_decisions
        if decisions_after_warmup < 0:
            return 1.0
        if self.options.exploration == "ucb":
            return 0.0
        return schedule(decisions_after_warmup, self.options.epsilon_decisions, self.options.epsilon_final)

    @torch.no_grad()
    def select(self, td: TensorDictBase) -> Tensor:
        """Return the choices `[*B]`: the highest mean Q if the policy is greedy, else exploring."""
        observation = td.get(keys.OBSERVATION)
        mask = td.get(keys.OPTION_MASK, None)
        q = self.critics(self.seen(td).flatten(0, -2))
        value = q.mean(0)
        if not is_greedy():
            if self.options.exploration == "ucb":
                value = value + self.options.ucb_width * q.std(0, correction=0)
            is_random = torch.rand_like(value[:, :1]) < self.epsilon
            value = torch.where(is_random, torch.rand_like(value), value)
        value = masked_values(value, None if mask is None else mask.flatten(0, -2))
        return value.argmax(-1).reshape(observation.shape[:-1])

    @torch.no_grad()
    def ends(self, td: TensorDictBase) -> Tensor:
        """Return where another option has a higher value than the held one, bool `[*B]`; exploring, also at random.

        If the option with the highest Q never ended, the other options would collect no data.
        """
        value = self.critics(self.seen(td).flatten(0, -2)).mean(0).reshape(*td.batch_size, -1)
        is_worse = masked_values(value, td.get(keys.OPTION_MASK, None)).argmax(-1) != td.get(keys.OPTION)
        if is_greedy():
            return is_worse
        random_probability = 1.0 - (1.0 - self.epsilon) * (1.0 - float(self.practice.sum()))
        return is_worse | (torch.rand(is_worse.shape, device=is_worse.device, dtype=torch.float32) < random_probability)

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Store finished decisions `[N]` and, after the warm-up, make the updates that are due."""
        return self._learn(self.rows(decisions))

    def learn_from_options(self, steps: TensorDictBase) -> dict[str, float]:
        """Do as `learn` does. With a recurrent memory, sequences need the decisions of each environment."""
        is_end = steps.get(("next", keys.IS_DECISION)).squeeze(-1)
        if self.links is None or not is_end.any():
            return super().learn_from_options(steps)
        begins = self.begins(steps)
        previous = self.links(begins, is_end, self.buffer.write_count)
        rows = self.rows(steps[is_end])
        rows["begins"], rows["previous"] = begins[is_end], previous[is_end]
        return self._learn(rows)

    def _learn(self, rows: TensorDict) -> dict[str, float]:
        self.buffer.extend(packed_states(rows, self.specs))
        before = int(self.num_decisions)
        now = before + len(rows)
        self.num_decisions = self.num_decisions + len(rows)
        if now < self.options.warmup_decisions:
            return {}
        due = int(now * self.options.updates_per_decision) - int(before * self.options.updates_per_decision)
        return {**self.update(min(due, self.options.max_updates)), "epsilon": self.epsilon}

    def add_demonstrations(self, decisions: TensorDictBase) -> None:
        """Store the decisions. They do not count for the warm-up or the decay of epsilon."""
        self.buffer.extend(packed_states(self.rows(decisions), self.specs))

    def update(self, num_updates: int) -> dict[str, float]:
        """Make updates from the stored decisions."""
        losses = [self.update_critics(self._sample()) for _ in range(num_updates)]
        return {"critic": torch.stack(losses).mean().item()} if losses else {}

    def _sample(self) -> TensorDictBase:
        size = self.options.batch_size
        if self.links is None:
            return unpacked_states(self.buffer[self._later_half(size)], self.specs)
        num_past = self.options.burn_in + self.options.sequence_length
        return unpacked_states(sample_with_past(self.buffer, size, num_past), self.specs)

    def _later_half(self, num: int) -> Tensor:
        """Return the places `[num]` of random decisions, but none of the oldest: their returns are out of date.

        As many are left out as half of the own decisions. Those of a data set are the oldest.
        """
        num_written = self.buffer.write_count
        num_own = min(int(self.num_decisions), num_written)  # a resumed run may lack the buffer
        age = torch.randint(min(len(self.buffer), num_written - num_own // 2), (num,))
        return (num_written - 1 - age) % self.options.buffer_size

    def rows(self, decisions: TensorDictBase) -> TensorDict:
        """Return what is stored of decisions `[*B]`."""
        after, held = decisions.get("next"), self.held(decisions)
        rows = {
            "state": after.get(keys.DECISION_OBSERVATION),
            "option": decisions.get(keys.OPTION),
            "return": after.get(keys.OPTION_RETURN).squeeze(-1),
            "next_state": after.get(keys.OBSERVATION),
            "discount": self.next_discount(decisions),
        }
        if self.specs.has_option_mask:
            rows["next_option_mask"] = after.get(keys.OPTION_MASK)
        if held is not None:
            rows["memory"] = held
        return TensorDict(rows, batch_size=decisions.shape)

    def memory_of(self, rows: TensorDictBase, perception: Perception) -> Tensor | None:
        """Return the memory's states after sampled decisions, `[B, size]`, by a perception; None without memory."""
        if self.links is not None:
            return states_of_past(rows, perception, self.options.burn_in)
        return rows.get("memory", None)

    def features(self, rows: TensorDictBase) -> Tensor:
        """Return what the critics see of the states of sampled decisions, `[B, perception.specs.observation_dim]`."""
        return self.perception(rows["state"], self.memory_of(rows, self.perception), has_seen=True)

    def next_features(self, rows: TensorDictBase) -> Tensor:
        """Return what the target critics see of the next states, `[B, perception.specs.observation_dim]`."""
        return self.target_perception(rows["next_state"], self.memory_of(rows, self.target_perception))

    def update_critics(self, rows: TensorDictBase) -> Tensor:
        """Make one update of the critics from decisions `[batch_size]`; return the loss."""
        q = self.critics(self.features(rows))
        with torch.no_grad():
            next_q = self.target_critics(self.next_features(rows)).mean(0)
            next_value = masked_values(next_q, rows.get("next_option_mask", None)).amax(-1)
            target = (rows["return"] + rows["discount"] * next_value).unsqueeze(-1)
            is_chosen = torch.zeros_like(q[0]).scatter(-1, rows["option"].unsqueeze(-1), 1.0)
            # Each member sees a random half of the decisions, so that the members stay different.
            is_seen = torch.rand(*q.shape[:2], 1, device=q.device, dtype=torch.float32) < 0.5 if len(q) > 1 else 1.0
        loss = ((q - target).square() * is_chosen * is_seen).sum(-1).mean()
        descend(self.optimizer, loss)
        polyak_update(self.target_critics, self.critics, self.options.tau)
        polyak_update(self.target_perception, self.perception, self.options.tau)
        return loss.detach()
