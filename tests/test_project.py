"""The project's pages and files agree with one another: versions, links, the length of the README."""

import re
import subprocess
from pathlib import Path

import yaml

import hpamdp

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    import tomli as tomllib

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", ROOT / "agents/README.md"]
PAGES += [file for folder in ("docs", "experiments", "examples") for file in sorted((ROOT / folder).rglob("*.md"))]


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken_links(page: Path) -> list[str]:
    """Return a page's relative links and pictures that lead nowhere."""
    broken = []
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        path, _, anchor = link.partition("#")
        if re.match(r"[a-z]+:", link):
            continue
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and target.suffix == ".md" and anchor not in anchors(target)):
            broken.append(link)
    return broken


def commands(page: Path) -> list[str]:
    """Return the lines of a page's code blocks that are not Python, yaml or output."""
    fences = re.findall(r"^```(\w*)\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL)
    return [line for language, block in fences if language in ("", "shell") for line in block.splitlines()]


def test_no_link_of_a_page_leads_nowhere():
    assert not {page: broken for page in PAGES if (broken := broken_links(page))}


def test_every_command_of_a_page_has_a_line_of_its_own():
    with_another = re.compile(r" # (.* )?(python|hpamdp) [-\w]")
    assert not [line for page in PAGES for line in commands(page) if with_another.search(line)]


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= 140


def test_the_page_usage_names_every_choice_of_the_groups():
    text = (ROOT / "docs/usage.md").read_text()
    choices = {
        path.stem
        for group in ("env", "high", "low", "data", "collector", "logger")
        for path in (ROOT / "conf" / group).glob("*.yaml")
    }
    assert not {name for name in choices - {"auto"} if f"`{name}`" not in text}


def test_no_page_is_long():
    long = {page: len(page.read_text().split()) for page in PAGES if "experiments" not in page.parts}
    assert not {page: words for page, words in long.items() if words > 3000}


def test_a_study_answers_its_question_before_all_else():
    answers = re.compile(r"^\*\*Questions?\.\*\*.+^\*\*Answer\.\*\*", re.MULTILINE | re.DOTALL)
    for page in ROOT.glob("experiments/*/README.md"):
        first, *_ = re.split(r"^(?:## |\||!\[|```)", page.read_text(), maxsplit=1, flags=re.MULTILINE)
        assert answers.search(first), page


def test_the_changelog_and_the_citation_have_this_version():
    assert f"## [{hpamdp.__version__}]" in (ROOT / "CHANGELOG.md").read_text()
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == hpamdp.__version__


def test_the_package_has_the_authors_keywords_and_licence_of_the_citation():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert project["authors"] == citation["authors"]
    assert project["keywords"] == citation["keywords"]
    assert project["license"] == citation["license"]
    assert all((ROOT / name).is_file() for name in [*project["license-files"], project["readme"]])


def test_the_classifiers_name_the_python_versions_that_are_allowed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    lowest, above = map(int, re.fullmatch(r">=3\.(\d+),<3\.(\d+)", project["requires-python"]).groups())
    named = re.findall(r"Python :: 3\.(\d+)", "\n".join(project["classifiers"]))
    assert [*map(int, named)] == [*range(lowest, above)]


def test_every_dependency_has_a_lowest_version_that_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    ranges = dict(re.fullmatch(r"([\w-]+)>=([\d.]+),<[\d.]+", line).groups() for line in project["dependencies"])
    text = (ROOT / "constraints-lowest.txt").read_text().lower()
    pinned = dict(re.findall(r"^([\w-]+)==([\d.]+)", text, re.MULTILINE))
    for name, lowest in ranges.items():
        assert pinned[name].startswith(lowest), name


def imported(package: str) -> bool:
    """Return whether a module of hpamdp imports a package."""
    pattern = rf"^\s*(import|from) {package}\b"
    return any(re.search(pattern, file.read_text(), re.MULTILINE) for file in (ROOT / "hpamdp").rglob("*.py"))


def test_every_dependency_is_imported_by_something():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    modules = {"hydra-core": "hydra", "pillow": "PIL", "pyyaml": "yaml", "lazy-loader": "lazy_loader"}
    modules["tensorboard"] = "torch.utils.tensorboard"
    for line in project["dependencies"]:
        name = re.match(r"[\w-]+", line).group()
        assert imported(modules.get(name, name)), name


def test_make_knows_its_targets():
    for target in ("run", "test", "slow", "lowest", "wheel", "report", "docs"):
        done = subprocess.run(["make", "--dry-run", target], cwd=ROOT, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
