"""Train one library's learner on the keys, and score its greedy agent at steps and CPU seconds.

python experiments/peers_small/players.py PLAYER SEED FILE CPU_SECONDS STEPS [SETTING=VALUE]...
    appends the scores to a csv file. The first of both limits ends the training.
"""

from __future__ import annotations

import csv
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
import yaml

from experiments.own_problems.protocol import cpu_seconds
from experiments.peers_small.problem import HIGHS, DictKeys, FlatKeys, Keys, make, way

LIMITS = [60.0, 200_000.0]  # CPU seconds and steps
SPACING = 1000  # steps between two scores, later a tenth of the steps so far


class Clock:
    """Score the greedy agent. CPU seconds count from the start of the program, without the scores."""

    def __init__(
        self, player: str, seed: int, file: str, act: Callable[[np.ndarray], Sequence[Any]], make_env: Any = make
    ) -> None:
        self.name, self.file, self.act, self.make_env = {"player": player, "seed": seed}, Path(file), act, make_env
        self.left_out, self.due = 0.0, 0

    def after(self, steps: int) -> bool:
        """Score the agent if it is due. Return whether the training is over."""
        began = cpu_seconds()
        cpu_s = began - self.left_out
        is_over = cpu_s >= LIMITS[0] or steps >= LIMITS[1]
        if steps >= self.due or is_over:
            self.due = steps - steps % SPACING + max(SPACING, steps // 10)
            outside, Keys.outside = Keys.outside, 0
            scored = way(self.act, self.make_env)
            row = {**self.name, "steps": steps, "cpu_s": round(cpu_s, 1), "way": round(scored, 4), "outside": outside}
            row["outside_greedy"], Keys.outside = Keys.outside, 0
            print(row, flush=True)
            is_new = not self.file.exists()
            with self.file.open("a", newline="") as file:
                writer = csv.DictWriter(file, list(row), lineterminator="\n")
                if is_new:
                    writer.writeheader()
                writer.writerow(row)
            self.left_out += cpu_seconds() - began
        return is_over


def hpamdp(player: str, seed: int, file: str, settings: dict[str, Any]) -> None:
    """Train a learner of hpamdp with its defaults."""
    import hpamdp

    name = " ".join(["hpamdp", player, *(f"{key}={value}" for key, value in settings.items())])

    class Scorer(hpamdp.Callback):
        def on_start(self, trainer: Any) -> None:
            agent = hpamdp.Agent(trainer.config, trainer.parts.agent, trainer.parts.problem, {})

            def act(seen: np.ndarray) -> list[Any]:
                keys, durations = agent.act(seen)
                return [(key, each) for key, *each in zip(keys, *durations, strict=True)]

            self.clock = Clock(name, seed, file, act)

        def on_batch(self, trainer: Any) -> None:
            if self.clock.after(trainer.frames):
                trainer.stop("the time is over")

    hpamdp.train(make, low=player, seed=seed, progress=False, callbacks=[Scorer()], **{"eval.every": 0, **settings})


def torchrl(player: str, seed: int, file: str, settings: dict[str, Any]) -> None:
    """Train PPO as TorchRL's tutorial does, with a `CompositeDistribution` as in its example of composite actions."""
    from tensordict import TensorDict
    from tensordict.nn import CompositeDistribution, NormalParamExtractor, TensorDictModule, set_composite_lp_aggregate
    from torch import nn
    from torchrl.collectors import Collector
    from torchrl.data.replay_buffers import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
    from torchrl.envs import Compose, DoubleToFloat, GymWrapper, ObservationNorm, StepCounter, TransformedEnv
    from torchrl.envs.utils import ExplorationType, set_exploration_type
    from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE

    set_composite_lp_aggregate(False).set()
    torch.manual_seed(seed)
    transforms = Compose(ObservationNorm(in_keys=["observation"]), DoubleToFloat(), StepCounter())
    env = TransformedEnv(GymWrapper(DictKeys(), categorical_action_encoding=True), transforms)
    env.set_seed(seed)
    env.transform[0].init_stats(num_iter=1000, reduce_dim=0, cat_dim=0)

    def layers(num: int) -> list[nn.Module]:
        return [nn.LazyLinear(256), nn.Tanh(), nn.LazyLinear(256), nn.Tanh(), nn.LazyLinear(256), nn.Tanh(),
                nn.LazyLinear(num)]  # fmt: skip

    class Heads(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layers, self.extract = nn.Sequential(*layers(9)), NormalParamExtractor()

        def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, ...]:
            numbers = self.layers(observation)
            return numbers[..., :3], *self.extract(numbers[..., 3:])

    out = [("params", "key", "logits"), ("params", "durations", "loc"), ("params", "durations", "scale")]
    actor = ProbabilisticActor(
        TensorDictModule(Heads(), in_keys=["observation"], out_keys=out),
        spec=env.full_action_spec,
        in_keys=["params"],
        distribution_class=CompositeDistribution,
        distribution_kwargs={
            "distribution_map": {"key": torch.distributions.Categorical, "durations": TanhNormal},
            "extra_kwargs": {"durations": {"low": torch.zeros(3), "high": torch.tensor(HIGHS)}},
        },
        return_log_prob=True,
    )
    critic = ValueOperator(nn.Sequential(*layers(1)), in_keys=["observation"])
    actor(env.reset()), critic(env.reset())
    collector = Collector(env, actor, frames_per_batch=1000, total_frames=10**9, split_trajs=False)
    buffer = ReplayBuffer(storage=LazyTensorStorage(1000), sampler=SamplerWithoutReplacement())
    advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=True)
    loss = ClipPPOLoss(
        actor, critic, clip_epsilon=0.2, entropy_bonus=True, entropy_coeff=1e-4, critic_coeff=1.0,
        loss_critic_type="smooth_l1",
    )  # fmt: skip
    optimizer = torch.optim.Adam(loss.parameters(), float(settings.get("lr", 3e-4)))

    def act(seen: np.ndarray) -> list[dict[str, Any]]:
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            chosen = actor(env.transform[0](TensorDict(observation=torch.as_tensor(seen), batch_size=[len(seen)])))
        pairs = zip(chosen["key"].numpy(), chosen["durations"].numpy(), strict=True)
        return [{"key": key, "durations": durations} for key, durations in pairs]

    clock, steps = Clock("torchrl ppo", seed, file, act, DictKeys), 0
    for batch in collector:
        for _ in range(10):
            advantage(batch)
            buffer.extend(batch.reshape(-1))
            for _ in range(1000 // 64):
                losses = loss(buffer.sample(64))
                (losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]).backward()
                torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
                optimizer.step()
                optimizer.zero_grad()
        steps += batch.numel()
        if clock.after(steps):
            break
    collector.shutdown()


