"""Build the site from the repository's own files, so that nothing is written twice.

- Pages outside docs/ become pages of the site: the README, the changelog, the agents, the studies.
- Relative links lead from page to page. Code that a page links to gets a page of its own. A broken link is a warning,
  and warnings are errors.
- Directives are HTML comments on lines of their own. They are replaced by text:
  `<!-- settings of conf/low/hppo.yaml -->`: all settings of the yaml's class, with bounds, default and meaning;
  `<!-- docstring of hpamdp/policies/low_level/hppo.py: Source -->`: the paragraphs of a module's docstring that begin
  with this word;
  `<!-- rows of experiments/table1/README.md, table 2: hppo -->`: the rows of a study's table by their first cell;
  `<!-- runs experiments/domains/results.csv: learner=pdqn, pdqn_published -->`: a study's runs by a column. Runs that
  differ only in their seed become one row, mean ± standard deviation. Which runs stand is the rule of the studies.
  `<!-- public names of hpamdp/__init__.pyi -->`: the names with their docstrings.
  `experiments/report.py` also writes the tables of `rows of` and `runs` into the pages themselves, up to the
  next `<!-- /table -->`, for readers of a clone. A test compares them with their sources.
- Notebooks are executed in an empty folder, and become pages with their outputs. An error in a cell ends the build.
- Every module with a docstring gets a page, which says that the module is internal.
"""

from __future__ import annotations

import ast
import base64
import functools
import json
import logging
import posixpath
import re
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parent.parent
DOCS = "docs/"
log = logging.getLogger("mkdocs.hooks.pages")

