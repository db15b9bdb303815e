"""A robot file with other masses than the robot: the whole-robot observer says so, and goes on saying so."""

import math

import numpy as np
import pytest

from pcw_description import AugmentedObjectModel, inverse_kinematics, load_robot
from pcw_description.differential_kinematics import joint_matrix, wheel_jacobian
from pcw_estimation import RobotSlidingModeObserver, SlidingModeParameters
from pcw_estimation.slip_estimate import JointMeasurement

ROBOT = load_robot("thesis")
PERIOD = 0.002


def sway(measured, mass_share, duration):
    """Roll to and fro along x without slip, by the torques of a robot of another mass; return what is said of each reading."""
    ahead = np.zeros(ROBOT.n)
    inertia, _ = AugmentedObjectModel(ROBOT).evaluate(ahead, np.zeros(3))
    torque = joint_matrix(ROBOT).T @ np.linalg.pinv(wheel_jacobian(ROBOT, ahead).T) @ inertia[:, 0]
    observer = RobotSlidingModeObserver(ROBOT, SlidingModeParameters(measured=measured))
    state, roll, contradicted, valid = observer.initial_state(), np.zeros(ROBOT.n), [], []
    for k in range(round(duration / PERIOD)):
        phase = 6.0 * PERIOD * k
        speed, acceleration = 0.5 + 0.3 * math.sin(phase), 1.8 * math.cos(phase - 3.0 * PERIOD)
        rates = inverse_kinematics(ROBOT, ahead, np.array([speed, 0.0, 0.0]))
        roll = roll + PERIOD * rates[:, 0]
        effort = mass_share * acceleration * torque.reshape(ROBOT.n, 2)
        state, estimate = observer.step(state, JointMeasurement(np.stack([roll, ahead], axis=1), rates, effort), PERIOD)
        contradicted.append(observer.contradicted(state))
        valid.append(bool(estimate.velocity_valid.any()))
    return np.array(contradicted), np.array(valid)


@pytest.mark.parametrize("measured", ["speed", "angle"])
@pytest.mark.parametrize("mass_share", [0.5, 0.7, 1.5])
def test_other_masses_are_told_without_a_break_and_no_velocity_is_vouched_for(measured, mass_share):
    """Half the mass was never told: its wheels seemed to spin, and nothing was learned while they did."""
    contradicted, valid = sway(measured, mass_share, 8.0)
    late = round(6.0 / PERIOD)
    assert contradicted[late:].all() and not valid[late:].any()


@pytest.mark.parametrize("mass_share", [0.9, 1.0, 1.1])
def test_masses_within_tolerance_are_never_told(mass_share):
    contradicted, _ = sway("speed", mass_share, 8.0)
    assert not contradicted.any()
