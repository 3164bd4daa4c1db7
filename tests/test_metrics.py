import io
import math

import pytest
import wandb

from hpamdp.env.base import PAMDPEnv
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.reference import HUMAN, RANDOM, human_normalised, human_references
from hpamdp.messages import duration
from hpamdp.metrics_file import Metrics, read_rows, rows_up_to
from hpamdp.run.loggers import CSVLogger, TensorboardLogger, WandbLogger
from hpamdp.run.summary import closing_table


@pytest.fixture
def without_login(monkeypatch, tmp_path):
    for name in ("WANDB_API_KEY", "WANDB_MODE", "WANDB_BASE_URL", "NETRC", "WANDB_DIR", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr("sys.stdin", io.StringIO())  # a prompt would read the end of the file and raise
    wandb.teardown()  # forgets the settings that an earlier test's environment gave


def wandb_logger(output_dir, mode):
    return WandbLogger(output_dir, config={"seed": 1}, project="hpamdp-tests", mode=mode)


def log_a_run(logger, output_dir):
    from PIL import Image

    Image.new("RGB", (8, 8)).save(output_dir / "figure.png")
    logger.log({"frames": 10, "eval/score": 1.5}, step=10)
    logger.images([output_dir / "figure.png"])
    Image.new("P", (8, 8)).save(output_dir / "episodes.gif")
    logger.film(output_dir / "episodes.gif")
    logger.summary({"eval/score": 1.5, "references": {"ceiling": 3.64}})
    logger.close()


def test_a_row_with_a_new_column_keeps_old_rows_and_the_columns_order(tmp_path):
    file = Metrics(tmp_path / "metrics.csv")
    rows = [{"frames": 1.0, "a": 1.0}, {"frames": 2.0, "b": 2.0}, {"c": 3.0}, {"frames": 4.0}]
    for row in rows:
        file.append(row)
    assert file.rows() == rows
    assert file.path.read_text().splitlines()[0] == "frames,a,b,c"


def test_a_kill_while_the_header_is_rewritten_leaves_the_old_file(tmp_path, monkeypatch):
    file = Metrics(tmp_path / "metrics.csv")
    file.append({"frames": 1.0})

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("os.replace", killed)
    with pytest.raises(KeyboardInterrupt):
        file.append({"frames": 2.0, "new": 1.0})
    assert read_rows(file.path) == [{"frames": 1.0}]


def test_a_last_line_that_was_cut_off_is_left_out_and_never_appended_to(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("frames,a\n1,2\n10,2.5\n100,3.4")
    assert read_rows(path) == [{"frames": 1.0, "a": 2.0}, {"frames": 10.0, "a": 2.5}]
    file = Metrics(path, rows_up_to(math.inf, path))
    file.append({"frames": 100, "a": 3.45})
    assert [row["a"] for row in file.rows()] == [2.0, 2.5, 3.45]


def test_a_file_of_something_else_has_no_rows(tmp_path, capsys):
    path = tmp_path / "metrics.csv"
    for data in (bytes(range(256)) * 99 + b"\n", b"\xff\xfea\0\n", b"a,b\n\0,x\n", b"[" * 9999):
        path.write_bytes(data)
        assert not any(read_rows(path))
    path.write_bytes(b'a,b\n"' + b"1" * 200_000 + b"\n")
    assert read_rows(path) == [] and "its rows are left out: field larger" in capsys.readouterr().err
    path.unlink()
    path.symlink_to("/dev/zero")
    assert read_rows(path) == []


def test_a_resumed_file_starts_with_the_rows_up_to_the_frame(tmp_path):
    first = Metrics(tmp_path / "first" / "metrics.csv")
    for frames in (100, 200, 300):
        first.append({"frames": frames, "loss": 1.0})
    other = Metrics(tmp_path / "other" / "metrics.csv", rows_up_to(200, first.path))
    other.append({"frames": 250, "loss": 2.0})
    assert [row["frames"] for row in other.rows()] == [100, 200, 250]
    assert len(first.rows()) == 3
    in_place = Metrics(first.path, rows_up_to(100, first.path))
    assert in_place.rows() == [{"frames": 100.0, "loss": 1.0}]


def test_a_new_run_in_an_old_folder_keeps_the_old_rows_beside_its_own(tmp_path):
    Metrics(tmp_path / "metrics.csv").append({"frames": 1})
    file = Metrics(tmp_path / "metrics.csv")
    file.append({"frames": 2})
    assert file.rows() == [{"frames": 2.0}]
    assert read_rows(tmp_path / "metrics.csv.previous") == [{"frames": 1.0}]


def test_a_file_that_no_row_was_added_to_stays_as_it_was(tmp_path):
    path = tmp_path / "metrics.csv"
    Metrics(path).append({"frames": 1})
    assert Metrics(path).rows() == []
    assert Metrics(path, rows_up_to(math.inf, path)).rows() == read_rows(path) == [{"frames": 1.0}]


def test_nothing_but_numbers_enters_the_file(tmp_path):
    file = Metrics(tmp_path / "metrics.csv")
    with pytest.raises(ValueError):
        file.append({"frames": "many"})
    assert file.rows() == []


def test_every_logger_takes_a_run(tmp_path, without_login):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log_a_run(CSVLogger(), tmp_path)
    log_a_run(TensorboardLogger(tmp_path), tmp_path)
    log_a_run(wandb_logger(tmp_path, "disabled"), tmp_path)
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [(event.step, event.value) for event in events.Scalars("eval/score")] == [(10, 1.5)]
    assert sorted(events.Tags()["images"]) == ["episodes", "figure"]


def test_wandb_auto_without_login_makes_an_offline_run_under_the_output_folder(tmp_path, without_login, capfd):
    logger = wandb_logger(tmp_path, "auto")
    assert logger.is_offline
    log_a_run(logger, tmp_path)
    assert list(tmp_path.glob("wandb/offline-run-*/*.wandb"))
    assert capfd.readouterr() == ("", "")


def test_wandb_auto_obeys_wandb_mode_even_with_a_key(tmp_path, without_login, monkeypatch):
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    monkeypatch.setenv("WANDB_MODE", "offline")
    logger = wandb_logger(tmp_path, "auto")
    assert logger.is_offline
    logger.close()


@pytest.mark.parametrize("mode", ["online", "auto"])
def test_wandb_online_without_a_key_goes_offline_with_a_warning(tmp_path, without_login, monkeypatch, capsys, mode):
    monkeypatch.setenv("WANDB_MODE", "online")
    logger = wandb_logger(tmp_path, mode)
    assert logger.is_offline
    (warning,) = capsys.readouterr().err.splitlines()
    assert "no API key" in warning
    logger.close()


def test_wandb_finds_a_key_in_netrc_and_goes_offline_when_nobody_answers(tmp_path, without_login, monkeypatch, capsys):
    (tmp_path / "netrc").write_text(f"machine 127.0.0.1:9 login user password {'0' * 40}\n")
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")
    monkeypatch.setattr("hpamdp.run.loggers._WANDB_START", 0.5)
    logger = wandb_logger(tmp_path, "auto")
    assert logger.is_offline
    (warning,) = capsys.readouterr().err.splitlines()
    assert "could not start online" in warning and "Timed out" in warning
    logger.close()


def test_the_closing_table_sets_this_agent_beside_the_references_in_their_order():
    ceiling = {"score": 3.6, "success": 1.0, "oracle_agreement": 1.0}
    table = closing_table(
        {
            "score": 3.2,
            "success": 0.97,
            "oracle_agreement": 0.9,
            "references": {"ceiling": ceiling, **human_references("chosen"), "random": {"score": -0.93}},
            "frames": 1_000_000,
            "wall_s": 754.2,
        },
        BoatDockEnv.table_metrics,
    )
    head, score, success, agreement, effort = table.splitlines()
    assert head.split("   ")[-5:] == ["this agent", "random", "people", "best person", "ceiling"]
    assert score.split() == ["score", "3.200", "-0.930", "1.970", "3.021", "3.600"]
    assert success.split() == ["success", "97.0%", "86.0%", "98.9%", "100.0%"]
    assert agreement.endswith("100.0%") and len(agreement) == len(head)
    assert effort == "1,000,000 frames in 12 min 34 s"


def test_human_normalised_is_0_for_random_presses_and_1_for_people_with_the_same_boat():
    for controller, people in HUMAN.items():
        assert human_normalised(people["score"], controller) == pytest.approx(1.0)
        assert human_normalised(RANDOM["score"], controller) == pytest.approx(0.0)
    assert human_normalised(3.0, "congruent") < human_normalised(3.0, "incongruent")  # where people reach less
    assert human_normalised(3.0, "random") == human_normalised(3.0)


def test_the_closing_table_leaves_out_what_is_not_known():
    table = closing_table({"score": 0.5, "success": float("nan"), "references": {}}, PAMDPEnv.table_metrics)
    assert table.splitlines() == ["        this agent", "score        0.500"]
    assert closing_table({}, PAMDPEnv.table_metrics) == ""


def test_numbers_in_the_table_are_never_minus_zero_and_times_are_in_words():
    assert closing_table({"optimality_gap": -1e-5}, PAMDPEnv.table_metrics).endswith(" 0.000")
    assert [duration(s) for s in (0.51, 59.97, 754.2, 7230.0)] == ["0.5 s", "1 min 00 s", "12 min 34 s", "2 h 00 min"]


def test_the_references_of_boats_follow_the_controller():
    chosen, held = BoatDockEnv(2), BoatDockEnv(2, controller="congruent")
    ceiling = chosen.references({"ceiling": 3.6})["ceiling"]
    assert ceiling["oracle_agreement"] == 1.0 and ceiling["human_normalised"] == human_normalised(3.6)
    beside = held.references({"ceiling": 3.4})
    assert list(beside) == ["human", "best_person", "ceiling"]
    assert beside["human"].items() >= HUMAN["congruent"].items() and "oracle_agreement" not in beside["ceiling"]
    assert human_references("random")["human"].items() >= HUMAN["chosen"].items()
