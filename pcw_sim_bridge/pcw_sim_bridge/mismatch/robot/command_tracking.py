"""What happens between a torque command and the motor's torque: one small problem per joint, `command_tracking/<joint>`.

The command that a joint held at each sample goes through the joint's limit and, for a candidate, through the effect's own
kernel, step by step as in a simulator; what the drive reports should be that. Commands are as ragged as the noise in
their feedback, and tell a dead time from a lag up to half the sampling rate, where the motion itself says nothing.

A candidate's column is what it changes in the torque at given numbers; its coefficient is a presence that has to be one.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from pcw_description.compiled import ARRAY_SIGNATURE, compiled_for_kernel
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.kinds import ACTUATOR_INPUTS, MEMORY, MOTOR_RATE, STEP, TORQUE, ActuatorEffect
from pcw_description.effects.registry import all_effects, get
from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, RobotDescription

from ..readings.held_commands import LARGEST_GAP, held_commands
from ..readings.reported_torques import doubtful_reports
from ..regression.regression_problem import (
    BoolArray,
    Channel,
    FloatArray,
    IntArray,
    LinearParameter,
    Nuisance,
    RegressionProblem,
    Shape,
    Term,
)

LARGEST_STEP = 1e-3  # [s] of the kernels
SHORTEST = 1.0  # [s]
# So many samples after one whose command was lost are not judged either: a drive that lags has not forgotten it yet.
REMEMBERED = 2
# Nobody knows how long a command was on its way within its own cycle: this part of a cycle either way.
LATENCY_PART = 0.1
PRESENCE = LinearParameter("presence", "1", 0.6, 1.6, 0.5, hidden=True)
NEARER = 0.5  # in squares
TIME_SPACING = 1.3
TIMES = tuple(1e-3 * TIME_SPACING**k for k in range(18))  # [s], of lags and dead times
# A dead time shows once it reaches into the last step of a cycle, or of one before, and as far as that step only in proportion
# to how far: by these parts of a step, in the first cycles, and in those that are about as long ago as what does best.
REACHES = (0.03, 0.08, 0.2, 0.5)
FIRST_CYCLES = 3
WORTH_A_LOOK = 0.9  # of the squares that a time leaves; above it, no others near it are tried
CYCLES = 2  # so many different lengths of cycles are looked at: 3 and 4 ms at 300 Hz among steps of 1 ms
# Torques at which a drive may give no more, by how much of the time more was asked of it.
LARGEST_QUANTILES = (0.8, 0.95, 0.99, 0.999)
QUANTILES = (0.3, 0.5, 0.65, 0.8, 0.88, 0.94, 0.97, 0.985)
KNEES = (0.2, 0.4, 0.6, 0.8)  # parts of the largest speed from which the voltage limits


@dataclasses.dataclass(frozen=True)
class CommandedJoint:
    """One joint of one contiguous piece, at the rate of joint_states; arrays (T,).

    Attributes:
        time: [s]; interval: between samples [s].
        command: held at each sample, within the joint's limit; torque: reported [N m]; rate: of the joint [rad/s].
        known: whether the command, and those just before it, were recorded; else the last one that was stands there.
    """

    recording: int
    interval: float
    time: FloatArray
    command: FloatArray
    torque: FloatArray
    rate: FloatArray
    known: BoolArray

    @functools.cached_property
    def steps(self) -> tuple[float, IntArray]:
        """Step [s] of the kernels, and how many of them a command was held before each sample (T,).

        At a rate that is no whole part of the controller's these are not the same everywhere: intervals of 3, 3 and 4 ms.
        """
        step = self.interval / max(1, int(np.ceil(self.interval / LARGEST_STEP - 1e-6)))
        intervals = np.diff(self.time, prepend=self.time[0] - self.interval)
        return step, np.maximum(np.rint(intervals / step), 1).astype(np.int64)


@compiled_for_kernel(ARRAY_SIGNATURE, "float64[::1]", "float64[::1], int64, float64[::1], float64[::1], float64, int64[::1]")
def _torque_along(kernel, values, memory, command, rate, step, steps):  # type: ignore[no-untyped-def]
    """Torque (T,) of an actuator at the end of each interval, of so many steps (T,), in which it held a command (T,)."""
    found = command.copy()
    at = np.zeros(ACTUATOR_INPUTS)
    state = np.zeros(memory)
    at[STEP] = step
    for t in range(len(command)):
        at[MOTOR_RATE] = rate[t]
        for _ in range(steps[t]):
            state[TORQUE] = command[t]
            kernel(at, values, state)
        found[t] = state[TORQUE]
    return found


def through(effect: ActuatorEffect, values: Mapping[str, float], joint: CommandedJoint, command: FloatArray) -> FloatArray:
    """Return the torque (T,) [N m] that an actuator with the effect makes of a command (T,)."""
    step, steps = joint.steps
    torque: FloatArray = _torque_along(
        effect.drive, effect.values(values), MEMORY + effect.memory(values, step), command, joint.rate, step, steps
    )
    return torque


def commanded_joints(
    robot: RobotDescription, recordings: Sequence[Recording]
) -> dict[tuple[int, int], list[CommandedJoint]]:
    """Return the pieces of every joint (caster, axis) that has torque commands and reported torques in all recordings.

    Without those with which something is wrong, see `doubtful_reports`.
    """
    found: dict[tuple[int, int], list[CommandedJoint]] = {}
    for index, recording in enumerate(recordings):
        commands, joints = held_commands(robot, recording), recording.joint_states
        if commands is None or joints.effort is None:
            return {}
        doubtful = doubtful_reports(robot, recording)
        for i in range(robot.n):
            for axis in range(2):
                if (i, axis) in doubtful:
                    continue
                command = commands[:, i, axis]
                lasting, known = _lasting(joints.stamp, command)
                usable = np.isfinite(lasting) & np.isfinite(joints.effort[:, i, axis])
                for piece in _pieces(joints.stamp, np.asarray(usable)):
                    if not known[piece].any():
                        continue
                    own = np.nan_to_num(joints.velocity[piece, i, axis])
                    found.setdefault((i, axis), []).append(
                        CommandedJoint(
                            index, float(np.median(np.diff(joints.stamp[piece]))), joints.stamp[piece],
                            np.ascontiguousarray(lasting[piece]), joints.effort[piece, i, axis], np.ascontiguousarray(own),
                            known[piece],
                        )
                    )
    return found


def _lasting(stamp: FloatArray, command: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return a command (T,) that lasts where the next was lost, NaN over a longer gap, and where it is known (T,)."""
    told = np.isfinite(command)
    last = np.maximum.accumulate(np.where(told, np.arange(len(command)), -1))
    fresh = (last >= 0) & (stamp - stamp[np.maximum(last, 0)] < LARGEST_GAP)
    known = told.copy()
    for back in range(1, REMEMBERED + 1):
        known[back:] &= told[:-back]
    return np.where(fresh, command[np.maximum(last, 0)], np.nan), known


