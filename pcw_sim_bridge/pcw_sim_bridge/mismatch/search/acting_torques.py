"""Torques that act on a bench axis, of those in its channel, which are as large as its motor reports them.

Beside an error e of the torque constant (1 + e) F = inertia a + gravity + friction: in the reported force F there is
1 / (1 + e) of a friction. The error itself is in proportion to what is reported.
"""

from __future__ import annotations

from collections.abc import Sequence

from pcw_description.axis_recording import TARGET

from ..regression.regression_problem import FloatArray, RegressionProblem, Term
from ..regression.whitened_regression import Instance

TORQUE_CONSTANT, PLACES = "torque_constant_error", {(TARGET,), ("axis_force",)}


def is_reported(term: Term) -> bool:
    """Whether a term is a torque at an axis that stands in its channel as large as the motor would report it."""
    return term.target in PLACES and term.effect != TORQUE_CONSTANT


def place_of_error(problem: RegressionProblem, instances: Sequence[Instance]) -> int | None:
    """Position of the error of an axis's torque constant in the mean of a fit; None where it is not among what is fitted."""
    position = len(problem.nuisances)
    for instance in instances:
        term = problem.terms[instance.term]
        if term.effect == TORQUE_CONSTANT and term.target in PLACES and instance.active:
            return position
        position += len(instance.active)
    return None


def acting_part(problem: RegressionProblem, instances: Sequence[Instance], mean: FloatArray) -> float:
    """So many times what the channel of an axis holds of a torque acts, by the mean (k,) of a fit of instances."""
    place = place_of_error(problem, instances)
    return 1.0 if place is None else 1.0 + float(mean[place])
