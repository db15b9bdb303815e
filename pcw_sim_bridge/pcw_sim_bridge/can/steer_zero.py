"""Zeros of the steering axes from a motion: the headings with which wheels that roll agree on how the robot moves.

With headings q - delta of measured angles q, A(q - delta) V = B q_dot (3.24) holds for one twist V at each instant. The
offsets minimise what no twist explains,

    sum_k | (I - A_k A_k^+) B q_dot_k |^2,     A_k = A(q_k - delta),

with a soft loss, as wheels slip now and then. Turned all alike, headings fit any translation as well as before; rotation alone
tells that, by the places of the wheels. So the motion must turn the robot, and `excitation` says whether it did.
"""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path

import numpy as np

from pcw_description.differential_kinematics import joint_matrix_blocks
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription

from .can_file import CanFile, joint_place, read_can_file
from .errors import CanError

BLOCKS = 5  # of the motion, whose estimates tell how sure the whole is
LARGEST_OFFSET = 1.2  # [rad]; from a quarter turn on, wheels roll the other way round
SLOWEST = 0.02  # a robot that stands says nothing: mean speed of the wheels [m/s]
SOFTNESS = 0.01  # residuals above are slip, and count less [m/s]
MOST_SAMPLES = 3000


@dataclasses.dataclass(frozen=True)
class SteerZeros:
    """What was found.

    Attributes:
        offset: what the steering axes read too much (n,) [rad]; to be added to the `zero` of the file.
        sigma: standard deviation of them, from how parts of the motion differ (n,) [rad].
        residual_before, residual_after: rms of what no twist explains [m/s].
    """

    offset: FloatArray
    sigma: FloatArray
    residual_before: float
    residual_after: float


