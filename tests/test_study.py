"""What studies make of finished runs: files gathered, seeds as the unit of the statistics."""

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from scripts import load_script

from experiments.study_tables import (
    FIRST_PROTOCOL_SEED,
    Run,
    add_to_tables,
    curve,
    difference,
    finished,
    gathered,
    interquartile_mean,
    interval_text,
    middle_half,
    planned_seeds,
    read_csv,
    standing_rows,
    with_enough_seeds,
    write_tables,
)
from hpamdp.analysis.statistics import mean_interval, spread
from hpamdp.figure_style import with_minus

EXPERIMENTS = Path(__file__).resolve().parent.parent / "experiments"
CONFIG = (
    "low: {{twin: {twin}, multipass: {multipass}}}\n"
    "env: {{controller: congruent, reward: {reward}}}\n"
    "eval: {{stop_score: {stop_score}}}\n"
)


def study(name):
    return load_script(EXPERIMENTS / name / "study.py")


def leave_run(folder, low="hppo", seed=0, scores=(-0.9, 1.5, 2.5), high="none", finished=True, **config):
    """Write what a finished run leaves behind, as far as studies read it."""
    folder.mkdir(parents=True, exist_ok=True)
    summary = {"low": low, "env": "boatdock", "controller": "congruent", "seed": seed, "score": scores[-1]}
    summary |= {"high": high, "finished": finished, "success": 0.9, "references": {"random": {"score": -0.9}}}
    summary |= {"frames": 100 * (len(scores) - 1), "ceiling": 3.4, "wall_s": 2.04, "cpu_s": 1.0}
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "config.yaml").write_text(
        CONFIG.format(**{"twin": "true", "multipass": "true", "reward": "paper", "stop_score": "null"} | config)
    )
    lines = ["frames,wall_s,loss,eval/score,eval/success", "50,0.5,1.0,,"]
    lines += [f"{100 * i},{i},,{score},{0.1 * i}" for i, score in enumerate(scores)]
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    np.savez(folder / "evaluation.npz", score=np.array([1.0, 2.0]))


def test_finished_runs_are_found_at_any_depth_and_unfinished_ones_left_out(tmp_path, capsys):
    leave_run(tmp_path / "b/deep/er", seed=1)
    leave_run(tmp_path / "a", seed=2)
    leave_run(tmp_path / "stopped", finished=False)
    (tmp_path / "c").mkdir()
    (tmp_path / "c/metrics.csv").write_text("frames\n1\n")
    runs = finished([tmp_path])
    assert [run.summary["seed"] for run in runs] == [2, 1] and runs[1].config["env"]["reward"] == "paper"
    assert capsys.readouterr().err == f"{tmp_path / 'stopped'}: was stopped, left out\n"
    assert finished([tmp_path / "b", str(tmp_path / "a")])[0].summary["seed"] == 1


def test_rows_come_back_from_csv_with_numbers_as_numbers_and_gaps_as_gaps(tmp_path):
    rows = [{"low": "hppo", "seed": 0, "reached": 1e6}, {"low": "a, b", "seed": 1, "reached": ""}]
    rows.append({"low": "64_64", "seed": 2, "reached": 0.5})
    write_tables(tmp_path, {"a": rows})
    assert read_csv(tmp_path / "a.csv") == rows


def test_of_tables_one_of_which_is_empty_none_is_written(tmp_path):
    (tmp_path / "a.csv").write_text("kept")
    with pytest.raises(SystemExit, match=r"b\.csv; nothing was written"):
        write_tables(tmp_path, {"a": [{"x": 1}], "b": []})
    assert [file.name for file in tmp_path.iterdir()] == ["a.csv"] and (tmp_path / "a.csv").read_text() == "kept"


