"""From a regression problem to what can be said: effects with numbers, doubts and look-alikes, and what is left.

    explanation = explain(problem, rng)

runs the search, the open-set test and, where something is left that depends on an argument of a named effect, tries the
refinements of that effect (a friction that differs forwards and backwards). A refined law is adopted if it completes the
explanation and every plain effect stays beside it. Otherwise the plain law stays, and the refinement is reported with the
leftover: it is the first suspect for physics that the library does not hold in full. A plain effect that the refinement
would put out (an offset, by a friction that differs between directions) is said to be ambiguous with it: what decides
between them is the shape of what is left, and that may have a third cause.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
from scipy import stats

from .evidence_selection import EffectSearch, Progress, Selection, SelectionSettings
from .open_set import Leftover, OpenSetResult, OpenSetTest, is_unknown, judge
from .regression_problem import FloatArray, RegressionProblem, Term
from .whitened_regression import Fit, Instance, WhitenedRegression

# A look-alike within so many nats of a named effect cannot be told from it.
AMBIGUOUS = 3.0
# 95 % of a Gaussian: half-width in deviations, and drop of the log likelihood.
HALF_WIDTH, DROP = 1.96, 1.92
# Widest profile interval of a shaping parameter that is searched on a logarithmic scale.
WIDEST_RATIO = 30.0


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A parameter with its 95 % interval."""

    value: float
    unit: str
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class NamedTerm:
    """A named effect.

    Attributes:
        probability: of the effect, among all sets that differ from the chosen one by leaving it out or by
            putting another term in its place.
        ambiguous_with: effects (of the same or another target, as "name" or "name/target") that would do as well.
        loss: evidence lost without it [nats]; held_out: the same on held-out blocks.
        contribution: what it adds to the residual (T, C).
    """

    instance: Instance
    term: Term
    estimates: dict[str, Estimate]
    probability: float
    ambiguous_with: tuple[str, ...]
    loss: float
    held_out: float
    contribution: FloatArray


@dataclasses.dataclass(frozen=True)
class Refinement:
    """A refined law that fits better without being adopted.

    Attributes:
        named: its effects with all their parameters.
        dropped: effects of the plain law that it makes redundant.
        gain: nats over the plain law.
        share: part of the plain law's remaining mean square that it explains.
    """

    named: tuple[NamedTerm, ...]
    dropped: tuple[str, ...]
    gain: float
    share: float

    def describe(self) -> str:
        """Say the refinement in one line."""
        parts = []
        for entry in self.named:
            refined = [p.name for p in entry.term.parameters if p.refinement and p.name in entry.estimates]
            for name in refined:
                estimate = entry.estimates[name]
                parts.append(f"{entry.term.effect}.{name} = {estimate.value:.3g} {estimate.unit}")
        text = " and ".join(parts)
        if self.dropped:
            text += f" (and no {' or '.join(self.dropped)})"
        return text


@dataclasses.dataclass(frozen=True)
class Explanation:
    """Everything that one problem lets be said.

    Attributes:
        leftovers: dependences that nothing named explains, strongest first.
        withdrawn: names that a leftover explains better: (label, variable).
        refinement: a refined law that was not adopted; None if there is none, or if it was adopted.
        floor: rms of each channel that nothing measured explains (C,).
        p_values: of each channel holding noise and tolerances only (C,).
    """

    search: EffectSearch
    selection: Selection
    named: tuple[NamedTerm, ...]
    leftovers: tuple[Leftover, ...]
    withdrawn: tuple[tuple[str, str], ...]
    refinement: Refinement | None
    floor: FloatArray
    p_values: FloatArray

    @property
    def fit(self) -> Fit:
        """Joint posterior of tolerances and effects."""
        return self.selection.fit

    @property
    def complete(self) -> bool:
        """Whether nothing is left."""
        return not self.leftovers


