"""The robot around a plant: timing, commands, repeatability."""

import dataclasses

import numpy as np
import pytest

from pcw_description import inverse_kinematics, load_robot
from pcw_sim_bridge.plants.factory import make_plant
from pcw_sim_bridge.plants.plant import PlantError, PlantState
from pcw_sim_bridge.sensors import ImuReading, JointReading
from pcw_sim_bridge.simulated_robot import JointCommand, SimulatedRobot, TrackedPose

THESIS = load_robot("thesis")


def robot_with_rates(joints, imu, tracker):
    sensors = THESIS.sensors
    return dataclasses.replace(
        THESIS,
        sensors=dataclasses.replace(
            sensors,
            encoders=dataclasses.replace(sensors.encoders, rate=joints),
            imu=dataclasses.replace(sensors.imu, rate=imu) if imu else None,
            tracker=dataclasses.replace(sensors.tracker, rate=tracker) if tracker else None,
        ),
    )


def simulated(robot=THESIS, **arguments):
    return SimulatedRobot(make_plant("reduced", robot), **arguments)


def run(robot, seconds):
    samples = list(robot.advance())
    while robot.time_ns < round(seconds * 1e9):
        samples += robot.advance()
    return samples


def stamps(samples, kind):
    return np.array([s.time_ns for s in samples if isinstance(s.reading, kind)]) * 1e-9


@pytest.mark.parametrize("joints, imu, tracker", [(500.0, 200.0, 100.0), (300.0, 1000.0, 7.0), (1000.0, None, None)])
def test_every_sensor_keeps_its_rate_without_drift(joints, imu, tracker):
    samples = run(simulated(robot_with_rates(joints, imu, tracker)), 2.0)
    truth = tracker or 100.0
    for kind, rate in ((JointReading, joints), (ImuReading, imu), (TrackedPose, truth), (PlantState, truth)):
        times = stamps(samples, kind)
        if rate is None:
            assert len(times) == 0
            continue
        ideal = np.arange(len(times)) / rate
        assert len(times) == pytest.approx(2.0 * rate + 1, abs=1)
        assert np.all(times - ideal > -1e-9) and np.all(times - ideal < 1e-3)


@pytest.mark.parametrize("rate", [300.0, 120.0, 500.0, 2000.0])
def test_the_periods_of_the_drives_are_even(rate):
    times = stamps(run(simulated(robot_with_rates(rate, 100.0, 100.0)), 0.5), JointReading)
    assert np.ptp(np.diff(times)) < 2e-9


def test_samples_come_in_order_and_each_period_ends_with_the_joints():
    robot = simulated()
    list(robot.advance())
    for k in range(1, 50):
        period = list(robot.advance())
        assert [s.time_ns for s in period] == sorted(s.time_ns for s in period)
        assert isinstance(period[-1].reading, JointReading) and period[-1].time_ns == k * 2_000_000


def test_a_seed_repeats_a_run_bit_by_bit_and_reset_does_too():
    def drive(robot):
        found = []
        for k in range(100):
            for sample in robot.advance():
                if isinstance(sample.reading, JointReading):
                    found.append([sample.reading.position, sample.reading.velocity, sample.reading.effort])
            robot.command(JointCommand(effort=np.full((4, 2), 0.01 * k)))
        return np.array(found)

    first = simulated(seed=3)
    list(first.advance())
    a = drive(first)
    first.reset()
    assert first.time_ns == 0
    list(first.advance())
    np.testing.assert_array_equal(a, drive(first))
    other = simulated(seed=4)
    list(other.advance())
    assert not np.array_equal(a, drive(other))


def test_torque_is_held_until_the_timeout_and_then_zero():
    robot = simulated(command_timeout=0.05)
    list(robot.advance())
    run(robot, 0.1)
    assert not robot.timed_out  # nothing was commanded yet
    robot.command(JointCommand(effort=np.tile([1.0, 0.0], (4, 1))))
    torques = []
    for _ in range(50):
        list(robot.advance())
        torques.append(robot.plant.state().motor_torque[0, 0])
    # A command given at t acts up to t + 50 ms: 26 periods of 2 ms, the last begun exactly at the timeout.
    assert torques == [1.0] * 26 + [0.0] * 24
    assert robot.timed_out


def test_zero_torque_by_command_of_none():
    robot = simulated()
    list(robot.advance())
    robot.command(JointCommand(effort=np.ones((4, 2))))
    list(robot.advance())
    robot.command(None)
    list(robot.advance())
    assert not robot.plant.state().motor_torque.any()


def test_velocity_commands_are_reached_and_held():
    robot = simulated()
    list(robot.advance())
    wanted = inverse_kinematics(THESIS, np.zeros(4), np.array([0.4, 0.0, 0.0]))
    for _ in range(1000):
        robot.command(JointCommand(velocity=wanted))
        list(robot.advance())
    state = robot.plant.state()
    np.testing.assert_allclose(state.joint_velocity, wanted, atol=0.02)
    assert state.twist[0] == pytest.approx(0.4, rel=0.01)


@pytest.mark.parametrize("name", ["dyros_pcv", "flow_base", "thesis", "tidybot2", "xr4000"])
def test_velocity_loops_are_quiet_on_light_wheels_and_slow_buses(name):
    """Computed once per joint_states, as they were at first, the loops of light wheels at 200 or 300 Hz fed a limit cycle at
    the torque limit: the wheel that slips weighs a tenth of what the loop is designed for.
    """
    robot = simulated(load_robot(name))
    list(robot.advance())
    limit, torques = robot.robot.torque_limit, []
    for _ in range(400):
        robot.command(JointCommand(velocity=np.tile([1.0, 0.0], (robot.robot.n, 1))))
        list(robot.advance())
        torques.append(np.abs(robot.plant.state().motor_torque) / limit)
    assert np.max(torques[200:]) < 0.1


@pytest.mark.parametrize(
    "fields, message",
    [
        ({}, "none of effort and velocity set; allowed: exactly one"),
        ({"effort": np.zeros((4, 2)), "velocity": np.zeros((4, 2))}, "both of effort and velocity set; allowed: exactly one"),
        ({"effort": np.full((4, 2), np.nan)}, "NaN or infinity"),
        ({"velocity": np.full((4, 2), np.inf)}, "NaN or infinity"),
    ],
)
def test_refuses_commands_that_say_nothing_or_too_much(fields, message):
    with pytest.raises(PlantError, match=message):
        JointCommand(**fields)


def test_refuses_a_sensor_that_is_faster_than_the_plant():
    with pytest.raises(PlantError, match=r"sensors.imu.rate = 2000 Hz is not allowed with dt = 0.001 s; .* at most 1000 Hz"):
        simulated(robot_with_rates(500.0, 2000.0, 100.0))