def test_linked_folders_count_once_and_unreadable_runs_are_named(tmp_path, capsys):
    for seed, folder in enumerate(["study/a", "elsewhere/b", "elsewhere/deep/c"]):
        leave_run(tmp_path / folder, seed=seed)
    study = tmp_path / "study"
    (study / "seed1").symlink_to(tmp_path / "elsewhere/b")
    (study / "seed2").symlink_to("../elsewhere/deep")
    (study / "again").symlink_to(study / "a")
    (study / "a/loop").symlink_to(study)
    (study / "gone").symlink_to(tmp_path / "nowhere")
    leave_run(study / "cut")
    (study / "cut/summary.json").write_text('{"score": 1.')
    runs = finished([study, study / "a"])
    assert sorted(run.summary["seed"] for run in runs) == [0, 1, 2]
    assert sorted(capsys.readouterr().err.splitlines()) == [
        f"{study / 'cut'}: summary.json is missing or damaged, left out",
        f"{study / 'gone'}: is a broken link, left out",
    ]


def test_the_spread_is_the_deviation_of_a_sample_and_of_one_seed_there_is_none():
    assert spread([1.0, 2.0, 3.0]) == "2.000 ± 1.000"
    assert spread([1.25], digits=1) == "1.2"


def test_the_interquartile_mean_ignores_the_outer_quarters_and_is_shown_from_ten_seeds_on():
    middle, low, high = interquartile_mean([-100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 100.0])
    assert middle == 3.5 and low < 3.5 < high
    assert interquartile_mean([1.0, 5.0, 9.0])[0] == 5.0  # a quarter of three seeds is none
    for values in ([2.0], [2.0, 2.0, 2.0]):
        middle, low, high = interquartile_mean(values)
        assert middle == 2.0 and np.isnan([low, high]).all()
    assert middle_half([1.0, 2.0, 3.0, 4.0] * 2) == "" and middle_half([1.0] * 10) == "1.000"


def test_the_interval_covers_the_truth_about_as_often_as_it_says():
    draws = np.random.default_rng(0).normal(size=(60, 20))
    covers = [low <= 0.0 <= high for _, low, high in map(interquartile_mean, draws)]
    assert 0.83 < np.mean(covers) <= 1.0


def test_a_difference_is_clear_where_its_interval_excludes_0():
    clear = difference([3.0, 3.1, 3.2], [1.0, 1.1, 1.2])
    assert clear.mean == pytest.approx(2.0)
    assert 1.7 < clear.low < 2.0 < clear.high < 2.3
    assert clear.is_clear and clear.improvement == 1.0
    assert difference([1.0, 1.1, 1.2], [3.0, 3.1, 3.2]).is_clear
    assert str(clear).startswith("+2.000 (+1.") and str(clear).endswith(")")
    unclear = difference([1.0, 2.0, 3.0], [1.1, 1.9, 2.9])
    assert unclear.low < 0.0 < unclear.high and not unclear.is_clear and str(unclear).endswith("), unclear")
    assert unclear.improvement == pytest.approx(5 / 9)
    assert difference([1.0, 1.0], [1.0, 1.0]).improvement == 0.5


def test_a_difference_counts_a_seed_that_failed_with_few_seeds_and_with_many():
    for num in (4, 10, 20):
        found = difference([*[1.0] * (num - 1), 0.0], [0.9] * num)
        assert found.mean == pytest.approx(0.1 - 1.0 / num) and not found.is_clear


def test_intervals_of_means_and_of_differences_cover_the_truth_about_as_often_as_they_say():
    draws = np.random.default_rng(0).normal(size=(1000, 3))
    assert np.mean([low <= 0.0 <= high for low, high in map(mean_interval, draws)]) == pytest.approx(0.95, abs=0.02)
    generator = np.random.default_rng(0)
    for num in (3, 5, 12):
        pairs = [difference(generator.normal(size=num), generator.normal(size=num)) for _ in range(400)]
        assert 0.93 <= np.mean([not pair.is_clear for pair in pairs]) <= 1.0


def test_seeds_that_do_not_vary_have_no_interval_and_no_clear_difference():
    assert np.isnan(mean_interval([1.0])).all() and np.isnan(mean_interval([2.0, 2.0])).all()
    assert interval_text([2.0, 2.0]) == "" and interval_text([1.0, 2.0, 3.0], ".1f") == "-0.5 to 4.5"
    assert str(difference([1.0, 1.0], [0.98, 0.98])) == "+0.020"
    assert not difference([1.0, 1.0], [0.98, 0.98]).is_clear


