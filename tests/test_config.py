"""The config: what is accepted, and that whatever is wrong ends in one line that says so."""

import inspect
import os
import subprocess
import sys
from typing import Annotated, Literal

import pytest
import torch
from conftest import CONF, choices, compose_config
from omegaconf import OmegaConf
from omegaconf.errors import ConfigAttributeError
from pydantic import Field, PositiveInt

from hpamdp import train
from hpamdp.assemble import CONTEXT
from hpamdp.config import GROUPS, ConfigError, build, load_class, name_of, run_config, validate
from hpamdp.main import main

FILES = [(group, name) for group in GROUPS for name in choices(group)]


class Sample:
    """Has an option of every kind."""

    def __init__(
        self,
        specs: object,
        *,
        size: PositiveInt,
        rate: Annotated[float, Field(ge=0.0, le=1.0)],
        form: Literal["plain", "fancy"],
        widths: list[PositiveInt],
        bounds: tuple[float, ...] = (0.0,),
        depth: int | None = None,
        label: str | int = "a",
        is_on: bool = False,
        model_lr: float = 1e-3,
    ) -> None:
        if widths == [13]:
            raise ValueError("widths: 13 is unlucky")
        if widths == [14]:
            _, _ = widths  # a bug
        self.specs = specs
        self.options = {"size": size, "rate": rate, "form": form, "widths": widths, "bounds": bounds}
        self.options |= {"depth": depth, "label": label, "is_on": is_on, "model_lr": model_lr}


SAMPLE = {"_target_": f"{__name__}.Sample", "size": 3, "rate": 0.5, "form": "plain", "widths": [4, 4]}


def mistake_in(**options: object) -> str:
    node = {name: value for name, value in (SAMPLE | options).items() if value != "absent"}
    with pytest.raises(ConfigError) as raised:
        build("low", OmegaConf.create(node), specs=None)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_build_passes_the_options_and_what_of_the_context_is_asked_for():
    built = build("low", OmegaConf.create(SAMPLE | {"budget": {"num_envs": 1}}), specs="specs", device="not asked for")
    assert built.specs == "specs"
    assert built.options["size"] == 3 and built.options["widths"] == [4, 4] and built.options["label"] == "a"


def test_an_integer_is_a_float_and_a_list_a_tuple():
    built = build("low", SAMPLE | {"rate": 1, "bounds": [1, 2.5], "depth": 2, "label": 7, "is_on": True}, specs=None)
    assert isinstance(built.options["rate"], float)
    assert built.options["bounds"] == (1.0, 2.5)
    assert built.options["depth"] == 2 and built.options["label"] == 7 and built.options["is_on"] is True


@pytest.mark.parametrize(
    ("option", "value", "complaint"),
    [
        ("size", 0, "low.size=0: must be greater than 0 (Sample, conf/low)"),
        ("size", True, "low.size=true: must be a valid integer"),
        ("size", "3", 'low.size="3": must be a valid integer'),
        ("size", 3.0, "low.size=3.0: must be a valid integer"),
        ("size", None, "low.size=null: must be a valid integer"),
        ("size", "absent", "low.size: missing (Sample, conf/low)"),
        ("rate", 1.5, "low.rate=1.5: must be less than or equal to 1"),
        ("rate", "1e-3x", 'low.rate="1e-3x": must be a valid number'),
        ("rate", float("nan"), "low.rate=NaN: must be a finite number"),
        ("form", "fany", "low.form=\"fany\": must be 'plain' or 'fancy'"),
        ("widths", 4, "low.widths=4: must be a list"),
        ("widths", [4, 0], "low.widths.1=0: must be greater than 0"),
        ("depth", "deep", 'low.depth="deep": must be a valid integer'),
        ("label", 1.5, "low.label=1.5: must be a valid string or must be a valid integer"),
        ("is_on", 1, "low.is_on=1: must be a valid boolean"),
        ("specs", 1, "low.specs: no such option of Sample"),
        ("widths", [13], "low: widths: 13 is unlucky (Sample, conf/low)"),
        ("rate", "${nowhere}", "rate: Interpolation key 'nowhere' not found"),
        ("rate", "???", "rate: Missing mandatory value"),
        ("_target_", "absent", "low._target_=None: must be a class"),
        ("_target_", "Sample", "low._target_=Sample: must be a class, as package.module.Class"),
        ("_target_", "hpamdp.nowhere.Sample", "low._target_=hpamdp.nowhere.Sample: there is no module hpamdp.nowhere"),
        ("_target_", "hpamdp.config.build", "low._target_=hpamdp.config.build: there is no class build"),
    ],
)
def test_a_wrong_option_is_named_with_what_is_allowed(option, value, complaint):
    assert complaint in mistake_in(**{option: value})


