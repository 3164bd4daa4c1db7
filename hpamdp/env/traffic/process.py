"""A simulation in a process of its own, since libsumo holds one simulation a process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from multiprocessing import Pipe
from pathlib import Path
from typing import Any

from hpamdp.children import STOP_SIGNALS, children_without
from hpamdp.env.errors import ProblemError
from hpamdp.env.traffic.simulation import FOLDER_PREFIX, Seen, Simulation, Task

_PROGRAM = f"from {Simulation.__module__} import serve; serve()"
_PATIENCE_S = 2.0  # until a dead process has an exit code


class SimulationProcess:
    """A `Simulation` that lives in another process. Its methods are those of `Simulation`.

    The process is not one of multiprocessing's, which a worker process may not start. It ends with its parent, and then
    removes its files, also if the parent was killed.

    Args:
        task: what the episodes have in common.

    Raises:
        ProblemError: from the constructor and from methods, if the process raised an error or died.
    """

    begin: Callable[[int], Seen]
    act: Callable[[int, float], Seen]
    follow: Callable[[str], Seen]
    play: Callable[[str], dict[str, float]]

    def __init__(self, task: Task) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix=FOLDER_PREFIX)
        self._connection, other = Pipe()
        # The folder is the working directory, so that Python imports nothing from the user's.
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))}
        with children_without(*STOP_SIGNALS):  # these signals are for the run alone
            self._process = subprocess.Popen(
                [sys.executable, "-c", _PROGRAM, str(other.fileno())],
                env=environment,
                cwd=self._folder.name,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=[other.fileno()],
                start_new_session=True,  # nor do others of a terminal reach it
            )
        other.close()
        try:
            self._call("__init__", (task, Path(self._folder.name)))
        except BaseException:
            self.close()
            raise

    def __getattr__(self, method: str) -> Callable[..., Any]:
        """Return a method of the simulation."""
        if method.startswith("_") or not hasattr(Simulation, method):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {method!r}", name=method, obj=self)
        return lambda *arguments: self._call(method, arguments)

    def _call(self, method: str, arguments: tuple[Any, ...]) -> Any:
        try:
            self._connection.send((method, arguments))
            is_answer, value = self._connection.recv()
        except (EOFError, OSError) as error:
            raise ProblemError(f"the process of SUMO {self._death()}") from error
        if not is_answer:
            raise ProblemError(f"SUMO: {value}")
        return value

    def _death(self) -> str:
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_PATIENCE_S)
        code = self._process.returncode
        if code is None:
            return "no longer answers"
        return f"died (exit code {code})" if code >= 0 else f"died (signal {-code}, {signal.Signals(-code).name})"

    def close(self) -> None:
        """End the process at once, also inside an episode, and remove its files."""
        self._connection.close()
        self._process.kill()
        self._process.wait()
        self._folder.cleanup()
