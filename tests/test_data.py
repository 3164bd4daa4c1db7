"""What serves any recording: demonstrations, tables and memory-mapped files, and Minari."""

import json
import re
from dataclasses import replace
from importlib.util import find_spec

import gymnasium
import numpy as np
import pytest
import torch
from conftest import make_config
from gymnasium import spaces
from gymnasium_players import make
from tensordict import TensorDict
from torchrl.data import Unbounded

from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.data import DataError, export, minari
from hpamdp.data.demonstrations import TRAJECTORY, Demonstrations, with_option_sums
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.policies.low_level.iql import IQL
from hpamdp.policies.low_level.td3_bc import TD3BC
from hpamdp.run.assemble import make_data, make_env
from hpamdp.specs import PAMDPSpecs

h5py = pytest.importorskip("h5py") if find_spec("minari") else None  # of the extra `minari`

LAYOUT = minari.MinariLayout(discrete="tool", parameters="force", infos=("heat",))


class Workshop(gymnasium.Env):
    """A problem of three tools, without options."""

    observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = spaces.Dict({"tool": spaces.Discrete(3), "force": spaces.Box(0.0, 1.0, (4,), np.float32)})

    def __init__(self, size: int) -> None:
        self.size = size


@pytest.fixture
def workshop_id():
    gymnasium.register("hpamdp-test/Workshop-v0", f"{__name__}:Workshop")
    yield "hpamdp-test/Workshop-v0"
    del gymnasium.registry["hpamdp-test/Workshop-v0"]


def episodes(*lengths: int) -> TensorDict:
    """Return random transitions of episodes of these lengths, whose last one is truncated."""
    generator = torch.Generator().manual_seed(0)
    num = sum(lengths)
    number = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    is_first = torch.cat([torch.ones(1, dtype=torch.bool), number[1:] != number[:-1]]).unsqueeze(1)
    done = is_first.roll(-1, 0)
    truncated = done & (number == len(lengths) - 1).unsqueeze(1)
    states = torch.randn(num + len(lengths), 2, generator=generator)
    heat = torch.rand(num + len(lengths), 1, generator=generator)
    here = torch.arange(num) + number  # an episode has one state more than steps
    none = torch.zeros_like(done)
    rows = {
        "observation": states[here],
        "heat": heat[here],
        "is_decision": is_first,
        "done": none,
        "terminated": none.clone(),
        "truncated": none.clone(),
        "action": {
            "discrete": torch.randint(3, (num,), generator=generator),
            "parameters": torch.rand(num, 4, generator=generator),
        },
        "collector": {"traj_ids": number},
        "next": {
            "observation": states[here + 1],
            "heat": heat[here + 1],
            "reward": torch.randn(num, 1, generator=generator),
            "is_decision": done.clone(),
            "done": done,
            "terminated": done & ~truncated,
            "truncated": truncated,
        },
    }
    return TensorDict(rows, batch_size=[num])


@pytest.mark.parametrize("gamma", [1.0, 0.9])
def test_option_sums_start_anew_with_every_episode(gamma):
    rows = episodes(1, 3, 2)
    given = rows.clone()
    extended = with_option_sums(rows, gamma)
    reward = rows["next", keys.REWARD].squeeze(-1)
    expected = torch.cat([(gamma ** torch.arange(len(part)) * part).cumsum(0) for part in reward.split([1, 3, 2])])
    torch.testing.assert_close(extended["next", keys.OPTION_RETURN].squeeze(-1), expected)
    assert extended["next", keys.OPTION_STEPS].squeeze(-1).tolist() == [1, 1, 2, 3, 1, 2]
    first = rows[keys.OBSERVATION][[0, 1, 1, 1, 4, 4]]
    assert extended["next", keys.DECISION_OBSERVATION].equal(first)
    assert set(rows.keys(True, True)) == set(given.keys(True, True))  # its argument is left as it was


