"""The ground under all casters from what a slip observer says, which believes in the ground of the robot file itself.

An observer knows well which wheels have let go, and the forces; how fast the robot goes it takes from friction curves that it
believes in. The slip of a wheel that has let go is measured here against the wheels that grip instead,

    V = (A_g^T A_g)^-1 A_g^T (B q_dot - creep)_g,      eps_i = (B q_dot - A V)_i,

g those that grip, with the creep that their forces take on the ground as it is believed to be by now: by the estimators
(`robot_terrain`), by the slopes (`slip_slope`), by the file before (`shared_friction`). Where fewer than two grip, the
observer's slip is taken. Estimators, slopes and belief depend on each other; this is the one place where they meet.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pcw_description.differential_kinematics import wheel_jacobian_kernel
from pcw_description.robot_description import FloatArray, RobotDescription

from .believed_slip import independent_slip
from .robot_terrain import RobotReading, RobotTerrain, RobotTerrainEstimate
from .shared_friction import SharedFriction, shared_friction
from .slip_slope import SlipSlope, SlipSlopeEstimate, SlipSlopeState
from .terrain_estimator import TerrainState

# Use of friction beyond which creep is not followed, as the curve has no slope there [1].
GREATEST_USE = 0.95
# Wheels that have to grip for the motion of the robot to follow from them; one leaves the turning open.
LEAST_GRIPPING = 2


@dataclasses.dataclass(frozen=True)
class ObservedGroundState:
    """What it remembers: the states of estimators and slopes, and what is believed (None: the file)."""

    terrain: TerrainState
    slopes: SlipSlopeState
    told: SharedFriction


@dataclasses.dataclass(frozen=True)
class ObservedGroundOutput:
    """What one reading gives: estimates, slopes, and what to believe."""

    ground: RobotTerrainEstimate
    slopes: SlipSlopeEstimate
    told: SharedFriction


def creep(
    robot: RobotDescription, sensed: FloatArray, force: FloatArray, normal_force: FloatArray, believed: SharedFriction
) -> FloatArray:
    """Return the slip velocities (n, 2) [m/s] that forces take on the lower root of Kiencke's curve (3.47) [Li2009].

    Args:
        robot: whose tyres have the ratios of lateral to longitudinal.
        sensed: B q_dot (n, 2) [m/s].
        force: of the ground on the wheels (n, 2) [N].
        normal_force: (n,) [N].
        believed: of the ground.
    """
    slip = np.zeros_like(force)
    for i, tyre in enumerate(robot.tyres):
        ratio = np.array([1.0, tyre.mu_p / tyre.lateral.mu_p])
        use = force[i] * ratio / max(believed.mu_p[i] * float(normal_force[i]), 1e-9)
        size = min(float(np.hypot(use[0], use[1])), GREATEST_USE)
        if size > 0.0:
            along = use / np.hypot(use[0], use[1]) * np.array([1.0, tyre.lateral.lambda_p / tyre.lambda_p])
            slip[i] = along * believed.lambda_p[i] * size / (1.0 + np.sqrt(1.0 - size * size)) * np.hypot(*sensed[i])
    return slip


class ObservedGround:
    """Estimators, slopes and belief of one robot; see the module's docstring.

    Args:
        robot: as its file says.

    Raises:
        KinematicsError: a caster without offset.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self.robot = robot
        self.terrain, self.slopes = RobotTerrain(robot), SlipSlope(robot)

    def initial_state(self) -> ObservedGroundState:
        """Return the state before the first reading."""
        return ObservedGroundState(
            self.terrain.initial_state(), self.slopes.initial_state(), shared_friction(self.robot, None, None)
        )

    def step(
        self, state: ObservedGroundState, reading: RobotReading, dt: float
    ) -> tuple[ObservedGroundState, ObservedGroundOutput]:
        """Take what joints and observer say.

        Args:
            state: after the reading before; it is not changed.
            reading: with the observer's slip and forces; `known` (n,) where the observer vouches for the slip, None: of all.
            dt: measured time since the reading before [s].

        Returns:
            New state and output.

        Raises:
            TerrainError: a reading that is not finite or of a wrong shape, or dt is not positive; the caller keeps its state.
        """
        loads = self.terrain.normal_force(reading.steer_angle, reading.force)
        known = independent_slip(self.robot, reading.sensed, reading.slip, reading.force, loads)
        if reading.known is not None:
            known &= reading.known
        slip = reading.slip
        if known.any() and np.isfinite(slip).all():
            slip = self._slip_against_others(reading, loads, ~known, state.told)
        reading = dataclasses.replace(reading, slip=slip, known=known)
        terrain, ground = self.terrain.step(state.terrain, reading, dt)
        creeping, slopes = self.slopes.step(state.slopes, reading, loads, dt)
        told = shared_friction(self.robot, ground, slopes)
        return ObservedGroundState(terrain, creeping, told), ObservedGroundOutput(ground, slopes, told)

    def _slip_against_others(
        self, reading: RobotReading, loads: FloatArray, grips: np.ndarray, believed: SharedFriction
    ) -> FloatArray:
        grips = grips & (loads > 0.0)
        if grips.sum() < LEAST_GRIPPING:
            return reading.slip
        A = wheel_jacobian_kernel(self.robot.steer_axis, self.robot.caster_offset, reading.steer_angle)
        rolled = (reading.sensed - creep(self.robot, reading.sensed, reading.force, loads, believed)).ravel()
        rows = np.repeat(grips, 2)
        rest = A[rows]
        twist = np.linalg.solve(rest.T @ rest, rest.T @ rolled[rows])
        slip: FloatArray = reading.sensed - (A @ twist).reshape(-1, 2)
        return np.where(grips[:, None], reading.slip, slip)
