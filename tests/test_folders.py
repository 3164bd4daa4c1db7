"""A folder holds one run, whatever came before in it and whatever its logger does."""

import json
import math
import signal
import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
import wandb
from conftest import compose_config, make_config, signal_after
from test_metrics import without_login  # noqa: F401  (a fixture)

from hpamdp.config.errors import ConfigError
from hpamdp.metrics_file import read_rows
from hpamdp.run import checkpoint
from hpamdp.run.folder import locked, moved_aside
from hpamdp.run.loggers import TensorboardLogger, WandbLogger
from hpamdp.run.recorder import Recorder
from hpamdp.run.resume import rest_of
from hpamdp.run.train import run
from hpamdp.run.trainer import Trainer
from hpamdp.run_files import CONFIG_NAME, SUMMARY_NAME, differing_settings, flat_settings

TINY = ["num_envs=8", "steps_per_batch=4", "total_frames=128", "log_every=32", "eval.layouts=4", "eval.every=0"]
TINY += ["env=catch_point", "env.max_steps=5", "high=none", "low=random"]


def start(folder: Path, *words: str) -> int:
    return run(compose_config([*TINY, *words]), folder, [*words])


def resume(source: Path, folder: Path, *words: str) -> int:
    given = [f"resume={source}", *words]
    return run(compose_config(given), folder, given)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def kill_at(monkeypatch: pytest.MonkeyPatch, frames: int) -> None:
    """Have the next run end at this many frames as if it had been killed: it saves nothing."""
    log = Recorder.log

    def killed(self, now, *given, **kept):
        if now >= frames:
            raise SystemError("killed")
        return log(self, now, *given, **kept)

    monkeypatch.setattr(Recorder, "log", killed)
    monkeypatch.setattr(Trainer, "_save_and_close", lambda self, collection: collection.close())


def start_and_kill(folder: Path, frames: int, *words: str) -> None:
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemError):
        kill_at(patch, frames)
        start(folder, *words)


def test_a_run_that_overwrites_another_and_is_killed_leaves_nothing_of_the_other(tmp_path):
    start(tmp_path, "logger=tensorboard")
    for name in ("notes.txt", "own.png", "learning_curves.png", "choices.png"):
        (tmp_path / name).write_text("")
    (tmp_path / ".figures").write_text("learning_curves.png\nchoices.png\n../outside.png\n")
    start_and_kill(tmp_path, 32, "seed=7", "overwrite=true")
    assert {path.name for path in tmp_path.iterdir()} == {"notes.txt", "own.png", "config.yaml", "metrics.csv"}
    assert "seed: 7" in (tmp_path / CONFIG_NAME).read_text()
    assert start(tmp_path, "seed=8", "logger=tensorboard") == 0, "nothing is left that would have to be overwritten"


def test_a_run_that_is_refused_destroys_nothing(tmp_path, monkeypatch, without_login):  # noqa: F811
    start(tmp_path / "run")
    before = contents(tmp_path / "run")
    refused = [["low=pdqn", "low.batch_size=0"], ["high=ucb"], ["seed=1", "resume=nowhere"], ["logger=wandb"]]
    monkeypatch.setenv("WANDB_MODE", "sometimes")  # which is found last, when the logger starts
    for words in refused:
        with pytest.raises(ConfigError):
            start(tmp_path / "run", "overwrite=true", *words)
        assert contents(tmp_path / "run") == before, words
    for word in (f"resume={tmp_path / 'run'}", "total_frames=256"), (f"resume={tmp_path / 'run'}", "total_frames=64"):
        with pytest.raises(ConfigError):
            run(compose_config([*word, "logger=wandb"]), tmp_path / "run", [*word, "logger=wandb"])
        assert contents(tmp_path / "run") == before


def test_a_move_that_fails_halfway_brings_the_earlier_run_back(tmp_path, monkeypatch):
    for name in ("summary.json", "checkpoint.safetensors", "config.yaml", "metrics.csv"):
        (tmp_path / name).write_text(name)
    before, rename = contents(tmp_path), Path.rename

    def full(self, target):
        if self.name == "metrics.csv":
            raise OSError("no space left")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", full)
    with pytest.raises(OSError, match="no space"), moved_aside(tmp_path):
        pass
    assert contents(tmp_path) == before


def test_a_folder_that_a_list_of_figures_names_is_never_deleted(tmp_path):
    (tmp_path / "run" / "thesis").mkdir(parents=True)
    (tmp_path / "run" / "metrics.csv").write_text("frames\n")
    (tmp_path / "run" / ".figures").write_text("thesis\n..\nlearning_curves.png\n")
    with moved_aside(tmp_path / "run"):
        pass
    assert [*(tmp_path / "run").iterdir()] == [tmp_path / "run" / "thesis"]


