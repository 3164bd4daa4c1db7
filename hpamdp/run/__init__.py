"""Assemble, train, evaluate and save single runs, and run sweeps."""
