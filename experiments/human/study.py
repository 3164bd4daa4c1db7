"""Measure people's episodes in the released recording, write csv files, draw and tabulate them.

python experiments/human/study.py measure     reads the recording (HPAMDP_HUMAN_DATA or the cache), writes the csv
                                              files, then draws and tabulates
python experiments/human/study.py             draws and tabulates the stored csv files
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from experiments.study_tables import Rows, markdown_table, read_csv, write_tables
from hpamdp.data.human import statistics, validation
from hpamdp.data.human.episodes import score
from hpamdp.data.human.released_file import HumanData, read
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.reference import OFFSET_EDGES
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
HUMAN, FAINT, INK, CHOICE, PRESSES = "#D98200", "#c9c9c9", "#2b2b2b", "#CC79A7", "#0072B2"
DOCKED, TOO_FAST, SHORT = "#009E73", "#D55E00", "#332288"
STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "savefig.dpi": 150,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.titlesize": 10,
}
BLOCK_EPISODES = 60
ALL_BLOCKS = -1
BOTH_BOATS = -1
Columns = dict[str, np.ndarray]


def measure() -> None:
    """Write every csv file."""
    data = read(one_frame=True)
    best = statistics.best_scores(data)
    gaps = optimality_gaps(data, best)
    write("persons", persons(data, best, gaps))
    write("blocks", blocks(data, gaps))
    write("choices", choices(data, best))
    singles = validation.single_presses(data)
    write("singles", rows_of(singles._asdict()))
    write("first_presses", rows_of(validation.first_presses(data)._asdict()))
    fit = fit_constants(singles)
    constants = ("likely_glide", "likely_speed", "agreeing_glide", "agreeing_speed")
    names = ("value", "low", "high", "constant")
    write("fit", [dict(zip(names, (*getattr(fit, constant), constant), strict=True)) for constant in constants])
    glide, speed = torch.meshgrid(fit.glides, fit.speeds, indexing="ij")
    grid = {"glide": glide.flatten(), "docking_speed": speed.flatten(), "agreement": fit.agreement.flatten()}
    write("agreement", rows_of(grid))


def optimality_gaps(data: HumanData, best: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return the gap between each episode's score and the best possible score, in three parts `[E]`.

    `gap` is the difference to the best plan with the better controller. It is the sum of two parts: `choice_gap` is due
    to the choice of the controller, `press_gap` is due to the presses with that controller.

    Args:
        data: the recording.
        best: `best_scores` of this recording.
    """
    scores = score(data)
    chosen = best.gather(1, data.episodes["controller"].unsqueeze(1)).squeeze(1)
    better = best.max(1).values
    return {"gap": better - scores, "choice_gap": better - chosen, "press_gap": chosen - scores}


class Fit(NamedTuple):
    """The glide and the docking speed (px/s) fitted to people's single presses, with 95 % bootstrap intervals.

    Attributes:
        likely_glide, likely_speed: the constants of largest likelihood, as (value, low, high).
        agreeing_glide, agreeing_speed: the constants that predict the most outcomes correctly, as (value, low, high).
        glides, speeds: the grid, `[G]` and `[S]`.
        agreement: fraction of outcomes predicted correctly on the grid, `[G, S]`.
    """

    likely_glide: tuple[float, float, float]
    likely_speed: tuple[float, float, float]
    agreeing_glide: tuple[float, float, float]
    agreeing_speed: tuple[float, float, float]
    glides: torch.Tensor
    speeds: torch.Tensor
    agreement: torch.Tensor


