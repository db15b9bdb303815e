"""Numbers and state of all casters as two arrays, the form in which compiled plants take them."""

from __future__ import annotations

import numpy as np

from pcw_description.contact.contact_model import TYRE_SIZE, tyre_parameters
from pcw_description.robot_description import FloatArray, RobotDescription

# Columns of the constant numbers of a caster.
SX, SY, BX, BY, RADIUS, MASS, CX, CY, IZZ, I_ROLL, J_RP, J_PP, LIMIT_DRIVE, LIMIT_STEER, TYRE = range(15)
# Columns of the state of a caster; the last four are the joint accelerations of the last step and, of plants in space, what
# pushed the contact besides its tyre [N].
RHO, PHI, RHO_DOT, PHI_DOT, ZX, ZY, MOTOR_RHO, MOTOR_PHI, SLIP_X, SLIP_Y, FX, FY, FZ = range(13)
RHO_DDOT, PHI_DDOT, PUSH_X, PUSH_Y = range(13, 17)
WHEEL_STATE = 17


def caster_numbers(robot: RobotDescription) -> FloatArray:
    """Return the constant numbers of all casters, (n, TYRE + TYRE_SIZE)."""
    numbers = np.empty((robot.n, TYRE + TYRE_SIZE))
    for row, caster, armature, tyre in zip(numbers, robot.casters, robot.armature, robot.tyres, strict=True):
        row[[SX, SY]] = caster.steer_axis
        row[[BX, BY]] = caster.caster_offset
        row[[RADIUS, MASS]] = caster.wheel_radius, caster.module.mass
        row[[CX, CY]] = caster.module.com
        row[IZZ] = caster.module.inertia_zz
        row[I_ROLL] = caster.wheel.inertia_axle + armature[0, 0]
        row[[J_RP, J_PP]] = armature[0, 1], armature[1, 1]
        row[[LIMIT_DRIVE, LIMIT_STEER]] = caster.limits.drive_torque, caster.limits.steer_torque
        row[TYRE:] = tyre_parameters(tyre)
    return numbers
