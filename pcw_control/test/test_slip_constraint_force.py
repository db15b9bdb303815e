"""Slip constraint force: what the law promises, for shipped robots and for random ones."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_control.controllers import CONTROLLERS, make_controller
from pcw_control.errors import ControlError
from pcw_control.slip_constraint_force import (
    PHASE,
    SlipConstraintForce,
    SlipConstraintForceParameters,
    SlipConstraintLaw,
    SlipConstraintParameters,
    contact_inertia,
    loop_rate,
    slip_gains,
)
from pcw_description import KinematicsError, joint_matrix, load_robot, shipped_robots, wheel_jacobian

_spec = importlib.util.spec_from_file_location("controller_contract", Path(__file__).with_name("controller_contract.py"))
contract = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(contract)

DT = 0.002


def is_torque_controlled(name):
    try:
        load_robot(name).require_torque_control()
    except KinematicsError:
        return False
    return True


ROBOTS = [name for name in shipped_robots() if is_torque_controlled(name)]


def robot_of(n, seed):
    """The thesis's robot with n casters at random places, of random offsets."""
    rng = np.random.default_rng(seed)
    robot = load_robot("thesis")
    casters = []
    for i in range(n):
        angle = 2.0 * np.pi * i / n + rng.uniform(-0.2, 0.2)
        offset = (-rng.uniform(0.015, 0.05), rng.uniform(-0.005, 0.005))
        place = tuple(rng.uniform(0.2, 0.35) * np.array([np.cos(angle), np.sin(angle)]))
        casters.append(dataclasses.replace(robot.casters[0], name=f"c{i}", steer_axis=place, caster_offset=offset))
    return dataclasses.replace(robot, casters=tuple(casters))


def force_of(robot, parameters, steer_angle, joint_velocity):
    law = SlipConstraintLaw(robot, parameters)
    A = wheel_jacobian(robot, steer_angle)
    return A, law.step(law.initial_state(), A, joint_velocity, False, DT)[1]


@pytest.mark.parametrize("name", ROBOTS)
def test_keeps_the_controllers_contract(name):
    robot = load_robot(name)
    for entry in ("slip_constraint_force", "friction_optimal_slip_constraint"):
        contract.check_contract(make_controller(entry, robot), robot, np.random.default_rng(5))


@settings(max_examples=60, deadline=None)
@given(n=st.integers(2, 6), seed=st.integers(0, 2**31))
def test_internal_force_is_internal_blind_to_the_motion_and_takes_energy(n, seed):
    rng = np.random.default_rng(seed)
    robot = robot_of(n, seed)
    steer, rate = rng.uniform(-3.0, 3.0, n), rng.normal(0.0, 5.0, (n, 2))
    A, found = force_of(robot, SlipConstraintParameters(integral_ratio=0.0), steer, rate)
    size = np.abs(found.force).max()
    # Rounding of sums of 2n products: 1e-12 of their size, times levers below one metre.
    assert np.abs(A.T @ found.force.ravel()).max() <= 1e-10 * size
    B = joint_matrix(robot)
    w = B @ rate.ravel()
    assert w @ found.force.ravel() <= 1e-9 * size * np.abs(w).max()
    # The same joints with any rigid motion on top: the same force.
    moving = rate + np.linalg.solve(B, A @ rng.normal(0.0, 1.0, 3)).reshape(n, 2)
    _, other = force_of(robot, SlipConstraintParameters(integral_ratio=0.0), steer, moving)
    np.testing.assert_allclose(other.force, found.force, atol=1e-8 * max(size, 1.0))


