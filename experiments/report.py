"""Draw and tabulate every study again from its csv files, and renew all pages.

python experiments/report.py    runs `main([])` of every study.py; renews the tables in the Markdown pages, and the
                                numbers in their sentences (fill_numbers.py), of which it names those that differed

In the page of a study, `<!-- table -->` and `<!-- /table -->` enclose all its tables. In every page, `<!-- table 2 of
STUDY -->` and `<!-- /table -->` enclose the second table of a study. In docs/, tables made from csv files and from rows
of a study's tables are renewed by docs/hooks.py, which explains their marks.
"""

from __future__ import annotations

import importlib.util
import io
import re
import sys
from collections.abc import Mapping
from contextlib import redirect_stdout
from pathlib import Path
from types import ModuleType

import fill_numbers

from hpamdp.figure_style import with_minus
from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
TABLE = re.compile(
    r"(?P<opening><!-- table(?: (?P<number>\d+) of (?P<study>\w+))? -->\n).*?(?P<closing><!-- /table -->)", re.DOTALL
)
PAGES = ("README.md", "agents/README.md", "docs/*.md", "experiments/*/README.md")


def report(experiments: Path) -> list[str]:
    """Renew figures, tables and the numbers of sentences.

    Args:
        experiments: the folder of the studies. The pages beside it are renewed as well.

    Returns:
        A line for each failure.
    """
    failures: list[str] = []
    tables: dict[str, str] = {}
    for script in sorted(experiments.glob("*/study.py")):
        try:
            tables[script.parent.name] = tables_in(run(script))
        except (Exception, SystemExit) as error:  # one failing study must not stop the others
            failures.append(f"{script.parent.name}: {type(error).__name__}: {error}")
    root = experiments.parent
    for page in (page for pattern in PAGES for page in sorted(root.glob(pattern))):
        failures += renew(page, tables)
    return failures + renew_filled(root / "docs") + fill_numbers.differences(root, write=True)


def load(script: Path) -> ModuleType:
    """Return a script as a module. Each call runs it anew."""
    spec = importlib.util.spec_from_file_location(f"{script.parent.name}_{script.stem}", script)
    if spec is None or spec.loader is None:
        raise ImportError(f"{script} is no Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def run(script: Path) -> str:
    """Run `main([])` of a study, and return the printed text."""
    with redirect_stdout(io.StringIO()) as printed:
        load(script).main([])
    return printed.getvalue()


def tables_in(printed: str) -> str:
    """Return the printed lines from the first of the first table to the last of the last table, with minus signs.

    Raises:
        ValueError: there is no table.
    """
    lines = printed.splitlines()
    rows = [number for number, line in enumerate(lines) if line.startswith("|")]
    if not rows:
        raise ValueError("it prints no table")
    return with_minus("\n".join(lines[rows[0] : rows[-1] + 1]))


def renew(page: Path, tables: Mapping[str, str]) -> list[str]:
    """Put the tables of studies, which are separated by empty lines, between the markers of a page.

    If a study failed or lacks a table, the current table stays. The page is written only if something changes.

    Returns:
        A line for each table that a study lacks.
    """
    missing = []

    def table(found: re.Match[str]) -> str:
        study, number = found["study"] or page.parent.name, found["number"]
        if study not in tables:
            return found[0]
        of_study = tables[study].split("\n\n") if number else [tables[study]]
        place = int(number or 1) - 1
        if not 0 <= place < len(of_study):
            missing.append(f"{page.name}: no table {number} of {study}")
            return found[0]
        return f"{found['opening']}{of_study[place]}\n{found['closing']}"

    text = page.read_text(encoding="utf-8")
    renewed = TABLE.sub(table, text)
    if renewed != text:
        page.write_text(renewed, encoding="utf-8")
    return missing


def renew_filled(docs: Path) -> list[str]:
    """Renew the tables that the directives of docs/hooks.py describe, in all pages of docs/.

    Returns:
        A line for each page with a directive that leads nowhere.
    """
    if not (docs / "hooks.py").exists():
        return []
    hooks = load(docs / "hooks.py")
    failures = []
    for page in sorted(docs.rglob("*.md")):
        text = page.read_text(encoding="utf-8")
        try:
            renewed = hooks.with_tables(text)
        except (hooks.SiteError, OSError) as error:
            failures.append(f"{page.name}: {error}")
            continue
        if renewed != text:
            page.write_text(renewed, encoding="utf-8")
    return failures


def main() -> int:
    """Renew the pages of this repository, and return 1 if anything failed, else 0."""
    failures = report(HERE)
    for line in failures:
        print(line, file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
