"""People's presses as BoatDockEnv would have given them: the same keys, the same observation, the same rewards.

What the recording does not say is filled in like this:
- Fuel before a press is a full tank less the logged presses, which is too much where presses are missing from the log
  (`complete` says where not); after the final press it is what the recorded tank says.
- The velocity observed is that at the release of the logged press before.
- A final press ends on the dock's circle where the boat docked or arrived too fast (where the course meets it; where
  people's boats met it off the course, at the point nearest to where the press began), else where our physics puts it.
  It is terminal in any case, so nothing bootstraps from it; only the progress reward depends on it.
- Where not even the first press was logged, the first observation shows the boat already on its way.
Episodes without a logged press give no transition.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.data.human.errors import HumanDataError
from hpamdp.data.human.released_file import FRAMES_A_SECOND, HumanData
from hpamdp.env import counter_rng
from hpamdp.env.boatdock import episode, harbour, physics
from hpamdp.env.boatdock.episode import BoatState, Reading, Rules

TRAJECTORY = ("collector", "traj_ids")
_REWARDS, _OBSERVATIONS = ("paper", "sparse"), ("scaled", "pixels")


def transitions(
    data: HumanData, *, reward: str = "paper", observation: str = "scaled", has_choice: bool = True
) -> TensorDict:
    """Return the presses as a batch of transitions `[N]`, in the order of episodes and presses.

    At the root: `observation` `[N, 16]` (14 with `pixels`), `option` `[N]`, `("action", "discrete")` `[N]`,
    `("action", "parameters")` `[N, 3]` (0 for the keys that were not pressed), `is_decision`, `done`, `terminated`,
    `truncated` `[N, 1]`, `outcome` `[N]`, `fuel` `[N, 1]`, and `("collector", "traj_ids")` `[N]`, the episode. Under
    `next`: all of these but action, option and trajectory, and `reward` `[N, 1]`.

    Args:
        data: read with `one_frame=True`, so that every harbour lies where the environment's does.
        reward, observation: as in BoatDockEnv.
        has_choice: the boat is chosen at the first press, as with `controller="choose"`: `option` is among the keys and
            the first observation doesn't show it yet. Otherwise it is given from the start, and there is no `option`.

    Raises:
        HumanDataError: a reward or observation that there is not, or harbours that lie elsewhere.
    """
    for name, value, allowed in (("reward", reward, _REWARDS), ("observation", observation, _OBSERVATIONS)):
        if value not in allowed:
            raise HumanDataError(f"{name}={value!r}, but must be one of {', '.join(allowed)}")
    if not (data.episodes["centre"] == torch.tensor(harbour.CENTRE)).all():
        raise HumanDataError("the harbours lie in two frames; read the file with one_frame=True")
    rules = Rules(controller="choose" if has_choice else "random", reward=reward, observation=observation)
    of = data.episodes[data.presses["episode"]]  # the episode of each press, `[N]`
    key, duration = data.presses["key"], data.presses["duration"]
    before, after = _states(data, of, has_choice)
    is_first = (data.presses["press"] == 0).unsqueeze(-1)
    root, then = _seen(before, rules), _seen(after, rules)
    then |= {keys.REWARD: episode.reward_of(before, after, rules).unsqueeze(-1), keys.IS_DECISION: then[keys.DONE]}
    durations = torch.zeros(len(key), harbour.NUM_KEYS).scatter(1, key.unsqueeze(1), duration.unsqueeze(1))
    root |= {keys.IS_DECISION: is_first, keys.ACTION: {"discrete": key.clone(), "parameters": durations}}
    root["collector"] = {"traj_ids": data.presses["episode"].clone()}
    if has_choice:
        root[keys.OPTION] = of["controller"]
    return TensorDict({**root, "next": then}, batch_size=[len(key)])


def _states(data: HumanData, of: TensorDict, has_choice: bool) -> tuple[BoatState, BoatState]:
    """Return the boats before and after each press, px from the harbour's centre."""
    presses, centre = data.presses, torch.tensor(harbour.CENTRE)
    is_first, is_final, duration = presses["press"] == 0, presses["is_final"], presses["duration"]
    controller = of["controller"].to(torch.int32)
    keymap = of["keymap"].to(torch.int32)
    heading = torch.stack(harbour.direction(controller, keymap, presses["key"].to(torch.int32)), 1)
    after_velocity = presses["speed"].unsqueeze(1) * heading
    velocity = torch.where(is_first.unsqueeze(1), 0.0, after_velocity.roll(1, 0))
    left, after_left = _fuel(duration, is_first, is_final, of["tank"])
    position, goal = presses["position"] - centre, of["goal"] - centre
    place = torch.where(
        is_final.unsqueeze(1), _final_place(position, goal, left, heading, duration, of["outcome"]),
        presses["next_position"] - centre,
    )  # fmt: skip
    not_chosen = torch.where(is_first, harbour.NOT_CHOSEN, controller).to(torch.int32)
    number = presses["press"].to(torch.int32)
    start = of["start"] - centre
    before = BoatState(
        *start.unbind(1),
        *goal.unbind(1),
        *position.unbind(1),
        *velocity.unbind(1),
        fuel=left,
        controller=not_chosen if has_choice else controller,
        keymap=keymap,
        presses=number,
        outcome=torch.full_like(number, physics.SAILING),
        episode=torch.zeros_like(number),
    )
    (x, y), (velocity_x, velocity_y) = place.unbind(1), after_velocity.unbind(1)
    # Where the final press is gone (`settled`) the episode is cut, not over: its last state bootstraps.
    episode_number = presses["episode"]
    is_last = torch.cat([episode_number[1:] != episode_number[:-1], torch.ones_like(is_final[:1])])
    outcome = torch.where(is_final, of["outcome"], torch.where(is_last, physics.TIME_LIMIT, physics.SAILING)).int()
    moved = dict(x=x, y=y, velocity_x=velocity_x, velocity_y=velocity_y, fuel=after_left)
    return before, before._replace(**moved, controller=controller, presses=number + 1, outcome=outcome)


