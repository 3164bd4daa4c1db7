"""The hand-written player finds out what the keys do while it docks, and then sails as the planner does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from scripts import load_script
from torch import Tensor

from hpamdp import keys
from hpamdp.env.boatdock.task import TANK
from hpamdp.env.boatdock_unseen.environment import UnseenBoatsEnv
from hpamdp.env.boatdock_unseen.planner import best_plan

EXPLORER = Path(__file__).parents[1] / "experiments/generalisation/explorer.py"


def explorer_for(env: UnseenBoatsEnv) -> Any:
    options = env.options
    return load_script(EXPLORER).Explorer(
        env.num_envs, options.fleet, num_boats=options.boats, trips=options.trips, shortest_press=options.shortest_press
    )


def press(env: UnseenBoatsEnv, explorer: Any) -> Tensor | None:
    """Let the player press once and return the boats that it chose."""
    td = env.read()
    boat, key, duration = explorer.act(td[keys.OBSERVATION])
    td[keys.ACTION] = {"discrete": key, "parameters": duration[:, None].expand(-1, 3)}
    if boat is not None:
        td[keys.OPTION] = boat
    env.step(td)
    return boat


def ceiling(env: UnseenBoatsEnv, rows: Tensor) -> Tensor:
    """Return the best scores of the trips that begin now in these rows, with each session's best boat."""
    state = type(env.state)(*(column[rows] for column in env.state))
    place = state.start_x, state.start_y, state.goal_x, state.goal_y, torch.full_like(state.start_x, TANK)
    shortest = env.options.shortest_press
    plans = [best_plan(*place, *boats, shortest_press=shortest) for boats in env.known_boats(state)]
    return torch.stack([plan.score for plan in plans]).amax(0)


def sail(env: UnseenBoatsEnv) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Sail one session in every row; return scores and ceilings `[N, trips]`, and the boats chosen at each press."""
    env.reset()
    explorer = explorer_for(env)
    ceilings = torch.full((env.num_envs, env.options.trips), torch.nan)
    chosen = []
    for _ in range(env.max_steps):
        begins = (env.state.presses == 0).nonzero().squeeze(-1)
        if len(begins):
            ceilings[begins, env.state.trip[begins].long()] = ceiling(env, begins)
        boat = press(env, explorer)
        if boat is not None:
            chosen.append(boat)
        if (env.state.outcome != 0).all():
            break
    return env.played()["trip_score"], ceilings, chosen


@pytest.mark.parametrize("frame", ["screen", "first_press"])
def test_the_player_pays_for_finding_out_in_the_first_trip_and_then_reaches_the_ceiling(frame):
    scores, ceilings, _ = sail(UnseenBoatsEnv(12, trips=2, frame=frame, seed=1))
    loss = (ceilings - scores).mean(0)
    assert 0.1 < loss[0] < 0.5
    assert loss[1].abs() < 0.02


@pytest.mark.parametrize("family", ["strength", "any"])
def test_after_two_trips_the_player_knows_the_boats_that_it_could_dock(family):
    scores, ceilings, _ = sail(UnseenBoatsEnv(8, trips=3, family=family, seed=2))
    can_dock = ceilings > 0.0
    loss = (ceilings - scores)[:, 2][can_dock[:, 2]]
    assert loss.median() < 0.02 and loss.mean() < 0.3


def test_with_two_boats_both_are_tried_and_then_the_better_one_is_taken():
    env = UnseenBoatsEnv(6, boats=2, trips=4, seed=3)
    scores, ceilings, chosen = sail(env)
    assert not chosen[0].any()
    assert torch.stack(chosen).amax(0).all()  # every session has tried the second boat
    assert (ceilings - scores)[:, 2:].mean().abs() < 0.05


def test_a_new_session_forgets_the_boat():
    env = UnseenBoatsEnv(4, seed=6)
    env.reset()
    explorer = explorer_for(env)
    press(env, explorer)
    explorer.act(env.read()[keys.OBSERVATION])
    assert explorer._known.seen[:, 0].any(-1).all()
    explorer.reset(torch.tensor([True, False, False, True]))
    assert explorer._known.seen[:, 0].any(-1).tolist() == [False, True, True, False]
