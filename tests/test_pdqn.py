"""P-DQN and MP-DQN: multi-pass critics, targets, n-step returns, and learning a problem with a known optimum."""

from dataclasses import replace

import pytest
import torch
from conftest import global_generators_unmoved, make_config
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_steps import SPECS, one_step_rows, sample, states

from hpamdp import keys
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.policies.shared.networks import InvertingGradients
from hpamdp.specs import PAMDPSpecs

OPTIONS = dict(
    hidden_dims=[64, 64], warmup_steps=1000, buffer_size=20_000, batch_size=64, updates_per_step=0.12, gamma=0.9,
    critic_lr=1e-3, actor_tau=0.02, critic_tau=0.02, epsilon_final=0.1, epsilon_steps=3000, initial_parameters="none",
    lr_steps=1000,
)  # fmt: skip
PUBLISHED = dict(twin=False, target_smoothing=0.0, policy_delay=1)


def make(specs: PAMDPSpecs = SPECS, **changes) -> PDQN:
    return PDQN(specs, device=torch.device("cpu"), **{**OPTIONS, **changes})


def learn(learner: PDQN, num_batches: int, size: int = 200) -> None:
    for _ in range(num_batches):
        learner.learn(one_step_rows(learner, size), torch.ones(size, 1, dtype=torch.bool))


OTHER_FORMS = [PUBLISHED, {"bounding": "inverting_gradients", "double_q": True}]


@pytest.mark.parametrize("changes", [{}, *(pytest.param(form, marks=pytest.mark.slow) for form in OTHER_FORMS)])
def test_the_learner_finds_the_best_discrete_action_and_its_parameters(changes):
    torch.manual_seed(0)
    learner = make(**changes)
    learn(learner, 18 if not changes else 30)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rows = one_step_rows(learner, 1000)
    assert (rows[keys.DISCRETE] == 1).float().mean() > 0.98
    assert rows["next", keys.REWARD].mean() > 0.9, "random actions earn about -0.2, action 2 alone 0.2, the optimum 1"


@pytest.mark.parametrize("multipass", [True, False])
def test_a_value_depends_on_its_own_parameters_alone_only_with_multipass(multipass):
    learner = make(multipass=multipass)
    unit = (torch.rand(8, 3) * 2 - 1).requires_grad_()
    q = learner.critics(torch.randn(8, 4), unit)
    for k in range(3):
        (gradient,) = torch.autograd.grad(q[..., k].sum(), unit, retain_graph=True)
        is_seen = (gradient != 0.0).any(0)
        assert torch.equal(is_seen, SPECS.parameter_mask[k] if multipass else torch.ones(3, dtype=torch.bool))


@pytest.mark.parametrize("multipass", [True, False])
def test_the_value_of_a_given_action_is_that_of_the_full_pass(multipass):
    learner, batch = make(multipass=multipass), sample()
    full = learner.critics(batch["state"], batch["unit"])
    expected = full[:, torch.arange(32), batch["discrete"]]
    torch.testing.assert_close(learner.critics.of_discrete(batch["state"], batch["discrete"], batch["unit"]), expected)


def test_the_actor_update_leaves_the_critics_alone():
    learner = make()
    before = {name: value.clone() for name, value in learner.state_dict().items()}
    learner.gradient_step("actor", learner.actor_loss, torch.randn(32, 4), None)
    moved = {name for name, value in learner.state_dict().items() if not torch.equal(value, before[name])}
    assert moved and all(name.startswith(("actor.", "policy.actor.")) for name in moved)
    assert all(p.grad is None and p.requires_grad for p in learner.critics.parameters())


@pytest.mark.parametrize("twin", [True, False])
@pytest.mark.parametrize("double_q", [True, False])
def test_targets_equal_those_computed_by_hand(twin, double_q):
    torch.manual_seed(0)
    learner, other = make(twin=twin, double_q=double_q, target_smoothing=0.0), make(twin=twin)
    learner.target_actor.load_state_dict(other.actor.state_dict())
    learner.target_critics.load_state_dict(other.critics.state_dict())
    batch = sample(200)
    target = learner.target(batch)
    choices = set()
    for i in range(200):
        state = batch["next_state"][i : i + 1]
        unit = learner.target_actor(state)
        # Each member's value of each discrete action, `[E][num_discrete]`.
        learned = learner.critics(state, unit)[:, 0].tolist()
        slow = learner.target_critics(state, unit)[:, 0].tolist()
        learned_q = [min(values) for values in zip(*learned, strict=True)]
        target_q = [min(values) for values in zip(*slow, strict=True)]
        choosing_q = learned_q if double_q else target_q
        chosen = choosing_q.index(max(choosing_q))
        choices.add(chosen == target_q.index(max(target_q)))
        expected = batch["reward"][i] + batch["discount"][i] * target_q[chosen]
        torch.testing.assert_close(target[i], expected)
    assert choices == ({True, False} if double_q else {True}), "the two choices of the action must differ somewhere"


