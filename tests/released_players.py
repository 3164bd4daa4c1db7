"""A recorded episode of the released code, and helpers to act in ReleasedBoatDockEnv."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from scripts import load_script
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.env.boatdock_released.environment import ReleasedBoatDockEnv

REPLAY = Path(__file__).resolve().parent.parent / "experiments" / "released" / "replay.py"
TRACES = sorted(Path(os.environ["HPAMDP_TRACES"]).glob("*.json")) if "HPAMDP_TRACES" in os.environ else []
IDLE, STEP = -1.0, -0.92  # durations u: 0 s, and .2 s, which move a boat by 66.65 px
X, Y = 9, 10
VELOCITY, FUEL, DISTANCE = slice(11, 13), 13, 14

# A recorded episode of the released code; the last press docks. Each press: key, parameter, boat, velocity, fuel,
# distance.
HEAD = (693.0, 585.0, 611.0, 482.0, 640.0, 512.0, 120.0, 1.0, -1.0)
FIRST, SECOND, THIRD = (
    (693.0, 527.7580543433888),
    (662.0440020606039, 509.88507631833335),
    (629.2628408440448, 490.95830887228306),
)
PRESSES = (
    (1, -0.9449630379676819, FIRST, (0.0, -1.3759240508079529), 1.1889926075935364, 0.7132524008542312),
    (2, -0.8716713190078735, SECOND, (2.778315943479538, 1.6041085124015808), 1.363326871395111, 0.4417926346074991),
    (2, -0.8712390661239624, THIRD, (2.787674218416214, 1.60951167345047), 1.5375746846199037, 0.15450739546487646),
    (2, -0.8746877312660217, THIRD, (2.7130106180906295, 1.5664033591747284), 1.712512230873108, 0.15450739546487646),
)
REWARDS = (0.2867475991457688, 0.27145976624673207, 0.28728523914262266, 17.12512230873108)
RECORDED = {
    "controller": 1,
    "keymap": -1,
    "start": HEAD[:2],
    "goal": HEAD[2:4],
    "observation0": (*HEAD, *HEAD[:2], 0.0, 0.0, 1.0, 1.0),
    "steps": [
        {
            "key": key,
            "parameter": (parameter,) * 3,
            "reward": reward,
            "observation": (*HEAD, *boat, *velocity, fuel, distance),
            "done": reward == REWARDS[-1],
            "truncated": False,
            "success": reward == REWARDS[-1],
        }
        for (key, parameter, boat, velocity, fuel, distance), reward in zip(PRESSES, REWARDS, strict=True)
    ],
}


def load_replay():
    return load_script(REPLAY)


def action(key, duration) -> TensorDict:
    """Return actions: `key` is a list, `duration` has a number for each environment or is `[N, 3]`."""
    key = torch.as_tensor(key)
    duration = torch.as_tensor(duration, dtype=torch.float32)
    duration = duration if duration.ndim == 2 else duration.unsqueeze(-1).expand(-1, 3)
    return TensorDict({keys.ACTION: TensorDict(discrete=key, parameters=duration, batch_size=[len(key)])}, [len(key)])


def press(env: ReleasedBoatDockEnv, key: int, duration: float) -> TensorDict:
    return env.step(action([key] * env.num_envs, [duration] * env.num_envs))["next"]


def place(env: ReleasedBoatDockEnv, start, goal, **more) -> TensorDict:
    """Start an episode of one boat in this layout."""
    layout = TensorDict(
        {"start": torch.tensor([start], dtype=torch.float64), "goal": torch.tensor([goal], dtype=torch.float64)}, [1]
    )
    for name, value in more.items():
        layout[name] = torch.tensor([value])
    return env.reset(layout)


def observed(td: TensorDict) -> list[float]:
    """Return the observation of the only boat."""
    return td[keys.OBSERVATION][0].tolist()


def end(td: TensorDict) -> tuple[int, float, bool, bool]:
    """Return outcome, reward, terminated and truncated of the only boat."""
    return td[keys.OUTCOME].item(), td[keys.REWARD].item(), td[keys.TERMINATED].item(), td[keys.TRUNCATED].item()


class InFloat64(ReleasedBoatDockEnv):
    float_type = torch.float64


def one(**arguments) -> ReleasedBoatDockEnv:
    return InFloat64(**arguments)


def restart(env: ReleasedBoatDockEnv, td: TensorDict, mask: list[bool]) -> TensorDict:
    """Start new episodes in the rows of the mask."""
    return env.reset(td.clone().set("_reset", torch.tensor(mask).unsqueeze(-1)))


def layouts(td: TensorDict) -> Tensor:
    return td[keys.OBSERVATION][:, :4]
