"""Mobility (3.1)-(3.2) and singularities under full and selective actuation, (3.34) and figure 3.6 [Li2009]."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcw_description import (
    DRIVE,
    STEER,
    KinematicsError,
    load_robot,
    parse_robot,
    slip_velocity,
    wheel_centres,
    wheel_jacobian,
)
from pcw_description.mobility import is_omnidirectional, planar_mobility, robot_mobility
from pcw_description.robot_file import robot_to_mapping
from pcw_description.singularity import analyse, find_singular_configuration, full_actuation_determinant

seeds = st.integers(min_value=0, max_value=2**32 - 1)
caster_counts = st.integers(min_value=2, max_value=6)


def test_gruebler_counts_known_mechanisms() -> None:
    """(3.1): a four-bar linkage has one degree of freedom, a five-bar two, a triangle none; a 2-DOF joint takes one
    away.
    """
    assert planar_mobility(bodies=4, one_dof_joints=4) == 1
    assert planar_mobility(bodies=5, one_dof_joints=5) == 2
    assert planar_mobility(bodies=3, one_dof_joints=3) == 0
    assert planar_mobility(bodies=3, one_dof_joints=2, two_dof_joints=1) == 1


@pytest.mark.parametrize("n", range(1, 9))
def test_mobility_is_three_for_any_number_of_casters(n: int) -> None:
    """(3.2): 3 (2 + 2n - 1) - 2 (3n) = 3, but one caster has too few actuators to use it."""
    assert robot_mobility(n) == 3
    assert is_omnidirectional(n) == (n >= 2)


def test_a_robot_without_casters_is_refused() -> None:
    """The message holds the number and the allowed range."""
    with pytest.raises(KinematicsError, match="casters = 0; allowed: at least 1"):
        robot_mobility(0)


@given(seed=seeds, n=caster_counts)
def test_determinant_is_that_of_the_matrix_and_never_zero(random_robot, seed: int, n: int) -> None:
    """(3.34) equals numpy's det(A^T A), whatever the headings, and is positive."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    heading = rng.uniform(-np.pi, np.pi, n)
    jacobian = wheel_jacobian(robot, heading)
    determinant = full_actuation_determinant(robot, heading)
    assert determinant == pytest.approx(np.linalg.det(jacobian.T @ jacobian), rel=1e-9)
    assert determinant > 0.0


def test_the_proof_of_3_35_needs_squares() -> None:
    """The thesis argues with sum |p| >= |sum p|, (3.35); what (3.34) needs is n sum |p|^2 >= |sum p|^2, zero for
    equal points only.
    """
    robot = load_robot("thesis")
    p = wheel_centres(robot, np.zeros(4))
    spread = p - p.mean(axis=0)
    assert full_actuation_determinant(robot, np.zeros(4)) == pytest.approx(
        4.0**2 * np.sum(spread**2), rel=1e-12
    )


@given(seed=seeds, n=caster_counts)
def test_full_actuation_is_never_singular(random_robot, seed: int, n: int) -> None:
    """All 2n joints locked hold the robot in any configuration; so do the four joints of any two casters."""
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    heading = rng.uniform(-np.pi, np.pi, n)
    assert not analyse(robot, heading, np.ones((n, 2), dtype=bool)).singular
    for pair in itertools.combinations(range(n), 2):
        actuated = np.zeros((n, 2), dtype=bool)
        actuated[list(pair)] = True
        assert analyse(robot, heading, actuated).rank == 3


def three_casters(offset_y: float = 0.0):
    """Return the robot of figure 3.6: three casters, trailing."""
    mapping = robot_to_mapping(load_robot("thesis"))
    mapping["casters"] = mapping["casters"][:3]
    for caster, bearing in zip(
        mapping["casters"], np.pi / 2.0 + 2.0 * np.pi / 3.0 * np.arange(3), strict=True
    ):
        caster["steer_axis"] = [float(0.3 * np.cos(bearing)), float(0.3 * np.sin(bearing))]
        caster["caster_offset"] = [-0.03, offset_y]
    return parse_robot(mapping)


