"""Is anything left, and what does it depend on? Asked before a name is given out.

First a law outside the library is looked for where torques and forces act (`law_search`). It stays in the joint fit, as a
closed form where one does as well as a curve, and takes with it the names that it makes redundant. Then, for whatever no
such law can be:

After the joint fit every channel's residual is offered a smooth function of one measured variable at a time (piecewise
linear, or a Fourier series for an angle). The function is fitted together with the effects and the tolerances, so that
it cannot live on what they explain already, and it counts only as far as it lowers the error of held-out blocks. A
named effect that such a function makes redundant, and of which it explains more, is not that effect: the name is
withdrawn and the dependence reported instead.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize

from ..all_cores import on_all_cores
from ..laws.leftover_expression import ClosedForm, closed_form, fourier, plain_expression, written
from ..laws.unknown_law import Law, combined
from ..regression.noise_model import robust_deviation
from ..regression.regression_problem import UNKNOWN, FloatArray, IntArray, RegressionProblem
from ..regression.whitened_regression import Instance, WhitenedRegression
from .acting_torques import acting_part
from .evidence_selection import EffectSearch, Selection
from .law_search import LAW_MARGIN, FoundLaw, LawSearch, changes_law_of, gain_of_a_smaller_law
from .shape_search import refined_shape

HAT_KNOTS = 9
HARMONICS = 3
# A function of one variable must take this part of what is left of a channel to be worth a report.
SMALLEST_SHARE = 0.10
# It must also reach this part of the measured signal. Below lie details that no description of a real machine holds (the
# lean on its springs, the ripple of a filter); a tool that reports them on every healthy robot says nothing.
SMALLEST_PART = 0.02
# So many deviations of what the model misjudges are more than that.
BEYOND_DOUBT = 2.0
# Of a healthy robot's channels none is left twice its floor. Where one is left so many times, no number of the description
# that is off by so many tolerances stands for it: a gyro that turns the other way is not one whose scale is 400 of them off.
FAR_FROM_FLOOR, FARTHEST = 4.0, 10.0
# No wheel is rounder, and no floor is more even, than that what it rolls is known better than to this part of its way.
ROUNDNESS = 2e-4
LARGEST_LAWS = 2
# So many effects of the library are held against a law before it is called one from outside.
LIBRARY_TRIALS = 3
# So many variables of a channel are looked at closely, after a look at so many samples.
MOST_PROMISING, PROMISING_SAMPLES = 4, 500
# A closed form may leave this part more of what a curve explains; and this, if it does without a name that the curve needs.
CLOSED_PART, SIMPLER_PART = 0.01, 0.05
# Nats by which a law has to do better without a name whose law it changes, if it needs as many numbers.
AGAINST_A_NAME = 3.0
# What is left of the probability of a name that a curve of the same argument can hold to this part of its square.
SHARED_BELIEF, HELD_PART = 0.5, 0.5
WORTH_TELLING = 0.95  # what is left of a probability, above which nobody asks why


@dataclasses.dataclass(frozen=True)
class Leftover:
    """A dependence that no named effect explains.

    Attributes:
        share: part of the channel's remaining mean square that the dependence explains on held-out blocks.
        gain: nats on held-out blocks.
        curve: the function, as (variable (N,), contribution (N,)) for the report.
        depends_on: all variables, the leading one first.
        expression: closed form of the torque or force, or of the channel; None where there is only a curve.
        law: what acts where; None for a dependence of a channel that is no torque or force.
        weights: of the law's basis (K,).
    """

    channel: str
    variable: str
    share: float
    gain: float
    curve: tuple[FloatArray, FloatArray]
    depends_on: tuple[str, ...] = ()
    expression: str | None = None
    law: Law | None = None
    weights: FloatArray = dataclasses.field(default_factory=lambda: np.zeros(0))


@dataclasses.dataclass(frozen=True)
class OpenSetResult:
    """What is left after the named effects.

    Attributes:
        leftovers: per channel the leading dependence, strongest first.
        vetoed: instances whose name is withdrawn, with the variable that explains them better.
        floor: rms of each channel that no function of the measured variables explains (C,).
    """

    leftovers: tuple[Leftover, ...]
    vetoed: tuple[tuple[Instance, str], ...]
    floor: FloatArray


@dataclasses.dataclass(frozen=True)
class Judgement:
    """What remains of a selection when physics outside the library has been looked for.

    Attributes:
        search, selection: with laws that were found as further terms, called `UNKNOWN`.
        result: what is left, laws first.
        withdrawn: names that something left explains better: (label, variable).
        beliefs: what is left of the probability of names, by term, that a law not sure enough to be told would withdraw, or
            that a law beside them can hold.
        doubts: the same in plain sentences.
    """

    search: EffectSearch
    selection: Selection
    result: OpenSetResult
    withdrawn: tuple[tuple[str, str], ...]
    beliefs: Mapping[int, float]
    doubts: tuple[str, ...]


def judge(search: EffectSearch, selection: Selection, left: OpenSetResult) -> Judgement:
    """Look for laws outside the library and for dependences of channels; withdraw the names that they make redundant.

    Args:
        search, selection: a finished search.
        left: what the test of its selection leaves.
    """
    withdrawn: list[tuple[str, str]] = []
    found: list[tuple[Law, FoundLaw]] = []
    beliefs: dict[int, float] = {}
    doubts: tuple[str, ...] = ()
    result: OpenSetResult | None = left
    for _ in range(LARGEST_LAWS if search.problem.sites is not None else 0):
        law = LawSearch(search, selection).run()
        if law is None:
            break
        selection, law = _beside_hidden_name(search, selection, law)
        if not law.counts:
            beliefs = {i.term: law.belief for i in law.withdrawn}
            doubts = _doubts(search, law)
            break
        listed = _in_library(search, selection, law)
        if listed is not None:
            selection, result = listed, None
            continue
        before = [i for i in selection.fit.instances if not is_unknown(search.problem, i)]
        search, selection, final = _adopted(search, selection, law)
        selection = _without_mere_relief(search, _with_names_beside(search, selection))
        after = {i.term for i in selection.fit.instances}
        withdrawn += [(search.label(i), " and ".join(final.depends_on)) for i in before if i.term not in after]
        found.append((final, law))
        result = OpenSetTest(search, selection.fit.instances).run(selection.threshold)
        if not result.leftovers:
            break
    result = result or OpenSetTest(search, selection.fit.instances).run(selection.threshold)
    while vetoed := [v for v in result.vetoed if not is_unknown(search.problem, v[0])]:
        instance, variable = vetoed[0]
        withdrawn.append((search.label(instance), variable))
        kept = [other for other in selection.fit.instances if other != instance]
        selection = search.conclude(kept, selection.threshold)
        result = OpenSetTest(search, selection.fit.instances).run(selection.threshold)
    # A second law, or an effect in its place, may do without the first one, and with the names that it had made redundant.
    named = {search.label(instance) for instance in selection.fit.instances}
    withdrawn = [(label, variable) for label, variable in withdrawn if label not in named]
    for label, variable in withdrawn:
        search.progress(f"withdrawn: {label}, the residual depends on {variable}")
    laws = [_law_leftover(search, selection, law, how) for law, how in found if _is_fitted(search, selection, law)]
    shared = shared_beliefs(search, selection)
    doubts += tuple(
        f"{search.label(i)} and the law beside it do the same: which part is which no recording tells; half as sure for that."
        for i in selection.fit.instances if i.term in shared
    )  # fmt: skip
    beliefs |= shared
    shadowed = {term: belief for term, belief in overshadowed_beliefs(search, selection).items() if term not in shared}
    doubts += tuple(
        f"{search.label(i)} does less than the law outside the library in the same channels, and may mend what that does not "
        "do quite right; half as sure for that." for i in selection.fit.instances if i.term in shadowed
    )  # fmt: skip
    beliefs |= shadowed
    return Judgement(
        search, selection, dataclasses.replace(result, leftovers=(*laws, *result.leftovers)), tuple(withdrawn), beliefs, doubts
    )


def _doubts(search: EffectSearch, found: FoundLaw) -> tuple[str, ...]:
    """What a law that is not sure enough to be told takes from the names in whose place it would do."""
    if not found.withdrawn or found.belief > WORTH_TELLING:
        return ()
    names = " and ".join(search.label(instance) for instance in found.withdrawn)
    law = f"{' and '.join(found.law.sites)} by {', '.join(found.law.depends_on)}"
    return (f"{names} may stand for a law outside the library, {law}: {100 * found.belief:.0f} % as sure for that.",)


def is_unknown(problem: RegressionProblem, instance: Instance) -> bool:
    """Whether an instance is a law outside the library."""
    return problem.terms[instance.term].effect == UNKNOWN


def shared_beliefs(search: EffectSearch, selection: Selection) -> dict[int, float]:
    """What is left of the probability of names, by term, that a law of the same arguments beside them can hold.

    Which part of a friction is viscous, and which an unknown function of the same speed, no recording can tell.
    """
    problem = search.problem
    rows = _standard_rows(search, selection)
    beliefs: dict[int, float] = {}
    for law in (i for i in selection.fit.instances if is_unknown(problem, i)):
        arguments, functions = set(problem.terms[law.term].arguments), rows(law)
        for name in selection.fit.instances:
            if is_unknown(problem, name) or not arguments <= set(problem.terms[name.term].arguments):
                continue
            if _held(rows(name), functions):
                beliefs[name.term] = SHARED_BELIEF
    return beliefs


def overshadowed_beliefs(search: EffectSearch, selection: Selection) -> dict[int, float]:
    """What is left of the probability of names, by term, that do most of their work where an unknown law does more.

    How far the form of a law holds nobody knows. What it leaves there is no noise, and a small name may stand for that.
    """
    problem, fit = search.problem, selection.fit
    laws = [i for i in fit.instances if is_unknown(problem, i)]
    if not laws:
        return {}
    rows = _standard_rows(search, selection)
    power, position = {}, len(problem.nuisances)
    for instance in fit.instances:
        weights = fit.mean[position : position + len(instance.active)]
        position += len(instance.active)
        power[instance] = np.sum((rows(instance) @ weights).reshape(problem.valid.shape) ** 2, axis=0)
    most = np.max([power[law] for law in laws], axis=0)
    return {
        i.term: SHARED_BELIEF
        for i in fit.instances
        if i not in laws and float(np.sum(power[i][most > power[i]])) > 0.5 * float(np.sum(power[i]))
    }


def _standard_rows(search: EffectSearch, selection: Selection) -> Callable[[Instance], FloatArray]:
    """Return what gives an instance's columns (T C, K) in deviations of what the selection leaves of each channel."""
    problem = search.problem
    residual = search.residual_of(selection.fit.instances)
    pairs = zip(residual.T, problem.valid.T, strict=True)
    deviation = np.array([robust_deviation(left[valid]) if valid.any() else 1.0 for left, valid in pairs])
    scale = np.where(problem.valid, 1.0 / deviation, 0.0)

    def rows(instance: Instance) -> FloatArray:
        columns = problem.columns(instance.term, instance.shape)[..., list(instance.active)]
        return (columns * scale[:, :, None]).reshape(scale.size, -1)

    return rows


