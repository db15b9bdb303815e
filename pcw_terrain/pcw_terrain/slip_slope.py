"""What each wheel holds compared with the others, from creep alone: slip slopes, long before any wheel lets go.

Friction takes slip, on the rising branch nearly in proportion, and the slope tells grounds apart (F. Gustafsson, Slip-based
tire-road friction estimation, Automatica 33, 1997). With the compliance c of a wheel on its ground, friction mu and the
tyre's relaxation length L,

    eps_i = c_i d_i,      d_i = |v_i| mu_i + L d(mu_i)/dt,      mu_i = F_i / F_zi,      c = lambda_p / (mu_p g'(0)) at least.

How fast the robot really goes is not needed: what encoders see of the slip is what contradicts a rigid motion,

    (I - A A^+) B q_dot = (I - A A^+) D c,      D = blockdiag(d_i),

2n - 3 equations for n compliances. Both sides pass the same two-pole filter and go into recursive least squares. What all
wheels have in common is not seen: of all answers that fit equally well the one is taken in which the wheels that hold best
are as the robot file says, the least sum of |c_i - c_file|, those below counted more, by iteratively reweighted least
squares, one iteration per reading. So `friction` is right in its ratios, and it is the peak friction itself as far as the
best wheels stand on the ground of the file. That is what sharing forces needs, and no more; see `shared_friction`.

A wheel beyond its peak has the compliance of its secant, which is large: the answer then is that it holds little, which is so.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import rigid_motion_kernel
from pcw_description.robot_description import FloatArray, RobotDescription

from .errors import TerrainError, require, require_dt
from .friction_shape import shape_table
from .robot_terrain import RobotReading
from .terrain_estimator import GREATEST_FRICTION, LEAST_FRICTION, POLE_PER_CUT_OFF, noise_gain

# Time over which the noise of the readings is averaged [s].
NOISE_MEMORY = 0.5
# Filtered readings closer than so many time constants of the filter say the same.
INDEPENDENT = 4.0
# A compliance this near that of the file, relative, is weighted as if it were so far from it.
NEAREST = 0.1
# To hold better than the file says is so many times less to be expected than to hold worse.
BETTER = 4.0

# Layout of the numbers of a robot, and of the scalars of the state.
_CUT_OFF, _MEMORY, _ACCURACY, _ACCURACY_SHARE, _SPREAD = range(5)
_READINGS, _NOISE = range(2)


@dataclasses.dataclass(frozen=True)
class SlipSlopeParameters:
    """How slopes are estimated.

    Attributes:
        cut_off: of the filter on all signals [Hz].
        memory: informative time after which readings are forgotten [s].
        accuracy: slip velocity that no friction explains, whatever the speed [m/s].
        accuracy_share: the same per speed: wheel radii and headings that are not quite those of the file [1].
        spread: how far, in parts of that of the file, a compliance is off without a reason [1].
    """

    cut_off: float = 20.0
    memory: float = 0.3
    accuracy: float = 0.0005
    accuracy_share: float = 0.003
    spread: float = 1.0

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            TerrainError: names the field, its value and what is allowed.
        """
        require("cut_off", self.cut_off, above=0.0, maximum=200.0)
        for name in ("memory", "accuracy", "spread"):
            require(name, getattr(self, name), above=0.0)
        require("accuracy_share", self.accuracy_share, minimum=0.0, maximum=0.5)


@dataclasses.dataclass(frozen=True)
class SlipSlopeState:
    """What it remembers.

    Attributes:
        scalars: number of readings, variance of the noise of the slip (2,).
        filters: two stages of every column of (I - A A^+) D and, last, of the slip (2, 2n, n + 1).
        slip_before: the slip of the two readings before (2, 2n) [m/s].
        friction_before: mu of the reading before (n, 2) [1].
        information: of the least squares (n, n).
        vector: of the same (n,).
        compliance: c (n,) [1].
    """

    scalars: FloatArray
    filters: FloatArray
    slip_before: FloatArray
    friction_before: FloatArray
    information: FloatArray
    vector: FloatArray
    compliance: FloatArray


@dataclasses.dataclass(frozen=True)
class SlipSlopeEstimate:
    """What is found.

    Attributes:
        friction: mu_p of the robot file times the slope found over the slope of the file (n,) [1].
        compliance: slip ratio per friction (n,) [1].
        spread: standard deviation of the compliance, relative to it (n,) [1]; large where nothing has been felt.
    """

    friction: FloatArray
    compliance: FloatArray
    spread: FloatArray


