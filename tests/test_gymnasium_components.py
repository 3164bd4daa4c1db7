"""GymnasiumEnv takes any tree of spaces: components, whole parameters, masks of each component, bounds of the state."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from action_trees import PAIR, TREES, UNIT, Recorder
from conftest import compose_config
from gymnasium import spaces
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, OneOf, Tuple
from gymnasium_players import action
from test_masks import SHORT
from torchrl.envs.utils import check_env_specs

import hpamdp
from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.env.base import ProblemError
from hpamdp.env.gymnasium.action_spaces import ActionSpace
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.env.gymnasium_form import VectorForm
from hpamdp.policies.low_level.random import Random
from hpamdp.run.train import run
from hpamdp.specs import PAMDPSpecs

STEPS = 200


def make(tree: str, num_envs: int = 1, **settings: Any) -> GymnasiumEnv:
    kwargs = {"tree": tree}
    settings = {"action_form": TREES[tree].form, "max_steps": STEPS + 1, **settings}
    return GymnasiumEnv(num_envs, entry_point="action_trees:Recorder", kwargs=kwargs, **settings)


@pytest.mark.parametrize("tree", TREES)
def test_an_action_tree_is_read_as_its_table_says(tree):
    env, expected = make(tree), TREES[tree]
    assert env.component_sizes == expected.component_sizes and env.parameter_dims == expected.dims
    assert env.integer_parameters == expected.integer_parameters
    specs = PAMDPSpecs.from_env(env)
    assert specs.num_discrete == sum(expected.sizes) and specs.num_components == len(expected.sizes)


@pytest.mark.parametrize("tree", TREES)
def test_all_tensors_are_as_the_specs_say_and_random_actions_are_in_the_space(tree):
    check_env_specs(make(tree, 2), return_contiguous=True)
    env = make(tree)  # of Recorders, which refuse other actions
    policy = Random(PAMDPSpecs.from_env(env)).policy
    torch.manual_seed(0)
    env.rollout(STEPS, policy, break_when_any_done=False)
    (copy,) = env.envs
    assert len(copy.unwrapped.actions) == STEPS


@pytest.mark.parametrize("tree", [name for name, tree in TREES.items() if tree.whole])
def test_whole_parameters_take_each_of_their_numbers_equally_often(tree):
    specs = PAMDPSpecs.from_env(make(tree))
    is_whole = torch.tensor(specs.integer_parameters)
    num = 4001
    units = torch.linspace(-1.0, 1.0, num).unsqueeze(-1).expand(-1, specs.num_parameters)
    values = specs.from_unit(units)[:, is_whole]
    low, high = (torch.tensor(side)[is_whole] for side in (specs.parameter_low, specs.parameter_high))
    assert (values == values.round()).all()
    for column, first, last in zip(values.T, low.tolist(), high.tolist(), strict=True):
        count = int(last - first) + 1
        numbers, times = column.unique(return_counts=True)
        assert numbers.tolist() == [first + number for number in range(count)]
        assert (times - num / count).abs().max() <= 2.0


def native(space: spaces.Space, discrete: list, parameters: list, **settings: Any) -> Any:
    (given,) = ActionSpace(space, **settings).to_native(np.array([discrete]), np.float32([parameters]))
    assert space.contains(given)
    return given


def test_each_part_of_a_native_action_is_what_was_chosen_for_it():
    space = Dict(
        a=Tuple([Discrete(2, start=3), Tuple([UNIT, PAIR])]),
        b=MultiDiscrete([[2, 5]], start=[[0, 10]]),
        c=Box(0.0, 9.0, (2,)),
        d=OneOf([Discrete(4), Tuple([UNIT, Discrete(3, start=-1)])]),
        e=MultiBinary(2),
    )
    given = native(space, [1, 0, 4, 0, 1, 1, 0], [0.25, 0.5, 20.0, 3.0, 4.0, 2.0, -0.5, 1.0])
    assert int(given["a"][0]) == 4 and given["a"][1][0] == [0.25] and given["a"][1][1].tolist() == [0.5, 20.0]
    assert given["b"].tolist() == [[0, 14]] and given["c"].tolist() == [3.0, 4.0] and given["e"].tolist() == [1, 0]
    number, (unit, order) = given["d"]
    assert (int(number), unit.tolist(), int(order)) == (1, [-0.5], 1)


def test_whole_parameters_are_rounded_to_the_nearest_and_clipped():
    space = OneOf([Box(2, 5, (1,), np.int64), Discrete(3)])
    for given, expected in ((2.4, 2), (2.6, 3), (-9.0, 2), (99.0, 5), (np.nan, 2), (np.inf, 5)):
        assert native(space, 0, [given, 0.0])[1].tolist() == [expected]


def test_whole_numbers_that_float32_cannot_hold_are_reached():
    late = Box(2**40, 2**40 + 9, (1,), np.int64)
    space = ActionSpace(late)
    assert space.low == [0.0] and space.high == [9.0] and space.integer_parameters == (True,)
    assert [native(late, 0, [number])[0] - 2**40 for number in (0.0, 4.0, 9.0)] == [0, 4, 9]
    many = Box(-5, 2**40, (1,), np.int64)
    space = ActionSpace(many)
    assert space.low == [-1.0] and space.high == [1.0] and space.integer_parameters == ()
    assert [int(native(many, 0, [unit])[0]) for unit in (-1.0, 1.0)] == [-5, 2**40]


@pytest.mark.parametrize(
    ("space", "sizes", "dims"),
    [
        (Tuple([Discrete(2), UNIT]), (2,), (1, 1)),
        (Tuple([Discrete(2), UNIT, UNIT, UNIT]), (2, 1, 1, 1), (0, 0, 1, 1, 1)),
        (Tuple([Discrete(2), Tuple([UNIT, Discrete(3)])]), (2,), (1, 1)),
        (Tuple([Discrete(2), UNIT, Discrete(3)]), (2, 1, 3), (0, 0, 1, 0, 0, 0)),
        (Tuple([UNIT, Discrete(2)]), (1, 2), (1, 0, 0)),
        (Dict(a=UNIT, b=Discrete(2)), (2,), (1, 1)),
        (Dict(a=Discrete(2), b=Discrete(2)), (2, 2), (0,) * 4),
    ],
    ids=str,
)
def test_a_discrete_and_its_boxes_are_one_choice_unless_components_are_asked_for(space, sizes, dims):
    found = ActionSpace(space)
    assert (found.component_sizes or (len(found.parameter_dims),), found.parameter_dims) == (sizes, dims)
    apart = ActionSpace(space, form="components")
    assert apart.num_components == sum(1 for part in str(space).split("(") if part.endswith(("Discrete", "Box")))


def test_a_component_that_has_no_such_action_is_told_in_one_line():
    env = make("discretes and a box", 2)
    env.reset()
    line = r"step: environment 1 got discrete=\[0, 3, 0\] \(allowed 0 to 1 and 0 to 2 and 0 to 0\)"
    with pytest.raises(ValueError, match=line):
        env.step(action(env, [[1, 2, 0], [0, 3, 0]], torch.full((2, 2), 0.5)))
    with pytest.raises(ValueError, match="those of the chosen action must be finite"):
        env.step(action(env, [[1, 2, 0]] * 2, torch.full((2, 2), torch.nan)))
    with pytest.raises(ValueError, match=r"discrete'\) has shape \[2\], but must be \[2, 3\]"):
        env.step(action(env, [1, 1], torch.zeros(2, 2)))


class Said(Recorder):
    """Says in the info, or in a Dict of observations, what is allowed in a state.

    Args:
        tree: name of the action space, from TREES.
        said: the entries.
        place: `info` or `observation`.
    """

    def __init__(self, tree: str, said: dict[str, Any], place: str = "info"):
        super().__init__(tree)
        self.said, self.place = said, place
        if place == "observation":
            parts = {name: Box(-100.0, 100.0, np.shape(value)) for name, value in said.items()}
            self.observation_space = Dict(seen=self.observation_space, **parts)

    def reset(self, **arguments):
        return super().reset(**arguments)[0], dict(self.said) if self.place == "info" else {}

    def step(self, action):
        return *super().step(action)[:4], dict(self.said) if self.place == "info" else {}

    def _observation(self):
        seen = super()._observation()
        if self.place == "info":
            return seen
        return {"seen": seen, **{name: np.float32(value) for name, value in self.said.items()}}


def saying(tree: str, said: dict[str, Any], place: str = "info", num_envs: int = 1, **settings: Any) -> GymnasiumEnv:
    settings = {"action_form": TREES[tree].form, **settings}
    return GymnasiumEnv(num_envs, make=lambda: Said(tree, said, place), max_steps=STEPS + 1, **settings)


@pytest.mark.parametrize(
    ("tree", "mask", "flat"),
    [
        ("discretes and a box", ([1, 0], np.int8([0, 1, 1]), None), [1, 0, 0, 1, 1, 1]),
        ("discretes and a box", (None, np.int8([0, 1, 1]), None), [1, 1, 0, 1, 1, 1]),
        ("matrix of discretes", (([1, 0], [0, 1, 0]), ([0, 0, 1, 1], [1])), [1, 0, 0, 1, 0, 0, 0, 1, 1, 1]),
        ("multi binary", np.int8([[0, 1], [2, 2]]), [1, 0, 0, 1, 1, 1, 1, 1]),
        ("two choices", {"arm": ([0, 1], None), "leg": ([1, 0, 1], None, None, None)}, [0, 1, 1, 0, 1]),
        ("nested", ([0, 1, 1], (None, None, None)), [0, 1, 1]),
        ("named", {"kind": [0, 1]}, [0, 1]),
    ],
)
def test_masks_are_flat_or_have_the_structure_of_gymnasiums_samples(tree, mask, flat):
    env = saying(tree, {"action_mask": mask}, action_mask="info")
    td = env.reset()
    assert td[keys.ACTION_MASK].tolist() == [[bool(each) for each in flat]]
    specs = PAMDPSpecs.from_env(env)
    torch.manual_seed(0)
    played = env.rollout(50, Random(specs).policy, break_when_any_done=False)
    assert td[keys.ACTION_MASK][0, specs.components.places(played[keys.DISCRETE])].all()


@pytest.mark.parametrize(
    ("tree", "mask", "line"),
    [
        ("discretes and a box", [1, 0, 2, 1, 1, 1], "gave .* as action_mask, which must be 6 numbers, 0 or 1$"),
        ("discretes and a box", ([1, 0], [1, 1, 1], [1]), r"gave \[1\] in action_mask, which must be None for a Box"),
        ("multi binary", [[0, 1], [2, 3]], r"gave .* as action_mask, which must be 0, 1 or 2 \(both\) in shape"),
        ("two choices", {"foot": [0, 1]}, r"action_mask, which must be a dict with names of \['arm', 'leg'\]"),
        ("discretes and a box", [1, 0, 1, 0, 0, 0], "environment 0 gave an action_mask that allows nothing"),
    ],
)
def test_a_mask_of_another_form_or_that_allows_nothing_of_a_component_is_told_in_one_line(tree, mask, line):
    with pytest.raises(ProblemError, match=line):
        saying(tree, {"action_mask": mask}, action_mask="info").reset()


THREE_BOXES = [UNIT, UNIT, UNIT]


@pytest.mark.parametrize(
    ("space", "mask", "line"),
    [
        (Dict(mode=Discrete(3), a=UNIT, b=UNIT, c=UNIT), {"mod": (1, 0, 0)}, "a dict with names of .'mode', 'a', 'b'"),
        (OneOf(THREE_BOXES), (None, None), "3 numbers, 0 or 1, or a tuple of 3 masks"),
    ],
)
def test_a_mask_of_a_choice_in_another_structure_never_allows_everything(space, mask, line):
    with pytest.raises(ProblemError, match=f"must be {line}"):
        ActionSpace(space).read_mask(mask)


@pytest.mark.parametrize(
    ("space", "mask", "flat"),
    [
        (Dict(mode=Discrete(3), a=UNIT, b=UNIT, c=UNIT), {"mode": (1, 0, 0), "a": None}, [1, 0, 0]),
        (OneOf(THREE_BOXES), (None, None, None), [1, 1, 1]),
        (Dict(arm=OneOf(THREE_BOXES), leg=Discrete(2)), {"arm": np.array([1, 0, 1])}, [1, 0, 1, 1, 1]),
    ],
)
def test_a_mask_of_a_choice_may_leave_out_parts(space, mask, flat):
    assert ActionSpace(space).read_mask(mask).tolist() == [bool(each) for each in flat]


@pytest.mark.parametrize("place", ["info", "observation"])
def test_a_pair_mask_says_what_goes_together(place):
    pairs = np.ones((5, 5))
    pairs[0, 3] = 0
    env = saying("two discretes", {"pair_mask": pairs}, place)
    assert PAMDPSpecs.from_env(env).has_pair_mask
    assert env.reset()[keys.PAIR_MASK].shape == (1, 5, 5) and not env.reset()[keys.PAIR_MASK][0, 0, 3]
    check_env_specs(env)


@pytest.mark.parametrize(
    ("tree", "said", "settings", "line"),
    [
        ("two discretes", {}, {"pair_mask": "info"}, "gave no pair_mask, which must come with every reset"),
        ("nested", {}, {"pair_mask": "info"}, "pair_mask=info: the action has one component, so there are no pairs"),
    ],
)
def test_a_pair_mask_that_is_not_what_was_set_is_told_in_one_line(tree, said, settings, line):
    with pytest.raises(ValueError, match=line) as raised:
        saying(tree, said, **settings).reset()
    assert "\n" not in str(raised.value)


BOUNDS = {"parameter_low": np.float32([0.2, 12.0]), "parameter_high": np.float32([0.5, 12.0])}


@pytest.mark.parametrize("place", ["info", "observation"])
def test_bounds_of_the_state_are_given_observed_and_kept(place):
    settings = {"parameter_bounds": "info"} if place == "info" else {}
    env = saying("discretes and a box", BOUNDS, place, num_envs=2, **settings)
    specs = PAMDPSpecs.from_env(env)
    assert specs.has_parameter_bounds and specs.observation_dim == 2 + 4
    td = env.reset()
    np.testing.assert_allclose(td[keys.PARAMETER_LOW], [[0.2, 12.0]] * 2)
    np.testing.assert_allclose(td[keys.PARAMETER_HIGH], [[0.5, 12.0]] * 2)
    np.testing.assert_allclose(td[keys.OBSERVATION][0, 2:], [-0.6, -0.8, 0.0, -0.8], atol=1e-6)
    env.step(action(env, torch.zeros(2, 3, dtype=torch.int64), [[9.0, -9.0], [0.3, 99.0]]))
    given = [copy.unwrapped.actions[0][2].tolist() for copy in env.envs]
    np.testing.assert_allclose(given, [[0.5, 12.0], [0.3, 12.0]])
    check_env_specs(env)


@pytest.mark.parametrize(
    ("tree", "low", "flat"),
    [
        ("nested", (None, ([0.5], None, [0.5, 20.0])), [0.5, 0.5, 20.0]),
        ("flat", (None, np.ones((2, 2)), None), [1.0, 1.0, 1.0, 1.0, 0.5]),
        ("named", {"by": {"at1": [0.5, 20.0]}}, [0.5, 20.0, -1.0]),
        ("one of", ([0.5], None), [0.5, 0.0, 0.0]),
        ("orders", (None, ([0.0], 4, None)), [0.0, 4.0, 0.0, 10.0]),
        ("two choices", {"arm": (None, ([0.5], None))}, [0.5, -1.0, 0.0, 10.0]),
        ("late", (None, ([1.7e9 + 1800.0], [2**30 + 1])), [0.0, 1.0]),
    ],
)
def test_bounds_may_have_the_structure_of_the_space(tree, low, flat):
    env = saying(tree, {"parameter_low": low}, parameter_bounds="info")
    td = env.reset()
    np.testing.assert_allclose(td[keys.PARAMETER_LOW][0], flat, atol=1e-6)
    torch.testing.assert_close(td[keys.PARAMETER_HIGH], env.full_action_spec[keys.PARAMETERS].space.high)
    torch.manual_seed(0)
    env.rollout(50, Random(PAMDPSpecs.from_env(env)).policy, break_when_any_done=False)


@pytest.mark.parametrize(
    ("said", "line"),
    [
        ({}, "gave no parameter_low or parameter_high, which must come with every reset and step; "),
        ({"parameter_high": [1.5, 12.0]}, r"parameter_high=1\.5 for parameter 0, outside the action space: 0 to 1$"),
        (
            {"parameter_low": [0.2, 15.0], "parameter_high": [0.5, 12.0]},
            "gave parameter_low=15 for parameter 1, above parameter_high=12$",
        ),
        ({"parameter_low": (None, None, [0.2])}, r"gave \[0.2\] in parameter_low, which must be of shape \(2,\)"),
    ],
)
def test_bounds_that_are_wrong_are_told_in_one_line(said, line):
    with pytest.raises(ProblemError, match=line):
        saying("discretes and a box", said, parameter_bounds="info").reset()
    with pytest.raises(ProblemError, match=r"gave parameter_low=2\.5 for parameter 0, but the parameter is whole$"):
        saying("counts", {"parameter_low": [2.5, 3.0]}, parameter_bounds="info").reset()


def test_bounds_are_read_where_a_first_reset_gives_them_and_reported_if_they_come_later():
    for settings, is_read in ({}, True), ({"parameter_bounds": "ignore"}, False):
        env = saying("discretes and a box", BOUNDS, **settings)
        assert PAMDPSpecs.from_env(env).has_parameter_bounds == is_read
    env = saying("discretes and a box", {})
    env.envs[0].unwrapped.said = BOUNDS
    line = r"gave info\['parameter_low'\], which is not read; .*bounds=info; env\.parameter_bounds=ignore ignores them$"
    with pytest.raises(ProblemError, match=line):
        env.reset()
    saying("discrete", BOUNDS).reset()  # without parameters, the names mean something else


def test_the_mask_of_a_state_may_be_a_dict_of_masks_in_a_vector_of_states():
    env = saying("two choices", {"action_mask": {"arm": [0, 1]}}, action_mask="info")
    form = env.gymnasium_form()
    info = {"action_mask": {"arm": np.array([[0, 1], [1, 0]])}}
    rows, is_batch = form.read(np.zeros((2, 2), np.float32), info)
    assert is_batch and rows[keys.ACTION_MASK].tolist() == [[False, True, True, True, True], [True, False] + [True] * 3]
    with pytest.raises(ValueError, match="action_mask of row 0 allows nothing of component 1"):
        form.read(np.zeros(2, np.float32), {"action_mask": [1, 1, 0, 0, 0]})


def test_the_infos_of_gymnasiums_vector_environments_are_read_row_by_row():
    low, high = {"leg": (None, [0.5], [0.2, 20.0], None)}, {"arm": (None, ([0.5], None))}
    said = ({"parameter_low": low}, {"parameter_high": high}, {"parameter_low": low, "parameter_high": high})
    vector = gymnasium.vector.SyncVectorEnv([lambda each=each: Said("two choices", each) for each in said])
    form = saying("two choices", said[0], parameter_bounds="info").gymnasium_form()
    rows, is_batch = form.read(*vector.reset(seed=0))
    singles = [form.read(np.zeros(2, np.float32), each)[0] for each in said]
    assert is_batch
    for name in (keys.PARAMETER_LOW, keys.PARAMETER_HIGH):
        torch.testing.assert_close(rows[name], torch.cat([single[name] for single in singles]))


@pytest.mark.parametrize("form_of", [GymnasiumEnv.gymnasium_form, VectorForm], ids=["own", "vector"])
@pytest.mark.parametrize("tree", TREES)
def test_the_gymnasium_forms_give_actions_of_their_spaces(tree, form_of):
    env = make(tree, 3)
    form = form_of(env)
    acted = Random(PAMDPSpecs.from_env(env)).policy(env.reset())
    assert form.action_space.contains(form.write(acted[:1], is_batch=False))
    batch = form.write(acted, is_batch=True)
    rows = list(gymnasium.vector.utils.iterate(gymnasium.vector.utils.batch_space(form.action_space, 3), batch))
    assert len(rows) == 3 and all(form.action_space.contains(row) for row in rows)


def test_the_form_of_a_problem_reads_bounds_and_masks_of_components():
    env = saying("discretes and a box", {**BOUNDS, "action_mask": [1] * 6}, action_mask="info", parameter_bounds="info")
    form = VectorForm(env)
    observation, info = np.zeros(6, np.float32), {**BOUNDS, "action_mask": np.array([1, 0, 0, 1, 0, 1])}
    rows, _ = form.read(observation, info)
    assert rows[keys.PARAMETER_LOW].tolist() == BOUNDS["parameter_low"][None].tolist()
    for changed, line in (
        ({"action_mask": [1, 1, 0, 0, 0, 1]}, "action_mask of row 0 allows nothing of component 1"),
        ({"action_mask": [1, 1, 0, 2, 0, 1]}, "action_mask must be 0 or 1"),
        ({"parameter_low": [0.5]}, r"parameter_low must be numbers in shape \[1, 2\]"),
    ):
        with pytest.raises(ValueError, match=line):
            form.read(observation, {**info, **changed})
    with pytest.raises(ValueError, match="give the info of the step with its action_mask"):
        form.read(observation)


@pytest.mark.parametrize("low", ["hppo", "pdqn"])
def test_a_problem_without_parameters_can_be_learned(low, tmp_path):
    words = [f"low={low}", *SHORT[low], "high=none", "env=gymnasium", "env.entry_point=action_trees:Recorder"]
    words += ["env.kwargs={tree: discrete}", "env.max_steps=10", "num_envs=4", "steps_per_batch=16"]
    assert run(compose_config([*words, "total_frames=256", "eval.layouts=2"]), tmp_path) == 0


def test_an_agent_acts_in_the_space_and_inside_the_bounds_of_the_state():
    settings = {"total_frames": 64, "num_envs": 4, "steps_per_batch": 16, "high": "none", "low.minibatch_size": 16}
    settings |= {"env.max_steps": 10, "env.parameter_bounds": "info"}
    agent = hpamdp.train(lambda: Said("discretes and a box", BOUNDS), low="hppo", **settings)
    for greedy in (True, False):
        first, second, box = agent.act(np.zeros(2, np.float32), BOUNDS, greedy=greedy)
        assert agent.action_space.contains((first, second, box))
        assert (box >= BOUNDS["parameter_low"]).all() and (box <= BOUNDS["parameter_high"]).all()
    with pytest.raises(ValueError, match="act: give the info of the step, which holds parameter_low and "):
        agent.act(np.zeros(2, np.float32))
    with pytest.raises(ConfigError, match="export: HPPO cannot be exported: the problem has bounds of the parameters"):
        agent.export("agent.onnx")
