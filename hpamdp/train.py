"""One run: build everything, then the loop: next batch, learn, log, evaluate if due, save if due."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from tqdm import tqdm

from hpamdp import checkpoint, keys, plots
from hpamdp.assemble import Parts, assemble, random_policy, resolve
from hpamdp.config import ConfigError
from hpamdp.env.physics import SUCCESS
from hpamdp.evaluate import measure
from hpamdp.metrics import MetricsFile, closing_table
from hpamdp.summary import summarise


def run(cfg: DictConfig, output_dir: Path, overrides: Sequence[str] = ()) -> int:
    """Train or score an agent as `cfg` says, write everything under `output_dir`, return the exit code.

    Args:
        cfg: the composed config.
        output_dir: a folder, made if need be.
        overrides: the command line's words, which change a resumed run's config.

    Raises:
        ConfigError: a value, a path or a pair of choices that cannot be.
    """
    cfg, settings, source = resolve(cfg, overrides)
    output_dir.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(cfg, output_dir / "config.yaml", resolve=True)
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    parts = assemble(cfg, settings, output_dir)
    trainer = Trainer(cfg, settings, parts, output_dir)
    if source is not None:
        trainer.restore(source)
    is_interrupted = False
    if settings.mode == "train" and trainer.frames < settings.total_frames:
        is_interrupted = trainer.train()
    trainer.finish()
    if is_interrupted:
        print(f"Interrupted at {trainer.frames:,} presses. Go on with: python run.py resume={output_dir}")
    return 130 if is_interrupted else 0


class Trainer:
    """The loop and its bookkeeping."""

    def __init__(self, cfg: DictConfig, settings: Any, parts: Parts, output_dir: Path) -> None:
        self.cfg, self.settings, self.parts, self.output_dir = cfg, settings, parts, output_dir
        self.frames, self.wall_s = 0, 0.0
        self.metrics = MetricsFile(output_dir / "metrics.csv")
        self.episodes: list[TensorDictBase] = []
        self.scalars: dict[str, float] = {}
        self.has_choice = parts.agent.selector is not None
        self.random = measure(parts.evaluation.run(random_policy(parts)), self.has_choice)

    def restore(self, source: Path) -> None:
        """Take the agent from a checkpoint and, to train on, where its run stood."""
        is_training = self.settings.mode == "train"
        env_state = checkpoint.load(source, self.parts.agent, self.parts.device, is_training)
        progress = checkpoint.progress_of(source)
        self.frames, self.wall_s = progress["frames"], progress["wall_s"]
        if not is_training:
            return
        state = self.parts.env.state
        if env_state["episode"].shape != state.episode.shape:
            had, given = len(env_state["episode"]), self.settings.num_envs
            raise ConfigError(f"num_envs={given}: the run to resume had {had}; leave this out")
        self.parts.env.state = type(state)(**env_state)
        self.metrics = MetricsFile(self.metrics.path, source.parent / "metrics.csv", self.frames)

    def train(self) -> bool:
        """Run until `total_frames`; return whether the user stopped it before. Either way the agent is saved."""
        settings, parts = self.settings, self.parts
        collector = Collector(
            parts.env,
            parts.agent.policy,
            frames_per_batch=settings.num_envs * settings.steps_per_batch,
            total_frames=-1,
            auto_register_policy_transforms=False,
        )
        bar = tqdm(total=settings.total_frames, initial=self.frames, unit=" presses", unit_scale=True, mininterval=1.0)
        previous = signal.signal(signal.SIGTERM, signal.default_int_handler)  # a cluster's stop is a Ctrl-C
        before = self.wall_s
        started = time.perf_counter()
        try:
            if self.frames == 0:
                self._log(bar, is_evaluated=True)
            for batch in collector:
                self.scalars |= parts.agent.learn(batch)
                self.episodes.append(_finished(batch))
                last, self.frames = self.frames, self.frames + batch.numel()
                self.wall_s = before + time.perf_counter() - started
                bar.update(batch.numel())
                is_over = self.frames >= settings.total_frames
                if is_over or _is_due(last, self.frames, settings.eval.every):
                    self._log(bar, is_evaluated=True)
                elif _is_due(last, self.frames, settings.log_every):
                    self._log(bar, is_evaluated=False)
                if not is_over and _is_due(last, self.frames, settings.checkpoint_every):
                    self.save()
                if is_over:
                    return False
        except KeyboardInterrupt:
            return True
        finally:
            signal.signal(signal.SIGTERM, signal.SIG_IGN)  # nothing may cut the saving short
            bar.close()
            self.save()
            collector.shutdown(close_env=False)
            signal.signal(signal.SIGTERM, previous)
        return False

    def save(self) -> None:
        """Write the checkpoint."""
        progress = {
            "config": OmegaConf.to_container(self.cfg, resolve=True),
            "frames": self.frames,
            "wall_s": self.wall_s,
        }
        path = self.output_dir / checkpoint.FILE_NAME
        checkpoint.save(path, self.parts.agent, self.parts.env.state._asdict(), progress)

    def finish(self) -> None:
        """Evaluate, write the summary and the pictures, print the closing table."""
        played = self.parts.evaluation.run(self.parts.agent.policy)
        np.savez_compressed(self.output_dir / "evaluation.npz", **played)
        measured = measure(played, self.has_choice)
        summary = summarise(self.cfg, measured, self.random, self.frames, self.wall_s)
        (self.output_dir / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
        pictures = plots.draw_all(self.output_dir)
        self.parts.logger.images(pictures)
        self.parts.logger.summary(summary)
        self.parts.logger.close()
        print(closing_table(summary))
        print(f"Everything is in {self.output_dir}")

    def _log(self, bar: tqdm, is_evaluated: bool) -> None:
        row = {"frames": float(self.frames), "wall_s": self.wall_s, **self._training_scores(), **self.scalars}
        if is_evaluated:
            measured = measure(self.parts.evaluation.run(self.parts.agent.policy), self.has_choice)
            row |= {f"eval/{name}": value for name, value in measured.items()}
            bar.set_postfix_str(f"score {measured['score']:.2f}, success {measured['success']:.1%}")
        self.metrics.append(row)
        self.parts.logger.log(row, self.frames)
        self.episodes, self.scalars = [], {}

    def _training_scores(self) -> dict[str, float]:
        """Return the means over the exploring episodes that ended since the last row."""
        if not self.episodes or not sum(len(ended) for ended in self.episodes):
            return {}
        ended = torch.cat(self.episodes)
        scores = {
            "train/score": self.parts.env.score(ended).mean().item(),
            "train/success": (ended[keys.OUTCOME] == SUCCESS).float().mean().item(),
            "train/return": ended[keys.OPTION_RETURN].mean().item(),
            "train/presses": ended[keys.OPTION_STEPS].float().mean().item(),
        }
        if self.has_choice:
            for i, name in enumerate(self.parts.agent.specs.option_names):
                scores[f"train/option_{name}"] = (ended[keys.OPTION] == i).float().mean().item()
        return scores


def _finished(batch: TensorDictBase) -> TensorDictBase:
    """Return the last steps of the batch's finished episodes, `[N]`."""
    is_end = batch.get(("next", keys.DONE)).squeeze(-1)
    ended = batch.get("next").select(keys.OUTCOME, keys.FUEL, keys.OPTION_RETURN, keys.OPTION_STEPS)[is_end]
    option = batch.get(keys.OPTION, None)
    return ended if option is None else ended.set(keys.OPTION, option[is_end])


def _is_due(before: int, now: int, every: int) -> bool:
    """Return whether a multiple of `every` was passed; never where it is 0."""
    return every > 0 and now // every > before // every
