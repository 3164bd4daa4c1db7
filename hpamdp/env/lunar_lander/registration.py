"""The Gymnasium id of Hybrid LunarLander."""

MAX_STEPS = 1000
IDS = {
    "hpamdp/LunarLander-v0": {
        "entry_point": "hpamdp.env.lunar_lander.lander:HybridLunarLander",
        "max_episode_steps": MAX_STEPS,
    }
}
