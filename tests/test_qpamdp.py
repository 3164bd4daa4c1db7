"""Q-PAMDP: each of its two learners against known answers, and how they take turns."""

import itertools
from dataclasses import replace

import pytest
import torch
from conftest import global_generators_unmoved
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.policies.low_level.qpamdp import PARAMETERS, QPAMDP, RAW, SARSA, NaturalActorCritic, SarsaLambda
from hpamdp.policies.low_level.qpamdp_features import fourier_coefficients, num_fourier_features
from hpamdp.policies.low_level.qpamdp_options import QPAMDPOptions
from hpamdp.specs import PAMDPSpecs

# Two discrete actions with a parameter each and one without.
SPECS = PAMDPSpecs(2, (), (1, 1, 0), (0.0, -2.0), (2.0, 2.0))

OPTIONS = dict(
    phi_order=1, psi_order=1, psi_max_coupled=1, warmup_steps=100, initial_episodes=100, relearning_episodes=100,
    gamma=0.9, temperature=0.5, parameter_updates=3, patience=2, rollouts=100, natural_step_size=1.0,
    max_divergence=1.0, ridge=1e-6, initial_parameters="none", sigma=0.2, sigma_final=0.1, sigma_decay=0.9,
)  # fmt: skip

ONE = torch.ones(1)
GREEDY = set_exploration_type(ExplorationType.DETERMINISTIC)


def make(specs: PAMDPSpecs = SPECS, **changes) -> QPAMDP:
    return QPAMDP(specs, device=torch.device("cpu"), **{**OPTIONS, **changes})


def make_sarsa(**changes) -> SarsaLambda:
    return SarsaLambda(QPAMDPOptions(**{"gamma": 0.5, "trace_decay": 0.5, **changes}))


def play(learner: QPAMDP, num_envs: int = 64, num_steps: int = 2) -> TensorDict:
    """Play episodes of one step.

    The reward is the higher, the nearer the parameter of discrete action 0 is to -0.4 and that of action 1 to 0.6.
    """
    td = TensorDict({keys.OBSERVATION: torch.rand(num_envs, num_steps, learner.specs.observation_dim)})
    td.batch_size = [num_envs, num_steps]
    td = learner.policy(td)
    optimum = torch.tensor([-0.4, 0.6])[: learner.specs.num_parameters]
    own = learner.specs.parameter_mask[td[keys.DISCRETE]]
    error = ((learner.specs.to_unit(td[keys.PARAMETERS]) - optimum).square() * own).sum(-1, keepdim=True)
    done = torch.ones(num_envs, num_steps, 1, dtype=torch.bool)
    td["next"] = {
        keys.OBSERVATION: torch.rand_like(td[keys.OBSERVATION]),
        keys.REWARD: 1.0 + 0.2 * td[keys.DISCRETE].unsqueeze(-1) - error,
        keys.TERMINATED: done,
        keys.DONE: done.clone(),
    }
    return td


def learn(learner: QPAMDP, num_batches: int, **sizes: int) -> dict[str, float]:
    for _ in range(num_batches):
        batch = play(learner, **sizes)
        scalars = learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))
    return scalars


def ready(specs: PAMDPSpecs = SPECS, **changes) -> QPAMDP:
    learner = make(specs, **changes)
    learn(learner, 1)
    return learner


@pytest.mark.parametrize(("num_inputs", "order", "max_coupled"), [(1, 3, 1), (3, 2, 2), (2, 4, 9)])
def test_the_fourier_basis_has_every_term_of_few_enough_inputs(num_inputs, order, max_coupled):
    rows = fourier_coefficients(num_inputs, order, max_coupled).long().tolist()
    everything = itertools.product(range(order + 1), repeat=num_inputs)
    expected = [row for row in everything if sum(c > 0 for c in row) <= max_coupled]
    assert num_fourier_features(num_inputs, order, max_coupled) == len(rows)
    assert sorted(map(tuple, rows)) == sorted(expected) and rows[0] == [0] * num_inputs


