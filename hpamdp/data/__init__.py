"""Recordings to learn from, and ways to other programs."""
