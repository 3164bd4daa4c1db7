"""Play a domain of RDDL with the planner of pyRDDLGym-jax, which knows the problem's formulas.

python experiments/rddl/planner.py DOMAIN drp|slp|replan SECONDS
    prints the mean return of the study's episodes.

`drp` trains a policy and `slp` a plan for SECONDS before it acts; `replan` plans at each step for the seconds of its
settings. Settings are those that the planner has for the domain, or else its default ones.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pyRDDLGym
import pyRDDLGym_jax
from pyRDDLGym_jax.core.planner import (
    JaxBackpropPlanner,
    JaxOfflineController,
    JaxOnlineController,
    load_config,
)
from rddlrepository.core.manager import RDDLRepoManager

EPISODE_SEEDS = range(7_000_000, 7_000_020)  # those of players.py, which needs hpamdp
CONFIGS = Path(pyRDDLGym_jax.__file__).parent / "examples" / "configs"


def main(domain: str, method: str, seconds: float) -> None:
    """Plan, play, print."""
    first = RDDLRepoManager().get_problem(domain).list_instances()[0]
    env = pyRDDLGym.make(domain, first, vectorized=True)
    own = CONFIGS / f"{domain}_{method}.cfg"
    planner_args, _, train_args = load_config(str(own if own.exists() else CONFIGS / f"default_{method}.cfg"))
    planner = JaxBackpropPlanner(rddl=env.model, **planner_args)
    if method == "replan":
        controller = JaxOnlineController(planner, **train_args)
    else:
        controller = JaxOfflineController(planner, **{**train_args, "train_seconds": seconds, "epochs": 10**9})
    returns = []
    for seed in EPISODE_SEEDS:
        state, _ = env.reset(seed=seed)
        controller.reset()
        total, is_over = 0.0, False
        while not is_over:
            state, reward, terminated, truncated, _ = env.step(controller.sample_action(state))
            total, is_over = total + reward, terminated or truncated
        returns.append(total)
    print(f"{domain} {method} {seconds:.0f} s: {np.mean(returns):.1f} ± {np.std(returns):.1f}")


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
