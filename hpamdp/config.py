"""What a user may set, checked once, before anything is built.

`read` turns the composed yaml files into a `Config`. The run's own values are those of `RunConfig`. The options of a
class are the arguments of its constructor: its signature is the schema of its yaml, and there is no other list of them.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import json
import linecache
import re
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeGuard, get_type_hints

import hydra
import yaml
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveInt,
    PydanticUserError,
    ValidationError,
    create_model,
)

from hpamdp.memory import is_about_memory
from hpamdp.messages import first_line
from hpamdp.settings import Settings

if TYPE_CHECKING:
    import torch  # takes seconds, and the help page needs this module too

# The groups of conf/, and the constructor arguments that the program supplies; all others are set in the yaml.
GROUPS: dict[str, tuple[str, ...]] = {
    "env": ("num_envs", "device", "seed", "first_env", "dtype", "oracle", "human"),
    "high": ("specs", "device"),
    "low": ("specs", "device"),
    "data": ("env",),
    "logger": ("output_dir", "config", "earlier"),
    "collector": ("config", "parts", "frames"),
}
RUN_FILE = "conf/config.yaml"
TARGET = "_target_"
NESTED = "a yaml file names itself among its defaults, or a value nests too deep"
RECIPE = "recipe"
# The base class of each group's classes. If it is a protocol, a class only needs its methods.
_KINDS = {
    "env": "hpamdp.env.base.PAMDPEnv",
    "high": "hpamdp.policies.base.Selector",
    "low": "hpamdp.policies.base.Learner",
    "data": "hpamdp.data.demonstrations.Demonstrations",
    "logger": "hpamdp.run.loggers.Logger",
    "collector": "hpamdp.run.collection.base.Collection",
}

_CAN_BE_NONE = ("high", "data")
_MOST_COMPLAINTS = 3
_LONGEST_NAME, _LONGEST_VALUE = 200, 300  # of a yaml file, and of a value in a message
_SHOWN = 200  # letters of a command line in an error
# Larger numbers leave those that a computation can hold; infinity is refused as well.
_LARGEST_FLOAT, _LARGEST_INT = 1e12, 2**63 - 1
# Entries of a group that are values of the run, not options of its class.
RUN_ENTRIES: dict[str, tuple[str, ...]] = {"low": ("budget", "checkpoint", "freeze", "per_option"), "env": ("options",)}
# Entries of a learner that the learner of a single option cannot have, and what to do instead.
_NOT_PER_OPTION = {
    TARGET: "a yaml file names the class; give the name of the file",
    "budget": "a run has one budget; set total_frames, num_envs, steps_per_batch or eval.every",
    "checkpoint": "a checkpoint fills all learners; set low.checkpoint",
    "freeze": "all learners are frozen or none; set low.freeze",
    "per_option": "an option has one learner",
}

_STRICT = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False, protected_namespaces=())

Seed = Annotated[int, Field(ge=0, lt=2**32)]  # NumPy takes no larger ones


class ConfigError(ValueError):
    """A user's mistake, told in one line."""


class MissingChoiceError(ConfigError):
    """A choice whose yaml file is in none of the searched folders.

    Attributes:
        known: the names that exist in the group.
    """

    def __init__(self, choice: str, known: Iterable[str]) -> None:
        super().__init__(f"the saved run chose {choice}, which is not there; is a --config-dir missing?")
        self.known = tuple(known)


def _check_device(name: str) -> str:
    if not re.fullmatch(r"auto|cpu|cuda(:\d{1,2})?", name):
        raise ValueError("must be auto, cpu, cuda or cuda:N")
    return name


class EvalConfig(BaseModel):
    """How agents are scored."""

    model_config = _STRICT

    every: NonNegativeInt
    layouts: PositiveInt
    seed: Seed
    stop_score: float | None


class AgentConfig(BaseModel):
    """How the two levels are put together."""

    model_config = _STRICT

    sharing: Literal["per_option", "shared"]
    termination: Literal["episode", "steps", "learned"]
    option_length: PositiveInt | None
    uniform_option_frames: NonNegativeInt


