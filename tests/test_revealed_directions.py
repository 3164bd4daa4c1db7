"""Directions of actions that a problem reveals but does not tell: they are remembered, and turn a model's states."""

import re
import signal
from dataclasses import replace

import pytest
import torch
from conftest import make_config
from tensordict import TensorDict
from test_resume import stop_and_resume
from torchrl.envs.utils import ExplorationType, set_exploration_type

import hpamdp
from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.env.boatdock_unseen.environment import UnseenBoatsEnv
from hpamdp.env.boatdock_unseen.rules import OBSERVATION_NAMES
from hpamdp.env.decisions import with_decisions
from hpamdp.geometry import PlaneGeometry, RevealedDirections
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.high_level.uniform import Uniform
from hpamdp.policies.low_level.pets.learner import PETS
from hpamdp.policies.shared.known_directions import KnownDirections
from hpamdp.run.assemble import assemble
from hpamdp.specs import PAMDPSpecs

SMALL = dict(
    gamma=0.97, num_members=3, updates_per_step=4.0, num_iterations=3, greedy_samples=12, planning_precision="float32"
)  # fmt: skip
STATE = "directions_6"
BOAT = slice(OBSERVATION_NAMES.index("boat_x"), OBSERVATION_NAMES.index("boat_y") + 1)


def make(env: UnseenBoatsEnv, **changes) -> PETS:
    torch.manual_seed(0)
    return PETS(PAMDPSpecs.from_env(env), **{**SMALL, **changes})


def sailed(env: UnseenBoatsEnv, learner: PETS, steps: int) -> tuple[TensorDict, torch.Tensor]:
    """Return presses of the policy `[N, T]`, and in which directions the keys pushed, `[N, T, 3, 2]`."""
    tracked = with_decisions(env)
    td, rows, directions = tracked.reset(), [], []
    for _ in range(steps):
        directions.append(env.known_boats(env.state)[0].directions)
        with torch.no_grad():
            td, following = tracked.step_and_maybe_reset(learner.policy(td))
        rows.append(td)
        td = following
    return torch.stack(rows, 1), torch.stack(directions, 1)


def learn(learner: PETS, rolled: TensorDict) -> None:
    learner.learn(rolled, torch.ones(rolled.shape, dtype=torch.bool))


def turned(vector: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
    """Return vectors `[*B, 2]` in the frame whose x axis points along `axis` `[2]`."""
    return torch.stack([vector @ axis, vector[..., 1] * axis[0] - vector[..., 0] * axis[1]], -1)


@pytest.mark.parametrize("frame", ["screen", "first_press"])
@pytest.mark.parametrize("family", ["turned", "any", "strength"])
def test_pressed_keys_have_their_true_directions_until_the_session_ends(frame, family):
    env = UnseenBoatsEnv(8, trips=3, frame=frame, family=family, seed=3)
    rolled, true = sailed(env, make(env, warmup_steps=1000), 40)
    x, y = rolled[STATE].chunk(2, -1)
    known = torch.stack([x, y], -1)
    num_later_trips = 0
    for row in range(8):
        pressed: list[int] = []
        for step in range(40):
            if rolled[keys.EPISODE_STEPS][row, step] == 0:
                pressed = []
            expected = torch.zeros(3, 2)
            if pressed:
                expected[pressed] = true[row, step][pressed]
                if frame == "first_press":
                    expected = turned(expected, true[row, step, pressed[0]])
                num_later_trips += int(rolled[keys.OBSERVATION][row, step, OBSERVATION_NAMES.index("trip")] > 0)
            torch.testing.assert_close(known[row, step], expected, atol=1e-4, rtol=0.0)
            pressed.append(int(rolled[keys.DISCRETE][row, step]))
    assert num_later_trips > 50 and rolled["next", keys.DONE].sum() > 8


@pytest.mark.parametrize(("family", "certainty_of_last"), [("turned", 1.0), ("any", 1.0 / 3.0)])
def test_unknown_directions_are_guessed_opposite_to_the_known_ones(family, certainty_of_last):
    memory = KnownDirections(PAMDPSpecs.from_env(UnseenBoatsEnv(1, family=family)))
    half, height = 0.5, 0.75**0.5
    x = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-half, 1.0, 0.0], [0.0, 1.0, -1.0]])
    y = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [height, 0.0, 0.0], [0.0, 0.0, 0.0]])
    seen_x, seen_y, certainty = memory.table(torch.cat([x, y], -1)).chunk(3, -1)
    # Of two opposite directions, the last row, the opposite says nothing: the guess is then +x.
    expected_x = torch.tensor([[1.0, 1.0, 1.0], [-1.0, 1.0, -1.0], [-half, 1.0, -half], [1.0, 1.0, -1.0]])
    expected_y = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [height, 0.0, -height], [0.0, 0.0, 0.0]])
    torch.testing.assert_close(seen_x, expected_x)
    torch.testing.assert_close(seen_y, expected_y)
    third, last = -1.0 / 3.0, certainty_of_last
    expected = torch.tensor([[-1.0, -1.0, -1.0], [third, 1.0, third], [1.0, 1.0, last], [last, 1.0, 1.0]])
    torch.testing.assert_close(certainty, expected)


