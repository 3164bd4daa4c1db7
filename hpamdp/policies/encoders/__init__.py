"""Encoders: what turns the entries of an observation into features, one class each."""
