"""Episodes of `hpamdp play` without a browser: events of given presses, and their results."""

import math

import torch

from hpamdp.env.boatdock import harbour, physics, planner
from hpamdp.env.boatdock.play import episodes
from hpamdp.env.boatdock.play.replay import HELD, settle

PLAYER = "0123456789abcdef"


def events_of(presses, gap=0.05):
    """Return the key events of presses (key, seconds), each begun when the boat is at rest, `gap` s later."""
    time, events = 0.3, []
    for key, seconds in presses:
        events.append({"t": time, "type": "down", "key": key, "code": f"Digit{key + 1}"})
        events.append({"t": time + seconds, "type": "up", "key": key, "code": f"Digit{key + 1}"})
        time += (1.0 + physics.GLIDE) * seconds + gap
    return events


def sailed(start, goal, directions, events, *, strength=1.0, glide=1.0, shortest=0.0, longest=HELD):
    """Return what the page says of a trip with any boat; the events must end it."""
    bare = episodes.Trip.model_construct(start=start, goal=goal, presses=[])
    settled = settle(((event["t"], event["type"], event["key"]) for event in events), shortest, longest)
    directions = torch.tensor([directions], dtype=torch.float64)
    boat = episodes.sail_trips([bare], directions, [settled], strength=strength, glide=glide)
    num, fuel = int(boat.num_presses), boat.fuel / physics.TANK
    return {
        "start": list(start),
        "goal": list(goal),
        "events": events,
        "presses": [
            {"key": press.key, "start": press.start, "duration": boat.burnt[0, i].item()}
            for i, press in enumerate(settled[:num])
        ],
        "outcome": physics.OUTCOMES[int(boat.outcome)],
        "fuel": fuel.item(),
        "score": harbour.score(boat.outcome, fuel).item(),
        "end": [boat.end_x.item(), boat.end_y.item()],
    }


def recorded(*, index=0, player=PLAYER):
    """Return what every line of a file has."""
    return {"format": 1, "software": "0.2.0", "consent": True, "player": player, "index": index, "resolution": 1e-4}


def played(start, goal, controller, events, *, keymap=1, index=0, player=PLAYER, mode="round"):
    """Return the episode that the page would send; the events must end it."""
    directions = harbour.DIRECTIONS[2 if controller == "congruent" else keymap - 1]
    return {
        **recorded(index=index, player=player),
        "mode": mode,
        "keymap": keymap,
        "controller": controller,
        **sailed(start, goal, directions, events),
    }


def docked(num, seed=11, **which):
    """Return `num` episodes in which the best plan is played, with the better boat."""
    layout = harbour.fixed_layouts(num, seed)
    plans = planner.best_plans(layout, torch.ones(num, dtype=torch.int32))
    made = []
    for i in range(num):
        option = int(plans.score[i].argmax())
        presses = [
            (int(plans.keys[i, option, j]), plans.durations[i, option, j].item())
            for j in range(int(plans.num_presses[i, option]))
        ]
        start, goal = ((layout[k][i].item(), layout[k + 1][i].item()) for k in (0, 2))
        made.append(played(start, goal, harbour.CONTROLLERS[option], events_of(presses), index=i, **which))
    return made


def random_events(rng, num):
    """Return up to `num` presses at random times, which overlap, interrupt each other and lose the window's focus."""
    events, time = [], 0.1
    for _ in range(num):
        time += rng.random() * rng.choice([0.2, 1.0, 2.5])
        key = rng.randrange(3)
        events.append({"t": time, "type": "down", "key": key})
        chance = rng.random()
        if chance < 0.85:
            end = time + rng.random() * rng.choice([0.1, 0.5, 1.3])
            events.append({"t": end, "type": "up" if chance < 0.8 else "blur", "key": key})
    return sorted(events, key=lambda event: event["t"])


def is_over(episode):
    """Return whether what `played` returned has come to an end."""
    return episode["outcome"] != "sailing" and math.isfinite(episode["fuel"])
