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

import copy
import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from pcw_description.augmented_object_model import dynamic_parameters
from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import forward_kinematics_kernel
from pcw_description.effects.effect import DescriptionEffect, JointTorqueEffect
from pcw_description.effects.registry import all_effects
from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, DRIVE, STEER, RobotDescription

from ..plants.reduced import support_forces
from .axis_channels import kernel_arguments
from .errors import MismatchError
from .regression_problem import BoolArray, Channel, FloatArray, LinearParameter, Nuisance, RegressionProblem, Shape, Term
from .signal_filter import SignalFilter, derivative, uniform_segments, white_noise_level

LARGEST_CUTOFF = 20.0  # [Hz]; above it structure and suspension answer
SMALLEST_CUTOFF = 3.0
# Effects are evaluated on signals filtered this much wider than the channels, so that they see sharp reversals.
PREFILTER_RATIO = 2.5
# Rate of the motions that the model is evaluated on, per cut-off of the wide filter: derivatives stay exact to a percent.
MOTION_OVERSAMPLING = 5.0
# The channels end at this part of the resonance of the robot on its tyres.
TYRE_MARGIN = 0.5
ALLOWED_DERIVATIVE_NOISE = 0.05
LARGEST_GAP = 0.05  # [s]
SHORTEST_SEGMENT = 1.0  # [s]
# Slip that the linear model may hold: a floor and a part of the speed (real robots: robots.md, last entry).
SLIP_FLOOR, SLIP_FRACTION = 0.03, 0.15
STILL_SPEED = 0.2  # [rad/s]; joints slower than this may be held by dry friction of unknown size
WRENCH = ("chassis_force/x", "chassis_force/y", "chassis_torque/z")


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


@dataclasses.dataclass(frozen=True)
class RobotMotion:
    """One contiguous piece on a regular grid after the wide filter; arrays along T.

    Attributes:
        rate: [Hz].
        sampling: interval of joint_states [s].
        position, velocity, acceleration, torque, torque_rate: joints (T, n, 2).
        imu: yaw rate and acceleration x, y (T, 3); NaN where not recorded.
    """

    recording: int
    rate: float
    sampling: float
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    torque: FloatArray
    torque_rate: FloatArray
    imu: FloatArray


@compiled
def _twists(steer_axis, caster_offset, radius, steer_angle, velocity):  # type: ignore[no-untyped-def]
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
    for t in range(len(steer_angle)):
        for i in range(steer_angle.shape[1]):
            c, s = np.cos(steer_angle[t, i]), np.sin(steer_angle[t, i])
            centre[i, 0] = steer_axis[i, 0] + caster_offset[i, 0] * c - caster_offset[i, 1] * s
            centre[i, 1] = steer_axis[i, 1] + caster_offset[i, 0] * s + caster_offset[i, 1] * c
        support_forces(mass, com_x, com_y, com_z, acceleration[t, 0], acceleration[t, 1], centre, normal[t])
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


