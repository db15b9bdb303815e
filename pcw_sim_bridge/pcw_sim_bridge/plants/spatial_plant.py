"""A robot in space on suspended wheels: what is the same whichever engine carries its rigid bodies.

No wheel has a collision shape: each stands on a vertical spring and damper, and its tyre acts through
`spatial_contact`. An engine's own contact is not usable for rolling with slip (EQUATIONS section 4).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import STATIC_DEFLECTION, FloatArray, RobotDescription

from .caster_arrays import (
    FX,
    FY,
    FZ,
    MOTOR_PHI,
    MOTOR_RHO,
    PHI,
    PHI_DOT,
    PUSH_X,
    PUSH_Y,
    RHO,
    RHO_DDOT,
    RHO_DOT,
    SLIP_X,
    SLIP_Y,
    WHEEL_STATE,
    ZX,
    ZY,
    caster_numbers,
)
from .effect_tables import EffectTables
from .plant import PlantError, PlantState
from .spatial_contact import contact_mobility, contact_wrench, rotation_matrix
from .true_robot import as_it_really_is, without_geared_rotors

# Time for the robot to sink into its springs after a reset [s].
SETTLING_TIME = 0.5
# A lifted robot's wheels hang so far above the ground [m].
LIFT = 0.1
# Motion of the base link's centre of mass as an engine reports it: position, quaternion (x, y, z, w), velocities; all in
# world axes.
POSITION, QUATERNION, LINEAR, ANGULAR = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)
BASE_STATE = 13
UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])


class Engine(Protocol):
    """The rigid bodies of one robot: chassis, forks and wheels, without any contact.

    Attributes:
        body_rotors: reflected rotors that its bodies carry where the definition has them on the joints (n, 2, 2)
            [kg m^2]; `contact_wrench` sets that right.
    """

    body_rotors: FloatArray

    def place(self, position: FloatArray, quaternion: FloatArray) -> None:
        """Put the base link's centre of mass (3,) [m] somewhere, at rest, turned by a quaternion (x, y, z, w)."""

    def put_joints(self, position: FloatArray, velocity: FloatArray) -> None:
        """Give the joints angles and rates (n, 2)."""

    def set_velocity(self, linear: FloatArray, angular: FloatArray) -> None:
        """Give the base link's centre of mass velocities (3,) in world axes; never called on a lifted robot."""

    def read(self, base: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fill `base` (BASE_STATE,) and return joint angles and rates (n, 2)."""

    def advance(self, wrench: FloatArray, joint_torque: FloatArray) -> None:
        """Make one step under a wrench (6,) at the base link's centre of mass, world axes, and joint torques (n, 2)."""

    def close(self) -> None:
        """Free what the engine holds; closing twice does nothing."""


# Makes an engine of a robot, with gravity (3,), step dt, whether it shows a window and whether the base is held.
EngineMaker = Callable[[RobotDescription, FloatArray, float, bool, bool], Engine]


def turned(quaternion: FloatArray, angle: float) -> FloatArray:
    """Return an attitude (x, y, z, w) turned about the world's vertical by an angle [rad]."""
    c, s = math.cos(0.5 * angle), math.sin(0.5 * angle)
    x, y, z, w = quaternion
    return np.array([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z])


def heading_of(rotation: FloatArray) -> float:
    """Return the yaw [rad] of a rotation matrix (3, 3), between -pi and pi."""
    return math.atan2(rotation[1, 0], rotation[0, 0])


@compiled
def _take_accelerations(  # type: ignore[no-untyped-def]
    dt, trust, before, base, rates_before, wheels, acceleration, angular_acceleration
):
    """Fill the accelerations of a step from the velocities around it; those that go on to the next one are smoothed."""
    for k in range(6):
        acceleration[k] = (base[7 + k] - before[7 + k]) / dt
    for k in range(3):
        angular_acceleration[k] += trust * (acceleration[3 + k] - angular_acceleration[k])
    for i in range(len(wheels)):
        for k in range(2):
            found = (wheels[i, RHO_DOT + k] - rates_before[i, k]) / dt
            wheels[i, RHO_DDOT + k] += trust * (found - wheels[i, RHO_DDOT + k])


@compiled
def _seen_from_above(base, acceleration, com_in_base, gravity, turned_yaw):  # type: ignore[no-untyped-def]
    """Return the yaw [rad], continuous, and in rows (6, 3) pose, twist, acceleration, gravity and swing of a `PlantState`."""
    rotation = rotation_matrix(base[3:7])
    arm = np.empty(3)
    for k in range(3):
        arm[k] = -(rotation[k, 0] * com_in_base[0] + rotation[k, 1] * com_in_base[1] + rotation[k, 2] * com_in_base[2])
    roll_rate, pitch_rate, yaw_rate = base[10], base[11], base[12]
    velocity_x = base[7] + pitch_rate * arm[2] - yaw_rate * arm[1]
    velocity_y = base[8] + yaw_rate * arm[0] - roll_rate * arm[2]
    heading = math.atan2(rotation[1, 0], rotation[0, 0])
    # The engine's yaw is wrapped; the integrated rate says which turn it is.
    yaw = heading + 2.0 * math.pi * round((turned_yaw - heading) / (2.0 * math.pi))
    c, s = math.cos(yaw), math.sin(yaw)
    acceleration_x = acceleration[0] + acceleration[4] * arm[2] - acceleration[5] * arm[1] - yaw_rate * yaw_rate * arm[0]
    acceleration_y = acceleration[1] + acceleration[5] * arm[0] - acceleration[3] * arm[2] - yaw_rate * yaw_rate * arm[1]
    truth = np.zeros((6, 3))
    truth[0, 0], truth[0, 1], truth[0, 2] = base[0] + arm[0], base[1] + arm[1], yaw
    truth[1, 0], truth[1, 1], truth[1, 2] = c * velocity_x + s * velocity_y, c * velocity_y - s * velocity_x, yaw_rate
    truth[2, 0], truth[2, 1] = c * acceleration_x + s * acceleration_y, c * acceleration_y - s * acceleration_x
    truth[2, 2] = acceleration[5]
    for k in range(3):
        truth[3, k] = rotation[0, k] * gravity[0] + rotation[1, k] * gravity[1] + rotation[2, k] * gravity[2]
    truth[4, 0], truth[4, 1] = c * roll_rate + s * pitch_rate, c * pitch_rate - s * roll_rate
    truth[5, 0], truth[5, 1] = c * acceleration[3] + s * acceleration[4], c * acceleration[4] - s * acceleration[3]
    return yaw, truth


class SpatialPlant:
    """The plant of one robot in one engine; see the module's docstring.

    Args:
        make_engine: the engine.
        robot: the robot; its `physics` are at work.
        dt: step [s].
        gui: show the engine's window.
        lifted: the robot stands on a jack, its wheels off the ground.

    Raises:
        PlantError: fewer than three casters, which cannot stand, or the engine cannot start.
    """

    def __init__(
        self, make_engine: EngineMaker, robot: RobotDescription, dt: float = 1e-3, gui: bool = False, lifted: bool = False
    ) -> None:
        robot.require_torque_control()
        if robot.n < 3 and not lifted:
            raise PlantError(
                f"{robot.name} has {robot.n} casters; a plant in space needs at least 3 to stand (use the reduced plant)"
            )
        self.robot = robot
        self.dt = dt
        self._lifted = lifted
        true_robot = as_it_really_is(robot)
        # The engine carries the rotors that turn with the joints.
        bodies = without_geared_rotors(true_robot)
        self._effects = EffectTables(true_robot, dt)
        self._casters = caster_numbers(bodies)
        self._mobility = contact_mobility(bodies)
        suspension = true_robot.wheel_suspension
        self._suspension = np.array([suspension.stiffness, suspension.damping])
        self._chassis_mass = bodies.chassis.mass
        self._com_in_base = np.array(bodies.chassis.com)
        self._wheels = np.zeros((robot.n, WHEEL_STATE))
        self._base = np.zeros(BASE_STATE)
        self._engine = make_engine(bodies, self._effects.gravity, dt, gui, lifted)
        # Rotors in the bodies are set right with accelerations that are a step old. From step to step that is a loop with
        # eigenvalues 1 - q, where q + 1 / q = 2 + J / I for rotors J in a chassis I: beyond J = I / 2 it swings up. Taking
        # over only a part below 2 / (2 + J / I) of each new acceleration, it settles.
        rotors = float(np.trace(self._engine.body_rotors.sum(axis=0)))
        self._trust = 1.0 / (1.0 + rotors / min(bodies.chassis.principal_inertias()))
        self.reset()

    def reset(self, pose: FloatArray | None = None, steer_angle: FloatArray | None = None) -> None:
        """Put the robot at rest at a pose (3,), the wheels at headings (n,); time becomes zero."""
        start = np.zeros(3) if pose is None else np.asarray(pose, dtype=float)
        joints = np.zeros((self.robot.n, 2))
        if steer_angle is not None:
            joints[:, PHI - RHO] = steer_angle
        self._wheels[:] = 0.0
        self._acceleration, self._acceleration_before, self._angular_acceleration = np.zeros(6), np.zeros(6), np.zeros(3)
        self._yaw = float(start[2])
        self._steps = 0
        self._effects.reset()
        upright = turned(UPRIGHT, start[2])
        if self._lifted:
            self._place(start, LIFT, upright, joints)
            return
        self._place(start, -STATIC_DEFLECTION, upright, joints)
        # Let the springs take the load, then put the settled robot exactly where it was asked for.
        for _ in range(round(SETTLING_TIME / self.dt)):
            self._single_step(np.zeros((self.robot.n, 2)))
            self._stop_all_but_sinking(joints)
        attitude = self._base[QUATERNION].copy()
        rotation = rotation_matrix(attitude)
        height = float(self._base[2] - rotation[2] @ self._com_in_base)
        normal_force = self._wheels[:, FZ].copy()
        self._wheels[:] = 0.0
        self._wheels[:, FZ] = normal_force
        self._effects.reset()
        self._place(start, height, turned(attitude, start[2] - heading_of(rotation)), joints)
        self._acceleration[:] = self._acceleration_before[:] = 0.0
        self._angular_acceleration[:] = 0.0
        self._yaw = float(start[2])
        self._steps = 0

    def set_motion(self, twist: FloatArray, joint_position: FloatArray, joint_velocity: FloatArray) -> None:
        """Give the robot a twist (3,) in base_link and its joints angles and rates (n, 2), to go on from there."""
        self._engine.put_joints(joint_position, joint_velocity)
        if not self._lifted:
            rotation = rotation_matrix(self._base[QUATERNION])
            spin = np.array([0.0, 0.0, twist[2]])
            velocity = rotation @ np.array([twist[0], twist[1], 0.0]) + np.cross(spin, rotation @ self._com_in_base)
            self._engine.set_velocity(velocity, spin)
        self._read_as_put()
        self._effects.align_motors(joint_position, joint_velocity)

    def _place(self, pose: FloatArray, height: float, attitude: FloatArray, joints: FloatArray) -> None:
        origin = np.array([pose[0], pose[1], height])
        self._engine.place(origin + rotation_matrix(attitude) @ self._com_in_base, attitude)
        self._engine.put_joints(joints, np.zeros_like(joints))
        self._read_as_put()
        self._effects.align_motors(self._wheels[:, RHO : PHI + 1], self._wheels[:, RHO_DOT : PHI_DOT + 1])

    def _stop_all_but_sinking(self, joints: FloatArray) -> None:
        """Let a settling robot neither roll nor slide: on a slope, or on a wheel out of true, it would leave its place."""
        _, _, sinking, roll_rate, pitch_rate, _ = self._base[7:]
        self._engine.set_velocity(np.array([0.0, 0.0, sinking]), np.array([roll_rate, pitch_rate, 0.0]))
        self._engine.put_joints(joints, np.zeros_like(joints))
        self._read_as_put()
        self._wheels[:, ZX : ZY + 1] = 0.0  # nor do the tyres hold it in a tilt

    def _read(self) -> None:
        """Read the engine's state once; a step and the truth both use it."""
        angle, rate = self._engine.read(self._base)
        self._wheels[:, RHO : PHI + 1] = angle
        self._wheels[:, RHO_DOT : PHI_DOT + 1] = rate

    def _read_as_put(self) -> None:
        """Read the state of joints that were just put so, whatever pushed them before."""
        self._read()
        self._wheels[:, PUSH_X : PUSH_Y + 1] = np.nan

    def _single_step(self, command: FloatArray) -> None:
        self._acceleration_before[:] = self._acceleration
        before, rates_before = self._base.copy(), self._wheels[:, RHO_DOT : PHI_DOT + 1].copy()
        wrench, joint_torque = contact_wrench(
            self.dt,
            self._steps * self.dt,
            self._chassis_mass,
            self._casters,
            self._mobility,
            self._suspension,
            self._engine.body_rotors,
            self._effects.compiled,
            command,
            before[POSITION],
            before[QUATERNION],
            before[LINEAR],
            before[ANGULAR],
            self._com_in_base,
            self._angular_acceleration,
            self._wheels,
        )
        self._engine.advance(wrench, joint_torque)
        self._read()
        _take_accelerations(
            self.dt,
            self._trust,
            before,
            self._base,
            rates_before,
            self._wheels,
            self._acceleration,
            self._angular_acceleration,
        )
        self._yaw += self.dt * self._base[12]
        self._steps += 1

    def step(self, motor_torque: FloatArray, steps: int = 1) -> None:
        """Advance by `steps` steps of dt with motor torques (n, 2) [N m] held.

        Raises:
            PlantError: a torque is NaN or infinite, and the plant has not moved; or its state has left all bounds, and only
                `reset` brings it back.
        """
        if not np.isfinite(motor_torque).all():
            raise PlantError("motor_torque holds NaN or infinity; allowed: finite torques in N m")
        for _ in range(steps):
            self._single_step(motor_torque)
        if not (np.isfinite(self._base).all() and np.isfinite(self._wheels[:, :PUSH_X]).all()):
            raise PlantError(f"the plant's state is not finite at {self._steps * self.dt:.3f} s")

    def state(self) -> PlantState:
        """Return the truth now; the pose is that of base_link's origin, seen from above."""
        acceleration = 0.5 * (self._acceleration + self._acceleration_before)
        self._yaw, truth = _seen_from_above(self._base, acceleration, self._com_in_base, self._effects.gravity, self._yaw)
        wheels = self._wheels
        joint_position, joint_velocity = wheels[:, RHO : PHI + 1].copy(), wheels[:, RHO_DOT : PHI_DOT + 1].copy()
        motor_position, motor_velocity = self._effects.motor_motion(joint_position, joint_velocity)
        return PlantState(
            time=self._steps * self.dt,
            pose=truth[0],
            twist=truth[1],
            acceleration=truth[2],
            gravity=truth[3],
            swing_rate=truth[4, :2],
            swing_acceleration=truth[5, :2],
            joint_position=joint_position,
            joint_velocity=joint_velocity,
            motor_position=motor_position,
            motor_velocity=motor_velocity,
            motor_torque=wheels[:, MOTOR_RHO : MOTOR_PHI + 1].copy(),
            slip=wheels[:, SLIP_X : SLIP_Y + 1].copy(),
            contact_force=wheels[:, FX : FY + 1].copy(),
            normal_force=wheels[:, FZ].copy(),
        )

    def close(self) -> None:
        """Free what the engine holds; closing twice does nothing."""
        self._engine.close()
