"""Replay recorded episodes of the released environment in ours, and print the largest difference.

Run: python experiments/released/replay.py FILE.json [--dtype float32]

A file is a list of episodes with `controller` (0 incongruent, 1 congruent), `keymap`, `start`, `goal`, `observation0`
and `steps`, each with `key`, `parameter`, `observation`, `reward`, `done`, `truncated` and `success`. The exit code is
1 if an observation, a reward or a flag differs, and 2 if the file is no such list.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.env.boatdock_released.environment import ReleasedBoatDockEnv
from hpamdp.env.boatdock_released.rules import SUCCESS
from hpamdp.messages import exit_code

CONTROLLERS = ("incongruent", "congruent")  # as they are numbered in the files
TOLERANCE = {"float64": 1e-9, "float32": 1e-3}  # relative for numbers beyond 1


class InFloat64(ReleasedBoatDockEnv):
    """The released environment, computed in float64."""

    float_type = torch.float64


_ENVIRONMENTS = {"float64": InFloat64, "float32": ReleasedBoatDockEnv}


def replay(episodes: list[dict[str, Any]], dtype: str = "float64") -> tuple[int, float]:
    """Return the number of compared steps and the largest difference, which is infinite if a flag differs."""
    steps = 0
    worst = 0.0
    for number, name in enumerate(CONTROLLERS):
        of_boat = [episode for episode in episodes if episode["controller"] == number]
        if of_boat:
            steps += sum(len(episode["steps"]) for episode in of_boat)
            worst = max(worst, _replay_boat(name, of_boat, dtype))
    return steps, worst


def _replay_boat(controller: str, episodes: list[dict[str, Any]], dtype: str) -> float:
    """Replay episodes of one boat side by side, and return the largest difference."""
    env = _ENVIRONMENTS[dtype](len(episodes), controller=controller)
    layout = {"start": _column(episodes, "start"), "goal": _column(episodes, "goal")}
    if controller == "incongruent":
        layout["keymap"] = _column(episodes, "keymap").long()
    td = env.reset(TensorDict(layout, [len(episodes)]))
    worst = _difference(td[keys.OBSERVATION], _column(episodes, "observation0"))
    for t in range(max(len(episode["steps"]) for episode in episodes)):
        # Episodes that are over repeat the last press, which changes nothing.
        recorded = [episode["steps"][min(t, len(episode["steps"]) - 1)] for episode in episodes]
        is_running = torch.tensor([t < len(episode["steps"]) for episode in episodes])
        action = {
            keys.DISCRETE: _column(recorded, "key").long(),
            keys.PARAMETERS: _column(recorded, "parameter").float(),
        }
        td = env.step(TensorDict(action, [len(episodes)]))["next"]
        numbers = {"observation": td[keys.OBSERVATION], "reward": td[keys.REWARD].squeeze(-1)}
        for name, number in numbers.items():
            worst = max(worst, _difference(number[is_running], _column(recorded, name)[is_running]))
        flags = {"done": td[keys.DONE], "truncated": td[keys.TRUNCATED], "success": td[keys.OUTCOME] == SUCCESS}
        for name, flag in flags.items():
            if not torch.equal(flag.flatten()[is_running], _column(recorded, name).bool()[is_running]):
                return float("inf")
    return worst


def _column(rows: list[dict[str, Any]], name: str) -> torch.Tensor:
    """Return an entry of all rows as float64, first dimension the row."""
    return torch.tensor([row[name] for row in rows], dtype=torch.float64)


def _difference(mine: torch.Tensor, recorded: torch.Tensor) -> float:
    """Return the largest difference, relative for numbers beyond 1, and infinite if the shapes differ."""
    if mine.shape != recorded.shape:
        return float("inf")
    relative = (mine.double() - recorded).abs() / recorded.abs().clamp(min=1.0)
    return float(relative.nan_to_num(nan=float("inf")).amax()) if len(mine) else 0.0


def main() -> None:
    """Replay the file that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--dtype", choices=tuple(TOLERANCE), default="float64")
    arguments = parser.parse_args()
    try:
        episodes = json.loads(arguments.file.read_text())
        if not (isinstance(episodes, list) and all(isinstance(episode, dict) for episode in episodes)):
            raise ValueError("it is not a list of episodes")
        steps, worst = replay(episodes, arguments.dtype)
        if not steps:
            raise ValueError("it has no episodes of either boat")
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        reason = f"missing: {error}" if isinstance(error, KeyError) else str(error).partition("\n")[0]
        print(f"{arguments.file}: not recorded episodes of the released environment ({reason})", file=sys.stderr)
        sys.exit(2)
    is_same = worst <= TOLERANCE[arguments.dtype]
    print(f"{steps} steps compared, largest difference {worst:.1e}: {'the same' if is_same else 'NOT the same'}")
    sys.exit(not is_same)


if __name__ == "__main__":
    sys.exit(exit_code(main))
