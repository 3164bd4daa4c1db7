import json

import numpy as np
import pytest
from PIL import Image

from hpamdp import figure_style as style
from hpamdp.analysis.figures import draw_all, learning_curves
from hpamdp.env.base import Metric
from hpamdp.env.boatdock import figures as boats
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.run_files import saved_summary

ALL = ["learning_curves.png", "trajectories.png", "choices.png"]


def write_evaluation(folder, num=6, without=(), **changed):
    rng = np.random.default_rng(0)
    start, goal = rng.uniform(-70, 70, (2, num, 2))
    path = np.full((num, 5, 2), np.nan)
    path[:, 0], path[:, 1] = start, goal
    option = rng.integers(0, 2, num)
    outcome = rng.integers(1, 6, num)
    arrays = {"start": start, "goal": goal, "option": option, "controller": option, "outcome": outcome, "path": path}
    arrays |= {"fuel": rng.uniform(0, 1, num), "score": np.where(outcome == 1, rng.uniform(0, 4, num), -1.0)}
    arrays |= {"steps": np.ones(num, dtype=int), "optimum": rng.uniform(2, 4, (num, 2))}
    arrays |= {"bearing_offset": rng.uniform(0, 60, num), **changed}
    np.savez(folder / "evaluation.npz", **{name: array for name, array in arrays.items() if name not in without})


def write_metrics(folder, columns=("eval/score", "eval/success", "train/score"), num=5):
    lines = [",".join(["frames", "wall_s", *columns])]
    lines += [",".join(str(0.1 * i) for _ in range(2 + len(columns))) for i in range(num)]
    (folder / "metrics.csv").write_text("\n".join(lines) + "\n")


def names(folder):
    summary = saved_summary(folder)
    evaluation = arrays_of(folder) if (folder / "evaluation.npz").exists() else {}
    paths = draw_all(folder, BoatDockEnv, summary, evaluation)
    for path in paths:
        with Image.open(path) as image:
            image.verify()
    return [path.name for path in paths]


def test_all_figures_come_from_complete_files(tmp_path):
    write_evaluation(tmp_path)
    write_metrics(tmp_path, ("eval/score", "eval/success", "train/option_congruent", "eval/oracle_agreement"))
    (tmp_path / "summary.json").write_text(
        json.dumps({"references": {"random": {"score": -0.9}, "ceiling": {"score": 3.6}}})
    )
    assert names(tmp_path) == ALL


def test_a_picture_of_a_users_own_with_a_name_that_the_problem_chooses_stays(tmp_path, capsys):
    write_evaluation(tmp_path)
    write_metrics(tmp_path)
    (tmp_path / "trajectories.png").write_text("mine")
    for _ in range(2):  # the second time the others are known to be the run's own
        assert names(tmp_path) == ["learning_curves.png", "choices.png"]
        assert "trajectories.png: no run has written it, so it stays" in capsys.readouterr().err
    assert (tmp_path / "trajectories.png").read_text() == "mine"


def test_learning_curves_show_the_logged_values_between_the_references(tmp_path):
    rows = [{"frames": 10.0 * i, "eval/score": 0.5 * i, "train/score": 0.1 * i} for i in range(4)]
    summary = {"references": {"random": {"score": -0.9}, "human": {"success": 0.9}, "ceiling": {"score": 3.6}}}
    figure = learning_curves(rows, summary, (Metric("score", "Score"), Metric("success", "Success", "share")))
    (axes,) = [axes for axes in figure.axes if axes.axison]
    assert axes.get_title() == "Score"
    lines = {tuple(line.get_ydata()) for line in axes.lines}
    assert {(0.0, 0.5, 1.0, 1.5), (-0.9, -0.9), (3.6, 3.6)} <= lines
    written = {text.get_text() for text in axes.texts}
    assert written == {"random \u22120.90", "ceiling 3.60", "this agent 1.50", "exploring 0.30"}
    few = learning_curves(rows[:2], {}, (Metric("score", "Score"),)).axes[0].lines[:2]
    assert [line.get_linestyle() for line in few] == ["None", "None"]  # points, without a line that nobody measured


def arrays_of(folder):
    with np.load(folder / "evaluation.npz") as file:
        return dict(file)


def test_trajectories_show_the_paths_and_scores_from_the_best_to_the_worst(tmp_path):
    write_evaluation(tmp_path, num=6)
    evaluation = arrays_of(tmp_path)
    panels = boats.draw(evaluation, {})["trajectories.png"].axes
    order = np.lexsort((evaluation["outcome"], -evaluation["score"]))
    assert [float(axes.get_title().split()[0].replace("\u2212", "-")) for axes in panels] == pytest.approx(
        evaluation["score"][order], abs=5e-3
    )
    for axes, episode in zip(panels, order, strict=True):
        path = evaluation["path"][episode]
        np.testing.assert_array_equal(axes.lines[0].get_xydata(), path[np.isfinite(path).all(1)])