def test_a_plan_may_name_one_seed(tmp_path):
    (tmp_path / "cells.csv").write_text("learner,seeds\nhppo,100\npdqn,100-101\n")
    assert planned_seeds(tmp_path / "cells.csv") == {("hppo",): range(100, 101), ("pdqn",): range(100, 102)}


def test_a_curve_joins_runs_that_were_evaluated_at_different_times():
    points = {0: [(100, 1.0), (0, 0.0)], 1: [(0, 0.0), (50, 0.5), (100, 1.0), (150, 9.0)]}
    rows = [{"seed": seed, "frames": at, "score": score} for seed, of in points.items() for at, score in of]
    at, means, deviations = curve(rows, "frames", "score")
    assert at.tolist() == [0, 50, 100] and means.tolist() == [0.0, 0.5, 1.0] and not deviations.any()


def test_the_learners_study_names_published_forms_and_rewards_and_when_people_were_reached(tmp_path):
    leave_run(tmp_path / "a", low="pdqn", twin="false", scores=(0.0, 2.0, 1.0))
    leave_run(tmp_path / "b", low="pdqn", twin="false", multipass="false", reward="sparse", scores=(0.0, 1.9))
    leave_run(tmp_path / "c", low="pdqn")
    results, curves = study("learners").gather(finished([tmp_path]))
    assert [(row["low"], row["reward"], row["presses_to_human"]) for row in results] == [
        ("pdqn as MP-DQN", "shaped", 100.0),
        ("pdqn as P-DQN", "sparse", ""),
        ("pdqn", "shaped", 200.0),
    ]
    assert len(curves) == 8 and math.isclose(curves[1]["eval/success"], 0.1)


def test_the_table_keeps_runs_that_ended_at_peoples_score_apart_from_full_length_ones(tmp_path):
    leave_run(tmp_path / "a", scores=(0.0, 2.0, 3.3))
    leave_run(tmp_path / "b", scores=(0.0, 3.1), reward="sparse")
    leave_run(tmp_path / "c", scores=(0.0, 2.0), stop_score=1.97)
    leave_run(tmp_path / "d", high="ucb")
    leave_run(tmp_path / "e", low="random")
    module = study("table1")
    found = gathered([tmp_path], module.gather, settings=module.OF_PROBLEM, **module.OF_STUDY)
    assert [(row["reward"], row["score"]) for row in found["results"]] == [("shaped", 3.3), ("sparse", 3.1)]
    assert len(found["curves"]) == 5
    assert [(row["frames"], row["eval/score"]) for row in found["efficiency"]] == [(0.0, 0.0), (100.0, 2.0)]


def test_the_hierarchy_ranks_selectors_by_their_distances_to_the_ceilings_of_their_own_layouts():
    hierarchy = study("hierarchy")
    cell = {"low": "hppo", "total": 100, "uniform_option_steps": 0} | dict.fromkeys(hierarchy.COLUMNS, 0.5)

    def runs(high, ceiling, *scores):
        return [
            cell | {"high": high, "seed": seed, "ceiling": ceiling, "score": each} for seed, each in enumerate(scores)
        ]

    rows = runs("actor", 3.7, 3.5, 3.51, 3.52) + runs("ucb", 3.5, 3.4, 3.41, 3.42)
    first, second = hierarchy.table(rows).splitlines()[2:]
    assert first.startswith("| ucb | hppo | 100, 0 | 3 | 3.410 ± 0.010 | 0.090 | +0.100 (+0.077 to +0.123) |")
    assert second.startswith("| actor | hppo | 100, 0 | 3 | 3.510 ± 0.010 | 0.190 |  |")