def _pieces(stamp: FloatArray, usable: BoolArray) -> list[slice]:
    """Runs of usable samples without a gap that last long enough."""
    broken = np.r_[False, np.diff(stamp) > LARGEST_GAP]
    index = np.cumsum(broken | np.r_[False, usable[1:] != usable[:-1]])
    found = []
    for label in np.unique(index[usable]):
        rows = np.flatnonzero((index == label) & usable)
        if stamp[rows[-1]] - stamp[rows[0]] >= SHORTEST:
            found.append(slice(int(rows[0]), int(rows[-1]) + 1))
    return found


def command_problems(
    robot: RobotDescription, recordings: Sequence[Recording], searched: bool = True
) -> list[RegressionProblem]:
    """Return one problem per joint with commands, in the order of the joints.

    Of a drive that is described as late or limited, and reports its commands all the same, reports say nothing.

    Args:
        robot: the nominal robot; recordings: opened with it.
        searched: False: the candidates get no numbers to try.
    """
    return [joint.problem(searched) for joint in _joints(robot, recordings) if not joint.reports_commands]


def joints_that_report_commands(robot: RobotDescription, recordings: Sequence[Recording]) -> list[str]:
    """Return the joints whose drives are described as late or limited, and report their commands all the same."""
    return [f"{joint.caster}_{joint.axis}" for joint in _joints(robot, recordings) if joint.reports_commands]


