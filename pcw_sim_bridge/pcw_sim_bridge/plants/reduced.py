"""The reduced planar plant: chassis and casters in the plane, slip at every contact, compiled.

Degrees of freedom: the twist V of base_link and (rho_dot, phi_dot) of every caster; a caster's fork turns at
sigma = phi_dot + omega. With the module's centre of mass c from its steering axis S, the relaxed tyre forces F at the
wheel centres p, and the reflected rotors as armature on (rho, phi), the equations are

    body:  M_bb V_dot + sum k phi_ddot               = sum (F, p x F + M_z) - bias
    phi:   k^T V_dot + M_phi phi_ddot + J_rp rho_ddot = tau_phi + b x F + M_z - m c x a_bias
    rho:   I_rho rho_ddot + J_rp phi_ddot             = tau_rho - r F_x

The joints are eliminated caster by caster, which leaves a 3x3 system (Schur complement). Normal forces follow the
accelerations of the last step quasi-statically, as a rigid body on equal springs that push and do not pull. On uneven ground,
or on a wheel that gives way, the chassis stands as the plane nearest to the heights under its wheels does, and its steering
axes with it: with t the vertical in its horizontal axes, the contact is where the wheel is lowest, b_x - r t_x in the wheel's
frame, and weights turn the steering by (N b - m g c) x t. What an IMU feels of that follows as the springs let it.

A step takes tyres, friction and gears implicitly in the new velocities, by their slopes. The tyre force F at the end of
a step follows from the step's mean slip velocity eps = J (v + v') / 2: with G the slopes of F over eps, the matrix is
M + dt/2 J^T G J. So no stiffness is too large for a step, and as the work of F is F . eps dt, no step adds energy.
Inertial terms are taken at the middle of the step, positions by the trapezoidal rule; both keep a free motion's energy to
second order.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from pcw_description.chassis_sway import sway_numbers
from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import scrub_torque, slip_under_load, tyre_step_with_slopes
from pcw_description.effects.kinds import (
    CONTACT_RESULTS,
    FORCE_INPUTS,
    FORCE_RESULTS,
    FRICTION,
    GRADIENT_X,
    GRADIENT_Y,
    HEIGHT,
    RADIUS_CHANGE,
    RADIUS_SLOPE,
)
from pcw_description.recording_series import IntArray
from pcw_description.robot_description import GRAVITY, FloatArray, RobotDescription
from pcw_description.support_forces import plane_gradient, support_forces

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
    MASS,
    MOTOR_PHI,
    MOTOR_RHO,
    PHI,
    PHI_DDOT,
    PHI_DOT,
    RADIUS,
    RHO,
    RHO_DDOT,
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
from .drivetrain import joint_torques, motor_torques, turn_motors
from .effect_tables import ANGLE, RATE, EffectTables, as_joint_motion
from .plant import PlantError, PlantState, gravity_in_base
from .surroundings import chassis_wrench, ground_under
from .true_robot import as_it_really_is, without_geared_rotors

# Entries of the chassis numbers and of the body state.
_M, _COM_X, _COM_Y, _I, _COM_Z, _SPRING, _LIFTED, _FREQUENCY, _DAMPING = (*range(8), 9)
_X, _Y, _YAW, _VX, _VY, _OMEGA, _AX, _AY, _ALPHA, _TIME, _STANDS, _TILT, _TILTING, _TILTED = (*range(12), 13, 15)
_BODY_STATE = 17
FASTEST_SWAY = 0.5  # radians of a period in a step
# Per-caster numbers within a step: place and turn of the wheel, forces, and the two rows of what is eliminated.
_C, _S, _PX, _PY, _FORCE_X, _FORCE_Y, _SPIN, _RHS_R, _RHS_P, _I_RR, _I_RP, _I_PP = range(12)
_KR0, _KR1, _KR2, _KP0, _KP1, _KP2, _DZ_X, _DZ_Y, _G_X, _G_Y, _E_X0, _E_X1, _E_X2, _E_Y0, _E_Y1, _E_Y2, _R = range(12, 29)
_B_X, _SCRATCH = 29, 30


@compiled
def _advance(  # type: ignore[no-untyped-def]
    steps,
    dt,
    chassis,
    casters,
    gravity,
    effects,
    command,
    body,
    wheels,
):
    """Advance body (_BODY_STATE,) and wheels (n, WHEEL_STATE) in place by `steps` steps, motor torques command (n, 2) held.

    Returns False, and changes nothing, if a torque is not finite.
    """
    n = len(casters)
    for i in range(n):
        if not (math.isfinite(command[i, 0]) and math.isfinite(command[i, 1])):
            return False
    centre, height, normal = np.empty((n, 2)), np.zeros(n), np.empty(n)
    ground, at, wrench = np.empty((n, CONTACT_RESULTS)), np.empty(FORCE_INPUTS), np.zeros(FORCE_RESULTS)
    part = np.empty((n, _SCRATCH))
    lifted = chassis[_LIFTED] > 0.0
    total_mass = chassis[_M]
    for i in range(n):
        total_mass += casters[i, MASS]
    for _ in range(steps):
        # Velocities at the middle of the step, for the inertial terms.
        vx, vy, omega = body[_VX], body[_VY], body[_OMEGA]
        half = 0.5 * dt
        mid_x = vx + half * (body[_AX] + omega * vy)
        mid_y = vy + half * (body[_AY] - omega * vx)
        mid_omega = omega + half * body[_ALPHA]
        mid_yaw = body[_YAW] + half * omega
        cos_yaw, sin_yaw = math.cos(mid_yaw), math.sin(mid_yaw)
        gravity_x = cos_yaw * gravity[0] + sin_yaw * gravity[1]
        gravity_y = -sin_yaw * gravity[0] + cos_yaw * gravity[1]
        mass, cx, cy = chassis[_M], chassis[_COM_X], chassis[_COM_Y]
        com_x, com_y, com_z = mass * cx, mass * cy, mass * chassis[_COM_Z]
        for i in range(n):
            angle = wheels[i, PHI] + half * wheels[i, PHI_DOT]
            c, s = math.cos(angle), math.sin(angle)
            part[i, _C], part[i, _S] = c, s
            centre[i, 0] = casters[i, SX] + casters[i, BX] * c - casters[i, BY] * s
            centre[i, 1] = casters[i, SY] + casters[i, BX] * s + casters[i, BY] * c
            com_x += casters[i, MASS] * (casters[i, SX] + casters[i, CX] * c - casters[i, CY] * s)
            com_y += casters[i, MASS] * (casters[i, SY] + casters[i, CX] * s + casters[i, CY] * c)
            com_z += casters[i, MASS] * casters[i, RADIUS]
            world_x = body[_X] + half * (cos_yaw * vx - sin_yaw * vy) + cos_yaw * centre[i, 0] - sin_yaw * centre[i, 1]
            world_y = body[_Y] + half * (sin_yaw * vx + cos_yaw * vy) + sin_yaw * centre[i, 0] + cos_yaw * centre[i, 1]
            roll_angle = wheels[i, RHO] + half * wheels[i, RHO_DOT]
            ground_under(i, body[_TIME], world_x, world_y, roll_angle, wheels[i, FZ], effects, at, ground[i])
            height[i] = ground[i, HEIGHT] + ground[i, RADIUS_CHANGE]
        com_x, com_y, com_z = com_x / total_mass, com_y / total_mass, com_z / total_mass
        tilt_x, tilt_y = plane_gradient(centre, height)
        for k, tilt in enumerate((tilt_x, tilt_y)):
            if body[_STANDS] == 0.0:  # as the ground is where it was put
                body[_TILT + k], body[_TILTING + k] = tilt, 0.0
            pace = chassis[_FREQUENCY + k]
            pushed = pace * (pace * (tilt - body[_TILT + k]) - 2.0 * chassis[_DAMPING + k] * body[_TILTING + k])
            body[_TILTED + k] = pushed
            body[_TILTING + k] += dt * pushed
            body[_TILT + k] += dt * body[_TILTING + k]
        body[_STANDS] = 1.0
        chassis_wrench(
            body[_TIME], body[_X], body[_Y], body[_YAW], vx, vy, omega, com_x, com_y, com_z, effects, at, wrench
        )
        if lifted:
            normal[:] = 0.0
        else:
            weight = -total_mass * gravity[2]
            support_forces(
                weight - wrench[2],
                weight * com_x - total_mass * com_z * (body[_AX] - gravity_x) + wrench[4],
                weight * com_y - total_mass * com_z * (body[_AY] - gravity_y) - wrench[3],
                chassis[_SPRING],
                centre,
                height,
                normal,
            )
        m00, m02, m11, m12 = mass, -mass * cy, mass, mass * cx
        m01, m22 = 0.0, chassis[_I] + mass * (cx * cx + cy * cy)
        bias_x = -mid_omega * mid_y - mid_omega * mid_omega * cx - gravity_x
        bias_y = mid_omega * mid_x - mid_omega * mid_omega * cy - gravity_y
        f0 = wrench[0] - mass * bias_x
        f1 = wrench[1] - mass * bias_y
        f2 = wrench[5] - mass * (cx * bias_y - cy * bias_x)
        for i in range(n):
            row = part[i]
            wheel = wheels[i]
            c, s = row[_C], row[_S]
            rho_dot, phi_dot = wheel[RHO_DOT], wheel[PHI_DOT]
            sigma = phi_dot + omega
            sx, sy, by = casters[i, SX], casters[i, SY], casters[i, BY]
            ahead, aside = c * tilt_x + s * tilt_y, c * tilt_y - s * tilt_x
            bx = casters[i, BX] - casters[i, RADIUS] * ahead
            row[_B_X] = bx
            radius = casters[i, RADIUS] + ground[i, RADIUS_CHANGE]
            # Velocity of the wheel centre in the wheel frame.
            axis_x, axis_y = vx - omega * sy, vy + omega * sx
            along = c * axis_x + s * axis_y - sigma * by
            across = -s * axis_x + c * axis_y + sigma * bx
            slip_x, slip_y = radius * rho_dot - along, -across
            speed = max(abs(radius * rho_dot), math.sqrt(along * along + across * across))
            tyre = casters[i, TYRE:]
            grip = normal[i] * ground[i, FRICTION]
            zx, zy, fx, fy, row[_DZ_X], row[_DZ_Y], gx, gy = tyre_step_with_slopes(
                tyre,
                slip_under_load(wheel[ZX], wheel[FZ], normal[i]),
                slip_under_load(wheel[ZY], wheel[FZ], normal[i]),
                slip_x,
                slip_y,
                speed,
                grip,
                dt,
            )
            spin = scrub_torque(tyre, sigma, speed, grip)
            wheel[ZX], wheel[ZY], wheel[FX], wheel[FY], wheel[FZ] = zx, zy, fx, fy, normal[i]
            wheel[SLIP_X], wheel[SLIP_Y] = slip_x, slip_y
            row[_G_X], row[_G_Y] = gx, gy
            # The ground's gradient tilts the normal force, which goes through the wheel centre.
            climb_x = -normal[i] * (cos_yaw * ground[i, GRADIENT_X] + sin_yaw * ground[i, GRADIENT_Y])
            climb_y = -normal[i] * (-sin_yaw * ground[i, GRADIENT_X] + cos_yaw * ground[i, GRADIENT_Y])
            force_x, force_y = c * fx - s * fy + climb_x, s * fx + c * fy + climb_y
            f0 += force_x
            f1 += force_y
            f2 += centre[i, 0] * force_y - centre[i, 1] * force_x + spin
            # Slip velocity over the twist: eps_x = r rho_dot + by phi_dot + ex . V,  eps_y = -bx phi_dot + ey . V.
            ex0, ex1, ex2 = -c, -s, c * sy - s * sx + by
            ey0, ey1, ey2 = s, -c, -s * sy - c * sx - bx
            row[_E_X0], row[_E_X1], row[_E_X2] = ex0, ex1, ex2
            row[_E_Y0], row[_E_Y1], row[_E_Y2], row[_R] = ey0, ey1, ey2, radius
            gx *= half
            gy *= half
            m00 += gx * ex0 * ex0 + gy * ey0 * ey0
            m01 += gx * ex0 * ex1 + gy * ey0 * ey1
            m02 += gx * ex0 * ex2 + gy * ey0 * ey2
            m11 += gx * ex1 * ex1 + gy * ey1 * ey1
            m12 += gx * ex1 * ex2 + gy * ey1 * ey2
            m22 += gx * ex2 * ex2 + gy * ey2 * ey2
            # The module as a body at q = S + c, turning at sigma.
            m, izz = casters[i, MASS], casters[i, IZZ]
            mid_sigma = mid_omega + phi_dot + half * wheel[PHI_DDOT]
            lever_x = casters[i, CX] * c - casters[i, CY] * s
            lever_y = casters[i, CX] * s + casters[i, CY] * c
            qx, qy = sx + lever_x, sy + lever_y
            m00 += m
            m11 += m
            m02 -= m * qy
            m12 += m * qx
            m22 += izz + m * (qx * qx + qy * qy)
            bias_x = -mid_omega * mid_y - mid_omega * mid_omega * sx - mid_sigma * mid_sigma * lever_x - gravity_x
            bias_y = mid_omega * mid_x - mid_omega * mid_omega * sy - mid_sigma * mid_sigma * lever_y - gravity_y
            f0 -= m * bias_x
            f1 -= m * bias_y
            f2 -= m * (qx * bias_y - qy * bias_x)
            motor_torques(i, dt, casters[i], command[i], wheel, effects, at)
            tau_rho, tau_phi, s_rr, s_rp, s_pp = joint_torques(i, dt, wheel, normal[i], effects)
            force_across = fy - s * climb_x + c * climb_y
            force_along = fx + c * climb_x + s * climb_y
            rhs_r = tau_rho - radius * fx - normal[i] * ground[i, RADIUS_SLOPE]
            rhs_p = tau_phi + bx * force_across - by * force_along + spin - m * (lever_x * bias_y - lever_y * bias_x)
            rhs_p += (normal[i] * bx + m * gravity[2] * casters[i, CX]) * aside
            rhs_p -= (normal[i] * by + m * gravity[2] * casters[i, CY]) * ahead
            inertia_rr = casters[i, I_ROLL] + dt * s_rr + gx * radius * radius
            inertia_rp = casters[i, J_RP] + dt * s_rp + gx * radius * by
            inertia_pp = izz + m * (lever_x * lever_x + lever_y * lever_y) + casters[i, J_PP]
            inertia_pp += dt * s_pp + gx * by * by + gy * bx * bx
            kr0, kr1, kr2 = gx * radius * ex0, gx * radius * ex1, gx * radius * ex2
            kp0 = -m * lever_y + gx * by * ex0 - gy * bx * ey0
            kp1 = m * lever_x + gx * by * ex1 - gy * bx * ey1
            kp2 = izz + m * (qx * lever_x + qy * lever_y) + gx * by * ex2 - gy * bx * ey2
            determinant = inertia_rr * inertia_pp - inertia_rp * inertia_rp
            i_rr, i_rp, i_pp = inertia_pp / determinant, -inertia_rp / determinant, inertia_rr / determinant
            row[_I_RR], row[_I_RP], row[_I_PP] = i_rr, i_rp, i_pp
            row[_RHS_R], row[_RHS_P] = rhs_r, rhs_p
            row[_KR0], row[_KR1], row[_KR2] = kr0, kr1, kr2
            row[_KP0], row[_KP1], row[_KP2] = kp0, kp1, kp2
            # Schur complement: what the caster takes from the body.
            on_r, on_p = i_rr * rhs_r + i_rp * rhs_p, i_rp * rhs_r + i_pp * rhs_p
            f0 -= kr0 * on_r + kp0 * on_p
            f1 -= kr1 * on_r + kp1 * on_p
            f2 -= kr2 * on_r + kp2 * on_p
            ar0, ap0 = i_rr * kr0 + i_rp * kp0, i_rp * kr0 + i_pp * kp0
            ar1, ap1 = i_rr * kr1 + i_rp * kp1, i_rp * kr1 + i_pp * kp1
            ar2, ap2 = i_rr * kr2 + i_rp * kp2, i_rp * kr2 + i_pp * kp2
            m00 -= kr0 * ar0 + kp0 * ap0
            m01 -= kr0 * ar1 + kp0 * ap1
            m02 -= kr0 * ar2 + kp0 * ap2
            m11 -= kr1 * ar1 + kp1 * ap1
            m12 -= kr1 * ar2 + kp1 * ap2
            m22 -= kr2 * ar2 + kp2 * ap2
        a00, a01, a02 = m11 * m22 - m12 * m12, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
        a11, a12, a22 = m00 * m22 - m02 * m02, m01 * m02 - m00 * m12, m00 * m11 - m01 * m01
        determinant = m00 * a00 + m01 * a01 + m02 * a02
        d0 = (a00 * f0 + a01 * f1 + a02 * f2) / determinant
        d1 = (a01 * f0 + a11 * f1 + a12 * f2) / determinant
        d2 = (a02 * f0 + a12 * f1 + a22 * f2) / determinant
        if lifted:  # held by what lifts it
            d0, d1, d2 = 0.0, 0.0, 0.0
        for i in range(n):
            row = part[i]
            wheel = wheels[i]
            rhs_r = row[_RHS_R] - (row[_KR0] * d0 + row[_KR1] * d1 + row[_KR2] * d2)
            rhs_p = row[_RHS_P] - (row[_KP0] * d0 + row[_KP1] * d1 + row[_KP2] * d2)
            rho_ddot = row[_I_RR] * rhs_r + row[_I_RP] * rhs_p
            phi_ddot = row[_I_RP] * rhs_r + row[_I_PP] * rhs_p
            # The mean slip of the step beyond the one it began with.
            bx, by = row[_B_X], casters[i, BY]
            more_x = row[_R] * rho_ddot + by * phi_ddot + row[_E_X0] * d0 + row[_E_X1] * d1 + row[_E_X2] * d2
            more_y = -bx * phi_ddot + row[_E_Y0] * d0 + row[_E_Y1] * d1 + row[_E_Y2] * d2
            more_x *= half
            more_y *= half
            wheel[ZX] += row[_DZ_X] * more_x
            wheel[ZY] += row[_DZ_Y] * more_y
            wheel[FX] += row[_G_X] * more_x
            wheel[FY] += row[_G_Y] * more_y
            wheel[SLIP_X] += more_x
            wheel[SLIP_Y] += more_y
            wheel[RHO] += dt * (wheel[RHO_DOT] + half * rho_ddot)
            wheel[PHI] += dt * (wheel[PHI_DOT] + half * phi_ddot)
            wheel[RHO_DOT] += dt * rho_ddot
            wheel[PHI_DOT] += dt * phi_ddot
            wheel[RHO_DDOT], wheel[PHI_DDOT] = rho_ddot, phi_ddot
            turn_motors(i, dt, wheel[RHO_DOT], wheel[PHI_DOT], effects)
        mean_x, mean_y = vx + half * d0, vy + half * d1
        body[_X] += dt * (cos_yaw * mean_x - sin_yaw * mean_y)
        body[_Y] += dt * (sin_yaw * mean_x + cos_yaw * mean_y)
        body[_YAW] += dt * (omega + half * d2)
        body[_VX], body[_VY], body[_OMEGA] = vx + dt * d0, vy + dt * d1, omega + dt * d2
        # Of base_link's origin in space, at the middle of the step.
        body[_AX], body[_AY], body[_ALPHA] = d0 - (omega + half * d2) * mean_y, d1 + (omega + half * d2) * mean_x, d2
        body[_TIME] += dt
    return True


@compiled
def _set_motion(body, wheels, effects, twist, position, velocity):  # type: ignore[no-untyped-def]
    """Set the motion of the body and of the wheels, motors behind gears as rigid gears would have them."""
    body[_VX : _OMEGA + 1] = twist
    for i in range(len(wheels)):
        for axis in range(2):
            wheels[i, RHO + axis] = position[i, axis]
            wheels[i, RHO_DOT + axis] = velocity[i, axis]
    _rigid_motors(effects, position, velocity)


@compiled
def _rigid_motors(effects, position, velocity):  # type: ignore[no-untyped-def]
    """Set the motors behind gears as rigid gears would have them."""
    for i in range(len(position)):
        for axis in range(2):
            first, second = effects.coupling[i, axis, 0], effects.coupling[i, axis, 1]
            effects.gear_state[i, axis, ANGLE] = first * position[i, 0] + second * position[i, 1]
            effects.gear_state[i, axis, RATE] = first * velocity[i, 0] + second * velocity[i, 1]


@compiled
def _roll_out(  # type: ignore[no-untyped-def]
    steps, dt, chassis, casters, gravity, effects, torque, marks, set_at, time, pose, twist, position, velocity, relaxed_slip,
    bodies, joints,
):
    """Fill bodies (W, K, 6) and joints (W, K, n, 4) of `ReducedPlant.roll_out`; False if a torque is not finite."""
    windows, rows, n, _ = torque.shape
    body, wheels = np.empty(_BODY_STATE), np.empty((n, WHEEL_STATE))
    for w in range(windows):
        body[:] = 0.0
        wheels[:] = 0.0
        effects.memory[:] = 0.0
        effects.gear_state[:] = 0.0
        body[_X : _YAW + 1] = pose[w, 0]
        body[_TIME] = time[w]
        _set_motion(body, wheels, effects, twist[w, 0], position[w, 0], velocity[w, 0])
        mark, setting = 0, 1
        for row in range(rows + 1):
            if setting < len(set_at) and row == set_at[setting]:
                body[_X : _YAW + 1] = pose[w, setting]
                wheels[:, ZX : ZY + 1] = relaxed_slip[w, setting]
                # Gears stay wound up as the lead left them.
                wound = effects.gear_state[:, :, : RATE + 1].copy()
                _rigid_motors(effects, wheels[:, RHO : PHI + 1].copy(), wheels[:, RHO_DOT : PHI_DOT + 1].copy())
                wound -= effects.gear_state[:, :, : RATE + 1]
                _set_motion(body, wheels, effects, twist[w, setting], position[w, setting], velocity[w, setting])
                effects.gear_state[:, :, : RATE + 1] += wound
                setting += 1
            if mark < len(marks) and row == marks[mark]:
                bodies[w, mark] = body[: _OMEGA + 1]
                joints[w, mark, :, :2] = as_joint_motion(
                    effects.gears, effects.coupling, effects.gear_state[:, :, ANGLE], wheels[:, RHO : PHI + 1]
                )
                joints[w, mark, :, 2:] = as_joint_motion(
                    effects.gears, effects.coupling, effects.gear_state[:, :, RATE], wheels[:, RHO_DOT : PHI_DOT + 1]
                )
                mark += 1
            if row == rows:
                break
            if not _advance(steps, dt, chassis, casters, gravity, effects, torque[w, row], body, wheels):
                return False
    return True


@dataclasses.dataclass(frozen=True)
class WindowStarts:
    """How the windows of a roll-out begin: W of them, the motion of each given A times, the first with its first row.

    Attributes:
        rows: after the first at which the motion is set (A,), increasing, the first 0.
        time: of the first row (W,) [s].
        pose: (W, A, 3) of base_link in the world.
        twist: (W, A, 3) of base_link, slip of the wheels left out.
        position, velocity: of the joints (W, A, n, 2).
        relaxed_slip: of the tyres (W, A, n, 2) [m], as they stand under their forces; with the first row they land, and have
            none.
    """

    rows: IntArray
    time: FloatArray
    pose: FloatArray
    twist: FloatArray
    position: FloatArray
    velocity: FloatArray
    relaxed_slip: FloatArray


class ReducedPlant:
    """The reduced plant of one robot; see the module's docstring.

    Args:
        robot: the robot; its `physics` are at work.
        dt: step [s].
        lifted: the robot stands on a jack, its wheels off the ground.
    """

    def __init__(self, robot: RobotDescription, dt: float = 1e-3, lifted: bool = False) -> None:
        robot.require_torque_control()
        self.robot = robot
        self.dt = dt
        true_robot = as_it_really_is(robot)
        chassis = true_robot.chassis
        spring = true_robot.wheel_suspension.stiffness
        lean, frequency, damping = sway_numbers(true_robot)
        # What no spring holds upright stands as the ground does.
        frequency = np.where(lean > 0.0, np.minimum(frequency, FASTEST_SWAY / dt), FASTEST_SWAY / dt)
        self._chassis = np.array([
            chassis.mass, chassis.com[0], chassis.com[1], chassis.inertia_zz, chassis.com[2], spring, float(lifted),
            *frequency, *damping,
        ])  # fmt: skip
        self._casters = caster_numbers(without_geared_rotors(true_robot))
        self._effects = EffectTables(true_robot, dt)
        self._body = np.zeros(_BODY_STATE)
        self._wheels = np.zeros((robot.n, WHEEL_STATE))
        self.reset()

    def reset(self, pose: FloatArray | None = None, steer_angle: FloatArray | None = None) -> None:
        """Put the robot at rest at a pose (3,), the wheels at headings (n,); time becomes zero."""
        self._body[:] = 0.0
        self._wheels[:] = 0.0
        self._effects.reset()
        self._steps = 0
        if pose is not None:
            self._body[[_X, _Y, _YAW]] = pose
        if steer_angle is not None:
            self._wheels[:, PHI] = steer_angle
        self._effects.align_motors(self._wheels[:, RHO : PHI + 1], self._wheels[:, RHO_DOT : PHI_DOT + 1])

    def set_motion(self, twist: FloatArray, joint_position: FloatArray, joint_velocity: FloatArray) -> None:
        """Give the robot a twist (3,) in base_link and its joints angles and rates (n, 2), to go on from there."""
        self._body[_VX : _OMEGA + 1] = twist
        self._wheels[:, RHO : PHI + 1] = joint_position
        self._wheels[:, RHO_DOT : PHI_DOT + 1] = joint_velocity
        self._effects.align_motors(joint_position, joint_velocity)

    def step(self, motor_torque: FloatArray, steps: int = 1) -> None:
        """Advance by `steps` steps of dt with motor torques (n, 2) [N m] held.

        Raises:
            PlantError: a torque is NaN or infinite; the plant has not moved.
        """
        effects = self._effects
        self._body[_TIME] = self._steps * self.dt
        if not _advance(
            steps,
            self.dt,
            self._chassis,
            self._casters,
            effects.gravity,
            effects.compiled,
            motor_torque,
            self._body,
            self._wheels,
        ):
            raise PlantError("motor_torque holds NaN or infinity; allowed: finite torques in N m")
        self._steps += steps

    def state(self) -> PlantState:
        """Return the truth now."""
        body, wheels = self._body, self._wheels
        joint_position, joint_velocity = wheels[:, RHO : PHI + 1].copy(), wheels[:, RHO_DOT : PHI_DOT + 1].copy()
        motor_position, motor_velocity = self._effects.motor_motion(joint_position, joint_velocity)
        gravity = gravity_in_base(self._effects.gravity, body[_YAW])
        gravity[:2] -= GRAVITY * body[_TILT:_TILTING]
        return PlantState(
            time=self._steps * self.dt,
            pose=body[_X : _YAW + 1].copy(),
            twist=body[_VX : _OMEGA + 1].copy(),
            acceleration=body[_AX : _ALPHA + 1].copy(),
            gravity=gravity,
            # The vertical leans along x by a turn about -y, and along y by one about x.
            swing_rate=np.array([body[_TILTING + 1], -body[_TILTING]]),
            swing_acceleration=np.array([body[_TILTED + 1], -body[_TILTED]]),
            joint_position=joint_position,
            joint_velocity=joint_velocity,
            motor_position=motor_position,
            motor_velocity=motor_velocity,
            motor_torque=wheels[:, MOTOR_RHO : MOTOR_PHI + 1].copy(),
            slip=wheels[:, SLIP_X : SLIP_Y + 1].copy(),
            contact_force=wheels[:, FX : FY + 1].copy(),
            normal_force=wheels[:, FZ].copy(),
        )

    def roll_out(
        self, torque: FloatArray, steps: int, starts: WindowStarts, marks: Sequence[int]
    ) -> tuple[FloatArray, FloatArray]:
        """Drive many short windows with recorded torques, compiled as one; the plant is at its reset state afterwards.

        Where the motion is set again, gears stay wound up, and actuators keep their memories.

        Args:
            torque: motor torques (W, L, n, 2) [N m], each row held for `steps` steps.
            steps: steps of dt per row.
            starts: of the windows.
            marks: rows after the first at which the state is wanted (K,), increasing, at most L.

        Returns:
            Pose and twist (W, K, 6), and what encoders on the motors would read: joint positions and velocities
            (W, K, n, 2, 2), position first.

        Raises:
            PlantError: a torque is NaN or infinite.
        """
        windows, _, n, _ = torque.shape
        bodies, joints = np.full((windows, len(marks), 6), np.nan), np.full((windows, len(marks), n, 4), np.nan)
        fine = _roll_out(
            steps, self.dt, self._chassis, self._casters, self._effects.gravity, self._effects.compiled,
            np.ascontiguousarray(torque), np.array(marks, dtype=np.int64), starts.rows, starts.time, starts.pose, starts.twist,
            starts.position, starts.velocity, starts.relaxed_slip, bodies, joints,
        )  # fmt: skip
        self.reset()
        if not fine:
            raise PlantError("torque holds NaN or infinity; allowed: finite torques in N m")
        return bodies, joints.reshape(windows, len(marks), n, 2, 2)

    def close(self) -> None:
        """Free what the plant holds: nothing."""
