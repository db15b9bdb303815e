"""What the analyser solves: residual channels, what may explain them, and how far a healthy system may differ.

Along a recording the nominal model leaves a residual r (T, C). To first order

    r = N nu + sum_j Phi_j(shape_j) theta_j + noise

with nuisance columns N (the description's numbers, each known to within its tolerance: nu ~ Normal(0, sd^2)) and, for
every candidate effect j on a target, columns Phi_j that are linear in the parameters theta_j and depend on a few
shaping parameters (the speed of a Stribeck curve, the order of a cogging). A builder (bench axis, robot) writes the
problem; the engine knows nothing of axes and robots.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]
IntArray = npt.NDArray[np.int64]

# An effect smaller than this part of its prior deviation is in proportion to its size.
CURVED_FROM = 0.01
# The power of its size that an effect is in proportion to is taken from this part of it to all of it, within these.
WEAKER, POWERS = 0.8, (0.5, 3.0)
TAKEN_OVER = 1e-4  # part of its tolerance that a number keeps which an effect has taken over
NEARBY = 0.01  # part of its size by which an effect is changed for its derivative there
PROPORTIONAL = 0.01  # an effect whose work departs by less from being in proportion to its size has its derivative at it

# Tolerances beyond which a number is not a healthy system's, and beyond which none of a hundred numbers is by chance; a loose
# one lies beyond the former often, and beyond the latter where something else is wrong.
HEALTHY, STRAINED, LOOSE_STRAINED = 3.0, 4.0, 5.0

UNKNOWN = "unknown"  # reserved in the vocabulary for what no entry explains

Shape = Mapping[str, float]  # values of the shaping parameters of one candidate


@dataclasses.dataclass(frozen=True)
class Channel:
    """One residual signal, by its public name (INTERFACES section 6).

    Attributes:
        casters: it belongs to; axis: "drive", "steer", "chassis", "imu" or "clock".
        information: part of its samples' information that no other channel holds too.
    """

    name: str
    unit: str
    casters: tuple[str, ...] = ()
    axis: str = "chassis"
    information: float = 1.0


@dataclasses.dataclass(frozen=True)
class Nuisance:
    """A number of the description that a healthy system may differ in.

    Attributes:
        nominal: value in the description, in `unit`.
        deviation: standard deviation, same unit.
        column: d residual / d value, (T, C).
        changes: least and largest change that makes sense.
        loose: a healthy one may be beyond its tolerance, as of tyres: what the model misjudges of slips ends up there.
        narrowed: part of the deviation that is allowed for: where an effect is looked for behind a number that strains it, and
            `TAKEN_OVER` where an effect is named that is the same thing.
    """

    name: str
    unit: str
    nominal: float
    deviation: float
    column: FloatArray
    changes: tuple[float, float] = (-math.inf, math.inf)
    loose: bool = False
    narrowed: float = 1.0

    @property
    def healthy(self) -> float:
        """Change up to which it is that of a healthy system, same unit."""
        return math.inf if self.loose else HEALTHY * self.deviation


@dataclasses.dataclass(frozen=True)
class LinearParameter:
    """A parameter whose regression coefficient the columns belong to; a coefficient outside [lower, upper] is no explanation.

    Attributes:
        lower, upper, deviation: bounds and prior deviation of the coefficient.
        refinement: not part of the effect when it is first named; zero, or `usual`, unless there is evidence for it.
        usual: coefficient that a refinement has where nobody knows better; None: zero.
        origin: value of the parameter where the coefficient is zero.
        reciprocal: the coefficient is the inverse of the parameter's distance from `pole`, less that of the origin's;
            squared: it is its square.
        hidden: it is no number of the effect, only of how much of it there is.
        number: of the description, by the nuisance's name, in whose place the parameter stands where the effect is at work:
            its value is the number as it was re-tuned, and the coefficient besides.
        sum_of: numbers of the description, by the nuisances' names, that a unit of the parameter changes, and by how much: it
            is these changes and nothing else, and its column is the sum of theirs wherever they are taken.
    """

    name: str
    unit: str
    lower: float
    upper: float
    deviation: float
    refinement: bool = False
    usual: float | None = None
    origin: float = 0.0
    reciprocal: bool = False
    pole: float = 0.0
    squared: bool = False
    hidden: bool = False
    number: str = ""
    sum_of: tuple[tuple[str, float], ...] = ()

    def value(self, coefficient: float) -> float:
        """Return the parameter's value for a coefficient; a vanishing inverse is a very large number."""
        if self.reciprocal:
            return self.pole + 1.0 / max(coefficient + 1.0 / (self.origin - self.pole), 1e-12)
        if self.squared:
            return math.sqrt(max(coefficient, 0.0))
        return self.origin + coefficient

    def coefficient(self, value: float) -> float:
        """Return the coefficient of a value."""
        if self.squared:
            return value**2
        if self.reciprocal:
            return 1.0 / (value - self.pole) - 1.0 / (self.origin - self.pole)
        return value - self.origin

    def interval(self, low: float, high: float) -> tuple[float, float]:
        """Return the parameter's interval for one of the coefficient."""
        first, last = self.value(low), self.value(high)
        return min(first, last), max(first, last)