class OfflineConfig(BaseModel):
    """How much is learned from a data set alone."""

    model_config = _STRICT

    updates: PositiveInt
    eval_every: NonNegativeInt


class StartConfig(BaseModel):
    """The learners that a run starts with, and which of them are of another class than `low`.

    `per_option` maps the name of an option to the name of a learner, or to its `name` and options; after the check, to
    the name and all options.
    """

    model_config = _STRICT

    checkpoint: str | None
    freeze: bool
    per_option: dict[str, str | dict[str, Any]] | None


class EnvConfig(BaseModel):
    """What can be made of any problem."""

    model_config = _STRICT

    options: Literal["default"] | dict[str, list[int | str]] | None


class BudgetConfig(BaseModel):
    """What a learner's yaml recommends; the values of a run take what is there."""

    model_config = _STRICT

    num_envs: PositiveInt | None = None
    steps_per_batch: PositiveInt | None = None
    total_frames: PositiveInt | None = None
    eval_every: NonNegativeInt | None = None


class RunConfig(BaseModel):
    """The run's own values, each explained in conf/config.yaml."""

    model_config = _STRICT

    mode: Literal["train", "offline", "eval"]
    seed: Seed
    device: Annotated[str, AfterValidator(_check_device)]
    threads: Annotated[int, Field(ge=1, le=1024)]
    agent: AgentConfig
    env: EnvConfig
    low: StartConfig
    total_frames: PositiveInt
    num_envs: PositiveInt
    steps_per_batch: PositiveInt
    log_every: NonNegativeInt
    offline: OfflineConfig
    eval: EvalConfig
    checkpoint_every: NonNegativeInt
    checkpoint_minutes: Annotated[float, Field(ge=0.0)]
    checkpoint_replay: bool
    checkpoint: str | None
    resume: str | None
    overwrite: bool
    # Runs of earlier versions did not save these.
    film: bool = True
    compile_updates: bool = False
    update_precision: Literal["float32", "bfloat16"] = "float32"

    # A permission of one command, which no file can give and no run saves.
    trust: bool = False

    @property
    def num_frames(self) -> int:
        """Length of the training: in updates with mode=offline, else in steps or decisions."""
        return self.offline.updates if self.mode == "offline" else self.total_frames

    @property
    def eval_every(self) -> int:
        """Distance between two evaluations, in the same unit; 0: only at the start and at the end."""
        return self.offline.eval_every if self.mode == "offline" else self.eval.every

    def resolve_device(self) -> torch.device:
        """Return the device to run on.

        Raises:
            ConfigError: this machine does not have it.
        """
        import torch

        count = torch.cuda.device_count() if torch.cuda.is_available() else 0
        if self.device == "auto":
            return torch.device("cuda" if count else "cpu")
        device = torch.device(self.device)
        if device.type == "cuda" and (device.index or 0) >= count:
            there = f"has CUDA devices 0 to {count - 1}" if count else "has no usable CUDA device"
            raise ConfigError(f"device={self.device}: this machine {there}; use device=auto or device=cpu")
        return device