def sb3(player: str, seed: int, file: str, settings: dict[str, Any]) -> None:
    """Train PPO or SAC of Stable-Baselines3 with the defaults, on the flattened action."""
    import stable_baselines3
    from stable_baselines3.common.callbacks import BaseCallback

    model = getattr(stable_baselines3, player.upper())("MlpPolicy", FlatKeys(), seed=seed, device="cpu", **settings)
    clock = Clock(f"sb3 {player}", seed, file, lambda seen: model.predict(seen, deterministic=True)[0], FlatKeys)

    class Scorer(BaseCallback):
        def _on_step(self) -> bool:
            # PPO has updated the agent just before the first step of its next batch.
            return (player == "ppo" and self.num_timesteps % 2048 != 1) or not clock.after(self.num_timesteps)

    model.learn(10**9, callback=Scorer())


def xuance(player: str, seed: int, file: str, settings: dict[str, Any]) -> None:
    """Train XuanCe's P-DQN with its settings for Platform, whose environment has these spaces and returns."""
    from gymnasium.spaces import Discrete, Tuple
    from xuance.common import BaseCallback, get_arguments
    from xuance.torch.agents import REGISTRY_Agents

    class Env(gymnasium.Wrapper):
        num_envs, max_episode_steps = 1, 6
        observation_space = Tuple((Keys().observation_space, Discrete(201)))
        first_seed: int | None = seed

        def reset(self) -> Any:
            found = self.env.reset(seed=self.first_seed)
            self.first_seed = None
            return found

        def step(self, action: Any) -> Any:
            observation, reward, terminated, truncated, info = self.env.step(action)
            return (observation, self.env.unwrapped.time), reward, terminated or truncated, info

    config = get_arguments("pdqn", "Platform", "Platform-v0")
    config.seed = config.env_seed = seed
    config.device, config.parallels, config.logger = "cpu", 1, "tensorboard"
    agent = REGISTRY_Agents[config.agent](config, Env(make()))

    def act(seen: np.ndarray) -> list[Any]:
        with torch.no_grad():
            parameters = agent.policy.con_action(torch.as_tensor(seen))
            keys = agent.policy.Qeval(torch.as_tensor(seen), parameters).argmax(-1).tolist()
        durations = (parameters.numpy() + 1.0) / 2.0 * np.array(HIGHS)
        return [(key, each[:, None]) for key, each in zip(keys, durations, strict=True)]

    class Scorer(BaseCallback):
        clock = Clock("xuance pdqn", seed, file, act)

        def on_train_step_end(self, current_step: int, **_: Any) -> None:
            if self.clock.after(current_step):
                raise SystemExit

    agent.callback = Scorer()  # the constructor would take it for the observation space
    agent.train(10**9)


