"""Controllers for powered-caster robots: computed torque, quintic trajectories and torque limits."""

__all__: list[str] = []
