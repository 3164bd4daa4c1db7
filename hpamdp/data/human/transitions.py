"""The recorded presses as BoatDockEnv would have returned them: the same keys, observations and rewards.

Values that the recording does not contain are filled in:
- The fuel before a press is a full tank less the logged presses. That is too much if presses are missing from the log.
  `complete` marks the episodes with a complete log. After the final press the fuel is the recorded tank.
- The observed velocity is the one at which the previous logged press was released.
- A final press that docked or was too fast ends where its course meets the dock's circle. If they do not meet, it ends
  at the point of the circle that is nearest to the start of the press. Our physics gives the ends of other final
  presses. These states are terminal, so no value bootstraps from them, and only the progress reward depends on them.
  Only played episodes that ended by the time limit are truncated; our physics gives where their boats are.
- If the first press was not logged, the first observation shows the boat away from its start.

Episodes without a logged press have no transitions.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor

from hpamdp import keys
from hpamdp.data import DataError
from hpamdp.data.human.released_file import TICKS_PER_SECOND, HumanData
from hpamdp.data.row_checks import TRAJECTORY
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.task import FAILURE_REWARD, SUCCESS_REWARD, BoatState, ObservationForm, RewardForm

NO_PRESS = "the episodes have no logged press"
_CENTRE = torch.tensor(harbour.CENTRE, dtype=torch.float32)


def transitions(
    data: HumanData, *, reward: RewardForm = "paper", observation: ObservationForm = "scaled", has_choice: bool = True
) -> TensorDict:
    """Return the presses as transitions `[N]`, in the order of episodes and presses.

    Entries at the root:
    - `[N]`: `option`, `("action", "discrete")`, `outcome` and `("collector", "traj_ids")`, the number of the episode.
    - `[N, 1]`: `is_decision`, `done`, `terminated`, `truncated` and `fuel`.
    - `observation` `[N, 16]` (14 with `pixels`).
    - `("action", "parameters")` `[N, 3]`, 0 for the keys that were not pressed.

    Entries under `next`: all of these except action, option and episode, and `reward` `[N, 1]`.

    Args:
        data: the recording, read with `one_frame=True`, so that every harbour has the environment's centre.
        reward, observation: as in BoatDockEnv.
        has_choice: whether the agent chooses the controller at the first press, as with `controller="choose"`. If so,
            there is an `option`, and the first observation does not show the controller. Otherwise all observations
            show it, and there is no `option`.

    Raises:
        SettingError: the reward or the observation is unknown.
        DataError: the harbours have different centres, or there is no press.
    """
    _check(data, reward, observation)
    if not len(data.presses):
        raise DataError(NO_PRESS)
    presses = data.presses
    episodes = data.episodes[presses["episode"]]  # the episode of each press
    before, after = _states(presses, episodes, has_choice)

    rows = _read(before, observation)
    key = presses["key"].unsqueeze(1)
    rows[keys.DISCRETE] = presses["key"].clone()
    rows[keys.PARAMETERS] = torch.zeros(len(key), harbour.NUM_KEYS, dtype=torch.float32).scatter(
        1, key, presses["duration"].unsqueeze(1)
    )
    if has_choice:
        rows[keys.OPTION] = episodes["controller"]
    rows[keys.IS_DECISION] = (presses["press"] == 0).unsqueeze(-1)
    rows[TRAJECTORY] = presses["episode"].clone()
    following = _read(after, observation)
    following[keys.REWARD] = _reward(before, after, reward).unsqueeze(-1)
    following[keys.IS_DECISION] = following[keys.DONE].clone()
    rows["next"] = following
    return rows


def decisions(data: HumanData, *, reward: RewardForm = "paper", observation: ObservationForm = "scaled") -> TensorDict:
    """Return each recorded episode as one decision of a selector, `[E]`: first observation, boat and return.

    The return is the environment's return for the recorded outcome and `tank`, even if the log of presses is not
    complete. Recorded episodes are terminated. A played episode that ended by the time limit is truncated. Episodes
    without a logged press are included.

    At the root: `option` `[E]`. Under `next`: `decision_observation` and `observation` `[E, 16]` (14 with `pixels`),
    `option_return`, `option_steps` (the logged presses, at least 1), `is_decision`, `done`, `terminated` and
    `truncated` `[E, 1]`.

    Args:
        data: the unchanged recording, read with `one_frame=True`.
        reward, observation: as in BoatDockEnv.

    Raises:
        DataError: the reward or the observation is unknown, or the harbours have different centres.
    """
    _check(data, reward, observation)
    episodes = data.episodes
    start, goal = episodes["start"] - _CENTRE, episodes["goal"] - _CENTRE
    # Find the end of the last logged press. Without a press, let the boat head for its goal from the start.
    position, heading = start.clone(), torch.nn.functional.normalize(goal - start, dim=1)
    duration = torch.zeros(len(start), dtype=torch.float32)
    last = data.presses[data.presses["is_final"]]
    number = last["episode"]
    controller, keymap = (episodes[name].to(torch.int32) for name in ("controller", "keymap"))
    position[number] = last["position"] - _CENTRE
    heading[number] = torch.stack(harbour.direction(controller[number], keymap[number], last["key"].int()), 1)
    duration[number] = last["duration"]
    full = torch.full_like(duration, physics.TANK)
    end = _final_position(position, goal, full, heading, duration, episodes["outcome"])

    steps = episodes["presses"].clamp(min=1)
    not_chosen, no_press = torch.full_like(controller, harbour.NOT_CHOSEN), torch.zeros_like(controller)
    before = _sailing(episodes, start, torch.zeros_like(start), full, not_chosen, no_press)
    after = before._replace(
        x=end[:, 0],
        y=end[:, 1],
        fuel=episodes["tank"] / TICKS_PER_SECOND,
        controller=controller,
        presses=steps.to(torch.int32),
        outcome=episodes["outcome"].int(),
    )
    ended = _read(after, observation)
    ended[keys.DECISION_OBSERVATION] = _read(before, observation)[keys.OBSERVATION]
    # The progress rewards of an episode's presses sum to that of one step from its start to its end.
    ended[keys.OPTION_RETURN] = _reward(before, after, reward).unsqueeze(-1)
    ended[keys.OPTION_STEPS] = steps.unsqueeze(-1)
    ended[keys.IS_DECISION] = ended[keys.DONE].clone()
    return TensorDict({keys.OPTION: episodes["controller"].clone(), "next": ended}, batch_size=[len(start)])


def _check(data: HumanData, reward: str, observation: str) -> None:
    """Check the arguments of `transitions` and `decisions`."""
    BoatDockOptions.of(None, {"reward": reward, "observation": observation})
    if not (data.episodes["centre"] == _CENTRE).all():
        raise DataError("the harbours have different centres; read the file with one_frame=True")


def _states(presses: TensorDict, episodes: TensorDict, has_choice: bool) -> tuple[BoatState, BoatState]:
    """Return the boats before and after each press, px from the harbour's centre."""
    is_first = presses["press"] == 0
    is_final = presses["is_final"]
    duration = presses["duration"]
    controller, keymap = (episodes[name].to(torch.int32) for name in ("controller", "keymap"))
    goal, position = episodes["goal"] - _CENTRE, presses["position"] - _CENTRE
    heading = torch.stack(harbour.direction(controller, keymap, presses["key"].to(torch.int32)), 1)
    next_velocity = presses["speed"].unsqueeze(1) * heading
    velocity = torch.where(is_first.unsqueeze(1), 0.0, next_velocity.roll(1, 0))
    fuel, next_fuel = _fuel(duration, is_first, is_final, episodes["tank"])
    final_position = _final_position(position, goal, fuel, heading, duration, episodes["outcome"])
    next_position = torch.where(is_final.unsqueeze(1), final_position, presses["next_position"] - _CENTRE)

    shown_controller = controller
    if has_choice:
        shown_controller = torch.where(is_first, harbour.NOT_CHOSEN, controller).to(torch.int32)
    before = _sailing(episodes, position, velocity, fuel, shown_controller, presses["press"].to(torch.int32))
    # If `to_rest_to_rest` left out the final press, the episode is truncated, and values bootstrap from its last state.
    number = presses["episode"]
    is_last = torch.cat([number[1:] != number[:-1], torch.ones_like(is_final[:1])])
    outcome_if_not_final = torch.where(is_last, physics.TIME_LIMIT, physics.SAILING)
    after = before._replace(
        x=next_position[:, 0],
        y=next_position[:, 1],
        velocity_x=next_velocity[:, 0],
        velocity_y=next_velocity[:, 1],
        fuel=next_fuel,
        controller=controller,
        presses=before.presses + 1,
        outcome=torch.where(is_final, episodes["outcome"], outcome_if_not_final).int(),
    )
    return before, after


