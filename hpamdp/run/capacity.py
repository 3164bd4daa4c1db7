"""Refuse runs that need too much memory, or whose budget is too small for a first update."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.modules.module import (
    register_module_buffer_registration_hook,
    register_module_parameter_registration_hook,
)

from hpamdp.complaints import as_json
from hpamdp.config.components import Component
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config, RunConfig
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.errors import EnvironmentFaultError
from hpamdp.memory import in_gigabytes, is_about_memory, total_memory
from hpamdp.messages import first_line
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner
from hpamdp.specs import PAMDPSpecs

# The memory of fewer steps or episodes than this is not estimated, because the estimate has to build an environment.
_MANY = 1_000_000
# Each weight takes four numbers: itself, its gradient and two moments of Adam.
_BYTES_A_WEIGHT = 16
# An agent that is loaded has at most so many numbers, for each number in its file and in all.
_SLACK, _FEW_NUMBERS = 4, 4_000_000


def check_run(run: RunConfig, device: torch.device, build_one: Callable[[], PAMDPEnv]) -> None:
    """Refuse more environments, steps or episodes than there is memory for, before any of them is built.

    The estimate counts the tensors of a step and the paths that an evaluation records.

    Args:
        run: the values of the run.
        device: device of the tensors.
        build_one: builds a single environment; called only if the numbers are large.

    Raises:
        ConfigError: memory does not suffice; the message names the least number of bytes.
    """
    num_steps = 0 if run.mode != "train" else run.num_envs * run.steps_per_batch
    if max(run.num_envs, num_steps, run.eval.layouts) < _MANY:
        return
    step, path = _bytes_of_one(build_one)
    needs = {
        f"num_envs={run.num_envs}": run.num_envs * step,
        f"num_envs={run.num_envs}, steps_per_batch={run.steps_per_batch}": num_steps * step,
        f"eval.layouts={run.eval.layouts}": run.eval.layouts * (step + path),
    }
    _check_memory(needs, device)


def check_number(argument: str, num: int, device: torch.device, build_one: Callable[[], PAMDPEnv]) -> None:
    """Refuse more environments than there is memory for, before any of them is built.

    Args:
        argument: the argument that gives the number, as `name=value`.
        num: number of environments, one for each episode of an evaluation.
        device: device of the tensors.
        build_one: builds a single environment; called only if the number is large.

    Raises:
        ConfigError: memory does not suffice; the message names the least number of bytes.
    """
    if num >= _MANY:
        _check_memory({argument: num * _bytes_of_one(build_one)[0]}, device, "takes")


def _bytes_of_one(build_one: Callable[[], PAMDPEnv]) -> tuple[int, int]:
    """Return the bytes of a step in one environment, and of the path that an evaluation records there."""
    with closing(build_one()) as one:
        return one.fake_tensordict().bytes(), 0 if one.position is None else 8 * one.max_steps


def check_agent(config: Config, specs: PAMDPSpecs, learners: Sequence[Component], device: torch.device) -> None:
    """Refuse replay buffers, batches and layers that are too large for memory, before any of them is built.

    They are recognised by the names of their settings: `buffer_size`, and names that end in `batch_size` or
    `hidden_dims`.

    Args:
        config: config of the run.
        specs: specs of its problem.
        learners: the component of each learner.
        device: device of the tensors.

    Raises:
        ConfigError: memory does not suffice; the message names the least number of bytes.
    """
    # Two observations, the action, reward and flags. A pixel takes one byte.
    observation = sum(entry.size if entry.is_picture else 4 * entry.size for entry in specs.entries)
    observation = observation if specs.entries else 4 * specs.observation_dim
    row = 2 * observation + 4 * (specs.num_parameters + 2)
    row += specs.num_discrete**2 if specs.has_pair_mask else 0
    needs = {}
    for component, num in ((config.high, 1), *((low, learners.count(low)) for low in learners)):
        for name, value in component.settings.items():
            setting = f"{component.group}.{name}={as_json(value)}"
            if name == "buffer_size":
                needs[setting] = num * value * (row + _bytes_remembered(component, specs))
            elif name.endswith("batch_size") and value is not None:
                needs[setting] = value * row
            elif name.endswith("hidden_dims"):
                # Behind pictures is an encoder, whose few features are not counted here.
                sizes = [0 if specs.has_pictures else specs.observation_dim, *value]
                weights = sum(a * b for a, b in zip(sizes, value, strict=False))
                needs[setting] = num * weights * _BYTES_A_WEIGHT
    _check_memory(needs, device)


def _bytes_remembered(component: Component, specs: PAMDPSpecs) -> int:
    """Return the bytes of a memory's state, which a replay buffer holds in every row."""
    settings = component.settings
    if settings.get("memory") == "gru":
        return 4 * int(settings["memory_size"])
    if settings.get("memory") == "stack":
        return 4 * int(settings["stack_steps"]) * specs.observation_dim
    return 0


