"""Computed torque with the least internal force: laws first, then the closed loop on an ideal plant."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest

from pcw_control.computed_torque import (
    ComputedTorque,
    ComputedTorqueParameters,
    ComputedTorqueState,
)
from pcw_control.controller_interface import ControllerMeasurement, TwistReference
from pcw_control.errors import ControlError
from pcw_control.quintic_trajectory import MotionLimits, TrajectoryPoint, plan_point_to_point
from pcw_description import (
    AugmentedObjectModel,
    KinematicsError,
    inverse_kinematics,
    joint_matrix,
    load_robot,
    shipped_robots,
    wheel_centres,
    wheel_jacobian,
)

_spec = importlib.util.spec_from_file_location("controller_contract", Path(__file__).with_name("controller_contract.py"))
contract = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(contract)


def is_torque_controlled(name):
    try:
        load_robot(name).require_torque_control()
    except KinematicsError:
        return False
    return True


ROBOTS = [name for name in shipped_robots() if is_torque_controlled(name)]
DT = 0.002


@pytest.fixture
def rng():
    return np.random.default_rng(5)


@pytest.mark.parametrize("name", ROBOTS)
def test_keeps_the_controllers_contract(name, rng):
    robot = load_robot(name)
    contract.check_contract(ComputedTorque(robot), robot, rng)


@pytest.mark.parametrize("name", ROBOTS)
def test_power_of_the_joints_is_power_of_the_wrench(name, rng):
    """Without slip tau . q_dot = F . V; with a lateral offset only B^T, not B, gives that."""
    robot = load_robot(name)
    controller = ComputedTorque(robot)
    for _ in range(20):
        twist = rng.normal(0.0, 0.3, 3)
        measurement = contract.rolling_measurement(robot, twist, rng.uniform(-3.0, 3.0, robot.n))
        _, output = controller.step(controller.initial_state(), measurement, TwistReference(rng.normal(0.0, 0.5, 3)), DT)
        power = float(np.sum(output.torque * measurement.joint_velocity))
        scale = float(np.sum(np.abs(output.torque * measurement.joint_velocity)))
        assert power == pytest.approx(float(output.wrench @ twist), abs=1e-12 * max(scale, 1.0))


@pytest.mark.parametrize("name", ROBOTS)
def test_contact_forces_carry_the_wrench_without_internal_force(name, rng):
    """A^T F_con = F (5.2) and E F_con = 0 (5.3)."""
    robot = load_robot(name)
    steer_angle = rng.uniform(-3.0, 3.0, robot.n)
    measurement = contract.rolling_measurement(robot, [0.3, -0.1, 0.4], steer_angle)
    controller = ComputedTorque(robot)
    _, output = controller.step(controller.initial_state(), measurement, TwistReference(np.array([1.0, 2.0, -1.0])), DT)
    A = wheel_jacobian(robot, steer_angle)
    np.testing.assert_allclose(A.T @ output.contact_force.ravel(), output.wrench, rtol=1e-10)
    np.testing.assert_allclose(output.torque.ravel(), joint_matrix(robot).T @ output.contact_force.ravel(), atol=1e-10)

    c, s = np.cos(steer_angle), np.sin(steer_angle)
    fx, fy = output.contact_force.T
    force_in_base = np.stack([c * fx - s * fy, s * fx + c * fy], axis=1)
    centre = wheel_centres(robot, steer_angle)
    for i in range(robot.n):
        for j in range(i):
            p_ij = centre[j] - centre[i]
            internal = p_ij @ (force_in_base[i] - force_in_base[j])
            assert abs(internal) < 1e-9 * np.abs(output.contact_force).max()


@pytest.mark.parametrize("name", ROBOTS)
def test_demands_no_force_of_a_coasting_robot_beyond_the_bias(name):
    robot = load_robot(name)
    twist = np.array([0.06, 0.02, 0.04])  # slow enough for every joint, whatever its heading
    steer_angle = np.linspace(-1.0, 2.0, robot.n)
    measurement = contract.rolling_measurement(robot, twist, steer_angle)
    controller = ComputedTorque(robot)
    _, output = controller.step(controller.initial_state(twist), measurement, TwistReference(twist), DT)
    _, theta = AugmentedObjectModel(robot).evaluate(steer_angle, twist)
    np.testing.assert_allclose(output.wrench, theta, atol=1e-9)


class IdealPlant:
    """Rolls without slip: V_dot = Lambda^-1 (A^T B^-T tau + load - theta), integrated by Runge-Kutta (4th order)."""

    def __init__(self, robot, load=(0.0, 0.0, 0.0)):
        self.robot, self.load = robot, np.array(load)
        self.model, self.B_T = AugmentedObjectModel(robot), joint_matrix(robot).T
        self.pose, self.twist = np.zeros(3), np.zeros(3)
        self.joint_position = np.zeros((robot.n, 2))

    def derivative(self, pose, twist, joint_position, torque):
        steer_angle = np.ascontiguousarray(joint_position[:, 1])
        inertia, bias = self.model.evaluate(steer_angle, twist)
        F = wheel_jacobian(self.robot, steer_angle).T @ np.linalg.solve(self.B_T, torque.ravel()) + self.load
        c, s = math.cos(pose[2]), math.sin(pose[2])
        pose_rate = np.array([c * twist[0] - s * twist[1], s * twist[0] + c * twist[1], twist[2]])
        return pose_rate, np.linalg.solve(inertia, F - bias), inverse_kinematics(self.robot, steer_angle, twist)

    def step(self, torque, dt):
        x = (self.pose, self.twist, self.joint_position)
        k1 = self.derivative(*x, torque)
        k2 = self.derivative(*(a + 0.5 * dt * k for a, k in zip(x, k1)), torque)
        k3 = self.derivative(*(a + 0.5 * dt * k for a, k in zip(x, k2)), torque)
        k4 = self.derivative(*(a + dt * k for a, k in zip(x, k3)), torque)
        self.pose, self.twist, self.joint_position = (
            a + dt / 6.0 * (p + 2 * q + 2 * r + t) for a, p, q, r, t in zip(x, k1, k2, k3, k4)
        )

    def measure(self, saturated=False):
        velocity = inverse_kinematics(self.robot, np.ascontiguousarray(self.joint_position[:, 1]), self.twist)
        return ControllerMeasurement(self.joint_position, velocity, self.pose, saturated)


@pytest.mark.parametrize("name", ROBOTS)
def test_follows_a_quintic_through_the_turning_of_its_casters(name):
    """Sideways and backwards with a turn, from all wheels ahead: the casters have to turn round on the way."""
    robot = load_robot(name)
    plant, controller = IdealPlant(robot), ComputedTorque(robot)
    state = controller.initial_state()
    limits = MotionLimits(0.3, 0.2, 0.5, 0.5)
    trajectory = plan_point_to_point(
        TrajectoryPoint(np.zeros(3)), TrajectoryPoint(np.array([-0.5, 0.8, 0.6])), limits
    )
    worst = 0.0
    steps = int(trajectory.duration / DT) + 250
    for k in range(steps):
        point = trajectory.sample(k * DT)
        worst = max(worst, float(np.abs(point.pose - plant.pose).max()))
        state, output = controller.step(state, plant.measure(), point, DT)
        plant.step(output.torque, DT)
    # 2 mm: the torque is held over each step of 2 ms while the casters turn at up to v/b = 15 rad/s.
    assert worst < 2e-3
    assert np.abs(plant.pose - trajectory.sample(trajectory.duration).pose).max() < 1e-4


def test_pose_error_dies_out_as_the_gains_say():
    """e_ddot + k_d e_dot + k_p e = 0 in odom, also while the robot turns: (1 + w t) exp(-w t) at w = 10 rad/s."""
    robot = load_robot("thesis")
    plant, controller = IdealPlant(robot), ComputedTorque(robot)
    state = controller.initial_state()
    dt = 5e-4
    spin = np.array([0.0, 0.0, 0.8])
    plant.twist = spin.copy()
    plant.joint_position[:, 1] = [2.4, 0.7, -2.4, -0.7]  # about where the casters trail when the robot spins
    offset = np.array([0.010, -0.006, 0.0])
    for k in range(601):
        t = k * dt
        point = TrajectoryPoint(offset + spin * t, spin)
        e = point.pose - plant.pose
        expected = offset * (1.0 + 10.0 * t) * math.exp(-10.0 * t)
        # 2 % of the step: the loop closes only every 0.5 ms.
        np.testing.assert_allclose(e, expected, atol=0.02 * 0.010)
        state, output = controller.step(state, plant.measure(), point, dt)
        plant.step(output.torque, dt)


def test_the_integral_takes_up_a_constant_load():
    robot = load_robot("thesis")
    target = np.array([0.3, 0.1, 0.2])
    for integral_gain, bound in ((50.0, 1e-3), (0.0, 1.0)):
        plant = IdealPlant(robot, load=(-40.0, 20.0, 3.0))
        controller = ComputedTorque(robot, ComputedTorqueParameters(integral_gain=integral_gain))
        state = controller.initial_state()
        for _ in range(1500):
            state, output = controller.step(state, plant.measure(), TwistReference(target), DT)
            plant.step(output.torque, DT)
        error = np.abs(plant.twist - target).max()
        assert error < bound
    assert error > 0.01  # without it the load leaves an error of load / (k_d Lambda)


def test_the_integral_holds_while_torque_is_limited_and_stays_within_its_limit():
    robot = load_robot("thesis")
    controller = ComputedTorque(robot)
    state = controller.initial_state()
    measurement = contract.rolling_measurement(robot, np.zeros(3), np.zeros(4), saturated=True)
    for _ in range(1000):
        state, _ = controller.step(state, measurement, TwistReference(np.ones(3)), DT)
    assert not state.error_integral.any()
    measurement = contract.rolling_measurement(robot, np.zeros(3), np.zeros(4))
    for _ in range(5000):
        state, _ = controller.step(state, measurement, TwistReference(np.ones(3)), DT)
    np.testing.assert_allclose(50.0 * state.error_integral, [1.0, 1.0, 3.0])


def test_the_reference_keeps_its_limits_of_acceleration_and_speed():
    robot = load_robot("thesis")
    limits = MotionLimits(0.5, 0.4, 0.8, 1.0)
    controller = ComputedTorque(robot, ComputedTorqueParameters(limits=limits))
    state = controller.initial_state()
    measurement = contract.rolling_measurement(robot, np.zeros(3), np.zeros(4))
    for _ in range(2000):
        before = state.reference_twist
        state, _ = controller.step(state, measurement, TwistReference(np.array([3.0, 0.0, -1.0])), DT)
        change = (state.reference_twist - before) / DT
        assert math.hypot(*change[:2]) <= 0.4 * (1 + 1e-9) and abs(change[2]) <= 1.0 * (1 + 1e-9)
    # The direction of the command is kept: the translation is the one limited.
    np.testing.assert_allclose(state.reference_twist, [0.5, 0.0, -0.5 / 3.0], rtol=1e-6)


def test_the_reference_waits_for_casters_that_turn_round():
    """Wheels across the motion steer at v/b, so 15 rad/s and b = 30 mm allow 0.45 m/s at most."""
    robot = load_robot("thesis")
    controller = ComputedTorque(robot)
    across = contract.rolling_measurement(robot, np.zeros(3), np.full(4, math.pi / 2))
    state = controller.initial_state()
    for _ in range(2000):
        state, output = controller.step(state, across, TwistReference(np.array([1.2, 0.0, 0.0])), DT)
    assert output.reference_twist[0] == pytest.approx(0.8 * 15.0 * 0.030)


def test_hands_over_between_references_without_a_jump():
    robot = load_robot("thesis")
    controller = ComputedTorque(robot)
    state = ComputedTorqueState(np.zeros(3), np.array([0.1, 0.0, 0.0]))
    twist = np.array([0.4, 0.0, 0.3])
    yaw = 1.1
    velocity = np.array([0.4 * math.cos(yaw), 0.4 * math.sin(yaw), 0.3])
    measurement = contract.rolling_measurement(robot, twist, np.zeros(4), pose=np.array([1.0, 2.0, yaw]))
    point = TrajectoryPoint(np.array([1.0, 2.0, yaw + math.tau]), velocity, 0.3 * np.array([-velocity[1], velocity[0], 0.0]))
    state, on_point = controller.step(state, measurement, point, DT)
    np.testing.assert_allclose(state.reference_twist, twist, atol=1e-12)
    _, on_twist = controller.step(state, measurement, TwistReference(twist), DT)
    # A circle at constant speed has a constant twist: both references ask for the same torque, whole turns of yaw aside.
    np.testing.assert_allclose(on_point.torque, on_twist.torque, atol=1e-9)


def test_refuses_a_robot_without_offset_and_gains_that_are_none():
    if "mpo700" in shipped_robots():
        with pytest.raises(KinematicsError, match="torque control"):
            ComputedTorque(load_robot("mpo700"))
    with pytest.raises(ControlError, match=r"velocity_gain = -1.0 is not allowed; allowed: a finite number, at least 0"):
        ComputedTorqueParameters(velocity_gain=-1.0)
    with pytest.raises(ControlError, match="joint_speed_fraction"):
        ComputedTorqueParameters(joint_speed_fraction=0.0)
