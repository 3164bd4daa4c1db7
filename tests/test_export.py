"""`Agent.export`: the file acts as the agent does and holds no code; agents that cannot be exported are refused."""

from __future__ import annotations

import importlib.util
import json
from itertools import pairwise

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from torchrl.envs.utils import ExplorationType, set_exploration_type

import hpamdp
from hpamdp import keys
from hpamdp.api.agent import Agent
from hpamdp.api.export import HELD_LENGTH, HELD_OPTION, GreedyStep
from hpamdp.run.assemble import option_length
from hpamdp.run.players import load_agent

PLATFORM = ["env=platform", "high=none"]
LEARNERS = {
    "hppo": [*PLATFORM, "low=hppo"],
    "pdqn": [*PLATFORM, "low=pdqn"],
    "pdqn_published": [*PLATFORM, "low=pdqn_published"],
    "pdqn_that_searches": [*PLATFORM, "low=pdqn", "low.greedy_samples=8"],
    "paddpg": [*PLATFORM, "low=paddpg"],
    "hsac": [*PLATFORM, "low=hsac"],
    "hyar": [*PLATFORM, "low=hyar"],
    "hyar_published": [*PLATFORM, "low=hyar_published"],
    "hyar_that_searches": [*PLATFORM, "low=hyar", "low.greedy_samples=8"],
    "hyar_nearest": ["env=hard_move", "high=none", "low=hyar", "low.discrete=nearest"],
    "qpamdp": [*PLATFORM, "low=qpamdp"],
    "td3_bc": ["high=meta_critic", "low=td3_bc"],
    "bc": ["high=linucb", "low=bc"],
    "iql": ["high=ucb", "low=iql"],
}
SELECTORS = {
    "ucb": ["high=ucb", "low=hppo"],
    "epsilon_greedy": ["high=epsilon_greedy", "low=hppo"],
    "thompson": ["high=thompson", "low=hppo", "agent.sharing=shared"],
    "exp3": ["high=exp3", "low=hsac"],
    "linucb": ["high=linucb", "low=pdqn"],
    "lin_thompson": ["high=lin_thompson", "high.features=random_fourier", "low=hppo"],
    "meta_critic": ["high=meta_critic", "low=hyar"],
    "actor": ["high=actor", "low=paddpg"],
    "option_critic": ["env=rooms", "high=option_critic", "low=hsac", "agent.sharing=shared"],
    "value": ["high=value", "low=hppo"],
    "value_of_shared": ["high=value", "low=hppo", "agent.sharing=shared"],
    "fixed": ["high=fixed", "high.option=congruent", "low=hppo"],
}
MASKED = ["env=gymnasium", "env.entry_point=toy_masked_gymnasium:Masked", "env.action_mask=info", "env.max_steps=9"]
GROUPED = [*MASKED, "+env.grouping={first: [0], second: [1]}", "agent.termination=steps", "agent.option_length=3"]
CASES = {
    **LEARNERS,
    **SELECTORS,
    "termination": ["env=rooms", "high=meta_critic", "low=hppo", "agent.termination=learned"],
    **{
        f"masked_{name}": [*MASKED, "high=none", f"low={name}"]
        for name in ("hppo", "pdqn", "paddpg", "hsac", "hyar", "qpamdp")
    },
    "grouped": [*GROUPED, "high=meta_critic", "low=hppo", "agent.sharing=shared"],
    "chosen": ["env=rooms", "high=actor", "low=hppo", "agent.termination=chosen", "agent.option_lengths=[1,2,4]"],
    "grouped_chosen": [*GROUPED[:-2], "high=meta_critic", "low=hppo", "agent.termination=chosen"],
    "grouped_actor": [*GROUPED, "high=actor", "low=pdqn"],
    "grouped_value": [*GROUPED, "high=value", "low=hppo"],
}
# The others differ in their networks alone.
QUICK = ["pdqn_that_searches", "hyar_nearest", "td3_bc", "exp3", "value_of_shared", "grouped_chosen"]


