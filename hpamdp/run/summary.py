"""Summarise a run: in one JSON object, and in the table at its end, this agent beside the references."""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from typing import Any

from hpamdp import __version__
from hpamdp.config.components import Component
from hpamdp.config.schema import Config
from hpamdp.env.base import Metric, PAMDPEnv
from hpamdp.figure_style import REFERENCES
from hpamdp.messages import aligned, duration
from hpamdp.metrics_file import FRAMES, WALL_SECONDS

WITHOUT_UPDATE = "without_update"  # names of the levels that made no update
ONE_OPTION = "one_option"  # lines about a selector that holds one option in all episodes
KEPT_FRAMES, KEPT_SCORE = "kept_frames", "kept_score"  # of the best agent, if it is kept in place of the last one
ONE_ACTION = "one_action"  # lines about a greedy policy that takes one discrete action at all steps
EVALUATED_FRAMES = "evaluated_frames"  # frames before the evaluation of an interrupted run, if it went on afterwards
SHORT_SIGHT = "short_sight"  # lines about learners that look far less ahead than episodes last
_FAR = 4.0  # times the steps that a learner looks ahead; longer episodes count as far longer
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
        measured: means of the agent's final evaluation, from `Evaluation.measure`; empty if there was none.
        random: the same means for the uniformly random agent.
        effort: `frames` of training, and `wall_s` and `cpu_s` of this run. With `mode=eval`, they are the times of
            the evaluation, otherwise of training with its evaluations, which took `eval_cpu_s` for `eval_steps` steps.
        is_finished: whether the run reached its end.
    """
    return {
        "mode": config.run.mode,
        "high": config.high.name,
        "low": config.low.name,
        "env": config.env.name,
        **env.summary_entries(),
        **measured,
        "references": {"random": dict(random), **(env.references(measured) if measured else {})},
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


def _number(value: float) -> str:
    return f"{round(value, 3) + 0.0:.3f}"  # adding 0 turns -0.0 into 0.0


_WRITE: dict[str, Callable[[float], str]] = {"number": _number, "share": "{:.1%}".format, "count": "{:.2f}".format}


def closing_table(summary: Mapping[str, Any], metrics: Sequence[Metric]) -> str:
    """Return a plain aligned table of this agent beside the references.

    Args:
        summary: the agent's metrics by their names, `references`, `mode`, `frames`, `wall_s`, `without_update`,
            `short_sight`, `one_option` and `one_action`; `kept_frames` and `kept_score`, if an earlier agent is kept;
            `evaluated_frames`, if the figures are those of an earlier agent.
        metrics: the rows. Rows without a value for the agent are left out, and so are columns without any value.
    """
    titles = {name: title for name, (title, _, _) in REFERENCES.items()}
    beside = summary.get("references", {})
    columns = {titles.get(name, name): beside[name] for name in sorted(beside, key=_order)}
    columns = {"this agent": summary, **columns}
    rows = [metric for metric in metrics if _is_known(summary.get(metric.name))]
    columns = {
        title: measured
        for title, measured in columns.items()
        if any(_is_known(measured.get(metric.name)) for metric in rows)
    }
    cells = [["", *columns]] if rows else []
    for metric in rows:
        values = [measured.get(metric.name) for measured in columns.values()]
        cells.append([metric.title, *(_WRITE[metric.kind](value) if _is_known(value) else "" for value in values)])
    lines = aligned(cells)
    lines += [line for name in (SHORT_SIGHT, ONE_OPTION, ONE_ACTION) for line in summary.get(name, [])]
    if EVALUATED_FRAMES in summary:
        lines.append(f"these figures are of the agent after {summary[EVALUATED_FRAMES]:,.0f} frames")
    without = summary.get(WITHOUT_UPDATE, [])
    lines += [f"no update was made: {', '.join(without)}"] if without else []
    if KEPT_FRAMES in summary:
        kept = f"{summary[KEPT_FRAMES]:,.0f} frames, whose score was {_number(summary[KEPT_SCORE])}"
        lines.append(f"clearly worse than the agent of {kept}: that one is kept")
    return "\n".join([*lines, *_effort(summary)])


def short_sight(learners: Iterable[Component], episode_steps: float) -> list[str]:
    """Return a line for each learner that looks far less ahead than the episodes that were seen.

    Args:
        learners: with a discount `gamma` or a planning `horizon` among their settings.
        episode_steps: mean length of the episodes.
    """
    lines: dict[str, None] = {}
    for low in learners:
        gamma, horizon = low.settings.get("gamma"), low.settings.get("horizon")
        seen = ""
        if isinstance(horizon, int) and not low.settings.get("end_values") and episode_steps > _FAR * horizon:
            seen = f"{low}: plans see low.horizon={horizon} steps"
        elif isinstance(gamma, float) and gamma < 1.0 and episode_steps > _FAR / (1.0 - gamma):
            seen = f"{low}: low.gamma={gamma} counts about {1.0 / (1.0 - gamma):.0f} steps"
        if seen:
            lines[f"{seen}, but episodes have {episode_steps:.0f} on average"] = None
    return list(lines)


def _order(reference: str) -> int:
    known = list(REFERENCES)
    return known.index(reference) if reference in known else len(known)


def _is_known(value: Any) -> bool:
    return value is not None and not math.isnan(value)


def _effort(summary: Mapping[str, Any]) -> list[str]:
    parts = []
    if _is_known(summary.get(FRAMES)):
        unit = "updates" if summary.get("mode") == "offline" else "frames"
        parts.append(f"{summary[FRAMES]:,.0f} {unit}")
    if _is_known(summary.get(WALL_SECONDS)):
        parts.append(duration(summary[WALL_SECONDS]))
    if summary.get("mode") == "eval":
        return [" of training, evaluated in ".join(parts)] if parts else []
    return [" in ".join(parts) + _shares(summary)] if parts else []


def _shares(summary: Mapping[str, Any]) -> str:
    """Return the run's CPU time and what it went to, in brackets; empty for a run of less than a second."""
    total = summary.get("cpu_s") or 0.0
    if total < 1.0:
        return ""
    played = f"evaluations of {summary.get('eval_steps', 0):,.0f} steps and random play"
    named = {played: summary.get("eval_cpu_s", 0.0), "compiling": summary.get("compile_cpu_s", 0.0)}
    shares = [f"{name} {seconds / total:.0%}" for name, seconds in named.items() if seconds >= 0.005 * total]
    return f" ({total:.0f} CPU s" + (f": {', '.join(shares)})" if shares else ")")
