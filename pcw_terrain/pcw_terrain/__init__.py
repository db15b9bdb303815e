"""Terrain for powered-caster robots: the catalogue of grounds."""

__all__: list[str] = []
