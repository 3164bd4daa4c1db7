"""H-PPO: ratios, advantages, which rows count, and learning a problem with a known optimum."""

from dataclasses import replace

import pytest
import torch
from conftest import global_generators_unmoved
from tensordict import TensorDict
from torch.distributions import Categorical, Normal
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives.value.functional import generalized_advantage_estimate
from toy_steps import SPECS, one_step_rows

from hpamdp import keys
from hpamdp.geometry import PlaneGeometry
from hpamdp.policies.base import States
from hpamdp.policies.low_level.hppo import HPPO, RAW
from hpamdp.policies.shared.on_policy import generalised_advantages, normalised
from hpamdp.specs import PAMDPSpecs

OPTIONS = dict(
    hidden_dims=[32, 32], critic_hidden_dims=[32, 32], min_scale=0.05, min_scale_final=0.01, epochs=4, gamma=0.9,
    gae_lambda=0.8, lr=3e-3, lr_final=3e-4, anneal_steps=40_000,
)  # fmt: skip


def make(specs: PAMDPSpecs = SPECS, **changes) -> HPPO:
    torch.manual_seed(0)
    return HPPO(specs, device=torch.device("cpu"), **{**OPTIONS, **changes})


@pytest.mark.parametrize("greedy_discrete", ["most_probable", "sampled"])
def test_the_greedy_policy_takes_mean_parameters_and_one_discrete_action_or_samples_it(greedy_discrete):
    learner = make(greedy_discrete=greedy_discrete)
    td = TensorDict({keys.OBSERVATION: torch.zeros(300, 4)}, [300])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = learner.policy(td)
    taken = acted[keys.DISCRETE].bincount(minlength=3) / 300
    probabilities = learner.actor(td[keys.OBSERVATION]).discrete_log_probs[0].exp()
    expected = probabilities if greedy_discrete == "sampled" else torch.eye(3)[probabilities.argmax()]
    torch.testing.assert_close(taken, expected, atol=0.1, rtol=0.0)
    assert (acted[RAW] == acted[RAW][0]).all()
    assert (learner.exported() is None) == (greedy_discrete == "sampled")


def test_greedy_parameters_may_be_the_means_of_the_clipped_samples():
    learner = make(greedy_parameters="clipped_mean")
    with torch.no_grad():
        learner.actor.parameter_head.bias[:4] = torch.tensor([-1.5, -1.0, 0.3, 0.9])
    td = TensorDict({keys.OBSERVATION: torch.zeros(100_000, 4)}, [100_000])
    sampled = learner.policy(td.clone())[RAW].clamp(-1.0, 1.0).mean(0)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        greedy = learner.policy(td)[RAW][0]
    torch.testing.assert_close(greedy, sampled, atol=0.01, rtol=0.0)
    assert greedy[1] > -0.9 and learner.exported() is None


def random_rows(learner: HPPO, num: int, steps: int, done: torch.Tensor | None = None) -> TensorDict:
    """Return random transitions `[num, steps]` with actions of the policy, and ends where `done` or at random."""
    td = learner.policy(TensorDict({keys.OBSERVATION: torch.randn(num, steps, 4)}, [num, steps]))
    done = torch.rand(num, steps, 1) < 0.3 if done is None else done
    last, following = torch.randn(num, steps, 4), torch.cat([td[keys.OBSERVATION][:, 1:], torch.randn(num, 1, 4)], 1)
    td["next"] = {
        keys.OBSERVATION: torch.where(done, last, following),
        keys.REWARD: torch.randn(num, steps, 1),
        keys.DONE: done,
        keys.TERMINATED: done & (torch.rand(num, steps, 1) < 0.5),
    }
    return td


def everything(td: TensorDict) -> torch.Tensor:
    return torch.ones(td.shape, dtype=torch.bool)


