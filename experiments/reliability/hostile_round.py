"""Try thousands of hostile inputs, and list each one that ends in a wrong way."""

from __future__ import annotations

import argparse
import itertools
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import command_line  # noqa: F401  # the imports of every run, before cases are forked

sys.path.insert(0, str(Path(__file__).parent))
from hostile import data_sets, environments, saved_files
from hostile.case import ACCEPTED, BAD, REFUSED, Case, play

from hpamdp.messages import exit_code

KINDS = ("files", "environments", "data")


def cases(kinds: list[str], agents: Path, contents: int, seed: int) -> Iterator[Case]:
    """Yield the cases of these kinds, among them `contents` changed checkpoints."""
    if "files" in kinds:
        yield from saved_files.cases(saved_files.train_agents(agents), contents, seed)
    if "environments" in kinds:
        yield from environments.cases(seed)
    if "data" in kinds:
        yield from data_sets.cases(contents // 6, seed)


def main() -> None:
    """Print a line for each case that ended wrongly, and a table of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", nargs="*", default=[*KINDS], choices=KINDS)
    parser.add_argument("--contents", type=int, default=1200, help="changed checkpoints; of others, a sixth")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--part", type=int, default=0, help="number of this process among several, from 0")
    parser.add_argument("--parts", type=int, default=1, help="processes that share the cases")
    arguments = parser.parse_args()
    counts: dict[str, Counter[str]] = {}
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as agents:
        all_cases = cases(arguments.kinds, Path(agents), arguments.contents, arguments.seed)
        for case in itertools.islice(all_cases, arguments.part, None, arguments.parts):
            ending = play(case)
            outcome = ending.partition(":")[0]
            counts.setdefault(case.kind, Counter())[outcome] += 1
            if outcome in BAD:
                print(f"{ending} | {case.kind} | {case.name}", flush=True)
    print(f"\n| kind | cases | {REFUSED} | {ACCEPTED} | {' | '.join(BAD)} |\n|---|---|---|---|---|---|---|")
    for kind, count in counts.items():
        cells = [sum(count.values()), *(count[outcome] for outcome in (REFUSED, ACCEPTED, *BAD))]
        print(f"| {kind} | {' | '.join(map(str, cells))} |")
    total = sum(sum(count.values()) for count in counts.values())
    print(f"\n{total} cases in {time.monotonic() - begin:.0f} s")


if __name__ == "__main__":
    sys.exit(exit_code(main))
