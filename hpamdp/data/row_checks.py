"""Check the values of a data set before anything learns from them; the error names the first wrong row.

`check_transitions` and `check_decisions` need no environment. They check the form, and that numbers are finite and
flags agree. `check_actions` and `check_options` compare the rows with the environment at hand.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from hpamdp import keys
from hpamdp.data import DataError
from hpamdp.specs import PAMDPSpecs

TRAJECTORY = ("collector", "traj_ids")  # the number of a row's episode, where TorchRL's collectors write it
DURATION = ("next", keys.DURATION)
PERSON = "person"  # who acted

_Key = str | tuple[str, ...]
_Form = tuple[torch.dtype, tuple[int | str, ...]]
_FLOAT, _INT, _BOOL = torch.float32, torch.int64, torch.bool
# The type of each entry, and its sizes beside the number of rows: numbers, or names of sizes of `PAMDPSpecs`.
_TRANSITIONS: dict[_Key, _Form] = {
    TRAJECTORY: (_INT, ()),
    keys.OBSERVATION: (_FLOAT, ("observation_dim",)),
    keys.DISCRETE: (_INT, ()),
    keys.PARAMETERS: (_FLOAT, ("num_parameters",)),
    keys.IS_DECISION: (_BOOL, (1,)),
    ("next", keys.OBSERVATION): (_FLOAT, ("observation_dim",)),
    ("next", keys.REWARD): (_FLOAT, (1,)),
    ("next", keys.DONE): (_BOOL, (1,)),
    ("next", keys.TERMINATED): (_BOOL, (1,)),
    ("next", keys.TRUNCATED): (_BOOL, (1,)),
    ("next", keys.IS_DECISION): (_BOOL, (1,)),
}
_DECISIONS: dict[_Key, _Form] = {
    keys.OPTION: (_INT, ()),
    ("next", keys.DECISION_OBSERVATION): (_FLOAT, ("observation_dim",)),
    ("next", keys.OPTION_RETURN): (_FLOAT, (1,)),
    ("next", keys.OPTION_STEPS): (_INT, (1,)),
    ("next", keys.OBSERVATION): (_FLOAT, ("observation_dim",)),
    ("next", keys.DONE): (_BOOL, (1,)),
    ("next", keys.IS_DECISION): (_BOOL, (1,)),
}
_OPTIONAL: dict[_Key, _Form] = {
    PERSON: (_INT, ()),
    keys.OPTION: (_INT, ()),
    keys.ACTION_MASK: (_BOOL, ("num_discrete",)),
    ("next", keys.ACTION_MASK): (_BOOL, ("num_discrete",)),
    keys.OPTION_MASK: (_BOOL, ("num_options",)),
    ("next", keys.OPTION_MASK): (_BOOL, ("num_options",)),
    keys.PAIR_MASK: (_BOOL, ("num_discrete", "num_discrete")),
    keys.PARAMETER_LOW: (_FLOAT, ("num_parameters",)),
    keys.PARAMETER_HIGH: (_FLOAT, ("num_parameters",)),
    DURATION: (_FLOAT, (1,)),
}
_OBSERVATIONS: tuple[_Key, ...] = (
    keys.OBSERVATION,
    ("next", keys.OBSERVATION),
    ("next", keys.DECISION_OBSERVATION),
)


class _Rule(NamedTuple):
    """A rule for an entry of every row.

    Attributes:
        entry: the entry's name.
        holds: whether each number of the entry keeps the rule, bool, of the entry's shape or `[N]`.
        allowed: the allowed values in words; for entries of several numbers, possibly one text each.
    """

    entry: _Key
    holds: Tensor
    allowed: str | Sequence[str]


def check_transitions(rows: TensorDict) -> None:
    """Check transitions `[N]` without an environment; `Demonstrations` has the contract.

    Raises:
        DataError: an entry is missing or has another shape or type, or a row breaks a rule.
    """
    what = "the transitions"
    _check_form(what, rows, _TRANSITIONS)
    episode = rows[TRAJECTORY]
    if (episode.diff() < 0).any():
        raise DataError(f"{what}' episode numbers ({_dotted(TRAJECTORY)}) must be in ascending order")
    _check_rules(what, rows, _transition_rules(rows))


def check_returns(rows: TensorDict) -> None:
    """Check that each episode's return is finite, given transitions `[N]`.

    Raises:
        DataError: a sum is too large.
    """
    _check_rules("the transitions", rows, _finite(rows, ("next", keys.OPTION_RETURN)))


def check_decisions(rows: TensorDict) -> None:
    """Check decisions `[K]` without an environment; `Demonstrations` has the contract.

    Raises:
        DataError: an entry is missing or has another shape or type, or a row breaks a rule.
    """
    _check_form("the decisions", rows, _DECISIONS)
    _check_rules("the decisions", rows, _decision_rules(rows))


def check_actions(rows: TensorDictBase, specs: PAMDPSpecs) -> None:
    """Check that transitions `[N]`, which `check_transitions` accepted, fit an environment.

    Raises:
        DataError: the observation or the parameters have another length, or the environment lacks or forbids a row's
            action or option.
    """
    what = "the transitions"
    needed = [keys.PAIR_MASK] * specs.has_pair_mask
    needed += [keys.PARAMETER_LOW, keys.PARAMETER_HIGH] * specs.has_parameter_bounds
    for name in needed:
        if name not in rows.keys():
            raise DataError(f"{what} lack {name}, which the environment gives with every state")
    _check_sizes(what, rows, specs)
    _check_rules(what, rows, _action_rules(rows, specs))
    if specs.num_options:
        check_options(what, rows, specs)


def check_options(what: str, rows: TensorDictBase, specs: PAMDPSpecs) -> None:
    """Check that the options of rows `[N]`, whose form and numbers are already checked, fit an environment.

    Raises:
        DataError: an observation has another length, there are no options, or a row has an option that does not exist.
    """
    if keys.OPTION not in rows.keys():
        names = ", ".join(specs.option_names)
        raise DataError(f"{what} lack {keys.OPTION}, which the agent chooses here, of {names}")
    _check_sizes(what, rows, specs)
    _check_rules(what, rows, _option_rules(rows, specs))


def check_observations(what: str, rows: TensorDictBase, low: Sequence[float], high: Sequence[float]) -> None:
    """Check that rows `[N]`, whose form is already checked, hold observations as the agent sees them.

    Args:
        what: name of the rows in the error.
        rows: the rows.
        low, high: bounds of these observations, `[observation_dim]`.

    Raises:
        DataError: a number is outside its bounds.
    """
    slack = 1e-4  # for rounding
    cure = "as the agent sees it; with env=gymnasium, env.scaled_rows(rows) scales the space's numbers"
    allowed = [f"{least:.6g} to {most:.6g}, {cure}" for least, most in zip(low, high, strict=True)]
    present = set(rows.keys(True, True))
    for name in [name for name in _OBSERVATIONS if name in present]:
        value = rows.get(name)
        is_inside = (value >= value.new_tensor(low) - slack) & (value <= value.new_tensor(high) + slack)
        _check_rules(what, rows, iter([_Rule(name, is_inside, allowed)]))


def missing_masks(rows: TensorDictBase, specs: PAMDPSpecs) -> list[str]:
    """Return the names of masks that the environment gives and the transitions `[N]` lack."""
    given = {keys.ACTION_MASK: specs.has_action_mask, keys.OPTION_MASK: specs.has_option_mask}
    names: list[_Key] = [name for mask, is_given in given.items() if is_given for name in (mask, ("next", mask))]
    present = rows.keys(True, True)
    return [_dotted(name) for name in names if name not in present]


def _check_form(what: str, rows: TensorDict, required: dict[_Key, _Form]) -> None:
    """Check the names, shapes and types of the entries."""
    if not isinstance(rows, TensorDictBase):
        raise DataError(f"{what} are of class {type(rows).__name__}, but must be a TensorDict")
    if rows.ndim != 1 or not len(rows):
        raise DataError(f"{what} have shape {list(rows.shape)}, but must be [N], of at least one row")
    present = set(rows.keys(True, True))
    missing = [name for name in required if name not in present]
    if missing:
        raise DataError(f"{what} lack {', '.join(map(_dotted, missing))}")
    optional = {name: form for name, form in _OPTIONAL.items() if name in present}
    for name, (dtype, expected) in {**optional, **required}.items():
        value = rows.get(name)
        if not isinstance(value, Tensor) or value.layout != torch.strided:
            raise DataError(f"{what}' {_dotted(name)} is of class {type(value).__name__}, but must be a tensor")
        shape = tuple(value.shape[1:])
        if name == keys.DISCRETE and len(shape) == 1:  # an action of several components
            expected = ("num_components",)
        pairs = zip(expected, shape, strict=True)
        fits = len(shape) == len(expected) and all(isinstance(size, str) or size == own for size, own in pairs)
        if value.dtype != dtype or not fits:
            wanted = ", ".join(["N", *("D" if isinstance(size, str) else str(size) for size in expected)])
            found = ", ".join(["N", *map(str, shape)])
            raise DataError(
                f"{what}' {_dotted(name)} is {_named(value.dtype)} [{found}], but must be {_named(dtype)} [{wanted}]"
            )


def _check_sizes(what: str, rows: TensorDictBase, specs: PAMDPSpecs) -> None:
    """Check that the entries, whose form is already checked, have the sizes of an environment."""
    present = set(rows.keys(True, True))
    for name, (_, form) in {**_TRANSITIONS, **_DECISIONS, **_OPTIONAL}.items():
        expected = [getattr(specs, size) if isinstance(size, str) else size for size in form]
        expected = list(specs.components.shape) if name == keys.DISCRETE else expected
        if name in present and list(found := rows.get(name).shape[1:]) != expected:
            if "num_options" in form and not specs.num_options:  # nobody reads it
                continue
            raise DataError(f"{what}' {_dotted(name)} is {list(found)} a row, but the environment's is {expected}")


def _check_rules(what: str, rows: TensorDictBase, rules: Iterator[_Rule]) -> None:
    for rule in rules:
        if not rule.holds.all():
            row, *place = (~rule.holds).nonzero()[0].tolist()
            value = rows.get(rule.entry)[row]
            allowed = rule.allowed if isinstance(rule.allowed, str) else rule.allowed[place[0]]
            index = ""
            if value.numel() > 1:
                value, index = value[place[0]], f"[{place[0]}]"
            entry = f"{_dotted(rule.entry)}{index}"
            raise DataError(f"{what}, row {row}: {entry} is {_shown(value.item())}, but must be {allowed}")


def _shown(value: float) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value).lower()


def _transition_rules(rows: TensorDict) -> Iterator[_Rule]:
    yield from _finite(rows, keys.OBSERVATION, keys.PARAMETERS, ("next", keys.OBSERVATION), ("next", keys.REWARD))
    if DURATION in rows.keys(True, True):
        duration = rows[DURATION]
        yield _Rule(DURATION, duration.isfinite() & (duration >= 0.0), "finite and at least 0")
    episode = rows[TRAJECTORY]
    changes = episode[1:] != episode[:-1]
    edge = changes.new_ones(1)
    is_first, is_last = torch.cat([edge, changes]).unsqueeze(-1), torch.cat([changes, edge]).unsqueeze(-1)
    done, terminated, truncated = (rows["next", name] for name in (keys.DONE, keys.TERMINATED, keys.TRUNCATED))
    yield _Rule(
        ("next", keys.DONE),
        done == (terminated | truncated),
        f"true if the row is {keys.TERMINATED} or {keys.TRUNCATED}, and only then",
    )
    yield _Rule(("next", keys.DONE), done == is_last, "true in the last row of an episode, and only there")
    yield _Rule(keys.IS_DECISION, rows[keys.IS_DECISION] == is_first, "true in an episode's first row, and only there")
    yield _Rule(("next", keys.IS_DECISION), rows["next", keys.IS_DECISION] == done, "the same as next.done")
    if keys.OPTION in rows.keys():
        option = rows[keys.OPTION]
        is_kept = torch.cat([edge, (option[1:] == option[:-1]) | changes])
        yield _Rule(keys.OPTION, is_kept, "the same as in the row before, of the same episode")


def _decision_rules(rows: TensorDict) -> Iterator[_Rule]:
    yield from _finite(rows, *(("next", name) for name in (keys.DECISION_OBSERVATION, keys.OBSERVATION)))
    yield from _finite(rows, ("next", keys.OPTION_RETURN))
    yield _Rule(("next", keys.OPTION_STEPS), rows["next", keys.OPTION_STEPS] >= 1, "at least 1")
    yield _Rule(("next", keys.IS_DECISION), rows["next", keys.IS_DECISION], "true")


def _finite(rows: TensorDict, *names: _Key) -> Iterator[_Rule]:
    for name in names:
        yield _Rule(name, rows.get(name).isfinite(), "finite")


def _action_rules(rows: TensorDictBase, specs: PAMDPSpecs) -> Iterator[_Rule]:
    discrete = rows.get(keys.DISCRETE)
    components = specs.components
    if components.is_single:
        yield _Rule(keys.DISCRETE, _is_below(discrete, specs.num_discrete), f"0 to {specs.num_discrete - 1}")
    else:
        ranges = [f"0 to {size - 1}" for size in components.sizes]
        yield _Rule(keys.DISCRETE, (discrete >= 0) & (discrete < discrete.new_tensor(components.sizes)), ranges)
    parameters = rows.get(keys.PARAMETERS)
    low, high = parameters.new_tensor(specs.parameter_low), parameters.new_tensor(specs.parameter_high)
    is_own = components.is_chosen(discrete).index_select(-1, specs.parameter_owner.to(discrete.device))
    slack = 1e-5 * (high - low)  # for rounding
    is_inside = (parameters >= low - slack) & (parameters <= high + slack)
    bounds = [f"{low:.6g} to {high:.6g}" for low, high in zip(specs.parameter_low, specs.parameter_high, strict=True)]
    yield _Rule(keys.PARAMETERS, is_inside | ~is_own, bounds)
    # Other actions' parameters do not count, so recordings fill them with zeros.
    is_filled = is_inside | is_own | (parameters == 0.0)
    yield _Rule(keys.PARAMETERS, is_filled, [f"{each}, or 0 as it is another action's" for each in bounds])
    if specs.has_integers:
        is_whole = (parameters - parameters.round()).abs() <= 1e-5
        is_float = ~torch.tensor(specs.integer_parameters, device=parameters.device)
        yield _Rule(keys.PARAMETERS, is_whole | is_float | ~is_own, "a whole number")
    if specs.has_parameter_bounds:
        state_low, state_high = rows.get(keys.PARAMETER_LOW), rows.get(keys.PARAMETER_HIGH)
        is_inside = (parameters >= state_low - slack) & (parameters <= state_high + slack)
        yield _Rule(
            keys.PARAMETERS, is_inside | ~is_own, f"within the row's {keys.PARAMETER_LOW} and {keys.PARAMETER_HIGH}"
        )
    if specs.has_pair_mask:
        may_follow = components.may_follow(discrete, rows.get(keys.PAIR_MASK))
        yield _Rule(keys.DISCRETE, may_follow, f"allowed by the row's {keys.PAIR_MASK}")
    if specs.has_action_mask and keys.ACTION_MASK in rows.keys():
        allowed = components.of_choice(rows.get(keys.ACTION_MASK), discrete)
        allowed = allowed.unsqueeze(-1) if components.is_single else allowed
        yield _Rule(keys.DISCRETE, allowed, f"allowed by the row's {keys.ACTION_MASK}")
    if specs.has_action_mask and ("next", keys.ACTION_MASK) in rows.keys(True, True):
        mask = rows.get(("next", keys.ACTION_MASK))
        has_one = components.any_of_each(mask).unsqueeze(-1) | rows.get(("next", keys.DONE))
        yield _Rule(("next", keys.ACTION_MASK), has_one.expand_as(mask), "true for at least one action")


def _option_rules(rows: TensorDictBase, specs: PAMDPSpecs) -> Iterator[_Rule]:
    option = rows.get(keys.OPTION)
    yield _Rule(keys.OPTION, _is_below(option, specs.num_options), f"0 to {specs.num_options - 1}")
    if specs.option_actions is not None and keys.DISCRETE in rows.keys(True, True):
        of_options = torch.tensor(specs.option_actions, device=option.device)
        allowed = of_options[option].gather(-1, specs.components.places(rows.get(keys.DISCRETE)))
        yield _Rule(keys.DISCRETE, allowed, "an action of the row's option")
    if specs.has_option_mask and keys.OPTION_MASK in rows.keys():
        is_allowed = rows.get(keys.OPTION_MASK).gather(-1, option.unsqueeze(-1))
        is_decision = rows.get(keys.IS_DECISION, torch.ones_like(is_allowed))
        yield _Rule(keys.OPTION, is_allowed | ~is_decision, f"allowed by the row's {keys.OPTION_MASK}")


def _is_below(numbers: Tensor, count: int) -> Tensor:
    return (numbers >= 0) & (numbers < count)


def _named(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _dotted(name: str | Sequence[str]) -> str:
    return name if isinstance(name, str) else ".".join(name)
