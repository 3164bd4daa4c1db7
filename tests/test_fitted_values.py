"""Fitted Q evaluation and importance sampling of agents in a problem of two steps whose values are known."""

import argparse
from types import SimpleNamespace

import pytest
import torch
from conftest import compose_config
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.commands.fitted_values import fitted_values
from hpamdp.commands.importance import RecordedEpisodes, is_whole, weighted_mean
from hpamdp.commands.judge import judged, main
from hpamdp.data.demonstrations import with_option_sums
from hpamdp.data.row_checks import TRAJECTORY
from hpamdp.env.decisions import DecisionTracker
from hpamdp.policies.agent import with_option
from hpamdp.run.train import run
from hpamdp.specs import PAMDPSpecs

SPECS = PAMDPSpecs(1, ("left", "right"), (0, 1), (-1.0,), (1.0,))


def recorded(num_episodes: int) -> TensorDict:
    """Return random episodes of two steps: 1 with the parameter x goes on, or ends the second step; 0 ends at once.

    The reward is x in the first step and 2 x in the second, more by 1 under the option `right`, and 0 for action 0.
    Where the number of an episode can be divided by 4, a time limit ends it after the first step that goes on.
    """
    generator = torch.Generator().manual_seed(0)
    rows = []
    for episode in range(num_episodes):
        option = torch.randint(2, (), generator=generator)
        for place in range(2):
            discrete = torch.randint(2, (), generator=generator)
            own = 2.0 * torch.rand(1, generator=generator) - 1.0
            terminated = (discrete == 0) | (place == 1)
            truncated = ~terminated & (episode % 4 == 0)
            reward = torch.where(discrete == 1, (1 + place) * own + option, 0.0)
            flags = {"terminated": terminated.reshape(1), "truncated": truncated.reshape(1)}
            done = (terminated | truncated).reshape(1)
            after = {keys.OBSERVATION: torch.tensor([place + 1.0]), keys.REWARD: reward, keys.DONE: done, **flags}
            row = {keys.OBSERVATION: torch.tensor([float(place)]), keys.IS_DECISION: torch.tensor([place == 0])}
            row |= {keys.OPTION: option, TRAJECTORY: torch.tensor(episode), "next": TensorDict(after)}
            rows.append(TensorDict({**row, keys.DISCRETE: discrete, keys.PARAMETERS: own}))
            if done:
                break
    return with_option_sums(torch.stack(rows))


ROWS = recorded(600)


def agent_with(own: float, option: int = 1):
    """Return an agent that takes action 1 with the parameter `own`, and -`own` where the observation is 1."""

    def act(td):
        discrete = torch.ones(len(td), dtype=torch.long)
        parameters = torch.where(td[keys.OBSERVATION] == 1.0, -own, own)
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": parameters}})

    choose = lambda td: act(td.set(keys.OPTION, torch.full((len(td),), option)))  # noqa: E731
    return SimpleNamespace(policy=choose, router=act)


def inputs(rows):
    action = rows[keys.DISCRETE].unsqueeze(-1).float()
    return torch.cat([with_option(rows, 2)[keys.OBSERVATION], action, action * rows[keys.PARAMETERS]], -1)


@pytest.mark.parametrize(("own", "option", "value"), [(0.5, 1, 1.5), (0.5, 0, -0.5), (-0.8, 1, 2.8)])
def test_fitted_q_evaluation_finds_the_value_of_an_agent_under_the_option_that_it_chooses(own, option, value):
    torch.manual_seed(0)
    agent = agent_with(own, option)
    found = fitted_values(SimpleNamespace(inputs=inputs), ROWS, agent, DecisionTracker(), torch.zeros(3, 1), 1000)
    assert found.shape == (3,) and (found - value).abs().max() < 0.15


def test_equal_weights_give_the_mean_of_all_episodes():
    values = torch.tensor([1.0, 2.0, 6.0])
    mean, effective = weighted_mean(torch.full((3,), -700.0), values)
    assert mean == pytest.approx(3.0) and effective == pytest.approx(3.0)


