"""What a user may set, checked before anything is built.

The run's own values are RunConfig. The options of a class are the arguments of its constructor: its signature is the
schema of its yaml, and there is no other list of them.
"""

from __future__ import annotations

import difflib
import importlib
import inspect
import json
import linecache
import re
import traceback
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    NonNegativeInt,
    PositiveInt,
    ValidationError,
    create_model,
)

if TYPE_CHECKING:
    import torch  # takes seconds, and the help page needs this module too

GROUPS = ("env", "high", "low", "data", "logger", "collector")
_CAN_BE_NONE = ("high", "data")
RUN_FILE = "conf/config.yaml"
# Entries of a class's part of the config that are not options of the class.
_TARGET, _RUNS_OWN = "_target_", ("budget", "checkpoint", "freeze")

_STRICT = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False, protected_namespaces=())

Seed = Annotated[int, Field(ge=0, lt=2**32)]  # NumPy takes no larger ones


class ConfigError(ValueError):
    """A user's mistake, told in one line."""


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
    stop_score: float | None = None  # early runs' configs lack it


class AgentConfig(BaseModel):
    """How the two levels are put together."""

    model_config = _STRICT

    sharing: Literal["per_option", "shared"]
    option_length: Literal["episode"] | PositiveInt
    uniform_option_frames: NonNegativeInt


class OfflineConfig(BaseModel):
    """How much is learned from a data set alone."""

    model_config = _STRICT

    updates: PositiveInt
    eval_every: NonNegativeInt


class StartConfig(BaseModel):
    """Where the learners begin."""

    model_config = _STRICT

    checkpoint: str | None
    freeze: bool


class RunConfig(BaseModel):
    """The run's own values, each explained in conf/config.yaml."""

    model_config = _STRICT

    mode: Literal["train", "offline", "eval"]
    seed: Seed
    device: Annotated[str, AfterValidator(_check_device)]
    threads: Annotated[int, Field(ge=1, le=1024)]
    agent: AgentConfig
    low: StartConfig
    total_frames: PositiveInt
    num_envs: PositiveInt
    steps_per_batch: PositiveInt
    log_every: NonNegativeInt
    offline: OfflineConfig
    eval: EvalConfig
    checkpoint_every: NonNegativeInt
    checkpoint: str | None
    resume: str | None

    @property
    def num_frames(self) -> int:
        """How long the run is to train: in updates with mode=offline, else in presses or decisions."""
        return self.offline.updates if self.mode == "offline" else self.total_frames

    @property
    def eval_every(self) -> int:
        """How far evaluations are apart, in the same; 0: only at the start and at the end."""
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


def run_config(cfg: DictConfig) -> RunConfig:
    """Check the run's own values in the composed config.

    Raises:
        ConfigError: a wrong value, or a group for which nothing is chosen.
    """
    for group in GROUPS:
        if cfg.get(group) is None or _TARGET not in cfg[group]:
            raise ConfigError(f"{group}: nothing chosen; set {group}=NAME with one of the files in conf/{group}")
    plain = _plain(cfg)
    values = {name: value for name, value in plain.items() if name not in GROUPS}
    values["low"] = {name: plain["low"].get(name) for name in StartConfig.model_fields}
    run = _validated(RunConfig, values, "", f"value of the run ({RUN_FILE})", RUN_FILE)
    if run.mode == "eval" and run.checkpoint is None:
        raise ConfigError("checkpoint: missing; mode=eval needs the output folder of a run")
    if run.mode != "eval" and run.checkpoint is not None:
        raise ConfigError("checkpoint: goes with mode=eval only; to go on with a run, set resume")
    if run.mode == "eval" and run.resume is not None:
        raise ConfigError("resume: goes with mode=train and mode=offline; to score an agent, set checkpoint")
    if run.mode != "eval" and run.eval.stop_score is not None and run.eval_every == 0:
        every = "offline.eval_every" if run.mode == "offline" else "eval.every"
        raise ConfigError(f"eval.stop_score={run.eval.stop_score}: wants evaluations on the way; set {every} above 0")
    return run


def validate(group: str, node: Any, context_names: Iterable[str] = ()) -> tuple[type | None, dict[str, Any]]:
    """Check a group's `_target_` and options against the class's constructor, and return both; build nothing.

    Args:
        group: such as `low`.
        node: the group's part of the config; its `budget`, `checkpoint` and `freeze` are the run's business.
        context_names: constructor arguments that the program gives, which no yaml may.

    Returns:
        The class and its options; None and no options for `high=none`, where nothing chooses, and `data=none`.

    Raises:
        ConfigError: all that is wrong with this group, in one line.
    """
    options = _plain(node, group)
    for name in _RUNS_OWN:
        options.pop(name, None)
    target = options.pop(_TARGET, None)
    # Where the environment gives the option, nothing chooses.
    cls = None if target is None and group in _CAN_BE_NONE else _load_target(group, target)
    name = "none" if cls is None else cls.__name__
    schema = create_model(name, __config__=_STRICT) if cls is None else _schema(cls, set(context_names))
    what, where = f"option of {name} ({_file(group)})", f"{name}, {_file(group)}"
    model = _validated(schema, options, f"{group}.", what, where)
    return cls, {option: getattr(model, option) for option in schema.model_fields}


