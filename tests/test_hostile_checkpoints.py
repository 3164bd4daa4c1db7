"""A checkpoint of another form, or with weights that are not finite, is refused in one line and changes nothing."""

import copy
import math

import pytest
import torch
from conftest import TRAINED, compose_config, make_config, parts_of
from test_grid import SHORT
from torchrl.data import ReplayBuffer

from hpamdp.config.errors import ConfigError
from hpamdp.run import checkpoint
from hpamdp.run.assemble import assemble
from hpamdp.run.collection.single import SingleCollection
from hpamdp.run.players import load_agent
from hpamdp.run.state_file import write
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
        self.folder, self.file = folder, folder / "hostile.safetensors"
        self.states = parts_of(folder / "checkpoint.safetensors")
        self.config = make_config(words)
        self.parts = assemble(self.config)
        self.collection = SingleCollection(self.config, self.parts)
        self.trainer = Trainer(self.config, self.parts, folder)

    def resume(self, **changed):
        """Resume from the file with other parts; raise ConfigError if it is refused."""
        write(self.file, self.states | changed)
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
ADDED_LATER = ("practice", "own_steps", "log_max_scale", "is_open", "open.value")


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


# Settings of optimizers that say only how a step is computed.
EXECUTION = ("foreach", "fused", "capturable", "differentiable")


def is_harmless(place, change):
    """Return whether a file with the change can be resumed: it lacks what it may lack, or could be another run's."""
    if (change == "gone" and str(place[-1]).endswith(ADDED_LATER)) or place[-1] in EXECUTION:
        return True
    if place[0] == "state" and "step" not in place:  # of an optimizer, some of whose weights had no gradient yet
        return change in ("gone", "empty") and len(place) < 3
    if place[0] == "param_groups" and len(place) == 3 and place[-1] not in ("lr", "weight_decay"):
        return change == "gone"
    if change in ("negative", "huge") or (
        place[0] == "coming" and change in ("inf", "nan")
    ):  # numbers of the right form
        return True
    if place[0] == "root" and len(place) > 1:  # counters, and what the next action replaces
        return change in ("gone", "inf", "nan")
    optional = {
        "held",
        "scalars",
        "own",
        "ranges",
        "config_dirs",
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
        for name, state in opener.states.items()
        for place in leaves(state)
        if "config" not in place and not any(str(part).endswith("_extra_state") for part in place)
        for change, value in mutations(get(state, place))
    ]
    for name, place, change, value in cases[::step]:
        try:
            opener.resume(**{name: put(opener.states[name], place, value)})
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


def test_weights_in_half_precision_are_read(opener):
    agent = dict(opener.states["agent"])
    name = next(name for name in agent if name.startswith("learners.0.critic") and agent[name].ndim == 2)
    half = agent[name].half()
    for key, value in opener.states["agent"].items():
        if value is agent[name]:
            agent[key] = half
    opener.resume(agent=agent)
    assert torch.equal(opener.parts.agent.state_dict()[name], half.float())
    opener.resume()


def test_learners_are_taken_over_as_a_whole_or_not_at_all(opener):
    """The second learner of `low.checkpoint` is wrong: the first one stays as it is, too."""
    name = next(name for name in opener.states["agent"] if name.startswith("learners.1.critic"))
    changed = {**opener.states["agent"], name: torch.zeros(3, 3)}
    with pytest.raises(ConfigError, match="does not fit"):
        opener.resume(agent=changed)
    before = opener.all_of_agent()
    with pytest.raises(ConfigError, match=r"^low\.checkpoint=.*of another class or size than low") as error:
        checkpoint.load_learners(opener.file, opener.parts.agent, opener.parts.device)
    assert "\n" not in str(error.value)
    assert same(opener.all_of_agent(), before)


@pytest.mark.parametrize("entry", ["frames", "wall_s", "last_score", "config", "option_names"])
@pytest.mark.parametrize("value", ["text", [1], True])
def test_a_policy_with_other_progress_is_refused(entry, value, opener, tmp_path):
    saved = parts_of(opener.folder / "policy.safetensors")
    saved["progress"][entry] = value
    write(tmp_path / "policy.safetensors", saved)
    with pytest.raises(ConfigError, match="damaged, or not a checkpoint") as error:
        load_agent(str(tmp_path / "policy.safetensors"), [])
    assert "\n" not in str(error.value)


def test_weights_that_overflowed_are_not_saved(opener):
    weight = next(opener.parts.agent.parameters())
    with torch.no_grad():
        weight.view(-1)[0] = torch.inf
    with pytest.raises(DivergedError, match="is inf"):
        opener.trainer.save(opener.collection)
    opener.resume()