def test_one_heavy_weight_gives_the_return_of_its_episode():
    mean, effective = weighted_mean(torch.tensor([0.0, 500.0, -torch.inf]), torch.tensor([1.0, 2.0, 6.0]))
    assert mean == pytest.approx(2.0) and effective == pytest.approx(1.0)


def test_importance_sampling_weighs_the_whole_episodes_that_an_agent_could_have_made():
    torch.manual_seed(0)
    episodes = RecordedEpisodes(SPECS, ROWS)
    mean, effective = episodes.estimate(agent_with(0.5), DecisionTracker())
    assert mean == pytest.approx(1.5, abs=0.3)
    assert 2.0 < effective < 0.2 * len(episodes.returns)


def test_no_recorded_episode_tells_of_an_option_that_nobody_chose():
    episodes = RecordedEpisodes(SPECS, ROWS[ROWS[keys.OPTION] == 0])
    mean, effective = episodes.estimate(agent_with(0.5, option=1), DecisionTracker())
    assert mean != mean and effective == 0.0


def test_importance_sampling_cannot_tell_anything_without_a_whole_episode():
    rows = ROWS.copy()
    rows["next", keys.TERMINATED] = torch.zeros_like(rows["next", keys.TERMINATED])
    mean, effective = RecordedEpisodes(SPECS, rows).estimate(agent_with(0.5), DecisionTracker())
    assert mean != mean and effective == 0.0


def test_episodes_with_a_gap_or_without_a_termination_are_not_whole():
    # Two steps; a time limit after the first; two steps, the second of which begins elsewhere; one step.
    episode = torch.tensor([0, 0, 1, 2, 2, 3])
    begins, ends = torch.tensor([0.0, 1.0, 0.0, 0.0, 5.0, 0.0]), torch.tensor([1.0, 2.0, 1.0, 1.0, 6.0, 1.0])
    terminated = torch.tensor([False, True, False, False, True, True])
    after = {keys.OBSERVATION: ends.unsqueeze(-1), keys.TERMINATED: terminated.unsqueeze(-1)}
    rows = TensorDict({TRAJECTORY: episode, keys.OBSERVATION: begins.unsqueeze(-1), "next": after}, [6])
    assert is_whole(rows).tolist() == [True, True, False, False, False, True]


def words(people_file) -> list[str]:
    return ["data=human", "data.checksum=null", f"data.path={people_file}", "offline.updates=20", "low.batch_size=16"]


def test_three_methods_judge_side_by_side_and_name_what_they_rest_on(people_file):
    given = [*words(people_file), "data.people=[0]"]
    (alone,) = judged(["linucb_hppo"], given, episodes=5)
    first, row = judged(["linucb_hppo", "linucb_hppo"], given, episodes=5, compare=True)
    assert row["return"] == alone["return"] and "fitted" not in alone
    assert row["fitted"] == first["fitted"]  # whoever is judged before
    assert row["fitted"] == row["fitted"] and row["effective"] >= 0.0
    assert any("importance sampling rests on" in doubt for doubt in row["doubts"])


def test_the_command_prints_the_other_methods_beside_the_roll_outs(people_file, capsys):
    parser = argparse.ArgumentParser()
    assert main(["linucb_hppo", "--compare", "--episodes=5", *words(people_file)], parser) == 0
    assert capsys.readouterr().out.splitlines()[0].split()[-3:] == ["fitted", "importance", "effective"]


def test_an_agent_with_a_memory_is_judged_by_roll_outs_alone(people_file, tmp_path):
    given = ["high=uniform", "low=hppo", "low.memory=gru", "num_envs=4", "steps_per_batch=8", "total_frames=32"]
    given += ["eval.layouts=4"]
    assert run(compose_config(given), tmp_path / "run", given) == 0
    (row,) = judged([str(tmp_path / "run")], words(people_file), episodes=5, compare=True)
    assert row["fitted"] != row["fitted"] and any("only roll-outs judge it" in doubt for doubt in row["doubts"])
