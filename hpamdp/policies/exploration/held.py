"""Random actions that are held with their parameters for a random number of steps, most of them few and some many.

A random action at every step moves an agent as a random walk does: n steps lead sqrt(n) steps away. An action that is
held for n steps leads n steps away.

Source: Dabney, Ostrovski and Barreto, *Temporally-Extended epsilon-Greedy Exploration*, 2021, arXiv 2006.01782,
algorithm 1: the length of a held action has the zeta distribution, P(n) proportional to n^-mu.

Differs from the source:
- an action has parameters, which are drawn uniformly and held, too;
- a hold of length n lasts n steps. In algorithm 1 the action is taken once more;
- lengths above `longest` are drawn again, not cut;
- a hold ends early if its action is forbidden in a state;
- the learner explores at the other steps as it always does, in place of greedy steps.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp import keys
from hpamdp.acting import is_greedy
from hpamdp.devices import Device, checked_device
from hpamdp.policies.base import Learner
from hpamdp.policies.exploration.base import Exploration, Explored
from hpamdp.policies.exploration.options import CARDS, HeldOptions
from hpamdp.policies.masks import random_discrete
from hpamdp.policies.shared.exploration import schedule
from hpamdp.specs import PAMDPSpecs


def zeta_distribution(mu: float, longest: int) -> Tensor:
    """Return the probabilities of the lengths 1 to `longest`, proportional to n^-mu, float64 `[longest]`."""
    weight = torch.arange(1, longest + 1, dtype=torch.float64) ** -mu
    return weight / weight.sum()


class HeldPolicy(TensorDictModuleBase):
    """Acts by a learner's policy, except where a random action is held.

    The learner's policy is called at held steps, too, since it may have a memory. What is held travels in the
    tensordict. If each option has its own learner, a hold ends when a new option begins. Else it ends with the
    episode.

    Args:
        policy: the learner's.
        specs: of the learner.
        options: the settings.
    """

    def __init__(self, policy: TensorDictModuleBase, specs: PAMDPSpecs, options: HeldOptions) -> None:
        super().__init__()
        is_shared = specs.num_options > 0 and specs.held_option is None
        self.begins_key = keys.EPISODE_STEPS if is_shared else keys.IS_DECISION
        state: list[NestedKey] = [keys.HOLD_STEPS, keys.HOLD_DISCRETE, keys.HOLD_UNIT]
        self.in_keys = list(dict.fromkeys([*policy.in_keys, keys.OBSERVATION, self.begins_key, *state]))
        self.out_keys = [*policy.out_keys, keys.IS_HELD, *state]
        self.policy = policy
        self.specs = specs
        self.epsilon = nn.Buffer(torch.tensor(options.epsilon, dtype=torch.float32))
        cumulative = zeta_distribution(options.mu, options.longest).cumsum(0)
        self.cumulative = nn.Buffer(cumulative, persistent=False)

    @torch.no_grad()
    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write what the learner's policy writes, `IS_HELD`, bool `[*B]`, and what is held from here on."""
        steps = td.get(keys.HOLD_STEPS, None)
        observation = td.get(keys.OBSERVATION)
        if steps is None or is_greedy():
            steps = torch.zeros_like(observation[..., 0], dtype=torch.long)
        if is_greedy():
            td = self.policy(td.set(keys.IS_HELD, steps > 0))
            discrete, unit = torch.zeros_like(td.get(keys.DISCRETE)), torch.zeros_like(td.get(keys.PARAMETERS))
            td.set(keys.HOLD_STEPS, steps).set(keys.HOLD_DISCRETE, discrete)
            return td.set(keys.HOLD_UNIT, unit)
        shape, device = td.batch_size, observation.device
        begins = td.get(self.begins_key, None)
        if begins is not None:
            is_new = begins == 0 if self.begins_key == keys.EPISODE_STEPS else begins
            steps = steps.masked_fill(is_new.reshape(shape), 0)
        allowed = self.specs.allowed(observation, td.get(keys.ACTION_MASK, None))
        pair_mask = td.get(keys.PAIR_MASK, None)
        discrete = random_discrete(self.specs, shape, allowed, device, pair_mask)
        unit = 2.0 * torch.rand(*shape, self.specs.num_parameters, device=device, dtype=torch.float32) - 1.0
        begins_hold = torch.rand(shape, device=device, dtype=torch.float32) < self.epsilon
        length = self.lengths(shape)
        if td.get(keys.HOLD_DISCRETE, None) is not None:
            held = td.get(keys.HOLD_DISCRETE)
            goes_on = (steps > 0) & self._is_allowed(held, allowed, pair_mask)
            discrete = torch.where(_like(goes_on, held), held, discrete)
            unit = torch.where(goes_on.unsqueeze(-1), td.get(keys.HOLD_UNIT), unit)
        else:
            goes_on = torch.zeros_like(begins_hold)
        is_held = goes_on | begins_hold
        steps = torch.where(goes_on, steps, length) - 1
        td = self.policy(td.set(keys.IS_HELD, is_held))
        taken = torch.where(_like(is_held, discrete), discrete, td.get(keys.DISCRETE))
        parameters = torch.where(is_held.unsqueeze(-1), self.specs.from_unit(unit, td), td.get(keys.PARAMETERS))
        td.update({keys.ACTION: {"discrete": taken, "parameters": parameters}})
        td.set(keys.HOLD_STEPS, torch.where(is_held, steps, 0))
        td.set(keys.HOLD_DISCRETE, torch.where(_like(is_held, discrete), discrete, 0))
        return td.set(keys.HOLD_UNIT, torch.where(is_held.unsqueeze(-1), unit, 0.0))

    def lengths(self, shape: torch.Size) -> Tensor:
        """Return random numbers of steps to hold an action for, int64 `shape`."""
        drawn = torch.rand(shape, device=self.cumulative.device, dtype=torch.float64)
        place = torch.searchsorted(self.cumulative, drawn, right=True)
        return place.clamp(max=len(self.cumulative) - 1) + 1

    def _is_allowed(self, discrete: Tensor, allowed: Tensor | None, pair_mask: Tensor | None) -> Tensor:
        """Return whether discrete actions may be taken, bool `[*B]`.

        Args:
            discrete: int64 `[*B]`, or `[*B, num_components]`.
            allowed: the discrete actions that may be taken, bool `[*B, num_discrete]`; if None, all.
            pair_mask: those that go together, bool `[*B, num_discrete, num_discrete]`; if None, all.
        """
        places = self.specs.components.places(discrete)
        is_allowed = torch.ones(places.shape[:-1], dtype=torch.bool, device=places.device)
        if allowed is not None:
            is_allowed = allowed.gather(-1, places).all(-1)
        if pair_mask is not None:
            is_allowed = is_allowed & self.specs.components.may_follow(discrete, pair_mask).all(-1)
        return is_allowed


