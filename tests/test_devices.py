"""Nothing is made on the CPU unasked: on the `meta` device a mixture of devices is an error, as it is on a GPU.

Tensors there have no values. A question for one is answered with 1 or True, and one for places with all places.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import test_hsac
import test_hyar
import test_paddpg
import test_pdqn
import torch
from conftest import CONF, choices, make_config
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch.fx.experimental import _config
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.envs.utils import ExplorationType, set_exploration_type
from toy_steps import SPECS, sample

from hpamdp import keys
from hpamdp.config.components import component
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.policies.low_level.hyar import LATENT
from hpamdp.policies.low_level.paddpg import SCORES
from hpamdp.policies.shared.gradients import gradients_of
from hpamdp.run.assemble import make_agent
from hpamdp.specs import PAMDPSpecs

META = torch.device("meta")


class Answers(TorchDispatchMode):
    """Says 1, or True, where a program asks for the value of a `meta` tensor."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func is torch.ops.aten._local_scalar_dense.default and args[0].is_meta:
            return True if args[0].dtype == torch.bool else 1
        return func(*args, **(kwargs or {}))


def agent_of(**names: str):
    """Return an agent for boats that is built on the CPU and moved, since fused optimizers refuse the device.

    Its levels are read from their yaml files alone: composing takes longer than the rest.
    """
    specs = PAMDPSpecs.from_env(BoatDockEnv(1))
    files = {group: OmegaConf.load(CONF / group / f"{name}.yaml") for group, name in names.items()}
    given = OmegaConf.to_container(OmegaConf.create({**files, "total_frames": 1000}), resolve=True)
    levels = {group: component(group, name, given[group]) for group, name in names.items()}
    config = replace(make_config(["high=uniform", "low=random"]), **levels)
    return make_agent(config, specs, torch.device("cpu")).to(META), specs


@pytest.fixture(autouse=True)
def everywhere():
    """Let `nonzero` find every place."""
    with _config.patch(meta_nonzero_assume_all_nonzero=True):
        yield


def observed(specs: PAMDPSpecs) -> TensorDict:
    flags = {name: torch.ones(5, 1, dtype=torch.bool, device=META) for name in (keys.IS_DECISION, keys.DONE)}
    seen = {keys.OBSERVATION: torch.zeros(5, specs.observation_dim, device=META), **flags}
    return TensorDict(seen, [5], device=META)


# DLPA's plans use autocast, which knows no such device.
@pytest.mark.parametrize("low", sorted({*choices("low")} - {"planner", "dlpa"}))
def test_policies_stay_on_their_device(low):
    agent, specs = agent_of(low=low)
    for mode in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        with Answers(), set_exploration_type(mode):
            acted = agent.learners[0].policy(observed(specs))
        assert acted[keys.DISCRETE].device == acted[keys.PARAMETERS].device == META


@pytest.mark.parametrize("high", sorted({*choices("high")} - {"none", "oracle", "human", "value"}))
def test_selectors_stay_on_their_device(high):
    agent, specs = agent_of(high=high)
    for mode in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        with Answers(), set_exploration_type(mode):
            assert agent.selector(observed(specs))[keys.OPTION].device == META


def on_meta(values: TensorDict) -> TensorDict:
    return values.apply(lambda tensor: torch.empty_like(tensor, device=META), device=META)


REPLAY = {
    "pdqn": partial(test_pdqn.make, search_samples=2, preactivation_penalty=0.1),
    "pdqn published": partial(test_pdqn.make, multipass=False, bounding="inverting_gradients"),
    "hyar": partial(test_hyar.make, search_samples=2, preactivation_penalty=0.1, relabelling="sample"),
    "hyar nearest": partial(test_hyar.make, search_samples=2, discrete="nearest"),
    "paddpg": test_paddpg.make,
    "hsac": test_hsac.make,
}


@pytest.mark.parametrize("name", REPLAY)
def test_losses_and_their_gradients_stay_on_their_device(name):
    learner = REPLAY[name]().to(META)
    rows = sample(8)
    if name == "paddpg":
        rows[SCORES] = torch.rand(8, SPECS.num_discrete)
    if name.startswith("hyar"):
        rows[LATENT] = torch.rand(8, test_hyar.OPTIONS["embedding_dim"] + test_hyar.OPTIONS["latent_dim"])
    rows = on_meta(rows)
    losses = {"critics": (learner.critic_loss, rows), "actor": (learner.actor_loss, rows["state"], None)}
    for part, (loss_of, *inputs) in losses.items():
        with Answers():
            _, gradients = gradients_of(loss_of, list(getattr(learner, part).parameters()), *inputs)
        assert {gradient.device for gradient in gradients if gradient is not None} == {META}
