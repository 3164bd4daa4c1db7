"""Linear contextual bandits: features, predictions, and that they learn which option is better where."""

import itertools
from dataclasses import replace

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_bandits import SPECS, against_sign, by_sign, constant, due, ended, play

from hpamdp import keys
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.planner import plans_of_options
from hpamdp.policies.high_level.lin_thompson import LinThompson
from hpamdp.policies.high_level.linucb import LinUCB
from hpamdp.policies.shared.bandit_options import LinearBanditOptions
from hpamdp.policies.shared.linear_bandit import ContextFeatures, LinearBandit, ProjectionFeatures
from hpamdp.specs import PAMDPSpecs

MEMORIES = ("all", "discounted", "sliding_window")
BANDITS = {"linucb": LinUCB, "lin_thompson": LinThompson}
OPTIONS = dict(
    exploration=1.0, inputs=None, features="polynomial", degree=2, ridge=1.0, memory="all", discount=0.998, window=500
)  # fmt: skip
every_bandit = pytest.mark.parametrize("name", BANDITS)
every_memory = pytest.mark.parametrize("memory", MEMORIES)


def make(name: str, **changes: object) -> LinearBandit:
    return BANDITS[name](SPECS, **{**OPTIONS, **changes})


def wide(observation_dim: int) -> PAMDPSpecs:
    return PAMDPSpecs(observation_dim, ("left", "right"), (1,), (0.0,), (1.0,))


