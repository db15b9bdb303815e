"""Tyre forces of a robot in space, as a wrench on the base and torques on the joints.

A three-dimensional engine carries the rigid bodies; this gives it everything the wheels feel. Forces at the contacts
are handed over as their exact equivalent in generalised forces: engines that apply a force at a moving link do so at a
link pose one step old, which falsifies the axle torque (EQUATIONS section 4).

Reflected rotors are defined by N^T J N on the joint rates. An engine that cannot do that carries the drive's share as
inertia of the wheel and the steering's as inertia of the fork; what that adds beyond the definition is taken back here,
with the accelerations of the last step: that the body's own turning turns the rotor too, that the rotor's spinning up and
gyroscopic torque push against the base, and the drive/steer coupling of the gears is added.
"""

from __future__ import annotations

import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import (
    scrub_torque,
    slip_under_load,
    tyre_step,
    tyre_step_with_slopes,
)
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
    MASS,
    PHI,
    PHI_DDOT,
    PHI_DOT,
    PUSH_X,
    PUSH_Y,
    RADIUS,
    RHO,
    RHO_DDOT,
    RHO_DOT,
    SLIP_X,
    SLIP_Y,
    SX,
    SY,
    TYRE,
    ZX,
    ZY,
)
from .drivetrain import joint_torques, motor_torques, turn_motors
from .effect_tables import GEAR, SLOPE
from .surroundings import chassis_wrench, ground_under


@compiled
def _cross(a, b):  # type: ignore[no-untyped-def]
    out = np.empty(3)
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
    return out


