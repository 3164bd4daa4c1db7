"""Whatever a checkpoint holds, it is refused in one line, changes nothing of the agent, and takes no memory."""

import copy
import hashlib
import io
import json
import math
import pickle
import resource
import tracemalloc
import zipfile
from pathlib import Path

import pytest
import torch
from conftest import TRAINED, compose_config, forked, make_config
from test_grid import SHORT
from torchrl.data import ReplayBuffer

from hpamdp.config.errors import ConfigError
from hpamdp.run import checkpoint
from hpamdp.run.assemble import assemble
from hpamdp.run.collection.single import SingleCollection
from hpamdp.run.players import load_agent
from hpamdp.run.tensor_archive import TensorArchive
from hpamdp.run.train import run
from hpamdp.run.trainer import DivergedError, Trainer

TINY = ["num_envs=4", "steps_per_batch=4", "total_frames=192", "eval.layouts=2", "eval.every=0", "log_every=1000"]
# A learner with waiting rows under a selector with a replay.
BOTH = ["low=hppo", "low.hidden_dims=[8]", "low.minibatch_size=48", "high=meta_critic", "high.hidden_dims=[8]"]
BOTH += ["high.num_members=2", "high.warmup_decisions=8", "high.batch_size=8", "high.updates_per_decision=0.1"]


class Opener:
    """A run that a file is resumed into, as far as it gets.

    Args:
        words: of the run.
        folder: with its checkpoint.
    """

    def __init__(self, words, folder):
        assert run(compose_config([*words, "checkpoint_every=64"]), folder, words) == 0
        self.folder, self.file = folder, folder / "hostile.zip"
        with zipfile.ZipFile(folder / "checkpoint.zip") as archive:
            self.members = {name: archive.read(name) for name in archive.namelist()}
        self.manifest = json.loads(self.members.pop("manifest.json"))
        self.states = {name: torch.load(io.BytesIO(data), weights_only=True) for name, data in self.members.items()}
        self.config = make_config(words)
        self.parts = assemble(self.config)
        self.collection = SingleCollection(self.config, self.parts)
        self.trainer = Trainer(self.config, self.parts, folder)

    def resume(self, **changed):
        """Resume from the file with other members or another manifest; raise ConfigError if it is refused."""
        manifest = copy.deepcopy(changed.pop("manifest", self.manifest))
        members = {**self.members, **{f"{name}.pt": data for name, data in changed.items()}}
        with zipfile.ZipFile(self.file, "w") as archive:
            for name, data in members.items():
                if not isinstance(data, bytes):
                    data = packed(data)
                if isinstance(manifest, dict) and isinstance(manifest.get("members"), dict):
                    manifest["members"][name.removesuffix(".pt")] = hashlib.sha256(data).hexdigest()
                archive.writestr(name, data)
            archive.writestr("manifest.json", manifest if isinstance(manifest, str) else json.dumps(manifest))
        try:
            self.trainer.restore(self.file)
            self.trainer.restore_collection(self.collection)
        except ConfigError:
            if not {*changed} & {"collection", "recorder"}:  # which are checked after the agent is complete
                assert not [part for part in self.replays() if len(part)]
            raise
        finally:
            for part in self.replays():
                part.empty()  # as before a run is resumed

    def replays(self):
        """Return the replay buffers of the agent."""
        return [part for part in self.parts.agent.stateful().values() if isinstance(part, ReplayBuffer)]

    def all_of_agent(self):
        """Return everything that a checkpoint could change of the agent, by name."""
        states = {"agent": self.parts.agent.state_dict()}
        for name, part in self.parts.agent.stateful().items():
            if isinstance(part, torch.optim.Optimizer):
                states[name] = part.state_dict()
        return copy.deepcopy(states)


def packed(state) -> bytes:
    stream = io.BytesIO()
    torch.save(state, stream)
    return stream.getvalue()


