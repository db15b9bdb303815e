"""From a regression problem to what can be said: effects with numbers, doubts and look-alikes, and what is left.

    explanation = explain(problem, rng)

runs the search, the open-set test and, where something is left that depends on an argument of a named effect, tries the
refinements of that effect (a friction that differs forwards and backwards). A refined law is adopted if it gains more
evidence than a name needs, lowers the error on held-out blocks, and leaves nothing that depends on its arguments. Where none
is, a search is tried in which refinements are parameters like all others. If that finds none, too, the plain law stays, and a
refinement is reported with the leftover: it is the first suspect for physics that the library does not hold in full.

A refinement may stand for what a plain effect stood for before (an asymmetry of friction for an offset). That effect is
put out only where the recording decides against it, by the odds that separate look-alikes. Where it does not decide, the
effect keeps its name, its interval from the joint fit and its probability, and is said to be ambiguous with the refined
one. Whether it is there was asked with its size under the plain law as the scale: a wider one would rule out any effect.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from scipy import stats

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.registry import all_effects, get

from ..found_effect import effect_instance
from ..regression.noise_model import channel_deviations
from ..regression.regression_problem import (
    HEALTHY,
    LOOSE_STRAINED,
    STRAINED,
    TAKEN_OVER,
    FloatArray,
    RegressionProblem,
    Term,
)
from ..regression.whitened_regression import Fit, Instance, WhitenedRegression
from ..search.acting_torques import is_reported, place_of_error
from ..search.effect_gates import EffectGates
from ..search.evidence_selection import EffectSearch, Selection
from ..search.open_set import SMALLEST_SHARE, Leftover, OpenSetResult, OpenSetTest, is_unknown, judge
from ..search.outline_search import Outlines
from ..search.selection_settings import SelectionSettings
from ..search.set_growth import LadderStep, Progress
from ..search.shape_search import DROP, refined_shape, shape_interval
from ..search.shape_slopes import slope_instances, with_slopes

# A look-alike within so many nats of a named effect cannot be told from it.
AMBIGUOUS = 3.0
# Nor can two effects in its place within so many: that there is one number more to choose costs about as much again.
TWO_AMBIGUOUS = 6.0
# What more than so many others would do as well is nothing that a name says anything of.
MOST_ALIKE = 5
# An effect of this part of the size that it had without a refinement was what that refinement is.
NEXT_TO_NOTHING = 0.2
# What a refinement of a named effect has to make up for against a further plain effect: the plain laws come first.
REFINEMENT_LOG_PRIOR = -3.0
# Half-width of 95 % of a Gaussian, in deviations.
HALF_WIDTH = 1.96
# Columns of an effect and of a number that are alike to this are those of one thing.
SAME = 0.9999
# Effects and numbers that share out among each other what all torques do to the robot, and how much such an effect is believed
# beside such numbers that no healthy robot has.
OF_THE_BALANCE = ("payload_mass", "payload_offset", "torque_constant_error")
NUMBERS_OF_THE_BALANCE = (
    "chassis.", "module.", "wheel.inertia", "rotors.", "torque_constant/", "inertia", "gravity_moment",
)  # fmt: skip
# Of wheels that cannot contradict each other these look like a slip in proportion to the motion.
OF_ROLLING, CONSISTENCY = ("wheel_radius_error", "caster_offset_error"), "rolling_consistency/"
HALF_AS_SURE = 0.5
# No effect does what these do.
HIDES_NOTHING = ("heading_lead",)
# An effect that hides behind a number leaves less than this part of its strain's square.
RELIEF = 0.5


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

    @property
    def effect(self) -> EffectInstance:
        """The effect with all its parameters, as it stands under `physics:`."""
        values = {name: estimate.value for name, estimate in self.estimates.items()}
        return effect_instance(self.term.effect, self.term.target, values, self.term.axis)


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
        remarks: what an adopted refinement changed, and why names are less sure, in plain sentences.
        floor: rms of each channel that nothing measured explains (C,).
        p_values: of each channel holding noise and tolerances only (C,).
        doubtful: names that have to be borne out by held-out data, see `nearest_effect`.
    """

    search: EffectSearch
    selection: Selection
    named: tuple[NamedTerm, ...]
    leftovers: tuple[Leftover, ...]
    withdrawn: tuple[tuple[str, str], ...]
    refinement: Refinement | None
    remarks: tuple[str, ...]
    floor: FloatArray
    p_values: FloatArray
    doubtful: frozenset[Instance] = frozenset()

    @property
    def fit(self) -> Fit:
        """Joint posterior of tolerances and effects."""
        return self.selection.fit

    @property
    def complete(self) -> bool:
        """Whether nothing is left."""
        return not self.leftovers

    def nearest(self) -> LadderStep | None:
        """What explained most of all that was refused although it explained enough for a name; None if nothing did."""
        steps = self.selection.ladder
        refused = [step for step in steps if step.refused is not None and step.gain >= self.selection.threshold]
        return max(refused, key=lambda step: step.gain, default=None)


