"""Models of people: the past that they see, the symmetry that they keep, how well they predict, simulated people."""

from __future__ import annotations

import json

import pytest
import torch

from hpamdp import keys
from hpamdp.data import DataError
from hpamdp.data.human import cli, models, statistics
from hpamdp.data.human.choice_model import ChoiceModel, features_of
from hpamdp.data.human.episodes import select
from hpamdp.data.human.press_model import KEYMAP, Presses, PressModel, press_features
from hpamdp.data.human.released_file import HumanData, read
from hpamdp.data.human.transitions import transitions
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv


@pytest.fixture(scope="module")
def data(people_file) -> HumanData:
    return read(people_file, checksum=None, one_frame=True)


@pytest.fixture(scope="module")
def simulated(data) -> HumanData:
    return models.simulate(select(data, presses=20), updates=20)


def test_choices_are_predicted_from_the_same_persons_earlier_episodes(data):
    before = features_of(data)
    changed = HumanData(data.episodes.clone(), data.presses)
    changed.episodes["controller"][100:] = 1 - changed.episodes["controller"][100:]  # episodes 30 on of person 1
    after = features_of(changed)
    is_person_1 = data.episodes["person"] == 1
    assert torch.equal(after[:101], before[:101])
    assert not torch.equal(after[101:140], before[101:140])
    changed.episodes["controller"][~is_person_1] = 0
    assert torch.equal(features_of(changed)[is_person_1], after[is_person_1])


def test_the_choice_model_learns_who_always_takes_the_same_boat(data):
    whole = HumanData(data.episodes.clone(), data.presses)
    whole.episodes["controller"] = whole.episodes["person"].clamp(max=1)
    features, is_congruent = features_of(whole), whole.episodes["controller"] == harbour.CONGRUENT
    model = ChoiceModel(features, is_congruent)
    later = whole.episodes["index"] > 20
    assert model.loss(features, is_congruent)[later].mean() < 0.1
    assert ((model.probability(features) > 0.5) == is_congruent)[later].all()


def test_the_press_model_keeps_the_symmetries_of_the_boats(data):
    torch.manual_seed(1)
    presses = Presses(data)
    model = PressModel(presses, torch.ones_like(presses.key, dtype=torch.bool), updates=20)
    env = BoatDockEnv(50, keymap=KEYMAP, seed=1)
    maps = env.symmetries
    td = env.rollout(2, break_when_any_done=False)[:, -1]
    controller, past = td[keys.OPTION], presses.past[:50]
    observation = td["next", keys.OBSERVATION]
    log_probs, mixture = model(press_features(observation, controller, past))
    num_kept = 0
    for each in range(len(maps)):
        number = torch.full((50,), each)
        if not torch.equal(maps.map_option(number, controller), controller):
            continue  # people may sail the two boats in different ways
        num_kept += 1
        mapped = model(press_features(maps.map_observation(number, observation), controller, past))
        key = maps.discrete[number, controller]
        torch.testing.assert_close(mapped[0].gather(1, key), log_probs, atol=1e-3, rtol=1e-3)
        torch.testing.assert_close(
            mapped[1].gather(1, key.unsqueeze(2).expand_as(mixture)), mixture, atol=1e-3, rtol=1e-3
        )
    assert num_kept == 6


def test_people_who_are_held_out_are_not_fitted(data):
    folds = models.folds_at_random(data, 3)
    assert torch.cat(folds).sort().values.tolist() == [0, 1, 2]
    losses = models.held_out_losses(data, folds, updates=60)
    assert losses.means(losses.choice == losses.choice)["key"] < 0.9 < torch.tensor(3.0).log()
    changed = HumanData(data.episodes.clone(), data.presses)
    of_fold = torch.isin(data.episodes["person"], folds[0])
    changed.episodes["controller"][of_fold] = 1 - changed.episodes["controller"][of_fold]
    again = models.held_out_losses(changed, folds[:1], updates=1)
    bins = models.held_out_losses(data, folds[:1], updates=1).bins
    # The probabilities come from the others, so the two possible choices of an episode exhaust them.
    torch.testing.assert_close(
        (-again.bins).exp()[of_fold] + (-bins).exp()[of_fold], torch.ones(int(of_fold.sum())).double()
    )
    with pytest.raises(DataError, match=r"^4 folds of 3 people"):
        models.folds_at_random(data, 4)


def test_simulated_people_are_a_recording_of_the_real_environment(data, simulated):
    episodes, presses = simulated
    assert statistics.figures(simulated)["episodes"] == len(episodes) == 3 * (int(episodes["index"].max()) + 1)
    assert torch.equal(torch.bincount(presses["episode"], minlength=len(episodes)), episodes["presses"])
    assert (presses["press"][presses["is_final"]] + 1 == episodes["presses"]).all()
    rows = transitions(simulated, has_choice=False)
    assert torch.equal(rows["next", keys.OUTCOME][presses["is_final"]], episodes["outcome"])
    number = presses["episode"]
    heading = harbour.direction(episodes["controller"][number], episodes["keymap"][number], presses["key"])
    x, y = (presses["position"] - episodes["centre"][number]).unbind(1)
    goal_x, goal_y = (episodes["goal"] - episodes["centre"])[number].unbind(1)
    tank = torch.full_like(x, physics.TANK)
    sailed = physics.press(x, y, tank, goal_x, goal_y, *heading, presses["duration"])
    is_on = ~presses["is_final"]
    moved = presses["next_position"] - episodes["centre"][number]
    torch.testing.assert_close(torch.stack([sailed.x, sailed.y], 1)[is_on], moved[is_on], atol=0.1, rtol=0.0)
    again = models.simulate(select(data, presses=20), updates=20)
    assert torch.equal(again.presses["duration"], presses["duration"])


def test_the_command_prints_losses_and_simulated_people(capsys, people_file, tmp_path):
    words = ["models", str(people_file), "--any-file", "--folds", "3", "--updates", "5"]
    assert cli.main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["held_out"]["at random"]["person"].keys() == {"0", "1", "2"}
    assert found["simulated"]["all"]["episodes"] == found["people"]["all"]["episodes"] == 210
    assert cli.main([*words, "--recorded"]) == 0
    output = capsys.readouterr().out
    assert "people 1 to 2" in output and "simulated" not in output
    for wrong, said in ((["--folds", "7"], "7 folds of 3 people"), (["--updates", "0"], "--updates 0, but must")):
        assert cli.main(["models", str(people_file), "--any-file", *wrong]) == 2
        assert capsys.readouterr().err.startswith(said)


def test_other_people_predict_the_released_ones(people_in_one_frame):
    losses = models.held_out_losses(people_in_one_frame, models.halves_by_number(people_in_one_frame)[:1], updates=200)
    found = losses.means(people_in_one_frame.episodes["person"] < 20)
    assert found["choice"] < 0.5 < 0.6 < found["bins"] and found["key"] < 0.63 and found["duration"] < -0.1
