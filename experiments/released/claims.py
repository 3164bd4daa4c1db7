"""Play the released environment to measure the effects of its rules, and print the figures of README.md.

Run: python experiments/released/claims.py
"""

from __future__ import annotations

import sys

import torch
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.env.boatdock_released import rules as released
from hpamdp.env.boatdock_released.environment import ReleasedBoatDockEnv
from hpamdp.messages import exit_code

BOATS = ("congruent", "incongruent")
LAYOUTS, IDLE = 1_000, 980
LONGEST = 66.0  # px that one press can carry without throwing


def press(env: ReleasedBoatDockEnv, key: Tensor | int, duration: Tensor | float) -> TensorDict:
    """Press a key with duration u in every environment; return the tensordict after it."""
    n = env.num_envs
    duration = torch.as_tensor(duration, dtype=torch.float32).expand(n)
    action = {keys.DISCRETE: torch.as_tensor(key).expand(n), keys.PARAMETERS: duration.unsqueeze(-1).expand(n, 3)}
    return env.step(TensorDict(action, [n]))["next"]


def place(env: ReleasedBoatDockEnv, start: tuple[float, float], goal: tuple[float, float]) -> TensorDict:
    """Start all boats at one place with one goal."""
    points = {"start": torch.tensor([start]), "goal": torch.tensor([goal])}
    layout = {name: point.expand(env.num_envs, 2) for name, point in points.items()}
    return env.reset(TensorDict(layout, env.batch_size))


def sail(observation: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return keys and durations u `[N]` by a rule of thumb: press the best key towards the goal as long as it helps.

    Args:
        observation: observation in pixels, `[N, 15]`.
        directions: directions of the keys, `[N, 3, 2]`.
    """
    to_goal = observation[:, 2:4] - observation[:, 9:11]
    distance, key = torch.einsum("nd,nkd->nk", to_goal, directions).max(-1)
    seconds = torch.linspace(0.0, 0.2, 2001)  # up to 0.2 s, a longer press carries further
    nearest = torch.searchsorted(released.reach(seconds), distance.clamp(0.0, LONGEST)).clamp(max=2000)
    return key, seconds[nearest] / 2.5 - 1.0


def play(controller: str, idle: int) -> tuple[Tensor, Tensor]:
    """Press `idle` times with duration 0, then sail, and return the returns and the outcomes `[LAYOUTS]`."""
    env = ReleasedBoatDockEnv(LAYOUTS, controller=controller, keymap=1)
    td = env.reset(env.fixed_episodes(0))
    directions = torch.tensor(released.DIRECTIONS[controller])[-1].expand(LAYOUTS, 3, 2)
    total = torch.zeros(LAYOUTS)
    for step in range(idle + 30):
        key, duration = (0, -1.0) if step < idle else sail(td[keys.OBSERVATION], directions)
        td = press(env, key, duration)
        total += td[keys.REWARD].squeeze(-1)
    return total, td[keys.OUTCOME]


def refuelling() -> None:
    """Print the effect of idling before sailing on the return."""
    for controller in BOATS:
        for idle in (0, IDLE):
            total, outcome = play(controller, idle)
            docked = outcome == released.SUCCESS
            print(
                f"{controller}, {idle} idle presses, then sailing: docks in {docked.float().mean():.0%} of {LAYOUTS:,} "
                f"layouts, mean return of these {total[docked].mean():,.1f}, of all {total.mean():,.1f}"
            )


def throws() -> None:
    """Print how far presses carry, and the fraction of durations that throw backwards."""
    for seconds in (0.1, 0.2, 0.29, 0.31, 0.5, 1.0, 5.0):
        px = released.reach(torch.tensor(seconds, dtype=torch.float64))
        print(f"a press of {seconds:.2f} s (u = {seconds / 2.5 - 1:+.3f}) carries {px:,.1f} px")
    uniform = torch.linspace(-1.0, 1.0, 100_001)
    is_throw = released.reach(2.5 * (uniform + 1.0)) < 0.0
    print(f"share of [-1, 1] that throws backwards: {is_throw.float().mean():.0%}")


def walls() -> None:
    """Print the effects of the four walls, and the cost of an empty tank."""
    env = ReleasedBoatDockEnv()
    # The congruent keys go down left, up and down right; u = -0.92 carries 67 px.
    courses = (
        ("left", (580.0, 500.0), 0),
        ("upper", (640.0, 450.0), 1),
        ("right", (700.0, 500.0), 2),
        ("lower", (640.0, 570.0), 2),
    )
    for name, start, key in courses:
        place(env, start, goal=(640.0, 512.0))
        td = press(env, key, -0.92)
        x, y = td[keys.OBSERVATION][0, 9:11].tolist()
        outcome = released.OUTCOMES[td[keys.OUTCOME].item()]
        print(f"{name} wall: {outcome}, reward {td[keys.REWARD].item():+.2f}, boat shown at ({x:.0f}, {y:.0f})")
    place(env, (600.0, 520.0), goal=(700.0, 530.0))
    durations = (0.0, 1.0, 1.0, 1.0, 1.0, 1.0)  # a throw to the lower wall, then five full burns
    rewards = [press(env, 1, duration)[keys.REWARD].item() for duration in durations]
    print("a tank burnt at the lower wall:", ", ".join(f"{reward:+.2f}" for reward in rewards))


def random_presses() -> None:
    """Print the results of uniformly random presses."""
    env = ReleasedBoatDockEnv(LAYOUTS)
    env.reset(env.fixed_episodes(0))
    generator = torch.Generator().manual_seed(0)
    total = torch.zeros(LAYOUTS)
    presses = torch.zeros(LAYOUTS)
    outcome = torch.zeros(LAYOUTS, dtype=torch.long)
    for _ in range(200):
        presses += outcome == released.SAILING
        key = torch.randint(3, (LAYOUTS,), generator=generator)
        td = press(env, key, 2.0 * torch.rand(LAYOUTS, generator=generator) - 1.0)
        total += td[keys.REWARD].squeeze(-1)
        outcome = td[keys.OUTCOME]
    shares = [f"{name} {(outcome == i).float().mean():.1%}" for i, name in enumerate(released.OUTCOMES)]
    print(f"random presses: mean return {total.mean():+.3f}, {presses.mean():.2f} presses, {', '.join(shares)}")


def frozen_layouts() -> None:
    """Print the number of layouts of an environment."""
    for is_frozen in (True, False):
        env = ReleasedBoatDockEnv(frozen_layouts=is_frozen)
        seen = set()
        for _ in range(100):
            seen.add(tuple(env.reset()[keys.OBSERVATION][0, :4].tolist()))
        print(f"frozen_layouts={is_frozen}: layouts in 100 episodes of an environment: {len(seen)}")


def main() -> None:
    """Print all claims, each with its numbers."""
    for claim in (frozen_layouts, refuelling, throws, walls, random_presses):
        print(f"# {claim.__name__}")
        claim()


if __name__ == "__main__":
    sys.exit(exit_code(main))
