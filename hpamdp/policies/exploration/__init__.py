"""Exploration that reaches far: modules that stand beside the learners, one class each."""
