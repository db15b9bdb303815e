"""Sharing a wrench: each solution against what defines it, and against an independent solver."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from pcw_control.controller_interface import internal_forces
from pcw_control.force_distribution import (
    friction_optimal_forces,
    jacobian_forces,
    limited_forces,
    weighted_forces,
)
from pcw_control.wheel_loads import WheelLoads
from pcw_description import joint_matrix, load_robot, wheel_jacobian
from pcw_description.differential_kinematics import joint_matrix_blocks
from pcw_description.robot_description import GRAVITY

ROBOTS = ("thesis", "tidybot2", "xr4000", "dyros_pcv", "flow_base")
SEEDS = st.integers(0, 2**32 - 1)


def some_case(seed):
    rng = np.random.default_rng(seed)
    robot = load_robot(ROBOTS[seed % len(ROBOTS)])
    A = wheel_jacobian(robot, rng.uniform(-math.pi, math.pi, robot.n))
    return rng, robot, A, rng.normal(0.0, 1.0, 3) * [200.0, 200.0, 60.0]


@settings(deadline=None, max_examples=60)
@given(SEEDS)
def test_every_way_makes_the_wrench(seed):
    rng, robot, A, F = some_case(seed)
    limit = rng.uniform(20.0, 200.0, (robot.n, 2))
    for force in (
        jacobian_forces(A, F, np.linalg.inv(joint_matrix_blocks(robot))), weighted_forces(A, F, limit),
        friction_optimal_forces(A, F, limit).force,
    ):
        np.testing.assert_allclose(A.T @ force.ravel(), F, atol=1e-9 * np.abs(F).max())


@settings(deadline=None, max_examples=40)
@given(SEEDS)
def test_through_j_no_other_torques_are_smaller_and_through_a_no_other_forces(seed):
    """Any internal force added on top makes the sum of squares larger: the gradient vanishes and the Hessian is positive."""
    rng, robot, A, F = some_case(seed)
    through_j = jacobian_forces(A, F, np.linalg.inv(joint_matrix_blocks(robot))).ravel()
    through_a = weighted_forces(A, F, np.ones((robot.n, 2))).ravel()
    B_T = joint_matrix(robot).T
    internal = (np.eye(2 * robot.n) - A @ np.linalg.pinv(A)) @ rng.normal(0.0, 50.0, 2 * robot.n)
    assert np.linalg.norm(B_T @ through_j) < np.linalg.norm(B_T @ (through_j + internal))
    assert np.linalg.norm(through_a) < np.linalg.norm(through_a + internal)


@settings(deadline=None, max_examples=60)
@given(SEEDS)
def test_limited_forces_keep_the_box_and_the_wrench_where_a_linear_program_says_that_both_can_be(seed):
    rng, robot, A, F = some_case(seed)
    limit = rng.uniform(1.0, 120.0, (robot.n, 2))
    found = limited_forces(A, F, limit)
    assert np.all(np.abs(found.force) <= limit)
    possible = linprog(np.zeros(2 * robot.n), A_eq=A.T, b_eq=F, bounds=list(zip(-limit.ravel(), limit.ravel()))).status == 0
    if possible:
        np.testing.assert_allclose(A.T @ found.force.ravel(), F, atol=1e-9)
    else:
        assert np.abs(found.missing).max() > 1e-6
        # The nearest wrench: a little more of it cannot be had from within the box.
        closer = linprog(-A @ np.linalg.solve(A.T @ A, found.missing), bounds=list(zip(-limit.ravel(), limit.ravel())))
        gain = -closer.fun - found.force.ravel() @ A @ np.linalg.solve(A.T @ A, found.missing)
        assert gain < 1e-6 * np.abs(limit).max() * np.linalg.norm(found.missing)


@settings(deadline=None, max_examples=60)
@given(SEEDS)
def test_the_largest_use_is_the_least_that_a_linear_program_finds(seed):
    """Within 2 % of the inscribed polygon and 0.5 % of the evenness term (w n / 2 of s^2, n = 4)."""
    rng, robot, A, F = some_case(seed)
    limit = np.repeat(rng.uniform(10.0, 200.0, (robot.n, 1)), 2, axis=1)
    found = friction_optimal_forces(A, F, limit)
    # The circle by 64 tangents: the linear program may use a hair more than the circle, so its s is a lower bound.
    angles = math.tau * np.arange(64) / 64
    rows = []
    for i in range(robot.n):
        for angle in angles:
            row = np.zeros(2 * robot.n + 1)
            row[2 * i : 2 * i + 2] = np.array([np.cos(angle), np.sin(angle)]) / limit[i]
            row[-1] = -1.0
            rows.append(row)
    cost = np.zeros(2 * robot.n + 1)
    cost[-1] = 1.0
    equal = np.hstack([A.T, np.zeros((3, 1))])
    best = linprog(cost, A_ub=np.array(rows), b_ub=np.zeros(len(rows)), A_eq=equal, b_eq=F, bounds=[(None, None)] * len(cost))
    assert best.x[-1] * (1.0 - 1e-9) <= found.use <= best.x[-1] * 1.025
    for other in (weighted_forces(A, F, limit), weighted_forces(A, F, np.ones_like(limit))):
        assert found.use <= np.sqrt(np.max(np.sum((other / limit) ** 2, axis=1))) * 1.025


def test_a_wheel_on_ice_is_asked_for_less():
    robot = load_robot("thesis")
    A, F = wheel_jacobian(robot, np.zeros(4)), np.array([100.0, 0.0, 0.0])
    limit = np.array([[18.0, 18.0], [180.0, 180.0], [180.0, 180.0], [180.0, 180.0]])
    even = weighted_forces(A, F, np.ones((4, 2)))
    np.testing.assert_allclose(even[:, 0], 25.0)
    best = friction_optimal_forces(A, F, limit)
    assert abs(best.force[0, 0]) < 0.2 * best.force[1, 0] and best.use < 0.25  # 25 / 18 = 1.4 with the pseudo-inverse
    shifted = weighted_forces(A, F, limit)
    assert abs(shifted[0, 0]) < 0.05 * shifted[1, 0]


def test_internal_forces_of_a_squeeze_and_of_none():
    """Two wheels that pull towards each other with 10 N; E A = 0 for everything that moves the robot."""
    robot = load_robot("thesis")
    steer_angle = np.zeros(4)
    force = np.zeros((4, 2))
    force[0, 1], force[1, 1] = -10.0, 10.0  # front left to the right, front right to the left
    pull = internal_forces(robot.steer_axis, robot.caster_offset, steer_angle, force)
    assert pull[0] == pytest.approx(20.0)  # the difference of both along the line, as (5.3) has it
    rng = np.random.default_rng(3)
    steer_angle = rng.uniform(-3.0, 3.0, 4)
    A = wheel_jacobian(robot, steer_angle)
    moving = (A @ rng.normal(0.0, 30.0, 3)).reshape(4, 2)
    np.testing.assert_allclose(internal_forces(robot.steer_axis, robot.caster_offset, steer_angle, moving), 0.0, atol=1e-11)


@pytest.mark.parametrize("name", ROBOTS)
def test_loads_carry_the_weight_and_move_as_the_acceleration_asks(name):
    robot = load_robot(name)
    loads = WheelLoads(robot)
    at_rest = loads.normal_force(np.zeros(robot.n), np.zeros(3))
    assert at_rest.sum() == pytest.approx(robot.total_mass * GRAVITY)
    speeding_up = loads.normal_force(np.zeros(robot.n), np.array([1.0, 0.0, 0.0]))
    assert speeding_up.sum() == pytest.approx(robot.total_mass * GRAVITY)
    rear = robot.steer_axis[:, 0] < 0.0
    assert speeding_up[rear].sum() > at_rest[rear].sum()
    limit = loads.traction_limit(np.zeros(robot.n), np.zeros(3), np.full(robot.n, 0.1))
    np.testing.assert_allclose(limit[:, 0], 0.1 * at_rest)
