"""The reduced planar plant: chassis and casters in the plane, slip at every contact, compiled.

Degrees of freedom: the twist V of base_link and (rho_dot, phi_dot) of every caster; a caster's fork turns at
sigma = phi_dot + omega. With the module's centre of mass c from its steering axis S, the relaxed tyre forces F at the
wheel centres p, and the reflected rotors as armature on (rho, phi), the equations are

    body:  M_bb V_dot + sum k phi_ddot               = sum (F, p x F + M_z) - bias
    phi:   k^T V_dot + M_phi phi_ddot + J_rp rho_ddot = tau_phi + b x F + M_z - m c x a_bias
    rho:   I_rho rho_ddot + J_rp phi_ddot             = tau_rho - r F_x

The joints are eliminated caster by caster, which leaves a 3x3 system (Schur complement). Normal forces follow the
accelerations of the last step quasi-statically, as a rigid body on equal springs. Steps are semi-implicit; friction at
the joints enters with its slope, so that Coulomb friction does not chatter at any step size.
"""

from __future__ import annotations

import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import scrub_torque, tyre_step
from pcw_description.robot_description import FloatArray, RobotDescription

from .caster_arrays import (
    BX,
    BY,
    CX,
    CY,
    FX,
    FY,
    FZ,
    I_ROLL,
    IZZ,
    J_PP,
    J_RP,
    LIMIT_DRIVE,
    LIMIT_STEER,
    MASS,
    MOTOR_PHI,
    MOTOR_RHO,
    PHI,
    PHI_DOT,
    RADIUS,
    RHO,
    RHO_DOT,
    SLIP_X,
    SLIP_Y,
    SX,
    SY,
    TYRE,
    WHEEL_STATE,
    ZX,
    ZY,
    caster_numbers,
)
from .joint_effects import JointEffects, joint_effect_torque
from .nominal_changes import as_it_really_is
from .plant import PlantError, PlantState

GRAVITY = 9.81

# Entries of the chassis numbers and of the body state.
_M, _COM_X, _COM_Y, _I, _COM_Z = range(5)
_X, _Y, _YAW, _VX, _VY, _OMEGA, _AX, _AY, _ALPHA = range(9)


@compiled
def support_forces(mass, com_x, com_y, com_z, acc_x, acc_y, centre, normal_force):  # type: ignore[no-untyped-def]
    """Fill normal_force (n,) [N]: equal springs under a rigid body with its inertial load, F_z = a + b p_x + c p_y.

    With two casters the moment across their line is carried by nothing here; the ridge leaves it out.
    """
    n = len(normal_force)
    sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        x, y = centre[i, 0], centre[i, 1]
        sx += x
        sy += y
        sxx += x * x
        sxy += x * y
        syy += y * y
    weight = mass * GRAVITY
    moment_x = weight * com_x - mass * com_z * acc_x
    moment_y = weight * com_y - mass * com_z * acc_y
    # Centred sums decouple the mean load from the two tilts.
    mx, my = sx / n, sy / n
    cxx, cxy, cyy = sxx - n * mx * mx, sxy - n * mx * my, syy - n * my * my
    ridge = 1e-9 * (cxx + cyy)
    cxx += ridge
    cyy += ridge
    rx, ry = moment_x - weight * mx, moment_y - weight * my
    determinant = cxx * cyy - cxy * cxy
    tilt_x = (cyy * rx - cxy * ry) / determinant
    tilt_y = (cxx * ry - cxy * rx) / determinant
    for i in range(n):
        load = weight / n + tilt_x * (centre[i, 0] - mx) + tilt_y * (centre[i, 1] - my)
        normal_force[i] = max(load, 0.0)


