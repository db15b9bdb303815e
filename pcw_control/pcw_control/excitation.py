"""Excitations: twists of base_link over time that make a robot show what it is made of.

`identification` and `holdout` are fixed for every robot: recordings of different robots, and of years, can be compared. All
others are made to measure, within the robot's `MotionRange`. None asks the wheel centres for more than one of

    v <= turning_speed                          where casters may turn round at speed: chirps, steps, wheels_off_ground
    v_dot <= turning_acceleration from rest     where they turn round on the first centimetres: all others

and neither for more acceleration than the default controller lets through, so that what is asked for is what happens.
"""

from __future__ import annotations

import dataclasses
import math
import zlib
from collections.abc import Callable, Mapping

import numpy as np

from pcw_description.description_fields import load_yaml_mapping
from pcw_description.errors import DescriptionError, nearest_name
from pcw_description.robot_description import FloatArray, RobotDescription

from .computed_torque import ComputedTorqueParameters
from .errors import ControlError
from .excitation_segments import (
    HOLDOUT,
    IDENTIFICATION,
    Segment,
    Twist,
    chirp,
    closed_curve,
    held,
    leg,
    point_to_point,
    rolling_free,
    stretched,
    turning_direction,
)
from .motion_range import MotionRange

FORMAT = "pcw_excitation/1"
FILE_KEYS = ("format", "name", "duration", "seed", "purpose")
SHORTEST, LONGEST = 10.0, 3600.0  # [s]; below, no segment says anything
CHIRP_FREQUENCIES = (0.1, 1.0)  # [Hz], beginning and end
LARGEST_SPEED = 0.6  # [m/s], of anything but a coast-down: these robots drive among people
COASTING_SPEED = 1.2  # [m/s]
CREEPING_SPEED = 0.025  # [m/s]: where stiction and the Stribeck effect are
# A robot that drives a curve and turns at once keeps each wheel rolling forwards while omega lever is below v.
CURVATURE_SHARE = 0.6
# The angle, up and down again by a sine, by which a heading turns along a figure of eight: the first zero of the Bessel
# function J_0, for which the integral of (cos, sin) of c (1 - cos(phi)) over a turn of phi vanishes.
FIGURE8_ANGLE = 2.404825557695773


@dataclasses.dataclass(frozen=True)
class Excitation:
    """Segments driven one after the other.

    Attributes:
        name: its name.
        summary: one sentence on what it does.
        segments: duration [s] and function (time in the segment, its duration) -> twist (v_x, v_y, omega), or None.
        lifted: the robot is jacked up, its wheels off the ground.
    """

    name: str
    summary: str
    segments: tuple[Segment, ...]
    lifted: bool = False

    @property
    def duration(self) -> float:
        """Length of all segments together [s]."""
        return sum(duration for duration, _ in self.segments)

    def twist(self, time: float) -> FloatArray | None:
        """Return the twist (3,) wanted at a time since the start [s]; None: motors off.

        Zero before and after; motors that are off at the end stay off.
        """
        if time >= 0.0:
            for duration, twist in self.segments:
                if time < duration:
                    wanted = twist(time, duration)
                    return None if wanted is None else np.array(wanted)
                time -= duration
            if twist(duration, duration) is None:
                return None
        return np.zeros(3)


def make_excitation(name: str, robot: RobotDescription, duration: float | None = None, seed: int = 0) -> Excitation:
    """Make an excitation to measure.

    Args:
        name: one of `EXCITATIONS`.
        robot: the robot that shall follow it, as its controller knows it.
        duration: length [s]; default: its own.
        seed: of what is drawn (`random_goals`).

    Raises:
        ControlError: unknown name, or a duration in which it cannot be driven.
        KinematicsError: a robot that is not torque controlled.
    """
    if name not in EXCITATIONS:
        raise ControlError(f"excitation {name!r} is not allowed; {nearest_name(name, EXCITATIONS)}")
    plan = EXCITATIONS[name]
    planner = _Planner(robot, seed)
    duration = plan.duration if duration is None else duration
    shortest = max(SHORTEST, math.ceil(10.0 * plan.shortest(planner)) / 10.0)
    if not shortest <= duration <= LONGEST:
        raise ControlError(
            f"duration = {duration!r} s of excitation {name} is not allowed; allowed: {shortest:g} to {LONGEST:g} s"
        )
    return Excitation(name, plan.summary, tuple(plan.segments(planner, duration)), plan.lifted)


