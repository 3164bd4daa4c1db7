"""Selectors, one per file. A selector chooses an option at each decision."""
