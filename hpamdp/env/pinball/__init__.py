"""Pinball: push a ball between walls into a hole."""
