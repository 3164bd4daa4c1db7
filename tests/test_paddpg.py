"""PADDPG and PATD3: targets, inverted gradients, and learning a problem with a known optimum."""

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_steps import SPECS, one_step_rows, sample, states

from hpamdp import keys
from hpamdp.policies.base import States
from hpamdp.policies.low_level.paddpg import PADDPG, SCORES
from hpamdp.specs import PAMDPSpecs

OPTIONS = dict(
    initial_parameters="none", hidden_dims=[64, 64], warmup_steps=1000, buffer_size=20_000, batch_size=64,
    updates_per_step=0.12, gamma=0.9, tau=0.02, actor_lr=1e-3, critic_lr=1e-3, max_grad_norm=None, epsilon_final=0.1,
    epsilon_steps=3000,
)  # fmt: skip
GREEDY = set_exploration_type(ExplorationType.DETERMINISTIC)


def make(specs: PAMDPSpecs = SPECS, **changes) -> PADDPG:
    return PADDPG(specs, device=torch.device("cpu"), **{**OPTIONS, **changes})


def rows_with_scores(num: int = 200) -> TensorDict:
    return sample(num).set(SCORES, torch.rand(num, 3) * 2 - 1)


@pytest.mark.parametrize("twin", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_learner_finds_the_best_discrete_action_and_its_parameters(twin):
    torch.manual_seed(0)
    learner = make(twin=twin)
    for _ in range(22):
        learner.learn(one_step_rows(learner, 200), torch.ones(200, 1, dtype=torch.bool))
    with GREEDY:
        rows = one_step_rows(learner, 1000)
    assert (rows[keys.DISCRETE] == 1).float().mean() > 0.95
    assert rows["next", keys.REWARD].mean() > 0.85, "random actions earn about -0.2, action 2 alone 0.2, the optimum 1"


def test_the_discrete_action_is_that_of_the_highest_score_and_random_ones_are_uniform():
    torch.manual_seed(0)
    learner = make()
    td = learner.policy(states(9000))
    assert torch.equal(td[keys.DISCRETE], td[SCORES].argmax(-1))
    torch.testing.assert_close(td[keys.DISCRETE].bincount() / 9000, torch.full((3,), 1 / 3), atol=0.03, rtol=0.0)
    unit = SPECS.to_unit(td[keys.PARAMETERS])
    torch.testing.assert_close(unit.std(0), torch.full((3,), 3**-0.5), atol=0.03, rtol=0.0)


def test_a_greedy_action_is_the_actors_output():
    learner = make()
    with GREEDY:
        td = learner.policy(states(20))
    output = learner.actor(td[keys.OBSERVATION])
    torch.testing.assert_close(td[SCORES], output[:, :3])
    torch.testing.assert_close(SPECS.to_unit(td[keys.PARAMETERS]), output[:, 3:])


def test_targets_equal_those_computed_by_hand():
    learner, other = make(), make()
    learner.target_actor.load_state_dict(other.actor.state_dict())
    learner.target_critics.load_state_dict(other.critics.state_dict())
    batch = rows_with_scores()
    output = other.actor.net(batch["next_state"]).clamp(-1.0, 1.0)
    q = other.critics(torch.cat([batch["next_state"], output], -1))[0, :, 0]
    torch.testing.assert_close(learner.target(batch), batch["reward"] + batch["discount"] * q)


def test_patd3_takes_the_lower_value_of_two_critics_smooths_targets_and_delays_the_actor():
    batch = rows_with_scores()
    learner = make(twin=True, target_smoothing=0.0)
    output = learner.target_actor(batch["next_state"])
    q = learner.target_critics(torch.cat([batch["next_state"], output], -1)).squeeze(-1)
    assert q.shape[0] == 2
    torch.testing.assert_close(learner.target(batch), batch["reward"] + batch["discount"] * q.amin(0))

    smooth = make(twin=True, target_smoothing=0.5, target_smoothing_clip=0.5)
    assert not torch.allclose(smooth.target(batch), smooth.target(batch))
    learner.updates += 1
    assert "actor" not in learner.update_once(batch)
    learner.updates += 1
    assert "actor" in learner.update_once(batch)


def test_paddpg_has_no_part_of_td3():
    learner, batch = make(target_smoothing=0.5, target_smoothing_clip=0.5, policy_delay=5), rows_with_scores()
    assert learner.critics.num_members == 1
    torch.testing.assert_close(learner.target(batch), learner.target(batch))
    learner.updates += 1
    assert "actor" in learner.update_once(batch)


def test_the_actors_gradient_is_that_of_the_critic_scaled_by_the_range_that_is_left():
    learner = make(hidden_dims=[])
    state = torch.randn(6, 4)
    with torch.no_grad():
        learner.actor.net[0].weight.zero_()
        learner.actor.net[0].bias.copy_(torch.tensor([0.5, -0.5, 0.0, 2.0, -2.0, 0.9]))
        learner.critics.layers[0].weight[0, 4:, 0] = torch.tensor([3.0, 3.0, -2.0, 1.0, -1.0, -4.0])
    loss = -learner.critics(torch.cat([state, learner.actor(state)], -1))[0].mean()
    loss.backward()
    # Up by (1 - x) / 2, down by (1 + x) / 2 of the gradient; past a bound, back.
    ascent = torch.tensor([3.0 * 0.25, 3.0 * 0.75, -2.0 * 0.5, 1.0 * -0.5, -1.0 * -0.5, -4.0 * 0.95])
    torch.testing.assert_close(-learner.actor.net[0].bias.grad, ascent)


def test_parameters_start_at_the_problems_initial_ones():
    weight = ((0.5, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    learner = make(replace(SPECS, initial_weight=weight, initial_bias=(0.1, 0.8, -0.6)), initial_parameters="domain")
    state = torch.rand(50, 4) * 2 - 1
    expected = torch.stack([0.1 + 0.5 * state[:, 0], torch.full((50,), 0.8), torch.full((50,), -0.6)], -1)
    torch.testing.assert_close(learner.actor(state)[:, 3:], expected, atol=0.02, rtol=0.0)


def test_the_value_is_that_of_the_actors_output():
    learner = make(twin=True, target_smoothing=0.0)
    state = torch.randn(10, 4)
    q = learner.critics(torch.cat([state, learner.actor(state)], -1)).squeeze(-1).amin(0)
    torch.testing.assert_close(learner.value(States(state)), q)
