"""Define the values of a run, and hold the checked config of a run in one object."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Literal

import yaml
from pydantic import AfterValidator, BeforeValidator, Field, NonNegativeInt, PositiveInt

from hpamdp.config.components import CALLBACK, GROUPS, TARGET, Component, check_base_class, component
from hpamdp.config.errors import ConfigError, validated
from hpamdp.settings import FromList, NumAtOnce, Settings

if TYPE_CHECKING:
    import torch  # takes seconds

RUN_FILE = "conf/config.yaml"
# The value of `resume` that continues the run in its own folder, or starts it there.
RESUME_AUTO = "auto"

Seed = Annotated[int, Field(ge=0, lt=2**32)]  # NumPy takes no larger ones


def _check_device(name: Any) -> Any:
    if not isinstance(name, str) or not re.fullmatch(r"auto|cpu|cuda(:\d{1,2})?", name):
        raise ValueError("must be auto, cpu, cuda or cuda:N")
    return name


# Empty would be the working directory.
SavedRun = Annotated[str, Field(min_length=1)]
Device = Annotated[str, BeforeValidator(_check_device)]


def usable_device(name: str) -> torch.device:
    """Return the device of a setting; `auto` is CUDA if there is a device.

    Raises:
        ConfigError: this machine does not have the device.
    """
    import torch

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return torch.device("cuda" if count else "cpu")
    device = torch.device(name)
    if device.type == "cuda" and (device.index or 0) >= count:
        there = f"has CUDA devices 0 to {count - 1}" if count else "has no usable CUDA device"
        raise ConfigError(f"device={name}: this machine {there}; use device=auto or device=cpu")
    return device


def _check_increasing(lengths: tuple[int, ...]) -> tuple[int, ...]:
    if not lengths or any(one >= two for one, two in pairwise(lengths)):
        raise ValueError("must be increasing numbers")
    return lengths


class AgentConfig(Settings):
    """Settings of how selector and learners act together."""

    sharing: Literal["per_option", "shared"] = "per_option"
    """`per_option`: one learner for each option. `shared`: one learner for all options, which observes the option."""
    termination: Literal["episode", "steps", "learned", "chosen"] = "episode"
    """When options end: with the episode, after `option_length` steps, or at any step if the selector decides so.

    If an episode is a session of trips, options also end with their trips.
    `chosen`: the selector chooses an option, and its length from `option_lengths`.
    """
    option_length: PositiveInt | None = None
    """Steps of an option, with `termination=steps` only."""
    option_lengths: Annotated[tuple[PositiveInt, ...], FromList, AfterValidator(_check_increasing)] | None = None
    """With `termination=chosen`: lengths to choose from, in steps, increasing. If null, 1, 2, 4, 8, 16, 32, 64, 128."""
    values_end: Literal["session", "trip"] = "session"
    """How far values look, if an episode is a session of trips: to the end of the `session`, or of the `trip`."""
    selector_values_end: Literal["session", "trip"] | None = None
    """How far the selector's values look. If null, as far as `values_end`, which then holds for both levels."""
    practice: Literal["auto", "curves"] | NonNegativeInt = "auto"
    """Which options practise while their learners improve, whatever the selector would choose.

    `curves`: an option behind the best one, if its learner would gain more from the practice that is left; otherwise
    all options equally in the first half of the run, and the selector's choice in the second. A number: all options
    equally, for so many steps at the start of training (decisions with `low.freeze=true`); 0 leaves practice to the
    selector. `auto`: `curves` if the selector sees the state, options last as long as their episodes, and each has its
    own learner; otherwise 0.
    """


class EnvConfig(Settings):
    """Settings that every problem has."""

    grouping: Literal["default"] | dict[str, list[int | str]] | None = None
    """Options as sets of discrete actions: `{NAME: [ACTION, ...], ...}`, or `default` for the problem's suggestion."""


class LowConfig(Settings):
    """Settings that every learner has: what it starts with, whether it learns, and the learners of single options."""

    checkpoint: SavedRun | None = None
    """Earlier run from which the learners' networks are loaded: its output folder, or the checkpoint in it."""
    freeze: bool = False
    """Keep the learners as they are and train only the selector. Frames are then decisions."""
    per_option: dict[str, str | dict[str, Any]] | None = None
    """Learners of single options: `{OPTION: LEARNER}`, or `{OPTION: {name: LEARNER, SETTING: VALUE, ...}}`."""


