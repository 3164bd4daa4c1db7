"""Tabulate and draw how agents dock boats that are new to them, by number of the trip, beside people.

python experiments/generalisation/study.py FOLDER...    adds the runs of experiment=generalisation in these folders to
                                                        results.csv, then draws and tabulates
python experiments/generalisation/study.py              draws and tabulates the stored csv files

`players.py`, `from_nothing.py` and `transfer.py` write the other csv files. people.csv has the recording's mean score
by number of the episode.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from hpamdp.analysis.study import (
    Rows,
    Run,
    add_to_tables,
    finished,
    groups,
    mean_interval,
    read_csv,
    spread,
    with_enough_seeds,
)
from hpamdp.env.boatdock.reference import HUMAN
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
SETTINGS = (
    "family",
    "boats",
    "frame",
    "fleet_size",
    "scored_boats",
    "values_end",
    "high",
    "high_memory",
    "low",
    "memory",
    "sharing",
)
RUN = (*SETTINGS, "frames", "seed")  # the columns that name a run
FIRST_LATER, NUM_TRIPS = 3, 8
PEOPLE_EPISODES = 60
PLANNING = ("pets", "dlpa")  # their plans end with the trip, whatever `agent.values_end` says
PLAYERS = {
    "knows": "best plans, which know the boat",
    "finds_out": "player who finds out",
    "from_nothing": "PETS, untrained when the session begins",
}
DRAWN = {"low": "hppo", "memory": "gru", "values_end": "trip"}  # the learner of the figure
COLOURS = {"turned": "#0072B2", "strength": "#009E73", "any": "#CC79A7"}


def gather(runs: Sequence[Run]) -> Rows:
    """Return a row for each run with sessions of `NUM_TRIPS` trips: its settings and the mean score of each trip."""
    rows: Rows = []
    for run in runs:
        if run.config["env"]["trips"] != NUM_TRIPS:
            continue
        env, low, high = run.config["env"], run.config["low"], run.config["high"] or {}
        played = run.played()
        scores, presses = played["trip_score"].mean(0), played["trip_presses"].mean(0)
        settings = {
            "family": env["family"],
            "boats": env["boats"],
            "frame": env["frame"],
            "fleet_size": env["fleet_size"] or "new",
            "scored_boats": env["scored_boats"],
            "values_end": "trip" if run.summary["low"] in PLANNING else _values_end(run.config["agent"]),
            "high": run.summary["high"],
            "high_memory": high.get("memory", ""),
            "low": run.summary["low"],
            "memory": low.get("memory", ""),
            "sharing": run.config["agent"]["sharing"],
        }
        rows.append(
            settings
            | {"frames": run.summary["frames"], "seed": run.summary["seed"], "cpu_s": round(run.summary["cpu_s"], 1)}
            | {"ceiling": round(run.summary["ceiling"], 4), "success": round(run.summary["success"], 4)}
            | {f"score_{trip}": round(float(score), 4) for trip, score in enumerate(scores, start=1)}
            | {f"presses_{trip}": round(float(number), 3) for trip, number in enumerate(presses, start=1)}
        )
    return rows


def _values_end(agent: dict) -> str:
    """Return where values end, such as `trip`, or `trip, selector: session` if the two levels differ."""
    of_selector = agent.get("selector_values_end") or agent["values_end"]
    return agent["values_end"] + (f", selector: {of_selector}" if of_selector != agent["values_end"] else "")


def later(row: dict, first: int = FIRST_LATER) -> float:
    """Return the mean score of a run's trips from this one on."""
    scores = [row[f"score_{trip}"] for trip in range(first, NUM_TRIPS + 1)]
    return sum(scores) / len(scores)


