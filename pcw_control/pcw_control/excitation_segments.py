"""Pieces of excitations: functions (time in the segment, its duration) -> twist of base_link (v_x, v_y, omega), or None."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from pcw_description.robot_description import FloatArray

from .quintic_trajectory import (
    REST_PEAK_ACCELERATION,
    REST_PEAK_SPEED,
    QuinticTrajectory,
    TrajectoryPoint,
    quintic_coefficients,
)

Twist = tuple[float, float, float]
TwistOverTime = Callable[[float, float], Twist | None]
Segment = tuple[float, TwistOverTime]
# (time in the segment, its duration) -> size [m/s, or a factor]
SizeOverTime = Callable[[float, float], float]


def stretched(segments: Sequence[Segment], duration: float) -> list[Segment]:
    """Return the segments, each longer or shorter in proportion, with `duration` [s] in all."""
    factor = duration / sum(length for length, _ in segments)
    return [(length * factor, twist) for length, twist in segments]


def held(twist: Twist, size: SizeOverTime) -> TwistOverTime:
    """Return one twist, times its size over time."""
    x, y, yaw = twist

    def function(t: float, duration: float) -> Twist:
        factor = size(t, duration)
        return factor * x, factor * y, factor * yaw

    return function


def leg(speed: float, acceleration: float, stop: bool = True) -> SizeOverTime:
    """From rest to a speed [m/s] with an acceleration [m/s^2], and to rest again; slower where there is no time for it."""

    def size(t: float, duration: float) -> float:
        left = duration - t if stop else math.inf
        return max(0.0, min(speed, acceleration * t, acceleration * left))

    return size


def chirp(low: float, high: float, speed: float, acceleration: float) -> SizeOverTime:
    """Sweep from a low to a high frequency [Hz] in whole periods, then stand.

    The amplitude is the speed [m/s], or less where the frequency would make it an acceleration [m/s^2] above the one given.
    """

    def size(t: float, duration: float) -> float:
        mean = 0.5 * (low + high)
        sweep = math.floor(mean * duration) / mean
        if t >= sweep:
            return 0.0
        frequency = low + (high - low) * t / sweep
        phase = math.tau * (low * t + 0.5 * (high - low) * t * t / sweep)
        return min(speed, acceleration / (math.tau * frequency)) * math.sin(phase)

    return size


def closed_curve(
    speed: float, yaw_rate: float, shape: Callable[[float], float], lap_time: float, ramp: float
) -> TwistOverTime:
    """Drive a curve lap by lap, faster and slower at its ends without leaving it.

    Args:
        speed: along the curve [m/s].
        yaw_rate: peak of the yaw rate [rad/s].
        shape: phase of the lap [rad] -> yaw rate over its peak.
        lap_time: time of a lap at full speed [s].
        ramp: time from rest to full speed, and back [s].
    """

    def function(t: float, duration: float) -> Twist:
        pace = max(0.0, min(1.0, t / ramp, (duration - t) / ramp))
        if t < ramp:
            progress = 0.5 * t * t / ramp
        elif t < duration - ramp:
            progress = t - 0.5 * ramp
        else:
            progress = duration - ramp - 0.5 * (duration - t) ** 2 / ramp
        return pace * speed, 0.0, pace * yaw_rate * shape(math.tau * progress / lap_time)

    return function


def point_to_point(
    rng: np.random.Generator,
    start: FloatArray,
    duration: float,
    limits: tuple[float, float],
    yaw_limits: tuple[float, float],
) -> tuple[TwistOverTime, FloatArray]:
    """Draw a goal in a box around the origin and return the quintic to it from rest to rest, and the goal.

    Args:
        rng: source of the goal.
        start: pose in odom (3,) [m, m, rad].
        duration: [s].
        limits: speed [m/s] and acceleration [m/s^2] of the translation.
        yaw_limits: yaw rate [rad/s] and acceleration [rad/s^2].

    Returns:
        Twist over time, and the goal (3,) in odom. The size of the box is such that any two poses in it are in reach.
    """
    farthest, largest_turn = (
        min(speed * duration / REST_PEAK_SPEED, acceleration * duration**2 / REST_PEAK_ACCELERATION)
        for speed, acceleration in (limits, yaw_limits)
    )
    half_side = farthest / math.sqrt(8.0)
    goal = rng.uniform(-1.0, 1.0, 3) * np.array([half_side, half_side, 0.5 * largest_turn])
    coefficients = quintic_coefficients(TrajectoryPoint(start), TrajectoryPoint(goal), duration)
    trajectory = QuinticTrajectory(coefficients, duration)

    def function(t: float, _: float) -> Twist:
        point = trajectory.sample(t)
        c, s = math.cos(point.pose[2]), math.sin(point.pose[2])
        v_x, v_y, yaw_rate = point.velocity.tolist()
        return c * v_x + s * v_y, -s * v_x + c * v_y, yaw_rate

    return function, goal


def turning_direction(speed: float, acceleration: float) -> TwistOverTime:
    """Translate at a speed [m/s], or less where the acceleration [m/s^2] asks for it, in a direction that turns once round
    to the left, and back.
    """

    def function(t: float, duration: float) -> Twist:
        direction = math.pi * (1.0 - math.cos(math.tau * t / duration))
        fastest_turn = math.pi * math.tau / duration
        size = leg(min(speed, acceleration / fastest_turn), acceleration)(t, duration)
        return size * math.cos(direction), size * math.sin(direction), 0.0

    return function


def rolling_free(t: float, duration: float) -> None:
    """Motors off."""


def _chirp(axis: int, amplitude: float, low: float = 0.2, high: float = 0.9) -> TwistOverTime:
    """Sweep one axis from a low to a high frequency [Hz]."""

    def twist(t: float, duration: float) -> Twist:
        phase = math.tau * (low * t + 0.5 * (high - low) * t * t / duration)
        values = [0.0, 0.0, 0.0]
        values[axis] = amplitude * math.sin(phase)
        return values[0], values[1], values[2]

    return twist


def _steps(*twists: Twist) -> TwistOverTime:
    """Hold each twist for an equal part of the segment."""
    return lambda t, duration: twists[min(int(t / duration * len(twists)), len(twists) - 1)]


# Chirps tell effects apart best and circles worst. Recordings of these two exist: they stay as they are, number by number.
IDENTIFICATION: tuple[Segment, ...] = (
    (6.0, _chirp(0, 0.45)),
    (6.0, _chirp(1, 0.45)),
    (5.0, _chirp(2, 1.2)),
    (4.0, lambda t, duration: (0.5, 0.0, 0.9)),
    (6.0, lambda t, duration: (0.5, 0.0, 1.2 * math.sin(math.tau * t / duration))),
    (5.0, _steps((0.0, 0.4, 0.0), (0.3, -0.3, 0.0), (-0.4, 0.0, 0.0), (0.3, 0.3, 0.0), (0.0, -0.4, 0.0))),
    (3.0, _steps((0.0, 0.0, 1.2), (0.0, 0.0, -1.2))),
    (4.0, _steps((0.6, 0.0, 0.0), (-0.6, 0.0, 0.0))),
    (1.0, _steps((0.0, 0.0, 0.0))),
)
HOLDOUT: tuple[Segment, ...] = (
    (
        14.0,
        lambda t, duration: (
            0.40 * math.sin(0.9 * t), 0.35 * math.sin(1.3 * t + 0.5), 0.6 * math.sin(0.7 * t + 1.0)
        ),
    ),
    (4.0, lambda t, duration: (0.35, 0.2, -0.7)),
    (4.0, _steps((0.25, 0.25, 0.6), (-0.3, 0.2, -0.6))),
    (2.0, _steps((0.0, 0.0, 0.0))),
)
