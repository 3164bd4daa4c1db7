"""People's figures are those of the released file, and their boats move as in our physics."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scripts import load_script

from hpamdp.data.human import statistics, validation
from hpamdp.data.human.episodes import keep, score, scores_by_person
from hpamdp.data.human.released_file import HumanData, read
from hpamdp.data.human.validation import Singles
from hpamdp.env.boatdock import harbour, physics, reference

STUDY = Path(__file__).parents[1] / "experiments/human/study.py"


@pytest.fixture(scope="module")
def data(people_file) -> HumanData:
    return read(people_file, checksum=None)


def test_scores_are_five_times_the_tank_left_or_minus_one(data):
    expected = [
        5 * tank / 360 if outcome == physics.SUCCESS else -1.0
        for outcome, tank in zip(data.episodes["outcome"].tolist(), data.episodes["tank"].tolist(), strict=True)
    ]
    torch.testing.assert_close(score(data), torch.tensor(expected))
    whole = statistics.figures(data)
    assert whole["score"] == pytest.approx(np.mean(expected), abs=1e-6) and whole["episodes"] == 210
    by_person = statistics.figures_by(data, "person")
    assert [f["score"] for f in by_person.values()] == pytest.approx(scores_by_person(data).tolist(), abs=1e-5)
    assert sum(whole[name] for name in physics.OUTCOMES[1:]) == pytest.approx(1.0)


def test_no_synthetic_player_beats_the_best_plan(data):
    data = keep(data, torch.arange(len(data.episodes)) < 40)
    gaps = load_script(STUDY).optimality_gaps(data, statistics.best_scores(data))
    assert (gaps["press_gap"] > -0.05).all()  # the tank is recorded in whole ticks of a score of 0.014
    assert (gaps["choice_gap"] >= 0).all() and (gaps["choice_gap"] > 0).any()
    torch.testing.assert_close(gaps["gap"], gaps["choice_gap"] + gaps["press_gap"])


def test_choice_curve_is_the_probability_of_the_congruent_choice_by_bearing(data):
    offset = harbour.bearing_offset(statistics.layouts(data)).numpy()
    congruent = data.episodes["controller"].numpy() == harbour.CONGRUENT
    expected = [congruent[(offset >= low) & (offset < low + 10)].mean() for low in range(0, 60, 10)]
    assert statistics.choice_curve(data) == pytest.approx(expected)
    none = torch.zeros(len(data.episodes), dtype=torch.bool)
    assert np.isnan(statistics.choice_curve(data, none)).all()


def test_figures_of_the_released_file_are_the_built_in_references(people):
    figures = statistics.figures(people)
    for name, value in reference.HUMAN["chosen"].items():
        measured = figures["presses" if name == "steps" else name]
        assert measured == pytest.approx(value, abs=5e-3 if name == "steps" else 1e-3), name
    for option, by in statistics.figures_by(people, "controller").items():
        for name, value in reference.HUMAN[harbour.CONTROLLERS[option]].items():
            assert by[name] == pytest.approx(value, abs=1e-3), name
    blocks = statistics.figures_by(people, "block")
    assert [b["success"] for b in blocks.values()] == pytest.approx(reference.HUMAN_SUCCESS_BY_BLOCK, abs=1e-3)
    assert blocks[5]["score"] == pytest.approx(reference.HUMAN_LAST_60["score"], abs=1e-3)
    best = statistics.figures_by(people, "person")[int(scores_by_person(people).argmax())]
    assert best["score"] == pytest.approx(reference.BEST_PERSON["score"], abs=1e-3)
    assert best["success"] == pytest.approx(reference.BEST_PERSON["success"], abs=1e-3)
    curve = statistics.choice_curve(people)
    assert curve == pytest.approx(reference.HUMAN_CONGRUENT_BY_OFFSET, abs=1e-3)


def test_single_presses_of_people_end_in_our_physics_as_recorded(people):
    singles = validation.single_presses(people)
    assert len(singles.outcome) == 204
    assert validation.agreement(singles) >= 0.94


def test_first_presses_of_people_go_as_far_as_our_physics_allows(people):
    ways = validation.first_presses(people)
    assert len(ways.is_inside) == 427
    assert ways.is_inside.double().mean() >= 0.98


def test_presses_of_synthetic_players_agree_with_our_physics(data):
    singles, ways = validation.single_presses(data), validation.first_presses(data)
    assert len(singles.outcome) >= 20 and validation.agreement(singles) == 1.0
    assert len(ways.is_inside) >= 100 and ways.is_inside.all()


def simulated_singles(num: int, glide: float, limit: float) -> Singles:
    generator = torch.Generator().manual_seed(0)
    x = 0.6 + 0.9 * torch.rand(num, generator=generator, dtype=torch.float64)
    pressed = physics.pressed_distance(x)
    to_dock = pressed * (1.0 + 1.1 * torch.rand(num, generator=generator, dtype=torch.float64))
    noise = torch.randn(2, num, generator=generator, dtype=torch.float64)
    spare = (1.0 + glide) * pressed - to_dock + 0.5 * noise[0]
    speed = physics.speed(physics.duration_for(spare.clamp(min=0.0) / glide)) + 2.0 * noise[1]
    docked = torch.where(speed > limit, physics.TOO_FAST, physics.SUCCESS)
    outcome = torch.where(spare < 0, physics.OUT_OF_FUEL, docked)
    return Singles(pressed, to_dock, outcome, outcome)


def test_fit_finds_the_constants_that_made_the_presses():
    fit = load_script(STUDY).fit_constants(simulated_singles(400, glide=1.1, limit=80.0), num_bootstraps=30)
    for glide in (fit.likely_glide, fit.agreeing_glide):
        assert glide[0] == pytest.approx(1.1, abs=0.05) and glide[1] <= 1.1 <= glide[2]
    for speed in (fit.likely_speed, fit.agreeing_speed):
        assert speed[0] == pytest.approx(80.0, abs=4.0) and speed[1] <= 80.0 <= speed[2]
    assert fit.agreement.max() > 0.9


def test_our_constants_lie_in_the_intervals_fitted_to_peoples_presses(people):
    fit = load_script(STUDY).fit_constants(validation.single_presses(people), num_bootstraps=100)
    for name in ("likely_glide", "agreeing_glide"):
        _, low, high = getattr(fit, name)
        assert low <= physics.GLIDE <= high, name
    assert fit.agreeing_speed[1] <= physics.DOCKING_SPEED <= fit.agreeing_speed[2]