# Figure 3.6: caster 1 is powered fully, casters 2 and 3 in one joint each.
FIGURE_3_6 = {
    "a: one rolling actuator": (STEER, STEER),
    "b: one steering actuator": (DRIVE, DRIVE),
    "c: one of each": (DRIVE, STEER),
}


def turned_towards_first_contact(robot, second: int, third: int) -> np.ndarray:
    """Return headings such that casters 2 and 3 cannot resist a turn about C_1.

    A locked wheel resists along its heading, a locked steering across it; neither does where that direction points at C_1.
    The wheel centre moves with the heading, so the bearing of C_1 is found by iteration.
    """
    heading = np.array([0.3, 0.0, 0.0])
    for _ in range(100):
        p = wheel_centres(robot, heading)
        for i, axis in ((1, second), (2, third)):
            to_c1 = p[0] - p[i]
            bearing = np.arctan2(to_c1[1], to_c1[0])
            heading[i] = bearing if axis == DRIVE else bearing - np.pi / 2.0
    return heading


@pytest.mark.parametrize("case", FIGURE_3_6)
def test_figure_3_6_cannot_resist_a_turn_about_the_contact_point_c1(case: str) -> None:
    """Each case has singular configurations; the free twist is a rotation about C_1 and moves no locked joint."""
    robot = three_casters()
    second, third = FIGURE_3_6[case]
    actuated = np.zeros((3, 2), dtype=bool)
    actuated[0] = True
    actuated[1, second] = actuated[2, third] = True
    heading = turned_towards_first_contact(robot, second, third)
    analysis = analyse(robot, heading, actuated, tolerance=1e-7)
    assert analysis.singular
    assert analysis.rank == 2
    x, y = wheel_centres(robot, heading)[0]
    size = float(np.max(np.linalg.norm(robot.steer_axis - robot.steer_axis.mean(axis=0), axis=1)))
    free = analysis.free_twists[0] / [1.0, 1.0, size]
    np.testing.assert_allclose(free[:2] / free[2], [y, -x], atol=1e-7)
    # Seen by the other road: that twist with the actuated joints at rest leaves slip only where a joint is free to take it.
    slip = slip_velocity(robot, heading, np.zeros((3, 2)), free)
    assert np.abs(slip[actuated]).max() < 1e-7
    assert np.abs(slip[~actuated]).min() > 0.1
    # Next to it the robot is held.
    assert not analyse(robot, heading + [0.0, 0.05, 0.05], actuated, tolerance=1e-7).singular


@pytest.mark.parametrize("case", FIGURE_3_6)
def test_the_search_finds_the_singular_configurations_of_selective_actuation(case: str) -> None:
    """Four actuators over three casters: a configuration that is not held is found from random headings."""
    robot = three_casters()
    actuated = np.zeros((3, 2), dtype=bool)
    actuated[0] = True
    actuated[1, FIGURE_3_6[case][0]] = actuated[2, FIGURE_3_6[case][1]] = True
    heading, analysis = find_singular_configuration(robot, actuated, seed=3)
    assert analysis.singular
    assert analysis.smallest_singular_value < 1e-6
    x, y = wheel_centres(robot, heading)[0]
    size = float(np.max(np.linalg.norm(robot.steer_axis - robot.steer_axis.mean(axis=0), axis=1)))
    free = analysis.free_twists[0] / [1.0, 1.0, size]
    np.testing.assert_allclose(free[:2] / free[2], [y, -x], atol=1e-4)


def test_the_search_finds_none_for_two_fully_powered_casters() -> None:
    """The same four actuators on two casters: the worst configuration is still held firmly."""
    robot = three_casters()
    actuated = np.array([[True, True], [True, True], [False, False]])
    _, analysis = find_singular_configuration(robot, actuated, seed=3)
    assert not analysis.singular
    # The wheel centres are never nearer than the axes less the offsets, 0.46 m of a robot of 0.3 m.
    assert analysis.smallest_singular_value > 0.5


