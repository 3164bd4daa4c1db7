"""The command line for the recording: `python -m hpamdp.data.human download | check | summary | models | export`."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor

from hpamdp.data import DataError, export
from hpamdp.data.human import minari, models, played_file, statistics, validation
from hpamdp.data.human.download import download
from hpamdp.data.human.episodes import scores_by_person, select
from hpamdp.data.human.options import SHA256
from hpamdp.data.human.press_model import UPDATES
from hpamdp.data.human.released_file import (
    EPISODES_PER_BLOCK,
    FILE_NAME,
    PATH_VARIABLE,
    QUIRKS,
    HumanData,
    default_path,
    read,
)
from hpamdp.data.human.transitions import NO_PRESS, transitions
from hpamdp.env.boatdock import harbour
from hpamdp.env.boatdock.reference import OFFSET_EDGES, Figures
from hpamdp.messages import INTERRUPTED, MISTAKE, exit_code, one_line, say, warn

_TABLE_FORMATS = ("csv", "npz")
_TRANSITION_FORMATS = ("memmap", "minari")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: the words after the program's name. If None, the words from the command line.

    Returns:
        The exit code: 0 after success, 1 if stdout cannot be written, 2 after an error, 130 after an interrupt. An
        error is printed to stderr in one line.
    """
    return exit_code(lambda: _main(arguments))


def _main(arguments: Sequence[str] | None) -> int:
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except DataError as error:
        warn(one_line(error))
        return MISTAKE
    except KeyboardInterrupt:
        return INTERRUPTED
    return 0


