"""Train one library's PPO for some steps, and append speed, memory and the final score to a csv file.

python experiments/speed_peers/players.py PLAYER PROBLEM WIDTH EPOCHS BATCHES SEED FILE [SETTING=VALUE]...

PLAYER is hpamdp, rejax, sb3, sbx or rlox, run by a Python in which that library is installed. The settings are those
of `hpamdp.train`. All seconds are CPU seconds of the process and its children.
"""

from __future__ import annotations

import csv
import os
import resource
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

# Copies and steps of each copy in a batch.
SIZES = {"cartpole": (128, 128), "boats": (1024, 8)}
MINIBATCH = 2048
WARM = 2  # batches before the steady state; the first ones compile
REPEATS = 5
EPISODES = 200  # of the evaluation at the end
LR, LR_FINAL = 1e-3, 1e-4  # a constant rate, or the ends of hpamdp's line


def cpu() -> float:
    """Return the CPU seconds of this process and its ended children so far."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


class Meter:
    """The CPU seconds at the end of each batch.

    Attributes:
        imported: CPU seconds at the end of the imports.
    """

    def __init__(self) -> None:
        self.marks: list[tuple[int, float]] = []
        self.imported = 0.0

    def mark(self, steps: int) -> None:
        """Note the end of a batch."""
        self.marks.append((steps, cpu()))

    def rows(self) -> list[dict[str, Any]]:
        """Return the columns of each repeat, a fifth of the steady state."""
        (first, began), (last, ended) = self.marks[0], self.marks[-1]
        seconds = (ended - began) / (last - first)
        of_run = {
            "import_s": round(self.imported, 2),
            # From the end of the imports to the first step of the steady state, without the batches before it.
            "compile_s": round(began - self.imported - first * seconds, 2),
            "peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024),
        }
        places = [round(part * (len(self.marks) - 1) / REPEATS) for part in range(REPEATS + 1)]
        rows = []
        for repeat, (before, after) in enumerate(pairwise(self.marks[place] for place in places)):
            speed = (after[0] - before[0]) / (after[1] - before[1])
            rows.append({"repeat": repeat, "steps_per_s": round(speed), **of_run})
        return rows


def hpamdp(problem: str, width: int, epochs: int, batches: int, seed: int, meter: Meter, given: dict) -> Callable:
    """Train H-PPO. It anneals its learning rate; the other players keep theirs."""
    import torch

    import hpamdp

    torch.set_num_threads(1)
    envs, horizon = SIZES[problem]
    of_problem: Any = "boatdock"
    if problem == "cartpole":
        from experiments.speed_peers.cartpole import CartPoleEnv

        of_problem = CartPoleEnv
    else:
        given = {"env.controller": "congruent", **given}
    meter.imported = cpu()

    class Marks(hpamdp.Callback):
        def on_batch(self, trainer: Any) -> None:
            if trainer.frames >= WARM * envs * horizon:
                meter.mark(trainer.frames)

    settings = {
        "num_envs": envs, "steps_per_batch": horizon, "total_frames": batches * envs * horizon, "eval.every": 0,
        "eval.layouts": 10, "film": False, "low.minibatch_size": MINIBATCH, "low.epochs": epochs, "low.lr": LR,
        "low.lr_final": LR_FINAL, "low.hidden_dims": [width] * 2, "low.critic_hidden_dims": [width] * 2,
        "compile_updates": True, **given,
    }  # fmt: skip
    agent = hpamdp.train(
        of_problem, high=None, low="hppo", seed=seed, threads=1, progress=False, callbacks=[Marks()], **settings
    )
    return lambda: agent.evaluate(episodes=EPISODES)["score"]


def rejax(problem: str, width: int, epochs: int, batches: int, seed: int, meter: Meter, given: dict) -> Callable:
    """Train rejax's PPO, compiled as a whole. With rewards as they are, its clipped values learn CartPole badly."""
    import jax
    import rejax

    envs, horizon = SIZES[problem]
    problem_of: Any = "CartPole-v1"
    algorithm = rejax.PPO
    if problem == "boats":
        from experiments.speed_peers.boats_rejax import Boat, HybridPPO

        problem_of, algorithm = Boat(), HybridPPO
    meter.imported = cpu()
    steps = batches * envs * horizon
    player = algorithm.create(
        env=problem_of, num_envs=envs, num_steps=horizon, num_minibatches=envs * horizon // MINIBATCH,
        num_epochs=epochs, learning_rate=LR, max_grad_norm=0.5, normalize_rewards=True, total_timesteps=steps,
        eval_freq=steps, skip_initial_evaluation=True,
        agent_kwargs={"activation": "relu", "hidden_layer_sizes": (width, width)},
    )  # fmt: skip
    without = player.replace(eval_callback=lambda *_: ())
    train = jax.jit(without.train).lower(jax.random.PRNGKey(seed)).compile()
    meter.mark(0)
    for repeat in range(REPEATS):
        state, _ = jax.block_until_ready(train(jax.random.PRNGKey(REPEATS * seed + repeat)))
        meter.mark((repeat + 1) * int(state.global_step))

    def score() -> float:
        from rejax.evaluate import evaluate

        env = Boat(scores=True) if problem == "boats" else player.env
        act, params = player.make_act(state), player.env_params
        _, returns = evaluate(act, jax.random.PRNGKey(7), env, params, EPISODES, params.max_steps_in_episode)
        return float(returns.mean())

    return score


