"""The channels of a robot on powered casters: what its encoders, motors and inertial sensor say that the model does not.

    chassis_force/x|y, chassis_torque/z    H[A^T F] - H[m a of chassis and modules]        motors against motion
    gyro                                   H[omega_imu] - H[omega]
    accelerometer/x|y                      H[a_imu] - H[acceleration at the sensor]

with H the same filter on both sides. Each joint's own balance gives the force at its contact,

    r F_x = tau_rho - I_rho rho_ddot - J_rp phi_ddot
    b_x F_y - b_y F_x = m c x a_c + I sigma_dot + J_pp phi_ddot + J_rp rho_ddot - tau_phi

and the tyre under that force slips: eps = |V_w| lambda(F) + L d lambda / dt, the relaxed slip solved for eps. The robot's
twist is the wheels' without it, V = A^+ (B q_dot - eps). Left out, this slip would pass for a missing force of a tenth of
the whole, growing with frequency; the channels end well below the resonance of the robot on its tyres.

Every number of the description that a healthy robot may differ in is a nuisance column, by differences of the whole
model; so is every effect. Robots whose wheels have no offset along their heading (b_x = 0) have no torque balance here.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from pcw_description.augmented_object_model import dynamic_parameters
from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import forward_kinematics_kernel
from pcw_description.robot_description import DRIVE, GRAVITY, STEER, RobotDescription

from ..plants.support_forces import support_forces
from .regression_problem import FloatArray
from .robot_motion import RobotMotion
from .signal_filter import derivative


@dataclasses.dataclass
class ModelNumbers:
    """All numbers of the channel model, as arrays to be varied.

    Attributes:
        chassis: (4,) as in `dynamic_parameters`; modules: (n, 9) likewise; com_height: [m].
        steer_axis, caster_offset, radius: geometry (n, 2), (n, 2), (n,).
        steer_zero: error of the measured headings (n,) [rad].
        gain: true over reported motor torque (n, 2).
        imu_position: (2,) [m]; gyro_bias [rad/s]; gyro_scale; accelerometer_bias: (2,) [m/s^2].
        slip: slip at the contact per nominal slip of the tyre.
        critical_slip, peak_friction, relaxation_length: of the nominal tyre.
        torque_lag: how long before its stamp a reported torque acted, relative to the position beside it [s].
    """

    chassis: FloatArray
    modules: FloatArray
    com_height: float
    steer_axis: FloatArray
    caster_offset: FloatArray
    radius: FloatArray
    steer_zero: FloatArray
    gain: FloatArray
    imu_position: FloatArray
    gyro_bias: float
    gyro_scale: float
    accelerometer_bias: FloatArray
    slip: float
    critical_slip: float
    peak_friction: float
    relaxation_length: float
    torque_lag: float

    @classmethod
    def of(cls, robot: RobotDescription) -> ModelNumbers:
        """Take the numbers of a description."""
        chassis, modules = dynamic_parameters(robot)
        imu = robot.sensors.imu
        return cls(
            chassis=chassis,
            modules=modules,
            com_height=robot.chassis.com[2],
            steer_axis=robot.steer_axis.copy(),
            caster_offset=robot.caster_offset.copy(),
            radius=robot.wheel_radius.copy(),
            steer_zero=np.zeros(robot.n),
            gain=np.ones((robot.n, 2)),
            imu_position=np.array(imu.position[:2]) if imu else np.zeros(2),
            gyro_bias=0.0,
            gyro_scale=1.0,
            accelerometer_bias=np.zeros(2),
            slip=1.0,
            critical_slip=robot.contact.lambda_p,
            peak_friction=robot.contact.mu_p,
            relaxation_length=robot.contact.relaxation_length,
            torque_lag=0.0,
        )


@compiled
def twists(steer_axis, caster_offset, radius, steer_angle, velocity):  # type: ignore[no-untyped-def]
    """Wheels' twist (T, 3) and largest consistency slip (T,) of joint motion (T, n), (T, n, 2)."""
    count = len(steer_angle)
    twist = np.empty((count, 3))
    slip = np.empty(count)
    for t in range(count):
        twist[t], residual, _ = forward_kinematics_kernel(
            steer_axis, caster_offset, radius, steer_angle[t], velocity[t]
        )
        slip[t] = np.sqrt(np.max(residual[:, 0] ** 2 + residual[:, 1] ** 2))
    return twist, slip


