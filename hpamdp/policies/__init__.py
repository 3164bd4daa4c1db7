"""Selectors, learners and the agent made of them."""
