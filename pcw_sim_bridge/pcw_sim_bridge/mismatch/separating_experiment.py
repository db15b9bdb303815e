"""Which manoeuvre would tell two sets of effects apart, predicted by driving it in simulation.

With the effect A at work the whitened residual of a recording is, to first order,

    y = X_a theta_a + N nu + e,      nu ~ Normal(0, D),  e ~ Normal(0, 1),

N the columns of what a healthy robot may differ in. A set S of columns (N, those of one effect, those of others that are
known to be there) explains it with the evidence of `whitened_regression`; over nu and e its expectation is

    E[log p(y | S)] = -1/2 (log|A_S| + log|D_S|) - 1/2 (theta_a^T K theta_a + tr D K_nn) + const,
    A_S = S^T S + D_S^-1,   K = X^T X - X^T S A_S^-1 S^T X.

theta_a^T K theta_a is what no combination of S can explain. The expected evidence for A against B is the difference of the
two, all from one Gram matrix per manoeuvre; and it is asked both ways, since either may be true.

The robot is simulated with A at work, so that what the manoeuvre can show, its noise and the samples that cannot be judged
are those of a recording. What the model of the channels itself misjudges counts as noise.
"""

from __future__ import annotations

import dataclasses
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from pcw_control.errors import ControlError
from pcw_control.excitation import EXCITATIONS, Excitation, make_excitation
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import get
from pcw_description.robot_description import ImuDescription, RobotDescription, TrackerDescription

from ..simulated_run import record_run
from .analysis import LEAST_DURATION
from .errors import MismatchError
from .regression.noise_model import NoiseModel, fit_noise_model
from .regression.regression_problem import FloatArray, RegressionProblem, Shape, Term
from .subjects.robot_subject import RobotSubject

# Evidence to plan for [nats]. The analyser calls sets within 3 nats look-alikes, and the evidence that one recording gives
# scatters by sqrt(2 times its expectation): of 15 nats expected, 99 of 100 recordings give more than 3.
WANTED = 15.0
TRIAL_DURATION = 20.0  # [s]; what a manoeuvre gives is about proportional to its length
LONGEST = 600.0  # [s]; nobody drives longer to settle a doubt
# A load that a person can carry, near a corner and low [m].
LOAD_SHARE, LOAD_REACH, LOAD_HEIGHT = 0.15, 0.8, 0.3
# Sensors of a common kind, for robots without, to say whether they would help.
COMMON_IMU = ImuDescription((0.0, 0.0, 0.1), 200.0, 2e-3, 0.02)
COMMON_TRACKER = TrackerDescription(100.0, 1e-3, 1e-3)

Progress = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Doubt:
    """Two readings of the same recordings.

    Attributes:
        first: the effect that was named, with its size.
        second: name of the other effect; second_target: where, None for anywhere.
        second_size: its parameters; None: as large as makes it most alike.
    """

    first: EffectInstance
    second: str
    second_target: tuple[str, ...] | None = None
    second_size: Mapping[str, float] | None = None

    def words(self) -> str:
        """Say what is to be told from what."""
        return f"{_words(self.first.name, self.first.target)} from {_words(self.second, self.second_target)}"