@compiled
def _contact_forces(  # type: ignore[no-untyped-def]
    modules, steer_axis, caster_offset, radius, steer_angle, velocity, acceleration, torque, twist, twist_dot
):
    """Forces at the contacts in the wheel frames from each joint's balance, (T, n, 2) [N]."""
    force = np.empty_like(torque)
    for t in range(len(torque)):
        vx, vy, omega = twist[t, 0], twist[t, 1], twist[t, 2]
        for i in range(len(radius)):
            c, s = np.cos(steer_angle[t, i]), np.sin(steer_angle[t, i])
            m, cx, cy = modules[i, 0], modules[i, 1], modules[i, 2]
            lever_x, lever_y = cx * c - cy * s, cx * s + cy * c
            sx, sy = steer_axis[i, 0], steer_axis[i, 1]
            sigma = velocity[t, i, 1] + omega
            sigma_dot = acceleration[t, i, 1] + twist_dot[t, 2]
            ax = (
                twist_dot[t, 0]
                - omega * vy
                - twist_dot[t, 2] * sy
                - omega * omega * sx
                - sigma_dot * lever_y
                - sigma * sigma * lever_x
            )
            ay = (
                twist_dot[t, 1]
                + omega * vx
                + twist_dot[t, 2] * sx
                - omega * omega * sy
                + sigma_dot * lever_x
                - sigma * sigma * lever_y
            )
            roll_inertia = modules[i, 4] + modules[i, 5]
            along = (
                torque[t, i, 0] - roll_inertia * acceleration[t, i, 0] - modules[i, 6] * acceleration[t, i, 1]
            ) / radius[i]
            turning = m * (lever_x * ay - lever_y * ax) + modules[i, 3] * sigma_dot
            turning += (
                modules[i, 7] * acceleration[t, i, 1]
                + modules[i, 6] * acceleration[t, i, 0]
                - torque[t, i, 1]
            )
            force[t, i, 0] = along
            force[t, i, 1] = (turning + caster_offset[i, 1] * along) / caster_offset[i, 0]
    return force


@compiled
def _wrench_of(steer_axis, caster_offset, steer_angle, force):  # type: ignore[no-untyped-def]
    """Wrench A^T F on the base (T, 3) of contact forces (T, n, 2)."""
    wrench = np.zeros((len(force), 3))
    for t in range(len(force)):
        for i in range(steer_angle.shape[1]):
            c, s = np.cos(steer_angle[t, i]), np.sin(steer_angle[t, i])
            fx, fy = force[t, i, 0], force[t, i, 1]
            bx, by = caster_offset[i, 0], caster_offset[i, 1]
            px = steer_axis[i, 0] + bx * c - by * s
            py = steer_axis[i, 1] + bx * s + by * c
            gx, gy = c * fx - s * fy, s * fx + c * fy
            wrench[t, 0] += gx
            wrench[t, 1] += gy
            wrench[t, 2] += px * gy - py * gx
    return wrench


