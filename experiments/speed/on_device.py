"""Check and time boats and their planner on a device; `cuda.sh` calls it.

python experiments/speed/on_device.py DEVICE LARGEST    with up to LARGEST boats

Boats by the kernel move on the CPU whatever the device; boats by tensor functions move on the device. Times are wall
times, the best of three.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import torch

from experiments.whole_map.boat_rules import TensorBoats
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.harbour import fixed_layouts
from hpamdp.env.boatdock.planner import best_plans

CHECKED, STEPS, PLANNED = 10_000, 10, 100


def seconds(act: Callable[[], object], device: str) -> float:
    """Return the wall seconds of the fastest of three calls, after one more."""
    act()
    taken = []
    for _ in range(3):
        began = time.perf_counter()
        act()
        if device != "cpu":
            torch.cuda.synchronize()
        taken.append(time.perf_counter() - began)
    return min(taken)


def check(device: str) -> None:
    """Compare boats on the device with the kernel's, press by press."""
    boats, kernel = TensorBoats(CHECKED, device=device, seed=1), BoatDockEnv(CHECKED, seed=1)
    torch.manual_seed(1)
    td, other = boats.reset(), kernel.reset()
    num_other, worst = 0, 0.0
    for _ in range(STEPS):
        other = kernel.rand_action(other)
        td["action"], td["option"] = other["action"].to(device), other["option"].to(device)
        (step, td), (other_step, other) = boats.step_and_maybe_reset(td), kernel.step_and_maybe_reset(other)
        after, other_after = step["next"].cpu(), other_step["next"]
        is_same = after["outcome"] == other_after["outcome"]
        num_other += int((~is_same).sum())
        worst = max(worst, float((after["observation"] - other_after["observation"])[is_same].abs().max()))
    print(f"boats on {device}: {num_other} of {CHECKED * STEPS:,} outcomes differ; observations by at most {worst:.1e}")
    if num_other > CHECKED * STEPS // 1000 or worst > 1e-3:
        sys.exit("boats on the device do not follow the kernel's rules")


def time_boats(kind: type[BoatDockEnv], device: str, num_envs: int) -> None:
    """Print how many presses a second boats make."""
    env = kind(num_envs, device=device)
    td = env.rand_action(env.reset())
    action, option = td["action"], td["option"]

    def steps() -> None:
        nonlocal td
        for _ in range(STEPS):
            td["action"], td["option"] = action, option
            _, td = env.step_and_maybe_reset(td)

    taken = seconds(steps, device)
    name = "tensor functions" if kind is TensorBoats else "kernel"
    print(f"{num_envs:>12,} boats, {name}, tensors on {device}: {STEPS * num_envs / taken:,.0f} presses/s", flush=True)


def time_planner(device: str, num: int) -> None:
    """Print how many layouts a second the planner plans, and how far its scores are from the CPU's."""
    layout = fixed_layouts(num, 0)
    moved = type(layout)(*(column.to(device) for column in layout))
    keymap = torch.ones(num, dtype=torch.int32)
    taken = seconds(lambda: best_plans(moved, keymap.to(device)), device)
    few = type(layout)(*(column[:PLANNED] for column in layout))
    own, reference = best_plans(moved, keymap.to(device)), best_plans(few, keymap[:PLANNED])
    difference = (own.score[:PLANNED].cpu() - reference.score).abs().max()
    print(
        f"{num:,} layouts planned on {device}: {num / taken:,.0f} a second, scores within {difference:.1e} of the CPU's"
    )


def main(device: str, largest: int) -> None:
    """Check, then time."""
    name = torch.cuda.get_device_name() if device != "cpu" else "the CPU"
    print(f"PyTorch {torch.__version__}, {name}, {torch.get_num_threads()} threads")
    check(device)
    num_envs = 1_000
    while num_envs <= largest:
        for kind in (TensorBoats, BoatDockEnv):
            time_boats(kind, device, num_envs)
        num_envs *= 10
    time_planner(device, max(largest // 1_000, PLANNED))
    if device != "cpu":
        print(f"at most {torch.cuda.max_memory_allocated() / 2**30:.1f} GiB on the device")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
