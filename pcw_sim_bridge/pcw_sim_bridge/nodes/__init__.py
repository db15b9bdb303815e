"""Nodes of the simulated robot: bridge and recorder."""