@compiled
def _inertial_wrench(  # type: ignore[no-untyped-def]
    chassis, modules, steer_axis, steer_angle, steer_rate, steer_acceleration, twist, twist_dot
):
    """Wrench (T, 3) that accelerates chassis and modules as they move; rotors and rolling wheels are not in it."""
    wrench = np.empty_like(twist)
    for t in range(len(twist)):
        vx, vy, omega = twist[t, 0], twist[t, 1], twist[t, 2]
        dx, dy, alpha = twist_dot[t, 0] - omega * vy, twist_dot[t, 1] + omega * vx, twist_dot[t, 2]
        mass, cx, cy = chassis[0], chassis[1], chassis[2]
        ax, ay = dx - alpha * cy - omega * omega * cx, dy + alpha * cx - omega * omega * cy
        fx, fy, moment = mass * ax, mass * ay, chassis[3] * alpha + mass * (cx * ay - cy * ax)
        for i in range(len(modules)):
            c, s = np.cos(steer_angle[t, i]), np.sin(steer_angle[t, i])
            lever_x, lever_y = modules[i, 1] * c - modules[i, 2] * s, modules[i, 1] * s + modules[i, 2] * c
            sx, sy = steer_axis[i, 0], steer_axis[i, 1]
            sigma, sigma_dot = steer_rate[t, i] + omega, steer_acceleration[t, i] + alpha
            ax = dx - alpha * sy - omega * omega * sx - sigma_dot * lever_y - sigma * sigma * lever_x
            ay = dy + alpha * sx - omega * omega * sy + sigma_dot * lever_x - sigma * sigma * lever_y
            m = modules[i, 0]
            fx += m * ax
            fy += m * ay
            moment += modules[i, 3] * sigma_dot + m * ((sx + lever_x) * ay - (sy + lever_y) * ax)
        wrench[t, 0], wrench[t, 1], wrench[t, 2] = fx, fy, moment
    return wrench


@compiled
def _normal_forces(mass, com_x, com_y, com_z, steer_axis, caster_offset, steer_angle, acceleration):  # type: ignore[no-untyped-def]
    """Quasi-static normal forces (T, n) [N] from the accelerations (T, 2)."""
    normal = np.empty_like(steer_angle)
    centre = np.empty_like(steer_axis)
    level = np.zeros(len(steer_axis))
    for t in range(len(steer_angle)):
        for i in range(steer_angle.shape[1]):
            c, s = np.cos(steer_angle[t, i]), np.sin(steer_angle[t, i])
            centre[i, 0] = steer_axis[i, 0] + caster_offset[i, 0] * c - caster_offset[i, 1] * s
            centre[i, 1] = steer_axis[i, 1] + caster_offset[i, 0] * s + caster_offset[i, 1] * c
        moment_x = mass * (GRAVITY * com_x - com_z * acceleration[t, 0])
        moment_y = mass * (GRAVITY * com_y - com_z * acceleration[t, 1])
        # On level ground the load does not depend on how stiff equal springs are.
        support_forces(mass * GRAVITY, moment_x, moment_y, 1.0, centre, level, normal[t])
    return normal


def normal_forces(numbers: ModelNumbers, steer_angle: FloatArray, acceleration: FloatArray) -> FloatArray:
    """Quasi-static normal forces (T, n) [N] on the wheels under accelerations (T, 2 or more) in base_link."""
    chassis, modules = numbers.chassis, numbers.modules
    module_mass = modules[:, 0].sum()
    mass = chassis[0] + module_mass
    centre = (chassis[0] * chassis[1:3] + (modules[:, :1] * numbers.steer_axis).sum(axis=0)) / mass
    height = (chassis[0] * numbers.com_height + (modules[:, 0] * numbers.radius).sum()) / mass
    forces: FloatArray = _normal_forces(
        mass,
        centre[0],
        centre[1],
        height,
        numbers.steer_axis,
        numbers.caster_offset,
        steer_angle,
        acceleration,
    )
    return forces


