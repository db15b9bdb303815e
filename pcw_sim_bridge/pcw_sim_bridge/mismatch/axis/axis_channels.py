"""The channel of a bench axis: `axis_force`, the force that the nominal model does not account for.

    residual = H[force + external_force] - (inertia H[a] - gravity - known effects),      H the same filter everywhere

with the position filtered before it is differentiated. Candidates are all joint-torque effects of the vocabulary that
a drive without ground contact can have.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from pcw_description.axis_recording import TARGET, AxisDescription, AxisRecording
from pcw_description.effects.effect import Effect, EffectParameter
from pcw_description.effects.kinds import JointTorqueEffect
from pcw_description.effects.registry import all_effects

from ..errors import MismatchError
from ..laws.unknown_law import TRAVEL
from ..regression.regression_problem import (
    BoolArray,
    Channel,
    FloatArray,
    LinearParameter,
    Nuisance,
    RegressionProblem,
    Shape,
    Sites,
    Term,
)
from ..regression.signal_filter import (
    SignalFilter,
    derivative,
    reading_noise_level,
    refined,
    uniform_segments,
    white_noise_level,
)

LARGEST_CUTOFF = (
    40.0  # [Hz]; above it real drives show the resonances of their structure, which no effect here describes
)
SMALLEST_CUTOFF = 2.0
# A force that is held between samples loses (w T)^2 / 24 of its amplitude: 1.6 % at this many samples per period.
SAMPLES_PER_CUTOFF = 10.0
# Signals are refined to this many samples per period of the cut-off before the sign of a speed is taken of them.
FINE_SAMPLES_PER_CUTOFF = 40.0
# Derivatives are formed of signals filtered this much wider than the channel, so that kernels see sharp reversals.
PREFILTER_RATIO = 2.5
# The noise that differentiation puts into the inertial force may reach this part of the measured force.
ALLOWED_DERIVATIVE_NOISE = 0.05
SHORTEST_SEGMENT = 1.0  # [s]
LEAST_RATE = 10.0  # [Hz]; of fewer samples no derivative is one of a drive
# A force is looked for so much later and earlier than it is recorded [s], in so many steps to either side; it is taken to be
# there if that leaves no more than this part of the squares. A friction that nobody described leaves more than half.
LARGEST_DELAY, DELAYS, DELAYED_SQUARES = 0.08, 16, 0.35
# An inertia of so many times the described one, or of so small a part, is a unit that is wrong, if the described one leaves so
# many times the squares; so one of the other sign is.
MISTAKEN, MISTAKEN_SQUARES = 3.0, 2.0
LARGEST_ORDER_GRID = 1500
# Coggings that count as known when a force is predicted or the smoothing chosen: so many, each explaining such a part of
# what the others leave, and such a part of the measured force.
LEADING_PERIODIC, SMALLEST_PERIODIC, SMALLEST_PERIODIC_FORCE = 8, 0.05, 0.003
MOST_OF_A_TURN = 0.75
# Parameters that only smooth a sign: one value serves all effects of an axis, chosen once.
SMOOTHING = "smoothing_speed"


@dataclasses.dataclass(frozen=True)
class AxisMotion:
    """One contiguous piece after the wide filter, refined; arrays (T,). Below the speed `slow` it may as well stand still."""

    recording: int
    time: FloatArray
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    force: FloatArray
    slow: float
    still: FloatArray


def choose_cutoff(axis: AxisDescription, recordings: Sequence[AxisRecording]) -> float:
    """Return the largest cut-off at which differentiated position noise stays small against the force [Hz].

    White position noise s_q at rate f_s, differentiated twice and cut at f_c, has the variance
    2 s_q^2 (2 pi)^4 f_c^5 / (5 f_s).
    """
    cutoffs = []
    for recording in recordings:
        rate = 1.0 / float(np.median(np.diff(recording.time)))
        limit = min(LARGEST_CUTOFF, rate / SAMPLES_PER_CUTOFF)
        noise = reading_noise_level(recording.position) if recording.velocity is None else 0.0
        allowed = ALLOWED_DERIVATIVE_NOISE * max(float(np.std(recording.force)), 1e-300) / axis.inertia
        if noise > 0.0:
            limit = min(limit, (allowed**2 * 5.0 * rate / (2.0 * noise**2 * (2.0 * np.pi) ** 4)) ** 0.2)
        cutoffs.append(limit)
    return max(min(cutoffs), SMALLEST_CUTOFF)


def axis_motion(
    axis: AxisDescription, recording: AxisRecording, index: int, cutoff: float
) -> tuple[float, list[AxisMotion]]:
    """Filter one recording, refine and differentiate it.

    Returns:
        The rate of the refined pieces [Hz] and the usable pieces.
    """
    velocity = recording.velocity if recording.velocity is not None else np.full_like(recording.time, np.nan)
    signals = np.stack([recording.position, velocity, recording.force + recording.external_force], axis=1)
    rate, pieces = uniform_segments(recording.time, signals, largest_gap=0.02)
    wide = SignalFilter(rate, PREFILTER_RATIO * cutoff)
    # Deviation of the velocity after the wide filter: of what is read of it, or of a noisy position.
    band = min(wide.cutoff, 0.5 * rate)
    if recording.velocity is not None:
        creep = white_noise_level(recording.velocity) * np.sqrt(2.0 / rate * band)
    else:
        creep = reading_noise_level(recording.position) * np.sqrt(2.0 / rate * (2.0 * np.pi) ** 2 * band**3 / 3.0)
    factor = max(1, math.ceil(FINE_SAMPLES_PER_CUTOFF * cutoff / rate))
    motions = []
    for stamps, values in pieces:
        if stamps[-1] - stamps[0] < SHORTEST_SEGMENT:
            continue
        position, force = wide.smooth(values[:, 0]), wide.smooth(values[:, 2])
        speed = derivative(position, rate) if recording.velocity is None else wide.smooth(values[:, 1])
        fine = refined(np.stack([position, speed, derivative(speed, rate), force], axis=1), factor)
        position, speed, acceleration, force = fine.T
        rounding = 1e-12 * float(np.max(np.abs(position))) * factor * rate
        floor = max(4.0 * creep, 2e-3 * float(np.max(np.abs(speed))), rounding)
        motions.append(
            AxisMotion(
                recording=index,
                time=stamps[0] + np.arange(len(fine)) / (factor * rate),
                position=position,
                velocity=speed,
                acceleration=acceleration,
                force=force,
                slow=floor,
                still=_long_runs(np.abs(speed) <= floor, int(0.05 * factor * rate)),
            )
        )
    return factor * rate, motions


def _long_runs(flags: BoolArray, shortest: int) -> FloatArray:
    """Return 1.0 where `flags` has been true for at least `shortest` samples on end, else 0.0."""
    edges = np.flatnonzero(np.diff(np.r_[False, flags, False].astype(np.int8)))
    result = np.zeros(len(flags))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start >= shortest:
            result[start:stop] = 1.0
    return result


class AxisProblemBuilder:
    """Builds the regression problem of a bench axis from its recordings."""

    def __init__(
        self, axis: AxisDescription, recordings: Sequence[AxisRecording], cutoff: float | None = None
    ) -> None:
        """Filter the recordings.

        Args:
            cutoff: of the channel filter [Hz]; None chooses it from the noise of the recordings.

        Raises:
            MismatchError: no recording has a piece long enough, or one has no force.
        """
        for recording in recordings:
            acting = recording.force + recording.external_force
            known = acting[np.isfinite(acting)]
            if not len(known) or np.ptp(known) == 0.0:
                always = f"{known[0]:.3g}" if len(known) else "NaN"
                raise MismatchError(f"{recording.path}: the force is {always} throughout; allowed: a drive that works")
            rate = 1.0 / float(np.median(np.diff(recording.time)))
            if rate < LEAST_RATE:
                raise MismatchError(
                    f"{recording.path}: {rate:.3g} samples a second by columns.time or rate; allowed: {LEAST_RATE:g} and more"
                )
        self.axis, self.recordings = axis, tuple(recordings)
        self.cutoff = cutoff if cutoff is not None else choose_cutoff(axis, recordings)
        rates_and_motions = [
            axis_motion(axis, recording, i, self.cutoff) for i, recording in enumerate(recordings)
        ]
        slowest = min(rate for rate, _ in rates_and_motions)
        self.filters = [SignalFilter(rate, self.cutoff) for rate, _ in rates_and_motions]
        self.motions = [motion for _, motions in rates_and_motions for motion in motions]
        if not self.motions:
            raise MismatchError(f"no contiguous piece of at least {SHORTEST_SEGMENT:g} s in the recordings")
        self.rate = slowest / SignalFilter(slowest, self.cutoff).step
        self._force = self._filtered([motion.force for motion in self.motions])
        self._variables = {
            "position": self._filtered([m.position for m in self.motions]),
            "velocity": self._filtered([m.velocity for m in self.motions]),
            "acceleration": self._filtered([m.acceleration for m in self.motions]),
        }
        self._acceleration = self._variables["acceleration"]
        self._valid = self._filtered([m.still for m in self.motions]) < 0.1
        self._scans: dict[str, FloatArray] = {}
        self._described: list[tuple[JointTorqueEffect, dict[str, float]]] = []
        self._plain_forces = self._explained_force((), in_channel=True, bare=True)
        self._smooth_forces = self._explained_force(())
        periodic = self._leading_periodic()
        self._smooth_forces = self._explained_force(periodic)
        self._shifted_forces = self._explained_force(periodic, with_load=True, in_channel=True)
        self._smooth_forces = self._forces_of_loads(periodic)
        self._shifted_forces = self._explained_force(periodic, with_load=True, in_channel=True)
        self._described = self._described_effects()
        self._plain_forces = self._with_described(self._plain_forces)
        self._periodic_columns = [self._columns(effect, shape)[:, 0, :] for effect, shape in periodic]

    def _filtered(self, pieces: Sequence[FloatArray]) -> FloatArray:
        """Channel filter on full-rate arrays of all motions, joined: [(T_i, ...)] -> (T, ...)."""
        return np.concatenate(
            [self.filters[m.recording].apply(p) for m, p in zip(self.motions, pieces, strict=True)]
        )

    def _explained_force(
        self,
        periodic: Sequence[tuple[JointTorqueEffect, Shape]],
        with_load: bool = False,
        in_channel: bool = False,
        bare: bool = False,
    ) -> list[FloatArray]:
        """The force as the simplest models of a drive would have it, at full rate.

        Args:
            periodic: effects periodic in position that take part, with their shapes.
            with_load: include a friction that follows the load as it is explained so far, which only effects non-linear in
                the force need.
            in_channel: fit it in the band of the channel, where it is in proportion to the force that acts. In the wider band
                the noise of an acceleration may be as large as itself, and what is fitted there is smoother than the force: so
                it has to be where its magnitude is taken.
            bare: give the part of inertia and gravity alone.

        Effects that depend on the motor torque must not see the measured one: its noise is the residual's own noise,
        and a column that holds it would be "found" in any recording. Nor may it hold structure that the named effects
        do not have: an error of the torque constant scales what is explained, it explains nothing by itself.
        """
        axis = self.axis
        speed = np.concatenate([m.velocity for m in self.motions])
        top = max(float(np.quantile(np.abs(speed), 0.99)), 1e-12)

        def basis(m: AxisMotion, load: FloatArray | None) -> FloatArray:
            sign = np.tanh(m.velocity / (0.02 * top))
            a, v = m.acceleration, m.velocity
            columns = [a, v, sign, np.ones_like(sign)]
            if axis.gravity_arm is not None:
                columns.append(np.sin(m.position - axis.gravity_arm.hanging_position))
            for effect, shape in periodic:
                columns.extend(effect.regressor(m.position, v, m.force, np.zeros_like(v), shape).values())
            return np.stack(columns if load is None else [*columns, np.abs(load) * sign], axis=1)

        loads = self._smooth_forces if with_load else [None] * len(self.motions)
        parts = [basis(m, load) for m, load in zip(self.motions, loads, strict=True)]
        if in_channel and self._valid.any():
            stacked, force = self._filtered(parts)[self._valid], self._force[self._valid]
        else:
            stacked, force = np.concatenate(parts), np.concatenate([m.force for m in self.motions])
        size = np.maximum(np.sqrt(np.mean(stacked**2, axis=0)), 1e-300)
        solution, *_ = np.linalg.lstsq(stacked / size, force, rcond=1e-8)
        scaled = solution / size
        if in_channel and not bare and not 1.0 / MISTAKEN < scaled[0] / axis.inertia < MISTAKEN:
            # The force follows no inertia there: what comes out as one is a force that is late, or cogging.
            return self._explained_force(periodic, with_load)
        if bare:
            # Frictions and loads are free to be as large as the error makes them. What there seems to be of them where a force
            # is late by half a sample is none, and would tell how large the error is.
            scaled[1:4] = 0.0
        return [part @ scaled for part in parts]

    def _forces_of_loads(self, periodic: Sequence[tuple[JointTorqueEffect, Shape]]) -> list[FloatArray]:
        """The explained force at full rate as the magnitude is taken of it that a gear rubs by.

        In the wider band the noise of an acceleration makes that too large where the force is small, and the force too smooth;
        smoothed to the channel it is that of the motor. A gear that rubs by both its sides may follow another one: where that
        leaves less, it is taken.
        """
        wide = self._explained_force(periodic, with_load=True)
        if not self._valid.any():
            return wide
        smooth = [self.filters[m.recording].smooth(f) for m, f in zip(self.motions, self._shifted_forces, strict=True)]
        velocity = self._variables["velocity"]
        signs = self._signs()
        fixed = [self._acceleration, velocity, np.ones_like(velocity), self._skew(), *self._gravity(), self._filtered(signs)]

        def left(forces: Sequence[FloatArray]) -> float:
            loads = self._filtered([np.abs(force) * sign for force, sign in zip(forces, signs, strict=True)])
            return self._misfit([column[:, None] for column in (*fixed, loads)])

        return min([wide, smooth], key=left)

    def _signs(self) -> list[FloatArray]:
        """Direction of the motion at full rate, roughly."""
        top = max(float(np.quantile(np.abs(self._variables["velocity"]), 0.99)), 1e-12)
        return [np.tanh(m.velocity / (0.02 * top)) for m in self.motions]

    def choose_smoothing(self) -> float:
        """Return the speed over which frictions reverse on this axis [m/s or rad/s], by least squares."""
        if not self._valid.any():
            return 1.0
        frictions = [
            e for e in candidate_effects() if e.parameters and SMOOTHING in {p.name for p in e.parameters}
        ]
        shaped = [[p.name for p in effect.nonlinear_parameters if p.name != SMOOTHING] for effect in frictions]
        top = max(float(np.quantile(np.abs(self._variables["velocity"]), 0.98)), 1e-12)

        def friction_columns(smoothing: float, width: float) -> list[FloatArray]:
            return [
                self._columns(effect, {SMOOTHING: smoothing} | dict.fromkeys(names, width * top))[:, 0, :]
                for effect, names in zip(frictions, shaped, strict=True)
            ]

        companions = ("drive_viscous_friction", "constant_load")
        fixed = [self._acceleration[:, None], self._skew()[:, None]]
        fixed += [self._columns(all_effects()[name], {})[:, 0, :] for name in companions]  # type: ignore[arg-type]
        fixed += self._periodic_columns
        fixed += [column[:, None] for column in self._gravity()]

        def misfit(smoothing: float) -> float:
            # Further shapes are tried, too: a curve of the wrong width would be mended by the smoothing.
            return min(
                self._misfit([*fixed, *friction_columns(smoothing, width)]) for width in (0.03, 0.06, 0.12, 0.25, 0.5)
            )

        grid = self._smoothings()
        best = grid[int(np.argmin([misfit(float(value)) for value in grid]))]
        for width in (0.5, 0.2):
            nearby = best * np.exp(width * np.array([-1.0, 0.0, 1.0]))
            best = nearby[int(np.argmin([misfit(float(value)) for value in nearby]))]
        return float(best)

    def _misfit(self, columns: Sequence[FloatArray]) -> float:
        """Least squares of the force that remain beside columns (T, P)."""
        if not self._valid.any():  # it never moves: nothing is misfitted
            return 0.0
        stacked = np.concatenate(columns, axis=1)[self._valid]
        scaled = stacked / np.maximum(np.sqrt(np.mean(stacked**2, axis=0)), 1e-300)
        force = self._force[self._valid]
        right = scaled.T @ force
        return float(force @ force - right @ np.linalg.lstsq(scaled.T @ scaled, right, rcond=1e-12)[0])

    def _leading_periodic(self) -> list[tuple[JointTorqueEffect, Shape]]:
        """The strongest effects periodic in position with their shapes, beside the simplest model of a drive."""
        valid = self._valid
        if not valid.any():  # it never moves
            return []
        force = self._force[valid]
        columns = [self._filtered(self._smooth_forces)[:, None], np.ones((len(valid), 1))]
        columns += [self._variables[name][:, None] for name in ("velocity", "acceleration")]
        found: list[tuple[JointTorqueEffect, Shape]] = []
        for effect in candidate_effects():
            term = self._term(effect, 1.0)
            if term.scan is None:
                continue
            scanned = term.scan()[valid, 0]
            flat = scanned.reshape(len(scanned), -1)
            for _ in range(LEADING_PERIODIC):
                known, _ = np.linalg.qr(np.concatenate(columns, axis=1)[valid])
                left = force - known @ (known.T @ force)
                overlap = (known.T @ flat).reshape(-1, *scanned.shape[1:])
                grams = np.einsum("tsp,tsq->spq", scanned, scanned) - np.einsum("ksp,ksq->spq", overlap, overlap)
                right = (left @ flat).reshape(scanned.shape[1:])
                grams += 1e-6 * np.trace(grams, axis1=1, axis2=2)[:, None, None] * np.eye(grams.shape[2]) + 1e-300
                gains = np.einsum("sp,sp->s", right, np.linalg.solve(grams, right[..., None])[..., 0])
                best = int(np.argmax(gains))
                least = SMALLEST_PERIODIC * float(left @ left), SMALLEST_PERIODIC_FORCE * float(force @ force)
                if gains[best] < max(least):
                    break
                found.append((effect, term.shapes[best]))
                columns.append(term.columns(term.shapes[best])[:, 0, :])
        return found

    def _gravity(self) -> list[FloatArray]:
        """Sine and cosine of the angle from where the arm hangs, (T,) each; none without an arm."""
        if self.axis.gravity_arm is None:
            return []
        angles = [m.position - self.axis.gravity_arm.hanging_position for m in self.motions]
        return [self._filtered([function(angle) for angle in angles]) for function in (np.sin, np.cos)]

    def _skew(self) -> FloatArray:
        """What a force measured later than it acts adds per second of delay (T,): F(t - d) = F(t) - d F'(t).

        Of the explained force, not the measured one, for the reason given there; as large as it is in the channel. Of one
        that is too small in its inertial part the delay comes out too long, and what that does to gravity passes for friction.
        """
        rates = [self.filters[m.recording].rate for m in self.motions]
        return self._filtered([-derivative(f, rate) for f, rate in zip(self._shifted_forces, rates, strict=True)])

    def build(self, smoothing: float) -> RegressionProblem:
        """Return the problem with the given smoothing of all signs."""
        axis = self.axis
        acceleration = self._variables["acceleration"]
        predicted = axis.inertia * acceleration
        nuisances = [
            Nuisance(
                "inertia",
                axis.unit("kg m^2"),
                axis.inertia,
                _deviation(axis, "inertia", axis.inertia),
                acceleration[:, None],
            )
        ]
        if axis.gravity_arm is not None:
            arm = axis.gravity_arm
            shape, across = self._gravity()
            predicted = predicted + arm.moment * shape
            deviation = _deviation(axis, "gravity_moment", arm.moment)
            nuisances.append(Nuisance("gravity_moment", "N m", arm.moment, deviation, shape[:, None]))
            deviation = _deviation(axis, "hanging_position", 1.0)
            lean = -arm.moment * across
            nuisances.append(Nuisance("hanging_position", "rad", arm.hanging_position, deviation, lean[:, None]))
        skew = self._skew()
        period = min(float(np.median(np.diff(recording.time))) for recording in self.recordings)
        nuisances.append(
            Nuisance("clock_offset", "s", 0.0, _deviation(axis, "clock_offset", 1.0) * period, skew[:, None])
        )
        for described, given in self._described:
            predicted = predicted - self._filtered(self._contributions(described, given))
        measured = self._force
        stamps = [self.filters[m.recording].decimate(m.time) for m in self.motions]
        start = {m.recording: m.time[0] for m in reversed(self.motions)}
        time = np.concatenate([t - start[m.recording] for m, t in zip(self.motions, stamps, strict=True)])
        segment = np.concatenate([np.full(len(t), i) for i, t in enumerate(stamps)])
        recording = np.concatenate(
            [np.full(len(t), m.recording) for m, t in zip(self.motions, stamps, strict=True)]
        )
        variables = dict(self._variables)
        variables["time"] = time
        variables["force"] = self._filtered(self._smooth_forces)
        variables[TRAVEL] = self._filtered(self._travels)
        terms = [self._term(effect, smoothing) for effect in candidate_effects()]
        return RegressionProblem(
            channels=(Channel("axis_force", axis.unit("N m"), axis="drive"),),
            time=time,
            segment=segment,
            recording=recording,
            rate=self.rate,
            measured=measured[:, None],
            residual=(measured - predicted)[:, None],
            valid=self._valid[:, None],
            nuisances=tuple(nuisances),
            terms=tuple(terms),
            variables=variables,
            sites=self._sites(start, smoothing),
            remarks=self._mistaken_units(),
        )

    def _described_effects(self) -> list[tuple[JointTorqueEffect, dict[str, float]]]:
        """The effects of the description that act on the axis, with their parameters.

        How fast a friction reverses is no physics: by a value that is not this axis's it would leave a Stribeck friction of
        about that speed. Where another one leaves less, that is taken.
        """
        described = [(all_effects()[instance.name], instance.parameters) for instance in self.axis.physics]
        torques = [(effect, dict(given)) for effect, given in described if isinstance(effect, JointTorqueEffect)]
        if not self._valid.any() or not any(p.name == SMOOTHING for effect, _ in torques for p in effect.parameters):
            return torques

        def smoothed(value: float) -> list[tuple[JointTorqueEffect, dict[str, float]]]:
            return [
                (effect, given | ({SMOOTHING: value} if SMOOTHING in {p.name for p in effect.parameters} else {}))
                for effect, given in torques
            ]

        velocity = self._variables["velocity"]
        beside = [self._acceleration, velocity, np.ones_like(velocity), self._skew(), *self._gravity()]
        known, _ = np.linalg.qr(np.stack(beside, axis=1)[self._valid])

        def left(effects: Sequence[tuple[JointTorqueEffect, dict[str, float]]]) -> float:
            does = np.sum([self._filtered(self._contributions(*effect)) for effect in effects], axis=0)
            force = (self._force + self._reported_part * does)[self._valid]
            return float(np.sum((force - known @ (known.T @ force)) ** 2))

        return min([torques, *(smoothed(float(value)) for value in self._smoothings())], key=left)

    @functools.cached_property
    def _reported_part(self) -> float:
        """So large a part of what acts is reported as it is of inertia and gravity, by a motor of another torque constant."""
        acting = self.axis.inertia * self._acceleration
        if self.axis.gravity_arm is not None:
            acting = acting + self.axis.gravity_arm.moment * self._gravity()[0]
        acting, reported = acting[self._valid], self._filtered(self._plain_forces)[self._valid]
        return float(np.clip(reported @ acting / max(float(acting @ acting), 1e-300), 1.0 / MISTAKEN, MISTAKEN))

    def _with_described(self, forces: list[FloatArray]) -> list[FloatArray]:
        """The forces of inertia and gravity, as they are reported, with those of what is described, at full rate."""
        for effect, given in self._described_beside_gains() if self._valid.any() else ():
            does = self._contributions(effect, given, self._smooth_forces)
            forces = [force - self._reported_part * torque for force, torque in zip(forces, does, strict=True)]
        return forces

    def _described_beside_gains(self) -> list[tuple[JointTorqueEffect, dict[str, float]]]:
        return [(effect, given) for effect, given in self._described if not _is_gain(effect)]

    def _unsure_part(self) -> float:
        """By which part an error of the torque constant is uncertain, as is how large described forces are reported."""
        inertia = self.axis.inertia
        return _deviation(self.axis, "inertia", inertia) / inertia if self._described_beside_gains() else 0.0

    def _smoothings(self) -> FloatArray:
        """Speeds over which frictions may reverse: one that takes more than a twentieth of the top speed is not dry."""
        top = max(float(np.quantile(np.abs(self._variables["velocity"]), 0.98)), 1e-12)
        grid: FloatArray = top * np.geomspace(5e-4, 0.05, 7)
        return grid

    def delay(self) -> float:
        """By how much the force is recorded later than it acts [s], roughly; 0 where that explains little.

        From far off no slope leads there, and beside a delay what is missing of friction looks like less of it.
        """
        if not self._valid.any():
            return 0.0
        signs = self._signs()
        loads = [np.abs(force) * sign for force, sign in zip(self._smooth_forces, signs, strict=True)]
        columns = [self._filtered(frictions) for frictions in (signs, loads)]
        columns += [self._acceleration, self._variables["velocity"], np.ones(len(self._valid)), *self._gravity()]
        known, _ = np.linalg.qr(np.concatenate([np.stack(columns, axis=1), *self._periodic_columns], axis=1)[self._valid])
        left: dict[float, float] = {}
        for late in np.linspace(-LARGEST_DELAY, LARGEST_DELAY, 2 * DELAYS + 1).tolist():
            force = self._filtered([np.interp(m.time + late, m.time, m.force) for m in self.motions])[self._valid]
            left[late] = float(np.sum((force - known @ (known.T @ force)) ** 2))
        best = min(left, key=lambda late: left[late])
        return best if left[best] < DELAYED_SQUARES * left[0.0] else 0.0

    def _mistaken_units(self) -> tuple[str, ...]:
        """Say so where the force asks for an inertia of the other sign or of another order of magnitude."""
        if not self._valid.any():
            return ()
        velocity, (acceleration, force) = self._variables["velocity"], (self._acceleration, self._force)
        friction = np.tanh(velocity / (0.02 * max(float(np.quantile(np.abs(velocity), 0.99)), 1e-12)))
        others = [velocity, friction, np.ones_like(velocity), *self._gravity()]
        left, fixed = [], force - self.axis.inertia * acceleration
        for known, target in ((others, fixed), ([*others, acceleration], force)):
            columns = np.stack(known, axis=1)[self._valid]
            size = np.maximum(np.sqrt(np.mean(columns**2, axis=0)), 1e-300)
            solution = np.linalg.lstsq(columns / size, target[self._valid], rcond=1e-9)[0] / size
            left.append(float(np.sum((target[self._valid] - columns @ solution) ** 2)))
        ratio, unit = float(solution[-1]) / self.axis.inertia, self.axis.unit("kg m^2")
        if left[0] < MISTAKEN_SQUARES * left[1] or 1.0 / MISTAKEN < ratio < MISTAKEN:
            return ()
        asked = f"The force asks for an inertia of {solution[-1]:.3g} {unit}, and the description has {self.axis.inertia:.3g}:"
        if ratio < -1.0 / MISTAKEN:
            return (f"{asked} force or position points the other way; turn one round by the sign of its scale in columns.",)
        return (f"{asked} check the units in columns (degrees for rad are 57.3, ms for s a million) and the inertia.",)

    @functools.cached_property
    def _travels(self) -> list[FloatArray]:
        return [travel_since_reversal(m.position, m.velocity, m.slow) for m in self.motions]

    def _sites(self, start: Mapping[int, float], smoothing: float) -> Sites:
        """The axis itself; `start` is the first instant of each recording [s]."""
        motions = self.motions
        lengths = np.cumsum([len(m.time) for m in motions])[:-1]

        def columns(forces: FloatArray) -> FloatArray:
            return self._filtered(np.split(-forces, lengths))

        variables = {
            name: np.concatenate([getattr(m, name) for m in motions]) for name in ("position", "velocity", "acceleration")
        }
        variables["time"] = np.concatenate([m.time - start[m.recording] for m in motions])
        variables["force"] = np.concatenate(self._smooth_forces)
        variables[TRAVEL] = np.concatenate(self._travels)
        angles = ("position",) if self.axis.kind == "rotary" and np.ptp(variables["position"]) > 2.0 * np.pi else ()
        return Sites(("axis_force",), variables, smoothing, columns, angles, max(m.slow for m in motions))

    def _contributions(
        self, effect: JointTorqueEffect, parameters: dict[str, float] | Shape, forces: Sequence[FloatArray] | None = None
    ) -> list[FloatArray]:
        """What an effect does at full rate, with the measured forces or others."""
        return [
            effect.contribution(m.position, m.velocity, force, np.zeros_like(force), parameters)
            for m, force in zip(self.motions, forces or [m.force for m in self.motions], strict=True)
        ]

    def _columns(self, effect: JointTorqueEffect, shape: Shape) -> FloatArray:
        """Exact columns (T, 1, P): what one unit of each linear parameter adds to the force the motor must give."""
        per_motion = []
        for m, force in zip(
            self.motions, self._plain_forces if _is_gain(effect) else self._smooth_forces, strict=True
        ):
            by_name = effect.regressor(m.position, m.velocity, force, np.zeros_like(force), shape)
            per_motion.append(-np.stack([by_name[p.name] for p in effect.linear_parameters], axis=1))
        return self._filtered(per_motion)[:, None, :]

    def _term(self, effect: JointTorqueEffect, smoothing: float) -> Term:
        fixed = {p.name: p.default for p in effect.nonlinear_parameters if p.default is not None}
        fixed |= {SMOOTHING: smoothing} if SMOOTHING in fixed else {}
        shapes: list[dict[str, float]] = [dict(fixed)]
        resolution: dict[str, tuple[str, float]] = {}
        periodic = None
        for parameter in effect.nonlinear_parameters:
            if parameter.name in fixed:
                continue
            grid, kind, step = self._shape_grid(parameter)
            resolution[parameter.name] = (kind, step)
            shapes = [{**shape, parameter.name: float(value)} for shape in shapes for value in grid]
            if kind == "linear":
                periodic = parameter.name

        def columns(shape: Shape) -> FloatArray:
            return self._columns(effect, shape)

        deviations = self._deviations(effect, shapes[len(shapes) // 2])
        parameters = tuple(
            LinearParameter(
                p.name, self.axis.unit(p.unit), p.lower, p.upper, deviation, refinement=p.name == "asymmetry"
            )
            for p, deviation in zip(effect.linear_parameters, deviations, strict=True)
        )
        return Term(
            effect=effect.name,
            log_prior=effect.log_prior,
            target=(TARGET,),
            unsure={p.name: self._unsure_part() for p in effect.linear_parameters} if _is_gain(effect) else {},
            parameters=parameters,
            shapes=tuple(shapes),
            columns=columns,
            arguments=kernel_arguments(effect.name),
            repeatable=periodic is not None,
            resolution=resolution,
            least={periodic: self._least_order(shapes[0][periodic])} if periodic is not None else {},
            whole=(periodic,) if periodic is not None and self.axis.kind == "rotary" else (),
            scan=(lambda: self._periodic_scan(effect, shapes, periodic)) if periodic is not None else None,
        )

    def _deviations(self, effect: JointTorqueEffect, shape: Shape) -> list[float]:
        """Prior deviation per parameter: a contribution as large as the whole measured force."""
        columns = self._columns(effect, shape)[:, 0, :]
        size = float(np.sqrt(np.mean(self._force**2)))
        return [
            size / max(float(np.sqrt(np.mean(columns[:, k] ** 2))), 1e-300) for k in range(columns.shape[1])
        ]

    def _shape_grid(self, parameter: EffectParameter) -> tuple[FloatArray, str, float]:
        """Return the grid, its kind and its spacing (a ratio for a logarithmic one) of a shaping parameter."""
        speed = np.abs(self._variables["velocity"])
        top = max(float(np.quantile(speed, 0.98)), 1e-12)
        if parameter.unit == "rad/s":
            grid = np.geomspace(0.02, 0.6, 8) * top
            return grid, "log", float(grid[1] / grid[0])
        if parameter.unit == "1/rad":
            position = self._variables["position"]
            travel = max(float(np.ptp(position)), 1e-12)
            step = np.pi / travel  # half a period over the travel
            typical = max(
                float(np.median(speed[speed > 0.05 * top])) if np.any(speed > 0.05 * top) else top, 1e-12
            )
            highest = 2.0 * np.pi * self.cutoff / typical
            grid = np.arange(3.0 * np.pi / travel, max(highest, 6.0 * np.pi / travel), step)
            if len(grid) > LARGEST_ORDER_GRID and self.axis.kind == "rotary":
                grid = np.arange(1.0, min(highest, LARGEST_ORDER_GRID))
            return grid[:LARGEST_ORDER_GRID], "linear", step
        if parameter.lower > 0.0:
            grid = np.geomspace(parameter.lower, parameter.upper, 12)
            return grid, "log", float(grid[1] / grid[0])
        grid = np.linspace(parameter.lower, parameter.upper, 12)
        return grid, "linear", float(grid[1] - grid[0])

    def _least_order(self, first: float) -> float:
        """Below what no order is searched: the first of the grid, or that of a turn where most of one was seen."""
        turns = float(np.ptp(self._variables["position"])) / (2.0 * np.pi)
        return min(first, 1.0) if self.axis.kind == "rotary" and turns > MOST_OF_A_TURN else first

    def _periodic_scan(self, effect: JointTorqueEffect, shapes: Sequence[Shape], name: str) -> FloatArray:
        """Columns of all shapes of an effect periodic in position, (T, 1, shapes, P), evaluated at the channel's rate.

        The filter's attenuation at the local frequency k v / 2 pi stands for filtering at the full rate, which for a
        thousand orders would take a minute.
        """
        if effect.name in self._scans:
            return self._scans[effect.name]
        position, velocity = self._variables["position"], self._variables["velocity"]
        force, zero = self._filtered(self._smooth_forces), np.zeros_like(position)
        width = len(effect.linear_parameters)
        scanned: FloatArray = np.empty((len(position), 1, len(shapes), width))
        for index, shape in enumerate(shapes):
            by_name = effect.regressor(position, velocity, force, zero, shape)
            attenuation = self.filters[0].gain(shape[name] * velocity / (2.0 * np.pi))
            for column, parameter in enumerate(effect.linear_parameters):
                scanned[:, 0, index, column] = -by_name[parameter.name] * attenuation
        self._scans[effect.name] = scanned
        return scanned


def travel_since_reversal(position: FloatArray, velocity: FloatArray, slow: float) -> FloatArray:
    """Return how far an axis has moved since it last turned round (T,), a speed below `slow` being no direction of motion."""
    moving = np.where(np.abs(velocity) > slow, np.sign(velocity), 0.0)
    known = np.maximum.accumulate(np.where(moving != 0.0, np.arange(len(moving)), 0))
    direction = moving[known]
    turned = np.flatnonzero(np.diff(direction)) + 1
    travel = np.empty_like(position)
    for start, stop in itertools.pairwise([0, *turned, len(position)]):
        # It turned where it was farthest back, up to where it was seen to move again.
        before = max(start - 1, 0)
        while before > 0 and moving[before] == 0.0:
            before -= 1
        ends = position[before : start + 1]
        origin = ends.min() if direction[start] > 0.0 else ends.max()
        travel[start:stop] = np.abs(position[start:stop] - origin)
    return travel


def _deviation(axis: AxisDescription, name: str, nominal: float) -> float:
    tolerance = axis.tolerance(name)
    return tolerance.value * abs(nominal) if tolerance.relative else tolerance.value


def _is_gain(effect: JointTorqueEffect) -> bool:
    return kernel_arguments(effect.name) == ("force",)


@functools.cache
def kernel_arguments(name: str) -> tuple[str, ...]:
    """Return which of position, velocity, force and normal_force the kernel of an effect depends on, by trying."""
    effect = all_effects()[name]
    assert isinstance(effect, JointTorqueEffect)
    rng = np.random.default_rng(0)
    unit = {
        p.name: (1.0 if p.linear else (p.default if p.default is not None else p.typical))
        for p in effect.parameters
    }
    arrays = [rng.uniform(0.3, 2.0, 16) * rng.choice([-1.0, 1.0], 16) for _ in range(4)]
    before = effect.contribution(arrays[0], arrays[1], arrays[2], arrays[3], unit)
    found = []
    for index, name in enumerate(("position", "velocity", "force", "normal_force")):
        changed = list(arrays)
        changed[index] = np.roll(arrays[index], 1) * 1.37
        after = effect.contribution(changed[0], changed[1], changed[2], changed[3], unit)
        if not np.array_equal(before, after):
            found.append(name)
    return tuple(found)


@functools.cache
def candidate_effects() -> tuple[JointTorqueEffect, ...]:
    """Return the effects of the vocabulary that a bench axis can have: drive torques that need no load on a wheel."""

    def suits(effect: Effect) -> bool:
        return (
            isinstance(effect, JointTorqueEffect)
            and effect.axis == "drive"
            and "normal_force" not in kernel_arguments(effect.name)
        )

    return tuple(effect for effect in all_effects().values() if suits(effect))  # type: ignore[misc]
