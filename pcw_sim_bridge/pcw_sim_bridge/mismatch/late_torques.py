"""Dead times and lags of drives whose reported torques are the commands themselves.

Many drives report what they were asked for. Between command and report nothing happens then, and what a drive makes of a
command shows in the motion alone: the torques that move the robot come later than they are reported (`torque_lag`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from pcw_description.robot_description import AXIS_NAMES

from .command_findings import CommandFindings, with_instance
from .explanation import HALF_WIDTH, Estimate, Explanation, NamedTerm
from .findings import LocationFinding
from .regression_problem import RegressionProblem
from .whitened_regression import Instance

TORQUE_LAG, DEAD_TIME, LAG = "torque_lag", "actuator_delay", "actuator_lag"
# Reports that depart from the commands by less than this part of them are the commands, with noise.
ECHOED = 0.3
# Cycles by which torques may be late of themselves: a command is made within one and held for another.
USUAL_CYCLES = 2.0
# A dead time and a lag are told apart by what they do to fast torques, of which filtered motions show nothing.
EVEN = 0.5


def with_late_torques(
    commands: CommandFindings, problems: Sequence[RegressionProblem], explanation: Explanation
) -> CommandFindings:
    """Name what makes all torques late if the reported ones are the commands.

    Args:
        commands: what is found between commands and reports.
        problems: one per joint with commands and reports.
        explanation: of the robot's motion.
    """
    late = _lateness(explanation)
    if late is None or not _are_echoed(problems, explanation.search.problem) or _named(commands) & {DEAD_TIME, LAG}:
        return commands
    cycle = max(1.0 / problem.rate for problem in problems)
    delay, deviation = late
    if delay - HALF_WIDTH * deviation < USUAL_CYCLES * cycle:
        return commands
    # A report may be of the command that was held until then, or of the one that is held from then on.
    half = math.hypot(HALF_WIDTH * deviation, cycle)
    estimate = Estimate(delay, "s", delay - half, delay + half)
    findings = [_of_axis(axis, problems, explanation, estimate) for axis in AXIS_NAMES]
    note = (
        f"The torques that joint_states report are the commands, and act {1e3 * delay:.2g} ms later: a dead time or a lag of "
        "the drives. Recordings of the torques that the motors give (their currents) would tell which, joint by joint."
    )
    return dataclasses.replace(
        commands,
        named=(*commands.named, *(with_instance(named) for named, _ in findings)),
        locations=(*commands.locations, *(place for _, place in findings)),
        notes=(*commands.notes, note),
        numbers=(*commands.numbers, TORQUE_LAG),
    )


def _lateness(explanation: Explanation) -> tuple[float, float] | None:
    """How much later than reported the torques acted, and its standard deviation [s]; None where no torques are judged."""
    numbers = [number.name for number in explanation.search.problem.nuisances]
    if TORQUE_LAG not in numbers:
        return None
    index, fit = numbers.index(TORQUE_LAG), explanation.fit
    return -float(fit.mean[index]), math.sqrt(float(fit.covariance[index, index]) * max(fit.scale, 1.0))


def _are_echoed(problems: Sequence[RegressionProblem], motion: RegressionProblem) -> bool:
    """Whether all joints report their commands."""
    casters = {caster for channel in motion.channels for caster in channel.casters}
    reporting = {(p.channels[0].casters[0], p.channels[0].axis) for p in problems}
    sizes = [[float(np.sqrt(np.mean(values**2))) for values in (p.residual, p.measured)] for p in problems]
    return (
        bool(problems) and reporting >= {(caster, axis) for caster in casters for axis in AXIS_NAMES}
        and all(departure < ECHOED * size for departure, size in sizes)
    )  # fmt: skip


def _named(commands: CommandFindings) -> set[str]:
    """The effects that the commands and reports show."""
    return {named.term.effect for named, _ in commands.named}


def _of_axis(
    axis: str, problems: Sequence[RegressionProblem], explanation: Explanation, estimate: Estimate
) -> tuple[NamedTerm, LocationFinding]:
    """The dead time of all joints of an axis, and where it shows."""
    own = [problem for problem in problems if problem.channels[0].axis == axis]
    casters = tuple(problem.channels[0].casters[0] for problem in own)
    index = [term.effect for term in own[0].terms].index(DEAD_TIME)
    term = dataclasses.replace(own[0].terms[index], target=casters)
    named = NamedTerm(
        Instance(index, (("delay", estimate.value),), ()), term, {"delay": estimate}, EVEN, (LAG,), loss=0.0, held_out=0.0,
        contribution=np.zeros_like(own[0].residual),
    )  # fmt: skip
    motion = explanation.search.problem
    balance = tuple(channel.name for channel in motion.channels if channel.name.startswith("chassis_"))
    first = motion.time[motion.recording == motion.recording[0]]
    return named, LocationFinding(balance, casters, axis, ((float(first.min()), float(first.max())),), {})