def explain(
    problem: RegressionProblem,
    rng: np.random.Generator,
    settings: SelectionSettings | None = None,
    progress: Progress = lambda message: None,
) -> Explanation:
    """Search, test what is left, refine; see the module."""
    search = EffectSearch(problem, rng, settings, progress)
    selection = search.run()
    judgement = judge(search, selection)
    search, selection, result = judgement.search, judgement.selection, judgement.result
    problem = search.problem
    refinement = None
    if result.leftovers:
        refined = _refined(search, selection, result)
        if refined is not None:
            instances, gain, share = refined
            terms = {i.term for i in instances}
            dropped = {problem.terms[i.term].effect for i in selection.fit.instances if i.term not in terms}
            finished = OpenSetTest(search, instances).run(selection.threshold)
            if not finished.leftovers and not dropped:
                progress("a refined law completes the explanation")
                selection, result = search.conclude(instances, selection.threshold), finished
            else:
                better = search.conclude(instances, selection.threshold)
                refinement = Refinement(named_terms(search, better), tuple(sorted(dropped)), gain, share)
                progress(f"not adopted: {refinement.describe()}")
    named = tuple(
        dataclasses.replace(entry, probability=entry.probability * judgement.beliefs.get(entry.instance.term, 1.0))
        for entry in named_terms(search, selection) if not is_unknown(problem, entry.instance)
    )
    if refinement is not None:
        named = tuple(_doubted(entry, refinement) for entry in named)
    return Explanation(
        search=search,
        selection=selection,
        named=named,
        leftovers=result.leftovers,
        withdrawn=judgement.withdrawn,
        refinement=refinement,
        floor=result.floor,
        p_values=_p_values(search, selection, result),
    )


def _doubted(entry: NamedTerm, refinement: Refinement) -> NamedTerm:
    """The entry, said to be ambiguous with the refined effects if these would do without it."""
    if entry.term.effect not in refinement.dropped:
        return entry
    rivals = (other.term.effect for other in refinement.named if any(
        p.refinement and p.name in other.estimates for p in other.term.parameters
    ))
    return dataclasses.replace(entry, ambiguous_with=tuple(dict.fromkeys((*entry.ambiguous_with, *rivals))))


def _refined(
    search: EffectSearch, selection: Selection, result: OpenSetResult
) -> tuple[tuple[Instance, ...], float, float] | None:
    """The best set with one or more refinements switched on and what they make redundant left out, if it is better."""
    problem, threshold = search.problem, selection.threshold
    variables = {leftover.variable for leftover in result.leftovers}
    best: tuple[tuple[Instance, ...], float, float] | None = None
    plain = selection.fit.instances
    before = float(np.sum(search.residual_of(plain)[problem.valid] ** 2))
    for index, instance in enumerate(plain):
        term = problem.terms[instance.term]
        everything = tuple(range(len(term.parameters)))
        if instance.active == everything or not variables & set(term.arguments):
            continue
        instances = (*plain[:index], dataclasses.replace(instance, active=everything), *plain[index + 1 :])
        # Judged under the noise of the better model: under that of the worse one a refinement is "slow noise".
        regression = search.whiten_at(search.residual_of(instances))
        plain_evidence = regression.fit(plain).log_evidence
        instances = _without_redundant(search, regression, instances, threshold)
        fit = regression.fit(instances)
        gain = fit.log_evidence - plain_evidence
        share = 1.0 - float(np.sum(search.residual_of(instances)[problem.valid] ** 2)) / max(before, 1e-300)
        if gain > threshold and regression.within_bounds(fit) and (best is None or gain > best[1]):
            best = (instances, gain, share)
    return best


def _without_redundant(
    search: EffectSearch, regression: WhitenedRegression, instances: tuple[Instance, ...], threshold: float
) -> tuple[Instance, ...]:
    while len(instances) > 1:
        losses, held_out, shares = search.judge(regression, instances, regression.fit(instances))
        failing = [
            (loss, k)
            for k, (loss, gain, share) in enumerate(zip(losses, held_out, shares, strict=True))
            if loss < threshold or gain <= 0.0 or share < 1.0
        ]
        if not failing:
            break
        _, worst = min(failing)
        instances = instances[:worst] + instances[worst + 1 :]
    return instances


def named_terms(search: EffectSearch, selection: Selection) -> tuple[NamedTerm, ...]:
    """Numbers, intervals, probability and look-alikes of every effect of a selection."""
    problem, regression, fit = search.problem, selection.regression, selection.fit
    deviation = np.sqrt(np.maximum(np.diag(fit.covariance), 0.0))
    position = len(problem.nuisances)
    named = []
    for index, instance in enumerate(fit.instances):
        term = problem.terms[instance.term]
        estimates = {}
        for offset, parameter_index in enumerate(instance.active):
            parameter = term.parameters[parameter_index]
            value = float(fit.mean[position + offset])
            half = HALF_WIDTH * math.hypot(float(deviation[position + offset]), problem.scale_deviation * value)
            estimates[parameter.name] = Estimate(value, parameter.unit, value - half, value + half)
        others = fit.instances[:index] + fit.instances[index + 1 :]
        for name, value in instance.shape:
            low, high = _profile(regression, others, instance, name, fit.log_evidence, term.resolution)
            estimates[name] = Estimate(value, "", low, high)
        columns = problem.columns(instance.term, instance.shape)[..., list(instance.active)]
        contribution = columns @ fit.mean[position : position + len(instance.active)]
        position += len(instance.active)
        probability, alike = _alternatives(search, selection, index)
        named.append(
            NamedTerm(
                instance,
                term,
                estimates,
                probability,
                alike,
                selection.losses[index],
                selection.held_out[index],
                contribution,
            )
        )
    return tuple(named)


