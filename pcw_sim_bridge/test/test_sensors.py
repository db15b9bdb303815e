"""What sensors report of the truth."""

import dataclasses
import math

import numpy as np
import pytest

from pcw_description import load_robot, shipped_robots
from pcw_description.errors import DescriptionError
from pcw_sim_bridge.plants.plant import PlantState
from pcw_sim_bridge.sensors import Encoders, Imu, read_tracker

THESIS = load_robot("thesis")


def truth(n=4, joint_position=None, joint_velocity=None, **changes):
    """A robot at rest but for the changes; its gears are rigid."""
    position = np.zeros((n, 2)) if joint_position is None else joint_position
    velocity = np.zeros((n, 2)) if joint_velocity is None else joint_velocity
    state = PlantState(
        time=0.0, pose=np.zeros(3), twist=np.zeros(3), acceleration=np.zeros(3), gravity=np.array([0.0, 0.0, -9.81]),
        swing_rate=np.zeros(2), swing_acceleration=np.zeros(2),
        joint_position=position, joint_velocity=velocity, motor_position=position, motor_velocity=velocity,
        motor_torque=np.zeros((n, 2)), slip=np.zeros((n, 2)), contact_force=np.zeros((n, 2)), normal_force=np.zeros(n),
    )
    return dataclasses.replace(state, **changes)


def with_imu(**changes):
    sensors = dataclasses.replace(THESIS.sensors, imu=dataclasses.replace(THESIS.sensors.imu, **changes))
    return Imu(dataclasses.replace(THESIS, sensors=sensors))


def with_encoders(robot, **changes):
    sensors = dataclasses.replace(robot.sensors, encoders=dataclasses.replace(robot.sensors.encoders, **changes))
    return dataclasses.replace(robot, sensors=sensors)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.mark.parametrize("name", shipped_robots())
def test_encoders_are_off_by_half_a_count_at_most(name, rng):
    """On the motor side half a count; on the joint side what the inverse gear matrix makes of it."""
    robot = load_robot(name)
    encoders = Encoders(robot)
    sensor = robot.sensors.encoders
    radians_per_count = math.tau / np.array([sensor.drive_counts, sensor.steer_counts])
    bound = np.abs(np.linalg.inv(robot.gear_matrix)) @ (0.5 * radians_per_count)
    worst = np.zeros((robot.n, 2))
    for _ in range(300):
        position = rng.normal(0.0, 30.0, (robot.n, 2))
        reading = encoders.read(truth(robot.n, joint_position=position), None, 0.002, rng)
        worst = np.maximum(worst, np.abs(reading.position - position))
        motor = np.einsum("nij,nj->ni", robot.gear_matrix, reading.position) / radians_per_count
        np.testing.assert_allclose(motor, np.round(motor), atol=1e-6)
    assert np.all(worst <= bound * (1.0 + 1e-6))
    assert np.all(worst > 0.5 * bound)  # it does quantise, and to that step


def test_a_coupled_gear_shows_in_both_joints(rng):
    """Steering alone turns the drive motor where the gears couple; the joint angles must not show it."""
    coupled = tuple(
        dataclasses.replace(c, gears=dataclasses.replace(c.gears, drive_per_steer=3.5714)) for c in THESIS.casters
    )
    robot = dataclasses.replace(THESIS, casters=coupled)
    encoders = Encoders(robot)
    position = np.tile([0.0, 1.0], (4, 1))
    counts = encoders.counts(position)
    np.testing.assert_allclose(counts[:, 0], round(3.5714 * 4096 / math.tau))
    reading = encoders.read(truth(joint_position=position), None, 0.002, rng)
    np.testing.assert_allclose(reading.position, position, atol=1e-4)


def test_noise_has_the_size_that_the_robot_states(rng):
    encoders = Encoders(THESIS)
    velocity, torque = rng.normal(size=(4, 2)), rng.normal(size=(4, 2))
    state = truth(joint_velocity=velocity, motor_torque=torque)
    readings = [encoders.read(state, None, 0.002, rng) for _ in range(2000)]
    # 16000 samples: the standard deviation is known to 0.6 %; 3 % is five times that.
    speed_noise = np.array([r.velocity - velocity for r in readings])
    assert speed_noise.std() == pytest.approx(THESIS.sensors.encoders.velocity_noise, rel=0.03)
    torque_noise = np.array([r.effort - torque for r in readings])
    assert torque_noise.std() == pytest.approx(THESIS.sensors.encoders.torque_noise, rel=0.03)


