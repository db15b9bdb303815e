"""Drawn faults of drawn robots: is the joint named that is at fault, and no other?"""

from __future__ import annotations

import dataclasses

import numpy as np

from ..fault_isolation import Fault, FaultIsolation
from ..slip_consensus import SlipConsensus
from .drawn_drives import DriveStyle, FloatArray, drawn_robot, drawn_twist, drive

FAULT_TIME = 3.0  # [s]
KINDS = {
    "none": None, "dead encoder": Fault.DEAD, "stuck encoder": Fault.STUCK, "drifting encoder": Fault.DRIFTING,
    "swapped sign": Fault.SWAPPED, "broken drive": Fault.NO_TORQUE,
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Diagnosis:
    """What was named on one drive.

    Attributes:
        n: number of casters.
        axis: of the joint at fault: 0 is drive, 1 steer.
        right: the joint was named with the fault that it has; where there is none, no joint was.
        wrong: other joints that were named.
        delay: until it was named [s]; NaN where it was not.
    """

    n: int
    axis: int
    right: bool
    wrong: int
    delay: float


def falsified(
    kind: str, position: FloatArray, velocity: FloatArray, stamp: FloatArray, i: int, j: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return readings (T, n, 2) with one joint's falsified."""
    position, velocity = position.copy(), velocity.copy()
    start = int(np.searchsorted(stamp, FAULT_TIME))
    if kind == "dead encoder":
        position[start:, i, j], velocity[start:, i, j] = position[start, i, j], 0.0
    elif kind == "stuck encoder":
        position[start:, i, j], velocity[start:, i, j] = position[start, i, j], velocity[start, i, j]
    elif kind == "drifting encoder":
        rate = rng.uniform(1.0, 4.0) * rng.choice([-1.0, 1.0])
        position[start:, i, j] += rate * (stamp[start:] - stamp[start])
        velocity[start:, i, j] += rate
    elif kind == "swapped sign":
        position[:, i, j] *= -1.0
        velocity[:, i, j] *= -1.0
    return position, velocity


def diagnose(seed: int, kind: str, duration: float = 15.0) -> Diagnosis:
    """Draw a robot, a drive and a joint, and return what is named of it."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 7))
    robot = drawn_robot(rng, n)
    twist = drawn_twist(rng, duration, DriveStyle())
    driven = drive(robot, twist, np.zeros((len(twist), n, 2)), rng)
    i, j = int(rng.integers(n)), int(rng.integers(2))
    position, velocity = falsified(kind, driven.position, driven.velocity, driven.stamp, i, j, rng)
    # Torques of some drive: what matters is whether they are there.
    commanded = rng.normal(0.0, 0.3, (n, 2)) * robot.torque_limit
    effort = commanded.copy()
    detector, isolation = SlipConsensus(robot), FaultIsolation(robot)
    state, joint = detector.initial_state(), robot.joint_names[2 * i + j]
    named: dict[str, dict[Fault, float]] = {}
    for k, now in enumerate(driven.stamp):
        if k % 50 == 0:
            commanded = rng.normal(0.0, 0.3, (n, 2)) * robot.torque_limit
            effort = commanded.copy()
            if kind == "broken drive" and now >= FAULT_TIME:
                effort[i, j] = 0.0
        dt = float(now - driven.stamp[k - 1]) if k else 0.0
        state, finding = detector.step(state, position[k], velocity[k], dt)
        if isolation.update(position[k], velocity[k], finding, dt, effort, commanded):
            for name, fault in isolation.faults().items():
                named.setdefault(name, {}).setdefault(fault, float(now))
    wrong = sum(name != joint or kind == "none" for name in named)
    wanted = KINDS[kind]
    if wanted is None:
        return Diagnosis(n, j, not named, wrong, np.nan)
    when = named.get(joint, {}).get(wanted)
    began = 0.0 if kind == "swapped sign" else FAULT_TIME
    return Diagnosis(n, j, when is not None, wrong, np.nan if when is None else when - began)
