"""The base class of explorations that reward new states."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp.cards import ExplorationCard
from hpamdp.policies.base import Learner
from hpamdp.policies.exploration.base import Exploration, Explored
from hpamdp.settings import SettingError


class NoveltyPolicy(TensorDictModuleBase):
    """A learner's policy together with the network that its plans use to score novelty.

    As a submodule, the network is copied to collector processes.
    """

    def __init__(self, policy: TensorDictModuleBase, network: nn.Module) -> None:
        super().__init__()
        self.in_keys = policy.in_keys
        self.out_keys = policy.out_keys
        self.policy = policy
        self.network = network

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write what the learner's policy writes."""
        return self.policy(td)


class RewardsNewStates(Exploration):
    """A bonus for states that are new. A subclass gives it to the learner by `Learner.take_bonus`.

    Args:
        learner: the learner.
        weight: reward of a bonus of 1.

    Raises:
        SettingError: the learner maps sampled states to others, which were never visited.
    """

    card = ExplorationCard(changes="rewards")

    def __init__(self, learner: Learner, weight: float) -> None:
        super().__init__(learner)
        if learner.card.novelty_by == "sample" and getattr(learner, "symmetry", None) is not None:
            raise SettingError("low.augment=true: maps states to others that were never visited; use low.augment=false")
        self.weight = weight
        self.adds_to_reward = learner.card.novelty_by == "reward"
        self.adds_to_plans = learner.card.novelty_by == "plan"

    def explored(self, bonus: Tensor, mask: Tensor, scalars: dict[str, float]) -> Explored:
        """Return what `learn` returns.

        Args:
            bonus: of the learner's own steps `[N]`, not weighted.
            mask: which steps are the learner's own, bool `[*B, T]`.
            scalars: to log beside the mean bonus.
        """
        scalars = {"bonus": bonus.mean().item(), **scalars}
        if not self.adds_to_reward:
            return Explored(None, scalars)
        of_batch = bonus.new_zeros(*mask.shape, 1)
        of_batch[mask] = self.weight * bonus.unsqueeze(-1)
        return Explored(of_batch, scalars)
