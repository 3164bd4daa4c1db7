"""A player without learning that finds out where the keys push while it docks: the reference beside the ceiling.

The player knows the family of the boats and keeps in mind what each key of each boat did. Before a press it samples
boats that agree with this. It tries many presses on each of them and takes the one with the best mean value. The value
after a press is the score of the planner that knows the sampled boat. So the player expects to know the boat from then
on (QMDP, Littman et al. 1995, *Learning policies for partially observable environments*). It adds only a small cost for
each key that a plan needs and that no press has shown.

With two boats the player prefers a boat with unknown keys if the remaining trips are worth the trial.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from hpamdp.env.boatdock import physics
from hpamdp.env.boatdock.harbour import fuel_fraction, score
from hpamdp.env.boatdock.task import (
    FAILURE_REWARD,
    GLIDE,
    HARBOUR_RADIUS,
    MAX_DURATION,
    NUM_KEYS,
    SAILING,
    SPEED_SCALE,
    SUCCESS_REWARD,
    TANK,
    speed,
)
from hpamdp.env.boatdock_unseen.fleet import Boats
from hpamdp.env.boatdock_unseen.options import FleetRules
from hpamdp.env.boatdock_unseen.planner import best_plan
from hpamdp.env.boatdock_unseen.rules import OBSERVATION_NAMES

_NUM_SAMPLES = 32  # boats that stand for all that agree with what is known
_NUM_DURATIONS = 12  # tried besides those of plans
_LONGEST_TRIED = 1.5  # seconds; no leg that stays in the harbour takes longer
_NUM_PLANNED = 2  # sampled boats whose planned durations are tried
# By how much a second boat raises the ceiling of a trip.
_SECOND_BOAT_GAIN = {"turned": 0.16, "strength": 0.18, "any": 0.9}
# A key that a plan needs and no press has shown costs half of the shortest press: only a wrong guess costs one.
_COST_OF_UNSEEN = 0.5
_PREFER_UNSEEN = 1e-3  # added to the value of a press that shows something, to break ties


class _Place(NamedTuple):
    """Boats at rest and their docks, px, and their fuel, seconds, `[N]` each."""

    x: Tensor
    y: Tensor
    goal_x: Tensor
    goal_y: Tensor
    fuel: Tensor


class _Known(NamedTuple):
    """What is known of boats `[*B]`."""

    seen: Tensor  # bool [*B, 3], the keys whose direction is known
    directions: Tensor  # [*B, 3, 2], 0 if unknown
    strength: Tensor  # [*B]
    glide: Tensor  # [*B]
    is_measured: Tensor  # bool [*B], whether strength and glide are known


_Columns = TypeVar("_Columns", _Place, _Known)


class Explorer:
    """Sail N sessions, each with one boat or two to choose from, and find out what their keys do.

    Args:
        num_rows: number of sessions N.
        fleet: the family that boats are drawn from.
        num_boats: boats to choose from, 1 or 2.
        trips: number of trips of a session.
        shortest_press: seconds.
        seed: seed of the sampled boats.
    """

    def __init__(
        self,
        num_rows: int,
        fleet: FleetRules,
        *,
        num_boats: int = 1,
        trips: int = 8,
        shortest_press: float,
        seed: int = 0,
    ) -> None:
        self._fleet = fleet
        self._num_boats = num_boats
        self._trips = trips
        self._shortest = shortest_press
        self._generator = torch.Generator().manual_seed(seed)
        shape = (num_rows, num_boats)
        self._known = _Known(
            seen=torch.zeros(*shape, NUM_KEYS, dtype=torch.bool),
            directions=torch.zeros(*shape, NUM_KEYS, 2, dtype=torch.float32),
            strength=torch.ones(shape, dtype=torch.float32),
            glide=torch.ones(shape, dtype=torch.float32),
            is_measured=torch.full(shape, fleet.family != "strength"),
        )
        self._trip = torch.zeros(num_rows, dtype=torch.float32)

    def reset(self, rows: Tensor) -> None:
        """Forget the boats of the sessions `rows`, bool `[N]`, because new sessions begin."""
        self._known.seen[rows] = False
        self._known.is_measured[rows] = self._fleet.family != "strength"
        self._trip[rows] = 0.0

    def act(self, observation: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        """Return the next boats, keys and seconds, `[N]` each, given observations `[N, 22]`.

        With one boat, the first is None.
        """
        seen = dict(zip(OBSERVATION_NAMES, observation.to(torch.float32).unbind(-1), strict=True))
        self._remember(seen)
        x, y, goal_x, goal_y = (seen[name] * HARBOUR_RADIUS for name in ("boat_x", "boat_y", "goal_x", "goal_y"))
        place = _Place(x, y, goal_x, goal_y, seen["fuel"] * TANK)
        held = seen["boat"].long()
        found = []
        for boat in range(self._num_boats):
            is_possible = (held < 0) | (held == boat)
            found.append(self._best_press(place, _take(self._known, (slice(None), boat)), is_possible))
        values, keys, durations = (torch.stack(columns, 1) for columns in zip(*found, strict=True))
        if self._num_boats == 1:
            return None, keys.squeeze(1), durations.squeeze(1)
        trips_left = self._trips - 1.0 - self._trip
        unseen = (~self._known.seen).float().mean(-1)
        preferred = values + _SECOND_BOAT_GAIN[self._fleet.family] * trips_left[:, None] * unseen
        boats = torch.where(held >= 0, held, preferred.argmax(1))
        chosen = boats[:, None]
        return boats, keys.gather(1, chosen).squeeze(1), durations.gather(1, chosen).squeeze(1)

    def _remember(self, seen: dict[str, Tensor]) -> None:
        """Keep what the last press has shown."""
        trip = (seen["trip"] * self._trips).round()
        is_same_trip, self._trip = trip == self._trip, trip
        pressed = torch.stack([seen[f"last_key_{key}"] for key in range(1, NUM_KEYS + 1)], -1)
        velocity = torch.stack([seen["velocity_x"], seen["velocity_y"]], -1) * SPEED_SCALE
        fastest = velocity.norm(dim=-1)
        row = (fastest > 0.0).nonzero().squeeze(1)
        boat, key = seen["last_boat"][row].long(), pressed[row].argmax(-1)
        known = self._known
        known.directions[row, boat, key] = velocity[row] / fastest[row, None]
        known.seen[row, boat, key] = True
        if self._fleet.family != "any":
            self._infer_third(row, boat)
        # The press that ends a trip is cut short, so its length tells nothing of the strength and the glide.
        row, boat = row[is_same_trip[row]], boat[is_same_trip[row]]
        duration = seen["last_duration"][row] * MAX_DURATION
        distance = torch.hypot(seen["moved_x"], seen["moved_y"])[row] * HARBOUR_RADIUS
        if self._fleet.family == "strength":
            strength = fastest[row] / speed(duration)
            glide = (distance / (strength * physics.pressed_distance(duration)) - 1.0) / GLIDE
            low, high = 1.0 - self._fleet.spread, 1.0 + self._fleet.spread
            known.strength[row, boat] = strength.clamp(low, high)
            known.glide[row, boat] = glide.clamp(low, high)
            known.is_measured[row, boat] = True

    def _infer_third(self, row: Tensor, boat: Tensor) -> None:
        """Note the third direction of boats of which two are known: 120 degrees from both."""
        known = self._known
        is_pair = known.seen[row, boat].sum(-1) == NUM_KEYS - 1
        row, boat = row[is_pair], boat[is_pair]
        third = known.seen[row, boat].int().argmin(-1)
        directions = torch.where(known.seen[row, boat, :, None], known.directions[row, boat], 0.0)
        known.directions[row, boat, third] = torch.nn.functional.normalize(-directions.sum(1), dim=-1)
        known.seen[row, boat, third] = True

    def _best_press(self, place: _Place, known: _Known, asked: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the expected score `[N]` of the best press of each boat, its key `[N]` and its seconds `[N]`.

        The results only have a meaning in the rows `asked`, bool `[N]`.
        """
        value = torch.full_like(place.x, FAILURE_REWARD)
        key = torch.zeros_like(place.x, dtype=torch.long)
        duration = torch.full_like(place.x, MAX_DURATION)  # ends a trip that cannot be saved
        num_seen = known.seen.sum(-1)
        is_known = (num_seen == NUM_KEYS) & known.is_measured
        for number in range(NUM_KEYS + 1):
            rows = (asked & (num_seen == number) & ~is_known).nonzero().squeeze(1)
            if len(rows):
                boats = self._sampled_boats(_take(known, rows), number)
                found = self._search(_take(place, rows), known.seen[rows], boats)
                value[rows], key[rows], duration[rows] = found
        rows = (asked & is_known).nonzero().squeeze(1)
        boats = Boats(known.directions[rows], known.strength[rows], known.glide[rows])
        plan = best_plan(*_take(place, rows), *boats, shortest_press=self._shortest)
        docks = plan.num_presses > 0
        rows = rows[docks]
        value[rows], key[rows], duration[rows] = plan.score[docks], plan.keys[docks, 0], plan.durations[docks, 0]
        return value, key, duration

    def _search(self, place: _Place, seen: Tensor, boats: Boats) -> tuple[Tensor, Tensor, Tensor]:
        """Return value, key and seconds of the press with the best mean value over sampled boats `[R, H]`.

        The rows have equally many keys `seen`, bool `[R, 3]`.
        """
        durations = self._tried_durations(place, boats)
        # All unseen keys promise the same, so only one of them is tried.
        num_keys = min(int(seen[0].sum()) + 1, NUM_KEYS)
        keys = (~seen).to(torch.int8).argsort(dim=1, stable=True)[:, :num_keys]
        keys = keys.repeat_interleave(durations.shape[1], dim=1)
        durations = durations.repeat(1, num_keys)
        # All have the shape [R, A, H]: rows, presses and boats.
        push_x, push_y = boats.directions[torch.arange(len(keys))[:, None], :, keys].unbind(-1)
        start = _Place(*(column[:, None, None].expand_as(push_x) for column in place))
        strength, glide = (factor[:, None].expand_as(push_x) for factor in boats[1:])
        after = physics.press(
            start.x,
            start.y,
            start.fuel,
            start.goal_x,
            start.goal_y,
            push_x,
            push_y,
            durations[..., None].expand_as(push_x),
            strength=strength,
            glide=glide,
        )
        value = score(after.outcome, fuel_fraction(after.fuel))
        sailing = after.outcome == SAILING
        rests = _Place(after.x, after.y, start.goal_x, start.goal_y, after.fuel)
        directions = boats.directions[:, None].expand(*push_x.shape, NUM_KEYS, 2)
        seen_after = seen[:, None] | torch.nn.functional.one_hot(keys, NUM_KEYS).bool()
        value[sailing] = self._value_at_rest(
            _take(rests, sailing),
            Boats(directions[sailing], strength[sailing], glide[sailing]),
            seen_after[:, :, None].expand(*push_x.shape, NUM_KEYS)[sailing],
        )
        mean = value.mean(-1)
        best = (mean + _PREFER_UNSEEN * (~seen).gather(1, keys).float()).argmax(1, keepdim=True)
        value, key, duration = (column.gather(1, best).squeeze(1) for column in (mean, keys, durations))
        return value, key, duration

    def _value_at_rest(self, place: _Place, boats: Boats, seen: Tensor) -> Tensor:
        """Return the score `[K]` that the player expects from these boats, if it knows the keys `seen` `[K, 3]`."""
        plan = best_plan(*place, *boats, shortest_press=self._shortest, is_rough=True)
        is_press = torch.arange(plan.keys.shape[1]) < plan.num_presses[:, None]
        needed = (torch.nn.functional.one_hot(plan.keys, NUM_KEYS).bool() & is_press[..., None]).any(1)
        unseen = (needed & ~seen).sum(-1)
        if self._fleet.family != "any":  # one more key tells all
            unseen = torch.where(seen.sum(-1) > 1, 0, unseen.clamp(max=1))
        cost = _COST_OF_UNSEEN * SUCCESS_REWARD * fuel_fraction(torch.tensor(self._shortest))
        return torch.where(plan.num_presses > 0, plan.score - cost * unseen, plan.score)

    def _tried_durations(self, place: _Place, boats: Boats) -> Tensor:
        """Return the seconds `[R, D]` to try with each key: a grid, and those of the plans of some sampled boats."""
        num_rows = len(place.x)
        num_planned = min(_NUM_PLANNED, boats.strength.shape[1])
        some = [field[:, :num_planned].flatten(0, 1) for field in boats]
        repeated = (column.repeat_interleave(num_planned) for column in place)
        plan = best_plan(*repeated, *some, shortest_press=self._shortest, is_rough=True)
        planned = plan.durations.view(num_rows, -1).clamp(self._shortest, MAX_DURATION)
        shortest = max(self._shortest, 0.02)
        grid = torch.logspace(math.log10(shortest), math.log10(_LONGEST_TRIED), _NUM_DURATIONS, dtype=torch.float32)
        grid[0] = self._shortest
        return torch.cat([grid.expand(num_rows, -1), planned], 1)

    def _sampled_boats(self, known: _Known, num_seen: int) -> Boats:
        """Return H boats for each row that agree with what is known, of `num_seen` keys in every row.

        Returns:
            Boats with fields `[R, H, ...]`.
        """
        num_rows = len(known.strength)
        num = _NUM_SAMPLES
        if self._fleet.family == "turned" and num_seen == 1:
            num = 2  # the two orders of the other keys
        angles = self._angles(num)
        known_angles = torch.atan2(known.directions[..., 1], known.directions[..., 0])
        angles = angles.expand(num_rows, num, NUM_KEYS)
        if num_seen == 1:
            turn = torch.where(known.seen[:, None], known_angles[:, None] - angles, 0.0).sum(-1, keepdim=True)
            angles = angles + turn
        elif num_seen == NUM_KEYS - 1:
            third = self._third_angles(known_angles[known.seen].view(num_rows, 2), num)
            angles = third[..., None].expand_as(angles)
        directions = torch.stack([angles.cos(), angles.sin()], -1)
        directions = torch.where(known.seen[:, None, :, None], known.directions[:, None], directions)
        factors = []
        for factor in (known.strength, known.glide):
            sampled = 1.0 + self._fleet.spread * (
                2.0 * torch.rand(num, generator=self._generator, dtype=torch.float32) - 1.0
            )
            factors.append(torch.where(known.is_measured[:, None], factor[:, None], sampled))
        return Boats(directions, *factors)

    def _angles(self, num: int) -> Tensor:
        """Return the angles of the keys of boats of the family, evenly turned, `[num, 3]`."""
        turn = 2.0 * math.pi / num * torch.arange(num)[:, None]
        if self._fleet.family == "any":
            separation = self._fleet.separation
            free = 2.0 * math.pi - NUM_KEYS * separation
            between = torch.rand(num, NUM_KEYS - 1, generator=self._generator, dtype=torch.float32).sort(1).values
            offsets = torch.cat(
                [
                    torch.zeros(num, 1, dtype=torch.float32),
                    between * free + separation * torch.tensor([1.0, 2.0], dtype=torch.float32),
                ],
                1,
            )
            order = torch.rand(num, NUM_KEYS, generator=self._generator, dtype=torch.float32).argsort(1)
            return turn + offsets.gather(1, order)
        clockwise = 1.0 - 2.0 * (torch.arange(num) % 2)[:, None]
        return turn + clockwise * torch.arange(NUM_KEYS) * (2.0 * math.pi / NUM_KEYS)

    def _third_angles(self, pair: Tensor, num: int) -> Tensor:
        """Return `num` even angles `[R, num]` at least `separation` away from the angles of two keys `[R, 2]`."""
        first, second = pair.unbind(1)
        separation = self._fleet.separation
        gap = (second - first) % (2.0 * math.pi)
        inside = (gap - 2.0 * separation).clamp(min=0.0)
        outside = (2.0 * math.pi - gap - 2.0 * separation).clamp(min=0.0)
        way = (torch.arange(num) + 0.5) / num * (inside + outside)[:, None]
        from_first = way + separation
        from_second = way - inside[:, None] + gap[:, None] + separation
        return first[:, None] + torch.where(way < inside[:, None], from_first, from_second)


def _take(fields: _Columns, index: Any) -> _Columns:
    """Return a tuple of the same type with some rows of every field."""
    return type(fields)(*(field[index] for field in fields))
