"""Quintic point-to-point motion in (x, y, yaw).

On each axis the position is the polynomial of fifth degree

    s(t) = sum_{k=0..5} a_k (t / T)^k

that meets position, velocity and acceleration at both ends. From rest to rest over the distance d it peaks at the speed
15/8 d/T and at the acceleration 10/sqrt(3) d/T^2, so a duration follows from limits of speed and acceleration.

Poses are (x, y, yaw) of base_link in odom, their derivatives are components in odom.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.robot_description import FloatArray

from .errors import ControlError

# Peak speed and acceleration of the rest-to-rest quintic over unit distance in unit time.
REST_PEAK_SPEED = 15.0 / 8.0
REST_PEAK_ACCELERATION = 10.0 / math.sqrt(3.0)

# The path of a general motion is checked at this many instants; a quintic has at most four extrema of speed, so its
# peak lies less than 1e-4 of itself above the largest sample.
_CHECKED_INSTANTS = 257
_LONGEST_DURATION = 1e4  # [s]


@dataclasses.dataclass(frozen=True)
class MotionLimits:
    """How fast a trajectory may be.

    Attributes:
        speed: largest speed of the translation [m/s].
        acceleration: largest acceleration of the translation [m/s^2].
        yaw_rate: largest yaw rate [rad/s].
        yaw_acceleration: largest yaw acceleration [rad/s^2].
    """

    speed: float = 0.6
    acceleration: float = 0.5
    yaw_rate: float = 1.0
    yaw_acceleration: float = 1.5

    def __post_init__(self) -> None:
        """Check the limits.

        Raises:
            ControlError: a limit that is not a positive number.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0.0):
                raise ControlError(f"{field.name} = {value!r} is not allowed; allowed: a positive number")


@dataclasses.dataclass(frozen=True)
class TrajectoryPoint:
    """Where the robot shall be at one instant.

    Attributes:
        pose: pose of base_link in odom (x, y, yaw) [m, m, rad].
        velocity: its first derivative (3,) [m/s, m/s, rad/s].
        acceleration: its second derivative (3,) [m/s^2, m/s^2, rad/s^2].
    """

    pose: FloatArray
    velocity: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(3))
    acceleration: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(3))


@dataclasses.dataclass(frozen=True)
class QuinticTrajectory:
    """One polynomial per axis over one duration.

    Attributes:
        coefficients: a_k of x, y and yaw in the normalised time t / T, (6, 3).
        duration: T [s]; 0 is a trajectory that is already at its end.
    """

    coefficients: FloatArray
    duration: float

    def sample(self, time: float) -> TrajectoryPoint:
        """Return the point at a time since the start [s].

        Before the start the robot is where it starts; after the end it goes on with the final velocity, at rest where
        that is zero.
        """
        if self.duration == 0.0:
            return TrajectoryPoint(self.coefficients[0].copy())
        s = min(max(time / self.duration, 0.0), 1.0)
        powers = s ** np.arange(6)
        k = np.arange(6)
        velocity_powers = k * np.concatenate([[0.0], powers[:-1]]) / self.duration
        acceleration_powers = k * (k - 1) * np.concatenate([[0.0, 0.0], powers[:-2]]) / self.duration**2
        point = TrajectoryPoint(
            powers @ self.coefficients, velocity_powers @ self.coefficients, acceleration_powers @ self.coefficients
        )
        beyond = time - self.duration
        if beyond <= 0.0:
            return point
        return TrajectoryPoint(point.pose + point.velocity * beyond, point.velocity)


def quintic_coefficients(start: TrajectoryPoint, end: TrajectoryPoint, duration: float) -> FloatArray:
    """Return a_0 .. a_5 per axis, (6, 3), that meet both ends in `duration` [s]."""
    p0, v0, a0 = start.pose, start.velocity * duration, start.acceleration * duration**2
    p1, v1, a1 = end.pose, end.velocity * duration, end.acceleration * duration**2
    # What is left at the end after following the start's parabola: the three high coefficients make up for it.
    dp = p1 - (p0 + v0 + 0.5 * a0)
    dv = v1 - (v0 + a0)
    da = a1 - a0
    return np.stack(
        [p0, v0, 0.5 * a0, 10.0 * dp - 4.0 * dv + 0.5 * da, -15.0 * dp + 7.0 * dv - da, 6.0 * dp - 3.0 * dv + 0.5 * da]
    )


def rest_to_rest_duration(distance: float, speed: float, acceleration: float) -> float:
    """Return the shortest T of a quintic from rest to rest, max(15 d / 8 v, sqrt(10 d / (sqrt(3) a))) [s]."""
    return max(REST_PEAK_SPEED * distance / speed, math.sqrt(REST_PEAK_ACCELERATION * distance / acceleration))


def nearest_turn(yaw: float, reference: float) -> float:
    """Return `yaw` plus the whole turns that bring it within half a turn of `reference` [rad]."""
    return reference + math.remainder(yaw - reference, math.tau)