@dataclasses.dataclass(frozen=True)
class Term:
    """A candidate: one effect on one target.

    Attributes:
        effect: name in the vocabulary.
        target: casters, ("chassis",), ("axis",) ...
        axis: "drive" or "steer" for an effect that can stand at either joint.
        parameters: the linear ones.
        shapes: the grid of shaping parameters to begin with; one empty mapping where there are none.
        columns: shape -> (T, C, len(parameters)), the contribution to the residual per unit of each parameter.
        arguments: names of the problem's variables that the contribution depends on.
        repeatable: several instances with different shapes may be at work at once (harmonics of a cogging).
        resolution: spacing of `shapes` per shaping parameter; local search stays within it.
        least: values of shaping parameters below which they are not searched, by name: a wave of which little more than a
            period was seen is any slow change.
        settled: shaping parameters that are as usual until the search has ended, and then where the model's slopes lead:
            spacing, least and largest value by name.
        blur: by how much shaping parameters are uncertain besides what noise does: standard deviations by name.
        unsure: by which parts of themselves linear parameters are.
        scan: cheaper, slightly inexact columns of all `shapes` at once, (T, C, len(shapes), len(parameters)), where the
            grid is long; None uses `columns`.
        grid_size: how many shapes `shapes` were chosen from, where a first look has narrowed them down.
        log_prior: of the effect (see there), part of every evidence.
        whole: shaping parameters that are whole numbers unless the recording says otherwise (periods per turn).
        is_exact: the problem's exact residual holds it; is_curved: and it is not in proportion to its parameters.
        at_joints: it adds torques to joints, in proportion to its parameters.
        turning: a phase or a direction shapes it, of which two a quarter turn apart make all others.
        noisy: its columns hold some of the noise that the residual holds, by the control that acts on that noise.
        unlike_errors: it turns with the angle of its own joint, changes sides with the torque of its gear, or goes with the
            square and the change of the rate of turning, as nothing does that the model misjudges.
        once: it is at work at one time, or one place, only: judged there, and no other part of a recording can foretell it.
        recording: the only one in which it is at work; None: it is in all, at the same time.
        law: the very law outside the library that it is, of which there may be several of the same arguments; None of effects.
        headed: changes of the nuisances by name -> its columns where these turn, or tilt, what it is a function of; None where
            they hardly do. None where it is a function of nothing that is re-tuned.
    """

    effect: str
    target: tuple[str, ...]
    parameters: tuple[LinearParameter, ...]
    shapes: tuple[Shape, ...]
    columns: Callable[[Shape], FloatArray]
    arguments: tuple[str, ...] = ()
    repeatable: bool = False
    resolution: Mapping[str, tuple[str, float]] = dataclasses.field(default_factory=dict)
    least: Mapping[str, float] = dataclasses.field(default_factory=dict)
    settled: Mapping[str, tuple[float, float, float]] = dataclasses.field(default_factory=dict)
    blur: Mapping[str, float] = dataclasses.field(default_factory=dict)
    unsure: Mapping[str, float] = dataclasses.field(default_factory=dict)
    scan: Callable[[], FloatArray] | None = None
    grid_size: int = 0
    log_prior: float = 0.0
    axis: str | None = None
    whole: tuple[str, ...] = ()
    is_exact: bool = False
    is_curved: bool = False
    at_joints: bool = False
    turning: bool = False
    noisy: bool = False
    unlike_errors: bool = False
    once: bool = False
    recording: int | None = None
    law: object | None = None
    headed: Callable[[Mapping[str, float]], Callable[[Shape], FloatArray] | None] | None = None

    @property
    def key(self) -> str:
        """Short label for logs and tables."""
        return term_key(self.effect, self.target, self.axis, self.recording, self.arguments)

    def base_indices(self) -> tuple[int, ...]:
        """Positions of the parameters that are not refinements."""
        return tuple(i for i, parameter in enumerate(self.parameters) if not parameter.refinement)


