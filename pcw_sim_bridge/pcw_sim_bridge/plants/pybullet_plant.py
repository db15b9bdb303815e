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

from pcw_description.robot_description import DRIVE, STATIC_DEFLECTION, STEER, FloatArray, RobotDescription
from pcw_description.urdf import robot_urdf

from .caster_arrays import (
    FX,
    FY,
    FZ,
    MOTOR_PHI,
    MOTOR_RHO,
    PHI,
    PHI_DDOT,
    PHI_DOT,
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
from .plant import PlantError, PlantState, gravity_in_base
from .spatial_contact import contact_wrench, rotation_matrix
from .true_robot import as_it_really_is, without_geared_rotors

# Time for the robot to sink into its springs after a reset [s].
SETTLING_TIME = 0.5
# A lifted robot's wheels hang so far above the ground [m].
LIFT = 0.1


class PybulletPlant:
    """The PyBullet plant of one robot; see the module's docstring.

    Args:
        robot: the robot; its `physics` are at work.
        dt: step [s].
        gui: show Bullet's window.
        lifted: the robot stands on a jack, its wheels off the ground.

    Raises:
        PlantError: fewer than three casters, which cannot stand, or Bullet cannot start.
    """

    def __init__(self, robot: RobotDescription, dt: float = 1e-3, gui: bool = False, lifted: bool = False) -> None:
        robot.require_torque_control()
        if robot.n < 3 and not lifted:
            raise PlantError(
                f"{robot.name} has {robot.n} casters; the PyBullet plant needs at least 3 to stand (use the reduced plant)"
            )
        self.robot = robot
        self.dt = dt
        self._lifted = lifted
        true_robot = as_it_really_is(robot)
        # The engine carries the rotors that turn with the joints.
        self._true_robot = without_geared_rotors(true_robot)
        self._effects = EffectTables(true_robot, dt)
        self._client = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if self._client < 0:
            raise PlantError("PyBullet could not start" + (" its window; is a display there?" if gui else ""))
        self._casters = caster_numbers(self._true_robot)
        suspension = true_robot.wheel_suspension
        self._suspension = np.array([suspension.stiffness, suspension.damping])
        self._armature = np.ascontiguousarray(self._true_robot.armature[:, DRIVE, DRIVE])
        self._wheels = np.zeros((robot.n, WHEEL_STATE))
        self._load()
        self.reset()

    def _load(self) -> None:
        client, robot = self._client, self._true_robot
        pybullet.setGravity(*self._effects.gravity.tolist(), physicsClientId=client)
        pybullet.setTimeStep(self.dt, physicsClientId=client)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(robot_urdf(robot), encoding="utf-8")
            self._body = pybullet.loadURDF(
                str(path),
                useFixedBase=self._lifted,
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
        self._com_in_base = np.array(robot.chassis.com)

    def reset(self, pose: FloatArray | None = None, steer_angle: FloatArray | None = None) -> None:
        """Put the robot at rest at a pose (3,), the wheels at headings (n,); time becomes zero."""
        start = np.zeros(3) if pose is None else np.asarray(pose, dtype=float)
        headings = np.zeros(self.robot.n) if steer_angle is None else np.asarray(steer_angle, dtype=float)
        self._wheels[:] = 0.0
        self._acceleration = np.zeros(3)
        self._yaw = float(start[2])
        self._steps = 0
        self._effects.reset()
        if self._lifted:
            self._place(start, headings, height=LIFT, tilt=(0.0, 0.0))
            return
        self._place(start, headings, height=-STATIC_DEFLECTION, tilt=(0.0, 0.0))
        # Let the springs take the load, then put the settled robot exactly where it was asked for.
        for _ in range(round(SETTLING_TIME / self.dt)):
            self._single_step(np.zeros((self.robot.n, 2)))
            self._stop_all_but_sinking(headings)
        position, quaternion = self._base
        roll, pitch, _ = pybullet.getEulerFromQuaternion(quaternion)
        origin = np.array(position) - rotation_matrix(np.array(quaternion)) @ self._com_in_base
        normal_force = self._wheels[:, FZ].copy()
        self._wheels[:] = 0.0
        self._wheels[:, FZ] = normal_force
        self._effects.reset()
        self._place(start, headings, height=float(origin[2]), tilt=(roll, pitch))
        self._wheels[:, RHO_DDOT : PHI_DDOT + 1] = 0.0
        self._acceleration[:] = 0.0
        self._yaw = float(start[2])
        self._steps = 0

    def set_motion(self, twist: FloatArray, joint_position: FloatArray, joint_velocity: FloatArray) -> None:
        """Give the robot a twist (3,) in base_link and its joints angles and rates (n, 2), to go on from there."""
        client = self._client
        for joint, angle, rate in zip(self._joints, joint_position.ravel(), joint_velocity.ravel(), strict=True):
            pybullet.resetJointState(self._body, joint, float(angle), float(rate), physicsClientId=client)
        if not self._lifted:
            rotation = rotation_matrix(np.array(self._base[1]))
            spin = np.array([0.0, 0.0, twist[2]])
            velocity = rotation @ np.array([twist[0], twist[1], 0.0]) + np.cross(spin, rotation @ self._com_in_base)
            pybullet.resetBaseVelocity(self._body, velocity.tolist(), spin.tolist(), physicsClientId=client)
        self._read()
        self._effects.align_motors(joint_position, joint_velocity)

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
        self._put_joints(headings)
        self._read()
        self._effects.align_motors(self._wheels[:, RHO : PHI + 1], self._wheels[:, RHO_DOT : PHI_DOT + 1])

    def _put_joints(self, headings: FloatArray) -> None:
        client = self._client
        for i, heading in enumerate(headings):
            pybullet.resetJointState(self._body, self._joints[2 * i + DRIVE], 0.0, 0.0, physicsClientId=client)
            pybullet.resetJointState(self._body, self._joints[2 * i + STEER], float(heading), 0.0, physicsClientId=client)

    def _stop_all_but_sinking(self, headings: FloatArray) -> None:
        """Let a settling robot neither roll nor slide: on a slope, or on a wheel out of true, it would leave its place."""
        linear, angular = self._velocity
        pybullet.resetBaseVelocity(
            self._body, [0.0, 0.0, linear[2]], [angular[0], angular[1], 0.0], physicsClientId=self._client
        )
        self._put_joints(headings)
        self._read()
        self._wheels[:, ZX : ZY + 1] = 0.0  # nor do the tyres hold it in a tilt

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
        client, effects = self._client, self._effects
        position, quaternion = self._base
        linear, angular = self._velocity
        before = self._wheels[:, RHO_DOT : PHI_DOT + 1].copy()
        wrench, joint_torque = contact_wrench(
            self.dt,
            self._steps * self.dt,
            self._true_robot.chassis.mass,
            self._casters,
            self._suspension,
            self._armature,
            effects.compiled,
            command,
            np.array(position),
            np.array(quaternion),
            np.array(linear),
            np.array(angular),
            self._com_in_base,
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
        self._wheels[:, RHO_DDOT : PHI_DDOT + 1] = (self._wheels[:, RHO_DOT : PHI_DOT + 1] - before) / self.dt
        self._acceleration[0] = (self._velocity[0][0] - linear[0]) / self.dt
        self._acceleration[1] = (self._velocity[0][1] - linear[1]) / self.dt
        self._acceleration[2] = (self._velocity[1][2] - angular[2]) / self.dt
        self._yaw += self.dt * self._velocity[1][2]
        self._steps += 1

    def step(self, motor_torque: FloatArray, steps: int = 1) -> None:
        """Advance by `steps` steps of dt with motor torques (n, 2) [N m] held.

        Raises:
            PlantError: a torque is NaN or infinite; the plant has not moved.
        """
        if not np.isfinite(motor_torque).all():
            raise PlantError("motor_torque holds NaN or infinity; allowed: finite torques in N m")
        for _ in range(steps):
            self._single_step(motor_torque)

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
        joint_position, joint_velocity = wheels[:, RHO : PHI + 1].copy(), wheels[:, RHO_DOT : PHI_DOT + 1].copy()
        motor_position, motor_velocity = self._effects.motor_motion(joint_position, joint_velocity)
        return PlantState(
            time=self._steps * self.dt,
            pose=np.array([origin[0], origin[1], yaw]),
            twist=np.array([*(to_base @ velocity), yaw_rate]),
            acceleration=np.array([*(to_base @ (self._acceleration[:2] + spin)), yaw_acceleration]),
            gravity=gravity_in_base(self._effects.gravity, yaw),
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
        """Disconnect from Bullet; closing twice does nothing."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1
