"""What surrounds a robot, as its effects have it: the ground under each wheel, and forces on the chassis."""

from __future__ import annotations

from pcw_description.compiled import compiled
from pcw_description.effects.kinds import (
    COM_X,
    COM_Y,
    COM_Z,
    CONTACT_TIME,
    CONTACT_X,
    CONTACT_Y,
    FORCE_TIME,
    FRICTION,
    LOAD,
    POSE_X,
    POSE_Y,
    POSE_YAW,
    ROLL_ANGLE,
    TWIST_X,
    TWIST_Y,
    TWIST_YAW,
)


@compiled
def ground_under(i, time, x, y, roll_angle, load, effects, at, ground):  # type: ignore[no-untyped-def]
    """Fill `ground` (CONTACT_RESULTS,) with what caster i meets, its wheel centre at (x, y) in the world [m]."""
    ground[:] = 0.0
    ground[FRICTION] = 1.0
    at[CONTACT_TIME], at[CONTACT_X], at[CONTACT_Y], at[ROLL_ANGLE], at[LOAD] = time, x, y, roll_angle, load
    for k in range(effects.array_start[i], effects.array_start[i + 1]):
        effects.array_kernels[k](at, effects.array_numbers[k], ground)


@compiled
def chassis_wrench(  # type: ignore[no-untyped-def]
    time, x, y, yaw, twist_x, twist_y, twist_yaw, com_x, com_y, com_z, effects, at, wrench
):
    """Fill `wrench` (6,) with the forces [N] on the chassis and their moments about base_link's origin [N m]."""
    wrench[:] = 0.0
    at[FORCE_TIME], at[POSE_X], at[POSE_Y], at[POSE_YAW] = time, x, y, yaw
    at[TWIST_X], at[TWIST_Y], at[TWIST_YAW] = twist_x, twist_y, twist_yaw
    at[COM_X], at[COM_Y], at[COM_Z] = com_x, com_y, com_z
    for k in range(effects.array_start[-2], effects.array_start[-1]):
        effects.array_kernels[k](at, effects.array_numbers[k], wrench)
