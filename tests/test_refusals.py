"""Settings that no run can have are refused in one line, before anything large is built."""

import re
import sys

import pytest
import yaml
from conftest import CONF, choices, compose_config, make_config
from omegaconf import DictConfig, OmegaConf
from pydantic import TypeAdapter

import hpamdp
from hpamdp.config.components import GROUPS, card_named
from hpamdp.config.compose import read
from hpamdp.config.errors import ConfigError
from hpamdp.limits import is_about_memory
from hpamdp.run.assemble import assemble, choose_selector
from hpamdp.run.checkpoint import progress_of
from hpamdp.run.compatibility import settings_without_effect
from hpamdp.run.players import load_agent, split_words
from hpamdp.run.resume import check_saved_options, resolve
from hpamdp.run.train import run
from hpamdp.settings import OnlyWith, SettingError

SMALL = ["num_envs=4", "steps_per_batch=4", "total_frames=32", "eval.layouts=4", "eval.every=0"]
PLATFORM = "env=platform high=none low=random "
GYMNASIUM = "env=gymnasium high=none low=random env.max_steps=9 "
CROSSING = "env=crossing low=stepper"
PICTURE = "env=catch_point_picture high=none "
CHOSEN = "env=rooms low=random agent.termination=chosen agent.option_lengths=[1,2,4] "
SCALED = "env=gymnasium env.id=hpamdp/Moving-v0 high=none low=hppo collector=multi env.observation_scaling=running "

