"""Terrain for powered-caster robots: the catalogue of grounds."""

from .ground_catalogue import GROUNDS, Ground, contact_on, ground, robot_on

__all__ = ["GROUNDS", "Ground", "contact_on", "ground", "robot_on"]
