"""Manipulation by primitives: a robot's arm moves, grasps, lifts and pulls in six Meta-World tasks."""
