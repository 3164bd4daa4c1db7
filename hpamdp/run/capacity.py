"""Explain errors about memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from hpamdp.complaints import as_json
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config
from hpamdp.env.errors import EnvironmentFaultError
from hpamdp.limits import is_about_memory
from hpamdp.messages import first_line


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
