"""What a robot's channels would be with an effect at work.

The effect's own function is called where it acts: on the description, on what was read, in a gear, under a wheel, on a
joint, on what gravity and other forces do. The difference to the channels without it, per unit of a parameter, is the
effect's column; nothing is derived by hand. What acts between a command and the motor's torque shows in `command_tracking`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy import signal

from pcw_description.compiled import ARRAY_SIGNATURE, compiled, compiled_for_kernel
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.effect import Effect
from pcw_description.effects.kinds import (
    COM_X,
    COM_Y,
    COM_Z,
    CONTACT_INPUTS,
    CONTACT_RESULTS,
    CONTACT_TIME,
    CONTACT_X,
    CONTACT_Y,
    FORCE_INPUTS,
    FORCE_TIME,
    FRICTION,
    GRADIENT_X,
    GRADIENT_Y,
    HEIGHT,
    LOAD,
    POSE_X,
    POSE_YAW,
    RADIUS_CHANGE,
    RADIUS_SLOPE,
    ROLL_ANGLE,
    TWIST_X,
    TWIST_YAW,
    ChassisForceEffect,
    ClockEffect,
    ContactEffect,
    DescriptionEffect,
    EncoderEffect,
    Gear,
    GravityEffect,
    ImuEffect,
    JointTorqueEffect,
    TransmissionEffect,
)
from pcw_description.effects.registry import get
from pcw_description.robot_description import AXIS_NAMES, DRIVE, GRAVITY, STEER, RobotDescription

from ..axis.axis_channels import kernel_arguments
from ..regression.regression_problem import BoolArray, FloatArray
from ..regression.signal_filter import SignalFilter, derivative
from .joint_balance import joint_sides
from .robot_motion import RobotMotion
from .rolling_model import (
    NOTHING,
    ChannelLayout,
    ModelNumbers,
    Surroundings,
    acceleration_of,
    channel_sides,
    directions,
    normal_forces,
    twists,
)

Sides = tuple[FloatArray, FloatArray]
# A gear's play changes sides once its torque is this part of its size the other way: below it are noise and free rolling.
PLAY_TORQUE = 0.1
# Periods of its cutoff that a step needs behind a filter from there to half of its height.
RISE = 0.2
# How often a wheel's load and what it does to the wheel are found from each other, down to so many metres.
LOAD_ROUNDS, LEAST_LIFT = 6, 1e-6
# What begins between two samples of a motion is seen so many times between them.
BETWEEN_SAMPLES = 12
# A torque by the angle may change faster than a motion is sampled: 30 ripples a turn, at one turn a second, are 30 Hz. It is
# computed between samples and low-passed by so many taps: flat to a sixth of their rate, none left beyond six tenths of it.
RIPPLE_TAPS, RIPPLE_CUTOFF = 96, 0.38
# Numbers of a model that loads of wheels, and their headings, come from.
OF_LOADS = ("chassis", "modules", "com_height", "steer_axis", "caster_offset", "radius", "steer_zero")


def with_pose(motions: Sequence[RobotMotion], numbers: ModelNumbers) -> list[RobotMotion]:
    """Return the motions with a pose everywhere: from the wheels where none was tracked.

    Beside what was tracked the wheels go on from there, or lead there; over a gap in it they are put right at both ends.
    Without any they go on from the piece before, over the gap with a twist in a line from its last value to its next, or
    begin at zero.
    """
    found: list[RobotMotion] = []
    for motion in motions:
        known = np.asarray(np.isfinite(motion.pose).all(axis=1), dtype=bool)
        if known.all():
            found.append(motion)
            continue
        twist = twists(numbers, numbers.headings(motion.position), motion.velocity)[0]
        if known.any():
            pose = _completed(motion.pose, known, twist, motion.time)
        elif found and found[-1].recording == motion.recording:
            pose = _rolled(_beyond(found[-1], numbers, twist[0], motion.time[0]), twist, motion.time)
        else:
            pose = _rolled(np.zeros(3), twist, motion.time)
        found.append(dataclasses.replace(motion, pose=pose))
    return found


def _beyond(before: RobotMotion, numbers: ModelNumbers, after: FloatArray, time: float) -> FloatArray:
    """Pose (3,) at the end of the gap that follows a piece, of a twist (3,) at a time."""
    last = twists(numbers, numbers.headings(before.position[-1:]), before.velocity[-1:])[0][0]
    gap = time - before.time[-1]
    yaws = before.pose[-1, 2] + np.array([0.0, 0.5 * (last[2] + after[2]) * gap])
    ways = [0.5 * gap * _turned(twist, yaw) for twist, yaw in zip((last, after), yaws, strict=True)]
    return np.asarray(before.pose[-1] + ways[0] + ways[1], dtype=np.float64)


def _turned(twist: FloatArray, yaw: float) -> FloatArray:
    """Twist (3,) along the axes of the world."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([c * twist[0] - s * twist[1], s * twist[0] + c * twist[1], twist[2]])


