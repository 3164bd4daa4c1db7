"""Time abstraction: which steps are decisions, and what each option earned from its decision to its end."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase, Transform, TransformedEnv

from hpamdp import keys


class DecisionTracker(Transform):
    """Write where an option is due and the semi-MDP view of the option that runs.

    At the root of a step `is_decision` `[*B, 1]` says that the agent chooses an option there. Under `next` it says that
    the option ended with this step, so the rows where `("next", "is_decision")` are the semi-MDP's transitions, with
    the discounted return `option_return` `[*B, 1]`, the length `option_steps` `[*B, 1]` and the observation
    `decision_observation` `[*B, observation_dim]` at which the option was chosen. Options last an episode. All state
    travels in the tensordict, so an option that spans two collected batches is accounted right.

    Source: Sutton, Precup and Singh 1999, *Between MDPs and semi-MDPs*, section 3.

    Args:
        gamma: discount of a step within the option.
    """

    def __init__(self, gamma: float = 1.0) -> None:
        super().__init__()
        self.gamma = gamma

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Declare the keys that the tracker writes."""
        shape, device = observation_spec.shape, observation_spec.device
        observation_spec[keys.IS_DECISION] = Binary(n=1, shape=(*shape, 1), dtype=torch.bool, device=device)
        observation_spec[keys.OPTION_RETURN] = Unbounded(shape=(*shape, 1), device=device)
        observation_spec[keys.OPTION_STEPS] = Unbounded(shape=(*shape, 1), dtype=torch.long, device=device)
        observation_spec[keys.DECISION_OBSERVATION] = observation_spec[keys.OBSERVATION].clone()
        return observation_spec

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        """Start an option in the environments that were reset; the others keep theirs."""
        observation = tensordict_reset.get(keys.OBSERVATION)
        is_new = torch.ones_like(tensordict_reset.get(keys.DONE))
        reset = None if tensordict is None else tensordict.get("_reset", None)
        fresh = {
            keys.IS_DECISION: is_new,
            keys.OPTION_RETURN: torch.zeros(is_new.shape, device=observation.device),
            keys.OPTION_STEPS: torch.zeros(is_new.shape, dtype=torch.long, device=observation.device),
            keys.DECISION_OBSERVATION: observation,
        }
        for name, value in fresh.items():
            held = None if reset is None else tensordict.get(name, None)
            tensordict_reset.set(name, value if held is None else torch.where(reset.view_as(is_new), value, held))
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        """Add this step to the option's account."""
        steps = tensordict.get(keys.OPTION_STEPS)
        reward = next_tensordict.get(keys.REWARD)
        next_tensordict.set(keys.IS_DECISION, next_tensordict.get(keys.DONE).clone())
        next_tensordict.set(keys.OPTION_RETURN, tensordict.get(keys.OPTION_RETURN) + self.gamma**steps * reward)
        next_tensordict.set(keys.OPTION_STEPS, steps + 1)
        next_tensordict.set(keys.DECISION_OBSERVATION, tensordict.get(keys.DECISION_OBSERVATION).clone())
        return next_tensordict


def with_decisions(env: EnvBase, gamma: float = 1.0) -> TransformedEnv:
    """Return the environment with its decisions tracked."""
    return TransformedEnv(env, DecisionTracker(gamma))
