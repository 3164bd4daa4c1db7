"""Replay recorded episodes of the field's domains in our rules, and print the largest differences.

Run: python experiments/domains/replay.py FILE.json [--dtype float32] [--step-by-step] [--tolerance 1e-6]

A file holds episodes that the reference code of a domain played, with every random number that it drew. By default an
episode runs through from its first state. With --step-by-step each step starts from the recorded state before it.
float32 always goes step by step, since small differences grow.

The exit code is 1 if a number differs by more than the tolerance, or if an outcome, termination or truncation differs.
It is 2 if the file is no such recording.

A file has `schema` (1), `domain`, `state_names` and `episodes`; for Hard Move also `num_actuators` and `motions`. An
episode has `initial` (`state`, `observation`) and `steps`. Each step has `action`, `parameters` (of the chosen action),
`observation`, `state` (after it), `reward`, `terminated`, `truncated` and `outcome` (empty while the episode
continues). The steps of Platform and Goal also have `ticks` and the random numbers: `draws` for each tick, and on
Platform `jump`. Another domain needs a module in `adapters/`, see the docstrings there.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent))
from adapters import Adapter, load

from hpamdp.messages import exit_code

FLOAT64_TOLERANCE = 1e-9


@dataclass
class Report:
    """Results of a replay.

    Attributes:
        steps: number of compared steps.
        largest: the largest difference of each column of the state, and of `observation`, `reward` and, if an action
            has them, `ticks`.
        mismatches: descriptions of steps whose outcome or flags differ.
    """

    steps: int = 0
    largest: dict[str, float] = field(default_factory=dict)
    mismatches: list[str] = field(default_factory=list)

    @property
    def worst(self) -> float:
        """The largest difference of all."""
        return max(self.largest.values(), default=0.0)


@dataclass(frozen=True)
class _Step:
    """One recorded step: its place in the file, the state before it, and the recorded values."""

    episode: int
    number: int
    before: list[float]
    recorded: dict[str, Any]


def replay(recording: dict[str, Any], dtype: torch.dtype = torch.float64, *, step_by_step: bool = False) -> Report:
    """Compare a recording with our rules.

    Raises:
        ValueError: there is no adapter for its domain, or a value in the recording is wrong.
        IndexError, KeyError, RuntimeError, TypeError: it is no recording of that domain.
    """
    adapter = load(recording)
    episodes = recording["episodes"]
    report = Report()
    starts = [episode["initial"] for episode in episodes]
    state = adapter.states([start["state"] for start in starts], [0] * len(starts), dtype)
    _note(report, "observation", adapter.observe(state), [start["observation"] for start in starts])
    if step_by_step:
        steps = [step for number, episode in enumerate(episodes) for step in _steps(number, episode)]
        before = adapter.states([step.before for step in steps], [step.number for step in steps], dtype)
        _compare(report, adapter, before, steps)
        return report
    running = list(range(len(episodes)))
    number = 0
    while running:
        going_on = [row for row, episode in enumerate(running) if number < len(episodes[episode]["steps"])]
        state = type(state)(*(column[going_on] for column in state))
        running = [running[row] for row in going_on]
        if running:
            steps = [_Step(episode, number, [], episodes[episode]["steps"][number]) for episode in running]
            state = _compare(report, adapter, state, steps)
        number += 1
    return report


def _steps(number: int, episode: dict[str, Any]) -> list[_Step]:
    before = [episode["initial"]["state"], *(step["state"] for step in episode["steps"])]
    return [_Step(number, at, before[at], step) for at, step in enumerate(episode["steps"])]


def _compare(report: Report, adapter: Adapter, state: Any, steps: list[_Step]) -> Any:
    """Take the steps `[N]` from the states, note the differences, and return the states after them."""
    recorded = [step.recorded for step in steps]
    after, results = adapter.act(state, recorded)
    report.steps += len(steps)
    columns = adapter.columns([step["state"] for step in recorded])
    for name, values in adapter.named(after).items():
        _note(report, name, values, columns[name], is_angle=name in adapter.angles)
    _note(report, "observation", adapter.observe(after), [step["observation"] for step in recorded])
    for name, values in results.items():
        _note(report, name, values, [step[name] for step in recorded])
    for step, code in zip(steps, after.outcome.tolist(), strict=True):
        outcome = adapter.outcomes[code]
        ours = (outcome, outcome not in ("", "limit"), outcome == "limit")
        theirs = (step.recorded["outcome"], step.recorded["terminated"], step.recorded["truncated"])
        if ours != theirs:
            report.mismatches.append(
                f"episode {step.episode}, step {step.number}: {ours}, but recorded (outcome, terminated, truncated) "
                f"is {theirs}"
            )
    return after


def _note(report: Report, name: str, ours: Tensor, theirs: Any, *, is_angle: bool = False) -> None:
    difference = (ours.double() - torch.as_tensor(theirs, dtype=torch.float64)).abs()
    if is_angle:
        difference = (difference + math.pi).remainder(2.0 * math.pi).sub(math.pi).abs()
    # A difference from NaN is infinite.
    largest = difference.nan_to_num(nan=math.inf).max().item() if difference.numel() else 0.0
    report.largest[name] = max(report.largest.get(name, 0.0), largest)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path)
    parser.add_argument("--dtype", choices=("float32", "float64"), default="float64")
    parser.add_argument("--step-by-step", action="store_true", help="start each step from the recorded state before it")
    parser.add_argument("--tolerance", type=float, help="largest difference allowed; the default depends on the dtype")
    options = parser.parse_args(arguments)
    step_by_step = options.step_by_step or options.dtype == "float32"
    if options.tolerance is not None and not options.tolerance >= 0.0:
        parser.error(f"--tolerance {options.tolerance}: must be at least 0")
    try:
        recording = json.loads(options.file.read_text())
        adapter = load(recording)
        report = replay(recording, getattr(torch, options.dtype), step_by_step=step_by_step)
    except (OSError, json.JSONDecodeError) as error:
        print(f"{options.file}: {error}", file=sys.stderr)
        return 2
    except KeyError as error:
        print(f"{options.file}: not a recording: it lacks {error}", file=sys.stderr)
        return 2
    except (IndexError, RuntimeError, TypeError, ValueError) as error:
        print(f"{options.file}: not a recording: {str(error).partition(chr(10))[0]}", file=sys.stderr)
        return 2
    tolerance = options.tolerance
    if tolerance is None:
        tolerance = FLOAT64_TOLERANCE if options.dtype == "float64" else adapter.float32_tolerance
    how = "step by step" if step_by_step else "run through"
    print(
        f"{recording['domain']}: {report.steps} steps of {len(recording['episodes'])} episodes, {options.dtype}, {how}"
    )
    for name, largest in report.largest.items():
        print(f"  {name:24} {largest:.1e}{'' if largest <= tolerance else f'  more than {tolerance:g}'}")
    for mismatch in report.mismatches[:20]:
        print(f"  {mismatch}")
    print(f"  outcomes and flags: {len(report.mismatches) or 'no'} differences")
    return 0 if report.worst <= tolerance and not report.mismatches else 1


if __name__ == "__main__":
    sys.exit(exit_code(main))
