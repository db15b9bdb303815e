"""Operational-space dynamics of the whole robot rolling without slip: Lambda V_dot + theta = F, (3.36)-(3.39) [Li2009].

Each caster is a serial arm (roll, steering, turn about the ground contact) that carries the chassis. Per caster, with
C the rows giving (rho_dot, phi_dot, sigma = phi_dot + omega) from V and the module's centre of mass d away from the
wheel centre (d in the wheel frame, so d_x = b - c in the letters of EQUATIONS section 2),

    M = [[m r^2, 0, -m r d_y], [0, 0, 0], [-m r d_y, 0, I + m |d|^2]] + armature on (rho, phi)
    Lambda = Lambda_chassis + sum C^T M C
    theta  = theta_chassis + sum C^T [ M C_dot V + ( -m r d_x sigma^2, 0, m d_x r rho_dot sigma ) ]

`armature` = N^T J N holds the reflected rotors with the steer/drive coupling N; they turn with the joint, not with
sigma. V holds components in base_link and V_dot is their time derivative, so V . theta = 1/2 V^T Lambda_dot V exactly.
Appendix B of the thesis prints entries with errors; this is derived anew and tested against independent engines.
"""

from __future__ import annotations

import math

import numpy as np

from .compiled import compiled
from .robot_description import FloatArray, RobotDescription


def dynamic_parameters(robot: RobotDescription) -> tuple[FloatArray, FloatArray]:
    """Return what the dynamics needs as arrays.

    Returns:
        Chassis numbers (4,): mass, com x, com y, I_zz. Module numbers (n, 9): mass, com x, com y (wheel frame, from the
        steering axis), I_zz, wheel inertia about the axle, armature (drive, drive), (drive, steer), (steer, steer),
        wheel radius.
    """
    chassis = np.array(
        [robot.chassis.mass, robot.chassis.com[0], robot.chassis.com[1], robot.chassis.inertia_zz]
    )
    modules = np.array(
        [
            [
                caster.module.mass,
                caster.module.com[0],
                caster.module.com[1],
                caster.module.inertia_zz,
                caster.wheel.inertia_axle,
                armature[0, 0],
                armature[0, 1],
                armature[1, 1],
                caster.wheel_radius,
            ]
            for caster, armature in zip(robot.casters, robot.armature, strict=True)
        ]
    )
    return chassis, modules


