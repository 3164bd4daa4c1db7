"""Time abstraction: which steps are decisions, and what each option earned from its decision to its end."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import Transform, TransformedEnv

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv


class DecisionTracker(Transform):
    """Write where an option is due and the semi-MDP view of the option that runs.

    At the root of a step `is_decision` `[*B, 1]` says that the agent chooses an option there. Under `next` it says that
    the option ended with this step, so the rows where `("next", "is_decision")` are the semi-MDP's transitions, with
    the discounted return `option_return` `[*B, 1]`, the length `option_steps` `[*B, 1]` and the observation
    `decision_observation` `[*B, observation_dim]` at which the option was chosen. `episode_return` and `episode_steps`
    `[*B, 1]` are the (undiscounted) sums since the episode began. All state travels in the tensordict, so an option
    that spans two collected batches is accounted right.

    Source: Sutton, Precup and Singh 1999, *Between MDPs and semi-MDPs*, section 3.

    Args:
        gamma: discount of a step within the option.
        option_length: steps after which an option ends, if its episode does not end before; None: it lasts an episode.
    """

    def __init__(self, gamma: float = 1.0, option_length: int | None = None) -> None:
        super().__init__()
        self.gamma, self.option_length = gamma, option_length

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declare the keys that the tracker writes."""
        shape, device = observation_spec.shape, observation_spec.device
        observation_spec[keys.IS_DECISION] = Binary(n=1, shape=(*shape, 1), dtype=torch.bool, device=device)
        for name in (keys.OPTION_RETURN, keys.EPISODE_RETURN):
            observation_spec[name] = Unbounded(shape=(*shape, 1), device=device)
        for name in (keys.OPTION_STEPS, keys.EPISODE_STEPS):
            observation_spec[name] = Unbounded(shape=(*shape, 1), dtype=torch.long, device=device)
        observation_spec[keys.DECISION_OBSERVATION] = observation_spec[keys.OBSERVATION].clone()
        return observation_spec

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        """Start an option everywhere; of environments that were not reset TorchRL keeps the rows as they were."""
        observation = tensordict_reset.get(keys.OBSERVATION)
        is_new = torch.ones_like(tensordict_reset.get(keys.DONE))
        nothing = torch.zeros(is_new.shape, device=observation.device)
        return tensordict_reset.update(
            {
                keys.IS_DECISION: is_new,
                keys.OPTION_RETURN: nothing,
                keys.OPTION_STEPS: nothing.long(),
                keys.DECISION_OBSERVATION: observation,
                keys.EPISODE_RETURN: nothing.clone(),
                keys.EPISODE_STEPS: nothing.long(),
            }
        )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        """Add this step to the accounts of the option and the episode."""
        reward, done = next_tensordict.get(keys.REWARD), next_tensordict.get(keys.DONE)
        total, steps = tensordict.get(keys.OPTION_RETURN), tensordict.get(keys.OPTION_STEPS)
        chosen_at = tensordict.get(keys.DECISION_OBSERVATION)
        if self.option_length is None:
            is_decision, chosen_at = done.clone(), chosen_at.clone()
        else:
            is_first = tensordict.get(keys.IS_DECISION)  # of its option, whose account it opens
            total, steps = _unless(is_first, total), _unless(is_first, steps)
            chosen_at = torch.where(is_first, tensordict.get(keys.OBSERVATION), chosen_at)
            is_decision = done | (steps + 1 >= self.option_length)
        next_tensordict.set(keys.IS_DECISION, is_decision)
        next_tensordict.set(keys.OPTION_RETURN, total + self.gamma**steps * reward)
        next_tensordict.set(keys.OPTION_STEPS, steps + 1)
        next_tensordict.set(keys.DECISION_OBSERVATION, chosen_at)
        next_tensordict.set(keys.EPISODE_RETURN, tensordict.get(keys.EPISODE_RETURN) + reward)
        next_tensordict.set(keys.EPISODE_STEPS, tensordict.get(keys.EPISODE_STEPS) + 1)
        return next_tensordict


def _unless(is_first: Tensor, account: Tensor) -> Tensor:
    return torch.where(is_first, torch.zeros_like(account), account)


class DecisionEnv(TransformedEnv):
    """An environment with its decisions tracked, whose `reset` takes what the environment's own takes."""

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        # As TorchRL's, which passes no more than the mask on.
        given = None if tensordict is None else tensordict.copy()
        given = self.transform._reset_env_preprocess(given)
        fresh = self.base_env._reset(given, **kwargs)
        self.base_env._complete_done(self.base_env.full_done_spec, fresh)
        return self.transform._reset(fresh.empty() if given is None else given, fresh)


def with_decisions(env: PAMDPEnv, gamma: float = 1.0, option_length: int | None = None) -> DecisionEnv:
    """Return the environment with its decisions tracked."""
    return DecisionEnv(env, DecisionTracker(gamma, option_length))
