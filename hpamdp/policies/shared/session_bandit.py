"""The base of bandits that can learn within a session.

With `memory=session`, each session starts a new bandit, which counts only the rewards of the session's own trips. Each
trip is a round of Auer, Cesa-Bianchi and Fischer 2002. Nothing is learned across sessions, so the greedy policy
explores, too.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional as F

from hpamdp import keys
from hpamdp.policies.masks import masked_values
from hpamdp.policies.shared.bandit import Bandit, Rewards
from hpamdp.policies.shared.bandit_options import SessionBanditOptions
from hpamdp.specs import PAMDPSpecs

# Counts, sums and sums of squares of the rewards of each option in the session, float64 `[*B, 3, num_options]`.
SESSION_REWARDS = "session_rewards"


class SessionRewards(Rewards):
    """The rewards of the options in each environment's session so far.

    Args:
        rewards: counts, sums and sums of squares, `[*B, 3, num_options]`.
    """

    def __init__(self, rewards: Tensor) -> None:
        self.counts, self.sums, self.squares = rewards.unbind(-2)


class SessionBandit(Bandit):
    """A bandit that counts the rewards of all episodes, or with `memory=session` those of each session alone.

    The rewards of a session are the policy's state in its environment. They travel in the tensordict as the choice
    does, so there may be any number of environments, and a resumed run goes on with them. A subclass writes
    `session_values`.
    """

    Options = SessionBanditOptions

    def __init__(self, specs: PAMDPSpecs, options: SessionBanditOptions | None = None, **settings: Any) -> None:
        super().__init__(specs, options, **settings)
        if self.options.memory == "session":
            self.memory_key = SESSION_REWARDS
            self.in_keys += [keys.OPTION_RETURN, keys.EPISODE_STEPS, SESSION_REWARDS]
            self.out_keys += [SESSION_REWARDS]
            self.export_refusal = f"remembers {SESSION_REWARDS}"

    @abstractmethod
    def session_values(self, rewards: SessionRewards) -> Tensor:
        """Return a value for each option, `[*B, num_options]`; the option with the highest is chosen."""
        raise NotImplementedError

    def select(self, td: TensorDictBase) -> Tensor:
        """Return the options `[*B]`; with `memory=session` by the session's rewards, greedy or not."""
        if self.memory_key is None:
            return super().select(td)
        values = self.session_values(SessionRewards(self._rewards(td)))
        return masked_values(values, td.get(keys.OPTION_MASK, None)).argmax(-1)

    def held_with(self, td: TensorDictBase, option: Tensor) -> dict[str, Tensor]:
        """Return, with `memory=session`, the rewards of the session before the options."""
        return {} if self.memory_key is None else {SESSION_REWARDS: self._rewards(td)}

    def _rewards(self, td: TensorDictBase) -> Tensor:
        """Return the rewards of the session before a decision, `[*B, 3, num_options]`, the last option's included."""
        before, option = td.get(SESSION_REWARDS, None), td.get(keys.OPTION, None)
        reward = td.get(keys.OPTION_RETURN).double()
        if before is None or option is None:
            return reward.new_zeros(*td.batch_size, 3, self.specs.num_options)
        is_held = F.one_hot(option, self.specs.num_options).double()
        added = torch.stack([is_held, is_held * reward, is_held * reward.square()], -2)
        begins = (td.get(keys.EPISODE_STEPS) == 0).unsqueeze(-1)
        return torch.where(begins, 0.0, before + added)

    def has_updated(self) -> bool:
        """Return whether any reward is known; always true with `memory=session`, which learns nothing."""
        return self.memory_key is not None or super().has_updated()

    def learn(self, decisions: TensorDictBase) -> dict[str, float]:
        """Do as `Bandit.learn` does; with `memory=session` learn nothing, and return the mean rewards."""
        if self.memory_key is None:
            return super().learn(decisions)
        option = decisions.get(keys.OPTION)
        reward = decisions.get(("next", keys.OPTION_RETURN)).squeeze(-1)
        numbers = {name: i for i, name in enumerate(self.specs.option_names) if (option == i).any()}
        return {f"reward_{name}": reward[option == i].mean().item() for name, i in numbers.items()}