def _like(mask: Tensor, other: Tensor) -> Tensor:
    """Return a mask `[*B]` with as many dimensions as `other` `[*B, ...]`."""
    return mask.reshape(*mask.shape, *[1] * (other.ndim - mask.ndim))


class Held(Exploration):
    """Temporally extended epsilon-greedy exploration: random actions, held for a heavy-tailed number of steps."""

    Options = HeldOptions
    card = CARDS["Held"]
    exploring_keys: ClassVar[frozenset[NestedKey]] = frozenset({keys.HOLD_STEPS, keys.HOLD_DISCRETE, keys.HOLD_UNIT})

    def __init__(self, learner: Learner, *, device: Device = "cpu", options: Any = None, **settings: Any) -> None:
        super().__init__(learner)
        self.options: HeldOptions = HeldOptions.of(options, settings)
        self.policy = HeldPolicy(learner.policy, learner.specs, self.options)
        self.frames: Tensor = nn.Buffer(torch.zeros((), dtype=torch.long))
        learner.is_overruled = True
        self.to(checked_device(self, device))

    def acting_policy(self, learner: Learner) -> TensorDictModuleBase:
        """Return the policy that holds actions."""
        return self.policy

    def learn(self, batch: TensorDictBase, mask: Tensor) -> Explored:
        """Lower the probability of a hold, if it falls, and report the fraction of held steps."""
        options = self.options
        self.frames += mask.sum()
        if options.epsilon_final is not None and options.epsilon > 0.0:
            fraction = schedule(int(self.frames), options.epsilon_steps, options.epsilon_final / options.epsilon)
            self.policy.epsilon.fill_(options.epsilon * fraction)
        if not mask.any():
            return Explored(None, {})
        return Explored(None, {"held": batch.get(keys.IS_HELD)[mask].float().mean().item()})
