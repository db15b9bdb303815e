"""Differential kinematics of n powered casters: A, B, slip, forward and inverse (3.15)-(3.28) [Li2009].

    A V = B q_dot  (3.24),      slip = B q_dot - A V  (3.28)

with the twist V = (v_x, v_y, omega) of base_link and joint rates q_dot = [rho_dot_1, phi_dot_1, ...]. For caster i with
the heading phi (counter-clockwise), u = (cos phi, sin phi), n = (-sin phi, cos phi), the steering axis S and the wheel
centre p = S + b_x u + b_y n,

    A_i = R(phi)^T [I, z x p],      B_i = [[r, b_y], [0, -b_x]].

`b_y` enters B because the fork swings a wheel that stands beside the axis along its own heading as well. The slip uses
the velocity of the chassis-fixed point at the wheel centre. A^T A depends on the wheel centres alone, so A^+ has a
closed form and exists for any two distinct wheels (3.34).

A robot with fixed wheels has the axle that they share besides, at p_a with the heading d, which nothing moves along:

    n(d) . (v + omega z x p_a) = 0.

It is one more row of the least squares, and with one caster whose wheel stands off the axle it makes them unique.
"""

from __future__ import annotations

import math

import numpy as np

from .compiled import compiled
from .errors import KinematicsError
from .robot_description import MINIMUM_CASTER_OFFSET, FloatArray, RobotDescription

DRAG_SPEED = 1e-9  # [m/s]; a twist that lets fixed wheels roll is exact but for rounding


@compiled
def wheel_jacobian_kernel(steer_axis, caster_offset, steer_angle):  # type: ignore[no-untyped-def]
    """Return A (2n, 3); arguments (n, 2), (n, 2), (n,)."""
    n = len(steer_angle)
    jacobian = np.empty((2 * n, 3))
    for i in range(n):
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        jacobian[2 * i, 0], jacobian[2 * i, 1] = c, s
        jacobian[2 * i + 1, 0], jacobian[2 * i + 1, 1] = -s, c
        jacobian[2 * i, 2] = s * steer_axis[i, 0] - c * steer_axis[i, 1] - caster_offset[i, 1]
        jacobian[2 * i + 1, 2] = c * steer_axis[i, 0] + s * steer_axis[i, 1] + caster_offset[i, 0]
    return jacobian


@compiled
def registration_kernel(steer_axis, caster_offset, direction, sensed, twist, slip):  # type: ignore[no-untyped-def]
    """Fill twist (3,) and slip (n, 2), see `rigid_motion_kernel`; return the mean wheel centre and the spread about it.

    Args:
        direction: cosines and sines of the headings (n, 2).
        sensed: velocities in the wheel frames (n, 2).

    The wheel centres move like a rigid body in the plane, so the least-squares twist is the one of a planar
    registration: rotation from the moments about the centroid, translation from the means.
    """
    n = len(direction)
    mean_px, mean_py, mean_wx, mean_wy = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        c, s = direction[i, 0], direction[i, 1]
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        mean_px += (steer_axis[i, 0] + bx * c - by * s) / n
        mean_py += (steer_axis[i, 1] + bx * s + by * c) / n
        mean_wx += (c * sensed[i, 0] - s * sensed[i, 1]) / n
        mean_wy += (s * sensed[i, 0] + c * sensed[i, 1]) / n
    moment, spread = 0.0, 0.0
    for i in range(n):
        c, s = direction[i, 0], direction[i, 1]
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        px = steer_axis[i, 0] + bx * c - by * s - mean_px
        py = steer_axis[i, 1] + bx * s + by * c - mean_py
        moment += px * (s * sensed[i, 0] + c * sensed[i, 1]) - py * (c * sensed[i, 0] - s * sensed[i, 1])
        spread += px * px + py * py
    omega = moment / spread
    twist[0] = mean_wx + omega * mean_py
    twist[1] = mean_wy - omega * mean_px
    twist[2] = omega
    for i in range(n):
        c, s = direction[i, 0], direction[i, 1]
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        vx = twist[0] - omega * (steer_axis[i, 1] + bx * s + by * c)
        vy = twist[1] + omega * (steer_axis[i, 0] + bx * c - by * s)
        slip[i, 0] = sensed[i, 0] - (c * vx + s * vy)
        slip[i, 1] = sensed[i, 1] - (-s * vx + c * vy)
    return mean_px, mean_py, spread


