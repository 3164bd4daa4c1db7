"""Check that the parts of a run go together, before anything is built.

A rule is a condition on the settings and cards of two or three parts, and the sentence that it yields with the settings
to change. The first sentence is the refusal. Rules need no class, so they can be checked without torch.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from omegaconf import DictConfig

from hpamdp.cards import CallbackCard, SelectorCard
from hpamdp.complaints import as_json
from hpamdp.config.components import (
    GROUPS,
    Component,
    constructor_arguments,
)
from hpamdp.config.compose import RECIPE, read, setting_of, settings_in
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config, RunConfig
from hpamdp.env.facts import ProblemFacts, ProblemOptions
from hpamdp.pickling import why_unsendable
from hpamdp.settings import OnlyWith, OwnSteps, Settings

# The choice that picks a selector automatically, and the selector that it picks if there are options.
AUTO_SELECTOR, DEFAULT_SELECTOR = "auto", "ucb"

_LARGE_BATCH = 1_000_000  # steps that fit into memory, so that a run may be shorter than its batch

# The encoder that encodes pictures if there are any.
AUTO_ENCODER = "auto"

# Parts of the config that define the agent.
GROUPS_OF_AGENT = ("high", "low", "encoder", "exploration", "agent", "experiment", RECIPE)

# Words of a command line that change nothing, by the mode of the run: settings, groups, and mappings of settings.
# There is no run for a `player`, who is watched or played with, and for an `agent` that Python code loads.
_OF_STEPS = (
    "total_frames",
    "num_envs",
    "steps_per_batch",
    "collector",
    "eval.every",
    "low.budget",
    "agent.practice",
)
_OF_LEARNING = ("offline", "data", "log_every", "callbacks", "save_best", "compile_updates", "update_precision")
_OF_AGENTS_LEARNING = ("agent.values_end", "agent.selector_values_end", "low.freeze", "exploration")
_OF_CHECKPOINTS = ("checkpoint_every", "checkpoint_minutes", "checkpoint_replay")
_WITHOUT_EFFECT = {
    "train": ("offline",),
    "offline": _OF_STEPS,
    "eval": (*_OF_STEPS, *_OF_LEARNING, *_OF_AGENTS_LEARNING, *_OF_CHECKPOINTS, "eval.stop_score"),
    "player": ("mode", "overwrite", "logger"),
    "agent": ("eval.layouts",),  # its method `evaluate` is told the number of episodes
}
_WHERE = {
    "train": "with mode=train",
    "offline": "with mode=offline",
    "eval": "without training",
    "player": "on a player",
    "agent": "on a trained agent",
}


def check(config: Config) -> None:
    """Refuse settings that do not go together, as far as they can be compared before the environment is built.

    Raises:
        ConfigError: a rule is broken; the message names the settings to change.
    """
    facts = facts_of(config)
    acting = config if facts is None else with_acting_learners(config, facts)
    _refuse_first(_complaints(acting))
    if facts is not None:
        check_problem(config, facts)


def checked(cfg: DictConfig, words: Sequence[str], objects: Mapping[str, Any] | None = None) -> Config:
    """Return the checked config of a run that no saved run completes.

    `high=auto` stays if only the built problem shows whether there are options.

    Args:
        cfg: the composed config.
        words: words of the command line.
        objects: arguments for the problem's constructor from Python code, if there are any.

    Raises:
        ConfigError: a value is wrong, or values do not go together.
    """
    config = read(cfg).with_objects(objects)
    check_saved_run(config.run)
    check_effects(config.run.mode, words)
    facts = facts_of(config)
    config = config if facts is None else with_selector(config, facts, words)
    check(config)
    return config


def check_saved_run(run: RunConfig) -> None:
    """Check the settings that name a saved run, before the saved run completes the config.

    Raises:
        ConfigError: a name is missing or empty, or does not go with the mode.
    """
    if run.mode == "eval" and run.checkpoint is None:
        raise ConfigError("checkpoint: missing; mode=eval needs the output folder of a run")
    if run.mode != "eval" and run.checkpoint is not None:
        raise ConfigError("checkpoint: goes with mode=eval only; to go on with a run, set resume")
    if run.mode == "eval" and run.resume is not None:
        raise ConfigError("resume: goes with mode=train and mode=offline; to score an agent, set checkpoint")


def check_effects(mode: str, words: Sequence[str]) -> None:
    """Refuse words of a command line that would change nothing.

    Args:
        mode: mode of the run, or `player` or `agent`.
        words: the words.

    Raises:
        ConfigError: there is such a word.
    """
    for word in words:
        given = settings_in(word)
        if any(each == name or each.startswith(f"{name}.") for each in given for name in _WITHOUT_EFFECT[mode]):
            raise ConfigError(f"{word}: has no effect {_WHERE[mode]}; leave it out")


def settings_without_effect(config: Config, words: Sequence[str]) -> list[str]:
    """Return a warning for each word whose setting has an effect only with another value of another setting or mode.

    A warning is enough: in a sweep, one command line serves several values of the other setting.

    Args:
        config: config of the run.
        words: words of the command line.
    """
    return [
        f"{word if name == setting_of(word) else name}: has no effect; {name.rpartition('.')[2]} counts only {each}"
        for word in words
        for name in settings_in(word)
        for each in _conditions(config, name)
    ]


def length_below_a_batch(config: Config, words: Sequence[str]) -> list[str]:
    """Return a warning if a word sets a length of training that is shorter than the first batch."""
    run, batch = config.run, config.run.num_envs * config.run.steps_per_batch
    if batch <= run.total_frames or "total_frames" not in map(setting_of, words):
        return []
    sizes = f"num_envs={run.num_envs} x steps_per_batch={run.steps_per_batch}"
    return [f"total_frames={run.total_frames}: less than a batch of {sizes}; the run has {batch:,} frames"]


def _component_and_setting(config: Config, name: str) -> tuple[Component | None, str]:
    """Return the component that a setting such as `low.memory_size` belongs to, if any, and its name there."""
    group, _, setting = name.partition(".")
    if setting.startswith("per_option."):
        option, _, setting = setting.removeprefix("per_option.").partition(".")
        return config.low_of.get(option), setting
    return (getattr(config, group) if group in GROUPS else None), setting


def marks_of(config: Config, name: str) -> tuple[list[Any], Mapping[str, Any]]:
    """Return the marks in the type of a setting, such as `OwnSteps`, and all settings of its class."""
    component, setting = _component_and_setting(config, name)
    fields = {} if component is None or component.options is None else type(component.options).model_fields
    if component is None or setting not in fields:
        return [], {}
    return fields[setting].metadata, component.settings


def _conditions(config: Config, name: str) -> list[str]:
    """Return the unmet conditions of a setting, for example `with memory=gru` for `low.memory_size`.

    With `mode=offline`, the only condition of a setting marked `OwnSteps` is another mode.
    """
    marks, settings = marks_of(config, name)
    if config.run.mode == "offline" and any(isinstance(mark, OwnSteps) for mark in marks):
        return ["with mode=train"]
    return [str(mark) for mark in marks if isinstance(mark, OnlyWith) and not mark.holds(settings)]


def check_problem(config: Config, facts: ProblemFacts) -> None:
    """Refuse settings that do not go with the problem.

    Raises:
        ConfigError: a rule is broken; the message names the settings to change.
    """
    acting = with_acting_learners(config, facts)
    _refuse_first(_complaints_about_problem(acting, facts))


def with_acting_learners(config: Config, facts: ProblemFacts) -> Config:
    """Return the config without a `low` that never acts, because `low.per_option` names a learner for every option.

    The learner of the first option takes its place.
    """
    if not config.low_of:
        return config
    names = _option_names(config, facts)
    if not names or any(name not in config.low_of for name in names):
        return config
    return replace(config, low=config.low_of[names[0]])


def facts_of(config: Config) -> ProblemFacts | None:
    """Return the facts about the problem that follow from its settings; None if only a built environment has them."""
    options = config.env.options
    if isinstance(config.env.target, str):
        return options.facts(config.env.class_name) if isinstance(options, ProblemOptions) else None
    facts = getattr(config.env.target, "facts", None)
    return facts(options) if facts is not None and isinstance(options, Settings) else None


def with_selector(config: Config, problem: ProblemFacts, words: Sequence[str] = ()) -> Config:
    """Return the config with `high=auto` replaced by a selector, or by none if there is no option to choose.

    Args:
        config: config of the run.
        problem: the facts about its problem.
        words: words of the command line.

    Raises:
        ConfigError: a word is a selector's setting, but there is no selector.
    """
    if config.high.name != AUTO_SELECTOR:
        return config
    if _has_choice(config, problem):
        return replace(config, high=replace(config.high, name=DEFAULT_SELECTOR))
    lost = [word for word in words if word.lstrip("+").startswith("high.")]
    if lost:
        raise ConfigError(f"{lost[0]}: {config.env} has no option to choose, so it has no selector; leave it out")
    return replace(config, high=Component("high", "none", None, {}))


def _refuse_first(complaints: Iterator[str]) -> None:
    """Raise an error with the first complaint, if there is one."""
    complaint = next(complaints, None)
    if complaint is not None:
        raise ConfigError(complaint)


def _complaints(config: Config) -> Iterator[str]:
    """Yield what does not go together, whatever the problem."""
    agent = config.run.agent
    ending = agent.termination
    if ending == "steps" and agent.option_length is None:
        yield "agent.option_length: missing; agent.termination=steps needs the number of steps of an option"
    if ending != "steps" and agent.option_length is not None:
        yield f"agent.option_length={agent.option_length}: goes with agent.termination=steps only, not with {ending}"
    if ending != "chosen" and agent.option_lengths is not None:
        given = f"agent.option_lengths={as_json(agent.option_lengths)}"
        yield f"{given}: goes with agent.termination=chosen only, not with {ending}"
    if config.run.mode != "eval":
        yield from _about_values(config)
        yield from _about_sources(config)
    yield from _about_levels(config)
    yield from _about_several_learners(config)
    if config.run.mode != "eval":
        yield from _about_batches(config)
    yield from _about_needs(config)


def _about_values(config: Config) -> Iterator[str]:
    """Yield what the values of a run cannot count: evaluations, lengths, or trips."""
    run, data, env = config.run, config.data, config.env
    if run.eval.stop_score is not None and run.eval_every == 0:
        yield f"eval.stop_score={run.eval.stop_score}: {_needs_evaluations(run)}"
    counting = need_of_evaluations(config, [(f"{each}:", each.card) for each in config.callbacks])
    if counting is not None:
        yield counting
    for name, other in (("values_end", "session"), ("selector_values_end", "null")):
        if getattr(run.agent, name) == "trip" and not has_trips(config):
            yield f"agent.{name}=trip: episodes of {env} have no trips; use agent.{name}={other}"
    values_end = run.agent.selector_values_end
    if values_end is not None and "gamma" not in config.high.settings:
        yield f"agent.selector_values_end={values_end}: {config.high} has no values; use agent.selector_values_end=null"
    if has_trips(config) and data.target is not None:
        yield f"{data}: {env} has sessions of trips, which data sets do not hold; use data=none"
    if has_trips(config) and run.low.freeze:
        yield f"low.freeze=true: plays whole episodes, but {env} has sessions of trips; use low.freeze=false"
    if run.agent.termination == "chosen" and data.target is not None:
        yield (
            f"agent.termination=chosen: the decisions of {data} have no lengths to learn from; use data=none or "
            "another agent.termination"
        )


def _about_sources(config: Config) -> Iterator[str]:
    """Yield what lacks the steps or the data to learn from."""
    run, data, exploration = config.run, config.data, config.exploration
    is_offline, has_data = run.mode == "offline", data.target is not None
    if exploration.target is not None and (is_offline or run.low.freeze):
        frozen = "low.freeze=true keeps the learners as they are, and greedy"
        why = "mode=offline takes no steps" if is_offline else frozen
        yield f"{exploration}: {why}; use exploration=none"
    if is_offline and not has_data:
        yield "mode=offline: data=none leaves nothing to learn from; choose a data set"
    sources = {"train": "its own steps", "offline": "data sets"}
    for low in config.learners:
        learns = f"{low} learns from {' and '.join(sources[known] for known in low.card.modes)}"
        if not is_offline and "train" not in low.card.modes:
            yield f"mode=train: {learns} only; use mode=offline and a data set, or another low"
        if has_data and "offline" not in low.card.modes:
            yield f"{data}: {learns} only; use data=none, or another low"
    if is_offline and "offline" not in config.high.card.modes:
        yield f"{config.high}: learns from its own choices only; use mode=train, or another high"
    if is_offline and run.low.freeze:
        yield "low.freeze=true: mode=offline trains the learners; use low.freeze=false"
    remembering = [level for level in _levels(config) if has_data and _memory(level)]
    for level in remembering:
        yield f"{level.group}.memory={_memory(level)}: {data} lacks what a policy remembered; use data=none"


def _needs_evaluations(run: RunConfig) -> str:
    every = "offline.eval_every" if run.mode == "offline" else "eval.every"
    return f"needs evaluations during training; set {every} above 0"


def need_of_evaluations(config: Config, callbacks: Iterable[tuple[str, CallbackCard]]) -> str | None:
    """Return which of these callbacks counts evaluations that training does not make, or None.

    Args:
        config: config of the run.
        callbacks: the name and the card of each.
    """
    counting = [name for name, card in callbacks if card.needs_evaluations and config.run.eval_every == 0]
    return f"{counting[0]} {_needs_evaluations(config.run)}" if counting else None


def _about_batches(config: Config) -> Iterator[str]:
    """Yield why no batch can be collected, or learned from."""
    collector, run = config.collector, config.run
    n_step = max(low.settings.get("n_step", 1) for low in config.learners)
    if run.mode == "train" and n_step > run.steps_per_batch:
        yield (
            f"low.n_step={n_step}: must be at most steps_per_batch={run.steps_per_batch}, as sums of rewards end with "
            "a batch"
        )
    batch = run.num_envs * run.steps_per_batch
    if run.mode == "train" and batch > max(run.total_frames, _LARGE_BATCH):
        yield (
            f"steps_per_batch={run.steps_per_batch}: counts the steps of each of num_envs={run.num_envs}, so a batch "
            f"has {batch:,}, more than total_frames={run.total_frames}"
        )
    package = collector.card.package
    if package is not None and importlib.util.find_spec(package) is None:
        yield f"{collector}: {package} is not installed; pip install hpamdp[{package}]"
    num_workers = collector.settings.get("num_workers", 1)
    if run.num_envs % num_workers:
        yield (
            f"collector.num_workers={num_workers}: must divide num_envs={run.num_envs}, of which each worker gets an "
            "equal part"
        )
    for low in config.learners:
        if collector.settings.get("ahead", False) and low.card.needs_current_policy:
            yield (
                f"collector.ahead=true: {low} learns from steps of its current policy alone, and batches ahead are of "
                "the one before; use collector.ahead=false"
            )
    if collector.card.has_workers:
        yield from _about_workers(config)


def _about_workers(config: Config) -> Iterator[str]:
    """Yield what is not of this package and no worker process can get."""
    parts = (config.env, config.high, *config.learners)
    passed: dict[str, object] = {str(part): part.cls for part in parts if isinstance(part.target, type)}
    if config.env.objects:
        passed["env"] = config.env.objects
    for what, value in passed.items():
        why = why_unsendable(value)
        if why is not None:
            yield (
                f"{what}: cannot be sent to the workers of {config.collector} ({why}); create what it refers to in its "
                "constructor or function, or use collector=single"
            )


def _about_levels(config: Config) -> Iterator[str]:
    """Yield what a level can neither count, remember, explore nor compare in this run."""
    high, env, changes = config.high, config.env, config.exploration.card.changes
    if high.settings.get("memory") == "session" and not has_trips(config):
        yield f"high.memory=session: episodes of {env} have no trips; use all, discounted or sliding_window"
    if high.settings.get("untried_first") is True and not has_trips(config):
        yield f"high.untried_first=true: episodes of {env} have no trips; use high.untried_first=false"
    if _memory(high) and _why_options_end(config) is None:
        yield (
            f"high.memory={_memory(high)}: agent.termination=episode has one decision in an episode, and nothing to "
            "remember; use agent.termination=steps, chosen or learned"
        )
    for low in config.learners:
        if config.exploration.target is not None and changes not in low.card.explores_with:
            yield (
                f"{config.exploration}: changes {changes}, which {low} does not take; use exploration=none or another "
                "low"
            )
        setting = low.card.value_setting
        if high.card.asks_learners and setting is not None and not low.settings[setting]:
            yield f"{high}: {low} has no value to compare without low.{setting}=true"
        if high.card.asks_learners and not low.card.has_value:
            yield f"{high}: {low} has no value to compare; use another low or another high"


def _about_several_learners(config: Config) -> Iterator[str]:
    """Yield why the learners of single options cannot share their steps, or value each other's states."""
    why_ends, is_compared = _why_options_end(config), config.high.card.asks_learners
    settings = "memory", "memory_size", "stack_steps"
    memories = {tuple(each.settings[name] for name in settings if _memory(each)) for each in config.learners}
    if why_ends is not None and len(memories) > 1:
        without = [str(each) for each in config.learners if not _memory(each)]
        yield (
            f"low.per_option: {why_ends} needs the same memory, memory_size and stack_steps "
            "in all learners, which value each other's states" + (f"; {without[0]} has no memory" if without else "")
        )
    for name in dict.fromkeys(name for low in config.learners for name in low.card.step_sizes):
        values = list(dict.fromkeys(low.settings[name] for low in config.learners if name in low.settings))
        if len(values) > 1:
            given = " and ".join("null" if value is None else str(value) for value in values)
            yield f"low.per_option: {name} must be the same in all learners, as steps hold one size, but is {given}"
    if config.run.mode == "eval" or (why_ends is None and not is_compared):
        return
    valued = [low for low in config.learners if _has_next_value(low)]
    without_value = [low for low in config.learners if low not in valued]
    if why_ends is not None and valued and without_value:
        setting = _value_setting(without_value[0])
        has_none = f"{without_value[0]} has no value{'' if setting is None else f' without {setting}=true'}"
        yield f"low.per_option: {why_ends} lets learners bootstrap from each other, but {has_none}"
    # Values end with trips if only trips end options.
    ends_with_trips = config.run.agent.termination == "episode" and config.run.agent.values_end == "trip"
    scales = {low.settings.get("reward_scale", 1.0): low for low in reversed(valued)}
    if len(scales) > 1 and (is_compared or not ends_with_trips):
        why = "which bootstrap from each other" if why_ends else "whose values it compares"
        (first, low), (second, other), *_ = reversed(scales.items())
        yield (
            f"low.per_option: {why_ends or config.high} needs the same reward_scale in all learners, {why}; {low} has "
            f"{first}, {other} {second}"
        )


