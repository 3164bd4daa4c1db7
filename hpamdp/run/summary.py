"""What one run comes to, as one JSON object."""

from __future__ import annotations

import platform
from importlib.metadata import version
from typing import Any

from omegaconf import DictConfig

from hpamdp import __version__
from hpamdp.config import name_of
from hpamdp.env.boatdock.reference import human_normalised

_PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "hydra-core", "numpy")


def summarise(
    cfg: DictConfig,
    measured: dict[str, float],
    random: dict[str, float],
    frames: int,
    wall_s: float,
    cpu_s: float,
    is_finished: bool,
) -> dict[str, Any]:
    """Return the run's summary: its final evaluation's means, what to hold them against, what it cost, what made it.

    Args:
        cfg: the resolved config.
        measured: means of the agent's final evaluation, from `evaluate.measure`.
        random: the same for random choices and presses.
        frames, wall_s, cpu_s: presses, seconds and the process's own seconds of training, evaluations included.
        is_finished: whether the run came to its end.
    """
    references = {"random": random}
    if "ceiling" in measured:
        references["ceiling"] = {"score": measured["ceiling"], "success": 1.0, "optimality_gap": 0.0}
    if "oracle_agreement" in measured:
        references["ceiling"]["oracle_agreement"] = 1.0
    controller = cfg.env.get("controller")
    boat = {} if controller is None else {"controller": "chosen" if controller == "choose" else controller}
    if name_of(cfg.env) == "boatdock":
        measured = measured | {"human_normalised": human_normalised(measured["score"], boat["controller"])}
    return {
        "high": name_of(cfg.high),
        "low": name_of(cfg.low),
        "env": name_of(cfg.env),
        **boat,
        **measured,
        "references": references,
        "episodes": cfg.eval.layouts,
        "finished": is_finished,
        "frames": frames,
        "wall_s": wall_s,
        "cpu_s": cpu_s,
        "seed": cfg.seed,
        "versions": {
            "hpamdp": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in _PACKAGES},
        },
    }