def test_features_are_cosines_of_the_varying_entries_scaled_to_their_ranges():
    learner = make(phi_order=2, phi_max_coupled=1, warmup_steps=4)
    batch = play(learner, 2, 2)
    batch[keys.OBSERVATION] = torch.tensor([[[3.0, 7.0], [5.0, 7.0]], [[4.0, 7.0], [3.5, 7.0]]])
    learner.learn(batch, torch.ones(2, 2, dtype=torch.bool))
    features = learner.policy.phi(torch.tensor([[3.0, 0.0], [3.5, 0.0], [5.0, 0.0]]))
    expected = torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.5**0.5, 0.0], [1.0, -1.0, 1.0]])
    torch.testing.assert_close(features, expected, atol=1e-6, rtol=0.0)


def sarsa_rows(phi, next_phi, discrete, reward, terminated, done) -> TensorDict:
    shape = (2, len(discrete[0]))
    given = {"phi": phi, "next_phi": next_phi, "discrete": discrete, "reward": reward, "terminated": terminated}
    rows = {name: torch.tensor(values) for name, values in {**given, "done": done}.items()}
    rows |= {"mask": torch.ones(shape, dtype=torch.bool), "is_first": torch.zeros(shape, dtype=torch.bool)}
    return TensorDict(rows, shape)


def test_sarsa_matches_a_computation_by_hand():
    # One feature, two discrete actions, gamma 0.5, lambda 0.5, a step too small for the bound to matter.
    sarsa = make_sarsa(step_size=0.1)
    w = torch.tensor([[1.0], [2.0]])
    # Environment 0 goes on after the first step, environment 1 ends its episode there.
    phi, next_phi = [[[1.0], [2.0]], [[1.0], [1.0]]], [[[2.0], [1.0]], [[9.0], [2.0]]]
    ends = [[False, True], [True, False]]
    first = sarsa_rows(phi, next_phi, [[0, 1], [1, 0]], [[1.0, 0.0], [0.0, 1.0]], ends, ends)
    got, _ = sarsa.update(w, first, ONE, ONE)
    # Step 1: error 1 + 0.5 * (2 * 2) - 1 = 2 along action 0's trace 1; error 0 - 2 = -2 along action 1's trace 1.
    w1 = [1.0 + 0.1 * 0.5 * 2.0, 2.0 - 0.1 * 0.5 * 2.0]
    # Step 2: environment 0 ends with traces (0.25, 2) and error -2 w[1]; environment 1 has traces (1, 0) and an unknown
    # next action.
    q = torch.tensor(w1) * 2.0
    error_0, error_1 = -2.0 * w1[1], 1.0 + 0.5 * float((q.softmax(0) * q).sum()) - w1[0]
    w2 = [w1[0] + 0.05 * (0.25 * error_0 + error_1), w1[1] + 0.05 * 2.0 * error_0]
    torch.testing.assert_close(got, torch.tensor(w2).unsqueeze(-1))
    torch.testing.assert_close(sarsa.traces.squeeze(-1), torch.tensor([[0.0, 0.0], [1.0, 0.0]]))

    # The next batch: environment 1's trace goes on, environment 0 begins a new episode; both end.
    ends = [[True], [True]]
    second = sarsa_rows([[[1.0]], [[2.0]]], [[[0.0]], [[0.0]]], [[0], [1]], [[1.0], [1.0]], ends, ends)
    got, _ = sarsa.update(torch.tensor(w2).unsqueeze(-1), second, ONE, ONE)
    error_0, error_1 = 1.0 - w2[0], 1.0 - 2.0 * w2[1]
    w3 = [w2[0] + 0.05 * (error_0 + 0.25 * error_1), w2[1] + 0.05 * 2.0 * error_1]
    torch.testing.assert_close(got, torch.tensor(w3).unsqueeze(-1))
    assert (sarsa.traces == 0.0).all()


