"""A steering whose zero is so far off that the wheels work against each other, told by what their forces do to the robot.

Drives that hold the speeds of an inverse kinematics force such a wheel across its way. Friction is used up, slips may be
anything, and no channel can be judged. But whatever a wheel slips, its force is what its torques make of it, in the direction
in which it points. With the right direction the forces of all wheels add up to what the robot's motion takes, and with the
described one they do not, by far. How the robot moves says a tracker, or else the other wheels.

A joint that rubs does likewise where its torque never reaches the ground, or that of the others drags it along. If forces are
balanced as well without what joints of the caster may lose so, they are left to the search, unless wheels roll with the turn:
those of a friction do without it. A joint that holds a speed loses no more than its torque.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
from scipy import optimize, stats

from ..all_cores import on_all_cores
from ..regression.noise_model import huber_weights
from ..regression.regression_problem import BoolArray, FloatArray
from ..regression.signal_filter import SignalFilter, derivative
from .robot_effects import ChannelModel
from .robot_motion import RobotMotion, in_body
from .robot_nuisances import MODEL_DEVIATION
from .rolling_model import (
    ChannelLayout,
    ModelNumbers,
    Surroundings,
    inertial_wrench,
    rolling_state,
    twists,
    wrench_of,
)

TURNS = np.radians(np.arange(-170.0, 181.0, 10.0))  # of a zero that are tried first
LEAST_TURN = 0.05  # [rad]; less does not use up the friction of wheels
# What forces leave has to be this part of all of them, and of that the turn may leave so much; that of any other steering
# leaves clearly more.
LEAST_PART, LEFT_PART, CLEARLY = 0.05, 0.35, 1.5
LEAST_PART_LIMITED = 0.03  # where friction is used up, and nothing could be said otherwise
FIGHTING = 0.1  # of the samples, in which wheels are driven against each other
FRICTION_SPEED = 0.05  # [rad/s], at which dry friction reverses
TRACKED_PART = 0.5  # of the samples; the pose goes on with the wheels over gaps
STRETCHES = 8  # of time, by which the turn is found anew
STRETCH = 1.0  # [s], over which what is left is one and the same error


@dataclasses.dataclass(frozen=True)
class TurnedSteering:
    """A steering that reads more than its wheel's heading.

    Attributes:
        caster: its name; offset: what it reads too much, with `interval` of 95 % [rad].
        probability: that it is this caster's.
        measured, before, after: rms of the wrench on the base that forces make, and of what is left of it as described and,
            every stretch of time by the offset that the others tell, with the offset (3,) [N, N, N m].
        p_values: of so much more being left before by chance, of every second anew (3,).
        part: of the size of all forces that is left before and after.
        fighting: part of the samples in which wheels slide with that zero, too: they are driven against each other.
    """

    caster: str
    offset: float
    interval: tuple[float, float]
    probability: float
    measured: FloatArray
    before: FloatArray
    after: FloatArray
    p_values: FloatArray
    part: tuple[float, float]
    fighting: float


def turned_steering(
    model: ChannelModel, motions: Sequence[RobotMotion], filters: Sequence[SignalFilter], limited: bool,
    sliding: Callable[[ModelNumbers], float],
) -> TurnedSteering | None:
    """Return the one steering whose zero, somewhere else, lets forces do what the robot does; None where there is none.

    Args:
        model: of the robot as described; motions: true motions, with `filters` of their channels.
        limited: torques use up the friction of wheels in many samples.
        sliding: part of the samples in which wheels slide by some numbers.
    """
    forces = _Forces(model, motions, filters)
    measured, left = forces.wrench(None, 0.0)
    before = forces.size(left)
    if before < (LEAST_PART_LIMITED if limited else LEAST_PART) * forces.typical:
        return None
    casters = range(len(forces.layout.casters))
    trials = [(caster, float(turn)) for caster in casters for turn in TURNS]
    sizes = np.reshape(on_all_cores(lambda trial: forces.size(forces.wrench(*trial)[1]), trials), (-1, len(TURNS)))
    least = sizes.min(axis=1)
    best, second = np.argsort(least)[:2].tolist()
    first, step = float(TURNS[np.argmin(sizes[best])]), float(TURNS[1] - TURNS[0])
    turn = float(
        optimize.minimize_scalar(
            lambda t: forces.size(forces.wrench(best, float(t))[1]), bounds=(first - step, first + step), method="bounded"
        ).x
    )
    after = forces.size(forces.wrench(best, turn)[1])
    if abs(turn) < LEAST_TURN or after > LEFT_PART * before or least[second] < CLEARLY * after:
        return None
    fighting = sliding(with_turn(model.numbers, best, turn))
    if fighting > FIGHTING and forces.without_losses(best) < CLEARLY * after:
        return None
    told = forces.told_by_others(best, turn)
    held_out = np.concatenate(
        [np.array_split(forces.wrench(best, t)[1], STRETCHES)[k] for k, t in enumerate(told.tolist())]
    )  # fmt: skip
    chance = math.sqrt((STRETCHES - 1) / STRETCHES * float(np.sum((told - np.mean(told)) ** 2)))  # of a jackknife
    # What is left is no noise, and may as well be a part of that wheel's force that points another way.
    by_chance = float(stats.t.ppf(0.975, STRETCHES - 1)) * math.hypot(chance, MODEL_DEVIATION * turn)
    half = math.hypot(by_chance, after / forces.of_wheel[best])
    count = forces.seconds / STRETCH
    odds = np.exp(-count * np.log(least / least[best]))
    left_before, left_after = _rms(left), _rms(held_out)
    offset = -math.remainder(turn, math.tau)
    return TurnedSteering(
        caster=forces.layout.casters[best], offset=offset, interval=(offset - half, offset + half),
        probability=float(odds[best] / odds.sum()), measured=_rms(measured), before=left_before, after=left_after,
        p_values=stats.f.sf((left_before / left_after) ** 2, count, count),
        part=(before / forces.typical, after / forces.typical), fighting=fighting,
    )  # fmt: skip


class _Forces:
    """What the forces of all wheels do to a robot, and what its motion takes.

    Attributes:
        layout: of the channels of forces; typical: size of all forces together where they are large; of_wheel: of each wheel's
            there (n,) [N].
        telling: samples (T,) in which they are: where next to none acts none is left.
        seconds: of all motions.
    """

    def __init__(self, model: ChannelModel, motions: Sequence[RobotMotion], filters: Sequence[SignalFilter]) -> None:
        self.layout = ChannelLayout(model.layout.casters, balanced=True, imu=False, pose=False)
        self._numbers, self._motions, self._filters = model.numbers, motions, filters
        self._around: list[Surroundings] = [model.around(motion) for motion in motions]
        casters = (None, *range(len(self.layout.casters)))
        self._twists = {caster: [_twist(motion, model.numbers, caster) for motion in motions] for caster in casters}
        reach = max(float(np.max(np.linalg.norm(model.numbers.steer_axis, axis=1))), 1e-3)
        self._scale = np.array([1.0, 1.0, 1.0 / reach])
        pieces = []
        for motion, near, own in zip(motions, self._around, filters, strict=True):
            load = rolling_state(motion, model.numbers, self.layout, near).load
            pieces.append(own.apply(np.linalg.norm(load, axis=2)))
        sizes = np.concatenate(pieces)
        size = sizes.sum(axis=1)
        self.telling: BoolArray = size >= np.median(size)
        self.typical = float(np.median(size[self.telling]))
        self.of_wheel = np.maximum(np.median(sizes[self.telling], axis=0), 1e-300)
        self.seconds = sum(float(motion.time[-1] - motion.time[0]) for motion in motions)

    def wrench(
        self, caster: int | None, turn: float, losses: Sequence[FloatArray] = ()
    ) -> tuple[FloatArray, FloatArray]:
        """Wrench on the base, and what its motion leaves of it (T, 3) [N, N, N m].

        Args:
            caster: that is looked at; turn: of its zero [rad].
            losses: torques (T, 2) of each motion that its joints lose before they reach the ground.
        """
        turned, pieces = with_turn(self._numbers, caster, turn), []
        for k, (motion, near, own) in enumerate(zip(self._motions, self._around, self._filters, strict=True)):
            if losses:
                torque = motion.torque.copy()
                torque[:, caster] -= losses[k]
                motion = dataclasses.replace(motion, torque=torque)
            state, twist = rolling_state(motion, turned, self.layout, near), self._twists[caster][k]
            given = wrench_of(turned, state)
            taken = inertial_wrench(turned, motion, state.wheels.direction, twist, derivative(twist, motion.rate))
            pieces.append(own.apply(np.concatenate([given, given - taken], axis=1)))
        both = np.concatenate(pieces)
        return both[:, :3], both[:, 3:]

    def lengths(self, left: FloatArray) -> FloatArray:
        """Length of wrenches (T, 3) where they tell something, as forces [N]."""
        return np.asarray(np.linalg.norm(left * self._scale, axis=1)[self.telling])

    def size(self, left: FloatArray) -> float:
        """The middle one of these: when a robot starts or stops, and steerings flip, forces are known the least."""
        return float(np.median(self.lengths(left)))

    def told_by_others(self, caster: int, turn: float) -> FloatArray:
        """The turn (STRETCHES,) near one that all stretches of time but one tell: the lowest point of a parabola."""
        away = self.lengths(self.wrench(caster, turn)[1])
        weights = huber_weights(away / max(float(np.median(away)), 1e-300))
        near = turn + np.array([-1.0, 0.0, 1.0]) * LEAST_TURN
        squares = np.stack([self.lengths(self.wrench(caster, float(t))[1]) ** 2 * weights for t in near])
        sums = np.array([part.sum(axis=1) for part in np.array_split(squares, STRETCHES, axis=1)])
        others = sums.sum(axis=0) - sums
        bend, slope = others[:, 0] - 2.0 * others[:, 1] + others[:, 2], others[:, 2] - others[:, 0]
        lowest: FloatArray = turn - 0.5 * LEAST_TURN * slope / np.maximum(bend, 1e-300)
        return lowest

    def without_losses(self, caster: int) -> float:
        """Size of what is left without turning anything, but for what the joints of a caster may lose [N]."""
        holding = all(np.any(motion.loops[..., 1]) for motion in self._motions)
        losses = [_held_back(motion, caster) if holding else _rubbing(motion, caster) for motion in self._motions]
        whole = self.wrench(caster, 0.0)[1]
        columns = [whole - self.wrench(caster, 0.0, [own[:, :, k] for own in losses])[1] for k in range(losses[0].shape[2])]
        target = (whole * self._scale)[self.telling].ravel()
        design = np.stack([(column * self._scale)[self.telling].ravel() for column in columns], axis=1)
        if holding:  # one of them, by any part of itself
            parts = np.clip(design.T @ target / np.maximum(np.sum(design**2, axis=0), 1e-300), 0.0, 1.0)
            rests = target[:, None] - parts * design
            rest = rests[:, np.argmin(np.sum(rests**2, axis=0))]
        else:
            rest = target - design @ np.linalg.lstsq(design, target, rcond=None)[0]
        return float(np.median(np.linalg.norm(rest.reshape(-1, 3), axis=1)))


def _held_back(motion: RobotMotion, caster: int) -> FloatArray:
    """The torques (T, 2, 2) of a caster's joints that hold a speed: what they lose is a part of these."""
    return motion.torque[:, caster, :, None] * np.eye(2)