def _why_options_end(config: Config) -> str | None:
    """Return what lets options end inside their episodes, as the beginning of a sentence; None if they do not."""
    if has_trips(config):
        return f"{config.env} has trips, and so"
    termination = config.run.agent.termination
    return None if termination == "episode" else f"agent.termination={termination}"


def _value_setting(low: Component) -> str | None:
    """Return the setting that lets other learners bootstrap from this one; None if they always can, or never."""
    return low.card.value_setting or ("end_values" if "end_values" in low.settings else None)


def _has_next_value(low: Component) -> bool:
    """Return whether other learners can bootstrap from this one."""
    setting = _value_setting(low)
    return low.card.has_value and (setting is None or low.settings[setting])


def _about_needs(config: Config) -> Iterator[str]:
    """Yield which level needs what the problem does not provide."""
    for level in _levels(config):
        lacks = [lack_of(need, config) for need in level.card.needs]
        yield from (f"{level}: {lack}" for lack in lacks if lack is not None)


def lack_of(need: str, config: Config) -> str | None:
    """Return why the problem does not provide what a level needs, such as `oracle`; None if it does."""
    facts, fact = facts_of(config), f"has_{need}"
    if hasattr(facts, fact):
        is_provided = getattr(facts, fact)
    else:
        assert config.env.cls is not None
        is_provided = need in constructor_arguments(config.env.cls)
    lacks = {"oracle": "has no planner to ask", "human": "has no human data"}
    return None if is_provided else f"{config.env} {lacks.get(need, f'takes no argument {need}')}"