def slip_twist(
    motion: RobotMotion,
    numbers: ModelNumbers,
    steer_angle: FloatArray,
    twist: FloatArray,
    force: FloatArray,
) -> FloatArray:
    """Twist (T, 3) that the wheels show beyond the robot's: A^+ of the slip that carries the contact forces.

    The force is inverted through the rising branch of Kiencke's curve, lambda = lambda_p m / (1 + sqrt(1 - m^2)) with
    m = F / (mu_p F_z); all curves share its slope to first order.
    """
    twist_dot = derivative(twist, motion.rate)
    acceleration = twist_dot[:, :2] + twist[:, 2:] * np.stack([-twist[:, 1], twist[:, 0]], axis=1)
    normal = np.maximum(normal_forces(numbers, steer_angle, acceleration), 1.0)
    use = np.clip(force / (numbers.peak_friction * normal[:, :, None]), -0.99, 0.99)
    ratio = numbers.slip * numbers.critical_slip * use / (1.0 + np.sqrt(1.0 - use**2))
    rolling = np.hypot(
        motion.velocity[:, :, DRIVE] * numbers.radius,
        motion.velocity[:, :, STEER] * numbers.caster_offset[:, 0],
    )
    slip = rolling[:, :, None] * ratio + numbers.relaxation_length * derivative(ratio, motion.rate)
    # A^+ of slips is A^+ B of the joint rates that would look like them.
    as_rates = np.empty_like(slip)
    as_rates[:, :, STEER] = slip[:, :, 1] / -numbers.caster_offset[:, 0]
    as_rates[:, :, DRIVE] = (
        slip[:, :, 0] - numbers.caster_offset[:, 1] * as_rates[:, :, STEER]
    ) / numbers.radius
    slip_twist, _ = twists(numbers.steer_axis, numbers.caster_offset, numbers.radius, steer_angle, as_rates)
    result: FloatArray = slip_twist
    return result


def channel_sides(
    motion: RobotMotion,
    numbers: ModelNumbers,
    wrench: bool,
    imu: bool,
    added_torque: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Measured and predicted side of every channel at the motion's rate, (T, C) each.

    Args:
        motion: the motion.
        numbers: of the model.
        wrench: whether the channels of the wrench are wanted; imu: likewise those of the inertial sensor.
        added_torque: acts on the joints besides the motors' (T, n, 2) [N m].
    """
    steer_angle = np.ascontiguousarray(motion.position[:, :, STEER]) + numbers.steer_zero
    geometry = numbers.steer_axis, numbers.caster_offset
    twist, _ = twists(*geometry, numbers.radius, steer_angle, motion.velocity)
    measured, predicted = [], []
    if wrench:
        torque = (motion.torque + numbers.torque_lag * motion.torque_rate) * numbers.gain
        if added_torque is not None:
            torque = torque + added_torque
        force = _contact_forces(
            numbers.modules,
            *geometry,
            numbers.radius,
            steer_angle,
            motion.velocity,
            motion.acceleration,
            torque,
            twist,
            derivative(twist, motion.rate),
        )
        twist = twist - slip_twist(motion, numbers, steer_angle, twist, force)
        twist_dot = derivative(twist, motion.rate)
        measured.append(_wrench_of(*geometry, steer_angle, force))
        predicted.append(
            _inertial_wrench(
                numbers.chassis,
                numbers.modules,
                numbers.steer_axis,
                steer_angle,
                np.ascontiguousarray(motion.velocity[:, :, STEER]),
                np.ascontiguousarray(motion.acceleration[:, :, STEER]),
                twist,
                twist_dot,
            )
        )
    else:
        twist_dot = derivative(twist, motion.rate)
    if imu:
        x, y = numbers.imu_position
        omega, alpha = twist[:, 2], twist_dot[:, 2]
        measured.append(motion.imu)
        predicted.append(
            np.stack(
                [
                    numbers.gyro_scale * omega + numbers.gyro_bias,
                    twist_dot[:, 0]
                    - omega * twist[:, 1]
                    - alpha * y
                    - omega**2 * x
                    + numbers.accelerometer_bias[0],
                    twist_dot[:, 1]
                    + omega * twist[:, 0]
                    + alpha * x
                    - omega**2 * y
                    + numbers.accelerometer_bias[1],
                ],
                axis=1,
            )
        )
    return np.concatenate(measured, axis=1), np.concatenate(predicted, axis=1)