@dataclass(frozen=True)
class Component:
    """A class that was chosen for a group, with its options.

    Attributes:
        group: such as `low`.
        name: of its yaml, such as `hyar`.
        cls: the class; None for `high=none` and `data=none`.
        options: checked arguments of its constructor.
    """

    group: str
    name: str
    cls: type | None
    options: Mapping[str, Any]

    def __str__(self) -> str:
        return f"{self.group}={self.name}"

    def is_guarded(self, name: str, value: object) -> bool:
        """Return whether a saved config may give a setting this value only if the user says so.

        The class lists such settings in `guarded_settings`, as `name`, or as `name=value` if only that value is
        guarded.
        """
        guarded = getattr(self.cls, "guarded_settings", ())
        return name in guarded or f"{name}={value}" in guarded

    def build(self, **context: Any) -> Any:
        """Build the object; None where there is no class.

        Args:
            context: what the program supplies; each goes to a constructor that has an argument of that name.

        Raises:
            ConfigError: the constructor refuses its arguments with a ValueError, or memory does not suffice.
        """
        if self.cls is None:
            return None
        accepted = constructor_arguments(self.cls)
        supplied = {name: value for name, value in context.items() if name in accepted}
        settings = {"options": options_model(self.cls)(**self.options)} if takes_options(self.cls) else self.options
        try:
            return self.cls(**supplied, **settings)
        except ValueError as error:
            if not _is_deliberate(error, self.cls):
                raise
            file = _file(self.group, self.name)
            raise ConfigError(f"{self.group}: {first_line(error)} ({self.cls.__name__}, {file})") from error
        except Exception as error:
            if not is_about_memory(error):
                raise
            raise ConfigError(f"{self.largest_sizes()}: takes more memory than there is") from error

    def largest_sizes(self) -> str:
        """Return in words the options that may have made this component too large."""
        sizes = {name: value for name, value in self.options.items() if _is_size(value)}
        largest = sorted(sizes, key=lambda name: _size(sizes[name]))[-2:]
        return ", ".join(f"{self.group}.{name}={as_json(sizes[name])}" for name in reversed(largest)) or str(self)


@dataclass(frozen=True)
class Config:
    """Everything that was set for a run, checked."""

    run: RunConfig
    env: Component
    high: Component
    low: Component
    data: Component
    logger: Component
    collector: Component
    low_of: Mapping[str, Component] = field(default_factory=dict)

    @property
    def learners(self) -> list[Component]:
        """The learner that was chosen and those of single options."""
        return [self.low, *self.low_of.values()]

    def to_dict(self) -> dict[str, Any]:
        """Return the config as plain values: what a run saves and is resumed from.

        A value has its name on the command line, such as `low` / `lr`. `choices` has the name that was chosen for each
        group, so that a class may have a setting of any name.
        """
        values = self.run.model_dump(mode="json", exclude={"trust"})
        values["choices"] = {group: getattr(self, group).name for group in GROUPS}
        for group in GROUPS:
            component: Component = getattr(self, group)
            options = json.loads(json.dumps(dict(component.options)))  # tuples become lists
            values[group] = {**options, **values.get(group, {})}
        return values

    def to_yaml(self) -> str:
        """Return `to_dict` as yaml; a reader must not resolve text that looks like an interpolation."""
        return yaml.safe_dump(self.to_dict(), sort_keys=False, allow_unicode=True)


def conf_dir() -> Path:
    """Return the folder of the yaml files."""
    folder = package_dir("conf")
    if folder is None or not (folder / "config.yaml").is_file():
        package = Path(__file__).resolve().parent
        raise ConfigError(f"there is no conf/config.yaml in {package} or beside it; install hpamdp again")
    return folder


def package_dir(name: str) -> Path | None:
    """Return a folder that lies inside the package where it is installed, and beside it in a clone; None: neither."""
    package = Path(__file__).resolve().parent
    folders = (package / name, package.parent / name)
    return next((folder for folder in folders if folder.is_dir()), None)


def read(cfg: DictConfig, choices: Mapping[str, str] | None = None) -> Config:
    """Check the composed config.

    Args:
        cfg: as Hydra composes conf/config.yaml, with or without its `hydra` part.
        choices: the name that was chosen for each group; None: those that Hydra knows.

    Raises:
        ConfigError: a wrong value, or a group for which nothing is chosen.
    """
    names = chosen_names(cfg) if choices is None else choices
    for group in GROUPS:
        if cfg.get(group) is None or TARGET not in cfg[group]:
            if names.get(group) is not None:
                raise ConfigError(f"{group}={names[group]}: {_file(group, names[group])} names no class as {TARGET}")
            raise ConfigError(f"{group}: nothing chosen; set {group}=NAME with one of the files in conf/{group}")
    own = cfg.copy()
    OmegaConf.set_struct(own, False)
    own.pop("hydra", None)
    if "hydra" in cfg or HydraConfig.initialized():
        _check_found(cfg.hydra if "hydra" in cfg else HydraConfig.get(), names)
    return check(plain(own), names)


