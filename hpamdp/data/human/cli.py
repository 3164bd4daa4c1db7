"""The command line of the human data: `python -m hpamdp.data.human download | check | summary | export`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from hpamdp.data.human import export, minari, statistics, validation
from hpamdp.data.human.download import download
from hpamdp.data.human.episodes import scores_of_people, select
from hpamdp.data.human.errors import HumanDataError
from hpamdp.data.human.released_file import FILE_NAME, PATH_VARIABLE, QUIRKS, SHA256, HumanData, default_path, read
from hpamdp.data.human.transitions import transitions
from hpamdp.env.boatdock import harbour
from hpamdp.env.boatdock.reference import OFFSET_EDGES, Figures

_MISTAKE, _INTERRUPTED = 2, 130
_FORMATS = ("csv", "npz", "memmap", "minari")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, 2 (a mistake, told in one line) or 130 (interrupted)."""
    given = _parser().parse_args(arguments)
    try:
        given.run(given)
    except HumanDataError as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return _MISTAKE
    except KeyboardInterrupt:
        return _INTERRUPTED
    return 0


class _Parser(argparse.ArgumentParser):
    """One that refuses in one line, like the rest of hpamdp."""

    def error(self, message: str) -> None:
        self.exit(_MISTAKE, f"{message}; see --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="python -m hpamdp.data.human", description="What people did at the boats: get it, check it, sum it up."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    get = commands.add_parser("download", help="fetch the released file into the user's cache")
    get.add_argument("--url", required=True, help=f"where {FILE_NAME} lies in the paper's repository")
    get.add_argument("--to", type=Path, help=f"the file to make (default {default_path()})")
    get.set_defaults(run=_download)

    read_arguments = _Parser(add_help=False)
    read_arguments.add_argument(
        "file", nargs="?", type=Path, help=f"the recording (default ${PATH_VARIABLE}, else the one in the cache)"
    )
    read_arguments.add_argument(
        "--any-file", action="store_true", help="take a file of the same schema, whatever its checksum"
    )
    check = commands.add_parser("check", parents=[read_arguments], help="does the file hold what it should?")
    check.set_defaults(run=_check)
    summary = commands.add_parser("summary", parents=[read_arguments], help="people's scores, choices and outcomes")
    summary.add_argument("--json", action="store_true", help="as json, by person, block and controller")
    summary.set_defaults(run=_summary)

    out = commands.add_parser("export", parents=[read_arguments], help="write it for other programs")
    out.add_argument("--to", required=True, help="file or folder to make, or the Minari data set's name")
    out.add_argument("--format", required=True, choices=_FORMATS)
    out.add_argument("--complete", action="store_true", help="only completely logged episodes")
    out.add_argument("--successes", action="store_true", help="only episodes that docked")
    out.add_argument("--best-people", type=int, metavar="K", help="only the K people of the best mean score")
    out.add_argument("--controller", choices=harbour.CONTROLLERS, help="only the episodes with this boat")
    out.add_argument("--one-frame", action="store_true", help="csv, npz: every harbour at the environment's centre")
    out.add_argument("--reward", default="paper", choices=("paper", "sparse"), help="memmap, minari")
    out.add_argument("--observation", default="scaled", choices=("scaled", "pixels"), help="memmap, minari")
    out.set_defaults(run=_export)
    return parser


def _read(given: argparse.Namespace, one_frame: bool = False) -> HumanData:
    return read(given.file, checksum=None if given.any_file else SHA256, one_frame=one_frame)


def _download(given: argparse.Namespace) -> None:
    print(download(given.url, given.to))


def _check(given: argparse.Namespace) -> None:
    data = _read(given)
    episodes, presses = data
    is_released = "any file was allowed" if given.any_file else f"SHA-256 {SHA256}"
    people = episodes["person"].unique()
    print(f"{given.file or default_path()}: {is_released}")
    print(f"{len(people)} people, {len(episodes)} episodes, {len(presses)} presses; contents fit together")
    print(f"episodes without a press {(episodes['presses'] == 0).sum()}, with a single one "
          f"{(episodes['presses'] == 1).sum()}, completely logged {episodes['complete'].sum()}")  # fmt: skip
    first = torch.stack([(episodes["person"] == person).nonzero()[0, 0] for person in people])
    for column, name in (("centre", "harbour at"), ("keymap", "key map")):
        values, counts = episodes[column][first].unique(dim=0, return_counts=True)
        told = [f"{name} {value.int().tolist()}: {count} people" for value, count in zip(values, counts, strict=True)]
        print("; ".join(told))
    print(f"longest press {presses['duration'].max():.2f} s")
    singles, ways = validation.single_presses(data), validation.first_presses(data)
    if len(singles.outcome):
        share = validation.agreement(singles)
        print(f"replayed in our physics: {share:.1%} of {len(singles.outcome)} single presses end as recorded")
    if len(ways.is_inside):
        print(f"first presses go as far as our physics allows: {ways.is_inside.float().mean():.1%} "
              f"of {len(ways.is_inside)}")  # fmt: skip
    print("To know:", *QUIRKS, sep="\n- ")


def _summary(given: argparse.Namespace) -> None:
    data = _read(given)
    by = {column: statistics.figures_by(data, column) for column in ("controller", "block", "person")}
    curve = statistics.choice_curve(data)
    if given.json:
        curve = [None if share != share else share for share in curve.tolist()]
        print(json.dumps({"all": statistics.figures(data), **by, "congruent_by_offset": curve}, indent=1))
        return
    print(f"{'':24}{'episodes':>8}  {'score':>7}  {'success':>7}  {'too fast':>8}  {'out':>6}  {'no fuel':>7}  presses")
    _print_row("all", statistics.figures(data))
    for option in by["controller"]:
        _print_row(harbour.CONTROLLERS[option], by["controller"][option])
    for block, figures in by["block"].items():
        _print_row(f"episodes {60 * block + 1} to {60 * block + 60}", figures)
    best = int(scores_of_people(data).nan_to_num(nan=-torch.inf).argmax())
    _print_row(f"best person ({best})", by["person"][best])
    print("congruent boat chosen, by degrees between the bearing and its nearest direction:")
    bins = zip(OFFSET_EDGES[:-1], OFFSET_EDGES[1:], curve, strict=True)
    print(", ".join(f"{low}-{high}: {share:.3f}" for low, high, share in bins))


def _print_row(name: str, figures: Figures) -> None:
    print(
        f"{name:24}{figures['episodes']:8}  {figures['score']:7.3f}  {figures['success']:7.1%}  "
        f"{figures['too_fast']:8.1%}  {figures['out_of_bounds']:6.1%}  {figures['out_of_fuel']:7.1%}  "
        f"{figures['presses']:7.2f}"
    )


def _export(given: argparse.Namespace) -> None:
    is_raw = given.format in ("csv", "npz")
    data = select(
        _read(given, one_frame=given.one_frame or not is_raw),
        complete=given.complete,
        successes=given.successes,
        best_people=given.best_people,
        controller=given.controller,
    )
    if is_raw:
        (export.write_csv if given.format == "csv" else export.write_npz)(data, Path(given.to))
    else:
        batch = transitions(data, reward=given.reward, observation=given.observation)
        if given.format == "memmap":
            export.write_memmap(batch, Path(given.to))
        else:
            minari.export(batch, given.to)
    print(f"{given.to}: {len(data.episodes)} episodes, {len(data.presses)} presses")