REFUSED = [
    ("low=qpamdp collector=multi collector.ahead=true", "low=qpamdp learns from steps of its current policy"),
    # More than there is memory for.
    ("num_envs=1000000000", "num_envs=1000000000: must be less than or equal to 10000000 (conf/config.yaml"),
    # Numbers out of all proportion.
    ("low=hppo low.lr=1e30", "low.lr=1e+30: must be less than or equal to 1 (HPPO)"),
    ("exploration=held exploration.epsilon_final=0.5", "exploration: epsilon_final=0.5: must be at most epsilon=0.05"),
    ("env.motor_noise=[0,11]", "env: motor_noise=11.0: must lie between 0 and 10"),
    # Values that contradict one another.
    ("high=value low=dlpa", "high=value: low=dlpa has no value to compare without low.end_values=true"),
    ("low.buffer_size=4 low.batch_size=64", "low: batch_size=64: must be at most buffer_size=4"),
    (
        "num_envs=1024 steps_per_batch=65536 total_frames=524288",
        "steps_per_batch=65536: counts the steps of each of num_envs=1024, so a batch has 67,108,864",
    ),
    ("eval.stop_score=1.97", "eval.stop_score=1.97: "),
    ("low=pdqn low.n_step=5", "low.n_step=5: must be at most steps_per_batch=4, as sums of rewards end with a batch"),
    ("low=dlpa low.horizon=10000000", "low: horizon=10000000, num_iterations=5, num_samples=256: a plan would try"),
    ("low.updates_per_step=1e9", "low: updates_per_step=1000000000.0: must be at most 1000"),
    ("low=qpamdp low.features=[0,16]", "low: features=[0, 16]: name some of the observation's entries 0 to 15"),
    ("low=qpamdp low.phi_order=1000000", "low: phi_order=1000000, psi_order=3: the regression for the parameters"),
    ("high=linucb high.inputs=[1,1]", "high: inputs=[1, 1]: names an entry twice"),
    ("high=linucb high.features=projections high.degree=2", "features=projections: takes neither inputs nor degree"),
    ("low=hppo low.initial_scale=2.0", "initial_scale=2.0: must lie between min_scale="),
    ("low=hppo low.max_scale_final=1.5", "max_scale_final=1.5"),
    ("low=hppo low.min_scale=0.05 low.max_scale_final=0.01", "max_scale_final=0.01"),
    ("low=pdqn low.preactivation_penalty=0.1 low.bounding=inverting_gradients", "preactivation_penalty=0.1: needs"),
    ("low=pdqn low.search_samples=8 low.multipass=false", "search_samples=8: needs multipass=true"),
    ("low=hyar low.critic_window=10", "critic_window=10: must be at least batch_size="),
    ("low=hyar low.noise_initial=0.01 low.parameter_noise=0.1", "noise_initial=0.01: must be at least parameter_no"),
    ("low=pets low.min_deviation=0.3 low.first_min_deviation=0.2", "min_deviation=0.3: must be at most first_min_"),
    ("low=pets low.num_elites=20 low.num_samples=16", "num_elites=20: must be at most num_samples=16"),
    ("low=pets low.num_elites=12 low.greedy_samples=8", "num_elites=12: must be at most greedy_samples=8"),
    ("high=linucb high.features=random_fourier high.degree=2000", "degree=2000: 2001 features of 16 inputs; at most"),
    # Parts of another kind.
    ("low=random low._target_=hpamdp.policies.random_agent.random_agent", "there is no class random_agent in "),
    ("low._target_=hpamdp.policies.low_level.random.Random", " more like this"),
    # Boats.
    ("env.boats=[congruent,sideways]", "env: boats=['congruent', 'sideways']: no controller sideways; controllers"),
    ("env.boats=[congruent]", "boats=['congruent']: nothing to choose; name more, or use controller=congruent"),
    ("+env.controllers.sideways=[0,180]", "controllers.sideways=[0.0, 180.0]: must be 3 directions in degrees"),
    ("env.controllers.congruent=[0,120,240]", "congruent is [150.0, 270.0, 30.0]; take another name"),
    ("env.boats=[congruent,incongruent1] env.controller=incongruent high=none", "controller=incongruent: must be one"),
    ("env.boats=[congruent,incongruent1] high=human", "controllers, so what they chose says nothing here; leave it"),
    ("env.switch_cost=0.2 env.controller=random high=none", "switch_cost=0.2: controller=random never changes"),
    ("env.switch_cost=0.2 high=oracle low=planner", "low=planner: its plans on env=boatdock change options, but"),
    ("env.switch_cost=0.2 agent.termination=steps agent.option_length=1", "high=ucb is a bandit, which counts what "),
    ("high=meta_critic agent.termination=steps agent.option_length=1", "agent.termination=steps: env=boatdock keeps"),
    ("high=none", "high=none: env=boatdock needs a selector; use another high or env.controller=congruent (or incong"),
    # Levels that do not go together.
    ("high=ucb env=platform low=random", "high=ucb: env=platform has no options to choose; use high=none"),
    ("high=none low=planner env=platform", "low=planner: env=platform has no planner to ask"),
    ("high=ucb env.controller=random", "high=ucb: env=boatdock leaves nothing to choose; use high=none or env.contr"),
    ("high=none env.controller=random low=random low.freeze=true", "low.freeze=true: there is no choice left to learn"),
    (
        "high=linucb env.observation=pixels high.inputs=[14,15]",
        "high: inputs=[14, 15]: the observation has entries 0 to 13; null: all",
    ),
    ("high=exp3 low=iql mode=offline data=human", "high=exp3: learns from its own choices only; use mode=train, or"),
    ("low=random low.checkpoint=/nowhere", "low.checkpoint=/nowhere: no checkpoint there; give a run's output folder"),
    (f"{CROSSING} high=actor agent.termination=learned", "high=actor does not decide where options end; use high=opt"),
    (f"{CROSSING} high=ucb agent.termination=steps agent.option_length=3 low.freeze=true", "plays whole episodes; use"),
    ("agent.termination=steps", "agent.option_length: missing; agent.termination=steps needs the number of steps of"),
    # Data sets.
    ("low=bc", "low=bc learns from data sets only; use mode=offline and a data set"),
    ("low=hppo mode=offline data=human", "low=hppo learns from its own steps only; use data=none"),
    ("low=iql mode=offline", "mode=offline: data=none leaves nothing to learn from; choose a data set"),
    ("low=iql high=none env=platform mode=offline data=human", "people docked boats; use env=boatdock"),
    # Explorations.
    ("low=random exploration=held", "exploration=held: changes actions, which low=random does not take; use "),
    ("low=bc mode=offline data=human exploration=held", "exploration=held: mode=offline takes no steps"),
    ("low=hppo low.freeze=true exploration=held", "exploration=held: low.freeze=true keeps the learners as they are"),
    ("low=pdqn low.augment=true exploration=novelty", "exploration: low.augment=true: maps states to others that were"),
    ("high=none low=hppo env=catch_point_picture exploration=counts", "exploration: no picture is seen twice; use "),
    ("high=value low=pets exploration=counts", "exploration: low=pets does not predict whole observations here, so "),
    ("high=value low=pets exploration=novelty exploration.in_plans=distillation", "use low.augment=false, or explor"),
    ("low=hppo exploration=counts exploration.resolution=[1.0,2.0]", "must have a number for each of 16 entries"),
    ("low=hppo exploration=counts exploration.resolution=[0,0,0,0,0,0,0,0,0,0,0,0,0,0,0,0]", "have a number above 0"),
    ("low=hppo exploration=counts exploration.resolution=1e30", "must be from 1e-12 to 1e+06"),
    (PLATFORM + "low=pets low.augment=true", "augment=true: the problem declares no symmetries; use augment=false"),
    # Pictures.
    (PICTURE + "low=pets", "low=pets: env=catch_point_picture observes pictures, which it has no encoder for"),
    (PICTURE + "low=hyar", "low=hyar: env=catch_point_picture observes pictures"),
    ("high=none env=goal low=hppo encoder=cnn", "encoder=cnn: env=goal observes no pictures; use encoder=auto"),
    (PICTURE + "low=hppo encoder.net=nature encoder.num_features=0", "encoder.num_features=0"),
    # Memories.
    ("low=hppo low.memory=gru low.vector_products=true", "vector_products=true: does not go with memory"),
    ("low=pets low.memory=gru low.augment=true", "augment=true: does not go with memory=gru"),
    ("low=pdqn low.memory=gru low.n_step=2", "n_step=2: does not go with memory=gru"),
    ("low=hppo low.memory=gru compile_updates=true total_frames=9999", "compile_updates=true: low=hppo: memory=gru"),
    ("low=pdqn low.memory=gru data=human", "lacks what a policy remembered"),
    ("low=hppo high=actor high.memory=gru", "high.memory=gru: agent.termination=episode has one decision"),
    ("low=hppo high=option_critic high.memory=gru", "must be 'none' or 'stack'"),
    # Updates.
    (PLATFORM + "low=qpamdp compile_updates=true", "compile_updates=true: low=qpamdp: its updates cannot be compiled"),
    (PLATFORM + "low=qpamdp update_precision=bfloat16", "low=qpamdp: its updates are made in float32 alone"),
    # Lengths that are chosen.
    (CHOSEN + "high=ucb", "agent.termination=chosen: high=ucb is a bandit, which counts what an option returns"),
    (CHOSEN + "high=value low=hppo", "agent.termination=chosen: high=value compares the learners' values, which do "),
    (CHOSEN + "high=actor data=recorded data.path=x", "agent.termination=chosen: the decisions of data=recorded have"),
    (CHOSEN + "high=actor low.freeze=true", "agent.termination=chosen: low.freeze=true plays whole episodes; use"),
    (CHOSEN + "high=actor agent.option_lengths=[1,4,2]", "agent.option_lengths=[1, 4, 2]: must be increasing numbers"),
    (CHOSEN + "high=actor agent.option_lengths=[0,1]", "agent.option_lengths.0=0: must be greater than 0"),
    (CHOSEN + "high=actor agent.termination=steps agent.option_length=2", "agent.option_lengths=[1, 2, 4]: goes with"),
    (
        CHOSEN + "high=actor compile_updates=true low=pdqn",
        "compile_updates=true: agent.termination=chosen, so ",
    ),
    # Callbacks.
    ("callbacks=[patiense]", "callbacks.0=patiense: no such file in conf/callback; did you mean patience?"),
    ("callbacks=[{name:patience,evaluation:3}]", "callbacks.0.evaluation: no such setting of Patience; did you "),
    ("callbacks=[patience]", "callback=patience: needs evaluations during training; set eval.every"),
    # Workers.
    ("collector=multi collector.num_workers=3", "collector.num_workers=3: must divide num_envs=4"),
    (SCALED + "collector.ahead=true", "collector.ahead=true: env=gymnasium learns the scale"),
    # Observations of others.
    (
        GYMNASIUM + "env.entry_point=toy_environments:TickingGoal env.observation_keys=[2]",
        "observation_keys=[2]: must name different entries of [0, 1]; null: all",
    ),
    (GYMNASIUM + "env.id=CartPole-v1 env.observation_keys=0", "env.observation_keys=0: must be a list"),
]