def _check_found(node: Any, names: Mapping[str, str]) -> None:
    """Refuse a recipe or a folder of yaml files that does not exist; Hydra leaves it out without a message.

    Args:
        node: the config's `hydra` part.
        names: the name that was chosen for each group.
    """
    for path in node.searchpath:
        scheme, _, folder = str(path).rpartition("://")
        if scheme in ("", "file") and not Path(folder).is_dir():
            raise ConfigError(f"hydra.searchpath={path}: there is no such folder")
    for group, level in ((RECIPE, "low"), (f"{RECIPE}/high", "high")):
        recipe = names.get(group)
        is_said = any(word.startswith(f"{group}=") for word in _words_of(node))
        if recipe is None or (recipe == f"{names['env']}_{names[level]}" and not is_said):
            continue
        if recipe not in names_of(group):
            raise ConfigError(f"{group}={recipe}: {no_such(f'file in conf/{group}', recipe, names_of(group))}")


def check(given: Mapping[str, Any], names: Mapping[str, str]) -> Config:
    """Check the config as plain values, in which no text is resolved.

    Args:
        given: the values of the run; for each group a mapping of `_target_` and the settings.
        names: the name that was chosen for each group.

    Raises:
        ConfigError: a wrong value.
    """
    values = {name: value for name, value in given.items() if name not in GROUPS}
    values["env"] = {name: given["env"].get(name) for name in EnvConfig.model_fields}
    values["low"] = {name: given["low"].get(name) for name in StartConfig.model_fields}
    run = _validated(RunConfig, values, "", f"value of the run ({RUN_FILE})", RUN_FILE)
    if "budget" in given["low"]:
        file = _file("low", names["low"])
        budget = given["low"]["budget"]
        if not isinstance(budget, dict):
            raise ConfigError(f"low.budget={as_json(budget)}: must be a mapping ({file})")
        _validated(BudgetConfig, budget, "low.budget.", f"value of low.budget ({file})", file)
    _check_mode(run)
    for group in GROUPS:
        _check_kind(group, names[group], given[group].get(TARGET))
    components = {group: component(group, names[group], given[group]) for group in GROUPS}
    low_of = _learners_of_options(run, names["env"])
    if low_of:
        # With all their settings, so that a saved run keeps them if their yaml files change.
        in_full = {option: {**low.options, "name": low.name} for option, low in low_of.items()}
        run = run.model_copy(update={"low": run.low.model_copy(update={"per_option": in_full})})
    return Config(run, **components, low_of=low_of)


def _learners_of_options(run: RunConfig, env: str) -> dict[str, Component]:
    """Return the learner of each option in `low.per_option`: its yaml and its recipe with the given settings."""
    learners = {}
    for option, choice in (run.low.per_option or {}).items():
        given = {"name": choice} if isinstance(choice, str) else dict(choice)
        where = f"low.per_option.{option}"
        name = given.pop("name", None)
        if not is_name(name):
            raise ConfigError(f"{where}={as_json(choice)}: must be the name of a learner, or its name and options")
        for word, instead in _NOT_PER_OPTION.items():
            if word in given:
                raise ConfigError(f"{where}.{word}: {instead}")
        try:
            cfg = compose([choosing("env", env), choosing("low", name)])
        except ConfigError as error:
            raise ConfigError(f"{where}={name}: there is no {_file('low', name)}") from error
        yaml = plain_groups(cfg, run.model_dump(), ["low"])["low"]
        _check_kind("low", name, yaml.get(TARGET))
        learners[option] = component("low", name, {**yaml, **given})
    return learners


def compose_words(words: list[str]) -> DictConfig:
    """Return the config of a command line's words, with its `hydra` part, outside of Hydra's own command line.

    Raises:
        ConfigError: the words cannot be composed.
    """
    folder = str(conf_dir())
    try:
        with hydra.initialize_config_dir(folder, version_base="1.3"):
            cfg = hydra.compose("config", words, return_hydra_config=True)
            HydraConfig.instance().set_config(cfg)  # as for a job; `compose` takes the searched folders from it
            return cfg
    except (hydra.errors.HydraException, OmegaConfBaseException, OSError, ValueError) as error:
        raise ConfigError(beginning_of(words) + first_line(error)) from error
    except RecursionError as error:
        raise ConfigError(beginning_of(words) + NESTED) from error


