"""Learning from data sets: what the learners and selectors make of human data, and which configs are refused."""

import json

import pytest
import torch
from conftest import compose_config, make_config
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.data.human.demonstrations import HumanDemonstrations
from hpamdp.data.human.released_file import read
from hpamdp.data.human.rest_to_rest import MAX_ERROR, MIN_DISTANCE, to_rest_to_rest
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.metrics_file import read_rows
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.low_level.bc import BC
from hpamdp.policies.low_level.iql import IQL
from hpamdp.policies.low_level.td3_bc import TD3BC
from hpamdp.run import checkpoint
from hpamdp.run.assemble import assemble
from hpamdp.run.train import begin, run
from hpamdp.run.trainer import Trainer
from hpamdp.specs import PAMDPSpecs

ALL = {"complete": False, "successes": False, "best_people": None, "checksum": None}
SMALL = ["mode=offline", "data=human", "data.checksum=null", "offline.updates=6", "offline.eval_every=3"]
SMALL += ["eval.layouts=4", "low.batch_size=16"]


@pytest.fixture(scope="module")
def path(people_file) -> str:
    return str(people_file)


def human_batch(path: str, rest_to_rest: bool = False, **env):
    return HumanDemonstrations(BoatDockEnv(**env), path=path, rest_to_rest=rest_to_rest, **ALL).batch


def overrides(path: str, low: str, high: str = "human") -> list[str]:
    plans = (
        ["low.horizon=2", "low.num_samples=8", "low.num_elites=4", "low.num_iterations=1"]
        if low in ("dlpa", "pets")
        else []
    )
    plans += ["low.greedy_samples=8", "low.max_sequences=8", "low.num_members=2"] if low == "pets" else []
    plans += ["low.transition_dims=[16]", "low.outcome_dims=[16]"] if low == "pets" else []
    return [*SMALL, f"data.path={path}", f"low={low}", f"high={high}", *plans]


@pytest.mark.parametrize(
    "low",
    ["bc", "iql", "pets", "dlpa", *(pytest.param(low, marks=pytest.mark.slow) for low in ("td3_bc", "pdqn", "hsac"))],
)
def test_a_learner_trains_on_a_data_set_without_stepping_an_environment(low, path, tmp_path):
    given = overrides(path, low)
    assert run(compose_config(given), tmp_path, given) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["frames"] == 6 and summary["without_update"] == []
    rows = read_rows(tmp_path / "metrics.csv")
    assert not any(name.startswith("train/") for row in rows for name in row)
    assert [row["frames"] for row in rows if "eval/score" in row] == [0, 3, 6]


def test_a_run_that_fails_at_its_start_adds_its_data_set_once(path, tmp_path, monkeypatch):
    added, add = [], HierarchicalAgent.add_demonstrations
    counted = lambda self, *data: (added.append(len(data[0])), add(self, *data))  # noqa: E731
    monkeypatch.setattr(HierarchicalAgent, "add_demonstrations", counted)
    words = ["data=human", "data.checksum=null", f"data.path={path}", "high=linucb", "low=pdqn", "low.warmup_steps=8"]
    words += ["num_envs=4", "steps_per_batch=4", "total_frames=16", "eval.layouts=4", "eval.every=0", "film=false"]
    with monkeypatch.context() as patched, pytest.raises(ZeroDivisionError):
        patched.setattr(Trainer, "_evaluate", lambda self, bar, request: 1 / 0)
        run(compose_config(words), tmp_path, words)
    trainer = begin(make_config(words), checkpoint.find(tmp_path, "resume"), tmp_path)  # as `resume=auto` does
    assert trainer.frames == 0
    trainer.train()
    assert trainer.frames == 16 and len(added) == 1


@pytest.mark.parametrize("high", ["ucb", "linucb", "meta_critic"])
def test_a_selector_learns_from_the_decisions_in_the_data(high, path):
    words = [*overrides(path, "iql", high), *(["high.memory=all"] if high != "meta_critic" else [])]
    parts = assemble(make_config(words))
    parts.agent.add_demonstrations(parts.data.batch, parts.data.decisions)
    num_episodes = len(read(path, checksum=None).episodes)
    selector = parts.agent.selector
    if high in ("ucb", "linucb"):
        assert selector.statistics.counts.sum() == num_episodes
    else:
        assert len(selector.buffer) == num_episodes