@compiled
def _advance(  # type: ignore[no-untyped-def]
    steps, dt, chassis, casters, effect_kernels, effect_place, effect_numbers, command, body, wheels
):
    """Advance body (9,) and wheels (n, 13) in place by `steps` steps with the motor torques command (n, 2) held.

    Returns False, and changes nothing, if a torque is not finite.
    """
    n = len(casters)
    for i in range(n):
        if not (math.isfinite(command[i, 0]) and math.isfinite(command[i, 1])):
            return False
    centre = np.empty((n, 2))
    normal = np.empty(n)
    coupling = np.empty((n, 3))
    inverse = np.empty((n, 3))
    drive_rhs = np.empty(n)
    steer_rhs = np.empty(n)
    total_mass = chassis[_M]
    for i in range(n):
        total_mass += casters[i, MASS]
    for _ in range(steps):
        vx, vy, omega = body[_VX], body[_VY], body[_OMEGA]
        mass, cx, cy = chassis[_M], chassis[_COM_X], chassis[_COM_Y]
        m00, m02, m11, m12 = mass, -mass * cy, mass, mass * cx
        m01, m22 = 0.0, chassis[_I] + mass * (cx * cx + cy * cy)
        f0 = mass * (omega * vy + omega * omega * cx)
        f1 = mass * (-omega * vx + omega * omega * cy)
        f2 = -mass * omega * (cx * vx + cy * vy)
        com_x, com_y, com_z = mass * cx, mass * cy, mass * chassis[_COM_Z]
        for i in range(n):
            c, s = math.cos(wheels[i, PHI]), math.sin(wheels[i, PHI])
            centre[i, 0] = casters[i, SX] + casters[i, BX] * c - casters[i, BY] * s
            centre[i, 1] = casters[i, SY] + casters[i, BX] * s + casters[i, BY] * c
            com_x += casters[i, MASS] * (casters[i, SX] + casters[i, CX] * c - casters[i, CY] * s)
            com_y += casters[i, MASS] * (casters[i, SY] + casters[i, CX] * s + casters[i, CY] * c)
            com_z += casters[i, MASS] * casters[i, RADIUS]
        support_forces(
            total_mass,
            com_x / total_mass,
            com_y / total_mass,
            com_z / total_mass,
            body[_AX],
            body[_AY],
            centre,
            normal,
        )
        for i in range(n):
            c, s = math.cos(wheels[i, PHI]), math.sin(wheels[i, PHI])
            rho_dot, phi_dot = wheels[i, RHO_DOT], wheels[i, PHI_DOT]
            sigma = phi_dot + omega
            sx, sy, bx, by = casters[i, SX], casters[i, SY], casters[i, BX], casters[i, BY]
            radius = casters[i, RADIUS]
            # Velocity of the wheel centre in the wheel frame.
            axis_x, axis_y = vx - omega * sy, vy + omega * sx
            along = c * axis_x + s * axis_y - sigma * by
            across = -s * axis_x + c * axis_y + sigma * bx
            slip_x, slip_y = radius * rho_dot - along, -across
            speed = max(abs(radius * rho_dot), math.sqrt(along * along + across * across))
            tyre = casters[i, TYRE:]
            zx, zy, fx, fy = tyre_step(
                tyre, wheels[i, ZX], wheels[i, ZY], slip_x, slip_y, speed, normal[i], dt
            )
            spin = scrub_torque(tyre, sigma, speed, normal[i])
            wheels[i, ZX], wheels[i, ZY] = zx, zy
            wheels[i, SLIP_X], wheels[i, SLIP_Y] = slip_x, slip_y
            wheels[i, FX], wheels[i, FY], wheels[i, FZ] = fx, fy, normal[i]
            force_x, force_y = c * fx - s * fy, s * fx + c * fy
            f0 += force_x
            f1 += force_y
            f2 += centre[i, 0] * force_y - centre[i, 1] * force_x + spin
            # The module as a body at q = S + c, turning at sigma.
            m, izz = casters[i, MASS], casters[i, IZZ]
            lever_x = casters[i, CX] * c - casters[i, CY] * s
            lever_y = casters[i, CX] * s + casters[i, CY] * c
            qx, qy = sx + lever_x, sy + lever_y
            m00 += m
            m11 += m
            m02 -= m * qy
            m12 += m * qx
            m22 += izz + m * (qx * qx + qy * qy)
            bias_x = -omega * vy - omega * omega * sx - sigma * sigma * lever_x
            bias_y = omega * vx - omega * omega * sy - sigma * sigma * lever_y
            f0 -= m * bias_x
            f1 -= m * bias_y
            f2 -= m * (qx * bias_y - qy * bias_x)
            coupling[i, 0], coupling[i, 1] = -m * lever_y, m * lever_x
            coupling[i, 2] = izz + m * (qx * lever_x + qy * lever_y)
            inertia_pp = izz + m * (lever_x * lever_x + lever_y * lever_y) + casters[i, J_PP]
            inertia_rr, inertia_rp = casters[i, I_ROLL], casters[i, J_RP]
            motor_rho = min(max(command[i, 0], -casters[i, LIMIT_DRIVE]), casters[i, LIMIT_DRIVE])
            motor_phi = min(max(command[i, 1], -casters[i, LIMIT_STEER]), casters[i, LIMIT_STEER])
            wheels[i, MOTOR_RHO], wheels[i, MOTOR_PHI] = motor_rho, motor_phi
            rhs_r = motor_rho - radius * fx
            rhs_p = motor_phi + bx * fy - by * fx + spin - m * (lever_x * bias_y - lever_y * bias_x)
            for k in range(len(effect_place)):
                if effect_place[k, 0] == i:
                    numbers = effect_numbers[k]
                    if effect_place[k, 1] == 0:
                        torque, slope = joint_effect_torque(
                            effect_kernels[k], wheels[i, RHO], rho_dot, motor_rho, normal[i], numbers
                        )
                        rhs_r += torque
                        inertia_rr += dt * slope
                    else:
                        torque, slope = joint_effect_torque(
                            effect_kernels[k], wheels[i, PHI], phi_dot, motor_phi, normal[i], numbers
                        )
                        rhs_p += torque
                        inertia_pp += dt * slope
            determinant = inertia_rr * inertia_pp - inertia_rp * inertia_rp
            inverse[i, 0], inverse[i, 1], inverse[i, 2] = (
                inertia_pp / determinant,
                -inertia_rp / determinant,
                inertia_rr / determinant,
            )
            drive_rhs[i], steer_rhs[i] = rhs_r, rhs_p
            # Schur complement: what the caster takes from the body.
            reach = inverse[i, 1] * rhs_r + inverse[i, 2] * rhs_p
            k0, k1, k2, weight = coupling[i, 0], coupling[i, 1], coupling[i, 2], inverse[i, 2]
            f0 -= k0 * reach
            f1 -= k1 * reach
            f2 -= k2 * reach
            m00 -= k0 * k0 * weight
            m01 -= k0 * k1 * weight
            m02 -= k0 * k2 * weight
            m11 -= k1 * k1 * weight
            m12 -= k1 * k2 * weight
            m22 -= k2 * k2 * weight
        a00, a01, a02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
        a11, a12, a22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
        determinant = m00 * a00 + m01 * a01 + m02 * a02
        d0 = (a00 * f0 + a01 * f1 + a02 * f2) / determinant
        d1 = (a01 * f0 + a11 * f1 + a12 * f2) / determinant
        d2 = (a02 * f0 + a12 * f1 + a22 * f2) / determinant
        body[_AX], body[_AY], body[_ALPHA] = d0 - omega * vy, d1 + omega * vx, d2
        body[_VX], body[_VY], body[_OMEGA] = vx + dt * d0, vy + dt * d1, omega + dt * d2
        middle = body[_YAW] + 0.5 * dt * body[_OMEGA]
        c, s = math.cos(middle), math.sin(middle)
        body[_X] += dt * (c * body[_VX] - s * body[_VY])
        body[_Y] += dt * (s * body[_VX] + c * body[_VY])
        body[_YAW] += dt * body[_OMEGA]
        for i in range(n):
            rhs_p = steer_rhs[i] - (coupling[i, 0] * d0 + coupling[i, 1] * d1 + coupling[i, 2] * d2)
            wheels[i, RHO_DOT] += dt * (inverse[i, 0] * drive_rhs[i] + inverse[i, 1] * rhs_p)
            wheels[i, PHI_DOT] += dt * (inverse[i, 1] * drive_rhs[i] + inverse[i, 2] * rhs_p)
            wheels[i, RHO] += dt * wheels[i, RHO_DOT]
            wheels[i, PHI] += dt * wheels[i, PHI_DOT]
    return True