def table(results: Rows) -> str:
    """Return a line for each cell: the score of the first, the second and the later trips, mean and interval."""
    lines = [
        "| family | boats | frame | training boats | scored on | values end | selector | learner, memory, sharing | n "
        "| first trip | second trip | trips 3 to 8 | 95 % | trips 4 to 8 | ceiling | presses, first trip | later "
        "| CPU |",
        "|---" * 18 + "|",
    ]
    for settings, rows in groups(results, *SETTINGS).items():
        family, boats, frame, fleet, scored, ends, high, high_memory, low, memory, sharing = settings
        first, second, rest = ([value(row) for row in rows] for value in (_first, _second, later))
        low_end, high_end = mean_interval(rest)
        columns = [
            family,
            boats,
            frame.replace("_", " "),
            fleet,
            scored,
            ends,
            f"{high} {high_memory}".strip(),
            f"{low}, {memory}" + (f", {sharing.replace('_', ' ')}" if boats > 1 else ""),
            len(rows),
            spread(first),
            spread(second),
            spread(rest),
            f"{low_end:.3f} to {high_end:.3f}",
            spread([later(row, first=4) for row in rows]),
            f"{_mean(rows, 'ceiling'):.3f}",
            f"{_mean(rows, 'presses_1'):.1f}",
            f"{sum(_mean(rows, f'presses_{trip}') for trip in range(3, 9)) / 6:.1f}",
            f"{_mean(rows, 'cpu_s'):.0f} s",
        ]
        lines.append(f"| {' | '.join(map(str, columns))} |")
    return "\n".join(lines)


def _first(row: dict) -> float:
    return row["score_1"]


def _second(row: dict) -> float:
    return row["score_2"]


def _mean(rows: Rows, column: str) -> float:
    return sum(row[column] for row in rows) / len(rows)


def of_new_boats(results: Rows) -> Rows:
    """Return the rows of agents that never sailed a boat twice in training."""
    return [row for row in results if row["fleet_size"] == "new"]


def by_fleet(results: Rows) -> dict[int, dict[str, list[float]]]:
    """Return the scores of later trips by the number of boats in training, then by which boats are scored.

    Agents are in the order of their seeds, which are the same for both.
    """
    found: dict[int, dict[str, list[float]]] = {}
    rows = [row for row in results if row["fleet_size"] != "new"]
    for row in sorted(rows, key=lambda row: (int(row["fleet_size"]), row["seed"])):
        found.setdefault(int(row["fleet_size"]), {}).setdefault(row["scored_boats"], []).append(later(row))
    return {size: scores for size, scores in found.items() if len(scores["training"]) == len(scores["new"])}


def fleet_table(results: Rows) -> str:
    """Return a line for each number of boats in training: the score of later trips on these boats and on new ones."""
    lines = ["| training boats | n | on these boats | on new boats | difference | 95 % |", "|---|---|---|---|---|---|"]
    for size, scores in by_fleet(results).items():
        lost = [own - new for own, new in zip(scores["training"], scores["new"], strict=True)]
        low, high = mean_interval(lost)
        lines.append(
            f"| {size} | {len(lost)} | {spread(scores['training'])} | {spread(scores['new'])} | {spread(lost)} "
            f"| {low:.3f} to {high:.3f} |"
        )
    return "\n".join(lines)


def players_table(players: Rows) -> str:
    """Return a line for each family, number of boats and player: the score by number of the trip."""
    heads = ("family", "boats", "player", *(f"trip {trip}" for trip in range(1, NUM_TRIPS + 1)), "trips 3 to 8")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for (family, boats, player), rows in groups(players, "family", "boats", "player").items():
        scores = [row["score"] for row in rows]
        rest = scores[FIRST_LATER - 1 :]
        shown = " | ".join(f"{score:.2f}" for score in scores)
        lines.append(f"| {family} | {boats} | {PLAYERS[player]} | {shown} | {sum(rest) / len(rest):.3f} |")
    return "\n".join(lines)


def transfer_table(rows: Rows) -> str:
    """Return a line for each learner and controller of the training: the scores with both controllers."""
    lines = ["| learner | trained with | n | same controller | other controller |", "|---|---|---|---|---|"]
    for (learner, trained_on), of_both in groups(rows, "learner", "trained_on").items():
        same = [row["score"] for row in of_both if row["controller"] == trained_on]
        other = [row["score"] for row in of_both if row["controller"] != trained_on]
        lines.append(f"| {learner} | {trained_on} | {len(same)} | {spread(same)} | {spread(other)} |")
    return "\n".join(lines)


