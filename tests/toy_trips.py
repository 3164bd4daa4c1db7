"""Sessions of trips: problems whose episodes are several trips, one after another, with something unseen that stays."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded
from toy_env import ToyEnv

from hpamdp import keys
from hpamdp.cards import ProblemCard


class Sessions(ToyEnv):
    """Take `length` steps in each of `trips` trips; every step earns 1.

    The observation is the step in the trip and the number of the trip, both as fractions, and what `shown` returns.

    Args:
        num_envs: environments of the batch.
        trips: trips of a session.
        length: steps of a trip.
        seed: of what is hidden.
        device: where the tensors live.

    Attributes:
        session: number of the environment's session, int64 `[N]`.
    """

    card = ProblemCard(has_trips=True)
    parameter_dims = (1, 1)

    def __init__(
        self, num_envs: int = 1, *, trips: int = 2, length: int = 2, seed: int = 0, device: object = "cpu"
    ) -> None:
        super().__init__(device=device, batch_size=[num_envs])
        self.num_envs = num_envs
        self.length, self.max_steps = length, trips * length
        flag = Binary(n=1, shape=(num_envs, 1), dtype=torch.bool)
        seen = {"observation": Bounded(-1.0, 1.0, shape=(num_envs, 3)), "trip_ended": flag}
        self.begin(-1.0, 1.0, seed, has_option=bool(self.option_names), **seen)

    def _set_seed(self, seed: int | None) -> None:
        self.seed = seed or 0
        self.session = torch.full(self.batch_size, -1)
        self.steps = torch.zeros(self.batch_size, dtype=torch.long)
        self.last_reward = torch.zeros(self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = self.reset_mask(tensordict)
        self.session = self.session + mask.long()
        self.steps = torch.where(mask, 0, self.steps)
        self.last_reward = torch.where(mask, 0.0, self.last_reward)
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        is_running = self.steps < self.max_steps
        self.last_reward = torch.where(is_running, self.earned(tensordict), 0.0)
        self.steps = (self.steps + 1).clamp(max=self.max_steps)
        return self._read().set(keys.REWARD, self.last_reward.unsqueeze(-1))

    @property
    def hidden(self) -> Tensor:
        """What stays the same in a session, 0 or 1, int64 `[N]`: a hash of the numbers of environment and session."""
        number = 1 + torch.arange(len(self.session)) + 7919 * self.session + 104729 * self.seed
        return (number * 2654435761 >> 13) % 2

    def env_state(self) -> dict[str, Tensor]:
        """Return the columns of the sessions, `[N]` each."""
        return {"session": self.session, "steps": self.steps, "last_reward": self.last_reward}

    def set_env_state(self, columns: Mapping[str, Tensor]) -> None:
        """Continue from an `env_state`."""
        for name, column in columns.items():
            setattr(self, name, column.clone())

    def earned(self, tensordict: TensorDictBase) -> Tensor:
        """Return what the actions of a step earn, `[N]`."""
        return torch.ones(self.batch_size)

    def shown(self) -> Tensor:
        """Return the last entry of the observation, `[N]`: the last step's reward."""
        return self.last_reward

    def _read(self) -> TensorDict:
        place, trip = self.steps % self.length, self.steps // self.length
        observation = torch.stack([place / self.length, trip * self.length / self.max_steps, self.shown()], -1)
        terminated = (self.steps >= self.max_steps).unsqueeze(-1)
        seen = {keys.OBSERVATION: observation, keys.TRIP_ENDED: ((place == 0) & (self.steps > 0)).unsqueeze(-1)}
        return TensorDict({**seen, **self.flags(terminated)}, self.batch_size)


class SessionsOfOptions(Sessions):
    """Sessions with two options to choose from; every step earns 1."""

    option_names = ("left", "right")


class HiddenAction(Sessions):
    """One of the two discrete actions earns 1 through a session, the other one -1.

    Which one is hidden: only the observation after the session's first step shows it, as -1 or 1.
    """

    def earned(self, tensordict: TensorDictBase) -> Tensor:
        """Return 1 for the hidden action, else -1."""
        return torch.where(tensordict[keys.DISCRETE] == self.hidden, 1.0, -1.0)

    def shown(self) -> Tensor:
        """Return what is hidden after the first step of a session, else 0."""
        return torch.where(self.steps == 1, 2.0 * self.hidden - 1.0, 0.0)


class HiddenOption(SessionsOfOptions):
    """One of the two options earns 1 a step through a session, the other one -1.

    Which one is hidden: only the observation at the beginning of the second trip shows it, as -1 or 1.
    """

    def earned(self, tensordict: TensorDictBase) -> Tensor:
        """Return 1 for the hidden option, else -1."""
        return torch.where(tensordict[keys.OPTION] == self.hidden, 1.0, -1.0)

    def shown(self) -> Tensor:
        """Return what is hidden at the beginning of the second trip, else 0."""
        return torch.where(self.steps == self.length, 2.0 * self.hidden - 1.0, 0.0)
