"""What serves any recording: demonstrations, tables and memory-mapped files, and Minari."""

import csv

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.data import export, minari
from hpamdp.data.demonstrations import TRAJECTORY, Demonstrations, with_option_sums
from hpamdp.data.errors import DataError

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


def test_demonstrations_are_one_batch_with_option_sums():
    rows = episodes(2, 2)
    batch = Demonstrations(rows, torch.device("cpu")).batch
    assert batch.shape == (1, 4)
    assert batch["next", keys.OPTION_STEPS].flatten().tolist() == [1, 2, 1, 2]
    assert batch[0][keys.PARAMETERS].equal(rows[keys.PARAMETERS])


def test_demonstrations_hold_the_decisions_that_they_are_given_and_name_missing_keys():
    rows = episodes(2, 2)
    assert Demonstrations(rows).decisions is None
    decisions = with_option_sums(rows)[1::2].set(keys.OPTION, torch.tensor([0, 1]))
    assert Demonstrations(rows, decisions=decisions).decisions.shape == (1, 2)
    with pytest.raises(DataError, match=r"the decisions lack option, next\.option_return$"):
        Demonstrations(rows, decisions=decisions.exclude(keys.OPTION, ("next", keys.OPTION_RETURN)))


def test_demonstrations_are_discounted_as_a_selector_asks():
    rows = episodes(2, 2)
    demonstrations = Demonstrations(rows)
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


def test_csv_gives_back_every_value(tmp_path):
    values = torch.tensor([0.1, float("nan"), 3e-8])
    table = TensorDict(
        {
            "single": values,
            "double": values.double() / 3,
            "flag": torch.tensor([True, False, True]),
            "count": torch.tensor([2**40, -1, 0]),
            "point": torch.arange(6.0).reshape(3, 2),
        },
        batch_size=[3],
    )
    export.write_csv({"things": table}, tmp_path / "numbered")
    with (tmp_path / "numbered" / "things.csv").open() as file:
        rows = list(csv.DictReader(file))
    for name in ("single", "double"):
        written = np.array([row[name] or "nan" for row in rows], table[name].numpy().dtype)
        np.testing.assert_array_equal(written, table[name].numpy())
    assert [row["flag"] for row in rows] == ["1", "0", "1"]
    assert [int(row["count"]) for row in rows] == table["count"].tolist()
    assert [row["point_1"] for row in rows] == ["1.0", "3.0", "5.0"]
    export.write_csv({"things": table}, tmp_path / "named", axes=("x", "y"))
    assert (tmp_path / "named" / "things.csv").read_text().splitlines()[0].endswith("point_x,point_y")


def test_a_failed_write_leaves_nothing_behind(tmp_path):
    def fail(unfinished):
        unfinished.write_text("half")
        raise OSError(28, "No space left on device")

    with pytest.raises(DataError, match=r"cannot be written \(No space left"):
        export.write_atomically(tmp_path / "folder" / "file", fail)
    assert not list((tmp_path / "folder").iterdir())


def test_minari_returns_the_transitions_of_a_problem_without_options(workshop_id, tmp_path, monkeypatch):
    library = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    batch = episodes(3, 1, 2)
    dataset = minari.export(
        batch, "test/tools-v0", LAYOUT, env_id=workshop_id, env_kwargs={"size": 2}, description="Tools."
    )
    assert dataset.total_episodes == 3 and dataset.total_steps == 6
    assert set(dataset[0].actions) == {"tool", "force"} and set(dataset[0].infos) == {"heat"}
    assert library.load_dataset("test/tools-v0").recover_environment().unwrapped.size == 2
    loaded = minari.load("test/tools-v0", LAYOUT)
    assert set(loaded.keys(True, True)) == set(batch.keys(True, True))
    for name, value in batch.items(True, True):
        assert loaded[name].dtype == value.dtype and loaded[name].equal(value), name
    with pytest.raises(DataError, match="test/tools-v0: cannot be read as transitions"):
        minari.load("test/tools-v0", minari.MinariLayout())


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
