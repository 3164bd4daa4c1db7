"""The ceiling: for each boat, the plan of up to three presses that docks with the most fuel left, without noise.

The distance grows with the cube of the pressing time, so the seconds are concave in the lengths of the legs. Three
facts follow:
- The last press is the shortest one that reaches the dock. Its glide ends on the dock circle.
- Consecutive presses use different keys. One long leg takes fewer seconds than the same course in two legs.
- Detours are expensive, so the best plan has as few legs as harbour and dock allow: mostly two, and never four.

This leaves two numbers to search for: the lengths of the first two of three legs. A leg of length 0 is no press, so the
same search covers plans of one and two presses. A coarse grid over every sequence of keys finds the local minima.
Shrinking grids around the best of them find the optimum.

Because of the concavity, most optima of three presses lie on the border of the feasible region: a leg ends just short
of harbour or dock. So the grid includes the borders and is denser there.

The same search serves other controllers, and agents that may change the controller before a press for some fuel. It
then covers the sequences of controllers and keys, and adds the costs of the changes. It also serves boats whose presses
go another distance, and presses of at least some seconds (`plan_with_directions`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from hpamdp.env.boatdock.harbour import (
    CONGRUENT,
    CONTROLLERS,
    INCONGRUENT,
    NUM_KEYS,
    Layout,
    direction,
    fuel_fraction,
    score_of,
)
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.physics import (
    DOCK_RADIUS,
    HARBOUR_RADIUS,
    TANK,
    distance_to_dock,
    distance_to_harbour,
    press_for,
    total_distance,
)
from hpamdp.env.boatdock.task import CONTROLLER_DEGREES, NOT_CHOSEN, Boats, BoatState
from hpamdp.env.kernels import sources
from hpamdp.files import kept_in_cache

MAX_PRESSES = 3

# Margins (px) that keep rounding from changing an outcome when a plan is replayed. Rounding moves a boat by about 1e-5
# px. On a course that nearly misses the dock, it moves the point of contact by 50 times as much.
_CLEARANCE = 0.01  # of all legs from harbour circle and dock, and of the last course from missing the dock
_OVERSHOOT = 0.002  # by which the last press reaches into the dock

# Sequences of three keys without equal neighbours. Repeating a key is never needed: no leg inside the harbour takes
# MAX_DURATION.
_SEQUENCES = [
    (first, second, last)
    for first in range(NUM_KEYS)
    for second in range(NUM_KEYS)
    for last in range(NUM_KEYS)
    if first != second and second != last
]

_GRID = 17  # points along each side of the coarse grid
_MINIMA = 2  # local minima that are refined, for each sequence of keys
_ZOOM_GRID = 5  # points along each side of the shrinking grids
_ZOOM_ROUNDS = 14
_ZOOM = 0.6  # factor by which they shrink each round
_CHUNK = 64  # number of boats searched together, which bounds the memory and fits the cache
_ROUGH_GRID = (3, 5)  # points along the sides of the only grid of a rough search
_ROUGH_CHUNK = 512
_KEPT_BOATS = 100  # whose best scores take longer to compute than to read


class Plan(NamedTuple):
    """The best plan of each boat."""

    keys: Tensor  # [*B, 3] int64, 0 past the plan's end
    durations: Tensor  # [*B, 3] float32, seconds, 0 past the plan's end
    num_presses: Tensor  # [*B] int64, 0 if no plan docks
    score: Tensor  # [*B] float32, 5 x the fuel left (fraction of a tank) after docking, -1 if no plan docks


class _Course(NamedTuple):
    """A boat at rest, its dock (px) and the unit directions of three legs. All fields have the same shape.

    `scale` is the distance of a press as a multiple of the distance with people's boats, and `shortest_press` the
    seconds of the shortest press.
    """

    x: Tensor
    y: Tensor
    goal_x: Tensor
    goal_y: Tensor
    first_x: Tensor
    first_y: Tensor
    second_x: Tensor
    second_y: Tensor
    last_x: Tensor
    last_y: Tensor
    scale: Tensor
    shortest_press: Tensor


def _reach(x: Tensor, y: Tensor, goal_x: Tensor, goal_y: Tensor, dir_x: Tensor, dir_y: Tensor) -> Tensor:
    """Return the length (px) of the longest leg that ends at rest inside the harbour and short of the dock."""
    to_dock = distance_to_dock(x, y, goal_x, goal_y, dir_x, dir_y)
    return (torch.minimum(to_dock, distance_to_harbour(x, y, dir_x, dir_y)) - _CLEARANCE).clamp(min=0.0)


def _leg_seconds(length: Tensor, scale: Tensor) -> Tensor:
    return torch.where(length > 0.0, press_for(length / scale), 0.0)


def _durations(course: _Course, first: Tensor, second: Tensor, max_presses: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the seconds of the three presses of a course. If the course does not dock, the last is `inf`.

    Args:
        course: courses whose fields broadcast against `first` and `second`.
        first: length of the first leg as a fraction of its reach.
        second: place of the second leg's length in the interval of lengths from which the last leg meets the dock, in
            [0, 1].
        max_presses: largest number of presses. If 2, the first leg has length 0. If 1, also the second. With a shortest
            press above 0, no other leg has length 0, so this is the number of presses.
    """
    goal_x = course.goal_x
    goal_y = course.goal_y
    no_leg = torch.zeros_like(course.x)
    shortest_leg = course.scale * total_distance(course.shortest_press)
    if max_presses > 2:
        first_shortest = shortest_leg
        first_reach = _reach(course.x, course.y, goal_x, goal_y, course.first_x, course.first_y)
    else:
        first_shortest = first_reach = no_leg
    first_length = first_shortest + first * (first_reach - first_shortest)
    x = course.x + first_length * course.first_x
    y = course.y + first_length * course.first_y

    # The distance of the dock from the line of the last leg is linear in the length of the second leg.
    aside = (goal_x - x) * course.last_y - (goal_y - y) * course.last_x
    slope = course.second_x * course.last_y - course.second_y * course.last_x
    middle = aside / slope
    half_width = (DOCK_RADIUS - _CLEARANCE) / slope.abs()
    if max_presses > 1:
        second_shortest = shortest_leg
        second_reach = _reach(x, y, goal_x, goal_y, course.second_x, course.second_y)
    else:
        second_shortest = no_leg
        second_reach = torch.zeros_like(x)
    # Skip legs shorter than half the clearance: they would only correct rounding, and take some hundredths of a second.
    shortest = torch.where(middle - half_width > 0.5 * _CLEARANCE, middle - half_width, 0.0)
    shortest = torch.maximum(shortest, second_shortest)
    longest = torch.minimum(middle + half_width, second_reach)
    second_length = shortest + second * (longest - shortest)
    x = x + second_length * course.second_x
    y = y + second_length * course.second_y

    last_length = distance_to_dock(x, y, goal_x, goal_y, course.last_x, course.last_y)
    # The harbour is convex, so the boat docks before it leaves if and only if the point of contact lies inside.
    contact_x = x + last_length * course.last_x
    contact_y = y + last_length * course.last_y
    is_inside = contact_x.square() + contact_y.square() <= (HARBOUR_RADIUS - _CLEARANCE) ** 2
    # A last leg shorter than that of the shortest press ends at the dock while the boat still moves, slowly.
    to_rest = press_for((last_length + _OVERSHOOT) / course.scale)
    is_feasible = (first_shortest <= first_reach) & (shortest <= longest) & is_inside
    last_seconds = torch.where(is_feasible, torch.maximum(to_rest, course.shortest_press), torch.inf)
    return _leg_seconds(first_length, course.scale), _leg_seconds(second_length, course.scale), last_seconds


