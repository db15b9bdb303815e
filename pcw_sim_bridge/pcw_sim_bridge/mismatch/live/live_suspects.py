"""Where a departure sits: the caster, the chassis or the IMU, by how much of it a simple cause there accounts for.

A hint within a second or two, not a name: that is the work of `mismatch analyze` on the recording that was kept. Each cause
is a few columns of the channel model; with the tolerances marginalised, y and X the whitened departure and columns,

    left = |y|^2 - y^T X (X^T X + 1 / d^2)^-1 X^T y

and a place is told where its best cause leaves much less than the best cause anywhere else.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
from scipy import linalg

from pcw_description.robot_description import AXIS_NAMES

from ..regression.regression_problem import BoolArray, FloatArray
from ..robot.channel_differences import ChannelDifferences
from ..robot.robot_channels import STILL_SPEED
from ..robot.rolling_model import WRENCH
from .live_rows import Window
from .live_tuning import Tuning

ALL_CASTERS = "all casters"
# A place is told if its best cause accounts for at least this part, and every other place leaves so many times as much.
LEAST_SHARE, LEAST_RATIO = 0.5, 1.5
# Numbers of the description by what they would be if they were far off, and where.
_CAUSE_OF_NUMBER = {
    "chassis": ("chassis", "mass or load"),
    "ground": ("chassis", "inclination of the floor"),
    "imu": ("imu", "reading of the IMU"),
    "wheel_radius": (None, "radius of the wheel"),
    "steer_zero": (None, "zero of the steering"),
    "caster_offset": (None, "caster offset"),
    "torque_constant": (None, "torque of a motor"),
}


@dataclasses.dataclass(frozen=True)
class Suspect:
    """What a departure looks most like.

    Attributes:
        place: a caster, "all casters", "chassis" or "imu".
        cause: in plain words.
        share: part of the departure's mean square that it accounts for, 0..1.
        told: whether it stands out from every other place.
    """

    place: str
    cause: str
    share: float
    told: bool

    def __str__(self) -> str:
        """One phrase for people."""
        if not self.told:
            return "where it comes from cannot be told yet"
        return f"looks most like {self.place}: {self.cause} ({100.0 * self.share:.0f} % of it)"


@dataclasses.dataclass(frozen=True)
class _Cause:
    place: str
    cause: str
    columns: FloatArray  # (T, C, P)


def find_suspect(tuning: Tuning, window: Window, since: float) -> Suspect | None:
    """Return what the rows from `since` [s] on look most like; None if there are none that may be judged."""
    rows, _ = tuning.layout.arranged(window.layout, window.rows)
    late = rows.time >= since
    valid = rows.valid & late[:, None]
    if not valid.any():
        return None
    scale = np.sqrt(tuning.noise**2 + (tuning.layout.scale_deviation * _size(rows.measured, valid)) ** 2)
    scale = scale * tuning.slow / tuning.noise

    def whitened(values: FloatArray) -> FloatArray:
        extra = (1,) * (values.ndim - 2)
        flat: FloatArray = (values / scale.reshape(1, -1, *extra))[valid]
        return flat

    target, numbers = whitened(tuning.residual(rows)), whitened(rows.columns)
    precision = tuning.information + np.diag(1.0 / tuning.layout.deviations**2)
    factor = linalg.cho_factor(precision + numbers.T @ numbers)

    def free_of_tolerances(values: FloatArray) -> FloatArray:
        result: FloatArray = values - numbers @ linalg.cho_solve(factor, numbers.T @ values)
        return result

    power = float(target @ free_of_tolerances(target))
    best: dict[str, tuple[float, str]] = {}
    for cause in _causes(tuning, window):
        columns = whitened(cause.columns)
        size = float(np.sum(columns**2))
        if size <= 0.0:
            continue
        freed = free_of_tolerances(columns)
        normal = columns.T @ freed + np.eye(columns.shape[1]) * size / max(power, 1e-12)
        moment = freed.T @ target
        left = power - float(moment @ np.linalg.solve(normal, moment))
        if cause.place not in best or left < best[cause.place][0]:
            best[cause.place] = left, cause.cause
    if not best or power <= 0.0:
        return None
    place, (left, name) = min(best.items(), key=lambda entry: entry[1][0])
    others = min((other for key, (other, _) in best.items() if key != place), default=power)
    share = 1.0 - left / power
    return Suspect(place, name, share, share >= LEAST_SHARE and others >= LEAST_RATIO * left)


def _size(measured: FloatArray, valid: BoolArray) -> FloatArray:
    size: FloatArray = np.sqrt(np.sum(np.where(valid, measured, 0.0) ** 2, axis=0) / np.maximum(valid.sum(axis=0), 1))
    return size


def _causes(tuning: Tuning, window: Window) -> Iterator[_Cause]:
    """Every cause that the channels can show, as columns in the tuning's layout."""
    layout, robot = tuning.layout, window.builder.robot
    rows, _ = layout.arranged(window.layout, window.rows)
    groups: dict[tuple[str, str], list[int]] = {}
    for k, name in enumerate(layout.nuisances):
        known = _CAUSE_OF_NUMBER.get(name.split("/")[0].split(".")[0])
        if known is None:
            continue
        place, cause = known
        own = name.partition("/")[2]
        for axis in AXIS_NAMES:
            if own.endswith(f"_{axis}"):
                own, cause = own.removesuffix(f"_{axis}"), f"torque of the {axis} motor"
        groups.setdefault((place or own, cause), []).append(k)
    for (place, cause), members in groups.items():
        together = cause == "inclination of the floor"
        for chosen in [members] if together else [[k] for k in members]:
            yield _Cause(place, cause, rows.columns[:, :, chosen])
    wrench = [c for c, name in enumerate(layout.channel_names) if name in WRENCH]
    if wrench:
        push = np.zeros((len(rows), len(layout.channels), len(wrench)))
        push[:, wrench, range(len(wrench))] = 1.0
        yield _Cause("chassis", "force or push", push)
    builder = window.builder
    if builder.balanced:
        differences = ChannelDifferences(builder.model, builder.motions, builder.filters)
        for column_of_axis, axis_name in enumerate(AXIS_NAMES):
            each = [_friction_column(tuning, window, differences, i, column_of_axis) for i in range(robot.n)]
            cause = f"friction in the {'drive' if axis_name == 'drive' else 'steering'}"
            for name, column in zip(robot.caster_names, each, strict=True):
                yield _Cause(name, cause, column)
            yield _Cause(ALL_CASTERS, cause, np.asarray(sum(each)))


def _friction_column(
    tuning: Tuning, window: Window, differences: ChannelDifferences, caster: int, axis: int
) -> FloatArray:
    """What a torque against the motion of one joint adds to the residual, (T, C, 1)."""
    torques = []
    for motion in differences.motions:
        torque = np.zeros((*motion.torque.shape, 1))
        torque[:, caster, axis, 0] = -np.tanh(motion.velocity[:, caster, axis] / STILL_SPEED)
        torques.append(torque)
    column = differences.of_torque(torques)[-len(window.rows) :, :, 0]
    rows = dataclasses.replace(window.rows, residual=column)
    arranged, _ = tuning.layout.arranged(window.layout, rows)
    return arranged.residual[:, :, None]