def build(group: str, node: Any, **context: Any) -> Any:
    """Build the object that a group's part of the config describes; None for `high=none` and `data=none`.

    Args:
        group: such as `low`.
        node: the group's part of the config.
        context: what the program gives; each goes to a constructor that has an argument of that name.

    Raises:
        ConfigError: what `validate` finds, or what the constructor refuses with a ValueError.
    """
    cls, options = validate(group, node, context)
    if cls is None:
        return None
    accepted = inspect.signature(cls.__init__).parameters
    try:
        return cls(**{name: value for name, value in context.items() if name in accepted}, **options)
    except ValueError as error:
        if not _is_deliberate(error, cls):
            raise
        raise ConfigError(f"{group}: {_one_line(error)} ({cls.__name__}, {_file(group)})") from error


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


def _load_target(group: str, target: Any) -> type:
    try:
        return load_class(str(target))
    except ConfigError as error:
        raise ConfigError(f"{group}.{_TARGET}={error} ({_file(group)})") from error


def name_of(node: Mapping[str, Any]) -> str:
    """Return the name by which a class of a group is chosen: that of the class's file, or `none`."""
    return "none" if node[_TARGET] is None else node[_TARGET].split(".")[-2]


def no_such_option(node: Mapping[str, Any], name: str, file: str) -> str:
    """Return that the class which a group's part of the config describes has no such option."""
    cls = str(node.get(_TARGET) or "none").rpartition(".")[2]
    return no_such(f"option of {cls} ({file})", name, [option for option in node if option not in (_TARGET, "budget")])


def no_such(what: str, name: str, known: Iterable[str]) -> str:
    """Return that there is no such thing, the likely spelling first, then all that there is."""
    known = sorted(known)
    close = difflib.get_close_matches(name, known, n=1)
    guess = f"did you mean {close[0]}? It" if close else "it"
    return f"no such {what}; {guess} has {', '.join(known) or 'none'}"


def _plain(node: Any, where: str = "the config") -> dict[str, Any]:
    """Resolve a part of the config into plain Python values."""
    if not isinstance(node, Mapping | DictConfig):
        raise ConfigError(f"{where}={_written(node)}: must be a mapping")
    if not OmegaConf.is_config(node):
        return dict(node)
    try:
        return OmegaConf.to_container(node, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:
        raise ConfigError(f"{error.full_key or where}: {_one_line(error)}") from error


def _schema(cls: type, given: set[str]) -> type[BaseModel]:
    hints = get_type_hints(cls.__init__, include_extras=True)
    fields = {}
    for name, argument in list(inspect.signature(cls.__init__).parameters.items())[1:]:
        if name in given or argument.kind in (argument.VAR_POSITIONAL, argument.VAR_KEYWORD):
            continue
        fields[name] = (hints.get(name, Any), ... if argument.default is argument.empty else argument.default)
    return create_model(cls.__name__, __config__=_STRICT, **fields)


def _validated(model: type[BaseModel], values: dict[str, Any], prefix: str, what: str, where: str) -> Any:
    """Return the values as the model; `what` they are and `where` they stand is told if they are wrong."""
    try:
        # As JSON, in which the strict mode takes what a yaml can hold: a list where a tuple is wanted, 1 for 1.0.
        return model.model_validate_json(json.dumps(values, default=str))
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
                message = re.sub("^(Input|String|List) should", "must", message)
                # A union complains once for each of its types.
                wrong.setdefault(f"{key}={_written(value)}", {})[message] = None
        raise ConfigError(
            "; ".join([*unknown, *(f"{key}: {' or '.join(wrong[key])} ({where})" for key in wrong)])
        ) from error


def _locate(location: tuple[int | str, ...], values: dict[str, Any]) -> tuple[list[str], Any]:
    """Return the keys to where a problem is, and what stands there."""
    path, value = [], values
    for part in location:
        # The other parts name the type of a union that was tried.
        if isinstance(value, dict) or (isinstance(value, list) and isinstance(part, int)):
            path.append(str(part))
            value = value.get(part) if isinstance(value, dict) else value[part]
    return path, value


def _fields(model: type[BaseModel], path: list[str]) -> Iterable[str]:
    for name in path:
        model = model.model_fields[name].annotation
    return model.model_fields


def _file(group: str) -> str:
    """Return the yaml that was chosen for a group."""
    chosen = HydraConfig.get().runtime.choices.get(group) if HydraConfig.initialized() else None
    return f"conf/{group}/{chosen}.yaml" if chosen else f"conf/{group}"


def _written(value: Any) -> str:
    return json.dumps(value, default=str)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split("\n")[0].split())


def _is_deliberate(error: ValueError, cls: type) -> bool:
    """Return whether the error is a `raise` in the class's own package, hence about its arguments, and not a bug."""
    frame, line = list(traceback.walk_tb(error.__traceback__))[-1]
    is_own = frame.f_globals["__name__"].partition(".")[0] == cls.__module__.partition(".")[0]
    return is_own and linecache.getline(frame.f_code.co_filename, line).lstrip().startswith("raise ")
