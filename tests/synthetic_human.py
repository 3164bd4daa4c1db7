"""A small file of the released recording's schema, played by simple players in our own physics."""

from __future__ import annotations

import copy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import torch

from hpamdp.env.boatdock import harbour, physics

NUM_PEOPLE = 3
NUM_EPISODES = 70
MAX_PRESSES = 8
CENTRES = ((640, 512), (672, 504), (672, 504))
KEYMAPS = (1, 2, 1)
OUTCOME_CODES = {physics.OUT_OF_FUEL: 1, physics.SUCCESS: 2, physics.TOO_FAST: 3, physics.OUT_OF_BOUNDS: 4}
LONGEST = 1.9  # seconds of pressing
Episode = dict[str, Any]
Press = tuple[np.ndarray, int, float]  # position from the harbour's centre, key, duration


def recording(seed: int = 0) -> list[list[Episode]]:
    """Return the episodes of each person, each as the fields of the file's struct.

    Presses begin at rest. Every seventh episode lacks one press in its log, which may be the only one.
    """
    return copy.deepcopy(_recording(seed))


@cache
def _recording(seed: int) -> list[list[Episode]]:
    rng = np.random.default_rng(seed)
    return [[_play(rng, person, index) for index in range(NUM_EPISODES)] for person in range(NUM_PEOPLE)]


def _play(rng: np.random.Generator, person: int, index: int) -> Episode:
    start, goal = _in_disc(rng), _in_disc(rng)
    while np.linalg.norm(start - goal) < harbour.MIN_SEPARATION:
        start, goal = _in_disc(rng), _in_disc(rng)
    controller = int(rng.integers(2))
    headings = _headings(controller, KEYMAPS[person])
    to = torch.tensor(goal).float()
    boat = torch.tensor(start).float()
    fuel = torch.tensor(physics.TANK)
    outcome = physics.SAILING
    presses: list[Press] = []
    while outcome == physics.SAILING:
        ahead = headings @ (to - boat)
        key = int(ahead.argmax())
        wanted = physics.press_for(ahead[key].clamp(min=5.0)) * float(np.exp(rng.normal(0.0, 0.12)))
        # The last allowed press is long enough to leave the harbour or run into the dock.
        duration = torch.tensor(LONGEST) if len(presses) == MAX_PRESSES - 1 else wanted.clamp(max=LONGEST)
        after = physics.press(boat[0], boat[1], fuel, to[0], to[1], headings[key, 0], headings[key, 1], duration)
        presses.append((boat.double().numpy(), key, float(fuel - after.fuel)))
        boat = torch.stack([after.x, after.y])
        fuel = after.fuel
        outcome = int(after.outcome)
    if index % 7 == 3:
        presses.pop(len(presses) // 2)
    return {
        **_press_fields(presses, start, goal, person),
        "center": np.array([CENTRES[person]], np.uint16),
        "SG": np.stack([start, goal], 1).reshape(1, 4) + np.repeat(CENTRES[person], 2),
        "R": np.uint8([[120]]),
        "outcome": np.uint8([[OUTCOME_CODES[outcome]]]),
        "boatdir": 10.0 * headings.double().numpy().T,
        "boatchoice": np.uint8([[controller]]),
        "incongkm": np.uint8([[KEYMAPS[person]]]),
        "tank": np.uint16([[round(60 * float(fuel))]]),
    }


def _headings(controller: int, keymap: int) -> torch.Tensor:
    """Return the three keys' unit directions, `[3, 2]`."""
    x, y = harbour.direction(torch.full((3,), controller), torch.full((3,), keymap), torch.arange(3))
    return torch.stack([x, y], 1)


def _in_disc(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0.0, 2.0 * np.pi)
    radius = 109.9 * np.sqrt(rng.uniform())
    return np.float32(radius * np.array([np.cos(angle), np.sin(angle)])).astype(float)


def _press_fields(presses: list[Press], start: np.ndarray, goal: np.ndarray, person: int) -> Episode:
    centre = np.array(CENTRES[person], float)
    num = len(presses)
    duration = np.array([duration for _, _, duration in presses])
    actions = np.zeros((num, 3))
    actions[np.arange(num), [key for _, key, _ in presses]] = duration
    position = np.array([position for position, _, _ in presses]).reshape(-1, 2) + centre
    if num == 1:  # the file has no position of a single press: it began at the start
        position[0] = start + centre
    return {
        "obs": position[:-1].reshape(1, -1),
        "next_obs": position[1:].reshape(1, -1),
        "actions": actions.reshape(1, -1),
        "velocity": (10.0 * actions**2 - 2.0 / 3.0 * actions**3).reshape(1, -1),
        "gas": (1.0 - np.cumsum(duration) / 5.0)[None],
        "distance": np.linalg.norm(position - (goal + centre), axis=1)[None],
        "terminals": np.array([[0] * (num - 1) + [1]], np.uint8),
    }


def write(path: Path, people: list[list[Episode]] | None = None, *, compressed: bool = True) -> Path:
    """Write a recording as a MAT file and return its path."""
    if people is None:
        people = recording()
    cells = np.empty((1, len(people)), object)
    for person, episodes in enumerate(people):
        cells[0, person] = np.empty((1, len(episodes)), object)
        for index, fields in enumerate(episodes):
            cells[0, person][0, index] = fields
    scipy.io.savemat(path, {"trajectories": cells}, do_compression=compressed)
    return path