def test_demonstrations_hold_the_decisions_that_they_are_given_and_name_missing_keys():
    rows = episodes(2, 2)
    assert Demonstrations(rows).decisions is None
    decisions = with_option_sums(rows)[1::2].set(keys.OPTION, torch.tensor([0, 1]))
    assert Demonstrations(rows, decisions=decisions).decisions.shape == (1, 2)
    with pytest.raises(DataError, match=r"the decisions lack option, next\.option_return$"):
        Demonstrations(rows, decisions=decisions.exclude(keys.OPTION, ("next", keys.OPTION_RETURN)))


def test_people_who_are_held_out_stand_beside_the_batch_and_must_be_told_apart():
    rows = episodes(2, 3, 1)
    with pytest.raises(DataError, match=r"held_out: the transitions do not say who acted \(person\)"):
        Demonstrations(rows, held_out=[4])
    rows["person"] = torch.tensor([4, 4, 6, 6, 6, 4])
    split = Demonstrations(rows, held_out=[6])
    assert split.batch["person"].tolist() == [[4, 4, 4]] and split.held_out["person"].tolist() == [[6, 6, 6]]
    whole = Demonstrations(rows).batch[0]
    assert (split.held_out[0] == whole[2:5]).all() and (split.batch[0] == whole[[0, 1, 5]]).all()


def test_demonstrations_are_discounted_as_a_selector_asks():
    rows = episodes(2, 2)
    demonstrations = Demonstrations(rows)
    assert demonstrations.batch.shape == (1, 4)
    reward = demonstrations.batch[0]["next", keys.REWARD].squeeze(-1)
    demonstrations.discount(0.5)
    total = demonstrations.batch["next", keys.OPTION_RETURN].flatten()
    torch.testing.assert_close(total[[1, 3]], reward[[0, 2]] + 0.5 * reward[[1, 3]])
    decisions = with_option_sums(rows)[1::2].set(keys.OPTION, torch.tensor([0, 1]))
    with pytest.raises(DataError, match=r"known only undiscounted; use 1$"):
        Demonstrations(rows, decisions=decisions).discount(0.5)


def test_demonstrations_name_missing_keys_and_refuse_episodes_out_of_order():
    rows = episodes(2, 2)
    with pytest.raises(DataError, match=r"the transitions lack action\.discrete, next\.reward$"):
        Demonstrations(rows.exclude(keys.DISCRETE, ("next", keys.REWARD)))
    with pytest.raises(DataError, match="must be in ascending order"):
        Demonstrations(rows.set(TRAJECTORY, torch.tensor([1, 1, 0, 0])))


SPECS = PAMDPSpecs(2, (), (1, 1, 2), (0.0,) * 4, (1.0,) * 4)
WITH_OPTIONS = replace(SPECS, option_names=("left", "right"), option_actions=((True, True, True), (False, False, True)))
MASKED = replace(SPECS, has_action_mask=True)


def spoilt(name, row, value, rows=None):
    rows = episodes(2, 3) if rows is None else rows.clone()
    rows[name][row] = value
    return rows


def with_option(*options):
    return spoilt(keys.DISCRETE, slice(None), 2).set(keys.OPTION, torch.tensor(options))


def masked(row, name=keys.ACTION_MASK):
    mask = torch.ones(5, 3, dtype=torch.bool)
    mask[row] = False
    return episodes(2, 3).set(name, mask)


def timed(row=slice(None), value=2.5):
    """Return transitions whose steps take a time of 1, but for the time of some rows."""
    return spoilt(("next", keys.DURATION), row, value, episodes(2, 3).set(("next", keys.DURATION), torch.ones(5, 1)))