def term_key(
    effect: str, target: Sequence[str], axis: str | None = None, recording: int | None = None, arguments: Sequence[str] = ()
) -> str:
    """Return the key of the term of an effect; `arguments` tell one unknown law from another."""
    place = f"{axis} of " if axis else ""
    occasion = "" if recording is None else f" in recording {recording + 1}"
    law = f" by {', '.join(arguments)}" if effect == UNKNOWN else ""
    return f"{effect}/{place}{'+'.join(target)}{law}{occasion}"


@dataclasses.dataclass(frozen=True)
class SizedTerm:
    """A term of a problem at work: with a shape, and with coefficients of all its parameters (P,).

    Refinements whose positions are not among the `active` ones are as they usually are.
    """

    term: int
    shape: tuple[tuple[str, float], ...]
    coefficients: FloatArray
    active: tuple[int, ...]

    def values(self, parameters: Sequence[LinearParameter]) -> dict[str, float]:
        """Return the values of the term's parameters, by name."""
        sizes = (
            float(size) if k in self.active else p.usual or 0.0
            for k, (p, size) in enumerate(zip(parameters, self.coefficients, strict=True))
        )
        return {p.name: p.value(size) for p, size in zip(parameters, sizes, strict=True)}


@dataclasses.dataclass(frozen=True)
class Point:
    """Where a problem is exact: changes of nuisances, by name, and sizes of effects; whether its columns are of there, too."""

    changes: Mapping[str, float]
    sizes: tuple[SizedTerm, ...]
    derived: bool = False


@dataclasses.dataclass(frozen=True)
class _NearSecant:
    """Columns of a term by its derivatives: times `factor` (P,), and `rest` (T, C, P)."""

    factor: FloatArray
    rest: FloatArray

    def column(self, slope: FloatArray) -> FloatArray:
        """Return the columns (T, C, P) for derivatives (T, C, P)."""
        return self.factor * slope + self.rest


@dataclasses.dataclass(frozen=True)
class Sites:
    """Where a torque or force may act that no effect of the library describes.

    Attributes:
        names: of the sites, as channels are named: `drive_torque/<caster>`, `steer_torque/<caster>`, `chassis_force/x|y` and
            `chassis_torque/z` in base_link, or `axis_force`.
        variables: what it may depend on: name -> (N,), at the rate at which the model is evaluated; names as those of
            `RegressionProblem.variables`.
        angles: those of them that come round again after a turn.
        slow: speed from which on the direction of a bench axis is sure.
        smoothing: speed over which the sign of a joint's speed reverses, as in the library's frictions [rad/s].
        columns: torques and forces (N, len(names), K) -> what they add to the residual (T, C, K).
    """

    names: tuple[str, ...]
    variables: Mapping[str, FloatArray]
    smoothing: float
    columns: Callable[[FloatArray], FloatArray]
    angles: tuple[str, ...] = ()
    slow: float = 0.0


