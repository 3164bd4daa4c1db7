"""Run with wrong settings, one at a time, and list the settings that are not refused in one line."""

from __future__ import annotations

import argparse
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import command_line
import yaml

from hpamdp.config.components import SUPPLIED_ARGUMENTS, defaults_of, load_class, settings_model
from hpamdp.messages import exit_code

CONF = command_line.REPOSITORY / "conf"
SMALL = ["num_envs=4", "steps_per_batch=2", "total_frames=16", "eval.layouts=4", "eval.every=0"]
# Values with which learners and selectors make an update in so short a run.
SHORT = {
    "warmup_steps": 8, "warmup_decisions": 8, "minibatch_size": 8, "updates_per_step": 0.5,
    "updates_per_decision": 0.5, "codec_pretrain_updates": 2,
}  # fmt: skip
DEFAULTS = {"high": "ucb", "low": "hyar"}
# Values that are wrong for each type.
WRONG: dict[type, tuple[str, ...]] = {
    int: ("banana", "[1,2]", "-7", "1.5", "nan", "1e12", "null"),
    float: ("banana", "[1,2]", "-1e30", "nan", "1e30"),
    bool: ("banana", "3", "[true]"),
    str: ("banana", "[a]", "7"),
    list: ("banana", "-3", "[banana]", "{a:1}"),
}
# Settings that take any word, or any number of that size.
FREE = {
    ("logger", "project"), ("logger", "entity"), ("logger", "group"), ("logger", "name"), ("run", "seed"),
    ("data", "checksum"), ("env", "kwargs"), ("run", "low.checkpoint"), ("run", "eval.stop_score"),
}  # fmt: skip
# Settings that go with a choice of a group, so that only the wrong value is wrong.
WITH = {
    "env/gymnasium": ["env.id=hpamdp/BoatDock-v0", "high=none", "low=random"],
    "env/platform": ["high=none", "low=random"],
    "high/none": ["env.controller=congruent", "low=random"],
    "data/human": ["low=random"],
}
BY_HAND = [
    "lo=hppo", "low", "=3", "low=", "low=hpo", "low=HPPO", "low=../env/boatdock", "low=../low/hppo", "low=/etc/passwd",
    "high=ucb,linucb", "env=boat dock", "low.lr", "low.lr=", "+low.lr=3", "++low.nothing=1", "low.hidden_dims.0=banana",
    "~low", "~low.gamma", "mode=trian", "mode=eval", "mode=offline", "mode=", "resume=", "resume=nowhere",
    "checkpoint=nowhere", "low.checkpoint=nowhere", "checkpoint=/dev/null mode=eval", "resume=/etc/passwd",
    "mode=eval checkpoint=.", "resume=. checkpoint=.", "hydra.run.dir=", "hydra.run.dir=.", "hydra.run.dir=/proc/run",
    "hydra.run.dir=/dev/null/run", "device=cuda:99", "device=tpu", "device=meta", "threads=0", "threads=1000000",
    "num_envs=0", "num_envs=1000000000", "steps_per_batch=1000000000", "eval.layouts=1000000000",
    "low=pdqn low.buffer_size=100000000000", "low=pdqn low.batch_size=10000000000", "low.hidden_dims=[1000000000]",
    "low=hppo low.hidden_dims=[]", "low=hppo low.hidden_dims=[0]", "low=hppo low.hidden_dims=[-1]",
    "low=hppo low.min_scale_final=2", "low=hppo low.min_scale=5", "low=qpamdp low.features=[]",
    "low=qpamdp low.features=[99]", "low=qpamdp low.phi_order=1000", "low.budget.num_envs=-1", "low.budget.nothing=1",
    "high=linucb high.inputs=[99]", "high=linucb high.degree=1000", "high=linucb high.inputs=[]",
    "high=human env=platform", "high=oracle env=platform", "high=ucb env=platform low=random",
    "high=none env.controller=choose", "high=ucb env.controller=congruent", "high=fixed high.option=3",
    "low=planner env=platform high=none", "low=bc", "low=td3_bc mode=train", "mode=offline data=none low=iql",
    "data=human env=platform high=none low=pdqn", "data=human data.path=nowhere", "data=human data.path=/etc/passwd",
    "data=human high=exp3 mode=offline low=iql", "collector=multi collector.num_workers=3",
    "collector=multi num_envs=5",
    "collector=multi collector.num_workers=0", "collector=multi collector.num_workers=100000", "logger=wnadb",
    "logger=wandb logger.project='a/b#c'", "logger=wandb logger.mode=sometimes", "agent.option_length=0",
    "agent.termination=never", "agent.sharing=none", "agent.practice=-1", "eval.seed=-1",
    "eval.seed=banana", "eval.stop_score=banana", "eval.layouts=0", "eval.every=-1", "log_every=0",
    "checkpoint_minutes=-1", "checkpoint_every=-1", "seed=1.5", "seed=-1", "env=gymnasium high=none low=random",
    "env=gymnasium env.id=CartPole-v1 high=none low=random", "env=gymnasium env.id=Nothing-v0 high=none low=random",
    "env=gymnasium env.id=nothing:Nothing-v0 high=none low=random", "experiment=nothing",
    "env=gymnasium env.entry_point=os:getcwd high=none low=random env.max_steps=3", 
    "env=gymnasium env.entry_point=nowhere high=none low=random", "low._target_=os.system", "low._target_=nothing",
    "env._target_=hpamdp.policies.low_level.hppo.HPPO", "low=hppo low=pdqn", "--multirun", "--nothing", "-m low",
    "--cfg", "--cfg nothing", "--config-name=nothing", "--config-dir=nowhere", "--multirun low=hppo --cfg job",
    "'low=hppo", "low=hppo}", "low={a", "low=[hppo", "low=\u202ehppo", "\u0000=1", "low=h\u00f6ppo", "seed=\u0661x",
    "env.motor_noise=1e30", "env.slip=2", "env.slip=-0.5", "env.sensor_noise=inf", "env.keymap=3", "env.reward=dense",
]  # fmt: skip