def test_an_abandoned_episode_leaves_nothing_to_the_next_one_of_its_environment():
    sarsa = make_sarsa(step_size=0.1)
    goes_on = [[False], [False]]
    rows = sarsa_rows([[[1.0]], [[1.0]]], [[[2.0]], [[2.0]]], [[0], [0]], [[1.0], [1.0]], goes_on, goes_on)
    rows["is_first"] = torch.tensor([[True], [False]])
    for _ in range(2):
        sarsa.update(torch.tensor([[1.0], [2.0]]), rows, ONE, ONE)
    torch.testing.assert_close(sarsa.traces[..., 0], torch.tensor([[1.0, 0.0], [1.25, 0.0]]))

    regression = NaturalActorCritic(ridge=0.0)
    regression.restart(2, torch.tensor([True, True]))
    rows["gradient"] = torch.ones(2, 1, 1)
    for _ in range(2):
        regression.collect(rows)
    torch.testing.assert_close(regression.regressors, torch.tensor([[1.0, 1.0], [2.0, 1.0]]))
    torch.testing.assert_close(regression.returns, torch.tensor([1.0, 2.0]))


def test_the_bound_shortens_sarsas_step_to_cancel_the_error():
    sarsa = make_sarsa(step_size=1.0)
    ends = [[True], [True]]
    rows = sarsa_rows([[[3.0]], [[3.0]]], [[[0.0]], [[0.0]]], [[0], [0]], [[6.0], [6.0]], ends, ends)
    got, error = sarsa.update(torch.zeros(2, 1), rows, ONE, ONE)
    torch.testing.assert_close(got, torch.tensor([[2.0], [0.0]]))
    assert error == 36.0


@pytest.mark.parametrize("step_scaling", [True, False])
def test_observations_that_never_change_have_one_feature(step_scaling):
    learner = make(warmup_steps=8, step_scaling=step_scaling)
    batch = play(learner, 8, 4)
    batch[keys.OBSERVATION] = torch.zeros_like(batch[keys.OBSERVATION])
    batch["next", keys.OBSERVATION] = torch.zeros_like(batch["next", keys.OBSERVATION])
    for _ in range(2):
        learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))
    assert learner.policy.w.shape[1] == 1 and learner.policy.w.isfinite().all()


def one_row(phi: float, reward: float, done: bool = True) -> TensorDict:
    """Return one step of one environment with discrete action 0; the next state has the feature 1."""
    return sarsa_rows([[[phi]]] * 2, [[[1.0]]] * 2, [[0]] * 2, [[reward]] * 2, [[done]] * 2, [[done]] * 2)


def test_a_non_increasing_bound_stays_at_the_smallest_so_far_and_heeds_only_updates_that_reduce_the_error():
    sarsa = make_sarsa(gamma=1.0, trace_decay=1.0, step_size=1.0, step_bound="non_increasing")
    w = torch.zeros(2, 1)
    w, _ = sarsa.update(w, one_row(2.0, 4.0), ONE, ONE)
    assert sarsa.step_size == 0.25, "the error changes by -2 * 2"
    torch.testing.assert_close(w[0], torch.tensor([2.0]))
    sarsa.update(w, one_row(0.5, 1.0), ONE, ONE)
    assert sarsa.step_size == 0.25, "a bound of 4 does not raise it"
    # From a feature of 0.1 to one of 1, with the same action next: the error grows by 0.1 * (1 - 0.1).
    w = torch.tensor([[9.0], [-99.0]])
    sarsa.update(w, one_row(0.1, 1.0, done=False), ONE, ONE)
    assert sarsa.step_size == 0.25


