"""The unit of a gyro told from the wheels: as soon as the robot turns, and never from a bias, slip or noise."""

import math

import numpy as np
import pytest

from pcw_description import inverse_kinematics, load_robot
from pcw_estimation.gyro_unit import GyroUnit

THESIS = load_robot("thesis")
DEGREE = math.radians(1.0)


def drive(unit, twist, gyro, seconds=10.0, joint_rate=200.0, imu_rate=200.0, start=0.0):
    """Let the wheels move with twist(t), the gyro read gyro(t); return the faults that were told, in their order."""
    steer, faults = np.zeros((THESIS.n, 2)), []
    stamps = sorted(
        [(start + k / joint_rate, "joints") for k in range(int(seconds * joint_rate))]
        + [(start + (k + 0.3) / imu_rate, "imu") for k in range(int(seconds * imu_rate))]
    )
    for time, kind in stamps:
        if kind == "imu":
            unit.add_gyro(round(time * 1e9), gyro(time))
            continue
        rates = inverse_kinematics(THESIS, steer[:, 1], np.array(twist(time)))
        steer = steer + rates / joint_rate
        unit.add_joints(round(time * 1e9), steer, rates)
        if unit.fault and (not faults or faults[-1] != unit.fault):
            faults.append(unit.fault)
    return faults


def turning(time):
    return 0.3, 0.0, 0.6 * math.sin(time)


@pytest.mark.parametrize(("joint_rate", "imu_rate"), [(1000.0, 200.0), (50.0, 100.0), (100.0, 20.0), (10.0, 10.0)])
@pytest.mark.parametrize(
    ("factor", "looks"), [(1.0 / DEGREE, "is in degrees/s"), (DEGREE, "was taken from degrees/s to rad/s twice")]
)
def test_another_unit_is_told_at_any_rate(factor, looks, joint_rate, imu_rate):
    rng = np.random.default_rng(1)
    faults = drive(
        GyroUnit(THESIS), turning, lambda t: factor * (turning(t)[2] + rng.normal(0.0, 0.01)), 30.0, joint_rate, imu_rate
    )
    assert faults and all(f"it looks as if it {looks}; allowed: rad/s" in fault for fault in faults)
    assert faults[0].startswith(f"imu/data: angular_velocity.z turns {factor:.2g}"[:-1])


@pytest.mark.parametrize("factor", [1.0, 1.02, 0.0, -1.0, 20.0])
def test_a_healthy_gyro_and_one_that_is_wrong_otherwise_is_not_accused(factor):
    rng = np.random.default_rng(2)
    assert not drive(GyroUnit(THESIS), turning, lambda t: factor * turning(t)[2] + rng.normal(0.003, 0.01))


def test_a_bias_beside_wheels_that_hardly_turn_is_no_unit():
    """Their ratio is constant, and may be anything."""
    assert not drive(GyroUnit(THESIS), lambda t: (0.8, 0.0, 1e-4), lambda t: 1e-4 / DEGREE, 30.0)


def test_a_gyro_that_is_put_right_is_believed_again():
    unit = GyroUnit(THESIS)
    assert drive(unit, turning, lambda t: turning(t)[2] / DEGREE)
    drive(unit, turning, lambda t: turning(t)[2], 15.0, start=10.0)
    assert unit.fault == ""


def test_time_that_begins_anew_begins_anew():
    unit = GyroUnit(THESIS)
    drive(unit, turning, lambda t: turning(t)[2], start=100.0)
    unit.clear()
    assert drive(unit, turning, lambda t: turning(t)[2] / DEGREE)