def _completed(pose: FloatArray, known: BoolArray, twist: FloatArray, time: FloatArray) -> FloatArray:
    """Poses (T, 3) where they are known (T,), and elsewhere as a twist (T, 3) leads from one to the next."""
    completed = pose.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[True], known, [True]])))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        if first == 0:
            back = slice(last, None, -1)
            completed[back] = _rolled(pose[last], twist[back], time[back])
            continue
        way = slice(first - 1, last + 1)
        rolled = _rolled(pose[first - 1], twist[way], time[way])
        if last < len(pose):
            part = (time[way] - time[first - 1]) / (time[last] - time[first - 1])
            rolled += part[:, None] * (pose[last] - rolled[-1])
        completed[way] = rolled
    return completed


def _rolled(start: FloatArray, twist: FloatArray, time: FloatArray) -> FloatArray:
    """Poses (T, 3) from the first one on with a twist (T, 3) in the body's axes; times may go backwards."""
    steps = np.diff(time)
    yaw = start[2] + _integral(twist[:, 2], steps)
    c, s = np.cos(yaw), np.sin(yaw)
    x = start[0] + _integral(c * twist[:, 0] - s * twist[:, 1], steps)
    y = start[1] + _integral(s * twist[:, 0] + c * twist[:, 1], steps)
    return np.column_stack([x, y, yaw])