def test_velocity_by_difference_is_that_of_the_counts(rng):
    robot = with_encoders(THESIS, velocity_noise=0.0)
    encoders = Encoders(robot, velocity_source="difference")
    rate, dt = np.full((4, 2), 3.3), 0.002
    previous = encoders.read(truth(), None, dt, rng)
    assert not previous.velocity.any()
    resolution = math.tau / 4096 / 20.0
    found = []
    for k in range(1, 200):
        reading = encoders.read(truth(joint_position=rate * k * dt), previous, dt, rng)
        assert np.abs(reading.velocity - rate).max() <= resolution / dt
        found.append(reading.velocity)
        previous = reading
    assert np.std(found) > 0.1 * resolution / dt
    np.testing.assert_allclose(np.mean(found, axis=0), rate, rtol=1e-3)


def test_accelerometer_on_a_circle_reads_the_centripetal_acceleration_of_its_own_place(rng):
    """Base at (R, 0) of a circle of radius R, driving along +x: every point has omega^2 times its way to the centre."""
    radius, omega = 2.0, 0.7
    imu = with_imu(position=(0.3, -0.1, 0.2), gyro_noise=0.0, accelerometer_noise=0.0)
    state = truth(
        twist=np.array([omega * radius, 0.0, omega]), acceleration=np.array([0.0, omega**2 * radius, 0.0])
    )
    reading = imu.read(state, rng)
    centre = np.array([0.0, radius])  # of the circle, in base_link
    expected = omega**2 * (centre - np.array([0.3, -0.1]))
    np.testing.assert_allclose(reading.linear_acceleration, [*expected, 9.81], atol=1e-12)
    np.testing.assert_allclose(reading.angular_velocity, [0.0, 0.0, omega], atol=1e-12)


def test_accelerometer_feels_a_yaw_acceleration_through_its_lever_arm(rng):
    imu = with_imu(position=(0.3, -0.1, 0.2), gyro_noise=0.0, accelerometer_noise=0.0)
    reading = imu.read(truth(acceleration=np.array([0.0, 0.0, 2.0])), rng)
    np.testing.assert_allclose(reading.linear_acceleration, [0.2, 0.6, 9.81], atol=1e-12)


def test_an_imu_swings_with_the_chassis_that_carries_it(rng):
    """Rolled about x and pitched about y, a place at the height z is accelerated by alpha x r; the gyro shows the rates."""
    imu = with_imu(position=(0.3, -0.1, 0.2), gyro_noise=0.0, accelerometer_noise=0.0)
    swing, rate = np.array([0.5, -0.8]), np.array([0.01, -0.02])
    reading = imu.read(truth(swing_acceleration=swing, swing_rate=rate), rng)
    expected = np.cross([*swing, 0.0], [0.3, -0.1, 0.2]) + [0.0, 0.0, 9.81]
    np.testing.assert_allclose(reading.linear_acceleration, expected, atol=1e-12)
    np.testing.assert_allclose(reading.angular_velocity, [0.01, -0.02, 0.0], atol=1e-12)


def test_equal_seeds_give_equal_readings():
    state = truth(pose=np.array([1.0, 2.0, 0.5]))

    def everything(seed):
        rng = np.random.default_rng(seed)
        joints = Encoders(THESIS).read(state, None, 0.002, rng)
        imu = Imu(THESIS).read(state, rng)
        pose = read_tracker(THESIS.sensors.tracker, state, rng)
        return np.concatenate([joints.velocity.ravel(), joints.effort.ravel(), imu.linear_acceleration, pose])

    np.testing.assert_array_equal(everything(1), everything(1))
    assert np.all(everything(1) != everything(2))


def test_tracker_noise_has_the_size_that_the_robot_states(rng):
    poses = np.array([read_tracker(THESIS.sensors.tracker, truth(), rng) for _ in range(4000)])
    np.testing.assert_allclose(poses.std(axis=0), [0.0005, 0.0005, 0.0005], rtol=0.05)


def test_refuses_an_unknown_source_of_velocity():
    with pytest.raises(DescriptionError, match=r"velocity_source: 'magic' is not allowed; allowed: drive, difference"):
        Encoders(THESIS, velocity_source="magic")
