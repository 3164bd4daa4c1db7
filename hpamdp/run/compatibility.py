"""Check that the parts of a run go together, by two lists of rules, before anything is built.

A rule returns one line with the settings to change, or None if the run satisfies it. Rules read only settings and
cards of classes, so they can be checked without torch.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TypeAlias

from hpamdp.cards import CallbackCard
from hpamdp.complaints import as_json
from hpamdp.config.components import (
    GROUPS,
    RUN_VALUES,
    Component,
    constructor_arguments,
    is_passed,
)
from hpamdp.config.compose import RECIPE, setting_of, settings_in
from hpamdp.config.errors import ConfigError
from hpamdp.config.schema import Config, RunConfig
from hpamdp.env.facts import ProblemFacts, ProblemOptions
from hpamdp.pickling import why_unsendable
from hpamdp.settings import OnlyWith, OwnSteps

# The choice that picks a selector automatically, and the selector that it picks if there are options.
AUTO_SELECTOR, DEFAULT_SELECTOR = "auto", "ucb"

# The encoder that encodes pictures if there are any.
AUTO_ENCODER = "auto"

# Parts of the config that define the agent.
GROUPS_OF_AGENT = ("high", "low", "encoder", "exploration", "agent", "experiment", "search", RECIPE)

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

# Values that a learner recommends, by the values of the run that take their place.
_RECOMMENDED = {
    "total_frames": "low.budget.total_frames",
    "num_envs": "low.budget.num_envs",
    "steps_per_batch": "low.budget.steps_per_batch",
    "eval.every": "low.budget.eval_every",
}

Rule: TypeAlias = Callable[[Config], "str | None"]
ProblemRule: TypeAlias = Callable[[Config, ProblemFacts], "str | None"]


def check(config: Config) -> None:
    """Refuse settings that do not go together, as far as they can be compared before the environment is built.

    Raises:
        ConfigError: a rule is broken; the message names the settings to change.
    """
    facts = facts_of(config)
    acting = config if facts is None else with_acting_learners(config, facts)
    _refuse_first((rule(acting) for rule in RULES), config.run)
    if facts is not None:
        check_problem(config, facts)


def check_saved_run(run: RunConfig) -> None:
    """Check the settings that name a saved run, before the saved run completes the config.

    Raises:
        ConfigError: a name is missing or empty, or does not go with the mode.
    """
    for name, value in (("resume", run.resume), ("checkpoint", run.checkpoint), ("low.checkpoint", run.low.checkpoint)):
        if value == "":
            raise ConfigError(f"{name}: empty; give the output folder of a run, or leave {name} out")
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
    word_of = _words_by_setting(words)
    for name, recommended in _RECOMMENDED.items():
        if name in word_of and recommended in word_of:
            raise ConfigError(f"{word_of[recommended]}: has no effect beside {word_of[name]}; leave it out")


def _words_by_setting(words: Sequence[str]) -> dict[str, str]:
    return {name: word for word in words for name in settings_in(word)}


def check_effects_on(problem: ProblemFacts, config: Config, words: Sequence[str]) -> None:
    """Refuse words of a command line that would change nothing on a problem.

    Yaml files may set the same values, because they serve several selectors and learners.

    Args:
        problem: the facts about the problem.
        config: config of the run, with its selector.
        words: the words.

    Raises:
        ConfigError: there is such a word.
    """
    agent, has_choice = config.run.agent, _has_choice(config, problem)
    is_low_unused = agent.sharing == "per_option" and with_acting_learners(config, problem) is not config
    for name, word in _words_by_setting(words).items():
        why = None
        if name == "agent.practice" and agent.practice not in ("auto", 0):
            if not has_choice:
                why = f"{config.env} has no options to choose"
            elif config.high.name == "uniform":
                why = f"{config.high} chooses uniformly in all steps"
        elif name == "agent.sharing" and agent.sharing == "shared" and not has_choice:
            why = f"{config.env} has no options to choose"
        elif is_low_unused and name.startswith("low.") and name.split(".")[1] not in RUN_VALUES["low"]:
            why = "low.per_option names a learner for every option"
        if why is not None:
            raise ConfigError(f"{word}: has no effect, because {why}; leave it out")


def settings_without_effect(config: Config, words: Sequence[str]) -> list[str]:
    """Return a warning for each word whose setting counts only with another value of another setting, or of the mode.

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


