"""Classes whose settings are called as entries of a saved config, or that cannot be chosen."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.run.loggers import CSVLogger


class NamedLogger(CSVLogger):
    """Appends its settings to a file that all runs of a test share."""

    def __init__(
        self,
        name: str | None,
        budget: int,
        checkpoint: str | None,
        choices: dict[str, str] | None,
        *,
        freeze: bool,
        options: list[str],
        per_option: dict[str, str] | None,
        output_dir: Path,
    ) -> None:
        settings = (name, budget, checkpoint, choices, freeze, options, per_option)
        with Path("logged.txt").open("a") as file:
            file.write(f"{settings}\n")


class NamedEnv(PlatformEnv):
    """Platform for at most 20 steps."""

    def __init__(
        self,
        num_envs: int = 1,
        *,
        name: str | None,
        budget: int,
        checkpoint: str | None,
        choices: dict[str, str] | None,
        freeze: bool,
        per_option: dict[str, str] | None,
        **supplied: Any,
    ) -> None:
        super().__init__(num_envs, max_steps=20, **supplied)
        self.named = (name, budget, checkpoint, choices, freeze, per_option)
