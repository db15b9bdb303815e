"""Wheels that do not steer: their description, the motion that they leave, odometry with them, and who refuses them."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from pcw_description import (
    AugmentedObjectModel,
    RobotDescription,
    forward_kinematics,
    inverse_kinematics,
    joint_matrix,
    load_robot,
    parse_robot,
    wheel_jacobian,
)
from pcw_description.differential_kinematics import forward_kinematics_kernel, guided_kinematics_kernel
from pcw_description.displacement_kinematics import forward_displacement
from pcw_description.errors import DescriptionError, KinematicsError
from pcw_description.odometry import OdometryParameters, initial_state, update
from pcw_description.robot_file import robot_to_mapping
from pcw_description.singularity import analyse
from pcw_description.urdf import robot_urdf
from pcw_description.validate import check

WHEELBASE = 1.2


def tricycle(**changes: Any) -> dict[str, Any]:
    """A robot with one driven and steered wheel in front and an axle behind, as it stands in a file."""
    caster = {
        "name": "front",
        "steer_axis": [WHEELBASE, 0.0],
        "caster_offset": [0.0, 0.0],
        "wheel_radius": 0.1,
        "module": {"mass": 4.0, "com": [0.0, 0.0], "inertia_zz": 0.02},
        "wheel": {"mass": 1.5, "inertia_axle": 0.006, "width": 0.05},
        "gears": {"drive": 10.0, "steer": 10.0},
        "rotors": {"drive": 0.0, "steer": 0.0},
        "limits": {"drive_torque": 10.0, "steer_torque": 10.0, "drive_speed": 20.0, "steer_speed": 5.0},
    }
    lateral = {"mu_p": 0.8, "lambda_p": 0.1}
    return {
        "format": "pcw_robot/1",
        "name": "tricycle",
        "provenance": {"all": "made up for the tests"},
        "chassis": {"mass": 60.0, "inertia_zz": 12.0, "com": [0.5, 0.0, 0.3], "size": [1.6, 0.6, 0.5]},
        "casters": [caster],
        "fixed_wheels": [
            {"name": "rear_left", "position": [0.0, 0.3], "wheel_radius": 0.1},
            {"name": "rear_right", "position": [0.0, -0.3], "wheel_radius": 0.1},
        ],
        "contact": {"model": "kiencke", **lateral, "lateral": lateral, "relaxation_length": 0.02},
        "sensors": {"encoders": {"drive_counts": 4096, "steer_counts": 4096, "rate": 100.0}},
        **changes,
    }


def with_casters(n: int, offset: float = 0.0) -> RobotDescription:
    """The same on n casters ahead of the axle."""
    data = tricycle()
    first = data["casters"][0]
    data["casters"] = [
        {**copy.deepcopy(first), "name": f"c{i}", "steer_axis": [WHEELBASE, 0.4 * i], "caster_offset": [offset, 0.0]}
        for i in range(n)
    ]
    return parse_robot(data)


# --- Description ---------------------------------------------------------------------------------------------------------


def test_written_and_read_again_it_is_the_same() -> None:
    tracker = {"rate": 25.0, "position": [1.5, 0.1], "yaw": 0.2}
    sensors = {**tricycle()["sensors"], "tracker": tracker}
    tolerances = {"fixed_wheels.position": "0.01 m", "tracker.yaw": "0.003 rad"}
    robot = parse_robot(tricycle(sensors=sensors, tolerances=tolerances))
    assert parse_robot(robot_to_mapping(robot)) == robot


def test_the_axle_is_the_mean_of_its_wheels_whichever_way_round_they_stand() -> None:
    data = tricycle()
    data["fixed_wheels"][1]["direction"] = math.pi
    np.testing.assert_allclose(parse_robot(data).fixed_axle, [[0.0, 0.0, 0.0]], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda d: d["fixed_wheels"].clear(), "casters: 1 is not allowed; allowed: at least 2 casters"),
        (lambda d: d["fixed_wheels"][1].update(position=[0.5, -0.3]), "fixed_wheels[1].position: [0.5, -0.3]"),
        (lambda d: d["fixed_wheels"][1].update(direction=0.3), "fixed_wheels[1].direction: 0.3"),
        (lambda d: d["fixed_wheels"][1].update(direction=90.0), "fixed_wheels[1].direction: 90.0"),
        (lambda d: d["fixed_wheels"][1].update(name="front"), "fixed_wheels[1].name: 'front'"),
        (lambda d: d["fixed_wheels"][1].update(name="rear right"), "fixed_wheels[1].name: 'rear right'"),
        (lambda d: d["fixed_wheels"][0].update(radius=0.1), "did you mean 'wheel_radius'"),
        (lambda d: d["fixed_wheels"][0].update(wheel_radius=0.0), "fixed_wheels[0].wheel_radius: 0.0"),
        (lambda d: d["casters"][0].update(steer_axis=[0.01, 0.0]), "casters[0].steer_axis: [0.01, 0.0]"),
        (lambda d: d.update(fixed_wheels={"rear": 1}), "fixed_wheels: {'rear': 1}"),
    ],
)
def test_what_is_wrong_is_named(change: Callable[[dict[str, Any]], None], named: str) -> None:
    data = tricycle()
    change(data)
    with pytest.raises(DescriptionError) as caught:
        parse_robot(data)
    assert named in str(caught.value)


def test_validate_says_what_it_is_for(tmp_path: Any, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "tricycle.yaml"
    path.write_text(yaml.safe_dump(tricycle()), encoding="utf-8")
    assert check([str(path)]) == 0
    told = "OK (1 caster, 2 fixed wheels, 64 kg; for kinematics and analysis only (fixed wheels))"
    assert capsys.readouterr().out == f"{path}: {told}\n"


# --- Kinematics ----------------------------------------------------------------------------------------------------------


@given(angle=st.floats(-3.1, 3.1), rate=st.floats(-20.0, 20.0))
def test_a_tricycle_turns_about_its_axle(angle: float, rate: float) -> None:
    """The textbook's: v = r rho' cos(phi) at the axle, omega = r rho' sin(phi) / wheelbase, nothing along the axle."""
    speed = 0.1 * rate
    twist = forward_kinematics(parse_robot(tricycle()), np.array([angle]), np.array([[rate, 0.7]]))
    expected = [speed * math.cos(angle), 0.0, speed * math.sin(angle) / WHEELBASE]
    np.testing.assert_allclose(twist, expected, atol=1e-12 + 1e-12 * abs(speed))