def test_offline_compares_data_sets_after_the_same_number_of_updates():
    offline = study("offline")

    def runs(data, **scores_by_updates):
        name = {"low": "bc", "start": "offline", "data": data, "episodes": "all"}
        return [
            name | {"seed": seed, "frames": int(updates[1:]), "score": score + 0.01 * seed}
            for updates, score in scores_by_updates.items()
            for seed in (0, 1, 2)
        ]

    curves = runs("rest-to-rest", _1000=0.2, _2000=0.5, _5000=0.9) + runs("recorded", _1000=0.1, _2000=0.3)
    better, other = ("bc", "offline", "rest-to-rest", "all"), ("bc", "offline", "recorded", "all")
    title, after, found, _ = offline.comparison("bc: a less b", better, other, curves)
    assert (title, after) == ("bc: a less b", "2,000 updates") and str(found).startswith("+0.200 (")
    assert offline.comparison("no runs", ("iql", *other[1:]), other, curves) is None


def test_domains_scores_each_learner_by_its_longest_runs_within_the_published_steps():
    domains = study("domains")

    def run(frames, seed):
        return {"domain": "catch_point", "learner": "hyar", "frames": frames, "seed": seed, "success": 0.5}

    allowed = [run(2000, 0), run(2000, 1)]
    assert domains.at_published_steps([*allowed, run(1000, 0), run(2_000_000, 0)]) == allowed


def test_a_cell_stands_with_the_seeds_of_the_protocol_once_all_planned_ones_have_run(tmp_path):
    domains, csv_file = study("domains"), tmp_path / "results.csv"
    write_tables(tmp_path, {"results": [_row("pdqn", seed) for seed in (0, 100, 101)] + [_row("hyar", 3)]})

    def standing(**seeds):
        write_tables(tmp_path, {"cells": [_cell(learner, planned) for learner, planned in seeds.items()]})
        return standing_rows(csv_file)

    assert [row["seed"] for row in standing(pdqn="100-102")] == [0, 3], "one planned seed is missing"
    assert [row["seed"] for row in standing(pdqn="100-101", hyar="100-101")] == [100, 101, 3]
    assert [row["seed"] for row in standing(hyar="100-101")] == [0, 3], "seeds that nothing plans"
    table = domains.table(standing(pdqn="100-101"), [], [])
    assert "| 0.700 ± 0.141 (2) |" in table and "| 0.700 (1†) |" in table
    (tmp_path / "cells.csv").unlink()
    assert [row["seed"] for row in standing_rows(csv_file)] == [0, 100, 101, 3], "without a plan all stand"


def _row(learner, seed):
    success = {100: 0.6, 101: 0.8}.get(seed, 0.7)
    return {"domain": "goal", "learner": learner, "frames": 1000, "seed": seed, "success": success}


def _cell(learner, seeds):
    return {"domain": "goal", "learner": learner, "seeds": seeds}


@pytest.mark.parametrize("plan", sorted(EXPERIMENTS.glob("*/cells.csv")), ids=lambda plan: plan.parent.name)
def test_every_stored_run_of_the_protocol_is_planned(plan):
    """Tables would leave it out without a word."""
    planned, names = planned_seeds(plan), plan.read_text().split(",seeds")[0].split(",")
    for row in read_csv(plan.with_name("results.csv")):
        if row["seed"] >= FIRST_PROTOCOL_SEED:
            assert row["seed"] in planned.get(tuple(row[name] for name in names), ()), row


def test_a_run_of_another_length_neither_replaces_a_stored_one_nor_joins_a_cell(tmp_path):
    names = ("domain", "learner", "seed")
    write_tables(tmp_path, {"results": [{**_row("pdqn", 2), "frames": 800_000}]})
    with pytest.raises(SystemExit, match=r"the given run has 2,000 steps .* results.csv 800,000; nothing"):
        add_to_tables(tmp_path, {"results": [{**_row("pdqn", 2), "frames": 2_000}]}, names)
    with pytest.raises(SystemExit, match=r"goal, pdqn: has runs of 2,000 and 800,000 steps; nothing was written"):
        add_to_tables(tmp_path, {"results": [{**_row("pdqn", 3), "frames": 2_000}]}, names)
    assert [row["frames"] for row in read_csv(tmp_path / "results.csv")] == [800_000]
    add_to_tables(tmp_path, {"results": [{**_row("pdqn", 3), "frames": 2_000}]}, names, lengths_differ=True)
    assert len(read_csv(tmp_path / "results.csv")) == 2