def _profile(
    regression: WhitenedRegression,
    others: tuple[Instance, ...],
    instance: Instance,
    name: str,
    best: float,
    resolution: Mapping[str, tuple[str, float]],
) -> tuple[float, float]:
    """95 % interval of a shaping parameter by its profile likelihood: on the scale that it was searched on, or as it is."""
    centre = dict(instance.shape)[name]
    kind, spacing = resolution.get(name, ("", 0.0))
    if not kind or (kind == "log" and centre <= 0.0):
        return centre, centre
    widest = math.log(WIDEST_RATIO) if kind == "log" else 2.0 * spacing
    smallest = 1e-4 if kind == "log" else 1e-4 * spacing

    def moved(step: float) -> float:
        return centre * math.exp(step) if kind == "log" else centre + step

    def drop(step: float) -> float:
        shape = {**dict(instance.shape), name: moved(step)}
        return best - regression.fit([*others, regression.with_shape(instance, shape)]).log_evidence

    ends = []
    for direction in (-1.0, 1.0):
        inner, outer = 0.0, smallest
        while outer < widest and drop(direction * outer) < DROP:
            inner, outer = outer, outer * 3.0
        for _ in range(5):
            middle = math.sqrt(inner * outer) if inner > 0.0 else 0.5 * outer
            if drop(direction * middle) < DROP:
                inner = middle
            else:
                outer = middle
        ends.append(moved(direction * min(outer, widest)))
    return ends[0], ends[1]


def _alternatives(search: EffectSearch, selection: Selection, index: int) -> tuple[float, tuple[str, ...]]:
    """Probability of an instance among the sets without it or with another term instead, and its look-alikes."""
    problem, regression, fit = search.problem, selection.regression, selection.fit
    own = fit.instances[index]
    others = fit.instances[:index] + fit.instances[index + 1 :]
    without = regression.fit(others)
    rivals = [without.log_evidence - fit.log_evidence]
    alike = []
    for candidate in regression.scan(others)[0]:
        same = candidate.instance.term == own.term
        if (
            same
            or not math.isfinite(candidate.gain)
            or without.log_evidence + candidate.gain < fit.log_evidence - 30.0
        ):
            continue
        trial = regression.fit([*others, candidate.instance])
        if not regression.within_bounds(trial):
            continue
        difference = without.log_evidence + candidate.gain - fit.log_evidence
        rivals.append(difference)
        if difference > -AMBIGUOUS:
            mine, theirs = problem.terms[own.term], problem.terms[candidate.instance.term]
            alike.append(theirs.effect if theirs.effect != mine.effect else theirs.key)
    total = sum(math.exp(min(rival, 50.0)) for rival in rivals)
    return 1.0 / (1.0 + total), tuple(alike)


def _p_values(search: EffectSearch, selection: Selection, result: OpenSetResult) -> FloatArray:
    """Probability per channel that noise and tolerances alone look like this.

    Where effects are named: chi-square of their whitened contribution in the channel. Where only a dependence is left:
    of its gain. Elsewhere: of the largest gain that any further candidate reaches, against that of the surrogates.
    """
    problem, regression, fit = search.problem, selection.regression, selection.fit
    count = len(problem.nuisances)
    channels = len(problem.channels)
    effects = regression.design(fit.instances)[:, count:] @ fit.mean[count:] if fit.instances else None
    further = regression.scan(fit.instances)[0]
    gain = max((c.gain for c in further), default=0.0)
    place, spread = search.noise_gain
    idle = -math.expm1(-math.exp(min(-(gain - place) / spread, 50.0))) if math.isfinite(gain) else 1.0
    values = np.full(channels, min(1.0, max(idle, 0.0)))
    for channel in range(channels):
        leftover = next(
            (left for left in result.leftovers if left.channel == problem.channels[channel].name), None
        )
        if leftover is not None:
            values[channel] = min(values[channel], float(stats.chi2.sf(2.0 * leftover.gain, 8)))
        if effects is not None:
            statistic = float(np.sum(regression.spread(effects)[:, channel] ** 2))
            freedom = len(fit.mean) - count
            if statistic > 2.0 * selection.threshold + freedom:
                values[channel] = min(values[channel], float(stats.chi2.sf(statistic, freedom)))
    return values