@dataclasses.dataclass(frozen=True)
class RegressionProblem:
    """Residuals and what may explain them, all on one regular time grid per segment.

    Attributes:
        time: stamps (T,) [s], from the start of each recording.
        segment: index of the contiguous piece of each sample (T,); filters never cross a border.
        recording: index of the recording of each sample (T,).
        rate: samples per second.
        measured: the measured side of each channel (T, C), for error ratios; residual = measured - predicted.
        valid: samples that may be judged (T, C).
        variables: what a leftover may depend on: name -> (T,).
        misjudged: standard deviation of what the model itself may misjudge in each sample, besides noise (T, C); None: of
            none. misjudged_slips: of that what it may misjudge of slips, where a residual shows how much of it there is.
        scale_deviation: relative deviation of the measured side that no nuisance holds; what is measured against it is
            known no better, and an effect that is no larger and looks alike is not told from it.
        drifts: columns (T, C, K) of the model's own errors, which may vary slowly; None: no effect looks otherwise than these.
        sites: where an unknown torque or force may act; None where nothing measured would show it.
        wheel_places: of the wheels in the world (T, n, 2) [m]; None where nothing rolls.
        exact: (changes of nuisances by name, sizes of effects) -> residual (T, C) of the model with all of them at work, and
            the names of the nuisances that it holds; None from it where there is no such model, and instead of it where the
            columns are exact everywhere.
        derive: (changes, sizes) -> columns of nuisances there, by name; None where `exact` is.
        softened: changes -> factors (C,) on what torques do to each channel where the tyres are as soft as these changes make
            them, and names of the nuisances that are torques; None where nothing rolls.
        soft: the factors (C,) that torques have now; None: those of the description.
        nominal: residual of the description as it is, where `residual` is exact elsewhere; point: where.
        powers: of parameters of effects (term, shape, position) that what they do there is in proportion to, where not to
            the parameters themselves.
        remarks: what a reader has to know of the recordings.
        apart: whether each channel has effects of its own, those of one joint.
        shaken: whether one of these is that wheels shake; limited: whether one is that torques use up their friction.
        near: how columns of a term follow from its derivatives, by term; see `around`.
    """

    channels: tuple[Channel, ...]
    time: FloatArray
    segment: IntArray
    recording: IntArray
    rate: float
    measured: FloatArray
    residual: FloatArray
    valid: BoolArray
    nuisances: tuple[Nuisance, ...]
    terms: tuple[Term, ...]
    variables: Mapping[str, FloatArray]
    misjudged: FloatArray | None = None
    misjudged_slips: FloatArray | None = None
    scale_deviation: float = 0.0
    drifts: FloatArray | None = None
    sites: Sites | None = None
    wheel_places: FloatArray | None = None
    exact: Callable[[Mapping[str, float], Sequence[SizedTerm]], tuple[FloatArray, Sequence[str]] | None] | None = None
    derive: Callable[[Mapping[str, float], Sequence[SizedTerm]], Mapping[str, FloatArray] | None] | None = None
    softened: Callable[[Mapping[str, float]], tuple[FloatArray, Sequence[str]]] | None = None
    soft: FloatArray | None = None
    nominal: FloatArray | None = None
    point: Point | None = None
    powers: Mapping[tuple[int, tuple[tuple[str, float], ...], int], float] = dataclasses.field(default_factory=dict)
    remarks: tuple[str, ...] = ()
    apart: bool = False
    shaken: bool = False
    limited: bool = False
    near: Mapping[int, _NearSecant] = dataclasses.field(default_factory=dict)
    _remembered: dict[tuple[int, tuple[tuple[str, float], ...]], FloatArray] = dataclasses.field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        """Check shapes once, so that the engine need not.

        Raises:
            ValueError: arrays that do not fit together.
        """
        shape = (len(self.time), len(self.channels))
        for name in ("measured", "residual", "valid"):
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape} instead of {shape}")
        for nuisance in self.nuisances:
            if nuisance.column.shape != shape:
                raise ValueError(
                    f"nuisance {nuisance.name} has shape {nuisance.column.shape} instead of {shape}"
                )
        if not np.isfinite(self.residual[self.valid]).all():
            raise ValueError("residual holds NaN at samples said to be valid")

    def columns(self, term: int, shape: tuple[tuple[str, float], ...]) -> FloatArray:
        """Columns (T, C, P) of one term at one shape, computed once."""
        if (term, shape) not in self._remembered:
            self._remembered[term, shape] = self.tried_columns(term, shape)
        return self._remembered[term, shape]

    def tried_columns(self, term: int, shape: tuple[tuple[str, float], ...]) -> FloatArray:
        """The same, not remembered: of a shape that a search only tries."""
        if (term, shape) in self._remembered:
            return self._remembered[term, shape]
        found = self._with_sums(term, self.terms[term].columns(dict(shape)))
        return self.near[term].column(found) if term in self.near else found

    def _with_sums(self, term: int, columns: FloatArray) -> FloatArray:
        """Columns (T, C, P) of a term in which parameters that are numbers of the description have those numbers' columns.

        Differences of two steps, or of two places, would leave a rest between them: beside precise sensors that is an effect.
        """
        sums = self._sums[term]
        if not sums:
            return columns
        columns = columns.copy()
        for k, parts in sums.items():
            columns[:, :, k] = sum(factor * self.nuisances[number].column for number, factor in parts)
        return columns

    @functools.cached_property
    def _sums(self) -> list[dict[int, list[tuple[int, float]]]]:
        """Of each term the parameters that are numbers of the description, by position, with positions of the numbers."""
        place = {nuisance.name: j for j, nuisance in enumerate(self.nuisances)}
        return [
            {
                k: [(place[name], factor) for name, factor in parameter.sum_of]
                for k, parameter in enumerate(term.parameters)
                if parameter.sum_of and all(name in place for name, _ in parameter.sum_of)
            }
            for term in self.terms
        ]

    def around(self, term: int, shape: tuple[tuple[str, float], ...]) -> RegressionProblem:
        """Return the problem with columns of a term that may be compared with its secant at the shape where it is exact.

        Elsewhere a column is a derivative, and against a secant each of these would lose, however little its shape differs.
        They get what the secant has over the derivative: the factor of a law of another power, and what that leaves, which is
        right near the shape.
        """
        if self.point is None or (term, shape) not in {(size.term, size.shape) for size in self.point.sizes}:
            return self
        secant, slope = self.columns(term, shape), self._with_sums(term, self.terms[term].columns(dict(shape)))
        if np.array_equal(secant, slope):
            return self
        factor = np.sum(secant * slope, axis=(0, 1)) / np.maximum(np.sum(slope**2, axis=(0, 1)), 1e-300)
        moved = dataclasses.replace(self, near={**self.near, term: _NearSecant(factor, secant - factor * slope)})
        moved._remembered.update(self._without(term))
        moved._remembered[term, shape] = secant
        return moved

    def _without(self, *terms: int) -> dict[tuple[int, tuple[tuple[str, float], ...]], FloatArray]:
        """Columns that were computed, except those of these terms."""
        return {key: columns for key, columns in self._remembered.items() if key[0] not in terms}

    def with_terms(self, terms: Sequence[Term]) -> RegressionProblem:
        """Return the problem with further terms after its own; columns that were computed are kept."""
        wider = dataclasses.replace(self, terms=(*self.terms, *terms))
        wider._remembered.update(self._remembered)
        return wider

    def exact_at(self, changes: Mapping[str, float], sizes: Sequence[SizedTerm]) -> RegressionProblem:
        """Return the problem with a residual that the columns explain exactly where numbers and effects are of these sizes.

        Columns are derivatives at the description. To the residual of the model there, r(x), is added what the columns take:
        r(x) + J x. A fit that comes out at x has then found a minimum of the model itself, not of its first order. An effect
        that is not in proportion to its size has a secant for a column instead, from none of it to its size: the problem is
        then exact with and without it.

        Args:
            changes: of the nuisances, by name.
            sizes: of the effects at work.
        """
        if self.exact is None:
            return self
        known = {nuisance.name: nuisance for nuisance in self.nuisances}
        changes = {name: change for name, change in changes.items() if name in known}
        found = self.exact(changes, self._held(sizes))
        if found is None:
            return self
        residual, taken = found
        columns: dict[tuple[int, tuple[tuple[str, float], ...]], FloatArray] = {}
        powers: dict[tuple[int, tuple[tuple[str, float], ...], int], float] = {}
        for index, size in enumerate(sizes):
            if self._holds(size):
                place = size.term, size.shape
                columns[place], found_powers = self._secants(changes, sizes, index, residual)
                powers |= {(*place, k): power for k, power in found_powers.items()}
        for name in taken:
            residual = residual + known[name].column * changes[name]
        for size in sizes:
            if (size.term, size.shape) in columns:
                residual = residual + columns[size.term, size.shape] @ size.coefficients
        moved = dataclasses.replace(
            self,
            residual=residual,
            nominal=self.nominal_residual,
            powers=powers,
            near={},
            point=Point(dict(changes), tuple(sizes), self.point is not None and self.point.derived),
        )
        moved._remembered.update(self._without(*self.near))
        moved._remembered.update(columns)
        return moved

    def derived(self) -> RegressionProblem:
        """Return the problem with the nuisances' columns as they are where it is exact, instead of at the description."""
        if self.derive is None or self.point is None:
            return self
        columns = self.derive(self.point.changes, self._held(self.point.sizes))
        if columns is None:
            return self
        numbers = tuple(dataclasses.replace(n, column=columns.get(n.name, n.column)) for n in self.nuisances)
        moved = dataclasses.replace(self, nuisances=numbers, point=dataclasses.replace(self.point, derived=True))
        moved._remembered.update(self._without(*(k for k, parameters in enumerate(self._sums) if parameters)))
        residual = self.residual
        for old, new in zip(self.nuisances, numbers, strict=True):
            residual = residual + (new.column - old.column) * self.point.changes.get(old.name, 0.0)
        for size in self._held(self.point.sizes):
            if self._sums[size.term]:
                before, now = (problem.columns(size.term, size.shape) for problem in (self, moved))
                residual = residual + (now - before) @ size.coefficients
        there = dataclasses.replace(moved, residual=residual)
        there._remembered.update(moved._remembered)
        return there

    def with_headings(self, changes: Mapping[str, float]) -> RegressionProblem:
        """Return the problem in which effects are those of headings and a floor as these changes turn and tilt them.

        A zero that is off by what may be turns a ripple of a high order by more than a right angle: what is one effect of all
        casters would be another one of each, and none of them where the problem is exact. An IMU's error is one of what a
        leaning floor adds, too.
        """
        headed = {k: term.headed(changes) for k, term in enumerate(self.terms) if term.headed is not None}
        turned = {k: columns for k, columns in headed.items() if columns is not None}
        if not turned:
            return self
        terms = tuple(
            dataclasses.replace(term, columns=turned[k]) if k in turned else term for k, term in enumerate(self.terms)
        )
        moved = dataclasses.replace(self, terms=terms)
        moved._remembered.update(self._without(*turned))
        return moved

    def with_soft_tyres(self) -> RegressionProblem:
        """Return the problem in which torques, whatever they are of, make tyres slip that are as soft as it is exact at.

        How soft tyres are nobody knows to a third, and so little is it known in the columns of the description.
        """
        if self.softened is None or self.point is None:
            return self
        factors, numbers = self.softened(self.point.changes)
        residual, nuisances = self.residual, []
        for nuisance in self.nuisances:
            column = nuisance.column * factors if nuisance.name in numbers else nuisance.column
            residual = residual + (column - nuisance.column) * self.point.changes.get(nuisance.name, 0.0)
            nuisances.append(dataclasses.replace(nuisance, column=column))
        terms = tuple(
            dataclasses.replace(
                term, columns=_multiplied(term.columns, factors[:, None]),
                scan=None if term.scan is None else _multiplied(term.scan, factors[:, None, None]),
            ) if term.at_joints else term
            for term in self.terms
        )  # fmt: skip
        sites = self.sites
        if sites is not None:
            sites = dataclasses.replace(sites, columns=_multiplied(sites.columns, factors[:, None]))
        drifts = None if self.drifts is None else self.drifts * factors[:, None]
        moved = dataclasses.replace(
            self, residual=residual, nuisances=tuple(nuisances), terms=terms, sites=sites, drifts=drifts, soft=factors
        )
        moved._remembered.update(self._without(*(k for k, term in enumerate(terms) if term is not self.terms[k])))
        return moved

    def with_laws_at(self, changes: Mapping[str, float]) -> RegressionProblem:
        """Return the problem in which new laws make tyres slip that are as soft as these changes make them.

        Without a large law the tyres come out too soft for its sake.
        """
        if self.softened is None or self.soft is None or self.sites is None:
            return self
        factors, _ = self.softened(changes)
        sites = dataclasses.replace(self.sites, columns=_multiplied(self.sites.columns, (factors / self.soft)[:, None]))
        moved = dataclasses.replace(self, sites=sites, soft=factors)
        moved._remembered.update(self._remembered)
        return moved

    def tangent(self) -> RegressionProblem:
        """Return the problem with all columns as they are where it is exact, for what numbers are known to there.

        By a secant an effect differs from the number of the description that does the same: with precise sensors it would be
        told from that number's tolerance by nothing but its curvature.
        """
        sizes = () if self.point is None else self.point.sizes
        curved = [(index, size) for index, size in enumerate(sizes) if self._holds(size) and self.terms[size.term].is_curved]
        if self.point is None or not curved:
            return self
        problem, at = self.derived(), (self.point.changes, sizes)
        residual, found = problem.residual, {}
        for index, size in curved:
            before = problem.columns(size.term, size.shape)
            columns = before.copy()
            parameters = self.terms[size.term].parameters
            for k, (parameter, coefficient) in enumerate(zip(parameters, size.coefficients, strict=True)):
                if abs(coefficient) < CURVED_FROM * parameter.deviation or k in self._sums[size.term]:
                    continue
                less, more = (self._left(*at, index, k, part) for part in (1.0 - NEARBY, 1.0 + NEARBY))
                if less is not None and more is not None:
                    columns[:, :, k] = (less - more) / (2.0 * NEARBY * coefficient)
            found[size.term, size.shape] = columns
            residual = residual + (columns - before) @ size.coefficients
        moved = dataclasses.replace(problem, residual=residual, powers={})
        moved._remembered.update(problem._remembered | found)
        return moved

    def change_between(
        self, size: SizedTerm, less: tuple[tuple[str, float], ...], more: tuple[tuple[str, float], ...]
    ) -> FloatArray | None:
        """What an effect does to the residual with the shape `more` beyond what it does with `less`, (T, C).

        Of one that is not in proportion to its size it is the model's own, where the problem is exact; None where it has none.
        """
        places = [(other.term, other.shape) for other in (() if self.point is None else self.point.sizes)]
        curved = self._holds(size) and self.terms[size.term].is_curved and (size.term, size.shape) in places
        if self.exact is None or self.point is None or not curved:
            first, last = (self.tried_columns(size.term, shape) @ size.coefficients for shape in (less, more))
            return last - first
        index, sizes = places.index((size.term, size.shape)), list(self.point.sizes)
        left = []
        for shape in (less, more):
            there = [*sizes[:index], dataclasses.replace(sizes[index], shape=shape), *sizes[index + 1 :]]
            found = self.exact(self.point.changes, self._held(there))
            if found is None:
                return None
            left.append(found[0])
        return left[0] - left[1]

    def with_secants(self, term: int, shape: tuple[tuple[str, float], ...]) -> RegressionProblem:
        """Return the problem in which one effect's columns are the model's own, in whatever shape, at the size that it has.

        Of what is not in proportion to its size a first order says little as soon as its shape is another one. Only of an
        effect of one parameter, with this shape where the problem is exact; otherwise it is this problem.
        """
        sizes = () if self.point is None else self.point.sizes
        size = next((s for s in sizes if (s.term, s.shape) == (term, shape) and self._holds(s) and s.coefficients[0]), None)
        if self.exact is None or self.point is None or size is None or len(size.coefficients) > 1:
            return self
        changes, others = self.point.changes, self._held([other for other in sizes if other is not size])
        without, exact, own = self.exact(changes, others), self.exact, self.terms[term]
        if without is None:
            return self

        def columns(shape: Shape) -> FloatArray:
            there = dataclasses.replace(size, shape=tuple(sorted(shape.items())))
            found = exact(changes, [*others, there])
            return own.columns(shape) if found is None else ((without[0] - found[0]) / size.coefficients[0])[:, :, None]

        terms = tuple(dataclasses.replace(t, columns=columns) if t is own else t for t in self.terms)
        near = {other: secant for other, secant in self.near.items() if other != term}
        moved = dataclasses.replace(self, terms=terms, near=near)
        moved._remembered.update(self._without(term))
        return moved

    def _holds(self, size: SizedTerm) -> bool:
        """Whether the exact residual holds an effect; laws that came later are not in it."""
        return size.term < len(self.terms) and self.terms[size.term].is_exact

    def _held(self, sizes: Sequence[SizedTerm]) -> list[SizedTerm]:
        return [size for size in sizes if self._holds(size)]

    def _left(
        self, changes: Mapping[str, float], sizes: Sequence[SizedTerm], index: int, k: int, part: float
    ) -> FloatArray | None:
        """Residual (T, C) of the model with a part of one parameter of one effect, and all others at work."""
        assert self.exact is not None
        coefficients = sizes[index].coefficients.copy()
        coefficients[k] *= part
        others = [*sizes[:index], dataclasses.replace(sizes[index], coefficients=coefficients), *sizes[index + 1 :]]
        found = self.exact(changes, self._held(others))
        return None if found is None else found[0]

    def _secants(
        self, changes: Mapping[str, float], sizes: Sequence[SizedTerm], index: int, residual: FloatArray
    ) -> tuple[FloatArray, dict[int, float]]:
        """Columns (T, C, P) of one effect from none of it to its size, where that tells more than its derivative there.

        With them the powers of the parameters that what the effect does is in proportion to there.
        """
        size = sizes[index]
        term, columns = self.terms[size.term], self.columns(size.term, size.shape)
        powers: dict[int, float] = {}
        if not term.is_curved:
            return columns, powers
        columns = columns.copy()
        for k, (parameter, coefficient) in enumerate(zip(term.parameters, size.coefficients, strict=True)):
            if abs(coefficient) < CURVED_FROM * parameter.deviation or k in self._sums[size.term]:
                continue
            without, weaker = (self._left(changes, sizes, index, k, part) for part in (0.0, WEAKER))
            if without is None or weaker is None:
                continue
            work = without - residual
            columns[:, :, k] = work / coefficient
            ratio = float(np.sum(work * (without - weaker))) / max(float(np.sum(work**2)), 1e-300)
            if abs(ratio - WEAKER) < PROPORTIONAL * WEAKER:
                # So the number of the description that does the same work keeps the same column, and each its own share of it.
                columns[:, :, k] = (weaker - residual) / ((1.0 - WEAKER) * coefficient)
            if ratio > 0.0:
                powers[k] = float(np.clip(math.log(ratio) / math.log(WEAKER), *POWERS))
        return columns, powers

    @property
    def nominal_residual(self) -> FloatArray:
        """What the description as it is leaves (T, C)."""
        return self.residual if self.nominal is None else self.nominal

    def nuisance_columns(self) -> FloatArray:
        """Nuisance columns side by side, (T, C, K), not to be changed."""
        return self._stacked

    @functools.cached_property
    def _stacked(self) -> FloatArray:
        if not self.nuisances:
            return np.zeros((*self.residual.shape, 0))
        return np.stack([nuisance.column for nuisance in self.nuisances], axis=2)

    def nuisance_deviations(self) -> FloatArray:
        """Tolerances (K,) that are allowed for."""
        return np.array([nuisance.deviation * nuisance.narrowed for nuisance in self.nuisances])

    def narrowed(self, parts: Mapping[str, float]) -> RegressionProblem:
        """Return the problem with parts of the tolerances of some numbers, by name."""
        numbers = tuple(dataclasses.replace(n, narrowed=parts.get(n.name, n.narrowed)) for n in self.nuisances)
        narrower = dataclasses.replace(self, nuisances=numbers)
        narrower._remembered.update(self._remembered)
        return narrower


def _multiplied(columns: Callable[..., FloatArray], factors: FloatArray) -> Callable[..., FloatArray]:
    """The function of columns with factors on what it returns."""
    return lambda *arguments: columns(*arguments) * factors


def segment_slices(segment: IntArray) -> list[slice]:
    """Return the slices of constant `segment`, in order."""
    borders = np.flatnonzero(np.diff(segment)) + 1
    edges = [0, *borders.tolist(), len(segment)]
    return [slice(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True) if b > a]


def contiguous_blocks(segment: IntArray, count: int) -> IntArray:
    """Cut the samples into about `count` blocks of equal length that never cross a segment border, (T,)."""
    block = np.zeros(len(segment), dtype=np.int64)
    length = max(1, len(segment) // max(1, count))
    next_block = 0
    for piece in segment_slices(segment):
        size = piece.stop - piece.start
        parts = max(1, round(size / length))
        block[piece] = next_block + (np.arange(size) * parts) // size
        next_block += parts
    return block
