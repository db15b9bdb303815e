"""Slip ratios of a whole robot kept in their band: well within it nothing changes, and known slip is needed to change it."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pcw_control.controllers import make_controller
from pcw_description import joint_matrix, load_robot

_spec = importlib.util.spec_from_file_location("controller_contract", Path(__file__).with_name("controller_contract.py"))
contract = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(contract)

DT = 0.002
ROBOT = load_robot("thesis")
REFERENCE = contract.TwistReference(np.array([1.0, 0.0, 0.0]))


@pytest.mark.parametrize("name", ["thesis", "tidybot2", "xr4000"])
def test_keeps_the_controllers_contract(name):
    robot = load_robot(name)
    contract.check_contract(make_controller("slip_ratio_limit", robot), robot, np.random.default_rng(5))


def steady(measurement, robot=ROBOT):
    """Torques of SCFC alone and with the limit, after the sliding mode has had 40 cycles to find the force."""
    outputs = []
    for entry in ("slip_constraint_force", "slip_ratio_limit"):
        controller = make_controller(entry, robot)
        state = begun = controller.initial_state(np.array([0.5, 0.0, 0.0]))
        for _ in range(40):
            # The reference stays where it was: what is asked for is the same in all cycles.
            state = dataclasses.replace(state, reference_twist=begun.reference_twist, error_integral=begun.error_integral)
            state, output = controller.step(state, measurement, REFERENCE, DT)
        outputs.append(output)
    return outputs


def rolling(slip=None, **more):
    measurement = contract.rolling_measurement(ROBOT, [0.5, 0.0, 0.0], np.zeros(4))
    return dataclasses.replace(measurement, slip=slip, **more)


def test_without_slip_and_within_the_band_nothing_changes():
    for slip in (None, np.zeros((4, 2))):
        plain, limited = steady(rolling(slip))
        np.testing.assert_array_equal(limited.torque, plain.torque)


def test_a_wheel_beyond_its_band_gets_less_torque_and_a_brake_is_let_go():
    """All wheels alike, which encoders cannot see: the ratio 0.3 is far beyond the 0.08 that are allowed."""
    for sign in (1.0, -1.0):
        slip = np.zeros((4, 2))
        slip[:, 0] = sign * 0.15
        plain, limited = steady(rolling(slip))
        assert np.all(sign * (limited.torque[:, 0] - plain.torque[:, 0]) < -0.1)
        np.testing.assert_array_equal(limited.torque[:, 1], plain.torque[:, 1])
        # What is said of the contact forces is what the torques are.
        tau = joint_matrix(ROBOT).T @ limited.contact_force.ravel()
        np.testing.assert_allclose(tau, limited.torque.ravel(), atol=1e-9)


def test_slip_that_nobody_vouches_for_changes_nothing():
    slip, valid = np.full((4, 2), 0.15), np.ones((4, 2), dtype=bool)
    valid[2] = False
    measurement = rolling(slip, slip_valid=valid)
    plain, limited = steady(measurement)
    assert limited.torque[2, 0] == plain.torque[2, 0]
    assert limited.torque[0, 0] < plain.torque[0, 0]


def test_the_band_is_that_of_the_ground_that_is_said():
    slip = np.zeros((4, 2))
    slip[:, 0] = 0.06  # a ratio of 0.12
    wide, narrow = (
        steady(rolling(slip, critical_slip=np.full(4, critical)))[1].torque[:, 0] for critical in (0.4, 0.06)
    )
    plain = steady(rolling(slip))[0].torque[:, 0]
    np.testing.assert_array_equal(wide, plain)
    assert np.all(narrow < plain)


def test_less_drive_needs_less_of_the_steering_where_the_wheel_stands_beside_its_axis():
    """A brake that was let go left the steering the torque against the whole of it: the casters of such a robot swung out."""
    robot = load_robot("tidybot2")
    assert np.all(np.abs(robot.caster_offset[:, 1]) > 1e-3)
    slip = np.zeros((4, 2))
    slip[:, 0] = 0.15
    measurement = contract.rolling_measurement(robot, [0.5, 0.0, 0.0], np.zeros(4))
    plain, limited = steady(dataclasses.replace(measurement, slip=slip), robot)
    change = limited.contact_force - plain.contact_force
    assert np.all(change[:, 0] < -1.0)
    np.testing.assert_array_equal(change[:, 1], 0.0)


def test_what_the_ground_does_not_give_is_not_asked_for_afterwards():
    """Braked at its limit for a second, a robot that stood at last drove on backwards, at a twelfth of its speed."""
    controller = make_controller("slip_ratio_limit", ROBOT)
    stop = contract.TwistReference(np.zeros(3))
    sides = []
    for slipping in (0.0, -0.15):
        slip = np.zeros((4, 2))
        slip[:, 0] = slipping
        state = controller.initial_state(np.array([0.5, 0.0, 0.0]))
        for _ in range(100):
            state, _output = controller.step(state, rolling(slip), stop, DT)
        sides.append(state.error_integral)
    assert sides[0][0] < -0.01
    assert abs(sides[1][0]) < 0.1 * abs(sides[0][0])
