"""Option-critic: values of options, learned within them, and terminations that follow the gradient of these values.

With `agent.termination=learned`, the held option o ends in state s with the learned probability beta(s, o), and the
next one is chosen epsilon-greedily by Q(s, o). Any learner can be the policy within the options.

Source: Bacon, Harb and Precup 2017, *The Option-Critic Architecture*, arXiv 1609.05140, algorithm 1 and theorem 2;
deliberation cost: Harb, Bacon, Klissarov and Precup 2018, *When Waiting is not an Option: Learning Options with a
Deliberation Cost*, arXiv 1709.04571, equation 10, as a margin of the advantage (their discount of the costs is 0).

Differs from the sources:
- the policies within the options are the agent's learners, with values and gradients of their own;
- Q and beta are learned from a replay buffer of steps, Q with a target network;
- the value of a state is max_o Q(s, o), without the share of random choices;
- where a time limit ends an episode, nothing follows;
- beta is learned by logistic regression, weighed by the size of the advantage: its gradient has the sign of the
  source's, but does not vanish where beta is sure and wrong, as it can be from values learned early;
- exploring, an option ends with `initial_termination` as often as options are random, else with beta;
- greedily, an option ends where beta is above 1/2.
"""

from __future__ import annotations

import copy
from typing import Any, ClassVar

import torch
from pydantic import NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torch.nn import functional as F
from torchrl.data import LazyTensorStorage, ReplayBuffer

from hpamdp import keys
from hpamdp.policies.base import Selector, is_greedy
from hpamdp.policies.masks import masked_values, random_choice
from hpamdp.policies.shared.exploration import linear_schedule
from hpamdp.policies.shared.networks import mlp, polyak_update
from hpamdp.policies.shared.replay import first_multiple
from hpamdp.settings import Fraction, LearningRate, PositiveFraction
from hpamdp.specs import PAMDPSpecs


