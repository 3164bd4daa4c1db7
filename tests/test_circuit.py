"""CircuitEnv builds the circuits of the source, against a small simulator of its own, and judges gate sets rightly."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np
import pytest
import torch
from batched_players import action, random_player, restart
from scipy.optimize import minimize
from torch import Tensor
from torchrl.envs.utils import check_env_specs

import hpamdp
from hpamdp import keys
from hpamdp.env.circuit import compiler, gates, rules
from hpamdp.env.circuit.environment import CircuitEnv
from hpamdp.env.circuit.known_circuits import CIRCUITS
from hpamdp.env.circuit.options import NATIVE_SETS
from hpamdp.env.circuit.rules import MATCHED, MISSED, TASK_OF, TASKS
from hpamdp.specs import PAMDPSpecs

UNIT, X, Y = np.eye(2), np.array([[0, 1], [1, 0]]), np.array([[0, -1j], [1j, 0]])
ZERO, ONE = np.diag([1.0, 0.0]), np.diag([0.0, 1.0])
NATIVE = {"task": "random_state", "gate_set": "choose"}


def on_wires(n: int, **of_wire) -> np.ndarray:
    """Return the tensor product of matrices, `q0` etc.; wire 0 is the last factor, as in Qiskit."""
    product = np.eye(1)
    for wire in reversed(range(n)):
        product = np.kron(product, of_wire.get(f"q{wire}", UNIT))
    return product


def rotation(generator: np.ndarray, angle: float) -> np.ndarray:
    """Return exp(-i angle generator / 2) of a generator whose square is 1."""
    return math.cos(angle / 2) * np.eye(len(generator)) - 1j * math.sin(angle / 2) * generator


def gate(name: str, angle: float, n: int) -> np.ndarray:
    """Return the operator of a gate on n wires. A name such as `cx 1 0` has the control first."""
    kind, *wires = name.split()
    *control, wire = (f"q{number}" for number in wires)
    phase = np.diag([1.0, np.exp(1j * angle)])
    if kind == "xx":
        return rotation(on_wires(n, **{control[0]: X, wire: X}), angle)
    if kind in ("cp", "cx"):
        inner = phase if kind == "cp" else X
        return on_wires(n, **{control[0]: ZERO}) + on_wires(n, **{control[0]: ONE, wire: inner})
    root = np.array([[1 + 1j, 1 - 1j], [1 - 1j, 1 + 1j]]) / 2
    single = {"p": phase, "rz": phase, "rx": rotation(X, angle), "ry": rotation(Y, angle), "sx": root}[kind]
    return on_wires(n, **{wire: single})


class Circuit:
    """A circuit as a list of gates, for comparison."""

    def __init__(self, n: int) -> None:
        self.operator = np.eye(2**n, dtype=complex)
        self.n, self.depths = n, [0] * n

    def add(self, name: str, angle: float) -> None:
        if name == "stop":
            return
        self.operator = gate(name, angle, self.n) @ self.operator
        wires = [int(number) for number in name.split()[1:]]
        depth = 1 + max(self.depths[wire] for wire in wires)
        for wire in wires:
            self.depths[wire] = depth

    def score(self, target: np.ndarray, limit: int) -> float:
        if target.shape[1] > 1:
            similarity = 1.0 - 2.0 * math.atan(np.linalg.norm(self.operator - target)) / math.pi
        else:
            similarity = abs(np.vdot(self.operator[:, 0], target)) ** 2
        return similarity - max(0.0, max(self.depths) - limit / 3) / (1.5 * limit)


def targets_of(env: CircuitEnv) -> np.ndarray:
    return rules.circuit_and_target(env.state, env.design)[1].numpy().astype(complex)


def act(env: CircuitEnv, number: Tensor | int, angle: Tensor | float = 0.0, option: Tensor | None = None):
    number = torch.as_tensor(number).expand(env.num_envs)
    angle = torch.as_tensor(angle, dtype=torch.float32).expand(env.num_envs)
    taken = action(number, angle.unsqueeze(-1).expand(-1, sum(env.parameter_dims)))
    return env.step(taken if option is None else taken.set(keys.OPTION, option))["next"]


@pytest.mark.parametrize("task", TASKS)
def test_random_circuits_score_as_a_simulator_of_tensor_products_says(task):
    env = CircuitEnv(40, task=task, seed=3, observe_depth=True)
    env.reset()
    targets = targets_of(env)
    n, limit = TASK_OF[task].n, TASK_OF[task].depth
    circuits = [Circuit(n) for _ in range(40)]
    generator = torch.Generator().manual_seed(0)
    stop, has_ended = len(env.discrete_names) - 1, [False] * 40
    for step in range(20):
        # No stop before the last step.
        number = torch.randint(stop, (40,), generator=generator) if step < 19 else torch.full((40,), stop)
        angle = (2.0 * torch.rand(40, generator=generator) - 1.0) * math.pi
        reading = act(env, number, angle)
        for row, circuit in enumerate(circuits):
            if has_ended[row]:
                continue
            circuit.add(env.discrete_names[number[row]], float(angle[row]))
            has_ended[row] = bool(reading[keys.DONE][row])
            assert has_ended[row] == (step == 19 or max(circuit.depths) >= limit)
            score = circuit.score(targets[row], limit)
            assert reading[keys.REWARD][row].item() == pytest.approx(score if has_ended[row] else 0.0, abs=2e-5)
            assert env.results(reading)["score"][row].item() == pytest.approx(score, abs=2e-5)
            made = reading[keys.OBSERVATION][row, : 2 * env.design.num_numbers].numpy()
            real, imaginary = made.reshape(2, -1, env.design.num_columns)
            np.testing.assert_allclose(real + 1j * imaginary, circuit.operator[:, : real.shape[1]], atol=1e-5)
            depths = limit * reading[keys.OBSERVATION][row, 4 * env.design.num_numbers :]
            assert depths.tolist() == pytest.approx(circuit.depths, abs=1e-4)
    assert all(has_ended)


@pytest.mark.parametrize("gate_set", NATIVE_SETS)
def test_native_circuits_have_the_simulators_fidelity_and_the_sum_of_their_gates_costs(gate_set):
    env = CircuitEnv(30, task="random_state", gate_set=gate_set, seed=5)
    env.reset()
    targets = targets_of(env)
    circuits = [Circuit(2) for _ in range(30)]
    generator = torch.Generator().manual_seed(1)
    one, two = env.options.costs(gate_set)
    prices = {"rz": 0.0, "sx": one, "rx": one, "ry": one, "cx": two, "xx": two}
    costs = [0.0] * 30
    for _ in range(6):
        number = torch.randint(len(env.discrete_names) - 1, (30,), generator=generator)
        angle = (2.0 * torch.rand(30, generator=generator) - 1.0) * math.pi
        reading = act(env, number, angle)
        for row, circuit in enumerate(circuits):
            name = env.discrete_names[number[row]]
            circuit.add(name, float(angle[row]))
            costs[row] += prices[name.split()[0]]
    results = env.results(reading)
    fidelity = [
        abs(np.vdot(circuit.operator[:, 0], target)) ** 2 for circuit, target in zip(circuits, targets, strict=True)
    ]
    assert results["similarity"].tolist() == pytest.approx(fidelity, abs=1e-5)
    assert results["cost"].tolist() == pytest.approx(costs, abs=1e-5)


@pytest.mark.parametrize(
    ("task", "mean"),
    [
        ("hadamard", 0.2952),
        ("random_state", 0.25),
        ("bell", 0.5),
        ("ghz", 0.5),
        ("random_unitary", 0.2187),
        ("toffoli", 0.2952),
    ],
)
def test_a_circuit_without_gates_has_the_known_score(task, mean):
    env = CircuitEnv(20_000 if "random" in task else 1, task=task)
    env.reset()
    reading = act(env, len(env.discrete_names) - 1)
    assert reading[keys.DONE].all() and (reading[keys.OUTCOME] == MISSED).all()
    assert reading[keys.REWARD].mean().item() == pytest.approx(mean, abs=0.004 if "random" in task else 1e-4)


@pytest.mark.parametrize("gate_set", ["choose", "superconducting", "ion"])
def test_all_tensors_of_native_gates_are_as_the_specs_say(gate_set):
    check_env_specs(CircuitEnv(3, task="bell", gate_set=gate_set, oracle=True), return_contiguous=True)


@pytest.mark.parametrize("task", TASKS)
def test_learners_see_the_sources_actions_and_observations(task):
    env = CircuitEnv(2, task=task)
    n, num = TASK_OF[task].n, 2 ** TASK_OF[task].n
    specs = PAMDPSpecs.from_env(env)
    assert specs.num_discrete == 2 * n * n + 1
    assert specs.observation_dim == 4 * (num * num if TASK_OF[task].is_operator else num)
    assert specs.num_parameters == n * n + n  # phases, controlled or not, and rotations
    assert set(specs.parameter_high) == {float(np.float32(math.pi))}
    assert set(specs.parameter_low) == {-float(np.float32(math.pi))}


@pytest.mark.parametrize(("task", "floor"), [("random_state", None), ("toffoli", None), ("toffoli", 0.1)])
def test_gain_is_how_much_the_final_score_exceeds_the_floor_and_never_negative(task, floor):
    gaining = {"task": task, "reward": "gain", "floor": floor, "max_steps": 3}
    final, gain = CircuitEnv(400, task=task, max_steps=3), CircuitEnv(400, **gaining)
    returns = []
    for env in (final, gain):
        player = random_player(4)
        reading, total = env.reset(), torch.zeros(400)
        without_gates = rules.similarity(*rules.circuit_and_target(env.state, env.design), env.design)
        while not reading[keys.DONE].all():
            reading = env.step(player(env))["next"]
            total += reading[keys.REWARD].squeeze(-1)
        returns.append(total)
    counts_from = without_gates if floor is None else floor
    assert torch.allclose(returns[1], (returns[0] - counts_from).clamp(min=0.0), atol=1e-5)
    # No three gates bring the identity nearer to the Toffoli gate.
    assert (returns[1] > 0.0).any() == ((task, floor) != ("toffoli", None))


@pytest.mark.parametrize("task", CIRCUITS)
def test_training_may_begin_within_the_known_circuit_and_evaluation_begins_without_gates(task):
    env = CircuitEnv(200, task=task, begin="known")
    circuit = CIRCUITS[task]
    begun = env.reset()[keys.OBSERVATION]
    made = Circuit(TASK_OF[task].n)
    expected = []
    for name, angle in circuit:
        expected.append(made.operator[:, : env.design.num_columns].ravel())
        made.add(name, angle)
    table = torch.from_numpy(np.concatenate([np.real(expected), np.imag(expected)], 1)).float()
    distance = torch.cdist(begun[:, : table.shape[1]], table)
    assert distance.amin(-1).max() < 1e-3
    assert {*distance.argmin(-1).tolist()} == {*range(len(circuit))}
    env.seed_evaluation(1)
    assert torch.allclose(env.reset()[keys.OBSERVATION][:, : table.shape[1]], table[0])


def test_training_begins_with_one_gate_less_of_the_known_circuit_after_as_many_episodes_as_are_said():
    env = CircuitEnv(2000, task="ghz", begin="known", begin_episodes=2)
    circuits = env.design.beginnings[0]
    for episode in range(9):
        env.reset()
        begun = rules.circuit_and_target(env.state, env.design)[0]
        number = (begun.unsqueeze(1) - circuits).abs().sum((-2, -1)).argmin(-1)
        most = min(4, 1 + episode // 2)
        expected = torch.full((4,), 0.25 / 4)  # a quarter of the circuits lack any number of gates
        expected[4 - most :] += 0.75 / most
        torch.testing.assert_close(number.bincount(minlength=4) / 2000, expected, atol=0.04, rtol=0.0)


@pytest.mark.parametrize("reward", get_args(rules.RewardName))
def test_a_circuit_of_as_many_gates_as_are_allowed_is_finished_and_has_its_score(reward):
    env = CircuitEnv(50, task="bell", reward=reward, max_steps=2)
    player = random_player(1)
    reading, total = env.reset(), torch.zeros(50)
    while not reading[keys.DONE].all():
        reading = env.step(player(env))["next"]
        total += reading[keys.REWARD].squeeze(-1)
    assert reading[keys.TERMINATED].all() and not reading[keys.TRUNCATED].any()
    score = env.results(reading)["score"]
    expected = {"final": score, "progress": score - 0.5, "gain": (score - 0.5).clamp(min=0.0)}[reward]
    assert torch.allclose(total, expected, atol=1e-5)


@pytest.mark.parametrize("task", CIRCUITS)
def test_the_planner_finishes_the_textbooks_circuit_wherever_training_begins_in_it_and_scores_1(task):
    env = CircuitEnv(50, task=task, begin="known", oracle=True)
    first = torch.tensor([0, *env.parameter_dims]).cumsum(0)
    td = env.reset()
    steps = []
    while not td[keys.DONE].all():
        plan = td["oracle"]
        gate = plan["discrete"].squeeze(-1)
        parameters = torch.zeros(50, int(first[-1]))
        has_angle = first[gate + 1] > first[gate]
        parameters[has_angle, first[gate][has_angle]] = plan["parameters"][has_angle, 0]
        td = env.step(td.update({"action": {"discrete": gate, "parameters": parameters}}))["next"]
        steps.append(td[keys.DONE].sum())
    assert (td[keys.OUTCOME] == MATCHED).all() and env.results(td)["score"].min() > 0.9999
    assert steps[1] > 0 and len(steps) == len(CIRCUITS[task]) + 1  # some had but one gate to go
    assert len(CIRCUITS[task]) == {"hadamard": 3, "bell": 3, "ghz": 4, "toffoli": 11}[task]


def test_the_closing_table_has_the_score_of_no_gates_for_the_target_at_hand():
    for settings in ({"task": "random_state", "target_number": 0}, {"task": "ghz"}):
        env = CircuitEnv(1, **settings)
        env.reset()
        assert env.references({})["no gates"]["score"] == pytest.approx(float(env.state.similarity), abs=1e-6)
    assert CircuitEnv(1, task="random_state").references({})["no gates"]["score"] == 0.25


@pytest.mark.parametrize("task", ["random_state", "toffoli"])
def test_training_may_begin_as_many_gates_from_the_target_as_are_said_and_evaluation_begins_without_gates(task):
    env = CircuitEnv(60, task=task, begin="near_target", begin_gates=1)
    env.reset()
    made, target = (matrices.to(torch.complex128) for matrices in rules.circuit_and_target(env.state, env.design))
    empty = rules.without_gates(env.design, env.device)
    is_empty = (made - empty).abs().amax((-2, -1)) < 1e-6
    assert 0.3 < is_empty.float().mean() < 0.7
    n = TASK_OF[task].n
    undone = torch.zeros(len(made), dtype=torch.float64)
    for name in env.discrete_names[:-1]:
        for angle in np.linspace(-math.pi, math.pi, 61):
            similarity = rules.similarity(
                torch.from_numpy(gate(name, angle, n).astype(complex)) @ made, target, env.design
            )
            undone = undone.maximum(similarity)
    assert undone[~is_empty].min() > 0.9  # angles six degrees apart
    env.seed_evaluation(1)
    env.reset()
    assert torch.equal(rules.circuit_and_target(env.state, env.design)[0], empty.expand_as(made))


def test_random_targets_are_normalised_uniform_and_new_in_every_episode():
    env = CircuitEnv(4000, task="random_state")
    env.reset()
    states = targets_of(env)[..., 0]
    assert np.abs(np.linalg.norm(states, axis=1) - 1.0).max() < 1e-6
    # The fidelity of a uniformly random state of two wires has the density 3 (1 - F)^2: mean 1/4, variance 3/80.
    fidelity = np.abs(states) ** 2
    assert fidelity.mean(0) == pytest.approx(np.full(4, 0.25), abs=0.02)
    assert fidelity.var(0) == pytest.approx(np.full(4, 3 / 80), abs=0.006)
    assert np.abs((states[:, 0] * states[:, 1].conj()).mean()) < 0.02
    env = CircuitEnv(500, task="random_unitary")
    env.reset()
    operators = targets_of(env)
    assert np.abs(operators @ operators.conj().transpose(0, 2, 1) - np.eye(4)).max() < 1e-5
    assert (np.abs(operators.reshape(500, -1)) ** 2).mean(0) == pytest.approx(np.full(16, 0.25), abs=0.05)
    env.reset()
    assert np.abs(targets_of(env) - operators).max(axis=(1, 2)).min() > 0.05


def test_a_numbered_target_is_the_same_in_training_and_evaluation_whatever_the_seed():
    seen = []
    for number, seed in ((0, 1), (0, 2), (1, 1)):
        env = CircuitEnv(3, task="random_unitary", target_number=number, seed=seed)
        for begin in (env.set_seed, env.seed_evaluation):
            begin(seed)
            observation = env.reset()[keys.OBSERVATION]
            assert (observation == observation[0]).all()
            seen.append(observation[0])
    assert all(torch.equal(seen[0], other) for other in seen[1:4])
    assert not torch.equal(seen[0], seen[4])


def test_the_gate_set_is_read_at_the_first_gate_and_held_for_the_episode():
    env = CircuitEnv(2, **NATIVE)
    reading = env.reset()
    act(env, 2, 1.0, torch.tensor([0, 1]))  # an SX and an RY on wire 0
    reading = act(env, 4, 0.5, torch.tensor([1, 0]))  # a CX and an XX
    assert env.state.gate_set.tolist() == [0, 1]
    assert env.state.cost.tolist() == pytest.approx([0.305, 0.08])
    made = rules.circuit_and_target(env.state, env.design)[0][..., 0].numpy()
    first = gate("cx 0 1", 0.0, 2) @ gate("sx 0", 0.0, 2)
    assert abs(np.vdot(made[0], first[:, 0])) == pytest.approx(1.0, abs=1e-5)  # but for a global phase
    np.testing.assert_allclose(made[1], (gate("xx 0 1", 0.5, 2) @ gate("ry 0", 1.0, 2))[:, 0], atol=1e-6)
    restart(env, reading, torch.tensor([True, False]))
    act(env, 6, 0.0, torch.tensor([1, 0]))
    assert env.state.gate_set.tolist() == [1, 1]


def states(num: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    drawn = rng.normal(size=(num, 4)) + 1j * rng.normal(size=(num, 4))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


SETS = {
    "superconducting": gates.superconducting(2, 0.005, 0.3),
    "ion": gates.ion(2, 0.03, 0.05),
    "costly superconducting": gates.superconducting(2, 0.04, 0.08),
    "costly ion": gates.ion(2, 0.06, 0.06),
}


def state_of(numbers, angles, gate_set) -> np.ndarray:
    state = np.eye(4, dtype=complex)[:, 0]
    for number, angle in zip(numbers, angles, strict=True):
        state = gate(gate_set[number].name, angle, 2) @ state
    return state


@pytest.mark.parametrize("name", SETS)
def test_the_compilers_circuits_have_the_score_that_it_promises(name):
    targets, gate_set = states(20, 1), SETS[name]
    plans = compiler.best(targets, gate_set)
    stop = len(gate_set) - 1
    for target, score, numbers, angles in zip(targets, *plans, strict=True):
        length = int((numbers == stop).argmax())
        assert (numbers[length:] == stop).all()
        made = state_of(numbers[:length], angles[:length], gate_set)
        cost = sum(gate_set[number].cost for number in numbers[:length])
        assert abs(np.vdot(made, target)) ** 2 - cost == pytest.approx(score, abs=1e-6)


@pytest.mark.parametrize("name", ["superconducting", "ion"])
def test_no_circuit_found_by_another_search_beats_the_compilers(name):
    # Any order of the gates, not only the forms, with another optimizer.
    gate_set = SETS[name]
    rng = np.random.default_rng(3)
    best = compiler.best(states(2, 2), gate_set).score
    for target, score in zip(states(2, 2), best, strict=True):
        found = -1.0
        for _ in range(8):
            numbers = rng.integers(len(gate_set) - 1, size=rng.integers(1, 9))
            cost = sum(gate_set[number].cost for number in numbers)

            def loss(angles, numbers=numbers, target=target):
                return -(abs(np.vdot(state_of(numbers, angles, gate_set), target)) ** 2)

            fitted = minimize(loss, rng.uniform(-3.0, 3.0, len(numbers)), options={"maxiter": 60})
            found = max(found, -fitted.fun - cost)
        assert found <= score + 1e-5


def test_the_better_set_depends_on_the_target_and_neither_is_always_better():
    env = CircuitEnv(200, **NATIVE)
    env.seed_evaluation(7)
    env.reset()
    optimum = env.describe()["optimum"]
    share = (optimum[:, 0] > optimum[:, 1]).double().mean().item()
    assert 0.4 < share < 0.7
    # The better set gains this much over always taking the same one.
    assert optimum.amax(-1).mean() - optimum.mean(0).max() > 0.02


@pytest.mark.parametrize("begin", ["empty", "known"])
def test_circuits_that_are_put_elsewhere_have_the_plans_of_that_place(begin):
    env, other = (CircuitEnv(16, task="toffoli", begin=begin, oracle=True, seed=seed) for seed in (2, 3))
    env.reset()
    td = other.reset()
    for _ in range(2):
        gate, angle = td["oracle", "discrete"][:, 0], td["oracle", "parameters"]
        td[keys.DISCRETE], td[keys.PARAMETERS] = gate, angle.repeat(1, other.action_spec[keys.PARAMETERS].shape[-1])
        td = other.step(td)["next"]
        env.state = other.state
        is_unfinished = ~td[keys.DONE].squeeze(-1)
        assert (env.read()["oracle"] == td["oracle"])[is_unfinished].all()


def test_the_oracle_with_the_planner_reaches_the_ceiling_and_always_chooses_right():
    settings = {"env.task": "random_state", "env.gate_set": "choose", "eval.layouts": 4, "film": False}
    sizes = {"num_envs": 4, "steps_per_batch": 4, "total_frames": 16}
    agent = hpamdp.train("circuit", high="oracle", low="planner", progress=False, **sizes, **settings)
    means = agent.evaluate(episodes=50)
    assert means["score"] == pytest.approx(means["ceiling"], abs=1e-4)
    assert means["oracle_agreement"] == means["oracle_agreement_weighted"] == 1.0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"task": "toffoli", "gate_set": "ion"}, "gate_set=ion: native sets are for task=bell and random_state, not"),
        ({"task": "random_state", "begin": "known"}, "begin=known: needs gate_set=published and a target with a"),
        ({"floor": 0.9}, "floor=0.9: needs reward=gain, not reward=final"),
        ({"ion_costs": [0.0, 0.1]}, r"ion_costs=\[0.0, 0.1\]: must lie between 0.001 and 1, and the second"),
        ({"task": "random_unitary", "oracle": True}, "task=random_unitary: nobody knows its best circuits"),
    ],
)
def test_settings_that_make_no_sense_are_refused_in_one_line(settings, words):
    with pytest.raises(ValueError, match=words):
        CircuitEnv(**settings)
