"""Estimators for powered-caster robots: encoder-consistency slip and odometry."""

__all__: list[str] = []