def _held(own: FloatArray, functions: FloatArray) -> bool:
    """Whether functions (N, F) hold columns (N, K) to a part of their square."""
    left = own - functions @ np.linalg.lstsq(functions, own, rcond=1e-9)[0]
    return bool(np.sum(left**2) < (1.0 - HELD_PART) * np.sum(own**2))


def _in_library(search: EffectSearch, selection: Selection, found: FoundLaw) -> Selection | None:
    """The selection with an effect of the library that does at least as well as a law; None if there is none.

    The library was asked under the noise that everything unexplained looked like. Under what a law leaves it may answer.
    """
    _, with_law = _with_law(search, selection, found.law, found.names)
    regression, names = with_law.regression, found.names
    wanted = with_law.fit.log_evidence
    if found.withdrawn:
        wanted += gain_of_a_smaller_law(regression, with_law.fit.instances)
    for candidate in regression.scan(names, only=range(len(search.problem.terms)))[0][:LIBRARY_TRIALS]:
        if is_unknown(search.problem, candidate.instance) or search.repeats(candidate.instance, names):
            continue
        trial = (*names, refined_shape(regression, names, candidate.instance))
        fit = regression.fit(trial)
        if fit.log_evidence < wanted or not regression.within_bounds(fit):
            continue
        chosen = search.retuned_away(search.settle_on(search.conclude(trial, selection.threshold), selection.threshold))
        if any(instance.term == candidate.instance.term for instance in chosen.fit.instances):
            search.progress(f"in the library after all: {search.label(trial[-1])}")
            return chosen
    return None


