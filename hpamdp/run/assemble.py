"""The parts of a run, built from its config: environment, agent, evaluation, data."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import TransformedEnv

from hpamdp.config import Component, Config, ConfigError, constructor_arguments
from hpamdp.data.demonstrations import Demonstrations
from hpamdp.data.errors import DataError
from hpamdp.env.base import PAMDPEnv, checked_option_names
from hpamdp.env.decisions import with_decisions
from hpamdp.env.option_choice import OptionChoiceEnv
from hpamdp.memory import in_gigabytes, is_about_memory, total_memory
from hpamdp.messages import first_line, warn
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner
from hpamdp.run import checkpoint
from hpamdp.run.evaluate import Evaluation
from hpamdp.specs import PAMDPSpecs

# Fewer steps or episodes than this need no estimate of their memory, for which an environment is built.
_MANY = 1_000_000
# Episodes of the film that every run leaves behind.
FILMED_EPISODES = 3
# A weight is there four times: itself, its gradient and two moments of Adam.
_BYTES_A_WEIGHT = 16


@dataclass
class Parts:
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


def assemble(config: Config, output_dir: Path) -> Parts:
    """Build the parts of a run.

    Raises:
        ConfigError: values that do not go together, that a constructor refuses, or for which there is no memory.
    """
    device = config.run.resolve_device()
    check_run_memory(config, device)
    env = make_env(config, config.run.num_envs, device, config.run.seed)
    check_choice(config, env)
    check_learners_of_options(config, env)
    check_collector(config, env)
    check_modes(config)
    specs = PAMDPSpecs.from_env(env)
    check_agent_memory(config, specs, device)
    agent = make_agent(config, specs, device)
    if config.run.mode != "eval":
        set_up_updates(config, agent)
    is_new = config.run.mode != "eval" and config.run.resume is None
    data = make_data(config, env, _gamma(agent)) if is_new else None
    if is_new and config.run.low.checkpoint is not None:
        checkpoint.load_learners(checkpoint.find(config.run.low.checkpoint, "low.checkpoint"), agent, device)
    check_length(config, agent)
    evaluation = make_evaluation(config, env)
    tracked, policy = acting(env, agent, config)
    return Parts(tracked, policy, agent, evaluation, data, device)


def make_env(config: Config, num_envs: int, device: torch.device, seed: int, first_env: int = 0) -> PAMDPEnv:
    """Build the environments from number `first_env` on, which write what the two levels read of them.

    Environments whose class has no argument `first_env` get a seed of their own.

    Raises:
        ConfigError: an option that the constructor refuses, or something that this environment does not have.
    """
    assert config.env.cls is not None
    arguments = constructor_arguments(config.env.cls)
    needs = {}
    for level in (config.high, *config.learners):
        for name in getattr(level.cls, "needs", ()):
            if name not in arguments:
                lacks = {"oracle": "has no planner to ask", "human": "has no human data"}[name]
                raise ConfigError(f"{level}: {config.env} {lacks}")
            needs[name] = True
    if first_env > 0 and "first_env" not in arguments:
        seed = int(np.random.SeedSequence((seed, first_env)).generate_state(1)[0])
    env: PAMDPEnv = config.env.build(num_envs=num_envs, device=device, seed=seed, first_env=first_env, **needs)
    env.option_names = checked_option_names(env.option_names)
    if config.run.env.options is not None:
        _group_actions(env, config)
    return env


def _group_actions(env: PAMDPEnv, config: Config) -> None:
    """Make options of the problem's discrete actions.

    Raises:
        ConfigError: the problem has no such actions, or options of its own.
    """
    chosen = config.run.env.options
    options: Mapping[str, Sequence[int | str]] = {}
    if isinstance(chosen, dict):
        options = chosen
    elif chosen == "default":
        options = env.default_options
        if not options:
            raise ConfigError(f"env.options=default: {config.env} suggests none; name the actions of each option")
    for level in (config.high, *config.learners):
        if getattr(level.cls, "needs", ()):
            raise ConfigError(f"env.options: {level} knows nothing of them; use another {level.group}")
    try:
        env.group_actions(options)
    except ValueError as error:
        raise ConfigError(f"env.options: {first_line(error)} ({config.env})") from error


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
    chosen = [config.low] if is_shared else _learners_of(config, specs)
    learners = [low.build(specs=each, device=device) for low, each in zip(chosen, learner_specs, strict=True)]
    agent = HierarchicalAgent(
        selector,
        learners,
        specs,
        is_shared=is_shared,
        is_frozen=config.run.low.freeze,
        uniform_option_frames=config.run.agent.uniform_option_frames,
        selector_ends_options=config.run.agent.termination == "learned" and selector is not None,
    )
    return agent.to(device)


def set_up_updates(config: Config, agent: HierarchicalAgent) -> None:
    """Have the learners compile their updates, or make their products in bfloat16, if the run asks for it.

    Raises:
        ConfigError: one of them cannot, or what follows an option decides what a compiled update computes.
    """
    run = config.run
    if run.compile_updates:
        given = "compile_updates=true"
        if run.agent.termination != "episode":
            raise ConfigError(f"{given}: goes with agent.termination=episode only, not with {run.agent.termination}")
        _ask_learners(config, agent, given, lambda learner: learner.compile_updates())
    if run.update_precision != "float32":
        given = f"update_precision={run.update_precision}"
        _ask_learners(config, agent, given, lambda learner: learner.lower_precision())


def _ask_learners(config: Config, agent: HierarchicalAgent, given: str, ask: Callable[[Learner], None]) -> None:
    """Ask all learners for something; if one refuses, say so with the setting that was given."""
    for low, learner in _with_learners(config, agent):
        try:
            ask(learner)
        except ValueError as error:
            raise ConfigError(f"{given}: {low}: {error}") from error


def _with_learners(config: Config, agent: HierarchicalAgent) -> Iterator[tuple[Component, Learner]]:
    """Yield the agent's learners, each with its component."""
    for low, learner in zip(_learners_of(config, agent.specs), agent.learners, strict=False):
        assert isinstance(learner, Learner)
        yield low, learner