def _component_and_setting(config: Config, name: str) -> tuple[Component | None, str]:
    """Return the component that a setting such as `low.memory_size` belongs to, if any, and its name there."""
    group, _, setting = name.partition(".")
    if setting.startswith("per_option."):
        option, _, setting = setting.removeprefix("per_option.").partition(".")
        return config.low_of.get(option), setting
    return (getattr(config, group) if group in GROUPS else None), setting


def _conditions(config: Config, name: str) -> list[str]:
    """Return what a setting needs to count but does not have, such as `low.memory_size` without `low.memory`.

    With `mode=offline`, a setting marked `OwnSteps` needs another mode, and nothing else is named.
    """
    component, setting = _component_and_setting(config, name)
    if component is None or component.model is None:
        return []
    field = component.model.model_fields.get(setting)
    marks = [] if field is None else field.metadata
    if config.run.mode == "offline" and any(isinstance(mark, OwnSteps) for mark in marks):
        return ["with mode=train"]
    return [str(mark) for mark in marks if isinstance(mark, OnlyWith) and not mark.holds(component.settings)]


def check_problem(config: Config, facts: ProblemFacts) -> None:
    """Refuse settings that do not go with the problem.

    Raises:
        ConfigError: a rule is broken; the message names the settings to change.
    """
    acting = with_acting_learners(config, facts)
    _refuse_first((rule(acting, facts) for rule in PROBLEM_RULES), config.run)


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
    return None if facts is None or options is None else facts(options)


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


def _refuse_first(complaints: Iterable[str | None], run: RunConfig) -> None:
    """Raise an error with the first complaint, if there is one."""
    complaint = next((complaint for complaint in complaints if complaint is not None), None)
    if complaint is None:
        return
    source = run.resume or run.checkpoint
    if source and re.split("[.=:]", complaint)[0] in GROUPS_OF_AGENT:
        where = "resume" if run.resume else "checkpoint"
        complaint += f". But {where}={source} gives the agent, so change other settings"
    raise ConfigError(complaint)


def _levels(config: Config) -> list[Component]:
    return [config.high, *config.learners]


def _memory(component: Component) -> str | None:
    """Return the kind of a level's memory, `stack` or `gru`; None if the level has no memory."""
    memory = component.settings.get("memory")
    return str(memory) if memory in ("stack", "gru") else None  # the setting of a bandit says which returns count


def _remembers_directions(low: Component) -> bool:
    """Return whether a learner remembers revealed directions."""
    can = low.card.remembers_directions
    return can and low.settings.get("memory") == "none" and low.settings.get("augment") is not False


def has_trips(config: Config) -> bool:
    """Return whether an episode of the problem is a session of several trips."""
    return config.env.card.has_trips


def _needs(component: Component) -> tuple[str, ...]:
    return component.card.needs


# Rules about the values of the run.


def option_length_goes_with_steps(config: Config) -> str | None:
    """Require `agent.option_length` with `agent.termination=steps`, and refuse it otherwise."""
    termination, length = config.run.agent.termination, config.run.agent.option_length
    if termination == "steps" and length is None:
        return "agent.option_length: missing; agent.termination=steps needs the number of steps of an option"
    if termination != "steps" and length is not None:
        return f"agent.option_length={length}: goes with agent.termination=steps only, not with {termination}"
    return None


def option_lengths_go_with_chosen(config: Config) -> str | None:
    """Refuse `agent.option_lengths` without `agent.termination=chosen`, and data sets with it."""
    termination, lengths = config.run.agent.termination, config.run.agent.option_lengths
    if termination != "chosen":
        if lengths is None:
            return None
        given = f"agent.option_lengths={as_json(lengths)}"
        return f"{given}: goes with agent.termination=chosen only, not with {termination}"
    if config.run.mode != "eval" and config.data.target is not None:
        return (
            f"agent.termination=chosen: the decisions of {config.data} have no lengths to learn from; use data=none or "
            "another agent.termination"
        )
    return None


