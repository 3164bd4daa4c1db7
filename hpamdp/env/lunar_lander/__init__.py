"""Hybrid LunarLander: two engines at once, each off or on with a throttle."""
