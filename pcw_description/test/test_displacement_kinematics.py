"""Finite-displacement kinematics, (3.3)-(3.14), against the thesis's own products of exponentials and loop closures."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import scipy.linalg
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_description import (
    DRIVE,
    STEER,
    KinematicsError,
    RobotDescription,
    forward_displacement,
    forward_kinematics,
    inverse_displacement,
    inverse_kinematics,
    load_robot,
    parse_robot,
    shipped_robots,
    wheel_centres,
)
from pcw_description.robot_description import MINIMUM_CASTER_OFFSET
from pcw_description.robot_file import robot_to_mapping

ROBOTS = tuple(
    name
    for name in shipped_robots()
    if np.all(np.abs(load_robot(name).caster_offset[:, 0]) >= MINIMUM_CASTER_OFFSET)
)
ROUND_TRIP = 1e-12

seeds = st.integers(min_value=0, max_value=2**32 - 1)
caster_counts = st.integers(min_value=2, max_value=6)


def reachable_displacement(rng: np.random.Generator, robot: RobotDescription) -> np.ndarray:
    """Return a displacement that moves no steering axis by more than half the shortest caster offset.

    A caster reaches any point ahead of its wheel; within this distance no steering axis overtakes its wheel.
    """
    shortest = np.abs(robot.caster_offset[:, 0]).min()
    longest_arm = np.linalg.norm(robot.steer_axis, axis=1).max()
    direction = rng.normal(size=3)
    direction /= np.hypot(*direction[:2]) + abs(direction[2]) * longest_arm
    return 0.5 * shortest * rng.uniform(0.0, 1.0) * direction


@pytest.mark.parametrize("name", ROBOTS)
def test_forward_after_inverse_is_the_identity(name: str) -> None:
    """Must show: FK(IK(x)) = x to 1e-12, every leg closing, for every shipped robot."""
    robot = load_robot(name)
    rng = np.random.default_rng(1)
    for _ in range(200):
        heading = rng.uniform(-np.pi, np.pi, robot.n)
        wanted = reachable_displacement(rng, robot)
        found, residual = forward_displacement(robot, heading, inverse_displacement(robot, heading, wanted))
        np.testing.assert_allclose(found, wanted, atol=ROUND_TRIP)
        assert np.abs(residual).max() < ROUND_TRIP


@given(seed=seeds, n=caster_counts)
def test_forward_after_inverse_is_the_identity_for_any_robot(random_robot, seed: int, n: int) -> None:
    """The same for 2 to 6 casters, leading and trailing, with lateral offsets."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    heading = rng.uniform(-np.pi, np.pi, n)
    wanted = reachable_displacement(rng, robot)
    found, residual = forward_displacement(robot, heading, inverse_displacement(robot, heading, wanted))
    np.testing.assert_allclose(found, wanted, atol=ROUND_TRIP)
    assert np.abs(residual).max() < ROUND_TRIP


@given(seed=seeds, n=caster_counts)
def test_inverse_after_forward_is_the_identity_on_consistent_steps(random_robot, seed: int, n: int) -> None:
    """IK(FK(dq)) = dq for joint displacements that close all loops."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    heading = rng.uniform(-np.pi, np.pi, n)
    consistent = inverse_displacement(robot, heading, reachable_displacement(rng, robot))
    displacement, _ = forward_displacement(robot, heading, consistent)
    # An error of 1e-16 m across an offset of 12 mm is 1e-14 rad.
    np.testing.assert_allclose(inverse_displacement(robot, heading, displacement), consistent, atol=1e-12)


@given(seed=seeds, n=caster_counts)
def test_a_straight_roll_of_any_length_is_exact_and_can_be_undone(random_robot, seed: int, n: int) -> None:
    """With all headings alike the displacement is r rho along them, also for half a metre in one sample."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    common = rng.uniform(-np.pi, np.pi)
    heading = np.full(n, common)
    distance = rng.uniform(-0.5, 0.5)
    step = np.zeros((n, 2))
    step[:, DRIVE] = distance / robot.wheel_radius
    there, residual = forward_displacement(robot, heading, step)
    np.testing.assert_allclose(there, [distance * np.cos(common), distance * np.sin(common), 0.0], atol=1e-13)
    assert np.abs(residual).max() < 1e-13
    back, _ = forward_displacement(robot, heading, -step)
    np.testing.assert_allclose(back, -there, atol=1e-13)


