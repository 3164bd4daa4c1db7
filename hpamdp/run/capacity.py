"""Refuse replay buffers larger than memory, and budgets too small for a first update; explain errors about memory."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import torch

from hpamdp.complaints import as_json
from hpamdp.config.components import Component
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config
from hpamdp.env.errors import EnvironmentFaultError
from hpamdp.limits import is_about_memory
from hpamdp.messages import first_line
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner
from hpamdp.specs import PAMDPSpecs

_CONTAINER_LIMIT = Path("/sys/fs/cgroup/memory.max")  # where Linux keeps a container's limit of memory


def check_buffers(config: Config, specs: PAMDPSpecs, learners: Sequence[Component], device: torch.device) -> None:
    """Refuse replay buffers larger than memory before they are built, since they fill only while the run goes on.

    Args:
        config: config of the run.
        specs: specs of its problem.
        learners: the component of each learner.
        device: device of the tensors.

    Raises:
        ConfigError: a buffer is larger than the machine's memory.
    """
    # Two observations, the action, reward and flags. A pixel takes one byte.
    row = 2 * specs.observation_dim * (1 if specs.has_pictures else 4) + 4 * (specs.num_parameters + 2)
    available = total_memory(device)
    for part, num in ((config.high, 1), *((low, learners.count(low)) for low in learners)):
        size = part.settings.get("buffer_size") or 0
        if num * size * row > available:
            raise ConfigError(
                f"{part.group}.buffer_size={size}: takes at least {num * size * row / 1e9:,.1f} GB of memory, and "
                f"there are {available / 1e9:,.1f} GB"
            )


def total_memory(device: torch.device) -> int:
    """Return the memory of a device in bytes; of the CPU's memory, as much as a container may use."""
    if device.type == "cuda":
        return torch.cuda.get_device_properties(device).total_memory
    sizes = [os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")]
    with suppress(OSError, ValueError):  # not there, or without a limit
        sizes.append(int(_CONTAINER_LIMIT.read_text()))
    return min(sizes)


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
