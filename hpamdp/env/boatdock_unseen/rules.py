"""The numbers of a session of trips, the columns of its state, and what is observed. `kernel` has the rules.

A press is that of the boats' task, see `hpamdp.env.boatdock.physics`. A trip is one episode of that task. The press
that ends it is followed by the next trip's layout. Positions are px from the harbour's centre.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

OUTCOMES = ("sailing", "finished", "time_limit")  # of sessions; no session reaches the limit of its presses
GOING_ON, FINISHED, _ = range(len(OUTCOMES))

# A session's random-number keys count from `NUMBERS_PER_SESSION` times its number: the layouts of its trips, then the
# boats.
NUMBERS_PER_SESSION = 32
FIRST_BOAT = 30
# The number in place of a session's for the keys of a fleet's boats.
FLEET = -(2**30)

# Each press has this many random numbers for noise. MOTOR and SENSOR count Gaussian ones, SENSOR is the first of eight.
NUMBERS_PER_PRESS = 24
MOTOR, SENSOR = 0, 1

_SHORTEST_AXIS = 1e-6  # keeps the division finite

OBSERVATION_NAMES = (
    "start_x",
    "start_y",
    "goal_x",
    "goal_y",
    "boat_x",
    "boat_y",
    "to_goal_x",
    "to_goal_y",
    "fuel",
    "distance",
    "velocity_x",
    "velocity_y",
    "trip",
    "boat",
    "last_boat",
    "last_key_1",
    "last_key_2",
    "last_key_3",
    "last_duration",
    "moved_x",
    "moved_y",
    "last_score",
)


class SessionState(NamedTuple):
    """The state of N sessions, columns `[N]`: positions in px, fuel in seconds, int32 integers.

    The velocity is the one at the end of the last press, before the glide. `moved` is the displacement by the last
    press. `last_score` is the score of the trip before this one, and `total_score` the sum over all trips that have
    ended. `boat` and `last_boat` are the numbers of this trip's boat and of the boat of the last press, or
    NOT_CHOSEN. `last_key` is -1 before the first press. `trip_ended` is 1 if a trip ended with the last press.
    `frame` is the displacement by the session's first press as it was seen, (0, 0) before. `episode` is the number of
    the session, -1 before the first reset.
    """

    start_x: Tensor
    start_y: Tensor
    goal_x: Tensor
    goal_y: Tensor
    x: Tensor
    y: Tensor
    velocity_x: Tensor
    velocity_y: Tensor
    fuel: Tensor
    moved_x: Tensor
    moved_y: Tensor
    last_duration: Tensor
    last_score: Tensor
    total_score: Tensor
    frame_x: Tensor
    frame_y: Tensor
    first_boat: Tensor  # bits, see `fleet`
    second_boat: Tensor
    boat: Tensor
    last_boat: Tensor
    last_key: Tensor
    trip: Tensor
    presses: Tensor  # of this trip
    docked: Tensor  # number of trips that have ended at the dock
    trip_ended: Tensor
    steps: Tensor
    outcome: Tensor
    episode: Tensor
