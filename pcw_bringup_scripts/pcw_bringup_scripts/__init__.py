"""Set-up, demonstration, composition and benchmarks of the PCW packages."""

__all__: list[str] = []
