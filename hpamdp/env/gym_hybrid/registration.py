"""The Gymnasium ids of Moving and Sliding."""

from hpamdp.env.registration import batched

IDS = {
    "hpamdp/Moving-v0": batched("hpamdp.env.gym_hybrid.environment:MovingEnv"),
    "hpamdp/Sliding-v0": batched("hpamdp.env.gym_hybrid.environment:SlidingEnv"),
}