def test_target_smoothing_is_bounded():
    batch = sample()
    learner = make(multipass=False, target_smoothing=100.0, target_smoothing_clip=0.0)
    smooth = learner.target(batch)
    learner.options = learner.options.model_copy(update={"target_smoothing": 0.0})
    torch.testing.assert_close(learner.target(batch), smooth)
    changed = {"target_smoothing": 0.5, "target_smoothing_clip": 0.5}
    learner.options = learner.options.model_copy(update=changed)
    assert not torch.allclose(learner.target(batch), smooth)


def test_n_step_returns_end_with_episodes_and_bootstrap_unless_terminated():
    learner = make(n_step=3, warmup_steps=10_000)
    # Environment 0: an episode that terminates at its third step, then another; environment 1: truncated at its second.
    reward = torch.tensor([[1.0, 2.0, 4.0, 8.0, 16.0], [1.0, 2.0, 4.0, 8.0, 16.0]])
    terminated = torch.tensor([[0, 0, 1, 0, 0], [0, 0, 0, 0, 0]], dtype=torch.bool)
    done = terminated | torch.tensor([[0, 0, 0, 0, 0], [0, 1, 0, 0, 0]], dtype=torch.bool)
    state = torch.arange(10.0).reshape(2, 5, 1).expand(2, 5, 4)
    batch = TensorDict(
        {
            keys.OBSERVATION: state,
            keys.ACTION: {"discrete": torch.zeros(2, 5, dtype=torch.long), "parameters": torch.ones(2, 5, 3)},
            "next": {
                keys.OBSERVATION: state + 100.0,
                keys.REWARD: reward.unsqueeze(-1),
                keys.DONE: done.unsqueeze(-1),
                keys.TERMINATED: terminated.unsqueeze(-1),
            },
        },
        [2, 5],
    )
    # The first episode of environment 1 is another learner's.
    mask = torch.ones(2, 5, dtype=torch.bool)
    mask[1, :2] = False
    learner.learn(batch, mask)
    stored = learner.buffer[:]
    assert stored["state"][:, 0].tolist() == [0, 1, 2, 3, 4, 7, 8, 9]
    g = 0.9
    expected = [1 + 2 * g + 4 * g**2, 2 + 4 * g, 4, 8 + 16 * g, 16, 4 + 8 * g + 16 * g**2, 8 + 16 * g, 16]
    torch.testing.assert_close(stored["reward"], torch.tensor(expected))
    torch.testing.assert_close(stored["discount"], torch.tensor([0, 0, 0, g**2, g, g**3, g**2, g]))
    assert stored["next_state"][:, 0].tolist() == [102, 102, 102, 104, 104, 109, 109, 109]
    # Steps of other durations: 2 units of the discount each.
    batch["next", keys.DURATION] = torch.full((2, 5, 1), 2.0)
    lasting = learner.transitions(batch)[1, 2:]
    torch.testing.assert_close(lasting["reward"], torch.tensor([4 + 8 * g**2 + 16 * g**4, 8 + 16 * g**2, 16]))
    torch.testing.assert_close(lasting["discount"], torch.tensor([g**6, g**4, g**2]))
    del batch["next", keys.DURATION]
    truncated = learner.transitions(batch)[1, :2]
    torch.testing.assert_close(truncated["reward"], torch.tensor([1 + 2 * g, 2]))
    torch.testing.assert_close(truncated["discount"], torch.tensor([g**2, g]))
    assert truncated["next_state"][:, 0].tolist() == [106, 106]


def test_inverting_gradients_follow_the_formula_and_turn_back_past_the_bounds():
    raw = torch.tensor([-1.5, -1.0, 0.0, 0.5, 1.0, 1.5], requires_grad=True)
    clipped = InvertingGradients.apply(raw)
    assert clipped.tolist() == [-1.0, -1.0, 0.0, 0.5, 1.0, 1.0]
    # Upwards the gradient is multiplied by (high - x) / (high - low), downwards by (x - low) / (high - low).
    (up,) = torch.autograd.grad(-2.0 * clipped.sum(), raw, retain_graph=True)
    torch.testing.assert_close(-up, 2.0 * (1.0 - raw.detach()) / 2.0)
    (down,) = torch.autograd.grad(2.0 * clipped.sum(), raw)
    torch.testing.assert_close(down, 2.0 * (raw.detach() + 1.0) / 2.0)


