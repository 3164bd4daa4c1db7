"""Pictures go from the environment through replay and checkpoints to an encoder; nothing flattens them unasked."""

from __future__ import annotations

import signal
from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from tensordict import TensorDict
from test_resume import stop_and_resume
from torch import nn
from torch.nn import functional as F
from toy_pictures import Camera, Mixed, TwoOptions

import hpamdp
from hpamdp import keys
from hpamdp.config.errors import ConfigError
from hpamdp.env.base import ProblemError
from hpamdp.env.catch_point import picture
from hpamdp.env.catch_point.environment import CatchPointEnv
from hpamdp.env.decisions import with_decisions
from hpamdp.env.gymnasium.environment import GymnasiumEnv
from hpamdp.env.gymnasium.observation_spaces import ObservationSpace
from hpamdp.observation_entries import ObservationEntry, is_picture_shape, packed, unpacked
from hpamdp.policies.encoders.base import Encoder, JoinedEncoders
from hpamdp.policies.encoders.cnn import CNN
from hpamdp.policies.low_level.hppo import HPPO
from hpamdp.policies.low_level.hsac import HSAC
from hpamdp.policies.low_level.pdqn import PDQN
from hpamdp.policies.shared.perception import Perception
from hpamdp.settings import SettingError
from hpamdp.specs import PAMDPSpecs

CATCH = ["env=catch_point_picture", "high=none"]
TINY = ["encoder.channels=[4,4,4]", "encoder.num_features=8"]
SHORT = {
    "hppo": ["low.hidden_dims=[16]", "low.critic_hidden_dims=[16]", "low.epochs=2", "low.minibatch_size=16"],
    "pdqn": ["low.hidden_dims=[16]", "low.warmup_steps=32", "low.batch_size=16", "low.buffer_size=256"],
    "hsac": ["low.hidden_dims=[16]", "low.warmup_steps=32", "low.batch_size=16", "low.buffer_size=256"],
}
LEARNERS = {"hppo": HPPO, "pdqn": PDQN, "hsac": HSAC}


# What counts as a picture.


@pytest.mark.parametrize(
    ("shape", "picture_shape"),
    [
        ((64, 48), (1, 64, 48)),
        ((64, 48, 3), (3, 64, 48)),
        ((4, 84, 84), (4, 84, 84)),
        ((84, 84, 16), (16, 84, 84)),
        ((16, 16, 16), (16, 16, 16)),
        ((4, 64, 48, 3), (12, 64, 48)),
        ((4, 3, 64, 48), (12, 64, 48)),
    ],
)
def test_channels_are_found_by_the_shorter_of_the_outer_axes(shape, picture_shape):
    entry = ObservationEntry("x", 0, shape, is_picture=True)
    assert is_picture_shape(shape) and entry.picture_shape == picture_shape
    values = torch.arange(entry.size, dtype=torch.int32).reshape(1, *shape)
    expected = (values.movedim(-1, -3) if entry.has_channels_last else values).reshape(1, *picture_shape)
    assert torch.equal(entry.picture(values.flatten(1)), expected)


@pytest.mark.parametrize(
    ("space", "counts"),
    [
        (spaces.Box(0, 255, (16, 16), np.uint8), True),
        (spaces.Box(0, 255, (15, 16, 3), np.uint8), False),
        (spaces.Box(0, 255, (400,), np.uint8), False),
        (spaces.Box(0, 1, (16, 16), np.uint8), False),
        (spaces.Box(0, 255, (16, 16), np.int16), False),
        (spaces.Box(0.0, 255.0, (16, 16)), False),
    ],
)
def test_a_picture_is_a_uint8_box_of_0_to_255_with_16_px_a_side(space, counts):
    read = ObservationSpace(space)
    assert bool(read.entries()) == counts
    assert read.dim == (0 if counts else np.prod(space.shape))


@pytest.mark.parametrize("shape", [(40, 36, 3), (8, 40, 36), (2, 4, 40, 36, 3)])
def test_a_colour_picture_of_floats_is_refused_unless_it_is_flattened(shape):
    space = spaces.Box(0.0, 1.0, shape)
    with pytest.raises(
        SettingError, match=r"observation camera: .* must be uint8 from 0 to 255, .*; encoder=mlp reads"
    ):
        ObservationSpace(spaces.Dict(camera=space))
    assert ObservationSpace(space, flattens_pictures=True).dim == np.prod(shape)