def test_the_log_ratios_are_those_of_the_discrete_action_and_of_its_own_parameters():
    learner = make()
    td = random_rows(learner, 50, 2)
    discrete, raw = td[keys.DISCRETE], td[RAW]
    with torch.no_grad():
        _, before = learner.actor(td[keys.OBSERVATION]).log_prob(discrete, raw)
        learner.actor.discrete_head.bias.add_(torch.tensor([0.3, -0.2, 0.1]))
        learner.actor.parameter_head.bias.add_(0.2 * torch.arange(6))
        now = learner.actor(td[keys.OBSERVATION])
        discrete_log_prob, parameter_log_prob = now.log_prob(discrete, raw)
    torch.testing.assert_close(discrete_log_prob, Categorical(logits=now.discrete_log_probs).log_prob(discrete))
    single = Normal(now.mean, now.log_scale.exp()).log_prob(raw)
    own = {0: single[..., 0], 1: single[..., 1] + single[..., 2], 2: torch.zeros(50, 2)}
    for k, expected in own.items():
        torch.testing.assert_close(parameter_log_prob[discrete == k], expected[discrete == k])
    assert (before[discrete == 2] == 0).all() and (parameter_log_prob - before)[discrete != 2].abs().min() > 0


def test_actor_and_critic_see_products_of_vectors():
    specs = replace(SPECS, geometry=PlaneGeometry(vectors=((0, 1), (2, 3))))
    learner = make(specs, vector_products=True)
    with torch.no_grad():
        learner.actor.parameter_head.weight.normal_()
        for net in (learner.actor.encoder[0], learner.critic[1][0]):
            net.weight[:, :4] = 0.0  # only the products are left
    state = torch.randn(1, 4)
    turned = state[:, [1, 0, 3, 2]] * torch.tensor([-1.0, 1.0, -1.0, 1.0])  # both vectors, by a right angle
    other = state * torch.tensor([1.0, 1.0, -1.0, -1.0])
    for output in (lambda seen: learner.value(States(seen)), lambda seen: learner.actor(seen).mean):
        torch.testing.assert_close(output(turned), output(state))
        assert not torch.allclose(output(other), output(state), atol=1e-3)
    assert learner.exported() is None, "the actors of pages have no products"


def test_the_ratios_are_one_before_the_first_update_also_of_what_an_older_policy_did():
    learner = make()
    td = random_rows(learner, 50, 4)
    with torch.no_grad():
        for parameter in learner.actor.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    rows = learner.rows(td, everything(td))
    discrete_log_prob, parameter_log_prob = learner.actor(td[keys.OBSERVATION].flatten(0, 1)).log_prob(
        td[keys.DISCRETE].flatten(), td[RAW].flatten(0, 1)
    )
    torch.testing.assert_close(discrete_log_prob, rows["discrete_log_prob"], atol=1e-5, rtol=0)
    torch.testing.assert_close(parameter_log_prob, rows["parameter_log_prob"], atol=1e-5, rtol=0)


def test_the_surrogate_stops_rewarding_beyond_the_clip():
    ratio, advantage = torch.tensor([0.5, 1.0, 1.5, 0.5, 1.5]), torch.tensor([1.0, 1.0, 1.0, -1.0, -1.0])
    expected = torch.tensor([0.5, 1.0, 1.2, -0.8, -1.5])
    torch.testing.assert_close(make().surrogate(ratio.log(), advantage), expected)


def test_generalised_advantages_are_torchrls_to_the_last_bit():
    torch.manual_seed(0)
    value, next_value, reward = torch.randn(3, 5, 20, 1)
    done = torch.rand(5, 20, 1) < 0.2
    steps = value, next_value, reward, done, done & (torch.rand(5, 20, 1) < 0.5)
    given = generalised_advantages(*steps, gamma=0.97, gae_lambda=0.9)
    for ours, theirs in zip(given, generalized_advantage_estimate(0.97, 0.9, *steps), strict=True):
        assert torch.equal(ours, theirs)


