"""The config: what is accepted, and that whatever is wrong ends in one line that says so."""

import json
from typing import Annotated, Literal

import pytest
import torch
import yaml
from conftest import CONF, choices, compose_config, make_config
from omegaconf import OmegaConf
from pydantic import Field, PositiveInt

from hpamdp.config.command_line import search_word
from hpamdp.config.components import (
    CALLBACK,
    GROUPS,
    SUPPLIED_ARGUMENTS,
    component,
    defaults_of,
    load_class,
    settings_model,
)
from hpamdp.config.compose import plain, read
from hpamdp.config.errors import ConfigError
from hpamdp.config.saved import read_saved
from hpamdp.policies.high_level.ucb import UCB
from hpamdp.policies.low_level.random import Random
from hpamdp.run import compatibility
from hpamdp.settings import SettingError, meanings_of

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
            raise SettingError("widths: 13 is unlucky")
        if widths == [14]:
            _, _ = widths  # a bug
        self.specs = specs
        self.options = {"size": size, "rate": rate, "form": form, "widths": widths, "bounds": bounds}
        self.options |= {"depth": depth, "label": label, "is_on": is_on, "model_lr": model_lr}


SAMPLE = {"_target_": f"{__name__}.Sample", "size": 3, "rate": 0.5, "form": "plain", "widths": [4, 4]}


def mistake_in(**options: object) -> str:
    node = {name: value for name, value in (SAMPLE | options).items() if value != "absent"}
    with pytest.raises(ConfigError) as raised:
        component("low", "sample", plain(OmegaConf.create(node), "low")).build(specs=None)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_build_passes_the_options_and_what_of_the_context_is_asked_for():
    node = {**SAMPLE, "budget": {"num_envs": 1}}
    built = component("low", "sample", node).build(specs="specs", device="not asked for")
    assert built.specs == "specs"
    assert built.options["size"] == 3 and built.options["widths"] == [4, 4] and built.options["label"] == "a"


def test_an_integer_is_a_float_and_a_list_a_tuple():
    node = SAMPLE | {"rate": 1, "bounds": [1, 2.5], "depth": 2, "label": 7, "is_on": True}
    built = component("low", "sample", node).build(specs=None)
    assert isinstance(built.options["rate"], float)
    assert built.options["bounds"] == (1.0, 2.5)
    assert built.options["depth"] == 2 and built.options["label"] == 7 and built.options["is_on"] is True


@pytest.mark.parametrize(
    ("option", "value", "complaint"),
    [
        ("size", 0, "low.size=0: must be greater than 0 (Sample)"),
        ("size", True, "low.size=true: must be a valid integer"),
        ("size", "absent", "low.size: missing (Sample)"),
        ("rate", float("nan"), "low.rate=NaN: must be a finite number"),
        ("form", "fany", "low.form=\"fany\": must be 'plain' or 'fancy'"),
        ("widths", 4, "low.widths=4: must be a list"),
        ("specs", 1, "low.specs: no such setting of Sample"),
        ("widths", [13], "low: widths: 13 is unlucky (Sample)"),
        ("rate", "${nowhere}", "rate: Interpolation key 'nowhere' not found"),
        ("_target_", "Sample", "low._target_=Sample: must be a class, as package.module.Class"),
        ("_target_", "hpamdp.nowhere.Sample", "low._target_=hpamdp.nowhere.Sample: there is no module hpamdp.nowhere"),
    ],
)
def test_a_wrong_option_is_named_with_what_is_allowed(option, value, complaint):
    assert complaint in mistake_in(**{option: value})


def test_an_unknown_option_gets_the_likely_one_first_and_then_all():
    line = mistake_in(siz=3)
    assert line.startswith("low.siz: no such setting of Sample; did you mean size? It has bounds, depth, ")
    assert mistake_in(xyz=3).startswith("low.xyz: no such setting of Sample; it has bounds, depth, ")


def test_all_problems_come_in_one_line():
    line = mistake_in(size=0, rate=2, siz=3)
    assert all(f"low.{name}" in line for name in ("size=0", "rate=2", "siz:")) and line.count("; ") >= 2


