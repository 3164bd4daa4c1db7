"""The only evaluation rollout: every episode of a fixed set once, greedily, to its end."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv
from hpamdp.policies.agent import HierarchicalAgent

# Keeps the randomness of the evaluation apart from that of a training run with the same seed.
_APART = 0x5EED0000


class Evaluation:
    """A fixed set of episodes with what is known of them, on which agents are scored.

    Args:
        env: a `PAMDPEnv` with its decisions tracked, one environment for each episode, used for nothing else.
        seed: of the set; training never meets its episodes.
    """

    def __init__(self, env: TransformedEnv, seed: int) -> None:
        self.env = env
        self.seed = seed
        self.episodes = env.fixed_episodes(seed)
        self._reset()
        self.known = env.describe()

    @property
    def problem(self) -> PAMDPEnv:
        """The environment itself, without what tracks its decisions."""
        return self.env.base_env

    def _reset(self) -> TensorDictBase:
        self.env.set_seed(self.seed ^ _APART)  # the noise, too, is the same at every evaluation
        return self.env.reset(None if self.episodes is None else self.episodes.copy())

    def run(self, policy: TensorDictModuleBase) -> dict[str, np.ndarray]:
        """Play every episode greedily; return one array an attribute, first dimension the episode.

        `return`, `steps` and `score` (the return, where the environment has no score of its own); `option`, the first
        one, where the agent chooses; `path` `[N, T + 1, 2]` (NaN past the end), where there are positions; beside them
        what the environment `describe`s and gives as `results`.
        """
        device = self.env.device
        td = self._reset()
        total = torch.zeros(td.batch_size, device=device)
        steps = torch.zeros(td.batch_size, dtype=torch.long, device=device)
        over, options, path = td.get(keys.DONE).squeeze(-1), [], [self.env.position]
        # A policy that samples even when greedy (a random one) must not move the run's generators.
        with (
            torch.random.fork_rng(devices=[device] if device.type == "cuda" else []),
            set_exploration_type(ExplorationType.DETERMINISTIC),
            torch.no_grad(),
        ):
            torch.manual_seed(self.seed)
            for _ in range(self.env.max_steps):
                td = self.env.step(policy(td))
                total += td.get(("next", keys.REWARD)).squeeze(-1)
                steps += ~over
                options.append(td.get(keys.OPTION, None))
                path.append(_unless(over, self.env.position))
                td = self.env.step_mdp(td)
                over = td.get(keys.DONE).squeeze(-1)
                if over.all():
                    break
        played: dict[str, Tensor] = {"return": total, "steps": steps, "score": total, **self.known}
        if options[0] is not None:
            played["option"] = options[0]
        if path[0] is not None:
            played["path"] = torch.stack(path, 1)
        played |= self.env.results(td)
        return {name: value.cpu().numpy() for name, value in played.items()}

    def run_agent(self, agent: HierarchicalAgent) -> dict[str, np.ndarray]:
        """Play every episode as `run` does; where the agent chooses, also with each option held.

        `option_scores` `[N, num_options]`: the scores that this agent's own low level reaches with each option.
        """
        played = self.run(agent.policy)
        if agent.selector is not None:
            each = [self.run(agent.policy_of(i))["score"] for i in range(agent.specs.num_options)]
            played["option_scores"] = np.stack(each, -1)
        return played

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the means of an evaluation: score, return, steps, success, and what else the environment tells.

        `optimality_gap` is what is missing to the environment's `ceiling`. Of choices: `regret`, what the better option
        of each episode would have scored with the agent's own low level less what was scored; `score_NAME`, the score
        with the option NAME held; `choice_gain`, the score less that of the best option held; `choice_entropy` of the
        options' shares (nats).
        """
        names = [name for name in ("score", "success", "return", "steps") if name in played]
        means = {name: float(played[name].mean()) for name in names} | self.env.measure(played)
        if "ceiling" in means:
            means["optimality_gap"] = means["ceiling"] - means["score"]
        if "option_scores" not in played:
            return means
        held, score = played["option_scores"], played["score"]
        shares = np.bincount(played["option"], minlength=held.shape[1]) / len(score)
        means["regret"] = float((held.max(1) - score).mean())
        means["choice_gain"] = float(score.mean() - held.mean(0).max())
        means["choice_entropy"] = float(-(shares * np.log(np.maximum(shares, 1e-12))).sum())
        scores = zip(self.env.option_names, held.mean(0), strict=True)
        return means | {f"score_{name}": float(mean) for name, mean in scores}


def _unless(over: Tensor, position: Tensor | None) -> Tensor | None:
    return None if position is None else torch.where(over.unsqueeze(-1), torch.nan, position)
