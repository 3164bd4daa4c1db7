"""A saved config is read back as it was, and nothing in it runs: `hpamdp.config.saved`, and every way in."""

import importlib.util
import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml
from conftest import CONF, OWN, choices, compose_config, make_config, parts_of
from test_grid import SHORT, SHORT_SELECTORS, SMALL

from hpamdp.commands.play import permissions
from hpamdp.config.components import GROUPS, card_named, load_class
from hpamdp.config.errors import ConfigError
from hpamdp.config.saved import needs_trust, read_saved
from hpamdp.config.schema import Config
from hpamdp.messages import one_line
from hpamdp.run.state_file import write
from hpamdp.run.train import run

TINY = ["num_envs=2", "steps_per_batch=2", "total_frames=8", "eval.layouts=2", "eval.every=0", "film=false"]
TOY = ["env=gymnasium", "env.entry_point=toy_environments:Toy", "env.kwargs={length:4}", "env.max_steps=6"]
AGENTS = Path(__file__).resolve().parent.parent / "agents"


def saved(config: Config) -> dict:
    """Return the config as a file holds it."""
    return json.loads(json.dumps(config.to_dict()))


def assert_all_commands_work(command, *words: str, trust: str = "trust=false", own: tuple[str, ...] = ()) -> None:
    """Train a run, then go on with it, score it and film it."""
    code, _, err = command(*own, *TINY, *words, "hydra.run.dir=a")
    assert code == 0, err
    is_offline = "mode=offline" in words
    more = ["mode=offline", "offline.updates=2"] if is_offline else ["total_frames=320"]
    for again in (["resume=a", *more, "hydra.run.dir=b"], ["mode=eval", "checkpoint=a", "hydra.run.dir=c"]):
        code, _, err = command(*own, *again, trust)
        assert code == 0, err
    code, _, err = command("watch", "a", *own, trust, "--episodes=1", "--size=40", "--fps=5")
    assert code == 0 or "has no pictures to film" in err, err


def test_settings_called_as_entries_of_a_saved_config_keep_their_values(command, tmp_path):
    values = ["name=csv", "budget=7", "checkpoint=x", "freeze=true", "choices={low: hppo}", "per_option={a: random}"]
    words = [f"{group}.{value}" for group in ("logger", "env") for value in values]
    words += ["logger.options=[b]", "logger=named", "env=named", "high=none", "low=random"]
    assert_all_commands_work(command, *words, own=(OWN,))
    # The evaluation logs where its own command line says.
    line = "('csv', 7, 'x', {'low': 'hppo'}, True, ['b'], {'a': 'random'})"
    assert (tmp_path / "logged.txt").read_text().splitlines() == [line, line]
    assert yaml.safe_load((tmp_path / "c/config.yaml").read_text())["env"]["checkpoint"] == "x"


ONE_BOAT = ["env.controller=random", "high=none", "low=random"]
PEOPLE = ["mode=offline", "offline.updates=1", "data=human", "low=bc", "high=linucb"]
# What a value needs, if not the default problem with random actions.
NEEDS = {
    "env=gymnasium": ["high=none", *TOY],
    "env=rooms": ["high=uniform"],
    "env=boatdock": [],
    "env=boatdock_released": ["high=none", "env.max_steps=9"],
    "high=none": ONE_BOAT,
    "high=value": ["low=pdqn", *SHORT["pdqn"]],
    "high=option_critic": ["low=hppo", *SHORT["hppo"], "agent.termination=learned", "env.switch_cost=0.1"],
    "low=bc": PEOPLE,
    "data=human": PEOPLE,
    "logger=wandb": ["logger.mode=disabled"],
}
SKIPPED = {"data=recorded"}  # needs a file of one's own


@pytest.mark.slow
@pytest.mark.parametrize("value", [f"{group}={name}" for group in GROUPS for name in choices(group)])
def test_a_run_of_every_value_of_every_group_is_resumed_scored_and_filmed(value, command):
    if value in SKIPPED or (NEEDS.get(value) == PEOPLE and "HPAMDP_HUMAN_DATA" not in os.environ):
        pytest.skip(f"{value} needs a data set")
    if value in ("collector=ray", "logger=tensorboard") and importlib.util.find_spec(value.partition("=")[2]) is None:
        pytest.skip(f"{value} is not installed")
    group, _, name = value.partition("=")
    needs = NEEDS.get(value, ["high=none"] if group == "env" else [])
    learner = [] if any(word.startswith("low=") for word in [value, *needs]) else ["low=random"]
    # Long enough for an update.
    short = [*SHORT_SELECTORS.get(name, []), *SHORT.get(name, []), *SMALL] if group in ("high", "low") else []
    trust = "trust=true" if value == "env=gymnasium" else "trust=false"
    assert_all_commands_work(command, *learner, *needs, *short, *({value} - {*needs}), trust=trust)