def ding(player: str, seed: int, file: str, settings: dict[str, Any]) -> None:
    """Train DI-engine's H-PPO with its settings for gym-hybrid. It is scored with draws; `greedy=true`: without."""
    from ding.config import compile_config
    from ding.envs import BaseEnv, BaseEnvTimestep, create_env_manager
    from ding.model import model_wrap
    from ding.policy import create_policy
    from ding.utils import set_pkg_seed
    from ding.worker import BaseLearner, create_serial_collector
    from dizoo.gym_hybrid.config.gym_hybrid_hppo_config import create_config, main_config
    from gymnasium.spaces import Box, Discrete, Tuple
    from tensorboardX import SummaryWriter

    def press(chosen: dict[str, Any]) -> dict[str, Any]:
        unit = (np.clip(np.asarray(chosen["action_args"]), -1.0, 1.0) + 1.0) / 2.0
        return {"key": int(chosen["action_type"]), "durations": unit * np.array(HIGHS)}

    class Env(BaseEnv):
        observation_space, reward_space = Box(-np.inf, np.inf, (3,)), Box(-np.inf, np.inf, (1,))
        action_space = Tuple((Discrete(3), Box(-1.0, 1.0, (3,))))
        __repr__, close = object.__repr__, gymnasium.Env.close

        def __init__(self, cfg: Any) -> None:
            self.env = DictKeys()

        def seed(self, seed: int, dynamic_seed: bool = True) -> None:
            self.env.reset(seed=seed)

        def reset(self) -> np.ndarray:
            self.total = 0.0
            return self.env.reset()[0]

        def step(self, action: dict[str, Any]) -> Any:
            observation, reward, terminated, truncated, _ = self.env.step(press(action))
            self.total += reward
            given = np.array([reward], np.float32), terminated or truncated, {"eval_episode_return": self.total}
            return BaseEnvTimestep(observation, *given)

    main_config.policy.model.update(obs_shape=3, action_shape={"action_type_shape": 3, "action_args_shape": 3})
    create_config.env.import_names, create_config.env_manager.type = [], "base"
    main_config.policy.cuda, create_config.policy.type = False, "ppo_command"
    cfg = compile_config(main_config, seed=seed, env=Env, auto=True, create_cfg=create_config, save_cfg=True)
    env = create_env_manager(cfg.env.manager, [lambda: Env(cfg.env)] * cfg.env.collector_env_num)
    env.seed(seed)
    set_pkg_seed(seed, use_cuda=False)
    policy = create_policy(cfg.policy, enable_field=["learn", "collect", "eval", "command"])
    given = {"tb_logger": SummaryWriter("log"), "exp_name": cfg.exp_name}
    learner = BaseLearner(cfg.policy.learn.learner, policy.learn_mode, **given)
    collector = create_serial_collector(cfg.policy.collect.collector, env=env, policy=policy.collect_mode, **given)
    if settings.get("greedy"):
        policy._eval_model = model_wrap(policy._model, wrapper_name="hybrid_deterministic_argmax_sample")

    def act(seen: np.ndarray) -> list[Any]:
        chosen = policy.eval_mode.forward(dict(enumerate(torch.as_tensor(seen))))
        return [press(chosen[number]["action"]) for number in range(len(seen))]

    clock = Clock(" ".join(["di-engine hppo", *settings]), seed, file, act, DictKeys)
    while not clock.after(collector.envstep):
        learner.train(collector.collect(train_iter=learner.train_iter), collector.envstep)


def rllib(player: str, seed: int, file: str, settings: dict[str, Any]) -> None:
    """Train RLlib's PPO with the defaults, on the `Tuple` of actions."""
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.utils.spaces.space_utils import unsquash_action
    from ray.tune.registry import register_env

    ray.init(num_cpus=1, include_dashboard=False)
    register_env("keys", lambda _: make())
    config = PPOConfig().environment("keys").env_runners(num_env_runners=0).debugging(seed=seed)
    algorithm = config.training(**settings).build_algo()
    module, space = algorithm.get_module(), (Keys().action_space[0], tuple(Keys().action_space[1]))

    def act(seen: np.ndarray) -> list[Any]:
        with torch.no_grad():
            inputs = module.forward_inference({"obs": torch.as_tensor(seen)})["action_dist_inputs"]
        keys, durations = module.get_inference_action_dist_cls().from_logits(inputs).to_deterministic().sample()
        pairs = zip(keys.numpy(), *(each.numpy() for each in durations), strict=True)
        return [unsquash_action((key, tuple(each)), space) for key, *each in pairs]

    clock, steps = Clock("rllib ppo", seed, file, act), 0
    while not clock.after(steps):
        steps = int(algorithm.train()["num_env_steps_sampled_lifetime"])


PLAYERS: dict[str, Callable[..., None]] = {
    "torchrl": torchrl, "hppo": hpamdp, "pdqn": hpamdp, "hsac": hpamdp, "ppo": sb3, "sac": sb3, "xuance": xuance,
    "ding": ding, "rllib": rllib,
}  # fmt: skip

if __name__ == "__main__":
    torch.set_num_threads(1)
    given_player, given_seed, given_file, most_seconds, most_steps, *given = sys.argv[1:]
    LIMITS[:] = float(most_seconds), float(most_steps)
    pairs = (each.split("=") for each in given)
    values = {key: yaml.safe_load(value) for key, value in pairs}
    with tempfile.TemporaryDirectory() as folder:  # for the files that libraries write
        given_file = os.path.abspath(given_file)
        os.chdir(folder)
        PLAYERS[given_player](given_player, int(given_seed), given_file, values)