@pytest.mark.parametrize(
    ("rows", "specs", "said"),
    [
        (spoilt(keys.OBSERVATION, (3, 1), np.nan), SPECS, r"row 3: observation[1] is nan, but must be finite"),
        (spoilt(("next", keys.REWARD), slice(None), 2e38), SPECS, "row 1: next.option_return is inf, but must be"),
        (
            spoilt(keys.PARAMETERS, (2, 0), 1e6, spoilt(keys.DISCRETE, 2, 0)),
            SPECS,
            "row 2: action.parameters[0] is 1e+06, but must be 0 to 1",
        ),
        (
            spoilt(keys.PARAMETERS, slice(None), 0.5, spoilt(keys.DISCRETE, slice(None), 0)),
            replace(SPECS, integer_parameters=(True, False, False, False)),
            "row 0: action.parameters[0] is 0.5, but must be a whole number",
        ),
        (
            spoilt(keys.PARAMETERS, (2, 3), -0.5, spoilt(keys.DISCRETE, 2, 0)),
            SPECS,
            "row 2: action.parameters[3] is -0.5, but must be 0 to 1, or 0 as it is another action's",
        ),
        (spoilt(keys.DISCRETE, 1, 3), SPECS, "row 1: action.discrete is 3, but must be 0 to 2"),
        (spoilt(("next", keys.DONE), 0, True), SPECS, "row 0: next.done is true, but must be true if the row is term"),
        (
            spoilt(("next", keys.DONE), 2, True, spoilt(("next", keys.TERMINATED), 2, True)),
            SPECS,
            "row 2: next.done is true, but must be true in the last row of an episode, and only there",
        ),
        (spoilt(keys.IS_DECISION, 2, False), SPECS, "row 2: is_decision is false, but must be true in an episode's"),
        (spoilt(("next", keys.IS_DECISION), 0, True), SPECS, "row 0: next.is_decision is true, but must be the same"),
        (episodes(2).set(keys.OBSERVATION, torch.zeros(2, 3)), SPECS, "observation is [3] a row, but the"),
        (episodes(2), WITH_OPTIONS, "lack option, which the agent chooses here, of left, right"),
        (with_option(0, 1, 1, 1, 1), WITH_OPTIONS, "row 1: option is 1, but must be the same as in the row before"),
        (
            spoilt(keys.DISCRETE, 3, 1, with_option(0, 0, 1, 1, 1)),
            WITH_OPTIONS,
            "row 3: action.discrete is 1, but must be an action of the row's option",
        ),
        (timed(3, -2.0), SPECS, "row 3: next.duration is -2, but must be finite and at least 0"),
        (masked(2), MASKED, "allowed by the row's action_mask"),
        (masked(3, ("next", keys.ACTION_MASK)), MASKED, "row 3: next.action_mask[0] is false, but must be true for"),
    ],
)  # fmt: skip
def test_a_wrong_value_in_a_data_set_is_refused_with_its_row(rows, specs, said):
    with pytest.raises(DataError) as refused:
        Demonstrations(rows).check(specs)
    assert said in str(refused.value) and "\n" not in str(refused.value)


def test_a_mask_after_the_end_of_an_episode_may_allow_nothing_and_then_allows_everything():
    rows = masked(2, ("next", keys.ACTION_MASK)).set(keys.OPTION, torch.tensor([0, 0, 1, 1, 1]))
    rows["next", keys.ACTION_MASK] = torch.tensor([[1, 0, 1], [0, 0, 0], [1, 1, 0], [1, 1, 1], [0, 0, 1]]).bool()
    rows["next", keys.OPTION_MASK] = torch.zeros(5, 2, dtype=torch.bool)
    rows["next", keys.TERMINATED][1], rows["next", keys.TRUNCATED][1] = True, False  # the other one is truncated
    given = rows.clone()
    demonstrations = Demonstrations(rows, decisions=with_option_sums(rows)[[1, 4]])
    demonstrations.check(replace(MASKED, option_names=("left", "right"), has_option_mask=True))
    after = demonstrations.batch[0]["next"]
    assert after[keys.ACTION_MASK][1].all() and after[keys.ACTION_MASK][4].tolist() == [False, False, True]
    assert after[keys.OPTION_MASK][[1, 4]].all() and not after[keys.OPTION_MASK][[0, 2, 3]].any()
    assert demonstrations.decisions[0]["next", keys.OPTION_MASK].all()
    assert (rows == given).all(), "the given rows stay as they are"
    learner = TD3BC(MASKED, hidden_dims=(8,), batch_size=4)
    learner.add_demonstrations(demonstrations.batch, torch.ones(1, 5, dtype=torch.bool))
    assert np.isfinite(learner.update(3)["critic"])