def generated() -> list[str]:
    """Return words with wrong values for each setting of each choice, if the setting is not None by default."""
    words = []
    for file in sorted(CONF.glob("*/*.yaml")):
        group, choice = file.parent.name, file.stem
        if group in ("callback", "experiment", "recipe", "search") or f"{group}/{choice}" == "collector/ray":
            continue
        for setting, value in settings_of(file).items():
            if value is None or (group, setting) in FREE or isinstance(value, dict):
                continue
            for wrong in WRONG[float if _is_number(value) else type(value)]:
                with_it = WITH.get(f"{group}/{choice}", [])
                words.append(" ".join([f"{group}={choice}", *with_it, f"{group}.{setting}={wrong}"]))
    return words


def settings_of(file: Path) -> dict[str, Any]:
    """Return the settings of a choice: the defaults of its class, and the values of its yaml file."""
    values = yaml.safe_load(file.read_text())
    target = values.pop("_target_")
    if target is None:
        return values
    model = settings_model(load_class(target), SUPPLIED_ARGUMENTS.get(file.parent.name, ()))
    return {**defaults_of(model), **values}


def short(given: list[str]) -> list[str]:
    """Return the words that shorten the warm-ups of the chosen learner and selector."""
    chosen = DEFAULTS | dict(word.split("=", 1) for word in given if word.startswith(("high=", "low=")))
    words = []
    for group, choice in chosen.items():
        file = CONF / group / f"{choice}.yaml"
        settings = settings_of(file) if choice.isidentifier() and file.is_file() else {}
        words += [f"{group}.{setting}={value}" for setting, value in SHORT.items() if setting in settings]
    return words


def _is_number(value: Any) -> bool:
    # YAML reads 1e-3 as a word.
    if isinstance(value, str):
        try:
            float(value)
        except ValueError:
            return value.startswith("${")
        return True
    return isinstance(value, float)


def main() -> None:
    """Print the cases that were not refused in one line, and the counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", type=int, default=300, help="hand-written ones first, then generated ones")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    others = generated()
    random.Random(arguments.seed).shuffle(others)
    cases = [*BY_HAND, *others][: arguments.cases]
    counts: Counter[str] = Counter()
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        for number, case in enumerate(cases):
            given = case.split(" ")
            keys = {word.partition("=")[0] for word in given}
            small = [word for word in [*SMALL, *short(given)] if word.partition("=")[0] not in keys]
            ending = command_line.run([*small, *given], Path(temporary) / str(number), 60.0)
            if ending.code == 2 and ending.is_one_line:
                kind = "one line"
            elif ending.code == 0:
                kind = "accepted"
            elif any("Traceback" in line for line in ending.errors):
                kind = "traceback"
            else:
                kind = "other"
            counts[kind] += 1
            if kind != "one line":
                said = ending.errors[-1] if ending.errors else ""
                print(f"{kind:<10} {ending.code!s:<5} {case!r}: {len(ending.errors)} lines; {said[:160]}", flush=True)
    print(f"{len(cases)} settings in {time.monotonic() - begin:.0f} s: {dict(counts)}")


if __name__ == "__main__":
    sys.exit(exit_code(main))
