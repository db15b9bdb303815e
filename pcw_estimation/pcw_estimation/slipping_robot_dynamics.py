"""Rigid-body dynamics of a robot whose wheels may slip, as the whole-robot observers need it, (3.44) [Li2009].

    Lambda V_dot + theta = A^T F

Lambda is that of chassis and modules as one body at the present headings, and theta holds what the modules take that turn
under it at the rates measured. The augmented object of a robot that rolls has these rates from V instead: with a wheel that
slips across, and over a short caster offset, a small error of V would become a large force.
"""

from __future__ import annotations

import math

import numpy as np

from pcw_description.augmented_object_model import augmented_object_kernel, dynamic_parameters
from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import TYRE_SIZE, tyre_parameters
from pcw_description.robot_description import FloatArray, RobotDescription
from pcw_description.support_forces import support_forces

# Columns of the numbers of a caster.
RADIUS, J_RR, J_RP, J_PP, MASS, CX, CY, I_STEER, TYRE = range(9)


def caster_numbers(robot: RobotDescription) -> FloatArray:
    """Return the numbers of all casters (n, TYRE + TYRE_SIZE).

    Wheel radius, inertias of wheel and rotors on the joints, mass and centre of mass of the module, its inertia about the
    steering axis, and the tyre.
    """
    _, modules = dynamic_parameters(robot)
    casters = np.empty((robot.n, TYRE + TYRE_SIZE))
    casters[:, RADIUS] = robot.wheel_radius
    casters[:, J_RR] = modules[:, 4] + modules[:, 5]
    casters[:, [J_RP, J_PP]] = modules[:, [6, 7]]
    casters[:, [MASS, CX, CY]] = modules[:, :3]
    casters[:, I_STEER] = modules[:, 3] + modules[:, 0] * np.sum(modules[:, 1:3] ** 2, axis=1)
    casters[:, TYRE:] = [tyre_parameters(tyre) for tyre in robot.tyres]
    return casters


@compiled
def solve_symmetric(matrix, right):  # type: ignore[no-untyped-def]
    """Return the solution of a symmetric 3x3 system."""
    m00, m01, m02 = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    m11, m12, m22 = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    a00, a01, a02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
    a11, a12, a22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
    determinant = m00 * a00 + m01 * a01 + m02 * a02
    solution = np.empty(3)
    solution[0] = (a00 * right[0] + a01 * right[1] + a02 * right[2]) / determinant
    solution[1] = (a01 * right[0] + a11 * right[1] + a12 * right[2]) / determinant
    solution[2] = (a02 * right[0] + a12 * right[1] + a22 * right[2]) / determinant
    return solution


@compiled
def composite_body(chassis, casters, steer_axis, steer_angle):  # type: ignore[no-untyped-def]
    """Return mass, com x, com y and I_zz (4,) of chassis and modules as one rigid body at these headings."""
    mass, first_x, first_y = chassis[0], chassis[0] * chassis[1], chassis[0] * chassis[2]
    second = chassis[3] + chassis[0] * (chassis[1] ** 2 + chassis[2] ** 2)
    for i in range(len(casters)):
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        m, cx, cy = casters[i, MASS], casters[i, CX], casters[i, CY]
        qx, qy = steer_axis[i, 0] + cx * c - cy * s, steer_axis[i, 1] + cx * s + cy * c
        mass += m
        first_x += m * qx
        first_y += m * qy
        second += casters[i, I_STEER] + m * (qx * qx + qy * qy - cx * cx - cy * cy)
    body = np.empty(4)
    body[0], body[1], body[2] = mass, first_x / mass, first_y / mass
    body[3] = second - (first_x * first_x + first_y * first_y) / mass
    return body


@compiled
def wheel_loads(composite, height, casters, steer_axis, caster_offset, steer_angle, twist, change, gravity):  # type: ignore[no-untyped-def]
    """Return the normal forces (n,) [N] under V (3,) and V_dot (3,)."""
    n = len(casters)
    ax, ay = change[0] - twist[2] * twist[1], change[1] + twist[2] * twist[0]
    mass, com_z = composite[0], height
    centre, flat, normal = np.empty((n, 2)), np.zeros(n), np.empty(n)
    for i in range(n):
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        centre[i, 0] = steer_axis[i, 0] + bx * c - by * s
        centre[i, 1] = steer_axis[i, 1] + bx * s + by * c
        com_z += casters[i, MASS] * casters[i, RADIUS]
    weight = mass * gravity
    support_forces(
        weight, weight * composite[1] - com_z * ax, weight * composite[2] - com_z * ay, 1.0, centre, flat, normal
    )
    return normal


@compiled
def add_turning_module(turning, caster, steer_axis, lever_x, lever_y, steer_rate, steer_acceleration, omega):  # type: ignore[no-untyped-def]
    """Add what a module takes that turns under the chassis to `turning` (3,) [N, N, N m].

    Its centre of mass is at the lever (m) from its steering axis, in the axes of base_link.
    """
    faster = (steer_rate + omega) ** 2 - omega * omega
    x = -caster[MASS] * (lever_y * steer_acceleration + lever_x * faster)
    y = caster[MASS] * (lever_x * steer_acceleration - lever_y * faster)
    turning[0] += x
    turning[1] += y
    turning[2] += caster[I_STEER] * steer_acceleration + steer_axis[0] * y - steer_axis[1] * x


@compiled
def body_dynamics(composite, casters, steer_axis, caster_offset, steer_angle, twist):  # type: ignore[no-untyped-def]
    """Return Lambda (3, 3) and theta (3,) of `composite` (4,), without turning modules."""
    return augmented_object_kernel(composite, casters[:0], steer_axis[:0], caster_offset[:0], steer_angle[:0], twist)
