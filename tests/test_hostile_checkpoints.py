"""A checkpoint of another agent is refused in one line, and changes nothing of the agent."""

import copy

import pytest
import torch
from conftest import assert_same, compose_config, make_config, parts_of
from torchrl.data import ReplayBuffer

from hpamdp.config.errors import ConfigError
from hpamdp.run import checkpoint
from hpamdp.run.assemble import assemble
from hpamdp.run.collection.single import SingleCollection
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


def tensors(state, place=()):
    """Yield the place and the value of every tensor in nested dictionaries."""
    for name, value in state.items() if isinstance(state, dict) else ():
        if torch.is_tensor(value):
            yield (*place, name), value
        yield from tensors(value, (*place, name))


def put(state, place, value):
    """Return nested dictionaries with another value at a place."""
    name, *rest = place
    return {**state, name: put(state[name], rest, value) if rest else value}


def mutations(value):
    """Yield values of other types and shapes."""
    yield "text"
    yield torch.cat([value.reshape(-1), value.new_zeros(1)])
    yield value.unsqueeze(0)
    yield value.to(torch.complex64 if value.dtype != torch.bool else torch.int64)


@pytest.fixture(scope="module")
def opener(tmp_path_factory):
    return Opener([*TINY, *BOTH], tmp_path_factory.mktemp("run") / "both")


def test_other_types_and_shapes_are_refused_in_one_line_and_change_nothing(opener):
    before = opener.all_of_agent()
    cases = [
        (name, place, other)
        for name in before
        for place, value in tensors(opener.states[name])
        for other in mutations(value)
    ]
    for name, place, other in cases[::23]:
        with pytest.raises(ConfigError) as error:
            opener.resume(**{name: put(opener.states[name], place, other)})
        assert "\n" not in str(error.value) and len(str(error.value)) < 600, (name, place)
        assert_same(opener.all_of_agent(), before, f"{name} {place}")


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
    assert_same(opener.all_of_agent(), before)


def test_weights_that_overflowed_are_not_saved(opener):
    weight = next(opener.parts.agent.parameters())
    with torch.no_grad():
        weight.view(-1)[0] = torch.inf
    with pytest.raises(DivergedError, match="is inf"):
        opener.trainer.save(opener.collection)
    opener.resume()