def stop_score_needs_evaluations(config: Config) -> str | None:
    """Require evaluations during training if a score is to end it."""
    run = config.run
    if run.mode == "eval" or run.eval.stop_score is None or run.eval_every > 0:
        return None
    every = "offline.eval_every" if run.mode == "offline" else "eval.every"
    return f"eval.stop_score={run.eval.stop_score}: needs evaluations during training; set {every} above 0"


def callbacks_have_evaluations(config: Config) -> str | None:
    """Require evaluations during training if a callback counts them."""
    return need_of_evaluations(config, [(f"{each}:", each.card) for each in config.callbacks])


def need_of_evaluations(config: Config, callbacks: Iterable[tuple[str, CallbackCard]]) -> str | None:
    """Return which of these callbacks counts evaluations that the run does not make, or None.

    Args:
        config: config of the run.
        callbacks: the name and the card of each.
    """
    run = config.run
    if run.mode == "eval" or run.eval_every > 0:
        return None
    every = "offline.eval_every" if run.mode == "offline" else "eval.every"
    counting = [name for name, card in callbacks if card.needs_evaluations]
    return f"{counting[0]} needs evaluations during training; set {every} above 0" if counting else None


# Rules about sessions of trips.


def values_end_where_there_are_trips(config: Config) -> str | None:
    """Refuse `agent.values_end=trip` for episodes without trips; an evaluation, which learns nothing, ignores it."""
    if config.run.mode == "eval" or has_trips(config):
        return None
    agent = config.run.agent
    for setting, value, other in (
        ("values_end", agent.values_end, "session"),
        ("selector_values_end", agent.selector_values_end, "null"),
    ):
        if value == "trip":
            return f"agent.{setting}=trip: episodes of {config.env} have no trips; use agent.{setting}={other}"
    return None


def selector_values_have_a_selector(config: Config) -> str | None:
    """Refuse `agent.selector_values_end` without a selector that values what follows its choices."""
    values_end = config.run.agent.selector_values_end
    if config.run.mode == "eval" or values_end is None or "gamma" in config.high.settings:
        return None
    return f"agent.selector_values_end={values_end}: {config.high} has no values; use agent.selector_values_end=null"


def what_counts_trips_has_trips(config: Config) -> str | None:
    """Refuse what counts a session's trips for episodes without trips."""
    if has_trips(config):
        return None
    if config.high.settings.get("memory") == "session":
        return f"high.memory=session: episodes of {config.env} have no trips; use all, discounted or sliding_window"
    if config.high.settings.get("untried_first") is True:
        return f"high.untried_first=true: episodes of {config.env} have no trips; use high.untried_first=false"
    return None


def data_and_frozen_learners_have_single_trips(config: Config) -> str | None:
    """Refuse what takes an episode for a single trip: data sets, and learners that play whole episodes."""
    if not has_trips(config) or config.run.mode == "eval":
        return None
    if config.data.target is not None:
        return f"{config.data}: {config.env} has sessions of trips, which data sets do not hold; use data=none"
    if config.run.low.freeze:
        return f"low.freeze=true: plays whole episodes, but {config.env} has sessions of trips; use low.freeze=false"
    return None


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


# Rules about exploration beside the learners.


def explorations_have_steps(config: Config) -> str | None:
    """Refuse exploration in a run whose learners take no steps of their own to learn from."""
    exploration, run = config.exploration, config.run
    if exploration.target is None or run.mode == "eval":
        return None
    if run.mode == "offline":
        return f"{exploration}: mode=offline takes no steps; use exploration=none"
    if run.low.freeze:
        return f"{exploration}: low.freeze=true keeps the learners as they are, and greedy; use exploration=none"
    return None


def learners_take_the_exploration(config: Config) -> str | None:
    """Require learners that can learn from other actions than their own, or with a bonus for new states."""
    exploration = config.exploration
    if exploration.target is None:
        return None
    changes = exploration.card.changes
    for low in config.learners:
        if changes not in low.card.explores_with:
            return f"{exploration}: changes {changes}, which {low} does not take; use exploration=none or another low"
    return None


