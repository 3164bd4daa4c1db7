"""Option-critic: values of options, learned within them, and terminations that follow the gradient of these values.

With `agent.termination=learned`, the held option o ends in state s with the learned probability beta(s, o), and the
next one is chosen epsilon-greedily by Q(s, o). Any learner can be the policy within the options.

Source: Bacon, Harb and Precup 2017, *The Option-Critic Architecture*, arXiv 1609.05140, algorithm 1 and theorem 2;
deliberation cost: Harb, Bacon, Klissarov and Precup 2018, *When Waiting is not an Option: Learning Options with a
Deliberation Cost*, arXiv 1709.04571, equation 10, as a margin of the advantage (their discount of the costs is 0).

Differs from the sources:
- the policies within the options are the agent's learners, with values and gradients of their own;
- Q and beta are learned from a replay buffer of steps, Q with a target network. Q(s, o) is learned itself, not as the
  mean of values of actions;
- beta has a network of its own. On Atari it shares the layers of Q;
- the value of a state is max_o Q(s, o), without the random choices;
- values do not bootstrap past the end of an episode, also if a time limit ended it;
- beta is learned by logistic regression, weighted by the size of the advantage. Its gradient has the sign of the
  source's. It does not vanish where wrong early values have driven beta close to 0 or 1;
- while exploring, beta is mixed with `initial_termination`, by the probability of a random option;
- if the policy is greedy, an option ends where beta is above 1/2, and no option is random. The authors' code samples
  terminations in tests, too, and chooses 5 % of the options at random.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.devices import Device, checked_device
from hpamdp.policies.high_level.options import CARDS, OptionCriticOptions
from hpamdp.policies.masks import masked_values, random_choice
from hpamdp.policies.shared.exploration import schedule
from hpamdp.policies.shared.gradients import descend
from hpamdp.policies.shared.networks import mlp, polyak_update
from hpamdp.policies.shared.replay import replay_buffer
from hpamdp.policies.shared.selector_memory import RemembersDecisions
from hpamdp.specs import PAMDPSpecs


class OptionCritic(RemembersDecisions):
    """Choose the option with the highest Q, and learn where it ends."""

    Options = OptionCriticOptions
    card = CARDS["OptionCritic"]

    def __init__(self, specs: PAMDPSpecs, *, device: Device = "cpu", options: Any = None, **settings: Any) -> None:
        super().__init__(specs)
        device = checked_device(self, device)
        self.options: OptionCriticOptions = OptionCriticOptions.of(options, settings)
        self.gamma = self.options.gamma
        self.set_perception(self.options)
        num_inputs = self.perception.specs.observation_dim
        self.critic = mlp(num_inputs, self.options.hidden_dims, specs.num_options)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.termination = mlp(num_inputs, self.options.hidden_dims, specs.num_options)
        last = self.termination[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight.mul_(0.01)
            last.bias.fill_(torch.tensor(self.options.initial_termination, dtype=torch.float32).logit().item())
        self.num_steps: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))
        self.to(device)
        self.optimizers = {
            "critic": torch.optim.Adam(self.critic.parameters(), lr=self.options.lr, fused=True),
            "termination": torch.optim.Adam(self.termination.parameters(), lr=self.options.termination_lr, fused=True),
        }
        self.buffer = replay_buffer(self.options.buffer_size, device)

    def stateful(self) -> dict[str, Any]:
        """Return the optimizers and the replay buffer."""
        return {**self.optimizers, "buffer": self.buffer}

    @property
    def epsilon(self) -> float:
        """Probability of a random option."""
        steps_after_warmup = int(self.num_steps) - self.options.warmup_steps
        if steps_after_warmup < 0:
            return 1.0
        return schedule(steps_after_warmup, self.options.epsilon_steps, self.options.epsilon_final)

    @torch.no_grad()
    def select(self, td: TensorDictBase) -> Tensor:
        """Return the options with the highest Q, `[*B]`; while exploring, some are random."""
        mask = td.get(keys.OPTION_MASK, None)
        best = masked_values(self.critic(self.seen(td)), mask).argmax(-1)
        if is_greedy():
            return best
        is_random = torch.rand(best.shape, device=best.device, dtype=torch.float32) < self.epsilon
        return torch.where(is_random, random_choice(best.shape, self.specs.num_options, mask, best.device), best)

    @torch.no_grad()
    def ends(self, td: TensorDictBase) -> Tensor:
        """Return where the held option ends, bool `[*B]`: sampled, or where beta > 1/2 if the policy is greedy.

        Forbidden options always end.
        """
        # If one option never terminated, the others would collect no data. Their values would stay wrong, and so would
        # the terminations learned from them. Therefore beta counts only as much as Q does in the choice.
        random_probability = 0.0 if is_greedy() else 1.0 - (1.0 - self.epsilon) * (1.0 - float(self.practice.sum()))
        beta = self.beta(self.seen(td), td.get(keys.OPTION), td.get(keys.OPTION_MASK, None), random_probability)
        return beta > 0.5 if is_greedy() else torch.rand_like(beta) < beta

    def learn_from_steps(self, batch: TensorDictBase) -> dict[str, float]:
        """Store the steps `[*B, T]` and, after the warm-up, make the updates that are due."""
        rows = self.rows(batch).flatten()
        self.buffer.extend(rows)
        before = int(self.num_steps)
        now = before + len(rows)
        self.num_steps = self.num_steps + len(rows)
        if now < self.options.warmup_steps:
            return {}
        due = int(now * self.options.updates_per_step) - int(before * self.options.updates_per_step)
        history: dict[str, list[Tensor]] = {}
        for _ in range(min(due, self.options.max_updates)):
            sample = self.buffer.sample(self.options.batch_size)
            history.setdefault("critic", []).append(self.update_critic(sample))
            if self.decides_ends:
                history.setdefault("termination", []).append(self.update_termination(sample))
        scalars = {name: torch.stack(values).mean().item() for name, values in history.items()}
        return {**scalars, "epsilon": self.epsilon}

    def rows(self, batch: TensorDictBase) -> TensorDict:
        """Return what is stored of a batch `[*B, T]`; states are features, `discount` is 0 where an episode ends."""
        after = batch.get("next")
        done = after.get(keys.DONE).squeeze(-1)
        held = self.held(batch)
        state = self.perception(batch.get(keys.OBSERVATION), held)
        if held is not None:  # at a decision, the memory has seen the observation already
            at_decision = self.perception(batch.get(keys.OBSERVATION), held, has_seen=True)
            state = torch.where(batch.get(keys.IS_DECISION), at_decision, state)
        rows = {
            "state": state,
            "option": batch.get(keys.OPTION),
            "reward": after.get(keys.REWARD).squeeze(-1),
            "next_state": self.perception(after.get(keys.OBSERVATION), held),
            "discount": self.gamma * (~done).float(),
            "is_ended": after.get(keys.OPTION_ENDED).squeeze(-1) if keys.OPTION_ENDED in after.keys() else done,
        }
        if self.specs.has_option_mask:
            rows["next_option_mask"] = after.get(keys.OPTION_MASK)
        return TensorDict(rows, batch_size=batch.shape)

    def beta(self, state: Tensor, option: Tensor, mask: Tensor | None, random_probability: float = 0.0) -> Tensor:
        """Return the probabilities `[*B]` that options end in states; 1 for forbidden options.

        Args:
            state: what the networks see, `[*B, perception.specs.observation_dim]`.
            option: the held options, `[*B]`.
            mask: the options that may be chosen, bool `[*B, num_options]`. If None, all may.
            random_probability: weight of `initial_termination` in the mixture, in [0, 1].
        """
        beta = _of_option(self.termination(state), option).sigmoid()
        beta = (1.0 - random_probability) * beta + random_probability * self.options.initial_termination
        return beta if mask is None else torch.where(_of_option(mask, option), beta, 1.0)

    def target(self, rows: TensorDictBase) -> Tensor:
        """Return r + discount ((1 - beta) Q'(s', o) + beta max Q'(s', .)), `[B]`.

        If the selector does not decide when options end, beta is 1 if the option has ended, else 0.
        """
        with torch.no_grad():
            q = self.target_critic(rows["next_state"])
            held = _of_option(q, rows["option"])
            mask = rows.get("next_option_mask", None)
            beta = rows["is_ended"].float()
            if self.decides_ends:
                beta = self.beta(rows["next_state"], rows["option"], mask)
            next_value = held.lerp(masked_values(q, mask).amax(-1), beta)
            return rows["reward"] + rows["discount"] * next_value

    def update_critic(self, rows: TensorDictBase) -> Tensor:
        """Make one update of Q from steps `[batch_size]`; return the loss."""
        q = _of_option(self.critic(rows["state"]), rows["option"])
        loss = (q - self.target(rows)).square().mean()
        descend(self.optimizers["critic"], loss)
        polyak_update(self.target_critic, self.critic, self.options.tau)
        return loss.detach()

    def update_termination(self, rows: TensorDictBase) -> Tensor:
        """Make one update of the terminations from steps `[batch_size]`; return their mean probability.

        The loss is logistic: an option should end where going on has a negative advantage. Each row is weighted by the
        size of the advantage. Forbidden options always end and do not count.
        """
        state, option, mask = rows["next_state"], rows["option"], rows.get("next_option_mask", None)
        with torch.no_grad():
            q = self.critic(state)
            best = masked_values(q, mask).amax(-1)
            advantage = _of_option(q, option) - best + self.options.deliberation_cost
            is_open = rows["discount"] > 0.0
            if mask is not None:
                is_open &= _of_option(mask, option)
        logit = _of_option(self.termination(state), option)
        should_end = (advantage < 0.0).float()
        loss = F.binary_cross_entropy_with_logits(logit, should_end, weight=advantage.abs() * is_open)
        descend(self.optimizers["termination"], loss)
        return logit.detach().sigmoid().mean()


def _of_option(table: Tensor, option: Tensor) -> Tensor:
    """Return the entries `[*B]` of a table `[*B, num_options]` for options `[*B]`."""
    return table.gather(-1, option.unsqueeze(-1)).squeeze(-1)
