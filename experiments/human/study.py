"""Measure people on the released recording into csv files, and draw and tabulate what these hold.

python experiments/human/study.py measure     reads the recording (HPAMDP_HUMAN_DATA or the cache), writes the csv files
python experiments/human/study.py             draws and tabulates what the csv files hold
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from hpamdp.data.human import statistics, validation
from hpamdp.data.human.episodes import score
from hpamdp.data.human.released_file import HumanData, read
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.reference import OFFSET_EDGES

HERE = Path(__file__).resolve().parent
PEOPLE, FAINT, INK, CHOICE, PRESSES = "#D98200", "#c9c9c9", "#2b2b2b", "#CC79A7", "#0072B2"
GOOD, FAST, SHORT = "#009E73", "#D55E00", "#332288"
STYLE = {"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "savefig.dpi": 150}
STYLE |= {"axes.titlelocation": "left", "axes.titleweight": "bold", "axes.titlesize": 10}
Rows = list[dict[str, float]]


def measure() -> None:
    """Write every csv file."""
    data = read(one_frame=True)
    best = statistics.best_scores(data)
    gaps = statistics.optimality_gaps(data, best)
    write("people", people(data, best, gaps))
    write("blocks", blocks(data, gaps))
    write("choices", choices(data, best))
    singles, ways = validation.single_presses(data), validation.first_presses(data)
    write("singles", rows_of(singles._asdict()))
    write("first_presses", rows_of(ways._asdict()))
    fit = validation.fit(singles)
    names = ("likely_glide", "likely_speed", "agreeing_glide", "agreeing_speed")
    write("fit", [dict(zip(("value", "low", "high"), getattr(fit, n), strict=True), constant=n) for n in names])
    glide, speed = torch.meshgrid(fit.glides, fit.speeds, indexing="ij")
    columns = {"glide": glide.flatten(), "docking_speed": speed.flatten(), "agreement": fit.agreement.flatten()}
    write("agreement", rows_of(columns))


def rows_of(columns: Mapping[str, torch.Tensor]) -> Rows:
    lists = {name: column.double().tolist() for name, column in columns.items()}
    return [dict(zip(lists, row, strict=True)) for row in zip(*lists.values(), strict=True)]


def people(data: HumanData, best: torch.Tensor, gaps: Mapping[str, torch.Tensor]) -> Rows:
    """Return a row a person: figures, and the mean gaps to the best plans on the person's own layouts."""
    rows = []
    better = best.argmax(1) == data.episodes["controller"]
    for person, figures in statistics.figures_by(data, "person").items():
        own = data.episodes["person"] == person
        means = {name: gap[own].mean().item() for name, gap in gaps.items()}
        last = statistics.figures(data, own & (data.episodes["block"] == 5))["score"]
        ceiling = {"ceiling": best[own].max(1).values.mean().item(), "better_boat": better[own].double().mean().item()}
        rows.append({"person": person, **figures, **ceiling, **means, "score_last_60": last})
    return rows


def blocks(data: HumanData, gaps: Mapping[str, torch.Tensor]) -> Rows:
    """Return a row a block and a boat (or both, -1), with the middle half of the people."""
    rows = []
    for block in data.episodes["block"].unique().tolist():
        of_block = data.episodes["block"] == block
        for controller in (-1, *range(len(harbour.CONTROLLERS))):
            mask = of_block if controller < 0 else of_block & (data.episodes["controller"] == controller)
            person, num = data.episodes["person"][mask], len(data.episodes["person"].unique())
            means = torch.bincount(person, score(data)[mask], num) / torch.bincount(person, minlength=num)
            means = means[means.isfinite()].double()
            spread = {f"score_{q}": means.quantile(q / 100).item() for q in (10, 25, 75, 90)}
            mean_gaps = {name: gap[mask].mean().item() for name, gap in gaps.items()}
            rows.append(
                {"block": block, "controller": controller, **statistics.figures(data, mask), **spread, **mean_gaps}
            )
    return rows


def choices(data: HumanData, best: torch.Tensor) -> Rows:
    """Return a row a block (or all, -1) and a bin of bearings: who chose the congruent boat, where it was better."""
    rows, bins = [], statistics.offset_bins(data)
    better = (best.argmax(1) == harbour.CONGRUENT).double()
    worth = (best[:, 1] - best[:, 0]).abs()
    for block in (-1, *data.episodes["block"].unique().tolist()):
        mask = torch.ones_like(bins, dtype=torch.bool) if block < 0 else data.episodes["block"] == block
        for number, share in enumerate(statistics.choice_curve(data, mask)):
            own = mask & (bins == number)
            rows.append(
                {"block": block, "offset": OFFSET_EDGES[number], "episodes": int(own.sum()), "congruent": share}
                | {"congruent_is_better": better[own].mean().item(), "worth": worth[own].mean().item()}
            )
    return rows