def _integral(values: FloatArray, steps: FloatArray) -> FloatArray:
    """Integrate (T,) over steps (T - 1,) by trapezoids, from zero."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * steps)])


def normal_along(motion: RobotMotion, numbers: ModelNumbers, height: FloatArray | None = None) -> FloatArray:
    """Normal forces (T, n) [N] along a motion, over ground of a height (T, n) [m]."""
    angle = numbers.headings(motion.position)
    twist, _ = twists(numbers, angle, motion.velocity)
    acceleration = acceleration_of(twist, derivative(twist, motion.rate))
    normal = normal_forces(numbers, directions(angle), acceleration, height)
    return np.ascontiguousarray(normal[:, : len(numbers.steer_axis)])


def with_true_angles(
    robot: RobotDescription,
    motion: RobotMotion,
    effect: EncoderEffect | TransmissionEffect,
    target: Sequence[str],
    values: Mapping[str, float],
    axis: str | None,
) -> RobotMotion:
    """Return the motion of the joints themselves: errors of reading, and what gears give way, taken back to first order."""
    position, velocity = motion.position.copy(), motion.velocity.copy()
    acceleration = motion.acceleration
    column = AXIS_NAMES.index(axis or effect.axis)
    for name in target:
        i = robot.caster_index(name)
        if isinstance(effect, EncoderEffect):
            seen = motion.position[:, i, column], motion.velocity[:, i, column]
            again = effect.measure(*seen, values)
            position[:, i, column] -= again[0] - seen[0]
            velocity[:, i, column] -= again[1] - seen[1]
        else:
            if acceleration is motion.acceleration:
                acceleration = acceleration.copy()
            ahead = _wind_up(robot, motion, i, column, effect.gear(values))
            position[:, i] -= ahead
            rate = derivative(ahead, motion.rate)
            velocity[:, i] -= rate
            acceleration[:, i] -= derivative(rate, motion.rate)
    return dataclasses.replace(motion, position=position, velocity=velocity, acceleration=acceleration)


def _wind_up(robot: RobotDescription, motion: RobotMotion, i: int, axis: int, gear: Gear) -> FloatArray:
    """How far the readings of caster i are ahead of its joints through a gear (T, 2) [rad], drive and steer."""
    diagonal, coupling = np.diag(robot.gear_matrix[i]), robot.gear_coupling[i]
    rotors = robot.casters[i].rotors
    rotor = (rotors.drive, rotors.steer)[axis] * diagonal[axis] ** 2
    shaft = motion.quiet_torque[:, i] @ np.linalg.inv(coupling)
    torque = shaft[:, axis] - rotor * (motion.acceleration[:, i] @ coupling[axis])
    ahead = _lagging(torque / gear.stiffness, gear.damping / gear.stiffness * motion.rate)
    if gear.play > 0.0:
        blur = RISE / motion.cutoff * motion.rate
        ahead = ahead + 0.5 * gear.play * _flank(torque, motion.velocity[:, i] @ coupling[axis], blur)
    smooth = SignalFilter(motion.rate, motion.cutoff).smooth(ahead)
    moved: FloatArray = smooth[:, None] * np.linalg.inv(coupling)[:, axis]
    return moved


def _lagging(values: FloatArray, lag: float) -> FloatArray:
    """What follows values (T,) with a time constant of `lag` samples: the twist of a spring that is damped."""
    leading = 1.0 + 2.0 * lag  # divided by here: what starts a filter does so itself only since scipy 1.12
    numerator, denominator = [1.0 / leading, 1.0 / leading], [1.0, (1.0 - 2.0 * lag) / leading]
    start = signal.lfiltic(numerator, denominator, y=values[:1], x=values[:1])
    followed: FloatArray = signal.lfilter(numerator, denominator, values, zi=start)[0]
    return followed


def _flank(torque: FloatArray, rate: FloatArray, blur: float) -> FloatArray:
    """Which flank of its play a gear lies on under a torque (T,): 1, -1, between them, and 0 before the first clear torque.

    Where next to no torque passes through it the motor is free. If it then comes to lie on the other flank, it has left the
    one with the joint's speed and gone ahead ever faster: with the square of the way (T,) of its rate [rad/s], so that nothing
    is crossed at rest. If it comes to lie on the same flank again, it has not left it.

    Args:
        blur: samples by which a filter shows the torque of the flank that is hit before it is hit.
    """
    clear = np.flatnonzero(np.abs(torque) > PLAY_TORQUE * float(np.sqrt(np.mean(torque**2))))
    index, sides = np.arange(len(torque)), np.sign(torque[clear])
    changes = np.flatnonzero(np.diff(sides))
    flank = np.where(index >= clear[0], sides[0], 0.0) if len(clear) else np.zeros(len(torque))
    if not len(changes):
        return flank
    left, reached = clear[changes], sides[changes + 1]
    hit = np.minimum(clear[changes + 1] + blur, np.append(left[1:], index[-1]))
    way = np.cumsum(np.abs(rate))
    latest = np.searchsorted(left, index, side="right") - 1
    whole = np.interp(hit, index, way) - way[left]
    crossed = np.clip((way - way[left[latest]]) / np.maximum(whole[latest], 1e-300), 0.0, 1.0)
    crossed[index >= hit[latest]] = 1.0
    flank[latest >= 0] = (reached[latest] * (2.0 * crossed**2 - 1.0))[latest >= 0]
    return flank


def true_motion(robot: RobotDescription, motion: RobotMotion) -> RobotMotion:
    """Return the motion without the errors of readings and clocks, and the give of gears, that the robot's `physics` hold."""
    for instance in robot.physics:
        effect = get(instance.name)
        if isinstance(effect, (EncoderEffect, TransmissionEffect)):
            motion = with_true_angles(robot, motion, effect, instance.target, instance.parameters, instance.axis)
        elif isinstance(effect, ClockEffect):
            inertial, tracked = (effect.offset(topic, instance.parameters) for topic in ("imu/data", "ground_truth/odom"))
            motion = with_leads(motion, inertial, tracked)
    return motion