@compiled
def _solve_positive(matrix, right):  # type: ignore[no-untyped-def]
    """Return the solution of a symmetric positive definite system with the right-hand sides (n, m), by Cholesky."""
    n = len(matrix)
    lower, solved = np.zeros((n, n)), right.copy()
    for i in range(n):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            lower[i, j] = math.sqrt(max(rest, 1e-300)) if i == j else rest / lower[j, j]
    for column in range(right.shape[1]):
        for i in range(n):
            for k in range(i):
                solved[i, column] -= lower[i, k] * solved[k, column]
            solved[i, column] /= lower[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                solved[i, column] -= lower[k, i] * solved[k, column]
            solved[i, column] /= lower[i, i]
    return solved


@compiled
def _advance(  # type: ignore[no-untyped-def]
    numbers, steer_axis, caster_offset, tyre, limits, scalars, filters, slip_before, friction_before, information, vector,
    compliance, steer_angle, sensed, friction, dt,
):
    """Take one reading in place; returns the relative spread (n,). `tyre` (n, 3): c of the file, lateral ratio, L."""
    n = len(steer_angle)
    first = scalars[_READINGS] == 0.0
    raw = np.zeros((2 * n, n + 1))
    _, slip, _ = rigid_motion_kernel(steer_axis, caster_offset, steer_angle, sensed)
    fastest = 0.0
    for i in range(n):
        speed = math.hypot(sensed[i, 0], sensed[i, 1])
        fastest = max(fastest, speed)
        column = np.zeros((n, 2))
        for row in range(2):
            ratio = tyre[i, 1] if row == 1 else 1.0
            grows = 0.0 if first else (friction[i, row] - friction_before[i, row]) / dt
            column[i, row] = ratio * (speed * friction[i, row] + tyre[i, 2] * grows)
        _, seen, _ = rigid_motion_kernel(steer_axis, caster_offset, steer_angle, column)
        raw[:, i] = seen.ravel()
    raw[:, n] = slip.ravel()
    friction_before[:] = friction
    pole = POLE_PER_CUT_OFF * numbers[_CUT_OFF]
    share = 1.0 - math.exp(-pole * dt)
    if first:
        filters[0], filters[1] = raw, raw
    else:
        filters[0] += share * (raw - filters[0])
        filters[1] += share * (filters[0] - filters[1])
    if scalars[_READINGS] >= 2.0:
        # The second difference of white noise has six times its variance; a smooth signal has next to none.
        square = 0.0
        for row in range(2 * n):
            square += (raw[row, n] - 2.0 * slip_before[0, row] + slip_before[1, row]) ** 2 / (6.0 * (2 * n - 3))
        forgotten = max(1.0 - math.exp(-dt / NOISE_MEMORY), 1.0 / (scalars[_READINGS] - 1.0))
        scalars[_NOISE] += forgotten * (square - scalars[_NOISE])
    slip_before[1] = slip_before[0]
    slip_before[0] = raw[:, n]
    scalars[_READINGS] += 1.0
    signals = filters[1]
    variance = noise_gain(pole, dt) * scalars[_NOISE] + numbers[_ACCURACY] ** 2 + (numbers[_ACCURACY_SHARE] * fastest) ** 2
    weight = min(dt * pole / INDEPENDENT, 1.0) / variance
    # Creep that would be seen on the ground of the file makes older readings forgotten; without it none are.
    felt = 0.0
    for row in range(2 * n):
        for i in range(n):
            felt += (signals[row, i] * tyre[i, 0]) ** 2 / variance
    keep = math.exp(-dt / numbers[_MEMORY] * felt / (1.0 + felt))
    for i in range(n):
        vector[i] *= keep
        for j in range(n):
            information[i, j] *= keep
    if scalars[_READINGS] > 2.0:
        for row in range(2 * n):
            for i in range(n):
                vector[i] += weight * signals[row, i] * signals[row, n]
                for j in range(n):
                    information[i, j] += weight * signals[row, i] * signals[row, j]
    matrix, right, vague = information.copy(), np.zeros((n, 1)), information.copy()
    for i in range(n):
        nominal = tyre[i, 0]
        away = max(abs(compliance[i] - nominal), NEAREST * nominal)
        prior = (BETTER if compliance[i] < nominal else 1.0) / (numbers[_SPREAD] * nominal * away)
        matrix[i, i] += prior
        right[i, 0] = vector[i] + prior * nominal
        vague[i, i] += 1.0 / (numbers[_SPREAD] * nominal) ** 2
    solved, covariance = _solve_positive(matrix, right), _solve_positive(vague, np.eye(n))
    spread = np.empty(n)
    for i in range(n):
        compliance[i] = min(max(solved[i, 0], limits[i, 0]), limits[i, 1])
        spread[i] = math.sqrt(max(covariance[i, i], 0.0)) / compliance[i]
    return spread


class SlipSlope:
    """The slip slopes of one robot's wheels; see the module's docstring.

    Args:
        robot: the robot; its ground is that from which differences are told.
        parameters: how slopes are estimated.
    """

    def __init__(self, robot: RobotDescription, parameters: SlipSlopeParameters | None = None) -> None:
        self.robot, self.n = robot, robot.n
        self.parameters = p = parameters or SlipSlopeParameters()
        self._numbers = np.array([p.cut_off, p.memory, p.accuracy, p.accuracy_share, p.spread])
        self._friction = np.array([tyre.mu_p for tyre in robot.tyres])
        rows = []
        for tyre in robot.tyres:
            nominal = tyre.lambda_p / (tyre.mu_p * float(shape_table(tyre)[0, 1]))
            lateral = (tyre.lateral.lambda_p / tyre.lateral.mu_p) / (tyre.lambda_p / tyre.mu_p)
            rows.append([nominal, lateral, tyre.relaxation_length])
        self._tyre = np.array(rows)
        steep, flat = GREATEST_FRICTION / self._friction, LEAST_FRICTION / self._friction
        self._limits = np.column_stack([self._tyre[:, 0] / np.maximum(steep, 1.0), self._tyre[:, 0] / np.minimum(flat, 1.0)])

    def initial_state(self) -> SlipSlopeState:
        """Return the state before the first reading: all is as the robot file says."""
        n = self.n
        return SlipSlopeState(
            np.zeros(2), np.zeros((2, 2 * n, n + 1)), np.zeros((2, 2 * n)), np.zeros((n, 2)), np.zeros((n, n)), np.zeros(n),
            self._tyre[:, 0].copy(),
        )  # fmt: skip

    def step(
        self, state: SlipSlopeState, reading: RobotReading, normal_force: FloatArray, dt: float
    ) -> tuple[SlipSlopeState, SlipSlopeEstimate]:
        """Take one reading.

        Args:
            state: after the reading before; it is not changed.
            reading: of all wheels; its slip is not looked at, what the joints sense and the forces are.
            normal_force: loads (n,) [N]; a wheel without load says nothing.
            dt: measured time since the reading before [s].

        Returns:
            New state and estimate.

        Raises:
            TerrainError: a reading that is not finite or of a wrong shape, or dt is not positive; the caller keeps its state.
        """
        require_dt(dt)
        n = self.n
        for name, values, shape in (
            ("sensed", reading.sensed, (n, 2)), ("force", reading.force, (n, 2)),
            ("steer_angle", reading.steer_angle, (n,)), ("normal_force", normal_force, (n,)),
        ):  # fmt: skip
            if values.shape != shape or not np.isfinite(values).all():
                raise TerrainError(f"{name} = {values.tolist()} is not allowed; allowed: finite numbers, shape {shape}")
        # More friction than any ground has is a force that is not one: a start-up, a bump.
        least = np.linalg.norm(reading.force, axis=1) / GREATEST_FRICTION
        friction = np.where(normal_force[:, None] > 0.0, reading.force / np.maximum(normal_force, least + 1e-9)[:, None], 0.0)
        after = SlipSlopeState(*(np.array(getattr(state, field.name)) for field in dataclasses.fields(state)))
        spread = _advance(
            self._numbers, self.robot.steer_axis, self.robot.caster_offset, self._tyre, self._limits,
            after.scalars, after.filters, after.slip_before, after.friction_before, after.information, after.vector,
            after.compliance, np.ascontiguousarray(reading.steer_angle), np.ascontiguousarray(reading.sensed), friction, dt,
        )  # fmt: skip
        if not all(np.isfinite(values).all() for values in (after.compliance, after.information, after.filters)):
            raise TerrainError(f"sensed = {reading.sensed.tolist()} is not allowed; allowed: velocities of a robot")
        found = self._friction * self._tyre[:, 0] / after.compliance
        return after, SlipSlopeEstimate(found, after.compliance.copy(), spread)