def draw(results: Rows, players: Rows, people: Rows, path: Path) -> None:
    """Draw the score by number of the trip with one boat, and people's over their first episodes beside it."""
    figure = Figure(figsize=(14.0, 4.2), layout="constrained")
    sessions, fleets, episodes = figure.subplots(1, 3, sharey=True, width_ratios=[3, 2, 2])
    trips = range(1, NUM_TRIPS + 1)
    for family, colour in COLOURS.items():
        shown = {"family": family, "boats": 1, "frame": "first_press", "fleet_size": "new", **DRAWN}
        rows = [row for row in results if all(row[name] == value for name, value in shown.items())]
        for number, row in enumerate(rows):
            scores = [row[f"score_{trip}"] for trip in trips]
            sessions.plot(trips, scores, color=colour, linewidth=1.3, label=None if number else f"H-PPO, {family}")
        for player, line in (("finds_out", "--"), ("knows", ":")):
            found = [row for row in players if (row["family"], row["boats"], row["player"]) == (family, 1, player)]
            if found:
                label = f"{PLAYERS[player]}, {family}"
                sessions.plot(trips, [row["score"] for row in found], color=colour, linestyle=line, label=label)
    sessions.set(xlabel="trip with a new boat", ylim=(-0.2, 3.8))
    sessions.set_ylabel("mean score of a trip")
    sizes = by_fleet(results)
    for scored, line, name in (("training", "o--", "these boats"), ("new", "o-", "new boats")):
        means = [sum(scores[scored]) / len(scores[scored]) for scores in sizes.values()]
        fleets.plot([*sizes], means, line, color=COLOURS["turned"], label=f"scored on {name}")
    fleets.set(xscale="log", xlabel="boats in training")
    fleets.set_xticks([*sizes], labels=[*map(str, sizes)])
    fleets.legend(loc="lower right", fontsize=7, frameon=False)
    scores = [row["score"] for row in people]
    episodes.plot(range(1, len(scores) + 1), scores, ".", color="#D98200", alpha=0.4, label="mean of 40 people")
    tens = [sum(scores[first : first + 10]) / 10 for first in range(0, len(scores), 10)]
    episodes.plot([10 * i + 5.5 for i in range(len(tens))], tens, "s-", color="#D98200", label="over ten episodes")
    episodes.legend(loc="lower right", fontsize=7, frameon=False)
    for axes in (sessions, fleets, episodes):
        axes.axhline(HUMAN["chosen"]["score"], color="#8c8c8c", linestyle=":", linewidth=1.0)
        axes.spines[["top", "right"]].set_visible(False)
    sessions.annotate(
        f"people's mean {HUMAN['chosen']['score']:.2f}", (NUM_TRIPS, HUMAN["chosen"]["score"]), ha="right"
    )
    episodes.set(xlabel="a person's episode, two boats", xlim=(0, PEOPLE_EPISODES))
    fleets.set_title("trips 3 to 8", loc="left", fontweight="bold", fontsize=10)
    episodes.set_title("people", loc="left", fontweight="bold", fontsize=10)
    sessions.set_title("agents", loc="left", fontweight="bold", fontsize=10)
    sessions.legend(loc="lower right", fontsize=7, frameon=False)
    figure.savefig(path, dpi=130)


def main(folders: Sequence[str]) -> None:
    """Gather, draw, tabulate."""
    if folders:
        add_to_tables(HERE, {"results": gather(finished(folders))}, RUN)
    names = ("results", "players", "from_nothing", "transfer", "people")
    stored = [HERE / f"{name}.csv" for name in names]
    results, players, untrained, transfer, people = (read_csv(file) if file.exists() else [] for file in stored)
    results = with_enough_seeds(results, *SETTINGS)
    transfer = with_enough_seeds(transfer, "learner", "trained_on", "controller")
    draw(results, players, people, HERE / "trips.png")
    of_agents = table(of_new_boats(results)), fleet_table(results)
    print(*of_agents, players_table(players + untrained), transfer_table(transfer), sep="\n\n")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
