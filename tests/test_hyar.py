"""HyAR: the codec, the correction of outdated latents, and learning a problem with a known optimum."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from hpamdp import keys
from hpamdp.policies.low_level.hyar import LATENT, HyAR
from hpamdp.specs import PAMDPSpecs

SPECS = PAMDPSpecs(4, (), (1, 2, 0), (0.0, -1.0, 5.0), (2.0, 1.0, 9.0))

OPTIONS = dict(
    embedding_dim=3, latent_dim=3, codec_hidden_dim=64, hidden_dims=[64, 64], warmup_frames=2000,
    codec_pretrain_updates=1500, codec_every=10, codec_lr=1e-3, kl_weight=1e-4, dynamics_weight=0.1,
    latent_coverage=0.96, correction_threshold=0.1,
    buffer_size=20_000, batch_size=128, updates_per_frame=0.25, gamma=0.9, tau=0.02, actor_lr=1e-3, critic_lr=1e-3,
    policy_delay=2, target_noise=0.1, target_noise_clip=0.2, exploration_noise=0.1, epsilon_final=0.05,
    epsilon_frames=3000,
)  # fmt: skip


def make(specs: PAMDPSpecs = SPECS, **changes) -> HyAR:
    return HyAR(specs, torch.device("cpu"), **{**OPTIONS, **changes})


def one_step_rows(learner: HyAR, num: int) -> TensorDict:
    """Act in a one-step problem: only action 1 is rewarded, the more the nearer its parameters are to (s0, -s1)."""
    td = TensorDict({keys.OBSERVATION: torch.rand(num, 4) * 2 - 1}, [num])
    td = learner.policy(td)
    unit = learner.specs.to_unit(td[keys.PARAMETERS])
    state, own = td[keys.OBSERVATION], unit * learner.codec.mask[td[keys.DISCRETE]]
    error = (unit[:, 1] - state[:, 0]).square() + (unit[:, 2] + state[:, 1]).square()
    td["next"] = {
        keys.OBSERVATION: state + own.sum(-1, keepdim=True) * torch.tensor([1.0, 0.5, 0.0, 0.0]),
        keys.REWARD: torch.where(td[keys.DISCRETE] == 1, 1.0 - error, -0.5).unsqueeze(-1),
        keys.TERMINATED: torch.ones(num, 1, dtype=torch.bool),
    }
    return td


def learn(learner: HyAR, num_batches: int, size: int = 200) -> dict[str, float]:
    for _ in range(num_batches):
        scalars = learner.learn(one_step_rows(learner, size), torch.ones(size, dtype=torch.bool))
    return scalars


@pytest.fixture(scope="module")
def trained() -> HyAR:
    torch.manual_seed(0)
    learner = make()
    learn(learner, 60)
    return learner


def test_decoding_an_encoded_action_returns_the_action(trained):
    rows = trained.buffer.sample(500)
    codec = trained.codec
    with torch.no_grad():
        mean, _ = codec.encode(rows["state"], rows["discrete"], rows["unit"])
        discrete = codec.nearest_discrete(codec.embeddings[rows["discrete"]])
        unit, _ = codec.decode(rows["state"], discrete, mean)
    assert torch.equal(discrete, rows["discrete"])
    error = ((unit - rows["unit"]) * codec.mask[rows["discrete"]]).abs()
    assert error.mean() < 0.05


def test_the_learner_finds_the_best_action_and_its_parameters(trained):
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        rows = one_step_rows(trained, 1000)
    assert (rows[keys.DISCRETE] == 1).float().mean() > 0.98
    assert rows["next", keys.REWARD].mean() > 0.85, "random actions earn about -0.4, the optimum 1"


def test_latents_that_still_decode_to_their_action_are_kept_and_a_shifted_codec_triggers_correction(trained):
    rows = trained.buffer.sample(1000)
    with torch.no_grad():
        mean, _ = trained.codec.encode(rows["state"], rows["discrete"], rows["unit"])
        rows["latent"] = torch.cat([trained.codec.embeddings[rows["discrete"]], trained.codec.z_to_unit(mean)], -1)
    _, is_corrected = trained.corrected_latent(rows)
    assert is_corrected.float().mean() < 0.1
    shifted = make()
    shifted.load_state_dict(trained.state_dict())
    with torch.no_grad():
        shifted.codec.table.copy_(shifted.codec.table.flip(0))
    latent, is_corrected = shifted.corrected_latent(rows)
    moved = rows["discrete"] != 1
    assert is_corrected[moved].all()
    assert torch.equal(shifted.codec.nearest_discrete(latent[:, :3]), rows["discrete"])


def test_a_random_action_is_encoded_when_sampled(trained):
    rows = trained.buffer.sample(1000)
    is_random = rows["latent"].isnan().any(-1)
    latent, is_corrected = trained.corrected_latent(rows)
    assert is_random.any() and is_corrected[is_random].all() and latent.isfinite().all()


def test_parameters_stay_in_bounds_and_the_greedy_policy_is_deterministic(trained):
    td = TensorDict({keys.OBSERVATION: torch.randn(500, 4) * 3}, [500])
    low, high = torch.tensor(SPECS.parameter_low), torch.tensor(SPECS.parameter_high)
    parameters = trained.policy(td.clone())[keys.PARAMETERS]
    assert (parameters >= low).all() and (parameters <= high).all()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        first, second = trained.policy(td.clone()), trained.policy(td.clone())
    assert torch.equal(first[keys.PARAMETERS], second[keys.PARAMETERS]) and not first[LATENT].isnan().any()


def test_the_state_change_is_scaled_by_its_standard_deviation(trained):
    change = trained.buffer[:]["next_state"] - trained.buffer[:]["state"]
    expected = change[: OPTIONS["warmup_frames"]].std(0).clamp(min=1e-2)
    torch.testing.assert_close(trained.codec.change_scale, expected)


def test_only_masked_transitions_are_stored():
    learner = make(warmup_frames=10_000)
    learner.learn(one_step_rows(learner, 100), torch.arange(100) < 30)
    assert learner.frames == 30 and len(learner.buffer) == 30


def test_targets_bootstrap_past_truncation_and_not_past_termination(trained):
    rows = trained.buffer.sample(64)
    rows["discount"] = torch.zeros(64)
    torch.testing.assert_close(trained._target(rows), rows["reward"])
    rows["discount"] = torch.full((64,), 0.9)
    assert (trained._target(rows) - rows["reward"]).abs().mean() > 0.05
