"""The geometry that wheels seem to have, where by that of the description they would slide most of the time.

A steering whose zero is off by 0.2 rad, or a wheel another radius by a tenth, makes wheels contradict each other by more than
any rolling tyre slips, whenever they turn fast: those samples would be taken for slides and not be judged, and they are the
ones that tell. Numbers of the description by which the contradictions vanish most of the time are no slides. What is wrong,
and by how much, the search finds; here it is asked which samples it may look at.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy import optimize

from ..regression.regression_problem import BoolArray, FloatArray
from .robot_motion import RobotMotion
from .robot_nuisances import VariedNumber
from .rolling_model import ModelNumbers, twists

# Kinds of numbers, and how many tolerances these may be off by; a robot that is farther from its description is another one.
GEOMETRY = {"wheel_radius/": 120.0, "caster_offset.": 120.0, "steer_zero/": 300.0}
MOST_ROWS = 3000  # of motions, enough for a few numbers of every caster
LEAST_PART = 0.05  # of the samples that have to be no slides any more


def seeming_numbers(
    numbers: ModelNumbers,
    varied: Sequence[VariedNumber],
    motions: Sequence[RobotMotion],
    sliding: Callable[[ModelNumbers, RobotMotion], BoolArray],
    slip: float,
) -> ModelNumbers:
    """Return the numbers by which wheels agree; those of the description where that makes few slides of theirs undone.

    Args:
        numbers: of the description; varied: what may be off in it.
        motions: true motions.
        sliding: in which samples (T,) of a motion wheels slide, by some numbers.
        slip: speed [m/s] at the contact up to which wheels agree.
    """

    def part(trial: ModelNumbers) -> float:
        return float(np.mean(np.concatenate([sliding(trial, motion) for motion in motions])))

    before = part(numbers)
    geometry = [(number, far) for number in varied for kind, far in GEOMETRY.items() if number.label.startswith(kind)]
    if before < LEAST_PART:
        return numbers
    step = max(1, sum(len(motion.time) for motion in motions) // MOST_ROWS)
    position, velocity = (
        np.concatenate([np.ascontiguousarray(values[::step]) for values in some])
        for some in ([m.position for m in motions], [m.velocity for m in motions])
    )

    def changed(changes: FloatArray) -> ModelNumbers:
        trial = numbers.copy()
        for (number, far), change in zip(geometry, changes, strict=True):
            number.vary(trial, far * number.deviation * float(change))
        return trial

    def rolled(trial: ModelNumbers) -> tuple[FloatArray, float]:
        twist, contradiction = twists(trial, trial.headings(position), velocity)
        return contradiction, float(np.sqrt(np.mean(twist**2)))

    _, usual = rolled(numbers)

    def errors(changes: FloatArray) -> FloatArray:
        # Smaller wheels altogether would contradict each other less.
        contradiction, motion = rolled(changed(changes))
        return np.concatenate([contradiction.ravel() * (usual / motion / slip), changes])

    found = optimize.least_squares(
        errors, np.zeros(len(geometry)), bounds=(-1.0, 1.0), loss="soft_l1", x_scale=0.1, max_nfev=20
    )
    seeming = changed(found.x)
    return seeming if before - part(seeming) > LEAST_PART else numbers