@compiled
def rigid_motion_kernel(steer_axis, caster_offset, steer_angle, sensed):  # type: ignore[no-untyped-def]
    """Return A^+ w (3,), what of w contradicts it (n, 2) and (A^T A)^-1 (3, 3), of velocities w (n, 2) in the wheel frames."""
    n = len(steer_angle)
    direction = np.empty((n, 2))
    for i in range(n):
        direction[i, 0], direction[i, 1] = math.cos(steer_angle[i]), math.sin(steer_angle[i])
    twist, slip = np.empty(3), np.empty((n, 2))
    mean_px, mean_py, spread = registration_kernel(steer_axis, caster_offset, direction, sensed, twist, slip)
    normal_inverse = np.empty((3, 3))
    normal_inverse[0, 0] = 1.0 / n + mean_py * mean_py / spread
    normal_inverse[1, 1] = 1.0 / n + mean_px * mean_px / spread
    normal_inverse[2, 2] = 1.0 / spread
    normal_inverse[0, 1] = normal_inverse[1, 0] = -mean_px * mean_py / spread
    normal_inverse[0, 2] = normal_inverse[2, 0] = mean_py / spread
    normal_inverse[1, 2] = normal_inverse[2, 1] = -mean_px / spread
    return twist, slip, normal_inverse


@compiled
def axle_row_kernel(axle):  # type: ignore[no-untyped-def]
    """Return the velocity (3,) of an axle (x, y, heading) along itself per twist of base_link."""
    c, s = math.cos(axle[2]), math.sin(axle[2])
    return np.array([-s, c, c * axle[0] + s * axle[1]])


@compiled
def guided_motion_kernel(steer_axis, caster_offset, axle, steer_angle, sensed):  # type: ignore[no-untyped-def]
    """As `rigid_motion_kernel`, of velocities (n + k, 2) of n casters and k fixed axles (k, 3), which have a lateral one.

    A wheel that rolls lets nothing move along its axle: there the velocity is zero, or what slips along it.
    """
    n, k = len(steer_angle), len(axle)
    if k == 0:
        return rigid_motion_kernel(steer_axis, caster_offset, steer_angle, sensed)
    jacobian = wheel_jacobian_kernel(steer_axis, caster_offset, steer_angle)
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for row in range(2 * n):
        for i in range(3):
            right[i] += jacobian[row, i] * sensed[row // 2, row % 2]
            for j in range(3):
                normal[i, j] += jacobian[row, i] * jacobian[row, j]
    for a in range(k):
        across = axle_row_kernel(axle[a])
        for i in range(3):
            right[i] += across[i] * sensed[n + a, 1]
            for j in range(3):
                normal[i, j] += across[i] * across[j]
    inverse = _inverse(normal)
    twist = np.zeros(3)
    for i in range(3):
        for j in range(3):
            twist[i] += inverse[i, j] * right[j]
    slip = np.zeros((n + k, 2))
    for row in range(2 * n):
        moved = jacobian[row, 0] * twist[0] + jacobian[row, 1] * twist[1] + jacobian[row, 2] * twist[2]
        slip[row // 2, row % 2] = sensed[row // 2, row % 2] - moved
    for a in range(k):
        across = axle_row_kernel(axle[a])
        slip[n + a, 1] = sensed[n + a, 1] - (across[0] * twist[0] + across[1] * twist[1] + across[2] * twist[2])
    return twist, slip, inverse


@compiled
def _inverse(m):  # type: ignore[no-untyped-def]
    """Return the inverse of a symmetric (3, 3)."""
    inverse = np.empty((3, 3))
    inverse[0, 0] = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    inverse[0, 1] = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    inverse[0, 2] = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    inverse[1, 1] = m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]
    inverse[1, 2] = m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]
    inverse[2, 2] = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
    return inverse / (m[0, 0] * inverse[0, 0] + m[0, 1] * inverse[0, 1] + m[0, 2] * inverse[0, 2])


@compiled
def sensed_velocities_kernel(caster_offset, wheel_radius, joint_velocity):  # type: ignore[no-untyped-def]
    """Return B q_dot (n, 2): what the joints say of the wheel centres."""
    sensed = np.empty((len(wheel_radius), 2))
    for i in range(len(wheel_radius)):
        sensed[i, 0] = wheel_radius[i] * joint_velocity[i, 0] + caster_offset[i, 1] * joint_velocity[i, 1]
        sensed[i, 1] = -caster_offset[i, 0] * joint_velocity[i, 1]
    return sensed


@compiled
def forward_kinematics_kernel(steer_axis, caster_offset, wheel_radius, steer_angle, joint_velocity):  # type: ignore[no-untyped-def]
    """Return twist (3,), slip (n, 2) and (A^T A)^-1 (3, 3): the closed form of A^+ B q_dot."""
    sensed = sensed_velocities_kernel(caster_offset, wheel_radius, joint_velocity)
    return rigid_motion_kernel(steer_axis, caster_offset, steer_angle, sensed)


@compiled
def guided_kinematics_kernel(steer_axis, caster_offset, wheel_radius, axle, steer_angle, joint_velocity):  # type: ignore[no-untyped-def]
    """As `forward_kinematics_kernel`, with fixed axles (k, 3); the slip is (n + k, 2)."""
    n = len(steer_angle)
    sensed = np.zeros((n + len(axle), 2))
    sensed[:n] = sensed_velocities_kernel(caster_offset, wheel_radius, joint_velocity)
    return guided_motion_kernel(steer_axis, caster_offset, axle, steer_angle, sensed)


