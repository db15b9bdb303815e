"""What torques on the joints add to a robot's channels, linear in the torques and without running the model again.

Along one motion, with tau (T, n, 2) and the tyres' curves straight about the slips there are:

    dF = G tau,  d lambda = S dF,  d eps = |V_w| (1 - T D) d lambda + L D (1 - T D) d lambda,  dV = -A^+ d eps

D being the time derivative and T the tyre's damping time. Thousands of torques that nobody has a name for can be tried so.
"""

from __future__ import annotations

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import LENGTH
from pcw_description.differential_kinematics import rigid_motion_kernel, wheel_jacobian_kernel
from pcw_description.robot_description import DRIVE, STEER

from ..regression.regression_problem import FloatArray
from ..regression.signal_filter import derivative
from .robot_motion import RobotMotion
from .rolling_model import (
    ChannelLayout,
    ModelNumbers,
    RollingState,
    StraightTyres,
    WheelMotion,
    inertial_wrench,
    loading,
)


class TorqueResponse:
    """The response of the channels along one motion."""

    def __init__(
        self,
        motion: RobotMotion,
        numbers: ModelNumbers,
        layout: ChannelLayout,
        state: RollingState,
        straight: StraightTyres,
    ) -> None:
        """Linearise.

        Args:
            motion: a true motion.
            numbers: of the model.
            layout: which channels there are.
            state: how the wheels roll along the motion; straight: its tyres.
        """
        self.layout = layout
        count, n = state.force.shape[:2]
        wheels = state.wheels
        # Forces in the wheel frames per joint torque (T, n, 2, 2).
        of_torque = np.zeros((count, n, 2, 2))
        offset_x, offset_y = wheels.offset[:, :, 0], wheels.offset[:, :, 1]
        of_torque[:, :, 0, DRIVE] = 1.0 / numbers.radius
        of_torque[:, :, 1, DRIVE] = offset_y / offset_x / numbers.radius
        of_torque[:, :, 1, STEER] = -1.0 / offset_x
        self._ratio_of_torque = (numbers.softness[:, :, None] * straight.of_force) @ of_torque
        self._rate, self._length, self._damping_time = motion.rate, numbers.tyres[:n, LENGTH], numbers.damping_time
        # A growing load takes up relaxed slip as rolling does.
        taken_up = wheels.speed[:, :n] + loading(wheels.normal[:, :n], motion.rate) * self._length
        self._speed = taken_up[:, :, None, None]
        jacobian, self._rigid = _rigid_maps(numbers.steer_axis, wheels.offset, wheels.steer_angle)
        wrench_of_force = jacobian.transpose(0, 2, 1).reshape(count, 3, n, 2)
        self._wrench_of_torque = np.einsum("tcnf,tnfj->tcnj", wrench_of_force, of_torque).reshape(count, 3, 2 * n)
        self._inertia, self._turning = _inertia_slopes(numbers, motion, wheels)
        self._imu_position, self._twist = numbers.imu_position, wheels.twist
        self._imu_scale = np.array([numbers.gyro_scale, *numbers.accelerometer_scale])

    @property
    def wrench_of_torque(self) -> FloatArray:
        """What torques on the joints add to force and moment (T, 3, n, 2)."""
        count, _, joints = self._wrench_of_torque.shape
        return self._wrench_of_torque.reshape(count, 3, joints // 2, 2)

    def apply(self, torque: FloatArray) -> FloatArray:
        """Return what torques (T, n, 2, K) [N m] change in measured minus predicted channels (T, C, K)."""
        count, _, _, width = torque.shape
        layout = self.layout
        # Most torques are those of one joint: what does nothing at the other casters need not be computed there.
        casters = np.flatnonzero(torque.any(axis=(0, 2, 3)))
        if not len(casters):
            return np.zeros((count, layout.tracked.stop, width))
        columns = (2 * casters[:, None] + [0, 1]).ravel()
        torque = np.ascontiguousarray(torque[:, casters])
        ratio_of_torque = self._ratio_of_torque[:, casters].reshape(-1, 2, 2)
        ratio = _products(ratio_of_torque, torque.reshape(-1, 2, width)).reshape(torque.shape)
        ratio -= self._damping_time * derivative(ratio, self._rate)
        slip = self._speed[:, casters] * ratio + self._length[casters, None, None] * derivative(ratio, self._rate)
        rigid = _products(np.ascontiguousarray(self._rigid[:, :, columns]), slip.reshape(count, len(columns), width))
        twist, contradiction = -rigid[:, :3], rigid[:, 3:]
        twist_dot = derivative(twist, self._rate)
        found = np.empty((count, layout.tracked.stop, width))
        found[:, :3] = _products(
            np.ascontiguousarray(self._wrench_of_torque[:, :, columns]), torque.reshape(count, len(columns), width)
        )
        found[:, :3] -= _products(self._inertia, twist_dot) + _products(self._turning, twist)
        found[:, layout.consistency] = -contradiction
        if layout.imu:
            (x, y), omega = self._imu_position, self._twist[:, 2, None]
            start = layout.inertial.start
            vx, vy = self._twist[:, 0, None], self._twist[:, 1, None]
            dvx, dvy, domega = twist[:, 0], twist[:, 1], twist[:, 2]
            found[:, start] = -self._imu_scale[0] * domega
            found[:, start + 1] = -self._imu_scale[1] * (
                twist_dot[:, 0] - omega * dvy - domega * vy - twist_dot[:, 2] * y - 2.0 * omega * domega * x
            )
            found[:, start + 2] = -self._imu_scale[2] * (
                twist_dot[:, 1] + omega * dvx + domega * vx + twist_dot[:, 2] * x - 2.0 * omega * domega * y
            )
        if layout.pose:
            found[:, layout.tracked] = -twist
        return found


@compiled
def _products(matrices, vectors):  # type: ignore[no-untyped-def]
    """Matrices (T, A, B) times vectors (T, B, K), (T, A, K): for matrices as small as these BLAS is slow."""
    found = np.zeros((matrices.shape[0], matrices.shape[1], vectors.shape[2]))
    for t in range(matrices.shape[0]):
        for a in range(matrices.shape[1]):
            for b in range(matrices.shape[2]):
                for k in range(vectors.shape[2]):
                    found[t, a, k] += matrices[t, a, b] * vectors[t, b, k]
    return found


@compiled
def _rigid_maps(steer_axis, offset, steer_angle):  # type: ignore[no-untyped-def]
    """Jacobian A (T, 2n, 3), and the map of slips to twist A^+ and contradiction 1 - A A^+, (T, 2n + 3, 2n)."""
    count, n = steer_angle.shape
    jacobians = np.empty((count, 2 * n, 3))
    maps = np.empty((count, 2 * n + 3, 2 * n))
    unit = np.zeros((n, 2))
    for t in range(count):
        jacobians[t] = wheel_jacobian_kernel(steer_axis, offset[t], steer_angle[t])
        for k in range(2 * n):
            unit[k // 2, k % 2] = 1.0
            twist, contradiction, _ = rigid_motion_kernel(steer_axis, offset[t], steer_angle[t], unit)
            unit[k // 2, k % 2] = 0.0
            maps[t, :3, k] = twist
            for i in range(n):
                maps[t, 3 + 2 * i, k] = contradiction[i, 0]
                maps[t, 4 + 2 * i, k] = contradiction[i, 1]
    return jacobians, maps


def _inertia_slopes(numbers: ModelNumbers, motion: RobotMotion, wheels: WheelMotion) -> tuple[FloatArray, FloatArray]:
    """Slopes of the inertial wrench over the twist's derivative and over the twist, (T, 3, 3) each."""
    direction, twist, twist_dot = wheels.direction, wheels.twist, wheels.twist_dot
    plain = inertial_wrench(numbers, motion, direction, twist, twist_dot)
    inertia, turning = np.empty((len(twist), 3, 3)), np.empty((len(twist), 3, 3))
    step = 1e-3
    for k in range(3):
        change = np.zeros(3)
        change[k] = step
        inertia[:, :, k] = (inertial_wrench(numbers, motion, direction, twist, twist_dot + change) - plain) / step
        turning[:, :, k] = (inertial_wrench(numbers, motion, direction, twist + change, twist_dot) - plain) / step
    return inertia, turning