def _complaints_about_problem(config: Config, problem: ProblemFacts) -> Iterator[str]:
    """Yield what does not go with the problem."""
    grouping, env = config.run.env.grouping, config.env
    if grouping == "default" and not problem.default_options:
        yield f"env.grouping=default: {env} suggests none; name the actions of each option"
    for level in _levels(config):
        if grouping is not None and level.card.needs:
            yield f"env.grouping: {level} knows nothing of them; use another {level.group}"
    yield from _about_choice(config, problem)
    yield from _about_ends(config, problem)
    if config.run.mode != "eval" and config.collector.card.has_workers:
        if not problem.is_shardable:
            yield f"{config.collector}: {env} starts processes itself; use collector=single"
        if problem.has_statistics and config.collector.settings.get("ahead", False):
            yield (
                f"collector.ahead=true: {env} learns the scale of its observations or rewards, which workers share "
                "between batches; use collector.ahead=false"
            )
    if not config.encoder.card.flattens:
        yield from _about_pictures(config, problem)


def _about_choice(config: Config, problem: ProblemFacts) -> Iterator[str]:
    """Yield why there is nothing, or nobody, to choose an option."""
    high, env, has_choice = config.high, config.env, _has_choice(config, problem)
    if high.target is not None and not has_choice:
        cure = f"leaves nothing to choose; use high=none or {env.card.choice_setting}"
        yield f"{high}: {env} {cure if problem.option_names else 'has no options to choose; use high=none'}"
    if high.target is None and has_choice:
        without = env.card.no_choice_setting and f" or {env.card.no_choice_setting}"
        yield f"high=none: {env} needs a selector; use another high{without}"
    if config.run.low.freeze and not has_choice:
        yield "low.freeze=true: there is no choice left to learn; use low.freeze=false"
    names = _option_names(config, problem) if has_choice else ()
    unknown = [name for name in config.low_of if name not in names]
    if unknown:
        yield f"low.per_option: {env} has no option {unknown[0]}; it has {', '.join(names) or 'none to choose'}"
    if config.low_of and config.run.agent.sharing == "shared":
        yield "low.per_option: agent.sharing=shared has one learner for all; use agent.sharing=per_option"


