"""The Gymnasium ids of Goal and Hard Goal."""

from hpamdp.env.registration import batched

IDS = {
    "hpamdp/Goal-v0": batched("hpamdp.env.goal.environment:GoalEnv"),
    "hpamdp/HardGoal-v0": batched("hpamdp.env.goal.environment:HardGoalEnv"),
}
