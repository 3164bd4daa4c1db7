"""Learners that learn from people's presses: what they make of them, and what a run makes of the settings."""

import json

import pytest
import synthetic_human
import torch
from conftest import compose_config, make_config
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.config import ConfigError
from hpamdp.data.human.demonstrations import HumanDemonstrations
from hpamdp.data.human.released_file import read
from hpamdp.data.human.rest_to_rest import TAP, to_rest_to_rest
from hpamdp.env.boatdock import harbour, physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.low_level.bc import BC
from hpamdp.policies.low_level.iql import IQL
from hpamdp.policies.low_level.td3_bc import TD3BC
from hpamdp.run.assemble import assemble
from hpamdp.run.train import run
from hpamdp.specs import PAMDPSpecs

ALL = {"complete": False, "successes": False, "best_people": None, "checksum": None}
SMALL = ["mode=offline", "data=human", "data.checksum=null", "offline.updates=6", "offline.eval_every=3"]
SMALL += ["eval.layouts=10", "low.batch_size=16"]


@pytest.fixture(scope="module")
def path(tmp_path_factory) -> str:
    return str(synthetic_human.write(tmp_path_factory.mktemp("human") / "people.mat"))


def presses(path: str, rest_to_rest: bool = False, **env):
    return HumanDemonstrations(BoatDockEnv(**env), path=path, rest_to_rest=rest_to_rest, **ALL).batch


@pytest.fixture
def no_pictures(monkeypatch):
    monkeypatch.setattr("hpamdp.analysis.figures.draw_all", lambda folder, env: [])


def words(path: str, low: str, high: str = "human") -> list[str]:
    return [*SMALL, f"data.path={path}", f"low={low}", f"high={high}"]


@pytest.mark.parametrize("low", ["bc", "iql", "td3_bc", "pdqn", "hsac"])
def test_a_learner_trains_on_a_data_set_without_a_press(low, path, tmp_path, no_pictures):
    given = words(path, low)
    assert run(compose_config(given), tmp_path, given) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["frames"] == 6
    text = (tmp_path / "metrics.csv").read_text()
    assert "train/" not in text.splitlines()[0]


@pytest.mark.parametrize("high", ["ucb", "linucb", "meta_critic"])
def test_a_selector_learns_from_the_decisions_in_the_data(high, path, tmp_path):
    parts = assemble(make_config(words(path, "iql", high)), tmp_path)
    parts.agent.add_demonstrations(parts.data)
    num_episodes = int((parts.data["next", keys.DONE]).sum())
    selector = parts.agent.selector
    if high == "ucb" or high == "linucb":
        assert selector.rewards.num_decisions == num_episodes
    else:
        assert len(selector.buffer) == num_episodes


def test_decision_sums_are_those_of_the_decision_tracker(path):
    batch = presses(path)[0]
    data = read(path, checksum=None, one_frame=True)
    ends = batch["next", keys.DONE].squeeze(-1)
    returns = torch.zeros(len(data.episodes)).index_add(
        0, batch["collector", "traj_ids"], batch["next", keys.REWARD].squeeze(-1)
    )
    assert torch.allclose(
        batch["next", keys.OPTION_RETURN][ends].squeeze(-1), returns[batch["collector", "traj_ids"][ends]], atol=1e-4
    )
    assert (
        batch["next", keys.OPTION_STEPS][ends].squeeze(-1) == data.episodes["presses"][data.episodes["presses"] > 0]
    ).all()
    firsts = batch[keys.IS_DECISION].squeeze(-1)
    assert (batch["next", keys.DECISION_OBSERVATION][firsts] == batch[keys.OBSERVATION][firsts]).all()
    tracked = with_decisions(BoatDockEnv(2)).rollout(2)["next"]
    for name in (keys.OPTION_RETURN, keys.OPTION_STEPS, keys.DECISION_OBSERVATION):
        assert tracked[name].dtype == batch["next", name].dtype
        assert tracked[name].shape[2:] == batch["next", name].shape[1:]


