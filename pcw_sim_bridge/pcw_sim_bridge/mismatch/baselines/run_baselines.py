"""Runs every baseline on the same recordings."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from pcw_description.axis_recording import AxisDescription
from pcw_description.errors import PcwError
from pcw_description.robot_description import RobotDescription

from ..regression.regression_problem import RegressionProblem
from ..subjects.axis_subject import AxisSubject
from ..subjects.robot_subject import RobotSubject
from ..subjects.subject import Subject
from .baseline_result import BaselineResult, Explained, gap_closed, inverse_error
from .comparison_packages import require_packages
from .gradient_boosting import boosted
from .identified_axis import identified_axis
from .identified_robot import identified_robot
from .sparse_regression import THRESHOLDS, by_effects, by_variables

Method = Callable[[], Explained]


def run_baselines(
    description: RobotDescription | AxisDescription,
    recordings: Sequence[Path],
    holdouts: Sequence[Path],
    floor: Mapping[str, float] | None = None,
    seed: int = 0,
    identification_seconds: float = 120.0,
    topics: Mapping[str, str] | None = None,
    progress: Callable[[str], None] = lambda message: None,
) -> list[BaselineResult]:
    """Run PySINDy (two libraries, two thresholds), gradient boosting and `mujoco.sysid`.

    Args:
        description: the nominal robot or bench axis.
        recordings: to learn from.
        holdouts: to judge by, never looked at before; at least one.
        floor: rms of the noise by channel name, as `noise_floor` of a report's channels, for `gap_closed`.
        seed: of everything random.
        identification_seconds: time that `mujoco.sysid` may take; 0 leaves it out.
        topics: contract topic -> topic in the recordings.
        progress: is told which method runs.

    Raises:
        MismatchError: a package of the comparison is not installed; says what installs it.
        PcwError: a recording cannot be read.
        ValueError: no held-out recording.
    """
    if not holdouts:
        raise ValueError("holdouts is empty; allowed: at least one recording that the baselines do not learn from")
    require_packages()
    subject: Subject = RobotSubject(description) if isinstance(description, RobotDescription) else AxisSubject(description)
    casters = description.caster_names if isinstance(description, RobotDescription) else ()
    opened = [subject.open(path, "fit", topics or {}) for path in recordings]
    held_out = [subject.open(path, "holdout", topics or {}) for path in holdouts]
    fitted, proof = subject.problem(opened), subject.problem(held_out)
    methods: dict[str, Method] = {}
    for threshold in THRESHOLDS:
        methods[f"PySINDy {threshold:g}, variables"] = _bound(by_variables, fitted, proof, casters, threshold, seed)
        methods[f"PySINDy {threshold:g}, effect columns"] = _bound(by_effects, fitted, proof, casters, threshold, seed)
    methods["gradient boosting"] = lambda: boosted(fitted, proof, seed)
    if identification_seconds > 0.0:
        pieces, others = [item.recording for item in opened], [item.recording for item in held_out]
        if isinstance(description, RobotDescription):
            methods["mujoco.sysid"] = lambda: identified_robot(description, pieces, others, proof, identification_seconds)
        else:
            methods["mujoco.sysid"] = lambda: identified_axis(description, pieces, others, proof)
    results = []
    for name, method in methods.items():
        progress(name)
        results.append(_judged(name, method, proof, floor))
    return results


def _bound(
    method: Callable[..., Explained],
    fitted: RegressionProblem,
    proof: RegressionProblem,
    casters: Sequence[str],
    threshold: float,
    seed: int,
) -> Method:
    return lambda: method(fitted, proof, casters, threshold, seed)


def _judged(name: str, method: Method, proof: RegressionProblem, floor: Mapping[str, float] | None) -> BaselineResult:
    begun = time.monotonic()
    try:
        explained = method()
    except PcwError as error:
        return BaselineResult(name, (), None, None, time.monotonic() - begun, str(error))
    seconds = time.monotonic() - begun
    errors = inverse_error(proof, proof.residual), inverse_error(proof, proof.residual - explained.predicted)
    return BaselineResult(name, explained.names, errors, gap_closed(proof, errors, floor), seconds, explained.remark)
