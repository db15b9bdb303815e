"""Nodes of the estimators."""