def test_a_curve_that_is_given_twice_or_is_shorter_than_those_of_its_cell_is_refused(tmp_path):
    def of_run(seed, last):
        return [{"boat": "congruent", "seed": seed, "presses": presses} for presses in (0, last)]

    def add(rows):
        add_to_tables(tmp_path, {"curves": rows}, ("boat", "seed"), steps="presses", of_evaluations=True)

    write_tables(tmp_path, {"curves": of_run(0, 384)})
    with pytest.raises(SystemExit, match="two runs of congruent, 1; nothing was written"):
        add(of_run(1, 384) + of_run(1, 200))
    with pytest.raises(SystemExit, match=r"congruent: has runs of 200 and 384 steps; nothing was written"):
        add(of_run(1, 200))
    add(of_run(1, 384))
    assert read_csv(tmp_path / "curves.csv") == of_run(0, 384) + of_run(1, 384)


@pytest.mark.parametrize("cut", ["a,b\r\n1,2\r\n3", "a,b\r\n1,2,3\r\n"])
def test_a_csv_file_that_was_cut_is_refused_in_one_line(tmp_path, cut):
    (tmp_path / "cut.csv").write_text(cut)
    with pytest.raises(SystemExit, match=r"cut.csv: line \d has not as many cells as the first line"):
        read_csv(tmp_path / "cut.csv")


def test_a_run_of_another_study_and_a_damaged_one_are_named_and_left_out(tmp_path, capsys):
    leave_run(tmp_path / "kept")
    for name in ("other", "no_metrics", "no_number", "seed", "config", "no_config"):
        leave_run(tmp_path / name)
    change_summary(tmp_path / "other", env="platform")
    (tmp_path / "no_metrics" / "metrics.csv").unlink()
    change_summary(tmp_path / "no_number", success=None)
    change_summary(tmp_path / "seed", seed="a")
    (tmp_path / "config" / "config.yaml").write_text("low: {twin: true}\nenv: 4\n")
    (tmp_path / "no_config" / "config.yaml").write_text("low: {twin: true}\n")
    learners = study("learners")
    results, _ = gathered([tmp_path], learners.gather, settings=learners.OF_PROBLEM, env=("boatdock",))
    assert [row["seed"] for row in results] == [0]
    lines = capsys.readouterr().err.splitlines()
    assert [line.removeprefix(f"{tmp_path}/") for line in lines] == [
        "config: cannot be read by this study: AttributeError: 'int' object has no attribute 'get'; left out",
        "no_config: has no env, as runs of this study have; left out",
        "no_metrics: metrics.csv is missing or has no evaluations; left out",
        "no_number: cannot be read by this study: TypeError: type NoneType doesn't define __round__ method; left out",
        "other: env=platform, but runs of this study have boatdock; left out",
        "seed: seed=a: must be a whole number; left out",
    ]


def test_runs_that_were_made_under_other_rules_are_named_and_left_out(tmp_path, capsys):
    problem = "max_steps: 200, noise: 1.0, grouping: null"
    for name in ("kept", "noise", "grouping", "eval", "short", "nan", "success", "cut"):
        leave_run(tmp_path / name)
        change_summary(tmp_path / name, env="platform")
        (tmp_path / name / "config.yaml").write_text(f"mode: train\nlow: {{gamma: 0.9}}\nenv: {{{problem}}}\n")
    for name, old, new in (
        ("noise", "noise: 1.0", "noise: 0.0"),
        ("grouping", "grouping: null", "grouping: default"),
        ("eval", "mode: train", "mode: eval"),
    ):
        file = tmp_path / name / "config.yaml"
        file.write_text(file.read_text().replace(old, new))
    change_summary(tmp_path / "short", frames=200_704)
    change_summary(tmp_path / "nan", score=math.nan)
    change_summary(tmp_path / "success", success=math.inf)
    metrics = tmp_path / "cut/metrics.csv"
    metrics.write_text(metrics.read_text()[:-3])
    results, _ = gathered([tmp_path], study("domains").gather, env=("platform",))
    assert len(results) == 1
    lines = capsys.readouterr().err.splitlines()
    assert [line.removeprefix(f"{tmp_path}/") for line in lines] == [
        "cut: metrics.csv has its last evaluation at 100 frames, but the run ended at 200; left out",
        "eval: mode=eval, but runs of this study have train; left out",
        "grouping: env.grouping=default, but runs of this study have None; left out",
        "nan: score=nan: must be a finite number; left out",
        "noise: env.noise=0.0, but runs of this study have 1.0; left out",
        "short: metrics.csv has its last evaluation at 200 frames, but the run ended at 200,704; left out",
        "success: success=inf: must be a finite number; left out",
    ]