@pytest.fixture(scope="module")
def of_toy(tmp_path_factory):
    """Return the folder of a run on an environment that is named by its entry point."""
    folder = tmp_path_factory.mktemp("toy") / "run"
    words = [*TOY, "high=none", "low=random", *TINY]
    assert run(compose_config(words), folder, words) == 0
    return folder


def forged(folder: Path, target: Path, change: Callable[[dict], None]) -> Path:
    """Copy a run's checkpoint and networks, with its config changed."""
    target.mkdir()

    for name in ("checkpoint.safetensors", "policy.safetensors"):
        parts = parts_of(folder / name)
        change(parts["progress"]["config"])
        write(target / name, parts)
    return target


def set_to(group: str, name: str, value: object) -> Callable[[dict], None]:
    return lambda config: config[group].update({name: value})


@pytest.fixture
def bait(tmp_path, monkeypatch):
    """Return how to tell whether the module `bait` was imported."""
    (tmp_path / "bait.py").write_text("from pathlib import Path\nPath('taken').touch()\n")
    monkeypatch.syspath_prepend(tmp_path)
    return (tmp_path / "taken").exists


WAYS_IN = {
    "eval": ["mode=eval", "checkpoint={}"],
    "networks": ["mode=eval", "checkpoint={}/policy.safetensors"],
    "resume": ["resume={}", "total_frames=16"],
    "watch": ["watch", "{}", "--episodes=1"],
    "play": ["play", "--agent={}", "--export=site"],
    "low.checkpoint": [*TOY[:2], *TOY[3:], "low.checkpoint={}", "high=none", "low=random", *TINY],
}


@pytest.mark.parametrize("way", WAYS_IN)
def test_a_file_names_no_code_by_any_way_in(way, of_toy, bait, command, tmp_path):
    forgeries = [
        *(set_to("env", name, "bait:make") for name in ("entry_point", "id")),
        *(set_to(group, "_target_", "bait.Anything") for group in GROUPS),
        set_to("low", "per_option", {"option0": {"name": "random", "_target_": "bait.Anything"}}),
        set_to("low", "per_option", {"option0": "../../bait"}),
        set_to("choices", "env", "../../bait"),
        set_to("choices", "low", "random,bait"),
    ]
    for number, change in enumerate(forgeries if way == "eval" else [forgeries[0], forgeries[-3]]):
        folder = forged(of_toy, tmp_path / str(number), change)
        code, _, err = command(*(word.format(folder) for word in WAYS_IN[way]))
        assert (code, err.count("\n")) == (2, 1) or way == "low.checkpoint", err  # which takes the networks alone
        assert not bait()


def test_classes_come_from_the_yaml_files_even_with_trust(of_toy, bait, command, tmp_path):
    def change(config: dict) -> None:
        for group in GROUPS:
            config[group]["_target_"] = "bait.Anything"

    folder = forged(of_toy, tmp_path / "forged", change)
    assert command(f"resume={folder}", "trust=true", "total_frames=16")[0] == 0
    assert not bait()


def test_guarded_settings_are_accepted_if_repeated_or_if_the_file_is_trusted(of_toy, command):
    evaluation = ["mode=eval", f"checkpoint={of_toy}"]
    code, _, err = command(*evaluation)
    line = 'env.entry_point="toy_environments:Toy", env.kwargs={"length": 4}: set by '
    assert code == 2 and err.startswith(line) and err.count("\n") == 1
    assert "set env.entry_point and env.kwargs on the command line, or add trust=true" in err
    assert command(*evaluation, "env.entry_point=toy_environments:Toy")[0] == 2
    said = ["env.entry_point=toy_environments:Toy", "env.kwargs={length:3}"]
    assert command(*evaluation, *said)[0] == 0
    assert command(f"resume={of_toy}", "trust=true", "total_frames=16", "hydra.run.dir=b")[0] == 0
    assert "trust" not in yaml.safe_load(Path("b/config.yaml").read_text())
    assert "has no pictures" in command("watch", str(of_toy), "trust=true")[2]
    assert "has no pictures" in command("watch", str(of_toy), *said)[2]


