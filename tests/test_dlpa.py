"""DLPA: the planner in a true model, the learned model's forms, windows and loss, and a problem that it solves."""

import pytest
import torch
from tensor_rules import boat_rules
from tensordict import TensorDict
from torch.nn import functional as F
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_steps import SPECS, one_step_rows

from hpamdp import keys
from hpamdp.env import counter_rng
from hpamdp.env.boatdock import physics, task
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.options import BoatDockOptions
from hpamdp.env.boatdock.task import BoatState
from hpamdp.env.state_columns import where
from hpamdp.policies.low_level.dlpa.learner import DLPA
from hpamdp.policies.low_level.dlpa.model import PAMDPModel
from hpamdp.policies.low_level.dlpa.planner import Plan, Planner
from hpamdp.policies.shared.planning import Prediction
from hpamdp.specs import PAMDPSpecs

FORMS = ["parallel", "masking", "sequential"]

SEARCH = dict(
    horizon=2, num_samples=64, num_elites=8, num_iterations=5, temperature=0.1, momentum=0.1, min_deviation=0.02,
    gamma=0.9, pessimism=0.0,
)  # fmt: skip
OPTIONS = dict(
    form="masking", hidden_dims=[64, 64], num_members=2, lr=2e-3, state_weight=2.0, reward_weight=0.5,
    termination_weight=0.5, rho=0.5, buffer_size=5000, batch_size=64, updates_per_step=0.5, warmup_steps=500,
    augment=False, epsilon=0.05, planning_precision="float32", end_values=False, end_value_lr=1e-3,
    end_value_tau=0.02, end_value_expectile=0.9, **SEARCH,
)  # fmt: skip


def make(specs: PAMDPSpecs = SPECS, **changes) -> DLPA:
    return DLPA(specs, device=torch.device("cpu"), **{**OPTIONS, **changes})


def boats(seen: torch.Tensor) -> BoatState:
    """Return the boats' state from scaled observations `[N, 16]`."""
    lengths = seen[:, [0, 1, 2, 3, 8, 9]] * physics.HARBOUR_RADIUS
    zeros = torch.zeros(len(seen), dtype=torch.int32)
    still = torch.zeros(len(seen))
    return BoatState(
        *lengths.unbind(-1), still, still, seen[:, 12] * physics.TANK, seen[:, 7].int(), zeros + 1, zeros, zeros, zeros
    )


def true_model(state: torch.Tensor, discrete: torch.Tensor, unit: torch.Tensor) -> Prediction:
    """Predict a step of the boat task with its own rules."""
    rules, row = BoatDockOptions(controller="congruent"), torch.arange(len(state)).int()
    rng = counter_rng.rng_key(counter_rng.seed_tensor(0), counter_rng.NOISE, row, torch.zeros_like(row))
    before = boats(state)
    duration = (unit + 1.0).clamp(0.0, physics.MAX_DURATION).gather(1, discrete.unsqueeze(1)).squeeze(1)
    after, reward = boat_rules.act(before, None, discrete, duration, rng, rules)
    is_over = before.outcome != physics.SAILING
    after, reward = where(is_over, before, after), torch.where(is_over, 0.0, reward)
    logit = torch.where((after.outcome != physics.SAILING) & (after.presses < task.MAX_PRESSES), 50.0, -50.0)
    return Prediction(boat_rules.observe(after, None, rules), reward[None], reward[None], logit[None])


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
def test_a_model_of_any_form_sees_only_the_chosen_actions_own_parameters(form):
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


def test_the_h_step_loss_equals_a_hand_computation_with_an_episodes_end_inside_the_window():
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
    losses = learner.losses(windows, windows["state"][:, 0])
    for name, value in expected.items():
        torch.testing.assert_close(losses[name], value)


def next_windows(learner: DLPA) -> TensorDict:
    return next(iter(learner.sample_batches(1)))


