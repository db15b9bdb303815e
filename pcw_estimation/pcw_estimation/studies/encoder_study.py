"""What the encoders alone can find: Fig. 4.1 of the thesis, drawn scenarios of slip, and false alarms of healthy robots."""

from __future__ import annotations

import dataclasses

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import RobotDescription
from pcw_description.robot_file import load_robot

from .. import slip_consensus, slip_procedure
from ..slip_consensus import SlipConsensus
from ..slip_noise import SlipNoise
from ..slip_procedure import SlipProcedure
from ..slip_verdict import Verdict
from .drawn_drives import STEP, Drive, DriveStyle, FloatArray, drawn_robot, drawn_twist, drive

METHODS = ("consensus", "procedure")


@dataclasses.dataclass(frozen=True)
class Found:
    """What a detector says along a drive: flags (T, n, 2), the verdict (T,), slip (T, n, 2) and the twist (T, 3)."""

    flagged: np.ndarray
    verdict: np.ndarray
    slip: FloatArray
    twist: FloatArray


def run(method: str, driven: Drive, noise: SlipNoise | None = None) -> Found:
    """Run a detector along a drive, compiled: the same as its `step` in a loop; `noise` is by default that of the file."""
    detector = SlipConsensus(driven.robot, noise) if method == "consensus" else SlipProcedure(driven.robot, noise)
    along = _consensus_along if method == "consensus" else _procedure_along
    dt = float(driven.stamp[1] - driven.stamp[0])
    return Found(
        *along(detector._geometry, driven.position, driven.velocity, dt, detector._numbers, detector.initial_state())
    )


@compiled
def _consensus_along(geometry, position, velocity, dt, numbers, state):  # type: ignore[no-untyped-def]
    flagged, verdicts = np.zeros(position.shape, dtype=np.bool_), np.zeros(len(position), dtype=np.int64)
    slips, twists = np.empty(position.shape), np.empty((len(position), 3))
    for k in range(len(position)):
        step = dt if k else 0.0
        state, fitted, arrays, masks, verdicts[k] = _consensus_step(geometry, position[k], velocity[k], step, numbers, state)
        flagged[k], slips[k], twists[k] = masks[1] | masks[2], arrays[0], fitted[0]
    return flagged, verdicts, slips, twists


@compiled
def _procedure_along(geometry, position, velocity, dt, numbers, state):  # type: ignore[no-untyped-def]
    flagged, verdicts = np.zeros(position.shape, dtype=np.bool_), np.zeros(len(position), dtype=np.int64)
    slips, twists = np.empty(position.shape), np.empty((len(position), 3))
    for k in range(len(position)):
        step = dt if k else 0.0
        state, fitted, arrays, masks, verdicts[k] = _procedure_step(geometry, position[k], velocity[k], step, numbers, state)
        flagged[k], slips[k], twists[k] = masks[1] | masks[2], arrays[0], fitted[0]
    return flagged, verdicts, slips, twists


_consensus_step, _procedure_step = slip_consensus._step_kernel, slip_procedure._step_kernel


# --- Fig. 4.1 -------------------------------------------------------------------------------------------


def fig_4_1(seed: int = 0, magnitude: float = 0.15) -> Drive:
    """Return the drive of Fig. 4.1: the thesis robot, wheel 3 slips from 1.5 to 3.5 s, all others roll."""
    rng = np.random.default_rng(seed)
    robot = with_imu_at_1_khz(load_robot("thesis"))
    steps = round(5.0 / STEP)
    time = STEP * np.arange(steps)
    twist = np.zeros((steps, 3))
    twist[:, 0] = 0.5 * np.clip(time / 0.5, 0.0, 1.0)
    slip = np.zeros((steps, robot.n, 2))
    slip[:, 2, 0] = magnitude * ((time >= 1.5) & (time < 3.5))
    return drive(robot, twist, slip, rng)


def with_imu_at_1_khz(robot: RobotDescription) -> RobotDescription:
    """Return the robot with the rate that the thesis gives for its IMU."""
    assert robot.sensors.imu is not None
    imu = dataclasses.replace(robot.sensors.imu, rate=1.0 / STEP)
    return dataclasses.replace(robot, sensors=dataclasses.replace(robot.sensors, imu=imu))


@dataclasses.dataclass(frozen=True)
class Episode:
    """Of one wheel that slipped: delay of the first flag and of its end [s]; NaN where there was none."""

    onset_delay: float
    end_delay: float