def _total_seconds(course: _Course, first: Tensor, second: Tensor, max_presses: int) -> Tensor:
    """Return the sum of `_durations`."""
    first_seconds, second_seconds, last_seconds = _durations(course, first, second, max_presses)
    return first_seconds + second_seconds + last_seconds


def _dense_at_the_ends(num: int, device: torch.device) -> Tensor:
    """Return `num` fractions in [0, 1]."""
    return torch.linspace(0.0, 0.5 * math.pi, num, device=device, dtype=torch.float32).sin().square()


def _local_minima(course: _Course, max_presses: int) -> tuple[Tensor, Tensor, Tensor]:
    """Find the local minima of the coarse grid.

    Args:
        course: courses with fields `[N, S]`, one column for each of the S sequences of keys.
        max_presses: as for `_durations`.

    Returns:
        The index of the sequence and the two fractions of each boat's best minima, `[N, S * _MINIMA]` each.
    """
    fractions = _dense_at_the_ends(_GRID, course.x.device)
    # Without a first leg, one row of the grid is enough.
    first, second = torch.meshgrid(fractions if max_presses > 2 else fractions[:1], fractions, indexing="ij")
    grid = _Course(*(field[..., None, None] for field in course))
    seconds = _total_seconds(grid, first, second, max_presses).expand(*course.x.shape, *first.shape)
    lowest_nearby = -max_pool2d(-seconds, kernel_size=3, stride=1, padding=1)
    minima = torch.where(seconds <= lowest_nearby, seconds, torch.inf).flatten(2)
    cell = minima.topk(_MINIMA, largest=False).indices.flatten(1)
    sequence = torch.arange(course.x.shape[1], device=cell.device).repeat_interleave(_MINIMA).expand(cell.shape)
    return sequence, first.flatten()[cell], second.flatten()[cell]


