"""Hostile cases, a file for each way in; `python experiments/reliability/hostile_round.py` runs them."""
