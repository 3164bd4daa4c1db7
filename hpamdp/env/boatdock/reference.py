"""People's results at the same task, as references for an agent's figures.

Source: `BDtrajectory40.mat`, the human data released with *A Benchmark for Hierarchical Parameterized Action Markov
Decision Process* (MIT licence): 40 people, 360 episodes each. A score is 5 x the fuel left (the file's `tank`, as a
fraction of 360 ticks) on success and -1 otherwise. People chose a controller in every episode. So their figures with
one controller cover the episodes in which they had chosen it.

The figures have the names of `metrics.csv`:
- `score` and `steps` are means.
- `success`, `too_fast`, `out_of_bounds`, `out_of_fuel` and `time_limit` are fractions of episodes with that outcome.
- `option_congruent` is the fraction of episodes with the congruent controller.
- `oracle_agreement` is the fraction of episodes with the better controller.
"""

from __future__ import annotations

Figures = dict[str, float]

# The first entry is the whole task, in which people choose the controller.
HUMAN: dict[str, Figures] = {
    "chosen": {
        "score": 1.970,
        "success": 0.860,
        "too_fast": 0.085,
        "out_of_bounds": 0.022,
        "out_of_fuel": 0.032,
        "time_limit": 0.0,
        "steps": 3.25,  # logged presses; the log drops presses that overlapped another
        "option_congruent": 0.582,
        "oracle_agreement": 0.648,  # the congruent controller counts as better under 30 degrees
    },
    "congruent": {"score": 2.012, "success": 0.864},
    "incongruent": {"score": 1.912, "success": 0.854},
}
# Uniformly random keys and durations with either controller, over 200,000 random layouts (standard error 0.0013).
RANDOM: Figures = {"score": -0.925, "success": 0.017}
HUMAN_LAST_60: Figures = {"score": 2.241, "success": 0.900}  # of each person's 360 episodes
BEST_PERSON: Figures = {"score": 3.021, "success": 0.989}
HUMAN_SUCCESS_BY_BLOCK = (0.764, 0.843, 0.873, 0.886, 0.894, 0.900)  # six blocks of 60 episodes

# Probability of choosing the congruent controller, by the degrees between the goal's bearing and the nearest congruent
# direction.
OFFSET_EDGES = (0, 10, 20, 30, 40, 50, 60)
HUMAN_CONGRUENT_BY_OFFSET = (0.788, 0.741, 0.654, 0.502, 0.427, 0.370)


def human_normalised(score: float, controller: str = "chosen") -> float:
    """Return the human-normalised score: 0 for random presses, 1 for the mean of people with the same controller.

    Args:
        score: mean score of an evaluation.
        controller: `chosen`, `congruent`, `incongruent` or `random`. `random` is compared with people's own choices.
    """
    human = HUMAN.get(controller, HUMAN["chosen"])["score"]
    return (score - RANDOM["score"]) / (human - RANDOM["score"])


def human_references(controller: str) -> dict[str, Figures]:
    """Return the figures of people on average (`human`) and of the best person (`best_person`).

    Args:
        controller: as for `human_normalised`.
    """
    found = {"human": HUMAN.get(controller, HUMAN["chosen"]), "best_person": BEST_PERSON}
    return {
        name: {**figures, "human_normalised": human_normalised(figures["score"], controller)}
        for name, figures in found.items()
    }