OF_OPTIONS = {"option_names": ("any", "last"), "option_actions": ((True, True, True), (False, False, True))}


@pytest.mark.parametrize(
    ("specs", "name", "chosen"),
    [
        (replace(MASKED, component_sizes=(2, 1)), keys.DISCRETE, torch.zeros(5, 2, dtype=torch.int64)),
        (replace(MASKED, **OF_OPTIONS), keys.OPTION, torch.zeros(5, dtype=torch.int64)),
    ],
    ids=["component", "option"],
)
def test_a_mask_after_the_end_that_leaves_a_part_without_actions_allows_everything(specs, name, chosen):
    rows = masked([], ("next", keys.ACTION_MASK)).set(name, chosen)
    rows["next", keys.TERMINATED][[1, 4]] = True
    rows["next", keys.TRUNCATED][[1, 4]] = False
    rows["next", keys.ACTION_MASK][[1, 4]] = torch.tensor([[True, True, False], [False, True, True]])
    demonstrations = Demonstrations(rows)
    demonstrations.check(specs)
    after = demonstrations.batch[0]["next", keys.ACTION_MASK]
    assert after[1].all() and after[4].tolist() == [False, True, True]


def test_a_mask_after_a_truncation_that_leaves_the_held_option_nothing_opens_its_own_actions_alone():
    specs = replace(MASKED, option_names=("low", "last"), option_actions=((True, True, False), (False, False, True)))
    rows = masked([], ("next", keys.ACTION_MASK)).set(keys.OPTION, torch.tensor([0, 0, 1, 1, 1]))
    rows[keys.DISCRETE][:2], rows[keys.DISCRETE][2:] = 0, 2
    for name, value in ((keys.TERMINATED, False), (keys.TRUNCATED, True)):
        rows["next", name][[1, 4]] = value
    rows["next", keys.ACTION_MASK][[1, 4]] = torch.tensor([[True, False, False], [True, False, False]])
    demonstrations = Demonstrations(rows)
    demonstrations.check(specs)
    after = demonstrations.batch[0]["next", keys.ACTION_MASK]
    assert after[[1, 4]].tolist() == [[True, False, False], [True, False, True]]


class OwnRows(Demonstrations):
    """A data set of somebody's own, one of whose rows has a parameter that the environment does not have."""

    def __init__(self, env: PAMDPEnv) -> None:
        wide = episodes(2, 3)
        short = wide.set(keys.PARAMETERS, wide[keys.PARAMETERS][:, : sum(env.parameter_dims)])
        dim = env.observation_spec_unbatched[keys.OBSERVATION].shape[-1]
        for name in (keys.OBSERVATION, ("next", keys.OBSERVATION)):
            short[name] = torch.zeros(5, dim)
        super().__init__(spoilt(keys.PARAMETERS, (3, slice(None)), 1e6, short))


class UnequalRows(Demonstrations):
    """A data set of somebody's own with more actions than observations."""

    def __init__(self) -> None:
        super().__init__(episodes(3).set(keys.OBSERVATION, torch.zeros(2, 9)))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("UnequalRows", "its entries differ in length (batch dimension mismatch, "),
        ("OwnRows", "the transitions, row 3: action.parameters[2] is 1e+06, but must be 0 to 430"),
    ],
)
def test_a_run_names_the_data_set_whose_rows_are_wrong(name, said):
    config = make_config(["env=platform", "low=bc", "mode=offline", f"data._target_={__name__}.{name}"])
    env = make_env(config, 1, torch.device("cpu"), 0)
    with pytest.raises(ConfigError) as refused:
        make_data(config, env, 1.0)
    assert str(refused.value).startswith(f"data=none: {said}")