def test_keys_are_those_of_the_environments_key_map(path):
    batch, data = presses(path, keymap=1)[0], read(path, checksum=None, one_frame=True)
    of = data.episodes[data.presses["episode"]]
    assert (of["keymap"] == 2).any()

    def heading(keymap, key):
        return torch.stack(harbour.direction(of["controller"].int(), keymap.int(), key.int()), -1)

    there = heading(torch.ones_like(of["keymap"]), batch[keys.DISCRETE])
    torch.testing.assert_close(there, heading(of["keymap"], data.presses["key"]))
    pressed = batch[keys.PARAMETERS].gather(-1, batch[keys.DISCRETE].unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(pressed, data.presses["duration"])


def test_a_settled_press_brings_a_gliding_boat_to_where_the_next_one_began(path):
    data = read(path, checksum=None, one_frame=True)
    # As if the second press of each episode had stopped the boat half-way.
    presses, is_cut = data.presses.clone(), ~data.presses["is_final"]
    moved = presses["next_position"] - presses["position"]
    presses["next_position"][is_cut] = (presses["position"] + 0.5 * moved)[is_cut]
    moved_presses = to_rest_to_rest(type(data)(data.episodes, presses)).presses
    kept = ~moved_presses["is_final"]
    assert kept.sum() > 50
    distance = physics.total_distance(moved_presses["duration"][kept])
    assert (distance >= TAP - 1e-3).all()
    assert (moved_presses["duration"] <= physics.MAX_DURATION).all()
    # Both ways of recording give the same episodes in the same order, numbered from 0.
    first = torch.searchsorted(moved_presses["episode"], moved_presses["episode"])
    assert (moved_presses["press"] == torch.arange(len(first)) - first).all()


def test_an_episode_whose_final_press_is_gone_is_cut_and_not_over(path):
    batch = presses(path, rest_to_rest=True)[0]
    trajectory = batch["collector", "traj_ids"]
    is_last = torch.cat([trajectory[1:] != trajectory[:-1], torch.ones(1, dtype=torch.bool)])
    done = batch["next", keys.DONE].squeeze(-1)
    assert (done == is_last).all()
    truncated = batch["next", keys.TRUNCATED].squeeze(-1)
    assert (done == (truncated | batch["next", keys.TERMINATED].squeeze(-1))).all()


REFUSED = [
    (["low=bc"], "low=bc learns from data sets only; use mode=offline and a data set"),
    (["low=hppo", "mode=offline", "data=human"], "low=hppo learns from its own steps only; use data=none"),
    (["low=iql", "mode=offline"], "mode=offline: data=none leaves nothing to learn from; choose a data set"),
    (["low=iql", "mode=offline", "data=human", "data.path=/nowhere.mat"], "/nowhere.mat: there is no such file"),
    (["low=iql", "high=none", "env=platform", "mode=offline", "data=human"], "people docked boats; use env=boatdock"),
    (["low=iql", "data=human", "mode=offline", "collector=multi"], "mode=offline takes no steps"),
    (["low=iql", "data=human", "mode=offline", "low.freeze=true"], "mode=offline trains the learners"),
]


@pytest.mark.parametrize(
    ("given", "line"), REFUSED, ids=lambda value: " ".join(value) if isinstance(value, list) else ""
)
def test_what_cannot_be_is_refused_in_one_line(given, line, tmp_path):
    config = make_config([*given, "eval.layouts=4", "num_envs=4"])
    with pytest.raises(ConfigError, match=line) as refusal:
        assemble(config, tmp_path)
    assert "\n" not in str(refusal.value)


def test_an_offline_run_goes_on_and_is_fine_tuned(path, tmp_path, no_pictures):
    given = words(path, "iql")
    assert run(compose_config(given), tmp_path / "a", given) == 0
    longer = ["mode=offline", f"resume={tmp_path / 'a'}", "offline.updates=9"]
    assert run(compose_config(longer), tmp_path / "b", longer) == 0
    assert json.loads((tmp_path / "b/summary.json").read_text())["frames"] == 9
    with pytest.raises(ConfigError, match="a run with mode=offline; resume it so"):
        run(compose_config([f"resume={tmp_path / 'a'}"]), tmp_path / "c", [f"resume={tmp_path / 'a'}"])
    tuned = ["low=iql", "high=human", f"low.checkpoint={tmp_path / 'a'}", "total_frames=512", "low.warmup_frames=64"]
    tuned += ["num_envs=16", "eval.layouts=10", "eval.every=0", "low.batch_size=16"]
    assert run(compose_config(tuned), tmp_path / "d", tuned) == 0


def test_demonstrations_lie_in_the_replay_beside_own_presses(path, tmp_path):
    given = ["low=pdqn", "data=human", "data.checksum=null", f"data.path={path}", "eval.layouts=4", "num_envs=4"]
    parts = assemble(make_config(given), tmp_path)
    parts.agent.add_demonstrations(parts.data)
    assert sum(len(learner.buffer) for learner in parts.agent.learners) == parts.data.numel()


# One step, three keys: the best press is key 1 for half its range, and the data holds worse ones three times as often.
SPECS = PAMDPSpecs(1, (), (1, 1, 1), (0.0, 0.0, 0.0), (2.0, 2.0, 2.0))


def one_step_data(num: int = 6000) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(0)
    key = torch.randint(0, 2, (num,), generator=generator)  # key 2 is never pressed
    duration = torch.where(
        torch.rand(num, generator=generator) < 0.75,
        0.4 + 0.1 * torch.randn(num, generator=generator),
        1.0 + 0.1 * torch.randn(num, generator=generator),
    ).clamp(0.0, 2.0)
    reward = torch.where(key == 1, 1.0, 0.5) - (duration - 1.0).square()
    return key, duration, reward


def one_step_batch():
    key, duration, reward = one_step_data()
    num = len(key)
    zeros, ends = torch.zeros(num, 1), torch.ones(num, 1, dtype=torch.bool)
    durations = torch.zeros(num, 3).scatter(1, key.unsqueeze(1), duration.unsqueeze(1))
    after = {"observation": zeros, "reward": reward.unsqueeze(1), "done": ends, "terminated": ends}
    rows = {"observation": zeros, "action": {"discrete": key, "parameters": durations}, "next": after}
    return TensorDict(rows, batch_size=[num]).unsqueeze(0)


COMMON = {"hidden_dims": [32, 32], "buffer_size": 10_000, "batch_size": 128}
IQL_OPTIONS = COMMON | dict(
    min_scale=0.02, max_scale=1.0, expectile=0.8, temperature=10.0, max_weight=100.0, gamma=0.9, tau=0.01,
    actor_lr=3e-3, critic_lr=3e-3, warmup_frames=0, updates_per_frame=1.0,
)  # fmt: skip
TD3BC_OPTIONS = COMMON | dict(
    behaviour_weight=0.2, discrete_threshold=0.3, target_smoothing=0.0, target_smoothing_clip=0.1, policy_delay=2,
    parameter_noise=0.1, gamma=0.9, tau=0.01, actor_lr=3e-3, critic_lr=3e-3, warmup_frames=0, updates_per_frame=1.0,
)  # fmt: skip


def practised(learner, num_updates: int) -> tuple[int, float]:
    """Let a learner learn from the one-step data; return its greedy key and duration."""
    torch.manual_seed(0)
    batch = one_step_batch()
    learner.add_demonstrations(batch, torch.ones(batch.shape, dtype=torch.bool))
    learner.update(num_updates)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        acted = learner.policy(batch[0, :1].select("observation"))
    key = acted["action", "discrete"].item()
    return key, acted["action", "parameters"][0, key].item()


def test_behaviour_cloning_takes_the_mean_of_what_it_sees():
    options = COMMON | dict(min_scale=0.02, max_scale=1.0, lr=3e-3, weight_decay=0.0)
    _, duration = practised(BC(SPECS, torch.device("cpu"), **options), 400)
    assert duration == pytest.approx(0.55, abs=0.05)


@pytest.mark.parametrize(("learner", "options"), [(IQL, IQL_OPTIONS), (TD3BC, TD3BC_OPTIONS)], ids=["iql", "td3_bc"])
def test_offline_learners_find_the_better_press_of_the_data(learner, options):
    key, duration = practised(learner(SPECS, torch.device("cpu"), **options), 600)
    assert key == 1
    assert duration == pytest.approx(0.95, abs=0.12)
