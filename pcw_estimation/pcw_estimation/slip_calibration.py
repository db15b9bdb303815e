"""Learn the noise of a healthy robot's encoders from a recording, for detectors that raise no false alarm on it.

    ros2 run pcw_estimation calibrate RECORDING --robot ROBOT --out slip_noise.yaml

The squared residuals of (4.4), (I - A A^+) B q_dot, of a drive known to be healthy follow the variances of `slip_noise`:

    e_k^2 / (1 - h_k) = sum of theta_m f_m        theta >= 0, the squares of the numbers of `SlipNoise`

with the leverage h of the fit and the features f: r^2, b_x^2, |w|^2, phi_dot^2, ... They are fitted by non-negative least
squares, weighted by the variance found. What the drive did not excite keeps the number of the robot file. At last the detector
runs along the recording, and its gate is set above the largest studentised residual that lasted as long as slip must.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.differential_kinematics import rigid_motion_kernel
from pcw_description.errors import PcwError
from pcw_description.new_file import require_new_file
from pcw_description.recording import Recording
from pcw_description.robot_description import FloatArray, RobotDescription
from pcw_description.robot_file import load_robot

from .errors import EstimationError
from .slip_consensus import SlipConsensus
from .slip_noise import DEFAULT_GATE, SlipNoise, sensed_kernel
from .slip_verdict import ConfirmParameters

# What a recording must hold: driving for so long [s], faster than this [m/s].
LEAST_DRIVING, LEAST_SPEED = 10.0, 0.05
# A healthy robot that contradicts its file by more than this is another robot: fractions of a speed [1], multiples of what the
# file's tolerances say [1], and a part of the distance of the casters from the centre [1].
MOST_FRACTION, MOST_TIMES, MOST_OF_REACH = 0.25, 10.0, 0.05
# Slip, and no noise: a residual that lasts, in fitted standard deviations.
MOST_GATE = 25.0
# The gate above the largest residual of the recording: another drive has a larger one.
HEADROOM = 1.3
FEATURES = 7


@dataclasses.dataclass(frozen=True)
class Calibration:
    """What was learned.

    Attributes:
        noise: the result.
        kept: numbers that the drive did not excite and that are still those of the robot file.
        driving: time in motion [s].
        largest: largest studentised residual that lasted.
    """

    noise: SlipNoise
    kept: tuple[str, ...]
    driving: float
    largest: float


def calibrate(
    robot: RobotDescription, stamp: FloatArray, position: FloatArray, velocity: FloatArray,
    segments: Sequence[slice] | None = None, confirm_time: float = 0.010,
) -> Calibration:  # fmt: skip
    """Learn the noise from joint readings of a healthy robot.

    Args:
        robot: the robot.
        stamp: (T,) [s], increasing.
        position: (T, n, 2) [rad].
        velocity: (T, n, 2) [rad/s].
        segments: rows between gaps; default: all.
        confirm_time: how long slip must last in the detector [s].

    Raises:
        EstimationError: too little driving, or readings that contradict the robot file by more than any healthy robot's.
    """
    usable = np.asarray(np.isfinite(position + velocity).all(axis=(1, 2)))
    if not usable.any():
        raise EstimationError("joint_states = all incomplete is not allowed; allowed: position and velocity of every joint")
    squares, features, speed = _features_along(
        robot.steer_axis, robot.caster_offset, robot.wheel_radius, position[usable], velocity[usable]
    )
    period = float(np.median(np.diff(stamp))) if len(stamp) > 1 else 0.0
    driving = float(np.count_nonzero(speed > LEAST_SPEED) * period)
    if driving < LEAST_DRIVING:
        raise EstimationError(
            f"driving = {driving:.3g} s above {LEAST_SPEED:g} m/s is not allowed; allowed: at least {LEAST_DRIVING:g} s"
        )
    nominal = SlipNoise.of_robot(robot)
    before = nominal.array()[:FEATURES] ** 2
    fitted, kept = _fitted(squares, features, before)
    names = [field.name for field in dataclasses.fields(SlipNoise)][:FEATURES]
    numbers = dict(zip(names, np.sqrt(fitted).tolist()))
    for name, most in (
        ("rolling_fraction", MOST_FRACTION), ("lateral_fraction", MOST_FRACTION),
        *((name, MOST_TIMES * getattr(nominal, name)) for name in ("steering_length", "heading_delay")),
        ("turning_length", MOST_OF_REACH * float(np.sqrt(np.mean(np.sum(robot.steer_axis**2, axis=1))))),
    ):  # fmt: skip
        if numbers[name] > most:
            raise EstimationError(
                f"{name} = {numbers[name]:.3g} is not allowed; allowed: at most {most:.3g}: the wheels of a healthy "
                f"{robot.name!r} agree better, so the robot file does not match, or the robot slipped"
            )
    noise = SlipNoise(**numbers)
    largest = _largest_lasting(robot, noise, stamp, position, velocity, usable, segments, confirm_time)
    if largest > MOST_GATE:
        raise EstimationError(
            f"largest residual = {largest:.3g} standard deviations for {confirm_time:g} s is not allowed; allowed: at most "
            f"{MOST_GATE:g}: the robot slipped in this recording, or a joint is at fault"
        )
    gate = max(DEFAULT_GATE, HEADROOM * largest)
    return Calibration(
        dataclasses.replace(noise, gate=gate), tuple(np.array(names)[kept]), driving, largest
    )


@compiled
def _features_along(steer_axis, caster_offset, wheel_radius, position, velocity):  # type: ignore[no-untyped-def]
    """Return e^2 / (1 - h) (T, 2n), the features (T, 2n, 7), and the speed of the wheels (T,)."""
    n = len(wheel_radius)
    squares, features, speed = np.empty((len(position), 2 * n)), np.zeros((len(position), 2 * n, 7)), np.empty(len(position))
    for k in range(len(position)):
        sensed = sensed_kernel(caster_offset, wheel_radius, velocity[k])
        heading = position[k, :, 1].copy()
        twist, residual, inverse = rigid_motion_kernel(steer_axis, caster_offset, heading, sensed)
        total = 0.0
        for i in range(n):
            c, s = np.cos(heading[i]), np.sin(heading[i])
            bx, by = caster_offset[i, 0], caster_offset[i, 1]
            px, py = steer_axis[i, 0] + bx * c - by * s, steer_axis[i, 1] + bx * s + by * c
            squared = sensed[i, 0] ** 2 + sensed[i, 1] ** 2
            total += squared / n
            rate = velocity[k, i, 1] ** 2
            for j in range(2):
                ux, uy = (c, s) if j == 0 else (-s, c)
                row = (ux, uy, uy * px - ux * py)
                leverage = 0.0
                for a in range(3):
                    for b in range(3):
                        leverage += row[a] * inverse[a, b] * row[b]
                m = 2 * i + j
                squares[k, m] = residual[i, j] ** 2 / max(1.0 - leverage, 0.05)
                features[k, m, j] = wheel_radius[i] ** 2 if j == 0 else bx * bx
                features[k, m, 2 + j] = squared
                features[k, m, 4], features[k, m, 5], features[k, m, 6] = rate, rate * squared, twist[2] ** 2
        speed[k] = np.sqrt(total)
    return squares, features, speed


def _fitted(squares: FloatArray, features: FloatArray, before: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Return theta (7,) and which of them the recording does not tell, by weighted non-negative least squares."""
    y, f = squares.ravel(), features.reshape(-1, FEATURES)
    # A fifth of a million numbers tell it as well as all of them.
    chosen = np.linspace(0, len(y) - 1, min(len(y), 200_000)).astype(int)
    y, f = y[chosen], f[chosen]
    white = f[:, :2] @ before[:2]
    kept = np.array([m > 1 and np.quantile(before[m] * f[:, m] / white, 0.99) < 0.05 for m in range(FEATURES)])
    theta = before.copy()
    for _ in range(8):
        variance = f @ theta + 1e-12
        weight = 1.0 / variance**2
        # A few gross outliers shall not make the noise of all the rest.
        weight *= np.minimum(1.0, 16.0 * variance / np.maximum(y, 1e-300))
        normal, right = (f * weight[:, None]).T @ f, (f * weight[:, None]).T @ y
        for _ in range(200):  # coordinate descent; non-negative
            for m in np.flatnonzero(~kept):
                if normal[m, m] > 0.0:
                    theta[m] = max(0.0, theta[m] + (right[m] - normal[m] @ theta) / normal[m, m])
        # Quiet joints at standstill do not say that a velocity is exact.
        theta[:2] = np.maximum(theta[:2], 0.05 * before[:2])
    return theta, kept