def test_folders_of_loggers_that_a_run_did_not_have_and_a_users_own_lock_are_never_deleted(tmp_path):
    start(tmp_path / "run")
    own = [".lock", ".replaced/notes.txt", "wandb/run-1/files/model.pt", "tensorboard/events"]
    for name in own:
        (tmp_path / "run" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "run" / name).write_text("mine")
    with pytest.raises(OSError, match="full"), locked(tmp_path / "run"), moved_aside(tmp_path / "run"):
        (tmp_path / "run" / CONFIG_NAME).write_text("choices: {logger: wandb}\n")
        raise OSError("full")
    with locked(tmp_path / "run"):
        start(tmp_path / "run", "overwrite=true")
    assert [(tmp_path / "run" / name).read_text() for name in own] == ["mine"] * len(own)


def test_a_resumed_run_of_wandb_removes_its_own_earlier_folder_alone(tmp_path):
    ids = ["1_000000-one", "1_000000-[a-z]*", "2_000000-[a-z]*"]
    names = [f"offline-run-2026010{each}" for each in ids]
    for name in names:
        (tmp_path / "wandb" / name / "files").mkdir(parents=True)
    logger = WandbLogger.__new__(WandbLogger)
    logger._run = SimpleNamespace(offline=True, id="[a-z]*", dir=str(tmp_path / "wandb" / names[2] / "files"))
    logger.log = lambda row, step: None
    logger._take_over([{"frames": 8.0}], tmp_path)
    assert sorted(each.name for each in (tmp_path / "wandb").iterdir()) == sorted([names[0], names[2]])


@pytest.mark.parametrize(
    "own",
    [
        {"best.safetensors": "my networks", "trajectories.png": "", "learning_curves.png": ""},
        {"learning_curves.png": "my drawing"},
        {CONFIG_NAME: "title: my site\n"},
        {"summary.json": '{"of": "my thesis"}'},
    ],
)
def test_a_file_of_a_users_own_with_the_name_of_a_result_is_never_deleted(own, tmp_path):
    for name, text in own.items():
        (tmp_path / name).write_text(text)
    before = contents(tmp_path)
    first = next(iter(own))
    for word in ("overwrite=false", "overwrite=true"):
        with pytest.raises(ConfigError, match=rf"holds {first}.*, which no run has written and a run would replace"):
            start(tmp_path, word)
        assert contents(tmp_path) == before


def test_a_resumed_run_in_the_folder_of_another_replaces_it_as_a_whole(tmp_path):
    start(tmp_path / "a")
    start(tmp_path / "b", "seed=3", "logger=tensorboard")
    with pytest.raises(ConfigError, match="holds the results of a run"):
        resume(tmp_path / "a", tmp_path / "b", "total_frames=256")
    assert resume(tmp_path / "a", tmp_path / "b", "total_frames=256", "overwrite=true") == 0
    assert "seed: 0" in (tmp_path / "b" / CONFIG_NAME).read_text() and not (tmp_path / "b/tensorboard").exists()


def test_a_finished_run_that_goes_on_and_is_killed_is_no_longer_finished(tmp_path, monkeypatch):
    start(tmp_path)
    with monkeypatch.context() as patch, pytest.raises(SystemError):
        kill_at(patch, 200)
        resume(tmp_path, tmp_path, "total_frames=256")
    assert not json.loads((tmp_path / "summary.json").read_text())["finished"]
    assert resume(tmp_path, tmp_path, "total_frames=256") == 0
    assert json.loads((tmp_path / "summary.json").read_text())["finished"]


@pytest.mark.parametrize(("text", "kept"), [("", []), ("frames,wall_s\n0,0.1\n3", [0.0])], ids=["empty", "cut"])
def test_a_resumed_run_goes_on_with_the_rows_that_are_left_of_its_metrics(text, kept, tmp_path):
    start_and_kill(tmp_path, 128, "checkpoint_every=96")
    (tmp_path / "metrics.csv").write_text(text)
    assert resume(tmp_path, tmp_path, "total_frames=128") == 0
    assert [row["frames"] for row in read_rows(tmp_path / "metrics.csv")] == [*kept, 128.0]


def test_an_evaluation_never_touches_the_record_of_a_run(tmp_path, command, capsys):
    start(tmp_path / "run")
    start_and_kill(tmp_path / "killed", 64)
    capsys.readouterr()
    before = contents(tmp_path)
    for folder in ("run", "killed"):
        code, _, err = command("mode=eval", "checkpoint=run", f"hydra.run.dir={folder}", "overwrite=true")
        assert code == 2 and err.count("\n") == 1 and "an evaluation never changes" in err
    words = ["mode=eval", "checkpoint=run", "overwrite=true", "hydra.sweep.dir=.", "hydra.sweep.subdir=killed"]
    code, _, err = command("-m", *words)
    assert code == 2 and err.count("\n") == 1
    after = contents(tmp_path)
    assert {name: after[name] for name in before} == before and {*after} - {*before} <= {"multirun.yaml", "report.csv"}


