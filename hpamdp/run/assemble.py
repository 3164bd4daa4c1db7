"""Build the parts of a run from its config: environment, agent, evaluation, data."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from hpamdp import keys
from hpamdp.config.components import Component, constructor_arguments
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config
from hpamdp.data import DataError
from hpamdp.data.demonstrations import Demonstrations
from hpamdp.data.row_checks import DURATION, missing_masks
from hpamdp.env.base import PAMDPEnv, checked_option_names
from hpamdp.env.decisions import OptionLength, with_decisions
from hpamdp.env.errors import closed_on_error
from hpamdp.env.facts import ProblemFacts
from hpamdp.env.option_choice import OptionChoiceEnv
from hpamdp.messages import first_line, warn
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner, Selector
from hpamdp.policies.option_lengths import DEFAULT_LENGTHS
from hpamdp.policies.practice import CurvePractice, Practice
from hpamdp.run import checkpoint, compatibility
from hpamdp.run.evaluate import Evaluation
from hpamdp.specs import PAMDPSpecs

# Number of episodes in the film of a run.
FILMED_EPISODES = 3
# Largest number of steps of an episode in it, few enough to film in a second or two.
FILMED_STEPS = 40
# If a learner makes at least so many updates in a run, compilation saves more time than the 40 s or so that it takes.
_UPDATES_THAT_PAY = 10_000


@dataclass
class AssembledRun:
    """The parts of a run.

    Attributes:
        env: the environments to train in, with tracked decisions.
        policy: policy that acts in `env`.
        agent: selector and learners.
        evaluation: evaluation of the agent on separate environments.
        data: the data set to learn from, if any.
        device: device of all parts.
    """

    env: TransformedEnv
    policy: TensorDictModuleBase
    agent: HierarchicalAgent
    evaluation: Evaluation
    data: Demonstrations | None
    device: torch.device

    @property
    def problem(self) -> PAMDPEnv:
        """The environments in which the whole agent acts; with `low.freeze=true`, `env` wraps them."""
        env = self.env.base_env
        return env.inner_env if isinstance(env, OptionChoiceEnv) else env

    def close(self) -> None:
        """Close the environments."""
        for env in (self.env, self.evaluation.env):
            if not env.is_closed:
                env.close()


def assemble(config: Config) -> AssembledRun:
    """Build the parts of a run.

    Raises:
        ConfigError: values do not go together, a constructor refuses them, or memory does not suffice.
    """
    run = config.run
    compatibility.check(config)
    device = run.resolve_device()
    env = make_env(config, run.num_envs, device, run.seed)
    with closed_on_error(env):
        return _assemble(config, env, device)


def _assemble(config: Config, env: PAMDPEnv, device: torch.device) -> AssembledRun:
    """Build the parts of a run around its environments."""
    run = config.run
    check_built(config, env)
    specs = PAMDPSpecs.from_env(env)
    agent = make_agent(config, specs, device)
    if run.mode != "eval":
        set_up_updates(config, agent)
    is_new = run.mode != "eval" and run.resume is None
    holds_out = run.mode == "offline" and bool(getattr(config.data.options, "held_out", ()))
    data = make_data(config, env, _gamma(agent)) if is_new or holds_out else None
    if is_new and run.low.checkpoint is not None:
        checkpoint.load_learners(checkpoint.find(run.low.checkpoint, "low.checkpoint"), agent, device)
    tracked, policy = env_and_policy(env, agent, config)
    return AssembledRun(tracked, policy, agent, make_evaluation(config, env), data, device)


def make_env(config: Config, num_envs: int, device: torch.device, seed: int, first_env: int = 0) -> PAMDPEnv:
    """Build the environments from number `first_env` on, with the entries that both levels need.

    If the class has no argument `first_env`, the environments get a seed that depends on it.

    Raises:
        ConfigError: the constructor refuses a setting.
    """
    assert config.env.cls is not None
    if first_env > 0 and "first_env" not in constructor_arguments(config.env.cls):
        seed = int(np.random.SeedSequence((seed, first_env)).generate_state(1)[0])
    levels = (config.high, *config.learners)
    needs = {need: True for level in levels for need in level.card.needs}
    flattens = config.encoder.card.flattens
    env: PAMDPEnv = config.env.build(
        num_envs=num_envs, device=device, seed=seed, first_env=first_env, flatten_pictures=flattens, **needs
    )
    if flattens and env.observation_entries:
        env.close()
        raise ConfigError(f"{config.encoder}: {config.env} cannot flatten its pictures; use encoder=cnn")
    return grouped(env, config)


def grouped(env: PAMDPEnv, config: Config) -> PAMDPEnv:
    """Return the environment with the options of `env.grouping`, if it is set.

    Raises:
        ConfigError: names of options are wrong, or the environment refuses the grouping; it is closed then.
    """
    with closed_on_error(env):
        env.option_names = checked_option_names(env.option_names)
        grouping = config.run.env.grouping
        if grouping is not None:
            try:
                env.group_actions(grouping if isinstance(grouping, dict) else env.default_options)
            except ValueError as error:
                raise ConfigError(f"env.grouping: {first_line(error)} ({config.env})") from error
    return env


def check_built(config: Config, env: PAMDPEnv) -> None:
    """Check the rules about the problem, and warn if its ceiling is out of reach.

    Raises:
        ConfigError: the settings do not go with the problem.
    """
    facts = compatibility.facts_of(config) or _facts_of_built(env)
    compatibility.check_problem(config, facts)
    left_out = actions_in_no_option(env) if isinstance(config.run.env.grouping, dict) else []
    if left_out:
        warn(f"env.grouping: no option has {', '.join(left_out)}; the agent never takes them ({config.env})")
    if facts.plans_change_options and config.run.agent.termination == "episode":
        warn(
            f"{config.env}: its plans, and so the ceiling, change options, but agent.termination=episode keeps them; "
            "use agent.termination=steps agent.option_length=1 to change them"
        )
    acting = compatibility.with_acting_learners(config, facts)
    reveals_directions = env.geometry is not None and env.geometry.revealed is not None
    if reveals_directions:
        compatibility.check_directions(acting)
    forgotten = compatibility.forgotten_trips(acting, facts, reveals_directions=reveals_directions)
    if forgotten is not None:
        warn(forgotten)
    uncounted = compatibility.uncounted_durations(acting) if keys.DURATION in env.observation_spec.keys() else None
    if uncounted is not None:
        warn(uncounted)


def actions_in_no_option(env: PAMDPEnv) -> list[str]:
    """Return the discrete actions of a grouped environment that no option allows, by name if they have names."""
    names = [*env.discrete_names] or [f"action {number}" for number in range(len(env.parameter_dims))]
    taken = zip(*(env.option_actions or ()), strict=True)
    return [name for name, by_options in zip(names, taken, strict=True) if not any(by_options)]


def _facts_of_built(env: PAMDPEnv) -> ProblemFacts:
    """Return the facts about a problem whose settings do not tell them."""
    return ProblemFacts(
        title=env.title,
        option_names=env.option_names,
        has_choice=env.has_choice,
        can_change_option=env.can_change_option,
        plans_change_options=env.plans_change_options,
        is_shardable=env.is_shardable,
        has_statistics=bool(env.statistics()),
        default_options=env.default_options,
        has_pictures=any(entry.is_picture for entry in env.observation_entries),
    )


def choose_selector(config: Config, words: Sequence[str] = ()) -> Config:
    """Return the config with `high=auto` replaced; see `compatibility.with_selector`.

    If the settings do not determine whether the problem has options, the problem is built once to find out.

    Raises:
        ConfigError: the problem cannot be built, or a word is a selector's setting, but there is no selector.
    """
    if config.high.name != compatibility.AUTO_SELECTOR:
        return config
    facts = compatibility.facts_of(config)
    if facts is None:
        env = make_env(config, 1, torch.device("cpu"), config.run.seed)
        with closing(env):
            facts = _facts_of_built(env)
    return compatibility.with_selector(config, facts, words)


def make_agent(config: Config, specs: PAMDPSpecs, device: torch.device) -> HierarchicalAgent:
    """Build both levels with fresh weights.

    Raises:
        ConfigError: a constructor refuses a setting.
    """
    specs = replace(specs, encoder=config.encoder.build_for_entry)
    lengths = option_lengths(config)
    high_specs = specs.with_option_lengths(lengths) if lengths else specs
    selector = config.high.build(specs=high_specs, device=device) if specs.num_options else None
    is_shared = config.run.agent.sharing == "shared" and specs.num_options > 0
    if is_shared:
        learner_specs = [specs.with_option_observed()]
    else:
        learner_specs = [specs.of_option(i) for i in range(specs.num_options)] or [specs]
    chosen = zip(learners_of(config, specs), learner_specs, strict=True)
    learners = [low.build(specs=each, device=device) for low, each in chosen]
    explorations = (
        []
        if config.exploration.target is None
        else [config.exploration.build(learner=learner, device=device) for learner in learners]
    )
    agent = HierarchicalAgent(
        selector,
        learners,
        specs,
        is_shared=is_shared,
        is_frozen=config.run.low.freeze,
        practice=_practice(config, selector),
        selector_ends_options=config.run.agent.termination == "learned" and selector is not None,
        option_lengths=lengths,
        explorations=explorations,
    )
    values_end, of_selector = config.run.agent.values_end, config.run.agent.selector_values_end
    agent.values_end_with_trips = values_end == "trip"
    agent.selector_values_end_with_trips = (of_selector or values_end) == "trip"
    return agent.to(device)


def _practice(config: Config, selector: Selector | None) -> Practice | None:
    """Return which options practise, see `AgentConfig.practice`."""
    run = config.run
    practice = run.agent.practice
    if practice == "auto":
        practises = selector is not None and selector.card.sees_state and not run.low.freeze
        lasts = run.agent.termination == "episode" and not compatibility.has_trips(config)
        practice = "curves" if practises and lasts and run.agent.sharing == "per_option" else 0
    if selector is None:
        return None
    num_options = selector.specs.num_options
    return CurvePractice(num_options, run.num_frames) if practice == "curves" else Practice(num_options, practice)


def set_up_updates(config: Config, agent: HierarchicalAgent) -> None:
    """Compile the learners' updates, or compute their matrix products in bfloat16, if the run asks for it.

    Raises:
        ConfigError: a learner cannot do so, or options may end inside episodes, which a compiled update cannot handle.
    """
    run = config.run
    if run.compile_updates == "auto":
        _compile_if_it_pays(config, agent)
    elif run.compile_updates:
        given = "compile_updates=true"
        if _options_end_inside(config, agent):
            ending = run.agent.termination
            why = f"{config.env} has trips" if ending == "episode" else f"agent.termination={ending}"
            raise ConfigError(f"{given}: {why}, so options end inside their episodes; use compile_updates=auto")
        _ask_learners(config, agent, given, lambda learner: learner.compile_updates())
    if run.update_precision != "float32":
        given = f"update_precision={run.update_precision}"
        _ask_learners(config, agent, given, lambda learner: learner.lower_precision())


def _compile_if_it_pays(config: Config, agent: HierarchicalAgent) -> None:
    """Compile the updates of all learners that support it, if they make enough updates in this run."""
    run = config.run
    if _options_end_inside(config, agent) or run.low.freeze:
        return
    fraction = 1.0 / len(agent.learners)
    for _, learner in with_learners(config, agent):
        num = run.num_frames if run.mode == "offline" else learner.num_updates(int(fraction * run.total_frames))
        if num >= _UPDATES_THAT_PAY:
            with suppress(ValueError):  # the learner, or this machine, cannot compile
                learner.compile_updates()


def _options_end_inside(config: Config, agent: HierarchicalAgent) -> bool:
    """Return whether options may end inside their episodes."""
    has_trips = agent.selector is not None and compatibility.has_trips(config)
    return has_trips or config.run.agent.termination != "episode"


def _ask_learners(config: Config, agent: HierarchicalAgent, given: str, ask: Callable[[Learner], None]) -> None:
    """Apply a request to all learners; if one refuses, raise an error that names the setting."""
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
    """Return the component of each learner: one for each option, or a single one if all options share it."""
    if config.run.agent.sharing == "shared":
        return [config.low]
    return [config.low_of.get(name, config.low) for name in specs.option_names] or [config.low]


def make_data(config: Config, env: PAMDPEnv, gamma: float) -> Demonstrations | None:
    """Build the data set, if there is one, and discount its option returns by the selector's `gamma`.

    Raises:
        ConfigError: the data set cannot be read, has a wrong value, or has returns that cannot be discounted.
    """
    try:
        demonstrations: Demonstrations | None = config.data.build(env=env)
        if demonstrations is None:
            return None
        demonstrations.check(PAMDPSpecs.from_env(env), env.observation_bounds)
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
    _check_completeness(config, env, demonstrations)
    return demonstrations


def _check_completeness(config: Config, env: PAMDPEnv, data: Demonstrations) -> None:
    """Warn if the data set lacks what the environment writes and learners would read.

    Raises:
        ConfigError: the data set has durations, but the environment's steps take no different times.
    """
    rows = data.batch.squeeze(0)
    writes, has = keys.DURATION in env.observation_spec.keys(), DURATION in rows.keys(True, True)
    if has and not writes:
        raise ConfigError(f"{config.data}: it has next.duration, but steps of {config.env} do not take different times")
    counting = compatibility.counting_durations(config)
    if writes and not has and counting:
        warn(
            f"{config.data}: it lacks next.duration, so {counting[0]} discounts its steps alike, but steps of "
            f"{config.env} take different times"
        )
    masks = missing_masks(rows, PAMDPSpecs.from_env(env))
    if masks:
        warn(f"{config.data}: it lacks {', '.join(masks)}, so learners take everything as allowed in its states")


def make_evaluation(
    config: Config, env: PAMDPEnv, num_filmed: int = FILMED_EPISODES, filmed_steps: int | None = FILMED_STEPS
) -> Evaluation:
    """Build the evaluation on separate environments, which scale observations as `env` does.

    The first `filmed_steps` steps of the first `num_filmed` episodes are filmed, or none with `film=false`.
    """
    test_env = make_env(config, config.run.eval.layouts, env.device, seed=0)
    with closed_on_error(test_env):
        test_env.set_scaling_from(env)
        num_filmed = num_filmed if config.run.film else 0
        return Evaluation(_with_decisions(test_env, config), config.run.eval.seed, num_filmed, filmed_steps)


def env_and_policy(
    env: PAMDPEnv, agent: HierarchicalAgent, config: Config
) -> tuple[TransformedEnv, TensorDictModuleBase]:
    """Return the environment to train in, with tracked decisions, and the policy that acts there."""
    gamma = _gamma(agent)
    if config.run.low.freeze:
        return _with_decisions(OptionChoiceEnv(agent.router, env, gamma), config), agent.selector
    return _with_decisions(env, config, gamma), agent.policy


def _gamma(agent: HierarchicalAgent) -> float:
    return 1.0 if agent.selector is None else agent.selector.gamma


def option_length(config: Config) -> OptionLength:
    """Return the steps of an option, as in `DecisionTracker`."""
    run = config.run.agent
    if run.termination == "chosen":
        return "chosen"
    return math.inf if run.termination == "learned" else run.option_length


def option_lengths(config: Config) -> tuple[int, ...]:
    """Return the lengths that the selector chooses from; empty if it chooses options alone."""
    run = config.run.agent
    return (run.option_lengths or DEFAULT_LENGTHS) if run.termination == "chosen" else ()


def _with_decisions(env: PAMDPEnv, config: Config, gamma: float = 1.0) -> TransformedEnv:
    return with_decisions(env, gamma, option_length(config))