def counting_batches(num_environments: int, num_batches: int, num_steps: int, option_length: int = 100) -> list:
    """Return batches whose observations say environment, episode, step and option.

    Episodes have 1 to 5 steps. Options 0 and 1 alternate, over the decisions of all episodes of an environment.
    """
    batches = []
    clock = [[0, 0, 0] for _ in range(num_environments)]  # episode, step and decision
    for _ in range(num_batches):
        batch = TensorDict({}, [num_environments, num_steps])
        seen = torch.zeros(2, num_environments, num_steps, 4)
        done = torch.zeros(num_environments, num_steps, 1, dtype=torch.bool)
        is_decision = torch.zeros_like(done)
        option = torch.zeros(num_environments, num_steps, dtype=torch.long)
        for e in range(num_environments):
            for t in range(num_steps):
                episode_number, step, decision = clock[e]
                option[e, t] = (decision + e) % 2
                seen[0, e, t] = torch.tensor([e, episode_number, step, option[e, t]])
                seen[1, e, t] = torch.tensor([e, episode_number, step + 1, option[e, t]])
                done[e, t] = step == (episode_number + e) % 5
                is_decision[e, t] = done[e, t] or (step + 1) % option_length == 0
                clock[e] = [episode_number + 1, 0, decision] if done[e, t] else [episode_number, step + 1, decision]
                clock[e][2] += int(is_decision[e, t])
        batch[keys.OBSERVATION] = seen[0]
        batch[keys.OPTION] = option
        batch[keys.ACTION] = {"discrete": option, "parameters": torch.zeros(*batch.shape, 3)}
        is_cut = done & (seen[0, ..., 1:2] % 3 == 0)
        batch["next"] = {
            keys.OBSERVATION: seen[1],
            keys.REWARD: torch.zeros(done.shape),
            keys.DONE: done,
            keys.TERMINATED: done & ~is_cut,
            keys.IS_DECISION: is_decision,
        }
        batches.append(batch)
    return batches


def seen_with_learned_ends(batches: list) -> list:
    """Return batches as learners see them if the selector decides on ends: a batch does not show that of its last step.

    The first root of the next batch does.
    """
    is_begun = torch.ones(len(batches[0]), 1, 1, dtype=torch.bool)
    seen = []
    for batch in batches:
        ended, done = batch["next", keys.IS_DECISION], batch["next", keys.DONE]
        seen.append(batch.copy().set(keys.IS_DECISION, torch.cat([is_begun, ended[:, :-1]], 1)))
        is_begun = ended[:, -1:]
        known = torch.cat([ended[:, :-1], done[:, -1:]], 1)
        seen[-1].set(keys.NEXT_OPTION, batch[keys.OPTION])
        seen[-1].set(("next", keys.IS_DECISION), known)
        seen[-1].set(("next", keys.OPTION_ENDED), torch.cat([(known & ~done)[:, :-1], torch.ones_like(is_begun)], 1))
    return seen


@pytest.mark.parametrize("buffer_size", [5000, 40])
def test_windows_follow_an_episode_across_batches_and_cross_no_end_environment_or_option(buffer_size):
    learner = make(horizon=3, buffer_size=buffer_size, batch_size=min(64, buffer_size))
    for batch in counting_batches(4, 12, 3):
        learner.store(batch, batch[keys.OPTION] == 1)
    windows = next_windows(learner)
    seen, valid = windows["state"], windows["valid"]
    environment, episode_number, step = seen[..., :3].unbind(-1)
    done = step == (episode_number + environment) % 5
    assert valid[:, 0].all() and (windows["discrete"] == 1).all()
    for h in (1, 2):
        follows = (seen[:, h] == seen[:, h - 1] + torch.tensor([0.0, 0.0, 1.0, 0.0])).all(-1)
        assert follows[valid[:, h]].all(), "a window left its episode or skipped a step"
        assert not (valid[:, h] & done[:, h - 1]).any()
        # What is known to follow is in the window; the newest steps have no successor yet.
        is_old = seen[:, h - 1, 1] < seen[..., 1].max() - 3
        assert (valid[:, h] | done[:, h - 1] | ~valid[:, h - 1] | ~is_old).all()
    assert valid[:, 2].any()