def same(one, other) -> bool:
    if torch.is_tensor(one):
        return torch.is_tensor(other) and one.dtype == other.dtype and torch.equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(one[name], other[name]) for name in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    return one == other


def leaves(state, place=()):
    """Yield the place of every entry of nested dictionaries and lists."""
    entries = state.items() if isinstance(state, dict) else enumerate(state) if isinstance(state, list | tuple) else ()
    for name, value in list(entries)[:40]:  # a generator has 625 numbers
        yield (*place, name)
        yield from leaves(value, (*place, name))


GONE = object()


def put(state, place, value):
    """Return nested values with another one at a place."""
    name, *rest = place
    if isinstance(state, tuple):
        return tuple(put(list(state), place, value))
    state = copy.copy(state)
    if rest:
        state[name] = put(state[name], rest, value)
    elif value is GONE:
        del state[name]
    else:
        state[name] = value
    return state


def get(state, place):
    for name in place:
        state = state[name]
    return state


def mutations(value):
    """Yield other values with the name of the change."""
    yield "gone", GONE
    yield "None", None if value is not None else "text"
    yield "text", "text" if value != "text" else 1
    yield "list", [[value]]
    if torch.is_tensor(value):
        yield "shape", torch.cat([value.reshape(-1), value.new_zeros(1)])
        yield "dim", value.unsqueeze(0)
        yield "dtype", value.to(torch.complex64 if value.dtype != torch.bool else torch.int64)
        yield "other", value.to(torch.float64 if value.dtype != torch.float64 else torch.int16)
        if value.is_floating_point() and value.numel():
            yield "nan", torch.full_like(value, math.nan)
            yield "inf", torch.full_like(value, math.inf)
        elif value.dtype in (torch.int32, torch.int64) and value.numel():
            yield "negative", torch.full_like(value, -(2**30))
            yield "huge", torch.full_like(value, torch.iinfo(value.dtype).max)
    elif isinstance(value, float):
        yield "nan", math.nan
        yield "negative", -1.0
    elif type(value) is int:
        yield "negative", -1
        yield "huge", 10**30
    elif isinstance(value, dict | list | tuple):
        yield "empty", type(value)()


def is_harmless(place, change):
    """Return whether a file with the change can be resumed: it lacks what it may lack, or could be another run's."""
    if place[0].endswith("_extra_state"):  # fewer waiting rows
        return change in ("gone", "empty") and len(place) < 3
    if place[0] == "state" and "step" not in place:  # of an optimizer, some of whose weights had no gradient yet
        return change in ("gone", "empty") and len(place) < 3
    if place[-1] in ("foreach", "fused", "capturable", "differentiable", "decoupled_weight_decay"):
        return change in ("gone", "None")
    if place[0] == "root" and len(place) > 1:  # counters, and what the next action replaces
        return change in ("gone", "huge", "negative", "inf", "nan")
    optional = {
        "held",
        "scalars",
        "own",
        "ended",
        "option_names",
        "last_score",
        "rows",
        "env",
        "frames",
        "cpu_s",
        "wall_s",
    }
    return bool({*place} & {*optional, "episode", "steps", "presses", "pending", "has_gauss"}) or change == "empty"


def assert_all_refused(opener, step=1):
    opener.resume()
    before = opener.all_of_agent()
    accepted = []
    cases = [
        (name, place, change, value)
        for name, state in {**opener.states, "manifest.json": {"progress": opener.manifest["progress"]}}.items()
        for place in leaves(state)
        if "config" not in place
        for change, value in mutations(get(state, place))
    ]
    for name, place, change, value in cases[::step]:
        if name == "manifest.json":
            changed = {"manifest": put(opener.manifest, place, value)}
        else:
            changed = {name.removesuffix(".pt"): put(opener.states[name], place, value)}
        try:
            opener.resume(**changed)
        except ConfigError as error:
            assert "\n" not in str(error), (name, place, change)
            assert len(str(error)) < 600, (name, place, change)
            assert same(opener.all_of_agent(), before), (name, place, change)
        else:
            accepted.append((name, place, change))
            assert is_harmless(place, change), (name, place, change)
            opener.resume()
    return accepted