def _sailing(
    episodes: TensorDict, position: Tensor, velocity: Tensor, fuel: Tensor, controller: Tensor, presses: Tensor
) -> BoatState:
    """Return boats that sail in episodes `[N]`: places `[N, 2]` from the harbour's centre, integers int32 `[N]`."""
    places = (episodes["start"] - _CENTRE, episodes["goal"] - _CENTRE, position, velocity)
    outcome = torch.full_like(presses, physics.SAILING)
    columns = [column for place in places for column in place.unbind(1)]
    episode_number = torch.zeros_like(presses)
    return BoatState._make((*columns, fuel, controller, episodes["keymap"].int(), presses, outcome, episode_number))


def _fuel(duration: Tensor, is_first: Tensor, is_final: Tensor, tank: Tensor) -> tuple[Tensor, Tensor]:
    """Return the fuel before and after each press, seconds `[N]`: a full tank less the logged presses.

    It is never less than the tank at the end of the episode. The logged durations can differ from that by a few ticks.

    Args:
        duration: duration of each press, seconds `[N]`.
        is_first, is_final: whether the press is its episode's first or final one, `[N]`.
        tank: ticks of fuel left at the end of each press's episode, `[N]`.
    """
    total = duration.double().cumsum(0)  # over all episodes
    total_at_start = (total - duration)[is_first]
    elapsed = total - total_at_start[is_first.cumsum(0) - 1]
    left_at_end = tank / TICKS_PER_SECOND
    before = torch.maximum(physics.TANK - (elapsed - duration), left_at_end).float()
    after = torch.maximum(physics.TANK - elapsed, left_at_end)
    return before, torch.where(is_final, left_at_end, after).float()


