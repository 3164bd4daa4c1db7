"""Hybrid SAC: densities, soft targets, actor loss, temperatures, and learning a problem with a known optimum."""

import math

import pytest
import torch
from conftest import global_generators_unmoved
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import TanhNormal
from toy_steps import SPECS, one_step_rows, sample, states

from hpamdp import keys
from hpamdp.policies.base import States
from hpamdp.policies.low_level.hsac import HSAC
from hpamdp.policies.shared.hybrid_distribution import HybridDistribution
from hpamdp.specs import PAMDPSpecs

OPTIONS = dict(
    hidden_dims=[64, 64], min_scale=0.01, discrete_temperature=0.05, parameter_temperature=0.03,
    discrete_target_entropy=0.1, parameter_target_entropy=-1.5, temperature_lr=3e-3, warmup_steps=1000,
    buffer_size=20_000, batch_size=64, updates_per_step=0.12, gamma=0.9, tau=0.02, actor_lr=3e-3, critic_lr=3e-3,
)  # fmt: skip


def make(specs: PAMDPSpecs = SPECS, **changes) -> HSAC:
    return HSAC(specs, device=torch.device("cpu"), **{**OPTIONS, **changes})


def soft_value_by_hand(learner: HSAC, critics: torch.nn.Module, state: torch.Tensor) -> float:
    """Return the value of a single state `[1, 4]` for the parameters sampled with the generator's current state."""
    discrete_log_probs, mean, log_scale, *_ = learner.actor(state)
    scale = log_scale.exp()
    raw = mean + scale * torch.randn_like(mean)
    pi, unit = discrete_log_probs.exp()[0], raw.tanh()[0].tolist()
    gaussian = torch.distributions.Normal(mean, scale).log_prob(raw)[0].tolist()
    log_density = [g - math.log(1.0 - x * x) for g, x in zip(gaussian, unit, strict=True)]
    value = 0.0
    for k, own in enumerate([[0], [1, 2], []]):
        seen = torch.tensor([[x if i in own else 0.0 for i, x in enumerate(unit)]])
        q = min(member[0, k].item() for member in critics.net(torch.cat([state, seen], -1)))
        q -= OPTIONS["discrete_temperature"] * discrete_log_probs[0, k].item()
        q -= OPTIONS["parameter_temperature"] * sum(log_density[i] for i in own)
        value += pi[k].item() * q
    return value


def test_the_learner_finds_the_best_discrete_action_and_its_parameters():
    torch.manual_seed(0)
    learner = make()
    for _ in range(28):
        learner.learn(one_step_rows(learner, 200), torch.ones(200, 1, dtype=torch.bool))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rows = one_step_rows(learner, 1000)
    assert (rows[keys.DISCRETE] == 1).float().mean() > 0.98
    assert rows["next", keys.REWARD].mean() > 0.9, "random actions earn about -0.2, action 2 alone 0.2, the optimum 1"


def test_densities_are_those_of_torchrls_squashed_gaussian_and_finite_at_the_bounds():
    mean, scale = torch.randn(64, 3), torch.rand(64, 3) + 0.1
    owner = SPECS.parameter_owner
    unit, log_density = HybridDistribution(
        torch.zeros(64, 3), mean, scale.log(), owner, SPECS.components
    ).sample_squashed()
    expected = TanhNormal(mean, scale, event_dims=0).log_prob(unit)
    torch.testing.assert_close(log_density, expected, rtol=1e-3, atol=1e-3)
    far = HybridDistribution(
        torch.zeros(1, 3), torch.full((1, 3), 50.0), torch.full((1, 3), 0.1).log(), owner, SPECS.components
    )
    assert far.sample_squashed()[1].isfinite().all()


def test_soft_targets_equal_those_computed_by_hand_and_stop_at_termination_alone():
    learner, batch = make(), sample(1).set("discount", torch.tensor([OPTIONS["gamma"]]))
    learner.target_critics.load_state_dict(make().critics.state_dict())
    torch.manual_seed(3)
    target = learner.target(batch)
    torch.manual_seed(3)
    value = soft_value_by_hand(learner, learner.target_critics, batch["next_state"])
    torch.testing.assert_close(target, batch["reward"] + OPTIONS["gamma"] * value)
    batch["discount"] = torch.zeros(1)
    torch.testing.assert_close(learner.target(batch), batch["reward"])


def test_the_stored_discount_is_0_at_termination_alone_and_rows_of_other_learners_are_dropped():
    learner = make(warmup_steps=10_000)
    rows = one_step_rows(learner, 4).squeeze(-1)
    rows["next", keys.TERMINATED] = torch.tensor([[True], [False], [False], [True]])
    rows["next", keys.TRUNCATED] = torch.tensor([[False], [True], [False], [False]])
    rows["next", keys.DONE] = rows["next", keys.TERMINATED] | rows["next", keys.TRUNCATED]
    learner.learn(rows, torch.tensor([True, True, True, False]))
    assert learner.frames == 3
    torch.testing.assert_close(learner.buffer[:]["discount"], torch.tensor([0.0, 0.9, 0.9]))