def explain(
    problem: RegressionProblem,
    rng: np.random.Generator,
    settings: SelectionSettings | None = None,
    progress: Progress = lambda message: None,
) -> Explanation:
    """Search, test what is left, refine; see the module."""
    search, selection = search_effects(problem, rng, settings, progress)
    selection = _with_whole_numbers(search, selection)
    result = OpenSetTest(search, selection.fit.instances).run(selection.threshold)
    suspect: Refinement | None = None
    doubts: dict[Instance, tuple[float, str]] = {}
    remarks: tuple[str, ...] = ()
    # A refined law of the library comes before any law outside it: what a friction that differs between directions explains
    # is no unknown function of the speed.
    refined = None
    for attempt in (_refined, _refined_from_the_start):
        tried = attempt(search, selection, result)
        if tried is None:
            continue
        finished = OpenSetTest(search, tried.instances).run(selection.threshold)
        arguments = problem.terms[tried.instances[tried.position].term].arguments
        better = search.conclude(tried.instances, selection.threshold)
        if not finished.vetoed and not {left.variable for left in finished.leftovers} & set(arguments):
            progress(f"refined: {search.label(tried.instances[tried.position])}, {tried.gain:.1f} nats")
            remarks = _remarks(search, selection, tried)
            selection, result, doubts = better, finished, tried.doubts(problem)
            refined, suspect = tried, None
            break
        if refined is None:
            refined = tried
            suspect = Refinement(named_terms(search, better), tried.put_out(search), tried.gain, tried.share)
            progress(f"not adopted: {suspect.describe()}")
    judgement = judge(search, selection, result)
    search, result = judgement.search, judgement.result
    selection = search.balanced(_taking_over(search, search.polished(judgement.selection)))
    selection, entries = _telling(search, selection)
    problem = search.problem
    named = tuple(
        dataclasses.replace(entry, probability=entry.probability * judgement.beliefs.get(entry.instance.term, 1.0))
        for entry in entries
        if not is_unknown(problem, entry.instance)
    )
    if refined is not None:
        if suspect is not None:
            rival = problem.terms[refined.instances[refined.position].term].effect
            doubts = {entry.instance: (entry.probability, rival) for entry in named if entry.term.effect in suspect.dropped}
        named = tuple(_doubted(entry, doubts) for entry in named)
    return Explanation(
        search=search,
        selection=selection,
        named=named,
        leftovers=result.leftovers,
        withdrawn=judgement.withdrawn,
        refinement=suspect,
        remarks=(*remarks, *judgement.doubts),
        floor=result.floor,
        p_values=_p_values(search, selection, result),
    )


def search_effects(
    problem: RegressionProblem, rng: np.random.Generator, settings: SelectionSettings | None, progress: Progress
) -> tuple[EffectSearch, Selection]:
    """Search, and once more with narrower tolerances where numbers come out as no healthy robot's do.

    A number that strains its tolerance costs less than an effect has to explain: a payload hides behind a mass that is off by
    ten times what it may be. What is found counts if it relieves the numbers, and strains no others instead, and explains more
    than what was found before.
    Fewer effects count also if they explain hardly less: what undoes effects that are too large fits the model's own errors.
    """
    search = EffectSearch(problem, rng, settings, progress)
    selection = search.run()
    strained = _strained(problem, selection.fit)
    if not strained:
        return search, selection
    progress(f"once more with narrower tolerances of {', '.join(strained)}")
    firm = problem.narrowed({name: HEALTHY / strain for name, strain in strained.items()})
    again = EffectSearch(firm, rng, settings, progress)
    instead = again.run()
    here, there = (_strains(problem, fit) for fit in (selection.fit, instead.fit))
    looked_at = strained.keys() | _strained(problem, instead.fit).keys()
    relief = sum(there[name] ** 2 for name in looked_at) / sum(here[name] ** 2 for name in looked_at)
    gain = again.advantage(instead, selection.fit.instances)
    progress(f"strains left {relief:.2f} of them, {gain:.1f} nats more")
    fewer = len(instead.fit.instances) < len(selection.fit.instances)
    wanted = -again.settings.least_peculiar if fewer else instead.threshold
    if relief >= RELIEF or gain <= wanted:
        return search, selection
    return again, again.with_whole_tolerances(instead, list(strained))


def _strains(problem: RegressionProblem, fit: Fit) -> dict[str, float]:
    """By how many tolerances the numbers of the description come out of it."""
    return {n.name: abs(float(mean)) / n.deviation for n, mean in zip(problem.nuisances, fit.mean, strict=False)}


def _strained(problem: RegressionProblem, fit: Fit) -> dict[str, float]:
    """Those of numbers that come out as no healthy robot's do, and behind which an effect may hide."""
    most = {number.name: LOOSE_STRAINED if number.loose else STRAINED for number in problem.nuisances}
    strains = _strains(problem, fit).items()
    return {name: strain for name, strain in strains if name not in HIDES_NOTHING and strain > most[name]}


def _telling(search: EffectSearch, selection: Selection) -> tuple[Selection, tuple[NamedTerm, ...]]:
    """The selection without effects in whose place nearly any other would do, and what is named by it.

    Which of two or three it is an experiment can tell. That any of thirty would do says that something is left, and no more.
    """
    while True:
        entries = named_terms(search, selection)
        alike = [0 if is_unknown(search.problem, entry.instance) else len(set(entry.ambiguous_with)) for entry in entries]
        index = int(np.argmax(alike)) if alike else 0
        if not alike or alike[index] <= MOST_ALIKE:
            return selection, entries
        search.note_drop(entries[index].instance, entries[index].loss, f"as good as {alike[index]} others")
        rest = tuple(entry.instance for entry in entries if entry is not entries[index])
        selection = search.conclude(search.made_exact(rest), selection.threshold)


def _with_whole_numbers(search: EffectSearch, selection: Selection) -> Selection:
    """The selection with whole numbers where a shaping parameter should be one and the recording does not object."""
    regression, instances = selection.regression, selection.fit.instances
    for index, instance in enumerate(instances):
        shape = dict(instance.shape)
        nearest = {name: float(round(shape[name])) for name in search.problem.terms[instance.term].whole}
        if not nearest or 0.0 in nearest.values():
            continue
        others = (*instances[:index], *instances[index + 1 :])
        rounded = regression.with_shape(instance, shape | nearest)
        trial = (*instances[:index], rounded, *instances[index + 1 :])
        loss = regression.fit(instances).log_evidence - regression.fit(trial).log_evidence
        search.progress(f"{search.label(instance)} as {search.label(rounded)}: {loss:.1f} nats lost")
        if loss < AMBIGUOUS and not search.repeats(rounded, others):
            instances = trial
    return selection if instances == selection.fit.instances else search.conclude(instances, selection.threshold)


