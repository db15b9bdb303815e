"""Mobility of the robot as a parallel mechanism, section 3.1 [Li2009]."""

from __future__ import annotations

from .errors import KinematicsError


def planar_mobility(bodies: int, one_dof_joints: int, two_dof_joints: int = 0) -> int:
    """Return the degrees of freedom by Gruebler's formula, DOF = 3 (m - 1) - 2 l_1 - l_2, (3.1)."""
    return 3 * (bodies - 1) - 2 * one_dof_joints - two_dof_joints


def robot_mobility(casters: int) -> int:
    """Return the mobility of a robot with n powered casters, (3.2): ground, chassis and two bodies per caster.

    Raises:
        KinematicsError: fewer than one caster.
    """
    if casters < 1:
        raise KinematicsError(f"casters = {casters}; allowed: at least 1")
    return planar_mobility(bodies=2 + 2 * casters, one_dof_joints=3 * casters)


def is_omnidirectional(casters: int) -> bool:
    """Return whether the robot can be driven in all three directions: mobility 3 and at least 3 of 2n actuators."""
    return robot_mobility(casters) == 3 and 2 * casters >= 3