def test_the_greedy_policy_samples_nothing_and_the_exploring_one_varies_the_whole_action():
    learner, td = make(), states(500)
    with global_generators_unmoved(), set_exploration_type(ExplorationType.DETERMINISTIC):
        greedy = learner.policy(td.clone())
    random = learner.policy(td.clone())
    assert random[keys.DISCRETE].unique().tolist() == [0, 1, 2]
    learner.policy.epsilon.zero_()
    noisy = learner.policy(td.clone())
    assert torch.equal(noisy[keys.DISCRETE], greedy[keys.DISCRETE])
    moved = SPECS.to_unit(noisy[keys.PARAMETERS]) - SPECS.to_unit(greedy[keys.PARAMETERS])
    assert 0.08 < moved.std() < 0.12


def test_random_actions_keep_the_actors_parameters_only_if_told_so():
    moved = {}
    for form in ("uniform", "actor"):
        torch.manual_seed(0)
        learner, td = make(random_parameters=form, parameter_noise=0.0), states(500)
        taken = learner.policy(td.clone())
        assert taken[keys.DISCRETE].unique().tolist() == [0, 1, 2]
        moved[form] = SPECS.to_unit(taken[keys.PARAMETERS]) - learner.actor(td[keys.OBSERVATION]).detach()
    torch.testing.assert_close(moved["actor"], torch.zeros(500, 3), atol=1e-6, rtol=0.0)
    assert moved["uniform"].std() > 0.4


def test_ornstein_uhlenbeck_noise_goes_on_from_step_to_step():
    torch.manual_seed(0)
    learner, td = make(noise_process="ornstein_uhlenbeck", parameter_noise=0.05), states(500)
    learner.policy.epsilon.zero_()
    before, steps = torch.zeros(500, 3), []
    own = learner.actor(td[keys.OBSERVATION]).detach()
    for _ in range(40):
        td = learner.policy(td)
        noise = SPECS.to_unit(td[keys.PARAMETERS]) - own
        steps.append(noise - 0.85 * before)
        before = noise
    assert torch.stack(steps).std() == pytest.approx(0.05, rel=0.03)
    assert before.std() == pytest.approx(0.05 / (1.0 - 0.85**2) ** 0.5, rel=0.05)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(SPECS.to_unit(learner.policy(td)[keys.PARAMETERS]), own)


@pytest.mark.parametrize("multipass", [True, False])
def test_the_greedy_policy_takes_the_best_allowed_action_of_the_actor_and_its_variations(multipass):
    torch.manual_seed(0)
    learner = make(multipass=multipass, greedy_samples=40, greedy_noise=0.5)
    td = states(30)
    td[keys.ACTION_MASK] = torch.tensor([True, True, False]).expand(30, -1)
    with global_generators_unmoved(), set_exploration_type(ExplorationType.DETERMINISTIC):
        taken = learner.policy(td.clone())
    has_varied = 0
    for i in range(30):
        state = td[keys.OBSERVATION][i : i + 1]
        own = learner.actor(state)
        tried = [own, *((own + each).clamp(-1.0, 1.0) for each in learner.policy.variations)]
        values = {
            (number, k): learner.critics(state, unit)[:, 0, k].min().item()
            for number, unit in enumerate(tried)
            for k in (0, 1)
        }
        number, discrete = max(values, key=values.__getitem__)
        has_varied += number > 0
        assert taken[keys.DISCRETE][i] == discrete
        torch.testing.assert_close(SPECS.to_unit(taken[keys.PARAMETERS][i]), tried[number][0].detach())
    assert has_varied > 20, "an untrained actor is nowhere near the maximum"


def test_variations_of_greedy_parameters_change_neither_exploration_nor_training():
    ends = []
    for greedy_samples in (0, 20):
        torch.manual_seed(0)
        learner = make(greedy_samples=greedy_samples, warmup_steps=100)
        learn(learner, 3)
        ends.append(learner.state_dict())
    assert ends[0].keys() == ends[1].keys()
    assert all(torch.equal(value, ends[1][name]) for name, value in ends[0].items())


def test_gradients_are_clipped_to_the_given_norm():
    learner = make(max_grad_norm=1e-3)
    learner.update_once(sample())
    norm = torch.stack([p.grad.norm() for p in learner.critics.parameters()]).norm()
    assert norm <= 1.001e-3


def test_multi_pass_stores_the_chosen_actions_parameters_alone_and_samples_them_with_zeros():
    learner = make(warmup_steps=10_000)
    td = one_step_rows(learner, 50)
    learner.learn(td, torch.ones(50, 1, dtype=torch.bool))
    assert learner.buffer[:]["unit"].shape == (50, 2), "the largest number of parameters of an action"
    learner.options = learner.options.model_copy(update={"batch_size": 400})
    rows = next(iter(learner.sample_batches(1)))
    own = SPECS.parameter_mask[rows["discrete"]]
    assert rows["unit"].shape == (400, 3) and (rows["unit"][~own] == 0.0).all()
    played = {tuple(unit) for unit in (SPECS.to_unit(td[keys.PARAMETERS])[:, 0]).tolist()}
    stored = [tuple(row) for row in rows["unit"].tolist()]
    for discrete, row in zip(rows["discrete"].tolist(), stored, strict=True):
        mine = SPECS.parameter_mask[discrete].nonzero().flatten().tolist()
        assert any(all(unit[i] == row[i] for i in mine) for unit in played)