def test_updates_of_groups_of_environments_follow_one_another():
    torch.manual_seed(0)
    drawn = {"phi": torch.randn(5, 3, 4), "next_phi": torch.randn(5, 3, 4), "discrete": torch.randint(2, (5, 3))}
    drawn |= {"reward": torch.randn(5, 3), "terminated": torch.rand(5, 3) < 0.2, "done": torch.rand(5, 3) < 0.4}
    drawn |= {"mask": torch.rand(5, 3) < 0.8, "is_first": torch.zeros(5, 3, dtype=torch.bool)}
    rows = TensorDict(drawn, [5, 3])
    rows["done"] |= rows["terminated"]
    features = torch.ones(4)
    grouped = make_sarsa(gamma=0.9, step_size=0.1, envs_per_update=2)
    got, _ = grouped.update(torch.zeros(2, 4), rows, ONE, features)

    # By hand: each group has its own traces; a batch of one time step and one group at a time, with its next action.
    w = torch.zeros(2, 4)
    groups = [rows[:2], rows[2:4], rows[4:]]
    alone = [make_sarsa(gamma=0.9, step_size=0.1) for _ in groups]
    for sarsa, group in zip(alone, groups, strict=True):
        sarsa.traces = torch.zeros(len(group), 2, 4)
    for t in range(3):
        for sarsa, group in zip(alone, groups, strict=True):
            row = {name: group[name][:, t] for name in group.keys()}
            taken = group["discrete"][:, t + 1] if t < 2 else torch.full((len(group),), -1)
            w, _ = sarsa.step(w, row, taken, sarsa.traces, ONE, features)
    torch.testing.assert_close(got, w)
    torch.testing.assert_close(grouped.traces, torch.cat([sarsa.traces for sarsa in alone]))
    together, _ = make_sarsa(gamma=0.9, step_size=0.1).update(torch.zeros(2, 4), rows, ONE, features)
    assert not torch.allclose(got, together)


def test_step_scaling_divides_each_weights_step_by_the_norm_of_its_coefficients():
    learner = ready(phi_order=2, phi_max_coupled=2, step_scaling=True)
    phi = learner.policy.phi
    expected = [1.0 / max(1.0, sum(c * c for c in row) ** 0.5) for row in phi.coefficients.tolist()]
    torch.testing.assert_close(phi.step_scale(), torch.tensor(expected))
    scale = torch.tensor([1.0, 0.5])
    sarsa = make_sarsa(step_size=0.01)
    rows = sarsa_rows([[[1.0, 2.0]]] * 2, [[[0.0, 0.0]]] * 2, [[0]] * 2, [[6.0]] * 2, [[True]] * 2, [[True]] * 2)
    w, _ = sarsa.update(torch.zeros(2, 2), rows, ONE, scale)
    torch.testing.assert_close(w[0], torch.tensor([0.06, 0.06]))
    # With the bound the error is cancelled: 1 + 2 * 2 / 2 = 3 of a step of size 1.
    sarsa = make_sarsa(step_size=1.0)
    w, _ = sarsa.update(torch.zeros(2, 2), rows, ONE, scale)
    torch.testing.assert_close(w[0] @ torch.tensor([1.0, 2.0]), torch.tensor(6.0))


def test_the_temperature_falls_with_the_episodes_of_the_sarsa_phases_alone():
    learner = ready(temperature=0.5, temperature_decay=0.99, temperature_final=0.1)
    learn(learner, 1, num_envs=10)
    assert learner.policy.temperature == pytest.approx(0.5 * 0.99**20)
    learn(learner, 4, num_envs=10)
    assert learner.phase == PARAMETERS
    held = learner.policy.temperature.clone()
    learn(learner, 1, num_envs=10)
    assert learner.policy.temperature == held
    learner.policy.temperature.fill_(0.1)
    learner.phase.fill_(SARSA)
    learn(learner, 1, num_envs=10)
    assert learner.policy.temperature == pytest.approx(0.1), "never below temperature_final"


@pytest.mark.parametrize("samples", [True, False])
def test_discrete_actions_are_sampled_in_the_parameter_phases_only_if_asked(samples):
    torch.manual_seed(0)
    learner = ready(samples_in_parameter_phase=samples, temperature=50.0, temperature_final=50.0)
    observation = TensorDict({keys.OBSERVATION: torch.zeros(200, 2)}, [200])
    assert learner.policy(observation.clone())[keys.DISCRETE].unique().numel() == 3, "Sarsa's phase"
    learn(learner, 2, num_envs=50)
    assert learner.phase == PARAMETERS
    td = learner.policy(observation.clone())
    assert td[keys.DISCRETE].unique().numel() == (3 if samples else 1)
    assert (td[RAW].std(0) > 0.0).all(), "the parameters are always sampled"