def test_a_run_is_not_resumed_where_another_process_is_at_work(tmp_path, command):
    start(tmp_path / "run")
    with locked(tmp_path / "run"):
        code, _, err = command("resume=run", "hydra.run.dir=run", "total_frames=256")
    assert code == 2 and "another process is at work" in err
    assert "128" in json.dumps(json.loads((tmp_path / "run/summary.json").read_text())["frames"])


def curves(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return what TensorBoard shows, without times."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder / "tensorboard"), size_guidance={"scalars": 0}).Reload()
    return {
        tag: [(event.step, event.value) for event in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
        if tag not in ("wall_s", "cpu_s")
    }


def wandb_curves(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """Return what `wandb sync` would send of the folder's offline runs, by their ids; the steps in order."""
    found: dict[str, list] = {}
    for file in sorted((folder / "wandb").glob("offline-run-*/run-*.wandb")):
        rows = found.setdefault(file.stem.removeprefix("run-"), [])
        for record in wandb_records(file):
            if record.HasField("history"):
                values = {item.nested_key[0] or item.key: json.loads(item.value_json) for item in record.history.item}
                rows.append((record.history.step.num, values.get("eval/score"), values.get("frames")))
    return found


def wandb_records(file: Path) -> Iterator:
    """Return the records of an offline run: a log in LevelDB's format, after a header of 7 bytes."""
    from wandb.proto import wandb_internal_pb2

    data, place, whole, block = file.read_bytes(), 7, b"", 32768
    while place + 7 <= len(data):
        if block - place % block < 7:
            place += block - place % block
            continue
        _, length, kind = struct.unpack("<IHB", data[place : place + 7])
        piece = data[place + 7 : place + 7 + length]
        place += 7 + length
        whole = piece if kind in (1, 2) else whole + piece
        if kind in (1, 4):
            record = wandb_internal_pb2.Record()
            record.ParseFromString(whole)
            yield record


def test_tensorboard_shows_a_resumed_run_as_the_one_that_was_never_stopped(tmp_path):
    words = ["logger=tensorboard", "total_frames=256", "checkpoint_every=96"]
    start(tmp_path / "whole", *words)
    start_and_kill(tmp_path / "killed", 192, *words)
    (tmp_path / "killed").rename(tmp_path / "moved")
    whole = curves(tmp_path / "whole")
    assert len(whole["frames"]) == 9
    for folder in (tmp_path / "elsewhere", tmp_path / "moved"):
        assert resume(tmp_path / "moved", folder) == 0
        assert curves(folder) == whole and len(list((folder / "tensorboard").iterdir())) == 1


def test_wandb_has_a_resumed_run_as_one_run_with_the_curve_of_the_one_never_stopped(
    tmp_path,
    without_login,  # noqa: F811
):
    words = ["logger=wandb", "logger.mode=offline", "total_frames=256", "checkpoint_every=96"]
    start(tmp_path / "whole", *words)
    start_and_kill(tmp_path / "killed", 192, *words)
    wandb.teardown()  # as at the end of a process
    (run_id,) = wandb_curves(tmp_path / "killed")
    for folder in (tmp_path / "elsewhere", tmp_path / "killed"):
        assert resume(tmp_path / "killed", folder) == 0
        wandb.teardown()  # waits until all is written
        (whole,) = wandb_curves(tmp_path / "whole").values()
        assert wandb_curves(folder) == {run_id: whole} and len(whole) >= 9


@pytest.mark.parametrize("where", ["__init__", "log", "close"])
def test_a_logger_that_fails_is_switched_off_with_one_warning(where, tmp_path, monkeypatch, capsys):
    def broken(*_, **__):
        raise BrokenPipeError("the other end\nis gone")

    monkeypatch.setattr(TensorboardLogger, where, broken)
    assert start(tmp_path, "logger=tensorboard") == 0
    warning = (
        "logger=tensorboard: BrokenPipeError: the other end; the run continues without this logger, and metrics.csv"
    )
    assert capsys.readouterr().err.count(warning) == 1
    assert len((tmp_path / "metrics.csv").read_text().splitlines()) == 6


@pytest.mark.parametrize(
    ("words", "difference"),
    [
        (["low=hppo", "total_frames=1000"], "with total_frames=900 for 1000 and "),
        (["low=hppo", "total_frames=900", "low.lr=0.5"], "with low.lr=0.001 for 0.5;"),
        (["low=pdqn", "total_frames=1000"], 'with low="hppo" for "pdqn" and '),
    ],
)
def test_a_run_of_another_config_is_refused_by_the_setting_that_others_follow(words, difference, tmp_path):
    (tmp_path / CONFIG_NAME).write_text(make_config(["low=hppo", "total_frames=900"]).to_yaml())
    (tmp_path / SUMMARY_NAME).write_text("{}")
    with pytest.raises(ConfigError) as raised:
        rest_of(make_config(words), tmp_path)
    assert difference in str(raised.value)


def test_the_same_command_after_a_requeue_goes_on_with_its_run(tmp_path, command, capsys):
    words = [*TINY, "film=false", "checkpoint_every=96", "hydra.run.dir=run", "resume=auto"]
    with pytest.MonkeyPatch.context() as patch, pytest.raises(SystemError):
        kill_at(patch, 128)
        command(*words)
    assert checkpoint.progress_of(tmp_path / "run/checkpoint.safetensors")["frames"] == 96
    code, out, _ = command(*words)
    assert code == 0 and "Going on from" in out
    start(tmp_path / "whole", "checkpoint_every=96")
    rows, whole = (read_rows(tmp_path / name / "metrics.csv") for name in ("run", "whole"))
    times = {"wall_s": 0, "cpu_s": 0}
    assert [row | times for row in rows] == [row | times for row in whole]
    before = contents(tmp_path / "run")
    capsys.readouterr()
    code, out, err = command(*words, "film=true", "checkpoint_minutes=1")  # bookkeeping
    assert (code, err) == (0, "") and "run: this run is finished, with score " in out
    assert contents(tmp_path / "run") == before
    code, _, err = command(*words, "seed=4")
    assert code == 2 and err.count("\n") == 1
    assert err.startswith("resume=auto: ") and "has the results of another config, with seed=0 for 4;" in err
    assert contents(tmp_path / "run") == before
    assert command(*words, "seed=4", "overwrite=true")[0] == 0
    assert "seed: 4" in (tmp_path / "run/config.yaml").read_text()


@pytest.mark.parametrize(
    ("env", "saved", "names"),
    [
        ({"kwargs": {"a": 1}}, {"kwargs": {"a": True}}, ["env.kwargs.a"]),
        ({"kwargs": {"a": {}}}, {"kwargs": {}}, ["env.kwargs.a"]),
        ({"kwargs": {"a": {}}}, {"kwargs": {"a": {"b": None}}}, ["env.kwargs.a", "env.kwargs.a.b"]),
        ({"kwargs": {"a": 1, "b": 2}}, {"kwargs": {"b": 2, "a": 1.0}}, []),
        ({"kwargs": {"a": [math.nan]}}, {"kwargs": {"a": [math.nan]}}, []),
        ({"id": "Toy-v0", "new": None, "kwargs": {}}, {"id": "Toy-v0"}, []),
        ({"noise": 1.0}, {"noise": 1.0, "compile_rules": True}, []),
    ],
)
def test_other_values_of_an_environments_own_arguments_make_another_run(env, saved, names):
    here, there = flat_settings({"env": env}), flat_settings({"env": saved})
    assert sorted(differing_settings(here, there)) == sorted(differing_settings(there, here)) == names


def test_a_job_that_was_finished_by_hand_counts_as_finished_in_its_sweep(tmp_path, command):
    words = ["-m", *TINY, "film=false", "checkpoint_every=96", "seed=0", "hydra.sweep.dir=sweep"]
    with pytest.MonkeyPatch.context() as patch:
        kill_at(patch, 128)
        assert command(*words)[0] == 1
    assert command("resume=sweep/0", "hydra.run.dir=sweep/0", "film=false")[0] == 0
    code, out, _ = command(*words)
    assert code == 0 and "1 job: 1 skipped, finished before\n" in out


def test_a_job_that_a_signal_stops_is_saved_before_its_launcher_gets_the_signal(tmp_path, command, monkeypatch):
    """As submitit does, whose handler requeues the job and exits."""
    found = []

    def requeue(number, frame):
        found.append(checkpoint.progress_of(tmp_path / "sweep/0/checkpoint.safetensors")["frames"])
        raise SystemExit(7)

    before = signal.signal(signal.SIGUSR2, requeue)
    words = ["-m", *TINY, "film=false", "seed=0", "hydra.sweep.dir=sweep"]
    try:
        with signal_after(2, signal.SIGUSR2):
            assert command(*words)[0] == 130
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert found == [64]
    code, out, _ = command(*words)
    assert code == 0 and "1 job: 1 resumed and finished\n" in out