def test_the_actor_loss_equals_one_computed_by_hand_and_leaves_the_critics_alone():
    learner, state = make(), torch.randn(1, 4)
    torch.manual_seed(4)
    expected = -soft_value_by_hand(learner, learner.critics, state)
    before = {name: value.clone() for name, value in learner.state_dict().items()}
    torch.manual_seed(4)
    loss = learner.gradient_step("actor", learner.actor_loss, state, None)["actor"]
    assert loss.item() == pytest.approx(expected, rel=1e-4, abs=1e-5)
    moved = {name for name, value in learner.state_dict().items() if not torch.equal(value, before[name])}
    assert moved and all(name.startswith(("actor.", "policy.actor.")) for name in moved)
    assert all(p.grad is None and p.requires_grad for p in learner.critics.parameters())


@pytest.mark.parametrize("discrete", [0, 1, 2])
def test_only_the_executed_actions_own_parameters_count_in_the_entropy(discrete):
    learner, state = make(), torch.randn(64, 4)
    with torch.no_grad():
        learner.actor.net[-1].bias[:3] = 50.0 * torch.eye(3)[discrete]
    torch.manual_seed(5)
    log_density = learner.actor(state).sample_squashed()[1]
    torch.manual_seed(5)
    _, discrete_excess, parameter_excess = learner.soft_value(learner.critics, state)
    own = [[0], [1, 2], []][discrete]
    target = OPTIONS["parameter_target_entropy"] * len(own)
    torch.testing.assert_close(parameter_excess, -log_density[:, own].sum(-1) - target)
    torch.testing.assert_close(discrete_excess, torch.full((64,), -OPTIONS["discrete_target_entropy"] * math.log(3.0)))


@pytest.mark.parametrize("excess", [0.5, -0.5])
@pytest.mark.parametrize("is_tuned", [True, False])
def test_a_temperature_falls_above_its_target_rises_below_and_stays_if_fixed(excess, is_tuned):
    learner = make(tune_parameter_temperature=is_tuned)
    learner.gradient_step("temperatures", learner.temperature_loss, torch.tensor(-excess), torch.tensor(excess))
    discrete_weight, parameter_weight = (weight.item() for weight in learner.temperatures())
    assert (discrete_weight > OPTIONS["discrete_temperature"]) == (excess > 0.0)
    change = parameter_weight / OPTIONS["parameter_temperature"] - 1.0
    assert change * excess < -1e-6 if is_tuned else abs(change) < 1e-6


def test_the_value_that_selectors_compare_is_that_of_the_greedy_action_without_entropy():
    learner, td = make(), states(50)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        acted = learner.policy(td.clone())
        unit_parameters = SPECS.to_unit(acted[keys.PARAMETERS])
        q = learner.target_critics.of_discrete(td[keys.OBSERVATION], acted[keys.DISCRETE], unit_parameters).amin(0)
        torch.testing.assert_close(learner.value(States(td[keys.OBSERVATION])), q)


def test_the_greedy_policy_samples_nothing_and_the_exploring_one_is_uniform_in_the_warm_up_alone():
    learner, td = make(), states(2000)
    with global_generators_unmoved(), set_exploration_type(ExplorationType.DETERMINISTIC):
        greedy = learner.policy(td.clone())
    distribution = learner.actor(td[keys.OBSERVATION])
    assert torch.equal(greedy[keys.DISCRETE], distribution.discrete_log_probs.argmax(-1))
    torch.testing.assert_close(SPECS.to_unit(greedy[keys.PARAMETERS]), distribution.mean.tanh())
    random = SPECS.to_unit(learner.policy(td.clone())[keys.PARAMETERS])
    torch.testing.assert_close(random.std(0), torch.full((3,), 3.0**-0.5), rtol=0.05, atol=0.0)
    learner.policy.is_random.fill_(False)
    with torch.no_grad():
        learner.actor.net[-1].bias[-3:] = -50.0  # the smallest deviation
    sampled = SPECS.to_unit(learner.policy(td.clone())[keys.PARAMETERS])
    assert (sampled - SPECS.to_unit(greedy[keys.PARAMETERS])).std() < 0.02


@pytest.mark.parametrize("is_random", [True, False])
def test_a_policy_takes_any_batch_shape_and_stays_in_bounds(is_random):
    learner = make()
    learner.policy.is_random.fill_(is_random)
    low, high = torch.tensor(SPECS.parameter_low), torch.tensor(SPECS.parameter_high)
    for shape in ((), (3,), (3, 200)):
        td = learner.policy(TensorDict({keys.OBSERVATION: torch.randn(*shape, 4) * 30}, shape))
        parameters = td[keys.PARAMETERS]
        assert td[keys.DISCRETE].shape == shape and parameters.shape == (*shape, 3)
        assert (parameters >= low).all() and (parameters <= high).all()
