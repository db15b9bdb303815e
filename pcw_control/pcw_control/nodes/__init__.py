"""Nodes of the controllers."""