def with_leads(motion: RobotMotion, inertial: float, tracked: float) -> RobotMotion:
    """Return the motion with what IMU and tracker sensed in its time, where their stamps are ahead by so much [s]."""
    return dataclasses.replace(
        motion,
        imu=_later(motion, motion.imu, inertial),
        pose=_later(motion, motion.pose, tracked),
        tracked_twist=_later(motion, motion.tracked_twist, tracked),
    )


def _later(motion: RobotMotion, values: FloatArray, offset: float) -> FloatArray:
    """Signals (T, K) of a motion read an offset later [s]."""
    if offset == 0.0:
        return values
    return np.stack([np.interp(motion.time + offset, motion.time, column) for column in values.T], axis=1)


@compiled_for_kernel(
    ARRAY_SIGNATURE, "float64[:, :, ::1]", "float64[::1], float64[::1], float64[:, :, ::1], float64[:, ::1], float64[:, ::1]"
)
def _contacts_along(kernel, values, time, place, roll_angle, load):  # type: ignore[no-untyped-def]
    """Results (W, T, CONTACT_RESULTS) of a contact's kernel under wheels that are at places (W, T, 2).

    Where a wheel comes upon other ground between two samples, they have the mean of the friction on the way.
    """
    wheels, count = load.shape
    found = np.zeros((wheels, count, CONTACT_RESULTS))
    at, one = np.zeros(CONTACT_INPUTS), np.zeros(CONTACT_RESULTS)
    friction = np.empty(count)
    for i in range(wheels):
        for t in range(count):
            found[i, t, FRICTION] = 1.0
            at[CONTACT_TIME], at[CONTACT_X], at[CONTACT_Y] = time[t], place[i, t, 0], place[i, t, 1]
            at[ROLL_ANGLE], at[LOAD] = roll_angle[i, t], load[i, t]
            kernel(at, values, found[i, t])
            friction[t] = found[i, t, FRICTION]
        for t in range(count):
            before, after = max(t - 1, 0), min(t + 1, count - 1)
            if friction[before] == friction[t] == friction[after]:
                continue
            total = 0.0
            for k in range(BETWEEN_SAMPLES):
                way = (k + 0.5) / BETWEEN_SAMPLES - 0.5
                other = after if way > 0.0 else before
                part = abs(way)
                at[CONTACT_TIME] = time[t] + part * (time[other] - time[t])
                at[CONTACT_X] = place[i, t, 0] + part * (place[i, other, 0] - place[i, t, 0])
                at[CONTACT_Y] = place[i, t, 1] + part * (place[i, other, 1] - place[i, t, 1])
                at[ROLL_ANGLE] = roll_angle[i, t] + part * (roll_angle[i, other] - roll_angle[i, t])
                at[LOAD] = load[i, t] + part * (load[i, other] - load[i, t])
                one[:] = 0.0
                one[FRICTION] = 1.0
                kernel(at, values, one)
                total += one[FRICTION]
            found[i, t, FRICTION] = total / BETWEEN_SAMPLES
    return found


@compiled
def _between_samples(rows):  # type: ignore[no-untyped-def]
    """Return what lies about the samples of signals (K, T), (K, T * BETWEEN_SAMPLES), as many to either side of each."""
    count = rows.shape[1]
    between = np.empty((len(rows), count * BETWEEN_SAMPLES))
    for i in range(len(rows)):
        for t in range(count):
            # Before the first sample and after the last one lies that sample.
            earlier, later = rows[i, t] - rows[i, max(t - 1, 0)], rows[i, min(t + 1, count - 1)] - rows[i, t]
            for k in range(BETWEEN_SAMPLES):
                way = (k + 0.5) / BETWEEN_SAMPLES - 0.5
                between[i, t * BETWEEN_SAMPLES + k] = rows[i, t] + way * (earlier if way < 0.0 else later)
    return between