def _about_ends(config: Config, problem: ProblemFacts) -> Iterator[str]:
    """Yield why options cannot end where `agent.termination` says."""
    high, env, ending = config.high, config.env, config.run.agent.termination
    planning = [low for low in config.learners if "oracle" in low.card.needs]
    given = f"agent.termination={ending}"
    if ending == "episode" and problem.plans_change_options and planning:
        yield (
            f"{planning[0]}: its plans on {env} change options, but {given} keeps them; use agent.termination=steps "
            "agent.option_length=1"
        )
    if ending == "episode":
        return
    if not _has_choice(config, problem):
        yield f"{given}: {env} has no options; use agent.termination=episode"
    if not problem.can_change_option:
        change = env.card.change_setting and f" or {env.card.change_setting}"
        yield f"{given}: {env} keeps an option for an episode; use agent.termination=episode{change}"
    if config.run.low.freeze:
        yield f"{given}: low.freeze=true plays whole episodes; use agent.termination=episode"
    if high.card.is_bandit:
        yield (
            f"{given}: {high} is a bandit, which counts what an option returns and nothing of what follows it; use "
            "agent.termination=episode, high=meta_critic or high=actor"
        )
    if ending == "learned" and not high.card.ends_options:
        yield (
            f"{given}: {high} does not decide where options end; use high=option_critic, high=meta_critic or "
            "agent.termination=steps"
        )
    why = _why_without_lengths(high.card)
    if ending == "chosen" and why is not None:
        yield f"{given}: {high} {why}; use high=meta_critic, high=actor or another agent.termination"


