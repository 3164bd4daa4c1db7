"""The crossing and the corridor: their signals, and what SUMO's netconvert makes of the files in `networks`."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import subprocess
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from filelock import FileLock
from platformdirs import user_cache_path

from hpamdp.env.errors import ProblemError
from hpamdp.files import replacing
from hpamdp.messages import file_and_reason, one_line, reason_of
from hpamdp.settings import SettingError

FOLDER = Path(__file__).resolve().parent / "networks"
ARMS = ("north", "east", "south", "west")
MIN_GREEN, MAX_GREEN = 5, 60
"""Shortest and longest green (s) of a decision; the actuated programs in `networks` have the same."""
YELLOW = 3
"""Seconds of yellow between different phases."""
NUM_LANES = 3
"""Lanes of an arm towards its signal: right and through, through, left."""
# The links of an arm, one after another: right, through, through, left. A signal's arms follow clockwise.
_THROUGH, _LEFT, _RED = "GGGr", "rrrG", "rrrr"
GREENS = (
    _THROUGH + _RED + _THROUGH + _RED,
    _LEFT + _RED + _LEFT + _RED,
    _RED + _THROUGH + _RED + _THROUGH,
    _RED + _LEFT + _RED + _LEFT,
)
"""SUMO's state of a signal in each phase."""
_PARTS = ("nod", "edg", "con", "tll")
_MISSING = "SUMO is not installed; pip install 'hpamdp[traffic]'"


@dataclass(frozen=True)
class Signal:
    """A crossing with a signal.

    Attributes:
        name: SUMO's id of the node and of its signal.
        arms: the nodes at the ends of its arms, clockwise from the north.
    """

    name: str
    arms: tuple[str, str, str, str]

    def inward(self) -> list[str]:
        """Return the edges that lead to the signal."""
        return [f"{arm}_to_{self.name}" for arm in self.arms]

    def outward(self) -> list[str]:
        """Return the edges that lead away."""
        return [f"{self.name}_to_{arm}" for arm in self.arms]

    def turns(self, arm: int) -> tuple[str, str, str]:
        """Return the edges to the left, ahead and to the right of a vehicle that comes from an arm."""
        outward = self.outward()
        return outward[(arm + 1) % 4], outward[(arm + 2) % 4], outward[(arm + 3) % 4]


def lanes_of(phase: int) -> list[tuple[int, int]]:
    """Return the lanes that a phase serves: numbers of the arm and of the lane."""
    lanes = (2,) if phase % 2 else (0, 1)
    return (
        [(arm, lane) for arm in (0, 2) for lane in lanes]
        if phase < 2
        else [(arm, lane) for arm in (1, 3) for lane in lanes]
    )


NETWORKS: dict[str, tuple[Signal, ...]] = {
    "crossing": (Signal("A", ("north_A", "east", "south_A", "west")),),
    "corridor": (
        Signal("A", ("north_A", "B", "south_A", "west")),
        Signal("B", ("north_B", "C", "south_B", "A")),
        Signal("C", ("north_C", "east", "south_C", "B")),
    ),
}


def entries(network: str) -> list[str]:
    """Return the edges on which vehicles enter a network."""
    signals = NETWORKS[network]
    names = {signal.name for signal in signals}
    return [
        edge for signal in signals for arm, edge in zip(signal.arms, signal.inward(), strict=True) if arm not in names
    ]


def require_sumo() -> None:
    """Refuse to go on without SUMO.

    Raises:
        SettingError: eclipse-sumo or libsumo is not installed.
    """
    if importlib.util.find_spec("sumo") is None or importlib.util.find_spec("libsumo") is None:
        raise SettingError(_MISSING)


def run_tool(name: str, *arguments: str) -> None:
    """Run one of SUMO's programs.

    Raises:
        ProblemError: it cannot be started, or it failed; then the message is its own first line.
    """
    import sumo

    program = os.path.join(sumo.SUMO_HOME, "bin", name)
    environment = {**os.environ, "SUMO_HOME": sumo.SUMO_HOME}
    try:
        done = subprocess.run([program, *arguments], env=environment, capture_output=True, text=True, check=False)
    except OSError as error:
        raise ProblemError(f"SUMO's {name} cannot be started: {file_and_reason(error)}") from error
    if done.returncode:
        said = done.stderr.strip() or done.stdout.strip() or f"exit code {done.returncode}"
        raise ProblemError(f"SUMO's {name} failed: {one_line(said)}")


def network_file(network: str) -> Path:
    """Return SUMO's file of a network, which netconvert makes at the first use.

    It is kept in the user's cache under a name that depends on the files in `networks` and on the version of SUMO.

    Raises:
        SettingError: SUMO is not installed, or the cache cannot be written to.
    """
    require_sumo()
    files = {part: FOLDER / f"{network}.{part}.xml" for part in _PARTS}
    made_of = b"".join(file.read_bytes() for file in files.values()) + version("eclipse-sumo").encode()
    folder = user_cache_path("hpamdp") / "traffic"
    made = folder / f"{network}-{hashlib.sha256(made_of).hexdigest()[:16]}.net.xml"
    try:
        if made.exists():
            return made
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(made.with_suffix(".lock")):
            if not made.exists():
                with replacing(made) as partial:
                    given = [
                        *("--node-files", str(files["nod"]), "--edge-files", str(files["edg"])),
                        *("--connection-files", str(files["con"]), "--tllogic-files", str(files["tll"])),
                    ]
                    kept = ["--no-turnarounds", "true", "--offset.disable-normalization", "true"]
                    run_tool("netconvert", *given, *kept, "--output-file", str(partial))
    except OSError as error:
        raise SettingError(
            f"{folder}: {reason_of(error)}; set XDG_CACHE_HOME to a folder that can be written"
        ) from error
    return made
