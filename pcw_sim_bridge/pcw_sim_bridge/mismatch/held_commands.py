"""The torque commands that a robot's joints held at the stamps of its joint states."""

from __future__ import annotations

import numpy as np

from pcw_description.recording import Recording
from pcw_description.robot_description import RobotDescription

from .regression_problem import FloatArray

SAME_STAMP = 1e-6  # [s]
# Where stamps tremble, a command and a state are of the same time that are nearer than this part of the shorter interval.
SAME_PART = 0.25
LARGEST_GAP = 0.05  # [s]; an older command is not held any more
# A motor follows its commands where what it reports is so many times the command.
FOLLOWS = (0.8, 1.2)
SURE = 5.0  # deviations of chance, by which one way to read the stamps must be nearer to what was reported than another


def held_commands(robot: RobotDescription, recording: Recording) -> FloatArray | None:
    """Return the command held by every joint at each stamp (T, n, 2) [N m], within its limit; NaN where there was none.

    None where no torques were commanded at all, or none reported.

    What is reported at a stamp is the answer to the command before it. But who logs a state together with the torque that was
    computed from it gives both the same stamp: then what is reported is nearer to the command of its own stamp, which no
    motor can obey before it was given. Where stamps tremble, the same stamp is one a little before or after.
    """
    commands, joints = recording.joint_commands, recording.joint_states
    if commands is None or commands.effort is None or joints.effort is None or len(commands.stamp) < 2:
        return None

    def held(latest: FloatArray) -> FloatArray:
        last = np.searchsorted(commands.stamp, latest, side="left") - 1
        fresh = (last >= 0) & (joints.stamp - commands.stamp[np.maximum(last, 0)] < LARGEST_GAP)
        effort = np.clip(commands.effort[np.maximum(last, 0)], -robot.torque_limit, robot.torque_limit)
        return np.where(fresh[:, None, None], effort, np.nan)

    same = SAME_PART * min(float(np.median(np.diff(series.stamp))) for series in (commands, joints))
    found = held(joints.stamp - SAME_STAMP)
    for offset in (-same, SAME_STAMP, same):
        instead = held(joints.stamp + offset)
        nearer = (joints.effort - found) ** 2 - (joints.effort - instead) ** 2
        nearer = nearer[np.isfinite(nearer)]
        if nearer.sum() > SURE * np.sqrt(np.sum(nearer**2)):
            found = instead
    return found


def quiet_torque(robot: RobotDescription, recording: Recording) -> FloatArray | None:
    """Return the motors' torques (T, n, 2) [N m] without the noise of their measurement where that can be had.

    It can where a motor follows its commands; elsewhere the torque is as it was reported. None where none was reported.

    An effect that is a function of the reported torque would hold the very noise that the residual holds, and be found as
    small, or as large, as makes that noise least.
    """
    reported, commanded = recording.joint_states.effort, held_commands(robot, recording)
    if reported is None or commanded is None:
        return reported
    both = np.isfinite(reported) & np.isfinite(commanded)
    product = np.sum(np.where(both, reported * commanded, 0.0), axis=0)
    slope = product / np.maximum(np.sum(np.where(both, commanded**2, 0.0), axis=0), 1e-300)
    follows = (slope > FOLLOWS[0]) & (slope < FOLLOWS[1])
    quiet: FloatArray = np.where(both & follows, commanded, reported)
    return quiet
