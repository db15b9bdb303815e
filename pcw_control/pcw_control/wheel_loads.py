"""What each wheel carries and can hold: the load of a rigid body on equal springs, and the friction under it.

    F_z from: sum F_z = m g,  sum F_z x = m (g x_com - z_com a_x),  sum F_z y = m (g y_com - z_com a_y)

Braking and turning move load between the wheels; the acceleration comes from the controller's own demand.
"""

from __future__ import annotations

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import GRAVITY, FloatArray, RobotDescription
from pcw_description.support_forces import support_forces


class WheelLoads:
    """The loads of one robot, from its description."""

    def __init__(self, robot: RobotDescription) -> None:
        chassis, modules = robot.chassis, robot.casters
        self._chassis = np.array([chassis.mass, *chassis.com])
        self._module = np.array([[c.module.mass, *c.module.com, c.wheel_radius] for c in modules])
        self._geometry = (robot.steer_axis, robot.caster_offset)
        mu = np.array([[tyre.mu_p, tyre.lateral.mu_p] for tyre in robot.tyres])
        # Peak friction along and across (n, 2), and along (n,), of the robot's ground.
        self.mu, self.mu_along = mu, np.ascontiguousarray(mu[:, 0])
        # What `traction_limit_kernel` takes first.
        self.numbers = (self._chassis, self._module, *self._geometry, mu)

    def normal_force(self, steer_angle: FloatArray, acceleration: FloatArray) -> FloatArray:
        """Return F_z (n,) [N].

        Args:
            steer_angle: headings (n,) [rad].
            acceleration: of base_link in base_link (2,) or (3,) [m/s^2].
        """
        load: FloatArray = _loads(self._chassis, self._module, *self._geometry, steer_angle, acceleration)
        return load

    def traction_limit(
        self,
        steer_angle: FloatArray,
        acceleration: FloatArray,
        friction: FloatArray | None = None,
        normal_force: FloatArray | None = None,
    ) -> FloatArray:
        """Return mu F_z along and across (n, 2) [N].

        Args:
            steer_angle: headings (n,) [rad].
            acceleration: of base_link in base_link [m/s^2].
            friction: peak friction coefficient under each wheel (n,); None is that of the robot's ground.
            normal_force: measured loads (n,) [N]; None computes them.
        """
        limit: FloatArray = traction_limit_kernel(
            *self.numbers, steer_angle, acceleration, *self.known(friction, normal_force)
        )
        return limit

    def known(self, friction: FloatArray | None, normal_force: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Return friction (n,) and loads as `traction_limit_kernel` takes them last: loads (0,) that nobody measured."""
        return self.mu_along if friction is None else friction, _NO_LOADS if normal_force is None else normal_force


_NO_LOADS = np.zeros(0)


@compiled
def traction_limit_kernel(  # type: ignore[no-untyped-def]
    chassis, module, steer_axis, caster_offset, mu, steer_angle, acceleration, friction, normal_force
):
    """Return mu F_z (n, 2); an estimate of friction is of the ground: along and across keep the ratio that the tyre has."""
    measured = len(normal_force) > 0
    load = np.empty(len(steer_angle))
    if not measured:
        load = _loads(chassis, module, steer_axis, caster_offset, steer_angle, acceleration)
    limit = np.empty(mu.shape)
    for i in range(len(load)):
        carried = normal_force[i] if measured else load[i]
        for j in range(2):
            limit[i, j] = mu[i, j] * (friction[i] / mu[i, 0]) * carried
    return limit


@compiled
def _loads(chassis, module, steer_axis, caster_offset, steer_angle, acceleration):  # type: ignore[no-untyped-def]
    n = len(steer_angle)
    centre = np.empty((n, 2))
    mass, moment_x, moment_y, height = chassis[0], chassis[0] * chassis[1], chassis[0] * chassis[2], chassis[0] * chassis[3]
    for i in range(n):
        c, s = np.cos(steer_angle[i]), np.sin(steer_angle[i])
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        centre[i, 0], centre[i, 1] = steer_axis[i, 0] + bx * c - by * s, steer_axis[i, 1] + bx * s + by * c
        m, dx, dy = module[i, 0], module[i, 1], module[i, 2]
        mass += m
        moment_x += m * (steer_axis[i, 0] + dx * c - dy * s)
        moment_y += m * (steer_axis[i, 1] + dx * s + dy * c)
        height += m * module[i, 3]
    normal_force = np.empty(n)
    # Equal springs on even ground: their stiffness does not count.
    support_forces(
        mass * GRAVITY, moment_x * GRAVITY - height * acceleration[0], moment_y * GRAVITY - height * acceleration[1], 1.0,
        centre, np.zeros(n), normal_force,
    )
    return normal_force