def _taking_over(search: EffectSearch, selection: Selection) -> Selection:
    """The selection in which effects take over what numbers that are the same thing have of it.

    A steering that is turned by 0.2 rad is said to be so, and not by 0.18 with a re-tuned zero for the rest: how much of it
    lies within the tolerance nothing tells. That stays in the effect's interval. An effect that is then all within what a
    healthy robot's numbers may be is given back to them.
    """
    description, fit = search.description, selection.fit
    valid = description.valid
    scale = np.where(valid, 1.0 / channel_deviations(description.residual, valid), 0.0)[:, :, None]
    numbers = (description.nuisance_columns() * scale).reshape(valid.size, -1)
    lengths = np.linalg.norm(numbers, axis=0)
    held = {}
    for instance in fit.instances:
        if is_unknown(search.problem, instance):
            continue
        columns = (description.columns(instance.term, instance.shape) * scale).reshape(valid.size, -1)
        for k in instance.active:
            products, size = numbers.T @ columns[:, k], float(np.linalg.norm(columns[:, k]))
            for j in np.flatnonzero(np.abs(products) > SAME * np.maximum(size * lengths, 1e-300)):
                number = description.nuisances[j]
                held[number.name] = (instance.term, k), abs(float(products[j])) / size**2 * number.deviation
    if not held:
        return selection
    before = {number.name: number.narrowed for number in search.problem.nuisances if number.name in held}
    search.taken_over = dict(held.values())
    search.problem = search.problem.narrowed(dict.fromkeys(held, TAKEN_OVER))
    chosen = search.conclude(search.made_exact(fit.instances), selection.threshold)
    tolerated = _tolerated(search, chosen)
    if tolerated is None:
        return chosen
    search.taken_over = {}
    search.problem = search.problem.narrowed(before)
    search.note_drop(chosen.fit.instances[tolerated], chosen.losses[tolerated], "within the tolerances")
    rest = chosen.fit.instances[:tolerated] + chosen.fit.instances[tolerated + 1 :]
    return _taking_over(search, search.conclude(search.made_exact(rest), selection.threshold))


def _tolerated(search: EffectSearch, selection: Selection) -> int | None:
    """An effect that is the same thing as numbers of the description, and no more of it than a healthy robot's; or None."""
    position = len(search.problem.nuisances)
    for index, instance in enumerate(selection.fit.instances):
        room = np.array([search.taken_over.get((instance.term, k), 0.0) for k in instance.active])
        sizes = np.abs(selection.fit.mean[position : position + len(room)])
        position += len(room)
        if len(room) and np.all(sizes < HEALTHY * room):
            return index
    return None


def explanation_by(explanation: Explanation, instances: Sequence[Instance], known: bool = False) -> Explanation:
    """Return the explanation by these effects alone: made exact and fitted again, and what is left tested again.

    Where the problem was exact with others at work numbers stand as beside those: what they then leave is no finding.

    Args:
        explanation: of the same problem.
        instances: effects.
        known: whether they are there as they are whatever this problem says, as others know of them.
    """
    search, threshold = explanation.search, explanation.selection.threshold
    if known:
        selection = search.conclude(instances, threshold)
    else:
        selection = search.conclude(search.made_exact(tuple(instances)), threshold)
        selection = search.balanced(search.bounded(search.retuned_away(selection)))
    instances = selection.fit.instances
    result = OpenSetTest(search, selection.fit.instances).run(threshold)
    return dataclasses.replace(
        explanation,
        selection=selection,
        named=tuple(entry for entry in named_terms(search, selection) if not is_unknown(search.problem, entry.instance)),
        leftovers=(*(left for left in explanation.leftovers if left.law is not None), *result.leftovers),
        floor=result.floor,
        p_values=_p_values(search, selection, result),
    )


def explanation_instead(explanation: Explanation, own: Instance, rival: Instance) -> Explanation:
    """Return the explanation with another effect in one's place, made exact there; what it was is to be come back to."""
    others = tuple(instance for instance in explanation.fit.instances if instance != own)
    return explanation_by(explanation, (*others, rival))


def _doubted(entry: NamedTerm, doubts: Mapping[Instance, tuple[float, str]]) -> NamedTerm:
    """The entry, said to be ambiguous with another effect if the recording does not decide between them."""
    if entry.instance not in doubts:
        return entry
    probability, rival = doubts[entry.instance]
    return dataclasses.replace(entry, ambiguous_with=(rival,), probability=probability)


def _remarks(search: EffectSearch, plain: Selection, refined: _Refined) -> tuple[str, ...]:
    """What became of the effects that an adopted refinement can stand for."""
    problem = search.problem
    law = problem.terms[refined.instances[refined.position].term].effect
    remarks = []
    for instance, values in zip(plain.fit.instances, _estimates(problem, plain.fit), strict=True):
        term = problem.terms[instance.term]
        if instance in refined.instances and instance not in refined.undecided:
            continue
        if term.effect == law:
            continue
        undecided = instance in refined.undecided or (instance == refined.instead and refined.gain < AMBIGUOUS)
        fate = "do not decide whether it is there" if undecided else "decide against it"
        numbers = " and ".join(
            f"{term.parameters[k].name} = {value:.3g} {term.parameters[k].unit}"
            for k, value in zip(instance.active, values, strict=True)
        )
        remarks.append(
            f"With a symmetric {law} there would be {term.effect} ({numbers}); with the refined one the recordings {fate}."
        )
    return tuple(remarks)


