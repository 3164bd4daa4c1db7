"""Declared symmetries hold in the real dynamics, and so does the frame in which an action points along +x."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch.nn.functional import one_hot

from hpamdp import keys
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.catch_point.environment import CatchPointEnv
from hpamdp.env.goal import rules as goal_rules
from hpamdp.env.goal.environment import GoalEnv, HardGoalEnv
from hpamdp.env.gym_hybrid.environment import MovingEnv, SlidingEnv
from hpamdp.env.hard_move.environment import HardMoveEnv
from hpamdp.geometry import Symmetries
from hpamdp.policies.shared.canonical_frame import CanonicalFrame
from hpamdp.policies.shared.symmetry import RandomSymmetry
from hpamdp.specs import PAMDPSpecs

NUM = 300


def boat_columns(env: BoatDockEnv, seen: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the boats' columns from observations; the columns that are not observed stay as they are."""
    is_pixels = env.options.observation == "pixels"
    lengths = seen[:, [0, 1, 2, 3, 8, 9]]
    lengths = lengths - torch.tensor([640.0, 512.0] * 3) if is_pixels else lengths * 120.0
    names = ("start_x", "start_y", "goal_x", "goal_y", "x", "y")
    columns = dict(zip(names, lengths.unbind(-1), strict=True))
    return {**env.env_state(), **columns, "fuel": seen[:, 12] * 6.0, "controller": seen[:, 7].round().int()}