@pytest.mark.parametrize("family", ["turned", "any"])
def test_sampled_directions_agree_with_the_known_ones_and_have_their_sum(family):
    memory = KnownDirections(PAMDPSpecs.from_env(UnseenBoatsEnv(1, family=family)))
    torch.manual_seed(0)
    x = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.6, 0.0], [-0.5, 1.0, 0.0]])
    y = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.8, 0.0], [0.75**0.5, 0.0, 0.0]])
    features = torch.cat([memory.table(torch.cat([x, y], -1)), torch.randn(3, memory.num_features - 9)], -1)
    sampled = memory.hypotheses(features, 64)
    assert sampled.shape == (3, 64, memory.num_features)
    torch.testing.assert_close(sampled[..., 9:], features[:, None, 9:].expand(-1, 64, -1))
    assert not memory.unknown(sampled).any()
    directions = sampled[..., :6].unflatten(-1, (2, 3)).mT
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(3, 64, 3))
    torch.testing.assert_close(directions[1, :, 1], torch.tensor([[0.6, 0.8]]).expand(64, -1))
    torch.testing.assert_close(directions[2, :, :2], torch.tensor([[-0.5, 0.75**0.5], [1.0, 0.0]]).expand(64, -1, -1))
    # Each unknown one points everywhere, or where the sum leaves it: in two places after the first.
    assert directions[0].mean(0).abs().max() < 0.1
    if family == "turned":
        torch.testing.assert_close(directions.sum(2), torch.zeros(3, 64, 2), atol=1e-5, rtol=0.0)
        assert len(directions[1, :, 0].round(decimals=3).unique(dim=0)) == 2
    else:
        assert directions[1, :, 0].mean(0).abs().max() < 0.1 and directions[2, :, 2].mean(0).abs().max() < 0.1


def test_the_model_learns_from_states_in_which_certain_presses_go_along_x():
    env = UnseenBoatsEnv(16, seed=3)
    learner = make(env, warmup_steps=1000)
    learn(learner, sailed(env, learner, 20)[0])
    rows = learner.prepared()
    change = (rows["change"] * learner.model.change_scale)[:, :2]  # the boat's place comes first
    goes_on, is_certain = rows["terminated"] == 0.0, rows["action"][:, 0] == 1.0
    certain, guessed = change[goes_on & is_certain], change[goes_on & ~is_certain]
    assert len(certain) > 100 and (certain[:, 0] > 0.0).all()
    torch.testing.assert_close(certain[:, 1], torch.zeros(len(certain)), atol=1e-5, rtol=0.0)
    assert len(guessed) > 10 and guessed[:, 1].abs().mean() > 0.05