def plan_point_to_point(
    start: TrajectoryPoint, goal: TrajectoryPoint, limits: MotionLimits, shortest_turn: bool = True
) -> QuinticTrajectory:
    """Return the quintic from `start` to `goal`, as short as the limits allow.

    Between two rests the shortest duration is closed-form; with other boundary conditions it is searched for.

    Args:
        start: pose, velocity and acceleration at the start.
        goal: the same at the end.
        limits: limits of the translation's magnitude and of yaw.
        shortest_turn: turn by at most half a turn; otherwise to exactly the yaw given.

    Returns:
        The trajectory; its duration is zero if it begins where it ends.

    Raises:
        ControlError: a value is not finite, or a boundary condition itself exceeds a limit.
    """
    for name, point in (("start", start), ("goal", goal)):
        for field in dataclasses.fields(point):
            value = getattr(point, field.name)
            if np.shape(value) != (3,) or not np.isfinite(value).all():
                raise ControlError(f"{name} {field.name} = {value!r} is not allowed; allowed: three finite numbers")
        _check_boundary(name, point, limits)
    if shortest_turn:
        turned = np.array([goal.pose[0], goal.pose[1], nearest_turn(goal.pose[2], start.pose[2])])
        goal = dataclasses.replace(goal, pose=turned)
    distance = goal.pose - start.pose
    duration = max(
        rest_to_rest_duration(math.hypot(distance[0], distance[1]), limits.speed, limits.acceleration),
        rest_to_rest_duration(abs(distance[2]), limits.yaw_rate, limits.yaw_acceleration),
    )
    boundary_rates = (start.velocity, start.acceleration, goal.velocity, goal.acceleration)
    if any(np.any(rate != 0.0) for rate in boundary_rates):
        duration = _shortest_duration(start, goal, limits)
    return QuinticTrajectory(quintic_coefficients(start, goal, duration), duration)


def _check_boundary(name: str, point: TrajectoryPoint, limits: MotionLimits) -> None:
    for kind, rate, linear, angular in (
        ("velocity", point.velocity, limits.speed, limits.yaw_rate),
        ("acceleration", point.acceleration, limits.acceleration, limits.yaw_acceleration),
    ):
        if math.hypot(rate[0], rate[1]) > linear or abs(rate[2]) > angular:
            raise ControlError(
                f"{name} {kind} = {rate.tolist()} is not allowed; allowed: at most {linear:g} along and {angular:g} in yaw"
            )


def _shortest_duration(start: TrajectoryPoint, goal: TrajectoryPoint, limits: MotionLimits) -> float:
    """Return the shortest duration found on a geometric grid, refined by bisection.

    The allowed durations need not reach to infinity: an acceleration at an end makes a long quintic swing out far.
    """
    # No motion is shorter than its distance at full speed.
    distance = goal.pose - start.pose
    fastest = max(math.hypot(distance[0], distance[1]) / limits.speed, abs(distance[2]) / limits.yaw_rate)
    short = long = max(1e-3, (1.0 - 1e-9) * fastest)
    while not _within(start, goal, long, limits):
        short, long = long, 1.1 * long
        if long > _LONGEST_DURATION:
            raise ControlError(
                f"no duration keeps the quintic from {_said(start)} to {_said(goal)} within {limits}; allowed: wider "
                "limits, or velocities and accelerations at the ends that are further below them"
            )
    while long - short > 1e-4 * long:
        middle = 0.5 * (short + long)
        if _within(start, goal, middle, limits):
            long = middle
        else:
            short = middle
    return long


def _said(point: TrajectoryPoint) -> str:
    return f"pose {point.pose.tolist()}, velocity {point.velocity.tolist()}, acceleration {point.acceleration.tolist()}"


def _within(start: TrajectoryPoint, goal: TrajectoryPoint, duration: float, limits: MotionLimits) -> bool:
    a = quintic_coefficients(start, goal, duration)
    s = np.linspace(0.0, 1.0, _CHECKED_INSTANTS)[:, None]
    velocity = (a[1] + s * (2 * a[2] + s * (3 * a[3] + s * (4 * a[4] + s * 5 * a[5])))) / duration
    acceleration = (2 * a[2] + s * (6 * a[3] + s * (12 * a[4] + s * 20 * a[5]))) / duration**2
    slack = 1.0 + 1e-9  # boundary conditions may stand exactly at a limit
    return bool(
        np.hypot(velocity[:, 0], velocity[:, 1]).max() <= limits.speed * slack
        and np.abs(velocity[:, 2]).max() <= limits.yaw_rate * slack
        and np.hypot(acceleration[:, 0], acceleration[:, 1]).max() <= limits.acceleration * slack
        and np.abs(acceleration[:, 2]).max() <= limits.yaw_acceleration * slack
    )