@dataclasses.dataclass(frozen=True)
class _Refined:
    """A set with one instance refined.

    Attributes:
        plain: the set before.
        instances: the refined set, without what the recording decides against.
        position: of the refined instance.
        undecided: probability of instances that the refined set does as well without.
        gain: nats over the plain set; share: part of its remaining mean square that is explained.
        instead: what the refinement is in the place of; None where it was found beside all others.
    """

    plain: tuple[Instance, ...]
    instances: tuple[Instance, ...]
    position: int
    undecided: dict[Instance, float]
    gain: float
    share: float
    instead: Instance | None = None

    def doubts(self, problem: RegressionProblem) -> dict[Instance, tuple[float, str]]:
        """Probability of what the recording does not decide, and the effect that would do instead."""
        law = problem.terms[self.instances[self.position].term].effect
        doubts = {instance: (probability, law) for instance, probability in self.undecided.items()}
        if self.instead is not None and self.gain < AMBIGUOUS:
            instead = problem.terms[self.instead.term].effect
            doubts[self.instances[self.position]] = 1.0 / (1.0 + math.exp(-self.gain)), instead
        return doubts

    def put_out(self, search: EffectSearch) -> tuple[str, ...]:
        """Effects of the plain set that the refined one has no need of."""
        left = {instance.term for instance in self.instances if instance not in self.undecided}
        return tuple(sorted({search.problem.terms[i.term].effect for i in self.plain if i.term not in left}))


def _refined(search: EffectSearch, selection: Selection, result: OpenSetResult) -> _Refined | None:
    """The set with the one refinement that gains most, if any explains what is left or stands for a plain effect.

    Whatever a leftover seems to depend on, and where none is told as well, if the refinement passes the gates of an effect: a
    friction that differs between directions leaves, of a steering, a torque by its angle, or noise that it is itself.
    """
    problem, threshold = search.problem, selection.threshold
    best: _Refined | None = None
    plain = selection.fit.instances
    before = float(np.sum(search.residual_of(plain)[problem.valid] ** 2))
    for position, instances in _refinements(problem, plain):
        own = selection.regression
        under_own = own.fit(instances)
        if not result.leftovers and under_own.log_evidence < selection.fit.log_evidence + threshold:
            continue
        residual = search.residual_of(instances)
        # Judged under the noise of the better model: under that of the worse one a refinement is "slow noise".
        regression = search.whiten_at(residual)
        fit, plain_fit = regression.fit(instances), regression.fit(plain)
        gain = fit.log_evidence - plain_fit.log_evidence + REFINEMENT_LOG_PRIOR
        held_out = float(np.sum(regression.block_scores(plain) - regression.block_scores(instances)))
        if gain < threshold or held_out <= 0.0 or not regression.within_bounds(fit):
            continue
        if best is not None and gain < best.gain:
            continue
        share = 1.0 - float(np.sum(residual[problem.valid] ** 2)) / max(before, 1e-300)
        kept, undecided = _still_needed(search, regression, instances, position, plain_fit, threshold)
        solid = [instance for instance in kept if instance not in undecided]
        instead = regression.fit(solid).log_evidence + REFINEMENT_LOG_PRIOR - plain_fit.log_evidence
        stands_in = len(solid) < len(plain) and instead > AMBIGUOUS
        explains = result.leftovers or EffectGates(problem, search.settings).refinement_counts(
            own, selection.fit, position, under_own
        )
        if (explains and share > SMALLEST_SHARE) or stands_in:
            best = _Refined(plain, kept, kept.index(instances[position]), undecided, gain, share)
    if best is None:
        return _instead_of_another(search, selection)
    return _searched_again(search, best, threshold)


def _refined_from_the_start(search: EffectSearch, selection: Selection, result: OpenSetResult) -> _Refined | None:
    """The set of a search in which refinements are parameters like all others, each kept where the recording needs it.

    What a refinement and a further effect, or two refinements, explain together looks like slow noise as long as any of it is
    missing: step by step neither is found. Where no effect is named there is none to refine.
    """
    problem, threshold, plain = search.problem, selection.threshold, selection.fit.instances
    whole = tuple(
        dataclasses.replace(term, parameters=tuple(dataclasses.replace(p, refinement=False) for p in term.parameters))
        for term in problem.terms
    )
    if not plain or not result.leftovers or whole == problem.terms:
        return None
    instances = EffectSearch(dataclasses.replace(problem, terms=whole), search.rng, search.settings).run().fit.instances
    regression = search.whiten_beside(instances)
    while True:
        own = regression.fit(instances).log_evidence
        losses = {}
        for position, instance in enumerate(instances):
            needed = [k for k in instance.active if not problem.terms[instance.term].parameters[k].refinement]
            if needed and len(needed) < len(instance.active):
                simpler = dataclasses.replace(instance, active=tuple(needed))
                fewer = (*instances[:position], simpler, *instances[position + 1 :])
                losses[position] = own - regression.fit(fewer).log_evidence, fewer
        if not losses:
            return None
        loss, fewer = min(losses.values(), key=lambda one: one[0])
        if loss > threshold - REFINEMENT_LOG_PRIOR:
            break
        instances = fewer
    fit, before = regression.fit(instances), regression.fit(plain)
    gain = fit.log_evidence - before.log_evidence + len(losses) * REFINEMENT_LOG_PRIOR
    held_out = float(np.sum(regression.block_scores(plain) - regression.block_scores(instances)))
    if gain < threshold or held_out <= 0.0 or not regression.within_bounds(fit):
        return None
    left = [float(np.sum(search.residual_of(chosen)[problem.valid] ** 2)) for chosen in (plain, instances)]
    position = max(losses, key=lambda one: losses[one][0])
    return _Refined(plain, instances, position, {}, gain, 1.0 - left[1] / max(left[0], 1e-300))