def test_a_study_states_which_settings_of_a_problem_its_runs_may_have(tmp_path, capsys):
    for name, tiles in (("a", 0), ("b", 20), ("c", 40)):
        leave_run(tmp_path / name)
        change_summary(tmp_path / name, env="office")
        (tmp_path / name / "config.yaml").write_text(f"low: {{}}\nenv: {{tiles: {tiles}}}\n")
    read = {"env": ("office",), "settings": {"office.tiles": (20, 40)}}
    assert [run.folder.name for run in gathered([tmp_path], list, **read)] == ["b", "c"]
    assert capsys.readouterr().err == f"{tmp_path / 'a'}: env.tiles=0, but runs of this study have 20 or 40; left out\n"
    assert len(gathered([tmp_path], list, settings={"office.tiles": None}, env=("office",))) == 3


def test_a_study_of_evaluations_takes_them_without_metrics(tmp_path, capsys):
    leave_run(tmp_path / "eval")
    (tmp_path / "eval/config.yaml").write_text("mode: eval\nlow: {}\nenv: {keymap: 1}\n")
    (tmp_path / "eval/metrics.csv").unlink()
    assert len(gathered([tmp_path], list, modes=("train", "eval"), env=("boatdock",))) == 1
    with pytest.raises(SystemExit, match=r"no finished runs of this study; nothing was written"):
        gathered([tmp_path], list, env=("boatdock",))
    assert "mode=eval, but runs of this study have train; left out" in capsys.readouterr().err


def test_options_refuses_cells_of_runs_with_different_settings():
    options = study("options")
    rows = [{"low": "pdqn", "high": "ucb", "seed": seed, "sharing": "shared"} for seed in (100, 101, 102)]
    assert options.standing(rows, options.PAIR, ["sharing"]) == {("pdqn", "ucb"): rows}
    with pytest.raises(SystemExit, match="pdqn, ucb: has runs with different sharing"):
        options.standing([*rows, rows[0] | {"sharing": "per_option"}], options.PAIR, ["sharing"])
    with pytest.raises(SystemExit, match="pdqn, ucb: has two runs with the same seed"):
        options.standing([*rows, rows[0]], options.PAIR)


STUDIES = sorted(EXPERIMENTS.glob("*/study.py"))
GATHERING = [file.parent.name for file in STUDIES if "gathered(" in file.read_text(encoding="utf-8")]


@pytest.mark.parametrize("name", GATHERING)
def test_a_study_that_is_given_a_run_of_no_study_changes_no_csv_file(name, tmp_path, monkeypatch):
    module, copy = study(name), tmp_path / "study"
    shutil.copytree(EXPERIMENTS / name, copy)
    monkeypatch.setattr(module, "HERE", copy)
    before = {file: file.read_bytes() for file in copy.glob("*.csv")}
    leave_run(tmp_path / "runs" / "foreign")
    change_summary(tmp_path / "runs" / "foreign", env="nowhere")
    with pytest.raises(SystemExit, match=r"no finished runs of this study; nothing was written"):
        module.main([str(tmp_path / "runs")])
    assert {file: file.read_bytes() for file in copy.glob("*.csv")} == before


def change_summary(folder, **values):
    file = folder / "summary.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


