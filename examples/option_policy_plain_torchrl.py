"""Train a policy over options with plain TorchRL, using only the environments of hpamdp.

Which boat should sail to the goal? Each boat has three keys, which push it in three fixed directions, and the two boats
differ in these directions. Sailing is not learned here: `Sailor` follows a simple geometric rule. One decision per
episode remains, the choice of the boat. `OptionChoiceEnv` turns it into an ordinary environment with one discrete
action, `option`, which TorchRL's own PPO can learn.

    python examples/option_policy_plain_torchrl.py [BATCHES]
"""

from __future__ import annotations

import sys
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.option_choice import OptionChoiceEnv

NUM_ENVS = 256
EPISODES_PER_BATCH = 1024
EPOCHS = 4
MINIBATCH_SIZE = 64


class Sailor(TensorDictModuleBase):
    """Press the key that points most directly at the goal, long enough to come to rest level with it."""

    in_keys: ClassVar = ["observation", "option"]
    out_keys: ClassVar = [("action", "discrete"), ("action", "parameters")]

    def __init__(self) -> None:
        super().__init__()
        # Directions of keys 0, 1 and 2 in degrees, y down, of boat 0 (incongruent, keymap=1) and boat 1 (congruent).
        degrees = torch.tensor([[-30.0, -150.0, 90.0], [150.0, -90.0, 30.0]])
        self.directions = torch.stack([degrees.deg2rad().cos(), degrees.deg2rad().sin()], -1)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write the key `[N]` and its duration, one for each key, `[N, 3]`."""
        to_goal = 120.0 * td["observation"][:, -2:]  # px
        distance_along = (self.directions[td["option"]] * to_goal.unsqueeze(1)).sum(-1)
        td["action", "discrete"] = distance_along.argmax(-1)
        # A press of d seconds moves a boat by about 62 d^3 px.
        td["action", "parameters"] = (distance_along.clamp(min=1.0) / 62.0) ** (1 / 3)
        return td


def choice_of_boat(seed: int) -> OptionChoiceEnv:
    """Return the choice of a boat as an environment in which `Sailor` plays a whole episode in one step."""
    return OptionChoiceEnv(Sailor(), BoatDockEnv(NUM_ENVS, seed=seed))


def train(env: EnvBase, num_batches: int) -> TensorDictModuleBase:
    """Train an option policy with PPO and return it."""
    num_options = env.full_action_spec["option"].n
    observation_dim = env.observation_spec_unbatched["observation"].shape[-1]
    logits = TensorDictModule(MLP(observation_dim, num_options, num_cells=[128, 128]), ["observation"], ["logits"])
    policy = ProbabilisticActor(
        logits,
        in_keys=["logits"],
        out_keys=["option"],
        distribution_class=torch.distributions.Categorical,
        return_log_prob=True,
        log_prob_key="option_log_prob",
    )
    critic = ValueOperator(MLP(observation_dim, 1, num_cells=[128, 128]), in_keys=["observation"])
    loss = ClipPPOLoss(policy, critic, entropy_coeff=0.01)
    loss.set_keys(action="option", sample_log_prob="option_log_prob")
    advantage = GAE(gamma=1.0, lmbda=1.0, value_network=critic, average_gae=True)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    collector = Collector(
        env,
        policy,
        frames_per_batch=EPISODES_PER_BATCH,
        total_frames=num_batches * EPISODES_PER_BATCH,
        auto_register_policy_transforms=False,
    )
    for batch in collector:
        for _ in range(EPOCHS):
            rows = advantage(batch).reshape(-1)
            for indices in torch.randperm(len(rows)).split(MINIBATCH_SIZE):
                losses = loss(rows[indices])
                optimizer.zero_grad()
                sum(losses[name] for name in ("loss_objective", "loss_critic", "loss_entropy")).backward()
                optimizer.step()
    collector.shutdown(close_env=False)
    return policy


def score(env: OptionChoiceEnv, option: int | None, policy: TensorDictModuleBase) -> float:
    """Return the mean score on fixed episodes with a fixed option or, if it is None, with the policy's choices."""
    env.set_seed(0)
    td = env.reset(env.fixed_episodes(0))
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        td = policy(td) if option is None else td.set("option", torch.full(td.shape, option))
    return env.results(env.step(td)["next"])["score"].mean().item()


def main(num_batches: int = 30) -> dict[str, float]:
    """Train a policy, then print and return the mean scores with each boat alone and with the learned choices."""
    torch.manual_seed(0)
    torch.set_num_threads(1)  # the networks are small
    policy = train(choice_of_boat(seed=1), num_batches)
    env = choice_of_boat(seed=0)
    scores = {name: score(env, option, policy) for option, name in enumerate(env.option_names)}
    scores["learned"] = score(env, None, policy)
    for name, value in scores.items():
        print(f"{name:<12} {value:.2f}")
    return scores


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
