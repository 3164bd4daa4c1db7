"""Play the bandits and the selectors in the cases: whose greedy choice among the options is best at the end?"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from bandits import POLICIES, Policy, features
from cases import BEARINGS, Case, all_cases, best_split, final_values, row
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs.utils import ExplorationType

from experiments.study_tables import Rows
from hpamdp import keys
from hpamdp.acting import acting
from hpamdp.policies.base import Selector
from hpamdp.policies.high_level.epsilon_greedy import EpsilonGreedy
from hpamdp.policies.high_level.lin_thompson import LinThompson
from hpamdp.policies.high_level.linucb import LinUCB
from hpamdp.policies.high_level.meta_critic import MetaCritic
from hpamdp.policies.high_level.ucb import UCB
from hpamdp.policies.practice import CurvePractice, Practice
from hpamdp.specs import PAMDPSpecs

NUM_SEEDS = 50
NUM_SELECTOR_SEEDS = 10
NUM_ENVS = 16
NUM_BATCHES = 200  # of long runs, which have more environments
# A minute each; the other selectors take seconds.
CASES_OF_META_CRITIC = ("50 and 150", "200 and 800", "equal", "frozen", "hyar", "hsac")
LINEAR = {"inputs": [0, 1], "degree": 5}


# Builds a selector for the specs, and what practises beside it.
Build = Callable[[PAMDPSpecs, Case], tuple[Selector, Practice]]


def alone(selector: type[Selector], **settings: Any) -> Build:
    """Return what builds a selector that decides itself which option practises."""
    return lambda specs, case: (selector(specs, **settings), Practice(case.num_options))


def uniform(part: float, selector: type[Selector], **settings: Any) -> Build:
    """Return what builds a selector beside options that practise equally in the first part of the run."""
    return lambda specs, case: (selector(specs, **settings), Practice(case.num_options, int(part * case.horizon)))


def curves(selector: type[Selector], **settings: Any) -> Build:
    """Return what builds a selector beside options that practise by fitted curves, the default of runs."""
    return lambda specs, case: (selector(specs, **settings), CurvePractice(case.num_options, case.horizon))


SELECTORS: dict[str, Build] = {
    "ucb": alone(UCB),
    "epsilon_greedy": alone(EpsilonGreedy),
    "linucb": alone(LinUCB, **LINEAR),
    "lin_thompson": alone(LinThompson, **LINEAR),
    "meta_critic": alone(MetaCritic, gamma=1.0),
    "linucb, uniform third": uniform(1 / 3, LinUCB, **LINEAR),
    "linucb, uniform half": uniform(1 / 2, LinUCB, **LINEAR),
    "linucb, curves": curves(LinUCB, **LINEAR),
    "lin_thompson, curves": curves(LinThompson, **LINEAR),
    "meta_critic, curves": curves(MetaCritic, gamma=1.0),
}


def play(
    case: Case, build: type[Policy], num_seeds: int = NUM_SEEDS, seed: int = 0
) -> tuple[dict, np.ndarray, np.ndarray]:
    """Play a policy with all seeds at once; return its final values, practice and regret, see `row`.

    `value` is that of the option that the policy recommends for all contexts, or of the regression if it recommends
    none; `by_context` is that of the regression.
    """
    rng = np.random.default_rng(seed)
    policy, practice = build(num_seeds, case, rng), np.zeros((num_seeds, case.num_options))
    rows, earned = np.arange(num_seeds), np.zeros(num_seeds)
    for t in range(case.horizon):
        bearing = rng.uniform(0.0, 360.0, num_seeds)
        x = features(bearing)
        option = policy.choose(t, x)
        returns, mean = case.sample(rng, bearing, practice, option)
        practice[rows, option] += 1
        earned += mean
        policy.learn(t, option, x, returns)
    by_context = final_values(case, practice, policy.ridge.choices())
    own = policy.recommended
    value = by_context if own is None else final_values(case, practice, np.repeat(own[:, None], 360, 1))
    regret = best_split(case)[1] - earned / case.horizon
    return {"value": value, "by_context": by_context}, practice / case.horizon, regret


def play_selector(case: Case, build: Build, seed: int) -> tuple[float, np.ndarray, float]:
    """Play a selector through its own interface; return its final value, practice `[K]` and regret.

    Args:
        case: the case.
        build: makes the selector, and what practises beside it.
        seed: of contexts, returns and choices.
    """
    torch.manual_seed(seed)
    rng, names = np.random.default_rng(seed), tuple(f"option{i}" for i in range(case.num_options))
    specs = PAMDPSpecs(2, names, parameter_dims=(1,), parameter_low=(-1.0,), parameter_high=(1.0,))
    selector, practice = build(specs, case)
    counts, earned = np.zeros(case.num_options), 0.0
    num_envs = max(NUM_ENVS, case.horizon // NUM_BATCHES)
    for done in range(0, case.horizon, num_envs):
        num = min(num_envs, case.horizon - done)
        bearing = rng.uniform(0.0, 360.0, num)
        td = decision(bearing)
        selector.practice.copy_(practice.probabilities(done))
        with acting(ExplorationType.RANDOM), torch.no_grad():
            option = selector(td)[keys.OPTION]
        returns, mean = sample_batch(case, rng, bearing, counts, option.numpy())
        earned += mean
        selector.learn(finished(td, option, returns))
        selector.pending.zero_()  # all decisions have ended
        practice.add(option, option, torch.from_numpy(returns))
    with acting(ExplorationType.DETERMINISTIC), torch.no_grad():
        choice = selector(decision(BEARINGS))[keys.OPTION].numpy()
    value = final_values(case, counts[None], choice[None])[0]
    return value, counts / case.horizon, best_split(case)[1] - earned / case.horizon


def sample_batch(
    case: Case, rng: np.random.Generator, bearing: np.ndarray, counts: np.ndarray, option: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return the returns of decisions made at the same time and the sum of their means; count them in `counts`."""
    # The learners learn after the batch, so all its decisions see the same practice.
    returns, means = case.sample(rng, bearing, np.repeat(counts[None], len(option), 0), option)
    counts += np.bincount(option, minlength=len(counts))
    return returns, float(means.sum())


