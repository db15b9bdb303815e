"""What a running robot has shown of its own numbers: re-tuning inside the tolerances, and the noise that remains.

Rows r = N nu + noise with nu ~ Normal(0, D) are collected as information, G = sum N^T W N and g = sum N^T W r with
W = 1 / (slow^2 + N U N^T + (s |measured|)^2), slow^2 the power of the slow part of the noise, so that coloured rows, and rows
that the model misjudges, do not count for more than they know:

    P = (G + D^-1)^-1,   m = P g,   judged residual = r - N m,
    deviation^2 = noise^2 + diag(N (P + U) N^T) + (s |measured|)^2

What has not been excited yet keeps its tolerance in P, so that a healthy robot stays near one deviation in manoeuvres that
were not part of the learning. s is the part of the measured side that the model may misjudge, U the variances than which no
number is steadier, each of a part of its tolerance.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_description.robot_description import RobotDescription
from pcw_description.robot_file import robot_to_mapping

from ..errors import MismatchError
from ..regression.noise_model import huber_weights, robust_deviation, slow_power
from ..regression.regression_problem import BoolArray, Channel, FloatArray
from .live_rows import Layout, Rows

FORMAT = "pcw_live_calibration/1"
ITERATIONS = 8
# Fewer rows of a channel than this tell nothing of its noise.
FEWEST_ROWS = 60
# Part of its tolerance by which a number differs from one motion to another: a tyre's radius with its load, a gain as motors
# warm up. What was learned of it in one motion is no nearer to the next.
UNSTEADY = 0.05
# The same of numbers of the tyres. Their columns are those of the description, and slips are curved in them: the more a wheel
# has to hold, the less the first order knows of a tyre that is off by a part of its wide tolerance.
CURVED, UNSTEADY_TYRES = "contact.", 0.3
# The floor of today is not that of the day of the calibration, and is counted from another yaw.
OF_THE_PLACE = "ground.slope"


@dataclasses.dataclass
class Tuning:
    """The state of the re-tuning.

    Attributes:
        robot: digest of the description, see `digest`; cutoff: of the channels' filter [Hz].
        layout: what the axes are.
        noise: deviation of each channel's healthy residual (C,); slow: the same of its slow part, as white noise.
        information: (K, K); moment: (K,).
        learned: length of motion that this rests on [s].
    """

    robot: str
    cutoff: float
    layout: Layout
    noise: FloatArray
    slow: FloatArray
    information: FloatArray
    moment: FloatArray
    learned: float

    def __post_init__(self) -> None:
        """Compute the posterior."""
        tyres = np.array([name.startswith(CURVED) for name in self.layout.nuisances])
        self._unsteady: FloatArray = np.where(tyres, UNSTEADY_TYRES, UNSTEADY) * self.layout.deviations
        self._update()

    def _update(self) -> None:
        precision = self.information + np.diag(1.0 / self.layout.deviations**2)
        scale = self.layout.deviations
        # In units of the tolerances, where the matrix is well conditioned.
        inverse = np.linalg.inv(precision * np.outer(scale, scale))
        self.covariance: FloatArray = np.outer(scale, scale) * 0.5 * (inverse + inverse.T)
        self.mean: FloatArray = self.covariance @ self.moment

    @classmethod
    def learn(cls, robot: str, cutoff: float, layout: Layout, rows: Rows, rate: float) -> Tuning:
        """Tune to the rows of a healthy beginning.

        Raises:
            MismatchError: a channel has too few rows that may be judged.
        """
        count = rows.valid.sum(axis=0)
        if count.min() < FEWEST_ROWS:
            name = layout.channels[int(np.argmin(count))].name
            raise MismatchError(
                f"channel {name} has {int(count.min())} rows that may be judged in the healthy beginning; needed: "
                f"{FEWEST_ROWS}. Drive on: all axes, without slipping"
            )
        size = len(layout.deviations)
        tuning = cls(
            robot, cutoff, layout, np.ones(len(layout.channels)), np.ones(len(layout.channels)),
            np.zeros((size, size)), np.zeros(size), learned=float(count.min()) / rate,
        )  # fmt: skip
        left = rows.residual
        for _ in range(ITERATIONS):
            tuning._measure_noise(left, rows)
            tuning.information[:], tuning.moment[:] = 0.0, 0.0
            tuning.include(rows)
            left = tuning.residual(rows)
        return tuning

    def _measure_noise(self, left: FloatArray, rows: Rows) -> None:
        one_piece = np.zeros(len(left), dtype=np.int64)
        for c in range(left.shape[1]):
            valid = rows.valid[:, c]
            deviation = robust_deviation(left[valid, c])
            self.noise[c] = deviation
            self.slow[c] = max(deviation, np.sqrt(slow_power(left[:, c], valid, one_piece)))

    def residual(self, rows: Rows) -> FloatArray:
        """Residual (T, C) after re-tuning."""
        left: FloatArray = rows.residual - rows.columns @ self.mean
        return left

    def deviation(self, rows: Rows) -> FloatArray:
        """Deviation (T, C) that a healthy robot's residual has in these rows."""
        unknown = np.einsum("tck,kl,tcl->tc", rows.columns, self.covariance, rows.columns, optimize=True)
        result: FloatArray = np.sqrt(self.noise**2 + unknown + self._misjudged(rows))
        return result

    def _misjudged(self, rows: Rows) -> FloatArray:
        """Variance (T, C) from which nothing can be learned: what is not steady, and what the model neglects."""
        moved = np.sqrt(np.sum(np.where(rows.valid, rows.measured, 0.0) ** 2, axis=0) / np.maximum(rows.valid.sum(axis=0), 1))
        variance: FloatArray = rows.columns**2 @ self._unsteady**2 + (self.layout.scale_deviation * moved) ** 2
        return variance

    def include(self, rows: Rows) -> None:
        """Learn from rows of a healthy robot."""
        standard = self.residual(rows) / self.deviation(rows)
        weight = np.where(rows.valid, huber_weights(standard), 0.0) / (self.slow**2 + self._misjudged(rows))
        weighted = rows.columns * weight[:, :, None]
        self.information += np.einsum("tck,tcl->kl", weighted, rows.columns, optimize=True)
        self.moment += np.einsum("tck,tc->k", weighted, rows.residual)
        self._update()

    def forget(self, share: float) -> None:
        """Let go of a share of what was learned; the tolerances stay."""
        self.information *= 1.0 - share
        self.moment *= 1.0 - share

    def release(self, numbers: BoolArray) -> None:
        """Give some numbers (K,) their tolerance back; what is known of the others stays as it is."""
        stay, gone = np.flatnonzero(~numbers), np.flatnonzero(numbers)
        scale = self.layout.deviations
        # Integrated over the numbers that go (Schur complement), in units of the tolerances.
        precision = self.information * np.outer(scale, scale) + np.eye(len(scale))
        moment = self.moment * scale
        weights = np.linalg.solve(precision[np.ix_(gone, gone)], precision[np.ix_(gone, stay)])
        left = precision[np.ix_(stay, stay)] - precision[np.ix_(stay, gone)] @ weights - np.eye(len(stay))
        self.information, self.moment = np.zeros_like(self.information), np.zeros_like(self.moment)
        self.information[np.ix_(stay, stay)] = 0.5 * (left + left.T) / np.outer(scale[stay], scale[stay])
        self.moment[stay] = (moment[stay] - moment[gone] @ weights) / scale[stay]
        self._update()

    def beyond_tolerance(self, factor: float = 3.0) -> list[str]:
        """Say which numbers had to leave their tolerance by more than a factor."""
        layout = self.layout
        return [
            f"{name} is {abs(value) / deviation:.1f} tolerances off ({value:+.3g} {unit})"
            for name, unit, value, deviation in zip(
                layout.nuisances, layout.units, self.mean, layout.deviations, strict=True
            )
            if abs(value) > factor * deviation
        ]

    # --- Files ------------------------------------------------------------------------------------------

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a calibration file (JSON).

        Raises:
            MismatchError: the path exists already, or cannot be written.
        """
        layout = self.layout
        content = {
            "format": FORMAT,
            "robot": self.robot,
            "cutoff": self.cutoff,
            "learned": self.learned,
            "scale_deviation": layout.scale_deviation,
            "channels": [
                {**dataclasses.asdict(channel), "noise": float(noise), "slow": float(slow)}
                for channel, noise, slow in zip(layout.channels, self.noise, self.slow, strict=True)
            ],
            "numbers": [
                {"name": name, "unit": unit, "nominal": nominal, "tolerance": deviation, "moment": moment}
                for name, unit, nominal, deviation, moment in zip(
                    layout.nuisances, layout.units, layout.nominal.tolist(), layout.deviations.tolist(), self.moment.tolist(),
                    strict=True,
                )
            ],
            "information": self.information.tolist(),
        }  # fmt: skip
        try:
            with Path(path).open("x", encoding="utf-8") as file:
                json.dump(content, file, indent=1)
        except FileExistsError:
            raise MismatchError(f"calibration {path} exists already and is left as it is; give another path") from None
        except OSError as error:
            raise MismatchError(f"calibration {path} cannot be written: {error.strerror}; give another path") from error

    @classmethod
    def load(cls, path: str | os.PathLike[str], robot: RobotDescription) -> Tuning:
        """Read a calibration file; what belongs to the place (the floor's inclination) is left out.

        Raises:
            MismatchError: no such file, another format or another robot.
        """
        try:
            content = json.loads(Path(path).read_text(encoding="utf-8"))
        except OSError as error:
            raise MismatchError(f"calibration {path} cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise MismatchError(f"calibration {path} is no JSON: {error}") from error
        found = content.get("format") if isinstance(content, dict) else None
        if found != FORMAT:
            raise MismatchError(f"calibration {path}: format = {found!r}; allowed: {FORMAT}")
        if content.get("robot") != digest(robot):
            raise MismatchError(
                f"calibration {path} is of another robot, or the description has changed since; learn it again"
            )
        try:
            return cls._of_content(content)
        except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
            raise MismatchError(f"calibration {path} is damaged: {error!r}; learn and save it again") from error

    @classmethod
    def _of_content(cls, content: dict[str, Any]) -> Tuning:
        channels = _entries(content["channels"])
        numbers = _entries(content["numbers"])
        column = {
            key: np.array([entry[key] for entry in numbers], dtype=float) for key in ("nominal", "tolerance", "moment")
        }
        layout = Layout(
            tuple(Channel(str(e["name"]), str(e["unit"]), tuple(e["casters"]), str(e["axis"])) for e in channels),
            tuple(str(entry["name"]) for entry in numbers),
            tuple(str(entry["unit"]) for entry in numbers),
            column["nominal"],
            column["tolerance"],
            float(content["scale_deviation"]),
        )
        noise, slow = (np.array([entry[key] for entry in channels], dtype=float) for key in ("noise", "slow"))
        information = np.array(content["information"], dtype=float)
        if information.shape != (len(numbers), len(numbers)) or not np.isfinite(information).all():
            raise ValueError(f"information has shape {information.shape}")
        tuning = cls(
            str(content["robot"]),
            float(content["cutoff"]),
            layout,
            noise,
            slow,
            information,
            column["moment"],
            float(content["learned"]),
        )
        tuning.release(np.array([name.startswith(OF_THE_PLACE) for name in layout.nuisances]))
        return tuning


def digest(robot: RobotDescription) -> str:
    """SHA-256 of all numbers of a description: what was learned holds for these only."""
    return hashlib.sha256(json.dumps(robot_to_mapping(robot), sort_keys=True).encode()).hexdigest()


def _entries(content: object) -> Sequence[dict[str, Any]]:
    if not isinstance(content, list) or not content or not all(isinstance(entry, dict) for entry in content):
        raise ValueError("a list is missing")
    return content