@compiled
def rotation_matrix(quaternion):  # type: ignore[no-untyped-def]
    """Return the rotation matrix (3, 3) of a unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    matrix = np.empty((3, 3))
    matrix[0, 0], matrix[0, 1], matrix[0, 2] = (
        1 - 2 * (y * y + z * z),
        2 * (x * y - z * w),
        2 * (x * z + y * w),
    )
    matrix[1, 0], matrix[1, 1], matrix[1, 2] = (
        2 * (x * y + z * w),
        1 - 2 * (x * x + z * z),
        2 * (y * z - x * w),
    )
    matrix[2, 0], matrix[2, 1], matrix[2, 2] = (
        2 * (x * z - y * w),
        2 * (y * z + x * w),
        1 - 2 * (x * x + y * y),
    )
    return matrix


@compiled
def _joint_inertia(caster, along):  # type: ignore[no-untyped-def]
    """Return the inertia [kg m^2] that a torque on the drive (along = 0) or steering (1) meets at least."""
    return caster[I_ROLL] if along == 0 else caster[IZZ] + caster[J_PP]


@compiled
def _behind_gear(dt, mobility, arm, inertia, gear, state):  # type: ignore[no-untyped-def]
    """Mobility of a contact [1/kg] where a motor behind a gear turns with the joint, as far as the gear grips.

    A force at an arm [m] on the joint's inertia [kg m^2] moves the motor, too: behind a gear that hardly gives way as
    behind none.
    """
    if gear[GEAR] == 0.0:
        return mobility
    return mobility - arm * arm * (1.0 / inertia - 1.0 / (inertia + dt * state[SLOPE]))


def contact_mobility(robot: RobotDescription) -> FloatArray:
    """Return by how much a force along and across each wheel accelerates its slip at most, (n, 2) [1/kg].

    The wheel and fork by themselves, and the chassis as if all wheels pushed its nearest part at once.
    """
    chassis = robot.chassis
    inertia_x, inertia_y, inertia_z = chassis.principal_inertias()
    reach = float(np.max(np.linalg.norm(robot.steer_axis - np.array(chassis.com[:2]), axis=1)))
    reach += float(np.max(np.linalg.norm(robot.caster_offset, axis=1)))
    base = 1.0 / chassis.mass + chassis.com[2] ** 2 / min(inertia_x, inertia_y) + reach**2 / inertia_z
    mobility = np.empty((robot.n, 2))
    for i, (caster, armature) in enumerate(zip(robot.casters, robot.armature, strict=True)):
        inertia = armature + np.diag([caster.wheel.inertia_axle, caster.module.inertia_zz])
        arms = np.array([[caster.wheel_radius, caster.caster_offset[1]], [0.0, -caster.caster_offset[0]]])
        mobility[i] = np.diag(arms @ np.linalg.solve(inertia, arms.T)) + robot.n * base
    return mobility


@compiled
def _pushes(dt, mobility, change, force_before, push_before, force):  # type: ignore[no-untyped-def]
    """What pushed a contact besides its tyre in the last step, and what will in this one if it goes on as it went [N].

    Of a wheel that was just put where it is nothing is known, nor how its slip changed: then it slips on as it does.
    """
    if math.isnan(push_before):
        return force, force
    push = force_before + change / (dt * mobility)
    return push, 2.0 * push - push_before


@compiled
def _slip_after(dt, mobility, slip, push, force, stiffness):  # type: ignore[no-untyped-def]
    """Slip at the end of a step, in which a stiff tyre under a light wheel has turned back long before its end.

    The tyre follows its slip to first order. A mobility that is too large damps; one below three quarters of the true one
    would let the step swing up.
    """
    return slip + dt * mobility * (push - force) / (1.0 + dt * mobility * stiffness)


@compiled
def contact_wrench(  # type: ignore[no-untyped-def]
    dt,
    time,
    chassis_mass,
    casters,
    mobility,
    suspension,
    body_rotors,
    effects,
    command,
    position,
    quaternion,
    linear_velocity,
    angular_velocity,
    com_in_base,
    angular_acceleration,
    wheels,
):
    """Advance the tyres by dt and return the wrench on the base (6,) about its centre of mass and joint torques (n, 2).

    Args:
        dt: step [s].
        time: since the start [s].
        chassis_mass: of the base link [kg].
        casters: constant numbers (n, TYRE + TYRE_SIZE).
        mobility: what a force along and across each wheel does at most to its slip (n, 2) [1/kg]; see `contact_mobility`.
        suspension: vertical stiffness [N/m] and damping [N s/m] of one wheel.
        body_rotors: reflected rotors that the engine carries in fork and wheel, not on the joints (n, 2, 2) [kg m^2].
        effects: see `EffectTables`.
        command: motor torques (n, 2) [N m], limited here.
        position, quaternion, linear_velocity, angular_velocity: motion of the base link's centre of mass, world axes.
        com_in_base: centre of mass of the base link in base_link (3,) [m].
        angular_acceleration: of the base link (3,) in world axes, of the last step or smoothed over the last steps
            [rad/s^2]; so those of the joints in `wheels`.
        wheels: state (n, WHEEL_STATE); positions, velocities and the last accelerations as the engine has
            them, the rest is filled here.
    """
    n = len(casters)
    wrench, joint_torque = np.zeros(6), np.zeros((n, 2))
    ground, at, push = np.empty(CONTACT_RESULTS), np.empty(FORCE_INPUTS), np.zeros(FORCE_RESULTS)
    rotation = rotation_matrix(quaternion)
    up = np.zeros(3)
    up[2] = 1.0
    axis = rotation[:, 2].copy()
    com = chassis_mass * com_in_base
    total_mass = chassis_mass
    for i in range(n):
        row = wheels[i]
        c, s = math.cos(row[PHI]), math.sin(row[PHI])
        # The steering axis at axle height, the wheel centre and the wheel's own axes, in the world.
        hub = np.empty(3)
        hub[0], hub[1], hub[2] = casters[i, SX], casters[i, SY], casters[i, RADIUS]
        offset = np.empty(3)
        offset[0] = casters[i, BX] * c - casters[i, BY] * s
        offset[1] = casters[i, BX] * s + casters[i, BY] * c
        offset[2] = 0.0
        total_mass += casters[i, MASS]
        com[0] += casters[i, MASS] * (casters[i, SX] + casters[i, CX] * c - casters[i, CY] * s)
        com[1] += casters[i, MASS] * (casters[i, SY] + casters[i, CX] * s + casters[i, CY] * c)
        com[2] += casters[i, MASS] * casters[i, RADIUS]
        side = np.empty(3)
        side[0], side[1], side[2] = -s, c, 0.0
        axle = rotation @ side
        arm = rotation @ (hub - com_in_base + offset)
        from_axis = rotation @ offset
        forward = _cross(axle, up)
        forward /= math.sqrt(forward[0] * forward[0] + forward[1] * forward[1])
        across = _cross(up, forward)
        radial = _cross(forward, axle)
        ground_under(i, time, position[0] + arm[0], position[1] + arm[1], row[RHO], row[FZ], effects, at, ground)
        radius = casters[i, RADIUS] + ground[RADIUS_CHANGE]
        # Out of round, the lowest point is ahead of the axle by the slope of the radius.
        contact = arm - radius * radial + ground[RADIUS_SLOPE] * forward
        # Velocities of the wheel centre and of the tread at the contact.
        turning = angular_velocity + row[PHI_DOT] * axis
        centre_velocity = (
            linear_velocity + _cross(angular_velocity, arm) + row[PHI_DOT] * _cross(axis, from_axis)
        )
        tread_velocity = centre_velocity + _cross(turning + row[RHO_DOT] * axle, contact - arm)
        gradient_x, gradient_y = ground[GRADIENT_X], ground[GRADIENT_Y]
        penetration = ground[HEIGHT] - (position[2] + contact[2])
        sinking = gradient_x * centre_velocity[0] + gradient_y * centre_velocity[1] - tread_velocity[2]
        normal = (
            max(suspension[0] * penetration + suspension[1] * sinking, 0.0) if penetration > 0.0 else 0.0
        )
        slip_x = -(tread_velocity[0] * forward[0] + tread_velocity[1] * forward[1])
        slip_y = -(tread_velocity[0] * across[0] + tread_velocity[1] * across[1])
        speed = max(
            abs(radius * row[RHO_DOT]),
            math.sqrt(centre_velocity[0] * centre_velocity[0] + centre_velocity[1] * centre_velocity[1]),
        )
        tyre = casters[i, TYRE:]
        grip = normal * ground[FRICTION]
        z_x, z_y = slip_under_load(row[ZX], row[FZ], normal), slip_under_load(row[ZY], row[FZ], normal)
        gear, motor = effects.gears[i], effects.gear_state[i]
        free_x = _behind_gear(dt, mobility[i, 0], casters[i, RADIUS], _joint_inertia(casters[i], 0), gear[0], motor[0])
        free_y = _behind_gear(dt, mobility[i, 1], casters[i, BX], _joint_inertia(casters[i], 1), gear[1], motor[1])
        _, _, force_x, force_y, _, _, stiff_x, stiff_y = tyre_step_with_slopes(tyre, z_x, z_y, slip_x, slip_y, speed, grip, dt)
        row[PUSH_X], push_x = _pushes(dt, free_x, slip_x - row[SLIP_X], row[FX], row[PUSH_X], force_x)
        row[PUSH_Y], push_y = _pushes(dt, free_y, slip_y - row[SLIP_Y], row[FY], row[PUSH_Y], force_y)
        row[ZX], row[ZY], force_x, force_y = tyre_step(
            tyre,
            z_x,
            z_y,
            _slip_after(dt, free_x, slip_x, push_x, force_x, stiff_x),
            _slip_after(dt, free_y, slip_y, push_y, force_y, stiff_y),
            speed,
            grip,
            dt,
        )
        spin = scrub_torque(tyre, turning[2], speed, grip)
        row[SLIP_X], row[SLIP_Y], row[FX], row[FY], row[FZ] = slip_x, slip_y, force_x, force_y, normal
        force = force_x * forward + force_y * across + normal * up
        # On a gradient the normal force leans, and goes through the wheel centre.
        lean = np.zeros(3)
        lean[0], lean[1] = -normal * gradient_x, -normal * gradient_y
        moment = spin * up + _cross(turning, body_rotors[i, 0, 0] * row[RHO_DOT] * axle)
        wrench[:3] += force + lean
        wrench[3:] += _cross(contact, force) + _cross(arm, lean) + moment
        motor_torques(i, dt, casters[i], command[i], row, effects, at)
        tau_rho, tau_phi, s_rr, _, s_pp = joint_torques(i, dt, row, normal, effects)
        tau_rho += axle @ _cross(contact - arm, force)
        tau_phi += axis @ (_cross(contact - arm + from_axis, force) + _cross(from_axis, lean) + moment)
        # Rotors: back to the definition N^T J N on the joint rates.
        drive_rotor, steer_rotor, gear_coupling = body_rotors[i, 0, 0], body_rotors[i, 1, 1], body_rotors[i, 0, 1]
        about_axle, about_axis = axle @ angular_acceleration, axis @ angular_acceleration
        tau_rho += drive_rotor * about_axle - gear_coupling * row[PHI_DDOT]
        tau_phi += steer_rotor * about_axis - gear_coupling * row[RHO_DDOT]
        wrench[3:] += drive_rotor * (row[RHO_DDOT] + about_axle) * axle + steer_rotor * (row[PHI_DDOT] + about_axis) * axis
        # The engine steps explicitly: it gets the torque that an implicit step would end with, at rest the very same.
        tau_rho /= 1.0 + dt * s_rr / _joint_inertia(casters[i], 0)
        tau_phi /= 1.0 + dt * s_pp / _joint_inertia(casters[i], 1)
        joint_torque[i, 0], joint_torque[i, 1] = tau_rho, tau_phi
        turn_motors(
            i,
            dt,
            row[RHO_DOT] + dt * tau_rho / _joint_inertia(casters[i], 0),
            row[PHI_DOT] + dt * tau_phi / _joint_inertia(casters[i], 1),
            effects,
        )
    if effects.array_start[-2] < effects.array_start[-1]:
        com /= total_mass
        origin = position - rotation @ com_in_base
        in_base = rotation.T @ (linear_velocity - _cross(angular_velocity, rotation @ com_in_base))
        chassis_wrench(
            time,
            origin[0],
            origin[1],
            math.atan2(rotation[1, 0], rotation[0, 0]),
            in_base[0],
            in_base[1],
            angular_velocity[2],
            com[0],
            com[1],
            com[2],
            effects,
            at,
            push,
        )
        # From moments about base_link's origin to those about the centre of mass.
        force = rotation @ push[:3]
        wrench[:3] += force
        wrench[3:] += rotation @ push[3:] - _cross(rotation @ com_in_base, force)
    return wrench, joint_torque