@pytest.mark.parametrize("reward", ["paper", "sparse"])
def test_selectors_learn_what_every_episode_returned_whatever_becomes_of_its_presses(reward, path):
    env = BoatDockEnv(reward=reward)
    episodes = read(path, checksum=None, one_frame=True).episodes
    decided = [
        HumanDemonstrations(env, path=path, rest_to_rest=rest_to_rest, **ALL).decisions
        for rest_to_rest in (True, False)
    ]
    assert (decided[0] == decided[1]).all()
    decisions = decided[0][0]
    assert torch.equal(decisions[keys.OPTION], episodes["controller"])
    is_success = episodes["outcome"] == physics.SUCCESS
    final = torch.where(is_success, 5.0 * episodes["tank"] / 360.0, 0.0)
    if reward == "paper":
        failed = torch.isin(episodes["outcome"], torch.tensor([physics.TOO_FAST, physics.OUT_OF_BOUNDS]))
        failed |= episodes["outcome"] == physics.OUT_OF_FUEL
        at_dock = is_success | (episodes["outcome"] == physics.TOO_FAST)
        progress = 1.0 - physics.DOCK_RADIUS / (episodes["goal"] - episodes["start"]).norm(dim=1)
        expected = (progress + final - failed.float())[at_dock]
    else:
        at_dock, expected = torch.ones_like(is_success), final
    torch.testing.assert_close(decisions["next", keys.OPTION_RETURN].squeeze(-1)[at_dock], expected)
    fresh = BoatDockEnv(len(episodes)).reset(episodes.select("start", "goal"))[keys.OBSERVATION]
    torch.testing.assert_close(decisions["next", keys.DECISION_OBSERVATION], fresh)


@pytest.mark.parametrize("mode", ["offline", "train"])
def test_a_learner_whose_option_is_not_in_the_data_makes_no_update_from_it(mode, path, tmp_path, monkeypatch, capsys):
    demonstrations = HumanDemonstrations(BoatDockEnv(), path=path, rest_to_rest=False, **ALL)
    demonstrations.batch[keys.OPTION].zero_()
    monkeypatch.setattr("hpamdp.run.assemble.make_data", lambda *_: demonstrations)
    given = [*overrides(path, "iql", "fixed"), "high.option=incongruent"]
    if mode == "train":
        given = [word for word in given if "offline" not in word]
        given += ["num_envs=8", "steps_per_batch=4", "total_frames=64", "low.warmup_steps=32"]
    assert run(compose_config(given), tmp_path, given) == 0
    printed = capsys.readouterr().out
    assert "no update was made: low/congruent\n" in printed
    assert ("6 updates in " if mode == "offline" else "64 frames in ") in printed


def test_where_the_boat_is_given_there_are_no_decisions(path):
    env = BoatDockEnv(controller="congruent")
    assert HumanDemonstrations(env, path=path, rest_to_rest=True, **ALL).decisions is None


def test_the_meta_critic_makes_as_many_updates_offline_as_the_learners_and_keeps_its_exploration(path, tmp_path):
    words = [*overrides(path, "iql", "meta_critic"), "offline.updates=7", "offline.eval_every=0", "high.batch_size=16"]
    parts = assemble(make_config(words))
    made = []
    update = parts.agent.selector.update_critics
    parts.agent.selector.update_critics = lambda rows: made.append(len(rows)) or update(rows)
    assert not Trainer(make_config(words), parts, tmp_path).train()
    assert made == [16] * 7 == [16] * int(parts.agent.learners[0].updates)
    assert parts.agent.selector.num_decisions == 0 and parts.agent.selector.epsilon == 1.0


def test_decisions_of_a_data_set_use_up_no_exploration_of_a_run_that_goes_on_with_its_own(path):
    words = [f"data.path={path}", "data=human", "data.checksum=null", "low=iql", "eval.layouts=4", "num_envs=4"]
    for high in ("meta_critic", "epsilon_greedy", "ucb"):
        parts = assemble(make_config([*words, f"high={high}"]))
        parts.agent.add_demonstrations(parts.data.batch, parts.data.decisions)
        assert parts.agent.selector.num_decisions == 0 and parts.agent.selector.pending.tolist() == [0, 0]


@pytest.mark.parametrize("high", [pytest.param("exp3", marks=pytest.mark.slow), "actor"])
def test_selectors_of_their_own_choices_alone_train_beside_a_data_set(high, path, tmp_path):
    words = [f"data.path={path}", "data=human", "data.checksum=null", "low=pdqn", f"high={high}", "eval.layouts=4"]
    words += ["num_envs=8", "steps_per_batch=4", "total_frames=256", "low.batch_size=16", "eval.every=0"]
    words += ["low.warmup_steps=64", *(["high.minibatch_size=8"] if high == "actor" else [])]
    assert run(compose_config(words), tmp_path, words) == 0
    header = (tmp_path / "metrics.csv").read_text().splitlines()[0]
    assert any(name.startswith("high/") for name in header.split(","))
    assert json.loads((tmp_path / "summary.json").read_text())["frames"] == 256