# Rules about the data that the agent learns from.


def offline_runs_have_data(config: Config) -> str | None:
    """Require a data set with `mode=offline`."""
    if config.run.mode == "offline" and config.data.target is None:
        return "mode=offline: data=none leaves nothing to learn from; choose a data set"
    return None


def levels_support_the_mode(config: Config) -> str | None:
    """Require learners and a selector that can learn from the run's own steps or data set."""
    mode, has_data = config.run.mode, config.data.target is not None
    sources = {"train": "its own steps", "offline": "data sets"}
    for low in config.learners:
        modes: tuple[str, ...] = low.card.modes
        learns = f"{low} learns from {' and '.join(sources[known] for known in modes)}"
        if mode == "train" and "train" not in modes:
            return f"mode=train: {learns} only; use mode=offline and a data set, or another low"
        if mode != "eval" and has_data and "offline" not in modes:
            return f"{config.data}: {learns} only; use data=none, or another low"
    if mode == "offline" and "offline" not in config.high.card.modes:
        return f"{config.high}: learns from its own choices only; use mode=train, or another high"
    if mode == "offline" and config.run.low.freeze:
        return "low.freeze=true: mode=offline trains the learners; use low.freeze=false"
    return None


def n_step_fits_a_batch(config: Config) -> str | None:
    """Require `low.n_step` to be at most the length of a batch."""
    n_step = max(low.settings.get("n_step", 1) for low in config.learners)
    if config.run.mode == "train" and n_step > config.run.steps_per_batch:
        return (
            f"low.n_step={n_step}: must be at most steps_per_batch={config.run.steps_per_batch}, as sums of rewards "
            "end with a batch"
        )
    return None


def compared_learners_have_values(config: Config) -> str | None:
    """Require learners with values if the selector compares them."""
    if not config.high.card.asks_learners:
        return None
    for low in config.learners:
        setting = low.card.value_setting
        if setting is not None and not low.settings[setting]:
            return f"{config.high}: {low} has no value to compare without low.{setting}=true"
        if not low.card.has_value:
            return f"{config.high}: {low} has no value to compare; use another low or another high"
    return None


def learners_ask_each_other(config: Config) -> str | None:
    """Refuse learners that bootstrap from one without a value, or compare values on different scales."""
    why_ends = _why_options_end(config)
    is_compared = config.high.card.asks_learners
    if config.run.mode == "eval" or (why_ends is None and not is_compared):
        return None
    without = [low for low in config.learners if not _has_next_value(low)]
    if why_ends is not None and 0 < len(without) < len(config.learners):
        setting = _value_setting(without[0])
        needed = "" if setting is None else f" without {setting}=true"
        has_none = f"{without[0]} has no value{needed}"
        return f"low.per_option: {why_ends} lets learners bootstrap from each other, but {has_none}"
    scales = {low.settings.get("reward_scale", 1.0): low for low in reversed(config.learners) if low not in without}
    if len(scales) > 1 and (is_compared or not _values_end_with_trips(config)):
        given, why = why_ends, "which bootstrap from each other"
        if given is None:
            given, why = str(config.high), "whose values it compares"
        (first, low), (second, other), *_ = reversed(scales.items())
        return (
            f"low.per_option: {given} needs the same reward_scale in all learners, {why}; {low} has {first}, "
            f"{other} {second}"
        )
    return None


def _why_options_end(config: Config) -> str | None:
    """Return what lets options end inside their episodes, as the beginning of a sentence; None if they do not."""
    if has_trips(config):
        return f"{config.env} has trips, and so"
    termination = config.run.agent.termination
    return None if termination == "episode" else f"agent.termination={termination}"


def _values_end_with_trips(config: Config) -> bool:
    """Return whether only trips end options, and values end with them."""
    return config.run.agent.termination == "episode" and config.run.agent.values_end == "trip"


def _value_setting(low: Component) -> str | None:
    """Return the setting that lets other learners bootstrap from this one; None if they always can, or never."""
    return low.card.value_setting or ("end_values" if "end_values" in low.settings else None)


def _has_next_value(low: Component) -> bool:
    """Return whether other learners can bootstrap from this one."""
    setting = _value_setting(low)
    return low.card.has_value and (setting is None or low.settings[setting])


