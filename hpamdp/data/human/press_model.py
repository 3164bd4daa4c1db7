"""A model of people's presses: the key, and how long it is held, given the state and the person's own past.

One network looks at each of the three keys in the frame that the problem's geometry declares: turned until the key
points along +x, and mirrored until the goal is on one side. So what is learned of one key holds for all. The network
gives each key a logit, and its duration a mixture of Gaussians.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor, nn
from torch.distributions import Categorical, MixtureSameFamily, Normal

from hpamdp import keys
from hpamdp.data import DataError
from hpamdp.data.human.choice_model import rows_of_people
from hpamdp.data.human.demonstrations import with_keymap
from hpamdp.data.human.released_file import FULL_TANK, HumanData
from hpamdp.data.human.rest_to_rest import to_rest_to_rest
from hpamdp.data.human.transitions import transitions
from hpamdp.env.boatdock import physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.task import DOCK_RADIUS, HARBOUR_RADIUS, MAX_DURATION, SCALED_NAMES

UPDATES = 800
KEYMAP = 1  # in which the model sees presses, whatever the key map of the recording
_NUM_GAUSSIANS = 5
_WIDTH = 128
_BATCH = 1024
_LEARNING_RATE = 3e-3
_WEIGHT_DECAY = 1e-3
_FADING = 0.05  # of the person's recent results, for each episode
_VECTORS = [SCALED_NAMES.index(f"{name}_{axis}") for name in ("boat", "velocity", "to_goal") for axis in "xy"]
_NUMBERS = [SCALED_NAMES.index(name) for name in ("fuel", "distance")]


def pasts(data: HumanData, modelled: HumanData) -> Tensor:
    """Return the past of the person before each episode, `[E, 4]`.

    The columns: the number of episodes, and recent means of success, of the fraction of fuel left, and of the duration
    of a press (s).

    Args:
        data: the unchanged recording, which has the results.
        modelled: the recording with the presses that are modelled.
    """
    presses, num_presses = modelled.presses, modelled.episodes["presses"]
    is_success = (data.episodes["outcome"] == physics.SUCCESS).float()
    fuel = data.episodes["tank"] / FULL_TANK
    pressed = torch.zeros(len(fuel), dtype=torch.float32).index_add(0, presses["episode"], presses["duration"])
    results = torch.stack([is_success, fuel, pressed / num_presses.clamp(min=1)], 1)
    rows = rows_of_people(data.episodes)
    recent = torch.full((len(rows), 3), 0.5, dtype=torch.float32)
    past = torch.zeros(len(fuel), 4, dtype=torch.float32)
    for number, now in enumerate(rows.T):
        is_there = now >= 0
        past[now[is_there]] = torch.cat([torch.full((len(rows), 1), number), recent], 1)[is_there]
        pressed_before = torch.where(num_presses[now] > 0, results[now, 2], recent[:, 2])
        recent = recent.lerp(torch.cat([results[now, :2], pressed_before.unsqueeze(1)], 1), _FADING)
    return past


class Presses:
    """Recorded presses as the model sees them.

    Args:
        data: the unchanged recording in one frame.
        rest_to_rest: whether to take rest-to-rest presses, without those that unlogged presses followed (`clean`).

    Attributes:
        past: of the person before each episode, `[E, 4]`, see `pasts`.
        episode: row of each press's episode, int64 `[N]`.
        features: `[N, 3, F]`; key: int64 `[N]`; duration: s, `[N]`.
        weight: how many recorded presses with its outcome each one stands for, `[N]`. The conversion leaves out four of
            five final presses.
    """

    def __init__(self, data: HumanData, *, rest_to_rest: bool = True) -> None:
        kept = to_rest_to_rest(data, clean=True) if rest_to_rest else data
        past = pasts(data, kept)
        kept = with_keymap(kept, KEYMAP)
        self.past = past
        self.episode = number = kept.presses["episode"]
        observation = transitions(kept, has_choice=False)[keys.OBSERVATION]
        self.features = press_features(observation, kept.episodes["controller"][number], past[number])
        self.key, self.duration = kept.presses["key"], kept.presses["duration"]
        num_recorded, num_kept = (
            torch.bincount(_kinds(each), minlength=len(physics.OUTCOMES)) for each in (data, kept)
        )
        self.weight = (num_recorded / num_kept)[_kinds(kept)]


def _kinds(data: HumanData) -> Tensor:
    """Return the outcome that each press led to, int64 `[N]`."""
    outcome = data.episodes["outcome"][data.presses["episode"]]
    return torch.where(data.presses["is_final"], outcome, physics.SAILING)


def press_features(observation: Tensor, controller: Tensor, past: Tensor) -> Tensor:
    """Return what the network sees of each key, `[N, 3, F]`.

    Args:
        observation: scaled, with the key map `KEYMAP`, `[N, 16]`.
        controller: int64 `[N]`.
        past: of the person, `[N, 4]`.
    """
    along = _directions()[controller]  # [N, 3, 2]
    across = torch.stack([along[..., 1], -along[..., 0]], -1)
    vectors = observation[:, _VECTORS].unflatten(1, (-1, 2)).mT  # [N, 2, vectors]
    ahead, aside = along @ vectors, across @ vectors  # [N, 3, vectors]
    aside = aside * torch.where(aside[..., -1:] < 0.0, -1.0, 1.0)
    boat, velocity, to_goal = (HARBOUR_RADIUS * torch.stack([ahead, aside])).unbind(-1)  # [2, N, 3], px
    zero, one = torch.zeros_like(boat[0]), torch.ones_like(boat[0])
    to_dock = physics.distance_to_dock(zero, zero, to_goal[0], to_goal[1], one, zero)
    is_hit = to_dock.isfinite()
    pressed = physics.press_for(torch.stack([torch.where(is_hit, to_dock, 0.0), to_goal[0]], -1))
    to_harbour = physics.distance_to_harbour(boat[0], boat[1], one, zero) / HARBOUR_RADIUS
    numbers = torch.stack([controller, (past[:, 0] / 360).sqrt()], 1)
    common = torch.cat([observation[:, _NUMBERS], numbers, past[:, 1:]], 1)
    common = common.unsqueeze(1).expand(-1, along.shape[1], -1)
    aim = (1.0 - to_goal[1] / DOCK_RADIUS) * (to_goal[0] > 0.0)
    repeats = velocity[0] / velocity.norm(dim=0).clamp(min=1e-6)
    own = torch.stack([is_hit.float(), aim, repeats, to_harbour, to_goal.norm(dim=0) / HARBOUR_RADIUS], -1)
    return torch.cat([ahead, aside, pressed, own, common], -1)


@cache
def _directions() -> Tensor:
    """Return where the keys of the controllers point, `[2, 3, 2]`."""
    directions = BoatDockEnv(1, keymap=KEYMAP).geometry.directions
    assert directions is not None
    return directions


class PressModel(nn.Module):
    """The network, fitted to presses by maximum likelihood.

    Args:
        presses: to fit.
        is_fitted: which of them to fit, bool `[N]`.
        updates: number of gradient steps.
        seed: of the initial weights and of the batches.

    Raises:
        DataError: there is no press to fit.
    """

    def __init__(self, presses: Presses, is_fitted: Tensor, *, updates: int = UPDATES, seed: int = 0) -> None:
        super().__init__()
        if not is_fitted.any():
            raise DataError("no press is left to fit a model to")
        features = presses.features[is_fitted]
        self.mean = nn.Buffer(features.mean((0, 1)))
        self.deviation = nn.Buffer(features.std((0, 1)) + 1e-6)
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed)
            self.hidden = nn.Sequential(
                nn.Linear(features.shape[-1], _WIDTH, dtype=torch.float32),
                nn.SiLU(),
                nn.Linear(_WIDTH, _WIDTH, dtype=torch.float32),
                nn.SiLU(),
            )
            self.heads = nn.Linear(_WIDTH, 1 + 3 * _NUM_GAUSSIANS, dtype=torch.float32)
            with torch.no_grad():
                self.heads.weight.mul_(0.1)
                spread = torch.linspace(0.1, 1.2, _NUM_GAUSSIANS, dtype=torch.float32)
                logits = torch.zeros(1 + _NUM_GAUSSIANS, dtype=torch.float32)
                self.heads.bias.copy_(torch.cat([logits, spread, torch.full_like(spread, -1.0)]))
            self._fit(presses, is_fitted.nonzero()[:, 0], updates)

    def _fit(self, presses: Presses, rows: Tensor, updates: int) -> None:
        optimizer = torch.optim.AdamW(self.parameters(), _LEARNING_RATE, weight_decay=_WEIGHT_DECAY)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LEARNING_RATE, total_steps=updates)
        for _ in range(updates):
            batch = rows[torch.randint(len(rows), (_BATCH,))]
            key_loss, duration_loss = self.losses(presses, batch)
            weight = presses.weight[batch]
            optimizer.zero_grad()
            ((key_loss + duration_loss) * weight).sum().div(weight.sum()).backward()
            nn.utils.clip_grad_norm_(self.parameters(), 1.0)
            optimizer.step()
            schedule.step()

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Return the keys' log-probabilities `[N, 3]` and the parameters of their durations `[N, 3, 15]`."""
        seen = ((features - self.mean) / self.deviation).clamp(-5.0, 5.0)
        logit, mixture = self.heads(self.hidden(seen)).split([1, 3 * _NUM_GAUSSIANS], -1)
        return logit.squeeze(-1).log_softmax(1), mixture

    def losses(self, presses: Presses, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Return the negative log-likelihoods of keys, and of durations in seconds given the key, nats, `[B]` each."""
        key = presses.key[rows].unsqueeze(1)
        log_probs, mixture = self(presses.features[rows])
        durations = _durations(mixture.gather(1, key.unsqueeze(2).expand(-1, -1, mixture.shape[2])).squeeze(1))
        return -log_probs.gather(1, key).squeeze(1), -durations.log_prob(presses.duration[rows])

    @torch.no_grad()
    def sample(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Draw keys `[N]` and durations (s) `[N]`."""
        log_probs, mixture = self(features)
        key = Categorical(logits=log_probs).sample()
        duration = _durations(mixture[torch.arange(len(key)), key]).sample()
        return key, duration.clamp(0.0, MAX_DURATION)


def _durations(mixture: Tensor) -> MixtureSameFamily:
    logits, mean, log_scale = mixture.chunk(3, -1)
    return MixtureSameFamily(Categorical(logits=logits), Normal(mean, log_scale.clamp(-4.5, 1.0).exp()))