def test_a_step_is_discounted_for_as_long_as_it_took():
    learner = make()
    td = random_rows(learner, 1, 2, torch.tensor([[[False], [True]]]))
    td["next", keys.TERMINATED] = torch.zeros(1, 2, 1, dtype=torch.bool)
    td["next", keys.DURATION] = torch.tensor([[[3.0], [0.5]]])
    advantage, _ = learner.advantages(td, everything(td))
    with torch.no_grad():
        value = learner.critic(td[keys.OBSERVATION]).flatten()
        next_value = learner.critic(td["next", keys.OBSERVATION]).flatten()
    delta = td["next", keys.REWARD].flatten() + torch.tensor([0.9**3, 0.9**0.5]) * next_value - value
    torch.testing.assert_close(advantage[0], torch.stack([delta[0] + 0.9**3 * 0.8 * delta[1], delta[1]]))


def test_advantages_bootstrap_past_truncation_and_stop_at_every_end():
    learner = make()
    # Row 0 terminates at its second step, row 1 is truncated there, row 2 goes on. What follows in row 0 is another
    # learner's.
    done = torch.tensor([[0, 1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0]], dtype=torch.bool).unsqueeze(-1)
    td = random_rows(learner, 3, 4, done)
    td["next", keys.TERMINATED] = done.clone()
    td["next", keys.TERMINATED][1:] = False
    mask = everything(td)
    mask[0, 2:] = False
    advantage, target = learner.advantages(td, mask)
    with torch.no_grad():
        value = learner.critic(td[keys.OBSERVATION]).squeeze(-1)
        next_value = learner.critic(td["next", keys.OBSERVATION]).squeeze(-1)
    reward = td["next", keys.REWARD].squeeze(-1)
    for row in range(3):
        trace = 0.0
        for t in (3, 2, 1, 0):
            is_terminated = td["next", keys.TERMINATED][row, t, 0]
            is_done = td["next", keys.DONE][row, t, 0]
            delta = reward[row, t] + 0.9 * next_value[row, t] * ~is_terminated - value[row, t]
            trace = delta + 0.9 * 0.8 * trace * ~is_done
            if mask[row, t]:
                torch.testing.assert_close(advantage[row, t], trace)
                torch.testing.assert_close(target[row, t], trace + value[row, t])


def test_rewards_are_learned_from_after_scaling():
    plain, scaled = make(), make(reward_scale=0.01)
    td = random_rows(plain, 3, 6)
    large = td.clone()
    large["next", keys.REWARD] = 100.0 * td["next", keys.REWARD]
    mask = torch.ones(3, 6, dtype=torch.bool)
    for one, other in zip(plain.advantages(td, mask), scaled.advantages(large, mask), strict=True):
        torch.testing.assert_close(one, other)


def test_advantages_smaller_than_the_least_are_not_blown_up():
    advantage = torch.tensor([0.0, 0.01, 0.02, 0.03])
    torch.testing.assert_close(normalised(advantage, least=0.5), (advantage - 0.015) / 0.5)
    torch.testing.assert_close(normalised(100.0 * advantage, least=0.5), normalised(100.0 * advantage))
    moved = []
    for least in (0.0, 1e9):
        learner = make(least_deviation=least, discrete_entropy=0.0)
        rows = one_step_rows(learner, 256)
        before = torch.cat([parameter.detach().flatten().clone() for parameter in learner.actor.parameters()])
        learner.learn(rows, torch.ones(256, 1, dtype=torch.bool))
        after = torch.cat([parameter.detach().flatten() for parameter in learner.actor.parameters()])
        moved.append((after - before).abs().max().item())
    assert moved[0] > 1e-3 and moved[1] < 1e-5


def test_rows_of_other_learners_change_nothing():
    learners = make(minibatch_size=64), make(minibatch_size=64)
    td = random_rows(learners[0], 64, 6)
    starts = td["next", keys.DONE].squeeze(-1).cumsum(1).roll(1, 1)
    starts[:, 0] = 0
    mask = starts % 2 == 0
    other = td.clone()
    for leaf in (keys.OBSERVATION, RAW, keys.PARAMETERS):
        other[leaf][~mask] = 1e3
        other["next", keys.OBSERVATION][~mask] = torch.nan
    other["next", keys.REWARD][~mask] = torch.nan
    for learner, batch in zip(learners, (td, other), strict=True):
        torch.manual_seed(1)
        assert learner.learn(batch, mask)
    for one, two in zip(*(learner.parameters() for learner in learners), strict=True):
        assert one.isfinite().all() and torch.equal(one, two)