def read_excitation(name: str, robot: RobotDescription, duration: float | None = None, seed: int = 0) -> Excitation:
    """Make an excitation by its name, or as a file asks for it.

    Args:
        name: one of `EXCITATIONS`, or the path of a .yaml file of the format `pcw_excitation/1`: `name`, and as wanted
            `duration` [s], `seed` and `purpose`, which says in words what it is driven for.
        robot: see `make_excitation`.
        duration: length [s], before that of the file; default: the file's, or its own.
        seed: of what is drawn, where the file has none.

    Raises:
        DescriptionError: the file cannot be read, or one of its keys is not allowed.
        ControlError, KinematicsError: as by `make_excitation`.
    """
    if not name.endswith((".yaml", ".yml")):
        return make_excitation(name, robot, duration, seed)
    content = load_yaml_mapping(name)
    for key in content:
        if key not in FILE_KEYS:
            raise DescriptionError(str(key), content[key], f"unknown key; {nearest_name(str(key), FILE_KEYS)}")
    if content.get("format") != FORMAT:
        raise DescriptionError("format", content.get("format"), f"allowed: {FORMAT}")
    chosen, length, drawn = content.get("name"), content.get("duration"), content.get("seed", seed)
    if not isinstance(chosen, str):
        raise DescriptionError("name", chosen, f"allowed: {', '.join(EXCITATIONS)}")
    if length is not None and (isinstance(length, bool) or not isinstance(length, (int, float))):
        raise DescriptionError("duration", length, f"allowed: {SHORTEST:g} to {LONGEST:g} s")
    if isinstance(drawn, bool) or not isinstance(drawn, int) or drawn < 0:
        raise DescriptionError("seed", drawn, "allowed: 0 and above")
    return make_excitation(chosen, robot, duration if duration is not None else length, drawn)