class Plain(gymnasium.Env):
    """Observations and actions of any space, drawn at random."""

    observation_space: spaces.Space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


class Own(Plain):
    """An option, a mask in the info, and numbers that float32 cannot hold or that do not begin at 0."""

    option_names = ("slow", "medium", "fast")
    observation_space = spaces.Dict(
        count=spaces.Box(2_000_000_000, 2_000_000_009, (1,), np.int64),
        kind=spaces.Discrete(3),
        time=spaces.Box(1.7e9, 1.7e9 + 100.0, (2,), np.float64),
    )
    action_space = spaces.Dict(
        action=spaces.Tuple(
            [
                spaces.Discrete(2, start=5),
                spaces.Tuple(
                    [
                        spaces.Box(1.7e9, 1.7e9 + 3600.0, (1,), np.float64),
                        spaces.Tuple(
                            [
                                spaces.Box(20_000_000, 20_000_009, (2,), np.int64),
                                spaces.Box(-50_000_000, 50_000_000, (2,), np.int64),
                                spaces.Box(0.0, 9.0, (1,)),
                                spaces.Box(-3, 4, (1,), np.int64),
                            ]
                        ),
                    ]
                ),
            ]
        ),
        option=spaces.Discrete(3, start=7),
    )

    def reset(self, *, seed=None, options=None):
        observation, _ = super().reset(seed=seed)
        return observation, {"action_mask": np.array([True, True])}

    def step(self, action):
        observation, *more, _ = super().step(action)
        return observation, *more, {"action_mask": np.array([True, False])}