# The way through Gymnasium environments.


def rollout(env, steps: int = 4) -> TensorDict:
    torch.manual_seed(0)
    return env.rollout(steps, break_when_any_done=False)


@pytest.mark.parametrize("num_workers", [0, 1])
def test_pictures_arrive_unchanged_as_uint8(num_workers, quick_workers):
    env = GymnasiumEnv(2, make=Camera, max_steps=5, seed=3, num_workers=num_workers)
    steps = rollout(env)
    env.close()
    assert steps[keys.OBSERVATION].dtype == steps["next", keys.OBSERVATION].dtype == torch.uint8
    pictures = steps["next", keys.OBSERVATION].reshape(2, 4, 36, 40, 3)
    offsets = steps[keys.OBSERVATION][:, 0, 0]
    for row in range(2):
        camera = Camera()
        camera.offset = int(offsets[row])
        for step in range(4):
            camera.steps = step + 1
            assert np.array_equal(pictures[row, step].numpy(), camera.picture())


def test_mixed_observations_hold_scaled_vectors_and_whole_pixels():
    env = GymnasiumEnv(2, make=Mixed, max_steps=5, seed=3)
    steps = rollout(env)
    specs = PAMDPSpecs.from_env(env)
    env.close()
    assert [entry.name for entry in specs.entries] == ["board", "gear", "speed", "camera"]
    assert [entry.is_picture for entry in specs.entries] == [False, False, False, True]
    assert specs.observation_dtype == steps[keys.OBSERVATION].dtype == torch.float32
    board, gear, speed, camera = (steps[keys.OBSERVATION][..., entry.place] for entry in specs.entries)
    torch.testing.assert_close(board, torch.full_like(board, -0.6))
    assert gear[0, 1].tolist() == [-1.0, 1.0, -1.0] and speed[0, 0].tolist() == [0.5, -0.25]
    single = Mixed()
    single.steps, single.offset = 0, int(camera[0, 0, 0])
    assert np.array_equal(camera[0, 0].numpy(), single.picture().transpose(2, 0, 1).ravel().astype(np.float32))


def test_running_statistics_skip_pictures():
    env = GymnasiumEnv(2, make=Mixed, max_steps=5, observation_scaling="running")
    rollout(env)
    assert env.statistics()["observation_mean"].shape == (16 + 3 + 2,)
    env.close()