def _learners_of(config: Config, specs: PAMDPSpecs) -> list[Component]:
    """Return the component of each option's learner; of the only one where there is no choice."""
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


def check_run_memory(config: Config, device: torch.device) -> None:
    """Refuse more environments, steps or episodes than there is memory for, before any of them is built.

    The estimate takes the tensors of a step, from a single environment that is built for it, and the paths that an
    evaluation records.

    Raises:
        ConfigError: with the bytes that are surely needed.
    """
    run = config.run
    num_steps = 0 if run.mode != "train" else run.num_envs * run.steps_per_batch
    if max(run.num_envs, num_steps, run.eval.layouts) < _MANY:
        return
    one = make_env(config, 1, device, run.seed)
    step = one.fake_tensordict().bytes()
    path = 0 if one.position is None else 8 * one.max_steps
    one.close()
    needs = {
        f"num_envs={run.num_envs}": run.num_envs * step,
        f"num_envs={run.num_envs}, steps_per_batch={run.steps_per_batch}": num_steps * step,
        f"eval.layouts={run.eval.layouts}": run.eval.layouts * (step + path),
    }
    _check_memory(needs, device)


def check_agent_memory(config: Config, specs: PAMDPSpecs, device: torch.device) -> None:
    """Refuse replay buffers, batches and layers that there is no memory for, before any of them is built.

    They are known by the names of their options: `buffer_size`, `batch_size`, `minibatch_size` and those
    that end in `hidden_dims`.

    Raises:
        ConfigError: with the bytes that are surely needed.
    """
    # Two observations, the action, reward and flags.
    row = 4 * (2 * specs.observation_dim + specs.num_parameters + 2)
    is_shared = config.run.agent.sharing == "shared"
    needs = {}
    lows = [config.low] if is_shared else _learners_of(config, specs)
    for component, num in ((config.high, 1), *((low, lows.count(low)) for low in lows)):
        for name, value in component.options.items():
            setting = f"{component.group}.{name}={value}"
            if name == "buffer_size":
                needs[setting] = num * value * row
            elif name in ("batch_size", "minibatch_size"):
                needs[setting] = value * row
            elif name.endswith("hidden_dims"):
                sizes = [specs.observation_dim, *value]
                weights = sum(a * b for a, b in zip(sizes, value, strict=False))
                needs[setting] = num * weights * _BYTES_A_WEIGHT
    _check_memory(needs, device)