def test_predictions_turn_with_the_state_and_the_revealed_directions():
    env = UnseenBoatsEnv(16, seed=3)
    learner = make(env, warmup_steps=64)
    rolled = sailed(env, learner, 10)[0]
    learn(learner, rolled)
    observation, state = rolled[keys.OBSERVATION].flatten(0, 1), rolled[STATE].flatten(0, 1)
    angle = torch.tensor(1.1)
    to_turned = torch.tensor([[angle.cos(), angle.sin()], [-angle.sin(), angle.cos()]])
    other = observation.clone()
    for pair in env.geometry.vectors:
        other[:, list(pair)] = observation[:, list(pair)] @ to_turned
    other_state = (state.unflatten(-1, (2, 3)).mT @ to_turned).mT.flatten(-2)
    has_known = (state != 0.0).any(-1)  # before, the guess is +x in every frame
    predicted = []
    for seen, held in ((observation, state), (other, other_state)):
        features = learner.perception(seen, held, has_seen=True)[has_known].expand(3, -1, -1)
        discrete = torch.arange(features.shape[1]).expand(3, -1) % 3
        predicted.append(learner.model(features, discrete, torch.zeros(*features.shape[:2], 1)))
    expected = predicted[0].next_state.clone()
    for pair in ([0, 1], [2, 3]):
        expected[..., pair] = expected[..., pair] @ to_turned
    torch.testing.assert_close(predicted[1].next_state, expected, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(predicted[1].logit, predicted[0].logit, atol=1e-3, rtol=1e-3)


def test_a_plan_keeps_the_directions_it_began_with():
    learner = make(UnseenBoatsEnv(1))
    features = torch.randn(4, learner.perception.specs.observation_dim)
    following = torch.randn(4, features.shape[-1] - 9)
    imagined = learner.perception.imagined(features, following)
    torch.testing.assert_close(imagined, torch.cat([features[:, :9], following], -1), check_stride=False)


@pytest.mark.slow
def test_a_few_hundred_presses_suffice_to_dock_boats_never_met():
    env = UnseenBoatsEnv(16, seed=3)
    learner = make(env)
    tracked = with_decisions(env)
    following = tracked.reset()
    for _ in range(6):
        rows = []
        for _ in range(4):
            with torch.no_grad():
                td, following = tracked.step_and_maybe_reset(learner.policy(following))
            rows.append(td)
        learn(learner, torch.stack(rows, 1))
    scored = UnseenBoatsEnv(32)
    scored.seed_evaluation(7)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rolled = sailed(scored, learner, 40)[0]
    before_end = rolled["next", keys.DONE].squeeze(-1).cumsum(1) - rolled["next", keys.DONE].squeeze(-1).long() == 0
    trip = rolled[keys.OBSERVATION][..., OBSERVATION_NAMES.index("trip")]
    ended = rolled["next", keys.TRIP_ENDED].squeeze(-1) & before_end & (trip >= 2 / 8)
    score = 5.0 * rolled["next", keys.OBSERVATION][..., OBSERVATION_NAMES.index("last_score")][ended]
    assert len(score) > 100 and score.mean() > 1.0  # random presses score -0.9, and the best plans 3.4


def test_other_settings_remember_no_directions():
    specs = PAMDPSpecs.from_env(UnseenBoatsEnv(1))
    for settings in ({"augment": False}, {"memory": "stack"}):
        learner = PETS(specs, **settings)
        assert not learner.model.frame.turns and STATE not in learner.policy.out_keys


@pytest.mark.parametrize("is_shared", [True, False])
def test_of_two_boats_each_has_the_directions_that_it_has_shown_itself(is_shared):
    torch.manual_seed(0)
    env = UnseenBoatsEnv(8, trips=4, boats=2, seed=3)
    specs = PAMDPSpecs.from_env(env)
    of_learners = [specs.with_option_observed()] if is_shared else [specs.of_option(boat) for boat in range(2)]
    learners = [PETS(own, **{**SMALL, "warmup_steps": 1000}) for own in of_learners]
    agent = HierarchicalAgent(Uniform(specs), learners, specs, is_shared=is_shared)
    tracked = with_decisions(env)
    td, num_of_the_other_boat = tracked.reset(), 0
    shown: list[dict] = [{} for _ in range(8)]
    for _ in range(40):
        boats = env.known_boats(env.state)
        with torch.no_grad():
            td = agent.policy(td)
        state = td["directions_12"].unflatten(-1, (2, 2, 3)).mT
        option = td[keys.OPTION]
        observed = td[keys.OBSERVATION]
        if is_shared:
            observed = torch.cat([observed, torch.nn.functional.one_hot(option, 2)], -1)
        for row in range(8):
            if td[keys.EPISODE_STEPS][row] == 0:
                shown[row] = {}
            expected = torch.zeros(2, 3, 2)
            for place, direction in shown[row].items():
                expected[place] = direction
            torch.testing.assert_close(state[row], expected, atol=1e-4, rtol=0.0)
            held = int(option[row])
            memory = learners[0 if is_shared else held].perception.memory
            known = ~memory.unknown(memory.features(observed[row], td["directions_12"][row]))
            num_shown = sum(boat == held for boat, _ in shown[row])
            assert known.tolist() == [num_shown >= 2 or (held, key) in shown[row] for key in range(3)]
            num_of_the_other_boat += any(boat != held for boat, _ in shown[row])
            key = int(td[keys.DISCRETE][row])
            shown[row][held, key] = boats[held].directions[row, key]
        _, td = tracked.step_and_maybe_reset(td)
    assert num_of_the_other_boat > 50


def test_one_model_of_both_boats_does_not_see_which_of_them_it_is():
    specs = PAMDPSpecs.from_env(UnseenBoatsEnv(1, boats=2)).with_option_observed()
    learner = PETS(specs, **SMALL)
    state = torch.randn(3, 4, learner.perception.specs.observation_dim)
    swapped = torch.cat([state[..., :-2], state[..., -2:].flip(-1)], -1)
    discrete, own = torch.zeros(3, 4, dtype=torch.long), torch.zeros(3, 4, 1)
    assert torch.equal(learner.model(state, discrete, own).logit, learner.model(swapped, discrete, own).logit)


@pytest.mark.parametrize(
    ("changes", "misfit"),
    [
        ({"directions": torch.zeros(1, 3, 2)}, "directions are both known and revealed"),
        ({"revealed": RevealedDirections((2, 3), (0, 1))}, "revealed by 2 entries of the last action, but must be 3"),
        (
            {"revealed": RevealedDirections((2, 3, 4), (0, 1), last_option=1)},
            r"revealed by the entries \(2, 3, 4, 0, 1, 1\), but must be",
        ),
    ],
)
def test_entries_that_cannot_reveal_directions_are_told_of(changes, misfit):
    geometry = PlaneGeometry(vectors=((0, 1),), revealed=RevealedDirections((2, 3, 4), (0, 1)))
    assert geometry.fits(5, (1, 1, 1)) == ""
    told = replace(geometry, **changes).fits(5, (1, 1, 1))
    assert re.match(misfit, told)


RUN = ["env=boatdock_unseen", "high=none", "low=pets", "num_envs=8", "steps_per_batch=4", "total_frames=320"]
RUN += ["eval.layouts=2", "eval.every=0", "log_every=64", "low.updates_per_step=0.1", "low.num_iterations=1"]
RUN += ["low.num_members=2", "low.greedy_samples=8", "low.num_samples=8", "low.horizon=2", "env.trips=2"]


TWO_BOATS = ["env.boats=2", "high=value", "high.untried_first=true", "agent.sharing=shared"]


@pytest.mark.parametrize(
    "words", [pytest.param([], id="one boat"), pytest.param(TWO_BOATS, id="two boats", marks=pytest.mark.slow)]
)
def test_a_run_that_remembers_directions_resumes_to_the_last_bit(words, tmp_path):
    stop_and_resume([*RUN, *words], tmp_path, signal.SIGINT)


QUIET = {"env.trips": 2, "total_frames": 128, "num_envs": 8, "steps_per_batch": 4}
QUIET |= {"eval.every": 0, "eval.layouts": 2, "progress": False}
QUICK = {"low.updates_per_step": 0.5, "low.num_iterations": 1, "low.horizon": 1, "low.greedy_samples": 8}


@pytest.mark.parametrize("second", [{"name": "pets", "augment": False}, {"name": "hppo", "memory": "none"}])
def test_learners_of_which_only_some_remember_directions_are_refused(second):
    more = {**QUIET, **QUICK, "env.boats": 2, "high": "value", "low.per_option": {"boat_2": second}}
    more["low.end_values"] = second["name"] == "hppo"  # which asks for the values of the other boat
    with pytest.raises(
        ConfigError, match=r"low\.per_option: env=boatdock_unseen reveals directions, which all learners"
    ):
        hpamdp.train("boatdock_unseen", low="pets", **more)


@pytest.mark.parametrize("augment", ["auto", "false"])
def test_runs_warn_of_forgotten_trips_only_if_no_directions_are_remembered(augment, capsys):
    assemble(make_config([*RUN, f"low.augment={augment}"]))
    assert ("forgets earlier trips" in capsys.readouterr().err) == (augment == "false")


def test_an_agent_remembers_directions_until_its_session_ends():
    agent = hpamdp.train("boatdock_unseen", high="none", low="pets", **QUIET, **QUICK)
    observation = torch.zeros(len(OBSERVATION_NAMES))
    agent.act(observation.numpy())
    for key, along in ((1, "moved_y"), (3, "moved_x")):
        shown = observation.clone()
        shown[[OBSERVATION_NAMES.index(name) for name in (f"last_key_{key}", along)]] = 1.0
        agent.act(shown.numpy())
    assert agent._last[STATE][0].tolist() == [0.0, 0.0, 1.0, 1.0, 0.0, 0.0]
    agent.reset()
    agent.act(observation.numpy())
    assert agent._last[STATE][0].tolist() == [0.0] * 6