def _rubbing(motion: RobotMotion, caster: int) -> FloatArray:
    """What joints may lose (T, 2, 8) that the others drag along: a part of their torque, friction of any kind, a load."""
    torque, speed = motion.torque[:, caster], motion.velocity[:, caster]
    kinds = torque, np.ones_like(speed), speed, np.tanh(speed / FRICTION_SPEED)
    return np.concatenate([kind[:, :, None] * np.eye(2) for kind in kinds], axis=2)


def with_turn(numbers: ModelNumbers, caster: int | None, turn: float) -> ModelNumbers:
    """Return the numbers with the zero of one steering turned [rad]."""
    turned = numbers.copy()
    if caster is not None:
        turned.steer_zero[caster] += turn
    return turned


def _twist(motion: RobotMotion, numbers: ModelNumbers, without: int | None) -> FloatArray:
    """Twist of base_link (T, 3) by the tracked pose, or by all wheels but one."""
    if np.isfinite(motion.tracked_twist).mean() > TRACKED_PART:
        return in_body(derivative(motion.pose, motion.rate), motion.yaw)
    some = numbers.copy()
    kept = [i for i in range(len(numbers.radius)) if i != without]
    for name in ("steer_axis", "caster_offset", "radius", "steer_zero"):
        setattr(some, name, np.ascontiguousarray(getattr(numbers, name)[kept]))
    position, velocity = (np.ascontiguousarray(values[:, kept]) for values in (motion.position, motion.velocity))
    return twists(some, some.headings(position), velocity)[0]


def _rms(values: FloatArray) -> FloatArray:
    rms: FloatArray = np.sqrt(np.mean(values**2, axis=0))
    return rms
