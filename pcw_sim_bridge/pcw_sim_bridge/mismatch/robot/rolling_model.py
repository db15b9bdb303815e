"""The channels of a robot on powered casters: what its encoders, motors and other sensors say that the model does not.

    chassis_force/x|y, chassis_torque/z    H[A^T F] - H[m a of chassis and modules]        motors against motion
    rolling_consistency/<caster>_...       H[P B q_dot] - H[P eps]                         wheels against one another
    gyro                                   H[omega_imu] - H[omega]
    accelerometer/x|y                      H[a_imu] - H[acceleration at the sensor]
    pose/x|y|yaw                           H[velocity of the tracked pose] - H[V there]    in the axes of what is tracked

with H the same filter on both sides and P = 1 - A A^+. Each joint's own balance gives the force at its contact,

    r F_x = tau_rho - I_rho rho_ddot - J_rp phi_ddot
    b_x F_y - b_y F_x = m c x a_c + I sigma_dot + J_pp phi_ddot + J_rp rho_ddot - tau_phi - M_scrub - (N b - m g c) x t

A chassis that leans on its springs, or stands on uneven ground or on a wheel that gives way, leans its steering axes: with t
the vertical in its horizontal axes, the contact is where the wheel is lowest, b_x = b_x0 - r t_x in the wheel's frame, and
weights turn the steering.

and the tyre under that force slips: eps = V lambda(F) + L (d lambda / dt + lambda max(dN/dt, 0) / N), the relaxed slip solved
for eps, with the faster of tread and wheel, V = max(|r rho_dot|, |V_w|), V_w = (r rho_dot, 0) - eps. The robot's twist is
the wheels' without it, V = A^+ (B q_dot - eps). Left out, this slip would pass for a missing force of a tenth of the whole,
growing with frequency; the channels end well below the resonance of the robot on its tyres. Where no torques were recorded,
the forces are those that the motion asks of the wheels, shared as evenly as can be.

Every number of the description that a healthy robot may differ in is a nuisance column, by differences of the whole
model; so is every effect. Robots whose wheels have no offset along their heading (b_x = 0), or that have a fixed axle,
have no torque balance here. A fixed axle is one more row of A, which senses nothing along itself; where the rows are then
three, as on a tricycle, wheels cannot contradict each other and the tracked pose alone is compared.
"""

from __future__ import annotations

import copy
import dataclasses
import functools

import numpy as np

from pcw_description.augmented_object_model import dynamic_parameters
from pcw_description.compiled import awaits_compiling, compiled
from pcw_description.contact.contact_model import (
    DAMPING_TIME,
    LAMBDA,
    LENGTH,
    scrub_torque,
    slip_of_force,
    tyre_parameters,
)
from pcw_description.differential_kinematics import (
    axle_row_kernel,
    guided_motion_kernel,
    registration_kernel,
    wheel_jacobian_kernel,
)
from pcw_description.robot_description import AXIS_NAMES, DRIVE, GRAVITY, STEER, RobotDescription
from pcw_description.support_forces import plane_gradient, support_forces

from ..regression.regression_problem import Channel, FloatArray
from ..regression.signal_filter import derivative
from .chassis_sway import ChassisSway
from .robot_motion import RobotMotion, tracked_place

# Of the numbers of the model those that say nothing of how wheels move, but what is felt, sensed and slips.
OF_NO_MOTION = frozenset((
    "gain", "crosstalk", "coupling", "torque_lag", "unreported", "tyres", "damping_time", "load_unrest", "softness",
    "imu_position", "imu_height", "gyro_bias", "gyro_scale", "accelerometer_bias", "accelerometer_scale", "imu_lean", "clock",
    "tracked",
))  # fmt: skip
FORCE_STEP = 1e-3  # of the load on a wheel, by which the slopes of its tyre's curves are taken
WRENCH = ("chassis_force/x", "chassis_force/y", "chassis_torque/z")
INERTIAL = ("gyro", "accelerometer/x", "accelerometer/y")


@dataclasses.dataclass(frozen=True)
class ChannelLayout:
    """Which channels there are, and at which columns.

    Attributes:
        casters: names.
        balanced: motor torques and an offset along the heading: there is a balance of forces.
        imu: an inertial sensor; pose: a tracked pose.
        axles: fixed axles, none or one.
        lifted: the wheels are off the ground, and each joint has a balance of its own; see `joint_balance`.
    """

    casters: tuple[str, ...]
    balanced: bool
    imu: bool
    pose: bool
    axles: int = 0
    lifted: bool = False

    @property
    def redundant(self) -> int:
        """How many velocities of the wheels there are beyond the three that make the motion; none where they make none."""
        return 0 if self.lifted else 2 * len(self.casters) + self.axles - 3

    @property
    def balance(self) -> slice:
        """Columns of the balance of forces; empty where there is none."""
        if not self.balanced:
            return slice(0, 0)
        return slice(0, 2 * len(self.casters) if self.lifted else len(WRENCH))

    @property
    def consistency(self) -> slice:
        """Columns of `rolling_consistency`, longitudinal and lateral by caster."""
        start = self.balance.stop
        return slice(start, start + (2 * len(self.casters) if self.redundant else 0))

    @property
    def inertial(self) -> slice:
        """Columns of gyro and accelerometer; empty without an IMU."""
        start = self.consistency.stop
        return slice(start, start + (3 if self.imu else 0))

    @property
    def tracked(self) -> slice:
        """Columns of the pose; empty without a tracker."""
        start = self.inertial.stop
        return slice(start, start + (3 if self.pose else 0))

    def channels(self) -> tuple[Channel, ...]:
        """The channels in order."""
        if self.lifted:
            return tuple(
                Channel(f"{axis}_torque/{name}", "N m", (name,), axis) for name in self.casters for axis in AXIS_NAMES
            )
        found = [Channel(name, "N m" if "torque" in name else "N") for name in WRENCH] if self.balanced else []
        # 2n slips of which a twist makes three: each sample tells so much less than its numbers.
        share = self.redundant / (2.0 * len(self.casters))
        for caster in self.casters if self.redundant else ():
            for axis, direction in (("drive", "longitudinal"), ("steer", "lateral")):
                name = f"rolling_consistency/{caster}_{direction}"
                found.append(Channel(name, "m/s", (caster,), axis, information=share))
        if self.imu:
            found += [Channel(name, "rad/s" if name == "gyro" else "m/s^2", axis="imu") for name in INERTIAL]
        if self.pose:
            found += [Channel(f"pose/{axis}", "rad/s" if axis == "yaw" else "m/s") for axis in ("x", "y", "yaw")]
        return tuple(found)


