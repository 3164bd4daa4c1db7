"""The recording of 40 people who docked boats."""