def signals_of(
    effect: JointTorqueEffect, axis: int, coupling: FloatArray, signals: Sequence[FloatArray]
) -> tuple[Sequence[FloatArray], FloatArray]:
    """Return position, velocity and torque (T,) that an effect goes by, and what its torque is on (drive, steer) (2,).

    Args:
        axis: of the joint, or of the motor of an effect on the motor's side.
        coupling: of the caster's gears (2, 2), see `RobotDescription.gear_coupling`.
        signals: position, velocity and torque of both joints (T, 2).
    """
    if not effect.motor_side:
        return [values[:, axis] for values in signals], np.eye(2)[axis]
    position, velocity, torque = signals
    return (position @ coupling[axis], velocity @ coupling[axis], torque @ np.linalg.inv(coupling)[:, axis]), coupling[axis]


def torque_along(
    effect: JointTorqueEffect, signals: Sequence[FloatArray], torque: Callable[..., FloatArray]
) -> FloatArray:
    """Return what a function makes of a joint's position, velocity, torque and load along a motion, as its samples hold it.

    Args:
        effect: which of the signals the function depends on.
        signals: position, velocity, motor torque and normal force (T,) each.
        torque: function of these, (N,) each, for any N; result (N, K).

    Returns:
        (T, K) [N m].
    """
    if "position" not in kernel_arguments(effect.name):
        return torque(*signals)
    fine = torque(*_between_samples(np.stack(signals)))
    taps = signal.firwin(RIPPLE_TAPS, RIPPLE_CUTOFF, fs=BETWEEN_SAMPLES)
    # The middle of an even number of taps lies between two values, as a sample lies between those about it.
    first = (RIPPLE_TAPS + BETWEEN_SAMPLES) // 2 - 1
    passed: FloatArray = signal.oaconvolve(fine, taps[:, None], mode="full", axes=0)
    return passed[first::BETWEEN_SAMPLES][: len(signals[0])]


