"""The Gymnasium ids of Goal and Hard Goal."""

from __future__ import annotations

from hpamdp.env.registration import register_batched_env

GOAL_ID = "hpamdp/Goal-v0"
HARD_GOAL_ID = "hpamdp/HardGoal-v0"


def register() -> None:
    """Register the ids with Gymnasium; calling it again changes nothing."""
    register_batched_env(GOAL_ID, "hpamdp.env.goal.environment:GoalEnv")
    register_batched_env(HARD_GOAL_ID, "hpamdp.env.goal.environment:HardGoalEnv")