def test_an_unknown_option_gets_the_likely_one_first_and_then_all():
    line = mistake_in(siz=3)
    assert line.startswith("low.siz: no such option of Sample (conf/low); did you mean size? It has bounds, depth, ")
    assert mistake_in(xyz=3).startswith("low.xyz: no such option of Sample (conf/low); it has bounds, depth, ")


def test_all_problems_come_in_one_line():
    line = mistake_in(size=0, rate=2, siz=3)
    assert all(f"low.{name}" in line for name in ("size=0", "rate=2", "siz:")) and line.count("; ") >= 2


def test_a_bug_in_a_constructor_is_no_mistake_of_the_users():
    with pytest.raises(ValueError, match="not enough values to unpack") as raised:
        build("low", SAMPLE | {"widths": [14]}, specs=None)
    assert not isinstance(raised.value, ConfigError)


def test_a_module_that_lacks_what_it_imports_is_no_mistake_of_the_users(tmp_path, monkeypatch):
    (tmp_path / "needy.py").write_text("import something_not_installed\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError):
        load_class("needy.Class")


def test_only_the_selector_can_be_none():
    assert build("high", {"_target_": None}, specs=None) is None
    with pytest.raises(ConfigError, match=r"high\.option: no such option of none"):
        build("high", {"_target_": None, "option": 1}, specs=None)
    with pytest.raises(ConfigError, match=r"low\._target_"):
        build("low", {"_target_": None}, specs=None)


@pytest.mark.parametrize(("group", "name"), FILES)
def test_a_yaml_and_its_class_have_the_same_options(group, name):
    cfg = compose_config([f"{group}={name}"])
    run_config(cfg)
    cls, options = validate(group, cfg[group], CONTEXT[group])
    in_yaml = set(cfg[group]) - {"_target_", "budget", "checkpoint", "freeze"}
    assert set(options) == in_yaml
    if cls is not None:
        arguments = set(list(inspect.signature(cls.__init__).parameters)[1:])
        assert in_yaml == arguments - {*CONTEXT[group]}
    if group in ("high", "low"):
        assert name == name_of(cfg[group])
    assert ("budget" in cfg[group]) == (group == "low")
    assert group != "low" or set(cfg[group].budget) == {"num_envs", "steps_per_batch", "total_frames", "eval_every"}


@pytest.mark.parametrize("experiment", choices("experiment"))
def test_an_experiment_is_a_valid_config(experiment):
    cfg = compose_config([f"experiment={experiment}"])
    run_config(cfg)
    for group in GROUPS:
        validate(group, cfg[group], CONTEXT[group])


def test_an_experiment_sets_groups_and_values(tmp_path, monkeypatch):
    (tmp_path / "experiment").mkdir()
    study = "# @package _global_\ndefaults:\n  - override /high: fixed\nseed: 7\nhigh:\n  option: incongruent\n"
    (tmp_path / "experiment/study.yaml").write_text(study)
    cfg = compose_config([f"hydra.searchpath=[{tmp_path}]", "experiment=study"])
    assert (name_of(cfg.high), cfg.high.option, cfg.seed) == ("fixed", "incongruent", 7)
    assert compose_config([f"hydra.searchpath=[{tmp_path}]", "experiment=study", "seed=8"]).seed == 8


def test_every_yaml_value_has_a_comment_and_every_group_a_folder():
    for file in CONF.rglob("*.yaml"):
        assert file.read_text().startswith("#"), f"{file} does not say what it is"
    assert {folder.name for folder in CONF.iterdir() if folder.is_dir()} == {*GROUPS, "experiment"}


def test_cuda_is_refused_in_one_line_where_there_is_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="device=cuda:1: this machine has no usable CUDA device"):
        run_config(compose_config(["device=cuda:1"])).resolve_device()
    assert run_config(compose_config(["device=auto"])).resolve_device() == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert run_config(compose_config(["device=cuda:1"])).resolve_device() == torch.device("cuda:1")
    assert run_config(compose_config(["device=auto"])).resolve_device().type == "cuda"
    with pytest.raises(ConfigError, match="has CUDA devices 0 to 1"):
        run_config(compose_config(["device=cuda:2"])).resolve_device()


