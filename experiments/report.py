"""Draw and tabulate every study again from its csv files, and collect all pages in one report.

python experiments/report.py    runs `main([])` of every study.py; renews the tables in the Markdown pages, and the
                                numbers in their sentences (fill_numbers.py), of which it names
                                those that differed; writes report/report.html, and every
                                figure as SVG

In the page of a study, `<!-- table -->` and `<!-- /table -->` enclose all its tables, and `<!-- table 2 of STUDY -->`
and `<!-- /table -->` the second one. So they do in the project's README, in that of agents/ and in docs/, there for
every study. In docs/, tables made from csv files and from rows of a study's tables are renewed by docs/hooks.py, which
explains their marks.
"""

from __future__ import annotations

import base64
import html
import io
import mimetypes
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from unittest import mock

import fill_numbers
import markdown
import modules
from matplotlib.figure import Figure

from hpamdp.messages import exit_code

HERE = Path(__file__).resolve().parent
TABLE = re.compile(
    r"(?P<opening><!-- table(?: (?P<number>\d+) of (?P<study>\w+))? -->\n).*?(?P<closing><!-- /table -->)", re.DOTALL
)
# First pages of the report; the others follow by name.
FIRST = ("table1", "learners", "hierarchy", "quickstart", "human")
STYLE = """
body { font: 16px/1.5 sans-serif; max-width: 62em; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; font-size: 85%; display: block; overflow-x: auto; margin: 1em 0 }
td, th { border-bottom: 1px solid #ddd; padding: .25em .6em; text-align: left }
img { max-width: 100% } pre { background: #f5f5f5; padding: .8em; overflow-x: auto }
section { border-top: 3px solid #222 }
"""


def report(experiments: Path, target: Path) -> list[str]:
    """Renew figures, tables and the report.

    Args:
        experiments: the folder of the studies. The tables of README.md, agents/README.md and docs/ beside it are
            renewed as well.
        target: the folder of the report.

    Returns:
        A line for each failure.
    """
    failures: list[str] = []
    tables: dict[str, str] = {}
    pages: list[tuple[str, str]] = []
    target.mkdir(parents=True, exist_ok=True)
    for folder in sorted(filter(Path.is_dir, experiments.iterdir()), key=_order):
        if (folder / "study.py").exists():
            try:
                tables[folder.name] = tables_in(run(folder / "study.py", target / folder.name))
            except (Exception, SystemExit) as error:  # one failing study must not stop the others
                failures.append(f"{folder.name}: {type(error).__name__}: {error}")
        if (folder / "README.md").exists():
            own = {name: text for name, text in tables.items() if name == folder.name}
            failures += renew_numbered(folder / "README.md", own)
        text = page_of(folder, tables.get(folder.name))
        if text is None:
            continue
        body, missing = to_html(text, folder)
        failures += [f"{folder.name}: no image {name}" for name in missing]
        pages.append((folder.name, body))
    root = experiments.parent
    for page in (root / "README.md", root / "agents/README.md", *sorted((root / "docs").glob("*.md"))):
        if page.exists():
            failures += renew_numbered(page, tables)
    failures += renew_filled(root / "docs")
    failures += fill_numbers.differences(root, write=True)
    (target / "report.html").write_text(bind(pages), encoding="utf-8")
    return failures


def _order(folder: Path) -> tuple[int, str]:
    place = FIRST.index(folder.name) if folder.name in FIRST else len(FIRST)
    return place, folder.name


def page_of(folder: Path, tables: str | None) -> str | None:
    """Return the text of a study's page with renewed tables. If there is no page, make one of tables and figures.

    Args:
        folder: folder of the study.
        tables: the printed tables of its study.py; None if there is no study.py or it failed.

    Returns:
        None if there is neither a page nor a study.
    """
    page = folder / "README.md"
    if page.exists():
        if tables is not None:
            renew(page, lambda found: tables if found["study"] is None else None)
        return page.read_text(encoding="utf-8")
    if not (folder / "study.py").exists():
        return None
    figures = [f"![{file.stem}]({file.name})" for file in sorted(folder.glob("*.png"))]
    return "\n\n".join([f"# {folder.name}", "There is no page of this study yet.", tables or "", *figures])