FENCE = re.compile(r"^ *```.*?^ *```[^\n]*$", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(?<=\]\()(?!https?:|mailto:|#)([^)\s#]+)(#[^)\s]*)?(?=\))")
DIRECTIVE = re.compile(r"^<!-- (settings of|docstring of|rows of|runs|public names of) (.+?) -->$", re.MULTILINE)
# A directive whose table is in the page itself.
FILLED = re.compile(r"^(<!-- (rows of|runs) (.+?) -->\n)(?:[^<\n].*\n)*<!-- /table -->\n", re.MULTILINE)
TABLE_MARK = re.compile(r"^<!-- /?table.*-->\n", re.MULTILINE)
LANGUAGES = {".py": "python", ".yaml": "yaml", ".yml": "yaml", ".csv": "text", ".toml": "toml", ".cff": "yaml"}
PICTURES = {".png", ".gif", ".svg"}
# The columns of runs that are shown, and their heads.
MEASURED = {"frames": "steps", "score": "score", "success": "success", "cpu_s": "CPU, s"}
# How a JSON schema's types and bounds are shown.
KINDS = {"number": "number", "integer": "whole number", "string": "text", "boolean": "`true`, `false`"}
KINDS |= {"null": "`null`", "array": "list", "object": "mapping"}
BOUNDS = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
PAGES = ("*.md", "agents/README.md", "experiments/*/README.md", "docs/**/*.md", "docs/**/*.ipynb")
PUBLIC_PAGE = "reference/api.md"
# Kinds of public names by the beginnings of their modules.
PUBLIC_KINDS = {
    "Environments, training, agents": "hpamdp.api.",
    "Learners": "hpamdp.policies.low_level.",
    "Selectors": "hpamdp.policies.high_level.",
    "Callbacks": "hpamdp.run.callbacks",
    "Classes to build on, errors": "hpamdp.",
}
PAGES_OF_CHOICES = {"Learners": "learners", "Selectors": "selectors"}
CELL_TIMEOUT = 600  # seconds


class SiteError(Exception):
    """A directive or a link that leads nowhere."""


def page_of(path: str) -> str | None:
    """Return the place of a file of the repository in the site, None if it is no page.

    Args:
        path: relative to the repository, as `experiments/table1/README.md`.
    """
    fixed = {
        "README.md": "index.md",
        "CHANGELOG.md": "changelog.md",
        "CONTRIBUTING.md": "contributing.md",
        "agents/README.md": "agents.md",
        "agents": "agents.md",
        "experiments": "results.md",
    }
    if path in fixed:
        return fixed[path]
    study = re.fullmatch(r"experiments/(\w+)/README\.md", path)
    if study:
        return f"studies/{study[1]}.md"
    if path.startswith(DOCS) and path.endswith((".md", ".ipynb")):
        return str(Path(path.removeprefix(DOCS)).with_suffix(".md"))
    if path.startswith("hpamdp/") and path.endswith(".py"):
        return api_page(path)
    return None


def pages() -> list[str]:
    """Return all Markdown files and notebooks of the repository that are pages."""
    files = [file for pattern in PAGES for file in ROOT.glob(pattern)]
    paths = (file.relative_to(ROOT).as_posix() for file in sorted(files))
    return [path for path in paths if page_of(path) is not None]


def modules() -> list[str]:
    """Return the package's modules that have something public to show."""
    files = (file for file in sorted((ROOT / "hpamdp").rglob("*.py")) if not file.name.startswith("__main"))
    return [file.relative_to(ROOT).as_posix() for file in files if ast.get_docstring(ast.parse(file.read_text()))]


def dotted(path: str) -> str:
    """Return a module's name, as `hpamdp.env.base` for `hpamdp/env/base.py`."""
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def api_page(path: str) -> str:
    """Return the place of a module's page in the API."""
    return f"api/{path.removesuffix('.py').replace('__init__', 'index')}.md"


def module_page(path: str) -> str:
    """Return the page of a module, which says that the module is internal."""
    name = dotted(path)
    if name == "hpamdp":
        return f"# {name}\n\n::: {name}\n"
    link = posixpath.relpath(PUBLIC_PAGE, posixpath.dirname(api_page(path)))
    note = f"Internal: this module may change between versions. [Public names]({link}) lists what stays."
    return f"# {name}\n\n{note}\n\n::: {name}\n"


def public_names(path: str) -> str:
    """Return the public names that a stub imports, by kind. Learners and selectors have pages of their own."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    names = {alias.name: f"hpamdp.{node.module}" for node in imports for alias in node.names}
    parts = []
    for title, start in PUBLIC_KINDS.items():
        chosen = {name: module for name, module in names.items() if module.startswith(start)}
        names = {name: module for name, module in names.items() if name not in chosen}
        parts.append(f"## {title}")
        if title in PAGES_OF_CHOICES:
            parts.append(choices_table(chosen, PAGES_OF_CHOICES[title]))
            continue
        for name, module in chosen.items():
            # Cross-references lead to the module's page, so that each object has one.
            options = {
                "show_root_heading": True,
                "heading": f"hpamdp.{name}",
                "heading_level": 3,
                "skip_local_inventory": True,
            }
            parts.append(f"::: {module}.{name}\n    options: {json.dumps(options)}")
    return "\n\n".join(parts)


def choices_table(names: dict[str, str], folder: str) -> str:
    """Return a table of learners or selectors: the name in Python, the choice on the command line, what it is."""
    rows = ["| Python | command line | |", "|---|---|---|"]
    for name, module in names.items():
        path = f"{module.replace('.', '/')}.py"
        choice = module.split(".")[3]
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        cls = next(node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
        sentence = (ast.get_docstring(cls) or "").partition("\n")[0]
        rows.append(f"| [`hpamdp.{name}`](../../{path}) | [`{choice}`](../{folder}/{choice}.md) | {cell(sentence)} |")
    return "\n".join(rows)


class Site:
    """The site's pages and what they need besides.

    Args:
        executes: whether to execute the notebooks. Otherwise their pages have no outputs.

    Attributes:
        pages: the text of each page, by its place in the site.
        pictures: the file of each picture, by its place in the site.
        drawn: the bytes of each picture that a notebook draws, by its place in the site.
        problems: a line for each link or directive that leads nowhere.
    """

    def __init__(self, executes: bool = False) -> None:
        self.pages: dict[str, str] = {}
        self.pictures: dict[str, Path] = {}
        self.drawn: dict[str, bytes] = {}
        self.problems: list[str] = []
        self._executes = executes
        for path in modules():
            self.pages[api_page(path)] = module_page(path)
        for path in pages():
            self.pages[str(page_of(path))] = self.converted(path)

    def converted(self, path: str) -> str:
        """Return the text of a page with its directives filled in and its links turned into the site's."""
        text = FILLED.sub(r"\1", (ROOT / path).read_text(encoding="utf-8"))
        text = TABLE_MARK.sub("", text)
        if path.endswith(".ipynb"):
            text = self._notebook(path, executed(text) if self._executes else text)

        def fill(found: re.Match[str]) -> str:
            try:
                return DIRECTIVES[found[1]](found[2])
            except (SiteError, OSError) as error:
                self.problems.append(f"{path}: {found[0]}: {error}")
                return ""

        text = outside_code(text, lambda part: DIRECTIVE.sub(fill, part))
        return outside_code(text, lambda part: LINK.sub(lambda link: self._link(path, link), part))

    def _notebook(self, path: str, text: str) -> str:
        """Return a notebook as Markdown, with the outputs that it has."""
        parts = []
        for cell in json.loads(text)["cells"]:
            source = "".join(cell["source"])
            parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
            for output in cell.get("outputs", []):
                data = output.get("data", {"text/plain": output.get("text", "")})
                if "image/png" in data:
                    name = f"{Path(path).stem}_{len(self.drawn)}.png"
                    place = posixpath.join(posixpath.dirname(str(page_of(path))), name)
                    self.drawn[place] = base64.b64decode(data["image/png"])
                    parts.append(f'<img src="../{name}" alt="What the cell above draws">')
                else:
                    printed = "".join(data["text/plain"]).rstrip()
                    parts.append(f"```text\n{printed}\n```")
        return "\n\n".join(parts) + "\n"

    def _link(self, path: str, found: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(path), found[1]))
        here = posixpath.dirname(str(page_of(path)))
        if not (ROOT / target).exists():
            self.problems.append(f"{path}: {found[1]} leads nowhere")
            return found[0]
        place = page_of(target) or self._extra(target)
        return posixpath.relpath(place, here or ".") + (found[2] or "")

    def _extra(self, target: str) -> str:
        """Return the place of a file that is no page: a picture, or a page that shows its text."""
        file = ROOT / target
        if file.suffix in PICTURES:
            place = target.removeprefix(DOCS) if target.startswith(DOCS) else f"source/{target}"
            if not target.startswith(DOCS):
                self.pictures[place] = file
            return place
        place = f"source/{target}.md"
        if file.is_dir():
            names = sorted(each.name + "/" * each.is_dir() for each in file.iterdir() if not each.name.startswith("_"))
            body = "\n".join(f"- `{name}`" for name in names)
        else:
            body = f"```{LANGUAGES.get(file.suffix, 'text')}\n{file.read_text(encoding='utf-8').rstrip()}\n```"
        self.pages[place] = f"---\nsearch:\n  exclude: true\n---\n# `{target}`\n\n{body}\n"
        return place


def with_tables(text: str) -> str:
    """Return the text of a page with the tables of its directives filled in, as a clone shows it."""
    return FILLED.sub(lambda found: f"{found[1]}{DIRECTIVES[found[2]](found[3])}\n<!-- /table -->\n", text)


@functools.cache
def executed(text: str) -> str:
    """Return a notebook with the outputs of its cells, which run in an empty folder."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.reads(text, as_version=4)
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        client = NotebookClient(notebook, timeout=CELL_TIMEOUT, resources=resources, coalesce_streams=True)
        client.execute()
    return nbformat.writes(notebook)


def outside_code(text: str, change: Callable[[str], str]) -> str:
    """Change the parts of a page that are not fenced code."""
    parts, end = [], 0
    for fence in FENCE.finditer(text):
        parts += [change(text[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join([*parts, change(text[end:])])


def settings_of(path: str) -> str:
    """Return what a yaml says at its head, and a table of all settings of its class.

    Names, bounds, defaults and sentences are those of the class's `Options`; a default that the yaml changes is the
    yaml's. A comment of the yaml explains a setting that the class does not explain.
    """
    text = (ROOT / path).read_text(encoding="utf-8")
    values = yaml.safe_load(text)
    target = values.pop("_target_", None)
    head, comments = comments_of(text)
    rows = ["| setting | values | default | meaning |", "|---|---|---|---|"]
    fields = fields_of(path, target)
    for name in [*fields, *(name for name in values if name not in fields)]:
        allowed, default, sentence = fields.get(name, ("", None, ""))
        value = values.get(name, default)
        inner = {f"{name}.{key}": each for key, each in value.items()} if isinstance(value, dict) and value else {}
        for place, (setting, each) in enumerate((inner or {name: value}).items()):
            meaning = comments.get(setting) or ("" if place else sentence or comments.get(name, ""))
            rows.append(f"| `{setting}` | {'' if inner else allowed} | `{cell(as_yaml(each))}` | {cell(meaning)} |")
    if len(rows) == 2:
        return "It has no settings."
    return "\n".join([cell(head), "", *rows])


def fields_of(path: str, target: str | None) -> dict[str, tuple[str, object, str]]:
    """Return the values, the default and the sentence of each setting of a yaml's class."""
    if target is None or not target.startswith("hpamdp."):
        return {}
    from hpamdp.config.components import SUPPLIED_ARGUMENTS, defaults_of, load_class, settings_model
    from hpamdp.settings import meanings_of

    group = Path(path).parent.name
    model = settings_model(load_class(target), SUPPLIED_ARGUMENTS.get(group, ()))
    schema, meanings = model.model_json_schema(), meanings_of(model)
    defaults = defaults_of(model)
    return {
        name: (
            allowed_values(schema["properties"][name], schema.get("$defs", {})),
            defaults[name],
            " ".join(meanings.get(name, "").split()),
        )
        for name in model.model_fields
    }


def allowed_values(schema: dict[str, Any], definitions: dict[str, Any]) -> str:
    """Return in words which values a JSON schema allows, such as `number > 0, <= 1`."""
    if "$ref" in schema:
        return allowed_values(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(allowed_values(each, definitions) for each in schema["anyOf"]))
    choices = schema.get("enum", [schema["const"]] if "const" in schema else [])
    if choices:
        return ", ".join(f"`{choice}`" for choice in choices)
    kind = str(schema.get("type", "any value"))
    words = KINDS.get(kind, kind)
    if kind == "array" and isinstance(schema.get("items"), dict) and schema["items"]:
        words = f"list: {allowed_values(schema['items'], definitions)}"
    bounds = [f"{sign} {schema[name]}" for name, sign in BOUNDS.items() if name in schema]
    return cell(" ".join([words, ", ".join(bounds)]).strip())


def comments_of(text: str) -> tuple[str, dict[str, str]]:
    """Return the comment at the head of a yaml, and those above its settings by their names."""
    head, section, comment, comments = "", "", [], {}
    for line in text.splitlines():
        entry = re.match(r"(  )?(\w+):( .+)?$", line)
        if line.lstrip().startswith("#"):
            comment.append(line.lstrip()[1:].strip())
            continue
        if entry and entry[2] != "_target_":
            section = section if entry[1] else f"{entry[2]}."
            comments[f"{section}{entry[2]}" if entry[1] else entry[2]] = " ".join(comment)
        else:
            head = head or " ".join(comment)
        comment = []
    return head, comments


def as_yaml(value: object) -> str:
    """Return a value as one writes it on the command line."""
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return re.sub(r"e([-+])0", r"e\1", repr(value))
    return json.dumps(value, default=str)


def cell(text: str) -> str:
    """Return a text as a cell of a Markdown table."""
    return text.replace("|", "\\|").replace("<", "&lt;")


def docstring_of(words: str) -> str:
    """Return the paragraphs of a module's docstring that begin with a word, as `PATH: Source`."""
    path, _, start = words.partition(": ")
    paragraphs = (ast.get_docstring(ast.parse((ROOT / path).read_text(encoding="utf-8"))) or "").split("\n\n")
    found = [paragraph for paragraph in paragraphs if paragraph.startswith(start)]
    if not found:
        raise SiteError(f"no paragraph begins with {start}")
    # The page's own headings say what these are.
    text = "\n\n".join(re.sub(r"^(Sources?|Differs from the sources?):\s", "", paragraph) for paragraph in found)
    # Docstrings have no empty line between a sentence and its list, which Markdown needs.
    text = re.sub(r":\n- ", ":\n\n- ", text)
    text = text[0].upper() + text[1:]
    return re.sub(r"arXiv([ :\n])(\d{4}\.\d{4,5})", r"arXiv\1[\2](https://arxiv.org/abs/\2)", text)


def rows_of(words: str) -> str:
    """Return rows of a table of a page by their first cell, as `PATH, table 2: hppo, random`."""
    match = re.fullmatch(r"(\S+), table (\d+): (.+)", words)
    if not match:
        raise SiteError("must read PATH, table NUMBER: ROW, ROW")
    text = (ROOT / match[1]).read_text(encoding="utf-8")
    tables = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    if int(match[2]) > len(tables):
        raise SiteError(f"it has {len(tables)} tables")
    head, line, *rows = tables[int(match[2]) - 1].splitlines()
    wanted = [name.strip() for name in match[3].split(",")]
    found = [row for row in rows if row.split("|")[1].strip() in wanted]
    missing = set(wanted) - {row.split("|")[1].strip() for row in found}
    if missing:
        raise SiteError(f"no row {', '.join(sorted(missing))}")
    return "\n".join([head, line, *found])


def runs_table(words: str) -> str:
    """Return a table of the runs in a csv file whose column has one of some values, as `PATH: column=value, value`.

    The columns before `seed` tell settings apart; of those after it the table has the means over the seeds. Runs that
    do not stand in the tables of studies, and settings with too few seeds, are left out.
    """
    from experiments.study_tables import FEWEST_SEEDS, groups, standing_rows, with_enough_seeds
    from hpamdp.analysis.statistics import spread
    from hpamdp.figure_style import with_minus

    path, _, condition = words.partition(": ")
    column, _, values = condition.partition("=")
    rows = standing_rows(ROOT / path)
    names = list(rows[0]) if rows else []
    if column not in names or "seed" not in names:
        raise SiteError(f"it has no column {column} or no column seed")
    place = names.index("seed")
    measured = [name for name in names[place + 1 :] if name in MEASURED]
    wanted = [value.strip() for value in values.split(",")]
    setting_columns = [name for name in names[:place] if name != column or len(wanted) > 1]
    shown = with_enough_seeds([row for row in rows if row[column] in wanted], *setting_columns)
    head = [*(MEASURED.get(name, name) for name in setting_columns), "seeds", *(MEASURED[name] for name in measured)]
    table = [head, ["---"] * len(head)]
    for setting, same in groups(shown, *setting_columns).items():
        numbers = [f"{value:,}" if isinstance(value, int) else cell(str(value)) for value in setting]
        spreads = [spread([row[name] for row in same], 0 if name == "cpu_s" else 3) for name in measured]
        table.append([*numbers, str(len(same)), *spreads])
    if len(table) == 2:
        return f"No {FEWEST_SEEDS} seeds of it have been run yet."
    return with_minus("\n".join(f"| {' | '.join(row)} |" for row in table))


DIRECTIVES: dict[str, Callable[[str], str]] = {
    "settings of": settings_of,
    "docstring of": docstring_of,
    "rows of": rows_of,
    "runs": runs_table,
    "public names of": public_names,
}


def studies() -> list[str]:
    """Return the places of the studies' pages, those to begin with first."""
    first = ["table1", "learners", "hierarchy", "quickstart", "human"]
    names = sorted(file.parent.name for file in ROOT.glob("experiments/*/README.md"))
    return [f"studies/{name}.md" for name in sorted(names, key=lambda n: first.index(n) if n in first else len(first))]


def api_nav() -> list[object]:
    """Return the navigation of the API, nested as the package is."""
    tree: dict[str, object] = {}
    for path in modules():
        *folders, name = Path(path).parts[1:]
        node = tree
        for folder in folders:
            node = node.setdefault(folder, {})
        node["" if name == "__init__.py" else name.removesuffix(".py")] = api_page(path)
    return list(_nested(tree))


def _nested(tree: dict[str, object]) -> Iterator[object]:
    for name, node in sorted(tree.items()):
        if isinstance(node, dict):
            yield {name: list(_nested(node))}
        else:
            yield {name: node} if name else node


def on_config(config):
    """Put the studies, the API and the pages of single choices into the navigation."""
    for item in config.nav:
        if "Results" in item:
            item["Results"] += studies()
        for inner in item.get("Reference", []):
            if "Internal modules" in inner:
                inner["Internal modules"] = api_nav()
            for title, folder in {**PAGES_OF_CHOICES, "Problems": "domains"}.items():
                if title in inner:
                    found = sorted(str(page.relative_to(ROOT / DOCS)) for page in (ROOT / DOCS / folder).glob("*.md"))
                    inner[title] += [page for page in found if page not in inner[title]]
    return config


def on_page_markdown(markdown, *, page, **others):
    """Leave out what stands beside the wide tables of results: navigation and table of contents."""
    if page.file.src_uri == "results.md" or page.file.src_uri.startswith("studies/"):
        page.meta["hide"] = ["navigation", "toc"]


def on_files(files, config):
    """Replace the pages of docs/ by their converted text, and add those from elsewhere."""
    from mkdocs.structure.files import File

    site = Site(executes=True)
    for line in site.problems:
        log.warning(line)
    for place, text in site.pages.items():
        existing = files.get_file_from_path(place)
        if existing is not None:
            files.remove(existing)
        files.append(File.generated(config, place, content=text))
    for place, content in site.drawn.items():
        files.append(File.generated(config, place, content=content))
    for place, file in site.pictures.items():
        files.append(File.generated(config, place, abs_src_path=str(file)))
    return files