@pytest.fixture
def command(tmp_path, monkeypatch, capsys):
    """Run the command line in an empty folder and return its exit code, its stdout and its stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # so that what `main` sets is undone

    def run(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["run.py", *words])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = stop.code
        out, err = capsys.readouterr()
        return code, out, err

    return run


MISTAKES = [
    # A choice that isn't there, a group that isn't there.
    (["high=foo"], "high=foo: no such choice; conf/high has actor, "),
    (["high=3"], "high=3: no such choice; conf/high has actor, "),
    (["low=null"], "low=null: no such choice; conf/low has "),
    (["experiment=foo"], "experiment=foo: no such choice; conf/experiment has learners, "),
    (["hihg=ucb"], "hihg: no such group or value of the run (conf/config.yaml); did you mean high? It has "),
    (["~low"], "low: nothing chosen; set low=NAME"),
    # A key that isn't there.
    (["sed=3"], "sed: no such group or value of the run (conf/config.yaml); did you mean seed? It has "),
    (["+sed=3"], "sed: no such value of the run (conf/config.yaml); did you mean seed? It has "),
    (["eval.evry=3"], "eval.evry: no such value of eval; did you mean every? It has every, layouts, seed"),
    (["+eval.evry=3"], "eval.evry: no such value of the run (conf/config.yaml); did you mean every? It has every, "),
    (["high=ucb", "high.windw=3"], "high.windw: no such option of UCB (conf/high/ucb.yaml); did you mean window? It"),
    (["high=ucb", "+high.windw=3"], "high.windw: no such option of UCB (conf/high/ucb.yaml); did you mean window? It"),
    (["high=none", "high.window=3"], "high.window: no such option of none (conf/high/none.yaml); it has none"),
    (["low.lrr=1"], "low.lrr: no such option of HyAR (conf/low/hyar.yaml); it has actor_lr, "),
    (["~low.tua"], "low.tua: no such option of HyAR (conf/low/hyar.yaml); did you mean tau? It has "),
    (["~low.tau"], "low.tau: missing (HyAR, conf/low/hyar.yaml)"),
    (["hydra.run.dri=x"], "hydra.run.dri: no such value of hydra.run; did you mean dir? It has dir"),
    # An override that isn't one.
    (["high="], "high=: no such choice; conf/high has actor, "),
    (["=3"], "=3: not understood; write GROUP=CHOICE or KEY=VALUE"),
    (["low..x=1"], "low..x=1: not understood; write GROUP=CHOICE or KEY=VALUE"),
    (["low"], "low: not understood; write GROUP=CHOICE or KEY=VALUE"),
    (["seed=[1"], "seed=[1: not understood; write GROUP=CHOICE or KEY=VALUE"),
    (["+seed=3"], "Could not append to config. An item is already at 'seed'"),
    (["high=ucb,fixed"], "high=ucb,fixed: several values; add --multirun"),
    (["--sed", "3"], "unrecognized arguments: --sed; see --help"),
    (["--cfg", "jobs"], "argument --cfg/-c: invalid choice: "),
    (["--multirun", "--cfg", "job"], "--multirun and --cfg do not go together"),
    (["--config-name", "foo"], "Cannot find primary config 'foo'"),
    (["hydra.run.dir=/proc/nowhere/x"], "[Errno 2] No such file or directory: '/proc/nowhere"),
    # A value that cannot be.
    (["seed=-1"], "seed=-1: must be greater than or equal to 0 (conf/config.yaml)"),
    (["seed=abc"], 'seed="abc": must be a valid integer (conf/config.yaml)'),
    (["eval.layouts=0"], "eval.layouts=0: must be greater than 0 (conf/config.yaml)"),
    (["eval=3"], "eval=3: must be "),
    (["device=tpu"], 'device="tpu": must be auto, cpu, cuda or cuda:N (conf/config.yaml)'),
    (["mode=eval"], "checkpoint: missing; mode=eval needs the output folder of a run"),
    (["checkpoint=x"], "checkpoint: goes with mode=eval only"),
    (["num_envs=${nowhere}"], "num_envs: Interpolation key 'nowhere' not found"),
    (["low.batch_size=0"], "low.batch_size=0: must be greater than 0 (HyAR, conf/low/hyar.yaml)"),
    (["low._target_=os.path.join"], "low._target_=os.path.join: there is no class join in os.path"),
    (["env.slip=2"], "must be "),
    (["env.reward=big"], "env.reward=\"big\": must be 'paper' or 'sparse' (BoatDockEnv, conf/env/boatdock.yaml)"),
    (["high=fixed", "high.option=sideways"], "sideways"),
    # The same in a sweep.
    (["-m", "high=ucb,foo"], "high=foo: no such choice; conf/high has actor, "),
    (
        ["-m", "high=ucb,fixed", "high.window=1,2"],
        "high.window: no such option of Fixed (conf/high/fixed.yaml); it has",
    ),
    (["-m", "low.lrr=1,2"], "low.lrr: no such option of HyAR (conf/low/hyar.yaml); it has actor_lr, "),
    (["-m", "seed=-1,-2"], "seed=-1: seed=-1: must be greater than or equal to 0 (conf/config.yaml)"),
    (["-m", "seed=range(1"], "seed=range(1: not understood"),
]


@pytest.mark.parametrize(("words", "line"), MISTAKES, ids=[" ".join(words) for words, _ in MISTAKES])
def test_a_mistake_gives_one_line_and_exit_code_2(command, words, line):
    code, _, err = command(*words)
    assert code == 2
    assert err.endswith("\n") and err.count("\n") == 1
    assert line in err


def test_a_broken_yaml_is_named_with_the_line(command, tmp_path):
    (tmp_path / "mine/experiment").mkdir(parents=True)
    (tmp_path / "mine/experiment/broken.yaml").write_text("# @package _global_\nseed: [1\nmode: train\n")
    code, _, err = command("--config-dir", str(tmp_path / "mine"), "experiment=broken")
    assert code == 2 and err.count("\n") == 1
    assert "broken.yaml, line 3: " in err


def test_a_refused_run_leaves_no_folder_behind(command, tmp_path):
    command("seed=-1", "hydra.run.dir=out")
    assert not (tmp_path / "out").exists()


def test_jobs_get_their_config_folder_and_overrides(command, tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(train, "run", lambda cfg, folder, overrides: seen.append((cfg.seed, folder, overrides)))
    assert command("seed=3", "hydra.run.dir=out")[0] == 0
    assert seen == [(3, tmp_path / "out", ["seed=3"])]
    assert list((tmp_path / "out").iterdir()) == []

    code, out, _ = command("-m", "seed=4,5", "hydra.sweep.dir=sweep")
    assert code == 0
    assert [job[:2] for job in seen[1:]] == [(4, tmp_path / "sweep/0"), (5, tmp_path / "sweep/1")]
    assert out == "Job 0: seed=4\nJob 1: seed=5\n"


def test_a_mistake_in_one_job_ends_the_sweep_with_its_overrides(command, monkeypatch):
    seen = []

    def run(cfg, folder, overrides):
        seen.append(cfg.seed)
        if cfg.seed == 1:
            raise ConfigError("these two\ndo not go together")

    monkeypatch.setattr(train, "run", run)
    code, _, err = command("-m", "seed=0,1,2", "high=fixed")
    assert (code, err, seen) == (2, "seed=1 high=fixed: these two do not go together\n", [0, 1])


@pytest.mark.parametrize("bug", [ZeroDivisionError("bug"), ValueError("bug"), ConfigAttributeError("bug")])
@pytest.mark.parametrize("words", [[], ["-m", "seed=1,2"]])
def test_a_bug_keeps_its_traceback(command, monkeypatch, bug, words):
    def run(cfg, folder, overrides):
        raise bug

    monkeypatch.setattr(train, "run", run)
    with pytest.raises(type(bug), match="bug"):
        command(*words)


def test_an_interrupted_run_exits_with_130_and_ends_a_sweep(command, monkeypatch):
    seen = []
    monkeypatch.setattr(train, "run", lambda cfg, folder, overrides: seen.append(cfg.seed) or 130)
    assert command("-m", "seed=1,2")[0] == 130
    assert seen == [1]

    def interrupted(cfg, folder, overrides):
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "run", interrupted)
    assert command()[0] == 130


def test_help_shows_groups_values_with_comments_and_examples(command):
    code, out, err = command("--help")
    assert code == 0 and not err
    for group in (*GROUPS, "experiment"):
        assert f"  {group:<12}{', '.join(choices(group))}\n" in out
    cfg = OmegaConf.load(CONF / "config.yaml")
    lines = out.splitlines()
    for name in set(cfg) - {"defaults", "hydra", "eval", "agent", "low"}:
        place = next(i for i, line in enumerate(lines) if line.startswith(f"  {name}:"))
        assert lines[place - 1].startswith("  # ")
    assert out.count("  python run.py ") >= 3
    assert "hydra:" not in out


def run_script(*words: str, cwd: str | os.PathLike[str]) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(CONF.parent)}
    script = str(CONF.parent / "run.py")
    return subprocess.run([sys.executable, script, *words], cwd=cwd, env=environment, capture_output=True, text=True)


def test_the_script_tells_a_mistake_in_one_line(tmp_path):
    done = run_script("low.lrr=1", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("low.lrr: no such option of HyAR") and done.stderr.count("\n") == 1


def test_the_script_tells_a_mistake_inside_a_job_in_one_line(tmp_path):
    done = run_script("--multirun", "high.exploration=0", "low=random", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("high.exploration=0 low=random: high.exploration=0: must be greater than 0 (UCB, ")
    assert done.stderr.count("\n") == 1


def test_help_does_not_wait_for_torch():
    code = "import sys; from hpamdp.main import main; main(); assert 'torch' not in sys.modules"
    done = subprocess.run([sys.executable, "-c", code, "--help"], cwd=CONF.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
