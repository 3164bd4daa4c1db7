"""The learned option policies, MetaCritic and Actor: their targets by hand, and that they learn the better options."""

import pytest
import torch
from conftest import global_generators_unmoved
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_bandits import CPU, SPECS, against_sign, by_sign, due, ended, play

from hpamdp import keys
from hpamdp.policies.high_level.actor import LOG_PROB, WEIGHT, Actor
from hpamdp.policies.high_level.meta_critic import MetaCritic

OPTIONS = {
    MetaCritic: dict(
        hidden_dims=[32, 32], num_members=3, exploration="epsilon", epsilon_final=0.1, epsilon_decisions=1000,
        ucb_width=2.0, gamma=1.0, buffer_size=4000, batch_size=64, updates_per_decision=0.1, max_updates=64,
        warmup_decisions=200, lr=3e-3, tau=0.05,
    ),
    Actor: dict(
        hidden_dims=[32, 32], gamma=1.0, epochs=4, minibatch_size=64, clip=0.2, entropy=0.0, lr=3e-3, max_grad_norm=0.5
    ),
}  # fmt: skip


def make(cls: type, seed: int = 0, **changes: object) -> MetaCritic | Actor:
    torch.manual_seed(seed)
    return cls(SPECS, device=CPU, **{**OPTIONS[cls], **changes})


def greedy_regret(selector: MetaCritic | Actor) -> float:
    """Return the mean regret of greedy choices on `by_sign`, where that of a single option is 1."""
    observation = torch.rand(1000, 2) * 2 - 1
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        option = selector(due(observation))[keys.OPTION]
    return 1.0 - by_sign(observation).gather(-1, option.unsqueeze(-1)).mean().item()


def mid_episode(selector: MetaCritic | Actor) -> TensorDict:
    """Return three decisions of 3 steps with the return 0.7.

    The episode goes on after the first one, terminates with the second and is cut off by its time limit with the third.
    """
    observation = torch.tensor([[0.1, 0.2], [0.3, 0.4], [0.2, 0.3]])
    decisions = ended(selector(due(observation)), torch.full((3,), 0.7))
    after = decisions["next"]
    after[keys.OBSERVATION] = torch.tensor([[0.5, 0.6], [0.7, 0.8], [0.6, 0.7]])
    after[keys.TERMINATED] = torch.tensor([[False], [True], [False]])
    after[keys.DONE] = torch.tensor([[False], [True], [True]])
    after[keys.OPTION_STEPS] = torch.full((3, 1), 3)
    decisions[keys.OBSERVATION] = torch.full((3, 2), 9.0)  # at the last step, which nobody should use
    return decisions


# MetaCritic.


@pytest.fixture(scope="module")
def trained() -> MetaCritic:
    critic = make(MetaCritic)
    play(critic, by_sign, 3000, 30, noise=0.5)
    return critic


def test_meta_critic_learns_which_option_is_better_where_also_if_bounds_explore(trained):
    assert greedy_regret(trained) < 0.2
    bounded = make(MetaCritic, exploration="ucb")
    play(bounded, by_sign, 3000, 30, noise=0.5)
    assert greedy_regret(bounded) < 0.2


def test_meta_critic_learns_from_options_that_others_chose():
    critic = make(MetaCritic)
    for _ in range(60):
        root = due(torch.rand(50, 2) * 2 - 1, option=torch.randint(2, (50,)))
        means = by_sign(root[keys.OBSERVATION]).gather(-1, root[keys.OPTION].unsqueeze(-1)).squeeze(-1)
        critic.learn(ended(root, means + 0.5 * torch.randn(50)))
    assert greedy_regret(critic) < 0.2


def test_meta_critic_does_not_learn_from_returns_that_are_out_of_date():
    critic = make(MetaCritic, buffer_size=10_000)
    play(critic, against_sign, 3000, 30, noise=0.5)
    play(critic, by_sign, 3000, 30, noise=0.5)
    assert greedy_regret(critic) < 0.2


def test_meta_critic_goes_on_without_the_buffer_that_a_checkpoint_left_out(trained):
    after = make(MetaCritic)
    after.load_state_dict(trained.state_dict())
    play(after, by_sign, 3000, 30, noise=0.5)
    assert greedy_regret(after) < 0.2


