"""A program in which float64 is the default dtype trains the same: the package names the dtype of every tensor."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from conftest import CONF, OF_EACH_KIND, buildable, choices, make_config
from tensordict import TensorDict
from test_masks import CASES, make_learner, play_and_learn
from toy_masks import Forbidden

import hpamdp
from hpamdp import keys
from hpamdp.env.decisions import with_decisions
from hpamdp.policies.agent import HierarchicalAgent
from hpamdp.policies.low_level.random import Random
from hpamdp.specs import PAMDPSpecs

# What torch, its layers and TorchRL's specs make in the default dtype, unless they are told another.
IN_DEFAULT_DTYPE = {
    "torch": {"zeros", "ones", "empty", "rand", "randn", "linspace", "logspace", "eye", "normal"},
    "nn": {"Linear", "LayerNorm", "Embedding", "GRU", "LSTM", "Bilinear", "Conv2d"},
    "": {"Bounded", "Unbounded"},
}
# One at a time: reset, then two steps of the uniformly random agent.
ENVS = {name: [] for name in choices("env")} | {
    "gymnasium": ["env.entry_point=toy_environments:Toy", "env.max_steps=6"],
    "boatdock": ["env.controller=choose"],
    "rooms": [],
}


@contextmanager
def default_dtype(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


def assert_same_with_float64(function: Callable[[], dict[str, Any]]) -> None:
    """Call a function with either default dtype and compare the tensors that it returns to the last bit."""
    with default_dtype(torch.float32):
        expected = function()
    with default_dtype(torch.float64):
        given = function()
    assert expected.keys() == given.keys() and expected
    for name, tensor in expected.items():
        if torch.is_tensor(tensor):
            torch.testing.assert_close(
                given[name], tensor, rtol=0, atol=0, equal_nan=True, msg=lambda m, n=name: f"{n}: {m}"
            )


def test_the_package_names_the_dtype_of_every_tensor_it_makes():
    package = CONF.parent / "hpamdp"
    unnamed = []
    for file in sorted(package.rglob("*.py")):
        assert "set_default_dtype" not in file.read_text(), "other threads share it"
        for node in ast.walk(ast.parse(file.read_text())):
            if not isinstance(node, ast.Call):
                continue
            module = node.func.value.id if _is_of_module(node.func) else ""
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            is_plain = module or isinstance(node.func, ast.Name)
            if is_plain and name in IN_DEFAULT_DTYPE.get(module, ()) and "dtype" not in {k.arg for k in node.keywords}:
                unnamed.append(f"{file.relative_to(package)}:{node.lineno} {name}")
    assert not unnamed


def _is_of_module(function: ast.expr) -> bool:
    return isinstance(function, ast.Attribute) and isinstance(function.value, ast.Name)


@pytest.mark.parametrize("env", buildable(ENVS))
def test_an_environment_is_the_same_with_float64_as_the_default_dtype(env):
    def steps() -> dict[str, Any]:
        torch.manual_seed(0)
        config = make_config([f"env={env}", "high=uniform", "low=random", *ENVS[env]])
        problem = config.env.build(num_envs=3, device=torch.device("cpu"), seed=0)
        tracked = with_decisions(problem)
        policy = Random(PAMDPSpecs.from_env(tracked)).policy

        def act(td: TensorDict) -> TensorDict:
            chosen = {keys.OPTION: torch.zeros(3, dtype=torch.int64)} if problem.has_choice else {}
            return policy(td.update(chosen))

        seen = tracked.rollout(2, act, break_when_any_done=False)
        return {str(key): value for key, value in seen.items(True, True)} | problem.describe()

    assert_same_with_float64(steps)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in OF_EACH_KIND else [pytest.mark.slow])
        for name in CASES
        if name != "random"  # it learns nothing
    ],
)
def test_a_learner_learns_the_same_with_float64_as_the_default_dtype(name):
    def learned() -> dict[str, Any]:
        env = with_decisions(Forbidden(8), 1.0)
        specs = PAMDPSpecs.from_env(env)
        learner = make_learner(name, specs)
        play_and_learn(env, HierarchicalAgent(None, [learner], specs), 2)
        return dict(learner.state_dict())

    assert_same_with_float64(learned)


def test_training_and_loading_give_the_same_numbers_with_float64_as_the_default_dtype_and_leave_it(tmp_path):
    settings = {"grouping": "default", "max_steps": 5, "low.minibatch_size": 16, "eval.layouts": 4, "eval.every": 0}
    file = tmp_path / "agent.zip"

    def trained() -> dict[str, Any]:
        before = torch.get_default_dtype()
        sizes = {"num_envs": 4, "steps_per_batch": 8, "total_frames": 64}
        agent = hpamdp.train("platform", high="ucb", low="hppo", progress=False, **sizes, **settings)
        agent.save(file)
        loaded = hpamdp.load(file)
        returns = loaded.evaluate(episodes=5, per_episode=True)["return"]
        hpamdp.make("platform").reset()
        assert torch.get_default_dtype() == before
        return {**agent.policy.state_dict(), "returns": torch.from_numpy(returns)}

    assert_same_with_float64(trained)