def _instead_of_another(search: EffectSearch, selection: Selection) -> _Refined | None:
    """The set with one instance refined in place of another one, if such a smaller set explains more.

    A friction that differs between directions and one with a constant load differ at rest only: beside the load the
    difference gains nothing, in its place it may do better.
    """
    regression, plain = selection.regression, selection.fit.instances
    best: _Refined | None = None
    for position, refined in _refinements(search.problem, plain):
        for other in range(len(plain)):
            instances = refined[:other] + refined[other + 1 :]
            if other == position:
                continue
            fit = regression.fit(instances)
            gain = fit.log_evidence - selection.fit.log_evidence
            if gain > (best.gain if best else 0.0) and regression.within_bounds(fit):
                best = _Refined(plain, instances, instances.index(refined[position]), {}, gain, 0.0, plain[other])
    return best


def _searched_again(search: EffectSearch, refined: _Refined, threshold: float) -> _Refined:
    """The refined set with what the plain law hid added, and its other stand-ins exchanged or dropped."""
    keeper = refined.instances[refined.position]
    solid = tuple(instance for instance in refined.instances if instance not in refined.undecided)
    regression = search.whiten_beside(refined.instances)
    grown = search.grow(regression, search.improve(regression, solid), search.settings.lenient_gain)
    found = search.prune(regression, grown, threshold).fit.instances
    if keeper not in found:
        return refined
    terms = {instance.term for instance in found}
    undecided = {i: probability for i, probability in refined.undecided.items() if i.term not in terms}
    # In the order of the plain set, what is new at the end.
    order = [i for i in refined.instances if i in found or i in undecided]
    instances = (*order, *(instance for instance in found if instance not in order))
    return dataclasses.replace(
        refined, instances=instances, position=instances.index(keeper), undecided=undecided
    )


def _still_needed(
    search: EffectSearch,
    regression: WhitenedRegression,
    instances: tuple[Instance, ...],
    refined: int,
    plain_fit: Fit,
    threshold: float,
) -> tuple[tuple[Instance, ...], dict[Instance, float]]:
    """The instances that the recording does not decide against, and the probability of those that it does not decide for."""
    sizes = dict(zip(plain_fit.instances, _estimates(search.problem, plain_fit), strict=True))
    keeper = instances[refined]
    while True:
        fit = regression.fit(instances)
        losses, held_out, shares = EffectGates(search.problem, search.settings).judge(regression, instances, fit)
        evidence = {}
        for instance, loss, gain, share in zip(instances, losses, held_out, shares, strict=True):
            if instance != keeper and (loss < threshold or gain <= 0.0 or share < 1.0):
                evidence[instance] = _size_evidence(search.problem, fit, instance, sizes[instance])
        against = min(evidence, key=lambda instance: evidence[instance], default=None)
        if against is None or evidence[against] > -AMBIGUOUS:
            return instances, {instance: 1.0 / (1.0 + math.exp(-value)) for instance, value in evidence.items()}
        instances = tuple(instance for instance in instances if instance != against)


def _size_evidence(problem: RegressionProblem, fit: Fit, instance: Instance, size: FloatArray) -> float:
    """Log odds that an instance is there, of about a given size (P,), against that it is not; none for next to nothing."""
    index = fit.instances.index(instance)
    start = len(problem.nuisances) + sum(len(other.active) for other in fit.instances[:index])
    rows = slice(start, start + len(instance.active))
    mean, covariance = fit.mean[rows], fit.covariance[rows, rows]
    if np.all(np.abs(mean) + 2.0 * np.sqrt(np.diag(covariance)) < NEXT_TO_NOTHING * np.abs(size)):
        return -math.inf
    wide = covariance + np.diag(np.maximum(size**2, 1e-300))
    odds = np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(wide)[1]
    odds += mean @ (np.linalg.solve(covariance, mean) - np.linalg.solve(wide, mean))
    return 0.5 * float(odds)


def _estimates(problem: RegressionProblem, fit: Fit) -> list[FloatArray]:
    """Estimated active parameters of every instance of a fit."""
    ends = np.cumsum([len(problem.nuisances), *(len(instance.active) for instance in fit.instances)])
    return [fit.mean[start:stop] for start, stop in zip(ends[:-1], ends[1:], strict=True)]


def _with_whole_tolerances(problem: RegressionProblem, covariance: FloatArray) -> FloatArray:
    """Covariance (k, k) of a fit's numbers with the whole tolerances of those that were narrowed.

    Less room for a number tells which effect it is, and nothing of how much of that lies within what a healthy robot has.
    """
    whole = covariance
    for j, number in enumerate(problem.nuisances):
        if TAKEN_OVER < number.narrowed < 1.0:
            added = (number.narrowed**-2 - 1.0) / number.deviation**2  # precision that is none of the recording's
            left = max(1.0 - added * whole[j, j], number.narrowed**2)
            whole = whole + np.outer(whole[:, j], whole[:, j]) * added / left
    return whole


