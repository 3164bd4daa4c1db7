"""The contract of explorations, one of which stands beside each learner."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from hpamdp.cards import ExplorationCard
from hpamdp.policies.base import Learner


class Explored(NamedTuple):
    """What an exploration makes of a batch `[*B, T]`."""

    bonus: Tensor | None  # to add to the rewards, float32 [*B, T, 1]; None for nothing
    scalars: dict[str, float]  # to log


class Exploration(nn.Module):
    """Lets a learner try what its own policy would hardly try. The learner's own exploration goes on beside it.

    The agent makes one for each learner, and asks `acting_policy` for the policy that acts. After each batch it calls
    `learn`, before the learner learns. What an exploration draws comes from torch's global generator, as all draws of
    policies do.

    Constructor: `learner` is the learner. Its `specs` hold the sizes of the problem. The argument `device`, if it
    exists, says where tensors live. Settings are fields of a model `Options`, see `hpamdp.settings`, or keyword-only
    arguments. Their names and types are the schema of the exploration's yaml in `conf/exploration`.

    Attributes:
        card: what the class declares: whether it changes the `actions` that are taken or the `rewards`.
        exploring_keys: the policy's states that it adds. They do not keep an agent from an export.
    """

    card: ClassVar[ExplorationCard] = ExplorationCard()
    exploring_keys: ClassVar[frozenset[NestedKey]] = frozenset()

    def __init__(self, learner: Learner) -> None:
        super().__init__()

    def acting_policy(self, learner: Learner) -> TensorDictModuleBase:
        """Return the policy that acts in place of the learner's own; by default that one."""
        return learner.policy

    def learn(self, batch: TensorDictBase, mask: Tensor) -> Explored:
        """Learn from a collected batch `[*B, T]`, in the form of `Learner.learn`; do not modify it.

        Args:
            batch: the batch.
            mask: the transitions that are the learner's, bool `[*B, T]`. A bonus must be 0 elsewhere.
        """
        return Explored(None, {})

    def stateful(self) -> dict[str, Any]:
        """Return what a checkpoint must hold besides parameters and buffers, by name; see `Level.stateful`."""
        return {}