class Timed(PlatformEnv):
    """A problem that writes how long its steps take, and forbids nothing."""

    def _knowledge_specs(self):
        return {keys.DURATION: Unbounded((self.num_envs, 1), dtype=torch.float32)}

    def _knowledge(self):
        return {keys.DURATION: torch.ones(self.num_envs, 1)}


class PlatformRows(Demonstrations):
    """Transitions of Platform, with some entries besides."""

    def __init__(self, durations: bool = False) -> None:
        rows = PlatformEnv(1).rollout(5, break_when_any_done=True, auto_reset=True).squeeze(0)
        rows[keys.DISCRETE], rows[keys.PARAMETERS] = torch.zeros_like(rows[keys.DISCRETE]), 0 * rows[keys.PARAMETERS]
        rows["next", keys.TRUNCATED][-1] = ~rows["next", keys.TERMINATED][-1]
        rows["next", keys.DONE][-1] = True
        rows[keys.IS_DECISION] = (torch.arange(len(rows)) == 0).unsqueeze(-1)
        rows["next", keys.IS_DECISION] = rows["next", keys.DONE].clone()
        rows[TRAJECTORY] = torch.zeros(len(rows), dtype=torch.long)
        if durations:
            rows["next", keys.DURATION] = torch.full((len(rows), 1), 3.0)
        super().__init__(rows)


def data_of(env, *words, low="iql"):
    given = ["env=platform", f"low={low}", "mode=offline", f"data._target_={__name__}.PlatformRows", *words]
    return make_data(make_config(given), env, 1.0)


def test_a_data_set_without_the_durations_that_its_problem_writes_is_said_to_lack_them(capsys):
    data_of(Timed(1), "low.gamma=0.9")
    assert capsys.readouterr().err == (
        "data=none: it lacks next.duration, so low=iql discounts its steps alike, but steps of env=platform take "
        "different times\n"
    )
    data_of(Timed(1), "low.gamma=1")
    data_of(Timed(1), "low.gamma=0.9", "+data.durations=true")
    data_of(PlatformEnv(1), "low.gamma=0.9")
    assert capsys.readouterr().err == ""


def test_durations_of_a_problem_whose_steps_take_the_same_time_are_refused():
    with pytest.raises(ConfigError, match=r"it has next\.duration, but steps of env=platform do not take different"):
        data_of(PlatformEnv(1), "+data.durations=true")


def test_an_offline_learner_discounts_by_the_durations_in_the_data():
    env = Timed(1)
    batch = data_of(env, "+data.durations=true").batch
    learner = IQL(PAMDPSpecs.from_env(env), gamma=0.9)
    goes_on = ~batch["next", keys.TERMINATED].squeeze(-1)
    torch.testing.assert_close(learner.transitions(batch)["discount"], 0.9**3 * goes_on)


def test_right_rows_pass_the_check():
    Demonstrations(episodes(2, 3, 1)).check(SPECS)
    Demonstrations(spoilt(keys.PARAMETERS, slice(None), 1.0 + 1e-6)).check(SPECS)  # rounding
    Demonstrations(with_option(0, 0, 1, 1, 1)).check(WITH_OPTIONS)
    Demonstrations(masked([])).check(MASKED)
    Demonstrations(timed()).check(SPECS)
    Demonstrations(timed(1, 0.0)).check(SPECS)  # two signals of a corridor may be due at once