def test_the_targets_of_the_meta_critic_are_those_of_semi_mdp_q_learning():
    critic = make(MetaCritic, gamma=0.9, num_members=1)
    with torch.no_grad():
        for layer in critic.target_critics.layers:
            layer.bias.normal_()
    decisions = mid_episode(critic)
    rows = critic.rows(decisions)
    torch.testing.assert_close(rows["discount"], torch.tensor([0.9**3, 0.0, 0.0]))
    torch.testing.assert_close(rows["state"], torch.tensor([[0.1, 0.2], [0.3, 0.4], [0.2, 0.3]]))
    q = critic.critics(rows["state"])[0].detach()
    next_value = critic.target_critics(torch.tensor([[0.5, 0.6]]))[0, 0].max().item()
    targets = [0.7 + 0.9**3 * next_value, 0.7, 0.7]
    chosen = decisions[keys.OPTION].tolist()
    expected = sum((q[i, chosen[i]].item() - targets[i]) ** 2 for i in range(3)) / 3
    assert critic.update_critics(rows).item() == pytest.approx(expected, rel=1e-5)


def test_only_the_chosen_option_has_a_target():
    critic = make(MetaCritic, num_members=1)
    rows = critic.rows(mid_episode(critic).set(keys.OPTION, torch.ones(3, dtype=torch.long)))
    critic.update_critics(rows)
    gradient = critic.critics.layers[-1].bias.grad[0, 0]
    assert gradient[0] == 0.0 and gradient[1] != 0.0


def test_an_option_that_idles_until_the_time_limit_is_worth_what_it_paid():
    critic, actor = make(MetaCritic, updates_per_decision=1.0, warmup_decisions=0), make(Actor)
    decisions = ended(due(100, option=torch.tensor([0, 1]).repeat(50)), torch.tensor([3.0, 0.0]).repeat(50))
    decisions["next", keys.TERMINATED] = torch.tensor([[True], [False]]).repeat(50, 1)
    for _ in range(5):
        critic.learn(decisions)
    assert critic.critics(torch.zeros(1, 2)).mean(0)[0].tolist() == pytest.approx([3.0, 0.0], abs=0.1)
    with torch.no_grad():
        actor.critic[-1].bias.fill_(5.0)
    decisions.update({LOG_PROB: torch.zeros(100), WEIGHT: torch.ones(100)})
    assert actor.rows(decisions)["target"].tolist() == [3.0, 0.0] * 50


def test_the_probability_of_a_random_option_falls_from_1_after_the_warm_up():
    critic = make(MetaCritic, warmup_decisions=200, epsilon_decisions=1000, epsilon_final=0.1)
    epsilons = []
    for _ in range(14):
        epsilons.append(critic.epsilon)
        critic.learn(ended(due(100, option=torch.zeros(100, dtype=torch.long)), torch.zeros(100)))
    assert epsilons == pytest.approx([1.0, 1.0, *(1.0 - 0.09 * i for i in range(11)), 0.1])
    assert make(MetaCritic, exploration="ucb", warmup_decisions=0).epsilon == 0.0


@pytest.mark.parametrize(("width", "chosen"), [(0.7, 0), (0.8, 1)])
def test_ucb_exploration_adds_the_standard_deviation_over_the_members(width, chosen):
    critic = make(MetaCritic, exploration="ucb", warmup_decisions=0, ucb_width=width)
    with torch.no_grad():
        critic.critics.layers[-1].weight.zero_()
        critic.critics.layers[-1].bias[:, 0] = torch.tensor([[2.0, 0.0], [2.0, 0.0], [2.0, 3.0]])
    # Means 2 and 1, deviations 0 and sqrt(2).
    assert critic.select(due(20)).tolist() == [chosen] * 20
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert critic.select(due(20)).tolist() == [0] * 20


# Actor.


def test_actor_learns_which_option_is_better_where():
    actor = make(Actor)
    play(actor, by_sign, 4000, 50, noise=0.5)
    assert greedy_regret(actor) < 0.2


def test_the_policy_of_the_actor_learns_the_same_from_returns_of_any_size():
    def gradient(scale, **changes):
        actor = make(Actor, epochs=1, **changes)
        play(actor, lambda observation: scale * by_sign(observation), 64, 64, noise=0.0)
        return torch.cat([parameter.grad.flatten() for parameter in actor.logits.parameters()])

    one = gradient(1e2)
    assert one.norm() > 0.01
    torch.testing.assert_close(gradient(1e4), one, rtol=0.05, atol=1e-3)


