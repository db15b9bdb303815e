"""What every torque controller must keep; each controller's test runs it with its own `step`.

A controller is what `pcw_control.controller_interface` says.
"""

import copy

import numpy as np
import pytest

from pcw_control import ControlError, ControllerMeasurement, TrajectoryPoint, TwistReference
from pcw_description import inverse_kinematics


def rolling_measurement(robot, twist, steer_angle, pose=None, saturated=False):
    """A measurement of a robot that rolls without slip at `twist` (3,)."""
    position = np.zeros((robot.n, 2))
    position[:, 1] = steer_angle
    velocity = inverse_kinematics(robot, steer_angle, np.asarray(twist, dtype=float))
    return ControllerMeasurement(position, velocity, np.zeros(3) if pose is None else pose, saturated)


def check_contract(controller, robot, rng):
    """Run all checks of the contract."""
    measurement = rolling_measurement(robot, rng.normal(0.0, 0.3, 3), rng.uniform(-3.0, 3.0, robot.n))
    state = controller.initial_state()
    reference = TwistReference(np.array([0.4, -0.2, 0.3]))

    kept = copy.deepcopy((state, measurement, reference))
    first_state, first = controller.step(state, measurement, reference, 0.002)
    second_state, second = controller.step(state, measurement, reference, 0.002)
    # Pure: equal arguments, equal results, and the arguments stay as they were.
    for a, b in ((first_state, second_state), (first, second), ((state, measurement, reference), kept)):
        assert repr(a) == repr(b)

    assert first.torque.shape == first.contact_force.shape == (robot.n, 2)
    assert first.wrench.shape == (3,)
    assert np.isfinite(first.torque).all()

    # A measurement that is not a number, and a dt that is none, are refused with their name.
    for field in ("joint_position", "joint_velocity"):
        bad = copy.deepcopy(measurement)
        getattr(bad, field)[0, 0] = np.nan
        with pytest.raises(ControlError, match=field):
            controller.step(state, bad, reference, 0.002)
    for dt in (0.0, -0.001, np.nan):
        with pytest.raises(ControlError, match="dt"):
            controller.step(state, measurement, reference, dt)
    with pytest.raises(ControlError, match="reference twist"):
        controller.step(state, measurement, TwistReference(np.array([np.inf, 0.0, 0.0])), 0.002)
    with pytest.raises(ControlError, match="reference pose"):
        controller.step(state, measurement, TrajectoryPoint(np.array([np.nan, 0.0, 0.0])), 0.002)