def test_displacement_and_differential_model_agree_to_first_order(random_robot) -> None:
    """Both models see the same small step; what differs falls with the square of the step (slope 2), both ways."""
    rng = np.random.default_rng(2)
    steps = np.array([1e-2, 5e-3, 2.5e-3, 1.25e-3])
    for n in range(2, 7):
        robot = random_robot(rng, n)
        heading = rng.uniform(-np.pi, np.pi, n)
        rates = rng.uniform(-3.0, 3.0, (n, 2))
        twist = rng.uniform(-0.3, 0.3, 3)
        forward = [
            np.linalg.norm(
                forward_displacement(robot, heading, rates * dt)[0]
                - forward_kinematics(robot, heading, rates) * dt
            )
            for dt in steps
        ]
        inverse = [
            np.linalg.norm(
                inverse_displacement(robot, heading, twist * dt)
                - inverse_kinematics(robot, heading, twist) * dt
            )
            for dt in steps
        ]
        for errors in (forward, inverse):
            slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
            assert 1.85 < slope < 2.15


def exponential_of_twist(linear: np.ndarray, angular: np.ndarray, amount: float) -> np.ndarray:
    """Return exp(xi amount) (4, 4) of the twist (linear, angular) by the matrix exponential."""
    xi = np.zeros((4, 4))
    wx, wy, wz = angular
    xi[:3, :3] = [[0.0, -wz, wy], [wz, 0.0, -wx], [-wy, wx, 0.0]]
    xi[:3, 3] = linear
    return scipy.linalg.expm(xi * amount)


def thesis_leg(
    steer_axis: np.ndarray, heading: float, b: float, sigma: float, roll: float, phi: float
) -> np.ndarray:
    """Return T_gt (4, 4) of one leg, (3.4)-(3.7) literally: phi clockwise seen from the chassis, roll = r rho."""
    vertical = np.array([0.0, 0.0, 1.0])
    v_2 = np.array([np.cos(heading), np.sin(heading), 0.0])
    p_3 = np.array([*steer_axis, 0.0])
    p_1 = p_3 - b * v_2
    return (
        exponential_of_twist(-np.cross(vertical, p_1), vertical, sigma)
        @ exponential_of_twist(v_2, np.zeros(3), roll)
        @ exponential_of_twist(-np.cross(vertical, p_3), vertical, phi)
    )


