"""The pages of the site: one for each learner, selector and domain, made of the repository's own files."""

import json
import os
import re
import sys
from pathlib import Path

import pytest
import yaml
from conftest import TRAINED, buildable, choices, forked, make_config
from scripts import load_script

import hpamdp
from hpamdp import cli
from hpamdp.metrics_file import read_rows

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
FOLDERS = {"low": "learners", "high": "selectors", "env": "domains"}
# Those that share a page.
SHARED = {
    "hppo_published": "hppo",
    "hyar_published": "hyar",
    "pdqn_published": "pdqn",
    "sliding": "moving",
    "catch_point_picture": "catch_point",
}
ALL = [(group, name) for group in FOLDERS for name in choices(group)]


@pytest.fixture(scope="module")
def hooks():
    """The module docs/hooks.py, which mkdocs loads."""
    return load_script(DOCS / "hooks.py")


@pytest.fixture(scope="module")
def site(hooks):
    return hooks.Site()


def page(group: str, name: str) -> Path:
    return DOCS / FOLDERS[group] / f"{SHARED.get(name, name)}.md"


@pytest.mark.parametrize(("group", "name"), ALL)
def test_every_choice_has_a_page_that_names_it_and_shows_its_settings(group, name, hooks):
    file = page(group, name)
    text = file.read_text()
    assert f"{group}={name}" in text
    source = f"conf/{group}/{name}.yaml"
    values = yaml.safe_load((ROOT / source).read_text())
    defaults = {name: field[1] for name, field in hooks.fields_of(source, values.pop("_target_")).items()}
    values = {**defaults, **values}
    if not values:
        return
    assert source in text
    table = hooks.settings_of(source)
    for key, value in values.items():
        for setting in [f"{key}.{inner}" for inner in value] if value and isinstance(value, dict) else [key]:
            assert f"| `{setting}` |" in table
            assert f"| `{setting}` |  |  |" not in table


@pytest.mark.parametrize("name", buildable(sorted({*choices("env")} - {"gymnasium", "boatdock_released", "hard_goal"})))
def test_a_domains_page_names_its_actions_outcomes_and_observations(name):
    text = page("env", name).read_text()
    env = make_config([f"env={name}"]).env.cls(1)
    named = [each for each in getattr(env, "observation_names", ()) if not re.fullmatch(r"[xy]_\d+", each)]
    named += [*env.outcomes] if hasattr(env, "outcomes") else []
    named += [] if name == "hard_move" else [*getattr(env, "discrete_names", ())]
    assert not [each for each in named if f"`{each}`" not in text]


def test_no_link_and_no_directive_of_the_site_leads_nowhere(site):
    assert not site.problems
    expected = {"index.md", "studies/table1.md", "changelog.md", "api/hpamdp/env/base.md", "tutorials/python.md"}
    assert expected <= site.pages.keys()
    code = "source/conf/env/moving.yaml.md"
    assert f"](../{code})" in site.pages["domains/moving.md"] and "_target_: hpamdp" in site.pages[code]


def test_the_first_page_of_the_reference_has_every_public_name_and_the_others_say_that_they_are_internal(hooks, site):
    pages = site.pages
    for name in hpamdp.__all__:
        assert re.search(rf"\bhpamdp\.{name}\b", pages[hooks.PUBLIC_PAGE]), name
    internal = {place for place, text in pages.items() if "Internal: this module may change" in text}
    assert internal == {place for place in pages if place.startswith("api/")} - {"api/hpamdp/index.md"}


def test_a_notebook_becomes_a_page_with_what_its_cells_print_and_draw(hooks, tmp_path, monkeypatch):
    printed = {"output_type": "stream", "name": "stdout", "text": ["2\n"]}
    value = {"output_type": "execute_result", "data": {"text/plain": ["'x'"]}}
    drawn = {"output_type": "display_data", "data": {"image/png": "iVBO", "text/plain": ["<Figure>"]}}
    sources = [("markdown", ["See [a](other.md)."], []), ("code", ["print(2)\n", "f()"], [printed, value, drawn])]
    cells = [{"cell_type": kind, "source": source, "outputs": outputs} for kind, source, outputs in sources]
    folder = tmp_path / "docs/tutorials"
    folder.mkdir(parents=True)
    (tmp_path / "hpamdp").mkdir()
    (folder / "other.md").write_text("# Other\n")
    (folder / "n.ipynb").write_text(json.dumps({"cells": cells}))
    monkeypatch.setattr(hooks, "ROOT", tmp_path)
    site = hooks.Site()
    assert not site.problems
    assert site.pages["tutorials/n.md"] == (
        "See [a](other.md).\n\n```python\nprint(2)\nf()\n```\n\n```text\n2\n```\n\n```text\n'x'\n```\n\n"
        '<img src="../n_0.png" alt="What the cell above draws">\n'
    )
    assert site.drawn["tutorials/n_0.png"].startswith(b"\x89PN")