class OptionCritic(Selector):
    """Choose the option with the highest Q, and learn where it ends.

    Args:
        specs: of the problem.
        device: where the networks live.
        hidden_dims: of the option values and of the terminations.
        gamma: discount of an environment step.
        deliberation_cost: margin by which another option must be better for the held one to end, in units of the
            return; 0: the option-critic of 2017, whose options tend to end at every step.
        initial_termination: probability that an option ends with a step, at the start; also with the probability of a
            random option, and always while options are uniform.
        epsilon_final, epsilon_steps: the probability of a random option falls linearly from 1 to `epsilon_final` over
            the `epsilon_steps` steps after the warm-up.
        buffer_size: steps that are stored.
        batch_size: steps in an update.
        updates_per_step, max_updates: updates for each step, and at most in one call of `learn_from_steps`.
        warmup_steps: steps with random options before the first update.
        lr, termination_lr: learning rates of Adam.
        tau: step of the target network towards the learned one after each update.
    """

    ends_options: ClassVar[bool] = True
    modes: ClassVar[tuple[str, ...]] = ("train",)

    num_steps: Tensor

    def __init__(
        self,
        specs: PAMDPSpecs,
        device: torch.device,
        *,
        hidden_dims: list[PositiveInt],
        gamma: PositiveFraction,
        deliberation_cost: NonNegativeFloat,
        initial_termination: PositiveFraction,
        epsilon_final: Fraction,
        epsilon_steps: NonNegativeInt,
        buffer_size: PositiveInt,
        batch_size: PositiveInt,
        updates_per_step: PositiveFloat,
        max_updates: PositiveInt,
        warmup_steps: NonNegativeInt,
        lr: LearningRate,
        termination_lr: LearningRate,
        tau: PositiveFraction,
    ) -> None:
        super().__init__(specs)
        if batch_size > buffer_size:
            raise ValueError(f"batch_size={batch_size}: must be at most {buffer_size=}")
        if initial_termination >= 1.0:
            raise ValueError(f"initial_termination={initial_termination}: must be less than 1")
        self.gamma = gamma
        self.initial_termination = initial_termination
        self.deliberation_cost = deliberation_cost
        self.epsilon_final = epsilon_final
        self.epsilon_steps = epsilon_steps
        self.batch_size = batch_size
        self.updates_per_step = updates_per_step
        self.max_updates = max_updates
        self.warmup_steps = warmup_steps
        self.tau = tau
        self.critic = mlp(specs.observation_dim, hidden_dims, specs.num_options)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.termination = mlp(specs.observation_dim, hidden_dims, specs.num_options)
        last = self.termination[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():
            last.weight.mul_(0.01)
            last.bias.fill_(torch.tensor(initial_termination, dtype=torch.float32).logit().item())
        self.register_buffer("num_steps", torch.zeros((), dtype=torch.long))
        self.to(device)
        self.optimizers = {
            "critic": torch.optim.Adam(self.critic.parameters(), lr=lr, fused=True),
            "termination": torch.optim.Adam(self.termination.parameters(), lr=termination_lr, fused=True),
        }
        self.buffer = ReplayBuffer(storage=LazyTensorStorage(buffer_size, device=device))

    def stateful(self) -> dict[str, Any]:
        """Return the optimizers and the replay buffer."""
        return {**self.optimizers, "buffer": self.buffer}

    def replay_rows(self, batch: TensorDictBase) -> dict[str, TensorDictBase]:
        """Return the rows that the buffer would store of a batch `[*B, T]`."""
        return {"buffer": self._rows(batch).flatten()}

    @property
    def epsilon(self) -> float:
        """Probability of a random option."""
        steps_after_warmup = int(self.num_steps) - self.warmup_steps
        if steps_after_warmup < 0:
            return 1.0
        return linear_schedule(steps_after_warmup, self.epsilon_steps, self.epsilon_final)

    @torch.no_grad()
    def select(self, td: TensorDictBase) -> Tensor:
        """Return the choices `[*B]`: the highest Q if the policy is greedy, else a random option at times."""
        mask = td.get(keys.OPTION_MASK, None)
        best = masked_values(self.critic(td.get(keys.OBSERVATION)), mask).argmax(-1)
        if is_greedy():
            return best
        is_random = torch.rand(best.shape, device=best.device, dtype=torch.float32) < self.epsilon
        return torch.where(is_random, random_choice(best.shape, self.specs.num_options, mask, best.device), best)

    @torch.no_grad()
    def ends(self, td: TensorDictBase) -> Tensor:
        """Return where the held option ends, bool `[*B]`: sampled, or where it is likely if the policy is greedy.

        It does where it is forbidden.
        """
        # An option that never ends leaves no steps to the others, and their values as wrong as those that beta was
        # learned from. So beta counts as much as the values do in the choice.
        random_share = 0.0 if is_greedy() else 1.0 if self.is_uniform else self.epsilon
        beta = self._beta(td.get(keys.OBSERVATION), td.get(keys.OPTION), td.get(keys.OPTION_MASK, None), random_share)
        return beta > 0.5 if is_greedy() else torch.rand_like(beta) < beta

    def decisions_to_update(self) -> dict[str, int]:
        """Return the length of the warm-up and the number of steps for one update; this selector learns from steps."""
        return {"warmup_steps": self.warmup_steps, "updates_per_step": first_multiple(self.updates_per_step)}

    def learn_from_steps(self, batch: TensorDictBase) -> dict[str, float]:
        """Store the steps and, after the warm-up, make the updates that are due from stored ones."""
        rows = self._rows(batch).flatten()
        self.buffer.extend(rows)
        before = int(self.num_steps)
        now = before + len(rows)
        self.num_steps = self.num_steps + len(rows)
        if now < self.warmup_steps:
            return {}
        due = int(now * self.updates_per_step) - int(before * self.updates_per_step)
        history: dict[str, list[Tensor]] = {}
        for _ in range(min(due, self.max_updates)):
            sample = self.buffer.sample(self.batch_size)
            history.setdefault("critic", []).append(self._update_critic(sample))
            if self.decides_ends:
                history.setdefault("termination", []).append(self._update_termination(sample))
        scalars = {name: torch.stack(values).mean().item() for name, values in history.items()}
        return {**scalars, "epsilon": self.epsilon}

    def _rows(self, batch: TensorDictBase) -> TensorDict:
        """Return what is stored of a batch `[*B, T]`; `discount` is 0 where the episode ended."""
        after = batch.get("next")
        done = after.get(keys.DONE).squeeze(-1)
        rows = {
            "state": batch.get(keys.OBSERVATION),
            "option": batch.get(keys.OPTION),
            "reward": after.get(keys.REWARD).squeeze(-1),
            "next_state": after.get(keys.OBSERVATION),
            "discount": self.gamma * (~done).float(),
            "is_ended": after.get(keys.OPTION_ENDED).squeeze(-1) if keys.OPTION_ENDED in after.keys() else done,
        }
        if self.specs.has_option_mask:
            rows["next_option_mask"] = after.get(keys.OPTION_MASK)
        return TensorDict(rows, batch_size=batch.shape)

    def _beta(self, state: Tensor, option: Tensor, mask: Tensor | None, random_share: float = 0.0) -> Tensor:
        """Return the probabilities `[*B]` that options end: 1 where they are forbidden.

        Args:
            state: where, `[*B, observation_dim]`.
            option: `[*B]`.
            mask: the options that may be chosen, bool `[*B, num_options]`; None: all.
            random_share: of `initial_termination` in the probabilities, in [0, 1].
        """
        beta = _of_option(self.termination(state), option).sigmoid()
        beta = (1.0 - random_share) * beta + random_share * self.initial_termination
        return beta if mask is None else torch.where(_of_option(mask, option), beta, 1.0)

    def _target(self, rows: TensorDictBase) -> Tensor:
        """Return r + discount ((1 - beta) Q'(s', o) + beta max Q'(s', .)), `[B]`.

        Where others decide when options end, beta is 1 or 0: whether this one has.
        """
        with torch.no_grad():
            q = self.target_critic(rows["next_state"])
            held = _of_option(q, rows["option"])
            mask = rows.get("next_option_mask", None)
            beta = rows["is_ended"].float()
            if self.decides_ends:
                beta = self._beta(rows["next_state"], rows["option"], mask)
            following = held.lerp(masked_values(q, mask).amax(-1), beta)
            return rows["reward"] + rows["discount"] * following

    def _update_critic(self, rows: TensorDictBase) -> Tensor:
        """Make one update of Q from steps `[batch_size]`; return the loss."""
        q = _of_option(self.critic(rows["state"]), rows["option"])
        loss = (q - self._target(rows)).square().mean()
        self.optimizers["critic"].zero_grad(set_to_none=True)
        loss.backward()
        self.optimizers["critic"].step()
        polyak_update(self.target_critic, self.critic, self.tau)
        return loss.detach()

    def _update_termination(self, rows: TensorDictBase) -> Tensor:
        """Make one step of the terminations against the advantage of going on; return their mean probability.

        The loss is the logistic one: of an end where going on is better, of no end where it is not, each weighed by how
        much. Forbidden options end in any case.

        Args:
            rows: steps `[batch_size]`.
        """
        state, option, mask = rows["next_state"], rows["option"], rows.get("next_option_mask", None)
        with torch.no_grad():
            q = self.critic(state)
            best = masked_values(q, mask).amax(-1)
            advantage = _of_option(q, option) - best + self.deliberation_cost
            is_open = rows["discount"] > 0.0
            if mask is not None:
                is_open &= _of_option(mask, option)
        logit = _of_option(self.termination(state), option)
        should_end = (advantage < 0.0).float()
        loss = F.binary_cross_entropy_with_logits(logit, should_end, weight=advantage.abs() * is_open)
        self.optimizers["termination"].zero_grad(set_to_none=True)
        loss.backward()
        self.optimizers["termination"].step()
        return logit.detach().sigmoid().mean()


def _of_option(table: Tensor, option: Tensor) -> Tensor:
    """Return the entries `[*B]` of a table `[*B, num_options]` for options `[*B]`."""
    return table.gather(-1, option.unsqueeze(-1)).squeeze(-1)
