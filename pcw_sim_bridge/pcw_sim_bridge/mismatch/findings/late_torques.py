"""Whether torques come late or their reports do: what the robot's motion says of commands and reported torques.

Many drives report what they were asked for. Between command and report nothing happens then, and what a drive makes of a
command shows in the motion alone: the torques that move the robot come later than they are reported (`torque_lag`).

Others filter what they report. Between command and report there is a lag then, and the robot moves as if there were none:
the torques that move it come before they are reported.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from pcw_description.robot_description import AXIS_NAMES

from ..regression.regression_problem import RegressionProblem
from ..regression.whitened_regression import Instance
from .command_findings import CommandFindings, with_instance
from .explanation import HALF_WIDTH, Estimate, Explanation, NamedTerm
from .findings import LocationFinding

TORQUE_LAG, DEAD_TIME, LAG = "torque_lag", "actuator_delay", "actuator_lag"
# Reports that depart from the commands by less than this part of them are the commands, with noise.
ECHOED = 0.3
# Cycles by which torques may be late of themselves: a command is made within one and held for another.
USUAL_CYCLES = 2.0
# By so much of a cycle torques act before they are reported of themselves, at most: they are held for one.
HELD_CYCLES = 0.75
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


def without_late_reports(
    commands: CommandFindings, problems: Sequence[RegressionProblem], explanation: Explanation
) -> CommandFindings:
    """Take back what makes all drives late where the robot moves as if they were not: their reports are late.

    Between a report that is as late as it seems and one that is not the nearer one is believed.

    Args:
        commands: what is found between commands and reports.
        problems: one per joint with commands and reports.
        explanation: of the robot's motion.
    """
    late, delays = _lateness(explanation), _delays(commands)
    casters = {caster for channel in explanation.search.problem.channels for caster in channel.casters}
    if late is None or not problems or set(delays) != {(caster, axis) for caster in casters for axis in AXIS_NAMES}:
        return commands
    cycle = max(1.0 / problem.rate for problem in problems)
    ahead, deviation = -late[0], late[1]
    usual, delay = HELD_CYCLES * cycle, float(np.mean(list(delays.values())))
    if delay <= usual or ahead - HALF_WIDTH * deviation < 0.5 * (usual + delay):
        return commands
    kept = [k for k, (named, _) in enumerate(commands.named) if named.term.effect not in (DEAD_TIME, LAG)]
    proofs = commands.proofs
    if not kept:
        proofs = tuple(dataclasses.replace(p, after=p.before, after_ci95=p.before_ci95) for p in proofs)
    note = (
        f"Reported torques follow the commands {1e3 * delay:.2g} ms late in every joint, and the robot moves by torques "
        f"{1e3 * ahead:.2g} ms before they are reported: it is the reports that are late, as by a filter, and not the drives. "
        "Record torques unfiltered to see what drives make of their commands."
    )
    return dataclasses.replace(
        commands,
        named=tuple(commands.named[k] for k in kept),
        locations=tuple(commands.locations[k] for k in kept),
        proofs=proofs,
        notes=(*commands.notes, note),
        numbers=(*commands.numbers, TORQUE_LAG),
    )


def _delays(commands: CommandFindings) -> dict[tuple[str, str], float]:
    """How late reports follow commands by what is named [s], by joint (caster, axis)."""
    found: dict[tuple[str, str], float] = {}
    for (named, _), place in zip(commands.named, commands.locations, strict=True):
        if named.term.effect in (DEAD_TIME, LAG):
            [delay] = [named.estimates[name].value for name in ("delay", "time_constant") if name in named.estimates]
            for caster in place.casters:
                found[caster, place.axis] = found.get((caster, place.axis), 0.0) + delay
    return found


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
    sizes = [[float(np.sqrt(np.mean(values[p.valid] ** 2))) for values in (p.residual, p.measured)] for p in problems]
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
