"""Moving and Sliding: drive to a target and stop there."""
