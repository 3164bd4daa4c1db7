"""Threads act one at a time, as TorchRL has one exploration type for all of them."""

from __future__ import annotations

import threading
from collections import Counter

from torchrl.envs.utils import ExplorationType, exploration_type
from toy_environments import Toy

import hpamdp
from hpamdp.acting import acting

STEPS = Counter()


class Recorder(Toy):
    """Counts the steps that are taken with each exploration type."""

    def step(self, action):
        STEPS[exploration_type()] += 1
        return super().step(action)


def steps_of_a_training() -> Counter:
    STEPS.clear()
    options = {"num_envs": 4, "steps_per_batch": 16, "eval.layouts": 2, "env.max_steps": 5, "progress": False}
    hpamdp.train(Recorder, low="hppo", total_frames=256, **options, **{"low.minibatch_size": 64})
    return Counter(STEPS)


def test_the_block_of_a_thread_waits_until_that_of_another_has_ended():
    before, seen, is_inside, starts = exploration_type(), [], threading.Event(), threading.Event()

    def explore() -> None:
        starts.set()
        with acting(ExplorationType.RANDOM):
            is_inside.set()
            seen.append(exploration_type())

    thread = threading.Thread(target=explore)
    with acting(ExplorationType.DETERMINISTIC):
        thread.start()
        assert starts.wait(5.0) and not is_inside.wait(0.1)
        assert exploration_type() == ExplorationType.DETERMINISTIC
    thread.join()
    assert seen == [ExplorationType.RANDOM] and exploration_type() == before


def test_a_training_explores_while_another_thread_acts_greedily():
    agent, env = hpamdp.load("hppo_platform"), hpamdp.make_gymnasium("platform")
    observation, _ = env.reset(seed=0)
    alone, before, steps = steps_of_a_training(), exploration_type(), []
    thread = threading.Thread(target=lambda: steps.append(steps_of_a_training()))
    thread.start()
    while thread.is_alive():
        agent.act(observation)
        agent.reset()
        thread.join(0.005)
    assert steps == [alone] and alone[ExplorationType.RANDOM] == 256
    assert exploration_type() == before