# Rules about what the levels remember.


def memories_have_own_steps(config: Config) -> str | None:
    """Refuse data sets for a level with a memory, whose states only a policy that acts can store."""
    if config.run.mode == "eval" or config.data.target is None:
        return None
    for level in _levels(config):
        if _memory(level) is not None:
            return f"{level.group}.memory={_memory(level)}: {config.data} lacks what a policy remembered; use data=none"
    return None


def selectors_remember_several_decisions(config: Config) -> str | None:
    """Refuse a selector with a memory if its episodes have a single decision."""
    memory = _memory(config.high)
    if memory is None or config.run.agent.termination != "episode" or has_trips(config):
        return None
    return (
        f"high.memory={memory}: agent.termination=episode has one decision in an episode, and nothing to remember; use "
        "agent.termination=steps, chosen or learned"
    )


def learners_have_the_same_memory(config: Config) -> str | None:
    """Refuse learners that value each other's states by different memories."""
    given = _why_options_end(config)
    settings = "memory", "memory_size", "stack_steps"
    memories = {tuple(each.settings[name] for name in settings if _memory(each)) for each in config.learners}
    if given is not None and len(memories) > 1:
        without = [str(each) for each in config.learners if not _memory(each)]
        return (
            f"low.per_option: {given} needs the same memory, memory_size and stack_steps "
            "in all learners, which value each other's states" + (f"; {without[0]} has no memory" if without else "")
        )
    return None


def learners_write_the_same_sizes(config: Config) -> str | None:
    """Refuse learners whose policies would write the same entry of a step in different sizes."""
    for name in dict.fromkeys(name for low in config.learners for name in low.card.step_sizes):
        values = list(dict.fromkeys(low.settings[name] for low in config.learners if name in low.settings))
        if len(values) > 1:
            given = " and ".join("null" if value is None else str(value) for value in values)
            return f"low.per_option: {name} must be the same in all learners, as steps hold one size, but is {given}"
    return None


# Rules about the collector.


def collector_fits_the_run(config: Config) -> str | None:
    """Require the collector's package, a mode with steps, equal parts for workers, and a current policy if needed."""
    collector, run = config.collector, config.run
    if run.mode == "eval":  # which collects nothing
        return None
    if run.mode == "offline" and collector.card.has_workers:
        return f"{collector}: mode=offline takes no steps; use collector=single"
    package: str | None = collector.card.package
    if package is not None and importlib.util.find_spec(package) is None:
        return f"{collector}: {package} is not installed; pip install hpamdp[{package}]"
    num_workers = collector.settings.get("num_workers", 1)
    if run.num_envs % num_workers:
        return (
            f"collector.num_workers={num_workers}: must divide num_envs={run.num_envs}, of which each worker "
            "gets an equal part"
        )
    if collector.settings.get("ahead", False):
        for low in config.learners:
            if low.card.needs_current_policy:
                return (
                    f"collector.ahead=true: {low} learns from steps of its current policy alone, and batches ahead are "
                    "of the one before; use collector.ahead=false"
                )
    return None


def workers_get_what_python_passed(config: Config) -> str | None:
    """Require that objects and classes from Python code can be sent to a collector's workers."""
    if config.run.mode == "eval" or not config.collector.card.has_workers:
        return None
    parts = (config.env, config.high, *config.learners)
    passed: dict[str, object] = {str(part): part.cls for part in parts if is_passed(part.target)}
    if config.env.objects:
        passed["env"] = config.env.objects
    for what, value in passed.items():
        why = why_unsendable(value)
        if why is not None:
            return (
                f"{what}: cannot be sent to the workers of {config.collector} ({why}); create what it refers to in its "
                "constructor or function, or use collector=single"
            )
    return None


def workers_fit_the_problem(config: Config, problem: ProblemFacts) -> str | None:
    """Refuse workers for environments that start processes, and batches ahead if a scale is learned between them."""
    settings = config.collector.settings
    if config.run.mode == "eval" or not config.collector.card.has_workers:
        return None
    if not problem.is_shardable:
        return f"{config.collector}: {config.env} starts processes itself; use collector=single"
    if problem.has_statistics and settings.get("ahead", False):
        return (
            f"collector.ahead=true: {config.env} learns the scale of its observations or rewards, which workers share "
            "between batches; use collector.ahead=false"
        )
    return None


