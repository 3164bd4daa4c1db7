"""Train a policy over options with plain TorchRL: nothing of hpamdp but its environments.

Which boat should sail from here to there? A boat's three keys push it in three fixed directions, and each boat has
others. How to sail either boat is settled here, by `Sailor`, a few lines of geometry. That leaves one decision an
episode, the boat, and `ControllerChoiceEnv` makes of it an ordinary environment with one discrete action, `option`, so
that TorchRL's own PPO learns it like any other.

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
from hpamdp.env.choice import OptionChoiceEnv

NUM_BOATS = 256  # that sail side by side
EPISODES_PER_BATCH, EPOCHS, MINIBATCH = 1024, 4, 64


class Sailor(TensorDictModuleBase):
    """Press the key that points best to the goal, just long enough to come to rest beside it."""

    in_keys: ClassVar = ["observation", "option"]
    out_keys: ClassVar = [("action", "discrete"), ("action", "parameters")]

    def __init__(self) -> None:
        super().__init__()
        # Degrees of keys 0, 1, 2, y down: of boat 0 (incongruent, with env.keymap=1) and boat 1 (congruent).
        degrees = torch.tensor([[-30.0, -150.0, 90.0], [150.0, -90.0, 30.0]])
        self.directions = torch.stack([degrees.deg2rad().cos(), degrees.deg2rad().sin()], -1)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write key `[N]` and durations `[N, 3]`."""
        way = 120.0 * td["observation"][:, -2:]  # px
        ahead = (self.directions[td["option"]] * way.unsqueeze(1)).sum(-1)
        td["action", "discrete"] = ahead.argmax(-1)
        # A press of d seconds carries a boat about 62 d^3 px.
        td["action", "parameters"] = (ahead.clamp(min=1.0) / 62.0) ** (1 / 3)
        return td


def boats(seed: int) -> OptionChoiceEnv:
    """Return the choice of a boat as an environment: one step is one whole episode, sailed by `Sailor`."""
    return OptionChoiceEnv(Sailor(), BoatDockEnv(NUM_BOATS, seed=seed))


def train(env: EnvBase, num_batches: int) -> TensorDictModuleBase:
    """Return an option policy trained by PPO."""
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
    frames = dict(frames_per_batch=EPISODES_PER_BATCH, total_frames=num_batches * EPISODES_PER_BATCH)
    collector = Collector(env, policy, **frames, auto_register_policy_transforms=False)
    for batch in collector:
        for _ in range(EPOCHS):
            rows = advantage(batch).reshape(-1)
            for indices in torch.randperm(len(rows)).split(MINIBATCH):
                losses = loss(rows[indices])
                optimizer.zero_grad()
                sum(losses[name] for name in ("loss_objective", "loss_critic", "loss_entropy")).backward()
                optimizer.step()
    collector.shutdown(close_env=False)
    return policy


def score(env: OptionChoiceEnv, option: int | None, policy: TensorDictModuleBase) -> float:
    """Return the mean score over the same episodes, with one option everywhere or, if None, with the policy's."""
    env.set_seed(0)
    td = env.reset(env.fixed_episodes(0))
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        td = policy(td) if option is None else td.set("option", torch.full(td.shape, option))
    return env.results(env.step(td)["next"])["score"].mean().item()


def main(num_batches: int = 30) -> dict[str, float]:
    """Train, print the score with each boat alone and with the policy's choices, and return the scores."""
    torch.manual_seed(0)
    torch.set_num_threads(1)  # the networks are small
    policy, env = train(boats(seed=1), num_batches), boats(seed=0)
    choices = {**dict(zip(env.option_names, (0, 1), strict=True)), "learned": None}
    scores = {name: score(env, option, policy) for name, option in choices.items()}
    for name, value in scores.items():
        print(f"{name:<12} {value:.2f}")
    return scores


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
