"""Learners, one per file. A learner chooses a discrete action and its parameters at each step."""
