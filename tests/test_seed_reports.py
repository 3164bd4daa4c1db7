"""Reports of many seeds: runs are grouped by all but the seed, and their folders may hold anything."""

import csv
import json
import os
from pathlib import Path

import numpy as np
import pytest

import hpamdp
from hpamdp.analysis.seed_report import report_on
from hpamdp.analysis.statistics import mean_curve
from hpamdp.config.errors import ConfigError

CONFIG = """\
mode: train
seed: {seed}
total_frames: {total_frames}
env: {{slip: {slip}, own_seed: {seed}}}
high: {{}}
low: {{lr: {lr}, anneal_steps: {total_frames}}}
film: {film}
choices: {{env: platform, high: none, low: {low}}}
"""
VALUES = {"total_frames": 400, "slip": 0.0, "lr": 0.1, "low": "hppo", "film": "true"}


def leave_run(folder, seed=0, scores=(0.0, 1.0, 2.0), finished=True, summary=None, **values):
    """Write the three text files of a run, as far as reports read them."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(CONFIG.format(seed=seed, **VALUES | values))
    lines = ["frames,loss,eval/score,eval/success", "50,1.0,,"]
    lines += [f"{100 * i},0.5,{score},{score / 10}" for i, score in enumerate(scores)]
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")
    written = {"low": values.get("low", "hppo"), "score": scores[-1], "success": 0.5, "frames": 400, "cpu_s": 60.0}
    written |= {"finished": finished, "seed": seed, "references": {"random": {"score": -1.0}}}
    (folder / "summary.json").write_text(json.dumps(written | (summary or {})))


def read_table(folder):
    with (folder / "report.csv").open() as file:
        return list(csv.DictReader(file))


def test_runs_are_grouped_by_all_settings_but_the_seed(tmp_path):
    for seed, score in enumerate((1.0, 2.0, 3.0)):
        leave_run(tmp_path / f"a{seed}", seed=seed, scores=(0.0, score))
        leave_run(tmp_path / f"b{seed}", seed=seed, scores=(0.0, score + 5.0), lr=0.5, film="false")
    first, second = hpamdp.report(tmp_path)
    expected = {"configuration": "low.lr=0.1", "settings": {"low.lr": "0.1"}, "seeds": 3, "mean": 2.0, "std": 1.0}
    expected |= {"min": 1.0, "max": 3.0, "interval": None, "frames": 400.0, "cpu_s": 60.0}
    assert first == expected | {"unfinished": 0, "failed": 0}
    assert (second["configuration"], second["mean"]) == ("low.lr=0.5", 7.0)


def test_evaluations_of_one_agent_do_not_count_as_seeds(tmp_path, capsys):
    for agent in "ab":
        for seed in (0, 1, 2):
            folder = tmp_path / f"{agent}{seed}"
            leave_run(folder, seed=seed, scores=(0.0, float(seed)))
            with (folder / "config.yaml").open("a") as file:
                file.write(f"mode: eval\ncheckpoint: {agent}\n")
    rows = hpamdp.report(tmp_path)
    assert [(row["configuration"], row["seeds"], row["mean"]) for row in rows] == [
        ("checkpoint=a", 1, 0.0),
        ("checkpoint=b", 1, 0.0),
    ]
    assert f"{tmp_path}/a1: evaluates the agent of {tmp_path}/a0, left out\n" in capsys.readouterr().err


def test_runs_on_objects_from_python_are_said_to_look_alike(tmp_path, capsys):
    for seed in (0, 1):
        leave_run(tmp_path / str(seed), seed=seed)
        file = tmp_path / f"{seed}/config.yaml"
        file.write_text(file.read_text().replace("slip: 0.0", "id: null, entry_point: null, slip: 0.0"))
    hpamdp.report(tmp_path)
    assert (
        "and 1 more: their environments were objects from Python, which no config tells apart"
        in capsys.readouterr().err
    )


def test_a_name_has_what_was_swept_but_not_what_follows_from_it(tmp_path):
    leave_run(tmp_path / "0", low="hppo", lr=0.1, total_frames=400)
    leave_run(tmp_path / "1", low="pdqn", lr=0.9, total_frames=900)  # as its yaml file says
    assert [row["configuration"] for row in hpamdp.report(tmp_path)] == ["low=hppo", "low=pdqn"]
    leave_run(tmp_path / "2", low="pdqn", lr=0.9, total_frames=500)  # `anneal_steps` follows it
    assert [row["configuration"] for row in hpamdp.report(tmp_path)] == [
        "low=hppo total_frames=400",
        "low=pdqn total_frames=900",
        "low=pdqn total_frames=500",
    ]


def test_a_single_configuration_is_named_by_its_choices(tmp_path):
    leave_run(tmp_path / "0")
    assert hpamdp.report(tmp_path / "0")[0]["configuration"] == "env=platform high=none low=hppo"


def test_unfinished_and_failed_runs_are_counted_and_left_out_of_the_mean(tmp_path):
    leave_run(tmp_path / "0", seed=0, scores=(0.0, 4.0))
    leave_run(tmp_path / "1", seed=1, finished=False)
    leave_run(tmp_path / "2", seed=2)
    (tmp_path / "2/summary.json").unlink()  # as of a run that diverged
    (tmp_path / "2/checkpoint.diverged.safetensors").touch()
    leave_run(tmp_path / "3", seed=3, finished=False)
    (tmp_path / "3/error.txt").touch()
    (row,) = hpamdp.report(tmp_path)
    assert (row["seeds"], row["mean"], row["std"], row["unfinished"], row["failed"]) == (1, 4.0, None, 1, 2)
    assert "4 runs, of which 2 failed and 1 unfinished; the table leaves these out" in report_on([tmp_path]).table()


def test_the_table_is_plain_and_aligned_and_says_what_the_figures_are(tmp_path):
    for seed, score in enumerate((1.0, 2.0, 3.0)):
        leave_run(tmp_path / f"a{seed}", seed=seed, scores=(score,))
    leave_run(tmp_path / "b", lr=0.25, scores=(7.0,))
    assert report_on([tmp_path]).table() == (
        "              seeds           score     min     max   steps     CPU time\n"
        "low.lr=0.1        3   2.000 ± 1.000   1.000   3.000     400   1 min 00 s\n"
        "low.lr=0.25       1           7.000                     400   1 min 00 s\n"
        "score: mean ± standard deviation over seeds, without a deviation if there is only one"
    )


def test_from_five_seeds_on_the_mean_has_an_interval(tmp_path):
    for seed in range(5):
        leave_run(tmp_path / str(seed), seed=seed, scores=(float(seed),))
    low, high = hpamdp.report(tmp_path)[0]["interval"]
    assert low == pytest.approx(2.0 - 1.9632, abs=1e-3) and high == pytest.approx(2.0 + 1.9632, abs=1e-3)
    assert hpamdp.report(*(tmp_path / name for name in "0123"))[0]["interval"] is None
    assert f"{low:.3f} to {high:.3f}" in report_on([tmp_path]).table()


def test_another_metric_comes_from_the_summary_or_else_from_the_last_row(tmp_path):
    leave_run(tmp_path / "0")
    assert hpamdp.report(tmp_path, metric="eval/success")[0]["mean"] == 0.5
    assert hpamdp.report(tmp_path, metric="loss")[0]["mean"] == 0.5
    with pytest.raises(ConfigError, match=r"metric=eval/sucess: no such .*did you mean eval/success\?"):
        hpamdp.report(tmp_path, metric="eval/sucess")


def test_a_value_in_the_middle_of_a_run_is_not_the_final_one(tmp_path):
    last = "nan"
    for seed in range(2):
        leave_run(tmp_path / str(seed), seed=seed)
    with (tmp_path / "1/metrics.csv").open("a") as file:
        file.write(f"300,{last},1.0,0.1\n")
    report = report_on([tmp_path], "loss")
    assert [run.value for run in report.configurations[0].runs] == [0.5, None]
    assert f"1 finished without a finite loss, the first in {tmp_path / '1'}" in report.table()
    assert report_on([tmp_path]).configurations[0].values == [2.0, 2.0]
    assert len(report.configurations[0].runs[1].curve) == 4  # the curve still has what was measured


def test_the_mean_of_curves_counts_each_seed_up_to_its_last_point():
    long = np.array([[0.0, 0.0], [10.0, 2.0], [20.0, 4.0]])
    short = np.array([[0.0, 2.0], [10.0, 4.0]])
    frames, means, deviations, counts = mean_curve([long, short])
    assert frames.tolist() == [0.0, 10.0, 20.0] and counts.tolist() == [2, 2, 1]
    assert means.tolist() == [1.0, 3.0, 4.0]
    assert deviations == pytest.approx([np.sqrt(2.0), np.sqrt(2.0), 0.0])


def test_a_report_writes_a_row_for_each_run_and_a_figure_again_and_again(tmp_path):
    leave_run(tmp_path / "runs/9", seed=9, scores=(0.0, 1.0, 2.0, 3.0), summary={"low": "a $\nb"})
    leave_run(tmp_path / "runs/10", seed=10, low='"$x^_ é 中"')
    for _ in range(2):
        hpamdp.report(tmp_path / "runs", to=tmp_path / "deep/to")
    rows = read_table(tmp_path / "deep/to")
    assert [(row["folder"], row["seed"], row["state"], row["eval/score"]) for row in rows] == [
        ("../../runs/9", "9", "finished", "3.0"),
        ("../../runs/10", "10", "finished", "2.0"),
    ]
    assert (tmp_path / "deep/to/report.png").read_bytes().startswith(b"\x89PNG")
    assert sorted(os.listdir(tmp_path / "deep/to")) == ["report.csv", "report.png"]


def test_a_file_that_no_report_wrote_stays_and_nothing_is_written(tmp_path):
    name = "report.png"
    leave_run(tmp_path / "run")
    (tmp_path / name).write_text("mine")
    with pytest.raises(ConfigError, match=f"{name}: no report has written this file"):
        hpamdp.report(tmp_path, to=tmp_path)
    assert sorted(os.listdir(tmp_path)) == sorted(["run", name]) and (tmp_path / name).read_text() == "mine"


def test_damaged_and_hostile_runs_cost_a_line_each(tmp_path, capsys):
    study = tmp_path / "study"
    leave_run(study / "good", seed=0)
    leave_run(study / "again", seed=0)
    leave_run(study / "cut", seed=1)
    (study / "cut/summary.json").write_text('{"score": 1.')
    leave_run(study / "without", seed=2)
    (study / "without/config.yaml").unlink()
    leave_run(study / "nan", seed=5, summary={"score": float("nan"), "references": {"random": []}})
    leave_run(study / "huge", seed=6, summary={"score": 10**400, "references": 3, "cpu_s": "x"})
    leave_run(study / "strange\nname", seed="!!bool x")
    leave_run(study / "circular", seed="&a {b: *a}")
    (study / "gone").symlink_to(tmp_path / "nowhere")
    (study / "good/loop").symlink_to(study)
    leave_run(tmp_path / "above")
    (study / "good/up").symlink_to(tmp_path)
    (study / "foreign").mkdir()
    (study / "foreign/config.yaml").write_text("model: resnet\nseed: 0\n")
    (study / "foreign/summary.json").write_text('{"score": 3.0, "finished": true}')
    leave_run(study / "half", seed=7)
    text = (study / "half/config.yaml").read_text()
    (study / "half/config.yaml").write_text(text[: text.rindex(":") + 2])  # which is still yaml
    (study / "other").mkdir()
    (study / "other/config.yaml").write_text("a: 1\n")
    report = report_on([study])
    lines = capsys.readouterr().err.splitlines()
    assert sorted(line.removeprefix(f"{study}/") for line in lines) == [
        "circular: config.yaml is missing or damaged, left out",
        "cut: summary.json is damaged, left out",
        "foreign: is of another program, left out",
        "gone: is a broken link, left out",
        f"good: has the settings and the seed of {study}/again, left out",
        "half: config.yaml is missing or damaged, left out",
        "strange name: config.yaml is missing or damaged, left out",
        "without: config.yaml is missing or damaged, left out",
    ]
    assert report.rows()[0]["seeds"] == 1
    assert "2 finished without a finite score, the first in " in report.table()
    report.write(tmp_path / "to")


def test_a_run_whose_summary_contradicts_its_config_or_itself_is_left_out(tmp_path, capsys):
    leave_run(tmp_path / "a", seed=1)
    leave_run(tmp_path / "b", seed=2, summary={"seed": 5})
    leave_run(tmp_path / "c", seed=3, summary={"seed": True})
    leave_run(tmp_path / "d", seed=4, summary={"finished": "no"})
    leave_run(tmp_path / "e", seed="null")
    assert [(row["seeds"], row["unfinished"]) for row in hpamdp.report(tmp_path)] == [(1, 0)]
    assert capsys.readouterr().err.splitlines() == [
        f"{tmp_path}/b: config.yaml has seed=2, but summary.json has seed=5, left out",
        f"{tmp_path}/c: config.yaml has seed=3, but summary.json has seed=true, left out",
        f'{tmp_path}/d: summary.json has finished="no", which is neither true nor false, left out',
        f"{tmp_path}/e: config.yaml has seed=null, which is no whole number, left out",
    ]


# The command.


def test_the_command_prints_the_table_and_writes_only_where_it_is_told_to(command, tmp_path):
    leave_run(tmp_path / "runs/0")
    code, out, err = command("report", "runs")
    assert (code, err) == (0, "") and out == report_on([Path("runs")]).table() + "\n"
    assert os.listdir(tmp_path) == ["runs"] and os.listdir(tmp_path / "runs") == ["0"]
    code, out, _ = command("report", "runs/0", "--metric", "eval/success", "--to", "to")
    assert code == 0 and out.endswith("Written: to/report.csv, to/report.png\n")


@pytest.mark.parametrize(
    ("words", "mistake"),
    [
        (["nowhere"], "nowhere: there is no such folder\n"),
        (["run", "--to", "run/config.yaml"], "--to run/config.yaml: "),
        ([], "the following arguments are required: FOLDER; see "),
    ],
)
def test_a_mistake_costs_one_line(command, tmp_path, words, mistake):
    leave_run(tmp_path / "run")
    code, _, err = command("report", *words)
    assert code == 2 and err.startswith(mistake) and err.count("\n") == 1