def fit_constants(singles: validation.Singles, num_bootstraps: int = 400, seed: int = 0) -> Fit:
    """Fit the glide and the docking speed to people's single presses, on a grid, and bootstrap over presses.

    The likelihood has two Gaussian errors: of the speed at the dock, and of the distance covered. Their standard
    deviations are fitted, too.
    """
    glides = torch.arange(0.7, 1.305, 0.02, dtype=torch.float64)
    speeds = torch.arange(60.0, 100.5, 1.0, dtype=torch.float64)
    speed_errors = torch.tensor([2.0, 4.0, 8.0, 16.0], dtype=torch.float64)
    distance_errors = torch.tensor([0.5, 2.0, 8.0], dtype=torch.float64)
    weights = _bootstrap_weights(len(singles.pressed), num_bootstraps, seed)

    glide, limit, speed_error, distance_error = _grid(glides, speeds, speed_errors, distance_errors)
    log_likelihood = _log_likelihood(singles, glide, limit, speed_error, distance_error)
    likely = (log_likelihood @ weights.T).argmax(0)
    likely_glide = _interval(glide[likely, 0])
    likely_speed = _interval(limit[likely, 0])

    glide, limit = _grid(glides, speeds)
    spare, speed = _arrival(singles, glide)
    at_dock = torch.where(speed > limit, physics.TOO_FAST, physics.SUCCESS)
    predicted = torch.where(spare < 0.0, physics.SAILING, at_dock)
    is_right = (predicted == validation.reached(singles.outcome)).double()
    agreeing = (is_right @ weights.T).argmax(0)
    return Fit(
        likely_glide=likely_glide,
        likely_speed=likely_speed,
        agreeing_glide=_interval(glide[agreeing, 0]),
        agreeing_speed=_interval(limit[agreeing, 0]),
        glides=glides,
        speeds=speeds,
        agreement=is_right.mean(1).reshape(len(glides), len(speeds)),
    )


def _bootstrap_weights(num: int, num_bootstraps: int, seed: int) -> torch.Tensor:
    """Return the weight of each press `[1 + num_bootstraps, num]`: 1 in the first row, then resampled counts."""
    sampled = torch.randint(num, (num_bootstraps, num), generator=torch.Generator().manual_seed(seed))
    resampled = torch.zeros(num_bootstraps, num, dtype=torch.float64)
    resampled.scatter_add_(1, sampled, torch.ones(sampled.shape, dtype=torch.float64))
    return torch.cat([torch.ones(1, num, dtype=torch.float64), resampled])


def _grid(*axes: torch.Tensor) -> list[torch.Tensor]:
    """Return each axis's values at all points of the grid of the axes, `[points, 1]`."""
    return [values.flatten().unsqueeze(1) for values in torch.meshgrid(*axes, indexing="ij")]