@dataclasses.dataclass(frozen=True)
class StraightTyres:
    """The slip of tyres as a linear function of the forces on them, many times cheaper than the inverse of their curves.

    Attributes:
        tyres: numbers of the tyres that it holds for (n, TYRE_SIZE).
        force, grip: where it is exact (T, n, 2), (T, n) [N].
        ratio: slip ratios there (T, n, 2); of_force, of_grip: their slopes (T, n, 2, 2), (T, n, 2) [1/N].
        in_place: tyres of other curves are straightened there, too, wherever their forces are.
    """

    tyres: FloatArray
    force: FloatArray
    grip: FloatArray
    ratio: FloatArray
    of_force: FloatArray
    of_grip: FloatArray
    in_place: bool = False

    @classmethod
    def about(cls, numbers: ModelNumbers, force: FloatArray, grip: FloatArray, in_place: bool = False) -> StraightTyres:
        """Straighten the tyres of a model about forces (T, n, 2) and loads (T, n)."""
        tyres = numbers.tyres.copy()
        plain = slip_ratios(tyres, force, grip)
        of_force = np.empty((*grip.shape, 2, 2))
        step = FORCE_STEP * grip
        for axis in range(2):
            changed = force.copy()
            changed[:, :, axis] += step
            of_force[:, :, :, axis] = (slip_ratios(tyres, changed, grip) - plain) / step[:, :, None]
        of_grip = (slip_ratios(tyres, force, grip + step) - plain) / step[:, :, None]
        return cls(tyres, force, grip, plain, of_force, of_grip, in_place)

    def ratios(self, force: FloatArray, grip: FloatArray) -> FloatArray:
        """Slip ratios (T, n, 2) under other forces and loads."""
        result: FloatArray = _straight_ratios(self.ratio, self.of_force, self.of_grip, force, self.force, grip, self.grip)
        return result


@compiled
def _straight_ratios(ratio, of_force, of_grip, force, force_there, grip, grip_there):  # type: ignore[no-untyped-def]
    found = np.empty_like(ratio)
    for t in range(ratio.shape[0]):
        for i in range(ratio.shape[1]):
            along, across = force[t, i, 0] - force_there[t, i, 0], force[t, i, 1] - force_there[t, i, 1]
            load = grip[t, i] - grip_there[t, i]
            for k in range(2):
                change = of_force[t, i, k, 0] * along + of_force[t, i, k, 1] * across
                found[t, i, k] = ratio[t, i, k] + change + of_grip[t, i, k] * load
    return found


@dataclasses.dataclass(frozen=True)
class Surroundings:
    """What an effect adds along a motion besides changed numbers; None where it adds nothing.

    Attributes:
        torque: on the joints besides the motors' (T, n, 2) [N m].
        radius: change of the rolling radius (T, n) [m].
        grip: factor on the friction under each wheel (T, n).
        height: of the ground under each wheel, and of what it is larger by (T, n) [m].
        climb: force of sloping ground through each wheel's centre, in the wheel frames (T, n, 2) [N].
        pull: of gravity along base_link's axes (T, 2) [m/s^2].
        straight: the tyres' curves straightened about where they are without a small change; None: the curves themselves.
        normal: loads of the wheels along the motion, on level ground (T, n) [N]; None: to be found when they are needed.
        places: of the wheels in the world, by caster (n, T, 2) [m]; None as above.
        wheels: how the wheels move along the motion; None, or another one: to be found.
    """

    torque: FloatArray | None = None
    radius: FloatArray | None = None
    grip: FloatArray | None = None
    height: FloatArray | None = None
    climb: FloatArray | None = None
    pull: FloatArray | None = None
    straight: StraightTyres | None = None
    normal: FloatArray | None = None
    places: FloatArray | None = None
    wheels: WheelMotion | None = None


NOTHING = Surroundings()


