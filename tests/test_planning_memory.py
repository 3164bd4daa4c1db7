"""Learners that plan, with a memory: what their models see of a session, and that plans end with trips."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_memory import Cue
from toy_trips import Sessions

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.base import States
from hpamdp.policies.low_level.dlpa.learner import DLPA
from hpamdp.policies.low_level.pets.learner import PETS
from hpamdp.policies.shared.planning import Prediction
from hpamdp.specs import PAMDPSpecs

PLANS = dict(
    horizon=1, num_iterations=3, lr=1e-2, warmup_steps=64, updates_per_step=1.0, epsilon=0.1,
    planning_precision="float32", stack_steps=2, memory_size=8, sequence_length=2, burn_in=0,
)  # fmt: skip
SMALL = {
    PETS: dict(
        num_samples=16, greedy_samples=16, num_members=3, transition_dims=[16], outcome_dims=[32, 32], weight_decay=0.1
    ),
    DLPA: dict(num_samples=64, num_elites=8, hidden_dims=[32, 32], batch_size=64),
}
MEMORIES = ["stack", "gru"]
every_planner = pytest.mark.parametrize("kind", SMALL)


def make(env: PAMDPEnv, memory: str, kind: type = PETS, **changes) -> PETS | DLPA:
    torch.manual_seed(0)
    return kind(PAMDPSpecs.from_env(env), **{**PLANS, **SMALL[kind], "memory": memory, **changes})


def played(env: PAMDPEnv, learner: PETS | DLPA, steps: int) -> TensorDict:
    with torch.no_grad():
        return with_decisions(env).rollout(steps, learner.policy, break_when_any_done=False)


def learn(learner: PETS | DLPA, rolled: TensorDict) -> None:
    learner.learn(rolled, torch.ones(rolled.shape, dtype=torch.bool))


@every_planner
@pytest.mark.parametrize(
    ("memory", "low", "high"),
    [
        ("stack", 0.9, 1.0),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in (("none", -1.0, 0.25), ("gru", 0.9, 1.0))),
    ],
)
def test_with_a_memory_plans_use_a_hidden_sign_that_the_step_before_has_revealed(kind, memory, low, high):
    env = Cue(16, length=2)
    learner = make(env, memory, kind)
    for _ in range(7):
        learn(learner, played(env, learner, 4))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rolled = played(Cue(200, length=2, seed=5), learner, 2)
    assert low <= rolled["next", keys.REWARD].sum(1).mean() <= high


@pytest.mark.parametrize("memory", MEMORIES)
def test_the_model_of_pets_learns_from_the_context_in_which_the_policy_acted(memory):
    env = Sessions(3, trips=2, length=3)
    learner = make(env, memory, warmup_steps=1000, sequence_length=2, burn_in=4)
    rolled = played(env, learner, 12)
    learn(learner, rolled)
    acted = learner.perception(rolled[keys.OBSERVATION], rolled[learner.memory_key], has_seen=True).flatten(0, 1)
    expected = learner.model.split(acted)[0]
    assert expected.reshape(3, 12, -1)[:, 3].abs().sum() > 0.0, "a trip begins with what the trip before has shown"
    rows = learner.prepared()
    for sample in learner.sample_batches(3):
        # The observations of a session differ, so they tell which step a row is.
        place = (sample["turned"].unsqueeze(-2) == rows["turned"]).all(-1).long().argmax(-1)
        torch.testing.assert_close(learner._context(sample), expected[place])


@pytest.mark.parametrize("memory", MEMORIES)
def test_imagined_steps_go_into_the_memory_of_pets(memory, monkeypatch):
    learner = make(Sessions(), memory, horizon=3, stack_steps=3)
    seen = []

    def predict(features, discrete, own, precision):
        seen.append(features)
        nothing = features[..., 0] * 0.0
        return Prediction(features[..., -3:] + 1.0, nothing, nothing, nothing - 50.0)

    monkeypatch.setattr(learner.model, "forward", predict)
    state = learner.perception.after(torch.randn(5, 3))
    observation = torch.randn(5, 3)
    features = learner.perception(observation, state)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        learner.policy.plan(features)
    for place in range(3):
        first = seen[-3 + place].reshape(3, 5, -1, features.shape[-1])[:, :, :1]
        torch.testing.assert_close(first, features.expand(3, -1, -1).unsqueeze(2), check_stride=False)
        state = learner.perception.after(observation, state)
        observation = observation + 1.0
        features = learner.perception(observation, state)


@every_planner
def test_the_end_of_a_trip_ends_plans_but_not_the_memory(kind):
    env = Sessions(2, trips=2, length=2)
    learner = make(env, "stack", kind, warmup_steps=1000)
    rolled = played(env, learner, 4)
    learn(learner, rolled)
    assert rolled["next", keys.TERMINATED].squeeze(-1).tolist() == [[False, False, False, True]] * 2
    stored = learner.buffer[:].reshape(2, 4)
    assert stored["terminated"].tolist() == [[False, True, False, True]] * 2
    assert (stored["memory"][:, 2, :3] == rolled[keys.OBSERVATION][:, 1]).all()


@every_planner
@pytest.mark.parametrize("memory", ["stack", pytest.param("gru", marks=pytest.mark.slow)])
def test_values_at_the_ends_of_plans_know_what_is_remembered(memory, kind):
    env = Cue(16, length=2)
    learner = make(env, memory, kind, end_values=True, end_value_lr=1e-2, end_value_tau=0.2, updates_per_step=0.5)
    for _ in range(6):
        learn(learner, played(env, learner, 4))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        observation = torch.tensor([[0.0, 0.5]]).expand(2, -1)
        held = learner.perception.after(torch.tensor([[1.0, 0.0], [-1.0, 0.0]]))
        assert (learner.value(States(observation, memory=held)) > 0.5).all(), (
            "after either cue the right action is known"
        )


def test_with_a_memory_no_states_are_turned():
    specs = PAMDPSpecs.from_env(BoatDockEnv(1, controller="congruent"))
    without, remembering = (PETS(specs, memory=memory) for memory in ("none", "stack"))
    assert without.model.frame.turns and not remembering.model.frame.turns
    assert remembering.model.frame.num_vectors > 0 and remembering.symmetry is None
    with pytest.raises(ValueError, match="augment=true: does not go with memory=stack; use augment=false or"):
        PETS(specs, memory="stack", augment=True)


# DLPA: windows of consecutive steps, each with what the memory knew at its first step.


@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("buffer_size", [1000, 40])
def test_the_windows_of_dlpa_begin_with_what_the_policy_remembered_when_it_acted(memory, buffer_size):
    env = Sessions(3, trips=2, length=3)
    changes = {"sequence_length": 2, "burn_in": 4, "batch_size": 32, "buffer_size": buffer_size}
    learner = make(env, memory, DLPA, horizon=2, warmup_steps=1000, **changes)
    rolled = played(env, learner, 24)
    rolled["next", keys.REWARD] = torch.arange(3.0 * 24).reshape(3, 24, 1)  # tells which step a row is
    for batch in rolled.split(5, 1):  # sessions of six steps, some of them in two batches
        learn(learner, batch)
    acted = learner.perception(rolled[keys.OBSERVATION], rolled[learner.memory_key], has_seen=True).flatten(0, 1)
    seen_by_loss = []
    learner.gradient_step = lambda _, __, windows, first: seen_by_loss.append((windows, learner.features(first))) or {}
    for sample in learner.sample_batches(5):
        learner.update_once(sample)
    for windows, features in seen_by_loss:
        place = windows["reward"].long()
        torch.testing.assert_close(features, acted[place[:, 0]])
        follows = windows["valid"][:, 1]
        assert follows.any() and torch.equal(place[follows, 1], place[follows, 0] + 1)
        assert (place[follows, 1] % 3 != 0).all(), "a window left its trip"


@every_planner
@pytest.mark.parametrize("memory", MEMORIES)
@pytest.mark.parametrize("is_trained", [False, True])
def test_a_planners_memory_sees_every_step_and_is_emptied_by_sessions_not_by_trips(memory, is_trained, kind):
    env = Sessions(3, trips=2, length=2)
    learner = make(env, memory, kind, epsilon=0.5)  # some steps are random even of a trained policy
    learner.policy.is_trained.fill_(is_trained)
    rolled = played(env, learner, 8)
    state = None
    for t in range(8):
        state = learner.perception.after(rolled[keys.OBSERVATION][:, t], None if t % 4 == 0 else state)
        torch.testing.assert_close(rolled[learner.memory_key][:, t], state)


@pytest.mark.parametrize("memory", MEMORIES)
def test_imagined_steps_go_into_the_memory_of_dlpa_in_plans_and_in_its_loss(memory, monkeypatch):
    learner = make(Sessions(), memory, DLPA, horizon=3, stack_steps=3)
    seen = []

    def predict(features, discrete, unit):
        seen.append(features)
        nothing = features[:, 0].expand(2, -1) * 0.0
        return Prediction(features[:, -3:] + 1.0, nothing, nothing, nothing - 50.0)

    monkeypatch.setattr(learner.model, "forward", predict)
    state = learner.perception.after(torch.randn(5, 3))
    observation = torch.randn(5, 3)
    features = learner.perception(observation, state)
    expected, held, ahead = [features], state, observation
    for _ in range(2):
        held = learner.perception.after(ahead, held)
        ahead = ahead + 1.0
        expected.append(learner.perception(ahead, held))
    learner.policy.planner.plan(features)
    for rows, each in zip(seen[-3:], expected, strict=True):
        torch.testing.assert_close(rows.unflatten(0, (5, -1)), each.unsqueeze(1).expand(-1, 64, -1))
    seen.clear()
    columns = {"discrete": torch.zeros(5, 3).long(), "unit": torch.zeros(5, 3, 2), "reward": torch.zeros(5, 3)}
    columns |= {"next_state": torch.zeros(5, 3, 3), "terminated": torch.zeros(5, 3).bool(), "valid": torch.ones(5, 3)}
    learner.losses(columns, features)
    for rows, each in zip(seen, expected, strict=True):
        torch.testing.assert_close(rows, each)


def test_the_loss_of_the_model_trains_the_memory_of_dlpa():
    env = Sessions(3, trips=2, length=3)
    learner = make(env, "gru", DLPA, warmup_steps=1000, horizon=2)
    learn(learner, played(env, learner, 12))
    before = {name: value.clone() for name, value in learner.perception.named_parameters()}
    for sample in learner.sample_batches(1):
        learner.update_once(sample)
    assert before and not any(torch.equal(value, before[name]) for name, value in learner.perception.named_parameters())


def test_dlpa_without_a_memory_plans_from_observations_and_stores_nothing_more():
    env = Sessions(2)
    learner = make(env, "none", DLPA, warmup_steps=1000)
    rolled = played(env, learner, 4)
    learn(learner, rolled)
    assert learner.perception.is_plain and not list(learner.perception.parameters())
    assert learner.model.state_mean.shape == learner.model.change_scale.shape == (3,)
    assert not {"memory", "begins", "previous"} & set(learner.buffer[:].keys())
    sample = next(iter(learner.sample_batches(1)))
    assert torch.equal(learner.features(sample[:, 0]), sample["state"][:, 0])