def test_the_learner_finds_the_best_discrete_action_and_its_parameters():
    learner = make()
    for _ in range(25):
        td = one_step_rows(learner, 1000, slope=0.5)
        scalars = learner.learn(td, everything(td))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        td = one_step_rows(learner, 1000, slope=0.5)
    assert (td[keys.DISCRETE] == 1).float().mean() > 0.99
    assert td["next", keys.REWARD].mean() > 0.98, "random actions earn about -0.3, the optimum 1"
    assert scalars["scale"] < 0.5


def test_parameters_stay_in_bounds_and_the_greedy_policy_samples_nothing():
    learner = make()
    td = TensorDict({keys.OBSERVATION: torch.randn(500, 4) * 30}, [500])
    low, high = torch.tensor(SPECS.parameter_low), torch.tensor(SPECS.parameter_high)
    parameters = learner.policy(td.clone())[keys.PARAMETERS]
    assert (parameters >= low).all() and (parameters <= high).all()
    with global_generators_unmoved(), set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = learner.policy(td.clone())
    with torch.no_grad():
        now = learner.actor(td[keys.OBSERVATION])
    assert torch.equal(acted[keys.DISCRETE], now.discrete_log_probs.argmax(-1)) and torch.equal(acted[RAW], now.mean)
    assert set(learner.policy.out_keys) <= set(acted.keys(include_nested=True, leaves_only=True))


def test_the_policy_samples_from_its_distribution():
    learner = make()
    with torch.no_grad():
        learner.actor.discrete_head.bias.copy_(torch.tensor([0.6, 0.3, 0.1]).log())
    td = learner.policy(TensorDict({keys.OBSERVATION: torch.zeros(20_000, 4)}, [20_000]))
    frequency = td[keys.DISCRETE].bincount(minlength=3) / 20_000
    torch.testing.assert_close(frequency, torch.tensor([0.6, 0.3, 0.1]), atol=0.02, rtol=0)
    torch.testing.assert_close(td[RAW].std(0), torch.full((3,), 0.5), atol=0.02, rtol=0)


def test_discrete_actions_without_parameters_are_learned_too():
    learner = make(PAMDPSpecs(4, (), (0, 0), (), ()))
    for _ in range(15):
        td = learner.policy(TensorDict({keys.OBSERVATION: torch.randn(512, 1, 4)}, [512, 1]))
        is_end = torch.ones(512, 1, 1, dtype=torch.bool)
        reward = (td[keys.DISCRETE] == 1).float().unsqueeze(-1)
        td["next"] = {keys.OBSERVATION: td[keys.OBSERVATION], keys.REWARD: reward}
        td["next"].update({keys.DONE: is_end, keys.TERMINATED: is_end})
        learner.learn(td, everything(td))
    assert td[keys.PARAMETERS].shape == (512, 1, 0) and reward.mean() > 0.95


def test_the_critics_own_learning_rate_falls_with_that_of_the_actors():
    learner = make(anneal_steps=200, minibatch_size=50, critic_lr=3e-2)
    td = random_rows(learner, 50, 2)
    rates = []
    for _ in range(3):
        learner.learn(td, everything(td))
        rates.append([group["lr"] for group in learner.optimizer.param_groups])
    assert rates == [pytest.approx([rate, 10.0 * rate]) for rate in (3e-3, 1.65e-3, 3e-4)]
    groups = [{id(each) for each in group["params"]} for group in learner.optimizer.param_groups]
    assert groups[1] == {id(each) for each in learner.critic.parameters()}
    assert groups[0] == {id(each) for each in learner.parameters()} - groups[1]