def _words(name: str, target: tuple[str, ...] | None) -> str:
    return name if target is None else f"{name} on {' and '.join(target)}"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a manoeuvre would give.

    Attributes:
        nats: expected evidence of the worst doubt, whichever of its effects is true, in a recording of `duration`.
        usable: seconds of it that can be judged.
    """

    excitation: str
    duration: float
    nats: float
    usable: float

    @property
    def needed(self) -> float:
        """Length that gives the wanted evidence, no shorter than the trial [s]."""
        return max(1.0, WANTED / self.nats) * self.duration if self.nats > 0.0 else math.inf

    @property
    def separates(self) -> bool:
        """Whether anybody would drive that long."""
        return self.needed <= LONGEST


def trial_excitations(robot: RobotDescription) -> Iterator[Excitation]:
    """Yield every excitation on the ground, as short as says something.

    Lifted ones have no channels of forces, and `holdout` stays for the proof.
    """
    for name, plan in EXCITATIONS.items():
        if plan.lifted or name == "holdout":
            continue
        try:
            yield make_excitation(name, robot, TRIAL_DURATION)
        except ControlError:  # longer than that
            yield make_excitation(name, robot)


def rank(
    robot: RobotDescription,
    doubts: Sequence[Doubt],
    others: Sequence[EffectInstance] = (),
    noise_floor: Mapping[str, float] | None = None,
    excitations: Iterable[Excitation] | None = None,
    progress: Progress = lambda message: None,
) -> list[Outcome]:
    """Return what every manoeuvre would give, the shortest way to certainty first.

    Args:
        robot: the robot as described.
        doubts: all to be settled by one manoeuvre.
        others: effects that are known to be there besides.
        noise_floor: rms of the noise that a recording of the real robot showed, by channel; the simulated one counts where
            it is louder.
        excitations: to try; default: `trial_excitations`.
        progress: is told what is being done.

    Raises:
        MismatchError: an effect that no channel of this robot shows.
    """
    at_work = list(others)
    at_work += [doubt.first for k, doubt in enumerate(doubts) if doubt.first not in [d.first for d in doubts[:k]]]
    trials = []
    for excitation in trial_excitations(robot) if excitations is None else excitations:
        progress(f"{excitation.name}, {excitation.duration:g} s, in simulation")
        problem = simulated_problem(robot, at_work, excitation)
        if problem is not None:
            trials.append(_Trial.of(excitation, problem, at_work, noise_floor or {}))
    if not trials:
        raise MismatchError("no manoeuvre gives this robot usable motion: nothing can be compared")
    nats = np.full((len(trials), len(doubts)), math.inf)
    for k, doubt in enumerate(doubts):
        known = [effect for effect in at_work if effect != doubt.first]
        second = _second(trials, doubt, known)
        for t, trial in enumerate(trials):
            nats[t, k] = trial.evidence(doubt, second, known)
    outcomes = [
        Outcome(trial.excitation.name, round(trial.excitation.duration, 6), float(worst), trial.usable)
        for trial, worst in zip(trials, nats.min(axis=1), strict=True)
    ]
    # Of those that are enough the one that moves everything: in a plainer one a third effect may look like both.
    return sorted(outcomes, key=lambda outcome: (outcome.needed, outcome.excitation != "identification", -outcome.nats))


def simulated_problem(
    robot: RobotDescription, effects: Sequence[EffectInstance], excitation: Excitation
) -> RegressionProblem | None:
    """Drive an excitation with effects at work and return what the analyser would make of the recording.

    None where the robot does not move in a way that can be judged for `LEAST_DURATION`.
    """
    true_robot = dataclasses.replace(robot, physics=(*robot.physics, *effects))
    believed = dataclasses.replace(robot, physics=())
    with tempfile.TemporaryDirectory(prefix="pcw_suggest_") as folder:
        path = Path(folder) / excitation.name
        record_run(true_robot, excitation.twist, excitation.duration, 0, path, "reduced", controlled_as=believed)
        subject = RobotSubject(robot)
        problem = subject.problem([subject.open(path, "fit", {})])
    usable = float(problem.valid.any(axis=1).sum()) / problem.rate
    return problem if usable >= LEAST_DURATION else None


@dataclasses.dataclass(frozen=True)
class _Columns:
    """Whitened columns (R, P) of an effect with one shape, their prior deviations (P,) and log prior."""

    values: FloatArray
    deviations: FloatArray
    log_prior: float


@dataclasses.dataclass(frozen=True)
class _Truth:
    """An effect with its size: a term by its key, its shape, and the values of its linear parameters by name."""

    key: str
    shape: Shape
    size: Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class _Trial:
    """One manoeuvre as the analyser sees it, whitened.

    Attributes:
        weights: root of the information of each sample, in parts of what its whitened noise says (T, C).
        nuisance: whitened nuisance columns (R, K).
        usable: seconds that can be judged.
    """

    excitation: Excitation
    problem: RegressionProblem
    noise: NoiseModel
    weights: FloatArray
    nuisance: FloatArray
    usable: float

    @classmethod
    def of(
        cls,
        excitation: Excitation,
        problem: RegressionProblem,
        effects: Sequence[EffectInstance],
        noise_floor: Mapping[str, float],
    ) -> _Trial:
        noise, weights = _noise(problem, effects, noise_floor)
        usable = float(problem.valid.any(axis=1).sum()) / problem.rate
        trial = cls(excitation, problem, noise, weights, np.zeros((0, 0)), usable)
        return dataclasses.replace(trial, nuisance=trial.whitened(problem.nuisance_columns()))

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Whiten columns (T, C, K) and put them on end, (T C, K)."""
        white = self.noise.whiten(columns, self.problem.valid, self.problem.segment) * self.weights[..., None]
        return white.reshape(-1, columns.shape[2])

    def columns(self, term: Term, shape: Shape, names: Sequence[str] | None = None) -> _Columns:
        """Columns of a term with a shape: of the parameters named, default: all that are no refinement."""
        wanted = [k for k, p in enumerate(term.parameters) if (not p.refinement if names is None else p.name in names)]
        values = self.whitened(term.columns(dict(shape))[..., wanted])
        return _Columns(values, np.array([term.parameters[k].deviation for k in wanted]), term.log_prior)

    def evidence(self, doubt: Doubt, second: _Truth, known: Sequence[EffectInstance]) -> float:
        """Least expected evidence for the truth [nats], whichever of the two it is."""
        terms = [_term_of(self.problem, effect) for effect in known]
        parts = [self.columns(t, _shape(t, effect.parameters)) for t, effect in zip(terms, known, strict=True)]
        base = _Columns(
            np.concatenate([self.nuisance, *(part.values for part in parts)], axis=1),
            np.concatenate([self.problem.nuisance_deviations(), *(part.deviations for part in parts)]),
            0.0,
        )
        term = _term_of(self.problem, doubt.first)
        first = _Truth(term.key, _shape(term, doubt.first.parameters), doubt.first.parameters)
        alone = self.rivals(doubt, known)
        rivals = [self.columns(*rival) for rival in alone] + self._on_both_axes(alone)
        mirrored = [self.columns(term, shape) for shape in (first.shape, *term.shapes)]
        return min(self._difference(base, first, rivals), self._difference(base, second, mirrored))

    def _on_both_axes(self, rivals: Sequence[tuple[Term, Shape, list[str] | None]]) -> list[_Columns]:
        """The rivals that stand at both axes of the same casters together, for every target with two."""
        first: dict[tuple[str, ...], dict[str, _Columns]] = {}
        for term, shape, names in rivals:
            own = first.setdefault(term.target, {})
            if term.key not in own:
                own[term.key] = self.columns(term, shape, names)
        return [
            _Columns(
                np.concatenate([part.values for part in parts.values()], axis=1),
                np.concatenate([part.deviations for part in parts.values()]),
                sum(part.log_prior for part in parts.values()),
            )
            for parts in first.values()
            if len(parts) > 1
        ]

    def _difference(self, base: _Columns, truth: _Truth, rivals: Sequence[_Columns]) -> float:
        term = next(term for term in self.problem.terms if term.key == truth.key)
        names = [p.name for p in term.parameters if p.name in truth.size and (truth.size[p.name] or not p.refinement)]
        own = self.columns(term, truth.shape, names)
        sent = own.values @ _coefficients(term, truth.size, names)
        if not np.any(sent):  # too far from its like to stand for it at any size
            return math.inf
        count = self.nuisance.shape[1]
        return _expected(base, own, sent, count) - max(_expected(base, rival, sent, count) for rival in rivals)

    def rivals(self, doubt: Doubt, known: Sequence[EffectInstance]) -> list[tuple[Term, Shape, list[str] | None]]:
        """Every form that the second effect of a doubt may take: term, shape, parameters.

        Of an effect that is known to be there, what it may still be taken for is its refinement.
        """
        found: list[tuple[Term, Shape, list[str] | None]] = []
        there = {(effect.name, effect.target): effect for effect in known}
        for term in self.problem.terms:
            if term.effect != doubt.second or doubt.second_target not in (None, term.target):
                continue
            if (term.effect, term.target) == (doubt.first.name, doubt.first.target):
                continue
            if (term.effect, term.target) in there:
                refined = [p.name for p in term.parameters if p.refinement]
                if refined:
                    found.append((term, _shape(term, there[term.effect, term.target].parameters), refined))
                continue
            found += [(term, shape, None) for shape in term.shapes]
        if not found:
            raise MismatchError(_not_searched(self.problem, doubt.second, doubt.second_target))
        return found


