"""What a test of one caster says once it is over, without having to know the ground beforehand.

The others creep under the forces that they take, and the twist that follows from them is off by that creep, which depends on
the very ground that is looked for. While the test goes on the creep is that of the ground as it is believed to be. Afterwards
it is that of the ground just found, over and over, until it does not change: all casters whose ground is not known are taken
to stand on the one under test. Every round takes off two thirds of what is wrong, as the others take about a third of the
force.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pcw_description.robot_description import FloatArray

from .active_identification import ActiveIdentification, ActiveMeasurement
from .errors import TerrainError, require_dt
from .robot_terrain import RobotTerrain, RobotTerrainEstimate
from .terrain_estimator import TerrainState

ROUNDS = 6


@dataclasses.dataclass(frozen=True)
class _Instant:
    measurement: ActiveMeasurement
    effort: FloatArray
    twist: FloatArray
    dt: float


class ActiveRecord:
    """The readings of one test.

    Args:
        terrain: the estimators of the robot.
        active: what makes the casters slip.
    """

    def __init__(self, terrain: RobotTerrain, active: ActiveIdentification) -> None:
        self._terrain, self._active = terrain, active
        self._instants: list[_Instant] = []

    def __len__(self) -> int:
        return len(self._instants)

    def add(self, measurement: ActiveMeasurement, effort: FloatArray, twist: FloatArray, dt: float) -> None:
        """Note one cycle.

        Args:
            measurement: what was measured, with what was believed of the ground before the test.
            effort: motor torques (n, 2) over the time since the cycle before [N m].
            twist: that of base_link by which odometry went on in this cycle, `ActiveOutput.twist` (3,).
            dt: time since the cycle before [s].
        """
        require_dt(dt)
        self._instants.append(_Instant(measurement, effort.copy(), twist.copy(), dt))

    def clear(self) -> None:
        """Forget all."""
        self._instants.clear()

    def identify(self, caster: int) -> tuple[TerrainState, RobotTerrainEstimate, FloatArray]:
        """Return what was found, and how far the odometry was off meanwhile.

        Returns:
            State and estimate of all casters, of which only that of `caster` has been estimated; and the motion (3,) [m, m,
            rad] in base_link that an odometry on `ActiveOutput.controller_position` has missed.

        Raises:
            TerrainError: nothing has been noted.
        """
        if not self._instants:
            raise TerrainError("a record of 0 cycles is not allowed; allowed: at least 1")
        n, last = self._terrain.n, self._instants[-1].measurement
        mu_p, lambda_p = last.mu_p.copy(), last.lambda_p.copy()
        follows = ~last.known
        follows[caster] = True
        only = np.arange(n) == caster
        used = np.sum([instant.dt * instant.twist for instant in self._instants], axis=0)
        path = used
        estimate: RobotTerrainEstimate
        for _ in range(ROUNDS):
            path = np.zeros(3)
            active, state = self._active.initial_state(), self._terrain.initial_state()
            for instant in self._instants:
                measurement = dataclasses.replace(instant.measurement, mu_p=mu_p, lambda_p=lambda_p)
                active, twist = self._active.twist_of_others(active, measurement, caster, instant.dt)
                state, estimate = self._terrain.step_with_twist(
                    state, measurement.position, measurement.velocity, instant.effort, twist, instant.dt, only
                )
                path += instant.dt * twist
            if not np.isfinite(estimate.mu_p[caster]):
                break
            mu_p, lambda_p = (
                np.where(follows, estimate.mu_p[caster], mu_p),
                np.where(follows, estimate.lambda_p[caster], lambda_p),
            )
        return state, estimate, path - used