class OfflineConfig(Settings):
    """Settings of training from a data set alone."""

    updates: PositiveInt = 5000
    """Updates of each learner, and of a selector that learns by updates, with `mode=offline`."""
    eval_every: NonNegativeInt = 500
    """Updates between two evaluations. If 0, only at the start and at the end."""


class EvalConfig(Settings):
    """Settings of evaluations."""

    every: NonNegativeInt | Literal["auto"]
    """Steps between two evaluations. If 0, only at the start and at the end.

    Default: what the learner or the problem recommends. `auto`: a fifth of `total_frames`, at most 40,000, and none at
    the start. After the first, evaluations are skipped while they have taken more than 5 % as many steps as training.
    The last one is never skipped.
    """
    layouts: NumAtOnce
    """Number of episodes of an evaluation. The agent acts greedily, and every evaluation has the same episodes.

    Default: 1,000, or what the learner or the problem recommends.
    """
    seed: Seed = 0
    """Seed of these episodes."""
    stop_score: float | None = None
    """Score at which training ends, as soon as an evaluation reaches it. If null, training goes to its full length."""


class RunConfig(Settings):
    """Values of the run as a whole."""

    mode: Literal["train", "offline", "eval"] = "train"
    """`train`: learn from the agent's own steps. `offline`: from a data set alone. `eval`: only score a checkpoint."""
    seed: Seed = 0
    """Seed of everything random in training: episodes, exploration, initial weights."""
    device: Device = "auto"
    """`auto` (CUDA if there is a device, else the CPU), `cpu`, `cuda` or `cuda:N`."""
    threads: Annotated[int, Field(ge=1, le=1024)] = 1
    """CPU threads of the learner. Small networks train fastest with one."""
    compile_updates: bool | Literal["auto"] = "auto"
    """Compile the learners' updates by `torch.compile`. If `auto`, only with a compiler and in a long enough run."""
    update_precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of the hidden layers in updates. bfloat16 is faster only with hardware support and large networks."""
    agent: AgentConfig = AgentConfig()
    env: EnvConfig = EnvConfig()
    low: LowConfig = LowConfig()
    total_frames: PositiveInt
    """Steps of training, over all environments. Default: the learner's recommendation."""
    num_envs: NumAtOnce
    """Number of parallel environments. Default: the learner's recommendation."""
    steps_per_batch: NumAtOnce
    """Steps of each environment in a batch, after which the agent learns. Default: the learner's recommendation."""
    log_every: NonNegativeInt = 5000
    """Steps between two rows of metrics.csv. If 0, rows are written only with evaluations."""
    offline: OfflineConfig = OfflineConfig()
    eval: EvalConfig
    checkpoint_every: NonNegativeInt = 0
    """Steps between two checkpoints. If 0, steps trigger no checkpoint."""
    checkpoint_minutes: Annotated[float, Field(ge=0.0)] = 5.0
    """Minutes between two checkpoints. A killed run loses at most these. If 0, time triggers no checkpoint."""
    checkpoint_replay: bool = True
    """Save the replay buffers in checkpoints. Without them, a resumed learner starts with an empty buffer."""
    checkpoint: SavedRun | None = None
    """Agent to score with `mode=eval`: the output folder of a run, or the checkpoint in it."""
    resume: SavedRun | None = None
    """Run to continue: its output folder, or the checkpoint in it.

    `auto` continues the run in `hydra.run.dir` if it has the same config, or starts a new run if the folder holds none.
    """
    trust: bool = False
    """Let the file of `resume` or `checkpoint` give settings that can run code, read files or reach servers.

    If false, such settings (`env.entry_point`, for example) must be on the command line, too.
    """
    overwrite: bool = False
    """Delete another run in the output folder, right before this one writes its first file."""
    callbacks: Annotated[tuple[str | dict[str, Any], ...], FromList] = ()
    """Callbacks of training, in their order: `[NAME, {name: NAME, SETTING: VALUE, ...}, ...]`."""
    save_best: bool = True
    """Keep the agent of the best evaluation in best.safetensors.

    With `mode=train`, it takes the place of the last one if that is clearly worse: by more than two standard errors.
    """
    film: bool = True
    """Write episodes.gif, which shows three episodes of the agent's last evaluation."""

    @property
    def num_frames(self) -> int:
        """Length of training: updates with `mode=offline`, decisions with frozen learners, otherwise steps."""
        return self.offline.updates if self.mode == "offline" else self.total_frames

    @property
    def eval_every(self) -> int:
        """Distance between two turns for an evaluation, in the unit of `num_frames`; 0 if only at start and end."""
        if self.mode == "offline":
            return self.offline.eval_every
        return max(1, min(40_000, self.total_frames // 5)) if self.eval.every == "auto" else self.eval.every

    @property
    def limits_evaluations(self) -> bool:
        """Whether evaluations are skipped while they have taken many steps."""
        return self.mode == "train" and self.eval.every == "auto"

    def resolve_device(self) -> torch.device:
        """Return the device to run on.

        Raises:
            ConfigError: this machine does not have the device.
        """
        return usable_device(self.device)


@dataclass(frozen=True)
class Config:
    """The checked config of a run."""

    run: RunConfig
    env: Component
    high: Component
    low: Component
    encoder: Component
    exploration: Component
    data: Component
    logger: Component
    collector: Component
    low_of: Mapping[str, Component] = field(default_factory=dict)
    callbacks: tuple[Component, ...] = ()
    # Folders of yaml files beside conf/ that were searched.
    config_dirs: tuple[str, ...] = field(default=(), compare=False)

    @property
    def learners(self) -> list[Component]:
        """The learner `low` and the learners of single options."""
        return [self.low, *self.low_of.values()]

    def with_run(self, **values: Any) -> Config:
        """Return the config with other, checked values of the run."""
        return replace(self, run=self.run.model_copy(update=values))

    def with_objects(self, objects: Mapping[str, Any] | None) -> Config:
        """Return the config with arguments for the problem's constructor that no file can hold."""
        return replace(self, env=replace(self.env, objects=objects)) if objects else self

    def to_dict(self) -> dict[str, Any]:
        """Return the config as plain values, the form in which a run saves it.

        Values are nested as on the command line, such as `low` / `lr`. `choices` holds the choice of each group, so
        that a class may have a setting of any name.
        """
        values = self.run.model_dump(mode="json", exclude={"trust"})
        values["choices"] = {group: getattr(self, group).name for group in GROUPS}
        for group in GROUPS:
            part: Component = getattr(self, group)
            settings = json.loads(json.dumps(dict(part.settings)))  # tuples become lists
            values[group] = {**settings, **values.get(group, {})}
        return values

    def to_yaml(self) -> str:
        """Return `to_dict` as yaml. A reader must not resolve text that looks like an interpolation."""
        return yaml.safe_dump(self.to_dict(), sort_keys=False, allow_unicode=True)


def check_run(given: Mapping[str, Any]) -> RunConfig:
    """Check the values of the run.

    Args:
        given: the values of the run, including its values in the groups `env` and `low`.

    Raises:
        ConfigError: a wrong value.
    """
    values = {name: value for name, value in given.items() if name not in GROUPS}
    own: dict[str, type[Settings]] = {"env": EnvConfig, "low": LowConfig}
    for group, entries in own.items():
        values[group] = {name: given[group][name] for name in entries.model_fields if name in given[group]}
    return validated(RunConfig, values, "", f"value of the run ({RUN_FILE})", RUN_FILE)


def checked_config(
    run: RunConfig,
    given: Mapping[str, Any],
    names: Mapping[str, str],
    learners: Mapping[str, tuple[str, Any]],
    callbacks: Sequence[tuple[str, Any]],
) -> Config:
    """Check the classes and the settings of all groups.

    Args:
        run: the checked values of the run.
        given: a mapping of `_target_` and the settings for each group. Text in it is not resolved.
        names: the name that was chosen for each group.
        learners: for single options, by the option's name: the learner's name, and a mapping as for a group.
        callbacks: the name of each callback, and a mapping as for a group.

    Raises:
        ConfigError: a wrong value.
    """
    components: dict[str, Any] = {group: _chosen(group, names[group], given[group]) for group in GROUPS}
    low_of = {
        option: _chosen("low", name, low, f"low.per_option.{option}.") for option, (name, low) in learners.items()
    }
    called = [_chosen(CALLBACK, name, each, f"callbacks.{i}.") for i, (name, each) in enumerate(callbacks)]
    # With all their settings, so that a saved run keeps them if their yaml files change.
    if called:
        in_full_list = tuple({"name": each.name, **each.settings} for each in called)
        run = run.model_copy(update={"callbacks": in_full_list})
    if low_of:
        in_full = {option: {**low.settings, "name": low.name} for option, low in low_of.items()}
        run = run.model_copy(update={"low": run.low.model_copy(update={"per_option": in_full})})
    return Config(run, **components, low_of=low_of, callbacks=tuple(called))


def _chosen(group: str, name: str, given: Mapping[str, Any], prefix: str = "") -> Component:
    check_base_class(group, name, given.get(TARGET))
    return component(group, name, given, prefix)