def test_actor_samples_options_by_its_probabilities_and_writes_them():
    actor = make(Actor)
    observation = torch.tensor([[0.5, -0.5]]).expand(40_000, 2)
    td = actor(due(observation))
    probability = actor.logits(observation[0]).softmax(-1)
    assert td[keys.OPTION].float().mean().item() == pytest.approx(probability[1].item(), abs=0.01)
    torch.testing.assert_close(td[LOG_PROB], probability.log()[td[keys.OPTION]].detach())


def test_the_ratio_is_1_in_the_first_minibatch(monkeypatch):
    actor = make(Actor, epochs=2, minibatch_size=32)
    seen = []

    def loss(rows):
        log_prob = actor.logits(rows["state"]).log_softmax(-1).gather(-1, rows["option"].unsqueeze(-1)).squeeze(-1)
        seen.append((log_prob - rows["log_prob"]).abs().max().item())
        return Actor.loss(actor, rows)

    monkeypatch.setattr(actor, "loss", loss)
    play(actor, by_sign, 64, 64)
    assert len(seen) == 4 and seen[0] < 1e-6 and max(seen[1:]) > 1e-4


def test_the_targets_of_the_actor_are_discounted_by_the_options_length_and_end_with_the_episode():
    actor = make(Actor, gamma=0.9)
    decisions = mid_episode(actor)
    rows = actor.rows(decisions)
    next_value = actor.critic(torch.tensor([[0.5, 0.6]])).item()
    assert rows["target"].tolist() == pytest.approx([0.7 + 0.9**3 * next_value, 0.7, 0.7])
    torch.testing.assert_close(rows["state"], torch.tensor([[0.1, 0.2], [0.3, 0.4], [0.2, 0.3]]))


def test_decisions_that_wait_for_an_update_are_part_of_the_state_dict():
    actor = make(Actor)
    play(actor, by_sign, 40, 20)
    assert sum(len(rows) for rows in actor.waiting) == 40
    other = make(Actor, seed=1)
    other.load_state_dict(actor.state_dict())
    other.optimizer.load_state_dict(actor.optimizer.state_dict())
    decisions = ended(actor(due(torch.rand(40, 2))), torch.randn(40))
    for one in (actor, other):
        torch.manual_seed(3)
        assert one.learn(decisions) and not one.waiting
    for one, two in zip(actor.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(one, two)


def test_uniform_options_are_weighted_by_the_policys_probability_over_the_uniform_one():
    actor = make(Actor)
    actor.practice.fill_(0.5)
    observation = torch.tensor([[0.5, -0.5]]).expand(20_000, 2)
    td = actor(due(observation))
    probability = actor.logits(observation[0]).softmax(-1).detach()
    assert td[keys.OPTION].float().mean().item() == pytest.approx(0.5, abs=0.015)
    torch.testing.assert_close(td[LOG_PROB], probability.log()[td[keys.OPTION]])
    torch.testing.assert_close(td[WEIGHT], (probability / 0.5)[td[keys.OPTION]])
    actor.practice.zero_()
    assert (actor(due(observation))[WEIGHT] == 1.0).all()


def test_actor_settles_on_the_better_options_while_options_are_chosen_uniformly():
    actor = make(Actor)
    actor.practice.fill_(0.5)
    play(actor, by_sign, 4000, 50, noise=0.5)
    assert greedy_regret(actor) < 0.2
    observation = torch.tensor([[0.8, 0.0], [-0.8, 0.0]])
    assert actor.logits(observation).softmax(-1).amax(-1).min() > 0.9


def test_the_value_of_the_actor_is_that_of_its_policy_while_options_are_chosen_uniformly():
    actor = make(Actor, seed=2, lr=1e-2)
    with torch.no_grad():
        actor.logits[-1].weight.zero_()
        actor.logits[-1].bias.copy_(torch.tensor([0.0, 2.0]))
    actor.practice.fill_(0.5)
    actor.surrogate = lambda log_ratio, advantage: 0.0 * log_ratio  # so that the policy stays as it is
    play(actor, lambda observation: torch.tensor([0.0, 1.0]).expand(len(observation), 2), 6000, 100, noise=0.0)
    likely = torch.tensor([0.0, 2.0]).softmax(-1)[1].item()
    assert actor.critic(torch.zeros(1, 2)).item() == pytest.approx(likely, abs=0.05)


@pytest.mark.parametrize("cls", [MetaCritic, Actor])
def test_greedy_choices_use_no_random_numbers(cls):
    selector = make(cls)
    with global_generators_unmoved(), set_exploration_type(ExplorationType.DETERMINISTIC):
        selector(due(torch.rand(20, 2, generator=torch.Generator().manual_seed(0))))
