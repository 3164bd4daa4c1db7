"""The recorded presses as transitions are those of BoatDockEnv for the same layouts and actions."""

from __future__ import annotations

import re

import pytest
import torch
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.data import DataError
from hpamdp.data.demonstrations import TRAJECTORY
from hpamdp.data.human import minari
from hpamdp.data.human.dataset import HumanExperienceReplay, slices, whole_episodes
from hpamdp.data.human.episodes import keep, scores_by_person, select
from hpamdp.data.human.released_file import HumanData, read
from hpamdp.data.human.transitions import decisions, transitions
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.task import FUEL
from hpamdp.env.decisions import with_decisions


@pytest.fixture(scope="module")
def data(people_file) -> HumanData:
    return read(people_file, checksum=None, one_frame=True)


def replayed(data: HumanData, **arguments) -> list[TensorDict]:
    """Play the logged presses in the environment; return a batch of those with each number in their episodes."""
    episodes = data.episodes
    env = BoatDockEnv(len(episodes), **arguments)
    names = ("start", "goal", "keymap") if env.has_choice else ("start", "goal", "keymap", "controller")
    td = env.reset(episodes.select(*names))
    batch, played = transitions(data, has_choice=env.has_choice), []
    for number in range(int(episodes["presses"].max())):
        rows = data.presses["press"] == number
        at = data.presses["episode"][rows]
        td[keys.DISCRETE] = torch.zeros(len(episodes), dtype=torch.long).index_put((at,), batch[keys.DISCRETE][rows])
        td[keys.PARAMETERS] = torch.zeros(len(episodes), 3).index_put((at,), batch[keys.PARAMETERS][rows])
        if env.has_choice:
            td[keys.OPTION] = episodes["controller"]
        td = env.step(td)
        played.append(td[at].clone())
        td = td["next"].exclude(keys.REWARD).clone()
    return played


def is_fully_logged(data: HumanData) -> torch.Tensor:
    # Where the missing press is short, the tank does not show it.
    return (data.episodes["index"] % 7 != 3) & data.episodes["complete"]


@pytest.mark.parametrize("reward", ["paper", "sparse"])
@pytest.mark.parametrize("observation", ["scaled", "pixels"])
@pytest.mark.parametrize("controller", ["choose", "random"])
def test_transitions_are_those_of_the_environment_for_the_same_presses(data, reward, observation, controller):
    data = keep(data, is_fully_logged(data))
    batch = transitions(data, reward=reward, observation=observation, has_choice=controller == "choose")
    for number, rows in enumerate(replayed(data, controller=controller, reward=reward, observation=observation)):
        ours = batch[data.presses["press"] == number]
        if number == 0:
            assert torch.equal(ours[keys.OBSERVATION], rows[keys.OBSERVATION])
        scale = 1.0 if observation == "scaled" else 120.0
        for name in (keys.OBSERVATION, ("next", keys.OBSERVATION)):
            # The tank is recorded in whole ticks.
            torch.testing.assert_close(ours[name], rows[name], atol=2e-3 * scale, rtol=1e-3)
        torch.testing.assert_close(ours["next", keys.REWARD], rows["next", keys.REWARD], atol=2e-2, rtol=0)
        for name in (keys.OUTCOME, keys.DONE, keys.TERMINATED, keys.TRUNCATED):
            assert torch.equal(ours["next", name], rows["next", name]), name


@pytest.mark.parametrize("reward", ["paper", "sparse"])
def test_the_return_of_a_fully_logged_episode_is_the_sum_of_its_rewards(data, reward):
    data = keep(data, is_fully_logged(data))
    rows = transitions(data, reward=reward)
    total = torch.zeros(len(data.episodes)).index_add(0, rows[TRAJECTORY], rows["next", keys.REWARD].squeeze(-1))
    decided = decisions(data, reward=reward)
    torch.testing.assert_close(decided["next", keys.OPTION_RETURN].squeeze(-1), total, atol=1e-4, rtol=0.0)
    ends = rows["next", keys.DONE].squeeze(-1)
    for name in (keys.TERMINATED, keys.IS_DECISION):
        assert torch.equal(decided["next", name], rows["next", name][ends])


def test_the_mean_return_of_peoples_episodes_is_their_score_and_the_progress(people_in_one_frame):
    data = people_in_one_frame
    decided = decisions(data)["next"]
    assert len(decided) == 14_400
    assert decided[keys.OPTION_RETURN].mean().item() == pytest.approx(2.768, abs=0.002)
    sparse = decisions(data, reward="sparse")["next", keys.OPTION_RETURN].mean().item()
    assert sparse - (data.episodes["outcome"] != physics.SUCCESS).float().mean().item() == pytest.approx(
        1.970, abs=1e-3
    )