@pytest.fixture(scope="module")
def opener(tmp_path_factory):
    return Opener([*TINY, *BOTH], tmp_path_factory.mktemp("run") / "both")


def test_other_contents_are_refused_in_one_line_and_change_nothing(opener):
    assert_all_refused(opener, step=97)


KINDS = [
    ["low=qpamdp", "high=linucb"],
    ["low=pets", "high=exp3"],
    ["low=hyar", "high=option_critic", "high.warmup_steps=16"],
]
OTHERS = [[f"low={low}", "high=ucb"] for low in TRAINED]


@pytest.mark.slow
@pytest.mark.parametrize("words", [BOTH, *KINDS, *OTHERS], ids="-".join)
def test_other_contents_of_every_learner_are_refused(words, tmp_path):
    short = SHORT.get(words[0].removeprefix("low="), [])
    assert_all_refused(Opener([*TINY, *words, *short], tmp_path / "run"), step=5)


MANIFESTS = {
    "nested": '{"format": 2, "progress": ' + "[" * 100_000 + "]" * 100_000 + "}",
    "long": '{"format": 1' + "0" * 5000 + "}",
    "infinite": '{"format": NaN}',
    "list": "[2]",
    "text": '"2"',
    "null": "null",
    "boolean": '{"format": true, "members": {}, "progress": {}}',
}


@pytest.mark.parametrize("text", MANIFESTS.values(), ids=MANIFESTS)
def test_manifests_of_other_forms_are_refused(text, opener):
    with pytest.raises(ConfigError, match="damaged, or not a checkpoint") as error:
        opener.resume(manifest=text)
    assert "\n" not in str(error.value) and len(str(error.value)) < 400


def laughs():
    value = ["ha"]
    for _ in range(40):
        value = [value, value]
    return value


def deep_script() -> bytes:
    """Return what `torch.save` cannot: lists in lists, without recursion."""
    script = pickle.PROTO + b"\x02" + pickle.EMPTY_LIST * 20_000 + pickle.APPEND * 19_999 + pickle.STOP
    return with_script(script)


def with_script(script: bytes, data: bytes = b"") -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("archive/data.pkl", script)
        archive.writestr("archive/data/0", data)
    return stream.getvalue()


def claimed(numbers: int) -> bytes:
    """Return a tensor whose storage claims to be longer than its bytes."""
    weight = packed({"a": torch.zeros(300)})
    with zipfile.ZipFile(io.BytesIO(weight)) as archive:
        script = archive.read("archive/data.pkl")
    assert b"M,\x01" in script  # 300
    return with_script(script.replace(b"M,\x01", b"J" + numbers.to_bytes(4, "little")), bytes(1200))


def compressed(data: bytes) -> bytes:
    """Return the archive of a state with compressed members."""
    stream = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as copied:
        for name in archive.namelist():
            copied.writestr(name, archive.read(name))
    return stream.getvalue()


ODD = {
    "laughs": laughs,
    "deep": deep_script,
    "claimed": lambda: claimed(2**31 - 1),
    "expanded": lambda: {"a": torch.zeros(1).expand(10**10)},
    "partly expanded": lambda: {"a": torch.zeros(5, 1).expand(5, 10**9)},
    "shared": lambda: dict(enumerate(torch.zeros(10**5).expand(400, -1))),
    "overlapping": lambda: {"a": torch.zeros(2000).as_strided((1000, 1000), (1, 1))},
    "compressed": lambda: compressed(packed({"a": torch.zeros(10**6)})),
    "complex": lambda: {"a": torch.zeros(2, dtype=torch.complex64)},
    "sparse": lambda: {"a": torch.zeros(2).to_sparse()},
    "meta": lambda: {"a": torch.zeros(10**12, device="meta")},
    "subclass": lambda: {"a": torch.nn.Parameter(torch.zeros(2))},
    "module": lambda: torch.nn.Linear(2, 2),
    "protocol 4": lambda: with_script(pickle.dumps({"a": [1]}, protocol=4)),
    "nothing": lambda: with_script(b""),
    "memo": lambda: with_script(b"\x80\x02}r\xff\xff\xff\xff."),
    "dicts": lambda: with_script(b"\x80\x02](" + b"}" * 2_000_000 + b"e."),
    "length": lambda: with_script(b"\x80\x02X\xff\xff\xff\x7fab."),
}


