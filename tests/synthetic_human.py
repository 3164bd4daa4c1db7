"""A small file of the released recording's schema, played by simple players in our own physics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
import torch

from hpamdp.env.boatdock import harbour, physics

NUM_PEOPLE, NUM_EPISODES, MAX_PRESSES = 3, 70, 8
CENTRES = ((640, 512), (672, 504), (672, 504))
KEYMAPS = (1, 2, 1)
OUTCOME_CODES = {physics.OUT_OF_FUEL: 1, physics.SUCCESS: 2, physics.TOO_FAST: 3, physics.OUT_OF_BOUNDS: 4}
Episode = dict[str, Any]


def recording(seed: int = 0) -> list[list[Episode]]:
    """Return the episodes of each person, each the fields of the file's struct.

    Presses begin at rest; in one episode of seven one is missing from the log, in some of these the only one.
    """
    rng = np.random.default_rng(seed)
    return [[_play(rng, person, index) for index in range(NUM_EPISODES)] for person in range(NUM_PEOPLE)]


def _play(rng: np.random.Generator, person: int, index: int) -> Episode:
    goal = start = np.zeros(2)
    while np.linalg.norm(start - goal) < harbour.MIN_SEPARATION:
        start, goal = (_in_disc(rng) for _ in range(2))
    controller, keymap = int(rng.integers(2)), KEYMAPS[person]
    options = torch.full((3,), controller), torch.full((3,), keymap), torch.arange(3)
    headings = torch.stack(harbour.direction(*options), 1)
    boat, fuel, outcome, presses = torch.tensor(start).float(), torch.tensor(physics.TANK), physics.SAILING, []
    while outcome == physics.SAILING:
        ahead = headings @ (torch.tensor(goal).float() - boat)
        key = int(ahead.argmax())
        wanted = physics.press_for(ahead[key].clamp(min=5.0)) * float(np.exp(rng.normal(0.0, 0.12)))
        # The last press that is allowed is so long that it leaves the harbour or runs into the dock.
        x = torch.tensor(1.9) if len(presses) == MAX_PRESSES - 1 else wanted.clamp(max=1.9)
        after = physics.press(*boat, fuel, *torch.tensor(goal).float(), *headings[key], x)
        presses.append((boat.double().numpy(), key, float(fuel - after.fuel)))
        boat, fuel, outcome = torch.stack([after.x, after.y]), after.fuel, int(after.outcome)
    tank = round(60 * float(fuel))
    if index % 7 == 3:
        presses.pop(len(presses) // 2)
    return _fields(presses, start, goal, person, controller, outcome, tank, headings.double().numpy())


def _in_disc(rng: np.random.Generator) -> np.ndarray:
    angle, radius = rng.uniform(0.0, 2.0 * np.pi), 109.9 * np.sqrt(rng.uniform())
    return np.float32(radius * np.array([np.cos(angle), np.sin(angle)])).astype(float)


def _fields(
    presses: list[tuple[np.ndarray, int, float]],
    start: np.ndarray,
    goal: np.ndarray,
    person: int,
    controller: int,
    outcome: int,
    tank: int,
    headings: np.ndarray,
) -> Episode:
    centre, num = np.array(CENTRES[person], float), len(presses)
    x, actions = np.array([x for _, _, x in presses]), np.zeros((num, 3))
    where = np.array([p for p, _, _ in presses]).reshape(-1, 2) + centre
    if num == 1:  # of a single press the file has no position: it began at the start
        where[0] = start + centre
    actions[np.arange(num), [key for _, key, _ in presses]] = x
    start, goal = start + centre, goal + centre
    return {
        "obs": where[:-1].reshape(1, -1),
        "next_obs": where[1:].reshape(1, -1),
        "actions": actions.reshape(1, -1),
        "velocity": (10.0 * actions**2 - 2.0 / 3.0 * actions**3).reshape(1, -1),
        "gas": (1.0 - np.cumsum(x) / 5.0)[None],
        "distance": np.linalg.norm(where - goal, axis=1)[None],
        "terminals": np.array([[0] * (num - 1) + [1]], np.uint8),
        "center": centre[None].astype(np.uint16),
        "SG": np.array([[start[0], goal[0], start[1], goal[1]]]),
        "R": np.uint8([[120]]),
        "outcome": np.uint8([[OUTCOME_CODES[outcome]]]),
        "boatdir": 10.0 * headings.T,
        "boatchoice": np.uint8([[controller]]),
        "incongkm": np.uint8([[KEYMAPS[person]]]),
        "tank": np.uint16([[tank]]),
    }


def write(path: Path, people: list[list[Episode]] | None = None, *, compressed: bool = True) -> Path:
    """Write a recording as a MAT file."""
    cells = np.empty((1, len(people := recording() if people is None else people)), object)
    for person, episodes in enumerate(people):
        cells[0, person] = np.empty((1, len(episodes)), object)
        for index, fields in enumerate(episodes):
            cells[0, person][0, index] = fields
    scipy.io.savemat(path, {"trajectories": cells}, do_compression=compressed)
    return path