def test_rows_in_the_numbers_of_the_space_are_refused_until_they_are_scaled():
    env = make(1, form="flat", observation_scaling="bounds")
    rows = episodes(2, 3)
    rows[keys.DISCRETE] = 4 + rows[keys.DISCRETE]
    rows[keys.PARAMETERS] = torch.tensor([0.5, 20.0, 0.2]).expand(5, -1).clone()
    rows[keys.OBSERVATION] = rows["next", keys.OBSERVATION] = torch.tensor([4.0, 7.0]).expand(5, -1).clone()
    scaled = env.scaled_rows(rows)
    assert scaled[keys.OBSERVATION][0].tolist() == [0.75, 7.0] and scaled[keys.DISCRETE].max() < 3
    Demonstrations(scaled).check(PAMDPSpecs.from_env(env), env.observation_bounds)
    scaled[keys.OBSERVATION] = rows[keys.OBSERVATION]
    line = r"row 0: observation\[0\] is 4, but must be -1 to 1, as the agent sees it; .* env\.scaled_rows\(rows\)"
    with pytest.raises(DataError, match=line):
        Demonstrations(scaled).check(PAMDPSpecs.from_env(env), env.observation_bounds)


def test_wrong_decisions_are_refused_with_their_row():
    rows = with_option(0, 0, 1, 1, 1)
    given = with_option_sums(rows)[rows["next", keys.DONE].squeeze(-1)]
    Demonstrations(rows, decisions=given).check(WITH_OPTIONS)
    for name, value, said in (
        (keys.OPTION, 7, "row 1: option is 7, but must be 0 to 1"),
        (("next", keys.OPTION_RETURN), np.inf, "row 1: next.option_return is inf, but must be"),
        (("next", keys.OPTION_STEPS), 0, "row 1: next.option_steps is 0, but must be at least 1"),
        (("next", keys.DECISION_OBSERVATION), np.nan, "row 1: next.decision_observation[0] is nan"),
    ):
        with pytest.raises(DataError, match=rf"^the decisions, {re.escape(said)}"):
            Demonstrations(rows, decisions=spoilt(name, 1, value, given)).check(WITH_OPTIONS)


def with_what_learners_read(rows):
    """Return transitions with all that an environment may write beside the observation and learners read."""
    num, generator = len(rows), torch.Generator().manual_seed(1)
    is_first = rows[keys.IS_DECISION].squeeze(-1)
    of_states = {
        keys.ACTION_MASK: torch.rand(num, 3, generator=generator) > 0.5,
        keys.OPTION_MASK: torch.rand(num, 2, generator=generator) > 0.5,
        keys.PAIR_MASK: torch.rand(num, 3, 3, generator=generator) > 0.5,
        keys.PARAMETER_LOW: -torch.rand(num, 4, generator=generator),
        keys.PARAMETER_HIGH: torch.rand(num, 4, generator=generator),
        keys.DURATION: torch.rand(num, 1, generator=generator) + 0.5,
    }
    for name, values in of_states.items():
        rows["next", name] = values
        rows[name] = values.roll(1, 0) * ~is_first.reshape(-1, *[1] * (values.ndim - 1))
    return rows


@pytest.mark.parametrize("rows", [episodes(3, 1, 2), with_what_learners_read(episodes(3, 1, 2))], ids=["few", "all"])
def test_minari_returns_all_that_learners_read_of_a_state(rows, workshop_id, tmp_path, monkeypatch):
    library = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    more = {"env_id": workshop_id, "env_kwargs": {"size": 2}}
    dataset = minari.export(rows, "test/tools-v0", LAYOUT, **more, description="Tools.")
    assert dataset.total_episodes == 3 and dataset.total_steps == 6
    assert set(dataset[0].actions) == {"tool", "force"} and "heat" in dataset[0].infos
    assert library.load_dataset("test/tools-v0").recover_environment().unwrapped.size == 2
    loaded = minari.load("test/tools-v0", LAYOUT)
    assert set(loaded.keys(True, True)) == set(rows.keys(True, True))
    for name, value in rows.items(True, True):
        assert loaded[name].dtype == value.dtype and loaded[name].equal(value), name
    assert minari.checksum(minari.load("test/tools-v0")) == minari.checksum(rows)
    with pytest.raises(DataError, match="test/tools-v0: its actions have no discrete and parameters"):
        minari.load("test/tools-v0", minari.MinariLayout())
    if keys.ACTION_MASK in rows.keys():
        for name in (keys.ACTION_MASK, keys.PAIR_MASK, keys.PARAMETER_LOW):
            with pytest.raises(DataError, match=f"have {name}, but lack next.{name}, which Minari keeps, too"):
                minari.export(rows.exclude(("next", name)), "test/half-v0", LAYOUT, **more)