def test_a_clone_shows_every_table_as_its_csv_file_has_it_or_says_where_to_look(hooks):
    """A failure means: run `python experiments/report.py`."""
    for file in sorted(DOCS.rglob("*.md")):
        text = file.read_text()
        assert hooks.with_tables(text) == text, f"the tables of {file.name} are out of date"
        marks = re.findall(r"^<!-- (?:rows of|runs) .+ -->$", text, re.MULTILINE)
        assert len(marks) == len(hooks.FILLED.findall(text)), f"{file.name} has a directive without <!-- /table -->"
        for path in re.findall(r"^<!-- docstring of (.+?):", text, re.MULTILINE):
            assert re.search(rf"\]\([./]*{re.escape(path)}\)", text), f"{file.name} does not link to {path}"
        if "<!-- settings of" in text:
            assert re.search(r"The settings are (the (fields|arguments) of `\w+` in \[|those of \[)", text), file.name


def test_directives_are_filled_in_and_wrong_ones_are_told(hooks, tmp_path, monkeypatch):
    (tmp_path / "docs").mkdir()
    (tmp_path / "hpamdp").mkdir()
    (tmp_path / "a.yaml").write_text("# What it is.\n_target_: x.Y\n\n# The size | of it.\nsize: 3\nrate: 0.5\n")
    (tmp_path / "b.md").write_text("| a | b |\n|---|---|\n| x | 1 |\n| y | 2 |\n")
    (tmp_path / "m.py").write_text('"""One.\n\nSource: me,\narXiv 1234.56789.\n\nDiffers:\n- a\n"""\n')
    lines = ["settings of a.yaml", "rows of b.md, table 1: y", "docstring of m.py: Source"]
    wrong = ["settings of gone.yaml", "rows of b.md, table 2: y", "docstring of m.py: Sauce"]
    (tmp_path / "docs/page.md").write_text("".join(f"<!-- {line} -->\n\n" for line in lines + wrong) + "[a](gone.md)\n")
    monkeypatch.setattr(hooks, "ROOT", tmp_path)
    site = hooks.Site()
    text = site.pages["page.md"]
    assert "| `size` |  | `3` | The size \\| of it. |\n| `rate` |  | `0.5` |  |" in text
    assert "| y | 2 |" in text and "| x | 1 |" not in text
    assert "arXiv [1234.56789](https://arxiv.org/abs/1234.56789)." in text
    assert len(site.problems) == len(wrong) + 1


def test_runs_of_a_setting_with_three_seeds_are_one_row_with_their_mean_and_spread(hooks, tmp_path, monkeypatch):
    monkeypatch.setattr(hooks, "ROOT", tmp_path)
    rows = ["domain,learner,frames,seed,score,success,cpu_s,wall_s", "a,x,2000,0,1.0,1,30,9", "a,x,2000,1,3.0,1,50,9"]
    rows += ["a,x,2000,2,2.0,1,40,9", *(f"a,y,500,{seed},-2.5,0,1,9" for seed in range(2)), "b,x,500,0,7,0,1,9"]
    (tmp_path / "r.csv").write_text("\n".join(rows) + "\n")
    head = "| learner | steps | seeds | score | success | CPU, s |\n| --- | --- | --- | --- | --- | --- |\n"
    x = "| x | 2,000 | 3 | 2.000 ± 1.000 | 1.000 ± 0.000 | 40 ± 10 |"
    assert hooks.runs_table("r.csv: domain=a") == f"{head}{x}"
    assert "No 3 seeds" in hooks.runs_table("r.csv: domain=b")
    (tmp_path / "cells.csv").write_text("domain,learner,seeds\na,x,100-103\n")
    fresh = [f"a,x,2000,{seed},5.0,1,40,9" for seed in range(100, 104)]
    (tmp_path / "r.csv").write_text("\n".join([*rows, *fresh[:3]]) + "\n")
    assert "2.000 ± 1.000" in hooks.runs_table("r.csv: domain=a")  # until all that are planned have run
    (tmp_path / "r.csv").write_text("\n".join([*rows, *fresh]) + "\n")
    assert "| 4 | 5.000 ± 0.000 |" in hooks.runs_table("r.csv: domain=a")
    assert "No 3 seeds" in hooks.runs_table("r.csv: domain=c")
    with pytest.raises(hooks.SiteError, match="no column problem"):
        hooks.runs_table("r.csv: problem=a")