class _Planner:
    """Sizes for one robot, and the segments of each excitation from them; all speeds are those of a wheel centre."""

    def __init__(self, robot: RobotDescription, seed: int) -> None:
        reach = MotionRange.of_robot(robot)
        followed = ComputedTorqueParameters().limits
        largest = min(followed.acceleration, followed.yaw_acceleration * reach.lever)
        self.lever = reach.lever
        self.turning_speed = min(reach.turning_speed, LARGEST_SPEED)
        self.rolling_speed = min(reach.rolling_speed, LARGEST_SPEED)
        self.coasting_speed = min(reach.rolling_speed, COASTING_SPEED)
        self.acceleration = min(reach.acceleration, largest)
        self.start_acceleration = min(reach.turning_acceleration, largest)
        # On a curve the wheels feel v omega and omega^2 lever as well.
        per_speed_squared = CURVATURE_SHARE * (1.0 + CURVATURE_SHARE) / reach.lever
        self.curve_speed = min(self.rolling_speed / (1.0 + CURVATURE_SHARE), math.sqrt(reach.acceleration / per_speed_squared))
        self.spin_speed = min(self.rolling_speed, math.sqrt(reach.acceleration * reach.lever))
        self.curve_yaw_rate = CURVATURE_SHARE * self.curve_speed / self.lever
        self.curve_ramp = (1.0 + CURVATURE_SHARE) * self.curve_speed / self.start_acceleration
        self.rng = np.random.default_rng([seed, zlib.crc32(b"excitation")])  # not the numbers of a sensor's noise

    def unit(self, axis: int) -> Twist:
        """Return the twist along one axis whose fastest wheel centre moves at 1 m/s."""
        twist = [0.0, 0.0, 0.0]
        twist[axis] = 1.0 if axis < 2 else 1.0 / self.lever
        return twist[0], twist[1], twist[2]

    def shortest_curve(self, angle: float) -> float:
        """Return the shortest duration of a closed curve whose yaw rate peaks at `angle` * 2 pi / time of a lap [s]."""
        return self.curve_ramp + math.tau * angle / self.curve_yaw_rate

    def circle(self, duration: float) -> list[Segment]:
        return [self._laps(duration, 1.0, lambda phase: 1.0)]

    def figure8(self, duration: float) -> list[Segment]:
        return [self._laps(duration, FIGURE8_ANGLE, math.sin)]

    def _laps(self, duration: float, angle: float, shape: Callable[[float], float]) -> Segment:
        """As many whole laps as the yaw rate allows; the start and the end take half a ramp each from the time."""
        laps = max(1, math.floor((duration - self.curve_ramp) * self.curve_yaw_rate / (math.tau * angle)))
        lap_time = (duration - self.curve_ramp) / laps
        return duration, closed_curve(self.curve_speed, math.tau * angle / lap_time, shape, lap_time, self.curve_ramp)

    def chirps(self, axes: tuple[int, ...], duration: float) -> list[Segment]:
        part = duration / len(axes)
        sweep = chirp(*CHIRP_FREQUENCIES, self.turning_speed, self.acceleration)
        return [(part, held(self.unit(axis), sweep)) for axis in axes]

    def spin(self, duration: float) -> list[Segment]:
        turn = leg(self.spin_speed, self.start_acceleration)
        return [(duration / 4.0, held(_scaled(self.unit(2), sign), turn)) for sign in (1.0, -1.0, -1.0, 1.0)]

    def strafe(self, duration: float) -> list[Segment]:
        """Sideways and diagonally, there and back; each leg lasts about five seconds."""
        rounds = max(1, round(duration / 30.0))
        drive, d = leg(self.rolling_speed, self.start_acceleration), math.sqrt(0.5)
        directions = ((0.0, 1.0), (0.0, -1.0), (d, d), (-d, -d), (-d, d), (d, -d))
        part = duration / (rounds * len(directions))
        return [(part, held((x, y, 0.0), drive)) for _ in range(rounds) for x, y in directions]

    def steps(self, duration: float) -> list[Segment]:
        """Each axis both ways at full and half size, a rest after each; a step lasts about two seconds."""
        rounds = max(1, round(duration / 36.0))
        part = duration / (rounds * 18)
        segments: list[Segment] = []
        for size in [self.turning_speed, 0.5 * self.turning_speed] * rounds:
            for axis in range(3):
                for sign in (size, -size, 0.0):
                    segments.append((part, held(_scaled(self.unit(axis), sign), lambda t, duration: 1.0)))
        return segments

    def creep(self, duration: float) -> list[Segment]:
        slow = leg(CREEPING_SPEED, self.start_acceleration)
        return [(duration / 6.0, held(_scaled(self.unit(axis), s), slow)) for axis in range(3) for s in (1.0, -1.0)]

    def coast_down(self, duration: float) -> list[Segment]:
        """Get up to speed, hold it for a second where there is time for that, let roll."""
        driven = min(0.5 * duration, self.coasting_speed / self.start_acceleration + 1.0)
        faster = leg(self.coasting_speed, self.start_acceleration, stop=False)
        return [(driven, held((1.0, 0.0, 0.0), faster)), (duration - driven, rolling_free)]

    def random_goals(self, duration: float) -> list[Segment]:
        """About ten seconds to each goal, drawn in a box that is small enough for every goal to be reached from any."""
        goals = max(1, round(duration / 10.0))
        part = duration / goals
        # Six tenths of speed and acceleration are for the translation, four for turning at the same time.
        speed, acceleration = 0.6 * self.rolling_speed, 0.6 * self.start_acceleration
        yaw_rate, yaw_acceleration = (0.4 / 0.6 / self.lever * value for value in (speed, acceleration))
        segments: list[Segment] = []
        pose = np.zeros(3)
        for _ in range(goals):
            function, pose = point_to_point(self.rng, pose, part, (speed, acceleration), (yaw_rate, yaw_acceleration))
            segments.append((part, function))
        return segments

    def wheels_off_ground(self, duration: float) -> list[Segment]:
        part = duration / 3.0
        (_, along), (_, turning) = self.chirps((0, 2), 2.0 * part)
        around = turning_direction(self.turning_speed, self.start_acceleration)
        return [(part, along), (part, around), (part, turning)]


