"""Reported torques that say nothing of what happens between a command and a motor, and what is wrong with them."""

from __future__ import annotations

import numpy as np

from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, RobotDescription

from ..regression.regression_problem import FloatArray
from .held_commands import held_commands

# Steps that a torque has to reach. Of fewer most of it is zero, as if the drive gave next to nothing, or always the same.
LEAST_STEPS = 4
OPPOSITE = -0.5  # correlation of reports with commands, below which one of the two has the wrong sign
# Where they go together, reports between these parts of the commands are those of a motor that is weak, or limited. Beyond,
# they are in other units, or torques before a gear.
TOGETHER, LIKELY = 0.8, (0.25, 4.0)
LEAST_SAMPLES = 200
# Stamps whose intervals differ from a period by more than this part of it as a rule, those of arrival on a busy network, do
# not say which command a report answers.
SCATTERED = 0.2
MOVED = 0.1  # [rad]
SAME = "is the same throughout although they move, as of a motor that is dead or not measured"
NO_BALANCE = "with one torque unknown no forces balance, and those of the others are not used"
LEFT_OUT = "what happens between commands and torques is not looked for there"


def unmeasured_torques(robot: RobotDescription, recording: Recording) -> str:
    """Say which joints' torques were not measured though those of others were; "" where all were, or none.

    A drive may send the same number for ever. Of a joint that moves and is not commanded to give none, that is no measurement,
    or it is one of a motor that is dead: nothing recorded tells.
    """
    effort, commands = recording.joint_states.effort, held_commands(robot, recording)
    never, same = [], []
    for i, axis in np.ndindex(robot.n, 2):
        name, own = f"{robot.caster_names[i]}_{AXIS_NAMES[axis]}", effort[:, i, axis]
        own, angle = own[np.isfinite(own)], recording.joint_states.position[:, i, axis]
        if not len(own):
            never.append(name)
        elif np.ptp(own) == 0.0 and np.nanmax(angle) - np.nanmin(angle) > MOVED:
            if commands is None or np.nan_to_num(commands[:, i, axis]).any():
                same.append(name)
    if not never and not same or len(never) == 2 * robot.n:
        return ""
    told = [f"that of {', '.join(names)} {how}" for names, how in ((never, "is NaN"), (same, SAME)) if names]
    return f"joint_states: the effort of some joints is not known: {' and '.join(told)}; {NO_BALANCE}"


def coarse_step(torque: FloatArray) -> float:
    """Return the step [N m] in which a torque (T,) was reported that never reached `LEAST_STEPS` of it; 0 where it did."""
    levels = np.unique(np.abs(torque[np.isfinite(torque)]))
    if len(levels) < 2:
        return 0.0
    step = float(np.min(np.diff(levels)))
    return step if levels[-1] < (LEAST_STEPS - 0.5) * step else 0.0


def unlikely_factor(command: FloatArray, torque: FloatArray) -> float | None:
    """Return how many times a command (T,) a motor reported (T,), where no motor does; None where one may.

    Commands smaller than usual, which no limit holds back, have to say so, too.
    """
    known = np.isfinite(command) & np.isfinite(torque)
    if known.sum() < LEAST_SAMPLES:
        return None
    given, reported = command[known], torque[known]
    sizes = float(np.sqrt(np.sum(given**2) * np.sum(reported**2)))
    together = float(given @ reported) / max(sizes, 1e-300)
    small = np.abs(given) <= np.median(np.abs(given))
    factors = [float(g @ r) / max(float(g @ g), 1e-300) for g, r in ((given, reported), (given[small], reported[small]))]
    if together < OPPOSITE and max(factors) < 0.0:
        return factors[0]
    least, largest = LIKELY
    if together > TOGETHER and (max(factors) < least or min(factors) > largest):
        return factors[0]
    return None


def doubtful_reports(robot: RobotDescription, recording: Recording) -> dict[tuple[int, int], str]:
    """Return what is wrong with the torques that joints (caster, axis) reported, of those of which something is."""
    effort, commands = recording.joint_states.effort, held_commands(robot, recording)
    found: dict[tuple[int, int], str] = {}
    scattered = "" if commands is None else _scattered(recording)
    for i, axis in np.ndindex(robot.n, 2) if effort is not None else ():
        step = coarse_step(effort[:, i, axis])
        factor = None if commands is None else unlikely_factor(commands[:, i, axis], effort[:, i, axis])
        if step > 0.0:
            found[i, axis] = f"comes in steps of {step:.2g} N m and never reached {LEAST_STEPS} of them"
        elif factor is not None and factor < 0.0:
            found[i, axis] = "is opposite to what was commanded: one of the two has the wrong sign"
        elif factor is not None:
            found[i, axis] = f"is {factor:.2g} times what was commanded: it has to be the torque at the joint [N m]"
        elif scattered:
            found[i, axis] = scattered
    return found


def _scattered(recording: Recording) -> str:
    """Say what is wrong with the stamps of states or commands that scatter; "" where they do not."""
    for name, series in (("joint_states", recording.joint_states), ("joint_commands", recording.joint_commands)):
        intervals = np.diff(series.stamp) if series is not None else np.zeros(0)
        if len(intervals) < LEAST_SAMPLES:
            continue
        period = float(np.median(intervals))
        part = float(np.median(np.abs(intervals - period))) / period
        if part > SCATTERED:
            return f"answers some command or other, as stamps of {name} scatter by {part:.0%} of their period"
    return ""


def told_of(robot: RobotDescription, doubtful: dict[tuple[int, int], str]) -> list[str]:
    """Return one sentence per kind of doubt on what was reported."""
    joints: dict[str, list[str]] = {}
    for (i, axis), wrong in doubtful.items():
        joints.setdefault(wrong, []).append(f"{robot.caster_names[i]}_{AXIS_NAMES[axis]}")
    return [f"joint_states: the effort of {', '.join(names)} {wrong}; {LEFT_OUT}" for wrong, names in joints.items()]
