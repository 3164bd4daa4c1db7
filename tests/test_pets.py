"""PETS: the search over sequences, what the model is told, its members, and problems that it solves."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.catch_point.environment import CatchPointEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.base import States
from hpamdp.policies.low_level.dlpa.learner import DLPA
from hpamdp.policies.low_level.pets.learner import PETS
from hpamdp.policies.low_level.pets.policy import MEMBER
from hpamdp.policies.shared.end_values import EndValues
from hpamdp.policies.shared.options import EndValueOptions
from hpamdp.policies.shared.planning import (
    PlannedAction,
    Prediction,
    SequenceSearch,
    absolute_temperature,
    discounted_return,
    elite_weights,
)
from hpamdp.policies.shared.scales import scale_of
from hpamdp.specs import PAMDPSpecs

CPU = torch.device("cpu")
SPECS = PAMDPSpecs(4, (), (1, 2, 0), (0.0, -1.0, 5.0), (2.0, 1.0, 9.0))
BOAT = PAMDPSpecs.from_env(BoatDockEnv(1, controller="congruent"))

SEARCH = dict(
    horizon=2, max_sequences=16, num_kept=3, num_samples=16, greedy_samples=16, num_elites=4, num_iterations=3,
    temperature=0.1, first_min_deviation=0.2, min_deviation=0.02,
)  # fmt: skip
OPTIONS = dict(
    num_members=3, transition_dims=[32, 32], outcome_dims=[32, 32], lr=2e-3, weight_decay=0.1, warmup_steps=64,
    updates_per_step=0.1, batch_size=32, buffer_size=4000, posterior_sampling=True, optimism=0.0, gamma=0.97,
    planning_precision="float32", **SEARCH,
)  # fmt: skip


def make(specs: PAMDPSpecs = SPECS, **changes) -> PETS:
    torch.manual_seed(0)
    return PETS(specs, device=CPU, **{**OPTIONS, **changes})


def batch_of(state, discrete, unit, reward, next_state, terminated, truncated=None, specs=SPECS) -> TensorDict:
    truncated = torch.zeros_like(terminated) if truncated is None else truncated
    flags = {keys.TERMINATED: terminated, keys.TRUNCATED: truncated, keys.DONE: terminated | truncated}
    after = {keys.OBSERVATION: next_state, keys.REWARD: reward.unsqueeze(-1)}
    after |= {name: flag.unsqueeze(-1) for name, flag in flags.items()}
    action = {"discrete": discrete, "parameters": specs.from_unit(unit)}
    flat = TensorDict({keys.OBSERVATION: state, keys.ACTION: action, "next": after}, [len(state)])
    return flat.unsqueeze(-1)


def random_batch(num: int, **changes) -> TensorDict:
    parts = {
        "state": torch.randn(num, 4),
        "discrete": torch.randint(3, (num,)),
        "unit": torch.rand(num, 3) * 2 - 1,
        "reward": torch.randn(num),
        "next_state": torch.randn(num, 4),
        "terminated": torch.rand(num) < 0.3,
    }
    return batch_of(**{**parts, **changes})


def learn(learner: PETS, batch: TensorDict) -> dict[str, float]:
    return learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))


# The search.


def whole(steps) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the sequences that the steps make up, `[N, Q, H]` and `[N, Q, S, H, D]`."""
    num = steps[-1].discrete.shape[1]
    parts = [[part.repeat_interleave(num // part.shape[1], 1) for part in step] for step in steps]
    return torch.stack([discrete for discrete, _ in parts], -1), torch.stack([own for _, own in parts], -2)


def test_all_sequences_are_tried_where_there_are_few():
    search = SequenceSearch(SPECS.parameter_dims, **SEARCH)
    first, second = search.sequences(2, CPU)
    assert first.tolist() == [[0, 1, 2]] * 2
    assert second.tolist() == [[0, 1, 2] * 3] * 2, "each first step is shared by the sequences that begin with it"


def test_half_as_many_sequences_are_refined_in_each_iteration_those_with_the_best_samples():
    seen = []

    def returns(steps):
        discrete, unit = whole(steps)
        seen.append(discrete)
        return (3.0 * discrete[..., 0] + discrete[..., 1]).unsqueeze(-1).expand(unit.shape[:3]).float()

    options = {**SEARCH, "num_kept": 5, "num_iterations": 5}
    SequenceSearch((1, 1, 1), **options)(returns, 2, CPU)
    best = [[2, 2], [2, 1], [2, 0], [1, 2], [1, 1]]
    assert [discrete[0].tolist() for discrete in seen[1:]] == [best, best[:2], best[:1], best[:1]]


def test_the_plan_is_the_best_sample_of_all_iterations():
    seen = []

    def returns(steps):
        unit = whole(steps)[1]
        seen.append((unit[..., 0, 0].flatten(1), -(unit[..., 0, 0] - 0.3).abs().flatten(1)))
        return seen[-1][1].unsqueeze(1)

    found = SequenceSearch((1,), **{**SEARCH, "horizon": 1})(returns, 30, CPU)
    unit, value = (torch.cat(part, -1) for part in zip(*seen, strict=True))
    torch.testing.assert_close(found.value, value.amax(-1))
    torch.testing.assert_close(found.own, unit.take_along_dim(value.argmax(-1, keepdim=True), -1))


def test_the_smallest_deviation_falls_from_iteration_to_iteration():
    spread = []

    def returns(steps):
        unit = whole(steps)[1]
        spread.append(unit[..., 0, 0].std().item())
        return -unit[..., 0, 0].square()

    options = {**SEARCH, "num_iterations": 4, "num_samples": 256, "first_min_deviation": 0.2, "min_deviation": 0.05}
    SequenceSearch((1,), **options)(returns, 20, CPU)
    assert [round(value, 2) for value in spread[1:]] == [0.2, 0.1, 0.05]


def test_a_rougher_estimate_may_choose_what_is_refined():
    def rough(steps):
        discrete, unit = whole(steps)
        return (discrete[..., 0] == 2).float().unsqueeze(-1).expand(unit.shape[:3])

    def exact(steps):
        discrete, unit = whole(steps)
        return -unit[..., 0, 0].square() - (discrete[..., 0] == 2).float().unsqueeze(-1)

    search = SequenceSearch((1, 1, 1), **{**SEARCH, "num_iterations": 4})
    found = search(exact, 10, CPU, first_returns=rough)
    assert (found.discrete == 2).all() and (found.value < -0.9).all()
    assert (SequenceSearch((1, 1, 1), **SEARCH)(exact, 10, CPU).discrete != 2).all()


def test_samples_are_spread_evenly():
    seen = []

    def returns(steps):
        seen.append(steps[0].own)
        return -steps[1].own.square().sum(-1)

    SequenceSearch((1, 1), **{**SEARCH, "num_kept": 4, "num_iterations": 1})(returns, 5, CPU)
    place = ((seen[0][..., 0] + 1.0) * 8.0).floor().sort(-1).values
    assert (place == torch.arange(16)).all(), "one of 16 in each sixteenth of the bounds"


def test_of_many_sequences_random_ones_are_tried_in_which_first_actions_occur_equally_often():
    search = SequenceSearch((1,) * 8, **{**SEARCH, "horizon": 5, "max_sequences": 32})
    sequences = torch.stack(search.sequences(50, CPU), -1)
    assert sequences.shape == (50, 32, 5)
    for state in sequences[..., 0]:
        assert state.bincount(minlength=8).tolist() == [4] * 8
    assert len(sequences[:, :, 1:].flatten(0, 1).unique(dim=0)) > 1000


@pytest.mark.parametrize("max_sequences", [2, 64])
def test_the_search_finds_the_best_sequence_and_its_parameters(max_sequences):
    # Worth most: action 1 with (.5, -.3), then action 0 with .2; of two random sequences one has the right beginning.
    def returns(steps):
        discrete, unit = whole(steps)
        error = (unit[..., 0, 0] - 0.5).square() + (unit[..., 0, 1] + 0.3).square() + (unit[..., 1, 0] - 0.2).square()
        is_best = (discrete[..., 0] == 1) & ((discrete[..., 1] == 0) | (max_sequences == 2))
        return is_best.float().unsqueeze(-1) - error

    torch.manual_seed(0)
    options = {**SEARCH, "max_sequences": max_sequences, "num_samples": 64, "num_elites": 8, "num_iterations": 6}
    found = SequenceSearch((1, 2), **options)(returns, 20, CPU)
    assert (found.discrete == 1).all()
    torch.testing.assert_close(found.own, torch.tensor([0.5, -0.3]).expand(20, 2), atol=0.06, rtol=0.0)


def test_what_an_action_has_no_parameter_for_is_0_in_every_sample():
    seen = []

    def returns(steps):
        seen.append(whole(steps))
        return torch.rand(seen[-1][1].shape[:3])

    SequenceSearch(SPECS.parameter_dims, **SEARCH)(returns, 5, CPU)
    dims = torch.tensor(SPECS.parameter_dims)
    for discrete, unit in seen:
        has_none = torch.arange(2) >= dims[discrete].unsqueeze(-1)
        assert (unit.abs().amax(2)[has_none] == 0).all() and (unit.abs().amax(2)[~has_none] > 0).all()
    assert [discrete.shape[1] for discrete, _ in seen] == [9, 3, 1]


def test_a_return_weights_rewards_by_the_end_of_the_episode():
    one = torch.ones(2, 5)
    step = Prediction(one, 2.0 * one, torch.stack([3.0 * one[0], 5.0 * one[0]]), torch.zeros(2, 5))
    expected = torch.tensor([2.5, 3.5])[:, None] * (1.0 + 0.5 * 0.5)
    torch.testing.assert_close(discounted_return([step, step], 0.5), expected.expand(2, 5))


def test_elites_are_the_best_weighted_by_their_returns():
    returns = torch.tensor([[0.1, 3.0, 2.0, -1.0], [2.0, 2.0, 2.0, 2.0]])
    temperature = absolute_temperature(0.5, returns)
    place, weight = elite_weights(returns, 2, temperature.unsqueeze(-1))
    assert place[0].tolist() == [1, 2]
    spread = returns[0].std(correction=0)
    torch.testing.assert_close(weight[0, 0] / weight[0, 1], (2.0 / spread).exp())
    assert weight[1].tolist() == [0.5, 0.5], "equal returns have equal weights"


def test_the_scale_of_rewards_leaves_a_plan_as_it_is():
    def planned(scale: float) -> PlannedAction:
        def returns(steps):
            total = sum(step.own.sum(-1).sin() - 0.3 * step.discrete.unsqueeze(-1) for step in steps[-1:])
            return scale * total

        torch.manual_seed(0)
        search = SequenceSearch((1, 2), horizon=2, num_kept=2)
        return search(returns, 3, torch.device("cpu"))

    one, other = planned(1.0), planned(50.0)
    assert torch.equal(one.discrete, other.discrete)
    torch.testing.assert_close(one.own, other.own, atol=1e-4, rtol=1e-4)


# The model.


def test_the_model_learns_where_steps_lead_when_they_end_and_what_ends_earn():
    """Entry 0 moves by the parameter of action 0 or 1; past 1 the episode ends, which earns 10 with action 1."""
    torch.manual_seed(0)
    num = 512
    state, unit = torch.rand(num, 4) * 2 - 1, torch.rand(num, 3) * 2 - 1
    discrete = torch.randint(3, (num,))
    way = torch.where(discrete == 0, unit[:, 0], torch.where(discrete == 1, unit[:, 1] * unit[:, 2], 0.0))
    after = state.clone()
    after[:, 0] += way
    ends = after[:, 0].abs() > 1
    reward = torch.where(ends, 10.0 * (discrete == 1), way)
    # Where an episode ends, the observation says nothing.
    after[ends] = 0.0
    learner = make(updates_per_step=1.2, lr=5e-3)
    learn(learner, batch_of(state, discrete, unit, reward, after, ends))
    slots = SPECS.parameter_slots
    own = unit.gather(-1, slots[discrete]) * learner.policy.search.has_slot[discrete]
    each = [part.expand(3, *part.shape) for part in (state, discrete, own)]
    with torch.no_grad():
        predicted = learner.model(*each)
    assert (predicted.next_state - after).square().mean((0, 2))[~ends].mean().sqrt() < 0.08
    assert ((predicted.logit > 0) == ends).float().mean() > 0.95
    assert (predicted.terminating - reward)[:, ends].square().mean().sqrt() < 1.5
    assert (predicted.continuing - reward)[:, ~ends].square().mean().sqrt() < 0.2


def test_changes_that_follow_from_others_are_derived_from_them():
    learner = make()
    state, change = torch.randn(100, 4), torch.randn(100, 4)
    change[:, 2] = 0.0
    change[:, 3] = 2.0 * change[:, 0] - change[:, 1]
    batch = random_batch(100, state=state, next_state=state + change, terminated=torch.zeros(100, dtype=torch.bool))
    learn(learner, batch)
    assert learner.model.is_predicted.tolist() == [1.0, 1.0, 0.0, 0.0]
    with torch.no_grad():
        each = [part.expand(3, *part.shape) for part in (state, batch[keys.DISCRETE][:, 0], torch.zeros(100, 2))]
        moved = learner.model(*each).next_state - state
    assert (moved[..., 2] == 0).all()
    torch.testing.assert_close(moved[..., 3], 2.0 * moved[..., 0] - moved[..., 1], atol=1e-4, rtol=1e-4)


def pushes(num: int) -> TensorDict:
    """Return steps that move entry 0 by the cube of the parameter of action 0, and entry 1 by what is random."""
    torch.manual_seed(0)
    state, unit = torch.randn(num, 4), torch.rand(num, 3) * 2 - 1
    discrete = torch.randint(3, (num,))
    change = torch.zeros(num, 4)
    change[:, 0] = torch.where(discrete == 0, unit[:, 0] ** 3, 0.0)
    change[:, 1] = torch.randn(num)
    never = torch.zeros(num, dtype=torch.bool)
    parts = dict(state=state, discrete=discrete, unit=unit, next_state=state + change, terminated=never)
    return random_batch(num, **parts)


def change_error(learner: PETS, batch: TensorDict) -> torch.Tensor:
    """Return the root mean square error of the predicted changes, `[4]`."""
    state, discrete = batch[keys.OBSERVATION][:, 0], batch[keys.DISCRETE][:, 0]
    unit = SPECS.to_unit(batch[keys.PARAMETERS][:, 0])
    own = unit.gather(-1, SPECS.parameter_slots[discrete]) * learner.policy.search.has_slot[discrete]
    each = [part.expand(3, *part.shape) for part in (state, discrete, own)]
    with torch.no_grad():
        ahead = learner.model(*each).next_state.mean(0)
    return (ahead - batch["next", keys.OBSERVATION][:, 0]).square().mean(0).sqrt()


def test_the_linear_part_knows_polynomial_changes_after_few_steps():
    batch = pushes(300)
    error = {}
    for linear_part in (True, False):
        learner = make(linear_part=linear_part, warmup_steps=100, updates_per_step=0.5)
        learn(learner, batch[:100])
        error[linear_part] = change_error(learner, batch[100:])
    assert error[True][0] < 0.5 * error[False][0]
    assert error[True][1] < 1.3, "what is random is not made worse"


def test_changes_that_are_not_linear_are_left_to_the_networks():
    learner = make(linear_part=True)
    learn(learner, pushes(64))
    assert learner.model.linear_weight[:, 0].abs().max() > 0.1
    assert (learner.model.linear_weight[:, 1:] == 0.0).all()


def test_where_no_states_are_turned_there_is_a_linear_part_and_all_members_explore_together():
    for specs, changes, turns in ((BOAT, {}, True), (BOAT, {"augment": False}, False), (SPECS, {}, False)):
        learner = make(specs, posterior_sampling="auto", **changes)
        assert learner.model.has_linear_part is not turns
        assert learner.policy.samples_posterior is turns
    assert make(linear_part=False).model.has_linear_part is False
    assert make(BOAT, posterior_sampling=False).policy.samples_posterior is False


def test_a_probabilistic_model_learns_how_noisy_a_step_is():
    torch.manual_seed(0)
    state = torch.rand(1000, 4)
    deviation = torch.where(state[:, :1] > 0.5, 1.0, 0.05)
    after = state + deviation * torch.randn(1000, 4)
    learner = make(probabilistic=True, updates_per_step=0.5)
    learn(learner, random_batch(1000, state=state, next_state=after, terminated=torch.zeros(1000, dtype=torch.bool)))
    each = [part.expand(3, *part.shape) for part in (state, torch.zeros(1000, dtype=torch.long), torch.zeros(1000, 2))]
    with torch.no_grad():
        moves = torch.stack([learner.model(*each).next_state - state for _ in range(20)])
    is_noisy = state[:, 0] > 0.5
    assert 0.7 < moves[:, :, is_noisy].std() < 1.3
    assert moves[:, :, ~is_noisy].std() < 0.3


def rotated(state: torch.Tensor, number: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return boats' observations under one of their symmetries, and what each key becomes."""
    maps = BOAT.symmetries
    return maps.map_observation(torch.full((len(state),), number), state), maps.discrete[number, 0]


@pytest.mark.parametrize("number", [1, 2])  # the turns
def test_the_model_predicts_for_a_turned_state_the_turned_next_state(number):
    learner = make(BOAT)
    state = BoatDockEnv(30, controller="congruent").reset()[keys.OBSERVATION]
    turned, becomes = rotated(state, number)
    entries = learner.entries
    discrete, own = torch.randint(3, (30,)), torch.rand(30, 1) * 2 - 1
    ahead, turned_ahead = (
        learner.model(seen[:, entries].expand(3, -1, -1), key.expand(3, -1), own.expand(3, -1, -1))
        for seen, key in ((state, discrete), (turned, becomes[discrete]))
    )
    for name in ("continuing", "terminating", "logit"):
        torch.testing.assert_close(getattr(ahead, name), getattr(turned_ahead, name), atol=1e-4, rtol=1e-4)
    maps = BOAT.symmetries.with_entries(entries)
    expected = maps.map_observation(torch.full((3, 30), number), ahead.next_state)
    torch.testing.assert_close(turned_ahead.next_state, expected, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("number", [1, 2])
def test_the_plan_of_a_turned_state_is_the_turned_plan(number):
    learner = make(BOAT, max_sequences=9, num_kept=9)
    state = BoatDockEnv(20, controller="congruent").reset()[keys.OBSERVATION]
    turned, becomes = rotated(state, number)
    entries = learner.entries
    search = learner.policy.search
    plain = search.sequences

    def plan(seen, order):
        # Random numbers belong to places in the list of sequences: list the turned sequences in the same order.
        search.sequences = lambda num, device, allowed: [order[part] for part in plain(num, device)]
        torch.manual_seed(1)
        return learner.policy.plan(seen[:, entries])

    found, turned_found = plan(state, torch.arange(3)), plan(turned, becomes)
    assert torch.equal(becomes[found.discrete], turned_found.discrete)
    torch.testing.assert_close(found.own, turned_found.own, atol=1e-3, rtol=0.0)


def test_with_a_frame_mirror_images_are_learned_from_and_without_one_all_maps():
    assert make(BOAT).symmetry is not None and make().symmetry is None
    for env, factor in ((BoatDockEnv(4, controller="congruent"), 2), (CatchPointEnv(4), 16)):
        learner = make(PAMDPSpecs.from_env(env), warmup_steps=10_000)
        rolled = with_decisions(env).rollout(8, learner.policy, break_when_any_done=False)
        learn(learner, rolled)
        assert len(learner.prepared()) == 32 * factor
        unaugmented = make(PAMDPSpecs.from_env(env), warmup_steps=10_000, augment=False)
        learn(unaugmented, rolled)
        assert len(unaugmented.prepared()) == 32


# The policy.


def acting(learner: PETS, td: TensorDict) -> TensorDict:
    learner.policy.is_trained.fill_(True)
    return learner.policy(td)


def test_the_weight_decay_falls_with_the_number_of_steps():
    learner = make(weight_decay=0.8, weight_decay_steps=100, updates_per_step=0.01)
    decays = []
    for num in (80, 120, 200):
        learn(learner, random_batch(num))
        decays.append(learner.optimizers["model"].param_groups[0]["weight_decay"])
    assert decays == pytest.approx([0.8, 0.4, 0.2])


def test_an_environment_follows_one_member_until_its_episode_ends():
    env = with_decisions(BoatDockEnv(40, controller="congruent"))
    learner = make(BOAT, num_members=5)
    rolled = env.rollout(12, learner.policy, break_when_any_done=False)
    member, done = rolled[MEMBER], rolled["next", keys.DONE].squeeze(-1)
    changes = member[:, 1:] != member[:, :-1]
    assert not changes[~done[:, :-1]].any()
    assert 0.5 < changes[done[:, :-1]].float().mean() < 1.0
    assert member[:, 0].bincount(minlength=5).min() > 0


def with_opinions(learner: PETS, rewards: list[float]) -> PETS:
    """Let each member predict its own constant reward, whatever is done."""
    with torch.no_grad():
        for part in learner.model.outcome.layers[-1:]:
            part.weight.zero_()
            part.bias.copy_(torch.tensor(rewards)[:, None, None].expand_as(part.bias))
            part.bias[..., 0] = -20.0  # no step terminates
    return learner


def test_exploring_plans_with_the_environments_own_member_greedy_ones_and_without_posterior_sampling_with_all():
    learner = with_opinions(make(num_members=3), [1.0, 2.0, 6.0])
    state, member = torch.randn(6, 4), torch.tensor([2, 0, 2, 2, 0, 0])
    two_steps = 1.0 + learner.options.gamma
    own = learner.policy.plan(state, member).value
    torch.testing.assert_close(own, two_steps * torch.tensor([1.0, 2.0, 6.0])[member], atol=1e-3, rtol=0.0)
    together = learner.policy.plan(state).value
    torch.testing.assert_close(together, two_steps * torch.full((6,), 3.0), atol=1e-3, rtol=0.0)
    asked = []
    plan = learner.policy.plan
    learner.policy.plan = lambda state, member=None, allowed=None: asked.append(member) or plan(state, member)
    td = TensorDict({keys.OBSERVATION: state, MEMBER: member, keys.IS_DECISION: torch.zeros(6, 1).bool()}, [6])
    acting(learner, td.clone())
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        acting(learner, td.clone())
    learner.policy.samples_posterior = False
    acting(learner, td.clone())
    assert torch.equal(asked[0], member) and asked[1:] == [None, None]


def test_exploring_plans_by_all_members_add_their_disagreement_and_cautious_greedy_ones_subtract_it():
    learner = with_opinions(make(num_members=3, optimism=2.0, caution=0.5), [1.0, 2.0, 6.0])
    deviation = torch.tensor([1.0, 2.0, 6.0]).std(correction=0)
    for exploration, weight in ((ExplorationType.RANDOM, 2.0), (ExplorationType.DETERMINISTIC, -0.5)):
        with set_exploration_type(exploration):
            planned = learner.policy.plan(torch.randn(6, 4)).value
        expected = (1.0 + learner.options.gamma) * (3.0 + weight * deviation)
        torch.testing.assert_close(planned, expected.expand(6), atol=1e-3, rtol=0.0)


@pytest.mark.parametrize("num_states", [1, 7])
def test_in_greedy_plans_single_members_choose_the_sequences_that_all_refine(num_states):
    learner = make(num_members=3, greedy_samples=24)
    rows = []
    forward = learner.model.forward

    def counted(state, *rest):
        rows.append(state.shape[:2].numel())
        return forward(state, *rest)

    learner.model.forward = counted
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        found = learner.policy.plan(torch.randn(num_states, 4))
    assert [len(part) for part in found] == [num_states] * 3
    of_single = -(-num_states // 3) * 3
    assert rows == [*(of_single * num * 24 for num in (3, 9)), *(num_states * 3 * num * 24 for num in (3, 3, 1, 1))]


def test_nothing_is_planned_before_the_first_update_or_for_finished_episodes(monkeypatch):
    learner = make()
    asked = []
    plan = learner.policy.plan
    monkeypatch.setattr(
        learner.policy, "plan", lambda state, member=None, allowed=None: asked.append(len(state)) or plan(state, member)
    )
    td = TensorDict({keys.OBSERVATION: torch.randn(8, 4), keys.DONE: (torch.arange(8) < 3).unsqueeze(-1)}, [8])
    learner.policy(td.clone())
    assert asked == []
    acting(learner, td.clone())
    assert asked == [5]


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_actions_are_random_only_while_neither_rewards_nor_terminations_differ(value):
    same = {"reward": torch.full((64,), value), "terminated": torch.zeros(64, dtype=torch.bool)}
    for changes in ({"reward": torch.arange(64.0)}, {"terminated": torch.arange(64) == 3}):
        learner = make(buffer_size=64, updates_per_step=0.1)
        for batch, is_trained in (({}, False), (changes, True), ({}, True)):
            learn(learner, random_batch(64, **{**same, **batch}))
            assert bool(learner.policy.is_trained) == is_trained


def test_the_scale_of_a_single_step_or_of_equal_ones_is_the_lower_bound():
    for num in (1, 3):
        assert scale_of(torch.full((num, 2), 5.0)).tolist() == pytest.approx([0.01, 0.01])


def test_before_planning_the_value_assumes_the_only_known_reward():
    learner = make()
    learn(learner, random_batch(64, reward=-torch.ones(64), terminated=torch.zeros(64, dtype=torch.bool)))
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert learner.value(States(torch.randn(3, 4))).tolist() == pytest.approx([-1.97] * 3)
    assert learner.value(States(torch.randn(3, 4))).tolist() == [torch.inf] * 3


@pytest.mark.parametrize(("reward", "is_good"), [(1.0, False), (-1.0, True)])
def test_plans_avoid_or_reach_terminations_if_every_reward_is_the_same(reward, is_good):
    """Action 1 ends the episode if its first parameter is above the state's first entry; nothing else does."""
    torch.manual_seed(0)
    learner = make(warmup_steps=64, updates_per_step=2.0, lr=5e-3)

    def play(state):
        td = learner.policy(TensorDict({keys.OBSERVATION: state}, [len(state)]))
        unit = SPECS.to_unit(td[keys.PARAMETERS])
        ends = (td[keys.DISCRETE] == 1) & (unit[:, 1] > state[:, 0])
        after = torch.rand(len(state), 4) * 2 - 1
        return batch_of(state, td[keys.DISCRETE], unit, torch.full((len(state),), reward), after, ends), ends

    for _ in range(8):
        batch, _ = play(torch.rand(20, 4) * 2 - 1)
        learn(learner, batch)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        _, ends = play(torch.rand(200, 4) * 2 - 1)
    assert (ends == is_good).float().mean() > 0.95, "random actions end one episode in six"


@pytest.mark.parametrize(
    ("epsilon", "is_exploring", "planned"), [(0.25, True, 0.75), (1.0, True, 0.0), (1.0, False, 1.0)]
)
def test_a_share_epsilon_of_exploring_actions_is_random_and_no_greedy_one(monkeypatch, epsilon, is_exploring, planned):
    learner = make(epsilon=epsilon)
    learner.policy.is_trained.fill_(True)
    asked = []

    def plan(state, member=None, allowed=None):
        asked.append(len(state))
        own = torch.zeros(len(state), learner.policy.joint.slots.shape[-1])
        return PlannedAction(torch.full((len(state),), 2), own, torch.zeros(len(state)))

    monkeypatch.setattr(learner.policy, "plan", plan)
    td = TensorDict({keys.OBSERVATION: torch.randn(4000, 4)}, [4000])
    with set_exploration_type(ExplorationType.RANDOM if is_exploring else ExplorationType.DETERMINISTIC):
        discrete = learner.policy(td)[keys.DISCRETE]
    assert sum(asked) == pytest.approx(planned * 4000, abs=100)
    assert (discrete == 2).float().mean().item() == pytest.approx(planned + (1 - planned) / 3, abs=0.03)


def test_a_plan_leads_where_its_last_state_is_worth_most_although_no_step_earns_anything(monkeypatch):
    learner = make(end_values=True, num_iterations=5, posterior_sampling=False)

    def predict(state, discrete, own, precision):
        nothing = state[..., 0] * 0.0
        ahead = state.clone()
        ahead[..., 0] += own[..., 0] * (discrete == 0)
        return Prediction(ahead, nothing, nothing, nothing - 50.0)

    monkeypatch.setattr(learner.model, "forward", predict)
    monkeypatch.setattr(learner.end_values, "forward", lambda state: -(state[..., 0] - 0.6).square())
    for exploration in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        with set_exploration_type(exploration):
            found = learner.policy.plan(torch.zeros(20, SPECS.observation_dim))
        torch.testing.assert_close(found.value, torch.zeros(20), atol=0.02, rtol=0.0)


@pytest.mark.parametrize("kind", [PETS, DLPA])
def test_end_values_discount_steps_as_plans_do_however_long_the_steps_take(kind):
    learner = kind(SPECS, end_values=True, gamma=0.9)
    batch = random_batch(20, terminated=torch.arange(20) < 5)
    batch.set(("next", keys.DURATION), torch.full((20, 1, 1), 7.0))
    discount = learner.transitions(batch)["discount"].flatten()
    assert discount.tolist() == [0.0] * 5 + [pytest.approx(0.9)] * 15


@pytest.mark.parametrize("kind", [PETS, DLPA])
def test_the_copies_of_a_policy_get_the_weights_of_its_end_values(kind):
    names = kind(SPECS, end_values=True).policy.state_dict()
    assert any(name.startswith("end_value.end.") for name in names)


@pytest.mark.parametrize(("expectile", "expected"), [(0.5, 0.5), (0.9, 0.9)])
def test_values_are_expectiles_of_what_the_stored_actions_led_to(expectile, expected):
    torch.manual_seed(0)
    values = EndValues(2, [16], EndValueOptions(end_value_lr=1e-2, end_value_tau=0.5, end_value_expectile=expectile))
    optimizer = values.optimizer()
    state = torch.rand(256, 2)
    reward = (torch.arange(256) % 2).float()
    for _ in range(200):
        optimizer.zero_grad()
        loss, _ = values.loss(state, state, reward, torch.full((256,), 0.5), torch.zeros(256))
        loss.backward()
        optimizer.step()
    assert values.own(state).mean().item() == pytest.approx(expected, abs=0.05)


def test_it_learns_a_two_step_problem_within_some_hundred_steps():
    """Action 1 opens a door if its parameters meet the state; through the open door, action 0 earns 1 and ends."""
    torch.manual_seed(0)
    learner = make(warmup_steps=100, updates_per_step=1.5, lr=5e-3, num_samples=32, num_elites=6, num_iterations=4)

    def play(state):
        td = learner.policy(TensorDict({keys.OBSERVATION: state}, [len(state)]))
        unit, discrete = SPECS.to_unit(td[keys.PARAMETERS]), td[keys.DISCRETE]
        is_open = state[:, 3] > 0
        opens = (discrete == 1) & ((unit[:, 1] - state[:, 0]).abs() < 0.5)
        after = state.clone()
        after[:, 3] = torch.where(opens, 1.0, state[:, 3])
        ends = is_open & (discrete == 0)
        reward = torch.where(ends, 1.0, -0.05)
        return batch_of(state, discrete, unit, reward, after, ends), after, ends

    def fresh(num):
        return torch.cat([torch.rand(num, 3) * 2 - 1, torch.full((num, 1), -1.0)], -1)

    state = fresh(20)
    for _ in range(20):
        batch, after, ends = play(state)
        learn(learner, batch)
        state = torch.where(ends.unsqueeze(-1), fresh(20), after)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        _, after, _ = play(fresh(100))
        _, _, ends = play(after)
    assert ends.float().mean() > 0.8, "random agents end within two steps in 2 of 100"


def test_the_first_updates_make_up_for_the_warm_up_in_the_number_of_updates_too():
    learner = make(warmup_steps=64, updates_per_step=2.0)
    assert [learner.num_updates(steps) for steps in (63, 64, 100)] == [0, 128, 200]
