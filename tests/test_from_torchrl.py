"""Environments of TorchRL, played and learned as any other environment."""

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Categorical, Composite, MultiCategorical, OneHot, Unbounded
from torchrl.envs import Compose, EnvBase, FrameSkipTransform, MultiAction, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.transforms import MacroPrimitiveTransform
from torchrl.envs.utils import step_mdp

import hpamdp
from hpamdp.env.gymnasium.from_torchrl import FromTorchRL
from hpamdp.settings import SettingError


class Tanks(EnvBase):
    """Fill one of three tanks by an amount: the reward is what the lowest tank gains. It ends when a tank overflows."""

    batch_locked = False

    def __init__(self, kind=Categorical, batch_size=()):
        super().__init__(batch_size=batch_size)
        shape = torch.Size(batch_size)
        which = kind(3, shape=(*shape, 3) if kind is OneHot else shape)
        amount = Bounded(0.0, 0.5, shape=(*shape, 1))
        self.action_spec = Composite(which=which, amount=amount, shape=shape)
        self.observation_spec = Composite(level=Bounded(0.0, 2.0, shape=(*shape, 3)), shape=shape)
        self.reward_spec = Unbounded(shape=(*shape, 1))

    def _set_seed(self, seed):
        self.generator = torch.Generator().manual_seed(seed or 0)

    def _reset(self, td=None):
        level = 0.3 * torch.rand((*self.batch_size, 3), generator=self.generator)
        return TensorDict({"level": level, "done": self._flag(False)}, self.batch_size)

    def _flag(self, value):
        return torch.full((*self.batch_size, 1), bool(value))

    def _step(self, td):
        which = td["which"].reshape(-1)
        which = which.long().argmax() if len(which) == 3 else which[0]
        before = td["level"]
        level = before.clone()
        level.view(-1)[which] += td["amount"].item()
        reward = level.min(-1, keepdim=True).values - before.min(-1, keepdim=True).values
        return TensorDict(
            {"level": level.clamp(max=2.0), "reward": reward, "done": self._flag(level.max() > 1.5)}, self.batch_size
        )


def limited(**settings):
    return TransformedEnv(Tanks(**settings), StepCounter(12))


@pytest.mark.parametrize(("kind", "batch_size"), [(Categorical, ()), (OneHot, ()), (Categorical, (1,))])
def test_it_is_stepped_as_torchrl_steps_it(kind, batch_size):
    env, own = FromTorchRL(limited(kind=kind, batch_size=batch_size)), limited(kind=kind, batch_size=batch_size)
    env.action_space.seed(0)
    own.set_seed(4)
    td = own.reset()
    observation, _ = env.reset(seed=4)
    ended = False
    while not ended:
        np.testing.assert_array_equal(observation["level"], td["level"].reshape(3))
        action = env.action_space.sample()
        observation, reward, terminated, truncated, _ = env.step(action)
        which = torch.tensor(int(action["which"]))
        which = torch.nn.functional.one_hot(which, 3) if kind is OneHot else which.reshape(batch_size)
        td.update({"which": which, "amount": torch.as_tensor(action["amount"]).reshape(*batch_size, 1)})
        after = own.step(td)["next"]
        assert (reward, terminated) == (after["reward"].item(), after["terminated"].item())
        td, ended = step_mdp(td), terminated or truncated
        assert ended == after["done"].item()
    assert env.observation_space.contains(observation) and env.own_time_limit == 12


def test_specs_become_spaces():
    specs = {
        "flags": (Binary(4), gymnasium.spaces.MultiBinary(4)),
        "kinds": (MultiCategorical([2, 3]), gymnasium.spaces.MultiDiscrete([2, 3])),
        "angle": (Bounded(-1.0, 1.0, shape=()), gymnasium.spaces.Box(-1.0, 1.0, ())),
        "number": (Bounded(0, 4, shape=(1,), dtype=torch.int64), gymnasium.spaces.Box(0, 4, (1,), np.int64)),
        "byte": (Bounded(0, 4, shape=(1,), dtype=torch.uint8), gymnasium.spaces.Box(0, 4, (1,), np.uint8)),
    }
    env = Tanks()
    env.action_spec = Composite({name: spec for name, (spec, _) in specs.items()})
    env.observation_spec = Composite(picture=Unbounded(shape=(1, 8, 8), dtype=torch.uint8))
    read = FromTorchRL(env)
    assert read.action_space == gymnasium.spaces.Dict({name: space for name, (_, space) in specs.items()})
    assert read.observation_space["picture"] == gymnasium.spaces.Box(0, 255, (1, 8, 8), np.uint8)


