"""Nodes of the demonstration."""
