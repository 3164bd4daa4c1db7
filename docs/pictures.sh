#!/bin/sh
# Film the pictures of docs/domains again, from the root of the repository: sh docs/pictures.sh
set -e
film() {
    name=$1
    shift
    hpamdp watch "$@" --to "docs/domains/$name.gif" --episodes 3 --size 240
}
film boatdock low=planner high=oracle
film catch_point low=planner high=none env=catch_point
film hard_move low=planner high=none env=hard_move env.n=4
film moving low=planner high=none env=moving
# These have no player that knows them: H-PPO after 300,000 steps, and random actions.
hpamdp high=none low=hppo env=platform total_frames=300000 eval.every=0 hydra.run.dir=outputs/platform_picture
film platform outputs/platform_picture
film goal low=random high=none env=goal
film hard_goal low=random high=none env=hard_goal
