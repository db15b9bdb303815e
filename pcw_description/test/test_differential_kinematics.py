"""A, B, slip, forward and inverse differential kinematics, (3.15)-(3.28), against geometry worked out another way."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcw_description import (
    DRIVE,
    STEER,
    KinematicsError,
    forward_kinematics,
    inverse_kinematics,
    joint_matrix,
    load_robot,
    parse_robot,
    shipped_robots,
    slip_velocity,
    wheel_centres,
    wheel_jacobian,
)
from pcw_description.differential_kinematics import forward_kinematics_kernel, joint_matrix_blocks
from pcw_description.robot_description import MINIMUM_CASTER_OFFSET, RobotDescription
from pcw_description.robot_file import robot_to_mapping

ROBOTS = shipped_robots()
ROLLING_ROBOTS = tuple(
    name for name in ROBOTS if np.all(np.abs(load_robot(name).caster_offset[:, 0]) >= MINIMUM_CASTER_OFFSET)
)

# Central difference of fourth order with this step [s]: truncation 1e-11, rounding 1e-13 on motions of metres per second.
STEP = 1e-3
FINITE_DIFFERENCE_ERROR = 1e-9
# Casters of 14 mm steer at 100 rad/s and more when pushed sideways: truncation 2e-11, rounding 1e-11.
STEP_AT_HIGH_RATES = 2e-5

seeds = st.integers(min_value=0, max_value=2**32 - 1)
caster_counts = st.integers(min_value=2, max_value=6)


def derivative(function, step: float = STEP) -> np.ndarray:
    """Return d/dt at t = 0 by the fourth-order central difference."""
    return (8.0 * (function(step) - function(-step)) - (function(2.0 * step) - function(-2.0 * step))) / (
        12.0 * step
    )


def rotation_z(angle: float) -> np.ndarray:
    """Return the rotation about the vertical (3, 3)."""
    return np.array(
        [[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )


def rotation_y(angle: float) -> np.ndarray:
    """Return the rotation about the axle (3, 3)."""
    return np.array(
        [[np.cos(angle), 0.0, np.sin(angle)], [0.0, 1.0, 0.0], [-np.sin(angle), 0.0, np.cos(angle)]]
    )


def rubber_velocity(
    robot: RobotDescription, heading: np.ndarray, rates: np.ndarray, twist: np.ndarray, step: float = STEP
) -> np.ndarray:
    """Return the velocity of the rubber that touches the ground, in the wheel frames (n, 2), from solid geometry alone.

    Each wheel is a body in space: chassis pose, then the steering axis, the fork, the axle. The velocity is that of the one
    material point of the wheel that is lowest at t = 0, from its positions before and after. No A, no B.
    """
    velocity = np.empty((robot.n, 2))
    for i in range(robot.n):
        axis = np.array([*robot.steer_axis[i], 0.0])
        offset = np.array([*robot.caster_offset[i], robot.wheel_radius[i]])
        lowest = np.array([0.0, 0.0, -robot.wheel_radius[i]])

        def position(t: float, i=i, axis=axis, offset=offset, lowest=lowest) -> np.ndarray:
            chassis = rotation_z(twist[2] * t)
            fork = chassis @ rotation_z(heading[i] + rates[i, STEER] * t)
            wheel = fork @ rotation_y(rates[i, DRIVE] * t)
            return (
                np.array([twist[0] * t, twist[1] * t, 0.0]) + chassis @ axis + fork @ offset + wheel @ lowest
            )

        velocity[i] = (rotation_z(heading[i]).T @ derivative(position, step))[:2]
    return velocity


def random_motion(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return headings (n,), joint rates (n, 2) and a twist (3,) that know nothing of each other."""
    return rng.uniform(-np.pi, np.pi, n), rng.uniform(-8.0, 8.0, (n, 2)), rng.uniform(-1.5, 1.5, 3)


@pytest.mark.parametrize("name", ROBOTS)
def test_wheel_jacobian_is_the_finite_difference_of_wheel_centres(name: str) -> None:
    """A maps the twist to the velocity of the chassis-fixed point at the wheel centre, in the wheel frame."""
    robot = load_robot(name)
    rng = np.random.default_rng(1)
    for _ in range(20):
        heading, _, twist = random_motion(rng, robot.n)
        centres = wheel_centres(robot, heading)

        def moved(t: float, twist=twist, centres=centres) -> np.ndarray:
            return centres @ rotation_z(twist[2] * t)[:2, :2].T + twist[:2] * t

        c, s = np.cos(heading), np.sin(heading)
        velocity = derivative(moved)
        expected = np.stack(
            [c * velocity[:, 0] + s * velocity[:, 1], -s * velocity[:, 0] + c * velocity[:, 1]], axis=1
        )
        np.testing.assert_allclose(
            wheel_jacobian(robot, heading) @ twist, expected.ravel(), atol=FINITE_DIFFERENCE_ERROR
        )