class _Parser(argparse.ArgumentParser):
    """A parser that reports errors in one line, like all of hpamdp."""

    def error(self, message: str) -> NoReturn:
        self.exit(MISTAKE, f"{message}; see --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="python -m hpamdp.data.human",
        description="Fetch, check, summarise, model and export the recording of 40 people at the boat-docking task.",
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND", parser_class=_Parser)

    download_parser = commands.add_parser("download", help="fetch the released file into the user's cache")
    download_parser.add_argument("--url", required=True, help=f"address of {FILE_NAME} in the paper's repository")
    download_parser.add_argument("--to", type=Path, help=f"file to make (default {default_path()})")
    download_parser.set_defaults(run=_download)

    file_arguments = _Parser(add_help=False)
    file_arguments.add_argument(
        "file",
        nargs="?",
        type=Path,
        help=f"the recording (default: ${PATH_VARIABLE}, else the one in the cache), or a .jsonl of `hpamdp play`",
    )
    file_arguments.add_argument(
        "--any-file", action="store_true", help="accept any file of the same schema, whatever its checksum"
    )

    check_parser = commands.add_parser(
        "check", parents=[file_arguments], help="check the file's contents, and compare our physics with them"
    )
    check_parser.set_defaults(run=_check)

    summary_parser = commands.add_parser(
        "summary", parents=[file_arguments], help="print people's scores, outcomes and choices"
    )
    summary_parser.add_argument("--json", action="store_true", help="print json, by person, block and controller")
    summary_parser.set_defaults(run=_summary)

    models_parser = commands.add_parser(
        "models",
        parents=[file_arguments],
        help="fit models of people's choices and presses, test them on other people, and simulate people",
    )
    models_parser.add_argument("--folds", type=int, default=5, metavar="K", help="folds of people (default 5)")
    models_parser.add_argument("--updates", type=int, default=UPDATES, help=f"of a press model (default {UPDATES})")
    models_parser.add_argument(
        "--seed", type=_seed, default=0, help="seed of folds, models and simulated people (default 0)"
    )
    models_parser.add_argument(
        "--recorded", action="store_true", help="model the presses as they were recorded; simulate nobody"
    )
    models_parser.add_argument("--json", action="store_true", help="print json, by person, block and controller")
    models_parser.set_defaults(run=_models)

    export_parser = commands.add_parser(
        "export", parents=[file_arguments], help="write the tables or the transitions for other programs"
    )
    export_parser.add_argument("--to", required=True, help="file or folder to make, or name of the Minari data set")
    export_parser.add_argument("--format", required=True, choices=(*_TABLE_FORMATS, *_TRANSITION_FORMATS))
    export_parser.add_argument("--complete", action="store_true", help="only completely logged episodes")
    export_parser.add_argument("--successes", action="store_true", help="only episodes that ended in the dock")
    export_parser.add_argument(
        "--best-people", type=int, metavar="K", help="only episodes of the K people with the highest mean score"
    )
    export_parser.add_argument("--controller", choices=harbour.CONTROLLERS, help="only episodes with this controller")
    export_parser.add_argument(
        "--one-frame", action="store_true", help="csv, npz: move every harbour to the environment's centre"
    )
    export_parser.add_argument(
        "--reward", choices=("paper", "sparse"), help="memmap, minari: the reward (default paper)"
    )
    export_parser.add_argument(
        "--observation", choices=("scaled", "pixels"), help="memmap, minari: the observation (default scaled)"
    )
    export_parser.set_defaults(run=_export)
    return parser


def _seed(text: str) -> int:
    seed = int(text)
    if not 0 <= seed < 2**63:
        raise argparse.ArgumentTypeError("must be from 0 to 2**63 - 1")
    return seed


def _read(options: argparse.Namespace, one_frame: bool = False) -> HumanData:
    if _is_played(options):
        return played_file.read(options.file)
    return read(options.file, checksum=None if options.any_file else SHA256, one_frame=one_frame)


def _is_played(options: argparse.Namespace) -> bool:
    """Return whether the file comes from `hpamdp play`."""
    return options.file is not None and options.file.suffix == played_file.SUFFIX


def _download(options: argparse.Namespace) -> None:
    say(str(download(options.url, options.to)))


def _check(options: argparse.Namespace) -> None:
    if _is_played(options):
        num = played_file.verify(options.file)
        checksum = f"all {num} episodes, including practice, follow from their key events"
    else:
        checksum = "any file was allowed" if options.any_file else f"SHA-256 {SHA256}"
    data = _read(options)
    episodes, presses = data
    people = episodes["person"].unique()
    say(f"{options.file or default_path()}: {checksum}")
    say(f"{len(people)} people, {len(episodes)} episodes, {len(presses)} presses")
    num_empty = (episodes["presses"] == 0).sum()
    num_single = (episodes["presses"] == 1).sum()
    say(
        f"episodes without a press {num_empty}, with a single press {num_single}, "
        f"completely logged {episodes['complete'].sum()}"
    )
    first_episodes = torch.stack([(episodes["person"] == person).nonzero()[0, 0] for person in people])
    _print_counts("harbour at", episodes["centre"][first_episodes])
    _print_counts("key map", episodes["keymap"][first_episodes])
    if not len(presses):
        say(NO_PRESS)
        return
    say(f"longest press {presses['duration'].max():.2f} s")
    singles = validation.single_presses(data)
    if len(singles.outcome):
        fraction = validation.agreement(singles)
        say(f"replayed in our physics: {fraction:.1%} of {len(singles.outcome)} single presses end as recorded")
    firsts = validation.first_presses(data)
    if len(firsts.is_inside):
        fraction = firsts.is_inside.float().mean().item()
        say(f"first presses cover a distance that our physics allows: {fraction:.1%} of {len(firsts.is_inside)}")
    if not _is_played(options):
        say("\n- ".join(("Know before you use it:", *QUIRKS)))


def _print_counts(name: str, values: Tensor) -> None:
    """Print the number of people with each distinct value of `[people]` or `[people, K]`."""
    distinct, counts = values.unique(dim=0, return_counts=True)
    say(
        "; ".join(
            f"{name} {value.int().tolist()}: {count} people" for value, count in zip(distinct, counts, strict=True)
        )
    )


def _figures(data: HumanData) -> dict[str, Any]:
    """Return figures of all episodes and by controller, block and person, and the curve of choices."""
    by = {column: statistics.figures_by(data, column) for column in ("controller", "block", "person")}
    return {"all": statistics.figures(data), **by, "congruent_by_offset": statistics.choice_curve(data).tolist()}


def _summary(options: argparse.Namespace) -> None:
    data = _read(options)
    figures = _figures(data)
    if options.json:
        say(json.dumps(_without_nan(figures), indent=1, allow_nan=False))
        return
    _print_head()
    _print_row("all", figures["all"])
    for option, of_option in figures["controller"].items():
        _print_row(harbour.CONTROLLERS[option], of_option)
    _print_blocks(figures["block"])
    best = int(scores_by_person(data).nan_to_num(nan=-torch.inf).argmax())
    _print_row(f"best person ({best})", figures["person"][best])
    say("congruent controller chosen, by degrees between the bearing and its nearest direction:")
    _print_curve("", figures["congruent_by_offset"])


def _models(options: argparse.Namespace) -> None:
    data = _read(options, one_frame=True)
    if not len(data.presses):
        raise DataError(NO_PRESS)
    if options.updates < 1:
        raise DataError(f"--updates {options.updates}, but must be at least 1")
    settings = {"updates": options.updates, "seed": options.seed}
    folds = {
        "at random": models.folds_at_random(data, options.folds, options.seed),
        "by number": models.halves_by_number(data),
    }
    losses = {
        name: models.held_out_losses(data, each, rest_to_rest=not options.recorded, **settings)
        for name, each in folds.items()
    }
    found: dict[str, Any] = {"held_out": {name: each.summary(data) for name, each in losses.items()}}
    if not options.recorded:
        found |= {"people": _figures(data), "simulated": _figures(models.simulate(data, **settings))}
    if options.json:
        say(json.dumps(_without_nan(found), indent=1, allow_nan=False))
        return
    say(f"{'nats on people held out':36}{'choice':>7}  {'six bins':>8}  {'key':>6}  {'duration':>8}")
    at_random, by_number = (found["held_out"][name] for name in folds)
    _print_losses(f"{options.folds} folds of people at random", at_random["all"])
    for block, of_block in at_random["block"].items():
        _print_losses(_episodes_of(block), of_block)
    _print_losses("halves by number", by_number["all"])
    for half in folds["by number"]:
        mask = torch.isin(data.episodes["person"], half)
        _print_losses(f"people {half[0]} to {half[-1]}", losses["by number"].means(mask))
    for name in ("people", "simulated"):
        if name in found:
            say("")
            _print_head()
            _print_row(name, found[name]["all"])
            _print_blocks(found[name]["block"])
            _print_curve("congruent by degrees off its direction: ", found[name]["congruent_by_offset"])


def _print_losses(name: str, losses: Figures) -> None:
    say(f"{name:36}{losses['choice']:7.3f}  {losses['bins']:8.3f}  {losses['key']:6.3f}  {losses['duration']:8.3f}")


def _print_head() -> None:
    say(f"{'':24}{'episodes':>8}  {'score':>7}  {'success':>7}  {'too fast':>8}  {'out':>6}  {'no fuel':>7}  presses")


def _print_blocks(by_block: dict[int, Figures]) -> None:
    for block, figures in by_block.items():
        _print_row(_episodes_of(block), figures)


def _episodes_of(block: int) -> str:
    first = EPISODES_PER_BLOCK * block + 1
    return f"episodes {first} to {first + EPISODES_PER_BLOCK - 1}"


def _print_curve(name: str, curve: Sequence[float]) -> None:
    bins = zip(OFFSET_EDGES[:-1], OFFSET_EDGES[1:], curve, strict=True)
    say(name + ", ".join(f"{low}-{high}: {probability:.3f}" for low, high, probability in bins))


def _without_nan(value: Any) -> Any:
    """Return nested values with None in place of NaN, which JSON lacks."""
    if isinstance(value, dict):
        return {name: _without_nan(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_without_nan(part) for part in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _print_row(name: str, figures: Figures) -> None:
    say(
        f"{name:24}{figures['episodes']:8}  {figures['score']:7.3f}  {figures['success']:7.1%}  "
        f"{figures['too_fast']:8.1%}  {figures['out_of_bounds']:6.1%}  {figures['out_of_fuel']:7.1%}  "
        f"{figures['presses']:7.2f}"
    )


def _export(options: argparse.Namespace) -> None:
    is_table = options.format in _TABLE_FORMATS
    _refuse_options_without_effect(options, is_table=is_table)
    data = select(
        _read(options, one_frame=options.one_frame or not is_table),
        complete=options.complete,
        successes=options.successes,
        best_people=options.best_people,
        controller=options.controller,
    )
    if is_table:
        _export_tables(data, options)
    else:
        _export_transitions(data, options)
    say(f"{options.to}: {len(data.episodes)} episodes, {len(data.presses)} presses")


def _refuse_options_without_effect(options: argparse.Namespace, *, is_table: bool) -> None:
    given = {
        f"--reward {options.reward}": is_table and options.reward is not None,
        f"--observation {options.observation}": is_table and options.observation is not None,
        "--one-frame": not is_table and options.one_frame,
    }
    ignored = [option for option, is_ignored in given.items() if is_ignored]
    if ignored:
        of = "tables, which hold what was recorded" if is_table else "transitions, which always have one frame"
        raise DataError(f"{', '.join(ignored)}: no effect on {of}; leave it out with --format {options.format}")


def _export_tables(data: HumanData, options: argparse.Namespace) -> None:
    if options.format == "csv":
        export.write_csv(data._asdict(), Path(options.to), axes=("x", "y"))
    else:
        export.write_npz(data._asdict(), Path(options.to))


def _export_transitions(data: HumanData, options: argparse.Namespace) -> None:
    rows = transitions(data, reward=options.reward or "paper", observation=options.observation or "scaled")
    if options.format == "memmap":
        export.write_memmap(rows, Path(options.to))
    else:
        minari.export(rows, options.to)
