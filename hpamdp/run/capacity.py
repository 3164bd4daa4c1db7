"""Refuse budgets that are too small for a first update, and explain errors about memory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

from hpamdp.complaints import as_json
from hpamdp.config.components import Component
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config
from hpamdp.env.errors import EnvironmentFaultError
from hpamdp.limits import is_about_memory
from hpamdp.messages import first_line
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner


@contextmanager
def memory_errors_explained(config: Config) -> Iterator[None]:
    """Turn an error about memory into one line that names the sizes to reduce.

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
        for part in (config.low, config.high):
            given = {name: part.settings.get(name) for name in ("buffer_size", "hidden_dims")}
            sizes += "".join(f", {part.group}.{name}={as_json(value)}" for name, value in given.items() if value)
        reason = f" ({first_line(error):.160})" if str(error) else ""
        raise ConfigError(f"{sizes}: the run takes more memory than there is{reason}") from error


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
