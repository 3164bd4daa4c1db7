"""DLPA: a learned model of parameterised actions, a planner in it, and the learner of both."""
