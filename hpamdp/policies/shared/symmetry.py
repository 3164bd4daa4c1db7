"""Random symmetries: stored transitions, mapped as the problem declares that they may be."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from hpamdp.geometry import Symmetries
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs


class RandomSymmetry:
    """Maps stored transitions by random symmetries of the problem.

    Args:
        specs: of the problem.
        device: of the transitions.

    Raises:
        ValueError: the problem declares no symmetries.
    """

    def __init__(self, specs: PAMDPSpecs, device: torch.device) -> None:
        if specs.symmetries is None:
            raise SettingError("augment=true: the problem declares no symmetries; use augment=false")
        self.maps: Symmetries = specs.symmetries.to(device)

    def __call__(self, rows: TensorDictBase) -> TensorDictBase:
        """Return rows `[N, *]`, each with states, action and options (if it has any) mapped by one map."""
        number = torch.randint(len(self.maps), rows.batch_size[:1], device=rows["state"].device)
        shape = rows.batch_size
        number = number.reshape(-1, *[1] * (len(shape) - 1)).expand(shape)
        return self.mapped(number, rows)

    def mapped(self, number: Tensor, rows: TensorDictBase) -> TensorDictBase:
        """Return rows `[*B]` under the maps int64 `[*B]`."""
        context = self.maps.context(rows["state"])
        discrete, unit_parameters = self.maps.map_action(number, context, rows["discrete"], rows["unit"])
        rows = rows.copy()
        for name in ("state", "next_state"):
            rows.set(name, self.maps.map_observation(number, rows[name]))
        for name in ("option", "next_option"):
            if name in rows.keys():
                rows.set(name, self.maps.map_option(number, rows[name]))
        return rows.set("discrete", discrete).set("unit", unit_parameters)
