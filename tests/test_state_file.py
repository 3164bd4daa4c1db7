"""What is written to a file is read back exactly, and a damaged file is refused."""

import math

import pytest
import torch
from conftest import assert_same, parts_of

from hpamdp.run.state_file import StateFile, write

WEIGHT = torch.arange(12.0).reshape(3, 4)
STATE = {
    "tensors": {
        **{str(dtype): torch.tensor([1, 0, 1]).to(dtype) for dtype in (torch.bool, torch.uint8, torch.int64)},
        **{str(dtype): torch.tensor([0.1, -3.0]).to(dtype) for dtype in (torch.bfloat16, torch.float16, torch.float64)},
        "special": torch.tensor([math.nan, math.inf, -0.0]),
        "scalar": torch.tensor(3),
        "empty": torch.zeros(0, 2),
        "weight": WEIGHT,
        "same": WEIGHT,
        "row": WEIGHT[1],
        "transposed": WEIGHT.T,
        "expanded": torch.zeros(1).expand(5),
    },
    "numbers": [2**70, -1, True, None, 0.1, 5e-324, math.nan, math.inf, -math.inf],
    "text": ["", "é\0\n\udc80", '"$tensor"'],
    "tuples": (1, (2.0, []), ()),
    "numbered": {0: {"moment": torch.ones(2)}, 1: {}, "2": None},
    "marked": {"$tensor": "weight", "$dict": [[1, 2]]},
    "a/b": {"c": torch.ones(1)},
    "a": {"b/c": torch.zeros(1), "b": {}},
}


def test_nested_values_are_read_back_exactly(tmp_path):
    write(tmp_path / "a", STATE)
    assert StateFile(tmp_path / "a").names == (*STATE,)
    assert_same(parts_of(tmp_path / "a"), STATE)


def test_a_number_with_the_stride_of_a_column_is_written(tmp_path):
    write(tmp_path / "a", {"x": torch.arange(6).reshape(1, 6)[:, 3]})
    assert StateFile(tmp_path / "a").read("x").tolist() == [3]


def test_the_same_values_make_the_same_bytes_and_shared_weights_are_stored_once(tmp_path):
    weight = torch.rand(1000)
    for name in ("a", "b"):
        write(tmp_path / name, {"agent": {"policy": weight, "actor": weight}})
    data = (tmp_path / "a").read_bytes()
    assert data == (tmp_path / "b").read_bytes() and len(data) < 1.2 * weight.nbytes
    agent = StateFile(tmp_path / "a").read("agent")
    assert agent["policy"] is agent["actor"]


def test_what_is_read_does_not_depend_on_the_file_any_more(tmp_path):
    write(tmp_path / "a", {"x": torch.ones(1000)})
    read = StateFile(tmp_path / "a").read("x")
    (tmp_path / "a").write_bytes(b"")
    assert read.add_(1.0).sum() == 2000.0


@pytest.mark.parametrize("value", [object(), {"a": [b"bytes"]}, {torch.float32: 1}])
def test_other_values_are_not_written(value, tmp_path):
    with pytest.raises(TypeError, match=r"^part.* is of type (object|bytes|dtype), which a file cannot hold$"):
        write(tmp_path / "a", {"part": value})
    assert not (tmp_path / "a").exists()


def test_every_changed_byte_is_noticed(tmp_path):
    write(tmp_path / "a", {"x": torch.tensor([True, False]), "y": [0.25, {"z": torch.arange(3)}]})
    data = (tmp_path / "a").read_bytes()
    padding = {place for place in range(8, len(data)) if data[place : place + 1] == b" "}
    for place in {*range(len(data))} - padding:
        (tmp_path / "b").write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        with pytest.raises(Exception, match=r"."):
            opened = StateFile(tmp_path / "b")
            [opened.read(name) for name in ("x", "y")]
