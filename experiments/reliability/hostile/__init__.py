"""Hostile cases, one file for each kind of input. `python experiments/reliability/hostile_round.py` runs them."""
