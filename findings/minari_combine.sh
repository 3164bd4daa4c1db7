#!/usr/bin/env bash
# Minari 0.5.4: combining filtered data sets brings the filtered episodes back and drops all seeds.
#
# Guess: `combine_datasets([good, other], ...)` joins the episodes that iterating over its arguments gives.
# Behaviour: it copies the files behind them. So episodes that `filter_episodes` took away are there again. The numbers
# of episodes and steps in the metadata count them, too. Seeds of episodes are not copied.
# Seen: 2 of 4 episodes filtered, 2 others: 6 episodes with rewards 0 1 2 3 0 1, no seeds; by iteration 4. The script fails
# if this changes.
# Why it matters: filtering for good episodes and mixing sources is the usual way to an offline data set.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv --without-pip "$folder/venv"
python3 -m pip --python "$folder/venv/bin/python" install --quiet --disable-pip-version-check "minari[hdf5]==0.5.4" gymnasium==1.4.0 pillow==11.3.0
export MINARI_DATASETS_PATH="$folder/data"
"$folder/venv/bin/python" -W ignore - <<'PYTHON'
import sys

import minari
import numpy as np
from gymnasium.spaces import Box, Discrete
from minari.data_collector import EpisodeBuffer


def made(name, num_episodes):
    episodes = [
        EpisodeBuffer(
            id=number,
            seed=10 + number,
            observations=[np.zeros(2, np.float32)] * 3,
            actions=[0, 1],
            rewards=[float(number)] * 2,
            terminations=[False, True],
            truncations=[False, False],
        )
        for number in range(num_episodes)
    ]
    return minari.create_dataset_from_buffers(
        name, episodes, observation_space=Box(-1, 1, (2,)), action_space=Discrete(2)
    )


recorded = made("table/recorded-v0", 4)
good = recorded.filter_episodes(lambda episode: episode.rewards[0] >= 2)
other = made("table/other-v0", 2)
both = minari.combine_datasets([good, other], "table/both-v0")
iterated = [float(episode.rewards[0]) for source in (good, other) for episode in source]
combined = [float(episode.rewards[0]) for episode in both]
seeds = ["seed" in metadata for metadata in both.storage.get_episode_metadata(range(both.total_episodes))]
print("rewards by iteration:", iterated, "combined:", combined, "with seeds:", sum(seeds))
has_seeds = all("seed" in metadata for metadata in recorded.storage.get_episode_metadata(range(4)))
sys.exit(iterated != [2, 3, 0, 1] or combined != [0, 1, 2, 3, 0, 1] or any(seeds) or not has_seeds)
PYTHON