def config_of(words: str) -> DictConfig:
    return compose_config([*SMALL, *words.split()])


@pytest.mark.parametrize(("words", "line"), REFUSED, ids=[words for words, _ in REFUSED])
def test_what_no_run_can_have_is_refused_in_one_line(words, line):
    with pytest.raises(ConfigError) as raised:
        assemble(choose_selector(read(config_of(words))))
    assert line in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("env", "module", "line"),
    [
        ("lunar_lander", "gymnasium.envs.box2d.lunar_lander", "Box2D is not installed; pip install 'hpamdp[box2d]'"),
        ("primitives", "metaworld.env_dict", "Meta-World is not installed; pip install 'hpamdp[robots]'"),
        ("rddl", "pyRDDLGym", "pyRDDLGym is not installed; pip install 'hpamdp[rddl]'"),
        ("traffic", "sumo", "SUMO is not installed; pip install 'hpamdp[traffic]'"),
        ("traffic", "libsumo", "SUMO is not installed; pip install 'hpamdp[traffic]'"),
    ],
)
def test_without_the_simulator_of_a_problem_one_line_says_what_to_install(env, module, line, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SettingError) as raised:
        make_config([f"env={env}"]).env.cls(1)
    assert str(raised.value).endswith(line) and "\n" not in str(raised.value)


