"""A resumed run is the run that was never stopped, to the last bit."""

import itertools
import json
import shutil
import signal
from pathlib import Path

import pytest
import torch
from conftest import TRAINED, assert_same, compose_config, forked, parts_of, rows_of, signal_after
from test_grid import SHORT, SHORT_SELECTORS
from tqdm import tqdm

import hpamdp
from hpamdp.children import STOP_SIGNALS
from hpamdp.run import checkpoint
from hpamdp.run.evaluate import Evaluation
from hpamdp.run.train import run

SMALL = ["num_envs=8", "steps_per_batch=4", "total_frames=320", "eval.layouts=2", "eval.every=0", "log_every=64"]
# Before the stop and after it; evaluations take longer than the training. What resumes in one way alone goes without.
EVALUATED = "eval.every=160"
STOPPED_AFTER = 7  # batches, in the middle of a log interval
SELECTORS = ("ucb", "linucb", "meta_critic", "actor", "exp3")


def rows_without_times(folder: Path) -> list[dict[str, str]]:
    return [row | {"wall_s": "", "cpu_s": ""} for row in rows_of(folder)]


def parts_of_run(folder: Path) -> dict:
    parts = parts_of(folder / checkpoint.FILE_NAME)
    del parts["progress"]  # which has wall times
    return parts


class Far(hpamdp.Callback):
    """Lets a run begin shortly before the largest int32 of steps and of episodes, and copies its folder in between."""

    def on_start(self, trainer) -> None:
        env = trainer.parts.env.base_env
        if trainer.resumed_from is None:
            trainer.frames = 2**31 - 96
            env.state = env.state._replace(episode=torch.full((8,), 2**31 - 3, dtype=torch.int32))

    def on_batch(self, trainer) -> None:
        if trainer.frames == 2**31 and trainer.resumed_from is None:
            shutil.copytree(trainer.output_dir, trainer.output_dir.with_name("copy"))


def stop_and_resume(given: list[str], tmp_path: Path, *numbers: int, on_resuming: tuple[str, ...] = ()) -> None:
    """Run once as a whole, and for each signal once with a resumption after it; assert that all are the same."""
    assert run(compose_config(given), tmp_path / "whole", given) == 0
    whole = parts_of_run(tmp_path / "whole")
    for number in numbers:
        stopped, resumed = tmp_path / f"stopped-{number}", tmp_path / f"resumed-{number}"
        with signal_after(STOPPED_AFTER, number):
            stop = kill if number == signal.SIGKILL else interrupt
            stop(given, stopped)
        words = [f"resume={stopped}", *on_resuming]
        torch.manual_seed(1234)  # nothing of another process's generators may matter
        assert run(compose_config(words), resumed, words) == 0
        assert rows_without_times(resumed) == rows_without_times(tmp_path / "whole")
        parts = parts_of_run(resumed)
        for rng in (whole["rng"], parts["rng"]):
            rng.pop("python", None), rng.pop("numpy", None)  # which no part of a run uses
        assert_same(parts, whole)