@dataclasses.dataclass
class ModelNumbers:
    """All numbers of the channel model, as arrays to be varied.

    Attributes:
        chassis: (4,) as in `dynamic_parameters`; modules: (n, 9) likewise; com_height: [m].
        steer_axis, caster_offset, radius: geometry (n, 2), (n, 2), (n,).
        steer_zero: error of the measured headings (n,) [rad].
        gain: true over reported torque of each motor (n, 2); crosstalk: part of a drive's reported torque that its steering
            gives besides (n,).
        coupling: of the gears, see `RobotDescription.gear_coupling` (n, 2, 2).
        imu_position: (2,) [m]; imu_height: above the floor [m]; gyro_bias [rad/s]; gyro_scale;
            accelerometer_bias: (2,) [m/s^2]; accelerometer_scale: (2,).
        axle: fixed axles (k, 3), k of 0 or 1: their middle [m] and heading [rad].
        tracked: where what is tracked stands: x, y [m], yaw [rad] in base_link.
        tyres: numbers of the tyres (n + k, TYRE_SIZE); softness: slip at the contact per slip of these (n + k, 2).
        damping_time: of their rubber [s]: a tyre's force is ahead of its relaxed slip by this.
        load_unrest: rate [1/s] at which loads grow while they come and go faster than a recording shows, as a part of what
            they are more or less than at rest: torques that leap make them leap, the more the more they accelerate.
        torque_lag: how long before its stamp a reported torque acted, relative to the position beside it [s].
        unreported: how much of each kind of `loops` the joints were given more than drives that hold speeds report
            (n, 2, 2) [1], [1/s].
        heading_lead: how much later the headings were that belong to the rates beside them [s]. A simulation in steps that
            makes its rates from one set of angles, and the next angles from those rates, is half a step off.
        clock: how much later than the joints' the stamps of IMU and tracker are (2,) [s].
        spring: of the chassis over each wheel [N/m].
        lean: how far the centre of mass stays behind where a rigid body would have it, per acceleration along x and y, as the
            chassis leans on its springs (2,) [s^2]; detuning: how much more of it there is per relative change of the
            frequencies of `sway`, times that change (2,) [s^2]; imu_lean: how far it does by what an IMU feels (2,) [s^2].
        sway: frequencies and damping of that. A chassis that leans when it accelerates does so too where its wheels do not
            carry it at its centre of mass.
    """

    chassis: FloatArray
    modules: FloatArray
    com_height: float
    steer_axis: FloatArray
    caster_offset: FloatArray
    radius: FloatArray
    steer_zero: FloatArray
    gain: FloatArray
    crosstalk: FloatArray
    coupling: FloatArray
    imu_position: FloatArray
    imu_height: float
    gyro_bias: float
    gyro_scale: float
    accelerometer_bias: FloatArray
    accelerometer_scale: FloatArray
    axle: FloatArray
    tracked: FloatArray
    tyres: FloatArray
    damping_time: float
    load_unrest: float
    softness: FloatArray
    torque_lag: float
    unreported: FloatArray
    heading_lead: float
    clock: FloatArray
    spring: float
    lean: FloatArray
    imu_lean: FloatArray
    detuning: FloatArray
    sway: ChassisSway

    def copy(self) -> ModelNumbers:
        """Return one whose numbers may be changed."""
        other = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                setattr(other, name, value.copy())
        return other

    def moves_as(self, other: ModelNumbers) -> bool:
        """Whether wheels that do not slip move alike under both."""
        if self is other:
            return True
        theirs = vars(other)
        return all(
            value is theirs[name] or (isinstance(value, np.ndarray) and np.array_equal(value, theirs[name])) or (
                isinstance(value, float) and value == theirs[name]
            )
            for name, value in vars(self).items() if name not in OF_NO_MOTION
        )  # fmt: skip

    @property
    def total_mass(self) -> float:
        """Chassis and modules [kg]."""
        return float(self.chassis[0] + self.modules[:, 0].sum())

    def headings(self, position: FloatArray) -> FloatArray:
        """Headings of the wheels (T, n) where joints stand at measured positions (T, n, 2) [rad]."""
        return np.ascontiguousarray(position[:, :, STEER]) + self.steer_zero

    @property
    def height_of_mass(self) -> float:
        """Height of the common centre of mass [m], the modules' at their axles."""
        return float(self.chassis[0] * self.com_height + self.modules[:, 0] @ self.radius) / self.total_mass

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
            crosstalk=np.zeros(robot.n),
            coupling=robot.gear_coupling,
            imu_position=np.array(imu.position[:2]) if imu else np.zeros(2),
            imu_height=imu.position[2] if imu else 0.0,
            gyro_bias=0.0,
            gyro_scale=1.0,
            accelerometer_bias=np.zeros(2),
            accelerometer_scale=np.ones(2),
            axle=robot.fixed_axle.copy(),
            tracked=tracked_place(robot),
            tyres=np.array([tyre_parameters(tyre) for tyre in (*robot.tyres, *(robot.contact for _ in robot.fixed_axle))]),
            damping_time=DAMPING_TIME,
            load_unrest=0.0,
            softness=np.ones((robot.n + len(robot.fixed_axle), 2)),
            torque_lag=0.0,
            unreported=np.zeros((robot.n, 2, 2)),
            heading_lead=0.0,
            clock=np.zeros(2),
            spring=robot.wheel_suspension.stiffness,
            lean=np.zeros(2),
            imu_lean=np.zeros(2),
            detuning=np.zeros(2),
            sway=ChassisSway.of(robot),
        )


def directions(steer_angle: FloatArray) -> FloatArray:
    """Cosines and sines (T, n, 2) of headings (T, n): all that most of the model knows of them, taken once."""
    return np.stack([np.cos(steer_angle), np.sin(steer_angle)], axis=2)


@compiled
def _rigid_motions(steer_axis, offset, axle, steer_angle, direction, velocity):  # type: ignore[no-untyped-def]
    twist, contradiction = np.empty((len(velocity), 3)), np.empty_like(velocity)
    for t in range(len(velocity)):
        if len(axle) == 0:
            registration_kernel(steer_axis, offset[t], direction[t], velocity[t], twist[t], contradiction[t])
        else:
            twist[t], contradiction[t], _ = guided_motion_kernel(steer_axis, offset[t], axle, steer_angle[t], velocity[t])
    return twist, contradiction


