"""Hard Move: reach a target with many actuators."""
