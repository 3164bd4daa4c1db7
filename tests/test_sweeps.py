"""Sweeps: what fails loses nothing else, what is finished is not repeated, what was stopped goes on."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest
import yaml
from conftest import CONF, choices

from hpamdp import messages
from hpamdp.config.command_line import completed, parse
from hpamdp.config.compose import read
from hpamdp.config.errors import ConfigError
from hpamdp.config.saved import read_saved
from hpamdp.messages import warn
from hpamdp.run import sweep as run_sweep
from hpamdp.run import train
from hpamdp.run.assemble import choose_selector

TINY = ["num_envs=32", "steps_per_batch=4", "eval.layouts=10", "eval.every=0", "film=false", "low=random"]


def is_installed(package: str) -> bool:
    try:
        return bool(version(package))
    except PackageNotFoundError:
        return False


def needs(package: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(not is_installed(package), reason=f"{package} is not installed")


@pytest.fixture
def jobs(monkeypatch):
    """Replace training by a function that writes what a run does; return what each run was started with."""
    started = []

    def run(cfg, folder, overrides, stopped_at=None, *, may_overwrite=False, tell=warn, **_):
        started.append((cfg.seed, stopped_at))
        (folder / "config.yaml").write_text(choose_selector(read(cfg)).to_yaml())
        if cfg.seed == 1:
            raise ConfigError("these two\ndo not go together")
        if cfg.seed == 2:
            raise ZeroDivisionError("a bug")
        if cfg.seed == 6:
            tell("reward is nan at frame 7: training stopped")
            return messages.DIVERGED
        frames = 5 if cfg.seed == 5 or (cfg.seed == 3 and stopped_at is None) else cfg.total_frames
        (folder / "checkpoint.safetensors").touch()
        score = float(cfg.seed + cfg.checkpoint_every)
        summary = {"score": score, "frames": frames, "finished": cfg.seed == 5 or frames > 5}
        (folder / "summary.json").write_text(json.dumps(summary))
        return 0 if summary["finished"] else 130

    monkeypatch.setattr(train, "run", run)
    return started


def test_a_failing_job_loses_no_other_and_is_named_at_the_end(command, jobs, tmp_path):
    code, out, err = command("-m", "seed=0,1,2,4", "high=fixed", "hydra.sweep.dir=sweep")
    assert code == 1 and [seed for seed, _ in jobs] == [0, 1, 2, 4]
    assert err.splitlines() == [
        "seed=1 high=fixed: these two do not go together (sweep/1)",
        "seed=2 high=fixed: ZeroDivisionError: a bug (sweep/2/error.txt)",
    ]
    assert "Traceback" in (tmp_path / "sweep/2/error.txt").read_text()
    assert out.endswith("4 jobs: 2 finished; 1 refused; 1 failed\n"), "there is no best one of one configuration"
    assert {path.name for path in (tmp_path / "sweep").iterdir()} == {"0", "1", "2", "3", "multirun.yaml", "report.csv"}


def test_each_job_of_a_sweep_over_problems_has_the_usual_learner_of_its_problem(command, jobs, tmp_path):
    code, *_ = command("-m", "env=gymnasium,rddl,platform", "high=none", "hydra.sweep.dir=sweep")
    saved = [read_saved(yaml.safe_load((tmp_path / f"sweep/{number}/config.yaml").read_text())) for number in range(3)]
    assert code == 0 and [each.low.name for each in saved] == ["hppo", "hppo", "hyar"]


def test_the_best_score_is_the_highest_mean_over_seeds(command, jobs):
    _, out, _ = command("-m", "checkpoint_every=3,5,0", "seed=0,4,9", "hydra.sweep.dir=sweep")
    assert out.endswith("9 jobs: 9 finished\nBest score 9.333, the mean over 3 seeds: checkpoint_every=5\n")


def test_a_job_that_diverges_is_named_with_the_reason(command, jobs):
    code, out, err = command("-m", "seed=0,6", "hydra.sweep.dir=sweep")
    assert code == 1
    assert err == "seed=6: reward is nan at frame 7: training stopped (sweep/1)\n"
    assert "Job 1: failed: reward is nan at frame 7: training stopped\n" in out


def test_a_sweep_ends_with_a_table_of_means_over_all_its_seeds_also_of_earlier_starts(command, jobs, tmp_path):
    words = [
        "high=none",
        "env=platform",
        "hydra.sweep.dir=sweep",
        "hydra.sweep.subdir=${hydra:runtime.choices.low}_${low.lr}/${seed}",
    ]
    command("-m", "low=hppo", "low.lr=0.1,0.2", "seed=4", *words)
    code, out, err = command("-m", "low=hppo", "low.lr=0.1,0.2", "seed=4,8,12", *words)
    table = out[out.index("            ") : out.index("6 jobs: ")].splitlines()
    assert (code, err) == (0, "") and [line.split() for line in table[1:3]] == [
        ["low.lr=0.1", "3", "8.000", "±", "4.000", "4.000", "12.000", "200,000"],
        ["low.lr=0.2", "3", "8.000", "±", "4.000", "4.000", "12.000", "200,000"],
    ]
    assert table[-1] == "Written: sweep/report.csv"
    assert (tmp_path / "sweep/report.csv").read_text().count("\n") == 7
    assert table[:-1] == command("report", "sweep")[1].splitlines()
    _, out, _ = command("-m", "low=hppo", "low.lr=0.1", "seed=4", *words)
    assert "3   8.000 ± 4.000" in out, "runs of earlier starts count, too"


def test_a_report_of_the_users_own_stays(command, jobs, tmp_path):
    (tmp_path / "sweep").mkdir()
    (tmp_path / "sweep/report.csv").write_text("mine")
    code, out, err = command("-m", "seed=0,4", "hydra.sweep.dir=sweep")
    assert code == 0 and "score: mean ± standard deviation over seeds\n" in out
    assert err.endswith("sweep/report.csv: no report has written this file, so it stays; move it away\n")
    assert (tmp_path / "sweep/report.csv").read_text() == "mine"


def test_a_sweep_started_again_does_what_is_left(command, jobs, tmp_path):
    words = ["-m", "seed=0,3,4,2", "hydra.sweep.dir=sweep"]
    code, out, _ = command(*words)
    assert "seeds" not in out and not (tmp_path / "sweep/report.csv").exists(), "no table yet"
    assert code == 130 and "To go on: the same command with hydra.sweep.dir=sweep\n" in out
    jobs.clear()
    code, out, err = command(*words)
    assert code == 1 and err.startswith("seed=2: ZeroDivisionError") and err.count("\n") == 1
    assert [seed for seed, _ in jobs] == [3, 4, 2]
    assert [file and file.parts[-2:] for _, file in jobs] == [("1", "checkpoint.safetensors"), None, None]
    assert "Job 0: skipped, finished before\n" in out and "Job 1: resumed and finished\n" in out
    jobs.clear()
    assert command(*words[:1], "seed=0,3,4", words[2])[0] == 0 and not jobs


def test_a_sweep_over_experiments_of_one_study_lies_in_its_folder_and_is_told_at_the_end(command, jobs, tmp_path):
    words = ["-m", "experiment=domains/moving,domains/sliding", "low=random", "seed=4"]
    code, out, err = command(*words)
    assert (code, err) == (0, "") and [seed for seed, _ in jobs] == [4, 4]
    best = f"{words[1].partition(',')[0]} low=random seed=4 (multirun/domains/moving_random_4)"
    assert out.endswith(f"2 jobs: 2 finished\nBest score 4.000: {best}\n")
    assert [path.name for path in (tmp_path / "multirun").iterdir()] == ["domains"]
    jobs.clear()
    assert command(*words)[0] == 0 and not jobs


def test_a_folder_of_experiments_stands_for_a_sweep_over_all_in_it():
    line = completed(parse(["--multirun", "experiment=domains", "seed=0,4"], CONF), CONF)
    experiments, seeds = line.words[-2:]
    assert line.is_multirun and seeds == "seed=0,4" and experiments.count(",") == len(choices("experiment/domains")) - 1


def test_a_glob_stands_for_a_sweep_over_the_choices_that_match(command, jobs, tmp_path):
    (tmp_path / "mine/low").mkdir(parents=True)
    (tmp_path / "mine/low/hmine.yaml").write_text((CONF / "low/hppo.yaml").read_text())
    line = completed(parse(["-m", "--config-dir", str(tmp_path / "mine"), "low=glob([hm*,h*o],exclude=x)"], CONF), CONF)
    assert line.words[-1] == "low=hmine,hppo"
    code, out, err = command("-m", "low=glob(random)", "high=glob([uniform,fixed])")
    assert (code, err) == (0, "") and "Job 1: low=random high=uniform\n" in out and len(jobs) == 2


def test_a_sweep_over_experiments_with_folders_of_their_own_is_refused_until_one_is_given(command, jobs, tmp_path):
    words = ["-m", "experiment=few_steps,domains/moving", "low=random"]
    code, _, err = command(*words)
    assert code == 2 and not jobs and not list(tmp_path.iterdir())
    assert err == (
        "experiment=few_steps,domains/moving: their sweeps have different folders, multirun/few_steps and "
        "multirun/domains; set hydra.sweep.dir\n"
    )
    assert command(*words, "hydra.sweep.dir=mine")[0] == 0 and len(jobs) == 2
    assert "add --multirun" in command(*words[1:])[2]


def test_a_run_that_ended_early_is_finished_and_one_that_was_stopped_is_not(command, jobs):
    words = ["-m", "seed=5,3", "eval.stop_score=3", "hydra.sweep.dir=sweep"]
    command(*words)
    code, out, _ = command(*words)
    assert code == 0 and [seed for seed, _ in jobs] == [5, 3, 3]
    assert "Job 0: skipped, finished before\n" in out and "Job 1: resumed and finished\n" in out


def test_the_results_of_another_config_stay_as_they_are(command, jobs, tmp_path):
    command("-m", "seed=4", "hydra.sweep.dir=sweep")
    before = {file: file.read_bytes() for file in (tmp_path / "sweep/0").iterdir()}
    code, _, err = command("-m", "seed=5,7", "eval.layouts=7", "hydra.sweep.dir=sweep")
    assert code == 2 and [seed for seed, _ in jobs] == [4, 7]
    assert err.startswith(
        "seed=5 eval.layouts=7: its folder has the results of another config, with seed=4 for 5 and 1 "
    )
    assert err.count("\n") == 1
    assert {file: file.read_bytes() for file in (tmp_path / "sweep/0").iterdir()} == before


def test_with_overwrite_a_job_replaces_only_the_results_of_another_config(command, jobs):
    command("-m", "seed=4,0", "hydra.sweep.dir=sweep")
    assert command("-m", "seed=7,0", "overwrite=true", "hydra.sweep.dir=sweep")[0] == 0
    assert jobs == [(4, None), (0, None), (7, None)]


def test_a_sweep_that_breaks_off_tells_the_jobs_it_leaves(command, jobs, monkeypatch):
    write = run_sweep.write_job

    def break_off(job, records):
        if job.number == 1:
            raise BrokenPipeError("a worker died")
        write(job, records)

    monkeypatch.setattr(run_sweep, "write_job", break_off)
    code, out, err = command("-m", "seed=0,4", "hydra.sweep.dir=sweep")
    assert code == 1 and "The sweep broke off: BrokenPipeError: a worker died (sweep/error.txt)\n" in err
    assert "1 job: 1 finished\n" in out and "hydra.sweep.dir=sweep" in out


def sweep(folder: Path, *words: str) -> subprocess.Popen[str]:
    # Ray gives its workers niceness 15, with which they hardly move beside anything else on the machine.
    environment = os.environ | {"PYTHONPATH": str(CONF.parent), "OMP_NUM_THREADS": "1", "RAY_worker_niceness": "0"}
    words = (str(CONF.parent / "run.py"), "-m", *TINY, *words, "hydra.sweep.dir=sweep")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen([sys.executable, *words], cwd=folder, env=environment, **pipes)


def kill_once_there(process: subprocess.Popen[str], file: Path) -> None:
    deadline = time.monotonic() + 120
    while not file.exists():
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.02)
    process.send_signal(signal.SIGKILL)
    process.communicate()


def frames_of(folder: Path) -> list[float]:
    with (folder / "metrics.csv").open() as file:
        return [float(row["frames"]) for row in csv.DictReader(file)]


# Seed -1 is refused; the log rows tell a run that went on from one that began anew.
STUDY = ["high=uniform,fixed", "seed=0,-1,1", "total_frames=16384", "checkpoint_every=1024", "log_every=1024"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "launcher",
    [
        [],
        pytest.param(["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"], marks=needs("hydra-joblib-launcher")),
        pytest.param(["hydra/launcher=submitit_local"], marks=needs("hydra-submitit-launcher")),
        pytest.param(
            ["hydra/launcher=ray", "+hydra.launcher.ray.init.include_dashboard=false"],
            marks=needs("hydra-ray-launcher"),
        ),
    ],
    ids=["basic", "joblib", "submitit", "ray"],
)
def test_a_killed_sweep_is_finished_by_the_same_command(tmp_path, launcher):
    jobs = tmp_path / "sweep"
    kill_once_there(sweep(tmp_path, *STUDY, *launcher), jobs / "2/checkpoint.safetensors")
    second = sweep(tmp_path, *STUDY, *launcher)
    out, err = second.communicate(timeout=300)
    assert second.returncode == 2, err
    failed = [line for line in err.splitlines() if "(sweep/" in line]
    assert [" seed=-1: " in line for line in failed] == [True, True]
    # submitit's jobs, as on a cluster, outlive the process that submitted them.
    assert "resumed and finished" in out or "submitit" in str(launcher)
    assert "2 refused" in out
    for job in (0, 2, 3, 5):
        assert frames_of(jobs / str(job)) == [float(n) for n in range(0, 16385, 1024)]
        assert json.loads((jobs / f"{job}/summary.json").read_text())["frames"] == 16384
    assert not (jobs / "1").exists() and not (jobs / "4").exists()
    finished = {job: (jobs / f"{job}/summary.json").stat().st_mtime_ns for job in (0, 2, 3, 5)}
    third = sweep(tmp_path, *STUDY, *launcher)
    out, _ = third.communicate(timeout=300)
    assert "6 jobs: 4 skipped, finished before; 2 refused\n" in out and third.returncode == 2
    assert finished == {job: (jobs / f"{job}/summary.json").stat().st_mtime_ns for job in (0, 2, 3, 5)}


@pytest.mark.slow
@needs("hydra-submitit-launcher")
def test_a_job_of_submitit_that_is_preempted_is_requeued_and_goes_on(tmp_path):
    words = ["high=uniform", "seed=0", "total_frames=131072", "log_every=2048", "hydra/launcher=submitit_local"]
    process = sweep(tmp_path, *words)
    metrics = tmp_path / "sweep/0/metrics.csv"
    deadline = time.monotonic() + 120
    while not metrics.exists() or metrics.read_text().count("\n") < 4:
        assert process.poll() is None and time.monotonic() < deadline, process.communicate()
        time.sleep(0.02)
    listed = subprocess.run(["ps", "-ewwo", "pid=,args="], capture_output=True, text=True).stdout.splitlines()
    (job,) = [line.split()[0] for line in listed if "submitit.core._submit" in line and str(tmp_path) in line]
    os.kill(int(job), signal.SIGUSR2)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert "1 job: 1 resumed and finished\n" in out
    assert frames_of(tmp_path / "sweep/0") == [float(n) for n in range(0, 131073, 2048)]


@pytest.mark.parametrize(
    ("word", "package", "extra"),
    [
        ("hydra/launcher=joblib", "hydra-joblib-launcher", "joblib"),
        ("hydra/launcher=submitit_slurm", "hydra-submitit-launcher", "slurm"),
    ],
)
def test_a_missing_launcher_is_told_with_its_extra(command, word, package, extra):
    if is_installed(package):
        pytest.skip(f"{package} is installed")
    code, _, err = command("-m", word, "seed=0,1")
    assert code == 2 and err.count("\n") == 1
    assert err.endswith(f"not installed; pip install 'hpamdp[{extra}]'\n")