def write(name: str, rows: Iterable[Mapping[str, object]]) -> None:
    rows = [{k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()} for row in rows]
    with (HERE / f"{name}.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def load(name: str) -> dict[str, np.ndarray]:
    with (HERE / f"{name}.csv").open() as file:
        rows = list(csv.DictReader(file))
    return {k: np.array([row[k] for row in rows]) if k == "constant" else np.array([float(row[k]) for row in rows])
            for k in rows[0]}  # fmt: skip


def draw() -> None:
    """Draw the three figures."""
    for name, panels in (
        ("yardstick", (draw_learning, draw_gaps)),
        ("choices", (draw_choices, draw_better_boat)),
        ("physics", (draw_singles, draw_ways, draw_agreement)),
    ):
        with mpl.rc_context(STYLE):
            figure = Figure(figsize=(3.6 * len(panels) + 1.2, 3.6), layout="constrained")
            axes = np.atleast_1d(figure.subplots(1, len(panels)))
            for panel, each in zip(panels, axes, strict=True):
                panel(each)
            figure.savefig(HERE / f"{name}.png")


def draw_learning(axes: Axes) -> None:
    rows, persons = load("blocks"), load("people")
    both = rows["controller"] < 0
    x = 60 * rows["block"][both] + 30
    axes.fill_between(x, rows["score_10"][both], rows["score_90"][both], color=PEOPLE, alpha=0.15, linewidth=0)
    axes.fill_between(x, rows["score_25"][both], rows["score_75"][both], color=PEOPLE, alpha=0.25, linewidth=0)
    axes.plot(x, rows["score"][both], color=PEOPLE, marker="o", markersize=4)
    axes.annotate("people: mean,\nmiddle 50 % and 80 %", (x[3], 0.75), color=PEOPLE, ha="center")
    best = persons["score"].max()
    for value, text in ((persons["ceiling"].mean(), "best plan with the better boat"), (best, "best person")):
        axes.axhline(value, color=INK if value > best else PEOPLE, linewidth=1, linestyle="-" if value > best else "-.")
        axes.annotate(text, (0, value), xytext=(2, 3), textcoords="offset points")
    axes.set(
        xlabel="episode", ylabel="score", xlim=(0, 360), ylim=(0, 4), title="People learn, and stay below the ceiling"
    )


def draw_gaps(axes: Axes) -> None:
    rows = load("people")
    order = np.argsort(rows["gap"])
    x = np.arange(len(order))
    axes.bar(x, rows["press_gap"][order], color=PRESSES, width=0.8, label="lost with the keys")
    bottom = rows["press_gap"][order]
    axes.bar(
        x, rows["choice_gap"][order], bottom=bottom, color=CHOICE, width=0.8, label="lost by the choice of the boat"
    )
    axes.set(
        xlabel="people, best first", xticks=[], ylabel="score below the best plan", title="Optimality gap, own layouts"
    )
    axes.legend(frameon=False, loc="upper left")


def draw_choices(axes: Axes) -> None:
    rows = load("choices")
    for block, colour, label in ((-1, PEOPLE, "people"), (0, FAINT, "first 60"), (5, INK, "last 60")):
        own = rows["block"] == block
        share, num = rows["congruent"][own], rows["episodes"][own]
        error = 1.96 * np.sqrt(share * (1 - share) / num)
        axes.errorbar(
            rows["offset"][own] + 5, share, error, color=colour, marker="o", markersize=4, capsize=2, label=label
        )
    every = rows["block"] < 0
    axes.plot(rows["offset"][every] + 5, rows["congruent_is_better"][every], color=PRESSES, marker="s", markersize=4,
              label="better boat")  # fmt: skip
    axes.set(xlim=(0, 60), ylim=(0, 1), title="Congruent boat chosen")
    axes.set_xlabel("degrees between bearing and congruent boat's nearest key")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    axes.legend(frameon=False, loc="lower left")


def draw_better_boat(axes: Axes) -> None:
    rows = load("people")
    axes.scatter(rows["better_boat"], rows["score"], color=PEOPLE, s=18)
    axes.set(xlabel="episodes with the better boat", ylabel="score", title="Choosing well and scoring well, 40 people")
    axes.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
    correlation = np.corrcoef(rows["better_boat"], rows["score"])[0, 1]
    axes.annotate(f"correlation {correlation:.2f}", (0.97, 0.03), xycoords="axes fraction", ha="right")


def draw_singles(axes: Axes) -> None:
    rows = load("singles")
    for code, colour, label in ((1, GOOD, "docked"), (2, FAST, "too fast"), (-1, SHORT, "dock not reached")):
        own = rows["outcome"] == code if code > 0 else rows["outcome"] > 2
        wrong = own & (_reached(rows["outcome"]) != _reached(rows["predicted"]))
        axes.scatter(rows["pressed"][own], rows["to_dock"][own], s=8, color=colour, label=f"{label} ({own.sum()})")
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
    axes.set_title("Single presses (ringed: told wrong)")
    axes.legend(frameon=False, loc="upper left")


def duration_at(speed: float) -> torch.Tensor:
    """Return the seconds of pressing after which the boat is this fast (px/s)."""
    times = torch.linspace(0.0, physics.MAX_DURATION, 20_001)
    return times[(physics.speed(times) - speed).abs().argmin()]


def _reached(outcome: np.ndarray) -> np.ndarray:
    return np.where((outcome == physics.SUCCESS) | (outcome == physics.TOO_FAST), outcome, 0)


def draw_ways(axes: Axes) -> None:
    rows = load("first_presses")
    axes.hist(rows["travelled"] / rows["pressed"], bins=np.arange(0.9, 2.25, 0.05), color=PEOPLE)
    for edge, text in ((1.0, "no glide"), (1.0 + physics.GLIDE, "at rest")):
        axes.axvline(edge, color=INK, linewidth=1)
        axes.annotate(text, (edge, 74), ha="center", bbox={"facecolor": "white", "edgecolor": "none", "pad": 1})
    axes.set(xlabel="px until the next press / px while the key is down", ylabel="first presses", ylim=(0, 78))
    axes.set_title(f"{rows['is_inside'].mean():.1%} of {len(rows['pressed'])} inside the band")


def draw_agreement(axes: Axes) -> None:
    rows = load("agreement")
    glides, speeds = np.unique(rows["glide"]), np.unique(rows["docking_speed"])
    share = rows["agreement"].reshape(len(glides), len(speeds))
    image = axes.pcolormesh(speeds, glides, share, cmap="viridis", vmin=0.7, shading="nearest", rasterized=True)
    axes.figure.colorbar(image, ax=axes, format=PercentFormatter(1.0, decimals=0), label="outcomes told right")
    fit = {row: i for i, row in enumerate(load("fit")["constant"])}
    values = load("fit")
    for name, colour, label in (("likely", "white", "most likely"), ("agreeing", FAST, "most told right")):
        y, x = (fit[f"{name}_{constant}"] for constant in ("glide", "speed"))
        errors = [np.abs(np.array([[values["low"][i]], [values["high"][i]]]) - values["value"][i]) for i in (x, y)]
        axes.errorbar(values["value"][x], values["value"][y], yerr=errors[1], xerr=errors[0], color=colour, marker="o",
                      capsize=3, label=label)  # fmt: skip
    axes.plot(physics.DOCKING_SPEED, physics.GLIDE, "k*", markersize=11, label="ours")
    axes.set(xlabel="docking speed, px/s", ylabel="glide", title="Constants, with 95 % intervals")
    axes.legend(frameon=True, loc="lower right", fontsize=8)


def cells(rows: dict[str, np.ndarray], of_blocks: np.ndarray) -> str:
    """Return a line's cells: means over the episodes of these blocks."""

    def mean(name: str, controller: int = -1) -> float:
        own = of_blocks & (rows["controller"] == controller)
        return np.average(rows[name][own], weights=rows["episodes"][own])

    shares = [f"{mean(name):.1%}" for name in ("success", "too_fast", "out_of_bounds", "out_of_fuel")]
    scores = [f"{mean('score', controller):.3f}" for controller in (-1, 1, 0)]
    gaps = [f"{mean(name):.2f}" for name in ("presses", "press_gap", "choice_gap")]
    return " | ".join([*scores, *shares, *gaps])


def tabulate() -> None:
    """Print the tables of the page."""
    rows = load("blocks")
    print("| episodes | score | congruent | incongruent | success | too fast | out | no fuel | presses | keys | boat |")
    print("|---|" + "---|" * 10)
    for block in np.unique(rows["block"]):
        print(f"| {60 * block + 1:.0f} to {60 * block + 60:.0f} | {cells(rows, rows['block'] == block)} |")
    print(f"| all | {cells(rows, np.ones_like(rows['block'], dtype=bool))} |")
    persons = load("people")
    for name in ("score", "success", "better_boat", "gap", "press_gap", "choice_gap", "ceiling", "score_last_60"):
        low, middle, high = np.quantile(persons[name], [0, 0.5, 1])
        print(f"{name}: mean {persons[name].mean():.3f}, people from {low:.3f} to {high:.3f}, median {middle:.3f}")
    fit = load("fit")
    for i, name in enumerate(fit["constant"]):
        print(f"{name} {fit['value'][i]:g} ({fit['low'][i]:g} to {fit['high'][i]:g})")
    agreement = load("agreement")
    ours = (np.abs(agreement["glide"] - 0.94) < 0.015) & (agreement["docking_speed"] == 74)
    print(f"best agreement {agreement['agreement'].max():.3f}; near ours {agreement['agreement'][ours]}")


def main(words: Sequence[str]) -> None:
    """Measure, if asked; draw, tabulate."""
    if list(words) == ["measure"]:
        measure()
    elif words:
        sys.exit(__doc__)
    draw()
    tabulate()


if __name__ == "__main__":
    main(sys.argv[1:])
