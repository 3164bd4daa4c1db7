"""DLPA: the planner in a true model, the forms of the learned one, its windows and loss, and a problem it solves."""

import pytest
import torch
from tensordict import TensorDict
from torch.nn import functional as F
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.env.boatdock import episode, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.policies.low_level.dlpa import DLPA, Plan, Planner
from hpamdp.policies.low_level.dlpa_model import PAMDPModel, Prediction
from hpamdp.specs import PAMDPSpecs

SPECS = PAMDPSpecs(4, (), (1, 2, 0), (0.0, -1.0, 5.0), (2.0, 1.0, 9.0))
FORMS = ["parallel", "masking", "sequential"]

SEARCH = dict(
    horizon=2, num_samples=64, num_elites=8, num_iterations=5, temperature=0.1, momentum=0.1, min_deviation=0.02,
    gamma=0.9, pessimism=0.0,
)  # fmt: skip
OPTIONS = dict(
    form="masking", hidden_dims=[64, 64], num_members=2, lr=2e-3, state_weight=2.0, reward_weight=0.5,
    termination_weight=0.5, rho=0.5, buffer_size=5000, batch_size=64, updates_per_frame=0.5, warmup_frames=500,
    epsilon=0.05, planning_precision="float32", **SEARCH,
)  # fmt: skip


def make(specs: PAMDPSpecs = SPECS, **changes) -> DLPA:
    return DLPA(specs, torch.device("cpu"), **{**OPTIONS, **changes})


def boats(seen: torch.Tensor) -> episode.BoatState:
    """Return the boats of scaled observations `[N, 16]`."""
    lengths = seen[:, [0, 1, 2, 3, 8, 9]] * physics.HARBOUR_RADIUS
    zeros = torch.zeros(len(seen), dtype=torch.int32)
    still = torch.zeros(len(seen))
    return episode.BoatState(
        *lengths.unbind(-1), still, still, seen[:, 12] * physics.TANK, seen[:, 7].int(), zeros + 1, zeros, zeros, zeros
    )


def true_model(state: torch.Tensor, discrete: torch.Tensor, unit: torch.Tensor) -> Prediction:
    """Predict a press of the boat task as it is."""
    rules, seed, row = episode.Rules("congruent"), torch.zeros((), dtype=torch.int32), torch.arange(len(state)).int()
    before = boats(state)
    after, reward, _ = episode.step(before, before.controller, discrete, unit + 1.0, seed, row, rules)
    reading = episode.read(after, seed, row, rules)
    logit = torch.where(reading.terminated.squeeze(-1), 50.0, -50.0)
    return Prediction(reading.observation, reward[None], reward[None], logit[None])


def test_planning_in_the_true_model_comes_close_to_the_ceiling():
    env = BoatDockEnv(100, controller="congruent")
    search = {**SEARCH, "num_samples": 256, "num_elites": 32, "gamma": 0.99}
    planner = Planner(true_model, PAMDPSpecs.from_env(env), **search)
    torch.manual_seed(0)
    td = env.reset(env.fixed_episodes(0))
    ceiling = env.describe()["optimum"][:, 1].mean()
    for _ in range(8):
        plan = planner.plan(td[keys.OBSERVATION])
        td[keys.ACTION] = {"discrete": plan.probability[:, 0].argmax(-1), "parameters": plan.mean[:, 0] + 1.0}
        td = env.step_mdp(env.step(td))
        if td[keys.DONE].all():
            break
    assert env.results(td)["score"].mean() >= 0.95 * ceiling


@pytest.mark.parametrize("form", FORMS)
def test_a_model_of_every_form_sees_the_pressed_keys_own_parameters_alone(form):
    model = PAMDPModel(SPECS, form, [32, 32], 3)
    state, discrete, unit = torch.randn(90, 4), torch.arange(3).repeat(30), torch.rand(90, 3) * 2 - 1
    predicted = model(state, discrete, unit)
    assert predicted.next_state.shape == (90, 4)
    assert all(part.shape == (3, 90) for part in predicted[1:])
    own = SPECS.parameter_mask[discrete]
    same = model(state, discrete, torch.where(own, unit, torch.rand(90, 3)))
    assert all(torch.equal(a, b) for a, b in zip(predicted, same, strict=True))
    other = model(state, discrete, torch.where(own, -unit, unit))
    has_parameters = discrete < 2
    assert ((other.logit - predicted.logit).abs().amin(0) > 0)[has_parameters].all()
    assert torch.equal(other.logit[:, ~has_parameters], predicted.logit[:, ~has_parameters])


