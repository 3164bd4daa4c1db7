"""The contract of a data set to learn from, and what its transitions need beside those that were recorded."""

from __future__ import annotations

import torch
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.data.errors import DataError

TRAJECTORY = ("collector", "traj_ids")  # the number of a row's episode, where TorchRL's collectors write it

_REQUIRED = (
    TRAJECTORY,
    keys.OBSERVATION,
    keys.DISCRETE,
    keys.PARAMETERS,
    keys.IS_DECISION,
    ("next", keys.OBSERVATION),
    ("next", keys.REWARD),
    ("next", keys.DONE),
    ("next", keys.TERMINATED),
    ("next", keys.TRUNCATED),
    ("next", keys.IS_DECISION),
)


class Demonstrations:
    """Transitions to learn from, as if they had been collected from the environment at hand.

    For a recording of your own, write a subclass and choose it in `conf/data`. Its constructor takes the environment
    as `env`, beside the options of its yaml, and passes its transitions to this one. Options last a whole episode.

    Args:
        transitions: `[M]`, one episode after another, with ascending episode numbers under `TRAJECTORY`. At the root
            `observation`, the action leaves, `is_decision` and, where the agent chooses options, `option`; under
            `next` `observation`, `reward`, `done`, `terminated`, `truncated` and `is_decision`; shapes and types are
            the environment's.
        device: where the batch is kept.

    Attributes:
        batch: the transitions `[1, M]`, with the sums that `with_option_sums` adds.

    Raises:
        DataError: a key is missing, or the episodes are out of order.
    """

    batch: TensorDict

    def __init__(self, transitions: TensorDict, device: torch.device | None = None) -> None:
        present = set(transitions.keys(True, True))
        missing = [name for name in _REQUIRED if name not in present]
        if missing:
            raise DataError(f"the transitions lack {', '.join(map(_dotted, missing))}")
        if (transitions[TRAJECTORY].diff() < 0).any():
            raise DataError(f"the transitions' episode numbers ({_dotted(TRAJECTORY)}) must be in ascending order")
        batch = with_option_sums(transitions).unsqueeze(0)
        self.batch = batch if device is None else batch.to(device)

    def discounted(self, gamma: float) -> TensorDict:
        """Return `batch` with option returns that are discounted by `gamma` a step, as a selector asks for."""
        return self.batch if gamma == 1.0 else with_option_sums(self.batch.squeeze(0), gamma).unsqueeze(0)


def _dotted(name: str | tuple[str, ...]) -> str:
    return name if isinstance(name, str) else ".".join(name)


def with_option_sums(transitions: TensorDict, gamma: float = 1.0) -> TensorDict:
    """Return the transitions with what `DecisionTracker` writes where an option lasts a whole episode.

    Under `next`, `option_return` `[N, 1]` is the discounted sum of the rewards since the episode began, `option_steps`
    `[N, 1]` the number of these steps, and `decision_observation` `[N, observation_dim]` the episode's first
    observation.

    Args:
        transitions: `[N]`, one episode after another, with ascending episode numbers under `TRAJECTORY`.
        gamma: discount of a step.
    """
    episode = transitions[TRAJECTORY]
    first = torch.searchsorted(episode, episode)  # the row in which each row's episode begins
    option_steps = torch.arange(len(first), device=first.device) - first + 1
    # Double precision, because the sum runs over all episodes before it is taken apart.
    reward = gamma ** (option_steps - 1).double() * transitions["next", keys.REWARD].squeeze(-1).double()
    total = reward.cumsum(0)
    option_return = total - total[first] + reward[first]
    extended = transitions.copy()
    extended["next", keys.OPTION_RETURN] = option_return.float().unsqueeze(-1)
    extended["next", keys.OPTION_STEPS] = option_steps.unsqueeze(-1)
    extended["next", keys.DECISION_OBSERVATION] = transitions[keys.OBSERVATION][first]
    return extended
