"""The command line: a mistake costs one line and exit code 2, a bug keeps its traceback, help is read from conf/."""

import pytest
from conftest import choices
from omegaconf.errors import ConfigAttributeError

from hpamdp.config.components import GROUPS
from hpamdp.run import train

MISTAKES = [
    # A choice that isn't there, a group that isn't there.
    (["high=foo"], "high=foo: no such choice; conf/high has actor, "),
    (["low=PPO"], "low=PPO: no such choice; did you mean hppo? conf/low has "),
    (["experiment=domains/foo"], "experiment=domains/foo: no such choice; did you mean domains/goal or "),
    # A key that isn't there.
    (["sed=3"], "sed: no such group or value of the run (conf/config.yaml); did you mean seed? It has "),
    (["eval.evry=3"], "eval.evry: no such value of eval; did you mean every? It has every, layouts, seed"),
    (["low=pdqn", "low.lr_final=0.1"], "low.lr_final: is called low.lr_final_fraction now"),
    (["high=ucb", "high.windw=3"], "high.windw: no such setting of UCB; did you mean window? It"),
    (["high=none", "high.window=3"], "high.window: high=none has no settings; choose another high, too"),
    (["+low=hppo"], "Multiple values for low. To override a value use 'override low: hppo'"),
    (["low=hppo", "low.learning_rate=1"], "no such setting of HPPO; did you mean lr or critic_lr? It has "),
    (["total_timesteps=64"], "did you mean total_frames? It has "),
    (["deterministic=true"], "did you mean agent.act(observation, greedy=True)? It has "),
    (["low=hppo", "low.verbose=1"], "did you mean hpamdp.train(..., progress=True)? It has "),
    (["hydra.run.dri=x"], "hydra.run.dri: no such value of hydra.run; did you mean dir? It has dir"),
    (["low=3"], "low=3: Config group override must be a string or a list. Got int"),
    (["hydra=null"], "hydra=null: not understood"),
    # An override that isn't one.
    (["seed=[1"], "seed=[1: not understood; write GROUP=CHOICE or SETTING=VALUE"),
    (["+seed=3"], "Could not append to config. An item is already at 'seed'"),
    (["high=ucb,fixed"], "high=ucb,fixed: several values; add --multirun"),
    (["--sed", "3"], "unrecognized arguments: --sed; see --help"),
    (["--total-timesteps", "64", "low=hppo"], "; settings have no dashes, write total_timesteps=64"),
    (["--low", "hppo", "--seed", "1"], "; settings have no dashes, write low=hppo seed=1"),
    (["hydra.run.dir=/proc/nowhere/x"], "/proc/nowhere: No such file or directory"),
    # A value that cannot be.
    (["seed=-1"], "seed=-1: must be greater than or equal to 0 (conf/config.yaml)"),
    (["device=tpu"], 'device="tpu": must be auto, cpu, cuda or cuda:N (conf/config.yaml)'),
    (["mode=eval"], "checkpoint: missing; mode=eval needs the output folder of a run"),
    (["checkpoint=x"], "checkpoint: goes with mode=eval only"),
    (["low._target_=os.path.join"], "low._target_=os.path.join: there is no class join in os.path"),
    # The same in a sweep.
    (["-m", "high=ucb,fixed", "high.window=1,2"], "high.window: no such setting of Fixed; it has"),
    (["-m", "seed=range(0,0)"], "seed=range(0,0): no job to run"),
    (["resume=auto"], "resume=auto: goes on with the run in a folder, so give hydra.run.dir"),
    (["-m", "resume=auto"], "resume=auto: goes on with the run in a folder, so give hydra.sweep.dir"),
    (
        ["experiment=domains", "env=platform", "low=hppo", "high=none"],
        "env=platform: the experiments of a sweep choose env themselves; leave it out",
    ),
    (["-m", "low=glob(x*)"], "low=glob(x*): matches no choice; conf/low has "),
    (["low=glob(h*)"], "low=glob(h*): several values; add --multirun"),
    (["seed=1", "-m", "low=random"], "low=random: settings on both sides of a flag; write all of them after the flags"),
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


@pytest.mark.parametrize(
    ("group", "content", "line"),
    [
        ("env", b"\xff\xfe\x00", "'utf-8' codec can't decode byte 0xff"),
        ("env", b"- 1\n- 2\n", "Cannot merge DictConfig with ListConfig"),
        ("high", b"", "high=mine: conf/high/mine.yaml names no class as _target_"),
        ("env", b"_target_: collections.OrderedDict\n", "env=mine: OrderedDict is no PAMDPEnv (hpamdp.env.base)"),
    ],
)
def test_a_yaml_that_is_none_or_of_something_else_is_told_in_one_line(group, content, line, command, tmp_path):
    (tmp_path / "mine" / group).mkdir(parents=True)
    (tmp_path / "mine" / group / "mine.yaml").write_bytes(content)
    code, _, err = command("--config-dir", str(tmp_path / "mine"), f"{group}=mine")
    assert code == 2 and err.count("\n") == 1 and line in err


def test_a_refused_run_leaves_no_folder_behind(command, tmp_path):
    command("seed=-1", "hydra.run.dir=out")
    assert not (tmp_path / "out").exists()


def test_jobs_get_their_config_folder_and_overrides(command, tmp_path, monkeypatch):
    seen = []

    def run(cfg, folder, overrides, stopped_at=None, **_):
        seen.append((cfg.seed, folder, overrides))

    monkeypatch.setattr(train, "run", run)
    assert command("seed=3", "hydra.run.dir=out")[0] == 0
    assert seen == [(3, tmp_path / "out", ["seed=3"])]
    assert list((tmp_path / "out").iterdir()) == []

    code, out, _ = command("-m", "seed=4,5", "hydra.sweep.dir=sweep")
    assert code == 0
    assert [job[:2] for job in seen[1:]] == [(4, tmp_path / "sweep/0"), (5, tmp_path / "sweep/1")]
    assert out == "Job 0: seed=4\nJob 1: seed=5\n2 jobs: 2 finished\n"


@pytest.mark.parametrize("bug", [ValueError("bug"), ConfigAttributeError("bug")])
def test_a_bug_keeps_its_traceback(command, monkeypatch, bug):
    def run(cfg, folder, overrides, **known):
        raise bug

    monkeypatch.setattr(train, "run", run)
    with pytest.raises(type(bug), match="bug"):
        command()


def test_an_interrupted_run_exits_with_130_and_ends_a_sweep(command, monkeypatch):
    seen = []
    monkeypatch.setattr(train, "run", lambda cfg, folder, overrides, stopped_at=None, **_: seen.append(cfg.seed) or 130)
    assert command("-m", "seed=1,2")[0] == 130
    assert seen == [1]

    def interrupted(cfg, folder, overrides, **_):
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "run", interrupted)
    assert command()[0] == 130


def test_help_shows_groups_and_values_with_their_meaning_and_examples(command):
    code, out, err = command("--help")
    assert code == 0 and not err
    words = " ".join(out.split())
    for group in GROUPS:
        assert f" {group} {', '.join(choices(group))} " in words
    assert ", domains, domains/catch_point, " in words and ", domains/sliding, few_steps, " in words
    lines = out.splitlines()
    for name in ("mode", "num_envs", "eval.layouts", "agent.sharing", "low.freeze", "film"):
        place = next(i for i, line in enumerate(lines) if line.startswith(f"  {name}="))
        assert lines[place + 1].startswith("      ")
    assert out.count("  python run.py ") >= 3 and " search " not in words
    assert "hydra:" not in out


def test_help_explains_the_settings_of_the_choices_that_are_named(command):
    code, out, err = command("--help", "low=hppo", "low.gamma=0.5")
    assert code == 0 and not err
    assert "Settings of low=hppo\n" in out and "  low.gamma=0.5\n      Discount of a step.\n" in out
    assert "Settings of high" not in out
