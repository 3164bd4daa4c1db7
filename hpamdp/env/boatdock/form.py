"""How a boat looks to Gymnasium, for agents that act there."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.boatdock.numpy_boats import action_space, observation_space
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.gymnasium_form import VectorForm


class BoatForm(VectorForm):
    """The form of `hpamdp/BoatDock-v0` with actions as dicts.

    Args:
        env: the boats.
        rules: their rules.
    """

    def __init__(self, env: PAMDPEnv, rules: BoatDockOptions) -> None:
        super().__init__(env)
        self._has_choice = rules.controller == "choose"
        self.observation_space = observation_space(rules)
        self.action_space = action_space(rules, "dict")

    def write(self, acted: TensorDictBase, *, is_batch: bool) -> Any:
        """Return the action of `GymnasiumForm.write`."""
        leaves = {"key": acted.get(keys.DISCRETE), "duration": acted.get(keys.PARAMETERS)}
        if self._has_choice:
            leaves["option"] = acted.get(keys.OPTION)
        arrays = {name: leaf.cpu().numpy() for name, leaf in leaves.items()}
        return arrays if is_batch else {name: array[0] for name, array in arrays.items()}