def _largest_lasting(
    robot: RobotDescription, noise: SlipNoise, stamp: FloatArray, position: FloatArray, velocity: FloatArray,
    usable: np.ndarray, segments: Sequence[slice] | None, confirm_time: float,
) -> float:  # fmt: skip
    """Return the largest studentised residual that lasts for `confirm_time`: the largest of the least in each window."""
    # A gate that nothing passes: all wheels are fitted, as while no slip is found.
    open_noise = dataclasses.replace(noise, gate=1e6)
    detector = SlipConsensus(robot, open_noise, ConfirmParameters(confirm_time=confirm_time))
    largest = 0.0
    for segment in segments or [slice(0, len(stamp))]:
        rows = np.arange(len(stamp))[segment][usable[segment]]
        if len(rows) < 2:
            continue
        state, scores = detector.initial_state(), np.empty((len(rows), 2 * robot.n))
        for k, row in enumerate(rows):
            dt = float(stamp[row] - stamp[rows[k - 1]]) if k else 0.0
            state, finding = detector.step(state, position[row], velocity[row], dt)
            scores[k] = (np.abs(finding.slip) / finding.threshold).ravel() * open_noise.gate
        width = max(2, round(confirm_time / float(np.median(np.diff(stamp[rows])))))
        if len(rows) > width:
            lasting = np.lib.stride_tricks.sliding_window_view(scores, width, axis=0).min(axis=-1)
            largest = max(largest, float(lasting.max()))
    # A fitted residual is smaller than the studentised one by the share that the fit takes.
    return largest / np.sqrt(1.0 - 3.0 / (2.0 * robot.n))