def test_a_scaled_picture_is_refused_even_if_all_its_pixels_are_whole():
    class Scaled(Camera):
        def observation(self):
            return (self.picture() // 255).astype(np.float32)

    env = GymnasiumEnv(1, make=Scaled, max_steps=5)
    with pytest.raises(ProblemError, match="has pixels from 0 to 1, but its space has 0 to 255; give the picture unsc"):
        env.reset()


def test_flattened_pictures_are_scaled_numbers_as_any_others():
    env = GymnasiumEnv(2, make=Mixed, max_steps=5, seed=3, flatten_pictures=True)
    steps = rollout(env)
    specs = PAMDPSpecs.from_env(env)
    env.close()
    assert not specs.entries and steps[keys.OBSERVATION].dtype == torch.float32
    assert steps[keys.OBSERVATION].abs().max() <= 1.0 and specs.observation_dim == 16 + 3 + 2 + 36 * 40 * 3


# Storage.


def test_packed_observations_come_back_to_the_last_bit_at_a_quarter_of_the_size():
    entries = (
        ObservationEntry("a", 0, (3,)),
        ObservationEntry("b", 3, (16, 17), is_picture=True),
        ObservationEntry("c", 275, (2,)),
    )
    observation = torch.randn(5, 277)
    observation[:, 3:275] = torch.randint(0, 256, (5, 272)).float()
    stored = packed(observation, entries)
    assert stored.dtype == torch.uint8 and stored.shape == (5, 272 + 4 * 5)
    assert torch.equal(unpacked(stored, entries), observation)
    assert torch.equal(unpacked(stored[:1], entries), observation[:1])


@pytest.mark.parametrize("make", [Camera, Mixed])
def test_replay_holds_bytes_and_samples_what_was_stored(make):
    env = GymnasiumEnv(2, make=make, max_steps=5)
    batch, specs = with_decisions(env).rollout(5, break_when_any_done=False), PAMDPSpecs.from_env(env)
    specs = replace(specs, encoder=tiny)
    learner = PDQN(specs, hidden_dims=(16,), warmup_steps=0, batch_size=4, buffer_size=64)
    mask = torch.ones(batch.shape, dtype=torch.bool)
    learner.store(batch, mask)
    stored = learner.buffer[:]["state"]
    assert stored.dtype == torch.uint8 and stored.shape[-1] <= specs.observation_dim + 3 * 21
    sample = next(learner.sample_batches(1))
    everything = batch[keys.OBSERVATION].reshape(-1, specs.observation_dim)
    assert sample["state"].dtype == everything.dtype
    assert all((everything == state).all(-1).any() for state in sample["state"])
    env.close()


def tiny(entry: ObservationEntry) -> CNN:
    return CNN(entry, channels=(4, 4, 4), num_features=8)


# Encoders.


def test_a_vector_has_no_encoder_and_passes_as_it_is():
    specs = PAMDPSpecs.from_env(CatchPointEnv())
    perception = Perception(specs)
    observation = torch.randn(3, 4)
    assert perception.is_plain and perception(observation) is observation and perception.specs is specs
    assert not list(perception.parameters())


def test_pictures_go_through_a_cnn_and_vectors_beside_them_as_they_are():
    env = GymnasiumEnv(3, make=Mixed, max_steps=5)
    specs = PAMDPSpecs.from_env(env)
    encoder = JoinedEncoders(specs)
    observation = env.reset()[keys.OBSERVATION]
    features = encoder(observation)
    assert features.shape == (3, 16 + 3 + 2 + 512) and encoder.feature_specs.observation_dim == features.shape[-1]
    assert torch.equal(features[:, :21], observation[:, :21])
    (cnn,) = encoder.encoders.values()
    pixels = observation[:, specs.entries[-1].place].reshape(3, 3, 36, 40) / 255.0
    torch.testing.assert_close(features[:, 21:], cnn(pixels))
    env.close()


def test_a_shared_learners_option_stays_at_the_end_of_the_features():
    specs = replace(PAMDPSpecs.from_env(CatchPointEnv(observation="picture")), option_names=("a", "b"), encoder=tiny)
    shared = specs.with_option_observed()
    assert shared.observation_dtype == torch.float32
    observation = torch.cat([torch.zeros(2, specs.observation_dim), torch.eye(2)], -1)
    assert torch.equal(Perception(shared)(observation)[:, -2:], torch.eye(2))


@pytest.mark.parametrize(
    ("settings", "shape", "num_features"),
    [
        ({}, (3, 64, 64), 512),
        ({"net": "impala"}, (3, 64, 64), 256),
        ({}, (20, 16), 256),
        ({"channels": (2, 3, 4), "num_features": 7}, (40, 50, 1), 7),
    ],
)
def test_the_cnn_has_the_papers_sizes_unless_others_are_set(settings, shape, num_features):
    entry = ObservationEntry("camera", 0, shape, is_picture=True)
    encoder = CNN(entry, **settings)
    assert encoder.num_features == num_features
    assert encoder(torch.rand(2, *entry.picture_shape)).shape == (2, num_features)
    first = next(layer for layer in encoder.modules() if isinstance(layer, nn.Conv2d))
    is_nature = settings.get("net") != "impala" and min(entry.picture_shape[1:]) >= 36
    assert (first.kernel_size, first.stride) == (((8, 8), (4, 4)) if is_nature else ((3, 3), (1, 1)))


def test_a_picture_too_small_for_nature_is_refused_in_one_line():
    with pytest.raises(SettingError, match="at least 36 px a side, but camera has 20 x 16; use net=impala"):
        CNN(ObservationEntry("camera", 0, (20, 16), is_picture=True), net="nature")


FEW_STEPS = {"progress": False, "total_frames": 64, "num_envs": 4, "steps_per_batch": 8}
FEW_STEPS |= {"eval.layouts": 2, "env.max_steps": 5}


class Means(Encoder):
    """Mean colours of 4 x 4 areas, then a linear layer."""

    def __init__(self, entry: ObservationEntry, *, num_features: int = 5) -> None:
        super().__init__(entry)
        self.num_features = num_features
        self.linear = nn.Linear(16 * entry.picture_shape[0], num_features)

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return self.linear(F.adaptive_avg_pool2d(values, 4).flatten(1))


def test_ones_own_encoder_is_trained_with_its_settings():
    agent = hpamdp.train(
        Camera,
        low={"name": "hppo", "minibatch_size": 16, "epochs": 2},
        encoder={"name": Means, "num_features": 3},
        **FEW_STEPS,
    )
    (encoder,) = agent.policy.policies[0].perception.encoder.encoders.values()
    assert isinstance(encoder, Means) and encoder.linear.out_features == 3
    fresh = Means(encoder.entry, num_features=3)
    assert encoder.linear.bias.shape == fresh.linear.bias.shape


# Learners.


@pytest.mark.parametrize("name", list(LEARNERS))
def test_the_encoder_is_trained_by_every_learner_that_takes_pictures(name):
    env = GymnasiumEnv(8, make=Mixed, max_steps=5)
    specs = replace(PAMDPSpecs.from_env(env), encoder=tiny)
    settings = {"minibatch_size": 16, "epochs": 1} if name == "hppo" else {"warmup_steps": 8, "batch_size": 16}
    learner = LEARNERS[name](specs, hidden_dims=(16,), **settings)
    before = [weight.clone() for weight in learner.perception.parameters()]
    batch = with_decisions(env).rollout(8, learner.policy, break_when_any_done=False, auto_reset=True)
    learner.learn(batch, torch.ones(batch.shape, dtype=torch.bool))
    after = list(learner.perception.parameters())
    assert before and any(not torch.equal(one, other) for one, other in zip(before, after, strict=True))
    env.close()


@pytest.mark.parametrize("name", ["pdqn", "hsac"])
def test_the_actors_loss_does_not_train_the_encoder(name):
    specs = replace(PAMDPSpecs.from_env(CatchPointEnv(observation="picture")), encoder=tiny)
    learner = LEARNERS[name](specs, hidden_dims=(16,), batch_size=4)
    sample = TensorDict({"state": torch.randint(0, 256, (4, specs.observation_dim), dtype=torch.uint8)}, [4])
    assert not learner.detached(sample).requires_grad and learner.features(sample).requires_grad


# Runs.


def test_a_picture_of_a_gymnasium_environment_is_refused_after_it_is_built():
    with pytest.raises(ConfigError, match="low=pets: env=gymnasium observes pictures"):
        hpamdp.train(Camera, low="pets", progress=False, total_frames=64, **{"env.max_steps": 5})


@pytest.mark.parametrize("low", ["pdqn", *(pytest.param(low, marks=pytest.mark.slow) for low in ("hppo", "hsac"))])
def test_a_run_with_pictures_resumes_to_the_last_bit(low, tmp_path):
    small = ["num_envs=4", "steps_per_batch=4", "total_frames=160", "eval.layouts=2", "eval.every=0", "log_every=32"]
    stop_and_resume([*CATCH, f"low={low}", *SHORT[low], *TINY, *small], tmp_path, signal.SIGINT)


@pytest.mark.parametrize("high", ["actor", "meta_critic"])
def test_learned_selectors_see_pictures(high):
    settings = {"actor": {"minibatch_size": 4}, "meta_critic": {"warmup_decisions": 4, "batch_size": 4}}[high]
    agent = hpamdp.train(
        TwoOptions,
        high={"name": high, **settings},
        low={"name": "hppo", "minibatch_size": 8},
        encoder={"name": "cnn", "channels": [4, 4, 4], "num_features": 8},
        **{**FEW_STEPS, "total_frames": 160},
    )
    assert not agent._agent.without_update()


def test_an_agent_acts_on_pictures_in_gymnasiums_form():
    words = {"total_frames": 64, "num_envs": 4, "steps_per_batch": 8, "eval.layouts": 2}
    low = {"name": "hppo", "minibatch_size": 16}
    agent = hpamdp.train("catch_point_picture", high="none", low=low, progress=False, **words)
    env = hpamdp.make_gymnasium("catch_point", observation="picture")
    assert agent.observation_space == env.observation_space == spaces.Box(0, 255, (3, 64, 64), np.uint8)
    observation, _ = env.reset(seed=1)
    discrete, parameters = agent.act(observation)
    assert env.action_space.contains((discrete, parameters))
    batch = agent.act(np.stack([observation] * 3))
    assert batch[0].tolist() == [discrete] * 3
    with pytest.raises(ValueError, match="pixels of the observation must be whole numbers from 0 to 255"):
        agent.act(observation + 0.5)
    with pytest.raises(ConfigError, match="export: HPPO cannot be exported: it observes pictures"):
        agent.export("agent.onnx")


# Catch Point's own picture.


def drawn(vectors: torch.Tensor, **settings) -> torch.Tensor:
    return CatchPointEnv(len(vectors), observation="picture", **settings).shown(vectors)


def test_the_picture_is_drawn_from_the_vector_of_the_same_state():
    for settings in ({}, {"progress": True}, {"catches": 3, "max_steps": 40}):
        vector, seen = (CatchPointEnv(16, seed=3, observation=kind, **settings) for kind in ("vector", "picture"))
        a, b = vector.reset(), seen.reset()
        torch.manual_seed(0)
        for _ in range(12):
            assert torch.equal(b[keys.OBSERVATION], seen.shown(a[keys.OBSERVATION]))
            action = vector.rand_action(a.clone())[keys.ACTION]
            (_, a), (_, b) = (
                env.step_and_maybe_reset(td.set(keys.ACTION, action.clone())) for env, td in ((vector, a), (seen, b))
            )


@pytest.mark.parametrize(
    ("entry", "step", "settings"),
    [
        *((entry, 0.01, {}) for entry in range(4)),
        (4, 1.0 / 6.0, {"progress": True}),
        (5, 1.0 / 12.0, {"progress": True}),
    ],
)
def test_a_small_change_of_each_entry_changes_the_picture(entry, step, settings):
    torch.manual_seed(0)
    num = 256
    low, high = CatchPointEnv(progress=True).observation_bounds
    vectors = torch.tensor(low) + torch.rand(num, 6) * (torch.tensor(high) - torch.tensor(low))
    vectors[:, 4] = torch.randint(0, 10, (num,)) / 6.0 - 1.0
    vectors[:, 5] = torch.randint(0, 24, (num,)) / 12.0 - 1.0
    changed = vectors.clone()
    changed[:, entry] += step
    dim = 6 if settings else 4
    before, after = (drawn(each[:, :dim], **settings) for each in (vectors, changed))
    assert (before != after).any(-1).all()


def test_the_parts_of_the_picture_lie_where_the_vector_says():
    image = drawn(torch.tensor([[0.4, 0.0, 0.0, 1.28]])).reshape(3, 64, 64)
    red, green, blue = image
    rows, columns = (red == 255).nonzero(as_tuple=True)
    assert abs(rows.float().mean() + 0.5 - 16.0) < 0.1 and abs(columns.float().mean() + 0.5 - 32.0) < 0.1
    assert green[32, 32] == 255 and green[16, 32] == 0
    assert (blue[31, 32:41] == 255).all() and blue[31, 44:].max() == 0 and blue[31, :30].max() == 0


def test_symmetries_and_geometry_are_of_vectors_alone():
    assert CatchPointEnv().symmetries is not None and CatchPointEnv(observation="picture").symmetries is None
    assert CatchPointEnv(observation="picture").geometry is None


def test_the_registered_environment_shows_the_picture():
    check_env(hpamdp.make_gymnasium("catch_point", observation="picture").unwrapped, skip_render_check=True)
    many = hpamdp.make_gymnasium("catch_point", num_envs=2, observation="picture")
    observations, _ = many.reset(seed=1)
    assert observations.shape == (2, *picture.SHAPE) and observations.dtype == np.uint8
    one = hpamdp.make_gymnasium("catch_point", observation="picture")
    assert np.array_equal(one.reset(seed=1)[0], observations[0])
