"""The training loop: collect a batch, learn, log, evaluate and save."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from tqdm import tqdm

from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config
from hpamdp.files import replacing
from hpamdp.messages import first_line, warn
from hpamdp.policies.base import Learner
from hpamdp.run import checkpoint
from hpamdp.run.assemble import AssembledRun
from hpamdp.run.callbacks import BestAgent, Callback, CallbackError, metrics_of, mistakes_explained, named, states_of
from hpamdp.run.collection.base import Collection
from hpamdp.run.folder import mark_unfinished, moved_aside
from hpamdp.run.recorder import Recorder
from hpamdp.run.stopping import StopRequest, signals_ignored, stop_on_signals
from hpamdp.run.summary import KEPT_FRAMES, KEPT_SCORE
from hpamdp.run_files import CONFIG_NAME, DIVERGED_NAME, POLICY_NAME

_MOST_EVALUATION = 0.05  # steps of evaluations for each step of training, with `eval.every=auto`
_UPDATES_A_TURN = 50  # with mode=offline, between two checks of what is due


class DivergedError(Exception):
    """Raised if a reward, a loss or a weight is not finite."""


class Trainer:
    """The training loop and its progress.

    A frame is the unit of a run's length: a step, a decision with frozen learners, or an update with `mode=offline`.

    Args:
        config: config of the run.
        parts: parts of the run.
        output_dir: folder of the run. If None, the run writes nothing.
        callbacks: called during training.

    Attributes:
        frames: frames so far.
        wall_s, cpu_s: wall time and CPU time of training so far, evaluations and compiling included.
        compile_cpu_s: CPU time of compiling updates since this process began, compilers that it started included.
        last_score: score of the last evaluation; None before the first one.
        stopped_by: class of the callback that has ended training; None if none has.
        stop_reason: why a callback has ended training; empty if none has, or if it gave no reason.
        is_evaluation_due: whether an evaluation began and did not end. A resumed run repeats it.
        resumed_from: folder of the run that is continued, if any.
        unit: what a frame is, as messages show it after a number, such as ` steps`.
        shows_progress: whether a bar on stderr shows the progress.
    """

    shows_progress = True

    def __init__(
        self,
        config: Config,
        parts: AssembledRun,
        output_dir: Path | None = None,
        callbacks: Sequence[Callback] = (),
    ) -> None:
        self.config = config
        self.parts = parts
        self.output_dir = output_dir
        self.callbacks = named(callbacks)
        self._states_of_callbacks = states_of(self.callbacks)
        self.recorder = Recorder(config, parts, output_dir)
        self._is_stopped = False
        self.stop_reason = ""
        self.stopped_by: str | None = None
        self.resumed_from: Path | None = None
        self.frames = 0
        self.wall_s = 0.0
        self.cpu_s = 0.0
        self.compile_cpu_s = 0.0
        self._compilers_cpu_s = 0.0  # of it, the time of other processes
        self.last_score: float | None = None
        self.is_evaluation_due = False
        self._kept: dict[str, Any] = {}  # progress of the best agent, if the run ended with it
        self._saved: checkpoint.Saved | None = None  # what a resumed run continues from
        self.unit = " steps"
        if config.run.mode == "offline":
            self.unit = " updates"
        elif config.run.low.freeze:
            self.unit = " decisions"

    def restore(self, source: Path) -> None:
        """Load the agent from a checkpoint, and the state of its run if training continues."""
        is_training = self.config.run.mode != "eval"
        saved = checkpoint.load(source, self.parts.agent, self.parts.device, with_training=is_training)
        progress = saved.progress
        self.frames = progress["frames"]
        self.wall_s = progress["wall_s"]
        self.cpu_s = progress["cpu_s"]
        self.recorder.eval_cpu_s = progress.get("eval_cpu_s", 0.0)
        self.recorder.eval_steps = progress.get("eval_steps", 0)
        self.last_score = progress["last_score"]
        self.is_evaluation_due = progress.get("evaluation_due", False)
        if not is_training:
            saved.set_statistics(self.parts.env)
            return
        self.resumed_from = source.parent
        # An evaluation that is due writes the row of these frames again.
        frames = self.frames - 1 if self.is_evaluation_due else self.frames
        recorded = saved.states["recorder"]
        self.recorder.resume_from(source.parent, frames, has_rows=frames > 0 and recorded.get("has_rows", True))
        try:
            self.recorder.set_state(recorded)
            self._restore_callbacks(saved.states["callbacks"])
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(f"{source}: does not fit this run ({first_line(error)})") from error
        self._saved = saved

    def _restore_callbacks(self, states: Mapping[str, Any]) -> None:
        """Set the saved states of callbacks. A callback without a saved state begins as in a new run.

        Raises:
            ValueError: a callback cannot take the state, such as that of another one.
        """
        for name, callback in self.callbacks.items():
            if name in states:
                try:
                    callback.set_state(states[name])
                except Exception as error:  # the state may be of another callback of this name
                    raise ValueError(f"{name}.set_state raised {type(error).__name__}: {first_line(error)}") from error
        dropped = [name for name, state in states.items() if state and name not in self.callbacks]
        if dropped:
            warn(f"the checkpoint holds the state of {', '.join(dropped)}, but this run has no such callback")

    def start(self, *, is_own: bool) -> None:
        """Write the config and start the logger, if the run has a folder.

        These are the first writes. So everything must have been checked and built before.

        Args:
            is_own: whether the folder holds the continued run. Otherwise an earlier run there is deleted.

        Raises:
            ConfigError: the logger refuses its settings; the folder stays as it was.
        """
        if self.output_dir is None:
            return
        if is_own:
            self.recorder.start()
            self._write_config(self.output_dir)
            mark_unfinished(self.output_dir)
            return
        self.output_dir.mkdir(parents=True, exist_ok=True)
        with moved_aside(self.output_dir):
            self._write_config(self.output_dir)
            self.recorder.start()
            self.recorder.metrics.keep_resumed()

    def _write_config(self, folder: Path) -> None:
        with replacing(folder / CONFIG_NAME) as partial:
            partial.write_text(self.config.to_yaml())

    def stop(self, reason: str = "") -> None:
        """End training after the current batch. The run counts as finished.

        Args:
            reason: shown after the closing table.
        """
        self._is_stopped = True
        self.stop_reason = reason

    def finish(self, *, is_finished: bool = True) -> str:
        """Evaluate the agent, write what the run has found, and return the closing table as text.

        With `mode=train` and `save_best=true`, the agent then becomes that of the best evaluation, if the last one is
        clearly worse. The figures of the run stay those of the last evaluation, since the best one was chosen by the
        episodes that score it. `checkpoint.safetensors`, from which the run can be continued, stays, too.

        Args:
            is_finished: whether training reached its end. If not, the figures are those of the last evaluation.
        """
        ending: dict[str, Any] = {"compile_cpu_s": self.compile_cpu_s}
        if self.stopped_by is not None:
            ending["stopped_by"] = self.stopped_by
        better = self._better_agent() if is_finished else None
        if better is not None:
            ending |= {KEPT_FRAMES: better.best_frames, KEPT_SCORE: better.best_score}
        table = self.recorder.finish(self.frames, self.wall_s, self.cpu_s, ending, is_finished=is_finished)
        if better is not None:
            better.restore(self)
            self._kept = {"frames": better.best_frames, "last_score": better.best_score}
            if self.output_dir is not None:
                self.save_policy(self.output_dir / POLICY_NAME)
        return table

    def _better_agent(self) -> BestAgent | None:
        """Return what holds the agent of the best evaluation if it is clearly better than the last one."""
        best = next((each for each in self.callbacks.values() if isinstance(each, BestAgent)), None)
        if best is None or self.config.run.mode != "train" or not self.config.run.save_best:
            return None
        return best if best.is_clearly_better(self.recorder.play()["score"]) else None

    def train(self) -> bool:
        """Train until `num_frames`, `eval.stop_score` or a callback ends it, and save the agent.

        A signal takes effect between two batches, so that the saved state equals that of an uninterrupted run. It ends
        an evaluation at once, which a resumed run repeats, and the wait for a new worker in place of a dead one.

        Returns:
            True if a signal stopped training before its end.

        Raises:
            DivergedError: a reward, a loss or a weight is not finite. Nothing has been saved since.
            CallbackError: a callback returned a value that cannot be recorded. The agent has been saved.
        """
        with stop_on_signals() as request:
            collection: Collection = self.config.collector.build(
                config=self.config, parts=self.parts, frames=self.frames
            )
            try:
                self.restore_collection(collection)
                collection.while_replacing = partial(self._replacing, collection, request)
                self._loop(collection, request)
            except KeyboardInterrupt:  # in a block of `taken_at_once`, or the second signal, perhaps in an update
                self.recorder.forget_evaluation()
            except CallbackError:
                self._save_and_close(collection)
                raise
            except (DivergedError, ConfigError):
                collection.close()
                raise
            except BaseException:  # such as a dead worker; the agent is saved before the run fails
                self._save_and_close(collection)
                raise
            try:
                self._call(lambda callback: callback.on_end(self))
            finally:
                self._save_and_close(collection)
            return self.is_evaluation_due or not self.is_over()

    def _call(self, act: Callable[[Callback], None]) -> None:
        for name, callback in self.callbacks.items():
            was_stopped = self._is_stopped
            with mistakes_explained(name):
                act(callback)
            if self._is_stopped and not was_stopped:
                self.stopped_by = type(callback).__name__

    def _save_and_close(self, collection: Collection) -> None:
        """Save first, uninterrupted and without any output, then close the collection."""
        with signals_ignored():
            try:
                self.save(collection)
            finally:
                collection.close()

    @contextmanager
    def _replacing(self, collection: Collection, request: StopRequest) -> Iterator[None]:
        """Save, since another process may never start, and let a signal end the wait for it."""
        self.save(collection)
        with request.taken_at_once():
            yield

    def restore_collection(self, collection: Collection) -> None:
        """Restore the saved state of the collection and the random generators, if there is one."""
        if self._saved is None:
            return
        state, generators = self._saved.states["collection"], self._saved.generators
        try:
            collection.set_state(state)
        except (ValueError, RuntimeError, KeyError) as error:
            raise ConfigError(f"{self._saved.file}: {first_line(error)}") from error
        checkpoint.set_generators(generators)

    def _loop(self, collection: Collection, request: StopRequest) -> None:
        run = self.config.run
        wall_before = self.wall_s - time.perf_counter()
        cpu_before = self.cpu_s - time.process_time()
        saved_at = time.monotonic()

        def take_time() -> None:
            self.wall_s = wall_before + time.perf_counter()
            self.cpu_s = cpu_before + time.process_time() + self._compilers_cpu_s + collection.cpu_s

        bar = tqdm(
            total=run.num_frames,
            initial=self.frames,
            unit=self.unit,
            unit_scale=True,
            mininterval=1.0,
            disable=not self.shows_progress,
        )
        for learner in self.parts.agent.learners:
            assert isinstance(learner, Learner)
            learner.while_compiling = partial(self._compiling, bar)
        with bar:
            is_new = self.last_score is None and self.frames == 0
            # Before anything can be saved, because a resumed run does not add the data again.
            if is_new and self._saved is None and self.parts.data is not None:
                self.parts.agent.add_demonstrations(self.parts.data.batch, self.parts.data.decisions)
            self._call(lambda callback: callback.on_start(self))
            if (is_new and not run.limits_evaluations) or self.is_evaluation_due:
                self._evaluate(bar, request)
            while not self.is_over() and request.signal is None:
                num = self._learn(collection)
                last = self.frames
                self.frames += num
                take_time()
                bar.update(num)
                self._show(bar)
                self._call(lambda callback: callback.on_batch(self))
                is_turn = _is_due(last, self.frames, run.eval_every)
                is_affordable = not run.limits_evaluations or self.recorder.eval_steps <= _MOST_EVALUATION * self.frames
                if self.is_over() or (is_turn and is_affordable):
                    self._evaluate(bar, request)
                elif _is_due(last, self.frames, run.log_every):
                    own = metrics_of(self.callbacks, self)
                    self.recorder.log(self.frames, self.wall_s, self.cpu_s, is_evaluated=False, own=own)
                is_time = run.checkpoint_minutes > 0.0 and time.monotonic() - saved_at > 60.0 * run.checkpoint_minutes
                if not self.is_over() and (is_time or _is_due(last, self.frames, run.checkpoint_every)):
                    self.save(collection)
                    saved_at = time.monotonic()
            take_time()

    def _show(self, bar: tqdm) -> None:
        """Show the last batch's return and the last evaluation behind the bar, from its next refresh on."""
        seen = self.recorder.training_return
        texts = [f"return {seen:.2f}"] if seen is not None else []
        bar.set_postfix_str(", ".join([*texts, self._last_evaluation()]), refresh=False)

    def _last_evaluation(self) -> str:
        """Return the last evaluation in the words of the bar. The untrained agent's says nothing of what is learned."""
        measured, frames = self.recorder.measured, self.recorder.evaluated_frames
        if not frames:
            return "no evaluation yet"
        success = f", success {measured['success']:.1%}" if "success" in measured else ""
        return f"score {measured['score']:.2f}{success} at {frames:,}{self.unit}"

    def _learn(self, collection: Collection) -> int:
        """Let the agent learn from a batch of steps or from the data set, and return the number of frames.

        Raises:
            DivergedError: a reward or a loss is not finite.
        """
        if self.config.run.mode == "offline":
            run = self.config.run
            to_next_row = [every - self.frames % every for every in (run.eval_every, run.log_every) if every > 0]
            num = min(_UPDATES_A_TURN, run.num_frames - self.frames, *to_next_row)
            scalars = self.parts.agent.update(num)
            held_out = None if self.parts.data is None else self.parts.data.held_out
            if held_out is not None and num in (run.num_frames - self.frames, *to_next_row):
                scalars |= self.parts.agent.held_out_losses(held_out)
            check_scalars(scalars)
            self.recorder.take(None, scalars)
            return num
        batch = collection.next()
        check_rewards(batch)
        scalars = self.parts.agent.learn(batch)
        check_scalars(scalars)
        self.recorder.take(batch, scalars)
        return batch.numel()

    def is_over(self) -> bool:
        """Return whether training has come to its end, or something has ended it."""
        stop_score, last_score = self.config.run.eval.stop_score, self.last_score
        is_reached = stop_score is not None and last_score is not None and last_score >= stop_score
        return self._is_stopped or is_reached or self.frames >= self.config.run.num_frames

    @contextmanager
    def _compiling(self, bar: tqdm) -> Iterator[None]:
        """Say before the bar that updates are compiled, and take the time, while the block runs."""
        bar.set_description_str("compiling the updates")
        before = os.times()
        try:
            yield
        finally:
            own, own_system, compilers, compilers_system, _ = np.subtract(os.times(), before).tolist()
            self._compilers_cpu_s += compilers + compilers_system
            self.compile_cpu_s += own + own_system + compilers + compilers_system
            bar.set_description_str(None)

    def _evaluate(self, bar: tqdm, request: StopRequest) -> None:
        self.is_evaluation_due = True  # if it is cut off, the resumed run makes it
        own = metrics_of(self.callbacks, self)
        with request.taken_at_once():
            self.recorder.play()
        row = self.recorder.log(self.frames, self.wall_s, self.cpu_s, is_evaluated=True, own=own)
        self.last_score = row["eval/score"]
        self._show(bar)
        self._call(lambda callback: callback.on_evaluation(self, row))
        self.is_evaluation_due = False

    def save(self, collection: Collection) -> None:
        """Write the checkpoint and the file with only the networks, if the run has a folder.

        Raises:
            DivergedError: a weight is not finite, or another number is NaN.
            CallbackError: a callback has a state that cannot be saved. Everything else is saved.
        """
        self.check_weights()
        if self.output_dir is None:
            return
        try:
            self._states_of_callbacks = states_of(self.callbacks)
        finally:  # an error in a callback's code costs no training
            self._write_checkpoint(self.output_dir, collection)

    def check_weights(self) -> None:
        """Check the numbers of the agent.

        Raises:
            DivergedError: a weight is not finite, or another number is NaN.
        """
        for name, weight in self.parts.agent.named_parameters():
            if not weight.isfinite().all():
                raise DivergedError(f"{name} is {'NaN' if weight.isnan().any() else 'inf'}")
        for name, value in self.parts.agent.state_dict().items():
            if isinstance(value, torch.Tensor) and value.is_floating_point() and value.isnan().any():
                raise DivergedError(f"{name} is NaN")

    def _write_checkpoint(self, folder: Path, collection: Collection) -> None:
        with_replay = self.config.run.checkpoint_replay
        states = {
            "collection": collection.state(),
            "recorder": self.recorder.state(),
            "callbacks": self._states_of_callbacks,
        }
        self.save_policy(folder / POLICY_NAME)
        file = folder / checkpoint.FILE_NAME
        checkpoint.save(file, self.parts.agent, states, self.progress(), with_replay=with_replay)

    def save_policy(self, file: Path) -> None:
        """Write the networks, and the scale of the observations, to a file that `hpamdp.load` reads."""
        checkpoint.save_policy(file, self.parts.agent, self.parts.env.base_env, self.progress())

    def load_policy(self, file: Path) -> None:
        """Give the agent the networks, and the environment the scale of the observations, from such a file."""
        saved = checkpoint.load(file, self.parts.agent, self.parts.device, with_training=False)
        saved.set_statistics(self.parts.env.base_env)
        self.recorder.forget_evaluation()

    def keep_for_inspection(self) -> str:
        """Save the current agent beside the last good checkpoint, and return a message about both files."""
        if self.output_dir is None:
            return "the run has no folder, so nothing is kept"
        file = self.output_dir / DIVERGED_NAME
        states = {"collection": {"env": self.parts.env.base_env.statistics()}}
        checkpoint.save(file, self.parts.agent, states, self.progress(), with_replay=False)
        good = self.output_dir / checkpoint.FILE_NAME
        kept = f"the last good checkpoint is {good}" if good.is_file() else "there is no checkpoint from before"
        return f"{kept}; the agent as it is now is in {file}"

    def progress(self) -> dict[str, Any]:
        """Return what a saved agent tells of its run, as JSON values."""
        return {
            "config": self.config.to_dict(),
            "option_names": list(self.parts.agent.specs.option_names),
            "ranges": self.parts.problem.ranges(),
            "config_dirs": list(self.config.config_dirs),
            "frames": self.frames,
            "wall_s": self.wall_s,
            "cpu_s": self.cpu_s,
            "eval_cpu_s": self.recorder.eval_cpu_s,
            "eval_steps": self.recorder.eval_steps,
            "last_score": self.last_score,
            "evaluation_due": self.is_evaluation_due,
            **self._kept,
        }


def check_rewards(batch: TensorDictBase) -> None:
    """Check the rewards of a batch `[*B, T]` and their sums.

    Raises:
        DivergedError: a reward or a sum is not finite.
    """
    for key in (keys.REWARD, keys.EPISODE_RETURN):
        value = cast(torch.Tensor, batch.get(("next", key)))
        is_finite = value.isfinite()
        if not is_finite.all():
            place = (~is_finite).nonzero()[0]
            raise DivergedError(f"{key} is {value[tuple(place)].item()} in environment {int(place[0])}")


def check_scalars(scalars: Mapping[str, float]) -> None:
    """Check the values that the agent returned from learning.

    Raises:
        DivergedError: a value is not finite.
    """
    for name, value in scalars.items():
        if not math.isfinite(value):
            raise DivergedError(f"{name} is {value}")


def _is_due(before: int, now: int, every: int) -> bool:
    """Return whether a multiple of `every` was passed; False if `every` is 0."""
    return every > 0 and now // every > before // every