@compiled
def augmented_object_kernel(chassis, modules, steer_axis, caster_offset, steer_angle, twist):  # type: ignore[no-untyped-def]
    """Return Lambda (3, 3) and theta (3,); see the module's docstring. Written in scalars for speed."""
    mass, cx, cy = chassis[0], chassis[1], chassis[2]
    vx, vy, omega = twist[0], twist[1], twist[2]
    l00, l01, l02, l11, l12, l22 = (
        mass,
        0.0,
        -mass * cy,
        mass,
        mass * cx,
        chassis[3] + mass * (cx * cx + cy * cy),
    )
    t0 = -mass * (omega * vy + omega * omega * cx)
    t1 = mass * (omega * vx - omega * omega * cy)
    t2 = mass * omega * (cx * vx + cy * vy)
    for i in range(len(steer_angle)):
        m, radius = modules[i, 0], modules[i, 8]
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        dx, dy = modules[i, 1] - bx, modules[i, 2] - by
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        sx, sy = steer_axis[i, 0], steer_axis[i, 1]
        # Rows of C: steering from the lateral, rolling from the longitudinal velocity of the wheel centre.
        along = s * sx - c * sy  # u . (z x S)
        across = c * sx + s * sy  # n . (z x S)
        p0, p1, p2 = s / bx, -c / bx, -(across + bx) / bx
        r0, r1, r2 = (c - by * p0) / radius, (s - by * p1) / radius, (along - by - by * p2) / radius
        s0, s1, s2 = p0, p1, p2 + 1.0
        m_rr = m * radius * radius + modules[i, 4] + modules[i, 5]
        m_rp = modules[i, 6]
        m_pp = modules[i, 7]
        m_rs = -m * radius * dy
        m_ss = modules[i, 3] + m * (dx * dx + dy * dy)
        # M C, column by column, then C^T (M C); only the upper triangle is formed.
        a0, a1, a2 = (
            m_rr * r0 + m_rp * p0 + m_rs * s0,
            m_rr * r1 + m_rp * p1 + m_rs * s1,
            m_rr * r2 + m_rp * p2 + m_rs * s2,
        )
        b0, b1, b2 = m_rp * r0 + m_pp * p0, m_rp * r1 + m_pp * p1, m_rp * r2 + m_pp * p2
        g0, g1, g2 = m_rs * r0 + m_ss * s0, m_rs * r1 + m_ss * s1, m_rs * r2 + m_ss * s2
        l00 += r0 * a0 + p0 * b0 + s0 * g0
        l01 += r0 * a1 + p0 * b1 + s0 * g1
        l02 += r0 * a2 + p0 * b2 + s0 * g2
        l11 += r1 * a1 + p1 * b1 + s1 * g1
        l12 += r1 * a2 + p1 * b2 + s1 * g2
        l22 += r2 * a2 + p2 * b2 + s2 * g2
        # C_dot V: only the heading moves, at phi_dot (u_dot = phi_dot n, n_dot = -phi_dot u).
        phi_dot = p0 * vx + p1 * vy + p2 * omega
        rho_dot = r0 * vx + r1 * vy + r2 * omega
        sigma = phi_dot + omega
        u_v = c * vx + s * vy + along * omega
        n_v = -s * vx + c * vy + across * omega
        p_dot = phi_dot * u_v / bx
        r_dot = (phi_dot * n_v - by * p_dot) / radius
        f_r = m_rr * r_dot + m_rp * p_dot + m_rs * p_dot - m * radius * dx * sigma * sigma
        f_p = m_rp * r_dot + m_pp * p_dot
        f_s = m_rs * r_dot + m_ss * p_dot + m * dx * radius * rho_dot * sigma
        t0 += r0 * f_r + p0 * f_p + s0 * f_s
        t1 += r1 * f_r + p1 * f_p + s1 * f_s
        t2 += r2 * f_r + p2 * f_p + s2 * f_s
    inertia = np.empty((3, 3))
    inertia[0, 0], inertia[0, 1], inertia[0, 2] = l00, l01, l02
    inertia[1, 0], inertia[1, 1], inertia[1, 2] = l01, l11, l12
    inertia[2, 0], inertia[2, 1], inertia[2, 2] = l02, l12, l22
    bias = np.empty(3)
    bias[0], bias[1], bias[2] = t0, t1, t2
    return inertia, bias


class AugmentedObjectModel:
    """The augmented object of one robot, with its numbers gathered once.

    Raises:
        KinematicsError: a caster without offset, whose motion does not follow from that of the chassis.
    """

    def __init__(self, robot: RobotDescription) -> None:
        robot.require_torque_control()
        chassis, modules = dynamic_parameters(robot)
        # What `augmented_object_kernel` takes first, for those that call it from compiled code.
        self.numbers: tuple[FloatArray, FloatArray, FloatArray, FloatArray] = (
            chassis,
            modules,
            robot.steer_axis,
            robot.caster_offset,
        )

    def evaluate(self, steer_angle: FloatArray, twist: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return Lambda and theta, (3.37)-(3.38).

        Args:
            steer_angle: headings (n,) [rad].
            twist: twist of base_link (3,) [m/s, m/s, rad/s].

        Returns:
            Lambda (3, 3), symmetric positive definite [kg, kg m, kg m^2], and theta (3,) [N, N, N m], in base_link.
        """
        inertia, bias = augmented_object_kernel(*self.numbers, steer_angle, twist)
        return inertia, bias