@pytest.mark.parametrize("name", ROBOTS)
def test_slip_is_the_velocity_of_the_rubber_on_the_ground(name: str) -> None:
    """(3.28): the slip B q_dot - A V is minus the velocity of the contact point's rubber, for motions that slip at
    will.
    """
    robot = load_robot(name)
    rng = np.random.default_rng(2)
    for _ in range(20):
        heading, rates, twist = random_motion(rng, robot.n)
        np.testing.assert_allclose(
            slip_velocity(robot, heading, rates, twist),
            -rubber_velocity(robot, heading, rates, twist),
            atol=FINITE_DIFFERENCE_ERROR,
        )


@given(seed=seeds, n=caster_counts)
def test_slip_is_the_velocity_of_the_rubber_for_any_robot(random_robot, seed: int, n: int) -> None:
    """The same for robots of 2 to 6 casters, leading and trailing, with lateral offsets."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    heading, rates, twist = random_motion(rng, n)
    np.testing.assert_allclose(
        slip_velocity(robot, heading, rates, twist),
        -rubber_velocity(robot, heading, rates, twist),
        atol=FINITE_DIFFERENCE_ERROR,
    )


def test_a_lateral_offset_enters_b_through_the_steering_rate() -> None:
    """A wheel beside its steering axis is swung along its own heading; B without b_y would miss 8 mm/s on TidyBot++
    at 2 rad/s.
    """
    mapping = robot_to_mapping(load_robot("thesis"))
    for caster in mapping["casters"]:
        caster["caster_offset"] = [-0.014, -0.0038]
    robot = parse_robot(mapping)
    heading, rates = np.array([0.3, -1.0, 2.0, 0.0]), np.zeros((4, 2))
    rates[:, STEER] = 2.0
    sensed = (joint_matrix(robot) @ rates.ravel()).reshape(4, 2)
    np.testing.assert_allclose(
        sensed, -rubber_velocity(robot, heading, rates, np.zeros(3)), atol=FINITE_DIFFERENCE_ERROR
    )
    np.testing.assert_allclose(sensed[:, 0], -0.0038 * 2.0)


@pytest.mark.parametrize("name", ROLLING_ROBOTS)
def test_consistent_motion_of_shipped_robots_does_not_slip(name: str) -> None:
    """Must show: zero slip on consistent motion to 1e-9 m/s, by the model's own slip and by solid geometry."""
    robot = load_robot(name)
    rng = np.random.default_rng(3)
    for _ in range(50):
        heading, _, twist = random_motion(rng, robot.n)
        rates = inverse_kinematics(robot, heading, twist)
        assert np.abs(slip_velocity(robot, heading, rates, twist)).max() < 1e-9
        assert np.abs(rubber_velocity(robot, heading, rates, twist, STEP_AT_HIGH_RATES)).max() < 1e-9


@given(seed=seeds, n=caster_counts)
def test_consistent_motion_of_any_robot_does_not_slip(random_robot, seed: int, n: int) -> None:
    """IK gives joint rates without slip, and FK gives the twist back."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    heading, _, twist = random_motion(rng, n)
    rates = inverse_kinematics(robot, heading, twist)
    assert np.abs(slip_velocity(robot, heading, rates, twist)).max() < 1e-9
    np.testing.assert_allclose(forward_kinematics(robot, heading, rates), twist, atol=1e-12)


@given(seed=seeds, n=caster_counts)
def test_closed_form_is_the_pseudo_inverse(random_robot, seed: int, n: int) -> None:
    """FK equals pinv(A) B q_dot (3.26), its covariance (A^T A)^-1, its residual (I - A A^+) B q_dot, for
    inconsistent rates.
    """
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    heading, rates, _ = random_motion(rng, n)
    jacobian = wheel_jacobian(robot, heading)
    sensed = joint_matrix(robot) @ rates.ravel()
    expected = np.linalg.pinv(jacobian) @ sensed
    twist, slip, normal_inverse = forward_kinematics_kernel(
        robot.steer_axis, robot.caster_offset, robot.wheel_radius, heading, rates
    )
    np.testing.assert_allclose(twist, expected, atol=1e-11)
    np.testing.assert_allclose(slip.ravel(), sensed - jacobian @ expected, atol=1e-11)
    np.testing.assert_allclose(normal_inverse, np.linalg.inv(jacobian.T @ jacobian), rtol=1e-9, atol=1e-11)


@given(seed=seeds, n=caster_counts)
def test_the_redundant_part_of_the_slip_needs_encoders_only(random_robot, seed: int, n: int) -> None:
    """(I - A A^+) eps = (I - A A^+) B q_dot exactly: whatever the true twist is, it drops out."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    heading, rates, twist = random_motion(rng, n)
    jacobian = wheel_jacobian(robot, heading)
    projector = np.eye(2 * n) - jacobian @ np.linalg.pinv(jacobian)
    slip = slip_velocity(robot, heading, rates, twist).ravel()
    np.testing.assert_allclose(projector @ slip, projector @ joint_matrix(robot) @ rates.ravel(), atol=1e-11)
    assert np.trace(projector) == pytest.approx(2 * n - 3, abs=1e-9)