def test_further_passes_of_the_critic_leave_the_actors_alone():
    once, more = make(), make(critic_epochs=20)
    td = random_rows(once, 200, 4)
    _, targets = once.advantages(td, everything(td))
    errors = []
    for learner in (once, more):
        torch.manual_seed(1)
        learner.learn(td, everything(td))
        errors.append((learner.value(States(td[keys.OBSERVATION].flatten(0, 1))) - targets.flatten()).square().mean())
    assert errors[1] < errors[0]
    for name, parameter in once.actor.named_parameters():
        assert torch.equal(parameter, more.actor.get_parameter(name)), name


@pytest.mark.parametrize(
    ("shape", "expected"),
    [
        ("linear", [3e-3, 1.65e-3, 3e-4, 3e-4]),
        ("cosine", [3e-3, 1.65e-3, 3e-4, 3e-4]),
        ("constant", [3e-3, 3e-3, 3e-3, 3e-3]),
    ],
)
def test_learning_rate_and_scale_are_annealed_over_the_steps_of_the_whole_run(shape, expected):
    learner = make(anneal_steps=200, minibatch_size=2, lr_schedule=shape)
    td = random_rows(learner, 50, 2)
    mask = everything(td)
    mask[1:] = False
    rates, scales = [], []
    for _ in range(4):
        learner.learn(td, mask)
        rates.append(learner.optimizer.param_groups[0]["lr"])
        scales.append(learner.actor.log_min_scale.exp().item())
    assert rates == pytest.approx(expected)
    assert scales == pytest.approx([0.05, 0.0005**0.5, 0.01, 0.01])


def test_the_largest_scale_is_annealed_and_part_of_the_state_dict():
    options = dict(max_scale_final=0.1, initial_scale=0.9, lr=1e-6, lr_final=0.0, anneal_steps=512)
    learner, resumed, started = make(**options), make(**options), make(**options)
    observation = torch.zeros(1, 4)
    scales = [learner.actor(observation).log_scale.exp().max().item()]
    for _ in range(2):
        rows = one_step_rows(learner, 256)
        learner.learn(rows, everything(rows))
        scales.append(learner.actor(observation).log_scale.exp().max().item())
    assert scales[0] > 0.8
    assert 0.1 < scales[1] < 0.32
    assert scales[2] < 0.1
    few = one_step_rows(learner, 2)  # they wait for more: the scale must not move before an update
    learner.learn(few, everything(few))
    resumed.load_state_dict(learner.state_dict())
    torch.testing.assert_close(resumed.actor.log_max_scale, learner.actor.log_max_scale, rtol=0.0, atol=0.0)
    started.load_networks(learner.state_dict())
    assert started.actor.log_max_scale.exp().item() == pytest.approx(1.0)
    assert started.actor.log_min_scale.exp().item() == pytest.approx(started.options.min_scale)


def test_too_few_rows_wait_for_more_and_are_part_of_the_state_dict():
    learner, other = make(minibatch_size=150), make(minibatch_size=150)
    first, second = random_rows(learner, 50, 2), random_rows(learner, 50, 2)
    before = learner.actor.discrete_head.weight.clone()
    assert learner.learn(first, everything(first)) == {}
    assert torch.equal(learner.actor.discrete_head.weight, before)
    other.load_state_dict(learner.state_dict())
    for one in (learner, other):
        torch.manual_seed(1)
        assert one.learn(second, everything(second)) and not one.waiting
    assert not torch.equal(learner.actor.discrete_head.weight, before)
    assert torch.equal(learner.actor.discrete_head.weight, other.actor.discrete_head.weight)


def test_rows_that_wait_in_a_run_are_not_taken_over_by_another_one():
    learner, other = make(minibatch_size=150), make(minibatch_size=150)
    batch = random_rows(learner, 50, 2)
    learner.learn(batch, everything(batch))
    other.load_networks(learner.state_dict())
    assert learner.waiting and not other.waiting
    assert torch.equal(learner.actor.discrete_head.weight, other.actor.discrete_head.weight)
