"""Tabulate H-PPO with its defaults beside PPO of Stable-Baselines3 on domains of RDDL, against CPU seconds.

python experiments/rddl/study.py FOLDER    gathers the curves in the folder into curves.csv, then tabulates
python experiments/rddl/study.py           tabulates the stored csv file
"""

from __future__ import annotations

import sys
from pathlib import Path

from experiments.own_problems.study import LATENESS, gather
from experiments.study_tables import Rows, groups, markdown_table, mean_of, read_csv, write_tables
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
TIMES = (30.0, 60.0, 120.0)  # columns of the table, CPU seconds


def table(curves: Rows, known: Rows) -> str:
    """Return a line for each domain and player, with the way from random play to the best return that is known."""
    lines = []
    for each in known:
        of_domain = [row for row in curves if row["problem"] == each["problem"]]
        best = max(row["return"] for row in of_domain)
        best = best if each["planner"] == "" else max(best, each["planner"])
        played = [row for row in of_domain if row["player"] != "random"]
        for (library, player, limit), rows in groups(played, "library", "player", "limit_s").items():
            runs = list(groups(rows, "seed").values())
            after = [[_return_at(run, time) for run in runs] for time in TIMES if time <= limit]
            means = [sum(returns) / len(runs) for returns in after]
            cells = [f"{mean:,.0f}" if abs(mean) > 99.0 else f"{mean:.1f}" for mean in means]
            cells += [""] * (len(TIMES) - len(cells))
            ways = sorted((value - each["random"]) / (best - each["random"]) for value in after[-1])
            way = f"{ways[len(ways) // 2]:.2f} ({ways[0]:.2f} to {ways[-1]:.2f})" if len(ways) > 1 else f"{ways[0]:.2f}"
            steps = f"{mean_of([run[-1] for run in runs], 'steps'):,.0f}"
            lines.append([each["problem"], each["part"], f"{library} {player}", len(runs), *cells, way, steps])
    after = " | ".join(f"{time:g} s" for time in TIMES)
    return markdown_table(f"domain | part | player | seeds | {after} | way | steps at the end", lines)


def _return_at(run: Rows, cpu_s: float) -> float:
    """Return the last return by then."""
    return next(row["return"] for row in reversed(run) if row["cpu_s"] <= cpu_s + LATENESS)


def main(folders: list[str]) -> None:
    """Gather and tabulate."""
    known = read_csv(HERE / "known.csv")
    if folders:
        curves = gather(Path(folders[0]), [row["problem"] for row in known])
        write_tables(HERE, {"curves": [{name: row[name] for name in row if name != "way"} for row in curves]})
    print(table(read_csv(HERE / "curves.csv"), known))


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
