"""Options practise while their learners improve: by fitted curves, and whatever the selector would choose."""

import json

import numpy as np
import pytest
import torch
from conftest import compose_config, make_config
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.policies.high_level.linucb import LinUCB
from hpamdp.policies.high_level.ucb import UCB
from hpamdp.policies.practice import CurvePractice
from hpamdp.run.assemble import assemble
from hpamdp.run.train import run
from hpamdp.specs import PAMDPSpecs

TOTAL = 3000


def practised(
    time_constants: list[float], plateaus: list[float], chosen: int, lengths: tuple[int, ...] = (1, 1, 1)
) -> np.ndarray:
    """Return the part of the steps that each option gets if the selector always chooses one of them.

    An option's return rises from -1 to its plateau with its own practice. Its decisions have the same length.
    """
    rng = np.random.default_rng(0)
    tau, plateau = np.array(time_constants), np.array(plateaus)
    practice = CurvePractice(len(tau), TOTAL)
    own = np.zeros(len(tau))
    while own.sum() < TOTAL:
        p = practice.probabilities(int(own.sum())).double().numpy()
        left = np.eye(len(tau))[chosen] * (1.0 - p.sum())
        option = rng.choice(len(tau), 20, p=(p + left) / (p + left).sum())
        value = -1.0 + (plateau + 1.0) * (1.0 - np.exp(-own / tau))
        returns = value[option] + rng.normal(0.0, 0.8, 20)
        of_step = option.repeat(np.array(lengths)[option])
        practice.add(torch.tensor(of_step), torch.tensor(option), torch.tensor(returns))
        own += np.bincount(of_step, minlength=len(tau))
    return own / own.sum()


def test_an_option_that_improves_slowly_practises_most_though_the_selector_prefers_another_one():
    assert practised([200.0, 800.0], [3.3, 3.3], chosen=0)[1] > 0.58  # the best split gives it 0.7


def test_options_that_have_stopped_improving_leave_the_second_half_to_the_selector():
    assert practised([50.0, 50.0], [3.3, 3.3], chosen=0)[0] == pytest.approx(0.73, abs=0.03)


def test_a_fruitless_option_practises_little():
    assert practised([100.0, 100.0, 100.0], [3.3, 3.3, -1.0], chosen=0)[2] < 0.1


def test_options_practise_for_equally_many_steps_though_the_decisions_of_one_are_longer():
    assert practised([50.0, 50.0], [3.3, 3.3], chosen=0, lengths=(1, 5))[1] == pytest.approx(0.27, abs=0.04)


def test_lengths_of_decisions_are_known_though_a_batch_is_longer_than_the_bins_they_are_taken_from():
    practice = CurvePractice(3, TOTAL)  # the third option may never be chosen
    for _ in range(3):
        of_step = torch.tensor([0, 1]).repeat_interleave(400)
        practice.add(of_step, of_step[::10], torch.randn(80))
    equal = practice.probabilities(TOTAL // 2).tolist()
    assert equal == pytest.approx([0.05 / 3.0] * 3)


def test_an_option_that_nobody_may_choose_does_not_keep_the_selector_waiting():
    practice = CurvePractice(2, TOTAL)
    for _ in range(TOTAL // 20):
        practice.add(torch.zeros(20).long(), torch.zeros(20).long(), torch.randn(20))
    assert practice.probabilities(TOTAL // 4)[1] == 1.0
    assert practice.probabilities(TOTAL // 2).sum().item() == pytest.approx(0.05)


def test_a_run_without_end_practises_equally():
    practice = CurvePractice(2, 10**12)
    for i in range(10):
        practice.add(torch.zeros(20).long(), torch.zeros(20).long(), torch.randn(20))
        assert practice.probabilities(20 * i).tolist() == [0.5, 0.5]


def test_a_resumed_run_that_is_longer_than_planned_keeps_its_curves():
    practice = CurvePractice(1, TOTAL)
    for i in range(2 * TOTAL // 20):
        option = torch.zeros(20).long()
        practice.add(option, option, torch.full((20,), float(i)))
    assert practice.counts.sum() == 2 * TOTAL and practice.width == 2 * TOTAL / 100
    means = practice.sums[0] / practice.counts[0]
    assert (means.diff() > 0.0).all()


def test_a_choice_that_practice_overrules_is_no_choice_of_the_bandit():
    bandit = UCB(PAMDPSpecs(2, ("a", "b"), (1,), (-1.0,), (1.0,)))
    bandit.practice.copy_(torch.tensor([0.0, 0.9]))
    td = TensorDict({keys.OBSERVATION: torch.zeros(1000, 2), keys.IS_DECISION: torch.ones(1000, 1).bool()}, [1000])
    bandit(td)
    assert bandit.pending.sum() < 200


def test_forbidden_options_do_not_practise():
    selector = LinUCB(PAMDPSpecs(2, ("a", "b", "c"), (1,), (-1.0,), (1.0,), has_option_mask=True))
    selector.practice.copy_(torch.tensor([0.9, 0.1, 0.0]))
    mask = torch.tensor([[False, True, True], [False, False, True]]).repeat(500, 1)
    observation = torch.zeros(1000, selector.specs.observation_dim)
    is_decision = torch.ones(1000, 1, dtype=torch.bool)
    td = TensorDict({keys.OBSERVATION: observation, keys.IS_DECISION: is_decision, keys.OPTION_MASK: mask}, [1000])
    assert selector(td)[keys.OPTION].unflatten(0, (500, 2)).unique(dim=0).tolist() == [[1, 2]]


@pytest.mark.parametrize(
    ("words", "practises"),
    [
        ("high=linucb low=hppo", True),
        ("high=ucb low=hppo", False),
        ("high=ucb low=hppo agent.practice=curves", True),
        ("high=linucb low=hppo agent.sharing=shared", False),
        ("high=meta_critic low=hppo agent.termination=steps agent.option_length=3 env.switch_cost=0.2", False),
    ],
)
def test_curves_are_the_default_where_a_selector_of_whole_episodes_sees_the_state(words, practises):
    agent = assemble(make_config([*words.split(), "eval.layouts=4"])).agent
    assert isinstance(agent.practice, CurvePractice) == practises


@pytest.mark.parametrize(("high", "is_told"), [("ucb", True), ("linucb", False)])
def test_a_run_says_what_practised_and_which_selector_holds_one_option(high, is_told, tmp_path):
    words = [f"high={high}", "low=random", "total_frames=2048", "eval.every=0", "eval.layouts=20", "film=false"]
    assert run(compose_config(words), tmp_path / "run") == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert sum(summary["practised"].values()) == pytest.approx(1.0)
    assert [line.startswith(f"high={high} holds") for line in summary["one_option"]] == [True] * is_told
