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

from experiments.study_tables import (
    Rows,
    Run,
    add_to_tables,
    gathered,
    groups,
    interval_text,
    markdown_table,
    mean_of,
    read_csv,
    with_enough_seeds,
)
from hpamdp.analysis.statistics import spread
from hpamdp.env.boatdock.reference import HUMAN
from hpamdp.env.boatdock_unseen.environment import UnseenBoatsEnv
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
# Settings of the problem that may differ from its own; those with None tell rows apart.
OF_PROBLEM = dict.fromkeys(
    f"boatdock_unseen.{setting}"
    for setting in ("trips", "boats", "family", "frame", "fleet_size", "fleet_seed", "scored_boats")
)
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
RUN = (*SETTINGS, "fleet_seed", "frames", "seed")  # the columns that name a run
FIRST_LATER, NUM_TRIPS = 3, 8
PEOPLE_EPISODES = 60
FLEETS = (1, 2, 4, 16, 64, 256)
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
        fleet_size, fleet_seed = env["fleet_size"], env["fleet_seed"]
        rows.append(
            settings
            | {"fleet_seed": fleet_seed if fleet_size else ""}
            | {"key_orders": key_orders(fleet_size, fleet_seed) if fleet_size else "both"}
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
    lines = []
    for settings, rows in groups(results, *SETTINGS).items():
        family, boats, frame, _, _, ends, high, high_memory, low, memory, sharing = settings
        first, second = ([row[f"score_{trip}"] for row in rows] for trip in (1, 2))
        rest = [later(row) for row in rows]
        columns = [
            family,
            boats,
            frame.replace("_", " "),
            ends,
            f"{high} {high_memory}".strip(),
            f"{low}, {memory}" + (f", {sharing.replace('_', ' ')}" if boats > 1 else ""),
            len(rows),
            spread(first),
            spread(second),
            spread(rest),
            interval_text(rest),
            spread([later(row, first=4) for row in rows]),
            f"{mean_of(rows, 'ceiling'):.3f}",
            f"{mean_of(rows, 'presses_1'):.1f}",
            f"{sum(mean_of(rows, f'presses_{trip}') for trip in range(3, 9)) / 6:.1f}",
            f"{mean_of(rows, 'cpu_s'):.0f} s",
        ]
        lines.append(columns)
    head = (
        "family | boats | frame | values end | selector | learner, memory, sharing | n "
        "| first trip | second trip | trips 3 to 8 | 95 % | trips 4 to 8 | ceiling | presses, first trip | later | CPU"
    )
    return markdown_table(head, lines)


def key_orders(fleet_size: int, fleet_seed: int) -> str:
    """Return `both` if the keys of some training boats push one after another to the left and of some to the right.

    Turned boats differ in nothing else, once they are seen in the frame of the first press. Else return `one`.
    """
    env = UnseenBoatsEnv(32 * fleet_size, fleet_size=fleet_size, fleet_seed=fleet_seed)
    env.reset()
    first, second = env.known_boats(env.state)[0].directions[:, :2].unbind(1)
    is_left = first[:, 0] * second[:, 1] > first[:, 1] * second[:, 0]
    return "both" if is_left.any() and not is_left.all() else "one"


def of_new_boats(results: Rows) -> Rows:
    """Return the rows of agents that never sailed a boat twice in training."""
    return [row for row in results if row["fleet_size"] == "new"]


def by_fleet(results: Rows) -> dict[tuple[int, str], list[dict[str, dict]]]:
    """Return the rows of each agent with few training boats, by the boats that it is scored on: `training` and `new`.

    Agents are grouped by the number of training boats and by the orders of their keys.
    """
    found: dict[tuple[int, str], dict[tuple[int, int], dict[str, dict]]] = {}
    for row in sorted((row for row in results if row["fleet_size"] != "new"), key=lambda row: int(row["fleet_size"])):
        agents = found.setdefault((int(row["fleet_size"]), row["key_orders"]), {})
        agents.setdefault((row["fleet_seed"], row["seed"]), {})[row["scored_boats"]] = row
    return {fleet: [rows for rows in agents.values() if len(rows) == 2] for fleet, agents in found.items()}


def fleet_table(results: Rows) -> str:
    """Return a line for each number of training boats: the scores on these boats and on new ones."""
    lines = []
    for (size, orders), agents in by_fleet(results).items():
        scores = [[rows[boats]["score_1"] for rows in agents] for boats in ("training", "new")]
        scores += [[later(rows[boats]) for rows in agents] for boats in ("training", "new")]
        lost = [own - new for own, new in zip(*scores[2:], strict=True)]
        lines.append([size, orders, len(agents), *map(spread, scores), spread(lost), interval_text(lost)])
    head = (
        "training boats | orders of their keys | n | first trip, these boats | new boats | trips 3 to 8, these boats "
        "| new boats | difference | 95 %"
    )
    return markdown_table(head, lines)


def players_table(players: Rows) -> str:
    """Return a line for each family, number of boats and player: the scores of the first and of the later trips."""
    lines = []
    for (family, boats, player), rows in groups(players, "family", "boats", "player").items():
        scores = [row["score"] for row in rows]
        rest = scores[FIRST_LATER - 1 :]
        shown = [f"{score:.2f}" for score in scores[:FIRST_LATER]]
        lines.append([family, boats, PLAYERS[player], *shown, f"{sum(rest) / len(rest):.3f}"])
    return markdown_table("family | boats | player | trip 1 | trip 2 | trip 3 | trips 3 to 8", lines)


def transfer_table(rows: Rows) -> str:
    """Return a line for each learner and controller of the training: the scores with both controllers."""
    lines = []
    for (learner, trained_on), of_both in groups(rows, "learner", "trained_on").items():
        same = [row["score"] for row in of_both if row["controller"] == trained_on]
        other = [row["score"] for row in of_both if row["controller"] != trained_on]
        lines.append([learner, trained_on, len(same), spread(same), spread(other)])
    return markdown_table("learner | trained with | n | same controller | other controller", lines)


def draw(results: Rows, players: Rows, people: Rows, path: Path) -> None:
    """Draw scores with one boat by number of the trip and by number of training boats, and people's by episode."""
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
    markers = {"one": "x", "both": "o"}
    for (size, orders), agents in by_fleet(results).items():
        for boats, colour in (("training", "#8c8c8c"), ("new", COLOURS["turned"])):
            scores = [later(rows[boats]) for rows in agents]
            fleets.plot([size] * len(agents), scores, markers[orders], color=colour, mfc="none")
    for orders, marker in markers.items():
        label = f"new boats ({orders} order{'s' if orders == 'both' else ''} in training)"
        fleets.plot([], [], marker, color=COLOURS["turned"], mfc="none", label=label)
    fleets.plot([], [], "o", color="#8c8c8c", mfc="none", label="the training boats")
    fleets.set(xscale="log", xlabel="boats in training", xticks=FLEETS, xticklabels=FLEETS)
    fleets.minorticks_off()
    fleets.legend(loc="lower right", fontsize=7, frameon=False, title="scored on", title_fontsize=7)
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
        new = gathered(folders, gather, settings=OF_PROBLEM, modes=("train", "eval"), env=("boatdock_unseen",))
        add_to_tables(HERE, {"results": new}, RUN)
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