def _why_without_lengths(card: SelectorCard) -> str | None:
    """Return why a selector cannot choose the lengths of options; None if it can."""
    if card.asks_learners:
        return "compares the learners' values, which do not depend on an option's length"
    return "chooses as the environment's entries say, which have no lengths" if card.needs else card.lengths_refusal


def _about_pictures(config: Config, problem: ProblemFacts) -> Iterator[str]:
    """Yield who cannot read the problem's pictures, which are flattened only if the user asks for it."""
    encoder, env = config.encoder, config.env
    for level in _levels(config):
        if problem.has_pictures and level.target is not None and not level.card.takes_pictures:
            yield (
                f"{level}: {env} observes pictures, which it has no encoder for; use another {level.group}, or "
                "encoder=mlp to flatten them"
            )
    if problem.has_pictures and config.data.target is not None:
        yield f"{config.data}: {env} observes pictures, which data sets do not hold; use data=none"
    if not problem.has_pictures and encoder.name != AUTO_ENCODER:
        yield f"{encoder}: {env} observes no pictures; use encoder={AUTO_ENCODER}"


def _has_choice(config: Config, problem: ProblemFacts) -> bool:
    return problem.has_choice or config.run.env.grouping is not None


def _option_names(config: Config, problem: ProblemFacts) -> tuple[str, ...]:
    grouping = config.run.env.grouping
    if grouping is None:
        return problem.option_names
    return tuple(problem.default_options if grouping == "default" else grouping)