def rigid_motions(
    numbers: ModelNumbers, steer_angle: FloatArray, direction: FloatArray, velocity: FloatArray, offset: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Split velocities (T, n, 2) in the wheel frames into the twist A^+ w (T, 3) and what contradicts it (T, n, 2).

    Those of fixed axles come last, (T, n + k, 2); where they are left out, nothing moves along them.

    Args:
        steer_angle, direction: headings (T, n) [rad], and `directions` of them.
        offset: of the contacts from the steering axes in the wheel frames (T, n, 2) [m].
    """
    n = len(numbers.steer_axis)
    missing = n + len(numbers.axle) - velocity.shape[1]
    if missing:
        velocity = np.concatenate([velocity, np.zeros((len(velocity), missing, 2))], axis=1)
    twist, contradiction = _rigid_motions(
        numbers.steer_axis, offset, numbers.axle, np.ascontiguousarray(steer_angle), direction, velocity
    )
    return twist, np.ascontiguousarray(contradiction[:, :n])


def _offsets(
    numbers: ModelNumbers, direction: FloatArray, tilt: FloatArray | None = None
) -> FloatArray:
    """Offsets (T, n, 2) [m] of the contacts from the steering axes, of a chassis that is tilted so (T, 2); None: upright."""
    offsets = np.empty(direction.shape)
    offsets[:] = numbers.caster_offset
    if tilt is not None:
        offsets[:, :, 0] -= numbers.radius * (direction[:, :, 0] * tilt[:, :1] + direction[:, :, 1] * tilt[:, 1:])
    return offsets


@compiled
def _rolling_velocities(radius, offset, velocity):  # type: ignore[no-untyped-def]
    """Velocities B q_dot (T, n, 2) of the wheel centres in the wheel frames that joint rates (T, n, 2) make without slip."""
    found = np.empty(velocity.shape)
    for t in range(velocity.shape[0]):
        for i in range(velocity.shape[1]):
            found[t, i, 0] = radius[i] * velocity[t, i, 0] + offset[t, i, 1] * velocity[t, i, 1]
            found[t, i, 1] = -offset[t, i, 0] * velocity[t, i, 1]
    return found


def _twists(
    numbers: ModelNumbers, steer_angle: FloatArray, direction: FloatArray, velocity: FloatArray, offset: FloatArray
) -> tuple[FloatArray, FloatArray]:
    rolling = _rolling_velocities(numbers.radius, offset, velocity)
    return rigid_motions(numbers, steer_angle, direction, rolling, offset)


def twists(numbers: ModelNumbers, steer_angle: FloatArray, velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Wheels' twist (T, 3) and what of each wheel's motion contradicts it (T, n, 2) [m/s], of joint rates (T, n, 2)."""
    direction = directions(steer_angle)
    return _twists(numbers, steer_angle, direction, velocity, _offsets(numbers, direction))


@compiled
def _contact_forces(  # type: ignore[no-untyped-def]
    modules, steer_axis, offset, radius, direction, velocity, acceleration, torque, spin, twist, twist_dot, normal, tilt
):
    """Forces at the contacts in the wheel frames from each joint's balance, (T, n, 2) [N].

    radius, spin, normal: rolling radius [m], torque of the ground about the vertical [N m] and load [N] of each wheel (T, n).
    """
    force = np.empty_like(torque)
    for t in range(len(torque)):
        vx, vy, omega = twist[t, 0], twist[t, 1], twist[t, 2]
        for i in range(torque.shape[1]):
            c, s = direction[t, i, 0], direction[t, i, 1]
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
            ) / radius[t, i]
            turning = m * (lever_x * ay - lever_y * ax) + modules[i, 3] * sigma_dot
            turning += (
                modules[i, 7] * acceleration[t, i, 1]
                + modules[i, 6] * acceleration[t, i, 0]
                - torque[t, i, 1]
                - spin[t, i]
            )
            ahead, aside = tilt[t, 0] * c + tilt[t, 1] * s, tilt[t, 1] * c - tilt[t, 0] * s
            weight = m * GRAVITY
            turning -= (normal[t, i] * offset[t, i, 0] - weight * cx) * aside
            turning += (normal[t, i] * offset[t, i, 1] - weight * cy) * ahead
            force[t, i, 0] = along
            force[t, i, 1] = (turning + offset[t, i, 1] * along) / offset[t, i, 0]
    return force


@compiled
def _wrench_of(steer_axis, offset, direction, force, spin):  # type: ignore[no-untyped-def]
    """Wrench on the base (T, 3) of contact forces (T, n, 2) and of torques about the vertical (T, n)."""
    wrench = np.zeros((len(force), 3))
    for t in range(len(force)):
        for i in range(direction.shape[1]):
            c, s = direction[t, i, 0], direction[t, i, 1]
            fx, fy = force[t, i, 0], force[t, i, 1]
            bx, by = offset[t, i, 0], offset[t, i, 1]
            px = steer_axis[i, 0] + bx * c - by * s
            py = steer_axis[i, 1] + bx * s + by * c
            gx, gy = c * fx - s * fy, s * fx + c * fy
            wrench[t, 0] += gx
            wrench[t, 1] += gy
            wrench[t, 2] += px * gy - py * gx + spin[t, i]
    return wrench