def _beside_hidden_name(search: EffectSearch, selection: Selection, law: FoundLaw) -> tuple[Selection, FoundLaw]:
    """The selection with a name that shows only beside a law, and the law that counts beside it; if there are such.

    Of two things that are missing each is slow noise to the other: a spring does not count where a friction is not named, nor
    that where the spring is not known. A robot's channels are many, and do not hide the same.
    """
    if law.counts or law.law.sites != ("axis_force",):
        return selection, law
    terms, names = search.problem.terms, selection.fit.instances
    wider, with_law = _with_law(search, selection, law.law, names)
    instances, trials = with_law.fit.instances, []
    for candidate in with_law.regression.scan(instances, only=range(len(terms)))[0][:LIBRARY_TRIALS]:
        term = terms[candidate.instance.term]
        mends = bool(term.arguments) and set(term.arguments) <= set(law.law.depends_on)
        if mends or term.repeatable or term.effect == UNKNOWN or wider.repeats(candidate.instance, instances):
            continue
        name = refined_shape(with_law.regression, instances, candidate.instance)
        regression = wider.whiten_beside((name, *instances))
        trials.append((regression.fit((name, *instances)).log_evidence - regression.fit(instances).log_evidence, name))
    if not trials:
        return selection, law
    gain, name = max(trials, key=lambda trial: trial[0])
    if gain < selection.threshold:
        return selection, law
    beside = search.conclude((*names, name), selection.threshold)
    found = LawSearch(search, beside).run()
    return (beside, found) if found is not None and found.counts else (selection, law)


def _with_names_beside(search: EffectSearch, selection: Selection) -> Selection:
    """The selection with effects that only show under what a law leaves, beside names or in place of some; with the law.

    Before, all that the law explains was noise to them: one that does a little of its work was named, and none of the others.
    """
    # Until now numbers are where they were without the law: what that leaves would pass for such an effect.
    selection = search.conclude(search.made_exact(selection.fit.instances), selection.threshold)
    instances = selection.fit.instances
    laws = {i for i in instances if is_unknown(search.problem, i)}
    grown = search.grow(selection.regression, search.improve(selection.regression, instances), selection.threshold)
    # What is a function of a law's own arguments mends the law; a constant is none.
    terms, held = search.problem.terms, [set(search.problem.terms[law.term].arguments) for law in laws]
    grown = tuple(
        i for i in grown
        if i in instances or not terms[i.term].arguments or not any(set(terms[i.term].arguments) <= own for own in held)
    )  # fmt: skip
    if {i.term for i in grown} == {i.term for i in instances}:
        return selection
    chosen = search.prune(search.whiten_beside(grown), grown, selection.threshold)
    gain = chosen.fit.log_evidence - chosen.regression.fit(instances).log_evidence
    return chosen if laws <= set(chosen.fit.instances) and gain > selection.threshold else selection


