"""Boats and H-PPO in JAX: the rules as a gymnax environment, and rejax's PPO with a hybrid head.

The rules are those of `hpamdp.env.boatdock` with the congruent controller and without noise: `physics.press`,
`harbour.sample_layout` and the scaled observation. A test of `study.py` compares them with the kernel.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces
from rejax import PPO
from rejax.networks import MLP, VNetwork

from hpamdp.env.boatdock.task import (
    DOCK_RADIUS,
    DOCKING_SPEED,
    DRY,
    FAILURE_REWARD,
    GLIDE,
    HARBOUR_RADIUS,
    LAYOUT_RADIUS,
    LAYOUT_TRIES,
    MAX_DURATION,
    MAX_PRESSES,
    MIN_SEPARATION,
    NUM_KEYS,
    SPEED_SCALE,
    SUCCESS_REWARD,
    TANK,
    speed,
)

DIRECTIONS = jnp.array([[-math.sqrt(3.0) / 2.0, 0.5], [0.0, -1.0], [math.sqrt(3.0) / 2.0, 0.5]], jnp.float32)


@struct.dataclass
class BoatState(environment.EnvState):
    start: jax.Array
    goal: jax.Array
    position: jax.Array
    velocity: jax.Array
    fuel: jax.Array
    is_over: jax.Array


@struct.dataclass
class BoatParams(environment.EnvParams):
    max_steps_in_episode: int = MAX_PRESSES


def pressed_distance(duration):
    """Return the distance covered while the key is down."""
    return duration**3 * ((100.0 / 3.0) - (5.0 / 3.0) * duration)


def duration_for(distance):
    """Return the seconds of pressing that cover a distance."""
    distance = jnp.maximum(distance, 0.0)
    root = jnp.cbrt((3.0 / 100.0) * distance + 1e-12)
    duration = root * (1.0 + root / 60.0)
    for _ in range(3):
        duration = duration - (pressed_distance(duration) - distance) / speed(duration)
    return jnp.maximum(duration, 0.0)


class Boat(environment.Environment[BoatState, BoatParams]):
    """One boat. An action is a key and the raw duration of each key, in [-1, 1] within the bounds.

    With `scores` an episode's return is its score instead of its reward.
    """

    def __init__(self, *, scores: bool = False) -> None:
        super().__init__()
        self.scores = scores

    @property
    def default_params(self) -> BoatParams:
        """Return the parameters."""
        return BoatParams()

    def reset_env(self, key, params):
        """Return a layout: start and goal in the disc, not too near."""
        *tries, turn_key = jax.random.split(key, LAYOUT_TRIES + 1)
        start, goal, turn = 0.5, 0.25, math.pi
        for number, each in enumerate(reversed(tries)):
            drawn = jax.random.uniform(each, (3,))
            angle = 2.0 * math.pi * drawn[2]
            squared = drawn[0] + drawn[1] - 2.0 * jnp.sqrt(drawn[0] * drawn[1]) * jnp.cos(angle)
            is_near = squared < (MIN_SEPARATION / LAYOUT_RADIUS) ** 2
            start = jnp.where(is_near & (number > 0), start, drawn[0])
            goal, turn = jnp.where(is_near, goal, drawn[1]), jnp.where(is_near, turn, angle)
        angle = 2.0 * math.pi * jax.random.uniform(turn_key)
        start, goal = (
            LAYOUT_RADIUS * jnp.sqrt(squared) * jnp.stack([jnp.cos(at), jnp.sin(at)])
            for squared, at in ((start, angle), (goal, angle + turn))
        )
        state = BoatState(0, start, goal, start, jnp.zeros(2), jnp.float32(TANK), jnp.bool_(False))
        return self.get_obs(state), state

    def step_env(self, key, state, action, params):
        """Press a key."""
        pressed_key, raw = action
        duration = (jnp.clip(raw[pressed_key], -1.0, 1.0) + 1.0) * (MAX_DURATION / 2.0)
        direction = DIRECTIONS[pressed_key]
        duration = jnp.minimum(duration, state.fuel)
        pressed = pressed_distance(duration)
        total = (1.0 + GLIDE) * pressed
        to_goal = state.goal - state.position
        ahead = to_goal @ direction
        aside = to_goal[0] * direction[1] - to_goal[1] * direction[0]
        half_chord_squared = DOCK_RADIUS**2 - aside * aside
        entry = jnp.maximum(ahead - jnp.sqrt(jnp.maximum(half_chord_squared, 0.0)), 0.0)
        to_dock = jnp.where((half_chord_squared >= 0.0) & (ahead > 0.0), entry, jnp.inf)
        outward = state.position @ direction
        aside = state.position[0] * direction[1] - state.position[1] * direction[0]
        to_harbour = jnp.maximum(jnp.sqrt(jnp.maximum(HARBOUR_RADIUS**2 - aside * aside, 0.0)) - outward, 0.0)
        docks = (to_dock <= total) & (to_dock <= to_harbour)
        leaves = (to_harbour < total) & ~docks
        travelled = jnp.where(docks, to_dock, jnp.where(leaves, to_harbour, total))
        in_glide = travelled > pressed
        virtual = jnp.minimum(duration_for(jnp.where(in_glide, (total - travelled) / GLIDE, travelled)), duration)
        burnt = jnp.where(in_glide, duration, virtual)
        left = state.fuel - burnt
        left = jnp.where(left > DRY, left, 0.0)
        is_success = docks & (speed(virtual) <= DOCKING_SPEED)
        has_failed = (docks | leaves | (left <= 0.0)) & ~is_success
        after = BoatState(
            state.time + 1,
            state.start,
            state.goal,
            state.position + travelled * direction,
            speed(burnt) * direction,
            left,
            is_success | has_failed,
        )
        final = jnp.where(is_success, SUCCESS_REWARD * left / TANK, jnp.where(has_failed, FAILURE_REWARD, 0.0))
        done = self.is_terminal(after, params)
        if self.scores:
            reward = jnp.where(done & ~is_success, FAILURE_REWARD, final)
        else:
            progress = jnp.linalg.norm(to_goal) - jnp.linalg.norm(state.goal - after.position)
            reward = final + progress / jnp.linalg.norm(state.goal - state.start)
        return self.get_obs(after), after, reward, done, {}

    def is_terminal(self, state, params):
        """Return whether the episode is over, also by its time limit."""
        return state.is_over | (state.time >= params.max_steps_in_episode)

    def get_obs(self, state, params=None, key=None):
        """Return the 16 scaled entries."""
        to_goal = state.goal - state.position
        distance = jnp.linalg.norm(to_goal)
        at_start = jnp.maximum(jnp.linalg.norm(state.goal - state.start), DOCK_RADIUS)
        return jnp.concatenate(
            [
                state.start / HARBOUR_RADIUS,
                state.goal / HARBOUR_RADIUS,
                jnp.array([0.0, 0.0, 1.0, 1.0]),
                state.position / HARBOUR_RADIUS,
                state.velocity / SPEED_SCALE,
                jnp.stack([state.fuel / TANK, distance / at_start]),
                to_goal / HARBOUR_RADIUS,
            ]
        )

    def action_space(self, params=None):
        """Return the space of the keys. rejax clips no actions then."""
        return spaces.Discrete(NUM_KEYS)

    def observation_space(self, params):
        """Return the space of observations."""
        return spaces.Box(-jnp.inf, jnp.inf, (16,))


class HybridPolicy(nn.Module):
    """A categorical over the keys and a Gaussian for their durations on shared hidden layers."""

    hidden_layer_sizes: tuple[int, ...]
    activation: object

    def setup(self):
        """Make the layers."""
        small = nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")
        self.features = MLP(self.hidden_layer_sizes, self.activation)
        self.keys = nn.Dense(NUM_KEYS, kernel_init=small)
        self.means = nn.Dense(NUM_KEYS, kernel_init=small)
        self.scales = nn.Dense(NUM_KEYS, kernel_init=small)

    def heads(self, obs):
        """Return log-probabilities of the keys, and means and log-scales of the durations."""
        features = self.features(obs)
        low, high = math.log(0.06), 0.0
        log_scale = low + (high - low) * nn.sigmoid(self.scales(features) + 1.12)  # 0.5 at first
        return nn.log_softmax(self.keys(features)), self.means(features), log_scale

    def __call__(self, obs, rng):
        """Return a sample and its log-probabilities."""
        return self.action_log_prob(obs, rng)

    def action_log_prob(self, obs, rng):
        """Return a sampled action and the log-probabilities of key and duration, `[N, 2]`."""
        log_probs, mean, log_scale = self.heads(obs)
        rng_key, rng_raw = jax.random.split(rng)
        key = jax.random.categorical(rng_key, log_probs)
        raw = mean + jnp.exp(log_scale) * jax.random.normal(rng_raw, mean.shape)
        return (key, raw), of_action(log_probs, mean, log_scale, key, raw)

    def log_prob_entropy(self, obs, action):
        """Return the log-probabilities of an action, `[N, 2]`, and the entropy of the key."""
        log_probs, mean, log_scale = self.heads(obs)
        entropy = -(jnp.exp(log_probs) * log_probs).sum(-1)
        return of_action(log_probs, mean, log_scale, *action), entropy

    def greedy(self, obs):
        """Return the most probable key and the mean durations."""
        log_probs, mean, _ = self.heads(obs)
        return log_probs.argmax(-1), mean


def of_action(log_probs, mean, log_scale, key, raw):
    """Return the log-probabilities of a key and of its own duration, `[N, 2]`."""
    chosen = jax.nn.one_hot(key, NUM_KEYS)
    density = -0.5 * ((raw - mean) * jnp.exp(-log_scale)) ** 2 - log_scale - 0.5 * math.log(2.0 * math.pi)
    return jnp.stack([(log_probs * chosen).sum(-1), (density * chosen).sum(-1)], -1)


class HybridPPO(PPO):
    """rejax's PPO with a ratio and a clipped surrogate for each of the two heads."""

    def make_act(self, ts):
        """Return the greedy policy of one boat."""

        def act(obs, rng):
            key, raw = self.actor.apply(ts.actor_ts.params, obs[None], method="greedy")
            return key[0], raw[0]

        return act

    @classmethod
    def create_agent(cls, config, env, env_params):
        """Return actor and critic."""
        sizes = tuple(config.pop("agent_kwargs")["hidden_layer_sizes"])
        return {"actor": HybridPolicy(sizes, nn.relu), "critic": VNetwork(sizes, nn.relu)}

    def update_actor(self, ts, batch):
        """Take a step of the actor."""

        def loss(params):
            log_prob, entropy = self.actor.apply(
                params, batch.trajectories.obs, batch.trajectories.action, method="log_prob_entropy"
            )
            advantages = (batch.advantages - batch.advantages.mean()) / (batch.advantages.std() + 1e-8)
            ratio = jnp.exp(log_prob - batch.trajectories.log_prob)
            clipped = jnp.clip(ratio, 1 - self.clip_eps, 1 + self.clip_eps)
            gain = jnp.minimum(ratio * advantages[:, None], clipped * advantages[:, None]).sum(-1).mean()
            return -gain - self.ent_coef * entropy.mean()

        grads = jax.grad(loss)(ts.actor_ts.params)
        return ts.replace(actor_ts=ts.actor_ts.apply_gradients(grads=grads))