def _arrival(singles: validation.Singles, glide: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the distance that each press would go beyond the dock's circle (px), and the speed there (px/s).

    Both are `[points, M]`.
    """
    pressed = singles.pressed.double()
    to_dock = singles.to_dock.double()
    spare = (1.0 + glide) * pressed - to_dock
    # The speed follows from the distance covered while the key is down, and from the distance left in the glide.
    in_glide = to_dock > pressed
    distance = torch.where(in_glide, (spare / glide).clamp(min=0.0), to_dock)
    return spare, physics.speed(physics.duration_for(distance))


def _log_likelihood(
    singles: validation.Singles,
    glide: torch.Tensor,
    limit: torch.Tensor,
    speed_error: torch.Tensor,
    distance_error: torch.Tensor,
) -> torch.Tensor:
    """Return the log-likelihood of each press's outcome at each point of the grid, `[points, M]`."""
    spare, speed = _arrival(singles, glide)
    log_reaches = torch.special.log_ndtr(spare / distance_error)
    log_falls_short = torch.special.log_ndtr(-spare / distance_error)
    log_too_fast = torch.special.log_ndtr((speed - limit) / speed_error)
    log_docks = torch.special.log_ndtr(-(speed - limit) / speed_error)
    at_dock = log_reaches + torch.where(singles.outcome == physics.TOO_FAST, log_too_fast, log_docks)
    return torch.where(validation.reached(singles.outcome) == physics.SAILING, log_falls_short, at_dock)


def _interval(values: torch.Tensor) -> tuple[float, float, float]:
    """Return the first value and the 95 % interval of the others, as (value, low, high)."""
    low, high = values[1:].quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return values[0].item(), low, high


def rows_of(columns: Mapping[str, torch.Tensor]) -> Rows:
    """Return columns as rows."""
    lists = {name: column.double().tolist() for name, column in columns.items()}
    return [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]


def persons(data: HumanData, best: torch.Tensor, gaps: Mapping[str, torch.Tensor]) -> Rows:
    """Return a row for each person: figures, and the mean gaps to the best plans on the person's own layouts."""
    rows = []
    is_better_boat = best.argmax(1) == data.episodes["controller"]
    last_block = data.episodes["block"] == 5
    for person, figures in statistics.figures_by(data, "person").items():
        own = data.episodes["person"] == person
        row = {"person": person, **figures}
        row["ceiling"] = best[own].max(1).values.mean().item()
        row["better_boat"] = is_better_boat[own].double().mean().item()
        for name, gap in gaps.items():
            row[name] = gap[own].mean().item()
        row["score_last_60"] = statistics.figures(data, own & last_block)["score"]
        rows.append(row)
    return rows


def blocks(data: HumanData, gaps: Mapping[str, torch.Tensor]) -> Rows:
    """Return a row for each block and boat (or both boats), with quantiles of the people's mean scores."""
    rows = []
    for block in data.episodes["block"].unique().tolist():
        of_block = data.episodes["block"] == block
        for controller in (BOTH_BOATS, *range(len(harbour.CONTROLLERS))):
            mask = of_block
            if controller != BOTH_BOATS:
                mask = of_block & (data.episodes["controller"] == controller)
            row = {"block": block, "controller": controller, **statistics.figures(data, mask)}
            means = _mean_score_of_each_person(data, mask)
            for percent in (10, 25, 75, 90):
                row[f"score_{percent}"] = means.quantile(percent / 100).item()
            for name, gap in gaps.items():
                row[name] = gap[mask].mean().item()
            rows.append(row)
    return rows


def _mean_score_of_each_person(data: HumanData, mask: torch.Tensor) -> torch.Tensor:
    """Return the mean scores of the people who have episodes in `mask`, float64."""
    person = data.episodes["person"][mask]
    num_persons = len(data.episodes["person"].unique())
    means = torch.bincount(person, score(data)[mask], num_persons) / torch.bincount(person, minlength=num_persons)
    return means[means.isfinite()].double()


def choices(data: HumanData, best: torch.Tensor) -> Rows:
    """Return a row for each block (or all) and bin of bearings: frequencies of choosing the congruent controller."""
    rows = []
    bins = statistics.offset_bins(data)
    is_congruent_better = (best.argmax(1) == harbour.CONGRUENT).double()
    worth = (best[:, 1] - best[:, 0]).abs()
    for block in (ALL_BLOCKS, *data.episodes["block"].unique().tolist()):
        mask = torch.ones_like(bins, dtype=torch.bool) if block == ALL_BLOCKS else data.episodes["block"] == block
        for number, share in enumerate(statistics.choice_curve(data, mask)):
            own = mask & (bins == number)
            rows.append(
                {
                    "block": block,
                    "offset": OFFSET_EDGES[number],
                    "episodes": int(own.sum()),
                    "congruent": share,
                    "congruent_is_better": is_congruent_better[own].mean().item(),
                    "worth": worth[own].mean().item(),
                }
            )
    return rows


def write(name: str, rows: Rows) -> None:
    """Write rows as a csv file, with four digits of each number."""
    write_tables(HERE, {name: [{column: _rounded(value) for column, value in row.items()} for row in rows]})


def _rounded(value: Any) -> Any:
    return round(value, 4) if isinstance(value, float) else value


def load(name: str) -> Columns:
    """Read the columns of a csv file."""
    rows = read_csv(HERE / f"{name}.csv")
    return {column: np.array([row[column] for row in rows]) for column in rows[0]}


def draw() -> None:
    """Draw the three figures."""
    figures = {
        "yardstick": (draw_learning, draw_gaps),
        "choices": (draw_choices, draw_better_boat),
        "physics": (draw_singles, draw_ways, draw_agreement),
    }
    for name, panels in figures.items():
        with mpl.rc_context(STYLE):
            figure = Figure(figsize=(3.6 * len(panels) + 1.2, 3.6), layout="constrained")
            for draw_panel, axes in zip(panels, figure.subplots(1, len(panels)), strict=True):
                draw_panel(axes)
            figure.savefig(HERE / f"{name}.png")


def draw_learning(axes: Axes) -> None:
    """Draw the mean score of each block, with the middle half and the middle four fifths of the people."""
    rows, of_persons = load("blocks"), load("persons")
    both = rows["controller"] == BOTH_BOATS
    x = BLOCK_EPISODES * rows["block"][both] + BLOCK_EPISODES / 2
    axes.fill_between(x, rows["score_10"][both], rows["score_90"][both], color=HUMAN, alpha=0.15, linewidth=0)
    axes.fill_between(x, rows["score_25"][both], rows["score_75"][both], color=HUMAN, alpha=0.25, linewidth=0)
    axes.plot(x, rows["score"][both], color=HUMAN, marker="o", markersize=4)
    axes.annotate("people: mean,\nmiddle 50 % and 80 %", (x[3], 0.75), color=HUMAN, ha="center")
    references = (
        ("best plan with the better boat", of_persons["ceiling"].mean(), INK, "-"),
        ("best person", of_persons["score"].max(), HUMAN, "-."),
    )
    for text, height, colour, style in references:
        axes.axhline(height, color=colour, linewidth=1, linestyle=style)
        axes.annotate(text, (0, height), xytext=(2, 3), textcoords="offset points")
    axes.set(xlabel="episode", ylabel="score", xlim=(0, 360), ylim=(0, 4))
    axes.set_title("People learn, and stay below the ceiling")


def draw_gaps(axes: Axes) -> None:
    """Draw each person's loss of score through the keys and through the choice of the controller."""
    rows = load("persons")
    order = np.argsort(rows["gap"])
    x = np.arange(len(order))
    lost_with_keys = rows["press_gap"][order]
    lost_by_choice = rows["choice_gap"][order]
    axes.bar(x, lost_with_keys, color=PRESSES, width=0.8, label="lost with the keys")
    axes.bar(x, lost_by_choice, bottom=lost_with_keys, color=CHOICE, width=0.8, label="lost by the choice of the boat")
    axes.set(xlabel="people, best first", xticks=[], ylabel="score below the best plan")
    axes.set_title("Optimality gap, own layouts")
    axes.legend(frameon=False, loc="upper left")


def draw_choices(axes: Axes) -> None:
    """Draw how often the congruent controller was chosen and how often it was better, by the bearing."""
    rows = load("choices")
    for block, colour, label in ((ALL_BLOCKS, HUMAN, "people"), (0, FAINT, "first 60"), (5, INK, "last 60")):
        own = rows["block"] == block
        share = rows["congruent"][own]
        error = 1.96 * np.sqrt(share * (1 - share) / rows["episodes"][own])
        axes.errorbar(
            rows["offset"][own] + 5, share, error, color=colour, marker="o", markersize=4, capsize=2, label=label
        )
    every = rows["block"] == ALL_BLOCKS
    axes.plot(
        rows["offset"][every] + 5,
        rows["congruent_is_better"][every],
        color=PRESSES,
        marker="s",
        markersize=4,
        label="better boat",
    )
    axes.set(xlim=(0, 60), ylim=(0, 1), title="Congruent boat chosen")
    axes.set_xlabel("degrees between bearing and congruent controller's nearest key")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.legend(frameon=False, loc="lower left")


def draw_better_boat(axes: Axes) -> None:
    """Draw each person's score against the fraction of episodes with the better controller."""
    rows = load("persons")
    axes.scatter(rows["better_boat"], rows["score"], color=HUMAN, s=18)
    axes.set(xlabel="episodes with the better boat", ylabel="score", title="Choosing well and scoring well, 40 people")
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    correlation = np.corrcoef(rows["better_boat"], rows["score"])[0, 1]
    axes.annotate(f"correlation {correlation:.2f}", (0.97, 0.03), xycoords="axes fraction", ha="right")


def draw_singles(axes: Axes) -> None:
    """Draw where single presses ended, and the distances at which our boats stop or become slow enough to dock."""
    rows = load("singles")
    outcome = rows["outcome"]
    is_wrong = _reached(outcome) != _reached(rows["predicted"])
    groups = (
        (outcome == physics.SUCCESS, DOCKED, "docked"),
        (outcome == physics.TOO_FAST, TOO_FAST, "too fast"),
        (outcome > physics.TOO_FAST, SHORT, "dock not reached"),
    )
    for own, colour, label in groups:
        axes.scatter(rows["pressed"][own], rows["to_dock"][own], s=8, color=colour, label=f"{label} ({own.sum()})")
        wrong = own & is_wrong
        axes.scatter(
            rows["pressed"][wrong], rows["to_dock"][wrong], s=38, facecolor="none", edgecolor=INK, linewidth=0.8
        )
    x = np.linspace(0, 115, 200)
    axes.plot(x, (1 + physics.GLIDE) * x, color=INK, linewidth=1)
    axes.annotate("at rest", (60, 1.95 * 60), xytext=(-40, 4), textcoords="offset points")
    slow = physics.pressed_distance(duration_at(physics.DOCKING_SPEED)).item()
    way = np.where(x > slow, (1 + physics.GLIDE) * x - physics.GLIDE * slow, np.nan)
    axes.plot(x, way, color=INK, linewidth=1, linestyle="--")
    axes.annotate("74 px/s", (93, 1.95 * 93 - 0.95 * slow), xytext=(4, -10), textcoords="offset points")
    axes.set(xlabel="px covered while the key is down", ylabel="px to the dock", xlim=(0, 118), ylim=(0, 200))
    axes.set_title("Single presses (ringed: predicted wrong)")
    axes.legend(frameon=False, loc="upper left")


def duration_at(speed: float) -> torch.Tensor:
    """Return the duration of a press, s, after which the boat has this speed, px/s."""
    times = torch.linspace(0.0, physics.MAX_DURATION, 20_001)
    return times[(physics.speed(times) - speed).abs().argmin()]


def _reached(outcome: np.ndarray) -> np.ndarray:
    """Return the outcome at the dock, 0 if the boat did not reach it."""
    return np.where((outcome == physics.SUCCESS) | (outcome == physics.TOO_FAST), outcome, 0)


def draw_ways(axes: Axes) -> None:
    """Draw the distances of first presses, as multiples of the distance while the key is down."""
    rows = load("first_presses")
    axes.hist(rows["travelled"] / rows["pressed"], bins=np.arange(0.9, 2.25, 0.05), color=HUMAN)
    for edge, text in ((1.0, "no glide"), (1.0 + physics.GLIDE, "at rest")):
        axes.axvline(edge, color=INK, linewidth=1)
        axes.annotate(text, (edge, 74), ha="center", bbox={"facecolor": "white", "edgecolor": "none", "pad": 1})
    axes.set(xlabel="px until the next press / px while the key is down", ylabel="first presses", ylim=(0, 78))
    axes.set_title(f"{rows['is_inside'].mean():.1%} of {len(rows['pressed'])} inside the band")


def draw_agreement(axes: Axes) -> None:
    """Draw the fraction of correctly predicted outcomes over both constants, with the fitted constants and ours."""
    rows = load("agreement")
    glides, speeds = np.unique(rows["glide"]), np.unique(rows["docking_speed"])
    share = rows["agreement"].reshape(len(glides), len(speeds))
    image = axes.pcolormesh(speeds, glides, share, cmap="viridis", vmin=0.7, shading="nearest", rasterized=True)
    axes.figure.colorbar(image, ax=axes, format=PercentFormatter(1.0, decimals=0), label="outcomes predicted right")
    for name, colour, label in (("likely", "white", "most likely"), ("agreeing", TOO_FAST, "most predicted right")):
        glide, glide_errors = _fitted(f"{name}_glide")
        speed, speed_errors = _fitted(f"{name}_speed")
        axes.errorbar(
            speed, glide, yerr=glide_errors, xerr=speed_errors, color=colour, marker="o", capsize=3, label=label
        )
    axes.plot(physics.DOCKING_SPEED, physics.GLIDE, "k*", markersize=11, label="ours")
    axes.set(xlabel="docking speed, px/s", ylabel="glide", title="Constants, with 95 % intervals")
    axes.legend(frameon=True, loc="lower right", fontsize=8)


def _fitted(constant: str) -> tuple[float, np.ndarray]:
    """Return a constant's fitted value and its errors `[2, 1]`, downwards and upwards."""
    fit = load("fit")
    row = list(fit["constant"]).index(constant)
    value = fit["value"][row]
    return value, np.abs(np.array([[fit["low"][row]], [fit["high"][row]]]) - value)


def table_cells(rows: Columns, mask: np.ndarray) -> list[str]:
    """Return the cells of a line: means over the episodes of the masked blocks."""

    def mean(name: str, controller: int = BOTH_BOATS) -> float:
        own = mask & (rows["controller"] == controller)
        return np.average(rows[name][own], weights=rows["episodes"][own])

    scores = [f"{mean('score', controller):.3f}" for controller in (BOTH_BOATS, harbour.CONGRUENT, harbour.INCONGRUENT)]
    shares = [f"{mean(name):.1%}" for name in ("success", "too_fast", "out_of_bounds", "out_of_fuel")]
    numbers = [f"{mean(name):.2f}" for name in ("presses", "press_gap", "choice_gap")]
    return [*scores, *shares, *numbers]


def tabulate() -> None:
    """Print the table of the page, then the other figures in it."""
    rows = load("blocks")
    lines = []
    for block in np.unique(rows["block"]):
        first, last = BLOCK_EPISODES * block + 1, BLOCK_EPISODES * (block + 1)
        lines.append([f"{first} to {last}", *table_cells(rows, rows["block"] == block)])
    lines.append(["all", *table_cells(rows, np.ones_like(rows["block"], dtype=bool))])
    outcomes = "success | too fast | out | no fuel"
    head = f"episodes | score | congruent | incongruent | {outcomes} | presses | keys | controller"
    print(markdown_table(head, lines))
    of_persons = load("persons")
    for name in ("score", "success", "better_boat", "gap", "press_gap", "choice_gap", "ceiling", "score_last_60"):
        low, middle, high = np.quantile(of_persons[name], [0, 0.5, 1])
        print(f"{name}: mean {of_persons[name].mean():.3f}, people from {low:.3f} to {high:.3f}, median {middle:.3f}")
    fit = load("fit")
    for constant, value, low, high in zip(fit["constant"], fit["value"], fit["low"], fit["high"], strict=True):
        print(f"{constant} {value:g} ({low:g} to {high:g})")
    agreement = load("agreement")
    is_near_ours = (np.abs(agreement["glide"] - 0.94) < 0.015) & (agreement["docking_speed"] == 74)
    print(f"best agreement {agreement['agreement'].max():.3f}; near ours {agreement['agreement'][is_near_ours]}")


def main(words: Sequence[str]) -> None:
    """Measure if asked, draw, tabulate."""
    if list(words) == ["measure"]:
        measure()
    elif words:
        sys.exit(__doc__)
    draw()
    tabulate()


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(sys.argv[1:])))