def test_choices_show_the_probability_of_the_congruent_boat_in_each_bin_with_its_interval(tmp_path):
    offset = np.repeat([5.0, 15.0, 25.0, 35.0, 45.0, 55.0], 10)
    option = np.tile(np.arange(10) < 7, 6).astype(int)
    write_evaluation(tmp_path, num=60, option=option, controller=option, bearing_offset=offset)
    axes = boats.draw(arrays_of(tmp_path), {})["choices.png"].axes[0]
    (bars,) = axes.containers
    assert bars.lines[0].get_ydata() == pytest.approx([0.7] * 6)
    segments = np.array(bars.lines[2][0].get_segments())[:, :, 1]
    assert segments == pytest.approx(np.tile([0.3968, 0.8922], (6, 1)), abs=1e-3)  # Wilson's, of 7 in 10


@pytest.mark.parametrize(
    ("text", "drawn"),
    [
        (None, []),
        ("frames,loss\n1,2\n", []),
        ("frames,wall_s,eval/score,eval/success\n1,1,nan,nan\n2,,,\n3,3,inf,0.5\n,4,1.0,0.5\n5,nan,x\n6,1.7", ALL[:1]),
    ],
)
def test_curves_come_from_whatever_metrics_there_are(tmp_path, text, drawn):
    if text is not None:
        (tmp_path / "metrics.csv").write_text(text)
    assert names(tmp_path) == drawn


@pytest.mark.parametrize(
    ("changes", "drawn"),
    [
        ({"option": np.full(6, -1), "optimum": np.full((6, 2), np.nan)}, ALL[1:2]),
        ({"num": 7, "without": ("optimum", "controller", "fuel", "steps", "start")}, ALL[1:]),
        ({"without": ("path",)}, ALL[2:]),
    ],
)
def test_missing_arrays_leave_out_only_what_needs_them(tmp_path, changes, drawn):
    write_evaluation(tmp_path, **changes)
    assert names(tmp_path) == drawn


def test_labels_stand_apart_near_their_lines_and_in_order():
    heights = [0.1, 0.9, 0.95, 0.96, 0.97, 1.0]
    placed = style.apart(heights, 0.06)
    assert np.diff(placed).min() > 0.06 - 1e-9
    assert placed[0] == 0.1 and placed[-1] <= 1.02
    assert style.apart([0.3, 0.5], 0.06) == [0.3, 0.5]


def test_the_best_possible_score_is_of_both_boats_only_where_the_agent_chose():
    evaluation = {"score": np.array([2.0]), "controller": np.array([1]), "optimum": np.array([[3.5, 3.0]])}
    assert boats.episode_title({**evaluation, "option": np.array([1])}, 0) == "2.00 / 3.50  C"
    assert boats.episode_title({**evaluation, "option": np.array([-1])}, 0) == "2.00 / 3.00  C"


def choices_of_three(**changed):
    rng = np.random.default_rng(0)
    option = np.arange(30) % 3
    best = np.zeros((30, 3))
    best[np.arange(30), option] = 1.0  # each choice is the best one
    evaluation = {
        "start": rng.uniform(-50, 50, (30, 2)),
        "goal": rng.uniform(-50, 50, (30, 2)),
        "option": option,
        "outcome": np.ones(30),
        "bearing_offset": rng.uniform(0, 60, 30),
        "optimum": best,
        **changed,
    }
    return boats.draw(evaluation, {"boats": ["a", "b", "c"]})["choices.png"]


@pytest.mark.parametrize("num_unknown", [20, 30])
def test_only_episodes_with_a_known_best_boat_count_in_the_agreement(num_unknown):
    best = np.eye(3)[np.arange(30) % 3]
    best[:num_unknown] = np.nan
    axes = choices_of_three(optimum=best).axes[0]
    known = "" if num_unknown == 30 else " (best one in 100%)"
    assert axes.get_title() + axes.get_title(loc="left") == f"Boat chosen{known}"
    assert len(axes.lines) == (3 if num_unknown == 30 else 6)
    assert np.isfinite(np.concatenate([line.get_ydata() for line in axes.lines])).all()


def test_only_episodes_with_a_known_better_boat_count_in_the_choice_of_people_s(tmp_path):
    optimum = np.tile([0.0, 1.0], (30, 1))
    optimum[:20] = np.nan
    write_evaluation(tmp_path, num=30, option=np.ones(30, int), optimum=optimum)
    axes = boats.draw(arrays_of(tmp_path), {})["choices.png"].axes[0]
    title = axes.get_title() + axes.get_title(loc="left")
    assert title == "Congruent boat chosen (better boat in 100%)"
    assert (axes.lines[0].get_ydata() == 1.0).all()


def test_the_choice_of_other_boats_is_drawn_by_their_names(tmp_path):
    rng = np.random.default_rng(1)
    write_evaluation(tmp_path, option=rng.permutation(6) % 3, optimum=rng.uniform(2, 4, (6, 3)))
    write_metrics(tmp_path, ("eval/score", "eval/option_a", "eval/option_b", "eval/option_c"))
    (tmp_path / "summary.json").write_text(json.dumps({"boats": ["a", "b", "c"], "references": {}}))
    assert names(tmp_path) == ALL
    assert [metric.name for metric in BoatDockEnv.curves({"boats": ["a", "b"]})][-2:] == ["option_a", "option_b"]
    with np.load(tmp_path / "evaluation.npz") as arrays:
        evaluation = dict(arrays)
    figure = boats.draw(evaluation, {"boats": ["a", "b", "c"]})["choices.png"]
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == ["a", "b", "c"]
    assert boats.episode_title(evaluation, 0, ("a", "b", "c")).endswith(("  a", "  b", "  c"))
