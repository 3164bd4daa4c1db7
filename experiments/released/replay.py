"""Play a file of recorded episodes of the released environment in ours, and print how far the two are apart.

Run: python experiments/released/replay.py FILE.json [--dtype float32]

A file is a list of episodes with `controller` (0 incongruent, 1 congruent), `keymap`, `start`, `goal`, `observation0`
and `steps`, each with `key`, `parameter`, `observation`, `reward`, `done`, `truncated` and `success`. Exits with 1
where an observation, a reward or a flag differs, with 2 if the file is no such list.
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

TOLERANCE = {"float64": 1e-9, "float32": 1e-3}  # relative beyond 1


def replay(episodes: list[dict[str, Any]], dtype: str = "float64") -> tuple[int, float]:
    """Return the number of steps compared and the largest difference, infinite where a flag differs."""
    steps, worst = 0, 0.0
    for name, number in (("incongruent", 0), ("congruent", 1)):
        chosen = [episode for episode in episodes if episode["controller"] == number]
        if chosen:
            played, difference = _replay_boat(name, chosen, dtype)
            steps, worst = steps + played, max(worst, difference)
    return steps, worst


def _replay_boat(controller: str, episodes: list[dict[str, Any]], dtype: str) -> tuple[int, float]:
    """Play episodes of one boat side by side."""
    env = ReleasedBoatDockEnv(len(episodes), controller=controller, dtype=dtype)
    layout = {name: _column(episodes, name) for name in ("start", "goal")}
    if controller == "incongruent":
        layout["keymap"] = _column(episodes, "keymap").long()
    td = env.reset(TensorDict(layout, [len(episodes)]))
    worst = _difference(td[keys.OBSERVATION], _column(episodes, "observation0"))
    for t in range(max(len(episode["steps"]) for episode in episodes)):
        # Episodes that are over stay as they are, whatever is pressed.
        recorded = [episode["steps"][min(t, len(episode["steps"]) - 1)] for episode in episodes]
        is_there = torch.tensor([t < len(episode["steps"]) for episode in episodes])
        press = {"discrete": _column(recorded, "key").long(), "parameters": _column(recorded, "parameter").float()}
        td = env.step(TensorDict({keys.ACTION: press}, [len(episodes)]))["next"]
        for mine, name in ((td[keys.OBSERVATION], "observation"), (td[keys.REWARD].squeeze(-1), "reward")):
            worst = max(worst, _difference(mine[is_there], _column(recorded, name)[is_there]))
        flags = {"done": td[keys.DONE], "truncated": td[keys.TRUNCATED], "success": td[keys.OUTCOME] == SUCCESS}
        for name, flag in flags.items():
            if not torch.equal(flag.flatten()[is_there], _column(recorded, name).bool()[is_there]):
                return sum(len(episode["steps"]) for episode in episodes), float("inf")
    return sum(len(episode["steps"]) for episode in episodes), worst


def _column(rows: list[dict[str, Any]], name: str) -> torch.Tensor:
    return torch.tensor([row[name] for row in rows], dtype=torch.float64)


def _difference(mine: torch.Tensor, recorded: torch.Tensor) -> float:
    """Return the largest difference, of numbers above 1 as a share of them; infinite where the shapes differ."""
    if mine.shape != recorded.shape:
        return float("inf")
    relative = (mine.double() - recorded).abs() / recorded.abs().clamp(min=1.0)
    return float(relative.nan_to_num(nan=float("inf")).amax()) if len(mine) else 0.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("--dtype", choices=tuple(TOLERANCE), default="float64")
    arguments = parser.parse_args()
    try:
        episodes = json.loads(arguments.file.read_text())
        if not (isinstance(episodes, list) and all(isinstance(episode, dict) for episode in episodes)):
            raise ValueError("it is no list of episodes")
        steps, worst = replay(episodes, arguments.dtype)
        if not steps:
            raise ValueError("there are no episodes of either boat in it")
    except (OSError, ValueError, KeyError, TypeError, IndexError) as error:
        reason = f"no {error}" if isinstance(error, KeyError) else str(error).partition("\n")[0]
        print(f"{arguments.file}: no recorded episodes of the released environment ({reason})", file=sys.stderr)
        sys.exit(2)
    is_same = worst <= TOLERANCE[arguments.dtype]
    print(f"{steps} steps compared, largest difference {worst:.1e}: {'the same' if is_same else 'NOT the same'}")
    sys.exit(not is_same)


if __name__ == "__main__":
    main()