def run(script: Path, figures: Path) -> str:
    """Run `main([])` of a study, return the printed text, and save its figures also as SVG."""
    with redirect_stdout(io.StringIO()) as printed, saved_as_svg_too(figures):
        modules.load(script).main([])
    return printed.getvalue()


@contextmanager
def saved_as_svg_too(folder: Path) -> Iterator[None]:
    """Save every figure inside the block also as SVG in this folder."""
    folder.mkdir(parents=True, exist_ok=True)
    save = Figure.savefig

    def save_both(figure: Figure, path: Path, **options: object) -> None:
        save(figure, path, **options)
        save(figure, folder / f"{Path(path).stem}.svg", **options)

    with mock.patch.object(Figure, "savefig", save_both):
        yield


def tables_in(printed: str) -> str:
    """Return the printed lines from the first of the first table to the last of the last table.

    Raises:
        ValueError: there is no table.
    """
    lines = printed.splitlines()
    rows = [number for number, line in enumerate(lines) if line.startswith("|")]
    if not rows:
        raise ValueError("it prints no table")
    return "\n".join(lines[rows[0] : rows[-1] + 1])


def renew(page: Path, table_for: Callable[[re.Match[str]], str | None]) -> None:
    """Put tables between the markers of a page.

    Args:
        page: a Markdown file, which is written only if something changes.
        table_for: returns the table for a match of `TABLE`, or None to keep the current table.
    """

    def replace(found: re.Match[str]) -> str:
        table = table_for(found)
        return found[0] if table is None else f"{found['opening']}{table}\n{found['closing']}"

    text = page.read_text(encoding="utf-8")
    renewed = TABLE.sub(replace, text)
    if renewed != text:
        page.write_text(renewed, encoding="utf-8")


def renew_numbered(page: Path, tables: Mapping[str, str]) -> list[str]:
    """Put the tables of studies, which are separated by empty lines, into a page that names them by number.

    If the study failed or lacks a table, the current table stays.

    Returns:
        A line for each table that the study lacks.
    """
    missing = []

    def table_for(found: re.Match[str]) -> str | None:
        if found["study"] not in tables:
            return None
        of_study = tables[found["study"]].split("\n\n")
        number = int(found["number"])
        if 1 <= number <= len(of_study):
            return of_study[number - 1]
        missing.append(f"{page.name}: no table {number} of {found['study']}")
        return None

    renew(page, table_for)
    return missing


def renew_filled(docs: Path) -> list[str]:
    """Renew the tables that the directives of docs/hooks.py describe, in all pages of docs/.

    Returns:
        A line for each page with a directive that leads nowhere.
    """
    if not (docs / "hooks.py").exists():
        return []
    hooks = modules.load(docs / "hooks.py")
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


def to_html(text: str, folder: Path) -> tuple[str, list[str]]:
    """Return a page as HTML with its images in it, and the names of missing images."""
    missing = []

    def inline(found: re.Match[str]) -> str:
        file = folder / html.unescape(found[1])
        if not file.is_file():
            missing.append(found[1])
            return found[0]
        kind = mimetypes.guess_type(file.name)[0] or "image/png"
        return f'src="data:{kind};base64,{base64.b64encode(file.read_bytes()).decode()}"'

    body = markdown.markdown(text, extensions=["tables", "fenced_code", "sane_lists"])
    body = re.sub(r'src="(?!data:|https?:)([^"]+)"', inline, body)
    return re.sub(r'href="\.\./([^/"]+)/README\.md(?:#[^"]*)?"', r'href="#\1"', body), missing


def bind(pages: list[tuple[str, str]]) -> str:
    """Return all pages as one document with a table of contents."""
    contents = " · ".join(f'<a href="#{name}">{name}</a>' for name, _ in pages)
    sections = "\n".join(f'<section id="{name}">\n{body}\n</section>' for name, body in pages)
    head = f'<meta charset="utf-8"><title>hpamdp: experiments</title><style>{STYLE}</style>'
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n<p>{contents}</p>\n{sections}\n</body></html>\n'
    )


def main() -> int:
    """Make the report of this folder, and return 1 if anything failed, else 0."""
    target = HERE.parent / "report"
    failures = report(HERE, target)
    print(f"Everything is in {target / 'report.html'}")
    for line in failures:
        print(line, file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(exit_code(main))