@pytest.mark.parametrize("make", ODD.values(), ids=ODD)
@pytest.mark.parametrize("member", ["agent", "learner0_optimizer"])
def test_odd_tensors_and_bombs_are_refused(make, member, opener):
    before = opener.all_of_agent()
    with pytest.raises(ConfigError) as error:
        opener.resume(**{member: make()})
    assert "\n" not in str(error.value)
    assert same(opener.all_of_agent(), before)


def open_bombs(opener) -> None:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + 200_000_000, -1))
    for name in ("laughs", "claimed", "expanded", "partly expanded", "shared", "overlapping", "compressed", "length"):
        for member in ("agent", "collection", "selector_buffer"):
            with pytest.raises(ConfigError) as error:
                opener.resume(**{member: ODD[name]()})
            assert "memory" not in str(error.value), (name, member)


def test_no_bomb_takes_memory(opener):
    assert forked(open_bombs, opener) == 0


def test_a_description_that_takes_more_memory_than_its_bytes_is_refused():
    data = ODD["dicts"]()
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"its description has more than 450,0\d\d instructions"):
        TensorArchive(io.BytesIO(data), len(data))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50_000_000


def test_a_description_of_many_small_tensors_is_read():
    data = packed([{"a": torch.zeros(1), "b": torch.zeros(2)} for _ in range(8_000)])
    assert len(TensorArchive(io.BytesIO(data), len(data)).state) == 8_000


def test_a_tensor_takes_its_bytes_twice_while_it_is_read():
    data = packed({"a": torch.arange(5_000_000)})
    archive = TensorArchive(io.BytesIO(data), len(data))
    tracemalloc.start()
    read = archive.tensor(archive.state["a"])
    peak = tracemalloc.get_traced_memory()[1]  # without torch's own copy
    tracemalloc.stop()
    assert read.equal(torch.arange(5_000_000)) and peak < 1.1 * read.nbytes


def test_a_compressed_or_ambiguous_archive_is_refused(opener, tmp_path):
    opener.resume()
    file = tmp_path / "a.zip"
    with zipfile.ZipFile(opener.file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for kind in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):
        with zipfile.ZipFile(file, "w", kind) as archive:
            for name, data in members.items():
                archive.writestr(name, data)
        with pytest.raises(ConfigError, match="is compressed"):
            checkpoint.progress_of(file)
    with zipfile.ZipFile(file, "w") as archive, pytest.warns(UserWarning, match="Duplicate"):
        for name, data in [*members.items(), ("agent.pt", members["agent.pt"])]:
            archive.writestr(name, data)
    with pytest.raises(ConfigError, match=r"agent\.pt is there twice"):
        checkpoint.progress_of(file)


def test_weights_in_another_layout_and_in_half_precision_are_read(opener):
    agent = {name: value for name, value in opener.states["agent.pt"].items()}
    name = next(name for name in agent if name.startswith("learners.0.critic") and agent[name].ndim == 2)
    same_weights = [key for key in agent if torch.is_tensor(agent[key]) and torch.equal(agent[key], agent[name])]
    half = agent[name].half()
    for key in same_weights:
        agent[key] = half.T.contiguous().T
    opener.resume(agent=agent)
    assert torch.equal(opener.parts.agent.state_dict()[name], half.float())
    opener.resume()