def test_one_gain_for_all_is_the_law_as_the_thesis_prints_it():
    """Table 5.4: (I - (A^T)^+ A^T) f_eps, f_eps = -k_p eps, with eps of any estimator, here that of the truth."""
    rng = np.random.default_rng(2)
    robot = robot_of(4, 3)
    steer, rate, V = rng.uniform(-3.0, 3.0, 4), rng.normal(0.0, 5.0, (4, 2)), rng.normal(0.0, 1.0, 3)
    parameters = SlipConstraintParameters(proportional_gain=400.0, integral_ratio=0.0)
    A, found = force_of(robot, parameters, steer, rate)
    slip = joint_matrix(robot) @ rate.ravel() - A @ V
    expected = (np.eye(8) - A @ np.linalg.pinv(A)) @ (-400.0 * slip)
    np.testing.assert_allclose(found.force.ravel(), expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_slip_of_wheels_without_grip_decays_at_one_rate_in_all_directions(n):
    """M e_dot = f has the poles -w_s, 2n - 3 times, and none else but the three of the free robot."""
    robot = robot_of(n, 7 + n)
    parameters = SlipConstraintParameters(integral_ratio=0.0)
    steer = np.random.default_rng(n).uniform(-3.0, 3.0, n)
    A = wheel_jacobian(robot, steer)
    law = SlipConstraintLaw(robot, parameters)
    inverse_B = np.linalg.inv(joint_matrix(robot))
    force_per_slip = np.stack(
        [
            law.step(law.initial_state(), A, (inverse_B @ column).reshape(n, 2), False, DT)[1].force.ravel()
            for column in np.eye(2 * n)
        ],
        axis=1,
    )
    M = np.zeros((2 * n, 2 * n))
    for i, block in enumerate(contact_inertia(robot)):
        M[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] = block
    poles = np.sort(np.linalg.eigvals(np.linalg.solve(M, force_per_slip)).real)
    rate = PHASE / (parameters.loop_delay + 1.0 / robot.sensors.encoders.rate)
    np.testing.assert_allclose(poles[: 2 * n - 3], -rate, rtol=1e-8)
    np.testing.assert_allclose(poles[2 * n - 3 :], 0.0, atol=1e-8 * rate)


def test_gain_of_the_thesis_robot_is_the_one_that_was_found_by_trial():
    """EQUATIONS section 7: about 400 N s/m on a robot of 90 kg."""
    gain = slip_gains(load_robot("thesis"), SlipConstraintParameters())
    assert 360.0 < gain[0, 0, 0] < 440.0
    slow = slip_gains(load_robot("thesis"), SlipConstraintParameters(loop_delay=0.006))
    np.testing.assert_allclose(slow, gain / 2.0)


@pytest.mark.parametrize("late", [1, 2, 3])
def test_a_loose_wheel_settles_with_the_delay_it_is_designed_for_and_with_nearly_twice_that(late):
    """e_dot = -w_s (e + w_i int e) sampled at 500 Hz, late by whole periods: the worst pole stays inside."""
    parameters = SlipConstraintParameters()
    rate = loop_rate(load_robot("thesis"), parameters)
    # State: e now and in the cycles before, and its integral. Forgetting only helps.
    matrix = np.eye(late + 2, k=-1)
    matrix[0, 0], matrix[0, late], matrix[0, late + 1] = 1.0, -rate * DT, -rate * parameters.integral_ratio * rate * DT
    matrix[late + 1] = 0.0
    matrix[late + 1, late + 1], matrix[late + 1, late] = 1.0, DT
    assert np.abs(np.linalg.eigvals(matrix)).max() < 0.98


def test_integral_is_limited_holds_while_saturated_and_is_forgotten():
    robot = load_robot("thesis")
    parameters = SlipConstraintParameters(integral_ratio=0.2)
    law = SlipConstraintLaw(robot, parameters)
    A = wheel_jacobian(robot, np.zeros(4))
    rolling, spinning = np.zeros((4, 2)), np.zeros((4, 2))
    spinning[0, 0] = 30.0
    strongest = robot.torque_limit[0, 0] / robot.wheel_radius[0]
    state = law.initial_state()
    for _ in range(2000):
        state, _ = law.step(state, A, spinning, False, DT)
    held = law.step(state, A, rolling, False, DT)[1].force
    assert np.abs(held[:, 0]).max() == pytest.approx(parameters.integral_share * strongest, rel=0.02)
    assert np.abs(A.T @ held.ravel()).max() < 1e-9 * strongest

    after, _ = law.step(state, A, spinning, True, DT)
    assert np.all(np.abs(after) <= np.abs(state))  # saturated: it does not grow
    for _ in range(500):
        state, found = law.step(state, A, rolling, True, DT)
    assert np.abs(found.force).max() < 1.05 * np.exp(-1.0 / parameters.integral_memory) * np.abs(held).max()


def test_force_joins_those_of_computed_torque_and_the_state_is_carried():
    robot = load_robot("thesis")
    controller = SlipConstraintForce(robot)
    measurement = contract.rolling_measurement(robot, [0.5, 0.1, 0.2], np.array([0.1, -0.4, 2.0, 1.0]))
    reference = contract.TwistReference(np.array([0.5, 0.1, 0.2]))
    plain = make_controller("computed_torque", robot)
    start = np.array([0.5, 0.1, 0.2])
    _, without = plain.step(plain.initial_state(start), measurement, reference, DT)
    _, rolling = controller.step(controller.initial_state(start), measurement, reference, DT)
    np.testing.assert_allclose(rolling.torque, without.torque, atol=1e-9)  # no slip, no difference

    measurement.joint_velocity[0, 0] += 3.0
    state, spinning = controller.step(controller.initial_state(start), measurement, reference, DT)
    assert spinning.contact_force[0, 0] < rolling.contact_force[0, 0] - 10.0
    assert state.slip_integral[0, 0] > 0.0
    A = wheel_jacobian(robot, np.ascontiguousarray(measurement.joint_position[:, 1]))
    np.testing.assert_allclose(A.T @ spinning.contact_force.ravel(), spinning.wrench, atol=1e-9 * 100.0)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("loop_delay", -0.001), ("proportional_gain", -1.0), ("integral_ratio", float("nan")), ("integral_memory", 0.0),
        ("integral_share", 1.5),
    ],
)
def test_refuses_parameters_with_their_name(field, value):
    with pytest.raises(ControlError, match=field):
        SlipConstraintParameters(**{field: value})


def test_is_in_the_registry():
    assert CONTROLLERS["slip_constraint_force"].parameters is SlipConstraintForceParameters
