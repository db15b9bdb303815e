"""The regression that everything is told by: a problem of residual channels, its noise, and evidence."""