@compiled
def _inertial_wrench(  # type: ignore[no-untyped-def]
    chassis, modules, steer_axis, direction, velocity, acceleration, twist, twist_dot
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
            c, s = direction[t, i, 0], direction[t, i, 1]
            lever_x, lever_y = modules[i, 1] * c - modules[i, 2] * s, modules[i, 1] * s + modules[i, 2] * c
            sx, sy = steer_axis[i, 0], steer_axis[i, 1]
            sigma, sigma_dot = velocity[t, i, 1] + omega, acceleration[t, i, 1] + alpha
            ax = dx - alpha * sy - omega * omega * sx - sigma_dot * lever_y - sigma * sigma * lever_x
            ay = dy + alpha * sx - omega * omega * sy + sigma_dot * lever_x - sigma * sigma * lever_y
            m = modules[i, 0]
            fx += m * ax
            fy += m * ay
            moment += modules[i, 3] * sigma_dot + m * ((sx + lever_x) * ay - (sy + lever_y) * ax)
        wrench[t, 0], wrench[t, 1], wrench[t, 2] = fx, fy, moment
    return wrench


@compiled
def _mass_centre(chassis, modules, steer_axis, direction, total_mass):  # type: ignore[no-untyped-def]
    """Centre of mass of chassis and modules (T, 2) [m]."""
    centre = np.empty((len(direction), 2))
    for t in range(len(direction)):
        x, y = chassis[0] * chassis[1], chassis[0] * chassis[2]
        for i in range(len(modules)):
            c, s = direction[t, i, 0], direction[t, i, 1]
            x += modules[i, 0] * (steer_axis[i, 0] + modules[i, 1] * c - modules[i, 2] * s)
            y += modules[i, 0] * (steer_axis[i, 1] + modules[i, 1] * s + modules[i, 2] * c)
        centre[t, 0], centre[t, 1] = x / total_mass, y / total_mass
    return centre


def mass_centre(numbers: ModelNumbers, direction: FloatArray) -> FloatArray:
    """Centre of mass of chassis and modules (T, 2) [m], the wheels in their directions (T, n, 2)."""
    centre: FloatArray = _mass_centre(
        numbers.chassis, numbers.modules, numbers.steer_axis, direction, numbers.total_mass
    )
    return centre


@compiled
def _normal_forces(  # type: ignore[no-untyped-def]
    mass, com, height_of_mass, spring, steer_axis, caster_offset, axle, direction, acceleration, height
):
    """Quasi-static normal forces (T, n + k) [N] from centre of mass and accelerations (T, 2), over a height (T, n + k)."""
    normal = np.empty_like(height)
    centre = np.empty((height.shape[1], 2))
    centre[len(steer_axis) :] = axle[:, :2]
    for t in range(len(direction)):
        for i in range(direction.shape[1]):
            c, s = direction[t, i, 0], direction[t, i, 1]
            centre[i, 0] = steer_axis[i, 0] + caster_offset[i, 0] * c - caster_offset[i, 1] * s
            centre[i, 1] = steer_axis[i, 1] + caster_offset[i, 0] * s + caster_offset[i, 1] * c
        moment_x = mass * (GRAVITY * com[t, 0] - height_of_mass * acceleration[t, 0])
        moment_y = mass * (GRAVITY * com[t, 1] - height_of_mass * acceleration[t, 1])
        support_forces(mass * GRAVITY, moment_x, moment_y, spring, centre, height[t], normal[t])
    return normal


def normal_forces(
    numbers: ModelNumbers, direction: FloatArray, acceleration: FloatArray, height: FloatArray | None = None
) -> FloatArray:
    """Quasi-static normal forces (T, n + k) [N] on the wheels, then on fixed axles.

    Args:
        direction: of the wheels (T, n, 2).
        acceleration: of base_link in its own axes (T, 2).
        height: of the ground under each wheel (T, n) [m]; None where it is level.
    """
    # On level ground the load does not depend on how stiff equal springs are, and rigid ones know no other.
    ground = np.zeros((len(direction), direction.shape[1] + len(numbers.axle)))
    if height is not None and numbers.spring > 0.0:
        ground[:, : height.shape[1]] = height
    forces: FloatArray = _normal_forces(
        numbers.total_mass, mass_centre(numbers, direction), numbers.height_of_mass, numbers.spring or 1.0,
        numbers.steer_axis, numbers.caster_offset, numbers.axle, direction, acceleration, ground,
    )  # fmt: skip
    return forces


@compiled
def _shared_forces(steer_axis, caster_offset, axle, steer_angle, wrench):  # type: ignore[no-untyped-def]
    """Smallest contact forces (T, n + k, 2) in the wheel frames that make a wrench (T, 3): A (A^T A)^-1 w."""
    n = len(steer_axis)
    force = np.zeros((len(wrench), n + len(axle), 2))
    for t in range(len(wrench)):
        _, _, normal_inverse = guided_motion_kernel(steer_axis, caster_offset, axle, steer_angle[t], force[t])
        per_length = normal_inverse @ wrench[t]
        flat = wheel_jacobian_kernel(steer_axis, caster_offset, steer_angle[t]) @ per_length
        for i in range(n):
            force[t, i, 0], force[t, i, 1] = flat[2 * i], flat[2 * i + 1]
        for a in range(len(axle)):
            force[t, n + a, 1] = axle_row_kernel(axle[a]) @ per_length
    return force


@compiled
def slip_ratios(tyres, force, grip):  # type: ignore[no-untyped-def]
    """Steady slip ratios (T, n, 2) under forces (T, n, 2) [N] on wheels of load times friction factor grip (T, n) [N]."""
    ratio = np.empty_like(force)
    for t in range(len(force)):
        for i in range(force.shape[1]):
            ratio[t, i, 0], ratio[t, i, 1] = slip_of_force(tyres[i], force[t, i, 0], force[t, i, 1], grip[t, i])
    return ratio


@compiled
def _scrub(tyres, turn_rate, speed, grip):  # type: ignore[no-untyped-def]
    """Torques of the ground on the wheels about the vertical (T, n) [N m]."""
    torque = np.empty_like(turn_rate)
    for t in range(len(turn_rate)):
        for i in range(turn_rate.shape[1]):
            torque[t, i] = scrub_torque(tyres[i], turn_rate[t, i], speed[t, i], grip[t, i])
    return torque


def acceleration_of(twist: FloatArray, twist_dot: FloatArray) -> FloatArray:
    """Acceleration (T, 2) of base_link's origin in its own axes [m/s^2]."""
    return twist_dot[:, :2] + twist[:, 2:] * np.stack([-twist[:, 1], twist[:, 0]], axis=1)


def slips(
    numbers: ModelNumbers,
    rate: float,
    wheels: WheelMotion,
    force: FloatArray,
    grip: FloatArray,
    straight: StraightTyres | None = None,
) -> FloatArray:
    """Slip velocities (T, n, 2) [m/s] of rolling tyres under forces (T, n, 2) and loads times friction factors (T, n) [N]."""
    if straight is not None and np.array_equal(straight.tyres[:, :LENGTH], numbers.tyres[:, :LENGTH]):
        ratio = straight.ratios(force, grip)
    elif straight is not None and straight.in_place:
        ratio = StraightTyres.about(numbers, straight.force, straight.grip).ratios(force, grip)
    else:
        ratio = slip_ratios(numbers.tyres, force, grip)
    return slips_of_ratios(numbers, rate, wheels, ratio)


def slips_of_ratios(numbers: ModelNumbers, rate: float, wheels: WheelMotion, ratio: FloatArray) -> FloatArray:
    """Slip velocities (T, n, 2) [m/s] of rolling tyres whose forces ask for slip ratios (T, n, 2) where nothing changes.

    Ratios are of the faster of tread and wheel. A wheel that brakes is faster than its tread, by the slip itself: taken for
    as fast its slip would be too small by that part of it, as if it bent more with the force on a floor of less friction.
    """
    ratio = numbers.softness * ratio
    ratio -= numbers.damping_time * derivative(ratio, rate)
    growth = loading(wheels.normal, rate)
    if numbers.load_unrest:
        at_rest = normal_forces(numbers, wheels.direction, np.zeros((len(ratio), 2)), wheels.height)
        growth = growth + numbers.load_unrest * np.abs(wheels.normal - at_rest) / np.maximum(wheels.normal, 1.0)
    lag = numbers.tyres[:, LENGTH, None] * (derivative(ratio, rate) + growth[:, :, None] * ratio)
    slip = wheels.speed[:, :, None] * ratio + lag
    # Two rounds of it would differ by the square of a ratio.
    speed = np.maximum(wheels.speed, np.hypot(wheels.tread - slip[:, :, 0], slip[:, :, 1]))
    result: FloatArray = speed[:, :, None] * ratio + lag
    return result


def loading(normal: FloatArray, rate: float) -> FloatArray:
    """Rates at which loads (T, n) [N] grow, of themselves [1/s]; zero where they fall.

    What more load brings to the ground is not sheared yet, see `slip_under_load`: it takes up relaxed slip.
    """
    growth: FloatArray = np.maximum(derivative(normal, rate), 0.0) / np.maximum(normal, 1.0)
    return growth


def _axle_velocities(numbers: ModelNumbers, twist: FloatArray) -> FloatArray:
    """Velocities (T, k) of fixed axles along their headings in a motion (T, 3)."""
    x, y, heading = numbers.axle.T
    along = twist[:, :1] - twist[:, 2:] * y
    across = twist[:, 1:2] + twist[:, 2:] * x
    velocities: FloatArray = np.cos(heading) * along + np.sin(heading) * across
    return velocities


def wrench_of(numbers: ModelNumbers, state: RollingState) -> FloatArray:
    """Wrench on the base (T, 3) of the forces under rolling wheels."""
    wheels = state.wheels
    wrench: FloatArray = _wrench_of(numbers.steer_axis, wheels.offset, wheels.direction, state.load, state.spin)
    return wrench


def inertial_wrench(
    numbers: ModelNumbers, motion: RobotMotion, direction: FloatArray, twist: FloatArray, twist_dot: FloatArray
) -> FloatArray:
    """Wrench (T, 3) that accelerates chassis and modules moving with a twist (T, 3), the wheels in directions (T, n, 2)."""
    wrench: FloatArray = _inertial_wrench(
        numbers.chassis, numbers.modules, numbers.steer_axis, direction, motion.velocity, motion.acceleration, twist, twist_dot
    )
    return wrench


def _leaning(numbers: ModelNumbers, rate: float, twist: FloatArray, twist_dot: FloatArray) -> FloatArray | None:
    """How far the centre of mass is behind a rigid body's as it accelerates (T, 2) [m]; None for a rigid body."""
    if not (numbers.lean.any() or numbers.detuning.any()):
        return None
    acceleration = acceleration_of(twist, twist_dot)
    leaning = numbers.lean * numbers.sway.response(acceleration, rate)
    if numbers.detuning.any():
        leaning = leaning + numbers.detuning * numbers.sway.detuned(acceleration, rate)
    return leaning


@compiled
def _contact_centre(steer_axis, caster_offset, direction):  # type: ignore[no-untyped-def]
    """Mean (T, 2) [m] of the wheel centres."""
    n = len(steer_axis)
    centre = np.empty((len(direction), 2))
    for t in range(len(direction)):
        x, y = 0.0, 0.0
        for i in range(n):
            c, s = direction[t, i, 0], direction[t, i, 1]
            x += steer_axis[i, 0] + caster_offset[i, 0] * c - caster_offset[i, 1] * s
            y += steer_axis[i, 1] + caster_offset[i, 0] * s + caster_offset[i, 1] * c
        centre[t, 0], centre[t, 1] = x / n, y / n
    return centre


@compiled
def _gradients(steer_axis, caster_offset, direction, height):  # type: ignore[no-untyped-def]
    """Slopes (T, 2) of the planes nearest to the heights (T, n) under the wheels."""
    found, centre = np.empty((len(height), 2)), np.empty(steer_axis.shape)
    for t in range(len(height)):
        for i in range(len(centre)):
            c, s = direction[t, i, 0], direction[t, i, 1]
            centre[i, 0] = steer_axis[i, 0] + caster_offset[i, 0] * c - caster_offset[i, 1] * s
            centre[i, 1] = steer_axis[i, 1] + caster_offset[i, 0] * s + caster_offset[i, 1] * c
        slope_x, slope_y = plane_gradient(centre, height[t])
        found[t, 0], found[t, 1] = slope_x, slope_y
    return found


def _tilt(numbers: ModelNumbers, leaning: FloatArray, lean: FloatArray, direction: FloatArray) -> FloatArray:
    """The vertical in the horizontal axes of the chassis (T, 2): how it leans as it accelerates, and where it stands.

    Args:
        leaning: (T, 2) [m], as of `_leaning`; lean: the number it was made with (2,) [s^2].
        direction: of the wheels (T, n, 2).
    """
    contact = _contact_centre(numbers.steer_axis, numbers.caster_offset, direction)
    height, aside_of_it = numbers.height_of_mass, mass_centre(numbers, direction) - contact
    tilt: FloatArray = leaning / height - lean * GRAVITY / height**2 * aside_of_it
    return tilt


@dataclasses.dataclass(frozen=True)
class WheelMotion:
    """How the wheels of a robot move along a motion before their slip: whatever friction there is, and whatever torque.

    Attributes:
        motion: of the joints; numbers: of the model; radius_change, pull, height: of the `Surroundings` it was made with.
        steer_angle, radius: true headings [rad] and rolling radii [m] (T, n); direction: `directions` of the former.
        offset: of the contacts from the steering axes in the wheel frames (T, n, 2) [m].
        velocity: joint rates that wheels of the described radius would have (T, n, 2).
        twist, twist_dot: that all wheels have together (T, 3); contradiction: what contradicts it (T, n, 2).
        felt: the latter of a robot on level ground under the same forces (T, 3); tilt: of its chassis (T, 2), standing: the
            part of it by the heights under its wheels.
        normal, tread: loads [N], and velocities of the treads along the headings [m/s] (T, n + k), fixed axles last.
    """

    motion: RobotMotion
    numbers: ModelNumbers
    radius_change: FloatArray | None
    pull: FloatArray | None
    height: FloatArray | None
    steer_angle: FloatArray
    direction: FloatArray
    radius: FloatArray
    offset: FloatArray
    velocity: FloatArray
    twist: FloatArray
    twist_dot: FloatArray
    contradiction: FloatArray
    felt: FloatArray
    tilt: FloatArray
    standing: FloatArray
    normal: FloatArray
    tread: FloatArray

    @functools.cached_property
    def speed(self) -> FloatArray:
        """Rolling speeds (T, n + k) [m/s]."""
        return np.abs(self.tread)

    def holds_for(self, motion: RobotMotion, numbers: ModelNumbers, around: Surroundings) -> bool:
        """Whether it is that of this very motion and of these surroundings, and of such numbers."""
        made_with = self.motion, self.radius_change, self.pull, self.height
        asked = motion, around.radius, around.pull, around.height
        same = all(one is other for one, other in zip(made_with, asked, strict=True))
        return same and self.numbers.moves_as(numbers)


@dataclasses.dataclass(frozen=True)
class RollingState:
    """How the wheels of a robot roll along a motion, before their slip.

    Attributes:
        wheels: how they move.
        grip: load times friction factor (T, n + k) [N], fixed axles last.
        spin: torque of the ground on each wheel about the vertical (T, n) [N m].
        force: of the tyres in the wheel frames (T, n + k, 2) [N].
        load: the same with what sloping ground pushes besides, which is what the base feels (T, n + k, 2) [N].
    """

    wheels: WheelMotion
    grip: FloatArray
    spin: FloatArray
    force: FloatArray
    load: FloatArray


def wheel_motion(motion: RobotMotion, numbers: ModelNumbers, around: Surroundings = NOTHING) -> WheelMotion:
    """Return how the wheels move along a motion."""
    steer_angle = numbers.headings(motion.position)
    if numbers.heading_lead:
        steer_angle += numbers.heading_lead * motion.velocity[:, :, STEER]
    velocity, radius = motion.velocity, np.broadcast_to(numbers.radius, steer_angle.shape)
    if around.radius is not None:
        radius = radius + around.radius
        velocity = velocity.copy()
        velocity[:, :, DRIVE] *= radius / numbers.radius
    radius = np.ascontiguousarray(radius)
    # On a slope, forces and loads are those of a robot that is accelerated uphill.
    pull = np.zeros(2) if around.pull is None else around.pull
    direction = directions(steer_angle)
    offset = _offsets(numbers, direction)
    twist, contradiction = _twists(numbers, steer_angle, direction, velocity, offset)
    twist_dot = derivative(twist, motion.rate)
    leaning = _leaning(numbers, motion.rate, twist, _without(twist_dot, pull))
    tilt = np.zeros((len(twist), 2))
    if leaning is not None:
        tilt = _tilt(numbers, leaning, numbers.lean, direction)
    standing = np.zeros_like(tilt)
    if around.height is not None:
        standing = _gradients(numbers.steer_axis, numbers.caster_offset, direction, around.height)
        tilt = tilt + standing
    if tilt.any():
        offset = _offsets(numbers, direction, tilt)
        twist, contradiction = _twists(numbers, steer_angle, direction, velocity, offset)
        twist_dot = derivative(twist, motion.rate)
    felt = _without(twist_dot, pull)
    normal = normal_forces(numbers, direction, acceleration_of(twist, felt), around.height)
    tread = np.concatenate([velocity[:, :, DRIVE] * numbers.radius, _axle_velocities(numbers, twist)], axis=1)
    return WheelMotion(
        motion, numbers, around.radius, around.pull, around.height,
        steer_angle, direction, radius, offset, velocity, twist, twist_dot, contradiction, felt, tilt, standing, normal, tread,
    )  # fmt: skip


def weights_on_steerings(motion: RobotMotion, numbers: ModelNumbers) -> FloatArray:
    """Torques (T, n) [N m] by which weights turn the steerings of a chassis that leans: (N b - m g c) x t, see the module."""
    wheels, n = wheel_motion(motion, numbers), len(numbers.modules)
    c, s = wheels.direction[:, :, 0], wheels.direction[:, :, 1]
    ahead = wheels.tilt[:, :1] * c + wheels.tilt[:, 1:] * s
    aside = wheels.tilt[:, 1:] * c - wheels.tilt[:, :1] * s
    arm = wheels.normal[:, :n, None] * wheels.offset[:, :n] - GRAVITY * numbers.modules[:, :1] * numbers.modules[:, 1:3]
    torque: FloatArray = arm[:, :, 0] * aside - arm[:, :, 1] * ahead
    return torque


def rolling_state(
    motion: RobotMotion, numbers: ModelNumbers, layout: ChannelLayout, around: Surroundings = NOTHING
) -> RollingState:
    """Return how the wheels roll along a motion, and the forces under them."""
    wheels = around.wheels
    if wheels is None or not wheels.holds_for(motion, numbers, around):
        wheels = wheel_motion(motion, numbers, around)
    direction, offset, velocity, twist, felt = wheels.direction, wheels.offset, wheels.velocity, wheels.twist, wheels.felt
    n = len(numbers.steer_axis)
    grip = np.maximum(wheels.normal, 1.0)
    if around.grip is not None:
        grip[:, :n] = np.maximum(wheels.normal[:, :n] * around.grip, 1.0)
    patches = numbers.tyres[:n].copy()
    patches[:, LAMBDA] *= numbers.softness[:n, 0]  # the edge of a patch slips as the tyre does
    spin = _scrub(patches, velocity[:, :, STEER] + twist[:, 2:], wheels.speed, grip)
    if layout.balanced:
        added = added_torque(motion, numbers, around)
        if around.climb is not None:  # it pushes the module like a torque that the wheel's own balance does not hold
            added[:, :, DRIVE] += wheels.radius * around.climb[:, :, 0]
        load, force = (
            _contact_forces(
                numbers.modules, numbers.steer_axis, offset, wheels.radius, direction, velocity, motion.acceleration,
                torque + added, spin, twist, felt, wheels.normal, wheels.tilt,
            )
            for torque in (motion.torque - (0.0 if motion.error is None else motion.error.torque), motion.quiet_torque)
        )  # fmt: skip
        if around.climb is not None:
            force = force - around.climb
    else:
        wrench = inertial_wrench(numbers, motion, direction, twist, felt)
        if around.climb is not None:
            wrench = wrench - _wrench_of(numbers.steer_axis, offset, direction, around.climb, np.zeros_like(spin))
        force = load = _shared_forces(numbers.steer_axis, numbers.caster_offset, numbers.axle, wheels.steer_angle, wrench)
    return RollingState(wheels, grip, spin, force, load)


def added_torque(motion: RobotMotion, numbers: ModelNumbers, around: Surroundings) -> FloatArray:
    """What joints are given besides the torques that were reported (T, n, 2) [N m]."""
    # What is scaled, and what makes wheels slip, is the torque without the noise of its report: with it gains, and loads of
    # tyres, would be found as small, or as large, as makes that noise least.
    added = np.zeros_like(motion.torque) if around.torque is None else around.torque.copy()
    added += _scaled_by_motors(motion.balanced_torque, numbers) + numbers.torque_lag * motion.torque_rate
    if numbers.unreported.any():
        added += np.sum(numbers.unreported * motion.loops, axis=3)
    return added


def _scaled_by_motors(torque: FloatArray, numbers: ModelNumbers) -> FloatArray:
    """What motors give more than they report on joints (T, n, 2): a motor's own error reaches both where gears are coupled."""
    errors = numbers.gain - 1.0
    if not numbers.coupling[:, [0, 1], [1, 0]].any():
        return errors * torque
    more = np.einsum("nij,nj,njk->nik", np.linalg.inv(numbers.coupling), errors, numbers.coupling)
    more[:, DRIVE, STEER] += numbers.crosstalk
    added: FloatArray = np.einsum("tni,nik->tnk", torque, more)
    return added


def _without(twist_dot: FloatArray, pull: FloatArray) -> FloatArray:
    """A twist's derivative (T, 3) without the pull of gravity along the floor."""
    felt = twist_dot.copy()
    felt[:, :2] -= pull
    return felt


def at_place(twist: FloatArray, place: FloatArray) -> FloatArray:
    """Twist (T, 3) of what stands at a place (x, y, yaw) in base_link, in its own axes."""
    x, y, yaw = place
    along, across = twist[:, 0] - twist[:, 2] * y, twist[:, 1] + twist[:, 2] * x
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * along + s * across, c * across - s * along, twist[:, 2]], axis=1)