def sb3(problem: str, width: int, epochs: int, batches: int, seed: int, meter: Meter, given: dict) -> Callable:
    """Train PPO of Stable-Baselines3, or of SBX, which computes its updates with JAX."""
    import gymnasium  # noqa: F401
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    if given.pop("library", "sb3") == "sbx":
        import flax.linen as nn
        from sbx import PPO

        activation: Any = nn.relu
    else:
        import torch
        from stable_baselines3 import PPO

        torch.set_num_threads(1)
        activation = torch.nn.ReLU
    meter.imported = cpu()
    envs, horizon = SIZES[problem]

    class Marks(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_start(self) -> None:  # the batches before are learned from
            if self.num_timesteps >= WARM * envs * horizon:
                meter.mark(self.num_timesteps)

    model = PPO(
        "MlpPolicy", make_vec_env("CartPole-v1", envs, seed=seed), n_steps=horizon, batch_size=MINIBATCH,
        n_epochs=epochs, learning_rate=LR, seed=seed,
        policy_kwargs={"net_arch": {"pi": [width] * 2, "vf": [width] * 2}, "activation_fn": activation},
    )  # fmt: skip
    model.learn((batches + 1) * envs * horizon, callback=Marks())
    env = make_vec_env("CartPole-v1", 20, seed=seed + 1000)
    return lambda: float(evaluate_policy(model, env, n_eval_episodes=EPISODES)[0])


def sbx(*arguments: Any) -> Callable:
    """Train SBX's PPO."""
    arguments[-1]["library"] = "sbx"
    return sb3(*arguments)


def rlox(problem: str, width: int, epochs: int, batches: int, seed: int, meter: Meter, given: dict) -> Callable:
    """Train rlox's PPO in its own CartPole, written in Rust. Its layers have tanh."""
    import gymnasium
    import torch
    from rlox.algorithms.ppo import PPO
    from rlox.callbacks import Callback
    from rlox.policies import DiscretePolicy

    torch.set_num_threads(1)
    torch.manual_seed(seed)
    meter.imported = cpu()
    envs, horizon = SIZES[problem]

    class Marks(Callback):
        num = 0

        def on_step(self, **_: Any) -> bool:
            self.num += 1
            if self.num >= WARM:
                meter.mark(self.num * envs * horizon)
            return True

    model = PPO(
        "CartPole-v1", envs, seed, DiscretePolicy(4, 2, hidden=width), callbacks=[Marks()], n_steps=horizon,
        batch_size=MINIBATCH, n_epochs=epochs, learning_rate=LR, clip_vloss=False, anneal_lr=False,
    )  # fmt: skip
    model.train(batches * envs * horizon)

    def score() -> float:
        env, total = gymnasium.make("CartPole-v1"), 0.0
        for episode in range(20):
            seen, is_over = env.reset(seed=1000 + episode)[0], False
            while not is_over:
                seen, reward, terminated, truncated, _ = env.step(int(model.predict(seen)))
                total, is_over = total + reward, terminated or truncated
        return total / 20

    return score


PLAYERS: dict[str, Callable[..., Callable]] = {"hpamdp": hpamdp, "rejax": rejax, "sb3": sb3, "sbx": sbx, "rlox": rlox}


def main(player: str, problem: str, width: int, epochs: int, batches: int, seed: int, file: Path, words: list) -> None:
    """Train, measure, score."""
    given = dict(word.split("=") for word in words)
    values = {key: value == "true" if value in ("true", "false") else value for key, value in given.items()}
    if problem == "boats" and player not in ("hpamdp", "rejax"):
        raise SystemExit(f"{player}: boats are written for hpamdp and rejax alone")
    meter = Meter()
    score = PLAYERS[player](problem, width, epochs, batches, seed, meter, values)
    envs, horizon = SIZES[problem]
    of_run = {
        "player": " ".join([player, *words]), "problem": problem, "width": width, "epochs": epochs, "seed": seed,
        "steps": batches * envs * horizon,
    }  # fmt: skip
    rows = meter.rows()
    last = {"score": round(score(), 3)}
    is_new = not file.exists()
    with file.open("a", newline="") as out:
        writer = csv.DictWriter(out, [*of_run, *rows[0], *last], lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerows({**of_run, **row, **last} for row in rows)
    print(*of_run.values(), *rows[REPEATS // 2].values(), *last.values())


if __name__ == "__main__":
    of_player, of_problem, *numbers, name = sys.argv[1:8]
    main(of_player, of_problem, *map(int, numbers), Path(name), sys.argv[8:])