def _without_mere_relief(search: EffectSearch, selection: Selection) -> Selection:
    """The selection, with a law, without effects that take a strain from the description's numbers and explain nothing more.

    It is what nobody knows that strains them: a number may mend what a law does not do quite right.
    """
    regression, fit = selection.regression, selection.fit
    for index, instance in enumerate(fit.instances):
        if is_unknown(search.problem, instance):
            continue
        rest = regression.fit(fit.instances[:index] + fit.instances[index + 1 :])
        relief = regression.tolerance_cost(rest) - regression.tolerance_cost(fit)
        loss = fit.log_evidence - rest.log_evidence
        if relief > 0.0 and loss - relief < selection.threshold:
            search.note_drop(instance, loss, "beside the law it does no more than relieve numbers")
            return _without_mere_relief(search, search.prune(regression, rest.instances, selection.threshold))
    return selection


def _adopted(search: EffectSearch, selection: Selection, found: FoundLaw) -> tuple[EffectSearch, Selection, Law]:
    """Put a law into the joint fit, in place of a name whose law it changes where a closed form does without that name.

    With fewer numbers it may do a little worse than both together, with as many it has to do better.

    Beside a viscous friction what is left of a drag by the square of the speed looks like one by its cube.
    """
    beside = _adopted_beside(search, selection, found, found.names)
    terms = search.problem.terms
    others = tuple(i for i in found.names if not changes_law_of(found.law, terms[i.term]))
    if len(others) == len(found.names):
        return beside
    alone = _adopted_beside(search, selection, found, others)
    if not isinstance(alone[2].basis, ClosedForm):
        return beside
    residual = beside[0].residual_of(beside[1].fit.instances)
    evidences = [s.whiten_at(residual).fit(chosen.fit.instances).log_evidence for s, chosen, _ in (beside, alone)]
    needed = AGAINST_A_NAME
    if _size(alone[1]) < _size(beside[1]):
        needed = -SIMPLER_PART * (evidences[0] - search.whiten_at(residual).fit(found.names).log_evidence)
    return alone if evidences[1] > evidences[0] + needed else beside


def _size(selection: Selection) -> int:
    """How many numbers a selection fits."""
    return sum(len(instance.active) for instance in selection.fit.instances)


def _adopted_beside(
    search: EffectSearch, selection: Selection, found: FoundLaw, names: tuple[Instance, ...]
) -> tuple[EffectSearch, Selection, Law]:
    """Put a law into the joint fit beside names: as a closed form if it does as well as the curve."""
    curve = _with_law(search, selection, found.law, names)
    if isinstance(found.law.basis, ClosedForm):
        return *curve, found.law
    weights, covariance = _weights_of(*curve, found.law)
    form = closed_form(found.law.basis, weights, covariance)
    if form is None:
        return *curve, found.law
    form = _as_far_as_seen(search.problem, found.law, form)
    law = dataclasses.replace(found.law, basis=form)
    closed = _with_law(search, selection, law, names)
    valid = search.problem.valid
    residuals = [s.residual_of(c.fit.instances) for s, c in (curve, closed)]
    residuals.append(search.residual_of(names))
    deviation = np.array([robust_deviation(residuals[0][valid[:, c], c]) for c in range(valid.shape[1])])
    sizes = [float(np.sum(np.where(valid, residual / deviation, 0.0) ** 2)) for residual in residuals]
    part = (sizes[1] - sizes[0]) / max(sizes[2] - sizes[0], 1e-300)
    if part < SIMPLER_PART:
        law = _without_what_names_hold(*closed, law, form)
        closed = _with_law(search, selection, law, names)
        simpler = _without_redundant(*closed)
        if part < CLOSED_PART or len(simpler.fit.instances) <= len(names):
            return closed[0], simpler, law
    if found.law.basis.kind == "periodic":
        law = dataclasses.replace(found.law, basis=fourier(found.law.basis))
        return *_with_law(search, selection, law, names), law
    return *curve, found.law


def _as_far_as_seen(problem: RegressionProblem, law: Law, form: ClosedForm) -> ClosedForm:
    """Return a closed form that holds over all that was seen: its knots leave out the ends, where a drag is largest."""
    if not form.clipped or problem.sites is None:
        return form
    seen = np.concatenate([combined(problem.sites.variables, place.arguments[0]) for place in law.places])
    return dataclasses.replace(form, knots=((float(seen.min()), float(seen.max())),))


