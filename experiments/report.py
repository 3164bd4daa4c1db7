"""Draw and tabulate every study again from its csv files, and put all pages into one report.

python experiments/report.py    runs main([]) of every study.py, renews the tables between `<!-- table -->` and
                                `<!-- /table -->` in the pages, and that between `<!-- table of STUDY -->` and
                                `<!-- /table -->` in the project's README, writes report/report.html and every figure
                                as SVG
"""

from __future__ import annotations

import base64
import html
import importlib.util
import io
import mimetypes
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from unittest import mock

import markdown
from matplotlib.figure import Figure

HERE = Path(__file__).resolve().parent
TABLE = re.compile(r"(<!-- table(?: of (\w+))? -->\n).*?(<!-- /table -->)", re.DOTALL)
# The pages that a reader wants first; the others follow by name.
FIRST = ("table1", "learners", "hierarchy", "quickstart", "human")
STYLE = """
body { font: 16px/1.5 sans-serif; max-width: 62em; margin: 2em auto; padding: 0 1em; color: #222 }
table { border-collapse: collapse; font-size: 85%; display: block; overflow-x: auto; margin: 1em 0 }
td, th { border-bottom: 1px solid #ddd; padding: .25em .6em; text-align: left }
img { max-width: 100% } pre { background: #f5f5f5; padding: .8em; overflow-x: auto }
section { border-top: 3px solid #222 }
"""


def report(experiments: Path, target: Path) -> list[str]:
    """Renew figures, tables and the report; return a line for everything that failed."""
    failures, pages, tables = [], [], {}
    target.mkdir(parents=True, exist_ok=True)
    folders = [folder for folder in experiments.iterdir() if folder.is_dir()]
    for folder in sorted(folders, key=lambda folder: (folder.name not in FIRST, _place(folder.name), folder.name)):
        if (folder / "study.py").exists():
            try:
                tables[folder.name] = tables_in(run(folder / "study.py", target / folder.name))
            except (Exception, SystemExit) as error:  # whatever a study does must not lose the others
                failures.append(f"{folder.name}: {type(error).__name__}: {error}")
        page = folder / "README.md"
        if page.exists():
            if folder.name in tables:
                renew(page, {None: tables[folder.name]})
            text = page.read_text(encoding="utf-8")
        elif (folder / "study.py").exists():
            figures = [f"![{file.stem}]({file.name})" for file in sorted(folder.glob("*.png"))]
            parts = [f"# {folder.name}", "There is no page of this study yet.", tables.get(folder.name, ""), *figures]
            text = "\n\n".join(parts)
        else:
            continue
        body, missing = to_html(text, folder)
        failures += [f"{folder.name}: no image {name}" for name in missing]
        pages.append((folder.name, body))
    front = experiments.parent / "README.md"
    if front.exists():
        renew(front, {name: table.split("\n\n")[0] for name, table in tables.items()})
    (target / "report.html").write_text(bind(pages), encoding="utf-8")
    return failures


def _place(name: str) -> int:
    return FIRST.index(name) if name in FIRST else len(FIRST)


def run(script: Path, figures: Path) -> str:
    """Run `main([])` of a study and return what it prints; its figures are saved as SVG, too."""
    spec = importlib.util.spec_from_file_location(f"study_{script.parent.name}", script)
    module = importlib.util.module_from_spec(spec)
    with redirect_stdout(io.StringIO()) as printed, saved_as_svg_too(figures):
        spec.loader.exec_module(module)
        module.main([])
    return printed.getvalue()


@contextmanager
def saved_as_svg_too(folder: Path) -> Iterator[None]:
    """Have every figure that is saved inside saved in this folder as SVG, so that no study has to see to it."""
    folder.mkdir(parents=True, exist_ok=True)
    save = Figure.savefig

    def save_both(figure: Figure, path: Path, **options: object) -> None:
        save(figure, path, **options)
        save(figure, folder / f"{Path(path).stem}.svg", **options)

    with mock.patch.object(Figure, "savefig", save_both):
        yield


def tables_in(printed: str) -> str:
    """Return what was printed from a table's first line to the last table's last.

    Raises:
        ValueError: there is no table.
    """
    lines = printed.splitlines()
    rows = [i for i, line in enumerate(lines) if line.startswith("|")]
    if not rows:
        raise ValueError("it prints no table")
    return "\n".join(lines[rows[0] : rows[-1] + 1])


def renew(page: Path, tables: Mapping[str | None, str]) -> None:
    """Put tables between the markers of a page, by the study that each names; without one, what is there stays."""

    def replace(found: re.Match[str]) -> str:
        return f"{found[1]}{tables[found[2]]}\n{found[3]}" if found[2] in tables else found[0]

    text = page.read_text(encoding="utf-8")
    renewed = TABLE.sub(replace, text)
    if renewed != text:
        page.write_text(renewed, encoding="utf-8")


def to_html(text: str, folder: Path) -> tuple[str, list[str]]:
    """Return a page as HTML that needs no other file, and the images that it lacks."""
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
    return re.sub(r'href="\.\./([^/"]+)/README\.md"', r'href="#\1"', body), missing


def bind(pages: list[tuple[str, str]]) -> str:
    """Return all pages as one document with a list of contents."""
    contents = " · ".join(f'<a href="#{name}">{name}</a>' for name, _ in pages)
    sections = "\n".join(f'<section id="{name}">\n{body}\n</section>' for name, body in pages)
    head = f'<meta charset="utf-8"><title>hpamdp: experiments</title><style>{STYLE}</style>'
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}</head><body>\n<p>{contents}</p>\n{sections}\n</body></html>\n'
    )


def main() -> int:
    """Make the report of this folder; return the exit code."""
    target = HERE.parent / "report"
    failures = report(HERE, target)
    print(f"Everything is in {target / 'report.html'}")
    for line in failures:
        print(line, file=sys.stderr)
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
