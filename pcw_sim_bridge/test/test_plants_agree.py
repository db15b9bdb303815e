"""All plants under the same controller and the same commands: a circle and a figure-8."""

import functools
from collections.abc import Callable

import numpy as np
import pytest

from pcw_control.computed_torque import ComputedTorque
from pcw_control.controller_interface import ControllerMeasurement
from pcw_control.quintic_trajectory import TrajectoryPoint
from pcw_description import load_robot
from pcw_description.odometry import OdometryParameters, update
from pcw_description.odometry import initial_state as initial_odometry
from pcw_sim_bridge.plants.factory import make_plant

DURATION = 12.0
RAMP = 2.0
STEPS_PER_CYCLE = 2


def circle(angle: float) -> np.ndarray:
    """Return a circle of 0.8 m, the robot turning with it, (x, y, yaw)."""
    return np.array([0.8 * np.sin(angle), 0.8 * (1.0 - np.cos(angle)), angle])


def figure8(angle: float) -> np.ndarray:
    """Return a figure-8 of 2 m x 1 m at fixed yaw but for a slow swing, (x, y, yaw)."""
    return np.array([np.sin(angle), 0.5 * np.sin(2.0 * angle), 0.4 * np.sin(angle)])


def reference(path: Callable[[float], np.ndarray], rate: float, time: float) -> TrajectoryPoint:
    """Return the point of a path run at `rate` [rad/s] after a smooth start, derivatives by central differences."""

    def phase(t: float) -> float:
        if t >= RAMP:
            return rate * (t - RAMP / 2)
        x = max(t, 0.0) / RAMP
        return (
            rate * RAMP * x**4 * (2.5 + x * (-3.0 + x))
        )  # its rate rises from 0 to `rate` with zero acceleration at both ends

    h = 1e-4
    before, now, after = (path(phase(time + shift)) for shift in (-h, 0.0, h))
    return TrajectoryPoint(now, (after - before) / (2 * h), (after - 2 * now + before) / h**2)


PATHS = [(circle, 0.75), (figure8, 0.75)]


@functools.cache
def drive(plant_name: str, path: Callable[[float], np.ndarray], rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return true poses (T, 3) and slip velocities (T, n, 2) of a closed-loop run from encoders alone."""
    robot = load_robot("thesis")
    plant = make_plant(plant_name, robot)
    start = path(0.0)
    tangent = path(1e-3) - start
    plant.reset(pose=start, steer_angle=np.full(robot.n, np.arctan2(tangent[1], tangent[0])))
    controller = ComputedTorque(robot)
    control, odometry = controller.initial_state(), initial_odometry(start)
    parameters = OdometryParameters()
    dt = STEPS_PER_CYCLE * plant.dt
    poses, slips = [], []
    try:
        for cycle in range(round(DURATION / dt)):
            state = plant.state()
            odometry, _ = update(robot, parameters, odometry, state.joint_position, dt)
            measurement = ControllerMeasurement(state.joint_position, state.joint_velocity, odometry.pose)
            control, output = controller.step(control, measurement, reference(path, rate, cycle * dt), dt)
            plant.step(output.torque, STEPS_PER_CYCLE)
            poses.append(state.pose)
            slips.append(state.slip)
    finally:
        plant.close()
    return np.array(poses), np.array(slips)


def furthest_apart(poses: np.ndarray, others: np.ndarray) -> float:
    """Return the largest distance between two runs at the same time [m]."""
    return float(np.hypot(*(poses - others)[:, :2].T).max())


@pytest.mark.parametrize(("path", "rate"), PATHS)
def test_closed_loop_runs_agree(engine: str, path: Callable[[float], np.ndarray], rate: float) -> None:
    """Poses stay within 1 mm and slip velocities within 20 % (RMS over the run) of each other, at 0.6 to 1 m/s."""
    reduced_pose, reduced_slip = drive("reduced", path, rate)
    pose, slip = drive(engine, path, rate)
    apart = furthest_apart(pose, reduced_pose)
    slip_size = np.sqrt(np.mean(reduced_slip**2))
    slip_apart = np.sqrt(np.mean((slip - reduced_slip) ** 2))
    travelled = np.sum(np.hypot(*np.diff(reduced_pose[:, :2], axis=0).T))
    print(
        f"\n{engine}, {path.__name__}: {travelled:.1f} m, pose within {1e3 * apart:.3f} mm, "
        f"slip {1e3 * slip_size:.2f} mm/s RMS, apart {100 * slip_apart / slip_size:.1f} %"
    )
    assert travelled > 5.0
    assert apart < 1e-3
    assert slip_apart < 0.2 * slip_size


@pytest.mark.parametrize(("path", "rate"), PATHS)
def test_results_do_not_hang_on_the_engine(path: Callable[[float], np.ndarray], rate: float) -> None:
    """On the same springs and tyres two engines are within 5 micrometres: only bodies and rotors are each one's own work."""
    pytest.importorskip("mujoco", reason="MuJoCo, which is optional, is not installed")
    apart = furthest_apart(drive("mujoco", path, rate)[0], drive("pybullet", path, rate)[0])
    print(f"\n{path.__name__}: engines within {1e6 * apart:.2f} micrometres")
    assert apart < 5e-6


@pytest.mark.parametrize("name", ["thesis", "tidybot2", "xr4000"])
def test_engines_agree_under_changing_torques(name: str) -> None:
    """Torques that jump and wheels turned anyhow, in open loop: joint rates within 1 % of the fastest.

    In PyBullet rotors are part of fork and wheel. That they push against the base when they spin up, and turn with it when it
    pitches, was not taken back: 3.4 % on the thesis robot, at any step. What is left now goes with the step, as PyBullet's
    correction comes a step late: 0.5 % at 1 ms on the thesis robot, 2.7 % on one whose gears couple strongly.
    """
    pytest.importorskip("mujoco", reason="MuJoCo, which is optional, is not installed")
    robot = load_robot(name)
    rates = []
    for plant_name in ("pybullet", "mujoco"):
        rng = np.random.default_rng(1)
        plant = make_plant(plant_name, robot, 2.5e-4)
        plant.reset(steer_angle=rng.normal(size=robot.n))
        for _ in range(10):
            plant.step(0.1 * robot.torque_limit * rng.normal(size=(robot.n, 2)), 120)
        rates.append(plant.state().joint_velocity)
        plant.close()
    np.testing.assert_allclose(rates[0], rates[1], atol=0.01 * np.abs(rates[1]).max())
