"""Quantum circuit design: build a circuit gate by gate for a state or an operator."""