@pytest.mark.parametrize("are_learned", [False, True])
@pytest.mark.parametrize(("is_shared", "buffer_size", "num_steps"), [(False, 5000, 1), (True, 40, 2), (False, 20, 5)])
def test_windows_cross_no_option_that_changes_inside_an_episode(num_steps, buffer_size, is_shared, are_learned):
    option_length = 2
    learner = make(horizon=4, buffer_size=buffer_size, batch_size=min(512, buffer_size), warmup_steps=1000)
    batches = counting_batches(4, 60 // num_steps, num_steps, option_length)
    for batch in seen_with_learned_ends(batches) if are_learned else batches:
        learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool) if is_shared else batch[keys.OPTION] == 1)
    windows = next_windows(learner)
    seen, valid = windows["state"], windows["valid"]
    environment, episode_number, step, option = seen.unbind(-1)
    decision = step.div(option_length, rounding_mode="floor")
    for part in (environment, episode_number, option, decision):
        assert (part == part[:, :1])[valid].all(), "a window left its environment, its episode or its option"
    position = torch.arange(4.0).expand_as(step)
    assert (step == step[:, :1] + position)[valid].all(), "a window skipped a step"
    if buffer_size == 5000:
        assert valid[:, 1].float().mean() > 0.25 and not valid[:, 2].any()


def test_a_window_does_not_go_on_in_an_environment_that_was_started_anew():
    learner = make(horizon=2, batch_size=512)
    before, after = counting_batches(4, 4, 1)[-1], counting_batches(4, 1, 1)[0]
    for batch in (before, after):
        learner.store(batch, torch.ones(batch.shape, dtype=torch.bool))
    windows = next_windows(learner)
    assert not windows["valid"][:, 1].any()


def test_the_elites_define_the_next_distribution_separately_for_each_discrete_action():
    planner = Planner(None, SPECS, **{**SEARCH, "horizon": 1, "num_samples": 5, "num_elites": 4})
    plan = Plan(torch.tensor([[[0.2, 0.3, 0.5]]]), torch.full((1, 1, 3), 0.1), torch.full((1, 1, 3), 0.7))
    discrete = torch.tensor([0, 0, 2, 0, 1]).view(1, 5, 1)
    unit = torch.tensor([0.5, -0.5, 0.9, 0.3, 0.9]).view(1, 5, 1, 1).expand(1, 5, 1, 3)
    returns = torch.tensor([[1.0, 0.5, 0.2, 0.8, -3.0]])
    new = planner.re_estimate(plan, discrete, unit, returns, torch.tensor([0.5]))
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


def test_the_scale_of_rewards_leaves_a_plan_as_it_is():
    def planned(scale: float) -> Plan:
        def model(state, discrete, unit):
            reward = scale * (unit[:, 0] - 0.4 * discrete - state[:, 0]).sin().expand(2, -1)
            return Prediction(state + 0.1, reward, reward - scale, unit[:, 1].expand(2, -1))

        torch.manual_seed(0)
        return Planner(model, SPECS, **SEARCH).plan(torch.linspace(-1.0, 1.0, 12).view(3, 4))

    for one, other in zip(planned(1.0), planned(50.0), strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)


def test_a_return_weights_later_rewards_by_the_probability_of_reaching_them():
    def model(state, discrete, unit):
        one = torch.ones(2, len(state))
        return Prediction(state, 2.0 * one, torch.stack([3.0 * one[0], 5.0 * one[0]]), torch.zeros(2, len(state)))

    planner = Planner(model, SPECS, **{**SEARCH, "gamma": 0.5, "pessimism": 0.5})
    found = planner.returns(torch.zeros(1, 4), torch.zeros(1, 7, 2, dtype=torch.long), torch.zeros(1, 7, 2, 3))
    members = torch.tensor([2.5, 3.5]) * (1.0 + 0.5 * 0.5)
    torch.testing.assert_close(found, (members.mean() - 0.5 * members.std(correction=0)).expand(1, 7))


