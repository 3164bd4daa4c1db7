"""The parts of a run, built from its config: environment, agent, evaluation, data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from hpamdp.config.components import Component, constructor_arguments
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config
from hpamdp.data.demonstrations import Demonstrations
from hpamdp.data.errors import DataError
from hpamdp.env.base import PAMDPEnv, checked_option_names
from hpamdp.env.decisions import with_decisions
from hpamdp.env.facts import ProblemFacts
from hpamdp.env.option_choice import OptionChoiceEnv
from hpamdp.messages import first_line, warn
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner
from hpamdp.run import capacity, checkpoint, compatibility
from hpamdp.run.evaluate import Evaluation
from hpamdp.specs import PAMDPSpecs

# Episodes of the film that every run leaves behind.
FILMED_EPISODES = 3
# Updates of a learner in a run from which on it is faster to compile them first, which takes some 40 s.
_UPDATES_THAT_PAY = 10_000


@dataclass
class AssembledRun:
    """What a run is made of.

    Attributes:
        env: the environments to train in, with their decisions tracked.
        policy: acts in `env`.
        agent: selector and learners.
        evaluation: scores the agent on environments of its own.
        data: what others did, to learn from, if there is any.
        device: of all of them.
    """

    env: TransformedEnv
    policy: TensorDictModuleBase
    agent: HierarchicalAgent
    evaluation: Evaluation
    data: Demonstrations | None
    device: torch.device


def assemble(config: Config, output_dir: Path) -> AssembledRun:
    """Build the parts of a run.

    Raises:
        ConfigError: values that do not go together, that a constructor refuses, or for which there is no memory.
    """
    run = config.run
    compatibility.check(config)
    device = run.resolve_device()
    capacity.check_run(run, device, lambda: make_env(config, 1, device, run.seed))
    env = make_env(config, run.num_envs, device, run.seed)
    check_built(config, env)
    specs = PAMDPSpecs.from_env(env)
    capacity.check_agent(config, specs, learners_of(config, specs), device)
    agent = make_agent(config, specs, device)
    capacity.check_length(config, agent, with_learners(config, agent))
    if run.mode != "eval":
        set_up_updates(config, agent)
    is_new = run.mode != "eval" and run.resume is None
    data = make_data(config, env, _gamma(agent)) if is_new else None
    if is_new and run.low.checkpoint is not None:
        checkpoint.load_learners(checkpoint.find(run.low.checkpoint, "low.checkpoint"), agent, device)
    evaluation = make_evaluation(config, env)
    tracked, policy = acting(env, agent, config)
    return AssembledRun(tracked, policy, agent, evaluation, data, device)


def make_env(config: Config, num_envs: int, device: torch.device, seed: int, first_env: int = 0) -> PAMDPEnv:
    """Build the environments from number `first_env` on, which write what the two levels read of them.

    Environments whose class has no argument `first_env` get a seed of their own.

    Raises:
        ConfigError: a setting that the constructor refuses.
    """
    assert config.env.cls is not None
    if first_env > 0 and "first_env" not in constructor_arguments(config.env.cls):
        seed = int(np.random.SeedSequence((seed, first_env)).generate_state(1)[0])
    levels = (config.high, *config.learners)
    needs = {need: True for level in levels for need in getattr(level.cls, "needs", ())}
    env: PAMDPEnv = config.env.build(num_envs=num_envs, device=device, seed=seed, first_env=first_env, **needs)
    env.option_names = checked_option_names(env.option_names)
    grouping = config.run.env.grouping
    if grouping is not None:
        try:
            env.group_actions(grouping if isinstance(grouping, dict) else env.default_options)
        except ValueError as error:
            raise ConfigError(f"env.grouping: {first_line(error)} ({config.env})") from error
    return env


def check_built(config: Config, env: PAMDPEnv) -> None:
    """Check the rules about the problem, some of which had to wait for the environment; warn of a ceiling out of reach.

    Raises:
        ConfigError: settings that do not go with the problem.
    """
    facts = compatibility.facts_of(config) or _facts_of_built(env)
    compatibility.check_problem(config, facts)
    if facts.plans_change_options and config.run.agent.termination == "episode":
        warn(
            f"{config.env}: its plans, and so the ceiling, change options, but agent.termination=episode keeps them; "
            "use agent.termination=steps agent.option_length=1 to change them"
        )


def _facts_of_built(env: PAMDPEnv) -> ProblemFacts:
    return ProblemFacts(
        title=env.title,
        option_names=env.option_names,
        has_choice=env.has_choice,
        can_change_option=env.can_change_option,
        plans_change_options=env.plans_change_options,
        is_shardable=env.is_shardable,
        default_options=env.default_options,
    )


def choose_selector(config: Config, words: Sequence[str] = ()) -> Config:
    """Return the config with a selector in the place of `high=auto`; see `compatibility.with_selector`.

    A problem whose settings do not tell whether it has options is built once for it.

    Raises:
        ConfigError: the problem cannot be built, or a word sets something of a selector that is not there.
    """
    if config.high.name != compatibility.AUTO_SELECTOR:
        return config
    facts = compatibility.facts_of(config)
    if facts is None:
        env = make_env(config, 1, torch.device("cpu"), config.run.seed)
        facts = _facts_of_built(env)
        env.close()
    return compatibility.with_selector(config, facts, words)


def make_agent(config: Config, specs: PAMDPSpecs, device: torch.device) -> HierarchicalAgent:
    """Build both levels with fresh weights.

    Raises:
        ConfigError: an option that a constructor refuses.
    """
    selector = config.high.build(specs=specs, device=device) if specs.num_options else None
    is_shared = config.run.agent.sharing == "shared" and specs.num_options > 0
    if is_shared:
        learner_specs = [specs.with_option_observed()]
    else:
        learner_specs = [specs.of_option(i) for i in range(specs.num_options)] or [specs]
    chosen = zip(learners_of(config, specs), learner_specs, strict=True)
    learners = [low.build(specs=each, device=device) for low, each in chosen]
    agent = HierarchicalAgent(
        selector,
        learners,
        specs,
        is_shared=is_shared,
        is_frozen=config.run.low.freeze,
        uniform_option_steps=config.run.agent.uniform_option_steps,
        selector_ends_options=config.run.agent.termination == "learned" and selector is not None,
    )
    return agent.to(device)


def set_up_updates(config: Config, agent: HierarchicalAgent) -> None:
    """Have the learners compile their updates, or make their products in bfloat16, if the run asks for it.

    Raises:
        ConfigError: one of them cannot, or what follows an option decides what a compiled update computes.
    """
    run = config.run
    if run.compile_updates == "auto":
        _compile_if_it_pays(config, agent)
    elif run.compile_updates:
        given = "compile_updates=true"
        if run.agent.termination != "episode":
            raise ConfigError(f"{given}: goes with agent.termination=episode only, not with {run.agent.termination}")
        _ask_learners(config, agent, given, lambda learner: learner.compile_updates())
    if run.update_precision != "float32":
        given = f"update_precision={run.update_precision}"
        _ask_learners(config, agent, given, lambda learner: learner.lower_precision())


def _compile_if_it_pays(config: Config, agent: HierarchicalAgent) -> None:
    """Compile the updates of learners that can, if they make enough of them in this run."""
    run = config.run
    if run.agent.termination != "episode" or run.low.freeze:
        return
    share = 1.0 / len(agent.learners)
    for _, learner in with_learners(config, agent):
        num = run.num_frames if run.mode == "offline" else learner.num_updates(int(share * run.total_frames))
        if num >= _UPDATES_THAT_PAY:
            with suppress(ValueError):  # the learner, or this machine, cannot compile
                learner.compile_updates()


def _ask_learners(config: Config, agent: HierarchicalAgent, given: str, ask: Callable[[Learner], None]) -> None:
    """Ask all learners for something; if one refuses, say so with the setting that was given."""
    for low, learner in with_learners(config, agent):
        try:
            ask(learner)
        except ValueError as error:
            raise ConfigError(f"{given}: {low}: {error}") from error


def with_learners(config: Config, agent: HierarchicalAgent) -> Iterator[tuple[Component, Learner]]:
    """Yield the agent's learners, each with its component."""
    for low, learner in zip(learners_of(config, agent.specs), agent.learners, strict=False):
        assert isinstance(learner, Learner)
        yield low, learner