def decision(bearing: np.ndarray) -> TensorDict:
    """Return a step in which every environment has a decision to make."""
    angle = torch.from_numpy(np.radians(bearing)).float()
    observation = torch.stack([angle.cos(), angle.sin()], -1)
    is_decision = torch.ones(len(bearing), 1, dtype=torch.bool)
    return TensorDict({keys.OBSERVATION: observation, keys.IS_DECISION: is_decision}, [len(bearing)])


def finished(td: TensorDict, option: Tensor, returns: np.ndarray) -> TensorDict:
    """Return the finished decisions in the form of `Selector.learn`; each took one step, which ended its episode."""
    yes, observation = torch.ones(len(td), 1, dtype=torch.bool), td[keys.OBSERVATION]
    after = {
        keys.DECISION_OBSERVATION: observation,
        keys.OPTION_RETURN: torch.from_numpy(returns).float().unsqueeze(-1),
        keys.OPTION_STEPS: torch.ones(len(td), 1, dtype=torch.long),
        keys.OBSERVATION: observation,
        keys.DONE: yes,
        keys.IS_DECISION: yes,
    }
    return TensorDict({keys.OPTION: option, keys.OBSERVATION: observation, "next": after}, [len(td)])


def play_case(name: str) -> Rows:
    """Return the rows of all policies and selectors in a case."""
    torch.set_num_threads(1)
    logging.getLogger("torchrl").setLevel(logging.WARNING)
    case, rows = all_cases()[name], []
    for policy, build in POLICIES.items():
        rows.append(row(name, case, policy, *play(case, build)))
    for selector, build in SELECTORS.items():
        if selector.startswith("meta_critic") and name not in CASES_OF_META_CRITIC:
            continue
        played = [play_selector(case, build, seed) for seed in range(NUM_SELECTOR_SEEDS)]
        values, practice, regret = (np.array(each) for each in zip(*played, strict=True))
        rows.append(row(name, case, selector, {"value": values, "by_context": values}, practice, regret))
    return rows