def named_terms(search: EffectSearch, selection: Selection) -> tuple[NamedTerm, ...]:
    """Numbers, intervals, probability and look-alikes of every effect of a selection."""
    # By columns of another place a payload's place would be told from the centre of mass that does the same.
    problem, regression, fit = search.exact_problem(selection), selection.regression, selection.fit
    # How large an effect is and which shape it has are known together: a payload that is nearer may be heavier.
    sloped, slopes = with_slopes(problem.tangent(), fit.instances, _estimates(problem, fit), search.outlines)
    there = regression if sloped is problem else regression.moved(sloped)
    known = there.fit((*fit.instances, *slope_instances(sloped, slopes)))
    misfit, whole = there.misfit_covariance(known), _with_whole_tolerances(problem, known.covariance)
    deviations = np.sqrt(np.diag(known.covariance))
    beside_all = {(s.index, s.name): (s, float(d)) for s, d in zip(slopes, deviations[len(fit.mean) :], strict=True)}
    widening = np.maximum(np.diag(misfit) / np.maximum(np.diag(known.covariance), 1e-300), 1.0)
    numbers = [nuisance.name for nuisance in problem.nuisances]
    position, error = len(numbers), place_of_error(problem, fit.instances)
    named = []
    for index, instance in enumerate(fit.instances):
        term = problem.terms[instance.term]
        estimates, active = {}, len(instance.active)
        for offset, parameter_index in enumerate(instance.active):
            parameter = term.parameters[parameter_index]
            if parameter.hidden:
                continue
            parts = [position + offset, *(numbers.index(name) for name in numbers if name == parameter.number)]
            value, gradient = float(fit.mean[parts].sum()), np.zeros(len(known.mean))
            gradient[parts] = 1.0
            if error is not None and is_reported(term):
                gradient *= 1.0 + float(fit.mean[error])
                gradient[error] = value
                value *= 1.0 + float(fit.mean[error])
            variance = max(float(gradient @ covariance @ gradient) for covariance in (whole, misfit))
            power = problem.powers.get((instance.term, instance.shape, parameter_index), 1.0)
            within = search.taken_over.get((instance.term, parameter_index), 0.0)
            relative = math.hypot(problem.scale_deviation / power, term.unsure.get(parameter.name, 0.0))
            half = HALF_WIDTH * math.hypot(math.sqrt(variance), within, relative * value)
            low, high = parameter.interval(value - half, value + half)
            estimates[parameter.name] = Estimate(parameter.value(value), parameter.unit, low, high)
        others = fit.instances[:index] + fit.instances[index + 1 :]
        around = problem.around(instance.term, instance.shape)
        near = regression if around is problem else regression.moved(around)
        wider = float(widening[position : position + active].max())
        for name, value in instance.shape:
            low, high = shape_interval(near, others, instance, name, wider)
            if (index, name) in beside_all:
                slope, deviation = beside_all[index, name]
                first, last = slope.interval(instance, HALF_WIDTH * deviation)
                low, high = min(low, first), max(high, last)
            estimates[name] = Estimate(value, "", low, high)
        if instance.term in search.outlines:
            estimates = _as_wide(estimates, term, instance, search.outlines[instance.term], DROP * wider)
        for name, deviation in term.blur.items():
            estimates[name] = _blurred(estimates[name], HALF_WIDTH * deviation)
        columns = problem.columns(instance.term, instance.shape)[..., list(instance.active)]
        contribution = columns @ fit.mean[position : position + active]
        position += active
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
    doubted = _doubted_beside_friction(_doubted_by_scale(named))
    doubtful = set(OF_THE_BALANCE if strained_of_the_balance(problem, selection.fit) else ())
    doubtful |= set(OF_ROLLING if cannot_contradict(problem) else ())
    return tuple(
        dataclasses.replace(entry, probability=HALF_AS_SURE * entry.probability) if entry.term.effect in doubtful else entry
        for entry in doubted
    )


def cannot_contradict(problem: RegressionProblem) -> bool:
    """Whether wheels are redundant and yet say nothing of one another, as those of one axle that never turn."""
    told = [problem.valid[:, c].any() for c, channel in enumerate(problem.channels) if channel.name.startswith(CONSISTENCY)]
    return bool(told) and not any(told)


def strained_of_the_balance(problem: RegressionProblem, fit: Fit) -> list[str]:
    """Masses, inertias and torque constants that come out as none of a healthy robot does.

    Whatever else is missing there is shared out among them and the effects that do the same to the balance of forces.
    """
    return [
        number.name for number, mean in zip(problem.nuisances, fit.mean, strict=False)
        if number.name.startswith(NUMBERS_OF_THE_BALANCE) and number.narrowed != TAKEN_OVER and not number.loose
        and abs(float(mean)) > STRAINED * number.deviation
    ]  # fmt: skip


def _as_wide(
    estimates: Mapping[str, Estimate], term: Term, instance: Instance, outlines: Outlines, drop: float
) -> dict[str, Estimate]:
    """Estimates with intervals that hold at least those outlines of a patch, and their sizes, that do as well [nats]."""
    shape, sizes = outlines.ranges(drop)
    wanted = dict(shape)
    for k, ends in zip(instance.active, sizes, strict=True):
        parameter = term.parameters[k]
        wanted[parameter.name] = parameter.interval(*(float(end) for end in ends))
    return {
        name: dataclasses.replace(e, low=min(e.low, *wanted[name]), high=max(e.high, *wanted[name]))
        if name in wanted else e
        for name, e in estimates.items()
    }  # fmt: skip


def _blurred(estimate: Estimate, half: float) -> Estimate:
    """An estimate that is uncertain by so much besides what its interval says."""
    below, above = estimate.value - estimate.low, estimate.high - estimate.value
    low, high = estimate.value - math.hypot(below, half), estimate.value + math.hypot(above, half)
    return dataclasses.replace(estimate, low=low, high=high)