def _without_what_names_hold(search: EffectSearch, selection: Selection, law: Law, form: ClosedForm) -> Law:
    """Return the law without those of its functions that the names beside it do without.

    A function that a name is already goes for a part of what the law explains, too: each against the other, large and
    opposite, the two mend the shape of the law and say nothing.
    """
    names, own = selection.fit.instances[:-1], selection.fit.instances[-1]
    if not names:
        return law
    fit, rows = selection.regression.fit, _standard_rows(search, selection)
    beside = np.concatenate([rows(name) for name in names], axis=1)
    held = {k for k in own.active if _held(rows(dataclasses.replace(own, active=(k,))), beside)}
    explained = fit((*names, own)).log_evidence - fit(names).log_evidence
    active = own.active
    while len(active) > 1:
        best = fit((*names, dataclasses.replace(own, active=active))).log_evidence
        trials = [tuple(k for k in active if k != left) for left in active]
        margins = []
        for left, trial in zip(active, trials, strict=True):
            allowed = max(selection.threshold, CLOSED_PART * explained) if left in held else selection.threshold
            margins.append(fit((*names, dataclasses.replace(own, active=trial))).log_evidence - best + allowed)
        index = int(np.argmax(margins))
        if margins[index] < 0.0:
            break
        active = trials[index]
    return dataclasses.replace(law, basis=dataclasses.replace(form, atoms=tuple(form.atoms[k] for k in active)))


def _with_law(
    search: EffectSearch, selection: Selection, law: Law, names: tuple[Instance, ...]
) -> tuple[EffectSearch, Selection]:
    """Fit names and law jointly, the law on tyres that are as soft as they come out beside it."""
    problem = search.problem
    for _ in range(2):
        wider = EffectSearch(problem.with_terms([law.term(problem)]), search.rng, search.settings, search.progress)
        wider.noise_gain, wider.ladder = search.noise_gain, search.ladder
        wider.where_exact, wider.outlines = search.where_exact, search.outlines
        terms = wider.problem.terms
        instance = Instance(len(terms) - 1, (), tuple(range(len(terms[-1].parameters))))
        selection_with = wider.conclude((*names, instance), selection.threshold)
        changes = {n.name: float(mean) for n, mean in zip(problem.nuisances, selection_with.fit.mean, strict=False)}
        again = problem.with_laws_at(changes)
        if again is problem:
            break
        problem = again
    return wider, selection_with


def _without_redundant(search: EffectSearch, selection: Selection) -> Selection:
    """Withdraw the names, the law being the last instance, that cost less than the threshold."""
    while len(selection.fit.instances) > 1 and min(selection.losses[:-1]) < selection.threshold:
        weakest = int(np.argmin(selection.losses[:-1]))
        kept = [i for k, i in enumerate(selection.fit.instances) if k != weakest]
        selection = search.conclude(kept, selection.threshold)
    return selection


def _weights_of(search: EffectSearch, selection: Selection, law: Law) -> tuple[FloatArray, FloatArray]:
    """Weights of a law's basis in the joint fit, with their covariance."""
    position = len(search.problem.nuisances)
    for instance in selection.fit.instances:
        count = len(instance.active)
        if search.problem.terms[instance.term].law is law:
            rows = slice(position, position + count)
            return selection.fit.mean[rows], selection.fit.covariance[rows, rows]
        position += count
    raise AssertionError("the law is in the fit")


def _is_fitted(search: EffectSearch, selection: Selection, law: Law) -> bool:
    """Whether a law is in the joint fit."""
    return any(search.problem.terms[instance.term].law is law for instance in selection.fit.instances)


def _law_leftover(search: EffectSearch, selection: Selection, law: Law, found: FoundLaw) -> Leftover:
    weights, _ = _weights_of(search, selection, law)
    if law.sites == ("axis_force",):
        weights = weights * acting_part(search.problem, selection.fit.instances, selection.fit.mean)
    knots = law.basis.knots[0]
    grid = np.linspace(knots[0], knots[-1], 61)
    if len(law.basis.knots) == 1:
        curve = law.basis.functions([grid]) @ weights
    else:
        curve = law.basis.functions([grid, np.full_like(grid, float(np.median(law.basis.knots[1])))]) @ weights
    return Leftover(
        _channel_of(search, law), law.depends_on[0], found.share, found.held_out, (grid, curve), law.depends_on,
        written(law, weights), law, weights,
    )  # fmt: skip


def _channel_of(search: EffectSearch, law: Law) -> str:
    """Name of the site; of all drives or steerings, or of a force along a direction, the channel that it moves most."""
    if len(law.sites) == 1 or (len(law.sites) == 2 and not law.sites[0].startswith("chassis")):
        return law.sites[0]
    problem = search.problem
    columns = problem.columns(len(problem.terms) - 1, ())
    moved = np.sqrt(np.mean(np.where(problem.valid[:, :, None], columns, 0.0) ** 2, axis=(0, 2)))
    signal = np.sqrt(np.mean(np.where(problem.valid, problem.measured, 0.0) ** 2, axis=0))
    return problem.channels[int(np.argmax(moved / np.maximum(signal, 1e-300)))].name


