"""People's presses as they would be if every boat came to rest before the next press, as the environment's boats do.

Two things in the recording mislead whoever copies it. A press that begins while the boat glides ends the glide, so
a press often brought its boat less far than it would here. And presses that overlapped another are missing, among them
most of those that ended their episodes: four of five final presses in the log are too short, or aimed past the dock, to
have done it. A policy that copies all this taps where it should press, and runs dry. Here
- a press lasts as long as takes a gliding boat to where it was when the next press began (P inverted);
- presses that moved the boat less than `TAP` are gone;
- so are final presses that, by our physics, would not have ended as their episodes did.
Where the final press is gone, the last one left leads to where it began, and the episode is cut, not over.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from hpamdp.data.human.released_file import FRAMES_A_SECOND, FULL_TANK, HumanData
from hpamdp.env.boatdock import harbour, physics

TAP = 4.0  # px
CENTRE = torch.tensor(harbour.CENTRE)


def to_rest_to_rest(data: HumanData) -> HumanData:
    """Return the recording with presses that start from rest and glide out; the tanks are what these presses leave.

    Args:
        data: read with `one_frame=True`.
    """
    presses = data.presses
    of = data.episodes[presses["episode"]]
    heading = torch.stack(harbour.direction(of["controller"].int(), of["keymap"].int(), presses["key"].int()), 1)
    is_final, duration = presses["is_final"], presses["duration"]
    moved = ((presses["next_position"] - presses["position"]) * heading).sum(1).nan_to_num()
    reach = torch.minimum(moved.clamp(min=0.0), physics.total_distance(duration))
    duration = torch.where(is_final, duration, physics.press_for(reach))
    is_kept = torch.where(is_final, _ends_alike(presses, of, heading), reach >= TAP)
    kept = presses[is_kept].clone().set("duration", duration[is_kept]).set("speed", physics.speed(duration[is_kept]))
    episode = kept["episode"]
    goes_on = episode[:-1] == episode[1:]
    kept["press"] = torch.arange(len(episode)) - torch.searchsorted(episode, episode)
    kept["next_position"][:-1][goes_on] = kept["position"][1:][goes_on]
    burnt = torch.zeros(len(data.episodes)).index_add(0, episode, kept["duration"]) * FRAMES_A_SECOND
    tank = (FULL_TANK - burnt).clamp(min=0.0).round().long()
    counts = torch.bincount(episode, minlength=len(data.episodes))
    return HumanData(data.episodes.clone().update({"tank": tank, "presses": counts}), kept)


def _ends_alike(presses: TensorDict, of: TensorDict, heading: Tensor) -> Tensor:
    """Return whether a press from rest with a full tank ends by itself as its episode did, bool `[N]`."""
    position, goal = presses["position"] - CENTRE, of["goal"] - CENTRE
    tank = torch.full_like(presses["duration"], physics.TANK)
    sailed = physics.press(*position.unbind(1), tank, *goal.unbind(1), *heading.unbind(1), presses["duration"])
    ran_dry = (of["outcome"] == physics.OUT_OF_FUEL) & (sailed.outcome == physics.SAILING)
    return (sailed.outcome == of["outcome"]) | ran_dry
