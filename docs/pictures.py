"""Film the pictures of docs/domains again: the agents that come with the code and, where there is none, other players.

python docs/pictures.py            all of them
python docs/pictures.py NAME ...   only these
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from PIL import Image

from hpamdp.analysis import film
from hpamdp.commands import watch
from hpamdp.env.primitives import players
from hpamdp.env.primitives.manipulation import Manipulation

ROOT = Path(__file__).resolve().parent.parent
PLAYERS = {
    "boatdock": ["agents/linucb_hppo"],
    "boatdock_unseen": ["agents/hppo_boatdock_unseen", "env.trips=5"],
    "platform": ["agents/hppo_platform"],
    "goal": ["agents/pdqn_goal"],
    "hard_goal": ["agents/pdqn_hard_goal"],
    "catch_point": ["agents/hppo_catch_point"],
    "hard_move": ["agents/hppo_hard_move_4"],
    "moving": ["agents/hppo_moving"],
    "sliding": ["agents/hppo_sliding"],
    "pinball": ["env=pinball", "env.map=hard", "env.start=anywhere", "high=none", "low=planner"],
    "rooms": ["agents/meta_critic_hppo_rooms"],
    "office": ["env=office", "high=none", "low=planner"],
    "lunar_lander": ["agents/hppo_lunar_lander", "env.render=true"],
    "traffic": [
        *("env=traffic", "env.render=true", "env.minutes=15", "env.strategies=true"),
        *("env.grouping={max_pressure:[max_pressure]}", "high=uniform", "low=random"),
    ],
    "rddl": [
        *("env=rddl", "env.domain=Intruders_Continuous", "env.max_steps=60", "env.render=true"),
        *("high=none", "low=random"),
    ],
    "circuit": ["env=circuit", "env.task=toffoli", "high=none", "low=planner"],
}


# A session has several trips, traffic's episodes are long, and the planner's circuits are all the same; three episodes
# elsewhere. Of RDDL one domain stands for all.
EPISODES = {"boatdock_unseen": "1", "traffic": "1", "circuit": "1", "rddl": "1"}


def film_primitives(to: Path) -> None:
    """Film the hand-written player of one task; MuJoCo needs a display, or MUJOCO_GL=egl."""
    env = Manipulation("assembly", render_mode="rgb_array")
    observation, _ = env.reset(seed=900)
    pictures = [env.render()]
    env.on_low_level_step = lambda: pictures.append(env.render())
    is_over = False
    while not is_over:
        choice = players.choose("assembly", observation)
        observation, _, is_over, _, _ = env.step(players.as_action(env, choice))
    env.close()
    small = [np.array(Image.fromarray(picture).resize((200, 200))) for picture in pictures[::10]]
    film.write(to, small, fps=10.0)


def main(names: list[str]) -> int:
    """Write the GIFs beside the pages."""
    for name in names or [*PLAYERS, "primitives"]:
        to = ROOT / "docs" / "domains" / f"{name}.gif"
        if name == "primitives":
            film_primitives(to)
            continue
        who = [str(ROOT / word) if word.startswith("agents/") else word for word in PLAYERS[name]]
        watch.main(
            [*who, "--to", str(to), "--episodes", EPISODES.get(name, "3"), "--size", "240"], argparse.ArgumentParser()
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
