"""Studies of the terrain estimators, which write their documents."""
