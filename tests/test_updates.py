"""Updates: what a step of an optimizer changes, and updates that are compiled."""

import copy
import shutil
from functools import partial

import pytest
import test_hppo
import test_hsac
import test_hyar
import test_paddpg
import test_pdqn
import torch
from conftest import make_config
from torch import Tensor, nn
from torch._dynamo import config as dynamo_config
from torch.utils._python_dispatch import TorchDispatchMode
from toy_steps import SPECS, one_step_rows, sample

from hpamdp.config.errors import ConfigError
from hpamdp.env.platform.environment import PlatformEnv
from hpamdp.policies.base import added_later
from hpamdp.policies.low_level.dlpa.learner import DLPA
from hpamdp.policies.low_level.hyar import LATENT, HyAR
from hpamdp.policies.low_level.iql import IQL
from hpamdp.policies.low_level.paddpg import SCORES
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.policies.low_level.pets.model import MemberNet
from hpamdp.policies.shared.gradients import gradients_of
from hpamdp.policies.shared.networks import EnsembleMLP, HybridCritics, InitialLayer, mlp
from hpamdp.policies.shared.options import ReplayOptions
from hpamdp.policies.shared.replay import ReplayLearner
from hpamdp.run.assemble import assemble
from hpamdp.specs import PAMDPSpecs

# Neither draws random numbers in a loss: compiled code draws others.
MAKE = {
    "pdqn": partial(test_pdqn.make, target_smoothing=0.0),
    "hyar": partial(test_hyar.make, target_smoothing=0.0, relabelling="mean"),
    "paddpg": partial(test_paddpg.make, max_grad_norm=None),
}
LR = {
    "pdqn": test_pdqn.OPTIONS["critic_lr"],
    "hyar": test_hyar.OPTIONS["critic_lr"],
    "paddpg": test_paddpg.OPTIONS["critic_lr"],
}


