"""Traffic lights: which phase comes next, and for how many seconds it stays green."""
