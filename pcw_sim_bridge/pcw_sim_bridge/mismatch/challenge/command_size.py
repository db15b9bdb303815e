"""How large an effect between commands and torques of motors is: in the channels that hold one against the other.

    size = max over joints of rms(residual - residual by a description that holds it) / noise of the reports

in one run, as of any other effect; `evidence` is what its re-tuned residuals cost more than by that description [nats]. Where
speeds are commanded there is no such channel, and nothing recorded shows it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.kinds import ActuatorEffect
from pcw_description.effects.registry import all_effects
from pcw_description.robot_description import RobotDescription

from ..regression.regression_problem import FloatArray, RegressionProblem
from ..robot.command_tracking import command_problems
from .simulated_case import SimulatedRecording

LEAST_NOISE = 1e-9  # [N m]


@dataclasses.dataclass(frozen=True)
class CommandSize:
    """Size in noise floors, the channel where it is largest, and evidence [nats]."""

    size: float = 0.0
    channel: str = ""
    evidence: float = 0.0


def shows_in_commands(effects: Sequence[EffectInstance]) -> bool:
    """Whether effects, of which there are some, are all between commands and torques."""
    return bool(effects) and all(isinstance(all_effects().get(instance.name), ActuatorEffect) for instance in effects)


def command_size(
    nominal: RobotDescription,
    healthy: Sequence[SimulatedRecording],
    quiet: Sequence[SimulatedRecording],
    effects: Sequence[EffectInstance],
) -> CommandSize:
    """Return how large effects are in runs.

    Args:
        nominal: the description; healthy: runs without effects, which tell the noise; quiet: runs with them, without noise.
    """
    holding = dataclasses.replace(nominal, physics=(*nominal.physics, *effects))
    noise = {p.channels[0].name: max(_rms(_retuned(p, 1.0)), LEAST_NOISE) for p in _problems(nominal, healthy)}
    described = {p.channels[0].name: p for p in _problems(holding, quiet)}
    found, evidence = CommandSize(), 0.0
    for problem in _problems(nominal, quiet):
        name = problem.channels[0].name
        if name not in noise or name not in described:
            continue
        size = _rms(problem.residual - described[name].residual) / noise[name]
        evidence += _cost(problem, noise[name]) - _cost(described[name], noise[name])
        if size > found.size:
            found = CommandSize(size, name)
    return dataclasses.replace(found, evidence=max(evidence, 0.0))


def _problems(robot: RobotDescription, recordings: Sequence[SimulatedRecording]) -> list[RegressionProblem]:
    return command_problems(robot, list(recordings), searched=False)  # type: ignore[arg-type]


def _solution(problem: RegressionProblem, noise: float) -> FloatArray:
    """The re-tuning (K,) of least cost under white noise."""
    columns, deviations = problem.nuisance_columns()[:, 0] / noise, problem.nuisance_deviations()
    gram = columns.T @ columns + np.diag(deviations**-2.0)
    return np.asarray(np.linalg.solve(gram, columns.T @ problem.residual[:, 0] / noise), dtype=np.float64)


def _retuned(problem: RegressionProblem, noise: float) -> FloatArray:
    """What re-tuning leaves (T, 1)."""
    return problem.residual - problem.nuisance_columns() @ _solution(problem, noise)


def _cost(problem: RegressionProblem, noise: float) -> float:
    """Least cost [nats] of residuals under white noise [N m]."""
    moved = _solution(problem, noise)
    left = (problem.residual - problem.nuisance_columns() @ moved) / noise
    return float(0.5 * np.sum(left**2) + 0.5 * np.sum((moved / problem.nuisance_deviations()) ** 2))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
