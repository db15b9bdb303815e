"""What a test of one caster says once it is over, without having to know the ground beforehand.

The others creep under the forces that they take, and the twist that follows from them is off by that creep, which depends on
the very ground that is looked for. While the test goes on the creep is that of the ground as it is believed to be. Afterwards
it is that of the ground just found, over and over, until it does not change: all casters whose ground is not known are taken
to stand on the one under test. Every round takes off two thirds of what is wrong, as the others take about a third of the
force.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from pcw_description.robot_description import FloatArray

from .active_identification import ActiveIdentification, ActiveMeasurement, ActiveState
from .errors import TerrainError, require_dt
from .robot_terrain import RobotTerrain, RobotTerrainEstimate
from .terrain_estimator import TerrainState

ROUNDS = 6


@dataclasses.dataclass(frozen=True)
class Instant:
    """One cycle of a test; see `ActiveRecord.add`."""

    measurement: ActiveMeasurement
    effort: FloatArray
    twist: FloatArray
    dt: float


@dataclasses.dataclass(frozen=True)
class Replay:
    """How far the rounds over a record have come; made by `ActiveRecord.begin`.

    Attributes:
        caster: the one that was tested.
        used: motion that odometry went on by (3,) [m, m, rad] in base_link.
        mu_p, lambda_p: of the ground, as this round believes (n,) [1].
        active, terrain: states within this round.
        path: motion by this round so far (3,) [m, m, rad] in base_link.
        estimate: after the last cycle that was gone over; None before the first.
        round: rounds that are done.
        at: cycle of the record that is next.
        finished: nothing is left to do.
    """

    caster: int
    used: FloatArray
    mu_p: FloatArray
    lambda_p: FloatArray
    active: ActiveState
    terrain: TerrainState
    path: FloatArray
    estimate: RobotTerrainEstimate | None = None
    round: int = 0
    at: int = 0
    finished: bool = False

    @property
    def missed(self) -> FloatArray:
        """Motion (3,) [m, m, rad] in base_link that an odometry on `ActiveOutput.controller_position` has missed."""
        return self.path - self.used


class ActiveRecord:
    """The readings of one test.

    Args:
        terrain: the estimators of the robot.
        active: what makes the casters slip.
        instants: what has been noted so far.
    """

    def __init__(self, terrain: RobotTerrain, active: ActiveIdentification, instants: Iterable[Instant] = ()) -> None:
        self._terrain, self._active = terrain, active
        self._instants: list[Instant] = list(instants)

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
        self._instants.append(Instant(measurement, effort.copy(), twist.copy(), dt))

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
        replay = self.advance(self.begin(caster), ROUNDS * len(self._instants))
        assert replay.estimate is not None
        return replay.terrain, replay.estimate, replay.missed

    def begin(self, caster: int) -> Replay:
        """Return where to begin with what `identify` does, to go on a few cycles at a time while the robot drives.

        Raises:
            TerrainError: nothing has been noted.
        """
        if not self._instants:
            raise TerrainError("a record of 0 cycles is not allowed; allowed: at least 1")
        last = self._instants[-1].measurement
        used = np.sum([instant.dt * instant.twist for instant in self._instants], axis=0)
        return Replay(
            caster, used, last.mu_p.copy(), last.lambda_p.copy(), self._active.initial_state(),
            self._terrain.initial_state(), np.zeros(3),
        )  # fmt: skip

    def advance(self, replay: Replay, cycles: int) -> Replay:
        """Return the replay after so many cycles more, or after its last.

        The end is the same whatever the numbers of cycles: `estimate`, of which only that of `caster` has been estimated.
        """
        for _ in range(cycles):
            if replay.finished:
                break
            replay = self._after_one(replay)
        return replay

    def _after_one(self, replay: Replay) -> Replay:
        caster, n = replay.caster, self._terrain.n
        instant = self._instants[replay.at]
        measurement = dataclasses.replace(instant.measurement, mu_p=replay.mu_p, lambda_p=replay.lambda_p)
        active, twist = self._active.twist_of_others(replay.active, measurement, caster, instant.dt)
        terrain, estimate = self._terrain.step_with_twist(
            replay.terrain, measurement.position, measurement.velocity, instant.effort, twist, instant.dt,
            np.arange(n) == caster,
        )  # fmt: skip
        path, at = replay.path + instant.dt * twist, replay.at + 1
        replay = dataclasses.replace(replay, active=active, terrain=terrain, path=path, estimate=estimate, at=at)
        return replay if at < len(self._instants) else self._after_round(replay, estimate)

    def _after_round(self, replay: Replay, estimate: RobotTerrainEstimate) -> Replay:
        caster, done = replay.caster, replay.round + 1
        if not np.isfinite(estimate.mu_p[caster]) or done == ROUNDS:
            return dataclasses.replace(replay, round=done, finished=True)
        follows = ~self._instants[-1].measurement.known
        follows[caster] = True
        return dataclasses.replace(
            replay, mu_p=np.where(follows, estimate.mu_p[caster], replay.mu_p),
            lambda_p=np.where(follows, estimate.lambda_p[caster], replay.lambda_p), active=self._active.initial_state(),
            terrain=self._terrain.initial_state(), path=np.zeros(3), round=done, at=0,
        )  # fmt: skip