# Rules about the problem and its options.


def problem_provides_needs(config: Config) -> str | None:
    """Require a problem with a planner or human data if a level needs one."""
    for level in _levels(config):
        for need in _needs(level):
            lack = lack_of(need, config)
            if lack is not None:
                return f"{level}: {lack}"
    return None


def lack_of(need: str, config: Config) -> str | None:
    """Return why the problem does not provide what a level needs, such as `oracle`; None if it does."""
    facts, fact = facts_of(config), f"has_{need}"
    if hasattr(facts, fact):
        is_provided = getattr(facts, fact)
    else:
        assert config.env.cls is not None
        is_provided = need in constructor_arguments(config.env.cls)
    if is_provided:
        return None
    lacks = {"oracle": "has no planner to ask", "human": "has no human data"}
    return f"{config.env} {lacks.get(need, f'takes no argument {need}')}"


def grouping_fits_levels(config: Config, problem: ProblemFacts) -> str | None:
    """Refuse `env.grouping` with levels that need the problem's own options."""
    if config.run.env.grouping is None:
        return None
    if config.run.env.grouping == "default" and not problem.default_options:
        return f"env.grouping=default: {config.env} suggests none; name the actions of each option"
    for level in _levels(config):
        if _needs(level):
            return f"env.grouping: {level} knows nothing of them; use another {level.group}"
    return None


def levels_take_pictures(config: Config, problem: ProblemFacts) -> str | None:
    """Refuse pictures with a level that cannot encode them: they are flattened only if the user asks for it."""
    if config.encoder.card.flattens or not problem.has_pictures:
        return None
    for level in _levels(config):
        if level.target is not None and not level.card.takes_pictures:
            return (
                f"{level}: {config.env} observes pictures, which it has no encoder for; use another {level.group}, or "
                "encoder=mlp to flatten them"
            )
    return None


def data_sets_have_no_pictures(config: Config, problem: ProblemFacts) -> str | None:
    """Refuse data sets with pictures: their observations are vectors."""
    if config.data.target is None or not problem.has_pictures or config.encoder.card.flattens:
        return None
    return f"{config.data}: {config.env} observes pictures, which data sets do not hold; use data=none"


def encoder_has_pictures(config: Config, problem: ProblemFacts) -> str | None:
    """Refuse an encoder of pictures, or its settings, if the problem has none."""
    encoder = config.encoder
    if problem.has_pictures or encoder.card.flattens:
        return None
    if encoder.name != AUTO_ENCODER:
        return f"{encoder}: {config.env} observes no pictures; use encoder={AUTO_ENCODER}"
    model = encoder.options
    for name, value in encoder.settings.items():
        if model is not None and value != type(model).model_fields[name].default:
            return f"encoder.{name}={as_json(value)}: {config.env} observes no pictures; leave it out"
    return None


def selector_fits_the_choice(config: Config, problem: ProblemFacts) -> str | None:
    """Require a selector if the agent chooses options, and refuse one otherwise."""
    has_selector, has_choice = config.high.target is not None, _has_choice(config, problem)
    if has_selector and not has_choice:
        if not problem.option_names:
            return f"{config.high}: {config.env} has no options to choose; use high=none"
        choice = config.env.card.choice_setting
        return f"{config.high}: {config.env} leaves nothing to choose; use high=none or {choice}"
    if not has_selector and has_choice:
        without = config.env.card.no_choice_setting
        without = f" or {without}" if without else ""
        return f"high=none: {config.env} needs a selector; use another high{without}"
    if config.run.low.freeze and not has_choice:
        return "low.freeze=true: there is no choice left to learn; use low.freeze=false"
    return None