class ReducedPlant:
    """The reduced plant of one robot; see the module's docstring.

    Args:
        robot: the robot; its `physics` are at work.
        dt: step [s].
    """

    def __init__(self, robot: RobotDescription, dt: float = 1e-3) -> None:
        robot.require_torque_control()
        self.robot = robot
        self.dt = dt
        true_robot = as_it_really_is(robot)
        chassis = true_robot.chassis
        self._chassis = np.array(
            [chassis.mass, chassis.com[0], chassis.com[1], chassis.inertia_zz, chassis.com[2]]
        )
        self._casters = caster_numbers(true_robot)
        self._effects = JointEffects(robot)
        self._body = np.zeros(9)
        self._wheels = np.zeros((robot.n, WHEEL_STATE))
        self._time = 0.0
        self.reset()

    def reset(self, pose: FloatArray | None = None, steer_angle: FloatArray | None = None) -> None:
        """Put the robot at rest at a pose (3,), the wheels at headings (n,); time becomes zero."""
        self._body[:] = 0.0
        self._wheels[:] = 0.0
        self._time = 0.0
        if pose is not None:
            self._body[[_X, _Y, _YAW]] = pose
        if steer_angle is not None:
            self._wheels[:, PHI] = steer_angle

    def set_motion(self, twist: FloatArray, joint_position: FloatArray, joint_velocity: FloatArray) -> None:
        """Give the robot a twist (3,) in base_link and its joints angles and rates (n, 2), to go on from a recorded motion."""
        self._body[_VX : _OMEGA + 1] = twist
        self._wheels[:, RHO : PHI + 1] = joint_position
        self._wheels[:, RHO_DOT : PHI_DOT + 1] = joint_velocity

    def step(self, motor_torque: FloatArray, steps: int = 1) -> None:
        """Advance by `steps` steps of dt with motor torques (n, 2) [N m] held.

        Raises:
            PlantError: a torque is NaN or infinite; the plant has not moved.
        """
        if not _advance(
            steps,
            self.dt,
            self._chassis,
            self._casters,
            self._effects.kernels,
            self._effects.place,
            self._effects.numbers,
            motor_torque,
            self._body,
            self._wheels,
        ):
            raise PlantError("motor_torque holds NaN or infinity; allowed: finite torques in N m")
        self._time += steps * self.dt

    def state(self) -> PlantState:
        """Return the truth now."""
        body, wheels = self._body, self._wheels
        return PlantState(
            time=self._time,
            pose=body[_X : _YAW + 1].copy(),
            twist=body[_VX : _OMEGA + 1].copy(),
            acceleration=body[_AX : _ALPHA + 1].copy(),
            joint_position=wheels[:, RHO : PHI + 1].copy(),
            joint_velocity=wheels[:, RHO_DOT : PHI_DOT + 1].copy(),
            motor_torque=wheels[:, MOTOR_RHO : MOTOR_PHI + 1].copy(),
            slip=wheels[:, SLIP_X : SLIP_Y + 1].copy(),
            contact_force=wheels[:, FX : FY + 1].copy(),
            normal_force=wheels[:, FZ].copy(),
        )

    def close(self) -> None:
        """Free what the plant holds: nothing."""