def _check_memory(needs: Mapping[str, int], device: torch.device, takes: str = "the run takes") -> None:
    """Refuse settings that together need more bytes than there are; the error names the largest one."""
    if not needs:
        return
    available = total_memory(device)
    setting = max(needs, key=needs.__getitem__)
    if sum(needs.values()) > available:
        raise ConfigError(
            f"{setting}: {takes} at least {in_gigabytes(sum(needs.values()))} of memory, and there are "
            f"{in_gigabytes(available)}"
        )


@contextmanager
def limited_to(file: Path, num_saved: int) -> Iterator[None]:
    """Refuse to build an agent that is far larger than the one in a file, before its weights get values.

    A small file may describe an agent of any size. An agent that fits has at most the numbers in the file, and a few
    that matter in training alone.

    Args:
        file: the checkpoint.
        num_saved: number of floating-point numbers of its agent.

    Raises:
        ConfigError: the modules that are built have many more numbers.
    """
    most = _SLACK * num_saved + _FEW_NUMBERS
    num = 0

    def count(module: nn.Module, name: str, tensor: Tensor | None) -> None:
        nonlocal num
        num += tensor.numel() if tensor is not None and tensor.is_floating_point() else 0
        if num > most:
            raise ConfigError(
                f"{file}: does not fit this agent: it holds {num_saved:,} numbers, but its settings describe an agent "
                f"with more than {most:,}"
            )

    hooks = [register_module_parameter_registration_hook(count), register_module_buffer_registration_hook(count)]
    try:
        yield
    finally:
        for hook in hooks:
            hook.remove()


@contextmanager
def memory_errors_explained(config: Config) -> Iterator[None]:
    """Turn an error about memory into one line that names the largest sizes.

    Raises:
        ConfigError: memory did not suffice.
    """
    try:
        yield
    except Exception as error:
        # If the environment's own code lacks memory, the line of its fault says so.
        if isinstance(error, ConfigError | EnvironmentFaultError) or not is_about_memory(error):
            raise
        run = config.run
        sizes = f"num_envs={run.num_envs}, steps_per_batch={run.steps_per_batch}, eval.layouts={run.eval.layouts}"
        parts = f"{sizes}, {config.low.largest_sizes()}, {config.high.largest_sizes()}"
        reason = f" ({first_line(error):.160})" if str(error) else ""
        raise ConfigError(f"{parts}: the run takes more memory than there is{reason}") from error


def check_length(config: Config, agent: HierarchicalAgent, learners: Iterable[tuple[Component, Learner]]) -> None:
    """Refuse a training run that must end before the first update of the selector or of a learner.

    Args:
        config: config of the run.
        agent: the agent with its selector.
        learners: the agent's learners, each with its component.

    Raises:
        ConfigError: the message names the setting that requires the most steps, and the number of steps of the run.
    """
    run = config.run
    if run.mode != "train":
        return
    batch = run.num_envs * run.steps_per_batch
    num = -(-run.total_frames // batch) * batch
    needs = [] if agent.selector is None else [(config.high, agent.selector.decisions_to_update())]
    if not run.low.freeze:
        needs += [(low, learner.steps_to_update()) for low, learner in learners]
    for component, needed in needs:
        name = max(needed, key=needed.__getitem__, default="")
        if name and needed[name] > num:
            setting = f"{component.group}.{name}"
            raise ConfigError(
                f"{setting}={as_json(component.settings.get(name))} ({component}): the first update comes after "
                f"{needed[name]:,} steps or decisions, but total_frames={run.total_frames} gives at most {num:,}; "
                f"set a larger total_frames or another {setting}"
            )