def test_transitions_have_the_environments_keys_shapes_and_types(data):
    env = with_decisions(BoatDockEnv(2))
    rollout = env.rollout(2, auto_reset=True)
    batch = transitions(data)
    tracked = {"option_return", "option_steps", "decision_observation", "episode_return", "episode_steps"}
    expected = {name: value for name, value in rollout.items(True, True) if not tracked & {name, name[-1]}}
    assert set(expected) | {TRAJECTORY} == set(batch.keys(True, True))
    for name, value in expected.items():
        assert batch[name].dtype == value.dtype and batch[name].shape[1:] == value.shape[2:], name


def test_decisions_options_and_trajectories_follow_the_episodes(data):
    batch = transitions(data)
    episode = data.presses["episode"]
    assert torch.equal(batch[TRAJECTORY], episode)
    assert torch.equal(batch[keys.OPTION], data.episodes["controller"][episode])
    starts = torch.cat([torch.tensor([True]), episode[1:] != episode[:-1]])
    assert torch.equal(batch[keys.IS_DECISION].squeeze(-1), starts)
    assert torch.equal(batch["next", keys.DONE].squeeze(-1), starts.roll(-1))
    shown = batch[keys.OBSERVATION][:, 7]
    assert (shown[starts] == harbour.NOT_CHOSEN).all() and torch.equal(
        shown[~starts], batch[keys.OPTION][~starts] * 1.0
    )
    pressed = batch[keys.PARAMETERS].gather(1, batch[keys.DISCRETE].unsqueeze(1)).squeeze(1)
    assert torch.equal(pressed, data.presses["duration"])
    assert torch.equal(batch[keys.PARAMETERS].count_nonzero(1), torch.ones(len(batch), dtype=torch.long))


def test_fuel_is_a_tank_less_the_logged_presses_and_at_the_end_the_recorded_tank(data):
    batch = transitions(data)
    for number in range(len(data.episodes)):
        rows = batch[batch[TRAJECTORY] == number]
        if not len(rows):
            assert data.episodes["presses"][number] == 0
            continue
        spent = rows[keys.PARAMETERS].sum(1).cumsum(0)
        torch.testing.assert_close(rows["next", FUEL][:-1, 0], 1 - spent[:-1] / physics.TANK, atol=1e-5, rtol=0)
        assert rows[FUEL][0] == 1.0
        assert rows["next", FUEL][-1, 0] == pytest.approx(data.episodes["tank"][number].item() / 360)


def test_two_frames_are_refused(people_file):
    with pytest.raises(DataError, match="one_frame=True"):
        transitions(read(people_file, checksum=None))


def test_first_observations_are_the_environments_and_second_ones_are_near_it(people_in_one_frame):
    data = select(people_in_one_frame, complete=True)
    batch = transitions(data)
    near = []
    for number, rows in enumerate(replayed(data, controller="choose")):
        ours = batch[data.presses["press"] == number]
        if number == 0:
            assert torch.equal(ours[keys.OBSERVATION], rows[keys.OBSERVATION])
        if number == 1:  # both boats began at the start, but the recorded glide was cut short by the next press
            near.append((ours[keys.OBSERVATION][:, 8:10] - rows[keys.OBSERVATION][:, 8:10]).norm(dim=1))
    near = torch.cat(near) * physics.HARBOUR_RADIUS
    assert near.median() < 8.0 and near.quantile(0.9) < 20.0


def test_all_recorded_transitions_are_finite_and_start_as_the_environment_does(people_in_one_frame):
    batch = transitions(people_in_one_frame)
    assert len(batch) == 46_757
    assert all(value.isfinite().all() for value in batch.values(True, True))
    # In five episodes not even the first press was logged, so the boat is already on its way.
    first = batch[batch[keys.IS_DECISION].squeeze(-1)][keys.OBSERVATION]
    assert (first[:, :2] != first[:, 8:10]).any(1).sum() == 5
    success = batch["next", keys.OUTCOME] == physics.SUCCESS
    to_goal = batch["next", keys.OBSERVATION][success][:, 14:].norm(dim=1) * physics.HARBOUR_RADIUS
    torch.testing.assert_close(to_goal, torch.full_like(to_goal, physics.DOCK_RADIUS), atol=1e-3, rtol=0)


