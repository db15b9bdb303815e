"""Torques of all drives or steerings that are in other units than joint-side newton metres, told by the motion they make.

    found = torque_units(robot, problem)
    joint_states, joint_commands = found.put_right(robot, recording)

A robot that moves as its description says under torques 14 times as large as the reported ones, its gears being 14:1,
reports those of its motors. Effects of its description are wrong by some per cent, not by factors.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy import optimize

from pcw_description.recording import JointSeries, Recording
from pcw_description.robot_description import AXIS_NAMES, RobotDescription

from ..readings.held_commands import held_commands
from ..readings.reported_torques import unlikely_factor
from ..regression.regression_problem import FloatArray, RegressionProblem
from .robot_nuisances import CROSSTALK

TORQUE_CONSTANT = "torque_constant_error"
FRICTIONS = ("drive_coulomb_friction", "drive_viscous_friction", "steer_coulomb_friction", "steer_viscous_friction")
# Factors have to explain this part of the square of what forces leave of the description.
EXPLAINED = 0.9
WORSE = 0.5  # times what likely factors leave, root mean square, is what others may leave
# Within these bounds a factor is a weak motor, or a heavy load.
LIKELY = (0.25, 4.0)
NEAR = 0.15  # of a known factor
LOST = 0.7  # of what is left without torques at all; if they leave no less, nothing tells by what factor they act
LEAST_PART = 0.2  # of the samples that can be judged
KINDS = dict(zip(AXIS_NAMES, ("drives", "steerings"), strict=True))


@dataclasses.dataclass(frozen=True)
class TorqueUnits:
    """What reported torques are off by.

    Attributes:
        factors: by which those of drives and steerings go into the ones at the joints (2,); NaN where nobody knows it.
        warning: what is wrong, and what is made of it.
    """

    factors: FloatArray
    warning: str

    @property
    def is_known(self) -> bool:
        """Whether the torques can be put right."""
        return bool(np.all(np.isfinite(self.factors)))

    def put_right(self, robot: RobotDescription, recording: Recording) -> tuple[JointSeries, JointSeries | None]:
        """Return joint states and commands with torques at the joints; commands in the units of reports go with them."""
        joints, commands = recording.joint_states, recording.joint_commands
        assert joints.effort is not None
        held = held_commands(robot, recording)
        if commands is not None and commands.effort is not None and held is not None:
            alike = [unlikely_factor(held[:, i, k], joints.effort[:, i, k]) is None for i, k in np.ndindex(robot.n, 2)]
            factors = np.where(np.reshape(alike, (robot.n, 2)), self.factors, 1.0)
            commands = dataclasses.replace(commands, effort=commands.effort * factors)
        return dataclasses.replace(joints, effort=joints.effort * self.factors), commands


def torque_units(robot: RobotDescription, problem: RegressionProblem) -> TorqueUnits | None:
    """Return what is wrong with the units or the sign of the torques behind a problem; None where nothing is.

    Args:
        robot: as it is described.
        problem: of its recordings, with all candidates.
    """
    gains = _gains(robot, problem)
    if gains is None:
        return None
    factors, told = np.ones(2), []
    for k, axis in enumerate(AXIS_NAMES):
        gear, own = _common_gear(robot, k), f"those of the {KINDS[axis]}"
        if LIKELY[0] < gains[k] < LIKELY[1]:
            continue
        if abs(gains[k] + 1.0) < NEAR:
            factors[k] = -1.0
            told.append(f"{own} count the other way round")
        elif math.isfinite(gear) and abs(abs(gains[k] / gear) - 1.0) < NEAR:
            factors[k] = math.copysign(gear, gains[k])
            told.append(f"{own} are the motors', before their gears of {abs(gear):.3g}")
        else:
            factors[k] = math.nan
            told.append(f"{own} are {1.0 / gains[k]:.3g} times what moves the robot")
    if not told:
        return None
    known = bool(np.all(np.isfinite(factors)))
    made = "converted to torques at the joints" if known else "they have to be torques at the joints [N m]"
    return TorqueUnits(factors, f"joint_states: of the reported torques {' and '.join(told)}; {made}")


def _gains(robot: RobotDescription, problem: RegressionProblem) -> FloatArray | None:
    """Factors of all drives' and all steerings' torques that move the robot as it moves (2,); None where they say little."""
    of_all = [term for term in problem.terms if term.target == robot.caster_names and term.effect == TORQUE_CONSTANT]
    both = [term for axis in AXIS_NAMES for term in of_all if term.axis == axis]
    rubbing = [term for term in problem.terms if len(term.target) == 1 and term.effect in FRICTIONS]
    force = [c for c, channel in enumerate(problem.channels) if channel.unit in ("N", "N m")]
    if len(both) != len(AXIS_NAMES) or not force:
        return None
    # Joints that rub, one or all, need many times the torque that moves the robot, and are no joints in other units.
    parts = [term.columns(term.shapes[0])[:, :, list(term.base_indices())] for term in (*both, *rubbing)]
    columns = np.concatenate(parts, axis=2)
    # Reports are of joints, and a motor's error reaches both of these where their gears are coupled.
    numbers = {number.name: number.column for number in problem.nuisances}
    for name, coupling in zip(robot.caster_names, robot.gear_coupling, strict=True):
        crossed = coupling[0, 1] * numbers.get(f"{CROSSTALK}/{name}", 0.0)
        columns[:, :, 0] -= crossed
        columns[:, :, 1] += crossed
    rows, left = [], []
    for c in force:
        valid = problem.valid[:, c]
        if np.mean(valid) < LEAST_PART:  # torques that are far too large use more friction than there is
            valid = np.isfinite(problem.residual[:, c])
        size = float(np.std(problem.measured[valid, c])) if valid.any() else 0.0
        if size > 0.0:
            rows.append(columns[valid, c] / size)
            left.append(problem.residual[valid, c] / size)
    if not rows:
        return None
    design, wanted = np.concatenate(rows), np.concatenate(left)
    errors = np.linalg.lstsq(design, wanted, rcond=None)[0]
    remains = _left(design, wanted, errors)
    # Torques that hardly move the robot could be many times themselves: what counts is what no likely factor explains.
    likely = np.tile([[-np.inf], [np.inf]], design.shape[1])
    likely[:, : len(both)] = np.array(LIKELY)[:, None] - 1.0
    within = optimize.lsq_linear(design, wanted, likely).x
    if remains > min((1.0 - EXPLAINED) * (wanted @ wanted), WORSE**2 * _left(design, wanted, within)):
        return None
    gains: FloatArray = 1.0 + errors[: len(both)]
    for k in range(len(both)):
        # Torques that do nothing to the robot at all are lost in their joints, whatever their units.
        lost, others = wanted + design[:, k], np.delete(design, k, axis=1)
        if remains > LOST * _left(others, lost, np.linalg.lstsq(others, lost, rcond=None)[0]):
            gains[k] = 1.0
    return gains


def _left(design: FloatArray, wanted: FloatArray, sizes: FloatArray) -> float:
    """What columns of some sizes leave of what they are to explain: the sum of squares."""
    remaining = wanted - design @ sizes
    return float(remaining @ remaining)


def _common_gear(robot: RobotDescription, axis: int) -> float:
    """Gear ratio of an axis that all casters have, and which no coupling goes through; NaN where there is none."""
    gears = robot.gear_matrix
    ratios = gears[:, axis, axis]
    coupled = np.any(gears[:, 0, 1]) or np.any(gears[:, 1, 0])
    return float(ratios[0]) if not coupled and np.all(ratios == ratios[0]) else math.nan