def test_the_h_step_loss_is_what_a_hand_computation_gives_with_an_end_inside_the_window():
    learner = make(horizon=3, num_members=2)
    learner.model.fit_scales(torch.randn(50, 4), torch.randn(50, 4))
    windows = TensorDict(
        {
            "state": torch.randn(2, 3, 4),
            "next_state": torch.randn(2, 3, 4),
            "discrete": torch.tensor([[0, 1, 2], [1, 0, 1]]),
            "unit": torch.rand(2, 3, 3) * 2 - 1,
            "reward": torch.randn(2, 3),
            "terminated": torch.tensor([[False, True, False], [False, False, False]]),
            "valid": torch.tensor([[True, True, False], [True, True, True]]),
        },
        [2, 3],
    )
    expected = dict.fromkeys(("state", "reward", "termination"), 0.0)
    for window, num_steps in zip(windows.unbind(0), (2, 3), strict=True):
        state = window["state"][0]
        for h in range(num_steps):
            row = window[h]
            predicted = learner.model(state[None], row["discrete"][None], row["unit"][None])
            state, ends = predicted.next_state[0], row["terminated"]
            weight = 0.5**h / 2
            if not ends:
                expected["state"] += weight * (((state - row["next_state"]) / learner.model.change_scale) ** 2).mean()
            reward = predicted.terminating if ends else predicted.continuing
            expected["reward"] += weight * ((reward - row["reward"]) ** 2).mean()
            label = torch.full((2, 1), float(ends))
            expected["termination"] += weight * F.binary_cross_entropy_with_logits(predicted.logit, label)
    losses = learner.losses(windows)
    for name, value in expected.items():
        torch.testing.assert_close(losses[name], value)


def counting_batches(num_environments: int, num_batches: int, num_steps: int) -> list[TensorDict]:
    """Return batches whose observations say environment, episode and step, and what comes next; options in turn."""
    batches, clock = [], [[0, 0] for _ in range(num_environments)]
    for _ in range(num_batches):
        batch = TensorDict({}, [num_environments, num_steps])
        seen = torch.zeros(2, num_environments, num_steps, 4)
        over = torch.zeros(num_environments, num_steps, 1, dtype=torch.bool)
        option = torch.zeros(num_environments, num_steps, dtype=torch.long)
        for e in range(num_environments):
            for t in range(num_steps):
                number, step = clock[e]
                seen[0, e, t] = torch.tensor([e, number, step, 0.0])
                seen[1, e, t] = torch.tensor([e, number, step + 1, 0.0])
                over[e, t] = step == (number + e) % 5
                option[e, t] = (number + e) % 2
                clock[e] = [number + 1, 0] if over[e, t] else [number, step + 1]
        batch[keys.OBSERVATION], batch[keys.OPTION] = seen[0], option
        batch[keys.ACTION] = {"discrete": option, "parameters": torch.zeros(*batch.shape, 3)}
        is_cut = over & (seen[0, ..., 1:2] % 3 == 0)
        batch["next"] = {keys.OBSERVATION: seen[1], keys.REWARD: torch.zeros(over.shape), keys.DONE: over}
        batch["next", keys.TERMINATED] = over & ~is_cut
        batches.append(batch)
    return batches


@pytest.mark.parametrize("buffer_size", [5000, 40])
def test_windows_follow_an_episode_across_batches_and_cross_no_end_environment_or_option(buffer_size):
    learner = make(horizon=3, buffer_size=buffer_size)
    for batch in counting_batches(4, 12, 3):
        learner.store(batch, batch[keys.OPTION] == 1)
    windows = learner.windows()
    seen, valid = windows["state"], windows["valid"]
    assert valid[:, 0].all() and (windows["discrete"] == 1).all()
    for h in (1, 2):
        follows = (seen[:, h] == seen[:, h - 1] + torch.tensor([0.0, 0.0, 1.0, 0.0])).all(-1)
        assert follows[valid[:, h]].all(), "a window left its episode or skipped a step"
        assert not (valid[:, h] & windows["over"][:, h - 1]).any()
        # What is known to follow is in the window; the newest steps have no successor yet.
        is_old = seen[:, h - 1, 1] < seen[..., 1].max() - 3
        assert (valid[:, h] | windows["over"][:, h - 1] | ~valid[:, h - 1] | ~is_old).all()
    assert valid[:, 2].any()


def test_the_elites_make_the_next_distribution_key_by_key():
    planner = Planner(None, SPECS, **{**SEARCH, "horizon": 1, "num_samples": 5, "num_elites": 4, "temperature": 0.5})
    plan = Plan(torch.tensor([[[0.2, 0.3, 0.5]]]), torch.full((1, 1, 3), 0.1), torch.full((1, 1, 3), 0.7))
    discrete = torch.tensor([0, 0, 2, 0, 1]).view(1, 5, 1)
    unit = torch.tensor([0.5, -0.5, 0.9, 0.3, 0.9]).view(1, 5, 1, 1).expand(1, 5, 1, 3)
    returns = torch.tensor([[1.0, 0.5, 0.2, 0.8, -3.0]])
    new = planner.re_estimate(plan, discrete, unit, returns)
    weight = (torch.tensor([1.0, 0.5, 0.2, 0.8]) / 0.5).exp()
    weight = weight / weight.sum()
    own = weight[[0, 1, 3]] / weight[[0, 1, 3]].sum()
    x = torch.tensor([0.5, -0.5, 0.3])
    mean = (own * x).sum()
    deviation = (own * (x - mean) ** 2).sum().sqrt()
    share = torch.tensor([weight[[0, 1, 3]].sum(), 0.0, weight[2]])
    torch.testing.assert_close(new.probability[0, 0], 0.1 * plan.probability[0, 0] + 0.9 * share)
    torch.testing.assert_close(new.mean[0, 0], torch.tensor([0.1 * 0.1 + 0.9 * mean, 0.1, 0.1]))
    torch.testing.assert_close(new.deviation[0, 0], torch.tensor([0.1 * 0.7 + 0.9 * deviation, 0.7, 0.7]))


