"""The procedure of section 4.1.1, (4.6)-(4.8) [Li2009]: which wheels slip, from the projected residuals of one axis at a time.

For the rolling joints and the steering joints separately, with eps_hat = (I - A A^+) B q_dot (4.5):

    1. |eps_hat_k| < threshold_k for all k: no wheel slips.                                                        (4.6)
    2. Else look for pairs i, j with eps_hat_i eps_hat_j > 0 and |eps_hat_i - eps_hat_j| <= threshold.               (4.7)
       No pair: all wheels slip, or one does not and cannot be told.
       Of several pairs the one of smallest |eps_hat| does not slip. Any further wheel k with
       eps_hat_i eps_hat_k > 0 and |eps_hat_i - eps_hat_k| <= threshold does not slip either;                        (4.8)
       the others slip where eps_hat_k > 0 and skid where it is negative (along their motion).
    3. The twist from the wheels that do not slip, V = A_ij^+ B_ij q_dot_ij, and with it the slip of those that do.

(4.7) is printed without the modulus; without it every pair would satisfy it in one order. The threshold is that of
`slip_noise`, gate sigma_k, in place of the constant of the thesis.

What it misses is known (`slip_consensus` does not): the projection turns slip in the rolling axis into residuals of the
steering axis and the other way round, so that single axes contradict each other; it is kept as the reference.
"""

from __future__ import annotations

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import rigid_motion_kernel, wheel_jacobian_kernel
from pcw_description.robot_description import STEER, FloatArray, RobotDescription

from .normal_equations import full_inverse, is_determined, parts_of_rows, solve, sum_of
from .slip_noise import SlipNoise, sensed_kernel, variance_kernel
from .slip_verdict import (
    ConfirmParameters,
    SlipFinding,
    Verdict,
    check_measurement,
    confirm_kernel,
    describe_kernel,
    finding_of,
)

_CONSISTENT, _SLIP, _CANNOT_KNOW = int(Verdict.CONSISTENT), int(Verdict.SLIP), int(Verdict.CANNOT_KNOW)


class SlipProcedure:
    """The detector for one robot; arguments as of `SlipConsensus`."""

    def __init__(
        self, robot: RobotDescription, noise: SlipNoise | None = None, confirm: ConfirmParameters | None = None
    ) -> None:
        self.robot = robot
        self.noise = noise or SlipNoise.of_robot(robot)
        self.confirm = confirm or ConfirmParameters()
        self._numbers = np.concatenate(
            [self.noise.array(), [self.confirm.confirm_time, self.confirm.release_time, self.confirm.ratio_speed]]
        )
        self._geometry = np.column_stack([robot.steer_axis, robot.caster_offset, robot.wheel_radius])

    def initial_state(self) -> FloatArray:
        """Return the state (4n,): confirmed slip, and for how long the measurements have contradicted it [s]."""
        return np.zeros(4 * self.robot.n)

    def step(
        self, state: FloatArray, joint_position: FloatArray, joint_velocity: FloatArray, dt: float
    ) -> tuple[FloatArray, SlipFinding]:
        """Decide on one measurement; arguments, result and errors as of `SlipConsensus.step`."""
        check_measurement(self.robot, joint_position, joint_velocity, dt)
        state, *found = _step_kernel(
            self._geometry, np.ascontiguousarray(joint_position, dtype=np.float64),
            np.ascontiguousarray(joint_velocity, dtype=np.float64), float(dt), self._numbers, state,
        )
        return state, finding_of(*found)


@compiled
def slipping_wheels(residual, threshold):  # type: ignore[no-untyped-def]
    """Return which wheels slip (n,), and whether it can be known, from the residuals of one axis (n,), (4.6)-(4.8)."""
    n = len(residual)
    slips = np.zeros(n, dtype=np.bool_)
    if (np.abs(residual) < threshold).all():
        return slips, True
    first, smallest = -1, np.inf
    for i in range(n):
        for j in range(i + 1, n):
            allowed = max(threshold[i], threshold[j])
            if residual[i] * residual[j] > 0.0 and abs(residual[i] - residual[j]) <= allowed:
                size = max(abs(residual[i]), abs(residual[j]))
                if size < smallest:
                    first, smallest = i if abs(residual[i]) < abs(residual[j]) else j, size
    if first < 0:
        return slips, False
    for k in range(n):
        same_sign = residual[first] * residual[k] > 0.0
        slips[k] = not (same_sign and abs(residual[first] - residual[k]) <= max(threshold[first], threshold[k]))
    return slips, True


@compiled
def _step_kernel(geometry, position, velocity, dt, numbers, state):  # type: ignore[no-untyped-def]
    steer_axis, caster_offset, wheel_radius = geometry[:, 0:2], geometry[:, 2:4], geometry[:, 4]
    noise, n = numbers[:8], len(geometry)
    flagged, elapsed = state[: 2 * n].copy().reshape((n, 2)), state[2 * n :].copy().reshape((n, 2))
    sensed = sensed_kernel(caster_offset, wheel_radius, velocity)
    steer_angle = position[:, STEER]
    twist, residual, _ = rigid_motion_kernel(steer_axis, caster_offset, steer_angle, sensed)
    variance, _ = variance_kernel(caster_offset, wheel_radius, velocity, sensed, twist[2], noise)
    arrays, masks = np.empty((3, n, 2)), np.zeros((3, n, 2), dtype=np.bool_)
    slip, threshold, suspect = arrays[0], arrays[2], masks[0]
    threshold[:] = noise[7] * np.sqrt(variance)
    verdict, chosen = _CONSISTENT, 0
    for axis in range(2):
        slips, can_know = slipping_wheels(residual[:, axis].copy(), threshold[:, axis].copy())
        if not can_know:
            verdict = _CANNOT_KNOW
        for i in range(n):
            if slips[i]:
                suspect[i, axis] = True
                chosen |= 1 << (2 * i + axis)
    jacobian = wheel_jacobian_kernel(steer_axis, caster_offset, steer_angle)
    offset = np.empty(2 * n)
    for k in range(2 * n):
        offset[k] = residual[k // 2, k % 2]
    parts = parts_of_rows(jacobian, offset, variance)
    total = sum_of(parts, chosen)
    covariance = np.zeros((3, 3))
    if is_determined(total):
        _, x, y, z = solve(total, np.zeros(6), False)
        twist[0] += x
        twist[1] += y
        twist[2] += z
        covariance = full_inverse(total)
        if chosen and verdict == _CONSISTENT:
            verdict = _SLIP
    else:
        verdict = _CANNOT_KNOW
        covariance = full_inverse(parts[2 * n])
    for k in range(2 * n):
        slip[k // 2, k % 2] = sensed[k // 2, k % 2] - (
            jacobian[k, 0] * twist[0] + jacobian[k, 1] * twist[1] + jacobian[k, 2] * twist[2]
        )
    confirm_kernel(suspect, flagged, elapsed, dt, numbers[8], numbers[9])
    describe_kernel(sensed, slip, threshold, flagged, numbers[10], arrays[1], masks[1], masks[2])
    fitted = np.empty((4, 3))
    fitted[0] = twist
    fitted[1:] = covariance
    return np.concatenate((flagged.ravel(), elapsed.ravel())), fitted, arrays, masks, verdict
