"""The ground under every caster of a robot, and under the robot as a whole.

Every caster has an estimator of its own (`terrain_estimator`), with its own tyre. What they are given comes from a slip
observer: slip velocities and contact forces in the wheel frames; or, where something else measures the robot's motion, from
that and the motor torques:    eps = B q_dot - A V (3.28),    F_x = tau_rho / r - (I_rho / r^2) d(r rho_dot)/dt (3.45),    F_y
by statics.

Loads follow from the weight and from the contact forces themselves, which accelerate the robot at the height of its centre.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import joint_matrix_blocks, wheel_jacobian_kernel
from pcw_description.robot_description import DRIVE, GRAVITY, STEER, FloatArray, RobotDescription
from pcw_description.support_forces import support_forces

from .errors import TerrainError, require_dt
from .friction_shape import shape_table
from .terrain_estimator import (
    CHANGES,
    COVARIANCE,
    FRICTION,
    IS_VALID,
    LAMBDA_P,
    LAMBDA_VARIANCE,
    MISFIT,
    MU_P,
    MU_VARIANCE,
    REASON,
    REASONS,
    RESULTS,
    SLIP,
    SUSPECT,
    TerrainParameters,
    TerrainState,
    ground_force,
    initial_state,
    run_wheels,
)

# Estimates of casters that differ by more than this many standard deviations stand on different grounds.
DIFFERENT_GROUND = 3.0
# Part of the critical slip at which a wheel feels what ground it is on.
FELT_SLIP = 0.6
# What observers and loads leave over on a robot that is as its file says; see `TerrainParameters`.
SLIP_ACCURACY, FRICTION_ACCURACY = 0.004, 0.02


@dataclasses.dataclass(frozen=True)
class RobotReading:
    """What is known of all wheels at one time; arrays (n, 2) are longitudinal and lateral, in the wheel frames.

    Attributes:
        sensed: B q_dot, the velocities of the wheel centres as the joints have it (n, 2) [m/s].
        slip: slip velocities B q_dot - A V (n, 2) [m/s].
        force: of the ground on the wheels (n, 2) [N].
        steer_angle: (n,) [rad].
        known: whose slip is known without believing in a friction curve (n,); None: of all. A slip that was computed from
            its own force by a curve that is believed in says nothing of the ground.
    """

    sensed: FloatArray
    slip: FloatArray
    force: FloatArray
    steer_angle: FloatArray
    known: np.ndarray | None = None


@dataclasses.dataclass(frozen=True)
class RobotTerrainEstimate:
    """What is known of the ground.

    Attributes:
        mu_p, lambda_p: per caster (n,) [1]; NaN where nothing is known.
        covariance: of (log mu_p, log lambda_p) per caster (n, 2, 2); inf where nothing is known.
        valid: per caster (n,).
        reason: why not, per caster; of `terrain_estimator.REASONS`.
        slip, friction: current, filtered, per caster (n,) [1].
        misfit: of the residuals, per caster (n,) [1].
        changes: how often the ground has changed, per caster (n,).
        suspect: whether what is felt now contradicts the estimate, per caster (n,).
        normal_force: loads used (n,) [N].
        robot: mu_p and lambda_p of the robot (2,), from all valid casters, NaN where there is none.
        robot_covariance: of their logarithms (2, 2).
        uniform: whether all valid casters stand on the same ground, as far as can be told.
    """

    mu_p: FloatArray
    lambda_p: FloatArray
    covariance: FloatArray
    valid: np.ndarray
    reason: tuple[str, ...]
    slip: FloatArray
    friction: FloatArray
    misfit: FloatArray
    changes: np.ndarray
    suspect: np.ndarray
    normal_force: FloatArray
    robot: FloatArray
    robot_covariance: FloatArray
    uniform: bool

    @property
    def felt_now(self) -> np.ndarray:
        """Where a valid estimate is about the ground under the wheel now: it slips enough, and nothing speaks against it."""
        return self.valid & ~self.suspect & (np.abs(self.slip) >= FELT_SLIP * self.lambda_p)


@compiled
def _fuse(results):  # type: ignore[no-untyped-def]
    """Return the weighted mean of the logarithms (2,) of valid rows, its covariance (2, 2), and the largest distance.

    Rows are (n, RESULTS); the distance is that of two friction coefficients, in standard deviations.
    """
    information, vector, farthest = np.zeros((2, 2)), np.zeros(2), 0.0
    for i in range(len(results)):
        row = results[i]
        if row[IS_VALID] == 0.0:
            continue
        a, b, c = row[MU_VARIANCE], row[COVARIANCE], row[LAMBDA_VARIANCE]
        determinant = a * c - b * b
        log_mu, log_slip = math.log(row[MU_P]), math.log(row[LAMBDA_P])
        information[0, 0] += c / determinant
        information[0, 1] -= b / determinant
        information[1, 1] += a / determinant
        vector[0] += (c * log_mu - b * log_slip) / determinant
        vector[1] += (a * log_slip - b * log_mu) / determinant
        for k in range(i):
            if results[k, IS_VALID] > 0.0:
                distance = abs(log_mu - math.log(results[k, MU_P])) / math.sqrt(a + results[k, MU_VARIANCE])
                farthest = max(farthest, distance)
    information[1, 0] = information[0, 1]
    determinant = information[0, 0] * information[1, 1] - information[0, 1] ** 2
    covariance = np.full((2, 2), np.inf)
    mean = np.full(2, np.nan)
    if determinant > 0.0:
        covariance[0, 0], covariance[1, 1] = information[1, 1] / determinant, information[0, 0] / determinant
        covariance[0, 1] = covariance[1, 0] = -information[0, 1] / determinant
        mean[0] = covariance[0, 0] * vector[0] + covariance[0, 1] * vector[1]
        mean[1] = covariance[1, 0] * vector[0] + covariance[1, 1] * vector[1]
    return mean, covariance, farthest


@compiled
def _loads(  # type: ignore[no-untyped-def]
    weight, centre_of_mass, height, spring, steer_axis, caster_offset, steer_angle, force, level, normal_force
):
    """Fill normal_force (n,): weight, and what forces at the ground tilt about a centre at `height`."""
    n = len(steer_angle)
    centre = np.empty((n, 2))
    push_x, push_y = 0.0, 0.0
    for i in range(n):
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        centre[i, 0] = steer_axis[i, 0] + c * caster_offset[i, 0] - s * caster_offset[i, 1]
        centre[i, 1] = steer_axis[i, 1] + s * caster_offset[i, 0] + c * caster_offset[i, 1]
        push_x += c * force[i, 0] - s * force[i, 1]
        push_y += s * force[i, 0] + c * force[i, 1]
    support_forces(
        weight,
        weight * centre_of_mass[0] - height * push_x,
        weight * centre_of_mass[1] - height * push_y,
        spring,
        centre,
        level,
        normal_force,
    )


class RobotTerrain:
    """The estimators of all casters; see the module's docstring.

    Args:
        robot: the robot; the friction numbers of its grounds are not used, only the shape of their curves.
        parameters: how the ground is estimated; contact and inertia are those of each caster, whatever stands in it.
            None: the defaults with what observers leave over.
        gravity: [m/s^2].

    Raises:
        KinematicsError: a caster without offset, of whose side force the steering torque says nothing.
    """

    def __init__(self, robot: RobotDescription, parameters: TerrainParameters | None = None, gravity: float = GRAVITY) -> None:
        robot.require_torque_control()
        self.robot, self.n = robot, robot.n
        base = parameters or TerrainParameters(slip_accuracy=SLIP_ACCURACY, friction_accuracy=FRICTION_ACCURACY)
        self.parameters = base
        each = [dataclasses.replace(base, contact=tyre) for tyre in robot.tyres]
        self._tables = np.stack([shape_table(p.contact) for p in each])
        self._with_force = np.stack([dataclasses.replace(p, inertia=0.0).numbers() for p in each])
        inertia = [c.wheel.inertia_axle + float(robot.armature[i, DRIVE, DRIVE]) for i, c in enumerate(robot.casters)]
        self._with_torque = np.stack(
            [dataclasses.replace(p, inertia=inertia[i] / robot.wheel_radius[i] ** 2).numbers() for i, p in enumerate(each)]
        )
        self._B = joint_matrix_blocks(robot)
        masses = np.array([robot.chassis.mass, *(c.module.mass for c in robot.casters)])
        places = np.array([robot.chassis.com[:2], *robot.steer_axis])
        self._weight = robot.total_mass * gravity
        self._centre = (masses[:, None] * places).sum(axis=0) / masses.sum()
        self._height = robot.chassis.mass * robot.chassis.com[2] / robot.total_mass
        self._level = np.zeros(robot.n)

    def initial_state(self) -> TerrainState:
        """Return the state before the first reading."""
        return initial_state(self.n)

    def normal_force(self, steer_angle: FloatArray, force: FloatArray) -> FloatArray:
        """Return the loads (n,) [N] at headings (n,) [rad] and contact forces (n, 2) [N]."""
        loads = np.empty(self.n)
        _loads(
            self._weight, self._centre, self._height, 1e5, self.robot.steer_axis, self.robot.caster_offset,
            np.ascontiguousarray(steer_angle), np.ascontiguousarray(force), self._level, loads,
        )  # fmt: skip
        return loads

    def step(self, state: TerrainState, reading: RobotReading, dt: float) -> tuple[TerrainState, RobotTerrainEstimate]:
        """Take one reading with forces that are those of the ground.

        Args:
            state: after the reading before; it is not changed.
            reading: of all wheels.
            dt: measured time since the reading before [s].

        Returns:
            New state and estimate.

        Raises:
            TerrainError: a reading that is not finite or of a wrong shape, or dt is not positive; the caller keeps its state.
        """
        return self._advance(self._with_force, state, reading, dt)

    def step_with_twist(
        self,
        state: TerrainState,
        position: FloatArray,
        velocity: FloatArray,
        effort: FloatArray,
        twist: FloatArray,
        dt: float,
        known: np.ndarray | None = None,
    ) -> tuple[TerrainState, RobotTerrainEstimate]:
        """Take one reading of joints (n, 2) and motor torques (n, 2), with the twist (3,) of base_link known otherwise.

        `known` (n,) tells of which casters' own curves that twist does not depend; None: of none.

        Raises:
            TerrainError: as `step`.
        """
        for name, values, shape in (
            ("position", position, (self.n, 2)), ("velocity", velocity, (self.n, 2)), ("effort", effort, (self.n, 2)),
            ("twist", twist, (3,)),
        ):  # fmt: skip
            _check(name, values, shape)
        steer_angle = np.ascontiguousarray(position[:, STEER])
        jacobian = wheel_jacobian_kernel(self.robot.steer_axis, self.robot.caster_offset, steer_angle)
        sensed = np.einsum("nij,nj->ni", self._B, velocity)
        slip = sensed - (jacobian @ twist).reshape(-1, 2)
        along = effort[:, DRIVE] / self.robot.wheel_radius
        offset = self.robot.caster_offset
        across = (offset[:, 1] * along - effort[:, STEER]) / offset[:, 0]
        reading = RobotReading(sensed, slip, np.stack([along, across], axis=1), steer_angle, known)
        return self._advance(self._with_torque, state, reading, dt)

    def _advance(
        self, numbers: FloatArray, state: TerrainState, reading: RobotReading, dt: float
    ) -> tuple[TerrainState, RobotTerrainEstimate]:
        require_dt(dt)
        n = self.n
        for name, shape in (("sensed", (n, 2)), ("slip", (n, 2)), ("force", (n, 2)), ("steer_angle", (n,))):
            _check(name, getattr(reading, name), shape)
        force = reading.force
        if numbers is self._with_torque:
            # What turns the wheel itself does not push the robot.
            force = np.column_stack([ground_force(numbers, state, force[:, 0], dt), force[:, 1]])
        loads = self.normal_force(reading.steer_angle, force)
        values = np.empty((1, n, 6))
        values[0, :, 0] = reading.sensed[:, 0]
        values[0, :, 1] = reading.sensed[:, 0] - reading.slip[:, 0]
        values[0, :, 2] = reading.force[:, 0]
        # A load below zero is that of a reading whose slip is not known.
        values[0, :, 3] = loads if reading.known is None else np.where(reading.known, loads, -loads)
        values[0, :, 4] = reading.slip[:, 1]
        values[0, :, 5] = reading.force[:, 1]
        state = TerrainState(state.numbers.copy(), state.sums.copy(), state.history.copy())
        results = np.empty((1, n, RESULTS))
        run_wheels(self._tables, numbers, state.numbers, state.sums, state.history, values, dt, 1, results)
        return state, self._estimate(results[0], loads)

    def _estimate(self, results: FloatArray, loads: FloatArray) -> RobotTerrainEstimate:
        known = results[:, MU_P] > 0.0
        covariance = np.full((self.n, 2, 2), np.inf)
        covariance[known] = results[known][:, [MU_VARIANCE, COVARIANCE, COVARIANCE, LAMBDA_VARIANCE]].reshape(-1, 2, 2)
        mean, robot_covariance, farthest = _fuse(results)
        return RobotTerrainEstimate(
            mu_p=np.where(known, results[:, MU_P], np.nan),
            lambda_p=np.where(known, results[:, LAMBDA_P], np.nan),
            covariance=covariance,
            valid=results[:, IS_VALID] > 0.0,
            reason=tuple(REASONS[int(reason)] for reason in results[:, REASON]),
            slip=results[:, SLIP],
            friction=results[:, FRICTION],
            misfit=results[:, MISFIT],
            changes=results[:, CHANGES].astype(int),
            suspect=results[:, SUSPECT] > 0.0,
            normal_force=loads,
            robot=np.exp(mean),
            robot_covariance=robot_covariance,
            uniform=bool(farthest <= DIFFERENT_GROUND),
        )


def _check(name: str, values: FloatArray, shape: tuple[int, ...]) -> None:
    if values.shape != shape or not np.isfinite(values).all():
        raise TerrainError(f"{name} = {values.tolist()} is not allowed; allowed: finite numbers, shape {shape}")