def test_its_random_numbers_are_apart_from_those_of_the_run():
    class Global(Tanks):
        def _set_seed(self, seed):
            self.generator = torch.manual_seed(seed)  # as in TorchRL's tutorial on Pendulum

    envs = [FromTorchRL(Global()) for _ in range(2)]
    torch.manual_seed(1)
    expected = torch.rand(3).tolist()
    torch.manual_seed(1)
    drawn, begun = [], []
    for seed in (5, None, None):
        for env in envs:
            begun.append(env.reset(seed=seed)[0]["level"].tolist())
        drawn.append(torch.rand(()).item())
    assert drawn == expected
    assert begun[::2] == begun[1::2] and begun[0] != begun[2] != begun[4]


def test_an_agent_learns_it_from_a_function_and_from_an_environment():
    settings = {"low": "hppo", "total_frames": 4096, "eval.layouts": 8, "progress": False}
    agents = [hpamdp.train(env, **settings) for env in (limited, limited())]
    for agent in agents:
        assert agent.specs.num_discrete == 3 and agent.history[-1]["eval/steps"] <= 12
    assert (
        agents[0].history[-1]["eval/score"] == agents[1].history[-1]["eval/score"] > agents[0].history[0]["eval/score"]
    )


def test_macro_actions_of_torchrl_are_a_choice_with_a_target():
    class Primitives(MacroPrimitiveTransform):
        def transform_input_spec(self, input_spec):
            input_spec["full_action_spec"] = Composite(
                action=Composite(
                    mode=Categorical(2, shape=(1, 1)), target=Bounded(-1.0, 1.0, shape=(1, 2)), shape=(1,)
                ),
                shape=(1,),
            )
            return input_spec

    class Point(EnvBase):
        def __init__(self):
            super().__init__(batch_size=(1,))
            self.action_spec = Bounded(-1.0, 1.0, shape=(1, 2))
            self.observation_spec = Composite(place=Unbounded(shape=(1, 2)), shape=(1,))
            self.reward_spec = Unbounded(shape=(1, 1))

        def _set_seed(self, seed):
            pass

        def _reset(self, td=None):
            self.place = torch.zeros(1, 2)
            return TensorDict({"place": self.place, "done": torch.zeros(1, 1, dtype=torch.bool)}, 1)

        def _step(self, td):
            self.place = self.place + td["action"]
            done = torch.zeros(1, 1, dtype=torch.bool)
            return TensorDict({"place": self.place, "reward": self.place.sum(-1, keepdim=True), "done": done}, 1)

    env = FromTorchRL(TransformedEnv(Point(), Compose(MultiAction(), Primitives(macro_steps=4, action_dim=2))))
    env.reset(seed=0)
    observation, reward, *_ = env.step({"action_mode": 1, "action_target": np.array([0.4, 0.0], np.float32)})
    assert set(env.action_space) == {"action_mode", "action_target"}
    assert reward == pytest.approx(0.1 + 0.3 + 0.6 + 1.0) and observation["place"] == pytest.approx([1.0, 0.0])


@pytest.mark.parametrize("transform", [FrameSkipTransform(2), MultiAction(stack_rewards=False)])
def test_transforms_that_lose_the_end_of_an_episode_are_refused(transform):
    with pytest.raises(SettingError, match=r"(end of an episode|episode's last step); "):
        FromTorchRL(TransformedEnv(limited(), transform))


def test_a_batch_is_refused_in_a_line():
    with pytest.raises(SettingError, match="steps 2 environments at once; give a single one"):
        FromTorchRL(SerialEnv(2, limited))
