"""Catch Point: move to a target and catch it."""
