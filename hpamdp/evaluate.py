"""The only evaluation rollout: every episode of a fixed set once, greedily, to its end."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.env.episode import MAX_PRESSES
from hpamdp.env.harbour import CONTROLLERS
from hpamdp.env.physics import OUTCOMES, SAILING, SUCCESS


class Evaluation:
    """A fixed set of episodes with what is known of them, on which agents are scored.

    Args:
        env: an environment with one boat for each episode, used for nothing else.
        seed: of the set; training never meets its layouts.
    """

    def __init__(self, env: TransformedEnv, seed: int) -> None:
        self.env, self.seed = env, seed
        self.episodes = env.fixed_episodes(seed)
        self._reset()
        self.layouts = env.describe()

    def _reset(self) -> TensorDict:
        self.env.set_seed(self.seed)  # the noise, too, is the same at every evaluation
        return self.env.reset(self.episodes.clone())

    def run(self, policy: TensorDictModuleBase) -> dict[str, np.ndarray]:
        """Play every episode greedily; return one array an attribute, first dimension the episode.

        `outcome` int, `fuel` (fraction), `score`, `return`, `presses`, `controller` (0 incongruent, 1 congruent),
        `path` `[N, P + 1, 2]` (px from the harbour's centre, NaN past the end), and the layouts' `start`, `goal`,
        `bearing_offset`, `optimum`.
        """
        device = self.env.device
        td = self._reset()
        path, total = [self.env.position], torch.zeros(td.batch_size, device=device)
        presses = torch.zeros(td.batch_size, dtype=torch.long, device=device)
        over = td.get(keys.DONE).squeeze(-1)
        # A policy that draws even when greedy (random presses) must not move the run's generators.
        with (
            torch.random.fork_rng(devices=[device] if device.type == "cuda" else []),
            set_exploration_type(ExplorationType.DETERMINISTIC),
            torch.no_grad(),
        ):
            torch.manual_seed(self.seed)
            for _ in range(MAX_PRESSES):
                td = self.env.step(policy(td))
                total += td.get(("next", keys.REWARD)).squeeze(-1)
                presses += ~over
                path.append(torch.where(over.unsqueeze(-1), torch.nan, self.env.position))
                td = self.env.step_mdp(td)
                over = td.get(keys.DONE).squeeze(-1)
                if over.all():
                    break
        played: dict[str, Tensor] = {
            **self.layouts,
            "outcome": td.get(keys.OUTCOME),
            "fuel": td.get(keys.FUEL).squeeze(-1),
            "score": self.env.score(td),
            "return": total,
            "presses": presses,
            "controller": self.env.state.controller,
            "path": torch.stack(path, 1),
        }
        return {name: value.cpu().numpy() for name, value in played.items()}


def measure(played: dict[str, np.ndarray], has_choice: bool) -> dict[str, float]:
    """Return the means of an evaluation: score, success, shares of outcomes and controllers, gap to the ceiling.

    `ceiling` is the best possible mean score on the same layouts: with the better controller of each where the agent
    chooses, else with the controller given. `oracle_agreement` is the share of episodes in which the agent chose the
    better controller, `oracle_agreement_weighted` the same weighted by what the choice is worth.
    """
    outcome, optimum, controller = played["outcome"], played["optimum"], played["controller"]
    given = np.take_along_axis(optimum, controller[:, None].astype(int), 1)[:, 0]
    ceiling = float(np.mean(optimum.max(1) if has_choice else given))
    scores = {
        "score": float(played["score"].mean()),
        "success": float((outcome == SUCCESS).mean()),
        "return": float(played["return"].mean()),
        "presses": float(played["presses"].mean()),
        "ceiling": ceiling,
        "optimality_gap": ceiling - float(played["score"].mean()),
    }
    for code, name in enumerate(OUTCOMES):
        if code != SAILING:
            scores[name] = float((outcome == code).mean())
    for option, name in enumerate(CONTROLLERS):
        scores[f"option_{name}"] = float((controller == option).mean())
    if has_choice:
        is_better = optimum.argmax(1) == controller
        worth = np.abs(optimum[:, 1] - optimum[:, 0])
        scores["oracle_agreement"] = float(is_better.mean())
        scores["oracle_agreement_weighted"] = float((is_better * worth).sum() / worth.sum())
    return scores