@pytest.mark.parametrize("n", [1, 2, 3, 4])
@pytest.mark.parametrize("offset", [0.0, -0.04])
def test_motions_that_let_the_axle_roll_come_back_and_contradict_nothing(n: int, offset: float) -> None:
    rng = np.random.default_rng(n)
    robot = with_casters(n, offset)
    for _ in range(20):
        twist = np.array([rng.normal(), 0.0, rng.normal()])
        if offset:
            angle = rng.uniform(-np.pi, np.pi, n)
            rates = inverse_kinematics(robot, angle, twist)
        else:  # a wheel without offset points where it goes
            velocity = np.stack([twist[0] - twist[2] * robot.steer_axis[:, 1], twist[2] * robot.steer_axis[:, 0]], axis=1)
            angle = np.arctan2(velocity[:, 1], velocity[:, 0])
            rates = np.stack([np.hypot(*velocity.T) / robot.wheel_radius, np.zeros(n)], axis=1)
        numbers = robot.steer_axis, robot.caster_offset, robot.wheel_radius, robot.fixed_axle
        found, slip, _ = guided_kinematics_kernel(*numbers, angle, rates)
        np.testing.assert_allclose(found, twist, atol=1e-9)
        np.testing.assert_allclose(slip, 0.0, atol=1e-9)


def test_it_is_the_least_squares_solution_with_the_axle_as_one_more_row() -> None:
    rng = np.random.default_rng(7)
    robot = with_casters(3)
    angle, rates = rng.uniform(-1, 1, 3), rng.normal(size=(3, 2))
    found, slip, normal_inverse = guided_kinematics_kernel(
        robot.steer_axis, robot.caster_offset, robot.wheel_radius, robot.fixed_axle, angle, rates
    )
    rows = np.vstack([wheel_jacobian(robot, angle), [[0.0, 1.0, 0.0]]])
    sensed = np.append(joint_matrix(robot) @ rates.ravel(), 0.0)
    expected, *_ = np.linalg.lstsq(rows, sensed, rcond=None)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    np.testing.assert_allclose(np.append(slip[:3].ravel(), slip[3, 1]), sensed - rows @ expected, atol=1e-12)
    np.testing.assert_allclose(normal_inverse, np.linalg.inv(rows.T @ rows), atol=1e-12)