def test_recorded_keys_are_translated_to_the_environments_key_map(path):
    batch = human_batch(path, keymap=1)[0]
    data = read(path, checksum=None, one_frame=True)
    episodes = data.episodes[data.presses["episode"]]
    assert (episodes["keymap"] == 2).any()

    def direction(keymap, key):
        return torch.stack(harbour.direction(episodes["controller"].int(), keymap.int(), key.int()), -1)

    translated = direction(torch.ones_like(episodes["keymap"]), batch[keys.DISCRETE])
    torch.testing.assert_close(translated, direction(episodes["keymap"], data.presses["key"]))
    pressed = batch[keys.PARAMETERS].gather(-1, batch[keys.DISCRETE].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(pressed, data.presses["duration"])


def test_a_rest_to_rest_press_brings_a_gliding_boat_to_where_the_next_one_began(path):
    data = read(path, checksum=None, one_frame=True)
    # As if the second press of each episode had stopped the boat half-way.
    presses, is_cut = data.presses.clone(), ~data.presses["is_final"]
    moved = presses["next_position"] - presses["position"]
    presses["next_position"][is_cut] = (presses["position"] + 0.5 * moved)[is_cut]
    moved_presses = to_rest_to_rest(type(data)(data.episodes, presses)).presses
    kept = ~moved_presses["is_final"]
    assert kept.sum() > 50
    distance = physics.total_distance(moved_presses["duration"][kept])
    assert (distance >= MIN_DISTANCE - 1e-3).all()
    assert (moved_presses["duration"] <= physics.MAX_DURATION).all()
    # The presses of each episode are numbered from 0 in order.
    first = torch.searchsorted(moved_presses["episode"], moved_presses["episode"])
    assert (moved_presses["press"] == torch.arange(len(first)) - first).all()


def test_clean_presses_are_those_that_end_where_such_a_press_leads(path):
    data = read(path, checksum=None, one_frame=True)
    presses, is_final = data.presses.clone(), data.presses["is_final"]
    is_pushed = ~is_final & (torch.arange(len(presses)) % 2 == 0)
    presses["next_position"][is_pushed] += 20.0  # as if unlogged presses had moved the boat
    kept = to_rest_to_rest(type(data)(data.episodes, presses), clean=True).presses
    assert 0 < (~kept["is_final"]).sum() <= (~is_final & ~is_pushed).sum()
    episodes = data.episodes[kept["episode"]]
    heading = torch.stack(
        harbour.direction(episodes["controller"].int(), episodes["keymap"].int(), kept["key"].int()), 1
    )
    led_to = kept["position"] + physics.total_distance(kept["duration"]).unsqueeze(1) * heading
    off = (kept["next_position"] - led_to).norm(dim=1)[~kept["is_final"]]
    assert (off < MAX_ERROR + 1e-3).all()


def test_an_episode_without_its_final_press_is_truncated_and_not_terminated(path):
    batch = human_batch(path, rest_to_rest=True)[0]
    trajectory = batch["collector", "traj_ids"]
    is_last = torch.cat([trajectory[1:] != trajectory[:-1], torch.ones(1, dtype=torch.bool)])
    done = batch["next", keys.DONE].squeeze(-1)
    assert (done == is_last).all()
    truncated = batch["next", keys.TRUNCATED].squeeze(-1)
    assert (done == (truncated | batch["next", keys.TERMINATED].squeeze(-1))).all()


def test_metrics_show_the_losses_on_people_who_are_held_out(path, tmp_path):
    given = [*overrides(path, "bc"), "data.held_out=[1]", "offline.updates=60", "offline.eval_every=20"]
    assert run(compose_config(given), tmp_path, given) == 0
    rows = [row for row in read_rows(tmp_path / "metrics.csv") if row["frames"] > 0]
    name = "low/congruent/held_out_loss"
    assert len(rows) == 3 and rows[-1][name] < rows[0][name]
    resumed = ["mode=offline", f"resume={tmp_path}", "offline.updates=80"]
    assert run(compose_config(resumed), tmp_path / "resumed", resumed) == 0
    assert read_rows(tmp_path / "resumed" / "metrics.csv")[-1][name] < rows[0][name]


def test_windows_of_dlpa_end_where_a_data_set_lacks_a_step(path):
    parts = assemble(make_config([*overrides(path, "dlpa", "none"), "env.controller=congruent"]))
    (learner,), rows = parts.agent.learners, parts.data.batch
    episode = rows["collector", "traj_ids"][0]
    of_one = rows[:, episode == episode.bincount().argmax()]
    with_gap = of_one[:, [0, *range(2, of_one.shape[1])]]
    learner.add_demonstrations(with_gap, torch.ones(with_gap.shape, dtype=torch.bool))
    assert learner.buffer[:]["successor"].tolist() == [-1, *range(2, of_one.shape[1] - 1), -1]
    learner.update(1)
    before = parts.agent.held_out_losses(with_gap)["low/held_out_loss"]
    learner.update(40)
    assert parts.agent.held_out_losses(with_gap)["low/held_out_loss"] < before


def test_nothing_learns_from_people_who_are_held_out(path):
    parts = assemble(make_config([*overrides(path, "pets", "linucb"), "data.held_out=[0,2]"]))
    data = parts.data
    assert data.batch["person"].unique().tolist() == data.decisions["person"].unique().tolist() == [1]
    assert data.held_out["person"].unique().tolist() == [0, 2]
    parts.agent.add_demonstrations(data.batch, data.decisions)
    learner = parts.agent.learners[0]
    stored = learner.buffer[:].clone()
    assert len(stored) == data.batch.numel()
    parts.agent.update(2)
    weights = {name: value.clone() for name, value in parts.agent.state_dict().items()}
    assert parts.agent.held_out_losses(data.held_out)["low/held_out_loss"] > 0.0
    assert (learner.buffer[:] == stored).all()
    assert all(torch.equal(value, weights[name]) for name, value in parts.agent.state_dict().items())


PEOPLE_REFUSED = [
    ("data.held_out=[7]", "held_out: the transitions have nobody with the number 7"),
    ("data.held_out=[0,1,2]", "held_out: the transitions are of nobody else"),
    ("data.worst_people=4", "worst_people=4, but must be 1 to 3"),
]


@pytest.mark.parametrize(("word", "line"), PEOPLE_REFUSED, ids=[word for word, _ in PEOPLE_REFUSED])
def test_a_choice_of_people_that_leaves_nothing_is_refused_in_one_line(word, line, path):
    with pytest.raises(ConfigError, match=line) as refusal:
        assemble(make_config([*overrides(path, "pets"), word]))
    assert "\n" not in str(refusal.value)


def test_an_offline_run_can_be_resumed_and_fine_tuned_online(path, tmp_path):
    given = overrides(path, "iql")
    assert run(compose_config(given), tmp_path / "a", given) == 0
    longer = ["mode=offline", f"resume={tmp_path / 'a'}", "offline.updates=9"]
    assert run(compose_config(longer), tmp_path / "b", longer) == 0
    assert json.loads((tmp_path / "b/summary.json").read_text())["frames"] == 9
    with pytest.raises(ConfigError, match="a run with mode=offline; resume it so"):
        run(compose_config([f"resume={tmp_path / 'a'}"]), tmp_path / "c", [f"resume={tmp_path / 'a'}"])
    tuned = ["low=iql", "high=human", f"low.checkpoint={tmp_path / 'a'}", "total_frames=512", "low.warmup_steps=64"]
    tuned += ["num_envs=16", "eval.layouts=10", "eval.every=0", "low.batch_size=16"]
    assert run(compose_config(tuned), tmp_path / "d", tuned) == 0


def test_a_buffer_that_drops_steps_of_the_data_says_so(path, capsys):
    given = ["low=pdqn", "data=human", "data.checksum=null", f"data.path={path}", "eval.layouts=4", "num_envs=4"]
    parts = assemble(make_config([*given, "low.buffer_size=32", "low.batch_size=8"]))
    parts.agent.add_demonstrations(parts.data.batch, parts.data.decisions)
    assert "low.buffer_size=32 keeps the last 32 of " in capsys.readouterr().err


# One step, three discrete actions with a parameter each. The best is action 1 with half its range; in the data three in
# four actions have a worse parameter.
SPECS = PAMDPSpecs(1, (), (1, 1, 1), (0.0, 0.0, 0.0), (2.0, 2.0, 2.0))


def one_step_batch(num: int = 6000) -> TensorDict:
    """Return a data set of one-step episodes, `[1, num]`."""
    generator = torch.Generator().manual_seed(0)
    discrete = torch.randint(0, 2, (num,), generator=generator)  # never action 2
    parameter = torch.where(
        torch.rand(num, generator=generator) < 0.75,
        0.4 + 0.1 * torch.randn(num, generator=generator),
        1.0 + 0.1 * torch.randn(num, generator=generator),
    ).clamp(0.0, 2.0)
    reward = torch.where(discrete == 1, 1.0, 0.5) - (parameter - 1.0).square()
    parameters = torch.zeros(num, 3).scatter(1, discrete.unsqueeze(1), parameter.unsqueeze(1))
    zeros = torch.zeros(num, 1)
    ends = torch.ones(num, 1, dtype=torch.bool)
    rows = {
        "observation": zeros,
        "action": {"discrete": discrete, "parameters": parameters},
        "next": {"observation": zeros, "reward": reward.unsqueeze(1), "done": ends, "terminated": ends},
    }
    return TensorDict(rows, batch_size=[num]).unsqueeze(0)


COMMON = {"hidden_dims": [32, 32], "buffer_size": 10_000, "batch_size": 128}
IQL_OPTIONS = COMMON | dict(
    min_scale=0.02, max_scale=1.0, expectile=0.8, temperature=10.0, max_weight=100.0, gamma=0.9, tau=0.01,
    actor_lr=3e-3, critic_lr=3e-3, warmup_steps=0, updates_per_step=1.0,
    augment=False,
)  # fmt: skip
TD3BC_OPTIONS = COMMON | dict(
    behaviour_weight=0.2, discrete_threshold=0.3, target_smoothing=0.0, target_smoothing_clip=0.1, policy_delay=2,
    parameter_noise=0.1, gamma=0.9, tau=0.01, actor_lr=3e-3, critic_lr=3e-3, warmup_steps=0, updates_per_step=1.0,
    augment=False,
)  # fmt: skip


def greedy_action(learner, num_updates: int) -> tuple[int, float]:
    """Return the greedy discrete action and its parameter after updates from the one-step data."""
    torch.manual_seed(0)
    batch = one_step_batch()
    learner.add_demonstrations(batch, torch.ones(batch.shape, dtype=torch.bool))
    learner.update(num_updates)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = learner.policy(batch[0, :1].select("observation"))
    discrete = acted["action", "discrete"].item()
    return discrete, acted["action", "parameters"][0, discrete].item()


def test_behaviour_cloning_finds_the_mean_parameter_of_the_data():
    options = COMMON | dict(min_scale=0.02, max_scale=1.0, lr=3e-3, weight_decay=0.0)
    _, parameter = greedy_action(BC(SPECS, device=torch.device("cpu"), **options), 400)
    assert parameter == pytest.approx(0.55, abs=0.05)


def test_held_out_losses_are_those_of_all_parameters_of_an_action():
    specs = PAMDPSpecs(1, (), (2, 1), (0.0, 0.0, 0.0), (2.0, 2.0, 2.0))
    learner, batch = BC(specs, hidden_dims=[8]), one_step_batch(20)
    found = learner.held_out_losses(batch, torch.ones(batch.shape, dtype=torch.bool))
    rows = batch[0]
    unit = specs.to_unit(rows["action", "parameters"], rows)
    sample = TensorDict({"state": rows["observation"], "discrete": rows["action", "discrete"], "unit": unit}, [20])
    assert found["held_out_loss"] == pytest.approx(learner.loss(sample, None)[0].item())


@pytest.mark.parametrize(("num_updates", "fraction"), [(1, 1.0), (6, 0.5), (12, 0.0)])
def test_the_policys_learning_rate_of_iql_falls_along_a_cosine_if_told_so(num_updates, fraction):
    learner = IQL(SPECS, **{**IQL_OPTIONS, "actor_lr_updates": 10})
    batch = one_step_batch()
    learner.add_demonstrations(batch, torch.ones(batch.shape, dtype=torch.bool))
    learner.update(num_updates)
    rates = {name: optimizer.param_groups[0]["lr"] for name, optimizer in learner.optimizers.items()}
    assert rates == pytest.approx({"actor": 3e-3 * fraction, "state_value": 3e-3, "critics": 3e-3})


@pytest.mark.parametrize(("learner", "options"), [(IQL, IQL_OPTIONS), (TD3BC, TD3BC_OPTIONS)], ids=["iql", "td3_bc"])
def test_offline_learners_find_the_better_actions_of_the_data(learner, options):
    discrete, parameter = greedy_action(learner(SPECS, device=torch.device("cpu"), **options), 600)
    assert discrete == 1
    assert parameter == pytest.approx(0.95, abs=0.12)


def test_learners_of_a_data_set_can_be_asked_for_the_option(path, tmp_path):
    words = overrides(path, "iql", "value")
    assert run(compose_config(words), tmp_path, words) == 0