def point_columns(env, seen: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the columns of a point at the origin."""
    names = ("vx", "vy", "target_x", "target_y")
    none = torch.zeros(len(seen))
    return {**env.env_state(), **dict(zip(names, seen.unbind(-1), strict=False)), "x": none, "y": none}


def vehicle_columns(env, seen: torch.Tensor) -> dict[str, torch.Tensor]:
    heading = torch.atan2(seen[:, 4], seen[:, 3])
    x, y, speed, _, _, target_x, target_y, *_ = seen.unbind(-1)
    places = {"x": x, "y": y, "speed": speed, "target_x": target_x, "target_y": target_y}
    return {**env.env_state(), **places, "heading": heading, "course": heading}


def goal_columns(env, seen: torch.Tensor) -> dict[str, torch.Tensor]:
    low, high = torch.tensor(goal_rules.OBSERVATION_LOW), torch.tensor(goal_rules.OBSERVATION_HIGH)
    raw = low + (seen + 1.0) * 0.5 * (high - low) if env.options.observation == "scaled" else seen
    columns = dict(zip(goal_rules.OBSERVATION_NAMES, raw.unbind(-1), strict=True))
    return {name: columns.get(name, column) for name, column in env.env_state().items()}


REPAIRED = ("kick_to", "goal_distance", "keeper_projection")
PROBLEMS = {
    **{
        f"{controller} boat, key map {keymap}, {observation}": (
            lambda c=controller, k=keymap, o=observation: BoatDockEnv(NUM, controller=c, keymap=k, observation=o),
            boat_columns,
            num_maps,
        )
        for controller, keymap, observation, num_maps in (
            ("congruent", 1, "scaled", 6),
            ("incongruent", 2, "pixels", 6),
            ("incongruent", "random", "scaled", 3),
            ("choose", 1, "scaled", 12),
            ("random", "random", "pixels", 3),
        )
    },
    "boats with a sparse reward": (lambda: BoatDockEnv(NUM, controller="congruent", reward="sparse"), boat_columns, 6),
    "catch point": (lambda: CatchPointEnv(NUM), point_columns, 16),
    "catch point with progress": (lambda: CatchPointEnv(NUM, progress=True), point_columns, 16),
    "hard move 4": (lambda: HardMoveEnv(NUM, n=4), point_columns, 8),
    "hard move 6": (lambda: HardMoveEnv(NUM, n=6, rounded_directions=False), point_columns, 12),
    "moving": (lambda: MovingEnv(NUM), vehicle_columns, 8),
    "sliding": (lambda: SlidingEnv(NUM), vehicle_columns, 8),
    "goal": (lambda: GoalEnv(NUM, noise=0.0, repaired=REPAIRED), goal_columns, 2),
    "raw goal": (lambda: GoalEnv(NUM, noise=0.0, repaired=REPAIRED, observation="raw"), goal_columns, 2),
    "hard goal": (lambda: HardGoalEnv(NUM, noise=0.0, repaired=(*REPAIRED, "middle_shots")), goal_columns, 2),
}


def started(env, columns_of, seen: torch.Tensor) -> None:
    """Put the environments where they observe this."""
    env.set_seed(3)
    env.reset()
    env.set_env_state(columns_of(env, seen))


def seen_on_the_way(env) -> torch.Tensor:
    """Return observations of random agents after none to two steps, where the episode goes on."""
    env.set_seed(3)
    td = env.reset()
    seen = td[keys.OBSERVATION].clone()
    for step in range(2):
        td = env.step_mdp(env.step(env.full_action_spec.rand().update(td)))
        goes_on = ~td[keys.DONE].squeeze(-1) & (torch.arange(NUM) % 3 > step)
        seen[goes_on] = td[keys.OBSERVATION][goes_on]
    return seen


def step(env, specs: PAMDPSpecs, columns_of, seen, context, discrete, unit) -> TensorDict:
    started(env, columns_of, seen)
    action = {"discrete": discrete, "parameters": specs.from_unit(unit)}
    option = {keys.OPTION: context} if env.has_choice else {}
    return env.step(TensorDict({keys.ACTION: action, **option}, [NUM]))["next"]


def worst_error(env, columns_of, maps: Symmetries) -> float:
    """Return by how much a mapped step differs from the step of the mapped state, over all maps."""
    specs = PAMDPSpecs.from_env(env)
    torch.manual_seed(0)
    seen = seen_on_the_way(env)
    discrete, unit = torch.randint(specs.num_discrete, (NUM,)), torch.rand(NUM, specs.num_parameters) * 2 - 1
    context = torch.randint(2, (NUM,)) if env.has_choice else maps.context(seen)
    if env.has_choice:  # an option is held once it is observed
        context = torch.where(seen[:, 7] < 0, context, seen[:, 7].long())
    after = step(env, specs, columns_of, seen, context, discrete, unit)
    worst = 0.0
    for g in range(len(maps)):
        number = torch.full((NUM,), g)
        mapped_seen = maps.map_observation(number, seen)
        mapped_discrete, mapped_unit = maps.map_action(number, context, discrete, unit)
        mapped_context = maps.contexts[g][context] if maps.num_contexts > 1 else context
        mapped = step(env, specs, columns_of, mapped_seen, mapped_context, mapped_discrete, mapped_unit)
        # Where rounding decides, such as on the rim of a circle, the two may end differently.
        is_same = mapped[keys.OUTCOME] == after[keys.OUTCOME]
        if not is_same.float().mean() > 0.99:
            return float("inf")
        expected = maps.map_observation(number, after[keys.OBSERVATION])
        scale = expected.abs().clamp(min=1.0)
        for error in ((mapped[keys.OBSERVATION] - expected) / scale, mapped[keys.REWARD] - after[keys.REWARD]):
            worst = max(worst, float(error[is_same].abs().max()))
    return worst


@pytest.mark.parametrize("name", list(PROBLEMS))
def test_a_mapped_transition_is_the_mapped_states_transition(name):
    make, columns_of, num_maps = PROBLEMS[name]
    env = make()
    maps = env.symmetries
    assert maps is not None and len(maps) == num_maps
    # Places that are not scaled have larger rounding errors, 3e-5 of a pixel, and so have Goal's actions of many ticks.
    is_rough = "pixels" in name or "raw" in name or name == "goal"
    assert worst_error(env, columns_of, maps) < (1e-4 if is_rough else 1e-5)


@pytest.mark.parametrize("n", [6, 10])
def test_directions_with_three_decimals_keep_the_symmetries_to_a_ten_thousandth(n):
    env = HardMoveEnv(NUM, n=n)
    assert 1e-6 < worst_error(env, point_columns, env.symmetries) < 1e-4


@pytest.mark.parametrize("slip", REPAIRED)
def test_each_slip_of_goal_breaks_its_mirror(slip):
    maps = GoalEnv(1, repaired=REPAIRED).symmetries
    env = GoalEnv(NUM, noise=0.0, repaired=[other for other in REPAIRED if other != slip])
    assert env.symmetries is None
    assert worst_error(env, goal_columns, maps) > 0.01


@pytest.mark.parametrize("name", ["congruent controller, key map 1, scaled", "choose 1", "hard move 6"])
def test_in_the_canonical_frame_actions_of_one_kind_make_the_same_transition(name):
    make, columns_of, _ = PROBLEMS.get(name, (lambda: BoatDockEnv(NUM, controller="choose"), boat_columns, 12))
    env = make()
    specs = PAMDPSpecs.from_env(env)
    frame = CanonicalFrame(specs)
    assert frame.turns
    torch.manual_seed(0)
    seen = seen_on_the_way(env)
    if env.has_choice:
        seen[:, 7] = torch.randint(2, (NUM,))
    context = frame.geometry.context(seen)
    kind = int(frame.kind.max())
    first, second = torch.where(frame.kind == kind)[0][:2].tolist()
    unit = torch.rand(NUM, 1).expand(-1, specs.num_parameters)
    turned = []
    for discrete in (first, second):
        chosen = torch.full((NUM,), discrete)
        direction = frame.direction(seen, chosen)
        # The same state in the canonical frame of either action.
        state = seen if discrete == first else frame.turn_back(turned[0][0], direction)
        after = step(env, specs, columns_of, state, context, chosen, unit)
        ahead = frame.turn(state, direction)
        turned.append((ahead, frame.turn(after[keys.OBSERVATION], direction), after[keys.REWARD]))
    is_same = (turned[0][2] - turned[1][2]).abs().squeeze(-1) < 0.5  # rounding decides on the rim of a circle
    assert is_same.float().mean() > 0.99
    for one, other in zip(*turned, strict=True):
        torch.testing.assert_close(one[is_same], other[is_same], atol=2e-5, rtol=0.0)


def test_a_map_that_swaps_the_options_is_left_out_for_one_and_permutes_the_observed_one_hot():
    specs = PAMDPSpecs.from_env(BoatDockEnv(1, controller="choose"))
    for option in (0, 1):
        own = specs.of_option(option).symmetries
        assert len(own) == 6 and own.num_contexts == 1
        assert own.discrete.sort(-1).values.equal(torch.arange(3).expand(6, 1, 3))
    shared = specs.with_option_observed().symmetries
    swaps = torch.where(shared.contexts[:, 0] == 1)[0]
    assert len(swaps) == 6
    seen = torch.rand(6, 18)
    seen[:, 7], seen[:, 16:] = -1.0, torch.tensor([1.0, 0.0])
    mapped = shared.map_observation(swaps, seen)
    assert mapped[:, 16:].equal(torch.tensor([0.0, 1.0]).expand(6, 2))
    assert (mapped[:, 7] == -1.0).all()
    seen[:, 7] = 0.0
    assert (shared.map_observation(swaps, seen)[:, 7] == 1.0).all()


def boat_rows(env: BoatDockEnv, option: torch.Tensor, next_option: torch.Tensor) -> TensorDict:
    """Return steps in whose observations the boat has been chosen, with the options before and after them."""
    seen = torch.rand(len(option), PAMDPSpecs.from_env(env).observation_dim)
    after = seen.clone()
    seen[:, 7], after[:, 7] = option.float(), next_option.float()
    return TensorDict(
        {
            "state": seen,
            "next_state": after,
            "discrete": torch.zeros(len(option), dtype=torch.long),
            "unit": torch.zeros(len(option), 3),
            "option": option,
            "next_option": next_option,
        },
        [len(option)],
    )


def test_random_symmetries_that_swap_the_boats_swap_the_options_of_a_sample_as_well():
    env = BoatDockEnv(1, controller="choose")
    rows = boat_rows(env, torch.randint(2, (100,)), torch.randint(2, (100,)))
    rows["state"] = torch.cat([rows["state"], one_hot(rows["option"], 2).float()], -1)
    rows["next_state"] = torch.cat([rows["next_state"], one_hot(rows["next_option"], 2).float()], -1)
    shared = PAMDPSpecs.from_env(env).with_option_observed()
    mapped = RandomSymmetry(shared, torch.device("cpu"))(rows)
    assert (mapped["option"] != rows["option"]).any()
    assert mapped["option"].equal(mapped["state"][:, 16:].argmax(-1))
    assert mapped["next_option"].equal(mapped["next_state"][:, 16:].argmax(-1))


def test_maps_that_keep_one_of_three_boats_swap_the_others_in_the_option_that_follows():
    turned = {"congruent": [150, 270, 30], "port": [170, 290, 50], "starboard": [130, 250, 10]}
    env = BoatDockEnv(1, controller="choose", boats=[*turned], controllers=turned)
    augment = RandomSymmetry(PAMDPSpecs.from_env(env).of_option(0), torch.device("cpu"))
    rows = boat_rows(env, torch.zeros(100, dtype=torch.long), torch.arange(100) % 3)
    mapped = [augment.mapped(torch.full((100,), number), rows) for number in range(len(augment.maps))]
    assert all((each["option"] == 0).all() for each in mapped)
    swapped = [each for each in mapped if not each["next_option"].equal(rows["next_option"])]
    assert len(swapped) == len(mapped) // 2
    assert all(each["next_option"].equal(torch.tensor([0, 2, 1])[rows["next_option"]]) for each in swapped)


def test_motor_noise_that_differs_between_the_boats_leaves_no_map_that_swaps_them():
    maps = BoatDockEnv(1, controller="choose", motor_noise=[0.1, 0.2]).symmetries
    assert len(maps) == 6 and maps.contexts.equal(torch.tensor([0, 1]).expand(6, 2))


def test_a_declaration_that_does_not_fit_is_refused_in_one_line():
    class Wrong(CatchPointEnv):
        @property
        def symmetries(self):
            return replace(super().symmetries, sign=torch.ones(16, 2))

    with pytest.raises(ValueError, match=r"symmetries: sign has shape \[16, 2\], but must be \[16, 1\]"):
        PAMDPSpecs.from_env(Wrong(1))

    class Crossed(CatchPointEnv):
        @property
        def geometry(self):
            return replace(super().geometry, vectors=((0, 1), (1, 2)))

    with pytest.raises(ValueError, match=r"geometry: vectors .* must be different entries of 4"):
        PAMDPSpecs.from_env(Crossed(1))


def test_random_symmetries_map_whole_rows_and_windows_by_one_map():
    specs = PAMDPSpecs.from_env(CatchPointEnv(1))
    augment = RandomSymmetry(specs, torch.device("cpu"))
    state = torch.tensor([1.0, 0.0, 0.0, 2.0]).expand(500, 3, 4)
    rows = TensorDict(
        {
            "state": state,
            "next_state": state,
            "discrete": torch.zeros(500, 3, dtype=torch.long),
            "unit": torch.zeros(500, 3, 1),
        },
        [500, 3],
    )
    mapped = augment(rows)
    assert torch.equal(mapped["state"], mapped["next_state"])
    assert (mapped["state"] == mapped["state"][:, :1]).all()
    assert len(mapped["state"][:, 0].round(decimals=3).unique(dim=0)) == 16
    torch.testing.assert_close(mapped["state"].norm(dim=-1), state.norm(dim=-1))
    assert torch.equal(rows["state"], state), "the sample itself stays as it is"