def channel_sides(
    motion: RobotMotion, numbers: ModelNumbers, layout: ChannelLayout, around: Surroundings = NOTHING
) -> tuple[FloatArray, FloatArray]:
    """Measured and predicted side of every channel at the motion's rate, (T, C) each.

    Args:
        motion: the motion.
        numbers: of the model.
        layout: which channels are wanted.
        around: what else is at work.
    """
    state = rolling_state(motion, numbers, layout, around)
    wheels = state.wheels
    slip = slips(numbers, motion.rate, wheels, state.force, state.grip, around.straight)
    slip_twist, slip_contradiction = rigid_motions(numbers, wheels.steer_angle, wheels.direction, slip, wheels.offset)
    twist = wheels.twist - slip_twist
    twist_dot = derivative(twist, motion.rate)
    leaning = _leaning(numbers, motion.rate, twist, twist_dot)
    measured, predicted = [], []
    if layout.balanced:
        base = wrench_of(numbers, state)
        measured.append(base if motion.error is None else base + motion.error.wrench)
        wrench = inertial_wrench(numbers, motion, wheels.direction, twist, twist_dot)
        if leaning is not None:
            wrench[:, :2] -= numbers.total_mass * derivative(derivative(leaning, motion.rate), motion.rate)
        predicted.append(wrench)
    if layout.redundant:
        measured.append(wheels.contradiction.reshape(len(twist), -1))
        predicted.append(slip_contradiction.reshape(len(twist), -1))
    if layout.imu:
        x, y = numbers.imu_position
        omega, alpha = twist[:, 2], twist_dot[:, 2]
        late = numbers.clock[0] * derivative(motion.imu, motion.rate) if numbers.clock[0] else 0.0
        measured.append(motion.imu + late)
        rate = numbers.gyro_scale * omega + numbers.gyro_bias
        along = twist_dot[:, 0] - omega * twist[:, 1] - alpha * y - omega**2 * x
        across = twist_dot[:, 1] + omega * twist[:, 0] + alpha * x - omega**2 * y
        standing = numbers.sway.response(wheels.standing, motion.rate) if wheels.standing.any() else wheels.standing
        tilt = standing if leaning is None else standing + leaning / numbers.height_of_mass
        if tilt.any():
            # The higher a sensor stands, the farther it swings with the chassis.
            swinging = numbers.imu_height * derivative(derivative(tilt, motion.rate), motion.rate)
            # And as it leans with it, it feels a part of its weight.
            thrown = GRAVITY * standing - swinging
            along, across = along + thrown[:, 0], across + thrown[:, 1]
        felt = numbers.accelerometer_scale * np.stack([along, across], axis=1) + numbers.accelerometer_bias
        sensed = np.concatenate([rate[:, None], felt], axis=1)
        if numbers.imu_lean.any():
            leaning = numbers.imu_lean * numbers.sway.response(acceleration_of(twist, twist_dot), motion.rate)
            sensed[:, 1:] += GRAVITY * _tilt(numbers, leaning, numbers.imu_lean, wheels.direction)
        predicted.append(sensed)
    if layout.pose:
        late = numbers.clock[1] * derivative(motion.tracked_twist, motion.rate) if numbers.clock[1] else 0.0
        measured.append(motion.tracked_twist + late)
        predicted.append(at_place(twist, numbers.tracked))
    return np.concatenate(measured, axis=1), np.concatenate(predicted, axis=1)


def model_awaits_compiling() -> bool:
    """Whether the model's first use will take seconds longer than any later one on this machine."""
    return awaits_compiling(_contact_forces)