def exported(tmp_path, monkeypatch, workshop_id):
    """Return the folder of a Minari data set, and what reads it."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    minari.export(episodes(3, 2), "test/tools-v0", LAYOUT, env_id=workshop_id, env_kwargs={"size": 2})
    return tmp_path / "test" / "tools-v0" / "data"


def with_metadata(folder, **changes):
    file = folder / "metadata.json"
    metadata = {**json.loads(file.read_text()), **changes}
    file.write_text(json.dumps({name: value for name, value in metadata.items() if value is not None}))


def with_values(folder, name, make):
    """Put other values in the place of an entry of the file of episodes."""
    with h5py.File(folder / "main_data.hdf5", "a") as file:
        episode = file["episode_1"]
        old = episode[name][()]
        del episode[name]
        make(episode, name, old)


def spec_that_runs(folder):
    spec = gymnasium.envs.registration.EnvSpec("Bomb-v0", entry_point=f"{__name__}:light")
    with_metadata(folder, env_spec=spec.to_json(), action_space=None)


is_lit = False


def light(**_):
    global is_lit
    is_lit = True


SPOILS = {
    "its metadata have no action_space": spec_that_runs,
    "cannot be read as transitions (no JSON": lambda folder: (folder / "metadata.json").write_text("[" * 9999),
    "cannot be read as transitions (Unable to": lambda folder: (folder / "main_data.hdf5").write_bytes(b"\x89HDF" * 99),
    "the transitions, row 3: next.reward is nan, but must be finite": lambda folder: with_values(
        folder, "rewards", lambda group, name, old: group.create_dataset(name, data=old * np.nan)
    ),
    "cannot be read as transitions (": lambda folder: with_values(
        folder, "rewards", lambda group, name, old: group.create_dataset(name, data=old[:1])
    ),
}


@pytest.mark.parametrize("said", SPOILS)
def test_a_foreign_minari_data_set_runs_no_code_and_is_refused_in_one_line(workshop_id, tmp_path, monkeypatch, said):
    pytest.importorskip("minari")
    SPOILS[said](exported(tmp_path, monkeypatch, workshop_id))
    with pytest.raises(DataError) as refused:
        minari.load("test/tools-v0", LAYOUT)
    message = str(refused.value)
    assert message.startswith("test/tools-v0: ") and said in message and "\n" not in message
    assert not is_lit


def test_what_is_written_as_memory_maps_is_read_back(tmp_path):
    rows = with_what_learners_read(episodes(3, 2))
    export.write_memmap(rows, tmp_path / "rows")
    found = TensorDict.load_memmap(tmp_path / "rows")
    assert set(found.keys(True, True)) == set(rows.keys(True, True))
    assert all(found[name].equal(value) for name, value in rows.items(True, True))


def test_minari_refuses_options_inside_episodes_and_unknown_environments(tmp_path, monkeypatch):
    pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    with pytest.raises(DataError, match="test/x-v0: Environment `Nowhere` doesn't exist"):
        minari.export(episodes(2), "test/x-v0", LAYOUT, env_id="Nowhere-v0")
    batch = episodes(2)
    batch["next", keys.IS_DECISION] = torch.ones(2, 1, dtype=torch.bool)
    with pytest.raises(DataError, match="options that end inside an episode"):
        minari.export(batch, "test/x-v0", LAYOUT, env_id="Nowhere-v0")
    assert not list(tmp_path.iterdir())