def _joints(robot: RobotDescription, recordings: Sequence[Recording]) -> list[_JointProblem]:
    pieces = commanded_joints(robot, recordings)
    return [_JointProblem(robot, i, axis, own) for (i, axis), own in sorted(pieces.items())]


class _JointProblem:
    """The problem of one joint."""

    def __init__(self, robot: RobotDescription, i: int, axis: int, pieces: Sequence[CommandedJoint]) -> None:
        self.robot, self.pieces = robot, pieces
        self.caster, self.axis = robot.caster_names[i], AXIS_NAMES[axis]
        known = [
            instance for instance in robot.physics
            if isinstance(get(instance.name), ActuatorEffect) and self.caster in instance.target
            and (instance.axis or get(instance.name).axis) == self.axis
        ]
        self._known = sorted(known, key=lambda instance: get(instance.name).stage)  # type: ignore[attr-defined]
        self._plain = self._torques(())
        self._measured = np.concatenate([piece.torque for piece in pieces])
        self._told = np.concatenate([piece.known for piece in pieces])

    @property
    def reports_commands(self) -> bool:
        """Whether the reports are nearer to the commands than to what the described effects make of them."""
        asked = np.concatenate([piece.command for piece in self.pieces])
        left = [self._sum_of_squares(self._measured - torque) for torque in (asked, self._plain)]
        return left[0] < NEARER * left[1]

    def _torques(self, more: Sequence[EffectInstance]) -> FloatArray:
        """Torque of all pieces on end (T,) with the robot's own effects and more of them, each in its stage."""
        chain = sorted((*self._known, *more), key=lambda instance: get(instance.name).stage)  # type: ignore[attr-defined]
        found = []
        for piece in self.pieces:
            torque = piece.command
            for instance in chain:
                effect = get(instance.name)
                assert isinstance(effect, ActuatorEffect)
                torque = through(effect, instance.parameters, piece, torque)
            found.append(torque)
        return np.concatenate(found)

    def problem(self, searched: bool) -> RegressionProblem:
        """Return the regression problem, see `command_problems`."""
        lengths = [len(piece.time) for piece in self.pieces]
        return RegressionProblem(
            channels=(Channel(f"command_tracking/{self.caster}_{self.axis}", "N m", (self.caster,), self.axis),),
            time=np.concatenate([piece.time for piece in self.pieces]),
            segment=np.repeat(np.arange(len(self.pieces)), lengths),
            recording=np.repeat([piece.recording for piece in self.pieces], lengths),
            rate=1.0 / self.pieces[0].interval,
            measured=self._measured[:, None],
            residual=(self._measured - self._plain)[:, None],
            valid=self._told[:, None],
            nuisances=tuple(self._nuisances()),
            terms=tuple(self._terms(searched)),
            variables=self._variables(),
        )

    def _nuisances(self) -> list[Nuisance]:
        interval = self.pieces[0].interval
        # The mean of a little later and a little earlier, which past samples alone can give to first order.
        earlier = np.concatenate([np.r_[piece.command[:1], piece.command[:-1]] for piece in self.pieces])
        latency = (earlier - self._plain) / interval
        found = [Nuisance("command_latency", "s", 0.0, LATENCY_PART * interval, latency[:, None])]
        gain = self.robot.tolerance("torque_constant").value
        if gain > 0.0:
            found.append(Nuisance("reported_torque", "1", 1.0, gain, self._plain[:, None]))
        return found

    def _column(self, effect: ActuatorEffect, shape: Shape) -> FloatArray:
        instance = EffectInstance(effect.name, (self.caster,), dict(shape), self.axis)
        return (self._torques([instance]) - self._plain)[:, None, None]

    def _terms(self, searched: bool) -> list[Term]:
        found = []
        for effect in all_effects().values():
            if not isinstance(effect, ActuatorEffect) or self.axis not in (effect.axes or (effect.axis,)):
                continue
            shapes, resolution, among = self._grid(effect) if searched else ((), {}, 0)
            if shapes or not searched:
                found.append(
                    Term(
                        effect=effect.name, target=(self.caster,), parameters=(PRESENCE,), shapes=shapes,
                        columns=functools.partial(self._column, effect), resolution=resolution, log_prior=effect.log_prior,
                        axis=self.axis if effect.axes else None, arguments=("command", "velocity"), grid_size=among,
                    )
                )
        return found

    def _grid(self, effect: ActuatorEffect) -> tuple[tuple[dict[str, float], ...], dict[str, tuple[str, float]], int]:
        """Numbers to try: times on a logarithmic scale, torques that were asked for, and speeds that were reached.

        Returns:
            The numbers, what of them is searched between, and how many they were chosen from.
        """
        defaults = {p.name: p.default for p in effect.parameters if p.default is not None}
        needed = [p for p in effect.parameters if p.default is None]
        if len(needed) != 1:
            return (), {}, 0
        [first] = needed
        if first.unit == "s":
            left = [self._left({first.name: t, **defaults}, effect) for t in TIMES]
            best = TIMES[int(np.argmin(left))]
            times, among = {*TIMES, *self._reaching(0.0, 0.0)}, 0
            near = {*self._reaching(best / TIME_SPACING, best * TIME_SPACING)}
            if not near <= times and min(left) < WORTH_A_LOOK * self._sum_of_squares(self._measured - self._plain):
                times, among = times | near, len({*TIMES, *self._reaching(0.0, TIMES[-1])})
            return tuple({**defaults, first.name: float(t)} for t in sorted(times)), {first.name: ("log", TIME_SPACING)}, among
        if first.unit != "N m":
            return (), {}, 0
        command, measured = np.abs(self._plain), np.abs(self._measured)
        # A limit is a torque that was asked for, or the largest that came.
        torques = np.unique([*np.quantile(command, QUANTILES), *np.quantile(measured, LARGEST_QUANTILES)])
        limits = [{**defaults, first.name: float(t)} for t in torques if t > 0.0]
        resolution = {first.name: ("log", 1.3)}
        if {"knee_speed", "no_load_speed"} <= set(defaults):
            top = float(np.max(np.abs(np.concatenate([piece.rate for piece in self.pieces]))))
            largest = 1.05 * float(command.max())
            limits += [
                {**defaults, first.name: largest, "knee_speed": part * top, "no_load_speed": (part + gap) * top}
                for part in KNEES for gap in (0.3, 0.8, 2.0) if top > 0.0
            ]
        return tuple(limits), resolution, 0

    def _left(self, shape: Shape, effect: ActuatorEffect) -> float:
        """Sum of squares that an effect leaves of the reported torque."""
        return self._sum_of_squares(self._measured - self._plain - self._column(effect, shape)[:, 0, 0])

    def _sum_of_squares(self, values: FloatArray) -> float:
        """Of a signal (T,), where the command is known."""
        return float(np.sum(values[self._told] ** 2))

    def _reaching(self, shortest: float, longest: float) -> list[float]:
        """Times [s] that reach a little into the last step of one of the commonest cycles, or of several one after another.

        Of the first cycles, and of all that are from `shortest` to `longest` [s] ago.
        """
        step, steps = max(self.pieces, key=lambda piece: len(piece.time)).steps
        lengths, counts = np.unique(steps, return_counts=True)
        whole: set[int] = set()
        for length in lengths[np.argsort(-counts, kind="stable")[:CYCLES]].tolist():
            near = range(math.ceil(shortest / (step * length)), math.ceil(longest / (step * length)) + 1)
            whole |= {length * back for back in {*range(1, FIRST_CYCLES + 1), *near} if back > 0}
        return [float(step * (steps_back - 1 + part)) for steps_back in sorted(whole) for part in REACHES]

    def _variables(self) -> dict[str, FloatArray]:
        return {
            "time": np.concatenate([piece.time for piece in self.pieces]),
            "command": np.concatenate([piece.command for piece in self.pieces]),
            "velocity": np.concatenate([piece.rate for piece in self.pieces]),
        }