WEIGHT = ((0.5, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("bounding", ["tanh", "inverting_gradients"])
def test_parameters_start_at_the_problems_initial_ones_and_can_move(bounding):
    specs = replace(SPECS, initial_weight=WEIGHT, initial_bias=(0.1, 0.8, -0.6))
    learner = make(specs, bounding=bounding, initial_parameters="domain")
    state = torch.rand(50, 4) * 2 - 1
    expected = torch.stack([0.1 + 0.5 * state[:, 0], torch.full((50,), 0.8), torch.full((50,), -0.6)], -1)
    before = learner.actor(state)
    torch.testing.assert_close(before, expected, atol=0.02, rtol=0.0)
    learner.gradient_step("actor", learner.actor_loss, state, None)
    assert (learner.actor(state) != before).any()


@pytest.mark.parametrize("penalty", [0.0, 0.1])
def test_a_penalty_on_preactivations_frees_parameters_that_tanh_holds_at_a_bound(penalty):
    torch.manual_seed(0)
    learner = make(preactivation_penalty=penalty, actor_lr=1e-2)
    state = states(64)[keys.OBSERVATION]
    with torch.no_grad():
        learner.actor.net[-1].bias.fill_(20.0)  # the tanh of which is 1
    for _ in range(200):
        learner.gradient_step("actor", learner.actor_loss, state, None)
    is_free = learner.actor(state) < 0.99
    assert is_free.all() if penalty > 0.0 else not is_free.any()


class TwoHills(torch.nn.Module):
    """Values that have a high hill at `high` and a low one at 0.6 in every parameter of the discrete action.

    The first discrete action has no parameters, the second two, the third one.
    """

    high = torch.tensor([-0.7, -0.4, -0.2])

    def forward(self, state: torch.Tensor, unit: torch.Tensor) -> torch.Tensor:
        hills = torch.maximum(1.0 - 2.0 * (unit - self.high).abs(), 0.5 - 2.0 * (unit - 0.6).abs())
        return torch.stack([torch.zeros(len(unit)), hills[:, :2].sum(-1), hills[:, 2]], -1).unsqueeze(0)


TWO_HILLS = replace(SPECS, parameter_dims=(0, 2, 1))


@pytest.mark.parametrize(("search_samples", "bounding"), [(0, "tanh"), (16, "tanh"), (16, "inverting_gradients")])
def test_the_search_brings_the_actor_to_a_higher_hill_that_its_gradient_does_not_see(search_samples, bounding):
    torch.manual_seed(0)
    learner = make(TWO_HILLS, search_samples=search_samples, search_weight=10.0, bounding=bounding, actor_lr=1e-2)
    learner.critics = TwoHills()
    state = states(64)[keys.OBSERVATION]
    with torch.no_grad():
        learner.actor.net[-1].weight.zero_()
        learner.actor.net[-1].bias.fill_(0.5)
    for _ in range(300):
        learner.gradient_step("actor", learner.actor_loss, state, None)
    expected = TwoHills.high if search_samples else torch.full((3,), 0.6)
    torch.testing.assert_close(learner.actor(state), expected.expand(64, -1), atol=0.1, rtol=0.0)


def test_the_search_leaves_forbidden_actions_parameters_alone():
    torch.manual_seed(0)
    learner = make(TWO_HILLS, search_samples=8)
    learner.critics = TwoHills()
    allowed = torch.tensor([True, False, True]).expand(64, -1)
    loss, _ = learner.actor_loss(states(64)[keys.OBSERVATION], allowed)
    gradient = torch.autograd.grad(loss, learner.actor.net[-1].bias)[0]
    assert (gradient != 0.0).tolist() == [False, False, True]


def test_epsilon_can_fall_with_the_episodes_from_the_start():
    learner = make(warmup_steps=80, updates_per_step=0.01, epsilon_episodes=100, epsilon_final=0.2)
    learn(learner, 1, size=50)  # in the warm-up
    assert learner.policy.epsilon == pytest.approx(1.0 - 0.8 * 0.5)
    learn(learner, 2, size=50)
    assert learner.policy.epsilon == pytest.approx(0.2)


def test_the_published_recipe_runs_where_there_are_no_initial_parameters():
    settings = make_config(["low=pdqn_published", "high=none", "env=platform"]).low.settings
    short = {"warmup_steps": 200, "updates_per_step": 0.05}
    learner = make(**{name: value for name, value in (settings | short).items() if name != "budget"})
    learn(learner, 2)
    assert learner.updates > 0