def report(result: Calibration, robot: RobotDescription) -> str:
    """Return what was learned as lines of text."""
    nominal, lines = SlipNoise.of_robot(robot), [f"{'':<18}{'robot file':>12}{'learned':>12}"]
    for field in dataclasses.fields(SlipNoise):
        remark = "   not excited: kept" if field.name in result.kept else ""
        values = f"{getattr(nominal, field.name):>12.4g}{getattr(result.noise, field.name):>12.4g}"
        lines.append(f"{field.name:<18}{values}{remark}")
    lines.append(f"{result.driving:.0f} s of driving; the largest residual that lasted has {result.largest:.2g} deviations")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Calibrate from the command line; exit 0, or 2 for bad input."""
    parser = argparse.ArgumentParser(
        prog="calibrate", description="Learn the noise of a healthy robot's encoders from a recording of a drive without slip."
    )
    parser.add_argument("recording", help="rosbag2 folder, .mcap or .db3 with joint_states")
    parser.add_argument("--robot", required=True, help="shipped robot or path of a robot file")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="YAML file to make, for `noise`")
    parser.add_argument("--confirm-time", type=float, default=0.010, help="of the detector [s] (default: %(default)s)")
    options = parser.parse_args(arguments)
    try:
        if not 0.0 <= options.confirm_time <= 10.0:
            raise EstimationError(f"confirm_time = {options.confirm_time!r} s is not allowed; allowed: 0 to 10")
        require_new_file(options.out, "--out")
        robot = load_robot(options.robot)
        recording = Recording.open(options.recording, robot)
        joints = recording.joint_states
        for warning in recording.warnings:
            print(f"calibrate: {warning}", file=sys.stderr)
        result = calibrate(robot, joints.stamp, joints.position, joints.velocity, joints.segments(), options.confirm_time)
        name = Path(options.recording).resolve().name
        result.noise.save(options.out, robot.name, f"learned from {name}, {result.driving:.0f} s of driving without slip")
    except (PcwError, OSError) as error:
        print(f"calibrate: {error}", file=sys.stderr)
        return 2
    print(report(result, robot))
    print(f"written to {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