def beginning_of(words: Sequence[str]) -> str:
    """Return the words of a command line, or as much of them as fits before an error."""
    return f"{' '.join(words)[:_SHOWN]}: "


def chosen_names(cfg: DictConfig) -> Mapping[str, str]:
    """Return the name that was chosen for each group, from the config's `hydra` part or else from the running job."""
    node = cfg.hydra if "hydra" in cfg else HydraConfig.get()
    return node.runtime.choices


def job_overrides() -> list[str]:
    """Return the words of the running job's command line, as they were written."""
    return _words_of(HydraConfig.get())


def _words_of(node: Any) -> list[str]:
    words = OmegaConf.to_container(node.overrides.task, resolve=False)
    assert isinstance(words, list)
    return [str(word) for word in words]


def _check_mode(run: RunConfig) -> None:
    termination, length = run.agent.termination, run.agent.option_length
    if termination == "steps" and length is None:
        raise ConfigError(
            "agent.option_length: missing; agent.termination=steps needs the number of steps of an option"
        )
    if termination != "steps" and length is not None:
        raise ConfigError(
            f"agent.option_length={length}: goes with agent.termination=steps only, not with {termination}"
        )
    for name, value in (("resume", run.resume), ("checkpoint", run.checkpoint), ("low.checkpoint", run.low.checkpoint)):
        if value == "":
            raise ConfigError(f"{name}: empty; give the output folder of a run, or leave {name} out")
    if run.mode == "eval" and run.checkpoint is None:
        raise ConfigError("checkpoint: missing; mode=eval needs the output folder of a run")
    if run.mode != "eval" and run.checkpoint is not None:
        raise ConfigError("checkpoint: goes with mode=eval only; to go on with a run, set resume")
    if run.mode == "eval" and run.resume is not None:
        raise ConfigError("resume: goes with mode=train and mode=offline; to score an agent, set checkpoint")
    if run.mode != "eval" and run.eval.stop_score is not None and run.eval_every == 0:
        every = "offline.eval_every" if run.mode == "offline" else "eval.every"
        raise ConfigError(
            f"eval.stop_score={run.eval.stop_score}: needs evaluations during training; set {every} above 0"
        )


def component(group: str, name: str, node: Any) -> Component:
    """Check a group's `_target_` and options against the class's constructor; build nothing.

    Args:
        group: such as `low`.
        name: of the yaml that was chosen.
        node: the group's part of the config.

    Raises:
        ConfigError: all that is wrong with this group, in one line.
    """
    options = plain(node, group)
    own = RUN_ENTRIES.get(group, ())
    for entry in own:
        options.pop(entry, None)
    target = options.pop(TARGET, None)
    file = _file(group, name)
    cls = None if target is None and group in _CAN_BE_NONE else _load_target(group, target, file)
    class_name = "none" if cls is None else cls.__name__
    schema = create_model(class_name, __config__=_STRICT) if cls is None else options_model(cls, GROUPS[group])
    taken = [entry for entry in (TARGET, *own) if entry in schema.model_fields]
    if taken:
        raise ConfigError(
            f"{group}={name}: {class_name} has an argument {taken[0]}, but {group}.{taken[0]} is a value of the run; "
            f"rename the argument ({file})"
        )
    model = _validated(schema, options, f"{group}.", f"option of {class_name} ({file})", f"{class_name}, {file}")
    return Component(group, name, cls, {option: getattr(model, option) for option in schema.model_fields})