@pytest.mark.parametrize(
    ("group", "target", "complaint"),
    [
        ("logger", "builtins.int", "logger=csv: int is no Logger (hpamdp.run.loggers); it lacks log, images, film, s"),
        ("logger", "hpamdp.run.loggers.Logger", "logger=csv: Logger is abstract; choose one of its subclasses (conf/"),
        (
            "collector",
            "hpamdp.run.collection.workers.WorkerCollection",
            "collector=single: WorkerCollection is abstract; choose one of its subclasses, which have _death, _star",
        ),
        (
            "env",
            "hpamdp.env.option_choice.OptionChoiceEnv",
            "OptionChoiceEnv: has an argument that no yaml file can hold",
        ),
    ],
)
def test_a_class_of_another_kind_is_refused_in_one_line(group, target, complaint):
    cfg = compose_config([])
    cfg[group]._target_ = target
    with pytest.raises(ConfigError) as error:
        read(cfg)
    assert str(error.value).startswith(complaint) and "\n" not in str(error.value)


class NotToBeSet(Random):
    """A learner with an argument that is a value of the run."""

    def __init__(self, specs: object, *, freeze: bool) -> None:
        raise AssertionError(freeze)


def test_an_argument_with_the_name_of_a_value_of_the_run_is_refused_in_one_line():
    cfg = compose_config(["low=random"])
    cfg.low._target_ = f"{__name__}.NotToBeSet"
    with pytest.raises(ConfigError, match=r"low=random: NotToBeSet has a setting freeze, but low.freeze is a value of"):
        read(cfg)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["recipe=goal_pdqm"], "recipe=goal_pdqm: no such file in conf/recipe; did you mean goal_pdqn? It has "),
        (["recipe/high=boatdock_uc"], "recipe/high=boatdock_uc: no such file in conf/recipe/high; did you mean "),
        (["hydra.searchpath=[/nowhere]"], "hydra.searchpath=/nowhere: there is no such folder"),
    ],
)
def test_a_missing_recipe_or_folder_is_refused_in_one_line(words, complaint):
    with pytest.raises(ConfigError) as error:
        make_config(words)
    assert str(error.value).startswith(complaint) and "\n" not in str(error.value)


def test_a_recipe_of_another_problem_can_be_chosen():
    assert make_config(["low=pdqn", "high=ucb", "recipe=goal_pdqn"]).low.settings["reward_scale"] == 0.02


def test_a_bug_in_a_constructor_is_no_mistake_of_the_users():
    with pytest.raises(ValueError, match="not enough values to unpack") as raised:
        component("low", "sample", SAMPLE | {"widths": [14]}).build(specs=None)
    assert not isinstance(raised.value, ConfigError)


