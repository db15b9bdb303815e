"""How a wanted twist is approached: casters that must turn far are planned for, and nothing turns at a stop."""

import math

import numpy as np
import pytest

from pcw_control.computed_torque import ComputedTorqueParameters
from pcw_control.reference_motion import ReferenceMotion, derived_steer_acceleration
from pcw_description import inverse_kinematics, load_robot, wheel_jacobian

DT = 0.002


def drive(robot, parameters, targets, steer_angle, seconds=2.0):
    """Follow targets one after the other with wheels that follow without slip; returns twists, headings, steering rates."""
    motion, V, phi, found = ReferenceMotion(robot, parameters), np.zeros(3), np.array(steer_angle, dtype=float), []
    for target in targets:
        for _ in range(round(seconds / DT)):
            V, _ = motion.towards(V, np.array(target), wheel_jacobian(robot, phi), DT)
            rate = inverse_kinematics(robot, phi, V)[:, 1]
            found.append((V, phi.copy(), rate))
            phi = phi + DT * rate
    twists, headings, rates = (np.array(values) for values in zip(*found))
    return twists, headings, rates


@pytest.mark.parametrize("name", ["thesis", "xr4000", "flow_base"])
def test_the_acceleration_at_which_casters_turn_round_stays_within_its_limit(name):
    """From all kinds of headings, reversals included. Beyond the limit only by what v_dot and one step of 2 ms add."""
    robot = load_robot(name)
    alpha = 15.0
    parameters = ComputedTorqueParameters(steer_acceleration=alpha)
    rng = np.random.default_rng(4)
    largest = unlimited = 0.0
    for _ in range(6):
        steer_angle = rng.uniform(-math.pi, math.pi, robot.n)
        targets = [(0.6, 0.2, 0.0), (-0.6, 0.1, 0.0), (0.0, 0.0, 0.0)]
        for parameters_now, is_limited in ((parameters, True), (ComputedTorqueParameters(steer_acceleration=1e4), False)):
            _, _, rates = drive(robot, parameters_now, targets, steer_angle)
            found = np.abs(np.diff(rates, axis=0)).max() / DT
            largest, unlimited = (max(largest, found), unlimited) if is_limited else (largest, max(unlimited, found))
    extra = parameters.limits.acceleration / np.abs(robot.caster_offset[:, 0]).min()
    bound = 1.15 * alpha + extra
    assert largest < bound < unlimited


@pytest.mark.parametrize("name", ["thesis", "tidybot2"])
def test_at_a_stop_no_wheel_straightens_or_flips(name):
    robot = load_robot(name)
    twists, headings, rates = drive(robot, ComputedTorqueParameters(), [(0.3, 0.2, 0.3), (0.0, 0.0, 0.0)], np.zeros(robot.n))
    stopped = np.nonzero(~twists.any(axis=1) & (np.arange(len(twists)) > 100))[0]
    assert len(stopped) > 100 and not rates[stopped].any()
    begun = round(2.0 / DT)
    # On the way to the stop the direction of the motion stays, so that headings hardly move and none turns back.
    assert np.abs(headings[-1] - headings[begun]).max() < 0.3


def test_the_derived_limit_is_half_of_what_the_steering_can():
    """10 N m on (0.004 + 0.012 + 22.5 * 0.03^2) kg m^2 by hand; a description without slack would stall."""
    robot = load_robot("thesis")
    assert derived_steer_acceleration(robot) == pytest.approx(5.0 / (0.004 + 0.012 + 22.5 * 0.0009), rel=1e-9)


def test_a_caster_that_trails_already_is_not_slowed_down():
    robot = load_robot("thesis")
    twists, _, _ = drive(robot, ComputedTorqueParameters(steer_acceleration=1.0), [(1.0, 0.0, 0.0)], np.zeros(4), seconds=3.0)
    assert twists[-1][0] == pytest.approx(1.0)


def test_steering_in_place_is_compensated_by_the_drive():
    """TidyBot++ has b_y = -3.8 mm: with the wheel centre at rest the roll makes up for what the fork's swing adds."""
    robot = load_robot("tidybot2")
    rates = inverse_kinematics(robot, np.full(4, math.pi / 2), np.array([0.1, 0.0, 0.0]))
    b_x, b_y = robot.caster_offset[0]
    assert abs(rates[0, 1]) == pytest.approx(0.1 / abs(b_x))
    np.testing.assert_allclose(rates[:, 0], -b_y * rates[:, 1] / robot.wheel_radius, atol=1e-12)
