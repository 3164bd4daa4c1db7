"""A problem of one step with a known optimum, and its data as learners see it."""

import torch
from tensordict import TensorDict

from hpamdp import keys
from hpamdp.policies.base import Learner
from hpamdp.specs import PAMDPSpecs

SPECS = PAMDPSpecs(4, (), (1, 2, 0), (0.0, -1.0, 5.0), (2.0, 1.0, 9.0))


def states(num: int) -> TensorDict:
    return TensorDict({keys.OBSERVATION: torch.rand(num, 4) * 2 - 1}, [num])


def one_step_rows(learner: Learner, num: int, slope: float = 1.0) -> TensorDict:
    """Play `num` episodes of one step, `[num, 1]`.

    Discrete action 1 earns the more, the nearer its parameters are to slope * (s0, -s1), at most 1; action 2 always
    earns 0.2, action 0 loses 0.5.
    """
    td = learner.policy(states(num))
    unit, state = learner.specs.to_unit(td[keys.PARAMETERS]), td[keys.OBSERVATION]
    error = (unit[:, 1] - slope * state[:, 0]).square() + (unit[:, 2] + slope * state[:, 1]).square()
    reward = torch.stack([torch.full_like(error, -0.5), 1.0 - error, torch.full_like(error, 0.2)], -1)
    is_end = torch.ones(num, 1, dtype=torch.bool)
    reward = reward.gather(-1, td[keys.DISCRETE].unsqueeze(-1))
    td["next"] = {keys.OBSERVATION: state, keys.REWARD: reward, keys.DONE: is_end, keys.TERMINATED: is_end}
    return td.unsqueeze(-1)


def sample(num: int = 32) -> TensorDict:
    """Return random transitions, as sampled from the replay buffer."""
    return TensorDict(
        {
            "state": torch.randn(num, 4),
            "discrete": torch.randint(3, (num,)),
            "unit": torch.rand(num, 3) * 2 - 1,
            "reward": torch.randn(num),
            "next_state": torch.randn(num, 4),
            "discount": torch.rand(num),
        },
        [num],
    )
