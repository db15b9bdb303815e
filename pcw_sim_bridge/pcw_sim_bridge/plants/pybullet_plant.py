"""The robot in PyBullet: rigid bodies in space on suspended wheels, tyre forces by the shared contact model.

No wheel has a collision shape: each stands on a vertical spring and damper, and its tyre acts through
`spatial_contact`. Bullet's own contact is not usable for rolling with slip (EQUATIONS section 4).
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np
import pybullet

from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription
from pcw_description.urdf import robot_urdf

from .caster_arrays import (
    FX,
    FY,
    FZ,
    MOTOR_PHI,
    MOTOR_RHO,
    PHI,
    PHI_DOT,
    RHO,
    RHO_DOT,
    SLIP_X,
    SLIP_Y,
    WHEEL_STATE,
    caster_numbers,
)
from .joint_effects import JointEffects
from .nominal_changes import as_it_really_is
from .plant import PlantError, PlantState
from .reduced import GRAVITY
from .spatial_contact import contact_wrench, rotation_matrix

# Static deflection of the suspension [m] and its damping ratio: stiff enough to follow the load, soft for the step.
STATIC_DEFLECTION = 1.5e-3
DAMPING_RATIO = 0.4
# Time for the robot to sink into its springs after a reset [s].
SETTLING_TIME = 0.5


class PybulletPlant:
    """The PyBullet plant of one robot; see the module's docstring.

    Args:
        robot: the robot; its `physics` are at work.
        dt: step [s].
        gui: show Bullet's window.

    Raises:
        PlantError: fewer than three casters, which cannot stand, or Bullet cannot start.
    """

    def __init__(self, robot: RobotDescription, dt: float = 1e-3, gui: bool = False) -> None:
        robot.require_torque_control()
        if robot.n < 3:
            raise PlantError(
                f"{robot.name} has {robot.n} casters; the PyBullet plant needs at least 3 to stand (use the reduced plant)"
            )
        self.robot = robot
        self.dt = dt
        self._true_robot = as_it_really_is(robot)
        self._client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if self._client < 0:
            raise PlantError("PyBullet could not start" + (" its window; is a display there?" if gui else ""))
        self._casters = caster_numbers(self._true_robot)
        self._effects = JointEffects(robot)
        wheel_load = self._true_robot.total_mass / robot.n
        stiffness = wheel_load * GRAVITY / STATIC_DEFLECTION
        self._suspension = np.array([stiffness, 2.0 * DAMPING_RATIO * math.sqrt(stiffness * wheel_load)])
        self._armature = np.ascontiguousarray(self._true_robot.armature[:, DRIVE, DRIVE])
        self._wheels = np.zeros((robot.n, WHEEL_STATE))
        self._load()
        self.reset()

    def _load(self) -> None:
        client, robot = self._client, self._true_robot
        pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
        pybullet.setTimeStep(self.dt, physicsClientId=client)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(robot_urdf(robot), encoding="utf-8")
            self._body = pybullet.loadURDF(
                str(path), flags=pybullet.URDF_USE_INERTIA_FROM_FILE, physicsClientId=client
            )
        indices = {}
        for index in range(pybullet.getNumJoints(self._body, physicsClientId=client)):
            indices[pybullet.getJointInfo(self._body, index, physicsClientId=client)[1].decode()] = index
        self._joints = [indices[name] for name in robot.joint_names]
        # Bullet's own damping, speed limit and holding motors are not physics of this robot.
        for link in range(-1, len(indices)):
            pybullet.changeDynamics(
                self._body,
                link,
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                maxJointVelocity=1e4,
                physicsClientId=client,
            )
        pybullet.setJointMotorControlArray(
            self._body,
            self._joints,
            pybullet.VELOCITY_CONTROL,
            forces=[0.0] * len(self._joints),
            physicsClientId=client,
        )
        # Reflected rotors: a URDF may not hold them, because no rigid body has such inertias.
        for i in range(robot.n):
            for link, component, inertia in (
                (self._joints[2 * i + DRIVE], 1, robot.armature[i, DRIVE, DRIVE]),
                (self._joints[2 * i + STEER], 2, robot.armature[i, STEER, STEER]),
            ):
                diagonal = list(pybullet.getDynamicsInfo(self._body, link, physicsClientId=client)[2])
                diagonal[component] += inertia
                pybullet.changeDynamics(
                    self._body, link, localInertiaDiagonal=diagonal, physicsClientId=client
                )
        self._com_in_base = np.array(robot.chassis.com)

    def reset(self, pose: FloatArray | None = None, steer_angle: FloatArray | None = None) -> None:
        """Put the robot at rest at a pose (3,), the wheels at headings (n,); time becomes zero."""
        start = np.zeros(3) if pose is None else np.asarray(pose, dtype=float)
        headings = np.zeros(self.robot.n) if steer_angle is None else np.asarray(steer_angle, dtype=float)
        self._wheels[:] = 0.0
        self._joint_acceleration = np.zeros((self.robot.n, 2))
        self._acceleration = np.zeros(3)
        self._yaw = float(start[2])
        self._place(start, headings, height=-STATIC_DEFLECTION, tilt=(0.0, 0.0))
        # Let the springs take the load, then put the settled robot exactly where it was asked for.
        for _ in range(round(SETTLING_TIME / self.dt)):
            self._single_step(np.zeros((self.robot.n, 2)))
        position, quaternion = self._base
        roll, pitch, _ = pybullet.getEulerFromQuaternion(quaternion)
        origin = np.array(position) - rotation_matrix(np.array(quaternion)) @ self._com_in_base
        normal_force = self._wheels[:, FZ].copy()
        self._wheels[:] = 0.0
        self._wheels[:, FZ] = normal_force
        self._place(start, headings, height=float(origin[2]), tilt=(roll, pitch))
        self._joint_acceleration[:] = 0.0
        self._acceleration[:] = 0.0
        self._yaw = float(start[2])
        self._time = 0.0

    def _place(
        self, pose: FloatArray, headings: FloatArray, height: float, tilt: tuple[float, float]
    ) -> None:
        client = self._client
        quaternion = pybullet.getQuaternionFromEuler([tilt[0], tilt[1], float(pose[2])])
        origin = np.array([pose[0], pose[1], height])
        position = origin + rotation_matrix(np.array(quaternion)) @ self._com_in_base
        pybullet.resetBasePositionAndOrientation(
            self._body, position.tolist(), quaternion, physicsClientId=client
        )
        pybullet.resetBaseVelocity(self._body, [0.0] * 3, [0.0] * 3, physicsClientId=client)
        for i, heading in enumerate(headings):
            pybullet.resetJointState(
                self._body, self._joints[2 * i + DRIVE], 0.0, 0.0, physicsClientId=client
            )
            pybullet.resetJointState(
                self._body, self._joints[2 * i + STEER], float(heading), 0.0, physicsClientId=client
            )
        self._read()

    def _read(self) -> None:
        """Read the engine's state once; a step and the truth both use it."""
        client = self._client
        self._base = pybullet.getBasePositionAndOrientation(self._body, physicsClientId=client)
        self._velocity = pybullet.getBaseVelocity(self._body, physicsClientId=client)
        states = pybullet.getJointStates(self._body, self._joints, physicsClientId=client)
        joints = np.array([state[:2] for state in states]).reshape(-1, 2, 2)
        self._wheels[:, RHO : PHI + 1] = joints[:, :, 0]
        self._wheels[:, RHO_DOT : PHI_DOT + 1] = joints[:, :, 1]

    def _single_step(self, command: FloatArray) -> None:
        client = self._client
        position, quaternion = self._base
        linear, angular = self._velocity
        before = self._wheels[:, RHO_DOT : PHI_DOT + 1].copy()
        wrench, joint_torque = contact_wrench(
            self.dt,
            self._casters,
            self._effects.kernels,
            self._effects.place,
            self._effects.numbers,
            self._suspension,
            self._armature,
            command,
            np.array(quaternion),
            np.array(position),
            np.array(linear),
            np.array(angular),
            self._com_in_base,
            self._joint_acceleration,
            self._acceleration[2],
            self._wheels,
        )
        pybullet.applyExternalForce(
            self._body, -1, wrench[:3].tolist(), position, pybullet.WORLD_FRAME, physicsClientId=client
        )
        pybullet.applyExternalTorque(
            self._body, -1, wrench[3:].tolist(), pybullet.WORLD_FRAME, physicsClientId=client
        )
        pybullet.setJointMotorControlArray(
            self._body,
            self._joints,
            pybullet.TORQUE_CONTROL,
            forces=joint_torque.ravel().tolist(),
            physicsClientId=client,
        )
        pybullet.stepSimulation(physicsClientId=client)
        self._read()
        self._joint_acceleration = (self._wheels[:, RHO_DOT : PHI_DOT + 1] - before) / self.dt
        self._acceleration[0] = (self._velocity[0][0] - linear[0]) / self.dt
        self._acceleration[1] = (self._velocity[0][1] - linear[1]) / self.dt
        self._acceleration[2] = (self._velocity[1][2] - angular[2]) / self.dt
        self._yaw += self.dt * self._velocity[1][2]

    def step(self, motor_torque: FloatArray, steps: int = 1) -> None:
        """Advance by `steps` steps of dt with motor torques (n, 2) [N m] held.

        Raises:
            PlantError: a torque is NaN or infinite; the plant has not moved.
        """
        if not np.isfinite(motor_torque).all():
            raise PlantError("motor_torque holds NaN or infinity; allowed: finite torques in N m")
        for _ in range(steps):
            self._single_step(motor_torque)
        self._time += steps * self.dt

    def state(self) -> PlantState:
        """Return the truth now; the pose is that of base_link's origin, seen from above."""
        position, quaternion = self._base
        linear, angular = self._velocity
        rotation = rotation_matrix(np.array(quaternion))
        arm = -rotation @ self._com_in_base
        origin = np.array(position) + arm
        # Of linear + angular x arm the horizontal part; np.cross is slow on single vectors.
        velocity = np.array(
            [linear[0] + angular[1] * arm[2] - angular[2] * arm[1], linear[1] + angular[2] * arm[0] - angular[0] * arm[2]]
        )
        heading = math.atan2(rotation[1, 0], rotation[0, 0])
        # The engine's yaw is wrapped; the integrated rate says which turn it is.
        yaw = heading + 2.0 * math.pi * round((self._yaw - heading) / (2.0 * math.pi))
        self._yaw = yaw
        c, s = math.cos(yaw), math.sin(yaw)
        to_base = np.array([[c, s], [-s, c]])
        yaw_acceleration, yaw_rate = self._acceleration[2], angular[2]
        spin = np.array(
            [
                -yaw_acceleration * arm[1] - yaw_rate**2 * arm[0],
                yaw_acceleration * arm[0] - yaw_rate**2 * arm[1],
            ]
        )
        wheels = self._wheels
        return PlantState(
            time=self._time,
            pose=np.array([origin[0], origin[1], yaw]),
            twist=np.array([*(to_base @ velocity), yaw_rate]),
            acceleration=np.array([*(to_base @ (self._acceleration[:2] + spin)), yaw_acceleration]),
            joint_position=wheels[:, RHO : PHI + 1].copy(),
            joint_velocity=wheels[:, RHO_DOT : PHI_DOT + 1].copy(),
            motor_torque=wheels[:, MOTOR_RHO : MOTOR_PHI + 1].copy(),
            slip=wheels[:, SLIP_X : SLIP_Y + 1].copy(),
            contact_force=wheels[:, FX : FY + 1].copy(),
            normal_force=wheels[:, FZ].copy(),
        )

    def close(self) -> None:
        """Disconnect from Bullet; closing twice does nothing."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1