def test_play_accepts_a_guarded_setting_if_repeated_or_if_the_file_is_trusted(command, tmp_path):
    parts = parts_of(AGENTS / "hppo_congruent/policy.safetensors")
    parts["progress"]["config"]["env"]["recording"] = "gone.jsonl"
    write(tmp_path / "policy.safetensors", parts)
    play = ["play", f"--agent={tmp_path}", "--export=site"]
    assert 'env.recording="gone.jsonl": set by' in command(*play)[2]
    # Then the file is looked for.
    assert "there is no such file" in command(*play, "trust=true")[2]
    assert permissions(str(tmp_path), make_config([]), ["env.recording=null", "env.slip=0"]) == ["env.recording=null"]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["env.slip=abc"], 'env.slip="abc": must be a valid number (BoatDockEnv)'),
        (["env=platform"], "high=linucb: env=platform has no options to choose; use high=none"),
    ],
)
def test_a_wrong_word_for_a_saved_agent_is_told(words, line, command):
    code, _, err = command("mode=eval", "checkpoint=linucb_hppo", *words)
    assert (code, err) == (2, f"{line}\n")


def test_no_file_gives_itself_trust(of_toy, command, tmp_path):
    folder = forged(of_toy, tmp_path / "forged", lambda config: config.update(trust=True))
    code, _, err = command("mode=eval", f"checkpoint={folder}")
    assert code == 2 and "trust=true" in err


def test_the_page_names_every_setting_that_needs_consent():
    page = (AGENTS.parent / "docs/opening-files.md").read_text()
    table = {
        word for line in page.splitlines() if line.startswith("|") for word in re.findall(r"`(\w+\.[\w=]+)`", line)
    }
    guarded = set()
    for file in (file for group in GROUPS for file in (CONF / group).glob("*.yaml")):
        target = yaml.safe_load(file.read_text())["_target_"]
        if target is not None:
            card = card_named(target) or load_class(target).card
            guarded |= {f"{file.parent.name}.{setting}" for setting in card.guarded_settings}
    assert guarded == {word for word in table if word.partition(".")[0] in GROUPS}


def test_the_command_that_continues_a_run_has_trust_if_needed():
    assert needs_trust(make_config([*TOY, "high=none", "low=random"])) and not needs_trust(make_config([]))


def test_files_and_servers_that_a_file_names_are_not_reached_unasked():
    config = make_config(["logger=wandb", "collector=ray", "low=random"])
    for group, name, value in (
        ("env", "recording", "/etc/passwd"),
        ("logger", "entity", "somebody"),
        ("logger", "mode", "online"),
        ("collector", "address", "ray://elsewhere:10001"),
    ):
        values = saved(config)
        values[group][name] = value
        with pytest.raises(ConfigError, match=rf"^{group}\.{name}=\"{value}\": set by .*trust=true"):
            read_saved(values)
        assert getattr(read_saved(values, trust=True), group).settings[name] == value
        assert getattr(read_saved(values, {f"{group}.{name}": value}), group).settings[name] == value


def test_text_of_a_saved_config_stays_text(of_toy, monkeypatch, tmp_path, command):
    monkeypatch.setenv("SECRET", "told")
    folder = forged(of_toy, tmp_path / "forged", set_to("low", "checkpoint", "${oc.env:SECRET}"))
    assert command("mode=eval", f"checkpoint={folder}", "trust=true", "hydra.run.dir=b")[0] == 0
    written = Path("b/config.yaml").read_text()
    assert yaml.safe_load(written)["low"]["checkpoint"] == "${oc.env:SECRET}" and "told" not in written
    values = saved(make_config(["logger=wandb", "low=random"]))
    for text in ("${oc.env:SECRET}", "${", "???", "a\\${seed}"):
        values["logger"]["name"] = text
        values["env"]["grouping"] = {text: [text]}
        config = read_saved(values)
        assert config.logger.settings["name"] == text and config.run.env.grouping == {text: [text]}
        assert read_saved(saved(config)) == config


@pytest.mark.parametrize(
    "change",
    [
        set_to("low", "per_option", {"a": {"name": ["random"]}}),
        set_to("env", "\x1b[31m", 1),
        lambda config: config.update(hydra={"run": {"dir": "/"}}),
    ],
)
def test_a_config_of_another_form_is_refused_in_one_short_line(change):
    values = saved(make_config(["low=random"]))
    change(values)
    with pytest.raises(ConfigError) as error:
        read_saved(values)
    line = one_line(error.value)
    assert "\n" not in str(error.value) and len(line) < 1000 and line.isprintable()


def test_the_name_that_0_3_had_for_practice_is_read():
    saved = make_config(["low=random"]).to_dict()
    del saved["agent"]["practice"]
    saved["agent"]["uniform_option_steps"] = 77
    assert read_saved(saved).run.agent.practice == 77


def test_a_setting_that_a_saved_run_lacks_has_its_default_and_not_the_value_of_todays_recipe():
    saved = make_config(["env=gymnasium", "env.id=CartPole-v1", "low=hppo"]).to_dict()
    assert saved["env"].pop("terminates_at_limit") and saved["env"].pop("reward_clip") == 100.0
    env = read_saved(saved, trust=True).env.settings
    assert env["terminates_at_limit"] is False and env["reward_clip"] == 10.0
