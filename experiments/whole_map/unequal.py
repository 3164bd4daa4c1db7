"""Train agents with an option that is of little or no use among good ones, and print which options practise.

python experiments/whole_map/unequal.py weak 301    trains the case with this seed, and prints a row of the table
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor
from torchrl.data import Binary, TensorSpec

import hpamdp
from experiments.options import train_rooms
from experiments.whole_map import boat_rules
from hpamdp import keys
from hpamdp.env.batched_env import Action
from hpamdp.env.boatdock import physics
from hpamdp.env.boatdock.environment import BoatDockEnv
from hpamdp.env.boatdock.task import CONGRUENT, NOT_CHOSEN, BoatState
from hpamdp.env.counter_rng import RngKey
from hpamdp.env.facts import ProblemFacts
from hpamdp.env.office import kernel, rules
from hpamdp.env.office.environment import OfficeEnv
from hpamdp.env.office.options import GOALS, OfficeOptions
from hpamdp.env.rooms.environment import RoomsEnv
from hpamdp.env.rooms.options import RoomsOptions
from hpamdp.env.rooms.rules import RoomsState
from hpamdp.messages import exit_code
from hpamdp.run.trainer import Trainer


class WeakBoatEnv(boat_rules.TensorBoats):
    """Boats of which the congruent one has a third of the push.

    Its speed, and so the way of a press, is a third of that of the other boat; a press takes as much fuel. The planner
    does not know, so neither do ceiling and oracle.
    """

    def act(self, state: BoatState, action: Action, rng: RngKey, is_idle: Tensor) -> tuple[BoatState, Tensor]:
        """Return the states after one press, and the rewards `[N]`."""
        option, key = action.option.int(), action.discrete.int()
        held = torch.where(state.controller == NOT_CHOSEN, option, state.controller)
        dir_x, dir_y = boat_rules.direction_of(self.options, held, state.keymap, key)
        strength = torch.where(held == CONGRUENT, 1.0 / 3.0, 1.0)
        position = (state.x, state.y, state.fuel, state.goal_x, state.goal_y)
        pressed = physics.press(*position, dir_x, dir_y, action.parameters.squeeze(-1), strength=strength)
        after = boat_rules.after_press(state, pressed, dir_x, dir_y, held)
        return after, boat_rules.reward_of(state, after, self.options)


class _SlippersOptions(RoomsOptions):
    def facts(self, title: str) -> ProblemFacts:
        return ProblemFacts(title=title, option_names=("skates", "boots", "slippers"), has_choice=True)


class SlippersRoomsEnv(RoomsEnv):
    """Rooms with a third kind of shoes, slippers, in which the agent stays where it is."""

    Options = _SlippersOptions

    def act(self, state: RoomsState, action: Action, rng: RngKey, is_idle: Tensor) -> tuple[RoomsState, Tensor]:
        """Return the states after one move and the rewards `[N]`."""
        walks = (action.option < 2).unsqueeze(-1)
        return super().act(state, action._replace(parameters=action.parameters * walks), rng, is_idle)


_NAP = len(GOALS)


def advance_with_nap(state: Any, option: Any, *others: Any) -> int:
    """Move offices as their kernel does. Who naps goes for what is out of reach, and so takes nothing."""
    x, y = state[0][:2]
    far_goal = np.where((abs(x - rules.PLACES[1][0]) < 0.2) & (abs(y - rules.PLACES[1][1]) < 0.2), 0, 1)
    return kernel.advance(state, np.where(option == _NAP, far_goal, option), *others)


class _NapOptions(OfficeOptions):
    def facts(self, title: str) -> ProblemFacts:
        return ProblemFacts(title=title, option_names=(*GOALS, "nap"), has_choice=True)


class NapOfficeEnv(OfficeEnv):
    """Office with a fourth goal, a nap, at which there is nothing to take. It is open while the agent holds nothing."""

    Options = _NapOptions
    row_kernel = staticmethod(advance_with_nap)

    def _knowledge_specs(self) -> dict[str, TensorSpec]:
        shape = (self.num_envs, _NAP + 1)
        return {keys.OPTION_MASK: Binary(_NAP + 1, shape=shape, dtype=torch.bool, device=self.device)}

    def masks(self) -> dict[str, Tensor]:
        """Return which goals are open, `[N, 4]`."""
        holds_nothing = ((self._state.coffee == 0) & (self._state.mail == 0)).unsqueeze(-1)
        return {keys.OPTION_MASK: torch.cat([rules.open_goals(self._state), holds_nothing], -1)}


BOATS = {"high": "meta_critic", "low": "hyar", "recipe": "boatdock_hyar"}
ROOMS_WORDS = [*train_rooms.COMMON[1:], *train_rooms.SELECTORS["meta_critic"], *train_rooms.LEARNERS["hppo"]]
ROOMS = {name: yaml.safe_load(value) for name, _, value in (word.partition("=") for word in ROOMS_WORDS)}
ROOMS |= {"high": "meta_critic", "low": "hppo"}
OFFICE = {"high": "meta_critic", "low": "hppo", "recipe": "office_hppo", "env.tiles": 20, "env.chooses_goal": True}
OFFICE |= {"exploration": "counts", "exploration.resolution": 1, "exploration.weight": 25, "eval.layouts": 100}
COUNTS = {"exploration": "counts", "exploration.resolution": 1, "exploration.weight": 0.1}
CRIPPLED = {"env.boats": ["incongruent1", "congruent", "crippled"], "+env.controllers": {"crippled": [0.0, 5.0, 10.0]}}
CASES: dict[str, dict[str, Any]] = {
    "boats": {"env": BoatDockEnv, **BOATS},
    "weak": {"env": WeakBoatEnv, **BOATS},
    "noisy": {"env": BoatDockEnv, **BOATS, "env.motor_noise": [0.6, 0.0]},
    "crippled": {"env": BoatDockEnv, **BOATS, **CRIPPLED},
    "rooms": {"env": RoomsEnv, **ROOMS},
    "rooms, curves": {"env": RoomsEnv, **ROOMS, "agent.practice": "curves"},
    "office": {"env": OfficeEnv, **OFFICE},
    "nap": {"env": NapOfficeEnv, **OFFICE},
    "slippers": {"env": SlippersRoomsEnv, **ROOMS},
    "slippers, curves": {"env": SlippersRoomsEnv, **ROOMS, "agent.practice": "curves"},
    "slippers, counts": {"env": SlippersRoomsEnv, **ROOMS, **COUNTS},
    "slippers, counts, curves": {"env": SlippersRoomsEnv, **ROOMS, **COUNTS, "agent.practice": "curves"},
}


class CountDecisions(hpamdp.Callback):
    """Count how many decisions practised each option."""

    def on_end(self, trainer: Trainer) -> None:
        """Keep the counts, which only practice by curves has."""
        counts = getattr(trainer.parts.agent.practice, "counts", None)
        self.shares = None if counts is None else (counts.sum(-1) / counts.sum()).tolist()


def main(name: str, seed: str) -> None:
    """Train, and print the score, and each option's share of the final choices and of the practice."""
    counted = CountDecisions()
    with tempfile.TemporaryDirectory() as folder:
        settings = {"eval.every": 0, **CASES[name], "seed": int(seed), "eval.seed": int(seed), "film": False}
        hpamdp.train(**settings, folder=folder, overwrite=True, callbacks=[counted], progress=False)
        summary = json.loads((Path(folder) / "summary.json").read_text())
        with np.load(Path(folder) / "evaluation.npz", allow_pickle=False) as evaluation:
            chosen = np.bincount(evaluation["option"], minlength=len(summary["practised"])) / summary["episodes"]
    columns = [", ".join(summary["practised"]), f"{summary['score']:.3f}", f"{summary['success']:.1%}"]
    columns += [_percent(each) for each in (chosen, summary["practised"].values(), counted.shares)]
    columns += [f"{summary[key]:.3f}" if key in summary else "" for key in ("oracle_agreement_weighted", "regret")]
    print(f"| {name} | {seed} | {' | '.join(columns)} | {summary['cpu_s']:.0f} s |")


def _percent(shares: Iterable[float] | None) -> str:
    return "" if shares is None else ":".join(f"{100 * share:.0f}" for share in shares)


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(*sys.argv[1:])))