def _term_of(problem: RegressionProblem, effect: EffectInstance) -> Term:
    """The candidate that an effect is for the analyser.

    Raises:
        MismatchError: there is none.
    """
    for term in problem.terms:
        axis = effect.axis or get(effect.name).axis
        if (term.effect, term.target) == (effect.name, effect.target) and term.axis in (None, axis):
            return term
    raise MismatchError(_not_searched(problem, effect.name, effect.target))


def _coefficients(term: Term, size: Mapping[str, float], names: Sequence[str]) -> FloatArray:
    """What the columns of some parameters of a term are multiplied by, for given values of the parameters."""
    chosen = [p for p in term.parameters if p.name in names]
    return np.array([p.coefficient(size[p.name]) for p in chosen])


def _not_searched(problem: RegressionProblem, name: str, target: tuple[str, ...] | None) -> str:
    names = sorted({term.effect for term in problem.terms})
    return (
        f"{_words(name, target)} is not searched for in the channels of this robot; it takes {', '.join(get(name).sensors)}; "
        f"allowed: {', '.join(names)}"
    )


def _shape(term: Term, values: Mapping[str, float]) -> Shape:
    """Shape of a term with given parameters; what they do not say is as in the middle of its grid."""
    middle = term.shapes[len(term.shapes) // 2]
    return {name: float(values.get(name, value)) for name, value in middle.items()}


def _second(trials: Sequence[_Trial], doubt: Doubt, known: Sequence[EffectInstance]) -> _Truth:
    """The second effect of a doubt with its size: as given, or the form that is over all manoeuvres most like the first.

    Without a size given, sizes outside the bounds of a parameter are brought back to them.
    """
    rivals = trials[0].rivals(doubt, known)
    if doubt.second_size is not None:
        term = rivals[0][0]
        return _Truth(term.key, _shape(term, doubt.second_size), doubt.second_size)
    best, least = None, math.inf
    for term, shape, chosen in rivals:
        names = [p.name for p in term.parameters if (not p.refinement if chosen is None else p.name in chosen)]
        gram, moment, power = np.zeros((len(names), len(names))), np.zeros(len(names)), 0.0
        for trial in trials:
            own = _term_of(trial.problem, doubt.first)
            columns = trial.columns(own, _shape(own, doubt.first.parameters)).values
            base = [p.name for p in own.parameters if not p.refinement]
            sent = columns @ _coefficients(own, doubt.first.parameters, base)
            alike = trial.columns(next(t for t in trial.problem.terms if t.key == term.key), shape, names).values
            gram, moment, power = gram + alike.T @ alike, moment + alike.T @ sent, power + float(sent @ sent)
        fitted = np.linalg.lstsq(gram, moment, rcond=None)[0]
        bounds = np.array([(p.lower, p.upper) for p in term.parameters if p.name in names])
        fitted = np.clip(fitted, bounds[:, 0], bounds[:, 1])
        apart = power - 2.0 * float(fitted @ moment) + float(fitted @ gram @ fitted)
        if apart < least:
            chosen_parameters = [p for p in term.parameters if p.name in names]
            size = {p.name: p.value(float(c)) for p, c in zip(chosen_parameters, fitted, strict=True)}
            best, least = _Truth(term.key, shape, size), apart
    assert best is not None  # `rivals` has raised otherwise
    return best


def _noise(
    problem: RegressionProblem, effects: Sequence[EffectInstance], noise_floor: Mapping[str, float]
) -> tuple[NoiseModel, FloatArray]:
    """Noise of a simulated recording when all that is at work is fitted, and the root weights (T, C) of its samples.

    They are lower where the real recordings were louder, and where the model itself misjudges.
    """
    terms = [_term_of(problem, effect) for effect in effects]
    pairs = zip(terms, effects, strict=True)
    parts = [t.columns(dict(_shape(t, effect.parameters)))[..., list(t.base_indices())] for t, effect in pairs]
    columns = np.concatenate([problem.nuisance_columns(), *parts], axis=2)
    deviations = np.concatenate(
        [problem.nuisance_deviations(), *([t.parameters[i].deviation for i in t.base_indices()] for t in terms)]
    )
    valid, residual = problem.valid, problem.residual
    for _ in range(3):
        size = _rms(residual, valid)
        weight = np.where(valid, 1.0 / size, 0.0)
        rows = (columns * weight[..., None]).reshape(-1, columns.shape[2])
        precision = rows.T @ rows + np.diag(deviations**-2.0)
        mean = np.linalg.solve(precision, rows.T @ np.where(valid, problem.residual * weight, 0.0).ravel())
        residual = problem.residual - columns @ mean
    size = _rms(residual, valid)
    real = np.array([noise_floor.get(channel.name, 0.0) for channel in problem.channels])
    information = np.array([channel.information for channel in problem.channels])
    misjudged = np.zeros_like(residual) if problem.misjudged is None else problem.misjudged
    louder = (np.maximum(real, size) ** 2 + misjudged**2) / size**2
    return fit_noise_model(residual, valid, problem.segment), np.sqrt(information / louder)


def _rms(values: FloatArray, valid: np.ndarray) -> FloatArray:
    counts = np.maximum(valid.sum(axis=0), 1)
    size: FloatArray = np.sqrt(np.sum(np.where(valid, values, 0.0) ** 2, axis=0) / counts)
    return np.maximum(size, 1e-300)


def _expected(base: _Columns, added: _Columns, sent: FloatArray, nuisances: int) -> float:
    """Expected log evidence of the set base + added when `sent` (R,) is what the truth sends; see the module."""
    columns = np.concatenate([base.values, added.values], axis=1)
    deviations = np.concatenate([base.deviations, added.deviations])
    gram = columns.T @ columns
    scaled = gram * np.outer(deviations, deviations) + np.eye(len(deviations))
    inverse = np.linalg.inv(scaled) * np.outer(deviations, deviations)
    moment = columns.T @ sent
    unexplained = float(sent @ sent - moment @ inverse @ moment)
    own = slice(0, nuisances)
    retuned = gram[own, own] - gram[own] @ inverse @ gram[:, own]
    healthy = float(np.sum(np.diag(retuned) * base.deviations[own] ** 2))
    fitted = float(np.sum(inverse * gram))  # degrees of freedom that the set spends on noise
    return -0.5 * float(np.linalg.slogdet(scaled)[1]) - 0.5 * (unexplained + healthy - fitted) + added.log_prior


# -- where no manoeuvre is enough ------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Remedy:
    """A change of the robot with which a manoeuvre separates: what is to be done, the robot then, and the outcome."""

    words: str
    robot: RobotDescription
    outcome: Outcome


def remedies(robot: RobotDescription) -> Iterator[tuple[str, RobotDescription]]:
    """Yield what may be added to a robot: the sensors that it lacks, and a known load on one corner."""
    sensors = robot.sensors
    if sensors.imu is None:
        better = dataclasses.replace(sensors, imu=COMMON_IMU)
        yield "an inertial measurement unit", dataclasses.replace(robot, sensors=better)
    if sensors.tracker is None:
        better = dataclasses.replace(sensors, tracker=COMMON_TRACKER)
        yield "a tracked pose (ground_truth/odom)", dataclasses.replace(robot, sensors=better)
    mass = float(f"{LOAD_SHARE * robot.total_mass:.2g}")
    x, y = (float(f"{LOAD_REACH * value:.2g}") for value in np.abs(robot.steer_axis).max(axis=0))
    values = get("payload_mass").check({"mass": mass, "x": x, "y": y, "z": LOAD_HEIGHT}, "payload_mass")
    load = EffectInstance("payload_mass", ("chassis",), values)
    words = f"a known load of {mass:g} kg, {x:g} m in front and {y:g} m to the left of base_link"
    yield words, dataclasses.replace(robot, physics=(*robot.physics, load))


def find_remedy(
    robot: RobotDescription,
    doubts: Sequence[Doubt],
    others: Sequence[EffectInstance],
    noise_floor: Mapping[str, float],
    excitations: Sequence[Excitation],
    progress: Progress,
) -> Remedy | None:
    """Return the first addition to the robot with which one of the excitations separates; None if none does."""
    for words, better in remedies(robot):
        progress(f"with {words}")
        best = rank(better, doubts, others, noise_floor, excitations, progress)[0]
        if best.separates:
            return Remedy(words, better, best)
    return None
