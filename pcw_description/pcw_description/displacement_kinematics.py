"""Finite-displacement kinematics by products of exponentials, (3.3)-(3.14) [Li2009].

Over one sample each caster is a serial leg from the ground to the chassis: a twist sigma about the contact point, a
roll r rho along the wheel, and the steering phi between fork and chassis. In base_link of the sample's beginning, with
the heading phi_0, the steering axis S and the wheel centre p = S + R(phi_0) b,

    P = p + R(sigma) [ r rho u_0 + S - p - R(-phi) S ],      theta = sigma - phi                     (3.7)

(the thesis counts phi clockwise: theta = phi + sigma). Substituting sigma = theta + phi,

    P = p + R(theta) h,      h = R(phi_0 + phi) ( (r rho, 0) - b ) - S,

so the loop closure (3.11) of all legs is a planar registration of the points h with the points p, which has a closed
form for any n >= 2; for two legs it is the solution of (3.12).
"""

from __future__ import annotations

import math

import numpy as np

from .compiled import compiled
from .differential_kinematics import wheel_centres
from .errors import KinematicsError
from .robot_description import DRIVE, MINIMUM_CASTER_OFFSET, STEER, FloatArray, RobotDescription


@compiled
def forward_displacement_kernel(steer_axis, caster_offset, wheel_radius, steer_angle, joint_displacement):  # type: ignore[no-untyped-def]
    """Return displacement (3,) and the closure residuals in the base frame (n, 2) [m]."""
    n = len(steer_angle)
    p = np.empty((n, 2))
    h = np.empty((n, 2))
    pmx, pmy, hmx, hmy = 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        c0, s0 = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        heading = steer_angle[i] + joint_displacement[i, 1]
        c, s = math.cos(heading), math.sin(heading)
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        along, across = wheel_radius[i] * joint_displacement[i, 0] - bx, -by
        p[i, 0] = steer_axis[i, 0] + bx * c0 - by * s0
        p[i, 1] = steer_axis[i, 1] + bx * s0 + by * c0
        h[i, 0] = c * along - s * across - steer_axis[i, 0]
        h[i, 1] = s * along + c * across - steer_axis[i, 1]
        pmx += p[i, 0] / n
        pmy += p[i, 1] / n
        hmx += h[i, 0] / n
        hmy += h[i, 1] / n
    cross, dot = 0.0, 0.0
    for i in range(n):
        ax, ay = h[i, 0] - hmx, h[i, 1] - hmy
        bx, by = pmx - p[i, 0], pmy - p[i, 1]
        cross += ax * by - ay * bx
        dot += ax * bx + ay * by
    theta = math.atan2(cross, dot)
    c, s = math.cos(theta), math.sin(theta)
    displacement = np.empty(3)
    displacement[0] = pmx + c * hmx - s * hmy
    displacement[1] = pmy + s * hmx + c * hmy
    displacement[2] = theta
    residual = np.empty((n, 2))
    for i in range(n):
        residual[i, 0] = p[i, 0] + c * h[i, 0] - s * h[i, 1] - displacement[0]
        residual[i, 1] = p[i, 1] + s * h[i, 0] + c * h[i, 1] - displacement[1]
    return displacement, residual


def forward_displacement(
    robot: RobotDescription, steer_angle: FloatArray, joint_displacement: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the displacement of base_link over one sample from joint displacements, (3.13), and what does not close.

    Args:
        robot: the robot.
        steer_angle: headings at the beginning of the sample (n,) [rad].
        joint_displacement: change of the joint angles over the sample (n, 2) [rad].

    Returns:
        Displacement (x, y, theta) in base_link of the beginning [m, m, rad], and the closure residual (n, 2) [m].

    Raises:
        KinematicsError: a robot with fixed wheels.
    """
    robot.require_casters_only("the displacement model")
    displacement, residual = forward_displacement_kernel(
        robot.steer_axis, robot.caster_offset, robot.wheel_radius, steer_angle, joint_displacement
    )
    return displacement, residual


def inverse_displacement(
    robot: RobotDescription, steer_angle: FloatArray, displacement: FloatArray
) -> FloatArray:
    """Return the joint displacements that move base_link by `displacement` without slip, (3.14).

    Args:
        robot: the robot.
        steer_angle: headings at the beginning (n,) [rad].
        displacement: (x, y, theta) in base_link of the beginning.

    Returns:
        Joint displacements (n, 2) [rad]; the steering part lies in (-pi, pi].

    Raises:
        KinematicsError: a caster without offset, a displacement that no roll of the wheel along its
            heading reaches, or a robot with fixed wheels.
    """
    robot.require_casters_only("the displacement model")
    offset = robot.caster_offset
    if np.any(np.abs(offset[:, 0]) < MINIMUM_CASTER_OFFSET):
        raise KinematicsError(
            f"{robot.name}: caster_offset[0] must be at least {MINIMUM_CASTER_OFFSET:g} m for inverse displacement"
        )
    x, y, theta = displacement
    back = np.array([x, y]) - wheel_centres(robot, steer_angle)
    c, s = math.cos(theta), math.sin(theta)
    g = back @ np.array([[c, -s], [s, c]]) + robot.steer_axis  # rows R(-theta) (P - p) + S
    squared = np.sum(g**2, axis=1) - offset[:, 1] ** 2
    if np.any(squared < 0.0):
        raise KinematicsError(
            f"{robot.name}: displacement {np.asarray(displacement).tolist()} is out of reach of a caster's offset"
        )
    # The branch that is continuous with no motion: the axis stays on its side of the wheel.
    along = np.copysign(np.sqrt(squared), -offset[:, 0])
    heading = np.arctan2(g[:, 1], g[:, 0]) - np.arctan2(-offset[:, 1], along)
    joint_displacement = np.empty((robot.n, 2))
    joint_displacement[:, DRIVE] = (along + offset[:, 0]) / robot.wheel_radius
    joint_displacement[:, STEER] = np.pi - np.mod(np.pi - (heading - steer_angle), 2.0 * np.pi)
    return joint_displacement