def wheel_jacobian(robot: RobotDescription, steer_angle: FloatArray) -> FloatArray:
    """Return A: twist to wheel-centre velocities in the wheel frames, (3.21).

    Args:
        robot: the robot.
        steer_angle: headings (n,) [rad].

    Returns:
        A (2n, 3), rows [longitudinal_1, lateral_1, longitudinal_2, ...].
    """
    jacobian: FloatArray = wheel_jacobian_kernel(robot.steer_axis, robot.caster_offset, steer_angle)
    return jacobian


def joint_matrix(robot: RobotDescription) -> FloatArray:
    """Return B: joint rates to sensed wheel-centre velocities, (3.22), with lateral offsets, (2n, 2n)."""
    matrix = np.zeros((2 * robot.n, 2 * robot.n))
    for i, block in enumerate(joint_matrix_blocks(robot)):
        matrix[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
    return matrix


def joint_matrix_blocks(robot: RobotDescription) -> FloatArray:
    """Return the diagonal blocks B_i = [[r, b_y], [0, -b_x]], (n, 2, 2)."""
    blocks = np.zeros((robot.n, 2, 2))
    blocks[:, 0, 0] = robot.wheel_radius
    blocks[:, 0, 1] = robot.caster_offset[:, 1]
    blocks[:, 1, 1] = -robot.caster_offset[:, 0]
    return blocks


def wheel_centres(robot: RobotDescription, steer_angle: FloatArray) -> FloatArray:
    """Return the wheel centres p in base_link, (n, 2) [m], for headings (n,) [rad]."""
    c, s = np.cos(steer_angle), np.sin(steer_angle)
    bx, by = robot.caster_offset[:, 0], robot.caster_offset[:, 1]
    return robot.steer_axis + np.stack([bx * c - by * s, bx * s + by * c], axis=1)


def forward_kinematics(
    robot: RobotDescription, steer_angle: FloatArray, joint_velocity: FloatArray
) -> FloatArray:
    """Return the twist A^+ B q_dot that fits the joint rates best (least squares), (3.26).

    Args:
        robot: the robot.
        steer_angle: headings (n,) [rad].
        joint_velocity: joint rates (n, 2) [rad/s].

    Returns:
        Twist of base_link (v_x, v_y, omega) [m/s, m/s, rad/s].
    """
    twist: FloatArray = guided_kinematics_kernel(
        robot.steer_axis, robot.caster_offset, robot.wheel_radius, robot.fixed_axle, steer_angle, joint_velocity
    )[0]
    return twist


def inverse_kinematics(robot: RobotDescription, steer_angle: FloatArray, twist: FloatArray) -> FloatArray:
    """Return the joint rates B^-1 A V of slip-free motion, (3.25).

    Args:
        robot: the robot.
        steer_angle: headings (n,) [rad].
        twist: twist of base_link (3,).

    Returns:
        Joint rates (n, 2) [rad/s].

    Raises:
        KinematicsError: a caster without offset along its heading; its steering rate does not follow from the twist. Or a
            twist that drags fixed wheels along their axle.
    """
    for axle in robot.fixed_axle:
        dragged = float(axle_row_kernel(axle) @ np.asarray(twist, dtype=float))
        if abs(dragged) > DRAG_SPEED:
            raise KinematicsError(
                f"{robot.name}: twist {np.asarray(twist).tolist()} drags the fixed wheels along their axle at {dragged:g} m/s"
                f"; allowed: at most {DRAG_SPEED:g} m/s"
            )
    bx, by = robot.caster_offset[:, 0], robot.caster_offset[:, 1]
    if np.any(np.abs(bx) < MINIMUM_CASTER_OFFSET):
        raise KinematicsError(
            f"{robot.name}: caster_offset[0] is {bx[np.argmin(np.abs(bx))]:g} m; the steering rate follows "
            f"from the twist only for at least {MINIMUM_CASTER_OFFSET:g} m"
        )
    velocity = (wheel_jacobian(robot, steer_angle) @ twist).reshape(-1, 2)
    steer_rate = -velocity[:, 1] / bx
    roll_rate = (velocity[:, 0] - by * steer_rate) / robot.wheel_radius
    return np.stack([roll_rate, steer_rate], axis=1)


def slip_velocity(
    robot: RobotDescription, steer_angle: FloatArray, joint_velocity: FloatArray, twist: FloatArray
) -> FloatArray:
    """Return the slip B q_dot - A V at the contacts, (3.28).

    Args:
        robot: the robot.
        steer_angle: headings (n,) [rad].
        joint_velocity: joint rates (n, 2) [rad/s].
        twist: true twist of base_link (3,).

    Returns:
        Slip velocities (n, 2) [m/s], longitudinal and lateral in the wheel frames.
    """
    sensed = np.einsum("nij,nj->ni", joint_matrix_blocks(robot), joint_velocity)
    return sensed - (wheel_jacobian(robot, steer_angle) @ twist).reshape(-1, 2)