def teach(bandit: LinearBandit, num: int, at_once: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Let the bandit learn `num` random decisions; return their observations, options and rewards."""
    torch.manual_seed(0)
    observation = torch.rand(num, 2) * 2 - 1
    option = torch.randint(2, (num,))
    reward = torch.randn(num)
    for rows in torch.arange(num).split(at_once):
        bandit.learn(ended(due(observation[rows], option=option[rows]), reward[rows]))
    return observation, option, reward


# Features.


@pytest.mark.parametrize(("num_inputs", "degree"), [(1, 4), (2, 3), (3, 2), (2, 1)])
def test_polynomial_features_are_all_monomials_up_to_the_degree(num_inputs, degree):
    torch.manual_seed(0)
    observation = torch.randn(7, num_inputs).double()
    powers = [p for p in itertools.product(range(degree + 1), repeat=num_inputs) if sum(p) <= degree]
    expected = torch.stack([(observation ** torch.tensor(p)).prod(-1) for p in powers], -1)
    features = ContextFeatures(wide(num_inputs), LinearBanditOptions(features="polynomial", degree=degree))
    found = features(observation)[:, 0]
    assert features.num_features == len(powers) == found.shape[-1]
    torch.testing.assert_close(found[0].sort().values, expected[0].sort().values)
    torch.testing.assert_close(found.pow(2).sum(-1), expected.pow(2).sum(-1))


def test_random_fourier_features_approximate_the_gaussian_kernel_and_are_the_same_in_every_run():
    torch.manual_seed(0)
    first = ContextFeatures(wide(3), LinearBanditOptions(features="random_fourier", degree=200))
    torch.manual_seed(1)
    second = ContextFeatures(wide(3), LinearBanditOptions(features="random_fourier", degree=200))
    x, y = torch.zeros(1, 3), torch.tensor([[0.6, 0.0, 0.0]])
    assert torch.equal(first(x), second(x)) and first(x).shape == (1, 2, 201) and (first(x)[0, :, -1] == 1.0).all()
    # Twice the mean product of two cosines approximates the Gaussian kernel exp(-|x - y|^2 / 2).
    kernel = (first(x)[0, 0, :-1] * first(y)[0, 0, :-1]).mean() * 2
    assert kernel.item() == pytest.approx(torch.tensor(-(0.6**2) / 2).exp().item(), abs=0.15)


def test_features_use_only_the_inputs():
    features = ContextFeatures(wide(4), LinearBanditOptions(inputs=[2, 0]))
    assert features(torch.tensor([5.0, 6.0, 7.0, 8.0])).tolist() == [[7.0, 5.0, 1.0]] * 2


def test_projections_tell_from_few_decisions_which_boat_is_better():
    env = BoatDockEnv(3000, seed=5)
    observation = env.reset()[keys.OBSERVATION]
    scores = plans_of_options(env.options, env._state).score.double()
    bandit = LinUCB(PAMDPSpecs.from_env(env))
    torch.manual_seed(0)
    option = torch.randint(2, (300,))
    reward = scores[:300].gather(-1, option.unsqueeze(-1)).squeeze(-1) + 0.5 * torch.randn(300)
    bandit.learn(ended(due(observation[:300], option=option), reward))
    mean, _ = bandit.predict(observation)
    # The entries of the observation that are best for polynomials would need several thousand decisions for it.
    assert (mean.argmax(-1) == scores.argmax(-1))[300:].float().mean() > 0.9


def test_projections_do_not_change_if_the_plane_is_turned_with_the_actions():
    specs, turned = (PAMDPSpecs.from_env(BoatDockEnv(2)) for _ in range(2))
    turn = torch.tensor([[0.6, -0.8], [0.8, 0.6]])
    geometry = specs.geometry
    turned = replace(turned, geometry=replace(geometry, directions=geometry.directions.flip(1) @ turn.T))
    observation = torch.randn(9, specs.observation_dim)
    moved = observation.clone()
    for pair in geometry.vectors:
        moved[:, pair] = observation[:, pair] @ turn.T
    torch.testing.assert_close(ProjectionFeatures(turned)(moved), ProjectionFeatures(specs)(observation))


# Predictions.


@every_memory
@pytest.mark.parametrize("at_once", [1, 7, 60])
def test_predictions_and_their_deviations_are_those_of_a_ridge_regression(memory, at_once):
    bandit = make("linucb", ridge=0.5, memory=memory, discount=0.9, window=25)
    observation, option, reward = teach(bandit, 60, at_once)
    weight = torch.ones(60).double()
    if memory == "discounted":
        weight = 0.9 ** torch.arange(59, -1, -1).double()
    if memory == "sliding_window":
        weight[:-25] = 0.0
    x, y = bandit.features(observation)[:, 0], reward.double()
    probe = torch.rand(9, 2) * 2 - 1
    mean, deviation = bandit.predict(probe)
    squares = 0.0
    spread = []
    for i in (0, 1):
        w = weight * (option == i)
        a = x.T @ (w.unsqueeze(-1) * x) + 0.5 * torch.eye(6).double()
        theta = torch.linalg.solve(a, x.T @ (w * y))
        of_probe = bandit.features(probe)[:, i]
        torch.testing.assert_close(mean[:, i], of_probe @ theta)
        squares += (w * (y - x @ theta).square()).sum() + 0.5 * theta.square().sum()
        spread.append((of_probe @ torch.linalg.inv(a) * of_probe).sum(-1).sqrt())
    noise = (squares / weight.sum()).sqrt()
    torch.testing.assert_close(deviation, noise * torch.stack(spread, -1))


@every_bandit
@pytest.mark.parametrize("degree", [1, 3])
def test_observations_may_be_in_pixels(name, degree):
    torch.manual_seed(0)
    bandit = BANDITS[name](wide(6), **{**OPTIONS, "degree": degree})
    observation = torch.rand(2000, 6) * torch.tensor([1280.0, 1024.0, 1280.0, 1024.0, 0.0, 0.0])
    observation[:, 4:] = torch.tensor([640.0, 512.0])  # the same in every observation
    option = torch.randint(2, (2000,))
    right = (observation[:, 0] - observation[:, 2]) / 300.0
    bandit.learn(ended(due(observation, option=option), torch.where(option == 1, right, -right)))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        chosen = bandit.select(due(observation))
    assert (chosen == (right > 0)).float().mean() > 0.97


# Choices.


def test_linucb_adds_the_width_only_if_it_explores():
    bandit = make("linucb", exploration=3.0)
    teach(bandit, 20, 20)
    probe = torch.rand(500, 2) * 2 - 1
    mean, deviation = bandit.predict(probe)
    assert torch.equal(bandit.select(due(probe)), (mean + 3.0 * deviation).argmax(-1))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(bandit.select(due(probe)), mean.argmax(-1))
    assert not torch.equal((mean + 3.0 * deviation).argmax(-1), mean.argmax(-1))


def test_lin_thompson_chooses_an_option_as_often_as_it_is_likely_to_be_the_best():
    bandit = make("lin_thompson", exploration=3.0)
    teach(bandit, 20, 20)
    probe = torch.tensor([[0.3, -0.4]])
    mean, deviation = bandit.predict(probe)
    likely = torch.distributions.Normal(0.0, 1.0).cdf((mean[0, 1] - mean[0, 0]) / (3.0 * deviation.norm())).item()
    chosen = bandit.select(due(probe.expand(40_000, 2)))
    assert 0.02 < likely < 0.98 and chosen.float().mean().item() == pytest.approx(likely, abs=0.01)


@every_bandit
def test_untried_options_come_first_and_in_random_order(name):
    torch.manual_seed(0)
    bandit = make(name)
    assert 20 <= bandit.select(due(torch.rand(100, 2))).sum().item() <= 80
    for reward in (5.0, 1e30):
        bandit.learn(ended(due(torch.rand(9, 2), option=torch.zeros(9, dtype=torch.long)), torch.full((9,), reward)))
        assert bandit.select(due(torch.rand(100, 2))).all()


@every_bandit
@pytest.mark.parametrize("features", ["polynomial", "random_fourier"])
def test_a_greedy_choice_takes_no_untried_option_however_low_the_known_rewards_are(name, features):
    torch.manual_seed(0)
    bandit = make(name, features=features)
    probe = torch.rand(100, 2) * 10.0 - 5.0
    bandit.learn(ended(due(torch.rand(9, 2), option=torch.ones(9, dtype=torch.long)), torch.full((9,), -5.0)))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert bandit.select(due(probe)).all()
        only_untried = torch.tensor([True, False]).expand(100, 2)
        assert not bandit.select(due(probe, option_mask=only_untried)).any()
    exported = bandit.exported()
    if exported is not None:  # what a page computes of it
        numbers = (bandit.features(probe) * torch.tensor(exported["coefficients"], dtype=torch.float64)).sum(-1)
        assert numbers.argmax(-1).all()


@every_bandit
def test_bandits_learn_which_option_is_better_where(name):
    torch.manual_seed(0)
    _, regret = play(make(name, degree=3), by_sign, 3000, 8, noise=0.5)
    # The regret of always the same option is 1.
    assert regret[-500:].mean() < 0.15


@every_bandit
def test_bandits_that_forget_follow_a_swap_of_the_better_options_and_others_lag(name):
    after = {}
    for memory in MEMORIES:
        torch.manual_seed(0)
        bandit = make(name, memory=memory, degree=1)
        play(bandit, by_sign, 3000, 40, noise=0.5)
        regret = play(bandit, against_sign, 2000, 40, noise=0.5)[1]
        after[memory] = regret.mean().item()
        assert memory == "all" or regret[-500:].mean() < 0.2
    assert after["all"] > 0.3 + max(after["discounted"], after["sliding_window"])


@every_bandit
@every_memory
def test_a_copy_made_from_a_state_dict_continues_identically(name, memory):
    torch.manual_seed(0)
    source, target = make(name, memory=memory), make(name, memory=memory)
    play(source, constant(0.0, 1.0), 50)
    target.load_state_dict(source.state_dict())
    torch.manual_seed(1)
    expected, _ = play(source, by_sign, 60, 2)
    torch.manual_seed(1)
    assert torch.equal(play(target, by_sign, 60, 2)[0], expected)


def test_the_context_is_the_observation_at_which_the_option_was_chosen():
    bandit = make("linucb", degree=1)
    decisions = ended(due(torch.ones(4, 2), option=torch.zeros(4, dtype=torch.long)), torch.ones(4))
    decisions[keys.OBSERVATION] = torch.full((4, 2), 9.0)  # at the option's last step
    bandit.learn(decisions)
    torch.testing.assert_close(bandit.gram[0], torch.full((3, 3), 4.0).double())
