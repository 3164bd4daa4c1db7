"""Problems of pyRDDLGym as one batched TorchRL environment."""

from __future__ import annotations

import zlib
from pathlib import Path

import torch
from torch import Tensor

from hpamdp import keys
from hpamdp.env.gymnasium.environment import SimulatorEnv
from hpamdp.env.rddl.options import CARDS, RDDLOptions, RDDLRules
from hpamdp.env.rddl.problem import RDDLProblem


class RDDLEnv(SimulatorEnv):
    """Step `num_envs` copies of an RDDL problem, one after another or in processes.

    `observation` float32 `[N, D]`: the fluents of the state, or those that the instance shows. See `RDDLProblem` for
    the action, and `GymnasiumEnv` for the arguments and the errors.
    """

    Options = RDDLOptions
    card = CARDS["RDDLEnv"]
    options: RDDLOptions
    simulator = RDDLProblem
    simulator_options = RDDLRules

    def _prepare(self) -> None:
        self.discrete_names = self._copies.call("discrete_names")[0]
        self.observation_names = self._copies.call("observation_names")[0]

    def initial_parameters(self) -> tuple[Tensor, Tensor] | None:
        """Return where numbers that are always set begin: `RDDLProblem.initial_numbers`."""
        rules = {name: getattr(self.options, name) for name in RDDLRules.model_fields}
        low, high = self._copies.actions.own_low, self._copies.actions.own_high
        numbers = RDDLProblem(**rules).initial_numbers(low, high)
        if numbers is None:
            return None
        unit = torch.tensor(2.0 * (numbers - low) / (high - low) - 1.0, dtype=torch.float32)
        return torch.zeros(len(unit), self.observation_spec[keys.OBSERVATION].shape[-1], dtype=torch.float32), unit

    def file_checksums(self) -> dict[str, Tensor]:
        """Return the checksum of files of one's own, int64 `[1]`; nothing for a problem of rddlrepository."""
        if self.options.files is None:
            return {}
        checksum = zlib.crc32(b"".join(Path(file).read_bytes() for file in self.options.files))
        return {"files_checksum": torch.tensor([checksum], dtype=torch.int64, device=self.device)}