def plain_groups(cfg: DictConfig, run: Mapping[str, Any], groups: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Return these groups of a composed config as plain values.

    Settings that refer to a number of the run, such as `${total_frames}`, get it from `run`. Text of `run` is not used.
    """
    cfg = cfg.copy()
    for name in RunConfig.model_fields:
        if name in cfg and isinstance(run.get(name), int | float):
            cfg[name] = run[name]
    return {group: plain(cfg[group], group) for group in groups}


def is_name(name: object) -> TypeGuard[str]:
    """Return whether this can be the name of a group's yaml file: words and slashes, but no way out of the folder."""
    if not isinstance(name, str) or len(name) > _LONGEST_NAME:
        return False
    return re.fullmatch(r"\w[\w.+-]*(/\w[\w.+-]*)*", name) is not None


def choosing(group: str, name: str) -> str:
    """Return the word that chooses a yaml file for a group; in quotes even `null` and `3` are names."""
    return f"{group}='{name}'"


def compose(overrides: list[str]) -> DictConfig:
    """Return the config of these words, in the folders that the running job searches for yaml files.

    Raises:
        MissingChoiceError: a word chooses a yaml file that is in none of these folders.
    """
    if HydraConfig.initialized():
        given = HydraConfig.get().overrides.hydra
        overrides = [*(word for word in given if word.startswith("hydra.searchpath=")), *overrides]
    try:
        if GlobalHydra.instance().is_initialized():
            return hydra.compose("config", overrides)
        with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
            return hydra.compose("config", overrides)
    except hydra.errors.MissingConfigException as error:
        raise MissingChoiceError(str(error.missing_cfg_file), error.options or ()) from error


def names_of(group: str) -> tuple[str, ...]:
    """Return the names of a group's yaml files in all folders that are searched."""
    try:
        compose([f"+{group}@__none__=__none__"])  # added to the group's own choice, which may be optional
    except MissingChoiceError as error:  # Hydra lists the names only here.
        return error.known
    return ()


def constructor_arguments(cls: type) -> dict[str, inspect.Parameter]:
    """Return the arguments of a class's constructor, without `self`."""
    constructor: Callable[..., None] = cls.__init__  # type: ignore[misc]  # a subclass's may differ, but this is `cls`
    return dict(list(inspect.signature(constructor).parameters.items())[1:])


def load_class(dotted: str) -> type:
    """Import a class by its dotted name.

    Raises:
        ConfigError: there is no such class.
    """
    module_name, _, name = dotted.rpartition(".")
    if not module_name or not all(part.isidentifier() for part in dotted.split(".")):
        raise ConfigError(f"{dotted}: must be a class, as package.module.Class")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        # A module that is there but lacks something it imports is no mistake of the user's.
        if error.name is None or not f"{module_name}.".startswith(f"{error.name}."):
            raise
        raise ConfigError(f"{dotted}: there is no module {error.name}") from error
    cls = getattr(module, name, None)
    if not inspect.isclass(cls):
        raise ConfigError(f"{dotted}: there is no class {name} in {module_name}")
    return cls


def _load_target(group: str, target: Any, file: str) -> type:
    try:
        return load_class(str(target))
    except ConfigError as error:
        raise ConfigError(f"{group}.{TARGET}={error} ({file})") from error


def _check_kind(group: str, name: str, target: object) -> None:
    """Refuse a class that does not fit the group, or that is abstract."""
    if target is None and group in _CAN_BE_NONE:
        return
    file = _file(group, name)
    cls, kind = _load_target(group, target, file), load_class(_KINDS[group])
    of_kind = f"{kind.__name__} ({kind.__module__})"
    given = f"{group}={name}: {cls.__name__}"
    if getattr(kind, "_is_protocol", False):
        methods = [method for method in vars(kind) if not method.startswith("_")]
        lacks = [method for method in methods if not callable(getattr(cls, method, None))]
        if lacks:
            raise ConfigError(f"{given} is no {of_kind}; it lacks {', '.join(lacks)} ({file})")
    elif not issubclass(cls, kind):
        raise ConfigError(f"{given} is no {of_kind}; derive it from {kind.__name__} ({file})")
    left = [method for method in dir(cls) if getattr(getattr(cls, method, None), "__isabstractmethod__", False)]
    if left or cls is kind:
        missing = f", which have {', '.join(left)}" if left else ""
        raise ConfigError(f"{given} is abstract; choose one of its subclasses{missing} ({file})")


def no_such_option(node: Mapping[str, Any], name: str, file: str) -> str:
    """Return that the class which a group's part of the config describes has no such option."""
    cls = str(node.get(TARGET) or "none").rpartition(".")[2]
    return no_such(f"option of {cls} ({file})", name, [option for option in node if option not in (TARGET, "budget")])


def no_such(what: str, name: str, known: Iterable[str]) -> str:
    """Return that there is no such thing, the likely spelling first, then all that there is."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=1)
    guess = f"did you mean {close[0]}? It" if close else "it"
    return f"no such {what}; {guess} has {', '.join(known) or 'none'}"


def plain(node: Any, where: str = "the config") -> dict[str, Any]:
    """Resolve a part of the config into plain Python values."""
    if not isinstance(node, Mapping | DictConfig):
        raise ConfigError(f"{where}={as_json(node)}: must be a mapping")
    if not isinstance(node, DictConfig):
        return dict(node)
    try:
        container = OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"{error.full_key or where}: {first_line(error)}") from error
    except RecursionError as error:
        raise ConfigError(f"{where}: a value refers to itself, or nests too deep") from error
    assert isinstance(container, dict)
    return {str(name): value for name, value in container.items()}


def takes_options(cls: type) -> bool:
    """Return whether the constructor takes a model of settings; other classes have a setting for each argument."""
    return hasattr(cls, "Options") and "options" in constructor_arguments(cls)


def options_model(cls: type, supplied: Iterable[str] = ()) -> type[BaseModel]:
    """Return the model of a class's settings: its `Options`, or one made of its constructor's arguments.

    Args:
        cls: the class.
        supplied: arguments of its constructor that are no settings.
    """
    if takes_options(cls):
        model = cls.Options  # type: ignore[attr-defined]
        if not (inspect.isclass(model) and issubclass(model, Settings)):
            raise ConfigError(f"{cls.__name__}.Options: must be a subclass of hpamdp.settings.Settings")
        return model
    hints = get_type_hints(cls.__init__, include_extras=True)  # type: ignore[misc]  # as in `constructor_arguments`
    fields: dict[str, Any] = {}
    for name, argument in constructor_arguments(cls).items():
        if name in supplied or argument.kind in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD):
            continue
        default = ... if argument.default is argument.empty else argument.default
        fields[name] = (hints.get(name, Any), default)
    try:
        return create_model(cls.__name__, __config__=_STRICT, **fields)
    except PydanticUserError as error:
        raise ConfigError(f"{cls.__name__}: has an argument that no yaml file can hold: {first_line(error)}") from error


def complete_yaml_files() -> None:
    """Have Hydra add to each yaml file that names a class the defaults of the class's other settings.

    So the composed config has all settings: the command line can override them, `--cfg job` shows them, and other yaml
    files can refer to them.
    """
    sources: list[Any] = [each for each in Plugins.instance().discover(ConfigSource) if each.scheme() == "file"]  # type: ignore[attr-defined]
    for source in sources:
        if not hasattr(source, "load_alone"):
            source.load_alone = source.load_config
            source.load_config = _load_complete


def _load_complete(source: Any, config_path: str) -> ConfigResult:
    result: ConfigResult = source.load_alone(config_path)
    group, cfg = config_path.partition("/")[0], result.config
    target = cfg.get(TARGET) if group in GROUPS and isinstance(cfg, DictConfig) else None
    if isinstance(target, str):
        try:
            model = options_model(load_class(target), GROUPS[group])
        except ConfigError:  # which `component` will raise again, with the name of the file
            return result
        result.config = OmegaConf.merge(defaults_of(model), cfg)
    return result


def defaults_of(model: type[BaseModel]) -> dict[str, Any]:
    """Return the default of each setting as yaml holds it; `???` for settings that have none."""
    fields = model.model_fields
    defaults = model.model_construct().model_dump(mode="json", warnings=False)
    return {name: "???" if fields[name].is_required() else defaults[name] for name in fields}


def _validated(model: type[BaseModel], values: dict[str, Any], prefix: str, what: str, where: str) -> Any:
    """Return the values as the model; an error names `what` they are and `where` they are set."""
    try:
        # As JSON, in which the strict mode takes what a yaml can hold: a list where a tuple is wanted, 1 for 1.0.
        checked = model.model_validate_json(json.dumps(values, default=str))
    except ValidationError as error:
        unknown: list[str] = []
        wrong: dict[str, dict[str, None]] = {}
        for problem in error.errors(include_url=False):
            path, value = _locate(problem["loc"], values)
            key = prefix + ".".join(path)
            if problem["type"] == "extra_forbidden":
                unknown.append(f"{key}: {no_such(what, path[-1], _fields(model, path[:-1]))}")
            elif problem["type"] == "missing":
                wrong[key] = {"missing": None}
            else:
                message = problem["msg"].removeprefix("Value error, ").replace("valid array", "list")
                message = message.replace("an object", "a mapping").replace(" or None", " or null")
                message = message.removesuffix(f" after validation, not {_length(value)}")
                message = re.sub("^(Input|String|List) should", "must", message)
                # A union complains once for each of its types.
                wrong.setdefault(f"{key}={as_json(value)}", {})[message] = None
        complaints = [f"{key}: {' or '.join(messages)} ({where})" for key, messages in wrong.items()]
        raise ConfigError("; ".join([*_shortened(unknown), *complaints])) from error
    _refuse_huge(model, values, prefix, where)
    return checked


def _length(value: Any) -> int | None:
    return len(value) if isinstance(value, list) else None


def _shortened(complaints: list[str]) -> list[str]:
    """Return the first complaints, and how many more there are: options of another class may all be wrong."""
    num_more = len(complaints) - _MOST_COMPLAINTS
    return complaints if num_more <= 0 else [*complaints[:_MOST_COMPLAINTS], f"and {num_more} more like this"]


def _refuse_huge(model: type[BaseModel], values: Mapping[str, Any], prefix: str, where: str) -> None:
    """Refuse numbers that no computation can hold, in a model's own fields and in lists there."""
    for name in model.model_fields:
        value = values.get(name)
        for number in value if isinstance(value, list) else [value]:
            if isinstance(number, bool) or not isinstance(number, int | float):
                continue
            largest = _LARGEST_INT if isinstance(number, int) else _LARGEST_FLOAT
            if abs(number) > largest:
                raise ConfigError(
                    f"{prefix}{name}={as_json(value)}: must lie between -{largest} and {largest} ({where})"
                )


def _is_size(value: Any) -> bool:
    numbers = value if isinstance(value, list | tuple) else [value]
    return bool(numbers) and all(isinstance(number, int) and not isinstance(number, bool) for number in numbers)


def _size(value: Any) -> int:
    return max(value) if isinstance(value, list | tuple) else value


def _locate(location: tuple[int | str, ...], values: dict[str, Any]) -> tuple[list[str], Any]:
    """Return the keys that lead to a problem, and the value there."""
    path: list[str] = []
    value: Any = values
    for part in location:
        # The other parts name the type of a union that was tried.
        if isinstance(value, dict):
            path.append(str(part))
            value = value.get(part)
        elif isinstance(value, list) and isinstance(part, int):
            path.append(str(part))
            value = value[part]
    return path, value


def _fields(model: type[BaseModel], path: list[str]) -> Iterable[str]:
    for name in path:
        inner = model.model_fields[name].annotation
        assert isinstance(inner, type)
        model = inner
    return model.model_fields


def _file(group: str, name: str) -> str:
    return f"conf/{group}/{name}.yaml"


def as_json(value: object) -> str:
    """Return a value as JSON, for a message; a long one is cut short."""
    text = json.dumps(value, default=str)
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


def _is_deliberate(error: ValueError, cls: type) -> bool:
    """Return whether the error is a `raise` in the class's own package, hence about its arguments, and not a bug."""
    frame, line = list(traceback.walk_tb(error.__traceback__))[-1]
    is_own = frame.f_globals["__name__"].partition(".")[0] == cls.__module__.partition(".")[0]
    return is_own and linecache.getline(frame.f_code.co_filename, line).lstrip().startswith("raise ")


complete_yaml_files()