class TransposedLearner(ReplayLearner):
    """Has one weight, which it uses transposed: so its gradient comes transposed, too."""

    Options = ReplayOptions

    def __init__(self) -> None:
        super().__init__(SPECS, warmup_steps=0, buffer_size=10, batch_size=2)

    def make_networks(self, specs) -> None:
        self.weight = nn.Parameter(torch.randn(3, 5))

    def make_optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"weight": torch.optim.Adam([self.weight], lr=0.1, fused=True)}

    def loss(self, x: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        loss = (x @ self.weight.T).square().sum()
        return loss, {"loss": loss}


def batch_for(name: str) -> dict[str, Tensor]:
    """Return a random sample; half of HyAR's actions were random, and have no latent action."""
    batch = sample(64)
    if name == "paddpg":
        batch[SCORES] = torch.rand(64, SPECS.num_discrete) * 2 - 1
    if name == "hyar":
        latent = torch.rand(64, MAKE[name]().critics.net.layers[0].weight.shape[1] - SPECS.observation_dim) * 2 - 1
        batch[LATENT] = torch.where(torch.arange(64).unsqueeze(-1) % 2 == 0, latent, torch.nan)
    return batch


def test_a_step_is_that_of_plain_adam_however_the_gradient_lies_in_memory():
    torch.manual_seed(0)
    learner = TransposedLearner()
    weight = learner.weight.detach().clone().requires_grad_()
    plain = torch.optim.Adam([weight], lr=0.1, fused=False)
    for _ in range(3):
        x = torch.randn(4, 5)
        (x @ weight.T).square().sum().backward()
        plain.step()
        plain.zero_grad()
        learner.gradient_step("weight", learner.loss, x)
    torch.testing.assert_close(learner.weight, weight)


@pytest.mark.parametrize("name", MAKE)
def test_the_critics_step_is_that_of_plain_adam_after_a_backward_pass(name):
    torch.manual_seed(0)
    learner, batch = MAKE[name](), batch_for(name)
    learner.updates.fill_(2)  # the actor learns as well, HyAR's codec does not
    reference = copy.deepcopy(learner)
    plain = torch.optim.Adam(reference.critics.parameters(), lr=LR[name], fused=False)
    reference.critic_loss(batch)[0].backward()
    plain.step()
    learner.update_once(batch)
    for new, expected in zip(learner.critics.parameters(), reference.critics.parameters(), strict=True):
        torch.testing.assert_close(new, expected)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("name", MAKE)
def test_compiled_updates_are_the_same_up_to_rounding(name):
    torch.manual_seed(0)
    learner = MAKE[name]()
    learner.updates.fill_(2)  # the actor learns as well, HyAR's codec does not
    compiled = copy.deepcopy(learner)
    compiled.compile_updates()
    for _ in range(2):
        batch = batch_for(name)
        scalars, expected = compiled.update_once(batch), learner.update_once(batch)
        assert list(scalars) == list(expected)
    for key, value in learner.actor.state_dict().items():
        torch.testing.assert_close(compiled.actor.state_dict()[key], value, rtol=1e-3, atol=1e-4)
    for key, value in learner.critics.state_dict().items():
        torch.testing.assert_close(compiled.critics.state_dict()[key], value, rtol=1e-3, atol=1e-4)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
@pytest.mark.parametrize(("name", "settings"), [("pdqn", {}), ("hyar", {}), ("hyar", {"discrete": "nearest"})])
def test_compiled_updates_may_search(name, settings):
    torch.manual_seed(0)
    learner = MAKE[name](search_samples=4, search_weight=1e3, **settings)
    learner.updates.fill_(2)
    before = copy.deepcopy(learner.actor.state_dict())
    learner.compile_updates()
    learner.lower_precision()
    learner.update_once(batch_for(name))
    assert all(not after.equal(before[key]) for key, after in learner.actor.state_dict().items() if "net" in key)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")
def test_compiled_updates_of_hppo_are_the_same_up_to_rounding_for_batches_of_any_size():
    learner = test_hppo.make(minibatch_size=32)
    compiled = copy.deepcopy(learner)
    compiled.compile_updates()
    for num in (20, 27, 34):
        batch = test_hppo.random_rows(learner, num, steps=4)
        with torch.random.fork_rng():
            expected = learner.learn(batch, test_hppo.everything(batch))
        scalars = compiled.learn(batch, test_hppo.everything(batch))
        assert scalars == pytest.approx(expected, rel=1e-2, abs=1e-3)
    for key, value in learner.actor.state_dict().items():
        torch.testing.assert_close(compiled.actor.state_dict()[key], value, rtol=1e-2, atol=1e-3)


@dynamo_config.patch(trace_autograd_ops=True)
def test_clipped_gradients_can_be_traced_without_a_compiler():
    torch.manual_seed(0)
    layers = torch.nn.ModuleList([torch.nn.Linear(3, 1, dtype=torch.float32) for _ in range(3)])
    seen, limits = torch.randn(8, 3, dtype=torch.float32), (0.01, ((0, 1, 4, 5), (2, 3)))

    def loss_of(seen: torch.Tensor) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:  # the last layer has no part
        return (layers[0](seen) * layers[1](seen)).square().mean(), {}

    traced = torch.compile(gradients_of, backend="eager", fullgraph=True)
    parameters = list(layers.parameters())
    found, expected = (each(loss_of, parameters, seen, limits=limits)[1] for each in (traced, gradients_of))
    torch.testing.assert_close(found[:4], expected[:4])
    assert found[4:] == expected[4:] == (None, None)


class Dtypes(TorchDispatchMode):
    """Notes the types of the inputs of matrix products made under it, each with the smallest sizes of the products."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: dict[torch.dtype, set[int]] = {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func in (torch.ops.aten.mm.default, torch.ops.aten.addmm.default, torch.ops.aten.bmm.default):
            smallest = min(*args[-2].shape[-2:], *args[-1].shape[-2:])
            self.seen.setdefault(args[-1].dtype, set()).add(smallest)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("name", MAKE)
def test_updates_in_bfloat16_make_the_products_of_hidden_layers_in_it_and_have_nearly_the_same_gradients(name):
    torch.manual_seed(0)
    learner, batch = MAKE[name](), batch_for(name)
    parameters = list(learner.critics.parameters())
    both = []
    for _ in range(2):
        with Dtypes() as products:
            _, gradients = gradients_of(learner.critic_loss, parameters, batch, precision=learner.descent.precision)
        both.append(torch.cat([gradient.flatten() for gradient in gradients]))
        learner.lower_precision()
    assert products.seen.keys() == {torch.bfloat16, torch.float32}
    assert max(products.seen[torch.bfloat16]) == 64, "the hidden layers have 64 units"
    assert max(products.seen[torch.float32]) < 16, "the last layers have fewer outputs"
    assert all(gradient.dtype == torch.float32 for gradient in both)
    assert torch.cosine_similarity(*both, dim=0) > 0.99


@pytest.mark.parametrize("is_pausing", [False, True])
def test_in_bfloat16_the_ratios_before_any_update_are_1_at_the_final_scale(is_pausing):
    learner = test_hppo.make(epochs=1, minibatch_size=64, hidden_dims=[64, 64])
    learner.lower_precision()
    with torch.no_grad():
        learner.actor.parameter_head.weight.normal_(0.0, 0.3)  # means differ from state to state, as after training
        learner.actor.parameter_head.bias[SPECS.num_parameters :] = -12.0
    learner.actor.set_min_scale(0.01)
    batch = test_hppo.random_rows(learner, 64, 4)
    everything = torch.ones(batch.shape, dtype=torch.bool)
    seen = []
    learner.surrogate = lambda log_ratio, advantage: seen.append(log_ratio.detach().exp()) or log_ratio * advantage
    if is_pausing:  # rows that wait for others
        learner.options = learner.options.model_copy(update={"minibatch_size": 300})
        learner.learn(batch[:32], everything[:32])
        learner.options = learner.options.model_copy(update={"minibatch_size": 64})
        learner.learn(batch[32:], everything[32:])
    else:
        learner.learn(batch, everything)
    for ratio in seen[:2]:  # the discrete action's and the parameters', in the first minibatch
        torch.testing.assert_close(ratio, torch.ones_like(ratio), atol=1e-3, rtol=0.0)


@pytest.mark.parametrize("name", ["mlp", "one value", "pdqn", "multipass", "hppo", "pets"])
def test_in_bfloat16_values_near_50_are_as_fine_as_in_float32(name):
    torch.manual_seed(0)
    critics = partial(HybridCritics, SPECS, 2)
    net, last = {
        "mlp": lambda: ((net := mlp(4, [128, 128], 3)), net[-1]),
        "one value": lambda: ((net := EnsembleMLP(2, 4, [128, 128], 1)), net.layers[-1]),
        "pdqn": lambda: ((net := critics([128, 128], is_multipass=False)), net.net.layers[-1]),
        "multipass": lambda: ((net := critics([128, 128], is_multipass=True)), net.net.layers[-1]),
        "hppo": lambda: ((net := test_hppo.make().critic), net[-1]),
        "pets": lambda: ((net := MemberNet(2, 4, [128, 128], 3)), net.layers[-1]),
    }[name]()
    with torch.no_grad():
        last.bias.fill_(50.0)
        inputs = (torch.rand(2, 500, 4) if name == "pets" else torch.rand(500, 4),)
        inputs += (torch.rand(500, 3),) if isinstance(net, HybridCritics) else ()
        exact = net(*inputs)
        with torch.autocast("cpu", torch.bfloat16):
            lower = net(*inputs)
    assert lower.dtype == torch.float32
    assert (lower - exact).abs().max() < 0.01
    assert len(lower.unique()) > 400, "bfloat16 has steps of 0.25 there"


def test_schedules_start_again_in_a_learner_that_takes_over_networks():
    small = dict(hidden_dims=(8,), batch_size=4, buffer_size=100)

    def taken_over(cls, **settings):
        old, new = cls(SPECS, **settings), cls(SPECS, **settings)
        for name, buffer in old.named_buffers():
            if name.rpartition(".")[2] in ("frames", "updates", "episodes", "actor_updates"):
                buffer.fill_(5000)
        old.on_progress(5000)
        new.load_networks(old.state_dict())
        new.on_progress(0)
        return new

    learner = taken_over(PDQN, epsilon_episodes=100, **small)
    assert learner.episodes == 0 and learner.policy.epsilon == 1.0
    learner = taken_over(HyAR, noise_initial=1.0, noise_episodes=100, parameter_noise=0.1, **small)
    assert learner.policy.noise == 1.0
    learner = taken_over(IQL, actor_lr_updates=1000, **small)
    assert learner.actor_updates == 0 and learner.updates == 5000


@pytest.mark.parametrize("warmup_steps", [0, 5])
def test_a_learner_starts_once_with_or_without_a_warm_up(warmup_steps):
    started = []

    class Started(PDQN):
        def start(self):
            started.append(len(self.buffer))

    learner = Started(SPECS, hidden_dims=(8,), batch_size=4, warmup_steps=warmup_steps, updates_per_step=0.25)
    for _ in range(4):
        batch = one_step_rows(learner, 4)
        learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))
    assert started == ([8] if warmup_steps else [4])


def test_networks_of_earlier_versions_are_taken_over_without_what_was_added_later():
    old, new = test_hppo.make(), test_hppo.make()
    later = added_later(old)
    assert later
    new.load_networks({key: value for key, value in old.state_dict().items() if key not in later})
    assert added_later(new) <= new.state_dict().keys()


def test_plans_in_bfloat16_tell_rewards_near_50_apart():
    torch.manual_seed(0)
    learner = DLPA(SPECS, planning_precision="bfloat16")
    with torch.no_grad():
        learner.model.outcome.net.layers[-1].bias[..., :2] = 50.0
        learner.model.outcome.net.layers[-1].bias[..., 2] = -20.0  # no step terminates
    planner = learner.policy.planner
    state, discrete = torch.rand(20, 4), torch.randint(3, (20, 30, 1))
    unit = torch.rand(20, 30, 1, 3) * 2 - 1
    with torch.no_grad():
        lower = planner.returns(state, discrete, unit)
        planner.precision = torch.float32
        exact = planner.returns(state, discrete, unit)
    assert (lower - exact).abs().max() < 0.01
    assert (lower.argmax(1) == exact.argmax(1)).float().mean() >= 0.9


def test_in_bfloat16_initial_parameters_are_as_fine_as_in_float32():
    layer = InitialLayer(PAMDPSpecs.from_env(PlatformEnv(1)), "domain", is_squashed=True)
    states = torch.rand(500, 9)
    with torch.autocast("cpu", torch.bfloat16):
        lower = layer(states)
    torch.testing.assert_close(lower, layer(states), rtol=0.0, atol=0.0)


@pytest.mark.parametrize("name", ["pdqn", "hyar", "hsac"])
def test_in_bfloat16_parameters_near_a_bound_still_have_a_gradient(name):
    # tanh of 4 is 1 in bfloat16, where its gradient is 0.
    torch.manual_seed(0)
    learner = test_hsac.make() if name == "hsac" else MAKE[name]()
    last = learner.actor.net[-1]
    with torch.no_grad():
        last.weight.zero_()
        last.bias.fill_(4.0)
    unit_of = {
        "pdqn": lambda state: learner.actor(state),
        "hyar": lambda state: learner.actor(state)[..., -learner.codec.latent_dim :],
        "hsac": lambda state: learner.actor(state).sample_squashed()[0],
    }
    if name == "hsac":
        learner.actor.log_max_scale = learner.actor.log_min_scale  # hardly any noise
    with torch.autocast("cpu", torch.bfloat16):
        unit = unit_of[name](sample(64)["state"])
    gradient = torch.autograd.grad(unit.sum(), last.bias)[0]
    first = SPECS.num_discrete if name == "hsac" else 0  # the logits come before the means
    assert gradient[first : first + SPECS.num_parameters].min() > 0.0


SMALL = ["num_envs=4", "steps_per_batch=4", "total_frames=20000", "eval.layouts=4"]


def test_a_missing_compiler_is_told_in_one_line(monkeypatch):
    from torch._inductor import cpp_builder
    from torch._inductor.exc import InvalidCxxCompiler

    def missing() -> str:
        raise InvalidCxxCompiler

    monkeypatch.setattr(cpp_builder, "get_cpp_compiler", missing)
    with pytest.raises(ConfigError, match=r"^compile_updates=true: low=pdqn: there is no C\+\+ compiler; install"):
        assemble(make_config([*SMALL, "env=platform", "high=none", "low=pdqn", "compile_updates=true"]))
