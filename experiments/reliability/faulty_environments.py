"""Train on Gymnasium environments, each with a different fault, and list how the runs end."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

import command_line
import gymnasium
import numpy as np
from gymnasium import spaces

from hpamdp.messages import exit_code

WORDS = [
    "env=gymnasium", "env.entry_point=faulty_environments:Faulty", "env.max_steps=10", "high=none", "low=random",
    "num_envs=2", "steps_per_batch=8", "total_frames=320", "eval.layouts=4", "eval.every=0", "checkpoint_every=32",
    "hydra.run.dir=run",
]  # fmt: skip
FAULTY_AFTER = 60  # steps, when there is a checkpoint

# How a run should end: `line` in one line and a code other than 0, `error` with the environment's own error and its
# traceback, `stops` as with Ctrl-C, `goes on` with code 0.
FAULTS = {
    "reward is NaN": "line",
    "reward is infinite": "line",
    "reward is 1e38, again and again": "line",
    "reward is None": "line",
    "reward is two numbers": "line",
    "reward is a word": "line",
    "observation is NaN": "line",
    "observation is longer than its space": "line",
    "observation is outside its Discrete": "line",
    "observation is None": "line",
    "observation is a word": "line",
    "observation lacks an entry": "line",
    "step returns three values": "line",
    "reset returns the observation alone": "line",
    "reset takes no seed": "line",
    "info is None": "line",
    "terminated is None": "line",
    "step raises": "error",
    "reset raises": "error",
    "constructor raises": "error",
    "close raises": "goes on",
    "step calls sys.exit": "line",
    "step interrupts the run": "stops",
    "no actions": "line",
    "parameters without bounds": "line",
    "parameters with NaN bounds": "line",
    "observation space is missing": "line",
    "copies have different spaces": "line",
    "returns the same array each time": "goes on",
    "prints at each step": "goes on",
    "reseeds the global generator": "goes on",
}


class Faulty(gymnasium.Env):
    """A trivial environment with one of the faults."""

    made = 0

    def __init__(self, fault: str = "") -> None:
        Faulty.made += 1
        self.fault = fault
        if fault == "constructor raises":
            raise RuntimeError("a bug in the constructor")
        side = 2 if fault == "copies have different spaces" and Faulty.made > 1 else 1
        self.observation_space: Any = spaces.Dict(
            {"place": spaces.Box(-1.0, 1.0, (side,)), "count": spaces.Discrete(100)}
        )
        if fault == "observation space is missing":
            self.observation_space = None
        high = {"parameters without bounds": np.inf, "parameters with NaN bounds": np.nan}.get(fault, 1.0)
        num = 0 if fault == "no actions" else 1
        box = spaces.Box(np.float32([-1.0]), np.float32([1.0]))
        if high != 1.0:
            box.low, box.high = np.float32([-high]), np.float32([high])
        boxes = [box] * (num + 1)
        kinds = spaces.Discrete(num + 1)
        if fault == "no actions":
            kinds.n, boxes = np.int64(0), []
        self.action_space = spaces.Tuple((kinds, spaces.Tuple(boxes)))
        self.place = np.zeros(side, np.float32)
        self.num_steps = 0

    def reset(self, **kwargs: Any) -> Any:
        is_late = self.num_steps > FAULTY_AFTER
        if self.fault == "reset takes no seed" and kwargs.get("seed") is not None:
            raise TypeError("reset() got an unexpected keyword argument 'seed'")
        super().reset(seed=kwargs.get("seed"))
        if self.fault == "reset raises" and is_late:
            raise RuntimeError("a bug in reset")
        return self._look() if self.fault == "reset returns the observation alone" else (self._look(), {})

    def step(self, action: Any) -> Any:
        self.num_steps += 1
        fault = self.fault if self.num_steps > FAULTY_AFTER else ""
        if fault == "step raises":
            raise RuntimeError("a bug in step")
        if fault == "step calls sys.exit":
            sys.exit(0)
        if fault == "step interrupts the run":
            os.kill(os.getpid(), signal.SIGINT)
        if fault == "prints at each step":
            print("stepping")
        if fault == "reseeds the global generator":
            np.random.seed(0)
        reward = {
            "reward is NaN": float("nan"),
            "reward is infinite": float("inf"),
            "reward is 1e38, again and again": 1e38,
            "reward is None": None,
            "reward is two numbers": np.ones(2),
            "reward is a word": "much",
        }.get(fault, 0.5)
        if fault == "step returns three values":
            return self._look(), reward, False
        return self._look(), reward, None if fault == "terminated is None" else False, False, self._info(fault)

    def close(self) -> None:
        if self.fault == "close raises":
            raise RuntimeError("a bug in close")

    def _info(self, fault: str) -> Any:
        return None if fault == "info is None" else {}

    def _look(self) -> Any:
        fault = self.fault if self.num_steps > FAULTY_AFTER else ""
        place = self.place if fault == "returns the same array each time" else self.place.copy()
        observation: Any = {"place": place, "count": min(self.num_steps, 99)}
        if fault == "observation is NaN":
            observation["place"] = np.full(1, np.nan, np.float32)
        if fault == "observation is longer than its space":
            observation["place"] = np.zeros(3, np.float32)
        if fault == "observation is outside its Discrete":
            observation["count"] = 100
        if fault == "observation is None":
            observation["place"] = None
        if fault == "observation is a word":
            observation["place"] = "here"
        if fault == "observation lacks an entry":
            del observation["count"]
        return observation


def main() -> None:
    """Print a row for each fault."""
    print("| fault | wanted | code | what the run said |")
    print("|---|---|---|---|")
    kept = 0
    with tempfile.TemporaryDirectory() as temporary:
        for number, (fault, wanted) in enumerate(FAULTS.items()):
            folder = Path(temporary) / str(number)
            ending = command_line.run([*WORDS, f"+env.kwargs.fault='{fault}'"], folder)
            said = ending.errors[-1] if ending.errors else ""
            is_right = {
                "line": ending.is_one_line,
                "error": ending.code == 1 and "a bug in" in said,
                "stops": ending.code == 130,
                "goes on": ending.code == 0,
            }[wanted]
            kept += (folder / "run" / "checkpoint.zip").is_file()
            lines = len(ending.errors)
            print(f"| {fault} | {wanted}{'' if is_right else ' **not so**'} | {ending.code} | {lines}: {said[:150]} |")
    print(f"\n{kept} of {len(FAULTS)} runs left a checkpoint.")


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent))
    sys.exit(exit_code(main))
