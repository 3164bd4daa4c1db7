"""The Gymnasium ids of traffic lights, one for each network."""

# No max_episode_steps: the environment itself truncates after its `minutes`.
IDS = {
    f"hpamdp/Traffic{network.capitalize()}-v0": {
        "entry_point": "hpamdp.env.traffic.lights:TrafficLights",
        "kwargs": {"network": network},
    }
    for network in ("crossing", "corridor")
}
