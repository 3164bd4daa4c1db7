"""Evaluate agents: play every episode of a fixed set once, greedily and to its end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType

from hpamdp import keys
from hpamdp.acting import acting
from hpamdp.env.base import PAMDPEnv, ProblemError
from hpamdp.policies.agent import HierarchicalAgent


class Evaluation:
    """A fixed set of episodes on which agents are scored.

    Args:
        env: a `PAMDPEnv` with tracked decisions, one environment for each episode, used for nothing else.
        seed: seed of the episodes.
        num_filmed: number of episodes, the first ones, whose states `run_agent` keeps.
        filmed_steps: largest number of their steps that is kept. If None, all of them.

    Attributes:
        steps: environment steps of all episodes so far.
        one_action: a line if the agent took one discrete action at every step of the last `run_agent`, else empty.
        states: the `film_state` of these episodes at the start and after every step, columns `[num_filmed, ...]`;
            empty before the first `run_agent`, or if the problem has none.
    """

    def __init__(self, env: TransformedEnv, seed: int, num_filmed: int = 0, filmed_steps: int | None = None) -> None:
        self.env = env
        self.seed = seed
        self.num_filmed = num_filmed
        self.filmed_steps = filmed_steps
        self.states: list[dict[str, Tensor]] = []
        self.one_action: list[str] = []
        self.steps = 0
        self._only_action: Tensor | None = None  # of all steps of the last `run`; None if actions differ
        self.problem.warn_if_seed_is_ignored(seed)
        self.episodes = env.fixed_episodes(seed)
        self._reset()
        self.known = env.describe()

    @property
    def problem(self) -> PAMDPEnv:
        """The environment without the tracker of its decisions."""
        return self.env.base_env

    def _reset(self) -> TensorDictBase:
        self.problem.seed_evaluation(self.seed)  # the noise, too, is the same at every evaluation
        return self.env.reset(None if self.episodes is None else self.episodes.copy())

    def run(self, policy: TensorDictModuleBase, states: list[dict[str, Tensor]] | None = None) -> dict[str, np.ndarray]:
        """Play every episode greedily and return arrays whose first dimension is the episode.

        Args:
            policy: policy that acts.
            states: list to which the states of the first `num_filmed` episodes are appended.

        Returns:
            Arrays by their names:

            - `return`, `steps`, and `score`, which is the return if the environment has no score of its own;
            - `option`: the first option of each episode, if the agent chooses options;
            - `option_changes`: number of option changes in each episode, if options may end inside episodes;
            - `option_length`: mean length of the options that were chosen in each episode, if the agent chooses them;
            - `path` `[N, T + 1, 2]`, NaN past an episode's end, if the environment has positions;
            - the entries of the environment's `describe` and `results`.

        Raises:
            ProblemError: the return of an episode is not finite, or an episode exceeds `max_steps`.
        """
        device = self.env.device
        td = self._reset()
        total = torch.zeros(td.batch_size, device=device, dtype=torch.float32)
        steps = torch.zeros(td.batch_size, dtype=torch.long, device=device)
        changes = torch.zeros_like(steps)
        over, options, path = td.get(keys.DONE).squeeze(-1), [], [self.env.position]
        lengths: list[Any] = []
        first_action, differ = None, torch.zeros((), dtype=torch.bool, device=device)
        self._film(states)
        # A policy that samples even when greedy (a random one) must not move the run's generators.
        with (
            torch.random.fork_rng(devices=[device] if device.type == "cuda" else []),
            acting(ExplorationType.DETERMINISTIC),
            torch.no_grad(),
        ):
            torch.manual_seed(self.seed)
            for _ in range(self.env.max_steps):
                td = self.env.step(policy(td))
                lengths.append(_chosen_length(td, over))
                discrete = td.get(keys.DISCRETE).reshape(len(over), -1)
                first_action = discrete[0] if first_action is None else first_action
                differ |= ((discrete != first_action).any(-1) & ~over).any()
                total += td.get(("next", keys.REWARD)).squeeze(-1)
                steps += ~over
                options.append(td.get(keys.OPTION, None))
                if len(options) > 1 and options[0] is not None:
                    changes += (options[-1] != options[-2]) & ~over
                path.append(_unless(over, self.env.position))
                self._film(states)
                td = self.env.step_mdp(td)
                over = td.get(keys.DONE).squeeze(-1)
                if over.all():
                    break
        if not total.isfinite().all():
            row = int((~total.isfinite()).nonzero()[0])
            raise ProblemError(f"{self.problem.title}: the return of evaluation episode {row} is {total[row].item()}")
        if not over.all():
            row, limit = int((~over).nonzero()[0]), self.env.max_steps
            raise ProblemError(f"{self.problem.title}: evaluation episode {row} has not ended after max_steps={limit}")
        self._only_action = None if differ else first_action
        self.steps += int(steps.sum())
        played: dict[str, Tensor] = {"return": total, "steps": steps, "score": total, **self.known}
        if options[0] is not None:
            played["option"] = options[0]
            if keys.OPTION_ENDED in td.keys():
                played["option_changes"] = changes
        if lengths[0] is not None:
            played["option_length"] = torch.stack(lengths).nanmean(0)
        if path[0] is not None:
            played["path"] = torch.stack(path, 1)
        played |= self.env.results(td) | self.problem.played()
        return {name: value.cpu().numpy() for name, value in played.items()}

    def run_agent(self, agent: HierarchicalAgent) -> dict[str, np.ndarray]:
        """Play every episode as `run` does, and again with each option held if the agent chooses options.

        The further episodes give `option_scores` `[N, num_options]`, the scores of the agent's learners with each
        option.
        """
        states: list[dict[str, Tensor]] = []
        played = self.run(agent.policy, states)
        only = None if self._only_action is None or agent.specs.num_discrete < 2 else self._only_action.tolist()
        if agent.selector is not None:
            each = [self.run(agent.policy_of(i))["score"] for i in range(agent.specs.num_options)]
            played["option_scores"] = np.stack(each, -1)
        # Only now, because a signal may have ended the evaluation: the film and the line belong to a whole one.
        self.states, self.one_action = states, []
        if only is not None:
            shown = only[0] if len(only) == 1 else only
            self.one_action = [f"the agent took discrete action {shown} at every step of the evaluation"]
        return played

    def _film(self, states: list[dict[str, Tensor]] | None) -> None:
        """Append the current state of the filmed episodes to `states`."""
        if states is None or self.num_filmed == 0:
            return
        if self.filmed_steps is None or len(states) <= self.filmed_steps:
            states.append(self.problem.film_state(self.num_filmed))

    def measure(self, played: Mapping[str, np.ndarray]) -> dict[str, float]:
        """Return the means of an evaluation: score, return, steps, success and the environment's own metrics.

        The further entries are:

        - `optimality_gap`: the environment's `ceiling` less the score;
        - `option_changes`: number of option changes in an episode, if options may end inside episodes;
        - `option_length`: mean length of the options that were chosen in an episode, if the agent chooses lengths.

        If the agent chooses options:

        - `score_NAME`: the score with the option NAME held;
        - `regret`: the score of each episode's best option, with the agent's own learners, less the score;
        - `choice_gain`: the score less the score of the best single option;
        - `choice_entropy`: entropy of the options' frequencies (nats).
        """
        names = ("score", "success", "return", "steps", "option_changes", "option_length")
        means = {name: float(played[name].mean()) for name in names if name in played} | self.env.measure(played)
        if "ceiling" in means:
            means["optimality_gap"] = means["ceiling"] - means["score"]
        if "option_scores" not in played:
            return means
        held, score = played["option_scores"], played["score"]
        frequencies = np.bincount(played["option"], minlength=held.shape[1]) / len(score)
        means["regret"] = float((held.max(1) - score).mean())
        means["choice_gain"] = float(score.mean() - held.mean(0).max())
        means["choice_entropy"] = float(-(frequencies * np.log(np.maximum(frequencies, 1e-12))).sum())
        scores = zip(self.env.option_names, held.mean(0), strict=True)
        return means | {f"score_{name}": float(mean) for name, mean in scores}


def _chosen_length(td: TensorDictBase, over: Tensor) -> Tensor | None:
    """Return the lengths chosen at a step, `[N]`: NaN where none was, or the episode is over; None without lengths."""
    length = td.get(keys.OPTION_LENGTH, None)
    return None if length is None else _unless(over | ~td.get(keys.IS_DECISION).squeeze(-1), length)


def _unless(is_left_out: Tensor, values: Tensor | None) -> Tensor | None:
    """Return values `[N, ...]` with NaN in the rows that are left out, bool `[N]`; None without values."""
    if values is None:
        return None
    return torch.where(is_left_out.reshape(-1, *[1] * (values.ndim - 1)), torch.nan, values)
