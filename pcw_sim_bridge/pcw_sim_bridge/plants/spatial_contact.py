"""Tyre forces of a robot in space, as a wrench on the base and torques on the joints.

A three-dimensional engine carries the rigid bodies; this gives it everything the wheels feel. Forces at the contacts
are handed over as their exact equivalent in generalised forces: engines that apply a force at a moving link do so at a
link pose one step old, which falsifies the axle torque (EQUATIONS section 4).

Reflected rotors are defined by N^T J N on the joint rates. The engine carries the drive's share as inertia of the wheel
and the steering's as inertia of the fork; what that adds beyond the definition is taken back here, with the
accelerations of the last step: the fork's coupling to the yaw rate, the gyroscopic torque of the wheel's share, and the
drive/steer coupling of the gears is added.
"""

from __future__ import annotations

import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import scrub_torque, tyre_step

from .caster_arrays import (
    BX,
    BY,
    FX,
    FY,
    FZ,
    I_ROLL,
    IZZ,
    J_PP,
    J_RP,
    LIMIT_DRIVE,
    LIMIT_STEER,
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
    ZX,
    ZY,
)
from .joint_effects import joint_effect_torque


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
def contact_wrench(  # type: ignore[no-untyped-def]
    dt,
    casters,
    effect_kernels,
    effect_place,
    effect_numbers,
    suspension,
    drive_armature,
    command,
    quaternion,
    com_position,
    com_velocity,
    angular_velocity,
    com_in_base,
    joint_acceleration,
    yaw_acceleration,
    wheels,
):
    """Advance the tyres by dt and return the wrench on the base (6,) about its centre of mass and joint torques (n, 2).

    Args:
        dt: step [s].
        casters: constant numbers (n, TYRE + TYRE_SIZE).
        effect_kernels, effect_place, effect_numbers: see `JointEffects`.
        suspension: vertical stiffness [N/m] and damping [N s/m] of one wheel.
        drive_armature: rotor inertia carried by each wheel body (n,) [kg m^2].
        command: motor torques (n, 2) [N m], limited here.
        quaternion, com_position, com_velocity, angular_velocity: motion of the base link, world axes.
        com_in_base: centre of mass of the base link in base_link (3,) [m].
        joint_acceleration, yaw_acceleration: of the last step, (n, 2) and scalar [rad/s^2].
        wheels: state (n, WHEEL_STATE); positions and velocities as the engine has them, the rest is filled here.
    """
    wrench = np.zeros(6)
    joint_torque = np.zeros((len(casters), 2))
    rotation = rotation_matrix(quaternion)
    up = np.zeros(3)
    up[2] = 1.0
    axis = rotation[:, 2].copy()
    for i in range(len(casters)):
        row = wheels[i]
        c, s = math.cos(row[PHI]), math.sin(row[PHI])
        radius = casters[i, RADIUS]
        # The steering axis at axle height, the wheel centre and the wheel's own axes, in the world.
        hub = np.empty(3)
        hub[0], hub[1], hub[2] = casters[i, SX], casters[i, SY], radius
        offset = np.empty(3)
        offset[0] = casters[i, BX] * c - casters[i, BY] * s
        offset[1] = casters[i, BX] * s + casters[i, BY] * c
        offset[2] = 0.0
        side = np.empty(3)
        side[0], side[1], side[2] = -s, c, 0.0
        axle = rotation @ side
        arm = rotation @ (hub - com_in_base + offset)
        from_axis = rotation @ offset
        forward = _cross(axle, up)
        forward /= math.sqrt(forward[0] * forward[0] + forward[1] * forward[1])
        across = _cross(up, forward)
        radial = _cross(forward, axle)
        contact = arm - radius * radial
        # Velocities of the wheel centre and of the tread at the contact.
        turning = angular_velocity + row[PHI_DOT] * axis
        centre_velocity = (
            com_velocity + _cross(angular_velocity, arm) + row[PHI_DOT] * _cross(axis, from_axis)
        )
        tread_velocity = centre_velocity + _cross(turning + row[RHO_DOT] * axle, contact - arm)
        penetration = -(com_position[2] + contact[2])
        normal = (
            max(suspension[0] * penetration - suspension[1] * tread_velocity[2], 0.0)
            if penetration > 0.0
            else 0.0
        )
        slip_x = -(tread_velocity[0] * forward[0] + tread_velocity[1] * forward[1])
        slip_y = -(tread_velocity[0] * across[0] + tread_velocity[1] * across[1])
        speed = max(
            abs(radius * row[RHO_DOT]),
            math.sqrt(centre_velocity[0] * centre_velocity[0] + centre_velocity[1] * centre_velocity[1]),
        )
        tyre = casters[i, TYRE:]
        row[ZX], row[ZY], force_x, force_y = tyre_step(
            tyre, row[ZX], row[ZY], slip_x, slip_y, speed, normal, dt
        )
        spin = scrub_torque(tyre, turning[2], speed, normal)
        row[SLIP_X], row[SLIP_Y], row[FX], row[FY], row[FZ] = slip_x, slip_y, force_x, force_y, normal
        force = force_x * forward + force_y * across + normal * up
        moment = spin * up + _cross(turning, drive_armature[i] * row[RHO_DOT] * axle)
        wrench[:3] += force
        wrench[3:] += _cross(contact, force) + moment
        motor_rho = min(max(command[i, 0], -casters[i, LIMIT_DRIVE]), casters[i, LIMIT_DRIVE])
        motor_phi = min(max(command[i, 1], -casters[i, LIMIT_STEER]), casters[i, LIMIT_STEER])
        row[MOTOR_RHO], row[MOTOR_PHI] = motor_rho, motor_phi
        joint_torque[i, 0] = motor_rho + axle @ _cross(contact - arm, force)
        joint_torque[i, 1] = motor_phi + axis @ (_cross(contact - arm + from_axis, force) + moment)
        # Rotors: back to the definition N^T J N on the joint rates.
        armature = casters[i, J_PP]
        joint_torque[i, 1] += armature * yaw_acceleration - casters[i, J_RP] * joint_acceleration[i, 0]
        joint_torque[i, 0] -= casters[i, J_RP] * joint_acceleration[i, 1]
        wrench[3:] += armature * (yaw_acceleration + joint_acceleration[i, 1]) * axis
    for k in range(len(effect_place)):
        i, along = effect_place[k, 0], effect_place[k, 1]
        torque, slope = joint_effect_torque(
            effect_kernels[k],
            wheels[i, RHO + along],
            wheels[i, RHO_DOT + along],
            wheels[i, MOTOR_RHO + along],
            wheels[i, FZ],
            effect_numbers[k],
        )
        # The engine steps explicitly: limit the torque to what an implicit step would apply.
        joint_torque[i, along] += torque / (1.0 + dt * slope / _joint_inertia(casters[i], along))
    return wrench, joint_torque
