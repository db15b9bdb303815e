"""What tests of the ground by slip on purpose have told of each caster, and for how long it counts.

What a test has told is of the place where it was made. It counts for a caster until

- its own estimate is valid, which is of the ground that it stands on now;
- it holds more than that ground could, for so long that it is no noise: it stands on another one;
- it has gone so far that an estimate of its own would not be vouched for any more either (`TerrainParameters.reach`).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pcw_description.robot_description import FloatArray

from .errors import TerrainError, require_dt
from .robot_terrain import RobotTerrainEstimate
from .terrain_estimator import ABOVE_PART, TerrainParameters

# So much longer above the peak, by `ABOVE_PART` of it, than below [s].
ABOVE_TIME = 0.1


@dataclasses.dataclass(frozen=True)
class GroundFromTests:
    """What counts now; made by `nothing`.

    Attributes:
        mu_p, lambda_p: per caster (n,) [1]; NaN where nothing counts.
        told: mu_p and lambda_p as they were told last (n, 2), to tell news from what is said again.
        way: since the test (n,) [m].
        above: for how much longer a wheel has held more than the ground could than not (n,) [s].
    """

    mu_p: FloatArray
    lambda_p: FloatArray
    told: FloatArray
    way: FloatArray
    above: FloatArray

    @classmethod
    def nothing(cls, n: int) -> GroundFromTests:
        """Return that nothing was told of n casters."""
        return cls(np.full(n, np.nan), np.full(n, np.nan), np.full((n, 2), np.nan), np.zeros(n), np.zeros(n))

    @property
    def known(self) -> np.ndarray:
        """Of which casters something counts (n,)."""
        return np.isfinite(self.mu_p)

    def hear(self, mu_p: FloatArray, lambda_p: FloatArray, way: FloatArray) -> GroundFromTests:
        """Return what counts after tests have told.

        Args:
            mu_p, lambda_p: per caster (n,) [1]; what is not finite or not positive tells nothing of that caster.
            way: that each has gone since the test (n,) [m].
        """
        told = np.stack([mu_p, lambda_p], axis=1)
        with np.errstate(invalid="ignore"):
            news = np.isfinite(told).all(axis=1) & (told > 0.0).all(axis=1) & (told != self.told).any(axis=1)
        return GroundFromTests(
            np.where(news, mu_p, self.mu_p), np.where(news, lambda_p, self.lambda_p),
            np.where(news[:, None], told, self.told), np.where(news, way, self.way), np.where(news, 0.0, self.above),
        )  # fmt: skip

    def step(self, ground: RobotTerrainEstimate, force: FloatArray, speed: FloatArray, dt: float) -> GroundFromTests:
        """Return what still counts.

        Args:
            ground: estimates of the casters' own, and loads.
            force: of the ground on the wheels (n, 2) [N].
            speed: at which each wheel goes (n,) [m/s].
            dt: time since the step before [s].

        Raises:
            TerrainError: a force or a speed that is not finite or of a wrong shape, or dt is not positive.
        """
        require_dt(dt)
        n = len(self.mu_p)
        for name, values, shape in (("force", force, (n, 2)), ("speed", speed, (n,))):
            if values.shape != shape or not np.isfinite(values).all():
                raise TerrainError(f"{name} = {values.tolist()} is not allowed; allowed: finite numbers, shape {shape}")
        loaded = ground.normal_force > 0.0
        friction = np.where(loaded, np.hypot(*force.T) / np.where(loaded, ground.normal_force, 1.0), 0.0)
        too_much = friction > np.where(self.known, self.mu_p, np.inf) * (1.0 + ABOVE_PART)
        way, above = self.way + np.abs(speed) * dt, np.maximum(self.above + np.where(too_much, dt, -dt), 0.0)
        counts = self.known & ~ground.valid & (above < ABOVE_TIME) & (way <= TerrainParameters().reach)
        return dataclasses.replace(
            self, mu_p=np.where(counts, self.mu_p, np.nan), lambda_p=np.where(counts, self.lambda_p, np.nan), way=way,
            above=above,
        )  # fmt: skip

    def beside(self, ground: RobotTerrainEstimate) -> RobotTerrainEstimate:
        """Return the estimates with those of tests where there are no own ones, for `shared_friction`."""
        return dataclasses.replace(
            ground, mu_p=np.where(self.known, self.mu_p, ground.mu_p), valid=ground.valid | self.known,
            lambda_p=np.where(self.known, self.lambda_p, ground.lambda_p), suspect=ground.suspect & ~self.known,
        )  # fmt: skip