def test_a_module_that_lacks_what_it_imports_is_no_mistake_of_the_users(tmp_path, monkeypatch):
    (tmp_path / "needy.py").write_text("import something_not_installed\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError):
        load_class("needy.Class")


def test_only_the_selector_and_the_data_can_be_none():
    for group in ("high", "data"):
        assert component(group, "none", {"_target_": None}).build(specs=None) is None
    with pytest.raises(ConfigError, match=r"high\.option: no such setting of none"):
        component("high", "none", {"_target_": None, "option": 1})
    with pytest.raises(ConfigError, match=r"low\._target_"):
        component("low", "none", {"_target_": None})


def module_paths(values: object) -> list[str]:
    """Return the dotted names of modules and classes in a nested config."""
    if isinstance(values, dict):
        return [path for value in values.values() for path in module_paths(value)]
    if isinstance(values, list):
        return [path for value in values for path in module_paths(value)]
    return [values] if isinstance(values, str) and values.startswith(("hpamdp.", "toy_")) else []


@pytest.mark.parametrize("n", range(max(len(choices(group)) for group in GROUPS)))
def test_a_yaml_and_its_class_have_the_same_options_and_all_are_read_back_as_they_were_saved(n):
    # Hydra takes longer than the rest, so the files of all groups are composed together, the n-th with the n-th.
    names = {group: choices(group)[n % len(choices(group))] for group in GROUPS}
    cfg = compose_config([f"{group}={name}" for group, name in names.items()])
    config = read(cfg)
    saved = json.loads(json.dumps(config.to_dict()))
    assert read_saved(saved) == config and not module_paths(saved) and "'_target_'" not in str(saved)
    for group, name in names.items():
        chosen = getattr(config, group)
        in_yaml = set(cfg[group]) - {"_target_", "budget", "checkpoint", "freeze", "per_option", "grouping"}
        assert chosen.name == name and set(chosen.settings) == in_yaml
        if chosen.cls is not None:
            assert in_yaml == settings_model(chosen.cls, SUPPLIED_ARGUMENTS[group]).model_fields.keys()
        assert ("budget" in cfg[group]) == (group == "low")
    assert set(cfg.low.budget) - {"eval_layouts"} == {"num_envs", "steps_per_batch", "total_frames", "eval_every"}


EXPERIMENTS = [*choices("experiment")]
EXPERIMENTS += [f"{folder}/{name}" for folder in ("circuits", "domains") for name in choices(f"experiment/{folder}")]
EXPERIMENTS += [
    f"lengths/{problem}_{ends}"
    for problem in ("rooms", "crossing")
    for ends in ("steps", "learned", "chosen", "chosen_actor")
]


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_is_a_valid_config(experiment):
    assert make_config([f"experiment={experiment}"])


def test_a_name_of_a_saved_config_that_is_nowhere_is_told_in_one_line():
    saved = make_config([]).to_dict()
    saved["choices"]["low"] = "gone"
    with pytest.raises(ConfigError, match=r"the saved run chose low/gone, which is not there; is a --config-dir miss"):
        read_saved(saved)


def test_every_yaml_says_what_it_is():
    assert not [file for file in CONF.rglob("*.yaml") if not file.read_text().startswith("#")]


def test_a_yaml_holds_only_what_differs_from_its_class_and_every_setting_has_its_meaning_in_the_model():
    offenders = []
    for group, name in (*FILES, *((CALLBACK, name) for name in choices(CALLBACK))):
        given = yaml.safe_load((CONF / group / f"{name}.yaml").read_text())
        target = given.pop("_target_")
        given.pop("defaults", None)
        if target is not None:
            model = settings_model(load_class(target), SUPPLIED_ARGUMENTS.get(group, ()))
            defaults = defaults_of(model)
            same = [key for key, value in given.items() if key != "budget" and value == defaults.get(key, value)]
            nameless = sorted(model.model_fields.keys() - meanings_of(model).keys())
            offenders += [f"{group}/{name}: {key}" for key in (*same, *nameless)]
    assert not offenders


@pytest.mark.parametrize(
    ("words", "low"),
    [
        ("env=platform", "hyar"),
        ("env=gymnasium env.id=CartPole-v1", "hppo"),
        ("env=gymnasium env.id=CartPole-v1 low=pdqn", "pdqn"),
        ("env=rddl", "hppo"),
        ("env=own", "hppo"),
        ("env=whole", "hppo"),
        ("env=pole", "hppo"),
        ("env=ledges", "hyar"),
        ("experiment=pole", "hppo"),
        ("experiment=pole low=hsac", "hsac"),
        ("experiment=chosen", "pdqn"),
    ],
)
def test_hppo_learns_the_problems_of_users_unless_a_learner_is_chosen(words, low, tmp_path):
    files = {
        "env/own": "_target_: hpamdp.env.platform.environment.PlatformEnv",
        "env/whole": "defaults: [_self_]\n_target_: hpamdp.env.platform.environment.PlatformEnv",
        "env/pole": "defaults: [gymnasium]\nid: CartPole-v1",
        "env/ledges": "defaults: [platform]",
        "experiment/pole": "# @package _global_\ndefaults: [override /env: pole]",
        "experiment/chosen": "# @package _global_\ndefaults: [override /env: gymnasium, override /low: pdqn]",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.yaml").write_text(text)
    cfg = compose_config([search_word([str(tmp_path)]), "high=none", *words.split()])
    assert read(cfg).low.name == low


def test_a_learner_gets_what_it_needs_on_a_problem_and_the_command_line_has_the_last_word():
    config = make_config(["env=platform", "high=none", "low=dlpa"])
    assert (config.low.settings["horizon"], config.run.total_frames) == (6, 10000)
    config = make_config(["env=platform", "high=none", "low=dlpa", "low.horizon=3", "total_frames=64"])
    assert (config.low.settings["horizon"], config.run.total_frames) == (3, 64)
    assert make_config(["low=dlpa"]).low.settings["horizon"] != 6


def test_a_selector_gets_what_it_needs_on_a_problem():
    assert make_config(["high=ucb"]).high.settings["exploration"] == 4.0
    assert make_config(["high=ucb", "high.exploration=1.0"]).high.settings["exploration"] == 1.0
    assert make_config(["env=rooms", "high=ucb"]).high.settings["exploration"] == UCB.Options().exploration
    assert make_config(["env=rooms", "high=fixed", "recipe/high=boatdock_fixed"]).high.settings["option"] == "congruent"


@pytest.mark.parametrize("low", [name.removeprefix("gymnasium_") for name in choices("recipe") if "gymnasium_" in name])
def test_a_learner_on_an_unknown_problem_gets_scaled_numbers_and_expects_nothing_after_the_limit(low):
    env = make_config(["env=gymnasium", "env.id=Any-v0", f"low={low}", "high=none"]).env.options
    assert (env.observation_scaling, env.terminates_at_limit) == ("running", True)
    assert env.reward_scaling is not None


def test_gymnasium_environments_are_evaluated_on_fewer_episodes():
    words = ["env=gymnasium", "env.id=hpamdp/Goal-v0", "high=none"]
    assert make_config(words).run.eval.layouts == 20 < make_config(["env=goal", "high=none"]).run.eval.layouts
    assert make_config([*words, "eval.layouts=7"]).run.eval.layouts == 7


@pytest.mark.parametrize(("group", "folder"), [("low", "recipe"), ("high", "recipe/high")])
def test_every_recipe_is_of_a_problem_and_a_learner_or_a_selector(group, folder):
    pairs = {f"{env}_{name}" for env in choices("env") for name in choices(group)}
    assert {file.stem for file in CONF.glob(f"{folder}/*.yaml")} <= pairs


def test_a_recipe_of_a_pair_counts_for_this_selector_over_this_learner_alone():
    known = {f"{env}_{low}_{high}" for env in choices("env") for low in choices("low") for high in choices("high")}
    assert {file.stem for file in CONF.glob("recipe/pair/*.yaml")} <= known
    sizes = [make_config([f"high={high}", "low=hppo"]).low.settings["minibatch_size"] for high in ("linucb", "ucb")]
    assert sizes == [1024, 2048]


def test_cuda_is_refused_in_one_line_where_there_is_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="device=cuda:1: this machine has no usable CUDA device"):
        make_config(["device=cuda:1"]).run.resolve_device()
    assert make_config(["device=auto"]).run.resolve_device() == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert make_config(["device=cuda:1"]).run.resolve_device() == torch.device("cuda:1")
    assert make_config(["device=auto"]).run.resolve_device().type == "cuda"
    with pytest.raises(ConfigError, match="has CUDA devices 0 to 1"):
        make_config(["device=cuda:2"]).run.resolve_device()


@pytest.mark.parametrize(
    ("words", "blind"),
    [
        (["high=none", "low=pdqn"], None),
        (["high=none", "low=pets"], "low=pets"),
        (["high=none", "low=pets", "low.gamma=1"], None),
        (["env.grouping=default", "high=meta_critic", "low=pdqn"], "high=meta_critic"),
        (["env.grouping=default", "high=ucb", "low=pdqn"], None),
    ],
)
def test_a_level_that_discounts_long_and_short_steps_alike_is_told_of(words, blind):
    warning = compatibility.uncounted_durations(make_config(["env=platform", *words]))
    assert warning is None if blind is None else warning.startswith(f"{blind}: discounts all steps alike")
