"""How far and how fast a chassis sways on the springs over its wheels: an inverted pendulum whose foot is accelerated.

About the line on the floor around which it leans, with mass m, height h, inertia I + m h^2, and springs k and dampers c at
the distances x from that line,

    (I + m h^2) theta'' + c sum(x^2) theta' + (k sum(x^2) - m g h) theta = m h a.
"""

from __future__ import annotations

import math

import numpy as np

from .robot_description import GRAVITY, FloatArray, RobotDescription


def sway_numbers(robot: RobotDescription) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return lean [s^2], natural, undamped frequency [rad/s] and damping ratio along x and y of base_link, (2,) each.

    `lean` is how far the centre of mass stays behind where a rigid body would have it, h theta, per slow acceleration a; zero
    for a robot that its springs would not hold upright, whose other numbers mean nothing.
    """
    chassis, springs = robot.chassis, robot.wheel_suspension
    lean, frequency, damping = np.zeros(2), np.ones(2), np.ones(2)
    mass = robot.total_mass
    masses = np.array([chassis.mass, *(c.module.mass for c in robot.casters)])
    heights = np.array([chassis.com[2], *robot.wheel_radius])
    height = float(masses @ heights) / mass
    about_x, about_y, _ = chassis.principal_inertias()
    for k, own in enumerate((about_y, about_x)):
        arms = robot.steer_axis[:, k] - robot.steer_axis[:, k].mean()
        inertia = own + float(masses @ heights**2)
        stiffness = springs.stiffness * float(arms @ arms) - mass * GRAVITY * height
        if stiffness > 0.0:
            lean[k] = mass * height**2 / stiffness
            frequency[k] = math.sqrt(stiffness / inertia)
            damping[k] = springs.damping * float(arms @ arms) / (2.0 * math.sqrt(stiffness * inertia))
    return lean, frequency, damping
