"""What the tests share."""

import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

# Two processes on two cores fight over threads otherwise.
torch.set_num_threads(1)

CONF = Path(__file__).resolve().parent.parent / "conf"


def compose_config(overrides: Sequence[str]) -> DictConfig:
    """Compose conf/config.yaml as the command line does."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", list(overrides))


def choices(group: str) -> list[str]:
    """Return the names in a group of conf/."""
    return sorted(file.stem for file in (CONF / group).glob("*.yaml"))


@contextmanager
def global_generators_unmoved() -> Iterator[None]:
    """Assert that what happens inside moves none of the global random generators."""

    def states() -> tuple:
        return torch.get_rng_state().tolist(), str(np.random.get_state()), random.getstate()

    before = states()
    yield
    assert states() == before
