"""The boat-docking benchmark: choose one of two boats, then dock it with timed key presses."""