def consistent_step(
    random_robot, seed: int, n: int
) -> tuple[RobotDescription, np.ndarray, np.ndarray, np.ndarray]:
    """Return a robot without lateral offset, headings, a displacement and the joint displacements that make it."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n, lateral_offset=False)
    heading = rng.uniform(-np.pi, np.pi, n)
    displacement = reachable_displacement(rng, robot)
    return robot, heading, displacement, inverse_displacement(robot, heading, displacement)


@settings(max_examples=25)  # matrix exponentials are slow
@given(seed=seeds, n=caster_counts)
def test_every_leg_is_the_product_of_exponentials_of_the_thesis(random_robot, seed: int, n: int) -> None:
    """(3.4)-(3.8), (3.11): with phi clockwise and sigma = theta - phi, all legs reach the displacement, by matrix
    exponentials.
    """
    robot, heading, displacement, step = consistent_step(random_robot, seed, n)
    x, y, theta = displacement
    for i in range(n):
        phi = -step[i, STEER]
        leg = thesis_leg(
            robot.steer_axis[i],
            heading[i],
            -robot.caster_offset[i, 0],
            theta - phi,
            robot.wheel_radius[i] * step[i, DRIVE],
            phi,
        )
        np.testing.assert_allclose(leg[:3, 3], [x, y, 0.0], atol=ROUND_TRIP)
        np.testing.assert_allclose(np.arctan2(leg[1, 0], leg[0, 0]), theta, atol=ROUND_TRIP)


@given(seed=seeds, n=caster_counts)
def test_equations_3_9_and_3_10_hold_once_a_misprint_is_read_right(random_robot, seed: int, n: int) -> None:
    """(3.9): the wheel's own heading psi and its twist sigma go with b + r rho, so the terms are cos(psi + sigma)
    and cos(psi).

    As printed, (b + r rho) cos(phi + sigma) - b cos(sigma), the equation is not the product (3.7) it is said to be; the
    last test of this file shows by how much. The h terms and the orientation phi + sigma are as printed.
    """
    robot, heading, displacement, step = consistent_step(random_robot, seed, n)
    for i in range(n):
        h, beta = np.hypot(*robot.steer_axis[i]), np.arctan2(robot.steer_axis[i, 1], robot.steer_axis[i, 0])
        b, roll, phi = -robot.caster_offset[i, 0], robot.wheel_radius[i] * step[i, DRIVE], -step[i, STEER]
        sigma = displacement[2] - phi
        expected = [
            h * (np.cos(beta) - np.cos(beta + phi + sigma))
            + (b + roll) * np.cos(heading[i] + sigma)
            - b * np.cos(heading[i]),
            h * (np.sin(beta) - np.sin(beta + phi + sigma))
            + (b + roll) * np.sin(heading[i] + sigma)
            - b * np.sin(heading[i]),
            phi + sigma,
        ]
        np.testing.assert_allclose(displacement, expected, atol=ROUND_TRIP)


@settings(max_examples=25)  # matrix exponentials are slow
@given(seed=seeds, n=caster_counts)
def test_loop_closure_of_any_pair_gives_the_same_motion(random_robot, seed: int, n: int) -> None:
    """(3.12): a cos(sigma_i) + b sin(sigma_i) = c of each pair of wheels, solved for sigma_i, gives theta = phi_i +
    sigma_i.
    """
    robot, heading, displacement, step = consistent_step(random_robot, seed, n)
    phi = -step[:, STEER]
    found, _ = forward_displacement(robot, heading, step)
    for i, j in itertools.combinations(range(n), 2):
        free = {}
        for k in (i, j):
            # The leg with sigma = 0: position g_k about its contact point p_k.
            v = np.array([np.cos(heading[k]), np.sin(heading[k])])
            contact = robot.steer_axis[k] + robot.caster_offset[k, 0] * v
            leg = thesis_leg(
                robot.steer_axis[k],
                heading[k],
                -robot.caster_offset[k, 0],
                0.0,
                robot.wheel_radius[k] * step[k, DRIVE],
                phi[k],
            )
            free[k] = (contact, leg[:2, 3] - contact)
        # sigma_j = sigma_i + phi_i - phi_j, so x(q_i) = x(q_j) reads R(sigma_i) d = p_j - p_i; (3.12) is its first row.
        c, s = np.cos(phi[i] - phi[j]), np.sin(phi[i] - phi[j])
        d = free[i][1] - np.array([[c, -s], [s, c]]) @ free[j][1]
        right = free[j][0] - free[i][0]
        middle = np.arctan2(-d[1], d[0])
        half = np.arccos(np.clip(right[0] / np.hypot(*d), -1.0, 1.0))
        roots = [middle + half, middle - half]
        second_row = [abs(np.sin(root) * d[0] + np.cos(root) * d[1] - right[1]) for root in roots]
        sigma = roots[int(np.argmin(second_row))]
        closes = (phi[i] + sigma - found[2] + np.pi) % (2.0 * np.pi) - np.pi
        # The arc cosine loses half the digits where the two roots meet.
        assert abs(closes) < 1e-7
        x_i = (
            free[i][0]
            + np.array([[np.cos(sigma), -np.sin(sigma)], [np.sin(sigma), np.cos(sigma)]]) @ free[i][1]
        )
        np.testing.assert_allclose(x_i, displacement[:2], atol=1e-7)


@given(seed=seeds, n=caster_counts)
def test_inconsistent_steps_are_fitted_best(random_robot, seed: int, n: int) -> None:
    """Slipping legs do not close; the answer is the displacement that leaves the least squared residual of contact
    points.
    """
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    heading = rng.uniform(-np.pi, np.pi, n)
    step = rng.uniform(-0.05, 0.05, (n, 2))
    found, residual = forward_displacement(robot, heading, step)

    def not_closed(displacement: np.ndarray) -> float:
        """Return the sum of squared distances of each leg's contact point, carried by the chassis, from where it
        was.
        """
        c, s = np.cos(displacement[2]), np.sin(displacement[2])
        turn = np.array([[c, -s], [s, c]])
        total = 0.0
        for i in range(n):
            a = heading[i] + step[i, STEER]
            fork = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
            behind = robot.steer_axis[i] + fork @ (
                robot.caster_offset[i] - [robot.wheel_radius[i] * step[i, DRIVE], 0.0]
            )
            contact = displacement[:2] + turn @ behind
            total += float(np.sum((contact - wheel_centres(robot, heading)[i]) ** 2))
        return total

    least = not_closed(found)
    assert least == pytest.approx(float(np.sum(residual**2)), rel=1e-9, abs=1e-18)
    for direction in np.vstack([np.eye(3), -np.eye(3), rng.normal(size=(4, 3))]):
        assert not_closed(found + 1e-4 * direction) > least


def test_a_large_turn_on_the_spot_has_no_wrong_branch() -> None:
    """Half a turn in steps: theta leaves atan2 with the right sign on both sides of zero."""
    robot = load_robot("thesis")
    heading = np.arctan2(robot.steer_axis[:, 0], -robot.steer_axis[:, 1])
    for theta in (-0.1, 0.1):
        step = inverse_displacement(robot, heading, np.array([0.0, 0.0, theta]))
        found, _ = forward_displacement(robot, heading, step)
        np.testing.assert_allclose(found, [0.0, 0.0, theta], atol=ROUND_TRIP)
        assert np.all(np.sign(step[:, DRIVE]) == np.sign(theta))


def test_steering_displacements_stay_small_at_the_cut_of_the_angle() -> None:
    """A heading near pi, or many turns away from zero, gives the same small step: no jump of 2 pi reaches the
    joints.
    """
    robot = load_robot("thesis")
    displacement = np.array([0.004, -0.003, 0.01])
    for heading in (np.full(4, np.pi - 1e-3), np.full(4, -np.pi + 1e-3)):
        plain = inverse_displacement(robot, heading, displacement)
        assert np.abs(plain[:, STEER]).max() < 1.0
        np.testing.assert_allclose(
            inverse_displacement(robot, heading + 14.0 * np.pi, displacement), plain, atol=1e-12
        )


def test_displacements_out_of_reach_are_refused() -> None:
    """A wheel beside its axis cannot bring it closer than b_y; the message names the displacement."""
    mapping = robot_to_mapping(load_robot("thesis"))
    for caster in mapping["casters"]:
        caster["caster_offset"] = [-0.010, 0.045]
    robot = parse_robot(mapping)
    # Moves the first steering axis onto its wheel's contact point.
    onto = wheel_centres(robot, np.zeros(4))[0] - robot.steer_axis[0]
    with pytest.raises(KinematicsError, match="out of reach of a caster's offset"):
        inverse_displacement(robot, np.zeros(4), np.array([*onto, 0.0]))


def test_a_wheel_without_offset_along_its_heading_is_refused_with_the_reason() -> None:
    """b_x = 0: where the wheel would steer does not follow from the displacement."""
    mapping = robot_to_mapping(load_robot("thesis"))
    for caster in mapping["casters"]:
        caster["caster_offset"] = [0.0, 0.045]
    robot = parse_robot(mapping)
    with pytest.raises(KinematicsError, match=r"caster_offset\[0\] must be at least 0\.001 m"):
        inverse_displacement(robot, np.zeros(4), np.array([0.01, 0.0, 0.0]))
    step = np.zeros((4, 2))
    step[:, DRIVE] = 0.1
    np.testing.assert_allclose(
        forward_displacement(robot, np.zeros(4), step)[0], [0.0075, 0.0, 0.0], atol=1e-15
    )


def test_equation_3_9_as_printed_is_not_the_product_it_comes_from() -> None:
    """The misprint is no matter of convention: in an ordinary sample (3.9) as printed is off by millimetres."""
    steer_axis, b, heading = np.array([0.25, 0.20]), 0.03, 0.4
    sigma, roll, phi = 0.05, 0.004, -0.07
    h, beta = np.hypot(*steer_axis), np.arctan2(steer_axis[1], steer_axis[0])
    product = thesis_leg(steer_axis, heading, b, sigma, roll, phi)[:2, 3]

    def equation(turned: float, before: float) -> np.ndarray:
        angles = np.array([0.0, -np.pi / 2.0])  # the second row has sines: cos(a - pi/2)
        return (
            h * (np.cos(beta + angles) - np.cos(beta + phi + sigma + angles))
            + (b + roll) * np.cos(turned + angles)
            - b * np.cos(before + angles)
        )

    np.testing.assert_allclose(equation(heading + sigma, heading), product, atol=ROUND_TRIP)
    assert np.linalg.norm(equation(phi + sigma, sigma) - product) > 1e-3
