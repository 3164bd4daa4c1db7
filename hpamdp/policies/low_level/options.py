"""The cards of the learners that have no settings."""

from __future__ import annotations

from hpamdp.cards import ActionFeature, LearnerCard

CARDS = {
    "Planner": LearnerCard(needs=("oracle",), takes_pictures=True),
    "Random": LearnerCard(takes=frozenset(ActionFeature), takes_pictures=True),
}