def test_a_project_name_that_wandb_refuses_is_reported_in_one_line(tmp_path):
    with pytest.raises(
        ConfigError, match=r"^logger: project=a/b#c: Invalid project name 'a/b#c': cannot contain "
    ) as raised:
        run(config_of("logger=wandb logger.project='a/b#c' high=ucb low=random"), tmp_path)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "error",
    [MemoryError(), RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 9")],
)
def test_memory_that_does_not_suffice_during_training_is_told_in_one_line(error, monkeypatch, tmp_path):
    def train(self):
        raise error

    monkeypatch.setattr("hpamdp.run.trainer.Trainer.train", train)
    reason = rf" \({re.escape(str(error))}\)" if str(error) else ""
    with pytest.raises(
        ConfigError, match=rf"^num_envs=4, .*eval\.layouts=4.*: the run takes more memory than there is{reason}$"
    ):
        run(config_of("low=random"), tmp_path)


def test_other_errors_are_not_taken_for_missing_memory():
    assert is_about_memory(RuntimeError("CUDA out of memory. Tried to allocate 20.00 GiB"))
    assert not is_about_memory(RuntimeError("mat1 and mat2 shapes cannot be multiplied"))
    assert not is_about_memory(KeyError("out of memory"))


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return the folder of a run of H-PPO on Platform."""
    folder = tmp_path_factory.mktemp("saved") / "run"
    assert run(config_of("env=platform high=none low=hppo low.minibatch_size=16 env.noise=0.5"), folder) == 0
    return folder


@pytest.mark.parametrize(
    ("word", "line"),
    [
        ("low.clip=-1", "low.clip=-1: resume takes the agent from "),
        ("low=hyar", "low=hyar: resume takes the agent from "),
        ("env.nose=1", "env.nose: no such setting of PlatformEnv; did you mean noise? It has "),
        ("env.noise=-1", "env.noise=-1: must be greater than or equal to 0"),
        ("seed=5", "seed=5: the run in "),
        ("env.noise=0", "has env.noise=0.5; leave it out when you resume, or start a run with low.checkpoint="),
        ("env.max_steps=3", "has env.max_steps=200; leave it out"),
        ("env=goal", "env=goal: the run in "),
        ("data=human", "data=human: low=hppo learns from its own steps only"),
        ("total_frames=16", "total_frames=16: the run that is continued has 32 already; set more, or leave it out"),
    ],
)
def test_errors_of_a_resumed_run_name_its_own_parts(word, line, saved, command):
    code, _, err = command(f"resume={saved}", word)
    assert code == 2 and err.count("\n") == 1 and line in err


def test_an_agent_is_told_when_its_options_are_others(tmp_path, capsys):
    first = "env.boats=[congruent,incongruent1]"
    assert run(config_of(f"{first} high=uniform low=random film=false"), tmp_path / "saved") == 0
    assert progress_of(tmp_path / "saved/policy.safetensors")["option_names"] == ["congruent", "incongruent1"]

    def check(words, setting="low.checkpoint"):
        config = read(config_of(f"{words} high=uniform low=random {setting}={tmp_path / 'saved'}"))
        source = None if setting == "low.checkpoint" else tmp_path / "saved/checkpoint.safetensors"
        check_saved_options(config, config.env.build(num_envs=1), source)

    for setting in ("mode=eval checkpoint", "resume", "low.checkpoint"):
        with pytest.raises(ConfigError, match=r"saved/.*: its agent .* incongruent1, congruent; keep the order$"):
            check("env.boats=[incongruent1,congruent]", setting)
    with pytest.raises(ConfigError, match=r"congruent, incongruent1, but env=boatdock has .*2, congruent$"):
        check("env.boats=[incongruent1,incongruent2,congruent]")
    capsys.readouterr()
    check(first)
    check(f"{first} env.slip=0.5")
    assert capsys.readouterr().err == ""
    check("")
    assert "but env=boatdock has incongruent, congruent, which take their places" in capsys.readouterr().err


@pytest.mark.parametrize(
    "word",
    [
        *("total_frames=5", "eval.every=1", "data=human", "collector=multi", "eval={seed:1,every:5}", "callbacks=[]"),
        *("offline.updates=2", "checkpoint_minutes=1", "compile_updates=false"),
    ],
)
def test_settings_of_training_are_refused_where_nothing_is_trained(saved, word):
    line = rf"^{re.escape(word)}: has no effect without training; leave it out$"
    words = ["mode=eval", f"checkpoint={saved}", word]
    with pytest.raises(ConfigError, match=line):
        resolve(compose_config(words), words)
    for player in (["low=random", "high=uniform"], [f"{saved}"]):
        path, settings = split_words([*player, word])
        with pytest.raises(ConfigError, match=line):
            load_agent(path, settings)


@pytest.mark.parametrize("word", ["agent.values_end=trip", "low.freeze=true", "exploration=held"])
def test_how_the_parts_of_an_agent_learn_is_refused_for_a_player_who_is_not_trained(word):
    with pytest.raises(ConfigError, match=rf"^{re.escape(word)}: has no effect without training; leave it out$"):
        load_agent(None, ["env=boatdock_unseen", "env.boats=2", "low=random", "high=uniform", word])


@pytest.mark.parametrize("name", ["checkpoint", "resume", "low.checkpoint"])
def test_a_player_of_settings_takes_no_weights_from_a_saved_run_and_says_so(saved, name):
    for player in (["low=random", "high=uniform"], [f"{saved}"]):
        path, settings = split_words([*player, f"{name}={saved}"])
        with pytest.raises(ConfigError, match=rf"^{name}=.*: give the folder or the name of a saved agent alone"):
            load_agent(path, settings)


@pytest.mark.parametrize("word", ["mode=train", "overwrite=true", "logger=tensorboard"])
def test_what_only_a_run_uses_is_refused_for_a_player(saved, word):
    for player in (["low=random", "high=uniform"], [f"{saved}"]):
        path, settings = split_words([*player, word])
        with pytest.raises(ConfigError, match=rf"^{word}: has no effect on a player; leave it out$"):
            load_agent(path, settings)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["high=uniform", "agent.option_length=3"], "agent.option_length=3: goes with agent.termination=steps only"),
        (["high=value"], "high=value: low=random has no value to compare"),
        (["high=ucb", "high.memory=session"], "high.memory=session: episodes of env=boatdock have no trips"),
    ],
)
def test_the_settings_of_a_player_have_to_go_together_as_those_of_a_run(words, message):
    with pytest.raises(ConfigError, match=f"^{message}"):
        load_agent(None, ["low=random", *words])


@pytest.mark.parametrize(("word", "instead"), [("eval.layouts=3", "--episodes"), ("eval.seed=7", "--seed")])
def test_settings_that_watch_has_flags_for_are_refused(command, word, instead):
    code, _, err = command("watch", "low=random", "high=uniform", word)
    assert (code, err) == (2, f"{word}: the command has a flag for it; use {instead}\n")


@pytest.mark.parametrize("word", ["total_frames=5", "low.lr=0.1", "high=ucb", "callbacks=[]"])
def test_settings_that_change_nothing_about_a_page_are_refused(command, word):
    code, _, err = command("play", word, "--export", "site")
    assert (code, err) == (2, f"{word}: has no effect on the page; give settings of the problem\n")


@pytest.mark.parametrize(
    ("mode", "word"),
    [
        *(
            ("offline", word)
            for word in ("total_frames=5", "num_envs=2", "steps_per_batch=2", "eval.every=5", "collector=multi")
        ),
        *(("train", word) for word in ("offline.updates=2", "offline.eval_every=1")),
    ],
)
def test_the_length_of_another_mode_is_refused(mode, word):
    words = [f"mode={mode}", "low=random", word]
    with pytest.raises(ConfigError, match=rf"^{re.escape(word)}: has no effect with mode={mode}; leave it out$"):
        resolve(compose_config(words), words)


@pytest.mark.parametrize(
    ("words", "needs"),
    [
        ("low=hppo low.memory_size=8", "with memory=gru"),
        ("low=qpamdp low.patience=3", "with parameter_updates=null"),
        ("low=random high=ucb high.window=9", "with memory=sliding_window"),
        ("env=boatdock_unseen high=none low=random env.fleet_seed=3", "if fleet_size is set"),
        ("env=primitives high=none low=random env.actions=small_steps env.reach=0.5", "with actions=primitives or all"),
        (
            "low=pets exploration=novelty exploration.in_plans=disagreement exploration.lr=0.1",
            "with in_plans=auto or distillation",
        ),
        ("env=platform high=none low=pdqn low.epsilon_episodes=5 low.epsilon_steps=5", "with epsilon_episodes=null"),
        ("env=platform high=none low=pdqn low.epsilon_steps=5", None),
        ("data=human high=human mode=offline low=iql low.warmup_steps=9", "with mode=train"),
        ("data=human low=iql mode=offline high=epsilon_greedy high.epsilon_scale=9", "with mode=train"),
        ("data=human high=human mode=offline low=iql low.actor_lr_updates=9", None),
        ("low=hppo low.memory=gru low.memory_size=8", None),
        ("env=boatdock_unseen high=none low=hppo low.memory_size=8", None),  # whose recipe has low.memory=gru
        ("low=random high=ucb high.memory=sliding_window high.window=9", None),
    ],
)
def test_a_setting_that_counts_only_with_another_value_is_told(words, needs):
    *_, last = words.split()
    name = last.partition("=")[0].partition(".")[2]
    expected = [] if needs is None else [f"{last}: has no effect; {name} counts only {needs}"]
    assert settings_without_effect(read(config_of(words)), words.split()) == expected


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        (
            "+low.per_option={congruent:{name:hppo,memory_size:8}}",
            ["low.per_option.congruent.memory_size: has no effect; memory_size counts only with memory=gru"],
        ),
        ("+low.per_option={congruent:{name:hppo,memory:gru,memory_size:8}}", []),
        ("high={window:9}", ["high.window: has no effect; window counts only with memory=sliding_window"]),
    ],
)
def test_a_setting_without_effect_is_found_inside_a_mapping(word, expected):
    words = ["env=boatdock", "high=ucb", "low=random", word]
    assert settings_without_effect(read(config_of(" ".join(words))), words) == expected


def test_a_grouping_that_leaves_actions_out_is_told(command):
    words = ["env=platform", "high=ucb", "low=random", "+env.grouping={a: [run]}", *SMALL, "film=false"]
    code, _, err = command(*words)
    assert code == 0
    assert "env.grouping: no option has hop, leap; the agent never takes them (env=platform)\n" in err


def test_a_setting_without_effect_is_told_once_by_both_doors(command, capsys):
    words = ["env=platform", "high=none", "low=hppo", "low.minibatch_size=16", "low.memory_size=8"]
    line = "low.memory_size=8: has no effect; memory_size counts only with memory=gru"
    code, _, err = command(*words, *SMALL, "film=false")
    assert code == 0 and err.count(line) == 1
    capsys.readouterr()
    settings = {"total_frames": 32, "num_envs": 4, "steps_per_batch": 4, "eval.layouts": 4, "progress": False}
    hpamdp.train("platform", low={"name": "hppo", "minibatch_size": 16, "memory_size": 8}, **settings)
    assert capsys.readouterr().err.count(line) == 1


@pytest.mark.parametrize("word", ["total_frames=10", "low.budget.total_frames=10"])
def test_a_length_below_a_batch_is_told_unless_the_learner_recommends_it(word, command):
    words = ["env=platform", "low=random", "num_envs=4", "steps_per_batch=4", "eval.layouts=4", "film=false", word]
    code, _, err = command(*words)
    line = "total_frames=10: less than a batch of num_envs=4 x steps_per_batch=4; the run has 16 frames\n"
    assert code == 0 and err.count(line) == (word == "total_frames=10")


@pytest.mark.parametrize(("group", "name"), [(group, name) for group in GROUPS for name in choices(group)])
def test_settings_that_count_with_another_one_name_a_setting_and_its_values(group, name):
    target = yaml.safe_load((CONF / group / f"{name}.yaml").read_text()).get("_target_")
    card = None if target is None else card_named(target)
    assert (card is None) == (target is None), f"{target}: its module's options.py needs a card in CARDS"
    model = None if card is None else card.options
    if model is None:
        return
    for field in model.model_fields.values():
        for each in field.metadata:
            if isinstance(each, OnlyWith):
                assert each.name in model.model_fields
                for value in each.values:
                    TypeAdapter(model.model_fields[each.name].annotation).validate_python(value)


def test_a_resumed_run_keeps_the_saved_options_of_the_choices_that_it_does_not_change(saved, command, tmp_path):
    repeated = ["env=platform", "low=hppo", "env.noise=0.5", "seed=0", "eval.seed=3", "total_frames=64"]
    for number, words in enumerate((["eval.layouts=3"], repeated)):
        assert command(f"resume={saved}", f"hydra.run.dir={number}", *words)[0] == 0
        config = OmegaConf.load(tmp_path / f"{number}/config.yaml")
        assert config.env.noise == 0.5 and config.choices.low == "hppo"
        assert config.env.max_steps == 200 and (config.eval.layouts == 3) == (number == 0)