def _doubted_by_scale(named: Sequence[NamedTerm]) -> tuple[NamedTerm, ...]:
    """Say what else would do where one effect is on all casters with the same numbers at the drives and at the steerings.

    Torques that are all wrong by one factor are also masses that are all wrong by it. An axis has only one.
    """
    doubted = [_doubted_by_load(entry) if entry.term.target == ("axis",) else entry for entry in named]
    for first, second in itertools.combinations(range(len(named)), 2):
        one, other = named[first], named[second]
        same = one.term.effect == other.term.effect and one.term.target == other.term.target and len(one.term.target) > 1
        pairs = [(one.estimates[name], other.estimates[name]) for name in one.estimates if name in other.estimates]
        overlap = all(a.low <= b.high and b.low <= a.high for a, b in pairs)
        if not (same and pairs and overlap and one.term.axis != other.term.axis):
            continue
        alike = tuple(name for name in get(one.term.effect).look_alikes if get(name).target_kind == "chassis")
        if not alike:
            continue
        for index in (first, second):
            entry = doubted[index]
            ambiguous = tuple(dict.fromkeys((*entry.ambiguous_with, *alike)))
            # Which of them, the recordings do not say.
            probability = min(entry.probability, 1.0 / (1.0 + len(alike)))
            doubted[index] = dataclasses.replace(entry, ambiguous_with=ambiguous, probability=probability)
    return tuple(doubted)


def _doubted_by_load(entry: NamedTerm) -> NamedTerm:
    """Say of an error of an axis's torque constant that a load on it, which moves along, does the same."""
    if entry.term.effect != "torque_constant_error":
        return entry
    ambiguous = tuple(dict.fromkeys((*entry.ambiguous_with, "payload_mass")))
    return dataclasses.replace(entry, ambiguous_with=ambiguous, probability=min(entry.probability, 0.5))


def _doubted_beside_friction(named: Sequence[NamedTerm]) -> tuple[NamedTerm, ...]:
    """Say of a constant load on a caster's joint that rubs that it is what a Coulomb friction does which has two sizes.

    -c sign(q_dot) - l is a friction of c + l one way and c - l the other; which it is, no recording says.
    """
    rubs: dict[tuple[tuple[str, ...], str | None], str] = {}
    for entry in named:
        numbers = {parameter.name: k for k, parameter in enumerate(entry.term.parameters)}
        if {"coulomb", "asymmetry"} <= numbers.keys() and numbers["asymmetry"] not in entry.instance.active:
            rubs[entry.term.target, _axis(entry.term)] = entry.term.effect
    doubted = []
    for entry in named:
        term, friction = entry.term, None
        if term.effect == "constant_load" and term.target != ("axis",):
            friction = rubs.get((term.target, _axis(term)))
        if friction is not None:
            ambiguous = tuple(dict.fromkeys((*entry.ambiguous_with, friction)))
            entry = dataclasses.replace(entry, ambiguous_with=ambiguous, probability=min(entry.probability, 0.5))
        doubted.append(entry)
    return tuple(doubted)


def _alternatives(search: EffectSearch, selection: Selection, index: int) -> tuple[float, tuple[str, ...]]:
    """Probability of an instance among the sets without it, with another term instead or besides, and its look-alikes."""
    problem, regression, fit = search.problem, selection.regression, selection.fit
    own = fit.instances[index]
    others = fit.instances[:index] + fit.instances[index + 1 :]
    without = regression.fit(others)
    rivals = [without.log_evidence - fit.log_evidence]
    alike = []
    # Far from where the problem is exact now, a first order says little of a rival: what it reached where it is exact counts.
    # One that has been named since, beside this effect, is no rival any more.
    beside = {other.term for other in others}
    where_exact = {
        rival: odds
        for (named, rival), odds in search.where_exact.items()
        if named == own.term and rival not in beside | search.contradicted
    }
    for position, refined in _refinements(problem, others):
        trial = regression.fit(refined)
        # A refined law in place of a further effect is as likely as that: neither is the plainer one.
        difference = trial.log_evidence - fit.log_evidence
        if regression.within_bounds(trial):
            rivals.append(difference)
            if difference > -AMBIGUOUS:
                alike.append(problem.terms[refined[position].term].effect)
    for form in _refined_forms(problem, own) if own.active != problem.terms[own.term].base_indices() else ():
        trial = regression.fit((*others, form))
        if regression.within_bounds(trial):
            rivals.append(regression.log_odds(trial, fit))
            if rivals[-1] > -AMBIGUOUS:
                alike.append(problem.terms[form.term].effect)
    for rival, usual in search.usual_rivals(regression, others, own):
        if rival.term in search.contradicted:
            continue
        rivals.append(regression.log_odds(usual, fit))
        if rivals[-1] > -AMBIGUOUS:
            alike.append(_called(problem.terms[own.term], problem.terms[rival.term]))
    pair = _pair_of_the_balance(problem, others, own)
    if pair and (odds := search.odds_instead(selection, others, pair)) > -TWO_AMBIGUOUS:
        # That a robot carries a load besides speaks against nothing; two errors of all motors are rarer than one load. Two
        # that do more, but not by the threshold, leave the one its name, and in doubt.
        loaded = any(problem.terms[rival].effect == "payload_mass" for rival in pair)
        rivals.append(0.0 if loaded else min(odds, 0.0))
        alike += [_called(problem.terms[own.term], problem.terms[rival]) for rival in pair]
    for candidate in regression.scan(others)[0]:
        if (
            candidate.instance.term in {own.term, *search.contradicted}
            or not math.isfinite(candidate.gain)
            or without.log_evidence + candidate.gain < fit.log_evidence - 30.0
        ):
            continue
        # With the shape that suits it best, as the named one has: those of its grid would lose however alike the two are.
        rival = refined_shape(regression, others, candidate.instance)
        trial = regression.fit([*others, rival])
        if not regression.within_bounds(trial):
            continue
        mine, theirs = problem.terms[own.term], problem.terms[candidate.instance.term]
        # Two that both have something of their own to explain are no rivals, however much more one of them explains.
        both = regression.fit([*fit.instances, rival])
        ours = both if both.log_evidence > fit.log_evidence and regression.within_bounds(both) else fit
        difference = trial.log_evidence - ours.log_evidence
        if not (mine.once or theirs.once):  # what happens once is in one piece of the recording
            difference = regression.log_odds(trial, ours)
        difference = max(difference, where_exact.pop(candidate.instance.term, -math.inf))
        rivals.append(difference)
        if difference > -AMBIGUOUS:
            alike.append(_called(mine, theirs))
    for rival_term, odds in where_exact.items():
        rivals.append(odds)
        if odds > -AMBIGUOUS:
            alike.append(_called(problem.terms[own.term], problem.terms[rival_term]))
    total = sum(math.exp(min(rival, 50.0)) for rival in rivals)
    return 1.0 / (1.0 + total), tuple(alike)


