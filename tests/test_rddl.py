"""Problems of pyRDDLGym: their actions, bounds, horizons and refusals."""

from __future__ import annotations

from importlib.util import find_spec

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

import hpamdp
from hpamdp import keys
from hpamdp.env.gymnasium.action_spaces import ActionSpace
from hpamdp.env.rddl.environment import RDDLEnv
from hpamdp.env.rddl.problem import RDDLProblem
from hpamdp.settings import SettingError

needs_simulator = pytest.mark.skipif(find_spec("pyRDDLGym") is None, reason="needs hpamdp[rddl]")
SHIPS = {"bounds": {"ship": [0, 20], "ship___w1": [5, 9]}}
# A domain of each kind: real numbers, whole ones, booleans beside real ones, one of many, two of many, enumerated,
# of which one is an integer, with masks, without bounds of its own, with observations that hide the state.
NAMES = "Reservoir_ippc2023 UAV_Mixed Epidemic SysAdmin_MDP_ippc2011 Elevators Intruders_Discrete Sudoku_arcade"
NAMES += " BinPacking_or SupplyChain_or CrossingTraffic_POMDP_ippc2014 EarthObservation_ippc2018"
DOMAINS = {name: {} for name in NAMES.split()} | {"SupplyChain_or": SHIPS}


def grounded(env: RDDLProblem, action) -> dict:
    """Return an action as a dictionary of pyRDDLGym's own names, read from the names of discrete actions."""
    if isinstance(env.action_space, gymnasium.spaces.Dict):
        return {**action.get("choices", {}), **(action["numbers"][1][0] if "numbers" in action else {})}
    choices = action if isinstance(action[0], tuple) else [action]
    one = env.action_space if isinstance(action[0], np.integer) else env.action_space[0]
    names = ["nothing", *(fluent.name for fluent, _ in env._settings)]
    values = {}
    for number, parameters in choices:
        if number > 0:
            is_number = one[1][int(number)].shape == ()
            values[names[number]] = parameters[number] if is_number else env._settings[number - 1][1]
    return values


@needs_simulator
@pytest.mark.parametrize("domain", DOMAINS)
def test_random_actions_do_what_they_do_in_a_loop_over_pyrddlgym(domain):
    import pyRDDLGym

    env = RDDLProblem(domain=domain, **DOMAINS[domain])
    theirs = pyRDDLGym.make(domain, env._title.split()[1])
    assert env.own_time_limit == theirs.horizon
    env.action_space.seed(0)
    observation, _ = env.reset(seed=3)
    theirs.reset(seed=3)
    is_over, steps = False, 0
    while not is_over:
        assert env.observation_space.contains(observation)
        action = env.action_space.sample()
        observation, reward, *flags, _ = env.step(action)
        seen, expected, *their_flags, _ = theirs.step(grounded(env, action))
        assert (reward, flags) == (expected, their_flags)
        vector = observation["state"] if isinstance(observation, dict) else observation
        named = dict(zip(env.observation_names(), vector.tolist(), strict=True))
        for name, value in seen.items():
            same = named[f"{name}={str(value).removeprefix('@')}"] == 1.0 if isinstance(value, str) else None
            assert same if same is not None else named[name] == float(value)
        is_over, steps = any(flags), steps + 1
    assert steps <= env.own_time_limit
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(action)


@needs_simulator
def test_whole_numbers_are_ordered_parameters_and_not_choices():
    actions = ActionSpace(RDDLProblem(domain="UAV_Mixed").action_space)
    assert actions.component_sizes == () and actions.parameter_dims == (3,)
    assert actions.integer_parameters == (True, False, False)
    env = RDDLProblem(domain="SupplyChain_or", **SHIPS)
    actions = ActionSpace(env.action_space)
    assert all(actions.integer_parameters) and actions.own_low.tolist()[1:] == [5.0, 0.0, 0.0]
    assert actions.own_high.tolist()[1:] == [9.0, 20.0, 20.0]


@needs_simulator
def test_booleans_are_choices_beside_the_numbers_or_one_choice_if_one_may_be_set():
    specs = hpamdp.PAMDPSpecs.from_env(RDDLEnv(1, domain="Epidemic"))
    assert specs.component_sizes == (2, 1) and specs.parameter_dims == (0, 0, 4)
    env = RDDLEnv(1, domain="Epidemic", max_actions=1)
    specs = hpamdp.PAMDPSpecs.from_env(env)
    assert specs.component_sizes == () and sorted(specs.parameter_dims) == [0, 0, 1, 1, 1, 1]
    assert env.discrete_names[0] == "nothing" and "close_schools=true" in env.discrete_names
    assert hpamdp.PAMDPSpecs.from_env(RDDLEnv(1, domain="Elevators")).component_sizes == (7, 7)


@needs_simulator
def test_one_choice_has_the_preconditions_as_a_mask():
    env = RDDLProblem(domain="BinPacking_or")
    observation, _ = env.reset(seed=0)
    none, check = np.zeros(0, np.float32), env._env.sampler.check_action_preconditions
    for number, is_allowed in enumerate(observation["action_mask"]):
        action = (number, (none,) * len(observation["action_mask"]))
        assert bool(is_allowed) == check(env.simulator_action(action), silent=True)
    assert 0 < observation["action_mask"].sum() < len(observation["action_mask"])
    check_env_specs(RDDLEnv(2, domain="BinPacking_or"))