def estimate_steer_zeros(robot: RobotDescription, position: FloatArray, velocity: FloatArray) -> SteerZeros:
    """Return the offsets of the steering axes.

    Args:
        robot: the robot.
        position, velocity: measured at T times, joint side (T, n, 2) [rad], [rad/s].

    Raises:
        CanError: too little motion, or a motion that does not tell the offsets.
    """
    every = max(len(position) // MOST_SAMPLES, 1)
    position, velocity = position[::every], velocity[::every]
    sensed = np.einsum("nij,tnj->tni", joint_matrix_blocks(robot), velocity)
    speed = float(np.abs(sensed).mean()) if len(sensed) else 0.0
    if len(sensed) < 100 or speed < SLOWEST:
        raise CanError(
            f"motion of {len(sensed)} readings at {speed:.3g} m/s is not allowed; allowed: at least 100, {SLOWEST:g} m/s"
        )
    angle = position[:, :, STEER]
    best = _fit(robot, angle, sensed, np.zeros(robot.n))
    parts = [_fit(robot, angle[part], sensed[part], best) for part in np.array_split(np.arange(len(angle)), BLOCKS)]
    sigma = np.std(parts, axis=0, ddof=1) / math.sqrt(BLOCKS)
    if not np.isfinite(best).all() or np.abs(best).max() > LARGEST_OFFSET:
        raise CanError(f"offsets {np.round(best, 3).tolist()} rad are not allowed; allowed: below {LARGEST_OFFSET:g} rad")
    before, after = (_rms(_residuals(robot, angle, sensed, offset)) for offset in (np.zeros(robot.n), best))
    return SteerZeros(best, sigma, before, after)


def _fit(robot: RobotDescription, angle: FloatArray, sensed: FloatArray, start: FloatArray) -> FloatArray:
    # Here, since it takes half a second, for which a driver that starts would wait.
    from scipy.optimize import least_squares

    def residuals(offset: FloatArray) -> FloatArray:
        return _residuals(robot, angle, sensed, offset)

    found: FloatArray = least_squares(residuals, start, loss="soft_l1", f_scale=SOFTNESS).x
    return found


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _residuals(robot: RobotDescription, angle: FloatArray, sensed: FloatArray, offset: FloatArray) -> FloatArray:
    """Return (I - A A^+) B q_dot for all times, flattened; `sensed` is B q_dot (T, n, 2)."""
    heading = angle - offset
    c, s = np.cos(heading), np.sin(heading)
    bx, by = robot.caster_offset[:, 0], robot.caster_offset[:, 1]
    x = robot.steer_axis[:, 0] + bx * c - by * s
    y = robot.steer_axis[:, 1] + bx * s + by * c
    # Rows of A: along and across the heading, for v_x, v_y and omega.
    along = np.stack([c, s, x * s - y * c], axis=-1)
    across = np.stack([-s, c, x * c + y * s], axis=-1)
    jacobian = np.concatenate([along, across], axis=1)  # (T, 2n, 3)
    wanted = np.concatenate([sensed[:, :, 0], sensed[:, :, 1]], axis=1)
    normal = np.einsum("tij,tik->tjk", jacobian, jacobian)
    twist = np.linalg.solve(normal, np.einsum("tij,ti->tj", jacobian, wanted)[:, :, None])[:, :, 0]
    residual: FloatArray = (wanted - np.einsum("tij,tj->ti", jacobian, twist)).ravel()
    return residual


def calibration_twist(time: float, duration: float, speed: float = 0.2, yaw_rate: float = 0.6) -> FloatArray:
    """Return the known motion: turning to and fro while going round, from rest to rest (3,)."""
    fade = min(1.0, time / 1.0, max(duration - time, 0.0) / 1.0)
    return fade * np.array(
        [
            speed * math.sin(math.tau * time / 8.0),
            speed * math.cos(math.tau * time / 8.0),
            yaw_rate * math.sin(math.tau * time / 5.0),
        ]
    )


# --- Writing back ----------------------------------------------------------------------------------------


def write_zeros(path: Path, robot: RobotDescription, offset: FloatArray, out: Path | None = None) -> Path:
    """Add offsets (n,) to the `zero` of the steering axes of a CAN file; comments and order stay as they are.

    Args:
        path: the file.
        robot: its robot.
        offset: to be added (n,) [rad].
        out: another file to write; default: `path`, the old one being kept under the first free name FILE.1, FILE.2 ...

    Returns:
        Where the old file is.

    Raises:
        CanError: a file whose entries cannot be found line by line, or that exists; nothing has changed then.
    """
    before = path.read_text(encoding="utf-8")
    old = read_can_file(path, robot)
    text, wanted = before, {}
    for joint in old.joints:
        place = joint_place(robot, joint.name)
        if place[1] == DRIVE:
            continue
        wanted[joint.name] = round(joint.zero + float(offset[place[0]]), 6)
        text = _with_zero(text, joint.name, wanted[joint.name])
    target = path if out is None else out
    if out is not None and out.exists():
        raise CanError(f"out {out} exists already and is left as it is; allowed: a new file")
    kept = path if out is not None else _free_name(path)
    if out is None:
        kept.write_text(before, encoding="utf-8")
    target.write_text(text, encoding="utf-8")
    problem = _differs(target, robot, old, wanted)
    if problem:
        if out is None:
            target.write_text(before, encoding="utf-8")
            kept.unlink()
        else:
            target.unlink()
        raise CanError(f"{path}: {problem}; allowed: joints with one `name:` each. The file is as it was")
    return kept


def _free_name(path: Path) -> Path:
    number = 1
    while (kept := path.with_name(f"{path.name}.{number}")).exists():
        number += 1
    return kept


def _differs(path: Path, robot: RobotDescription, old: CanFile, wanted: dict[str, float]) -> str:
    """Say what is not as wanted in a file that was written; "" when all is well."""
    try:
        new = read_can_file(path, robot)
    except ValueError as error:
        return f"it would not be read any more ({error})"
    for before, after in zip(old.joints, new.joints, strict=True):
        if dataclasses.replace(after, zero=before.zero) != before:
            return f"{before.name} would change in more than its zero"
        if after.zero != wanted.get(before.name, before.zero):
            return f"the zero of {before.name} would be {after.zero:g}"
    return ""


def _with_zero(text: str, name: str, zero: float) -> str:
    """Return the text with the zero of one joint set."""
    lines = text.split("\n")
    for i, line in enumerate(lines):
        if not re.search(rf"(?<![\w.])name:\s*[\"']?{re.escape(name)}[\"']?\s*(?:[,}}#]|$)", line):
            continue
        if "{" in line:
            if re.search(r"(?<![\w.])zero:", line):
                lines[i] = re.sub(r"(?<![\w.])zero:\s*[^,}]+", f"zero: {zero:.6g}", line, count=1)
            else:
                lines[i] = line[: line.rindex("}")] + f", zero: {zero:.6g}" + line[line.rindex("}") :]
            return "\n".join(lines)
        indent = line.index("name:")
        end = i + 1
        while end < len(lines) and (not lines[end].strip() or len(lines[end]) - len(lines[end].lstrip()) >= indent):
            if re.match(rf"\s{{{indent}}}zero:", lines[end]):
                lines[end] = re.sub(r"zero:\s*\S+", f"zero: {zero:.6g}", lines[end], count=1)
                return "\n".join(lines)
            end += 1
        lines.insert(i + 1, f"{' ' * indent}zero: {zero:.6g}")
        return "\n".join(lines)
    raise CanError(f"joint {name} has no line of its own in the file; allowed: `name: {name}` on one line")