def _pair_of_the_balance(problem: RegressionProblem, others: Sequence[Instance], own: Instance) -> tuple[int, ...]:
    """The two terms that may do together what one does: a load, all drives and all steerings share one balance of forces.

    Steerings that are too weak by a part look like drives that are too strong on a robot that is heavier by as much.
    """
    everywhere = max(len(term.target) for term in problem.terms)
    balance = [
        index for index, term in enumerate(problem.terms)
        if term.effect == "payload_mass" or (term.effect == "torque_constant_error" and len(term.target) == everywhere > 1)
    ]  # fmt: skip
    pair = tuple(index for index in balance if index != own.term)
    whole = own.term in balance and len(pair) == 2 and not {other.term for other in others} & set(pair)
    return pair if whole else ()


def _called(own: Term, rival: Term) -> str:
    """What a rival of an effect is called: by its name, or by its target, too, where only that differs."""
    return rival.effect if rival.effect != own.effect else rival.key


def _refinements(
    problem: RegressionProblem, instances: tuple[Instance, ...]
) -> Iterator[tuple[int, tuple[Instance, ...]]]:
    """Every set that differs by one more refined instance, with the position of that."""
    for index, instance in enumerate(instances):
        for form in _refined_forms(problem, instance):
            yield index, (*instances[:index], form, *instances[index + 1 :])


def _refined_forms(problem: RegressionProblem, instance: Instance) -> Iterator[Instance]:
    """An instance with all its parameters, and its look-alikes at the same place with all of theirs.

    Of dry friction near standstill, that differs between directions, viscous friction explains more than a dry one that does
    not, and less than one that does.
    """
    own = problem.terms[instance.term]
    known = all_effects().get(own.effect)
    alike = known.look_alikes if known is not None else ()
    own_form = dataclasses.replace(instance, active=tuple(range(len(own.parameters))))
    if own_form != instance:
        yield own_form
    for index, term in enumerate(problem.terms):
        at_place = term.effect in alike and (term.target, _axis(term)) == (own.target, _axis(own))
        everything = tuple(range(len(term.parameters)))
        if at_place and everything != term.base_indices() and len(term.shapes) == 1:
            yield Instance(index, tuple(sorted(term.shapes[0].items())), everything)


def _axis(term: Term) -> str | None:
    """The axis of a joint that the effect of a term in the library acts on; None of any other."""
    return term.axis or getattr(get(term.effect), "axis", None)


def _p_values(search: EffectSearch, selection: Selection, result: OpenSetResult) -> FloatArray:
    """Probability per channel that noise and tolerances alone look like this.

    Where effects are named: chi-square of their whitened contribution in the channel. Where only a dependence is left:
    of its gain. Elsewhere: of the largest gain that any further candidate reaches, against that of the surrogates, in the
    channels that this one moves.
    """
    problem, regression, fit = search.problem, selection.regression, selection.fit

    def moved(instances: Sequence[Instance], first: int) -> FloatArray:
        """Chi-square per channel (C,) of what the numbers of a set do from the first one of them on."""
        does = regression.design(instances)[:, first:] @ regression.fit(instances).mean[first:]
        return np.asarray(np.sum(regression.spread(does) ** 2, axis=0), dtype=np.float64)

    # A channel in which no sample can be judged says nothing.
    values = np.ones(len(problem.channels))
    best = max(regression.scan(fit.instances)[0], key=lambda candidate: candidate.gain, default=None)
    if best is not None and math.isfinite(best.gain):
        place, spread = search.noise_gain
        idle = -math.expm1(-math.exp(min(-(best.gain - place) / spread, 50.0)))
        statistics = moved((*fit.instances, best.instance), len(fit.mean))
        nowhere = stats.chi2.sf(statistics, len(best.instance.active))
        values = np.where(problem.valid.any(axis=0), np.clip(np.maximum(idle, nowhere), 0.0, 1.0), 1.0)
    count = len(problem.nuisances)
    effects, freedom = moved(fit.instances, count), len(fit.mean) - count
    for channel, statistic in enumerate(effects):
        leftover = next(
            (left for left in result.leftovers if left.channel == problem.channels[channel].name), None
        )
        if leftover is not None:
            values[channel] = min(values[channel], float(stats.chi2.sf(2.0 * leftover.gain, 8)))
        if freedom and statistic > 2.0 * selection.threshold + freedom:
            values[channel] = min(values[channel], float(stats.chi2.sf(statistic, freedom)))
    return values