def test_a_return_counts_what_comes_after_by_the_probability_of_getting_there():
    def model(state, discrete, unit):
        one = torch.ones(2, len(state))
        return Prediction(state, 2.0 * one, torch.stack([3.0 * one[0], 5.0 * one[0]]), torch.zeros(2, len(state)))

    planner = Planner(model, SPECS, **{**SEARCH, "gamma": 0.5, "pessimism": 0.5})
    found = planner.returns(torch.zeros(1, 4), torch.zeros(1, 7, 2, dtype=torch.long), torch.zeros(1, 7, 2, 3))
    members = torch.tensor([2.5, 3.5]) * (1.0 + 0.5 * 0.5)
    torch.testing.assert_close(found, (members.mean() - 0.5 * members.std(correction=0)).expand(1, 7))


def one_step_rows(learner: DLPA, num: int) -> TensorDict:
    """Play a problem of one step: only key 1 pays, the more the nearer its parameters are to (s0, -s1)."""
    td = TensorDict({keys.OBSERVATION: torch.rand(num, 1, 4) * 2 - 1}, [num, 1])
    td = learner.policy(td)
    unit, state = learner.specs.to_unit(td[keys.PARAMETERS]), td[keys.OBSERVATION]
    error = (unit[..., 1] - state[..., 0]).square() + (unit[..., 2] + state[..., 1]).square()
    over = torch.ones(num, 1, 1, dtype=torch.bool)
    reward = torch.where(td[keys.DISCRETE] == 1, 1.0 - error, -0.5).unsqueeze(-1)
    td["next"] = {keys.OBSERVATION: state, keys.REWARD: reward, keys.DONE: over, keys.TERMINATED: over}
    return td


@pytest.fixture(scope="module")
def trained() -> DLPA:
    torch.manual_seed(0)
    learner = make(horizon=1)
    for _ in range(12):
        learner.learn(one_step_rows(learner, 100), torch.ones(100, 1, dtype=torch.bool))
    return learner


def test_the_learner_finds_the_key_and_parameters_that_pay(trained):
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rows = one_step_rows(trained, 500)
    assert (rows[keys.DISCRETE] == 1).float().mean() > 0.98
    assert rows["next", keys.REWARD].mean() > 0.85, "random presses earn about -0.4, the optimum 1"


def test_a_greedy_press_is_a_function_of_the_seed_and_lies_in_bounds(trained):
    td = TensorDict({keys.OBSERVATION: torch.randn(50, 4)}, [50])
    pressed = []
    for seed in (3, 3):
        torch.manual_seed(seed)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            pressed.append(trained.policy(td.clone()))
    assert torch.equal(pressed[0][keys.DISCRETE], pressed[1][keys.DISCRETE])
    assert torch.equal(pressed[0][keys.PARAMETERS], pressed[1][keys.PARAMETERS])
    duration = trained.policy(td.clone())[keys.PARAMETERS]
    assert (duration >= torch.tensor(SPECS.parameter_low)).all()
    assert (duration <= torch.tensor(SPECS.parameter_high)).all()


def test_no_plan_is_made_for_episodes_that_are_over_nor_before_anything_is_learned(trained, monkeypatch):
    planned = []
    plan = trained.policy.planner.plan
    monkeypatch.setattr(trained.policy.planner, "plan", lambda state: planned.append(len(state)) or plan(state))
    over = (torch.arange(50) < 20).unsqueeze(-1)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        trained.policy(TensorDict({keys.OBSERVATION: torch.randn(50, 4), keys.DONE: over}, [50]))
        assert planned == [30]
        fresh = make()
        monkeypatch.setattr(fresh.policy.planner, "plan", None)
        fresh.policy(TensorDict({keys.OBSERVATION: torch.randn(50, 4)}, [50]))


def test_the_state_change_is_scaled_by_its_own_deviation_over_the_warm_up():
    learner = make(updates_per_frame=1e-3, warmup_frames=12 * 4)
    batches = counting_batches(4, 6, 3)
    for batch in batches:
        learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))
    seen = torch.cat(batches[:4], 0)
    change = (seen["next", keys.OBSERVATION] - seen[keys.OBSERVATION]).flatten(0, 1).std(0).clamp(min=1e-2)
    torch.testing.assert_close(learner.model.change_scale, change)


def test_more_elites_than_samples_are_refused():
    with pytest.raises(ValueError, match="num_elites=200"):
        make(num_elites=200)