def _zoom(course: _Course, first: Tensor, second: Tensor, max_presses: int) -> tuple[Tensor, Tensor]:
    """Refine the fractions `first` and `second` of C candidates by shrinking grids. All arguments are `[N, C]`."""
    offset = torch.linspace(-1.0, 1.0, _ZOOM_GRID, device=first.device, dtype=torch.float32)
    first_offset, second_offset = torch.cartesian_prod(offset, offset).unbind(1)
    course = _Course(*(field[..., None] for field in course))
    width = 0.5 * math.pi / (_GRID - 1)  # the coarse grid's widest spacing
    for _ in range(_ZOOM_ROUNDS):
        near_first = (first[..., None] + width * first_offset).clamp(0.0, 1.0)
        near_second = (second[..., None] + width * second_offset).clamp(0.0, 1.0)
        best = _total_seconds(course, near_first, near_second, max_presses).argmin(-1, keepdim=True)
        first = near_first.gather(-1, best).squeeze(-1)
        second = near_second.gather(-1, best).squeeze(-1)
        width *= _ZOOM
    return first, second


def _search(course: _Course, max_presses: int, cost: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return each boat's best sequence `[N]` and the seconds of its presses `[N, 3]`, given courses `[N, S]`.

    With a `cost`, the seconds of fuel that each sequence takes besides its presses, `[S]`, only the best minima are
    refined.
    """
    sequence, first, second = _local_minima(course, max_presses)
    candidates = _Course(*(field.gather(1, sequence) for field in course))
    if cost is not None:
        coarse = _total_seconds(candidates, first, second, max_presses) + cost[sequence]
        kept = coarse.topk(min(_CANDIDATES, coarse.shape[1]), dim=1, largest=False).indices
        sequence, first, second = (field.gather(1, kept) for field in (sequence, first, second))
        candidates = _Course(*(field.gather(1, sequence) for field in course))
    first, second = _zoom(candidates, first, second, max_presses)
    durations = torch.stack(_durations(candidates, first, second, max_presses), dim=-1)
    total = durations.sum(-1) if cost is None else durations.sum(-1) + cost[sequence]
    best = total.argmin(1, keepdim=True)
    return sequence.gather(1, best).squeeze(1), durations.take_along_dim(best[..., None], 1).squeeze(1)


def _rough_search(course: _Course, max_presses: int) -> tuple[Tensor, Tensor]:
    """Return the same as `_search`, from one small grid."""
    device = course.x.device
    first, second = (_dense_at_the_ends(num, device) for num in _ROUGH_GRID)
    first, second = torch.meshgrid(first if max_presses > 2 else first[:1], second, indexing="ij")
    first, second = first.flatten(), second.flatten()
    grid = _Course(*(field[..., None] for field in course))
    seconds = _total_seconds(grid, first, second, max_presses).expand(*course.x.shape, len(first))
    best = seconds.flatten(1).argmin(1, keepdim=True)
    sequence = best // len(first)
    chosen = _Course(*(field.gather(1, sequence) for field in course))
    cell = best % len(first)
    durations = torch.cat(_durations(chosen, first[cell], second[cell], max_presses), dim=1)
    return sequence.squeeze(1), durations


def best_plan(
    x: Tensor,
    y: Tensor,
    goal_x: Tensor,
    goal_y: Tensor,
    fuel: Tensor,
    controller: Tensor,
    keymap: Tensor,
    max_presses: int = MAX_PRESSES,
) -> Plan:
    """Return the best plan of every boat from its current place of rest.

    Args:
        x, y: position of the boat, at rest, px from the harbour's centre, `[N]`.
        goal_x, goal_y: centre of the dock, px from the harbour's centre, `[N]`.
        fuel: seconds of pressing left in the tank, `[N]`.
        controller: INCONGRUENT or CONGRUENT, `[N]`.
        keymap: 1 or 2, `[N]`.
        max_presses: largest number of presses of a plan, 1 to 3.

    Raises:
        ValueError: `max_presses` is out of range.
    """
    if not 1 <= max_presses <= MAX_PRESSES:
        raise ValueError(f"max_presses must be 1 to {MAX_PRESSES}, got {max_presses}")
    keys = torch.arange(NUM_KEYS, device=x.device)
    directions = torch.stack(direction(controller[:, None], keymap[:, None], keys), dim=-1)
    return plan_with_directions(x, y, goal_x, goal_y, fuel, directions, max_presses=max_presses)


def plan_with_directions(
    x: Tensor,
    y: Tensor,
    goal_x: Tensor,
    goal_y: Tensor,
    fuel: Tensor,
    directions: Tensor,
    *,
    scale: Tensor | None = None,
    shortest_press: float = 0.0,
    max_presses: int = MAX_PRESSES,
    is_rough: bool = False,
) -> Plan:
    """Return the best plan of every boat, whose keys push in directions of its own.

    Args:
        x, y, goal_x, goal_y, fuel: as for `best_plan`.
        directions: unit direction of each key, `[N, NUM_KEYS, 2]`.
        scale: distance of a press as a multiple of the distance with people's boats, `[N]`. If None, 1.
        shortest_press: seconds. Each press of a plan has at least as many, and is slow enough to dock at any moment.
        max_presses: as for `best_plan`.
        is_rough: whether to search 60 times faster, with scores 0.002 lower on average and up to 0.07 lower.
    """
    search, size = (_rough_search, _ROUGH_CHUNK) if is_rough else (_search, _CHUNK)
    sequences = torch.tensor(_SEQUENCES, device=x.device)
    columns = [column.to(torch.float32)[:, None] for column in (x, y, goal_x, goal_y)]
    legs = [leg for key in sequences.unbind(1) for leg in directions[:, key].to(torch.float32).unbind(-1)]
    scale = torch.ones_like(columns[0]) if scale is None else scale.to(torch.float32)[:, None]
    course = _Course(*torch.broadcast_tensors(*columns, *legs, scale, torch.full_like(scale, shortest_press)))
    chunks = [_Course(*chunk) for chunk in zip(*(field.split(size) for field in course), strict=True)]
    # With a shortest press, a leg of length 0 is not the limit of short legs, so each number of presses has its search.
    numbers = [max_presses] if shortest_press == 0.0 else range(1, max_presses + 1)
    durations = torch.zeros(len(x), MAX_PRESSES, device=x.device, dtype=torch.float32)
    durations[:, -1] = torch.inf
    keys = torch.zeros(len(x), MAX_PRESSES, device=x.device, dtype=torch.long)
    for number in numbers:
        found = [search(chunk, number) for chunk in chunks]
        seconds = torch.cat([seconds for _, seconds in found])
        is_better = (seconds.sum(1) < durations.sum(1))[:, None]
        durations = torch.where(is_better, seconds, durations)
        keys = torch.where(is_better, sequences[torch.cat([sequence for sequence, _ in found])], keys)

    fuel_left = fuel.to(torch.float32) - durations.sum(1)
    is_solved = fuel_left >= 0.0
    is_press = (durations > 0.0) & is_solved[:, None]
    # Legs of length 0 are no presses, so move the others to the front.
    order = (~is_press).to(torch.int8).argsort(dim=1, stable=True)
    return Plan(
        keys=torch.where(is_press, keys, 0).gather(1, order),
        durations=torch.where(is_press, durations.clamp(min=shortest_press), 0.0).gather(1, order),
        num_presses=is_press.sum(1),
        score=score_of(is_solved, fuel_fraction(fuel_left)),
    )


def best_plans(layout: Layout, keymap: Tensor) -> Plan:
    """Return the best plans with either controller, incongruent first, from the start with a full tank, `[N, 2]`.

    Args:
        layout: layouts with fields `[N]`.
        keymap: 1 or 2, `[N]`.
    """
    num_options = len(CONTROLLERS)
    x, y, goal_x, goal_y, keymaps = (field.repeat_interleave(num_options) for field in (*layout, keymap))
    fuel = torch.full_like(x, TANK)
    controller = torch.tensor([INCONGRUENT, CONGRUENT], device=fuel.device).repeat(len(keymap))
    plan = best_plan(x, y, goal_x, goal_y, fuel, controller, keymaps)
    return Plan(*(field.unflatten(0, (len(keymap), num_options)) for field in plan))


def plans_of_options(rules: BoatDockOptions, state: BoatState) -> Plan:
    """Return the best plan of each option from the boats' current places of rest, fields `[N, num_options, ...]`.

    A plan may begin with a press of 0 s: the option then does nothing with its own controller. This happens with a
    `switch_cost`, and if one of the `boats` cannot reach the dock.

    If the agent does not choose, the only option is the controller that each row has. With a `switch_cost`, the plan of
    an option begins with that option's controller, and may change it before each later press.
    """
    position = state.x, state.y, state.goal_x, state.goal_y, state.fuel
    has_choice = rules.controller == "choose"
    if not rules.are_peoples:
        plans = _plans_with_boats(rules, *position, state.controller, state.keymap)
        if has_choice:
            return plans
        own = state.controller.long()
        return Plan(*(field[torch.arange(len(own), device=own.device), own].unsqueeze(1) for field in plans))
    numbers = range(len(CONTROLLERS)) if has_choice else (None,)
    controllers = [state.controller if each is None else torch.full_like(state.controller, each) for each in numbers]
    found = [best_plan(*position, controller, state.keymap) for controller in controllers]
    return Plan(*(torch.stack(fields, 1) for fields in zip(*found, strict=True)))


def best_scores(rules: BoatDockOptions, layout: Layout, keymap: Tensor) -> Tensor:
    """Return the best score with each controller, from the start with a full tank, `[N, num_controllers]`.

    With a `switch_cost`, it is the best score of a plan that begins with that controller.

    The scores of many boats, as in an evaluation, take seconds. The user's cache keeps them.
    """
    if len(keymap) < _KEPT_BOATS:
        return _best_scores(rules, layout, keymap)
    columns = [column.numpy(force=True).tobytes() for column in (*layout, keymap)]
    given = (*sources(), torch.__version__, torch.get_default_dtype(), repr(rules), len(keymap))
    scores = kept_in_cache(
        "ceilings",
        b"".join([repr(given).encode(), *columns]),
        lambda: _best_scores(rules, layout, keymap).numpy(force=True),
    )
    return torch.from_numpy(scores).to(keymap.device)


def _best_scores(rules: BoatDockOptions, layout: Layout, keymap: Tensor) -> Tensor:
    if rules.are_peoples:
        return best_plans(layout, keymap).score
    fuel = torch.full_like(layout.start_x, TANK)
    return _plans_with_boats(rules, *layout, fuel, torch.full_like(keymap, NOT_CHOSEN), keymap).score


def better_option(plans: Plan) -> Tensor:
    """Return the option with the highest score, int64 `[N]`, given plans `[N, num_options]`.

    The first of equally good options wins. An option that begins with a press of 0 s, to change the controller
    afterwards, is as good as the option to change at once. It loses the tie, because an agent that asks again at every
    press would idle forever.
    """
    return (plans.score - _IDLE * (plans.durations[..., 0] == 0.0).float()).argmax(1)


_IDLE = 1e-3  # subtracted from the score to break ties
_Direction = tuple[float, float]
_Press = tuple[int, int]  # the number of a kind of controller, and the number of one of its directions

_PARALLEL = 1e-3  # two directions with a smaller cross product count as parallel, so one leg replaces two
_CANDIDATES = 24  # local minima that are refined, over all sequences of presses
_FEWER = 1e-4  # seconds by which a plan with more presses must be better


def _plans_with_boats(
    rules: BoatDockOptions,
    x: Tensor,
    y: Tensor,
    goal_x: Tensor,
    goal_y: Tensor,
    fuel: Tensor,
    held: Tensor,
    keymap: Tensor,
) -> Plan:
    """Return the best plan that begins with each controller, for any number of controllers and with changes at a cost.

    Controllers that push in the same directions with other keys are of one kind and share a search.

    Args:
        rules: rules of the environment.
        x, y, goal_x, goal_y, fuel, keymap: as in `best_plan`.
        held: current controllers, or NOT_CHOSEN, `[N]`.
    """
    peoples = Boats(CONTROLLERS, (CONTROLLER_DEGREES["incongruent1"], CONTROLLER_DEGREES["congruent"]))
    directions = (rules.own_boats or peoples).directions
    sets = [tuple(sorted(each)) for each in directions]
    kinds = list(dict.fromkeys(sets))
    kind_of = [kinds.index(each) for each in sets]
    position = tuple(column.to(torch.float32) for column in (x, y, goal_x, goal_y))
    found = [_plans_of_kind(kinds, kind, rules.switch_cost, position) for kind in range(len(kinds))]

    # The key of each direction of a kind, for each controller.
    key_of = torch.tensor(
        [[keys.index(each) for each in kinds[kind]] for keys, kind in zip(directions, kind_of, strict=True)],
        device=x.device,
    )
    plans = []
    for boat, kind in enumerate(kind_of):
        legs, durations, num_presses, seconds = found[kind]
        # A plan names kinds. Its own kind stands for this controller, any other kind for the first one of that kind.
        members = [boat if other == kind else kind_of.index(other) for other in range(len(kinds))]
        boats = torch.tensor(members, device=x.device)[legs[..., 0]]
        keys = key_of[boats, legs[..., 1]]
        if rules.boats is None:
            # Key map 2 has the same directions, each one key later.
            keys = torch.where((boats == INCONGRUENT) & (keymap[:, None] == 2), (keys + 1) % NUM_KEYS, keys)
        if rules.switch_cost is not None:
            seconds = seconds + rules.switch_cost * ((held != NOT_CHOSEN) & (held != boat))
        left = fuel.to(torch.float32) - seconds
        is_solved = left >= 0.0
        is_press = (torch.arange(MAX_PRESSES, device=x.device) < num_presses[:, None]) & is_solved[:, None]
        plans.append(
            Plan(
                keys=torch.where(is_press, keys, 0),
                durations=torch.where(is_press, durations, 0.0),
                num_presses=is_press.sum(1),
                score=score_of(is_solved, fuel_fraction(left)),
            )
        )
    return Plan(*(torch.stack(fields, 1) for fields in zip(*plans, strict=True)))


def _plans_of_kind(
    kinds: Sequence[Sequence[_Direction]], kind: int, switch_cost: float | None, position: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the best plan that begins with a controller of this kind.

    Returns:
        The presses (kind and direction) int64 `[N, 3, 2]`, their seconds `[N, 3]`, their number `[N]`, and the fuel of
        the plan in seconds `[N]`. The fuel includes changes of the controller after the first press. It is `inf` if no
        plan docks.
    """
    device = position[0].device
    legs = torch.zeros(len(position[0]), MAX_PRESSES, 2, dtype=torch.long, device=device)
    legs[..., 0] = kind
    durations = torch.zeros(len(position[0]), MAX_PRESSES, device=device, dtype=torch.float32)
    num_presses = torch.zeros(len(position[0]), dtype=torch.long, device=device)
    seconds = torch.full((len(position[0]),), torch.inf, device=device, dtype=torch.float32)
    for num in range(1, MAX_PRESSES + 1):
        sequences = _sequences(kinds, kind, num, may_change=switch_cost is not None)
        if not sequences:
            continue
        changes = [sum(a[0] != b[0] for a, b in itertools.pairwise(presses)) for presses in sequences]
        cost = torch.tensor(changes, dtype=torch.float32, device=device) * (switch_cost or 0.0)
        course = [[kinds[each][number] for each, number in presses] for presses in sequences]
        directions = torch.tensor([_padded(each) for each in course], device=device, dtype=torch.float32)
        chunks = zip(*(column.split(_CHUNK) for column in position), strict=True)
        found = [_search_sequences(directions, cost, chunk, num) for chunk in chunks]
        sequence, pressed = (torch.cat(parts) for parts in zip(*found, strict=True))
        total = pressed.sum(-1) + cost[sequence]
        is_better = total < seconds - _FEWER
        table = torch.tensor([[*presses, *[(kind, 0)] * (MAX_PRESSES - num)] for presses in sequences], device=device)
        pressed = torch.nn.functional.pad(pressed[:, MAX_PRESSES - num :], (0, MAX_PRESSES - num))
        legs = torch.where(is_better[:, None, None], table[sequence], legs)
        durations = torch.where(is_better[:, None], pressed, durations)
        num_presses = torch.where(is_better, num, num_presses)
        seconds = torch.where(is_better, total, seconds)
    return legs, durations, num_presses, seconds


def _sequences(
    kinds: Sequence[Sequence[_Direction]], first: int, num: int, *, may_change: bool
) -> list[tuple[_Press, ...]]:
    """Return the sequences of `num` presses that begin with this kind and have no parallel neighbours."""
    every = [(kind, number) for kind in range(len(kinds)) for number in range(NUM_KEYS) if may_change or kind == first]

    def is_turn(before: _Press, after: _Press) -> bool:
        (a, b), (c, d) = kinds[before[0]][before[1]], kinds[after[0]][after[1]]
        return abs(a * d - b * c) > _PARALLEL

    sequences: list[tuple[_Press, ...]] = [(each,) for each in every if each[0] == first]
    for _ in range(num - 1):
        sequences = [(*presses, each) for presses in sequences for each in every if is_turn(presses[-1], each)]
    return sequences


def _padded(course: Sequence[_Direction]) -> list[_Direction]:
    """Return a course padded to three directions. The added legs, of length 0, are not parallel to the last one."""
    aside = (-course[-1][1], course[-1][0])
    return [aside] * (MAX_PRESSES - len(course)) + list(course)


def _search_sequences(
    directions: Tensor, cost: Tensor, position: Sequence[Tensor], num_presses: int
) -> tuple[Tensor, Tensor]:
    """Return the index of each boat's best sequence `[N]` and the seconds of its presses `[N, 3]`.

    Args:
        directions: directions of each sequence's three legs, `[S, 3, 2]`.
        cost: seconds of fuel that each sequence takes besides its presses, `[S]`.
        position: x, y, goal x and goal y, `[N]` each.
        num_presses: number of presses of each sequence. Earlier legs have length 0.
    """
    num = len(position[0])
    columns = [column[:, None].expand(num, len(directions)) for column in position]
    columns += [leg.expand(num, len(directions)) for leg in directions.flatten(1).unbind(1)]
    columns += [torch.ones_like(columns[0]), torch.zeros_like(columns[0])]
    return _search(_Course(*columns), num_presses, cost)