def smooth_basis(values: FloatArray, periodic: bool) -> tuple[FloatArray, FloatArray]:
    """Functions of one variable (T, K) without the constant one, and the knots they stand on."""
    if periodic:
        harmonics = np.arange(1, HARMONICS + 1)
        angles = values[:, None] * harmonics
        return np.concatenate([np.cos(angles), np.sin(angles)], axis=1), np.linspace(-np.pi, np.pi, 61)
    # Quantiles by rank among distinct levels: a recording that holds a few speeds has most samples on plateaus.
    low, high = np.quantile(values, [0.005, 0.995])
    if high - low < 1e-12 * max(abs(low), abs(high), 1e-300):
        return np.zeros((len(values), 0)), np.array([low])
    quantiles = np.quantile(values, np.linspace(0.01, 0.99, HAT_KNOTS))
    even = np.linspace(low, high, HAT_KNOTS)
    knots = 0.5 * (quantiles + even)
    clipped = np.clip(values, knots[0], knots[-1])
    hats = np.stack([np.interp(clipped, knots, row) for row in np.eye(HAT_KNOTS)], axis=1)
    # Between two knots that no sample is near there is nothing to fit.
    return (hats - hats.mean(axis=0))[:, hats.std(axis=0) > 1e-6], knots


def _is_angle(name: str) -> bool:
    """Whether a variable comes round again after a turn."""
    return name.startswith(("steer_angle", "drive_angle"))


class _Dependence(NamedTuple):
    """A function of one variable in one channel.

    Attributes:
        gain: on held-out blocks [nats]; share: part of what is left there that it explains.
        curve: (variable (N,), contribution (N,)); expression: a plain function that does nearly the same.
    """

    gain: float
    share: float
    curve: tuple[FloatArray, FloatArray]
    expression: str | None


