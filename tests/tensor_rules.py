"""The rules of boats and of the field's domains as environments without kernels, to compare the kernels with."""

import importlib
from pathlib import Path

from scripts import load_script

from hpamdp.env.batched_env import BatchedEnv
from hpamdp.env.catch_point.environment import CatchPointEnv
from hpamdp.env.goal.environment import GoalEnv, HardGoalEnv
from hpamdp.env.hard_move.environment import HardMoveEnv

_EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"
load_script(_EXPERIMENTS / "domains" / "replay.py")  # which finds them
catch_point, goal, gym_hybrid, hard_move, points = (
    importlib.import_module(f"published_rules.{name}")
    for name in ("catch_point", "goal", "gym_hybrid", "hard_move", "points")
)
boat_rules = load_script(_EXPERIMENTS / "whole_map" / "boat_rules.py")


def with_tensor_rules(env: BatchedEnv, seed: int) -> BatchedEnv:
    """Return environments like these, whose states tensor functions move."""
    start, act, observe = _functions_of(env)
    rules = {"start": lambda _, *given: start(*given), "act": act, "observe": lambda _, state: observe(state)}
    cls = type("Ruled", (type(env),), {"row_kernel": None, **rules})
    return cls(env.num_envs, options=env.options, seed=seed, first_env=int(env._environment[0]))


def _functions_of(env):
    """Return how episodes start, what an action does, and what is observed."""
    options = env.options
    if isinstance(env, CatchPointEnv):
        rules = {"catches": options.catches, "late_end": options.late_end}
        return (
            catch_point.start,
            lambda _, state, action, *__: catch_point.act(state, action.discrete, action.parameters[:, 0], **rules),
            lambda state: catch_point.observe(state, progress=options.progress),
        )
    if isinstance(env, HardMoveEnv):
        return (
            hard_move.start,
            lambda _, state, action, *__: hard_move.act(state, action.discrete, action.parameters[:, 0], env.motions),
            points.observe,
        )
    if isinstance(env, GoalEnv):
        repairs = {"repairs_projection": "keeper_projection" in options.repaired}
        is_scaled = options.observation == "scaled"
        return goal.start, _act_in_goal, lambda state: goal.observe(state, is_scaled=is_scaled, **repairs)
    vehicle = {"slides": env.slides, "max_steps": env.max_steps}
    return (
        gym_hybrid.start,
        lambda _, state, action, *__: gym_hybrid.act(state, action.discrete, action.parameters[:, 0], **vehicle),
        lambda state: gym_hybrid.observe(state, env.max_steps),
    )


def _act_in_goal(env, state, action, rng, is_idle):
    repaired = env.options.repaired
    slips = {"kicks_to_point": "kick_to" in repaired}
    if isinstance(env, HardGoalEnv):
        aim = goal.hard_goal_aim(action.discrete, action.parameters, has_middle="middle_shots" in repaired, **slips)
    else:
        aim = goal.goal_aim(action.discrete, action.parameters, **slips)

    def numbers(ticks, rows):
        return goal.random_numbers(rng._replace(bits=rng.bits[rows]), state.steps[rows], ticks)

    after, _ = goal.act(state, aim, ~is_idle, numbers, noise=env.options.noise, max_steps=env.max_steps)
    return after, goal.reward(state, after, repairs_distance="goal_distance" in repaired)
