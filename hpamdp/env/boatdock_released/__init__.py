"""Boat docking by the rules of the code that was released with the paper."""
