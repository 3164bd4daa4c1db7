"""Summarise a run in one JSON object."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from hpamdp import __version__
from hpamdp.config.schema import Config
from hpamdp.env.base import PAMDPEnv

_PACKAGES = ("torch", "torchrl", "tensordict", "gymnasium", "hydra-core", "numpy")


def summarise(
    config: Config,
    env: PAMDPEnv,
    measured: Mapping[str, float],
    random: Mapping[str, float],
    effort: Mapping[str, float],
    *,
    is_finished: bool,
) -> dict[str, Any]:
    """Return the run's summary: means of the final evaluation, references, cost and versions.

    Args:
        config: config of the run.
        env: the problem, which has the references.
        measured: means of the agent's final evaluation, from `Evaluation.measure`.
        random: the same means for the uniformly random agent.
        effort: `frames` of training, and `wall_s` and `cpu_s` of this run. With `mode=eval`, they are the times of
            the evaluation, otherwise of training with its evaluations.
        is_finished: whether the run reached its end.
    """
    return {
        "mode": config.run.mode,
        "high": config.high.name,
        "low": config.low.name,
        "env": config.env.name,
        **env.summary_entries(),
        **measured,
        "references": {"random": dict(random), **env.references(measured)},
        "episodes": config.run.eval.layouts,
        "finished": is_finished,
        **effort,
        "seed": config.run.seed,
        "versions": {
            "hpamdp": __version__,
            "python": platform.python_version(),
            **{name: version(name) for name in _PACKAGES},
        },
    }
