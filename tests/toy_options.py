"""A problem whose best option changes within an episode, its best value, and learners that need no training."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.env.base import PAMDPEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.base import Learner, Selector
from hpamdp.specs import PAMDPSpecs

WALK, SWIM = 0, 1
STEP, REST = 0, 1
LENGTH = 6.0  # of the way
SHORE = 3.0  # where land ends and water begins
SLOW = 0.25  # length of a whole step with the wrong option
_CELLS = int(LENGTH / SLOW) + 1


class Crossing(PAMDPEnv):
    """Walk over land, then swim through water; only the arrival is rewarded, with 1.

    Discrete actions: 0 steps, and its parameter in [0, 1] is the fraction of a whole step; 1 rests, and its parameter
    has no effect. A whole step is 1 long with the option that suits the place and `SLOW` with the other. The
    observation is the one-hot index of the place, in units of `SLOW`. Episodes start at a random place in the first
    `start` of the way.
    """

    option_names = ("walk", "swim")
    parameter_dims = (1, 1)
    max_steps: int = 30
    result_keys: ClassVar[tuple[str, ...]] = ("place",)

    def __init__(self, num_envs: int = 1, *, start: float = 0.0, seed: int = 0, device: object = "cpu") -> None:
        super().__init__(device=device, batch_size=[num_envs])
        self.start = start
        n = num_envs
        self.observation_spec = Composite(
            observation=Bounded(0.0, 1.0, shape=(n, _CELLS)), place=Bounded(0.0, LENGTH, shape=(n, 1)), shape=(n,)
        )
        action = Composite(discrete=Categorical(2, shape=(n,)), parameters=Bounded(0.0, 1.0, shape=(n, 2)), shape=(n,))
        self.action_spec = Composite(action=action, option=Categorical(2, shape=(n,)), shape=(n,))
        self.reward_spec = Unbounded(shape=(n, 1))
        self.done_spec = self.make_done_spec()
        self._set_seed(seed)

    def results(self, last: TensorDictBase) -> dict[str, Tensor]:
        return {"success": last["place"].squeeze(-1) >= LENGTH}

    def _set_seed(self, seed: int | None) -> None:
        self.generator = torch.Generator().manual_seed(seed or 0)
        self.place = torch.zeros(self.batch_size)
        self.steps = torch.zeros(self.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        mask = self.reset_mask(tensordict)
        fresh = torch.rand(self.batch_size, generator=self.generator) * self.start
        self.place = torch.where(mask, (fresh / SLOW).floor() * SLOW, self.place)
        self.steps = torch.where(mask, 0.0, self.steps)
        return self._read()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        fraction = tensordict[keys.PARAMETERS][:, STEP].clamp(0.0, 1.0)
        over = (self.place >= LENGTH) | (self.steps >= self.max_steps)
        whole = torch.where(tensordict[keys.OPTION] == (self.place >= SHORE), 1.0, SLOW)
        way = torch.where((tensordict[keys.DISCRETE] == REST) | over, 0.0, fraction * whole)
        self.place = (self.place + way).clamp(max=LENGTH)
        self.steps = self.steps + ~over
        return self._read().set(keys.REWARD, ((self.place >= LENGTH) & ~over).float().unsqueeze(-1))

    def _read(self) -> TensorDict:
        place = self.place.unsqueeze(-1)
        cell = torch.arange(_CELLS) == (place / SLOW).floor()
        terminated = place >= LENGTH
        truncated = (self.steps >= self.max_steps).unsqueeze(-1) & ~terminated
        flags = {keys.TERMINATED: terminated, keys.TRUNCATED: truncated, keys.DONE: terminated | truncated}
        return TensorDict({keys.OBSERVATION: cell.float(), "place": place, **flags}, self.batch_size)


class Toll(Crossing):
    """A crossing with a random reward at every step."""

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        return super()._step(tensordict).set(keys.REWARD, torch.rand(*self.batch_size, 1))


def best_value(gamma: float, option_length: int) -> float:
    """Return the discounted return of the best choices of options from the start of the way, with whole steps.

    By dynamic programming over the places, in units of `SLOW`, from the end of the way.
    """
    quick = round(1.0 / SLOW)
    value = {0: 0.0}

    def of(option: int, place: int) -> float:
        for step in range(option_length):
            place += quick if (option == SWIM) == (place >= round(SHORE / SLOW)) else 1
            if place >= _CELLS - 1:
                return gamma**step
        return gamma**option_length * value[place]

    for place in range(_CELLS - 2, -1, -1):
        value[place] = max(of(WALK, place), of(SWIM, place))
    return value[0]


class WholeStep(TensorDictModuleBase):
    """Always take a whole step."""

    in_keys: ClassVar[list] = [keys.OBSERVATION]
    out_keys: ClassVar[list] = [keys.DISCRETE, keys.PARAMETERS]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        discrete = torch.zeros(td.batch_size, dtype=torch.long)
        return td.update({keys.ACTION: {"discrete": discrete, "parameters": torch.ones(*td.batch_size, 2)}})


class Stepper(Learner):
    """Take whole steps and learn nothing."""

    def __init__(self, specs: PAMDPSpecs) -> None:
        super().__init__(specs)
        self.policy = WholeStep()


def steppers(selector: Selector, specs: PAMDPSpecs) -> HierarchicalAgent:
    """Return the agent that takes whole steps with the selector's options."""
    return HierarchicalAgent(selector, [Stepper(specs), Stepper(specs)], specs)


def earned(agent: HierarchicalAgent, gamma: float, option_length: int | None) -> float:
    """Return the discounted return of a greedy episode from the start of the way."""
    env = with_decisions(Crossing(1), option_length=option_length)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        rows = env.rollout(Crossing.max_steps, agent.policy)
    rewards = rows["next", keys.REWARD].flatten()
    return (gamma ** torch.arange(len(rewards)) * rewards).sum().item()
