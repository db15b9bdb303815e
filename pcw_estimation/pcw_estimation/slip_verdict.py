"""What a detector that works on encoders alone says of every wheel, and the confirmation that all of them share."""

from __future__ import annotations

import dataclasses
import enum
import math
from typing import NamedTuple

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import FloatArray, RobotDescription

from .errors import EstimationError, require_not_negative


class Verdict(enum.IntEnum):
    """What the encoders together allow to be said.

    Slip that is a motion of the whole robot (all wheels alike) is within `CONSISTENT`: no encoder shows it. Where it comes
    faster than traction can move the robot it is `CANNOT_KNOW`.
    """

    CONSISTENT = 0
    SLIP = 1
    CANNOT_KNOW = 2


VERDICTS = tuple(Verdict)
REASONS = {
    Verdict.CONSISTENT: "the wheels agree",
    Verdict.SLIP: "some wheels slip",
    Verdict.CANNOT_KNOW: "all wheels slip, or one does not and cannot be told",
}
# Whatever the verdict: slip that is a motion of the whole robot is motion to every encoder.
COMMON_SLIP = "whether all wheels slip alike cannot be known from encoders"


@dataclasses.dataclass(frozen=True)
class ConfirmParameters:
    """How long a wheel must be found slipping, and rolling, until it is said.

    Attributes:
        confirm_time: a component is flagged once it has slipped for so long [s].
        release_time: and is no more once it has rolled for so long [s].
        ratio_speed: slip ratio and slip angle refer to at least this speed, below which they are noise [m/s].
    """

    confirm_time: float = 0.010
    release_time: float = 0.010
    ratio_speed: float = 0.05

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            EstimationError: names the field, its value and what is allowed.
        """
        require_not_negative(self, positive=("ratio_speed",))


class SlipFinding(NamedTuple):
    """What one measurement of the joints says about slip; arrays (n, 2) are longitudinal and lateral.

    A named tuple because one is made on every cycle, and a frozen dataclass of as many fields takes four times as long.

    Attributes:
        twist: twist of base_link from the components that do not slip (3,), step 3 of the procedure.
        covariance: of the twist (3, 3), from the noise of those components.
        slip: sensed less fitted velocity in the frames of the wheels (n, 2) [m/s].
        ratio: slip ratio (longitudinal) [1] and slip angle (lateral) [rad] (n, 2).
        threshold: how far each component may lie off before it counts as slip (n, 2) [m/s].
        suspect: left out of the twist in this measurement (n, 2).
        slipping: confirmed, and the wheel runs ahead of its motion over the ground (n, 2).
        skidding: confirmed, and the wheel lags behind (n, 2).
        verdict: what can be said at all.
    """

    twist: FloatArray
    covariance: FloatArray
    slip: FloatArray
    ratio: FloatArray
    threshold: FloatArray
    suspect: np.ndarray
    slipping: np.ndarray
    skidding: np.ndarray
    verdict: Verdict


def check_measurement(robot: RobotDescription, joint_position: FloatArray, joint_velocity: FloatArray, dt: float) -> None:
    """Refuse what no detector can use.

    Raises:
        EstimationError: dt is negative or not finite; a measurement is not finite or not of shape (n, 2).
    """
    if not (math.isfinite(dt) and dt >= 0.0):
        raise EstimationError(f"dt = {dt!r} s is not allowed; allowed: at least 0, measured from stamps")
    for name, values in (("joint_position", joint_position), ("joint_velocity", joint_velocity)):
        # A sum is finite only if all of it is, and costs a fraction of isfinite().all().
        if values.shape != (robot.n, 2) or not math.isfinite(values.sum()):
            raise EstimationError(
                f"{name} = {values.tolist()} is not allowed; allowed: finite numbers, shape ({robot.n}, 2)"
            )


# What a kernel gives as its verdict where a measurement is not finite; `check_measurement` then says which.
REFUSED = -1


@compiled
def finite_kernel(joint_position, joint_velocity):  # type: ignore[no-untyped-def]
    """Whether a measurement (n, 2) holds finite numbers only."""
    total = 0.0
    for i in range(len(joint_position)):
        for j in range(2):
            total += joint_position[i, j] + joint_velocity[i, j]
    return math.isfinite(total)  # a sum is finite only if all of it is


def finding_of(fitted: FloatArray, arrays: FloatArray, masks: np.ndarray, verdict: int) -> SlipFinding:
    """Return the finding that a kernel packed: twist and covariance (4, 3); slip, ratio, threshold; the three masks."""
    # By index: to unpack an array takes numpy five times as long.
    return SlipFinding(
        fitted[0], fitted[1:], arrays[0], arrays[1], arrays[2], masks[0], masks[1], masks[2], VERDICTS[verdict]
    )


@compiled
def confirm_kernel(suspect, flagged, elapsed, dt, confirm_time, release_time):  # type: ignore[no-untyped-def]
    """Advance in place the flags (n, 2) and the times (n, 2) [s] for which `suspect` has contradicted them."""
    for i in range(len(suspect)):
        for j in range(2):
            contradicted = suspect[i, j] != (flagged[i, j] != 0.0)
            elapsed[i, j] = elapsed[i, j] + dt if contradicted else 0.0
            limit = release_time if flagged[i, j] != 0.0 else confirm_time
            # Stamps are whole nanoseconds, their sums in floating point are not.
            if contradicted and elapsed[i, j] >= limit - 1e-9:
                flagged[i, j], elapsed[i, j] = 1.0 if suspect[i, j] else 0.0, 0.0


@compiled
def describe_kernel(sensed, slip, threshold, flagged, ratio_speed, ratio, slipping, skidding):  # type: ignore[no-untyped-def]
    """Write slip ratio and angle (n, 2), which flags mean slipping and which skidding (n, 2), into the last three."""
    for i in range(len(slip)):
        along = max(abs(sensed[i, 0] - slip[i, 0]), abs(sensed[i, 0]), ratio_speed)
        ratio[i, 0] = slip[i, 0] / along
        ratio[i, 1] = math.atan2(slip[i, 1], along)
        for j in range(2):
            # Ahead or behind is meant along the motion over the ground; of a standing robot along the wheel's own.
            fitted = sensed[i, j] - slip[i, j]
            direction = fitted if abs(fitted) > threshold[i, j] else sensed[i, j]
            slipping[i, j] = flagged[i, j] != 0.0 and slip[i, j] * direction > 0.0
            skidding[i, j] = flagged[i, j] != 0.0 and not slipping[i, j]
