"""Keep a run's metrics and evaluations, and write them with its summary and figures if the run has a folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.analysis import film
from hpamdp.config.schema import Config
from hpamdp.files import replacing
from hpamdp.messages import warn
from hpamdp.metrics_file import CPU_SECONDS, EVALUATION, FRAMES, WALL_SECONDS, Metrics, rows_up_to
from hpamdp.policies.base import Learner
from hpamdp.policies.random_agent import random_agent
from hpamdp.run.assemble import AssembledRun
from hpamdp.run.loggers import EarlierRun, LenientLogger, Logger
from hpamdp.run.summary import (
    EVALUATED_FRAMES,
    ONE_ACTION,
    ONE_OPTION,
    SHORT_SIGHT,
    WITHOUT_UPDATE,
    closing_table,
    short_sight,
    summarise,
)
from hpamdp.run_files import EVALUATION_NAME, FILM_NAME, METRICS_NAME, SUMMARY_NAME

# Small enough to film in a second or two.
_FPS, _FILM_SIZE = 20.0, 200
_MOST_ACTIONS = 20  # discrete actions that have a column each in the metrics


class Recorder:
    """Collect a run's metrics and write them to its output folder and its logger.

    Args:
        config: config of the run.
        parts: the run's environment, agent and evaluation.
        output_dir: folder of `metrics.csv`, `summary.json`, `evaluation.npz` and the pictures. If None, nothing is
            written.

    Attributes:
        metrics: the rows so far.
        summary: see `summarise`; empty before `finish`.
        training_return: mean return of the exploring episodes in the last batch in which some ended; None before.
        eval_cpu_s: CPU time of the evaluations so far, random play included.
        eval_steps: environment steps of the agent's evaluations so far.
        measured: means of the last evaluation, also if it was before a resumption; empty before the first one.
        evaluated_frames: frames of training before it; None before the first one.
    """

    def __init__(self, config: Config, parts: AssembledRun, output_dir: Path | None) -> None:
        self.config = config
        self.parts = parts
        self.output_dir = output_dir
        self.metrics = Metrics(None if output_dir is None else output_dir / METRICS_NAME)
        self.summary: dict[str, Any] = {}
        self.training_return: float | None = None
        self._logger: LenientLogger | None = None
        self._resumed_from: Path | None = None  # the folder of the run that is continued
        self._ended: list[TensorDictBase] = []
        self._scalars: dict[str, float] = {}
        self.eval_cpu_s = 0.0
        self.eval_steps = 0
        self._played: dict[str, np.ndarray] | None = None  # the last evaluation of this process
        self._is_current = False  # whether the agent is as it was then
        self.measured: dict[str, float] = {}
        self.evaluated_frames: int | None = None
        self._action_counts: Tensor | None = None  # steps with each discrete action, since the last row
        self._callback_metrics: Mapping[str, float] = {}  # the last metrics of callbacks
        self._option_scores: dict[str, float] = {}  # scores with each option held, at the last evaluation
        self._random_scores: dict[str, float] = {}  # empty before the first evaluation

    def resume_from(self, folder: Path, frames: int, *, has_rows: bool) -> None:
        """Start the metrics with the rows of the run in `folder`, up to `frames`; warn if it has lost those it had."""
        source = folder / METRICS_NAME
        rows = rows_up_to(frames, source)
        if not rows and has_rows:
            warn(f"{source}: is missing or damaged; the run goes on without the rows up to {FRAMES}={frames}")
        self.metrics = Metrics(self.metrics.path, rows)
        for row in rows:
            if f"{EVALUATION}score" in row:
                evaluated = {name: value for name, value in row.items() if name.startswith(EVALUATION)}
                self.measured = {name.removeprefix(EVALUATION): value for name, value in evaluated.items()}
                self.evaluated_frames = int(row[FRAMES])
        self._resumed_from = folder

    def start(self) -> None:
        """Start the logger of a run with a folder. It takes over the rows of a resumed run.

        Raises:
            ConfigError: the logger refuses its settings.
        """
        earlier = None
        if self._resumed_from is not None:
            earlier = EarlierRun(self._resumed_from, self.metrics.rows())
        chosen, values = self.config.logger, self.config.to_dict()
        self._logger = LenientLogger(
            chosen.name, lambda: chosen.build(output_dir=self.output_dir, config=values, earlier=earlier)
        )

    def state(self) -> dict[str, Any]:
        """Return the state that the next row of metrics depends on, for a checkpoint."""
        return {
            "ended": [dict(TensorDict.cat(self._ended).items())] if self._ended else [],
            "scalars": dict(self._scalars),
            "held": dict(self._option_scores),
            "own": dict(self._callback_metrics),
            "actions": [] if self._action_counts is None else self._action_counts.tolist(),
            "random": dict(self._random_scores),
            "episodes": self._episodes(),
            "has_rows": bool(self.metrics.rows()),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from a `state`. Checkpoints of 0.3 lack its last five entries."""
        self._ended = [TensorDict(ended).auto_batch_size_(1) for ended in state["ended"]]
        self._scalars, self._option_scores = state["scalars"], state["held"]
        self._callback_metrics = state.get("own", {})
        if state.get("episodes") == self._episodes():
            self._random_scores = {name: float(value) for name, value in state["random"].items()}
        if state.get("actions"):
            self._action_counts = torch.tensor(state["actions"], device=self.parts.device)

    def _episodes(self) -> list[int]:
        """Return what tells the episodes of evaluations: their number and their seed."""
        return [self.config.run.eval.layouts, self.config.run.eval.seed]

    def take(self, batch: TensorDictBase | None, scalars: dict[str, float]) -> None:
        """Note a collected batch `[N, T]`, if there is one, and the scalars that the agent returned from learning."""
        self._scalars |= scalars
        self.forget_evaluation()
        if batch is None:
            return
        if keys.DISCRETE in batch.keys(include_nested=True):  # batches of decisions have no actions
            self._count_actions(batch.get(keys.DISCRETE))
        is_end = batch.get(("next", keys.DONE)).squeeze(-1)
        ended = self._results(batch)[is_end]
        self._ended.append(ended)
        if len(ended):
            self.training_return = self._outcomes(ended)["return"].mean().item()

    def _count_actions(self, discrete: Tensor) -> None:
        """Add the steps with each discrete action, given the actions `[N, T]`, or `[N, T, num_components]`."""
        sizes = self.parts.agent.specs.components.sizes
        if sum(sizes) > _MOST_ACTIONS:
            return
        columns = discrete.reshape(-1, len(sizes)).unbind(-1)
        counts = torch.cat([column.bincount(minlength=size) for column, size in zip(columns, sizes, strict=True)])
        self._action_counts = counts if self._action_counts is None else self._action_counts + counts

    def _action_shares(self) -> dict[str, float]:
        """Return the share of the steps since the last row that took each discrete action, of each component."""
        if self._action_counts is None:
            return {}
        sizes = self.parts.agent.specs.components.sizes
        counts, self._action_counts = self._action_counts.split(list(sizes)), None
        prefixes = ["train/action_"] if len(sizes) == 1 else [f"train/action_{place}_" for place in range(len(sizes))]
        return {
            f"{prefix}{i}": share
            for prefix, own in zip(prefixes, counts, strict=True)
            for i, share in enumerate((own / own.sum()).tolist())
        }

    def _results(self, steps: TensorDictBase) -> TensorDictBase:
        """Return the entries of steps `[*B]` to record at the end of an episode."""
        results = steps.get("next").select(*self.parts.env.result_keys, keys.EPISODE_RETURN, keys.EPISODE_STEPS)
        if keys.OPTION in steps.keys():
            results.set(keys.OPTION, steps.get(keys.OPTION))
        return results

    def _outcomes(self, ended: TensorDictBase) -> dict[str, Tensor]:
        """Return what the environment tells of episodes that ended, and their `return` as the environment gave it."""
        return {"return": ended[keys.EPISODE_RETURN], **self.parts.env.results(ended)}

    def forget_evaluation(self) -> None:
        """Have the next figures come from a new evaluation, because the agent may have changed."""
        self._is_current = False

    def log(
        self,
        frames: int,
        wall_s: float,
        cpu_s: float,
        is_evaluated: bool,
        *,
        own: Mapping[str, float] | None = None,
    ) -> dict[str, float]:
        """Write a row of metrics, with an evaluation if `is_evaluated`, and return it.

        `own` are the metrics of callbacks; the summary repeats the last ones.
        """
        times = {FRAMES: float(frames), WALL_SECONDS: wall_s, CPU_SECONDS: cpu_s}
        row = {**times, **self._training_scores(), **self._action_shares(), **self._scalars}
        if own is not None:
            row |= own
            self._callback_metrics = own
        if is_evaluated:
            self._measure(frames)
            measured = self.measured | self._drift(self.measured)
            row |= {f"{EVALUATION}{name}": value for name, value in measured.items()}
        self.metrics.append(row)
        self._pass_on(lambda logger: logger.log(row, frames))
        self._ended = []
        self._scalars = {}
        return row

    def finish(self, frames: int, wall_s: float, cpu_s: float, ending: Mapping[str, Any], *, is_finished: bool) -> str:
        """Write the summary and the figures, close the logger, and return the closing table as text.

        The figures are of the agent as it is. If training was interrupted, nothing is played: the figures are those of
        the last evaluation, if there was one.

        Args:
            frames: frames of training.
            wall_s: wall time of training; with `mode=eval`, the time of the evaluation replaces it.
            cpu_s: CPU time of training; likewise.
            ending: entries of the summary about training: `compile_cpu_s`, `stopped_by`, `kept_frames`, `kept_score`.
            is_finished: whether training reached its end.
        """
        if self.config.run.mode == "eval":
            wall_before, cpu_before = time.perf_counter(), time.process_time()
            self.play()
            wall_s, cpu_s = time.perf_counter() - wall_before, time.process_time() - cpu_before
        if is_finished:
            self._measure(frames)
        measured = self.measured
        effort = {"frames": frames, "wall_s": wall_s, "cpu_s": cpu_s}
        effort |= {"eval_cpu_s": self.eval_cpu_s, "eval_steps": self.eval_steps}
        if self.evaluated_frames not in (None, frames):
            effort[EVALUATED_FRAMES] = self.evaluated_frames
        env = self.parts.evaluation.problem
        summary = summarise(self.config, env, measured, self._random_scores, effort, is_finished=is_finished)
        summary |= {**self._callback_metrics, **ending}
        if self.config.run.mode != "eval":
            summary[WITHOUT_UPDATE] = self.parts.agent.without_update()
            summary[SHORT_SIGHT] = short_sight(self.config.learners, measured.get("steps", 0.0))
            summary[ONE_OPTION] = self._one_option()
            summary[ONE_ACTION] = self.parts.evaluation.one_action
            summary["practised"] = self.parts.agent.practised()
        self.summary = summary
        if self.output_dir is not None:
            self._write(self.output_dir)
        return closing_table(summary, env.table_metrics)

    def _one_option(self) -> list[str]:
        """Return a line if the selector cannot tell states apart, in which another option may be better."""
        selector = self.parts.agent.selector
        if selector is None or selector.memory_key is not None:
            return []
        if not selector.card.is_bandit or selector.card.sees_state:
            return []
        learners = [each for each in self.parts.agent.learners if isinstance(each, Learner)]
        have_value = all(each.card.has_value and each.card.value_setting is None for each in learners)
        better = "high=value" if have_value else "high=meta_critic"
        return [f"{self.config.high} holds the option that is best on average; {better} chooses one for each episode"]

    def _write(self, folder: Path) -> None:
        """Write the summary, and the last evaluation with its pictures if this process played one. Close the logger."""
        played: dict[str, Any] | None = self._played
        if played is not None:
            with replacing(folder / EVALUATION_NAME) as partial:
                np.savez_compressed(partial, **played)
        with replacing(folder / SUMMARY_NAME) as partial:
            partial.write_text(json.dumps(self.summary, indent=2) + "\n")
        if played is not None:
            self._draw(folder, played)
        self._pass_on(lambda logger: logger.summary(self.summary))
        self._pass_on(lambda logger: logger.close())

    def _draw(self, folder: Path, played: Mapping[str, np.ndarray]) -> None:
        """Draw the figures and the film of the last evaluation."""
        from hpamdp.analysis import figures  # takes a third of a second, which a loaded agent need not wait for

        images = figures.draw_all(folder, type(self.parts.evaluation.problem), self.summary, played)
        filmed = self._film(folder)
        self._pass_on(lambda logger: logger.images(images))
        if filmed is not None:
            self._pass_on(lambda logger: logger.film(filmed))

    def _pass_on(self, act: Callable[[Logger], None]) -> None:
        if self._logger is not None:
            self._logger.call(act)

    def _film(self, folder: Path) -> Path | None:
        """Film the first episodes of the last evaluation, if the problem has pictures, and return the file."""
        evaluation = self.parts.evaluation
        tracks = film.tracks_of(evaluation.states)
        pictures = film.film(evaluation.problem, tracks, _FPS, _FILM_SIZE)
        path = folder / FILM_NAME
        try:
            film.write(path, pictures, _FPS)
        except film.NoPictureError:
            return None
        return path

    def play(self) -> dict[str, np.ndarray]:
        """Evaluate the agent unless it is as it was at the last evaluation, and return `Evaluation.run_agent`."""
        if self._played is None or not self._is_current:
            cpu_before, evaluation = time.process_time(), self.parts.evaluation
            if not self._random_scores:
                specs, lengths = self.parts.agent.specs, self.parts.agent.option_lengths
                random = random_agent(specs, self.parts.device, lengths)
                self._random_scores = evaluation.measure(evaluation.run(random.policy))
            steps_before = evaluation.steps
            self._played = evaluation.run_agent(self.parts.agent)
            self.eval_cpu_s += time.process_time() - cpu_before
            self.eval_steps += evaluation.steps - steps_before
            self._is_current = True
        return self._played

    def _measure(self, frames: int) -> None:
        """Note the means of an evaluation of the agent after these frames of training."""
        self.measured, self.evaluated_frames = self.parts.evaluation.measure(self.play()), frames

    def _drift(self, measured: dict[str, float]) -> dict[str, float]:
        """Return, for each option, how much the score with that option held has changed since the last evaluation."""
        held = {name: value for name, value in measured.items() if name.startswith("score_")}
        before, self._option_scores = self._option_scores, held
        return {
            f"drift_{name.removeprefix('score_')}": value - before[name]
            for name, value in held.items()
            if name in before
        }

    def _training_scores(self) -> dict[str, float]:
        """Return the means over the exploring episodes that ended since the last row."""
        if not sum(len(ended) for ended in self._ended):
            return {}
        ended: TensorDictBase = TensorDict.cat(self._ended)
        results = self._outcomes(ended)
        results = {"score": results["return"], **results}
        names = [name for name in ("score", "success", "return") if name in results]
        scores = {f"train/{name}": results[name].float().mean().item() for name in names}
        scores["train/steps"] = ended[keys.EPISODE_STEPS].float().mean().item()
        for i, name in enumerate(self.parts.agent.specs.option_names):
            scores[f"train/option_{name}"] = (ended[keys.OPTION] == i).float().mean().item()
        return scores