def _final_position(
    position: Tensor, goal: Tensor, fuel: Tensor, heading: Tensor, duration: Tensor, outcome: Tensor
) -> Tensor:
    """Return the end of each press if it were its episode's final one, `[N, 2]`. The module's docstring explains it."""
    x, y = position.unbind(1)
    goal_x, goal_y = goal.unbind(1)
    dir_x, dir_y = heading.unbind(1)
    to_dock = physics.distance_to_dock(x, y, goal_x, goal_y, dir_x, dir_y).unsqueeze(1)
    meets_dock = to_dock.isfinite()
    on_course = position + torch.where(meets_dock, to_dock, 0.0) * heading
    from_goal = position - goal
    nearest = goal + physics.DOCK_RADIUS * (from_goal / from_goal.norm(dim=1, keepdim=True))
    on_circle = torch.where(meets_dock, on_course, nearest)
    sailed = physics.press(x, y, fuel, goal_x, goal_y, dir_x, dir_y, duration)
    reached_dock = (outcome == physics.SUCCESS) | (outcome == physics.TOO_FAST)
    return torch.where(reached_dock.unsqueeze(1), on_circle, torch.stack([sailed.x, sailed.y], 1))


def _reward(before: BoatState, after: BoatState, form: RewardForm) -> Tensor:
    """Return the rewards of presses between two states, `[N]`."""
    final = torch.where(after.outcome == physics.SUCCESS, SUCCESS_REWARD * after.fuel / physics.TANK, 0.0)
    if form == "sparse":
        return final
    failed = (after.outcome > physics.SUCCESS) & (after.outcome < physics.TIME_LIMIT)
    progress = (_to_goal(before.x, before.y, before) - _to_goal(after.x, after.y, after)) / _to_goal(
        before.start_x, before.start_y, before
    )
    return progress + torch.where(failed, FAILURE_REWARD, final)


def _to_goal(x: Tensor, y: Tensor, state: BoatState) -> Tensor:
    return ((state.goal_x - x).square() + (state.goal_y - y).square()).sqrt()


def _read(state: BoatState, observation: ObservationForm) -> TensorDict:
    """Return the environment's entries for these boats, without noise."""
    boats = BoatDockEnv(len(state.x), options=BoatDockOptions(observation=observation))
    boats.state = state
    return boats.read()