def _fuel(duration: Tensor, is_first: Tensor, is_final: Tensor, tank: Tensor) -> tuple[Tensor, Tensor]:
    """Return the seconds of fuel before and after each press `[N]`: a full tank less the logged presses.

    There was never less than the tank that was left at the end, whatever the frames by which the two clocks differ.
    """
    elapsed = duration.double().cumsum(0)
    at_start = (elapsed - duration)[is_first]
    elapsed = elapsed - at_start[is_first.cumsum(0) - 1]
    last = tank / FRAMES_A_SECOND
    left = torch.maximum(physics.TANK - (elapsed - duration), last).float()
    return left, torch.where(is_final, last, torch.maximum(physics.TANK - elapsed, last)).float()


def _final_place(
    position: Tensor, goal: Tensor, fuel: Tensor, heading: Tensor, duration: Tensor, outcome: Tensor
) -> Tensor:
    """Return where a final press ended `[N, 2]`; see the module's docstring."""
    columns = (*position.unbind(1), *goal.unbind(1), *heading.unbind(1))
    to_dock = physics.distance_to_dock(*columns).unsqueeze(1)
    on_course = position + torch.where(to_dock.isfinite(), to_dock, 0.0) * heading
    outward = (position - goal) / (position - goal).norm(dim=1, keepdim=True)
    dock = torch.where(to_dock.isfinite(), on_course, goal + physics.DOCK_RADIUS * outward)
    sailed = physics.press(*columns[:2], fuel, *columns[2:], duration)
    is_dock = (outcome == physics.SUCCESS) | (outcome == physics.TOO_FAST)
    return torch.where(is_dock.unsqueeze(1), dock, torch.stack([sailed.x, sailed.y], 1))


def _seen(state: BoatState, rules: Rules) -> dict[str, Tensor]:
    row = torch.arange(len(state.x), dtype=torch.int32)
    reading: Reading = episode.read(state, counter_rng.seed_tensor(0), row, rules)
    return reading._asdict()