def test_runs_are_added_to_a_csv_file_in_the_place_of_repeated_ones(tmp_path):
    write_tables(tmp_path, {"results": [_row("pdqn", 0), _row("pdqn", 2)]})
    again = {**_row("pdqn", 2), "success": 0.1}
    add_to_tables(tmp_path, {"results": [again, _row("hyar", 1)]}, ("domain", "learner", "seed"))
    rows = [(row["learner"], row["seed"], row["success"]) for row in read_csv(tmp_path / "results.csv")]
    assert rows == [("hyar", 1, 0.7), ("pdqn", 0, 0.7), ("pdqn", 2, 0.1)]


def test_domains_ranks_learners_by_the_plain_mean():
    domains = study("domains")

    def runs(learner, frames, cpu_s, *scores):
        name = {"domain": "goal", "learner": learner, "frames": frames, "cpu_s": cpu_s}
        return [name | {"seed": seed, "success": score} for seed, score in enumerate(scores, 100)]

    # One bad seed of five lowers the mean, but not the interquartile mean.
    bad_seed, steady = runs("hyar", 1000, 500.0, 0.9, 0.9, 0.9, 0.9, 0.0), runs("pdqn", 1000, 700.0, *[0.8] * 5)
    line = domains.best_table(bad_seed + steady, [{"domain": "goal", "method": "chdp", "score": 0.81}]).splitlines()[-1]
    assert line.startswith("| goal | pdqn | 2 | 0.800 ± 0.000 (5), IQM 0.800 success |  | hyar (5) |")
    assert line.endswith("| 0.20 | hyar | 0.81 (chdp) | 700 s |")
    table = domains.table(steady, [], [{"domain": "goal", "player": "random", "score": 0.0004}])
    assert table.splitlines()[-1].startswith("| random |  | 0.0004 |")
    assert "| 0.720 ± 0.402 (5) |" in domains.table(bad_seed, [], [])


def test_domains_names_learners_that_differ_from_the_best_by_chance():
    domains = study("domains")

    def runs(learner, *scores):
        name = {"domain": "goal", "learner": learner, "frames": 1000, "cpu_s": 1.0}
        return [name | {"seed": seed, "success": score} for seed, score in enumerate(scores)]

    results = runs("hppo", 0.9, 0.8, 0.7) + runs("pdqn", 0.9, 0.7, 0.7) + runs("hyar", 0.1, 0.1, 0.2)
    cells = domains.best_table(results, []).splitlines()[-1].split("|")
    assert [cell.strip() for cell in cells[5:9]] == ["0.552 to 1.048", "pdqn (3†)", "0.61", "pdqn"]


def test_cells_with_one_or_two_seeds_get_no_place_in_a_table():
    cells = {"hppo": (0, 1, 2), "pdqn": (0, 1), "hyar": (5, 5, 5)}
    rows = [{"learner": learner, "seed": seed} for learner, seeds in cells.items() for seed in seeds]
    assert {row["learner"] for row in with_enough_seeds(rows, "learner")} == {"hppo"}


def test_a_share_on_crossing_is_of_the_best_return_from_the_same_places(tmp_path):
    lengths = study("lengths")
    env = lengths.Crossing(50, start=3.0)
    env.seed_evaluation(7)
    env.reset()
    best = lengths.best_values(lengths.GAMMA, 1)
    steps = [1.0 + math.log(best[cell]) / math.log(lengths.GAMMA) for cell in lengths.cell_of(env.place).tolist()]
    np.savez(tmp_path / "evaluation.npz", score=np.ones(50), success=np.ones(50), steps=np.array(steps))
    config = {"env": {"start": 3.0}, "eval": {"seed": 7}}
    assert lengths.share_on_crossing(Run(tmp_path, {}, config)) == pytest.approx(1.0)
    np.savez(tmp_path / "evaluation.npz", score=np.ones(50), success=np.ones(50), steps=np.array(steps) + 1.0)
    assert lengths.share_on_crossing(Run(tmp_path, {}, config)) == pytest.approx(lengths.GAMMA)


def test_the_page_of_lengths_has_the_table_of_its_stored_runs(capsys):
    study("lengths").main([])
    assert with_minus(capsys.readouterr().out) in (EXPERIMENTS / "lengths" / "README.md").read_text()