@dataclasses.dataclass(frozen=True)
class ExcitationPlan:
    """An excitation before it is made for a robot.

    Attributes:
        summary: one sentence on what it does.
        segments: (sizes for a robot, duration [s]) -> segments.
        duration: its own length [s].
        lifted: see `Excitation`.
        shortest: sizes for a robot -> shortest duration [s], if that depends on the robot.
    """

    summary: str
    segments: Callable[[_Planner, float], list[Segment]]
    duration: float = 60.0
    lifted: bool = False
    shortest: Callable[[_Planner], float] = lambda planner: SHORTEST


EXCITATIONS: Mapping[str, ExcitationPlan] = {
    "circle": ExcitationPlan(
        "Whole circles to the left at one speed.", _Planner.circle, shortest=lambda planner: planner.shortest_curve(1.0)
    ),
    "figure8": ExcitationPlan(
        "Whole figures of eight at one speed, closed.", _Planner.figure8,
        shortest=lambda planner: planner.shortest_curve(FIGURE8_ANGLE),
    ),
    "chirp_x": ExcitationPlan("Back and forth along x, from 0.1 to 1 Hz.", lambda p, duration: p.chirps((0,), duration)),
    "chirp_y": ExcitationPlan("Back and forth along y, from 0.1 to 1 Hz.", lambda p, duration: p.chirps((1,), duration)),
    "chirp_yaw": ExcitationPlan("Left and right on the spot, from 0.1 to 1 Hz.", lambda p, duration: p.chirps((2,), duration)),
    "chirps": ExcitationPlan("The chirps of x, y and yaw in turn.", lambda p, duration: p.chirps((0, 1, 2), duration)),
    "spin": ExcitationPlan("Turns on the spot at one speed, to the left and to the right.", _Planner.spin),
    "strafe": ExcitationPlan("Straight sideways and diagonally, there and back.", _Planner.strafe),
    "steps": ExcitationPlan("Each axis switched on and off both ways, at full and half size.", _Planner.steps),
    "creep": ExcitationPlan("Each axis both ways at 25 mm/s, where stiction shows.", _Planner.creep),
    "coast_down": ExcitationPlan("Gets up to speed along x, then motors off: it rolls until it stops.", _Planner.coast_down),
    "random_goals": ExcitationPlan("From rest to rest between poses drawn from the seed.", _Planner.random_goals),
    "wheels_off_ground": ExcitationPlan(
        "Jacked up: drives and steering both ways, without the ground.", _Planner.wheels_off_ground, lifted=True
    ),
    "identification": ExcitationPlan(
        "Each axis alone, then all together, with reversals and at several speeds; the same for every robot.",
        lambda _, duration: stretched(IDENTIFICATION, duration), duration=40.0,
    ),
    "holdout": ExcitationPlan(
        "Shares nothing with identification, to test on what was learnt there; the same for every robot.",
        lambda _, duration: stretched(HOLDOUT, duration), duration=24.0,
    ),
}


def _scaled(twist: Twist, factor: float) -> Twist:
    return factor * twist[0], factor * twist[1], factor * twist[2]
