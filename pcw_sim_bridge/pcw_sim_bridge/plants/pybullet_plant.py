"""The robot in PyBullet: rigid bodies by Bullet, everything else by `spatial_plant`."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import numpy as np
import pybullet

from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription
from pcw_description.urdf import robot_urdf

from .plant import PlantError
from .spatial_plant import ANGULAR, LINEAR, POSITION, QUATERNION, SpatialPlant


class PybulletPlant(SpatialPlant):
    """The PyBullet plant of one robot; arguments and errors are those of `SpatialPlant`."""

    def __init__(self, robot: RobotDescription, dt: float = 1e-3, gui: bool = False, lifted: bool = False) -> None:
        super().__init__(BulletEngine, robot, dt, gui, lifted)


class BulletEngine:
    """The bodies of one robot in a Bullet of their own.

    Args:
        robot: the robot as it really is.
        gravity: (3,) [m/s^2].
        dt: step [s].
        gui: show Bullet's window.
        held: the base does not move.

    Raises:
        PlantError: Bullet cannot start.
    """

    def __init__(self, robot: RobotDescription, gravity: FloatArray, dt: float, gui: bool, held: bool) -> None:
        # Where no display is, Bullet would end the process.
        if gui and sys.platform == "linux" and not os.environ.get("DISPLAY"):
            raise PlantError("PyBullet could not start its window; is a display there?")
        self._client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if self._client < 0:
            raise PlantError("PyBullet could not start")
        self.body_rotors = np.array(robot.armature)
        self._load(robot, gravity, dt, held)

    def _load(self, robot: RobotDescription, gravity: FloatArray, dt: float, held: bool) -> None:
        client = self._client
        pybullet.setGravity(*gravity.tolist(), physicsClientId=client)
        pybullet.setTimeStep(dt, physicsClientId=client)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(robot_urdf(robot), encoding="utf-8")
            self._body = pybullet.loadURDF(
                str(path),
                useFixedBase=held,
                flags=pybullet.URDF_USE_INERTIA_FROM_FILE,
                physicsClientId=client,
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

    def place(self, position: FloatArray, quaternion: FloatArray) -> None:
        """Put the base link's centre of mass (3,) [m] somewhere, at rest, turned by a quaternion (x, y, z, w)."""
        pybullet.resetBasePositionAndOrientation(
            self._body, position.tolist(), quaternion.tolist(), physicsClientId=self._client
        )
        self.set_velocity(np.zeros(3), np.zeros(3))

    def put_joints(self, position: FloatArray, velocity: FloatArray) -> None:
        """Give the joints angles and rates (n, 2)."""
        for joint, angle, rate in zip(self._joints, position.ravel().tolist(), velocity.ravel().tolist(), strict=True):
            pybullet.resetJointState(self._body, joint, angle, rate, physicsClientId=self._client)

    def set_velocity(self, linear: FloatArray, angular: FloatArray) -> None:
        """Give the base link's centre of mass velocities (3,) in world axes."""
        pybullet.resetBaseVelocity(self._body, linear.tolist(), angular.tolist(), physicsClientId=self._client)

    def read(self, base: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Fill `base` (BASE_STATE,) and return joint angles and rates (n, 2)."""
        client = self._client
        self._position, base[QUATERNION] = pybullet.getBasePositionAndOrientation(self._body, physicsClientId=client)
        base[POSITION] = self._position
        base[LINEAR], base[ANGULAR] = pybullet.getBaseVelocity(self._body, physicsClientId=client)
        states = pybullet.getJointStates(self._body, self._joints, physicsClientId=client)
        joints = np.array([state[:2] for state in states]).reshape(-1, 2, 2)
        return joints[:, :, 0], joints[:, :, 1]

    def advance(self, wrench: FloatArray, joint_torque: FloatArray) -> None:
        """Make one step under a wrench (6,) at the base link's centre of mass, world axes, and joint torques (n, 2).

        The force acts where `read` last found the centre of mass.
        """
        client = self._client
        pybullet.applyExternalForce(
            self._body, -1, wrench[:3].tolist(), self._position, pybullet.WORLD_FRAME, physicsClientId=client
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

    def close(self) -> None:
        """Disconnect from Bullet; closing twice does nothing."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1