def test_a_feature_range_sees_states_that_the_warm_up_did_not_reach():
    learners = [ready(feature_range=feature_range, phi_max_coupled=1) for feature_range in (None, [-2.0, 2.0])]
    # The warm-up's observations lie in [0, 1].
    beyond = torch.tensor([[1.0, 0.5], [1.5, 0.5], [2.0, 0.5]])
    clipped, seen = (learner.policy.phi(beyond) for learner in learners)
    torch.testing.assert_close(clipped, clipped[:1].expand(3, -1), atol=1e-3, rtol=0.0)
    assert max(column.unique().numel() for column in seen.T) == 3


def test_means_start_at_the_problems_initial_parameters_instead_of_initial_mean():
    specs = replace(SPECS, initial_weight=((0.5, 0.0), (0.0, 0.0)), initial_bias=(0.1, -0.8))
    learner = ready(specs=specs, initial_parameters="domain", initial_mean=0.7)
    state = torch.rand(9, 2)
    expected = torch.stack([0.1 + 0.5 * state[:, 0], torch.full((9,), -0.8)], -1)
    torch.testing.assert_close(learner.policy.mean(state), expected)
    torch.testing.assert_close(
        ready(initial_parameters="domain", initial_mean=0.7).policy.mean(state), torch.full((9, 2), 0.7)
    )


def test_the_natural_gradient_finds_the_best_parameters():
    torch.manual_seed(0)
    learner = ready(
        initial_episodes=100, parameter_updates=1000, rollouts=2000, natural_step_size=10.0, max_divergence=10.0
    )
    learn(learner, 60, num_envs=500)
    mean = learner.policy.psi(torch.rand(200, 2)) @ learner.policy.theta.T
    torch.testing.assert_close(mean, torch.tensor([-0.4, 0.6]).expand(200, 2), atol=0.08, rtol=0.0)


class Always7:
    """What follows any option is worth 7."""

    decides_ends = True

    def value(self, states, option):
        return torch.full((len(option),), 7.0)


