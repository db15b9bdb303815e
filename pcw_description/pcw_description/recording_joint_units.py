"""Finds joints recorded in degrees, rpm or counts and turns them into rad and rad/s where the unit is certain."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from .recording_checks import (
    DEGREE,
    TO_SI,
    axes_in_degrees,
    is_counts,
    position_scale,
    top_speed,
    units_of,
    unwrap_turns,
)
from .robot_description import AXIS_NAMES, DRIVE, STEER, RobotDescription

FloatArray = npt.NDArray[np.float64]
Units = tuple[str, str] | None  # of position and velocity; None: they disagree by a factor that is no unit
Warn = Callable[[str, str, int], None]

SI: Units = ("rad", "rad/s")
# No wheel module is faster than this; for recordings read without a robot [rad/s].
FASTEST_JOINT = {DRIVE: 300.0, STEER: 100.0}
# A healthy controller may overshoot a limit a little.
SPEED_MARGIN = 1.5


def correct_units(
    stamp: FloatArray,
    names: Sequence[str],
    robot: RobotDescription | None,
    position: FloatArray,
    velocity: FloatArray,
    warn: Warn,
) -> None:
    """Check and convert, in place, position and velocity (T, m) of joints `names`; stamps (T,) [s] increase.

    Three witnesses: position differences against velocity, joint by joint; the wheels' rolling together, where there
    is a robot; and the joints' speed limits, which only raise a doubt. Also makes angles continuous that their
    driver wraps at one turn.
    """
    for column in range(len(names)):
        position[:, column] = unwrap_turns(position[:, column])
    for units, columns, ratio in _units_by_consistency(stamp, names, position, velocity):
        text = _correct(units, [names[column] for column in columns], columns, ratio, position, velocity)
        warn("wrong_unit", text, len(columns))
    if robot is not None:
        shape = (len(stamp), -1, len(AXIS_NAMES))
        for axis in axes_in_degrees(robot, position.reshape(shape), velocity.reshape(shape)):
            position[:, axis :: len(AXIS_NAMES)] *= DEGREE
            velocity[:, axis :: len(AXIS_NAMES)] *= DEGREE
            text = (
                f"the {AXIS_NAMES[axis]} joints are in degrees and degrees/s: read so, the wheels roll together, read as "
                "rad they contradict each other; converted to rad and rad/s"
            )
            warn("wrong_unit", text, robot.n)
    _warn_of_speed(stamp, names, robot, position, velocity, warn)


def _units_by_consistency(
    stamp: FloatArray, names: Sequence[str], position: FloatArray, velocity: FloatArray
) -> list[tuple[Units, list[int], float]]:
    """Units that are not SI, the columns that have them, and the factor measured (NaN: judged by whole numbers)."""
    found: dict[int, Units] = {}
    factors: dict[int, float] = {}
    for column in range(len(names)):
        factor = position_scale(stamp, position[:, column], stamp, velocity[:, column])
        if factor is not None:
            factors[column], found[column] = factor, units_of(factor)
        if is_counts(position[:, column]) and found.get(column, SI) == SI:
            found[column] = ("counts", "counts/s" if factor is not None else "rad/s")
        elif is_counts(position[:, column]) and found[column] is None:
            found[column] = ("counts", "rad/s")
    # a joint that stood still goes with the others of its axis, if they agree: they have one driver
    for axis in (DRIVE, STEER):
        own = [column for column, name in enumerate(names) if axis_of(name) == axis]
        verdicts = {found[column] for column in own if column in found}
        if len(verdicts) == 1:
            found.update((column, next(iter(verdicts))) for column in own)

    columns_by_units: dict[Units, list[int]] = {}
    for column in sorted(found):
        if found[column] != SI:
            columns_by_units.setdefault(found[column], []).append(column)
    return [
        (units, columns, float(np.median([factors[c] for c in columns if c in factors] or [math.nan])))
        for units, columns in columns_by_units.items()
    ]


def _correct(
    units: Units, joints: list[str], columns: list[int], ratio: float, position: FloatArray, velocity: FloatArray
) -> str:
    """Convert or leave out (NaN) the columns, in place; returns the sentence about it."""
    which = ", ".join(joints)
    evidence = f"position changes {ratio:.4g} times as much as velocity says"
    if units is None:
        velocity[:, columns] = np.nan
        unit = "counts/s" if 0.0 < ratio < 0.01 else "no common unit, or with another sign or gear,"
        return f"the velocity of {which} is in {unit}: {evidence}; it is left out (NaN)"
    if units[0] == "counts":
        position[:, columns] = np.nan
        if units[1] == "counts/s":
            velocity[:, columns] = np.nan
            return f"position and velocity of {which} are in encoder counts: whole numbers; both are left out (NaN)"
        return f"the position of {which} is in encoder counts: whole numbers; it is left out (NaN)"
    position[:, columns] *= TO_SI[units[0]]
    velocity[:, columns] *= TO_SI[units[1]]
    quantities = zip(("position", "velocity"), units, SI or ())
    wrong = " and ".join(f"the {quantity} is in {unit}" for quantity, unit, right in quantities if unit != right)
    return f"{wrong} for {which}: {evidence}; converted to rad and rad/s"


def _warn_of_speed(
    stamp: FloatArray,
    names: Sequence[str],
    robot: RobotDescription | None,
    position: FloatArray,
    velocity: FloatArray,
    warn: Warn,
) -> None:
    too_fast = []
    for column, name in enumerate(names):
        limit, known = FASTEST_JOINT[axis_of(name)], "which no such joint does"
        if robot is not None:
            limits = robot.casters[column // len(AXIS_NAMES)].limits
            limit = limits.drive_speed if axis_of(name) == DRIVE else limits.steer_speed
            known = f"its limit is {limit:.3g} rad/s"
        speed = top_speed(stamp, position[:, column], velocity[:, column])
        if speed > SPEED_MARGIN * limit:
            too_fast.append(f"{name} reaches {speed:.3g} rad/s, {known}")
    if too_fast:
        listed = "; ".join(too_fast[:4]) + (f"; and {len(too_fast) - 4} more" if len(too_fast) > 4 else "")
        warn("implausible_speed", f"{listed}; the unit may be degrees, rpm or counts; left as it is", len(too_fast))


def axis_of(joint: str) -> int:
    """DRIVE or STEER, by the joint's name."""
    return STEER if joint.endswith("_" + AXIS_NAMES[STEER]) else DRIVE
