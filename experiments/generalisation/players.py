"""Score the player that finds out what the keys do, and the best plans with known keys, by number of the trip.

python experiments/generalisation/players.py    writes players.csv: a row for each family, number of boats, player and
                                                trip. It takes ten minutes.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from explorer import Explorer
from torch import Tensor

from experiments.study_tables import Rows, write_tables
from hpamdp import keys
from hpamdp.env.boatdock_unseen.environment import UnseenBoatsEnv
from hpamdp.env.boatdock_unseen.options import FAMILIES
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
SESSIONS = 200
EVALUATION_SEED = 99


def trip_scores(env: UnseenBoatsEnv) -> Tensor:
    """Return the scores `[N, trips]` of the player that finds out what the keys do, one session in every row."""
    options = env.options
    player = Explorer(
        env.num_envs,
        env.options.fleet,
        num_boats=options.boats,
        trips=options.trips,
        shortest_press=options.shortest_press,
    )
    td = env.reset()
    while not td[keys.DONE].all():
        boat, key, seconds = player.act(td[keys.OBSERVATION])
        td[keys.ACTION] = {"discrete": key, "parameters": seconds.unsqueeze(-1).expand(-1, 3)}
        if boat is not None:
            td[keys.OPTION] = boat
        td = env.step(td)["next"]
    return env.played()["trip_score"]


def rows_of(family: str, num_boats: int) -> Iterator[dict[str, Any]]:
    """Yield the mean scores of both players by trip, with standard errors over sessions."""
    env = UnseenBoatsEnv(SESSIONS, family=family, boats=num_boats)
    env.seed_evaluation(EVALUATION_SEED)
    env.reset()
    known = env.describe()["optimum"]
    env.seed_evaluation(EVALUATION_SEED)
    for player, scores in (("knows", known), ("finds_out", trip_scores(env))):
        for trip, of_trip in enumerate(scores.unbind(1), start=1):
            yield {
                "family": family,
                "boats": num_boats,
                "player": player,
                "trip": trip,
                "score": round(of_trip.mean().item(), 3),
                "standard_error": round(of_trip.std().item() / SESSIONS**0.5, 3),
            }


def main() -> int:
    """Score both players on every family."""
    torch.set_num_threads(1)
    rows: Rows = []
    for family in FAMILIES:
        for num_boats in (1, 2):
            rows += rows_of(family, num_boats)
            print(rows[-1], flush=True)
            write_tables(HERE, {"players": rows})
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