def test_selected_episodes_meet_every_condition_and_keep_their_presses(data):
    chosen = select(data, complete=True, successes=True, best_people=1, controller="congruent")
    best = int(scores_by_person(data).argmax())
    assert (chosen.episodes["person"] == best).all() and chosen.episodes["complete"].all()
    assert (chosen.episodes["outcome"] == physics.SUCCESS).all() and (chosen.episodes["controller"] == 1).all()
    assert torch.equal(chosen.presses["episode"].bincount(minlength=len(chosen.episodes)), chosen.episodes["presses"])
    of = data.episodes[data.presses["episode"]]
    kept = (of["person"] == best) & of["complete"] & (of["outcome"] == physics.SUCCESS) & (of["controller"] == 1)
    assert torch.equal(chosen.presses["duration"], data.presses["duration"][kept])
    scores = scores_by_person(data)
    assert select(data, worst_people=1).episodes["person"].unique().tolist() == [int(scores.argmin())]
    assert select(data, people=[0, 2], best_people=1).episodes["person"].unique().tolist() == [
        int(scores[::2].argmax()) * 2
    ]
    few = select(data, presses=30)
    for person in range(3):
        own, every = (each.episodes[each.episodes["person"] == person]["presses"] for each in (few, data))
        assert own.sum() <= 30 < own.sum() + every[len(own)] and torch.equal(own, every[: len(own)])


def test_replay_buffer_is_complete(people_file, data):
    buffer = HumanExperienceReplay(32, reward="sparse", path=people_file, checksum=None)
    assert len(buffer) == len(data.presses) and buffer.sample().shape == (32,)
    assert buffer[:].exclude("index")[keys.OBSERVATION].equal(transitions(data)[keys.OBSERVATION])
    with pytest.raises(DataError, match="truncated, altered or another file"):
        HumanExperienceReplay(4, path=people_file)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (dict(best_people=0), "best_people=0, but must be 1 to 3"),
        (dict(controller="congruen"), "controller='congruen', but must be one of incongruent, congruent"),
        (dict(reward="dense"), "reward='dense': must be 'paper' or 'sparse'"),
    ],
)
def test_a_wrong_argument_of_the_replay_buffer_is_refused_in_one_line(people_file, given, said):
    with pytest.raises(ValueError, match=f"^{re.escape(said)}$"):
        HumanExperienceReplay(4, path=people_file, checksum=None, **given)


def test_replay_buffer_samples_whole_episodes_and_slices(people_file, data):
    arguments = dict(path=people_file, checksum=None)
    episodes = HumanExperienceReplay(200, sampler=whole_episodes(), **arguments).sample()
    starts, ends = episodes[keys.IS_DECISION].squeeze(-1), episodes["next", keys.DONE].squeeze(-1)
    assert starts.sum() == ends.sum() == 8 and starts[0] and torch.equal(starts.roll(-1), ends)
    for number in episodes[TRAJECTORY].unique():
        assert (episodes[TRAJECTORY] == number).sum() % data.episodes["presses"][number] == 0
    pairs = HumanExperienceReplay(40, sampler=slices(2), **arguments).sample()
    same = pairs[TRAJECTORY][1:] == pairs[TRAJECTORY][:-1]
    follows = torch.isclose(pairs["next", keys.OBSERVATION][:-1], pairs[keys.OBSERVATION][1:]).all(1)
    inside = same & ~pairs["next", keys.DONE].squeeze(-1)[:-1] & ~pairs[keys.IS_DECISION].squeeze(-1)[1:]
    assert follows[inside].float().mean() > 0.9  # two slices of one episode may lie side by side


def test_minari_returns_the_exported_transitions(data, tmp_path, monkeypatch):
    library = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    batch = transitions(select(data, complete=True, best_people=1))
    dataset = minari.export(batch, "hpamdp/people-v0")
    assert dataset.total_steps == len(batch)
    episode = dataset[0]
    assert dataset.action_space.contains({name: value[0] for name, value in episode.actions.items()})
    assert dataset.observation_space.contains(episode.observations[0])
    assert library.load_dataset("hpamdp/people-v0").recover_environment().unwrapped.spec.id == "hpamdp/BoatDock-v0"
    loaded = minari.load("hpamdp/people-v0")
    assert set(loaded.keys(True, True)) == set(batch.keys(True, True))
    loaded[TRAJECTORY] = batch[TRAJECTORY].unique()[
        loaded[TRAJECTORY]
    ]  # episodes without a press are not counted there
    for name, value in batch.items(True, True):
        assert loaded[name].dtype == value.dtype and torch.equal(loaded[name], value), name
    with pytest.raises(DataError, match="minari delete hpamdp/people-v0"):
        minari.export(batch, "hpamdp/people-v0")
    with pytest.raises(DataError, match=r"hpamdp/nobody-v0: is not in .*minari download hpamdp/nobody-v0"):
        minari.load("hpamdp/nobody-v0")
    with pytest.raises(DataError, match="it must be like namespace/name-v0"):
        minari.export(batch, "people")