def test_without_fixed_wheels_it_is_the_closed_form() -> None:
    rng = np.random.default_rng(3)
    robot = load_robot("tidybot2")
    angle, rates = rng.uniform(-3, 3, robot.n), rng.normal(size=(robot.n, 2))
    numbers = robot.steer_axis, robot.caster_offset, robot.wheel_radius
    guided = guided_kinematics_kernel(*numbers, robot.fixed_axle, angle, rates)
    for left, right in zip(guided, forward_kinematics_kernel(*numbers, angle, rates), strict=True):
        np.testing.assert_array_equal(left, right)


# --- Odometry ------------------------------------------------------------------------------------------------------------


def test_odometry_closes_a_circle_and_tells_what_its_counts_leave_open() -> None:
    robot, parameters = parse_robot(tricycle()), OdometryParameters()
    angle, steps = 0.6, 2000
    turn = math.tau * WHEELBASE / math.sin(angle)  # way of the front wheel
    state = initial_state()
    for k in range(steps + 1):
        state, output = update(robot, parameters, state, np.array([[turn / 0.1 * k / steps, angle]]), 0.01)
    np.testing.assert_allclose(state.pose, [0.0, 0.0, math.tau], atol=1e-6)
    np.testing.assert_allclose(output.twist, [turn * math.cos(angle) / 20.0, 0.0, math.tau / 20.0], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(output.slip, 0.0, atol=1e-12)
    # A count is 15 um of way. Nothing slips that anything would show: the variance stays that of one count.
    deviation = np.sqrt(np.diag(state.pose_covariance))
    assert 0.0 < deviation.min() and deviation.max() < 1e-4


def test_odometry_learns_its_noise_where_wheels_are_redundant() -> None:
    """Two steered wheels and an axle: 5 velocities, 3 of a motion. Slip of one wheel shows in the covariance."""
    robot, parameters = with_casters(2), OdometryParameters()
    rng = np.random.default_rng(0)
    covariance = []
    for slip in (1e-4, 1e-3):
        state, position = initial_state(), np.zeros((2, 2))
        for _ in range(400):
            position = position + np.column_stack([0.05 + slip * rng.standard_normal(2), np.zeros(2)])
            state, output = update(robot, parameters, state, position, 0.01)
        covariance.append(output.twist_covariance[0, 0])
    assert 50.0 < covariance[1] / covariance[0] < 200.0  # the square of ten, from some fifty updates


# --- Who refuses them ----------------------------------------------------------------------------------------------------


def test_what_knows_no_fixed_wheels_says_so() -> None:
    robot = with_casters(2, offset=-0.04)
    asked: list[Callable[[], Any]] = [
        lambda: AugmentedObjectModel(robot),
        lambda: forward_displacement(robot, np.zeros(2), np.zeros((2, 2))),
        lambda: analyse(robot, np.zeros(2), np.ones((2, 2), dtype=bool)),
        lambda: update(robot, OdometryParameters("displacement"), started, np.zeros((2, 2)), 0.01),
        lambda: inverse_kinematics(robot, np.zeros(2), np.array([1.0, 0.1, 0.0])),
    ]
    started, _ = update(robot, OdometryParameters("displacement"), initial_state(), np.zeros((2, 2)), 0.01)
    for call in asked:
        with pytest.raises(KinematicsError, match="fixed wheels|fixed_wheels are rear_left, rear_right"):
            call()


def test_the_urdf_shows_them_on_the_base() -> None:
    drawn = robot_urdf(parse_robot(tricycle()))
    one_less = robot_urdf(parse_robot(tricycle(fixed_wheels=tricycle()["fixed_wheels"][:1])))
    assert drawn.count("<cylinder") == one_less.count("<cylinder") + 1