class RobotProblemBuilder:
    """Builds the regression problem of a robot from its recordings."""

    def __init__(
        self, robot: RobotDescription, recordings: Sequence[Recording], cutoff: float | None = None
    ) -> None:
        """Filter the recordings.

        Args:
            robot: the nominal robot.
            recordings: opened with this robot.
            cutoff: of the channel filter [Hz]; None chooses it from the noise of the encoders.

        Raises:
            MismatchError: no torques were recorded, or no recording has a piece long enough.
        """
        self.robot = robot
        self.balanced = bool(np.all(np.abs(robot.caster_offset[:, 0]) > 1e-3))
        self.cutoff = cutoff if cutoff is not None else choose_cutoff(robot, recordings)
        self.motions: list[RobotMotion] = []
        for index, recording in enumerate(recordings):
            self._add(recording, index)
        if not self.motions:
            raise MismatchError(f"no contiguous piece of at least {SHORTEST_SEGMENT:g} s in the recordings")
        self.filters = [SignalFilter(m.rate, self.cutoff) for m in self.motions]
        self.has_imu = any(np.isfinite(m.imu).any() for m in self.motions)
        self.numbers = ModelNumbers.of(self._with_nominal_changes(robot))

    def _with_nominal_changes(self, robot: RobotDescription) -> RobotDescription:
        """Effects that the description already holds belong to the nominal model."""
        for instance in robot.physics:
            effect = all_effects()[instance.name]
            if isinstance(effect, DescriptionEffect):
                robot = effect.apply(robot, instance.target, instance.parameters)
        return robot

    def _add(self, recording: Recording, index: int) -> None:
        joints = recording.joint_states
        n = self.robot.n
        torque = joints.effort if joints.effort is not None else np.full_like(joints.position, np.nan)
        if self.balanced and not np.isfinite(torque).any():
            raise MismatchError(
                f"{recording.path}: joint_states holds no effort (motor torque); without it no force can be judged"
            )
        signals = np.concatenate([joints.position.reshape(-1, 2 * n), torque.reshape(-1, 2 * n)], axis=1)
        imu = np.full((len(signals), 3), np.nan)
        if recording.imu is not None:
            measured = np.column_stack([recording.imu.gyro[:, 2], recording.imu.acceleration[:, :2]])
            for column in range(3):
                imu[:, column] = np.interp(
                    joints.stamp, recording.imu.stamp, measured[:, column], left=np.nan, right=np.nan
                )
        signals = np.concatenate([signals, imu], axis=1)
        rate, pieces = uniform_segments(joints.stamp, signals, LARGEST_GAP)
        wide = SignalFilter(rate, PREFILTER_RATIO * self.cutoff)
        step = max(1, int(rate / (MOTION_OVERSAMPLING * wide.cutoff)))
        for stamps, values in pieces:
            needed = 4 * n if self.balanced else 2 * n
            finite = np.isfinite(values[:, :needed]).all(axis=1)
            for start, stop in _runs(np.asarray(finite, dtype=bool)):
                if stamps[stop - 1] - stamps[start] < SHORTEST_SEGMENT:
                    continue
                block = values[start:stop]
                smooth = wide.smooth(np.where(np.isfinite(block), block, 0.0))
                position = smooth[:, : 2 * n].reshape(-1, n, 2)
                velocity = derivative(position, rate)
                torque = smooth[:, 2 * n : 4 * n].reshape(-1, n, 2)
                keep = slice(None, None, step)
                sensed = np.where(np.isfinite(block[:, 4 * n :]), smooth[:, 4 * n :], np.nan)
                self.motions.append(
                    RobotMotion(
                        recording=index,
                        rate=rate / step,
                        sampling=1.0 / rate,
                        time=stamps[start:stop][keep],
                        position=position[keep].copy(),
                        velocity=velocity[keep].copy(),
                        acceleration=derivative(velocity, rate)[keep].copy(),
                        torque=torque[keep].copy(),
                        torque_rate=derivative(torque, rate)[keep].copy(),
                        imu=sensed[keep],
                    )
                )

    # -- the model ----------------------------------------------------------------------------------------------

    def channels(self) -> tuple[Channel, ...]:
        """Channels that these recordings can fill."""
        names = (
            [Channel(name, "N m" if "torque" in name else "N") for name in WRENCH] if self.balanced else []
        )
        if self.has_imu:
            names.append(Channel("gyro", "rad/s", axis="imu"))
            names += [Channel(f"accelerometer/{axis}", "m/s^2", axis="imu") for axis in "xy"]
        return tuple(names)

    def _sides(
        self, motion: RobotMotion, numbers: ModelNumbers, added_torque: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Measured and predicted side of every channel at the motion's rate, (T, C) each.

        `added_torque` (T, n, 2) acts on the joints besides the motors'.
        """
        steer_angle = np.ascontiguousarray(motion.position[:, :, STEER]) + numbers.steer_zero
        geometry = numbers.steer_axis, numbers.caster_offset
        twist, _ = _twists(*geometry, numbers.radius, steer_angle, motion.velocity)
        measured, predicted = [], []
        if self.balanced:
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
            twist = twist - self._slip_twist(motion, numbers, steer_angle, twist, force)
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
        if self.has_imu:
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

    def _slip_twist(
        self,
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
        slip_twist, _ = _twists(
            numbers.steer_axis, numbers.caster_offset, numbers.radius, steer_angle, as_rates
        )
        result: FloatArray = slip_twist
        return result

    # -- the problem --------------------------------------------------------------------------------------------

    def build(self) -> RegressionProblem:
        """Return the regression problem of all recordings."""
        sides = self._nominal = [self._sides(motion, self.numbers) for motion in self.motions]
        measured = self._filtered([np.nan_to_num(side[0]) for side in sides])
        predicted = self._filtered([side[1] for side in sides])
        residual = measured - predicted - self._known_effects(measured.shape[1])
        valid = self._valid(sides)
        stamps = [f.decimate(m.time) for f, m in zip(self.filters, self.motions, strict=True)]
        return RegressionProblem(
            channels=self.channels(),
            time=np.concatenate(stamps),
            segment=np.concatenate([np.full(len(t), i) for i, t in enumerate(stamps)]),
            recording=np.concatenate(
                [np.full(len(t), m.recording) for t, m in zip(stamps, self.motions, strict=True)]
            ),
            rate=float(np.mean([f.decimated_rate for f in self.filters])),
            measured=measured,
            residual=residual,
            valid=valid,
            nuisances=tuple(self._nuisances(sides)),
            terms=tuple(self._terms(sides, measured)),
            variables=self._variables(),
        )

    def _filtered(self, pieces: Sequence[FloatArray]) -> FloatArray:
        return np.concatenate([f.apply(piece) for f, piece in zip(self.filters, pieces, strict=True)])

    def _valid(self, sides: Sequence[tuple[FloatArray, FloatArray]]) -> BoolArray:
        """Samples (T, C) that the rolling model can judge: moving, no gross slip, sensor there."""
        pieces = []
        numbers = self.numbers
        for motion, (measured, _) in zip(self.motions, sides, strict=True):
            steer_angle = np.ascontiguousarray(motion.position[:, :, STEER])
            twist, slip = _twists(
                numbers.steer_axis, numbers.caster_offset, numbers.radius, steer_angle, motion.velocity
            )
            speed = np.hypot(twist[:, 0], twist[:, 1]) + np.abs(twist[:, 2]) * np.max(
                np.linalg.norm(numbers.steer_axis, axis=1)
            )
            bad = slip > SLIP_FLOOR + SLIP_FRACTION * speed
            if self.balanced:
                bad |= np.all(np.abs(motion.velocity[:, :, DRIVE]) < STILL_SPEED, axis=1)
            pieces.append(bad[:, None] | ~np.isfinite(measured))
        return self._filtered([piece.astype(float) for piece in pieces]) < 0.1

    def _difference(
        self, sides: Sequence[tuple[FloatArray, FloatArray]], numbers: ModelNumbers, step: float
    ) -> FloatArray:
        """Column (T, C) of a number: what the residual of the nominal model holds per unit of its deviation."""
        pieces = []
        for motion, (measured, predicted) in zip(self.motions, sides, strict=True):
            changed_measured, changed_predicted = self._sides(motion, numbers)
            pieces.append(
                np.nan_to_num(((measured - predicted) - (changed_measured - changed_predicted)) / step)
            )
        return self._filtered(pieces)

    def _nuisances(self, sides: Sequence[tuple[FloatArray, FloatArray]]) -> list[Nuisance]:
        nuisances = []
        for name, unit, nominal, deviation, vary in self._deviations():
            numbers = copy.deepcopy(self.numbers)
            step = 0.5 * deviation
            vary(numbers, step)
            nuisances.append(Nuisance(name, unit, nominal, deviation, self._difference(sides, numbers, step)))
        return nuisances

    def _deviations(self) -> list[tuple[str, str, float, float, Callable[[ModelNumbers, float], None]]]:
        """Name, unit, nominal value, tolerance and variation of every number that a healthy robot may differ in."""
        robot = self.robot
        found: list[tuple[str, str, float, float, Callable[[ModelNumbers, float], None]]] = []

        def number(
            tolerance: str, label: str, nominal: float, vary: Callable[[ModelNumbers, float], None]
        ) -> None:
            known = robot.tolerance(tolerance)
            deviation = known.value * abs(nominal) if known.relative else known.value
            if deviation > 0.0:
                found.append((label, known.unit, nominal, deviation, vary))

        def entry(
            array: str, index: int | tuple[int, ...] | tuple[slice, int]
        ) -> Callable[[ModelNumbers, float], None]:
            def vary(numbers: ModelNumbers, step: float) -> None:
                getattr(numbers, array)[index] += step

            return vary

        def scaled(array: str, column: int, nominal: float) -> Callable[[ModelNumbers, float], None]:
            def vary(numbers: ModelNumbers, step: float) -> None:
                getattr(numbers, array)[:, column] *= 1.0 + step / nominal

            return vary

        if self.balanced:
            first = robot.casters[0]

            def lag(numbers: ModelNumbers, step: float) -> None:
                numbers.torque_lag += step

            # A drive reports the torque of some instant within its own cycle; nobody knows which.
            found.append(("torque_lag", "s", 0.0, 0.5 * max(m.sampling for m in self.motions), lag))
            number("chassis.mass", "chassis.mass", robot.chassis.mass, entry("chassis", 0))
            number("chassis.com", "chassis.com.x", 0.0, entry("chassis", 1))
            number("chassis.com", "chassis.com.y", 0.0, entry("chassis", 2))
            number("chassis.inertia_zz", "chassis.inertia_zz", robot.chassis.inertia_zz, entry("chassis", 3))
            number("module.mass", "module.mass", first.module.mass, scaled("modules", 0, first.module.mass))
            number(
                "module.inertia_zz",
                "module.inertia_zz",
                first.module.inertia_zz,
                scaled("modules", 3, first.module.inertia_zz),
            )
            number(
                "wheel.inertia_axle",
                "wheel.inertia_axle",
                first.wheel.inertia_axle,
                scaled("modules", 4, first.wheel.inertia_axle),
            )
            for rotor, column in (("drive", 5), ("steer", 7)):
                inertia = float(self.numbers.modules[0, column])
                if inertia > 0.0:
                    number("rotors", f"rotors.{rotor}", inertia, scaled("modules", column, inertia))
        for i, caster in enumerate(robot.casters):
            number("wheel_radius", f"wheel_radius/{caster.name}", caster.wheel_radius, self._radius(i))
            number("steer_zero", f"steer_zero/{caster.name}", 0.0, entry("steer_zero", i))
            if self.balanced:
                number("caster_offset", f"caster_offset.x/{caster.name}", 0.0, entry("caster_offset", (i, 0)))
                for axis, axis_name in enumerate(AXIS_NAMES):
                    number(
                        "torque_constant",
                        f"torque_constant/{caster.name}_{axis_name}",
                        1.0,
                        entry("gain", (i, axis)),
                    )
        if self.has_imu:

            def scale(numbers: ModelNumbers, step: float) -> None:
                numbers.gyro_scale += step

            def bias(numbers: ModelNumbers, step: float) -> None:
                numbers.gyro_bias += step

            number("imu.scale", "imu.gyro_scale", 1.0, scale)
            number("imu.gyro_bias", "imu.gyro_bias", 0.0, bias)
            for k, axis_name in enumerate("xy"):
                number(
                    "imu.accelerometer_bias",
                    f"imu.accelerometer_bias.{axis_name}",
                    0.0,
                    entry("accelerometer_bias", k),
                )
                number("imu.position", f"imu.position.{axis_name}", 0.0, entry("imu_position", k))
            if self.balanced:

                def slip(numbers: ModelNumbers, step: float) -> None:
                    numbers.slip += step

                number("contact.stiffness", "contact.stiffness", 1.0, slip)
        return found

    def _radius(self, index: int) -> Callable[[ModelNumbers, float], None]:
        """Vary a wheel's radius in the kinematics and in the dynamics, which holds its own copy."""

        def vary(numbers: ModelNumbers, step: float) -> None:
            numbers.radius[index] += step
            numbers.modules[index, 8] += step

        return vary

    # -- effects ------------------------------------------------------------------------------------------------

    def _joint_columns(self, effect: JointTorqueEffect, casters: Sequence[int], shape: Shape) -> FloatArray:
        """Columns (T, C, P) of an effect at work on some casters with common parameters."""
        axis = AXIS_NAMES.index(effect.axis)
        width = len(self.channels())
        names = [parameter.name for parameter in effect.linear_parameters]
        pieces = []
        # Small against the weight, so that the tyres' curves stay straight.
        scales = [
            1e-2
            * self.robot.total_mass
            * float(np.mean(self.numbers.radius))
            / self._torque_size(effect, name, shape)
            for name in names
        ]
        for motion, normal, nominal in zip(self.motions, self._normal, self._nominal, strict=True):
            columns = np.zeros((len(motion.time), width, len(names)))
            torques = np.zeros((len(names), len(motion.time), self.robot.n, 2))
            for i in casters:
                by_name = effect.regressor(
                    motion.position[:, i, axis],
                    motion.velocity[:, i, axis],
                    motion.torque[:, i, axis],
                    normal[:, i],
                    shape,
                )
                for k, name in enumerate(names):
                    torques[k, :, i, axis] = by_name[name]
            measured, predicted = nominal
            for k, scale in enumerate(scales):
                with_effect = self._sides(motion, self.numbers, scale * torques[k])
                difference = (measured - predicted) - (with_effect[0] - with_effect[1])
                columns[:, :, k] = np.nan_to_num(difference) / scale
            pieces.append(columns)
        return self._filtered(pieces)

    def _torque_size(self, effect: JointTorqueEffect, name: str, shape: Shape) -> float:
        """Rough size [N m] of the torque that one unit of a parameter makes."""
        axis = AXIS_NAMES.index(effect.axis)
        motion, normal = self.motions[0], self._normal[0]
        column = effect.regressor(
            motion.position[:, 0, axis],
            motion.velocity[:, 0, axis],
            motion.torque[:, 0, axis],
            normal[:, 0],
            shape,
        )[name]
        return max(float(np.sqrt(np.mean(column**2))), 1e-9)

    @property
    def _normal(self) -> list[FloatArray]:
        """Normal forces (T, n) along every motion, computed once."""
        if not hasattr(self, "_normal_cache"):
            self._normal_cache = []
            numbers = self.numbers
            for motion in self.motions:
                angle = np.ascontiguousarray(motion.position[:, :, STEER])
                twist, _ = _twists(
                    numbers.steer_axis, numbers.caster_offset, numbers.radius, angle, motion.velocity
                )
                twist_dot = derivative(twist, motion.rate)
                acceleration = twist_dot[:, :2] + twist[:, 2:] * np.stack([-twist[:, 1], twist[:, 0]], axis=1)
                self._normal_cache.append(normal_forces(numbers, angle, acceleration))
        return self._normal_cache

    def _known_effects(self, width: int) -> FloatArray:
        """What effects that the description already holds add to the residual, (T, C)."""
        total = np.zeros(
            (sum(len(f.decimate(m.time)) for f, m in zip(self.filters, self.motions, strict=True)), width)
        )
        for instance in self.robot.physics:
            effect = all_effects()[instance.name]
            if self.balanced and isinstance(effect, JointTorqueEffect):
                casters = [self.robot.caster_index(name) for name in instance.target]
                shape = {p.name: instance.parameters[p.name] for p in effect.nonlinear_parameters}
                weights = np.array([instance.parameters[p.name] for p in effect.linear_parameters])
                total += self._joint_columns(effect, casters, shape) @ weights
        return total

    def _terms(self, sides: Sequence[tuple[FloatArray, FloatArray]], measured: FloatArray) -> list[Term]:
        if not self.balanced:
            return []
        terms = []
        groups: list[tuple[tuple[str, ...], list[int]]] = [((name,), [i]) for i, name in enumerate(self.robot.caster_names)]
        groups.append((self.robot.caster_names, list(range(self.robot.n))))
        size = np.sqrt(np.mean(measured[:, :3] ** 2))
        for effect in all_effects().values():
            if isinstance(effect, JointTorqueEffect):
                shapes = self._shapes(effect)
                if shapes is None:
                    continue
                for target, casters in groups:
                    terms.append(self._joint_term(effect, target, casters, shapes, float(size)))
            elif isinstance(effect, DescriptionEffect) and effect.target_kind == "chassis":
                terms.append(self._description_term(effect, sides))
        return terms

    def _shapes(self, effect: JointTorqueEffect) -> tuple[dict[str, float], ...] | None:
        """Grid of an effect's shaping parameters, or None for effects whose search does not pay on a rolling robot."""
        shapes: list[dict[str, float]] = [{}]
        axis = AXIS_NAMES.index(effect.axis)
        speeds = np.concatenate([np.abs(m.velocity[:, :, axis]).ravel() for m in self.motions])
        top = float(np.quantile(speeds, 0.98))
        for parameter in effect.nonlinear_parameters:
            if parameter.default is not None:
                shapes = [{**shape, parameter.name: parameter.default} for shape in shapes]
            elif parameter.unit == "rad/s":
                shapes = [
                    {**shape, parameter.name: float(v)}
                    for shape in shapes
                    for v in np.geomspace(0.05, 0.5, 4) * top
                ]
            else:
                return None
        return tuple(shapes)

    def _joint_term(
        self,
        effect: JointTorqueEffect,
        target: tuple[str, ...],
        casters: list[int],
        shapes: tuple[dict[str, float], ...],
        size: float,
    ) -> Term:
        def columns(shape: Shape) -> FloatArray:
            return self._joint_columns(effect, casters, shape)

        first = columns(shapes[0])
        variable = {
            "position": "angle",
            "velocity": "velocity",
            "force": "torque",
            "normal_force": "normal_force",
        }
        parameters = []
        for k, parameter in enumerate(effect.linear_parameters):
            scale = float(np.sqrt(np.mean(first[:, :3, k] ** 2)))
            parameters.append(
                LinearParameter(
                    parameter.name,
                    parameter.unit,
                    parameter.lower,
                    parameter.upper,
                    size / max(scale, 1e-12),
                    refinement=parameter.name == "asymmetry",
                )
            )
        return Term(
            effect=effect.name,
            target=target,
            parameters=tuple(parameters),
            shapes=shapes,
            columns=columns,
            arguments=tuple(
                f"{effect.axis}_{variable[argument]}/{name}"
                for argument in kernel_arguments(effect.name)
                for name in target
            ),
            resolution={p.name: ("log", 2.15) for p in effect.nonlinear_parameters if p.default is None},
        )

    def _description_term(
        self, effect: DescriptionEffect, sides: Sequence[tuple[FloatArray, FloatArray]]
    ) -> Term:
        """A change of the description's numbers, linear in its first parameter for given shaping ones."""
        linear = effect.linear_parameters[0]
        reach = np.max(np.abs(self.robot.steer_axis), axis=0)
        places = [
            {"x": x * float(reach[0]), "y": y * float(reach[1])}
            for x in (-0.7, 0.0, 0.7)
            for y in (-0.7, 0.0, 0.7)
        ]
        defaults = {p.name: p.default for p in effect.nonlinear_parameters if p.default is not None}
        free = {p.name for p in effect.nonlinear_parameters}
        shapes = tuple({**defaults, **{k: v for k, v in place.items() if k in free}} for place in places)

        def columns(shape: Shape) -> FloatArray:
            step = 0.1 * linear.typical
            robot = effect.apply(
                self._with_nominal_changes(self.robot), (effect.target_kind,), {**shape, linear.name: step}
            )
            return self._difference(sides, ModelNumbers.of(robot), step)[:, :, None]

        return Term(
            effect=effect.name,
            target=(effect.target_kind,),
            shapes=shapes,
            columns=columns,
            arguments=("acceleration",),
            parameters=(
                LinearParameter(linear.name, linear.unit, linear.lower, linear.upper, 3.0 * linear.typical),
            ),
            resolution={
                name: ("linear", 0.35 * float(reach[k])) for k, name in enumerate("xy") if name in free
            },
        )

    def _variables(self) -> dict[str, FloatArray]:
        """What a leftover may depend on, each (T,)."""
        numbers = self.numbers
        variables: dict[str, list[FloatArray]] = {}

        def put(name: str, filter_: SignalFilter, values: FloatArray) -> None:
            variables.setdefault(name, []).append(filter_.apply(values))

        for filter_, motion, normal in zip(self.filters, self.motions, self._normal, strict=True):
            angle = np.ascontiguousarray(motion.position[:, :, STEER])
            twist, _ = _twists(
                numbers.steer_axis, numbers.caster_offset, numbers.radius, angle, motion.velocity
            )
            variables.setdefault("time", []).append(filter_.decimate(motion.time))
            put("speed", filter_, np.hypot(twist[:, 0], twist[:, 1]))
            for k, name in enumerate(("v_x", "v_y", "omega")):
                put(name, filter_, twist[:, k])
            for i, caster in enumerate(self.robot.caster_names):
                put(f"steer_angle/{caster}", filter_, np.ascontiguousarray(angle[:, i]))
                put(f"drive_angle/{caster}", filter_, np.ascontiguousarray(motion.position[:, i, DRIVE]))
                put(f"drive_normal_force/{caster}", filter_, np.ascontiguousarray(normal[:, i]))
                for axis, axis_name in enumerate(AXIS_NAMES):
                    put(
                        f"{axis_name}_velocity/{caster}",
                        filter_,
                        np.ascontiguousarray(motion.velocity[:, i, axis]),
                    )
                    put(
                        f"{axis_name}_torque/{caster}",
                        filter_,
                        np.ascontiguousarray(motion.torque[:, i, axis]),
                    )
        return {name: np.concatenate(parts) for name, parts in variables.items()}


def choose_cutoff(robot: RobotDescription, recordings: Sequence[Recording]) -> float:
    """Return the largest cut-off at which differentiated encoder noise stays small against the motion [Hz].

    White noise s of a joint angle at the rate f_s, differentiated twice and cut at f_c, has the variance
    2 s^2 (2 pi)^4 f_c^5 / (5 f_s); it may reach a part of the largest accelerations recorded.
    """
    contact = robot.contact
    # Slip stiffness 2 mu_p F_z / lambda_p over the relaxation length: the spring between wheel and ground, per unit mass.
    stiffness = 2.0 * contact.mu_p * 9.81 / (contact.lambda_p * contact.relaxation_length)
    cutoffs = [LARGEST_CUTOFF, TYRE_MARGIN * float(np.sqrt(stiffness)) / (2.0 * np.pi)]
    for recording in recordings:
        joints = recording.joint_states
        rate = 1.0 / float(np.median(np.diff(joints.stamp)))
        cutoffs.append(rate / 8.0)
        slow = SignalFilter(rate, min(5.0, rate / 8.0))
        for i in range(robot.n):
            angle = joints.position[:, i, DRIVE]
            usable = np.isfinite(angle)
            if usable.sum() < 4 * slow.settling:
                continue
            angle = angle[usable]
            noise = white_noise_level(angle)
            acceleration = derivative(derivative(slow.smooth(angle), rate), rate)[
                slow.settling : -slow.settling
            ]
            allowed = ALLOWED_DERIVATIVE_NOISE * max(float(np.std(acceleration)), 1e-3)
            if noise > 0.0:
                cutoffs.append((allowed**2 * 5.0 * rate / (2.0 * noise**2 * (2.0 * np.pi) ** 4)) ** 0.2)
    return max(min(cutoffs), SMALLEST_CUTOFF)


def _runs(flags: BoolArray) -> list[tuple[int, int]]:
    """Start and stop of every run of true values."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]
