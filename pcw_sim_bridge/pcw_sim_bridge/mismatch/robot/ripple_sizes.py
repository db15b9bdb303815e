"""How large ripples of joints are that pass too fast for the channels: by forward simulation under the measured torques.

What the rate of a joint does in a window of half a second is simulated, beside a slow drift of every window:

    rate measured - rate simulated = a S_c + b S_s + sum_j z_j S_j

S_c and S_s are what a unit of the ripple's cosine and sine adds. At tens of hertz a wheel swings between its rotor and its
tyre: numbers of these that the description knows within tolerances, the order, and the instant within a sample that a torque
was measured at, are re-tuned beside the sizes, z_j in their deviations. Slopes are taken anew where a step has led.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pcw_description.effects.kinds import ActuatorEffect
from pcw_description.effects.registry import get
from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, STEER, RobotDescription

from ...plants.reduced import ReducedPlant, WindowStarts
from ...plants.true_robot import as_it_really_is
from ..regression.regression_problem import BoolArray, FloatArray, IntArray
from ..regression.signal_filter import white_noise_level
from .joint_ripples import HIGHEST, JointRipple, even_series
from .robot_nuisances import common_relaxation, rotor_armature
from .robot_rollout import STEP, wheel_twist
from .rolling_model import ModelNumbers

LENGTH, SETTLING = 0.5, 0.15  # [s], of a window, and of its beginning, in which tyres take up their forces
WINDOWS, LEAST_WINDOWS = 48, 6  # at most, spread over all that was recorded, and at least
DRIFT = 4  # numbers of the polynomial that is the drift of a window
PROBE, TRIED = 0.02, 0.3  # of the joint's torque limit, and of a number's deviation, by which slopes are taken
ROUNDS, PARTS = 12, (1.0, 0.5, 0.2, 0.05)  # of steps, and parts of a step that are tried
SETTLED = 1e-3  # part of the cost that a last step gains
FARTHEST = 3.0  # deviations that a number is re-tuned by
DISPLACED = 0.3  # of its width, by which a line may be displaced
GROUPS = 6  # of windows, one left out in turn
CORRELATED = 4.0  # samples that noise within the band is alike over
# What a simulation leaves of a ripple is what it misjudges of tyres and gears, and it misjudges as much more. Sizes are
# uncertain by that, by this part of themselves, and by as much again for every deviation beyond one that a number is re-tuned
# by.
UNCERTAIN = 0.1


@dataclasses.dataclass(frozen=True)
class RippleSize:
    """A ripple with its size.

    Attributes:
        ripple: the ripple; cosine, sine: of its torque [N m]; deviations: of both (2,) [N m].
        numbers: what else was re-tuned, in deviations (J,): of the description, the order, and the instant of torques.
        before, after, floor: of the torques that would do what is left without it, with it, and of what noise of the encoder
            leaves, mean squares (W,) [N^2 m^2]: the part of each window, by how far it can be trusted, in the mean of all.
        recording, begin: number and stamp [s] of the windows (W,).
    """

    ripple: JointRipple
    cosine: float
    sine: float
    deviations: FloatArray
    numbers: FloatArray
    before: FloatArray
    after: FloatArray
    floor: FloatArray
    recording: IntArray
    begin: FloatArray


@dataclasses.dataclass(frozen=True)
class _Windows:
    """Windows of one recording: sampling period [s], stamps (W,), angles, rates and torques (W, L + 1, n, 2)."""

    recording: int
    step: float
    begin: FloatArray
    angle: FloatArray
    rate: FloatArray
    torque: FloatArray

    def drift_free(self, values: FloatArray) -> FloatArray:
        """Values (W, L) after the beginning of each window, without a polynomial in time of each."""
        after = values[:, round(SETTLING / self.step) :]
        drift, _ = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, after.shape[1]), DRIFT))
        return np.asarray(after - (after @ drift) @ drift.T)


Retuned = Callable[[Mapping[str, float]], RobotDescription]
"""The robot with numbers of its description re-tuned, by name."""


class RippleScale:
    """Weighs one ripple in windows of recordings."""

    def __init__(
        self, retuned: Retuned, recordings: Sequence[Recording], ripple: JointRipple, lowest: float
    ) -> None:
        """Take a robot without the ripple, recordings with torques, and the frequency above which it was looked for [Hz]."""
        robot = retuned({})
        self.retuned, self.ripple = retuned, ripple
        self.index = i, k = robot.caster_index(ripple.caster), AXIS_NAMES.index(ripple.axis)
        found = [_windows(r, n, self.index, ripple, lowest, len(recordings)) for n, r in enumerate(recordings)]
        self.windows = [windows for windows in found if windows is not None]
        described = {
            "contact.stiffness": 1.0, "contact.relaxation_length": common_relaxation(robot),
            f"rotors.{ripple.axis}": float(rotor_armature(robot, k)[0, k, k]),
        }  # fmt: skip
        known = [(name, nominal, _deviation(robot, name, nominal)) for name, nominal in described.items()]
        self.varied = [number for number in known if number[2] > 0.0]
        self.probe = PROBE * float(robot.torque_limit[i, k])

    def size(self) -> RippleSize | None:
        """The size of the ripple; None where too few windows show it."""
        if sum(len(w.begin) for w in self.windows) < LEAST_WINDOWS:
            return None
        point, deviations = np.zeros(4 + len(self.varied)), np.zeros(2)
        here = self._left(point)
        trust = [np.ones(len(own)) for own in here]
        noise = _square(here, trust) / sum(own.size for own in here)
        for count in range(ROUNDS):
            # The sizes first: until they are about right, all else that moves the phase of a wave would be moved instead.
            wanted, deviations, noise = _step(here, self._slopes(point, here, len(point)), point[2:], trust, noise, not count)
            least = _square(here, trust) / noise + float(np.sum(point[2:] ** 2))
            for part in PARTS:
                tried = point + part * wanted
                tried[2:] = np.clip(tried[2:], -FARTHEST, FARTHEST)
                there = self._left(tried)
                if (reached := _square(there, trust) / noise + float(np.sum(tried[2:] ** 2))) < least:
                    point, here = tried, there
                    break
            else:
                break
            if count and least - reached < SETTLED * least:
                break
            trust = _trust(here)
        return self._at(point, deviations)

    def again(self, size: RippleSize) -> RippleSize | None:
        """What a size that others told leaves of these recordings; None where too few windows show the ripple."""
        if sum(len(w.begin) for w in self.windows) < LEAST_WINDOWS:
            return None
        point = np.array([size.cosine, size.sine, *size.numbers])
        point[-2] = 0.0  # the order is the ripple's by now
        return self._at(point, size.deviations)

    def _at(self, point: FloatArray, deviations: FloatArray) -> RippleSize:
        left, without = self._left(point), self._left(np.array([0.0, 0.0, *point[2:]]))
        trust = np.concatenate(_trust(left))
        # A unit of cosine and one of sine are one amplitude at two phases; its torque has half its square as mean square.
        unit = np.concatenate([2.0 * np.mean(own**2, axis=(1, 2)) for own in self._slopes(point, left, 2)])
        i, k = self.index
        noise = np.concatenate([np.full(len(w.begin), white_noise_level(w.rate[:, :, i, k].ravel())) for w in self.windows])

        def torques(squares: FloatArray) -> FloatArray:
            return np.asarray(trust * squares / max(float(np.mean(trust * unit)), 1e-300))

        before, after = (torques(np.concatenate([np.mean(own**2, axis=1) for own in side])) for side in (without, left))
        strained = max(float(np.abs(point[2:]).max()) - 1.0, 0.0)
        part = math.hypot(math.sqrt(after.mean() / max(before.mean(), 1e-300)), UNCERTAIN * (1.0 + strained))
        return RippleSize(
            dataclasses.replace(self.ripple, order=self._order(point)), float(point[0]), float(point[1]),
            np.hypot(deviations, part * math.hypot(point[0], point[1])), point[2:], before, after,
            np.minimum(torques(noise**2), after), np.concatenate([np.full(len(w.begin), w.recording) for w in self.windows]),
            np.concatenate([w.begin for w in self.windows]),
        )  # fmt: skip

    def _order(self, point: FloatArray) -> float:
        """The order, which was found but for the phases that change with the speed, unless it is a whole number [1/rad]."""
        found = self.ripple.order
        return found if found == round(found) else found + DISPLACED * self.ripple.width * float(point[-2])

    def _left(self, point: FloatArray) -> list[FloatArray]:
        """What is left of the rate, per recording (W, L), with sizes, re-tuned numbers, and torques of another instant."""
        robot = self.retuned({n: nominal + d * z for (n, nominal, d), z in zip(self.varied, point[2:-2], strict=True)})
        i, k = self.index
        return [
            w.drift_free(w.rate[:, 1:, i, k]) - w.drift_free(self._simulated(robot, w, point)) for w in self.windows
        ]

    def _slopes(self, point: FloatArray, here: Sequence[FloatArray], count: int) -> list[FloatArray]:
        """What a unit of each of the first numbers of a point takes away, per recording (W, L, count)."""
        columns = []
        for j in range(count):
            step = self.probe if j < 2 else TRIED
            there = self._left(point + step * np.eye(len(point))[j])
            columns.append([(one - other) / step for one, other in zip(here, there, strict=True)])
        return [np.stack(parts, axis=2) for parts in zip(*columns, strict=True)]

    def _simulated(self, robot: RobotDescription, windows: _Windows, point: FloatArray) -> FloatArray:
        """Rate (W, L) of the joint under the measured torques and a ripple.

        It goes with the measured angle: a simulated one is soon a part of a wave away.
        """
        i, k = self.index
        substeps = math.ceil(windows.step / STEP - 1e-6)
        # The torques were measured behind whatever happens to the commands.
        behind = tuple(instance for instance in robot.physics if not isinstance(get(instance.name), ActuatorEffect))
        plant = ReducedPlant(dataclasses.replace(robot, physics=behind), windows.step / substeps)
        angle, rate = windows.angle[:, :1], windows.rate[:, :1]
        twist = wheel_twist(ModelNumbers.of(as_it_really_is(robot)), angle[..., STEER], rate)
        starts = WindowStarts(
            np.zeros(1, dtype=np.int64), windows.begin, np.zeros((len(angle), 1, 3)), twist, angle, rate, np.zeros_like(angle)
        )
        # A row is held until the next. What acts meanwhile is the mean of both, unless torques are of another instant.
        later = 0.5 + point[-1]
        torque = (1.0 - later) * windows.torque[:, :-1] + later * windows.torque[:, 1:]
        row = robot.gear_coupling[i, k]
        turned = 0.5 * self._order(point) * ((windows.angle[:, :-1, i] + windows.angle[:, 1:, i]) @ row)
        torque[:, :, i] += (point[0] * np.cos(turned) + point[1] * np.sin(turned))[:, :, None] * row
        _, joints = plant.roll_out(torque, substeps, starts, list(range(1, torque.shape[1] + 1)))
        return np.asarray(joints[:, :, i, 1, k])


def _deviation(robot: RobotDescription, name: str, nominal: float) -> float:
    """Standard deviation that a number of the description has by its tolerance."""
    tolerance = robot.tolerance("rotors" if name.startswith("rotors.") else name)
    return tolerance.value * abs(nominal) if tolerance.relative else tolerance.value


def _windows(
    recording: Recording, number: int, joint: tuple[int, int], ripple: JointRipple, lowest: float, recordings: int
) -> _Windows | None:
    """Windows in which the ripple passes within the band all the time, evenly among those of a recording."""
    time, values, whole = even_series(recording)
    if len(time) < 2:
        return None
    step = float(time[1] - time[0])
    length = max(round(LENGTH / step), 2)
    fast = ripple.order * np.abs(values[:, joint[0], joint[1], 1]) / math.tau
    good = whole & (fast > lowest) & (fast < min(HIGHEST, 0.25 / step)) & np.isfinite(values).all(axis=(1, 2, 3))
    counts = np.concatenate([[0], np.cumsum(good)])
    starts: list[int] = []
    for start in np.flatnonzero(counts[length + 1 :] - counts[: -length - 1] == length + 1):
        if not starts or start - starts[-1] >= length:
            starts.append(int(start))
    if not starts:
        return None
    most = max(WINDOWS // recordings, 1)
    chosen = np.array(starts)[np.unique(np.linspace(0, len(starts) - 1, min(most, len(starts))).astype(int))]
    angle, rate, torque = np.moveaxis(values[chosen[:, None] + np.arange(length + 1)], 4, 0)
    return _Windows(number, step, time[chosen], angle, rate, torque)


def _trust(left: Sequence[FloatArray]) -> list[FloatArray]:
    """Weights (W,) of windows per recording: where far more is left than of most, something else happened."""
    squares = [np.mean(own**2, axis=1) for own in left]
    usual = float(np.median(np.concatenate(squares)))
    return [np.minimum(usual / np.maximum(own, 1e-300), 1.0) for own in squares]


def _square(left: Sequence[FloatArray], trust: Sequence[FloatArray]) -> float:
    return sum(float(np.sum(weight[:, None] * own**2)) for own, weight in zip(left, trust, strict=True))


def _step(
    left: Sequence[FloatArray], slopes: Sequence[FloatArray], numbers: FloatArray, trust: Sequence[FloatArray], noise: float,
    only_sizes: bool,
) -> tuple[FloatArray, FloatArray, float]:
    """Change of a point that leaves least, deviations of both sizes (2,), and the noise that is left then.

    Noise: mean square of what is left, times the samples that noise is alike over.
    """
    prior = np.concatenate([np.zeros(2), np.full(len(numbers), 1e12 if only_sizes else 1.0)])
    pull = np.concatenate([np.zeros(2), numbers])
    gram = np.concatenate([np.einsum("w,wta,wtb->wab", w, s, s) for s, w in zip(slopes, trust, strict=True)])
    moment = np.concatenate([np.einsum("w,wta,wt->wa", w, s, own) for s, own, w in zip(slopes, left, trust, strict=True)])

    def change(among: BoolArray) -> FloatArray:
        part = gram[among].sum(axis=0) / noise + np.diag(prior)
        return np.asarray(np.linalg.solve(part, moment[among].sum(axis=0) / noise - pull))

    everything = np.ones(len(gram), dtype=bool)
    best = change(everything)
    remains = _square([own - s @ best for own, s in zip(left, slopes, strict=True)], trust)
    noise = CORRELATED * remains / sum(own.size for own in left)
    best = change(everything)
    group = np.arange(len(gram)) % GROUPS
    parted = np.stack([change(group != g) - best for g in range(GROUPS)])
    scatter = (GROUPS - 1) / GROUPS * np.sum(parted**2, axis=0)
    known = np.diag(np.linalg.inv(gram.sum(axis=0) / noise + np.diag(prior)))
    return best, np.sqrt(np.maximum(scatter, known))[:2], noise