def _levels(config: Config) -> list[Component]:
    return [config.high, *config.learners]


def _memory(component: Component) -> str | None:
    """Return the kind of a level's memory, `stack` or `gru`; None if the level has no memory."""
    memory = component.settings.get("memory")
    return str(memory) if memory in ("stack", "gru") else None  # the setting of a bandit says which returns count


def has_trips(config: Config) -> bool:
    """Return whether an episode of the problem is a session of several trips."""
    return config.env.card.has_trips


# Rules for a built environment, whose steps and actions show more than its settings.


def uncounted_durations(config: Config) -> str | None:
    """Return a warning if a level discounts all steps alike, for a problem whose steps take different times."""
    blind = [level for level in _discounting(config) if not level.card.counts_durations]
    if config.run.mode == "eval" or not blind:
        return None
    return f"{blind[0]}: discounts all steps alike, but those of {config.env} take different times; gamma=1 avoids that"


def counting_durations(config: Config) -> list[Component]:
    """Return the levels whose discounts count how long steps take."""
    return [level for level in _discounting(config) if level.card.counts_durations]


def _discounting(config: Config) -> list[Component]:
    return [level for level in [config.high, *config.learners] if level.settings.get("gamma", 1.0) != 1.0]


def forgotten_trips(config: Config, problem: ProblemFacts, *, reveals_directions: bool) -> str | None:
    """Return a warning if the learners of a session remember nothing of earlier trips; None if one does.

    This may be intended. But then no learner uses in later trips what earlier ones have shown.

    Args:
        config: config of the run.
        problem: the facts about its problem.
        reveals_directions: whether the problem reveals where its actions point, which some learners remember by
            themselves.
    """
    if not has_trips(config) or (reveals_directions and any(map(_remembers_directions, config.learners))):
        return None
    remembering = [low for low in config.learners if _memory(low) is not None]
    if not remembering and any(low.settings.get("memory") == "none" for low in config.learners):
        return (
            f"low.memory=none: {config.env} has sessions, of which it forgets earlier trips; low.memory=gru keeps them"
        )
    if not remembering or not _has_choice(config, problem) or config.run.agent.sharing == "shared":
        return None
    return (
        f"low.memory={_memory(remembering[0])}: with agent.sharing=per_option a memory begins with its option, so it "
        "forgets earlier trips; agent.sharing=shared remembers the session"
    )


def check_directions(config: Config) -> None:
    """Refuse learners of single options if only some of them remember the directions that the problem reveals.

    Such a memory sees actions, and is reset, only while an option of the learners with a memory is held.

    Raises:
        ConfigError: some remember them, and others do not.
    """
    if len({*map(_remembers_directions, config.learners)}) > 1:
        raise ConfigError(
            f"low.per_option: {config.env} reveals directions, which all learners must remember or none; "
            "use pets with the same augment and memory for all options, or augment=false"
        )


def _remembers_directions(low: Component) -> bool:
    """Return whether a learner remembers revealed directions."""
    can = low.card.remembers_directions
    return can and low.settings.get("memory") == "none" and low.settings.get("augment") is not False