def spread(agent: torch.nn.Module) -> None:
    """Move all weights, and what bandits have learned, away from their values at the start, which are nearly alike."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weight in (each for each in agent.parameters() if each.ndim):
            weight += torch.randn(weight.shape, generator=generator) / weight.shape[-1] ** 0.5
        for name, buffer in agent.named_buffers():
            if name.endswith(("moment", "sums", "counts")):
                buffer += torch.rand(buffer.shape, generator=generator)


def fresh_agent(*words: str) -> Agent:
    loaded = load_agent(None, words)
    spread(loaded.agent)
    return Agent(loaded.config, loaded.agent, loaded.env, loaded.progress)


def steps(agent: Agent, num_steps: int, num_rows: int):
    """Yield random vectors and masks of steps, with at least one choice allowed everywhere."""
    rng, specs = np.random.default_rng(0), agent.specs
    for _ in range(num_steps):
        low = 0.0 if specs.has_action_mask else -1.0  # bound of the problem with masks
        vectors = rng.uniform(low, 1.0, (num_rows, specs.observation_dim)).astype(np.float32)
        info = {}
        if specs.has_action_mask:
            info[keys.ACTION_MASK] = rng.random((num_rows, specs.num_discrete)) < 0.5
            first = info[keys.ACTION_MASK][:, 0]
            first |= ~info[keys.ACTION_MASK].any(-1)
        yield vectors, info


def differences(agent: Agent, run, num_steps: int = 6, num_rows: int = 64) -> float:
    """Return the largest difference between the parameters of `act` and of `run`, as a fraction of their bounds.

    Discrete actions and options must be the same.
    """
    width = np.array(agent.specs.parameter_high) - np.array(agent.specs.parameter_low)
    length = option_length(agent._config) or np.inf
    is_chosen = length == "chosen"
    if is_chosen:
        length = np.ones(num_rows, np.int64)
    largest, held, age = 0.0, np.zeros(num_rows, np.int64), np.full(num_rows, np.inf)
    agent.reset()
    for vectors, info in steps(agent, num_steps, num_rows):
        inputs = {keys.OBSERVATION: vectors, **info}
        if num_rows == 1:
            vectors, info = vectors[0], {name: mask[0] for name, mask in info.items()}
        agent.act(vectors, info)
        acted = agent._last
        is_due = age == np.inf if length is np.inf else age >= length
        if agent.specs.num_options:
            inputs |= {HELD_OPTION: held, keys.IS_DECISION: is_due}
        if is_chosen:
            inputs |= {HELD_LENGTH: length}
        discrete, parameters, *option = run(inputs)
        np.testing.assert_array_equal(discrete, acted[keys.DISCRETE].numpy())
        if option:
            np.testing.assert_array_equal(option[0], acted[keys.OPTION].numpy())
            age = np.where(is_due | (option[0] != held), 1, age + 1)
            held = option[0]
        if is_chosen:
            np.testing.assert_array_equal(option[1], acted[keys.OPTION_LENGTH].numpy())
            length = option[1]
        largest = max(largest, (np.abs(parameters - acted[keys.PARAMETERS].numpy()) / width).max())
    return largest


def traced_step(agent: Agent):
    """Return the function that is traced for an export."""
    step = GreedyStep(agent._agent, agent._form, option_length(agent._config))

    def run(inputs):
        with torch.no_grad():
            return [each.numpy() for each in step(*(torch.from_numpy(inputs[name]) for name in step.names))]

    return run


def session_of(path):
    onnxruntime = pytest.importorskip("onnxruntime")
    return onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])


def own_observations() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "count": rng.integers(2_000_000_000, 2_000_000_010, (64, 1)),
        "kind": rng.integers(0, 3, 64),
        "time": rng.uniform(1.7e9, 1.7e9 + 100.0, (64, 2)),
    }


def own_inputs() -> dict[str, np.ndarray]:
    """Return the inputs of the file for these observations."""
    seen = own_observations()
    rows = [spaces.flatten(Own.observation_space, {name: each[i] for name, each in seen.items()}) for i in range(64)]
    masks = np.random.default_rng(1).random((64, 2)) < 0.5
    masks[:, 0] |= ~masks.any(1)
    return {
        "observation": np.stack(rows),
        "action_mask": masks,
        "option_mask": np.ones((64, 3), bool),
        "held_option": np.zeros(64, np.int64),
        "is_decision": np.ones(64, bool),
    }


@pytest.fixture(scope="module")
def own_agent() -> Agent:
    own = ["env=gymnasium", "env.entry_point=test_export:Own", "env.max_steps=5", "env.action_mask=info"]
    agent = fresh_agent(*own, "env.observation_scaling=running", "high=linucb", "low=hppo")
    agent._env.scaling.statistics.update(own_inputs()["observation"][:50])
    return agent


@pytest.fixture(scope="module")
def own_session(own_agent, tmp_path_factory):
    path = tmp_path_factory.mktemp("onnx") / "own.onnx"
    own_agent.export(path)
    return session_of(path), path.read_bytes()


@pytest.mark.parametrize("name", QUICK)
def test_the_function_that_is_exported_acts_as_the_agent(name):
    agent = fresh_agent(*CASES[name])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert differences(agent, traced_step(agent)) < 1e-5


def test_options_end_where_the_selector_ends_them():
    agent = fresh_agent(*CASES["termination"])
    options = []
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        run = traced_step(agent)

        def kept(inputs):
            outputs = run(inputs)
            options.append(outputs[2])
            return outputs

        assert differences(agent, kept) < 1e-5
    assert any((first != second).any() for first, second in pairwise(options))


def test_the_file_acts_as_the_agent_on_raw_observations_alone_and_in_a_batch(own_agent, own_session):
    session, _ = own_session
    inputs = own_inputs()
    outputs = session.run(None, inputs)
    own_agent.reset()
    own_agent.act(own_observations(), {"action_mask": inputs["action_mask"]})
    discrete, _, option = outputs
    for found, key in ((discrete, keys.DISCRETE), (option, keys.OPTION)):
        expected = own_agent._last[key].numpy()
        assert found.dtype == expected.dtype and len({*expected}) > 1
        np.testing.assert_array_equal(found, expected)
    for alone, together in zip(
        session.run(None, {name: each[:1] for name, each in inputs.items()}), outputs, strict=True
    ):
        np.testing.assert_allclose(alone, together[:1], rtol=1e-5)


def test_the_file_holds_an_option_until_a_decision_is_due_where_it_may_be_any_number(own_session):
    session, _ = own_session
    held = np.arange(8) % 3
    inputs = {name: each[:8] for name, each in own_inputs().items()}
    inputs |= {"observation": inputs["observation"][:1].repeat(8, 0), "action_mask": np.ones((8, 2), bool)}
    inputs |= {"held_option": held, "is_decision": np.zeros(8, bool)}
    np.testing.assert_array_equal(session.run(["option"], inputs)[0], held)
    chosen = session.run(["option"], {**inputs, "is_decision": np.arange(8) < 4})[0]
    assert len({*chosen[:4]}) == 1
    np.testing.assert_array_equal(chosen[4:], held[4:])
    inputs["is_decision"] = np.ones(8, bool)
    expected, found = (
        session.run(None, {**inputs, "held_option": of}) for of in (held, np.array([-1, 3, 99, 0, 1, 2, 7, -9]))
    )
    assert all(map(np.array_equal, found, expected))


@pytest.mark.parametrize("name", ["termination", "chosen"])
def test_selectors_that_read_the_held_option_ignore_it_at_a_decision(name):
    agent = fresh_agent(*CASES[name])
    ((vectors, info),) = steps(agent, 1, 3)
    inputs = {keys.OBSERVATION: vectors, **info, keys.IS_DECISION: np.ones(3, bool), HELD_LENGTH: np.full(3, 99)}
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        expected, found = (traced_step(agent)({**inputs, HELD_OPTION: np.full(3, number)}) for number in (0, 99))
    assert all(map(np.array_equal, found, expected))


class Parts(Plain):
    """Several components, each with numbers of its own."""

    action_space = spaces.Dict(
        a=spaces.MultiDiscrete([3, 2], start=[4, -1]),
        b=spaces.Box(-3, 4, (2,), np.int64),
        c=spaces.Box(1.7e9, 1.7e9 + 9.0, (1,), np.float64),
        d=spaces.Discrete(2, start=3),
    )


def own(name: str) -> list[str]:
    return ["env=gymnasium", f"env.entry_point=test_export:{name}", "env.max_steps=9"]


def about(session) -> dict:
    return {name: json.loads(value) for name, value in session.get_modelmeta().custom_metadata_map.items()}


def test_numbers_that_float32_cannot_hold_are_those_of_the_environment(own_agent, own_session):
    session, _ = own_session
    assert session.get_inputs()[0].type == "tensor(double)"
    said = about(session)
    assert (said["discrete_starts"], said["option_start"]) == ([5], 7)
    assert said["parameter_low"] == [1.7e9, 2e7, 2e7, -5e7, -5e7, 0.0, -3.0]
    assert said["parameter_high"] == [1.7e9 + 3600.0, 20_000_009, 20_000_009, 5e7, 5e7, 9.0, 4.0]
    assert said["integer_parameters"] == [False, True, True, True, True, False, True]
    discrete, parameters, option = session.run(None, own_inputs())
    own_agent.reset()
    acted = own_agent.act(own_observations(), {"action_mask": own_inputs()["action_mask"]})
    chosen, (seconds, (counts, many, real, few)) = acted["action"]
    np.testing.assert_array_equal(discrete + said["discrete_starts"][0], chosen)
    np.testing.assert_array_equal(option + said["option_start"], acted["option"])
    np.testing.assert_allclose(parameters[:, :1], seconds, rtol=0.0, atol=1e-2)
    np.testing.assert_array_equal(parameters[:, 1:3], counts)
    np.testing.assert_allclose(parameters[:, 3:5], many, rtol=0.0, atol=1e3)  # float32 has 1e-5 of the width
    np.testing.assert_allclose(parameters[:, 5:6], real, atol=1e-4)
    np.testing.assert_array_equal(parameters[:, 6:], few)
    assert (parameters[:, said["integer_parameters"]] % 1.0 == 0.0).all()


@pytest.mark.parametrize("low", ["hppo", *(pytest.param(low, marks=pytest.mark.slow) for low in ("pdqn", "hsac"))])
def test_each_component_says_the_number_of_its_first_action(low, tmp_path):
    agent = fresh_agent(*own("Parts"), "high=none", f"low={low}")
    agent.export(tmp_path / "a.onnx")
    session = session_of(tmp_path / "a.onnx")
    said = about(session)
    assert said["discrete_starts"] == [4, -1, 0, 0, 3]
    vectors = np.random.default_rng(0).uniform(-1.0, 1.0, (64, 2)).astype(np.float32)
    discrete, parameters = session.run(None, {"observation": vectors})
    acted = agent.act(vectors)
    numbers = discrete + said["discrete_starts"]
    np.testing.assert_array_equal(numbers[:, :2], acted["a"])
    np.testing.assert_array_equal(numbers[:, 4], acted["d"])
    np.testing.assert_array_equal(parameters[:, :2], acted["b"])
    np.testing.assert_allclose(parameters[:, 2:], acted["c"], rtol=0.0, atol=1e-4)


def test_the_file_says_what_its_numbers_mean_and_holds_no_code(own_session):
    session, data = own_session
    said = about(session)
    assert said["option_names"] == ["slow", "medium", "fast"]
    assert said["parameter_dims"] == [1, 6]
    assert (said["high"], said["low"], said["env"]) == ("linucb", "hppo", "gymnasium")
    assert said["hpamdp_version"] == hpamdp.__version__
    shapes = {each.name: each.shape for each in (*session.get_inputs(), *session.get_outputs())}
    assert shapes["observation"] == ["N", 6] and shapes["parameters"] == ["N", 7]
    assert not [word for word in (b".py", b"import ", b"def ", b"site-packages") if word in data]


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_file_acts_as_the_agent(name, tmp_path):
    agent = fresh_agent(*CASES[name])
    agent.export(tmp_path / "a.onnx")
    session = session_of(tmp_path / "a.onnx")
    assert differences(agent, lambda inputs: session.run(None, inputs)) < 1e-5
    assert differences(agent, lambda inputs: session.run(None, inputs), num_rows=1) < 1e-5


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*PLATFORM, "low=dlpa"], "DLPA cannot be exported: it plans at every step"),
        (["high=oracle", "low=hppo"], "Oracle cannot be exported: it reads oracle entries"),
        (["high=uniform", "low=hppo"], "cannot be exported: it samples even if it acts greedily"),
        ([*PLATFORM, "low=hppo", "low.greedy_discrete=sampled"], "it samples even if it acts greedily"),
    ],
)
def test_an_agent_that_cannot_be_exported_is_refused_in_one_line(words, message, tmp_path):
    agent = fresh_agent(*words)
    with pytest.raises(hpamdp.ConfigError, match=message) as refusal:
        agent.export(tmp_path / "a.onnx")
    assert "\n" not in str(refusal.value) and not [*tmp_path.iterdir()]


def test_a_missing_package_is_one_line_that_names_the_extra(own_agent, tmp_path, monkeypatch):
    found = importlib.util.find_spec
    monkeypatch.setattr("hpamdp.api.export.find_spec", lambda name: None if name == "onnxscript" else found(name))
    with pytest.raises(hpamdp.ConfigError, match=r"onnxscript not installed; pip install 'hpamdp\[onnx\]'"):
        own_agent.export(tmp_path / "a.onnx")