def test_four_casters_with_four_selected_actuators_are_singular_somewhere() -> None:
    """One joint on each of four casters, all steering or all rolling: there is no fully powered pair, and it shows."""
    robot = load_robot("thesis")
    for axis in (DRIVE, STEER):
        actuated = np.zeros((4, 2), dtype=bool)
        actuated[:, axis] = True
        assert find_singular_configuration(robot, actuated, seed=1, starts=8)[1].singular


@given(seed=seeds, n=caster_counts)
def test_a_free_twist_moves_no_locked_joint(random_robot, seed: int, n: int) -> None:
    """The free directions, for lateral offsets too: joints that follow the twist without slip are at rest where they
    are locked.
    """
    rng = np.random.default_rng(seed)
    robot = random_robot(rng, n)
    heading = rng.uniform(-np.pi, np.pi, n)
    actuated = np.zeros((n, 2), dtype=bool)
    actuated.ravel()[rng.choice(2 * n, 2, replace=False)] = True
    analysis = analyse(robot, heading, actuated)
    assert analysis.rank + len(analysis.free_twists) == 3
    assert analysis.singular
    size = float(np.max(np.linalg.norm(robot.steer_axis - robot.steer_axis.mean(axis=0), axis=1)))
    jacobian = wheel_jacobian(robot, heading)
    for scaled in analysis.free_twists:
        twist = scaled / [1.0, 1.0, size]
        velocity = (jacobian @ twist).reshape(n, 2)
        steer = -velocity[:, 1] / robot.caster_offset[:, 0]
        roll = (velocity[:, 0] - robot.caster_offset[:, 1] * steer) / robot.wheel_radius
        assert (
            np.abs(np.stack([roll, steer], axis=1)[actuated]).max()
            < 1e-9 * np.abs(np.stack([roll, steer])).max() + 1e-9
        )


def test_a_wheel_without_offset_is_held_across_its_heading_by_the_ground_alone() -> None:
    """b_x = 0: nothing but slip moves the wheel sideways, so also free joints hold the robot there (swerve, MPO-700).

    It once counted only what is actuated, and called such a robot free where it cannot move.
    """
    mapping = robot_to_mapping(load_robot("thesis"))
    for caster in mapping["casters"]:
        caster["caster_offset"] = [0.0, 0.045]
    robot = parse_robot(mapping)
    free = np.zeros((4, 2), dtype=bool)
    assert analyse(robot, np.array([0.1, 0.5, -0.7, 1.0]), free).rank == 3
    ahead = analyse(robot, np.zeros(4), free)
    assert ahead.rank == 2
    np.testing.assert_allclose(np.abs(ahead.free_twists), [[1.0, 0.0, 0.0]], atol=1e-12)
    # A locked drive beside the axis gives way by steering; with the steering locked as well it holds.
    drives, both = free.copy(), free.copy()
    drives[:, DRIVE], both[:] = True, True
    assert analyse(robot, np.zeros(4), drives).rank == 2
    assert analyse(robot, np.zeros(4), both).rank == 3


def test_no_actuator_holds_nothing() -> None:
    """Without a locked joint all three directions are free."""
    robot = load_robot("thesis")
    analysis = analyse(robot, np.zeros(4), np.zeros((4, 2), dtype=bool))
    assert analysis.rank == 0
    np.testing.assert_array_equal(analysis.free_twists, np.eye(3))


def test_a_wrong_selection_is_refused_with_its_shape() -> None:
    """The message names the shape found and the one wanted."""
    with pytest.raises(
        KinematicsError, match=r"shape \(3, 2\); allowed: \(4, 2\), drive and steer per caster"
    ):
        analyse(load_robot("thesis"), np.zeros(4), np.ones((3, 2), dtype=bool))