def test_every_domain_has_a_moving_picture_and_none_is_large():
    for name in {*choices("env")} - {"gymnasium", "boatdock_released"}:
        picture = page("env", name).with_suffix(".gif")
        assert f"]({picture.name})" in page("env", name).read_text()
        assert picture.stat().st_size < 400_000


# What makes each one learn within a few steps, and seldom.
FEW = {"warmup_steps": 128, "updates_per_step": 0.1}
QUICK = {
    "hppo": ["low.minibatch_size=16"],
    "qpamdp": [
        *(f"low.{name}=8" for name in ("initial_episodes", "relearning_episodes", "rollouts", "patience")),
        *(f"low.{name}=1" for name in ("phi_order", "psi_order", "parameter_updates")),
    ],
    "hyar": ["low.codec_pretrain_updates=1", "low.codec_every=1"],
    "pets": ["low.num_samples=8", "low.greedy_samples=8", "low.num_elites=4", "low.num_iterations=1"],
    "dlpa": ["low.num_samples=8", "low.num_elites=4", "low.num_iterations=1"],
    "actor": ["high.minibatch_size=16"],
    "meta_critic": ["high.warmup_decisions=16", "high.updates_per_decision=0.1"],
    "option_critic": ["high.warmup_steps=64"],
}
SELECTORS = ["ucb", "epsilon_greedy", "thompson", "exp3", "linucb", "lin_thompson", "option_critic", "actor"]
SELECTORS += ["meta_critic"]


def run(words: list[str]) -> None:
    sys.argv = ["hpamdp", *words]
    cli.main()


@pytest.mark.slow
@pytest.mark.parametrize("low", sorted({*TRAINED} - {"planner", "random"}))
def test_the_pages_explain_every_scalar_that_is_logged(low, tmp_path):
    high = SELECTORS[sorted(TRAINED).index(low) % len(SELECTORS)]
    words = [f"low={low}", f"high={high}", "num_envs=16", "steps_per_batch=4", "total_frames=1024", "log_every=64"]
    words += ["eval.every=0", "eval.layouts=4", f"hydra.run.dir={tmp_path}", "agent.practice=1024"]
    words += ["env=rooms", "agent.termination=learned"] if high == "option_critic" else []
    settings = make_config([f"low={low}"]).low.settings
    words += [f"low.{name}={value}" for name, value in FEW.items() if name in settings]
    assert forked(run, [*words, *QUICK.get(low, []), *QUICK.get(high, [])]) == 0
    columns = {name for row in read_rows(tmp_path / "metrics.csv") for name in row}
    logged = {name for name in columns if name.startswith(("low/", "high/"))}
    assert {name.split("/")[0] for name in logged} == {"low", "high"}
    for column in logged:
        level, *_, name = column.split("/")
        name = re.sub("_(incongruent|congruent)$", "_NAME", name)
        text = page(level, low if level == "low" else high).read_text()
        assert f"`{name}`" in text, column


@pytest.mark.slow
@pytest.mark.parametrize("name", ["README.md", "docs/usage.md", "docs/coming-from.md"])
def test_the_python_of_a_front_page_runs(name, tmp_path):
    def follow() -> None:
        os.chdir(tmp_path)
        names: dict = {}
        for code in re.findall(r"^```python\n(.*?)^```", (ROOT / name).read_text(), re.MULTILINE | re.DOTALL):
            exec(compile(code, name, "exec"), names)
        if name == "README.md":
            assert names["info"]["score"] > 0.0
            assert hpamdp.load("platform.safetensors").evaluate(episodes=100)["score"] > 0.9

    assert forked(follow) == 0