def test_a_plan_counts_what_its_last_state_is_worth_weighted_by_the_probability_of_reaching_it():
    def model(state, discrete, unit):
        one = torch.ones(1, len(state))
        return Prediction(state + 1.0, one, one, 0.0 * one)  # every second step ends the episode

    planner = Planner(model, SPECS, **{**SEARCH, "gamma": 0.5}, end_value=lambda state: 10.0 * state[:, 0])
    found = planner.returns(torch.zeros(1, 4), torch.zeros(1, 7, 2, dtype=torch.long), torch.zeros(1, 7, 2, 3))
    torch.testing.assert_close(found, torch.full((1, 7), 1.0 + 0.25 * 1.0 + 0.25**2 * 20.0))


def test_a_learner_with_end_values_plans_towards_what_they_say(monkeypatch):
    torch.manual_seed(0)
    learner = make(end_values=True, horizon=1, num_samples=256, num_elites=16, temperature=0.01)

    def predict(state, discrete, unit):
        nothing = torch.zeros(2, len(state))
        ahead = state.clone()
        ahead[:, 0] = unit[:, 0] * (discrete == 0)
        return Prediction(ahead, nothing, nothing, nothing - 50.0)

    monkeypatch.setattr(learner.model, "forward", predict)
    monkeypatch.setattr(learner.end_values, "forward", lambda state: -(state[:, 0] - 0.6).square())
    learner.policy.is_trained.fill_(True)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        td = learner.policy(TensorDict({keys.OBSERVATION: torch.zeros(20, 4)}, [20]))
    assert (td[keys.DISCRETE] == 0).all()
    unit = SPECS.to_unit(td[keys.PARAMETERS])[:, 0]
    torch.testing.assert_close(unit, torch.full((20,), 0.6), atol=0.1, rtol=0.0)


@pytest.fixture(scope="module")
def trained() -> DLPA:
    torch.manual_seed(0)
    learner = make(horizon=1, warmup_steps=300, num_iterations=4)
    for _ in range(8):
        learner.learn(one_step_rows(learner, 100), torch.ones(100, 1, dtype=torch.bool))
    return learner


def test_the_learner_finds_the_best_action_and_its_parameters(trained):
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rows = one_step_rows(trained, 500)
    assert (rows[keys.DISCRETE] == 1).float().mean() > 0.98
    assert rows["next", keys.REWARD].mean() > 0.85, "the optimum is 1"


def test_nothing_is_planned_for_finished_episodes_or_before_the_first_update(trained, monkeypatch):
    planned = []
    plan = trained.policy.planner.plan
    monkeypatch.setattr(
        trained.policy.planner, "plan", lambda state, *mask: planned.append(len(state)) or plan(state, *mask)
    )
    done = (torch.arange(50) < 20).unsqueeze(-1)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        trained.policy(TensorDict({keys.OBSERVATION: torch.randn(50, 4), keys.DONE: done}, [50]))
        assert planned == [30]
        fresh = make()
        monkeypatch.setattr(fresh.policy.planner, "plan", None)
        fresh.policy(TensorDict({keys.OBSERVATION: torch.randn(50, 4)}, [50]))


def test_states_and_their_changes_are_scaled_by_standard_deviations_over_all_stored_steps_not_those_of_the_warm_up():
    learner = make(updates_per_step=0.1, warmup_steps=24 * 4)
    batches = counting_batches(4, 6, 8)
    for batch in batches[:4]:
        # The warm-up sees nothing of what the last entry is later.
        batch[keys.OBSERVATION][..., -1] = batch["next", keys.OBSERVATION][..., -1] = 0.0
    for batch in batches:
        learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))
    seen = torch.cat(batches, 0)
    state, next_state = (part.flatten(0, 1) for part in (seen[keys.OBSERVATION], seen["next", keys.OBSERVATION]))
    torch.testing.assert_close(learner.model.state_mean, state.mean(0))
    torch.testing.assert_close(learner.model.state_scale, state.std(0).clamp(min=1e-2))
    torch.testing.assert_close(learner.model.change_scale, (next_state - state).std(0).clamp(min=1e-2))
    scaled = (state - learner.model.state_mean) / learner.model.state_scale
    assert scaled.abs().max() < 5.0
