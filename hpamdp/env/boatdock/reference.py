"""What people did at the same task, and the mean ceiling: the lines that an agent's figures stand beside.

Source: `BDtrajectory40.mat`, the human data released with *A Benchmark for Hierarchical Parameterized Action Markov
Decision Process* (MIT licence): 40 people, 360 episodes each. A score is 5 x the fuel left (the file's `tank`, as a
fraction of 360 frames) on success and -1 otherwise. Shares are fractions of episodes. People chose their boat at every
episode, so their figures with one boat are those of the episodes in which they had chosen it.

The figures' names are those of `metrics.csv` without the prefix: `score`, `success`, `too_fast`, `out_of_bounds`,
`out_of_fuel` and `time_limit` (shares of the outcomes), `presses`, `option_congruent`, `oracle_agreement` (share of
episodes with the better boat), `optimality_gap`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Figures = dict[str, float]

CHOICE_FIGURES = ("option_congruent", "oracle_agreement")  # which mean something only where the boat is chosen

# The first entry is the whole task, in which the boat is chosen.
HUMAN: dict[str, Figures] = {
    "chosen": {
        "score": 1.970,
        "success": 0.860,
        "too_fast": 0.085,
        "out_of_bounds": 0.022,
        "out_of_fuel": 0.032,
        "time_limit": 0.0,
        "presses": 3.25,  # as logged; the log drops presses that overlapped another
        "option_congruent": 0.582,
        "oracle_agreement": 0.648,  # by the bearing: the congruent boat is the better one under 30 degrees
    },
    "congruent": {"score": 2.012, "success": 0.864},
    "incongruent": {"score": 1.912, "success": 0.854},
}
# Uniformly random keys and durations with either boat, over 200,000 random layouts (standard error .0013).
RANDOM: Figures = {"score": -0.925, "success": 0.017}
HUMAN_LAST_60: Figures = {"score": 2.241, "success": 0.900}  # of each person's 360 episodes
BEST_PERSON: Figures = {"score": 3.021, "success": 0.989}
HUMAN_SUCCESS_BY_BLOCK = (0.764, 0.843, 0.873, 0.886, 0.894, 0.900)  # six blocks of 60 episodes

# Share choosing the congruent boat, by the degrees between the goal's bearing and that boat's nearest direction.
OFFSET_EDGES = (0, 10, 20, 30, 40, 50, 60)
HUMAN_CONGRUENT_BY_OFFSET = (0.788, 0.741, 0.654, 0.502, 0.427, 0.370)

# Mean score of the best plan of each layout without noise, over 1,500 random layouts (standard error .011). Every
# layout can be docked at. Only for runs without a ceiling computed on the very layouts they were evaluated on.
CEILING: dict[str, Figures] = {
    "chosen": {"score": 3.64, "success": 1.0, "oracle_agreement": 1.0, "optimality_gap": 0.0},
    "congruent": {"score": 3.42, "success": 1.0, "optimality_gap": 0.0},
    "incongruent": {"score": 3.41, "success": 1.0, "optimality_gap": 0.0},
    "random": {"score": 3.41, "success": 1.0, "optimality_gap": 0.0},
}


def has_choice(summary: Mapping[str, Any]) -> bool:
    """Return whether the run of this summary chose its boats."""
    return _is_on_boats(summary) and summary.get("controller", "chosen") == "chosen"


def _is_on_boats(summary: Mapping[str, Any]) -> bool:
    return summary.get("env", "boatdock") == "boatdock"


def human_normalised(score: float, controller: str = "chosen") -> float:
    """Return a score on boats on the scale of random presses, 0, and people's mean with the same boat, 1.

    Args:
        controller: as in a run's summary; boats that are drawn are held against people's choice, as they are elsewhere.
    """
    people = HUMAN.get(controller, HUMAN["chosen"])["score"]
    return (score - RANDOM["score"]) / (people - RANDOM["score"])


def references(summary: Mapping[str, Any]) -> dict[str, Figures]:
    """Return the figures to stand beside a run's own, by name: those known of random, human, best_person and ceiling.

    Args:
        summary: a run's summary. `controller` ("chosen" if missing, "congruent", "incongruent" or "random") picks the
            figures; `references` overrides them by name: a mapping of figures is taken as it is, a number is the
            score beside the other figures, and None leaves the name out. Leaving people out leaves out the best one.
            Of other environments than the boats these are all there is; on boats each score is also `human_normalised`.

    Raises:
        ValueError: the controller is not one of these.
    """
    controller = summary.get("controller", "chosen")
    if controller not in CEILING:
        raise ValueError(f"controller in the summary must be one of {', '.join(CEILING)}, got {controller!r}")
    found: dict[str, Figures] = {}
    if _is_on_boats(summary):
        found["human"] = HUMAN.get(controller, HUMAN["chosen"])
        found |= {"best_person": BEST_PERSON, "ceiling": CEILING[controller]}
    given = summary.get("references") or {}
    if "human" in given and given["human"] is None:
        del found["best_person"]
    for name, figures in given.items():
        if figures is None:
            found.pop(name, None)
        elif isinstance(figures, Mapping):
            found[name] = dict(figures)
        else:
            found[name] = {**found.get(name, {}), "score": float(figures)}
    order = [name for name in ("random", "human", "best_person", "ceiling") if name in found]
    return {name: _normalised(found[name], controller) if _is_on_boats(summary) else found[name] for name in order}


def _normalised(figures: Figures, controller: str) -> Figures:
    if "score" not in figures:
        return figures
    return {**figures, "human_normalised": human_normalised(figures["score"], controller)}
