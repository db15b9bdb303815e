"""What a robot's joints were commanded at the stamps of its joint states, and its motors' torques without noise."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from pcw_description.recording import Recording
from pcw_description.robot_description import RobotDescription

from ..regression.regression_problem import BoolArray, FloatArray

SAME_STAMP = 1e-6  # [s]
# Where stamps tremble, a command and a state are of the same time that are nearer than this part of the shorter interval.
SAME_PART = 0.25
# Where one command is given for each state and both are of the same time on average, half a cycle is the farthest: if both
# trembled by a quarter of one, one state in eight would get the command after its own, as if drives lagged.
SAME_ON_AVERAGE, CYCLES_ALIKE, LEAST_UNISON = 0.5, 0.1, 0.2
# There, a command that is older than usual by this part of a cycle is not the one that was held: that was lost on its way to
# the recording.
LOST_PART = 0.5
LARGEST_GAP = 0.05  # [s]; an older command is not held any more
SURE = 5.0  # deviations of chance, by which one way to read the stamps must be nearer to what was reported than another
NOISE_BANDS = 10  # of all frequencies; the quietest holds no more than the noise
# Of a periodogram that are averaged: few enough to see a motion, enough to see that there is none; and by how many deviations
# of chance they have to be more than noise.
SMOOTHED_ORDINATES, SURE_POWER = 25, 3.0
LEAST_SAMPLES = 10 * SMOOTHED_ORDINATES
# A motor follows its commands if no more than this part of the noise is expected beyond them: so much chance leaves.
NOISE_PART = 0.5
# A shorter recording [s], such as what a running robot is judged by, is too little to tell a motor that lags from noise: there
# it follows its commands where it reports so many times the command, and else does what it reports.
LEAST_DURATION, FOLLOWS = 15.0, (0.8, 1.2)


def held_commands(robot: RobotDescription, recording: Recording) -> FloatArray | None:
    """Return the command held by every joint at each stamp (T, n, 2) [N m], within its limit; NaN where there is none.

    That is before the first, after a pause, and where one was lost on its way to the recording. None where no torques were
    commanded at all, or none reported.

    What is reported at a stamp is the answer to the command before it. But who logs a state together with the torque that was
    computed from it gives both the same stamp: then what is reported is nearer to the command of its own stamp, which no
    motor can obey before it was given. Where stamps tremble, the same stamp is one a little before or after.
    """
    commands, joints = recording.joint_commands, recording.joint_states
    if commands is None or commands.effort is None or joints.effort is None or len(commands.stamp) < 2:
        return None

    def held(latest: FloatArray) -> FloatArray:
        return _held(commands.stamp, effort, latest, joints.stamp)

    effort = np.clip(commands.effort, -robot.torque_limit, robot.torque_limit)
    cycle = _common_cycle(commands.stamp, joints.stamp)
    same = SAME_PART * min(float(np.median(np.diff(series.stamp))) for series in (commands, joints))
    if cycle is not None and _are_of_the_same_time(commands.stamp, joints.stamp, cycle):
        same = SAME_ON_AVERAGE * cycle
    found, latest = held(joints.stamp - SAME_STAMP), joints.stamp - SAME_STAMP
    for offset in (-same, SAME_STAMP, same):
        instead = held(joints.stamp + offset)
        nearer = (joints.effort - found) ** 2 - (joints.effort - instead) ** 2
        nearer = nearer[np.isfinite(nearer)]
        # Roots of squares: else a few leaps of the commands, which any lag leaves far behind, would drown all the rest.
        nearer = np.sign(nearer) * np.sqrt(np.abs(nearer))
        if nearer.sum() > SURE * np.sqrt(np.sum(nearer**2)):
            found, latest = instead, joints.stamp + offset
    if cycle is not None:
        age = _age(commands.stamp, latest)
        found[age > np.median(age) + LOST_PART * cycle] = np.nan
    return found


def _common_cycle(given: FloatArray, stamp: FloatArray) -> float | None:
    """Return the cycle [s] in which one command (M,) is given for each state (T,); None where it is not."""
    cycles = [float(np.median(np.diff(stamps))) for stamps in (given, stamp)]
    return min(cycles) if max(cycles) < (1.0 + CYCLES_ALIKE) * min(cycles) else None


def _are_of_the_same_time(given: FloatArray, stamp: FloatArray, cycle: float) -> bool:
    """Whether commands (M,) are nearer in time to the states (T,) that they are of than to any other."""
    together = np.mean(np.exp(2j * np.pi * _age(given, stamp) / cycle))
    return bool(np.abs(together) > LEAST_UNISON and np.abs(np.angle(together)) <= 2.0 * np.pi * SAME_PART)


def _age(given: FloatArray, latest: FloatArray) -> FloatArray:
    """How long before each time (T,) the last command (M,) was given [s]; before the first one less than nothing."""
    age: FloatArray = latest - given[np.maximum(np.searchsorted(given, latest, side="left") - 1, 0)]
    return age


def held_speeds(recording: Recording) -> FloatArray:
    """Return the speed that every joint was last commanded to hold at each stamp (T, n, 2) [rad/s]; NaN where none was."""
    commands, joints = recording.joint_commands, recording.joint_states
    if commands is None or commands.velocity is None or len(commands.stamp) < 2:
        return np.full_like(joints.position, np.nan)
    return _held(commands.stamp, commands.velocity, joints.stamp - SAME_STAMP, joints.stamp)


def _held(given: FloatArray, commands: FloatArray, latest: FloatArray, stamp: FloatArray) -> FloatArray:
    """The last of commands (M, n, 2) given before the latest time (T,) for each stamp (T,); NaN where it is too old."""
    last = np.searchsorted(given, latest, side="left") - 1
    fresh = (last >= 0) & (stamp - given[np.maximum(last, 0)] < LARGEST_GAP)
    return np.where(fresh[:, None, None], commands[np.maximum(last, 0)], np.nan)


def quiet_torque(
    robot: RobotDescription, recording: Recording, live: bool = False
) -> tuple[FloatArray, BoolArray] | None:
    """Return the motors' torques with as little of the noise of their measurement as can be had; None if none was reported.

    That is the command that a motor follows, and what is `expected` of the rest: late, short of it, or all where there was no
    command.

    An effect that is a function of the reported torque would hold the very noise that the residual holds, and be found as
    small, or as large, as makes that noise least.

    Args:
        robot: the robot; recording: of it.
        live: a window of a running robot, or what such windows are judged by: too short to tell a motor that lags.

    Returns:
        Torques (T, n, 2) [N m], and of which joints nothing but the reported ones is known (n, 2).
    """
    reported, commanded = recording.joint_states.effort, held_commands(robot, recording)
    if reported is None:
        return None
    commanded = np.full_like(reported, np.nan) if commanded is None else commanded
    long = not live and float(np.ptp(recording.joint_states.stamp)) >= LEAST_DURATION
    told: BoolArray = np.isfinite(commanded).max(axis=0)
    quiet = np.empty_like(reported)
    for i, axis in np.ndindex(told.shape):
        measured, command = reported[:, i, axis], commanded[:, i, axis]
        if not told[i, axis]:
            quiet[:, i, axis] = expected(measured)
            continue
        rest = measured - command
        if long:
            given = command + (0.0 if _is_noise(rest) else expected(rest))
        else:
            given = command if _follows(measured, command) else measured
        quiet[:, i, axis] = np.where(np.isfinite(given), given, measured)
    return quiet, ~told


def _follows(measured: FloatArray, command: FloatArray) -> bool:
    """Whether a torque (T,) is about its command (T,)."""
    both = np.isfinite(measured) & np.isfinite(command)
    slope = float(measured[both] @ command[both]) / max(float(command[both] @ command[both]), 1e-300)
    return FOLLOWS[0] < slope < FOLLOWS[1]


def _is_noise(rest: FloatArray) -> bool:
    """Whether what is reported beyond a command (T,) is noise, or too little to tell."""
    known = rest[np.isfinite(rest)]
    if len(known) < LEAST_SAMPLES:
        return True
    quiet = expected(known)
    return bool(np.std(quiet) <= NOISE_PART * np.std(known - quiet))


def expected(values: FloatArray) -> FloatArray:
    """Return what a signal (T,) in white noise is expected to be without it, NaN where it is NaN.

    The part of each frequency that is not noise, by Wiener's filter; the noise is no more than what the quietest frequencies
    hold. What is regressed on it comes out in its true size, where on the signal as it is it would come out too
    small by the noise's part: Carroll et al., Measurement Error in Nonlinear Models, 2nd ed. (2006), chapter 4.
    """
    known = np.flatnonzero(np.isfinite(values))
    if len(known) < LEAST_SAMPLES:
        return values
    rows = np.arange(len(values))
    whole = np.interp(rows, known, values[known])
    mirrored = np.concatenate([whole, whole[::-1]])  # without a step at the ends
    spectrum = np.fft.rfft(mirrored)
    power = ndimage.uniform_filter1d(np.abs(spectrum) ** 2, SMOOTHED_ORDINATES, mode="nearest")
    noise = min(float(np.median(band)) for band in np.array_split(power, NOISE_BANDS))
    by_chance = 1.0 + SURE_POWER / np.sqrt(SMOOTHED_ORDINATES)
    share = np.where(power > by_chance * noise, 1.0 - noise / np.maximum(power, 1e-300), 0.0)
    quiet: FloatArray = np.fft.irfft(spectrum * share, len(mirrored))[: len(values)]
    return np.where(np.isfinite(values), quiet, np.nan)