def learners_of(config: Config, specs: PAMDPSpecs) -> list[Component]:
    """Return the component of each learner: one for each option or, if they share it or there is none, one."""
    if config.run.agent.sharing == "shared":
        return [config.low]
    return [config.low_of.get(name, config.low) for name in specs.option_names] or [config.low]


def make_data(config: Config, env: PAMDPEnv, gamma: float) -> Demonstrations | None:
    """Build the data set, if there is one, with option returns that are discounted by the selector's `gamma`.

    Raises:
        ConfigError: the data set cannot be read, has a wrong value, or its returns cannot be discounted.
    """
    try:
        demonstrations: Demonstrations | None = config.data.build(env=env)
        if demonstrations is None:
            return None
        demonstrations.check(PAMDPSpecs.from_env(env))
    except DataError as error:
        raise ConfigError(f"{config.data}: {first_line(error)}") from error
    except RuntimeError as error:  # raised by tensordict in the constructor of a user's own data set
        if "batch dimension mismatch" not in str(error):
            raise
        raise ConfigError(f"{config.data}: its entries differ in length ({first_line(error)})") from error
    try:
        demonstrations.discount(gamma)
    except DataError as error:
        raise ConfigError(f"high.gamma={gamma}: {config.data}: {error}") from error
    return demonstrations


def make_evaluation(config: Config, env: PAMDPEnv, num_filmed: int = FILMED_EPISODES) -> Evaluation:
    """Build the evaluation on environments of its own, which scale observations as `env` does.

    With `film=false` no episode is filmed, otherwise the first `num_filmed`.
    """
    test_env = make_env(config, config.run.eval.layouts, env.device, seed=0)
    test_env.set_scaling_from(env)
    return Evaluation(_with_decisions(test_env, config), config.run.eval.seed, num_filmed if config.run.film else 0)


def acting(env: PAMDPEnv, agent: HierarchicalAgent, config: Config) -> tuple[TransformedEnv, TensorDictModuleBase]:
    """Return the environment to train in, with its decisions tracked, and the policy that acts there."""
    gamma = _gamma(agent)
    if config.run.low.freeze:
        return _with_decisions(OptionChoiceEnv(agent.router, env, gamma), config), agent.selector
    return _with_decisions(env, config, gamma), agent.policy


def _gamma(agent: HierarchicalAgent) -> float:
    return 1.0 if agent.selector is None else agent.selector.gamma


def _with_decisions(env: PAMDPEnv, config: Config, gamma: float = 1.0) -> TransformedEnv:
    is_learned = config.run.agent.termination == "learned"
    return with_decisions(env, gamma, math.inf if is_learned else config.run.agent.option_length)