@pytest.mark.parametrize("name", ROBOTS)
def test_fit_is_best_in_the_least_squares_sense(name: str) -> None:
    """No other twist leaves less slip: FK is a minimum, also for robots whose steering rate does not follow from the
    twist.
    """
    robot = load_robot(name)
    rng = np.random.default_rng(4)
    heading, rates, _ = random_motion(rng, robot.n)
    best = forward_kinematics(robot, heading, rates)
    least = np.sum(slip_velocity(robot, heading, rates, best) ** 2)
    for direction in [*np.eye(3), *rng.normal(size=(10, 3))]:
        for sign in (-1.0, 1.0):
            assert np.sum(slip_velocity(robot, heading, rates, best + sign * 1e-3 * direction) ** 2) > least


def test_a_mirrored_motion_gives_mirrored_joint_rates() -> None:
    """The thesis robot is its own mirror image: left and right change places, headings and turns change sign."""
    robot = load_robot("thesis")
    mirror = [robot.caster_index(name) for name in ("front_right", "front_left", "rear_right", "rear_left")]
    rng = np.random.default_rng(5)
    for _ in range(20):
        heading, _, twist = random_motion(rng, 4)
        rates = inverse_kinematics(robot, heading, twist)
        mirrored = inverse_kinematics(robot, -heading[mirror], twist * [1.0, -1.0, -1.0])
        np.testing.assert_allclose(mirrored[:, DRIVE], rates[mirror, DRIVE], atol=1e-12)
        np.testing.assert_allclose(mirrored[:, STEER], -rates[mirror, STEER], atol=1e-12)


def test_a_robot_turned_by_half_a_turn_is_the_same_robot() -> None:
    """Front left becomes rear right, and all headings and velocities turn with it."""
    robot = load_robot("thesis")
    turned = [robot.caster_index(name) for name in ("rear_right", "rear_left", "front_right", "front_left")]
    rng = np.random.default_rng(6)
    heading, _, twist = random_motion(rng, 4)
    rates = inverse_kinematics(robot, heading, twist)
    again = inverse_kinematics(robot, heading[turned] + np.pi, twist * [-1.0, -1.0, 1.0])
    np.testing.assert_allclose(again, rates[turned], atol=1e-12)


def test_straight_ahead_with_trailing_wheels_rolls_at_v_over_r() -> None:
    """(3.16): v_x = r rho_dot, and no steering; the plainest case, by hand."""
    robot = load_robot("thesis")
    rates = inverse_kinematics(robot, np.zeros(4), np.array([0.6, 0.0, 0.0]))
    np.testing.assert_allclose(rates, np.tile([0.6 / 0.075, 0.0], (4, 1)), atol=1e-15)


def test_a_caster_pushed_sideways_steers_at_v_over_b() -> None:
    """A trailing wheel (b_x = -b) pushed to the left turns its heading counter-clockwise towards the motion: phi_dot
    = v / b.
    """
    robot = load_robot("thesis")
    rates = inverse_kinematics(robot, np.zeros(4), np.array([0.0, 0.3, 0.0]))
    np.testing.assert_allclose(rates, np.tile([0.0, 0.3 / 0.030], (4, 1)), atol=1e-15)


def test_blocks_and_joint_matrix_agree() -> None:
    """B is block diagonal in the order of the flattened joint array."""
    robot = load_robot("thesis")
    rates = np.random.default_rng(7).normal(size=(4, 2))
    by_blocks = np.einsum("nij,nj->ni", joint_matrix_blocks(robot), rates)
    np.testing.assert_allclose((joint_matrix(robot) @ rates.ravel()).reshape(4, 2), by_blocks, atol=1e-15)


def test_a_wheel_without_offset_along_its_heading_is_refused_with_the_reason() -> None:
    """b_x = 0: the steering rate does not follow from the twist, and the message says so with the value and what is
    needed.
    """
    mapping = robot_to_mapping(load_robot("thesis"))
    mapping["casters"][2]["caster_offset"] = [0.0, 0.045]
    robot = parse_robot(mapping)
    with pytest.raises(
        KinematicsError, match=r"caster_offset\[0\] is 0 m; the steering rate follows.*at least 0\.001 m"
    ):
        inverse_kinematics(robot, np.zeros(4), np.array([0.1, 0.0, 0.0]))
    # What it does have, it keeps: sensed velocities, fit and slip, offset along the axle included.
    rates = np.zeros((4, 2))
    rates[:, DRIVE] = 2.0
    np.testing.assert_allclose(forward_kinematics(robot, np.zeros(4), rates), [0.15, 0.0, 0.0], atol=1e-15)