@dataclasses.dataclass(frozen=True)
class ChannelModel:
    """The channels of one robot as it is described, the effects of its `physics` at work.

    Attributes:
        robot: with the numbers that its effects change already changed.
        numbers: of that robot.
        layout: which channels there are.
    """

    robot: RobotDescription
    numbers: ModelNumbers
    layout: ChannelLayout

    def around(self, motion: RobotMotion) -> Surroundings:
        """What the robot's `physics` add on joints and under wheels along a motion."""
        around = NOTHING
        for instance in self.robot.physics:
            around = self.around_with(motion, around, instance)
        return around

    def around_with(self, motion: RobotMotion, around: Surroundings, instance: EffectInstance) -> Surroundings:
        """Return the surroundings with a further effect on joints or under wheels; others change nothing here."""
        effect = get(instance.name)
        if isinstance(effect, GravityEffect):
            return self.around_leaning(motion, around, effect.gravity(instance.parameters))
        if not isinstance(effect, (JointTorqueEffect, ContactEffect)):
            return around
        shape = motion.position.shape
        torque = np.zeros(shape) if around.torque is None else around.torque.copy()
        normal = self.normal_along(motion) if around.normal is None else around.normal
        if isinstance(effect, JointTorqueEffect):
            axis = AXIS_NAMES.index(instance.axis or effect.axis)
            for name in instance.target:
                i = self.robot.caster_index(name)
                position = motion.position[:, i].copy()
                position[:, STEER] = self.numbers.headings(motion.position)[:, i]  # whatever is read of them
                signals = position, motion.velocity[:, i], motion.balanced_torque[:, i]
                own, row = signals_of(effect, axis, self.robot.gear_coupling[i], signals)
                found = torque_along(
                    effect, (*own, normal[:, i]),
                    lambda *at, effect=effect: effect.contribution(*at, instance.parameters)[:, None],
                )  # fmt: skip
                torque[:, i] += found * row
            return dataclasses.replace(around, torque=torque)
        if self.layout.lifted:  # there is nothing under the wheels
            return around
        under, height, normal = self._under_wheels(motion, around, instance, normal)
        # What nothing is added to stays the array that it was: how the wheels move depends on nothing else of the floor.
        radius, climb = around.radius, around.climb
        grip = np.ones(shape[:2]) if around.grip is None else around.grip.copy()
        for i, found in under.items():
            if found[:, RADIUS_CHANGE].any():
                radius = np.zeros(shape[:2]) if radius is None else radius.copy()
                radius[:, i] += found[:, RADIUS_CHANGE]
            grip[:, i] *= found[:, FRICTION]
            torque[:, i, DRIVE] -= normal[:, i] * found[:, RADIUS_SLOPE]
            gradient = found[:, [GRADIENT_X, GRADIENT_Y]]
            if gradient.any():
                climb = np.zeros(shape) if climb is None else climb.copy()
                climb[:, i] -= normal[:, i, None] * self._in_wheel_frame(motion, i, gradient)
        return dataclasses.replace(around, torque=torque, radius=radius, grip=grip, height=height, climb=climb)

    def normal_along(self, motion: RobotMotion) -> FloatArray:
        """Normal forces (T, n) [N] along a motion; none off the ground."""
        return np.zeros(motion.position.shape[:2]) if self.layout.lifted else normal_along(motion, self.numbers)

    def around_leaning(self, motion: RobotMotion, around: Surroundings, change: FloatArray) -> Surroundings:
        """Return the surroundings with gravity whose unit vector leans further by `change` (3,), in axes of the yaw."""
        pull = self._pull(motion, change)
        return dataclasses.replace(around, pull=pull if around.pull is None else around.pull + pull)

    def wheel_places(self, motion: RobotMotion) -> FloatArray:
        """Centres of the casters' wheels in the world (n, T, 2) [m]."""
        heading = self.numbers.headings(motion.position)
        c, s = np.cos(heading), np.sin(heading)
        (bx, by), (sx, sy) = self.numbers.caster_offset.T, self.numbers.steer_axis.T
        x, y = sx + bx * c - by * s, sy + bx * s + by * c
        c, s = np.cos(motion.pose[:, 2:]), np.sin(motion.pose[:, 2:])
        turned = np.stack([(c * x - s * y).T, (s * x + c * y).T], axis=2)
        places: FloatArray = motion.pose[:, :2] + turned
        return places

    def _under_wheels(
        self, motion: RobotMotion, around: Surroundings, instance: EffectInstance, normal: FloatArray
    ) -> tuple[dict[int, FloatArray], FloatArray | None, FloatArray]:
        """What a contact's effect does under each of its wheels, and what that does to all of them.

        A wheel that gives way under its load hands a part of it to the others, and gives way less.

        Returns:
            By wheel (T, CONTACT_RESULTS); heights of the axles (T, n) [m], None where nothing lifts them, and normal forces
            (T, n) [N] with it at work.
        """
        effect = get(instance.name)
        assert isinstance(effect, ContactEffect)
        values = effect.values(instance.parameters)
        casters = [self.robot.caster_index(name) for name in instance.target]
        places = np.ascontiguousarray((self.wheel_places(motion) if around.places is None else around.places)[casters])
        roll_angle = np.ascontiguousarray(motion.position[:, casters, DRIVE].T)
        height = np.zeros(motion.position.shape[:2])
        for _ in range(LOAD_ROUNDS):
            load = np.ascontiguousarray(normal[:, casters].T)
            results = _contacts_along(effect.contact, values, motion.time, places, roll_angle, load)
            under = dict(zip(casters, results, strict=True))
            if around.height is None and not results[:, :, [HEIGHT, RADIUS_CHANGE]].any():
                return under, None, normal
            before, height = height, np.zeros(motion.position.shape[:2]) if around.height is None else around.height.copy()
            for i, found in under.items():
                height[:, i] += found[:, HEIGHT] + found[:, RADIUS_CHANGE]
            if np.abs(height - before).max(initial=0.0) < LEAST_LIFT:
                break
            normal = normal_along(motion, self.numbers, height)
        return under, height, normal

    def _in_wheel_frame(self, motion: RobotMotion, i: int, vectors: FloatArray) -> FloatArray:
        """Vectors of the world (T, 2) in the frame of wheel i (T, 2)."""
        heading = motion.pose[:, 2] + self.numbers.headings(motion.position)[:, i]
        c, s = np.cos(heading), np.sin(heading)
        return np.stack([c * vectors[:, 0] + s * vectors[:, 1], c * vectors[:, 1] - s * vectors[:, 0]], axis=1)

    def sides(self, motion: RobotMotion, around: Surroundings, numbers: ModelNumbers | None = None) -> Sides:
        """Measured and predicted side of every channel along a true motion, (T, C) each."""
        if numbers is not None:
            around = self._around_under(numbers, motion, around)
        numbers = numbers or self.numbers
        if self.layout.lifted:  # what pushes a chassis on its jack, or what it feels there, says nothing of the robot
            return joint_sides(motion, numbers, around)
        sides = channel_sides(motion, numbers, self.layout, around)
        for instance in self.robot.physics:
            if not isinstance(effect := get(instance.name), ClockEffect):  # a true motion has the right times
                self._apply(motion, numbers, effect, instance.parameters, *sides)
        return sides

    def _around_under(self, numbers: ModelNumbers, motion: RobotMotion, around: Surroundings) -> Surroundings:
        """Return the surroundings with what acts on joints under the loads, and at the headings, of other numbers.

        Wheels resist by their loads: a centre of mass that is elsewhere shows in that, as a payload that is elsewhere does.
        """
        acting = [instance for instance in self.robot.physics if isinstance(get(instance.name), JointTorqueEffect)]
        same = all(np.array_equal(getattr(numbers, name), getattr(self.numbers, name)) for name in OF_LOADS)
        if not acting or around.torque is None or same:
            return around
        change = np.zeros_like(around.torque)
        for model, sign in ((dataclasses.replace(self, numbers=numbers), 1.0), (self, -1.0)):
            there = dataclasses.replace(NOTHING, normal=model.normal_along(motion))
            for instance in acting:
                there = model.around_with(motion, there, instance)
            if there.torque is not None:
                change += sign * there.torque
        return dataclasses.replace(around, torque=around.torque + change)

    def sides_with(self, motion: RobotMotion, around: Surroundings, plain: Sides, instance: EffectInstance) -> Sides:
        """The same with a further effect at work.

        Args:
            motion: the true motion; around: what is at work already.
            plain: the sides without the effect.
            instance: the effect, with all its parameters.
        """
        effect = get(instance.name)
        if isinstance(effect, DescriptionEffect):
            changed = effect.apply(self.robot, instance.target, instance.parameters)
            return self.sides(motion, around, ModelNumbers.of(changed))
        if isinstance(effect, (EncoderEffect, TransmissionEffect)):
            place = instance.target, instance.parameters, instance.axis
            return self.sides(with_true_angles(self.robot, motion, effect, *place), around)
        if isinstance(effect, (JointTorqueEffect, ContactEffect)):
            return self.sides(motion, self.around_with(motion, around, instance))
        if self.layout.lifted:
            return self.sides(motion, self.around_with(motion, around, instance))
        if isinstance(effect, GravityEffect):  # the lean itself besides, which `sides` adds for the robot's own effects only
            sides = self.sides(motion, self.around_with(motion, around, instance))
        else:
            sides = plain[0].copy(), plain[1].copy()
        self._apply(motion, self.numbers, effect, instance.parameters, *sides)
        return sides

    def _apply(
        self, motion: RobotMotion, numbers: ModelNumbers, effect: Effect, values: Mapping[str, float], measured: FloatArray,
        predicted: FloatArray,
    ) -> None:
        """Change both sides as an effect on forces, gravity, IMU or clocks does; other kinds change nothing here."""
        layout = self.layout
        if isinstance(effect, ChassisForceEffect) and layout.balanced:
            wrench = effect.contribution(_between_samples(np.ascontiguousarray(_at(motion, numbers).T)).T, values)
            measured[:, :3] += wrench[:, [0, 1, 5]].reshape(-1, BETWEEN_SAMPLES, 3).mean(axis=1)
        elif isinstance(effect, GravityEffect):
            self.lean(motion, numbers, effect.gravity(values), measured, predicted)
        elif isinstance(effect, ImuEffect) and layout.imu:
            sensed = predicted[:, layout.inertial]
            zero = np.zeros(len(sensed))
            rate, acceleration = effect.measure(
                np.column_stack([zero, zero, sensed[:, 0]]), np.column_stack([sensed[:, 1:], zero + GRAVITY]), values
            )
            predicted[:, layout.inertial] = np.column_stack([rate[:, 2], acceleration[:, :2]])
        elif isinstance(effect, ClockEffect):
            # What bears the stamp t was sensed the offset earlier: what was sensed at t bears t + offset.
            # A derivative, not a shift: of two samples one has the noise that the residual has too.
            if layout.imu:
                measured[:, layout.inertial] += effect.offset("imu/data", values) * derivative(motion.imu, motion.rate)
            if layout.pose:
                offset = effect.offset("ground_truth/odom", values)
                measured[:, layout.tracked] += offset * derivative(motion.tracked_twist, motion.rate)

    def _pull(self, motion: RobotMotion, change: FloatArray) -> FloatArray:
        """What gravity pulls along base_link's axes (T, 2) [m/s^2] when it leans by `change` (3,) in those of the yaw."""
        pull = GRAVITY * change
        c, s = np.cos(motion.pose[:, 2]), np.sin(motion.pose[:, 2])
        return np.column_stack([c * pull[0] + s * pull[1], c * pull[1] - s * pull[0]])

    def lean(
        self, motion: RobotMotion, numbers: ModelNumbers, change: FloatArray, measured: FloatArray, predicted: FloatArray
    ) -> None:
        """Change both sides as gravity does whose unit vector leans by `change` (3,), in axes of the yaw.

        What it changes of the forces under the wheels is that of the surroundings' `pull`.
        """
        along, across = self._pull(motion, change).T
        if self.layout.balanced and not self.layout.lifted:
            mass, centre = _mass_and_centre(numbers)
            measured[:, 0] += mass * along
            measured[:, 1] += mass * across
            measured[:, 2] += mass * (centre[0] * across - centre[1] * along)
        if self.layout.imu:
            predicted[:, self.layout.inertial.start + 1] -= along
            predicted[:, self.layout.inertial.start + 2] -= across


def _mass_and_centre(numbers: ModelNumbers) -> tuple[float, FloatArray]:
    """Mass of the whole robot [kg] and its centre (3,) [m], the casters' modules at their axes."""
    modules = numbers.modules[:, 0]
    mass = float(numbers.chassis[0]) + float(modules.sum())
    moment = numbers.chassis[0] * np.array([numbers.chassis[1], numbers.chassis[2], numbers.com_height])
    moment[:2] += modules @ numbers.steer_axis
    moment[2] += float(modules @ numbers.radius)
    return mass, moment / mass


def _at(motion: RobotMotion, numbers: ModelNumbers) -> FloatArray:
    """What forces on the chassis are functions of, along a motion (T, FORCE_INPUTS)."""
    at = np.zeros((len(motion.time), FORCE_INPUTS))
    at[:, FORCE_TIME] = motion.time
    at[:, POSE_X : POSE_YAW + 1] = motion.pose
    at[:, TWIST_X : TWIST_YAW + 1] = twists(numbers, numbers.headings(motion.position), motion.velocity)[0]
    at[:, [COM_X, COM_Y, COM_Z]] = _mass_and_centre(numbers)[1]
    return at