def test_the_bar_of_a_resumed_run_shows_the_last_evaluation_as_that_of_the_stopped_run(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(tqdm, "set_postfix_str", lambda bar, text, refresh: shown.append(text))
    given = {"low": "random", "film": False, "num_envs": 8, "eval.layouts": 2, "steps_per_batch": 4, "eval.every": 0}
    hpamdp.train("platform", folder=tmp_path / "run", total_frames=64, **given)
    last = shown[-1].partition("score")[2]
    shown.clear()
    hpamdp.train(resume=tmp_path / "run", total_frames=128)
    assert last.endswith(" at 64 steps") and shown[0].endswith(f"score{last}")


def interrupt(given: list[str], folder: Path) -> None:
    assert run(compose_config(given), folder, given) == 130


def kill(given: list[str], folder: Path) -> None:
    """Run in a process of its own that is killed; what it saved last is some batches old."""
    words = [*given, "checkpoint_every=128"]
    assert forked(run, compose_config(words), folder, words) == -signal.SIGKILL


def words_of(high: str, low: str) -> list[str]:
    return [f"high={high}", f"low={low}", *SHORT.get(low, []), *SHORT_SELECTORS.get(high, []), *SMALL]


# `test_every_pair_resumes_to_the_last_bit` has the others.
@pytest.mark.parametrize(("high", "low"), [("meta_critic", "random"), ("ucb", "hppo")])
def test_a_resumed_run_is_the_run_that_was_never_stopped(high, low, tmp_path):
    stop_and_resume([*words_of(high, low), EVALUATED], tmp_path, signal.SIGINT)


def test_a_run_cut_in_its_first_evaluation_makes_those_of_the_whole_run(tmp_path, monkeypatch, capsys):
    given = ["env=platform", "high=none", "low=random", *SMALL, "eval.every=auto", "total_frames=1280", "log_every=0"]
    assert run(compose_config(given), tmp_path / "whole", given) == 0

    def cut(*_):
        monkeypatch.undo()
        raise KeyboardInterrupt

    monkeypatch.setattr(Evaluation, "run_agent", cut)  # after random play
    interrupt(given, tmp_path / "cut")
    words = [f"resume={tmp_path / 'cut'}"]
    assert run(compose_config(words), tmp_path / "resumed", words) == 0
    assert "damaged" not in capsys.readouterr().err  # the cut run has no rows
    assert rows_without_times(tmp_path / "resumed") == rows_without_times(tmp_path / "whole")
    words = [f"resume={tmp_path / 'resumed'}", "eval.seed=9", "total_frames=1312"]
    assert run(compose_config(words), tmp_path / "other", words) == 0
    random = [json.loads((tmp_path / name / "summary.json").read_text())["references"] for name in ("resumed", "other")]
    assert random[0] != random[1]


def test_a_run_of_the_selector_alone_resumes_to_the_last_bit(tmp_path):
    stop_and_resume([*words_of("linucb", "random"), "low.freeze=true"], tmp_path, signal.SIGINT)


@pytest.mark.slow
def test_every_signal_that_stops_a_run_saves_it(tmp_path):
    stop_and_resume([*words_of("ucb", "random"), EVALUATED], tmp_path, *STOP_SIGNALS)


@pytest.mark.slow
@pytest.mark.parametrize(("high", "low"), list(itertools.product(SELECTORS, TRAINED)))
def test_every_pair_resumes_to_the_last_bit(high, low, tmp_path):
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
    stop_and_resume([*words_of(high, low), EVALUATED], tmp_path, *numbers)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("low", ["hppo", "pdqn", "hsac", "hyar", "paddpg", "iql", "td3_bc", "dlpa", "pets"])
def test_a_run_with_compiled_updates_resumes_to_the_last_bit(low, tmp_path, monkeypatch):
    in_this_process = torch.compile

    def compile_afresh(*args, **kwargs):
        torch.compiler.reset()  # as in another process
        return in_this_process(*args, **kwargs)

    monkeypatch.setattr(torch, "compile", compile_afresh)
    stop_and_resume([*words_of("ucb", low), "compile_updates=true"], tmp_path, signal.SIGINT)


def test_a_killed_run_resumes_from_its_last_checkpoint_to_the_last_bit(tmp_path):
    stop_and_resume(words_of("ucb", "pdqn"), tmp_path, signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.parametrize("low", TRAINED)
def test_a_run_with_worker_processes_resumes_to_the_last_bit(low, tmp_path):
    stop_and_resume([*words_of("ucb", low), "collector=multi"], tmp_path, signal.SIGTERM)


@pytest.mark.slow
@pytest.mark.parametrize("high", SELECTORS)
def test_a_killed_run_with_worker_processes_resumes_to_the_last_bit(high, tmp_path):
    stop_and_resume([*words_of(high, "hppo"), "collector=multi"], tmp_path, signal.SIGKILL)


@pytest.mark.parametrize("collector", ["single", pytest.param("multi", marks=pytest.mark.slow)])
def test_options_that_end_with_the_last_batch_before_a_stop_are_learned_from(collector, tmp_path):
    given = [
        *words_of("meta_critic", "random"),
        "agent.termination=learned",
        "env.switch_cost=0.2",
        f"collector={collector}",
    ]
    given[given.index("steps_per_batch=4")] = "steps_per_batch=1"
    given[given.index("total_frames=320")] = "total_frames=96"
    stop_and_resume(given, tmp_path, signal.SIGTERM)


@pytest.mark.parametrize("env", [pytest.param("platform", marks=pytest.mark.slow), "boatdock_released"])
def test_other_problems_resume_to_the_last_bit(env, tmp_path):
    given = [*words_of("none", "pdqn"), f"env={env}", "env.max_steps=12"]
    stop_and_resume(given, tmp_path, signal.SIGTERM)


@pytest.mark.parametrize(
    ("low", "collector"), [("iql", "single"), pytest.param("hppo", "multi", marks=pytest.mark.slow)]
)
def test_several_components_resume_to_the_last_bit(low, collector, tmp_path, monkeypatch):
    """Of an environment whose new episodes are all the same, as a Gymnasium environment's state is not saved."""
    monkeypatch.syspath_prepend(Path(__file__).resolve().parents[1] / "examples" / "spaces")
    given = [*words_of("none", low), "low.autoregressive=true", "env=gymnasium", "env.entry_point=shop:Tour"]
    given += ["env.max_steps=1", "env.pair_mask=info", f"collector={collector}"]
    stop_and_resume(given, tmp_path, signal.SIGTERM, on_resuming=("trust=true",))


def test_a_run_goes_on_past_the_largest_int32_of_steps_and_episodes_and_resumes_there(tmp_path):
    sizes = {"num_envs": 8, "steps_per_batch": 4, "max_steps": 2, "total_frames": 2**31 + 64, "eval.layouts": 2}
    every = {"eval.every": 0, "log_every": 32, "checkpoint_every": 32}
    given = {"low": "random", "film": False, "progress": False, **sizes, **every}
    hpamdp.train("catch_point", folder=tmp_path / "whole", callbacks=[Far()], **given)
    hpamdp.train(folder=tmp_path / "resumed", resume=str(tmp_path / "copy"), progress=False)
    assert rows_without_times(tmp_path / "resumed") == rows_without_times(tmp_path / "whole")
    assert [float(row["frames"]) for row in rows_of(tmp_path / "whole")] == [2**31 + 32.0 * i for i in range(-3, 3)]
    parts, whole = (parts_of_run(tmp_path / name) for name in ("resumed", "whole"))
    assert (whole["collection"]["env"]["episode"] < 0).all()
    assert_same(parts["collection"], whole["collection"])
