"""The joint torques of a robot's effects, in the form that compiled plants call."""

from __future__ import annotations

import numpy as np

from pcw_description.compiled import compiled, joint_torque_list
from pcw_description.effects.effect import JointTorqueEffect
from pcw_description.effects.registry import get
from pcw_description.robot_description import AXIS_NAMES, RobotDescription

# Step of the slope of a friction law [rad/s]: far below any smoothing speed, far above rounding.
_SLOPE_STEP = 1e-6


@compiled
def joint_effect_torque(kernel, position, velocity, motor_torque, normal_force, numbers):  # type: ignore[no-untyped-def]
    """Return the torque [N m] and minus its slope over speed, at least zero [N m s/rad], for implicit steps."""
    torque = kernel(position, velocity, motor_torque, normal_force, numbers)
    ahead = kernel(position, velocity + _SLOPE_STEP, motor_torque, normal_force, numbers)
    return torque, max((torque - ahead) / _SLOPE_STEP, 0.0)


class JointEffects:
    """Every joint-torque effect of a robot, one entry per targeted joint.

    Attributes:
        kernels: list of m compiled kernels.
        place: caster and axis of each, (m, 2) int.
        numbers: parameters of each, (m, widest), padded with zeros.
    """

    def __init__(self, robot: RobotDescription) -> None:
        kernels, place, numbers = [], [], []
        for instance in robot.physics:
            effect = get(instance.name)
            if isinstance(effect, JointTorqueEffect):
                for name in instance.target:
                    kernels.append(effect.torque)
                    place.append((robot.caster_index(name), AXIS_NAMES.index(effect.axis)))
                    numbers.append(effect.values(instance.parameters))
        self.kernels = joint_torque_list(kernels)
        self.place = np.array(place, dtype=np.int64).reshape(-1, 2)
        self.numbers = np.zeros((len(numbers), max((len(row) for row in numbers), default=1)))
        for row, values in zip(self.numbers, numbers, strict=True):
            row[: len(values)] = values