class OpenSetTest:
    """Tests the residual of a chosen set for dependences on the problem's variables."""

    def __init__(self, search: EffectSearch, instances: Sequence[Instance]) -> None:
        self.search = search
        self.problem: RegressionProblem = search.problem
        self.instances = tuple(instances)
        self.residual = search.residual_of(self.instances)
        self.bases = self._bases()
        self.noise = self._unexplained()
        self.regression = search.whiten_at(self.noise)
        self._far = [self._is_far(channel) for channel in range(len(self.problem.channels))]

    def _is_far(self, channel: int) -> bool:
        """Whether what is left of a channel is far more than its noise, and than what the model misjudges."""
        valid = self.problem.valid[:, channel]
        if not valid.any():
            return False
        floor = robust_deviation(self.noise[valid, channel])
        if self.problem.misjudged is not None:
            floor = max(floor, float(np.sqrt(np.mean(self.problem.misjudged[valid, channel] ** 2))))
        return float(np.sqrt(np.mean(self.residual[valid, channel] ** 2))) > FAR_FROM_FLOOR * floor

    def _bases(self) -> dict[tuple[int, str], tuple[FloatArray, FloatArray]]:
        """Basis columns (T, K) and knots by channel and variable."""
        bases = {}
        for name, values in self.problem.variables.items():
            functions, knots = smooth_basis(values, _is_angle(name))
            if functions.shape[1]:
                for channel in range(len(self.problem.channels)):
                    bases[channel, name] = (functions, knots)
        return bases

    def _unexplained(self) -> FloatArray:
        """Residual (T, C) after additive functions of all variables: the noise to judge every single one by.

        Grown by what so many functions take of mere noise.
        """
        left = self.residual.copy()
        columns = {name: functions for (_, name), (functions, _) in self.bases.items()}
        if not columns:
            return left
        stacked = np.concatenate([*columns.values(), np.ones((len(left), 1))], axis=1)
        masks, mask_of = np.unique(self.problem.valid, axis=1, return_inverse=True)
        for number, valid in enumerate(masks.T):
            if not valid.any():
                continue
            own = np.flatnonzero(mask_of.ravel() == number)  # channels that are judged at the same samples
            size = np.maximum(np.sqrt(np.mean(stacked[valid] ** 2, axis=0)), 1e-300)
            scaled = stacked[valid] / size
            ridge, width = 1e-3 * len(scaled), scaled.shape[1]
            factor = linalg.cho_factor(scaled.T @ scaled + ridge * np.eye(width))
            left[:, own] -= stacked / size @ linalg.cho_solve(factor, scaled.T @ left[np.ix_(valid, own)])
            freedom = width - ridge * float(np.trace(linalg.cho_solve(factor, np.eye(width))))
            left[:, own] *= np.sqrt(len(scaled) / max(len(scaled) - freedom, 0.1 * len(scaled)))
        return left

    def run(self, threshold: float) -> OpenSetResult:
        """Find the leading dependence of every channel, and the names that do not survive it."""
        channels = range(len(self.problem.channels))
        self.regression.grams(self.instances)  # found once, before all channels ask for it at the same time
        leading = on_all_cores(lambda channel: self._leading(channel, self.instances, threshold), channels)
        leftovers = [best for best in leading if best is not None]
        leftovers.sort(key=lambda leftover: -leftover.gain)
        vetoed = self._vetoes(leftovers, threshold)
        floor = np.array(
            [
                robust_deviation(self.noise[self.problem.valid[:, c], c]) if self.problem.valid[:, c].any() else 0.0
                for c in range(len(self.problem.channels))
            ]
        )
        return OpenSetResult(tuple(leftovers), tuple(vetoed), floor)

    def _leading(self, channel: int, instances: Sequence[Instance], threshold: float) -> Leftover | None:
        best: Leftover | None = None
        valid = self.problem.valid[:, channel]
        if not valid.any():
            return None
        smallest = SMALLEST_PART * float(np.std(self.problem.measured[valid, channel]))
        if self.problem.misjudged is not None:  # what the model cannot judge is no finding either
            smallest = max(smallest, BEYOND_DOUBT * float(np.sqrt(np.mean(self.problem.misjudged[valid, channel] ** 2))))
        if self.problem.channels[channel].name.startswith("rolling_consistency"):
            smallest = max(smallest, ROUNDNESS * float(np.sqrt(np.mean(self.problem.variables["speed"][valid] ** 2))))
        for name in self._promising(channel):
            functions, knots = self.bases[channel, name]
            found = self._dependence(channel, name, functions, knots, instances)
            gain, share = found.gain, found.share
            size = np.sqrt(share) * float(np.sqrt(np.mean(self.residual[valid, channel] ** 2)))
            passes = gain > threshold + LAW_MARGIN and share > SMALLEST_SHARE and size > smallest
            if passes and (best is None or gain > best.gain):
                own = self.problem.channels[channel].name
                formula = None if found.expression is None else f"{own} = {found.expression}"
                best = Leftover(own, name, share, gain, found.curve, expression=formula)
        return best

    def _promising(self, channel: int) -> list[str]:
        """Variables whose functions take a part of the residual as it is, the largest parts first, and few of them."""
        rows = np.flatnonzero(self.problem.valid[:, channel])
        rows = rows[:: max(1, len(rows) // PROMISING_SAMPLES)]
        left = self.residual[rows, channel]
        total = max(float(left @ left), 1e-300)
        parts = {}
        for (c, name), (functions, _) in self.bases.items():
            if c == channel:
                columns = np.column_stack([functions[rows], np.ones(len(rows))])
                moment = columns.T @ left
                gram = columns.T @ columns
                gram[np.diag_indices_from(gram)] += 1e-9 * np.trace(gram)
                parts[name] = float(moment @ np.linalg.solve(gram, moment)) / total
        ordered = sorted(parts, key=lambda name: -parts[name])[:MOST_PROMISING]
        return [name for name in ordered if parts[name] > 0.5 * SMALLEST_SHARE]

    def _dependence(
        self, channel: int, name: str, functions: FloatArray, knots: FloatArray, instances: Sequence[Instance]
    ) -> _Dependence:
        """What a function of one variable in one channel does, fitted beside the set."""
        farthest = FARTHEST if self._far[channel] else np.inf
        augmented = AugmentedFit(self.regression, instances, channel, functions, farthest)
        before, after = augmented.held_out_errors()
        # Few samples and many functions leave less than noise does; held-out errors say how much less.
        scale = max(after / self.regression.effective_rows, 1.0)
        weights = augmented.weights()
        valid = self.problem.valid[:, channel]
        total = float(np.sum(self.residual[valid, channel] ** 2))
        errors = augmented.held_out_residuals(self.problem, self.search.block, channel)
        share = 1.0 - float(np.sum(errors[valid] ** 2)) / max(total, 1e-300)
        order = np.argsort(self.problem.variables[name])
        if _is_angle(name):
            grid = knots
            curve = smooth_basis(grid, periodic=True)[0] @ weights
        else:
            grid = np.linspace(knots[0], knots[-1], 61)
            shape = functions[order] @ weights
            curve = np.interp(grid, self.problem.variables[name][order], shape)
        formula = plain_expression(name, self.problem.variables[name][valid], functions[valid] @ weights, _is_angle(name))
        return _Dependence(0.5 * (before - after) / scale, max(share, 0.0), (grid, curve), formula)

    def _vetoes(self, leftovers: Sequence[Leftover], threshold: float) -> list[tuple[Instance, str]]:
        """Instances that a leading dependence makes redundant and outdoes."""
        vetoed = []
        names = [channel.name for channel in self.problem.channels]
        for leftover in leftovers:
            channel = names.index(leftover.channel)
            functions, _ = self.bases[channel, leftover.variable]
            for instance in self.instances:
                if leftover.variable in self.problem.terms[instance.term].arguments:
                    continue
                others = [i for i in self.instances if i != instance]
                with_both = AugmentedFit(self.regression, self.instances, channel, functions).log_evidence()
                without = AugmentedFit(self.regression, others, channel, functions).log_evidence()
                own = (
                    self.regression.fit(self.instances).log_evidence
                    - self.regression.fit(others).log_evidence
                )
                captured = without - self.regression.fit(others).log_evidence
                if with_both - without < threshold and own < 0.5 * captured:
                    vetoed.append((instance, leftover.variable))
        return vetoed


class AugmentedFit:
    """A set of effects and a free function of one variable in one channel, fitted jointly."""

    def __init__(
        self,
        regression: WhitenedRegression,
        instances: Sequence[Instance],
        channel: int,
        functions: FloatArray,
        farthest: float = np.inf,
    ) -> None:
        """Put a function's values (T, K) beside a set.

        Args:
            regression: with the noise to fit by; instances: the set.
            channel: of the function; functions: its values.
            farthest: tolerances by which no number of the description may be off.
        """
        self.regression, self.farthest = regression, farthest
        self.instances = tuple(instances)
        problem = regression.problem
        self.columns = np.zeros((*problem.residual.shape, functions.shape[1]))
        self.columns[:, channel] = functions
        valid = problem.valid[:, channel]
        size = float(np.sqrt(np.mean(problem.residual[valid, channel] ** 2))) if valid.any() else 1.0
        spread = np.maximum(np.sqrt(np.mean(functions**2, axis=0)), 1e-300)
        self.own = functions.shape[1]
        self.deviations = np.concatenate([regression.deviations(self.instances), size / spread])

    @functools.cached_property
    def _grams(self) -> FloatArray:
        """Gram matrices of set, function and target by block; that of set and target is known to the regression."""
        regression = self.regression
        known = regression.grams(self.instances)
        set_size = known.shape[1] - 1
        own = np.arange(set_size, set_size + self.own)
        rest = np.r_[np.arange(set_size), set_size + self.own]
        beside = np.concatenate([regression.design(self.instances), regression.target[:, None]], axis=1)
        white = regression.whiten_columns(self.columns)
        grams = np.empty((len(known), len(rest) + self.own, len(rest) + self.own))
        grams[:, rest[:, None], rest] = known
        for gram, piece in zip(grams, regression.blocks, strict=True):
            cross = beside[piece].T @ white[piece]
            gram[rest[:, None], own], gram[own[:, None], rest] = cross, cross.T
            gram[own[:, None], own] = white[piece].T @ white[piece]
        return grams

    @functools.cached_property
    def _held_out_means(self) -> FloatArray:
        """Numbers of set and function (blocks, k) by all other blocks."""
        total = self._grams.sum(axis=0)
        return np.stack([self._posterior(total - gram, len(self.deviations)) for gram in self._grams])

    def _posterior(self, gram: FloatArray, count: int) -> FloatArray:
        """The first numbers (count,), those of the description as far off as they may be."""
        precision = gram[:count, :count] + np.diag(1.0 / self.deviations[:count] ** 2)
        mean = np.asarray(np.linalg.solve(precision, gram[:count, -1]), dtype=np.float64)
        limits = np.full(count, np.inf)
        numbers = self.regression.problem.nuisances
        limits[: len(numbers)] = [np.inf if number.loose else self.farthest * number.deviation for number in numbers]
        if np.all(np.abs(mean) <= limits):
            return mean
        root = np.linalg.cholesky(precision)
        bounded = optimize.lsq_linear(root.T, np.linalg.solve(root, gram[:count, -1]), (-limits, limits))
        return np.asarray(bounded.x, dtype=np.float64)

    def held_out_errors(self) -> tuple[float, float]:
        """Squared whitened error on held-out blocks without and with the function."""
        grams = self._grams
        total = grams.sum(axis=0)
        base = len(self.deviations) - self.own
        errors = [0.0, 0.0]
        for gram, everything in zip(grams, self._held_out_means, strict=True):
            for which, mean in enumerate((self._posterior(total - gram, base), everything)):
                count = len(mean)
                keep = np.r_[np.arange(count), gram.shape[0] - 1]
                extended = np.append(-mean, 1.0)
                errors[which] += float(extended @ gram[np.ix_(keep, keep)] @ extended)
        return errors[0], errors[1]

    def held_out_residuals(self, problem: RegressionProblem, block: IntArray, channel: int) -> FloatArray:
        """Residual of the channel in its own unit (T,), every block predicted from the others."""
        parts = [problem.nuisance_columns()[:, channel]]
        for instance in self.instances:
            parts.append(problem.columns(instance.term, instance.shape)[:, channel, list(instance.active)])
        plain = np.concatenate([*parts, self.columns[:, channel]], axis=1)
        residual = problem.residual[:, channel].copy()
        used = self.regression.block_labels()
        for label, mean in zip(used, self._held_out_means, strict=True):
            rows = block == label
            residual[rows] -= plain[rows] @ mean
        return residual

    def weights(self) -> FloatArray:
        """Coefficients of the function, from all blocks."""
        return self._posterior(self._grams.sum(axis=0), len(self.deviations))[-self.own :]

    def log_evidence(self) -> float:
        """Evidence of set and function, comparable with that of the regression's own fits."""
        gram = self._grams.sum(axis=0)
        scaled = gram[:-1, :-1] * np.outer(self.deviations, self.deviations) + np.eye(len(self.deviations))
        moment = gram[:-1, -1] * self.deviations
        factor = np.linalg.cholesky(scaled)
        half = np.linalg.solve(factor, moment)
        rss = float(gram[-1, -1] - half @ half)
        return -float(np.sum(np.log(np.diag(factor)))) - 0.5 * rss - sum(i.occam for i in self.instances)