@pytest.mark.parametrize("num_steps", [1, 3])
def test_options_whose_selector_ends_them_are_counted_once_however_long_batches_are(num_steps):
    def learned(num_steps, phase):
        torch.manual_seed(0)
        learner = ready(parameter_updates=1000, rollouts=10_000, ridge=0.0, initial_episodes=10_000)
        learner.next_options = Always7()
        learner.phase.fill_(phase)
        if phase == PARAMETERS:
            num_features = len(learner.policy.phi.coefficients)
            learner.enac.restart(learner.policy.theta.numel() + num_features, torch.ones(40, dtype=torch.bool))
        whole = play(learner, 40, 24)
        generator = torch.Generator().manual_seed(1)
        done = torch.rand(40, 24, 1, generator=generator) < 0.1
        ended = (torch.rand(40, 24, 1, generator=generator) < 0.3) | done
        whole["next", keys.DONE] = whole["next", keys.TERMINATED] = done
        begins = torch.cat([torch.ones_like(ended[:, :1]), ended[:, :-1]], 1)
        whole[keys.IS_DECISION] = begins
        whole[keys.NEXT_OPTION] = torch.zeros(40, 24, dtype=torch.long)
        for start in range(0, 24, num_steps):
            batch = whole[:, start : start + num_steps].clone()
            known, is_done = ended[:, start : start + num_steps].clone(), done[:, start : start + num_steps]
            known[:, -1] = is_done[:, -1]
            taken = known & ~is_done
            taken[:, -1] = True
            batch["next", keys.IS_DECISION], batch["next", keys.OPTION_ENDED] = known, taken
            learner.learn(batch, torch.ones(40, num_steps, dtype=torch.bool))
        return learner, int(ended[:, :-1].sum() + done[:, -1].sum())

    learner, num_ended = learned(num_steps, SARSA)
    assert learner.window_episodes == num_ended
    rows = {}
    learner.sarsa.update = lambda w, given, *_: (rows.update(given.items()), (w, torch.zeros(())))[1]
    batch = play(learner, 40, 1)
    batch["next", keys.DONE] = batch["next", keys.TERMINATED] = torch.zeros(40, 1, 1, dtype=torch.bool)
    batch["next", keys.IS_DECISION] = batch["next", keys.DONE]
    batch["next", keys.OPTION_ENDED] = torch.ones(40, 1, 1, dtype=torch.bool)
    batch[keys.NEXT_OPTION] = torch.zeros(40, 1, dtype=torch.long)
    learner.learn(batch, torch.ones(40, 1, dtype=torch.bool))
    target = batch["next", keys.REWARD].squeeze(-1) + learner.options.gamma * 7.0
    torch.testing.assert_close(rows["reward"], target)
    assert rows["terminated"].all() and not rows["done"].any(), "its value is in the reward; its trace goes on"
    learner, num_ended = learned(num_steps, PARAMETERS)
    whole, _ = learned(24, PARAMETERS)
    assert learner.enac.num_episodes == whole.enac.num_episodes == num_ended
    torch.testing.assert_close(learner.enac.gram, whole.enac.gram, rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(learner.enac.moment, whole.enac.moment, rtol=1e-4, atol=1e-2)
    torch.testing.assert_close(learner.window_return, whole.window_return)


def test_the_regression_is_least_squares_on_whole_episodes_across_batches():
    learner = ready(parameter_updates=1000, rollouts=10_000, ridge=0.0, initial_episodes=1)
    learn(learner, 1)
    assert learner.phase == PARAMETERS
    batches = [play(learner, 40, 3) for _ in range(6)]
    generator = torch.Generator().manual_seed(1)
    done = torch.rand(40, 18, generator=generator) < 0.4
    enac = learner.enac
    enac.restart(enac.regressors.shape[1], torch.arange(40) % 2 == 0)
    for i, batch in enumerate(batches):
        batch["next", keys.DONE] = done[:, 3 * i : 3 * i + 3].unsqueeze(-1)
        learner.learn(batch, torch.ones(40, 3, dtype=torch.bool))
    x, y = [], []
    rows = learner.rows(torch.cat(batches, 1), torch.ones(40, 18, dtype=torch.bool))
    for env in range(40):
        start = 0 if env % 2 == 0 else None
        for end in done[env].nonzero().flatten().tolist():
            if start is not None:
                gradient = rows["gradient"][env, start : end + 1].sum(0)
                x.append(torch.cat([gradient, rows["phi"][env, start]]))
                y.append(rows["reward"][env, start : end + 1].sum())
            start = end + 1
    solution = torch.linalg.lstsq(torch.stack(x).double(), torch.stack(y).double().unsqueeze(-1)).solution.squeeze(-1)
    num_weights = learner.policy.theta.numel()
    assert enac.num_episodes == len(x)
    torch.testing.assert_close(
        enac.natural_gradient(num_weights)[0].double(), solution[:num_weights], atol=1e-3, rtol=1e-3
    )


def test_the_phases_take_turns_and_leave_the_other_weights_alone():
    torch.manual_seed(0)
    learner = ready()
    phases = []
    for _ in range(25):
        phase, w, theta = int(learner.phase), learner.policy.w.clone(), learner.policy.theta.clone()
        updates = int(learner.updates)
        learn(learner, 1, num_envs=50)
        assert torch.equal(w, learner.policy.w) == (phase == PARAMETERS)
        assert torch.equal(theta, learner.policy.theta) == (updates == learner.updates)
        phases.append(phase)
    # A batch has 100 episodes: one batch of Sarsa, then three parameter updates of a batch each, and so on.
    assert phases == ([SARSA] + 3 * [PARAMETERS]) * 6 + [SARSA]
    assert learner.updates == 18


def test_without_a_number_of_updates_a_phase_lasts_until_the_return_sets_no_more_records():
    torch.manual_seed(0)
    learner = ready(parameter_updates=None, patience=4, rollouts=400, max_divergence=0.05)
    lengths = [0]  # of the phases, in batches
    for _ in range(150):
        phase = int(learner.phase)
        learn(learner, 1, num_envs=200)
        lengths[-1] += 1
        if learner.phase != phase:
            lengths.append(0)
    assert len(lengths) > 4 and lengths[1] > 5, "the first parameter phase has the most to gain"
    assert (learner.policy.theta[:, 0] - torch.tensor([-0.4, 0.6])).abs().max() < 0.1


def test_sigma_is_the_standard_deviation_of_the_parameters():
    torch.manual_seed(0)
    learner = make(sigma=0.3, initial_mean=0.1)
    td = learner.policy(TensorDict({keys.OBSERVATION: torch.zeros(50_000, 2)}, [50_000]))
    torch.testing.assert_close(td[RAW].std(0), torch.full((2,), 0.3), atol=0.01, rtol=0.0)
    torch.testing.assert_close(td[RAW].mean(0), torch.full((2,), 0.1), atol=0.01, rtol=0.0)
    learn(learner, 2)
    assert learner.phase == PARAMETERS
    learn(learner, 20)
    assert learner.policy.sigma == pytest.approx(0.1), "it decays to sigma_final"


@pytest.mark.parametrize("dims", [(0, 0), (0, 2, 1)])
def test_discrete_actions_with_any_number_of_parameters_are_learned(dims):
    torch.manual_seed(0)
    specs = PAMDPSpecs(2, (), dims, (0.0,) * sum(dims), (1.0,) * sum(dims))
    learner = make(specs, step_size=0.5)
    for _ in range(30):
        td = learner.policy(TensorDict({keys.OBSERVATION: torch.rand(64, 2, 2)}, [64, 2]))
        done = torch.ones(64, 2, 1, dtype=torch.bool)
        reward = (td[keys.DISCRETE] == 1).float().unsqueeze(-1)
        td["next"] = {
            keys.OBSERVATION: torch.rand(64, 2, 2),
            keys.REWARD: reward,
            keys.TERMINATED: done,
            keys.DONE: done,
        }
        learner.learn(td, torch.ones(64, 2, dtype=torch.bool))
    assert learner.updates > 0 and learner.policy.theta.isfinite().all()
    with GREEDY:
        td = learner.policy(TensorDict({keys.OBSERVATION: torch.rand(64, 2)}, [64]))
    assert (td[keys.DISCRETE] == 1).all() and td[keys.PARAMETERS].shape == (64, sum(dims))


def test_the_greedy_policy_samples_nothing_and_stays_in_bounds():
    learner = ready(sigma=3.0)
    td = TensorDict({keys.OBSERVATION: torch.rand(100, 2)}, [100])
    low, high = torch.tensor(SPECS.parameter_low), torch.tensor(SPECS.parameter_high)
    parameters = learner.policy(td.clone())[keys.PARAMETERS]
    assert (parameters >= low).all() and (parameters <= high).all()
    with global_generators_unmoved(), GREEDY:
        td = learner.policy(td)
    torch.testing.assert_close(td[RAW], learner.policy.psi(td[keys.OBSERVATION]) @ learner.policy.theta.T)


def test_rows_of_other_learners_change_nothing():
    learners = [ready(), ready()]
    learners[1].load_state_dict(learners[0].state_dict())
    batch, mask = play(learners[0], 20, 2), (torch.arange(20) < 10).unsqueeze(-1).expand(20, 2)
    other = batch.clone()
    other["next", keys.REWARD][10:] = 100.0
    for learner, rows in zip(learners, (batch, other), strict=True):
        learner.learn(rows, mask)
    assert torch.equal(learners[0].policy.w, learners[1].policy.w)
    assert learners[0].window_episodes == 20


@pytest.mark.parametrize("num_envs", [32, 128])
def test_the_parameter_phase_goes_on_with_another_number_of_environments(num_envs):
    torch.manual_seed(0)
    learner = ready(rollouts=500)
    while learner.phase == SARSA:
        learn(learner, 1)
    learn(learner, 1, num_envs=64)
    before = int(learner.enac.num_episodes)
    assert learner.phase == PARAMETERS and before > 0
    learn(learner, 1, num_envs=num_envs)
    # An episode that was under way is left out, and so is what may be the middle of one.
    assert learner.enac.num_episodes == before + num_envs
