"""Simulated plants, bridge and recorder nodes, and the mismatch analyser."""

__all__: list[str] = []
