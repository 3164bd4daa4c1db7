"""One run: build its parts, then loop: collect a batch, learn, log, evaluate and save when due."""

from __future__ import annotations

import signal
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from hpamdp.config import Config, ConfigError
from hpamdp.run import checkpoint
from hpamdp.run.assemble import Parts, assemble
from hpamdp.run.collection.base import Collection
from hpamdp.run.recorder import Recorder
from hpamdp.run.resume import resolve

_UPDATES_A_TURN = 50  # with mode=offline, between two checks of what is due


def run(cfg: DictConfig, output_dir: Path, overrides: Sequence[str] = (), stopped_at: Path | None = None) -> int:
    """Train or score an agent, write everything under `output_dir`, return the exit code.

    Args:
        cfg: the composed config.
        output_dir: a folder, made if need be.
        overrides: the command line's words, which change a resumed run's config.
        stopped_at: the checkpoint of this very run, to continue from.

    Raises:
        ConfigError: a wrong value or path, or values that do not go together.
    """
    config, source = resolve(cfg, overrides)
    torch.set_num_threads(config.run.threads)
    torch.manual_seed(config.run.seed)
    parts = assemble(config, output_dir)
    trainer = Trainer(config, parts, output_dir)
    source = stopped_at or source
    if source is not None:
        trainer.restore(source)
    output_dir.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(OmegaConf.create(config.to_dict()), output_dir / "config.yaml")
    is_interrupted = config.run.mode != "eval" and trainer.train()
    print(trainer.recorder.finish(trainer.frames, trainer.wall_s, trainer.cpu_s, not is_interrupted))
    print(f"Everything is in {output_dir}")
    if is_interrupted:
        mode = "" if config.run.mode == "train" else f"mode={config.run.mode} "
        print(f"Stopped at {trainer.frames:,}{trainer.unit}; to go on: python run.py {mode}resume={output_dir}")
    return 130 if is_interrupted else 0


class Trainer:
    """The training loop and its progress.

    A frame is what a run is counted in: a step, with frozen learners a decision, with `mode=offline` an update.

    Args:
        config: of the run.
        parts: built from it.
        output_dir: the run's folder.
    """

    def __init__(self, config: Config, parts: Parts, output_dir: Path) -> None:
        self.config = config
        self.parts = parts
        self.output_dir = output_dir
        self.recorder = Recorder(config, parts, output_dir)
        self.frames = 0
        self.wall_s = 0.0
        self.cpu_s = 0.0
        self.last_score: float | None = None  # at the last evaluation
        self.unit = " steps"
        if config.run.mode == "offline":
            self.unit = " updates"
        elif config.run.low.freeze:
            self.unit = " decisions"

    def restore(self, source: Path) -> None:
        """Take the agent from a checkpoint and, to continue training, the progress of its run."""
        is_training = self.config.run.mode != "eval"
        env_state = checkpoint.load(source, self.parts.agent, self.parts.device, is_training)
        progress = checkpoint.progress_of(source)
        self.frames = progress["frames"]
        self.wall_s = progress["wall_s"]
        self.cpu_s = progress["cpu_s"]
        self.last_score = progress["last_score"]
        if not is_training:
            self.parts.env.set_statistics(env_state)
            return
        try:
            self.parts.env.set_env_state(env_state)
        except ValueError as error:
            raise ConfigError(f"num_envs={self.config.run.num_envs}: {error}; leave it out when you resume") from error
        self.recorder.resume_from(source.parent, self.frames)

    def train(self) -> bool:
        """Train until `num_frames` or `eval.stop_score` and save the agent; return whether the user interrupted it."""
        collection = self.config.collector.build(config=self.config, parts=self.parts, frames=self.frames)
        total = self.config.run.num_frames
        bar = tqdm(total=total, initial=self.frames, unit=self.unit, unit_scale=True, mininterval=1.0)
        previous = signal.signal(signal.SIGTERM, signal.default_int_handler)  # a cluster's stop is a Ctrl-C
        try:
            self._loop(collection, bar)
            return False
        except KeyboardInterrupt:
            return True
        finally:
            # Saving must not be interrupted.
            handlers = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
            bar.close()
            self.save(collection)
            collection.close()
            signal.signal(signal.SIGINT, handlers[signal.SIGINT])
            signal.signal(signal.SIGTERM, previous)

    def _loop(self, collection: Collection, bar: tqdm) -> None:
        wall_before, cpu_before = self.wall_s - time.perf_counter(), self.cpu_s - time.process_time()
        if self.last_score is None and self.frames == 0:
            self._evaluate(bar)
            if self.parts.data is not None:
                self.parts.agent.add_demonstrations(self.parts.data)
        while not self._is_over():
            num = self._learn(collection)
            last, self.frames = self.frames, self.frames + num
            self.wall_s = wall_before + time.perf_counter()
            self.cpu_s = cpu_before + time.process_time() + collection.cpu_s
            bar.update(num)
            if self.frames >= self.config.run.num_frames or _is_due(last, self.frames, self.config.run.eval_every):
                self._evaluate(bar)
            elif _is_due(last, self.frames, self.config.run.log_every):
                self.recorder.log(self.frames, self.wall_s, is_evaluated=False)
            if not self._is_over() and _is_due(last, self.frames, self.config.run.checkpoint_every):
                self.save(collection)

    def _learn(self, collection: Collection) -> int:
        """Let the agent learn from a batch of steps or from the data set; return the number of frames."""
        if self.config.run.mode == "offline":
            num = min(_UPDATES_A_TURN, self.config.run.num_frames - self.frames)
            self.recorder.take(None, self.parts.agent.update(num))
            return num
        batch = collection.next()
        self.recorder.take(batch, self.parts.agent.learn(batch))
        return batch.numel()

    def _is_over(self) -> bool:
        stop_score, last_score = self.config.run.eval.stop_score, self.last_score
        is_reached = stop_score is not None and last_score is not None and last_score >= stop_score
        return is_reached or self.frames >= self.config.run.num_frames

    def _evaluate(self, bar: tqdm) -> None:
        row = self.recorder.log(self.frames, self.wall_s, is_evaluated=True)
        success = f", success {row['eval/success']:.1%}" if "eval/success" in row else ""
        self.last_score = row["eval/score"]
        bar.set_postfix_str(f"score {self.last_score:.2f}{success}")

    def save(self, collection: Collection) -> None:
        """Write the checkpoint."""
        progress = {
            "config": self.config.to_dict(),
            "frames": self.frames,
            "wall_s": self.wall_s,
            "cpu_s": self.cpu_s,
            "last_score": self.last_score,
        }
        checkpoint.save(self.output_dir / checkpoint.FILE_NAME, self.parts.agent, collection.env_state(), progress)


def _is_due(before: int, now: int, every: int) -> bool:
    """Return whether a multiple of `every` was passed; never if it is 0."""
    return every > 0 and now // every > before // every