def test_an_archive_reads_what_torch_saved():
    state = {"a": torch.randn(3, 4).T, "b": [torch.arange(3), {"c": (1, 2.5, None, True, "x")}], "e": torch.zeros(0, 2)}
    state |= {"bool": torch.tensor([True, False]), "bfloat": torch.randn(2).bfloat16(), "scalar": torch.tensor(3)}
    data = packed(state)
    archive = TensorArchive(io.BytesIO(data), len(data))
    assert same(archive.filled(archive.state), state)


def test_learners_are_taken_over_as_a_whole_or_not_at_all(opener):
    """The second learner of `low.checkpoint` is wrong: the first one stays as it is, too."""
    name = next(name for name in opener.states["agent.pt"] if name.startswith("learners.1.critic"))
    changed = {**opener.states["agent.pt"], name: torch.zeros(3, 3)}
    with pytest.raises(ConfigError, match="does not fit"):
        opener.resume(agent=changed)
    before = opener.all_of_agent()
    with pytest.raises(ConfigError, match=r"^low\.checkpoint=.*of another class or size than low") as error:
        checkpoint.load_learners(opener.file, opener.parts.agent, opener.parts.device)
    assert "\n" not in str(error.value)
    assert same(opener.all_of_agent(), before)


@pytest.mark.parametrize("entry", ["frames", "wall_s", "last_score", "config", "option_names"])
@pytest.mark.parametrize("value", ["text", [1], math.inf, {"a": 1}, True])
def test_a_policy_with_other_progress_is_refused(entry, value, opener, tmp_path):
    if (entry, value) == ("config", {"a": 1}):
        return
    saved = torch.load(opener.folder / "policy.pt", weights_only=True)
    saved["progress"] = json.dumps({**json.loads(saved["progress"]), entry: value})
    torch.save(saved, tmp_path / "policy.pt")
    with pytest.raises(ConfigError, match="damaged, or not a checkpoint") as error:
        load_agent(str(tmp_path / "policy.pt"), [])
    assert "\n" not in str(error.value)


HUGE = {
    "low": {"low": {"hidden_dims": [8_000, 8_000]}},
    "high": {"high": {"hidden_dims": [8_000, 8_000]}},
    "members": {"high": {"num_members": 200_000}},
    "exploration": {
        "exploration": {
            "_target_": "hpamdp.policies.exploration.novelty.Novelty",
            "hidden_dims": [8_000, 8_000],
        },
        "choices": {"exploration": "novelty"},
    },
}


def policy_of(opener, file, changes, *, has_weights=True):
    """Write the policy of a run with other settings in its config."""
    saved = torch.load(opener.folder / "policy.pt", weights_only=True)
    progress = json.loads(saved["progress"])
    for group, values in changes.items():
        progress["config"][group].update(values)
    torch.save({**saved, "progress": json.dumps(progress), **({} if has_weights else {"agent": {}})}, file)


def load_without_memory(file) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    words = ["mode=eval", f"checkpoint={file}"]
    for load in (lambda: load_agent(str(file), []), lambda: run(compose_config(words), file.parent / "run", words)):
        with pytest.raises(ConfigError, match="does not fit this agent") as error:
            load()
        assert "\n" not in str(error.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


@pytest.mark.parametrize("has_weights", [True, False])
@pytest.mark.parametrize("changes", HUGE.values(), ids=HUGE)
def test_a_small_file_that_describes_a_huge_agent_is_refused_before_it_takes_memory(
    changes, has_weights, opener, tmp_path
):
    policy_of(opener, tmp_path / "policy.pt", changes, has_weights=has_weights)
    assert forked(load_without_memory, tmp_path / "policy.pt") == 0


def test_weights_that_overflowed_are_not_saved(opener):
    weight = next(opener.parts.agent.parameters())
    with torch.no_grad():
        weight.view(-1)[0] = torch.inf
    with pytest.raises(DivergedError, match="is inf"):
        opener.trainer.save(opener.collection)
    opener.resume()