def plans_fit_the_termination(config: Config, problem: ProblemFacts) -> str | None:
    """Refuse plans that change options if an option lasts for its episode."""
    if config.run.agent.termination != "episode" or not problem.plans_change_options:
        return None
    for low in config.learners:
        if "oracle" in _needs(low):
            return (
                f"{low}: its plans on {config.env} change options, but agent.termination=episode keeps them; use "
                "agent.termination=steps agent.option_length=1"
            )
    return None


def options_end_where_they_may(config: Config, problem: ProblemFacts) -> str | None:
    """Refuse options that end inside their episodes if the problem, the selector or the run does not support that."""
    termination, high = config.run.agent.termination, config.high
    if termination == "episode":
        return None
    given, has_choice = f"agent.termination={termination}", _has_choice(config, problem)
    if not (has_choice and problem.can_change_option):
        why = "keeps an option for an episode" if has_choice else "has no options"
        change = config.env.card.change_setting
        change = f" or {change}" if has_choice and change else ""
        return f"{given}: {config.env} {why}; use agent.termination=episode{change}"
    if config.run.low.freeze:
        return f"{given}: low.freeze=true plays whole episodes; use agent.termination=episode"
    if high.card.is_bandit:
        return (
            f"{given}: {high} is a bandit, which counts what an option returns and nothing of what follows it; use "
            "agent.termination=episode, high=meta_critic or high=actor"
        )
    if termination == "learned" and not high.card.ends_options:
        return (
            f"{given}: {high} does not decide where options end; use high=option_critic, high=meta_critic or "
            "agent.termination=steps"
        )
    return None


def selector_chooses_lengths(config: Config, problem: ProblemFacts) -> str | None:
    """Require a selector that can choose lengths with `agent.termination=chosen`."""
    if config.run.agent.termination != "chosen":
        return None
    why: str | None = config.high.card.lengths_refusal
    if config.high.card.asks_learners:
        why = "compares the learners' values, which do not depend on an option's length"
    elif _needs(config.high):
        why = "chooses as the environment's entries say, which have no lengths"
    others = "use high=meta_critic, high=actor or another agent.termination"
    return None if why is None else f"agent.termination=chosen: {config.high} {why}; {others}"


def per_option_names_options(config: Config, problem: ProblemFacts) -> str | None:
    """Require existing options with separate learners in `low.per_option`."""
    names = _option_names(config, problem) if _has_choice(config, problem) else ()
    unknown = [name for name in config.low_of if name not in names]
    if unknown:
        known = ", ".join(names) or "none to choose"
        return f"low.per_option: {config.env} has no option {unknown[0]}; it has {known}"
    if config.low_of and config.run.agent.sharing == "shared":
        return "low.per_option: agent.sharing=shared has one learner for all; use agent.sharing=per_option"
    return None


def _has_choice(config: Config, problem: ProblemFacts) -> bool:
    return problem.has_choice or config.run.env.grouping is not None


def _option_names(config: Config, problem: ProblemFacts) -> tuple[str, ...]:
    grouping = config.run.env.grouping
    if grouping is None:
        return problem.option_names
    return tuple(problem.default_options if grouping == "default" else grouping)


RULES: tuple[Rule, ...] = (
    option_length_goes_with_steps,
    option_lengths_go_with_chosen,
    stop_score_needs_evaluations,
    callbacks_have_evaluations,
    values_end_where_there_are_trips,
    selector_values_have_a_selector,
    what_counts_trips_has_trips,
    data_and_frozen_learners_have_single_trips,
    explorations_have_steps,
    learners_take_the_exploration,
    offline_runs_have_data,
    levels_support_the_mode,
    n_step_fits_a_batch,
    memories_have_own_steps,
    selectors_remember_several_decisions,
    learners_have_the_same_memory,
    learners_write_the_same_sizes,
    compared_learners_have_values,
    learners_ask_each_other,
    collector_fits_the_run,
    workers_get_what_python_passed,
    problem_provides_needs,
)
PROBLEM_RULES: tuple[ProblemRule, ...] = (
    grouping_fits_levels,
    selector_fits_the_choice,
    plans_fit_the_termination,
    options_end_where_they_may,
    selector_chooses_lengths,
    per_option_names_options,
    workers_fit_the_problem,
    levels_take_pictures,
    data_sets_have_no_pictures,
    encoder_has_pictures,
)
