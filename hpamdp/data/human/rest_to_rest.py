"""Recorded presses converted to rest-to-rest presses, the only ones that the environment has.

A learner that imitates the recorded presses learns presses that are too short, for two reasons:
- A press that begins during a glide ends the glide. So a recorded press often moved its boat less far than the same
  press does in the environment.
- The log misses presses that overlapped another, among them most presses that ended their episodes. Four of five final
  presses in the log are too short to have ended their episodes, or aimed past the dock.

A rest-to-rest press starts from rest and lasts until the boat has come to rest again:
- The new duration of a press takes the boat, from rest to rest, to the point where the next press began.
- Presses that moved the boat by less than `MIN_DISTANCE` are left out.
- Final presses are left out if, by our physics, they would not have ended their episode as recorded.

More than half of the converted presses do not end where such a press leads, because unlogged presses moved the boat
between two logged ones. `clean` leaves these out, and keeps presses of any length. Each press then has its own end,
which need not be the start of the next one.

If the final press is left out, the last remaining press leads to the start of the final one. The episode is then
truncated, not terminated.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from hpamdp.data.human.released_file import FULL_TANK, TICKS_PER_SECOND, HumanData
from hpamdp.env.boatdock import harbour, physics

MIN_DISTANCE = 4.0  # px
MAX_ERROR = 3.0  # px, with `clean`
_CENTRE = torch.tensor(harbour.CENTRE, dtype=torch.float32)


def to_rest_to_rest(data: HumanData, *, clean: bool = False) -> HumanData:
    """Return the recording with rest-to-rest presses.

    Each episode's `tank` is a full tank less these presses.

    Args:
        data: the recording, read with `one_frame=True`.
        clean: whether to take only presses after which the boat was where such a press leads.
    """
    presses = data.presses
    is_final = presses["is_final"]
    episodes = data.episodes[presses["episode"]]  # the episode of each press
    heading = torch.stack(
        harbour.direction(episodes["controller"].int(), episodes["keymap"].int(), presses["key"].int()), 1
    )
    moved = ((presses["next_position"] - presses["position"]) * heading).sum(1).nan_to_num()
    reach = torch.minimum(moved.clamp(min=0.0), physics.total_distance(presses["duration"]))
    duration = torch.where(is_final, presses["duration"], physics.press_for(reach))
    if clean:
        led_to = presses["position"] + reach.unsqueeze(1) * heading
        is_right = (presses["next_position"] - led_to).norm(dim=1) < MAX_ERROR
    else:
        is_right = reach >= MIN_DISTANCE
    is_kept = torch.where(is_final, _ends_as_recorded(presses, episodes, heading), is_right)

    kept = presses[is_kept].clone()
    kept["duration"] = duration[is_kept]
    kept["speed"] = physics.speed(kept["duration"])
    episode = kept["episode"]
    first = torch.searchsorted(episode, episode)
    kept["press"] = torch.arange(len(episode)) - first
    if not clean:
        has_next = episode[:-1] == episode[1:]
        kept["next_position"][:-1][has_next] = kept["position"][1:][has_next]

    pressed = torch.zeros(len(data.episodes), dtype=torch.float32).index_add(0, episode, kept["duration"])
    converted = data.episodes.clone()
    converted["tank"] = (FULL_TANK - pressed * TICKS_PER_SECOND).clamp(min=0.0).round().long()
    converted["presses"] = torch.bincount(episode, minlength=len(data.episodes))
    return HumanData(converted, kept)


def _ends_as_recorded(presses: TensorDict, episodes: TensorDict, heading: Tensor) -> Tensor:
    """Return whether a press, from rest and with a full tank, ends as its episode did, bool `[N]`."""
    x, y = (presses["position"] - _CENTRE).unbind(1)
    goal_x, goal_y = (episodes["goal"] - _CENTRE).unbind(1)
    dir_x, dir_y = heading.unbind(1)
    tank = torch.full_like(presses["duration"], physics.TANK)
    sailed = physics.press(x, y, tank, goal_x, goal_y, dir_x, dir_y, presses["duration"])
    outcome = episodes["outcome"]
    # A full tank outlasts any press, so a press that ran dry in the recording comes to rest here.
    ran_dry = (outcome == physics.OUT_OF_FUEL) & (sailed.outcome == physics.SAILING)
    return (sailed.outcome == outcome) | ran_dry