def episode(driven: Drive, found: Found, caster: int, start: float, end: float) -> Episode:
    """Return when the slip of a caster was found and when it was found to be over."""
    flags = np.asarray(found.flagged[:, caster].any(axis=1))
    on = np.flatnonzero(flags)
    if not len(on):
        return Episode(np.nan, np.nan)
    last = min(on[-1] + 1, len(flags) - 1)
    return Episode(float(driven.stamp[on[0]] - start), float(driven.stamp[last] - end))


# --- Drawn scenarios ------------------------------------------------------------------------------------

# Axes in which a caster slips, and how often: rolling, steering, both.
AXES = ((True, False), (False, True), (True, True))


@dataclasses.dataclass(frozen=True)
class Scenario:
    """A drive with slip.

    Attributes:
        driven: the drive.
        casters: which slip (n,).
        start, end: from the first onset to the last end [s].
    """

    driven: Drive
    casters: np.ndarray
    start: float
    end: float


def drawn_scenario(
    seed: int, axes_share: tuple[float, float, float] = (1.0, 0.0, 0.0), to_and_fro: bool = False
) -> Scenario:
    """Return a scenario: 3 to 6 casters, 1 to n - 2 of them slip for a second or two on a drawn drive.

    Args:
        seed: of everything.
        axes_share: how often a caster slips in its rolling axis, its steering axis and both.
        to_and_fro: slips change their signs, those along and across a wheel at different times.
    """
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 7))
    count = int(rng.integers(1, n - 1))
    robot = drawn_robot(rng, n)
    duration, start = 6.0, rng.uniform(2.0, 2.5)
    end = start + rng.uniform(1.0, 2.5)
    twist = drawn_twist(rng, duration, DriveStyle())
    time = STEP * np.arange(len(twist))
    slip = np.zeros((len(twist), n, 2))
    casters = np.zeros(n, dtype=bool)
    casters[rng.choice(n, count, replace=False)] = True
    together = rng.random() < 0.5
    for i in np.flatnonzero(casters):
        own_start = start if together else start + rng.uniform(0.0, 0.5)
        own_end = end if together else end - rng.uniform(0.0, 0.3)
        rise = rng.uniform(0.005, 0.1)
        ramp = np.clip(np.minimum((time - own_start) / rise, (own_end - time) / rise), 0.0, 1.0)
        axes = AXES[rng.choice(3, p=axes_share)]
        for axis in np.flatnonzero(axes):
            size = np.exp(rng.uniform(np.log(0.05), np.log(0.5))) * rng.choice([-1.0, 1.0])
            wave = 1.0 + rng.uniform(0.0, 0.3) * np.sin(2.0 * np.pi * rng.uniform(0.5, 4.0) * time)
            if to_and_fro:
                wave = np.sin(2.0 * np.pi * (rng.uniform(0.5, 4.0) * time + rng.random()))
            slip[:, i, axis] = size * wave * ramp
    source = "drive" if rng.random() < 0.5 else "difference"
    return Scenario(drive(robot, twist, slip, rng, velocity_source=source), casters, start, end)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a detector made of a scenario.

    Attributes:
        exact: the casters flagged are those that slipped, no more and no fewer.
        missed, wrong: number of casters that slipped and were not flagged, and the other way round.
        said_it_cannot_know: share of the time of slip in which it said so.
        early: casters flagged before anything slipped.
    """

    exact: bool
    missed: int
    wrong: int
    said_it_cannot_know: float
    early: int


def judge(scenario: Scenario, found: Found) -> Outcome:
    """Compare what was found with what was; up to 20 ms after the end count as slip."""
    stamp = scenario.driven.stamp
    during = (stamp >= scenario.start) & (stamp < scenario.end + 0.02)
    ever = np.asarray(found.flagged.any(axis=2))
    flagged = ever.any(axis=0)
    early = int(ever[~during].any(axis=0).sum())
    missed, wrong = scenario.casters & ~flagged, flagged & ~scenario.casters
    unknown = float(np.mean(found.verdict[during] == int(Verdict.CANNOT_KNOW)))
    return Outcome(not missed.any() and not wrong.any() and not early, int(missed.sum()), int(wrong.sum()), unknown, early)


def healthy_alarms(seed: int, method: str = "consensus", duration: float = 20.0) -> int:
    """Return how often a drawn healthy robot is said to slip on a drawn drive."""
    rng = np.random.default_rng(seed)
    robot = drawn_robot(rng, int(rng.integers(3, 7)))
    twist = drawn_twist(rng, duration, DriveStyle())
    source = "drive" if rng.random() < 0.5 else "difference"
    driven = drive(robot, twist, np.zeros((len(twist), robot.n, 2)), rng, velocity_source=source)
    flags = run(method, driven).flagged.any(axis=(1, 2))
    return int(np.count_nonzero(np.diff(flags.astype(int)) > 0))
