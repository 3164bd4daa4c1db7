"""Tabulate which policy ends with the best greedy agent if the options are still learning.

python experiments/rising/study.py             only tabulates the csv files
python experiments/rising/study.py all         plays all cases first, in some minutes
python experiments/rising/study.py CASE...     plays these cases, such as "50 and 150", and replaces their rows
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from experiments.study_tables import Rows, groups, markdown_table, read_csv, write_tables
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
SHARE = "Share of the best split's gain over option 0 alone, if the final choice sees the context"


def play(names: Sequence[str]) -> None:
    """Play cases and replace their rows in results.csv and cases.csv."""
    from cases import all_cases, case_row  # these modules lie beside this one, which reports load without them
    from play import play_case

    cases = all_cases()
    unknown = set(names) - set(cases)
    if unknown:
        raise SystemExit(f"no case {unknown.pop()}; there are: {', '.join(cases)}")
    write_tables(HERE, {"cases": [case_row(name, case) for name, case in cases.items()]})
    for name in names or cases:
        stored = read_csv(HERE / "results.csv") if (HERE / "results.csv").exists() else []
        rows = [row for row in stored if row["case"] != name] + play_case(name)
        order = list(cases)
        write_tables(HERE, {"results": sorted(rows, key=lambda row: order.index(row["case"]))})


def of_cases(cases: Rows) -> str:
    """Return a line for each case: option 0 alone, the best split and its final value."""
    lines = []
    for case in cases:
        shares = ":".join(f"{100 * case[f'split_{i}']:.0f}" for i in range(3) if case[f"split_{i}"] != "")
        lines.append([case["case"], f"{case['decisions']:,}", f"{case['alone']:.3f}", shares, f"{case['best']:.3f}"])
    return markdown_table("case | decisions | option 0 alone | best split | its final value", lines)


def table(rows: Rows, cases: Rows) -> str:
    """Return a line for each policy, with a cell for each case."""
    names = [case["case"] for case in cases]
    lines = []
    for (policy,), own in groups(rows, "policy").items():
        of_case = {row["case"]: row for row in own}
        lines.append([policy, *(cell(of_case[name]) if name in of_case else "" for name in names)])
    return markdown_table(" | ".join(["policy", *names]), lines)


def cell(row: dict) -> str:
    """Return the share of a policy in a case; empty if there is nothing to gain."""
    share = row["by_context_share"]
    return "" if share == "" else f"{round(share, 2) + 0.0:.2f}"  # no minus before a zero


def main(arguments: Sequence[str]) -> None:
    """Play what the arguments name, and tabulate."""
    if arguments:
        play([] if list(arguments) == ["all"] else arguments)
    cases, rows = read_csv(HERE / "cases.csv"), read_csv(HERE / "results.csv")
    if (HERE / "peers.csv").exists():
        rows += read_csv(HERE / "peers.csv")
    print(of_cases(cases))
    print(f"\n{SHARE}\n\n{table(rows, cases)}")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