@needs_simulator
def test_preconditions_that_are_not_enforced_are_told_once(capsys):
    RDDLEnv(2, domain="PushYourLuck_ippc2018")
    assert capsys.readouterr().err == (
        "PushYourLuck_ippc2018 1: the simulator does not enforce preconditions of several fluents; env.max_actions=1 "
        "makes masks of them\n"
    )
    RDDLEnv(1, domain="PushYourLuck_ippc2018", max_actions=1)
    assert capsys.readouterr().err == ""


@needs_simulator
def test_the_horizon_is_the_instances_and_rewards_and_observations_are_scaled():
    env = RDDLEnv(2, domain="HVAC", seed=1)
    assert env.max_steps == 40 and len(env.statistics()) > 0
    check_env_specs(env)
    plain = RDDLEnv(1, domain="HVAC", seed=1, reward_scaling=None, observation_scaling="none", max_steps=7)
    assert plain.max_steps == 7 and not plain.statistics()
    rolled = plain.rollout(20)
    assert rolled.shape == (1, 7) and rolled["next", "truncated"][0, -1].all()
    with pytest.raises(SettingError, match="max_steps=41: the environment ends its episodes after 40"):
        RDDLEnv(1, domain="HVAC", max_steps=41)


@needs_simulator
def test_steps_of_the_batched_environment_are_those_of_the_gymnasium_form():
    env = RDDLEnv(1, domain="Reservoir_ippc2023", reward_scaling=None, observation_scaling="none")
    single = hpamdp.make_gymnasium("rddl", domain="Reservoir_ippc2023")
    seeds = env.fixed_episodes(5)
    state = env.reset(seeds)
    observation, _ = single.reset(seed=int(seeds["seed"]))
    assert state[keys.OBSERVATION][0].tolist() == observation.astype(np.float32).tolist()
    for _ in range(10):
        state = env.rand_action(state)
        releases = state[keys.PARAMETERS][0].double().tolist()
        names = single.action_space["numbers"][1][0]
        action = {"numbers": (0, (dict(zip(names, releases, strict=True)),))}
        observation, reward, *_ = single.step(action)
        state = env.step(state)["next"]
        assert state["reward"].item() == np.float32(reward)
        assert state[keys.OBSERVATION][0].tolist() == observation.astype(np.float32).tolist()


@needs_simulator
@pytest.mark.parametrize(
    ("domain", "settings", "expected"),
    [
        ("Reservoir_ippc2023", {}, -1.0),  # the defaults are 0, and so are the least releases
        ("SupplyChain_or", SHIPS, 0.0),  # random shipments earn more than the defaults
        ("Sudoku_arcade", {}, None),
        ("Elevators", {}, None),
    ],
)
def test_numbers_begin_at_their_defaults_or_in_mid_range_if_random_play_is_better_there(domain, settings, expected):
    env = RDDLEnv(1, domain=domain, **settings)
    initial = env.initial_parameters()
    if expected is None:
        assert initial is None
    else:
        weight, bias = initial
        assert weight.shape == (env.full_action_spec_unbatched[keys.PARAMETERS].shape[-1], len(env.observation_names))
        assert not weight.any() and bias.tolist() == [expected] * len(bias)


@needs_simulator
def test_numbers_begin_at_their_defaults_if_a_rule_of_the_domain_fails_in_random_play(monkeypatch):
    def failing(*given):
        raise ValueError("a probability of 1.5")

    monkeypatch.setattr(RDDLProblem, "_trial", failing)
    _, bias = RDDLEnv(1, domain="SupplyChain_or", **SHIPS).initial_parameters()
    assert bias.tolist() == [-1.0] * 4


@needs_simulator
def test_files_of_ones_own_are_read_and_watched(tmp_path):
    from rddlrepository.core.manager import RDDLRepoManager

    problem = RDDLRepoManager().get_problem("HVAC")
    files = [str(tmp_path / name) for name in ("domain.rddl", "instance.rddl")]
    for file, source in zip(files, (problem.get_domain(), problem.get_instance("0")), strict=True):
        with open(source) as read, open(file, "w") as written:
            written.write(read.read())
    env = RDDLEnv(1, files=files)
    assert env.max_steps == 40
    before = env.file_checksums()
    with open(files[1], "a") as written:
        written.write("// edited\n")
    assert before and torch.cat([*before.values()]) != torch.cat([*env.file_checksums().values()])
    assert not RDDLEnv(1, domain="HVAC").file_checksums()
    (tmp_path / "instance.rddl").write_text("instance {")
    with pytest.raises(SettingError, match=r"instance.rddl: pyRDDLGym cannot read it: ") as raised:
        RDDLEnv(1, files=files)
    assert "\n" not in str(raised.value)


@needs_simulator
@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"domain": "Reservoir_ipc2023"}, r"did you mean Reservoir_ippc2023\?"),
        ({"instance": 77}, r"instance=77: no such instance of Reservoir_ippc2023; it has 1, 2, 3, 4, 5$"),
        ({"bounds": {"relese": [0, 1]}}, r"bounds: relese: .* did you mean release\?"),
        ({"bounds": {"release": [-2, -1]}}, r"nothing is left for release___t1$"),
        ({"bounds": {"release": [1]}}, r"bounds"),
        ({"domain": "SupplyChain_or"}, r"no bounds of the numbers ship; give 'env\.bounds=\{ship:\[0,HIGH\]\}'$"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(settings, line):
    with pytest.raises(SettingError, match=line) as raised:
        RDDLEnv(1, **settings)
    assert "\n" not in str(raised.value)