def _check_memory(needs: Mapping[str, int], device: torch.device) -> None:
    """Refuse settings that together need more bytes than there are; the error names the one that needs most."""
    if not needs:
        return
    available = total_memory(device)
    setting = max(needs, key=needs.__getitem__)
    if sum(needs.values()) > available:
        raise ConfigError(
            f"{setting}: the run takes at least {in_gigabytes(sum(needs.values()))} of memory, and there are "
            f"{in_gigabytes(available)}"
        )


@contextmanager
def memory_errors_explained(config: Config) -> Iterator[None]:
    """Turn the errors of what does not fit into memory into one line that names the largest sizes.

    Raises:
        ConfigError: there was such an error.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, ConfigError) or not is_about_memory(error):
            raise
        run = config.run
        sizes = f"num_envs={run.num_envs}, steps_per_batch={run.steps_per_batch}, eval.layouts={run.eval.layouts}"
        parts = f"{sizes}, {config.low.largest_sizes()}, {config.high.largest_sizes()}"
        raise ConfigError(f"{parts}: the run takes more memory than there is ({first_line(error):.160})") from error


def check_choice(config: Config, env: PAMDPEnv) -> None:
    """Refuse a needless or a missing selector, and options that end where they must not.

    Raises:
        ConfigError: with the settings to change.
    """
    has_selector = config.high.cls is not None
    if has_selector and not env.option_names:
        raise ConfigError(f"{config.high}: {config.env} has no options to choose; use high=none")
    if has_selector and not env.has_choice:
        raise ConfigError(
            f"{config.high}: {config.env} leaves nothing to choose; use high=none or {env.choice_setting}"
        )
    if not has_selector and env.has_choice:
        without = f" or {env.no_choice_setting}" if env.no_choice_setting else ""
        raise ConfigError(f"high=none: {config.env} needs a selector; use another high{without}")
    if config.run.low.freeze and not env.has_choice:
        raise ConfigError("low.freeze=true: there is no choice left to learn; use low.freeze=false")
    if config.run.agent.termination == "episode":
        _check_plans(config, env)
    else:
        _check_ends(config, env)
    if getattr(config.high.cls, "asks_learners", False):
        _check_values(config)


def _check_values(config: Config) -> None:
    """Refuse learners whose values the selector would ask for, but which have none."""
    for low in config.learners:
        option = getattr(low.cls, "value_option", None)
        if option is not None and not low.options[option]:
            raise ConfigError(f"{config.high}: {low} has no value to compare without low.{option}=true")
        if getattr(low.cls, "value", None) is Learner.value:
            raise ConfigError(f"{config.high}: {low} has no value to compare; use another low or another high")


def _check_plans(config: Config, env: PAMDPEnv) -> None:
    """Refuse plans that change options where an option lasts for its episode; say so of a ceiling made of them."""
    for low in config.learners:
        if env.plans_change_options and "oracle" in getattr(low.cls, "needs", ()):
            raise ConfigError(
                f"{low}: its plans on {config.env} change options, but agent.termination=episode keeps them; use "
                "agent.termination=steps agent.option_length=1"
            )
    if env.plans_change_options:
        warn(
            f"{config.env}: its plans, and so the ceiling, change options, but agent.termination=episode keeps them; "
            "use agent.termination=steps agent.option_length=1 to change them"
        )


def _check_ends(config: Config, env: PAMDPEnv) -> None:
    """Refuse options that end inside their episodes where the problem, the selector or the run has no use for that."""
    given = f"agent.termination={config.run.agent.termination}"
    if not (env.has_choice and env.can_change_option):
        why = "keeps an option for an episode" if env.has_choice else "has no options"
        change = f" or {env.change_setting}" if env.has_choice and env.change_setting else ""
        raise ConfigError(f"{given}: {config.env} {why}; use agent.termination=episode{change}")
    if config.run.low.freeze:
        raise ConfigError(f"{given}: low.freeze=true plays whole episodes; use agent.termination=episode")
    if getattr(config.high.cls, "is_bandit", False):
        raise ConfigError(
            f"{given}: {config.high} is a bandit, which counts what an option pays and nothing of what follows it; use "
            "agent.termination=episode, high=meta_critic or high=actor"
        )
    if config.run.agent.termination == "learned" and not getattr(config.high.cls, "ends_options", False):
        raise ConfigError(
            f"{given}: {config.high} does not decide where options end; use high=option_critic, high=meta_critic or "
            "agent.termination=steps"
        )


def check_learners_of_options(config: Config, env: PAMDPEnv) -> None:
    """Refuse learners of options that do not exist, or that share a learner.

    Raises:
        ConfigError: with the options that there are, or the setting to change.
    """
    unknown = [name for name in config.low_of if not env.has_choice or name not in env.option_names]
    if unknown:
        known = ", ".join(env.option_names) if env.has_choice else "none to choose"
        raise ConfigError(f"low.per_option: {config.env} has no option {unknown[0]}; it has {known}")
    if config.low_of and config.run.agent.sharing == "shared":
        raise ConfigError("low.per_option: agent.sharing=shared has one learner for all; use agent.sharing=per_option")


def check_modes(config: Config) -> None:
    """Refuse a run whose agent cannot learn from what there is: steps of its own, a data set or both.

    Raises:
        ConfigError: with the settings to change.
    """
    mode, has_data = config.run.mode, config.data.cls is not None
    sources = {"train": "its own steps", "offline": "data sets"}
    if mode == "offline" and not has_data:
        raise ConfigError("mode=offline: data=none leaves nothing to learn from; choose a data set")
    for low in config.learners:
        modes: tuple[str, ...] = getattr(low.cls, "modes", ())
        learns = f"{low} learns from {' and '.join(sources[known] for known in modes)}"
        if mode == "train" and "train" not in modes:
            raise ConfigError(f"mode=train: {learns} only; use mode=offline and a data set, or another low")
        if mode != "eval" and has_data and "offline" not in modes:
            raise ConfigError(f"{config.data}: {learns} only; use data=none, or another low")
    if mode == "offline" and "offline" not in getattr(config.high.cls, "modes", ("offline",)):
        raise ConfigError(f"{config.high}: learns from its own choices only; use mode=train, or another high")
    n_step = max(low.options.get("n_step", 1) for low in config.learners)
    if mode == "train" and n_step > config.run.steps_per_batch:
        raise ConfigError(
            f"low.n_step={n_step}: must be at most steps_per_batch={config.run.steps_per_batch}, as sums of rewards "
            "end with a batch"
        )
    if mode == "offline" and config.run.low.freeze:
        raise ConfigError("low.freeze=true: mode=offline trains the learners; use low.freeze=false")


def check_length(config: Config, agent: HierarchicalAgent) -> None:
    """Refuse a training run that must end before the first update of the selector or of a learner.

    Raises:
        ConfigError: the message names the setting that requires the most steps, and the number of steps of the run.
    """
    run = config.run
    if run.mode != "train":
        return
    batch = run.num_envs * run.steps_per_batch
    num = -(-run.total_frames // batch) * batch
    needs = [] if agent.selector is None else [(config.high, agent.selector.decisions_to_update())]
    if not run.low.freeze:
        needs += [(low, learner.steps_to_update()) for low, learner in _with_learners(config, agent)]
    for component, needed in needs:
        name = max(needed, key=needed.__getitem__, default="")
        if name and needed[name] > num:
            setting = f"{component.group}.{name}"
            raise ConfigError(
                f"{setting}={component.options.get(name)} ({component}): the first update comes after "
                f"{needed[name]:,} steps or decisions, but total_frames={run.total_frames} gives at most {num:,}; "
                f"set a larger total_frames or another {setting}"
            )


def check_collector(config: Config, env: PAMDPEnv) -> None:
    """Refuse a collector that this run cannot have.

    Raises:
        ConfigError: with the settings to change.
    """
    num_workers = config.collector.options.get("num_workers", 1)
    package: str | None = getattr(config.collector.cls, "package", None)
    if config.run.mode == "eval":  # which collects nothing
        return
    if config.run.mode == "offline" and getattr(config.collector.cls, "has_workers", False):
        raise ConfigError(f"{config.collector}: mode=offline takes no steps; use collector=single")
    if package is not None and importlib.util.find_spec(package) is None:
        raise ConfigError(f"{config.collector}: {package} is not installed; pip install hpamdp[{package}]")
    if config.run.num_envs % num_workers:
        raise ConfigError(
            f"collector.num_workers={num_workers}: must divide num_envs={config.run.num_envs}, of which each worker "
            "has an equal share"
        )
    if num_workers > 1 and not env.is_shardable:
        raise ConfigError(
            f"{config.collector}: {config.env} learns the scale of its observations from all environments together; "
            "use collector=single or env.observation_scaling=bounds"
        )
