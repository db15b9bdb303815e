"""Chooses the set of effects that explains a recording: by evidence of sets, calibrated on surrogates, checked held out.

1. Grow: add the term of largest marginal gain, refit everything jointly, re-estimate the noise; go on with a lenient
   threshold, so that what is left at the end is noise even where the surplus terms will not stay.
2. Calibrate: phase-randomised surrogates of that noise are searched like the recording. The largest gain that noise
   alone reaches, at the wanted false-alarm rate, is the threshold.
3. Prune: drop every term whose loss in evidence stays below the threshold, that does not lower the error on held-out
   blocks, or that moves no channel by a fair part of what is left of it. Exchange terms where another one does better.
4. Settle: make the problem exact at what is left, ask whether something that was dropped is missing now, and prune again.
5. Ask whether fewer effects do as well from the description on, and whether one that looks like an effect does more.
   What is off at all drives and all steerings gives way to one cause in the chassis, unless the recordings object; what is
   off at one of the two, to the other and such a cause where that does more.
6. Ask of every effect whose work re-tuned numbers could do whether they do it as well once the problem is exact at those.
7. Search the outlines of patches of floor.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from pcw_description.effects.registry import all_effects

from ..regression.noise_model import SLOW_ORDINATES
from ..regression.regression_problem import HEALTHY, FloatArray, RegressionProblem, segment_slices
from ..regression.whitened_regression import Fit, Instance, WhitenedRegression
from .effect_gates import EffectGates
from .exact_problem import DERIVED_AFTER, EXACT_ROUNDS, STEADY, STEADY_EVIDENCE, STEPS
from .gathered_terms import gatherings
from .outline_search import Outlines, has_outline, reaching, searched_outline, settled_outline
from .selection_settings import SelectionSettings
from .set_growth import GATHERED_AMONG, LadderStep, Progress, SetGrowth
from .shape_search import DROP, refined_shape
from .shape_slopes import sizes_of, slope_instances, with_slopes

# Effects of so little less evidence [nats] are alike, and at most so many are tried; those of so much less are not looked at.
ALIKE, MOST_ALIKE, FAR = 10.0, 3, 30.0
# So many tolerances that a number has moved are far.
FAR_MOVED = 2.0
LONG_WAY = 20  # rounds in which a problem is made exact, from the description on
# What stands in for an effect that a gate stops must be worth so much [nats]: of little, much is alike.
LEAST_STAND_IN = 30.0
# Waves of a floor are tried anew beside what was found: these lengths [m], and so many directions; the best few are refined.
WAVELENGTHS, WAVE_DIRECTIONS, WAVE_STARTS = np.geomspace(0.3, 4.0, 10), 12, 3
HIDDEN_WAVE = -2.0  # nats that a wave of a first look costs at most to be searched from there
# What is off at all drives and all steerings and gave way to one cause in the chassis has at most these log odds against it.
REPLACED_ODDS = -1.0
# So often a chosen set is asked whether something that was dropped should come back.
SECOND_THOUGHTS = 2
# Why an effect is refused that does less than what the model itself may misjudge.
BELOW_DETAILS = "below the details that remain"
# So often the outline of a patch is searched, each time from where the last one was made exact.
OUTLINE_ROUNDS = 3


@dataclasses.dataclass(frozen=True)
class Selection:
    """The chosen set with everything needed to say why.

    Attributes:
        regression: whitened at the chosen set.
        threshold: nats, from the surrogates.
        losses: evidence lost when the instance is dropped and the rest refitted, per instance.
        held_out: reduction of the squared whitened error on held-out blocks (half of it: nats), per instance.
    """

    regression: WhitenedRegression
    fit: Fit
    threshold: float
    losses: tuple[float, ...]
    held_out: tuple[float, ...]
    ladder: tuple[LadderStep, ...]


class EffectSearch(SetGrowth):
    """The search on one problem. Holds the current noise model; everything random comes from `rng`."""

    def __init__(
        self,
        problem: RegressionProblem,
        rng: np.random.Generator,
        settings: SelectionSettings | None = None,
        progress: Progress = lambda message: None,
    ) -> None:
        """Take a problem that is exact at the description."""
        super().__init__(problem, settings, progress)
        self.rng = rng
        self.description = problem
        # Log odds of a rival in place of a term that is named, both where they are exact: by (named, rival).
        self.where_exact: dict[tuple[int, int], float] = {}
        # Log odds of terms together in place of one: by all that is named, what of it stays, and the terms.
        self.odds_of_sets: dict[tuple[tuple[int, ...], ...], float] = {}
        # Outlines of patches of floor that were tried, by term.
        self.outlines: dict[int, Outlines] = {}
        # Terms that held-out recordings contradict, whatever the fitted ones say.
        self.contradicted: set[int] = set()
        # Tolerances of numbers that effects took over, by (term, parameter), as deviations of the coefficient.
        self.taken_over: dict[tuple[int, int], float] = {}
        # Place and spread of the Gumbel distribution of the largest gain that noise alone reaches.
        self.noise_gain = (0.0, 1.0)
        # The problem, and where it is exact, before any effect was named.
        self.unexplained = (self.problem, self._point)

    def run(self) -> Selection:
        """Grow, calibrate, prune, settle, and drop what re-tuning does as well."""
        plain = self.problem
        for count in range(EXACT_ROUNDS):
            if count == DERIVED_AFTER:
                self.problem = self.problem.derived()
            regression = self.whiten_at(self.problem.residual, white=True, by_channel=True)
            self._settle(regression, ())
            if not self._exact_at(regression.fit(())):
                break
        if self.problem.point is not None and self.problem.point.derived:
            # Exact there, but with the columns of the description: those of effects are so, too, and are compared with them.
            self.problem = plain.exact_at(self.problem.point.changes, ())
        if self.problem.point is not None:
            # Ripples turn with a heading, not with what is read of it; by now the zeros are known, and how the floor leans.
            changes = self.problem.point.changes
            self.description, self.problem = self.description.with_headings(changes), self.problem.with_headings(changes)
        # Of all numbers this one moves far in healthy robots, and what every torque does hangs on it.
        self.problem = self.problem.with_soft_tyres()
        self.unexplained = self.problem, self._point
        regression, instances = self._grown()
        threshold = self.calibrate(regression, instances)
        selection = self.settle_on(self.prune(regression, instances, threshold), threshold)
        selection = self.with_best_waves(self.with_hidden_waves(self.gathered(self.afresh(selection))))
        selection = self.against_alike(self.against_fewer(selection))
        selection = self.with_one_look_alike(self.with_other_axis(self.with_one_cause(selection)))
        return self.with_outlines(self.bounded(self.retuned_away(selection)))

    def _grown(self, instances: tuple[Instance, ...] = ()) -> tuple[WhitenedRegression, tuple[Instance, ...]]:
        """More than there is to be found, from some effects on, and its noise."""
        instances = self.over_complete(instances)
        regression = self.whiten_beside(instances)
        for _ in range(3):
            before = instances
            instances = self.improve(regression, self.thin(regression, instances))
            instances = self.grow(regression, instances, self.settings.lenient_gain)
            regression = self.whiten_beside(instances)
            if {(i.term, i.shape) for i in before} == {(i.term, i.shape) for i in instances}:
                break
        return regression, instances

    def settle_on(self, selection: Selection, threshold: float) -> Selection:
        """Make the problem exact at what was chosen, add what was dropped too early, and choose again.

        Of two terms that can do each other's work one goes first, and it may be the wrong one: that shows when the other goes.
        """
        for count in range(SECOND_THOUGHTS + 1):
            chosen = self.made_exact(selection.fit.instances)
            regression = self.whiten_beside(chosen)
            wider = self.grow(regression, chosen, threshold, settling=True) if count < SECOND_THOUGHTS else chosen
            if _terms(wider) != _terms(chosen):
                here, under = (self.problem, self._point), self.whiten_beside(wider)
                selection = self.prune(under, wider, threshold)
                found = selection.fit.instances
                # What was added may push out what is there, and then be dropped itself: that is no reason to name less.
                if _terms(found) != _terms(chosen) and under.fit(found).log_evidence > under.fit(chosen).log_evidence:
                    continue
                self.problem, self._point = here
            selection = self.prune(regression, chosen, threshold)
            if _terms(selection.fit.instances) == _terms(chosen):
                break
        return selection

    def afresh(self, selection: Selection) -> Selection:
        """The same effects where the problem is exact at them from the description on, if that is the better place.

        While other effects were tried numbers may have moved far, and the way back is barred by all that is curved.
        """
        fit = selection.fit
        if not fit.instances or not self._is_strained(fit):
            return selection
        here, own = (self.problem, self._point), self._exact_evidence(selection.regression, fit)
        self.problem, self._point = self.unexplained
        regression = selection.regression.moved(self.problem)
        gain = self._arrived(regression, regression.fit(fit.instances), LONG_WAY)[0] - own
        if gain < STEADY_EVIDENCE:
            self.problem, self._point = here
            return selection
        self.progress(f"the same from the description on: {gain:.1f} nats more")
        return self.settle_on(self.conclude(fit.instances, selection.threshold), selection.threshold)

    def retuned_away(self, selection: Selection) -> Selection:
        """Drop effects that other numbers of the description stand in for as soon as the problem is exact at those.

        Where it is exact with an effect at work, columns of the same cause differ by their curvature: with precise sensors
        that is evidence enough for an effect that is well within a tolerance. And where numbers have moved far to make room
        for an effect, it takes them back to do without.
        """
        instances = selection.fit.instances
        own: float | None = None
        for index, instance in enumerate(instances):
            others = instances[:index] + instances[index + 1 :]
            instead = selection.regression.retuned_instead(selection.fit, index)
            if instead is None and self._is_strained(selection.fit):
                instead = selection.regression.fit(others)
            if instead is None:
                continue
            # Both where they are exact: a fit may promise more than re-tuning gets, or split one cause between an effect and
            # a number, and promise less than it has itself.
            own = self._exact_evidence(selection.regression, selection.fit) if own is None else own
            loss = own - self._exact_evidence(selection.regression, instead)
            if loss < selection.threshold:
                self.note_drop(instance, loss, "re-tuning does the same")
                self._exact_at(instead)
                regression = self.whiten_beside(others)
                return self.retuned_away(self.prune(regression, others, selection.threshold))
        return selection

    def with_whole_tolerances(self, selection: Selection, names: Sequence[str]) -> Selection:
        """The selection without effects that some numbers have room for once their tolerances are whole again.

        With a part of its tolerance alone a number that is off by no more than a healthy robot's passes for an effect, too.
        """
        firm = self.problem, self._point
        self.problem = self.problem.narrowed(dict.fromkeys(names, 1.0))
        whole = self.retuned_away(self.conclude(self.made_exact(selection.fit.instances), selection.threshold))
        numbers = zip(self.problem.nuisances, whole.fit.mean, strict=False)
        healthy = all(abs(float(mean)) < HEALTHY * n.deviation for n, mean in numbers if n.name in names)
        if healthy and len(whole.fit.instances) < len(selection.fit.instances):
            return whole
        self.problem, self._point = firm
        return selection

    def bounded(self, selection: Selection) -> Selection:
        """Drop effects that come out beyond their bounds where they were not found exactly: as such they are nothing."""
        instances = selection.fit.instances
        within = selection.regression.each_within_bounds(selection.fit, strictly=True)
        if all(within):
            return selection
        index = min((k for k, inside in enumerate(within) if not inside), key=selection.losses.__getitem__)
        self.note_drop(instances[index], selection.losses[index], "beyond its bounds")
        others = instances[:index] + instances[index + 1 :]
        return self.bounded(self.retuned_away(self.prune(self.whiten_beside(others), others, selection.threshold)))

    def gathered(self, selection: Selection) -> Selection:
        """Exchange the same effect on several casters for one on all of these, where that does more from the description on.

        Where the problem is exact with each of them at work, the one on all does next to nothing in their place.
        """
        instances = selection.fit.instances
        here, own = (self.problem, self._point), None
        for others, wider in gatherings(self.problem, instances):
            own = self._exact_evidence(selection.regression, selection.fit) if own is None else own
            described = selection.regression.moved(self.description)
            for candidate in described.scan(others, only=wider)[0][:GATHERED_AMONG]:
                self.problem, self._point = self.description, None
                one = self.made_exact((*others, refined_shape(described, others, candidate.instance)))
                regression = selection.regression.moved(self.problem)
                gain = self._exact_evidence(regression, regression.fit(one)) - own
                if gain > STEADY_EVIDENCE:
                    self.progress(f"gather into {self.label(one[-1])}, from the description on: {gain:.1f} nats")
                    return self.settle_on(self.conclude(one, selection.threshold), selection.threshold)
        self.problem, self._point = here
        return selection

    def against_fewer(self, selection: Selection) -> Selection:
        """Exchange a set for a smaller one that does as well from the description on.

        Stronger motors, a payload and larger inertias undo each other. Once the search is far out along that way, a first
        order leads nowhere without any two of them, and all of them would be needed.
        """
        instances = selection.fit.instances
        if len(instances) < 2:
            return selection
        here, own = (self.problem, self._point), self._exact_evidence(selection.regression, selection.fit)
        regression = selection.regression.moved(self.description)
        fewer: tuple[Instance, ...] = ()
        while len(fewer) <= len(instances) - 2:
            self.problem, self._point = self.description, None
            gain = self._exact_evidence(regression, regression.fit(fewer)) - own
            if gain > -selection.threshold:
                said = " and ".join(map(self.label, fewer)) or "nothing"
                self.progress(f"{said} alone, from the description on: {gain:.1f} nats")
                return self.settle_on(self.conclude(fewer, selection.threshold), selection.threshold)
            rest = [instance for instance in instances if instance not in fewer]
            fewer = (*fewer, max(rest, key=lambda instance: regression.fit((*fewer, instance)).log_evidence))
        self.problem, self._point = here
        return selection

    def with_one_cause(self, selection: Selection) -> Selection:
        """Exchange what is off at all drives and all steerings for one cause in the chassis, unless the recordings object.

        Torques too small by one factor are masses too large by it. What tells the two apart is little beside what the model
        errs by itself, and two effects with strained numbers may fit that better than the one that is there.
        """
        terms = self.problem.terms
        for first, second in itertools.combinations(selection.fit.instances, 2):
            one, other = terms[first.term], terms[second.term]
            if one.effect != other.effect or one.target != other.target or one.axis == other.axis or len(one.target) < 2:
                continue
            alike = [name for name in all_effects()[one.effect].look_alikes if all_effects()[name].target_kind == "chassis"]
            # What is carried displaces the centre of mass itself: beside a displaced one its place would be anywhere.
            others = tuple(
                i for i in selection.fit.instances if i not in (first, second) and not set(self._look_alikes(i)) & set(alike)
            )
            for rival in (k for k, term in enumerate(terms) if term.effect in alike):
                instead, odds = self._with_rival(selection, others, rival, -selection.threshold)
                if instead is not selection:
                    self.where_exact[rival, first.term] = min(-odds, REPLACED_ODDS)
                    return instead
        return selection

    def with_other_axis(self, selection: Selection) -> Selection:
        """Exchange what is off at all of one axis for the same at the other and a cause in the chassis, where that does more.

        Steerings too weak by a factor are drives too strong by it under masses too large by it. Where strong drives hide a
        payload one effect does nearly what these two do, and only inertias that no healthy robot has tell that it is not it.
        """
        terms = self.problem.terms
        for instance in selection.fit.instances if self._is_strained(selection.fit) else ():
            own, alike = terms[instance.term], self._look_alikes(instance)
            causes = [k for k, t in enumerate(terms) if t.effect in alike and all_effects()[t.effect].target_kind == "chassis"]
            others = tuple(i for i in selection.fit.instances if i != instance and i.term not in causes)
            for place, term in enumerate(terms if len(own.target) > 1 and not instance.shape else ()):
                if (term.effect, term.target) != (own.effect, own.target) or term.axis == own.axis:
                    continue
                with_other = (*others, Instance(place, (), term.base_indices()))
                for cause in causes:
                    instead, _ = self._with_rival(selection, with_other, cause, max(selection.threshold, STEADY_EVIDENCE))
                    if instead is not selection:
                        return instead
        return selection

    def _look_alikes(self, instance: Instance) -> tuple[str, ...]:
        """Names of the look-alikes of an instance's effect; none of a law that is in no library."""
        known = all_effects().get(self.problem.terms[instance.term].effect)
        return known.look_alikes if known is not None else ()

    def with_one_look_alike(self, selection: Selection) -> Selection:
        """Exchange an effect of some casters, and its look-alike of a part of them, for that look-alike of all of them.

        Drives that rub and tyres that resist differ by the load of the wheels alone. Where that load was misjudged while the
        first was named, the second makes up for the difference at one wheel, and neither gives way to any further one.
        """
        terms = self.problem.terms
        for first, second in itertools.permutations(selection.fit.instances, 2):
            one, other = terms[first.term], terms[second.term]
            if other.effect not in self._look_alikes(first) or not set(other.target) < set(one.target):
                continue
            others = tuple(i for i in selection.fit.instances if i not in (first, second))
            for rival, term in enumerate(terms):
                if (term.effect, term.axis, term.target) != (other.effect, other.axis, one.target):
                    continue
                instead, odds = self._with_rival(selection, others, rival, 0.0)
                if instead is not selection:
                    self.where_exact[rival, first.term] = -odds
                    return instead
                self.where_exact[first.term, rival] = odds
        return selection

    def _with_rival(
        self, selection: Selection, others: tuple[Instance, ...], rival: int, least: float
    ) -> tuple[Selection, float]:
        """A smaller set with another term, from where nothing was named on, and its log odds; the old one if below `least`."""
        here, odds = (self.problem, self._point), -math.inf
        self.problem, self._point = self.unexplained
        regression = self.whiten_beside(others)
        candidates = regression.scan(others, only=[rival])[0]
        if candidates and math.isfinite(candidates[0].gain):
            chosen = self.made_exact((*others, refined_shape(regression, others, candidates[0].instance)))
            instead = self.prune(self.whiten_beside(chosen), chosen, selection.threshold)
            odds = self._odds_there(selection, here, instead.regression, instead.fit.instances)
            said = " and ".join(map(self.label, instead.fit.instances))
            self.progress(f"{said} instead, from the beginning: log odds {odds:.1f}")
            if not any(found.term == rival for found in instead.fit.instances):
                odds = -math.inf  # those of a set that has come to do without it, perhaps of the old one, are not its own
            elif odds > least:
                return instead, odds
        self.problem, self._point = here
        return selection, odds

    def _odds_there(
        self,
        selection: Selection,
        here: tuple[RegressionProblem, dict[object, float] | None],
        regression: WhitenedRegression,
        instead: tuple[Instance, ...],
    ) -> float:
        """Log odds of a set where the problem is exact now against a selection where it is exact; the problem stays there."""
        there, odds = self.place, 0.0
        # Which of the two leaves noise alone nobody knows: by that of either in turn.
        for noise in (selection.regression, regression):
            self.place = here
            own, own_left = self._reached_with(noise, selection.fit.instances)
            self.place = there
            evidence, left = self._reached_with(noise, instead)
            odds += 0.5 * noise.odds(evidence - own, own_left, left)
        return odds

    def odds_instead(self, selection: Selection, others: tuple[Instance, ...], rivals: Sequence[int]) -> float:
        """Log odds of some terms together in place of what a selection has besides `others`, both where they are exact."""
        key = (tuple(i.term for i in selection.fit.instances), tuple(i.term for i in others), tuple(rivals))
        if key not in self.odds_of_sets:
            here, odds = self.place, -math.inf
            self.place = self.unexplained
            regression, chosen = self.whiten_beside(others), others
            for rival in rivals:
                candidates = regression.scan(chosen, only=[rival])[0]
                if not candidates or not math.isfinite(candidates[0].gain):
                    break
                chosen = (*chosen, refined_shape(regression, chosen, candidates[0].instance))
            else:
                chosen = self.made_exact(chosen)
                regression = self.whiten_beside(chosen)
                if regression.within_bounds(regression.fit(chosen)):
                    odds = self._odds_there(selection, here, regression, chosen)
            self.place = here
            self.odds_of_sets[key] = odds
        return self.odds_of_sets[key]

    def against_alike(self, selection: Selection) -> Selection:
        """Exchange an effect for one that does the same to first order, where that one does more when both are exact."""
        instances = selection.fit.instances
        for index, instance in enumerate(instances):
            others = instances[:index] + instances[index + 1 :]
            here = self.problem, self._point
            starts = [(here, self._alike(selection, others, instance))]
            # A first order may lead nowhere: far out, or from an effect in proportion to its number to one that is not.
            if self._is_strained(selection.fit) or not self.problem.terms[instance.term].is_curved:
                starts.append(self._alike_from_description(selection, others, instance))
            own: tuple[float, FloatArray] | None = None
            for start, rivals in starts:
                for rival in rivals:
                    self.problem, self._point = here
                    own = self._reached(selection.regression, selection.fit) if own is None else own
                    self.problem, self._point = start
                    regression = selection.regression.moved(self.problem)
                    evidence, left = self._reached(regression, regression.fit((*others, rival)))
                    gain = evidence - own[0]
                    self.where_exact[instance.term, rival.term] = regression.odds(gain, own[1], left)
                    if gain < STEADY_EVIDENCE:
                        continue
                    self.progress(f"exchange {self.label(instance)} for {self.label(rival)}: {gain:.1f} nats where exact")
                    instead = self.settle_on(self.conclude((*others, rival), selection.threshold), selection.threshold)
                    if any(found.term == rival.term for found in instead.fit.instances):
                        return instead
                    # Beside the other one numbers may have moved to where the effect itself does more than either did before.
                    if _terms(instead.fit.instances) == _terms(instances):
                        reached, own_left = self._reached_with(selection.regression, instead.fit.instances)
                        if reached - own[0] > STEADY_EVIDENCE:
                            self.progress(f"the same where that led: {reached - own[0]:.1f} nats more")
                            self.where_exact[instance.term, rival.term] = regression.odds(evidence - reached, own_left, left)
                            return self.against_alike(instead)
            self.problem, self._point = here  # the selection is exact there
        return selection

    def _is_strained(self, fit: Fit) -> bool:
        """Whether some number of the description has moved so far that the first order of other effects leads nowhere."""
        numbers = zip(self.problem.nuisances, fit.mean, strict=False)
        return any(abs(float(mean)) > FAR_MOVED * number.deviation for number, mean in numbers if not number.loose)

    def _alike_from_description(
        self, selection: Selection, others: tuple[Instance, ...], own: Instance
    ) -> tuple[tuple[RegressionProblem, None], list[Instance]]:
        """Where the problem is exact at the description, and what the library says looks like an effect on its target."""
        terms, problem = self.problem.terms, self.description
        mine, known = terms[own.term], all_effects().get(terms[own.term].effect)
        regression = selection.regression.moved(problem)
        found = []
        for k, term in enumerate(terms if known is not None else ()):
            assert known is not None
            if term.effect not in known.look_alikes or term.target != mine.target or not (term.is_curved or mine.is_curved):
                continue
            candidates = regression.scan(others, only=[k])[0]
            if candidates and math.isfinite(candidates[0].gain) and not self.repeats(candidates[0].instance, others):
                found.append(refined_shape(regression, others, candidates[0].instance))
        return (problem, None), found

    def stand_ins(self, selection: Selection, own: Instance) -> list[Instance]:
        """Effects that the library says look like one, and other outlines of a patch of floor, that do its work as well."""
        others = tuple(instance for instance in selection.fit.instances if instance != own)
        effect, effects = self.problem.terms[own.term].effect, [term.effect for term in self.problem.terms]
        found = [
            rival for rival in self._alike(selection, others, own, straight=True)
            if effects[rival.term] in self._look_alikes(own) or effect in self._look_alikes(rival)
        ]
        if own.term in self.outlines:
            outlines = self.outlines[own.term].apart(dict(own.shape), ALIKE)
            found += [selection.regression.with_shape(own, dict(own.shape) | shape) for shape in outlines]
        return found

    def _alike(
        self, selection: Selection, others: tuple[Instance, ...], own: Instance, straight: bool = False
    ) -> list[Instance]:
        """Effects that do an effect's work nearly as well, of which a first order may not say it; straight: also others."""
        regression, terms = selection.regression, self.problem.terms
        found = []
        for candidate in regression.scan(others)[0]:
            if not math.isfinite(candidate.gain) or candidate.instance.term in {own.term, *self.contradicted}:
                continue
            # Of what is in proportion a first order says all, but for what goes by loads, as masses do: look-alikes are tried.
            curved = terms[candidate.instance.term].is_curved or terms[own.term].is_curved
            if not (straight or curved or terms[candidate.instance.term].effect in self._look_alikes(own)):
                continue
            if self.repeats(candidate.instance, others):
                continue
            rival = refined_shape(regression, others, candidate.instance)
            if regression.fit((*others, rival)).log_evidence > selection.fit.log_evidence - ALIKE:
                found.append(rival)
            if len(found) == MOST_ALIKE or candidate.gain < selection.losses[selection.fit.instances.index(own)] - FAR:
                break
        usual = self.usual_rivals(regression, others, own)
        found += [rival for rival, fit in usual if fit.log_evidence > selection.fit.log_evidence - ALIKE]
        return found

    def usual_rivals(
        self, regression: WhitenedRegression, others: tuple[Instance, ...], own: Instance
    ) -> list[tuple[Instance, Fit]]:
        """Effects that look like one where their refinements are as they usually are, each with its fit beside the others.

        Teeth with play give way, too. Of a small play that is nearly all that is seen, and a soft gear does it as well.
        """
        terms, known = self.problem.terms, all_effects().get(self.problem.terms[own.term].effect)
        mine, found = terms[own.term], []
        for position, term in enumerate(terms if known is not None else ()):
            assert known is not None
            usual = {k: p.usual for k, p in enumerate(term.parameters) if p.usual is not None}
            if not usual or term.effect not in known.look_alikes or (term.target, term.axis) != (mine.target, mine.axis):
                continue
            for candidate in regression.scan(others, only=[position])[0][:1]:
                if self.repeats(candidate.instance, others):
                    continue
                whole = dataclasses.replace(candidate.instance, active=tuple(range(len(term.parameters))))
                expected = np.array([term.parameters[k].deviation for k in usual])
                fit = _with_known(regression.fit((*others, whole)), usual, expected)
                if regression.within_bounds(fit):
                    found.append((candidate.instance, fit))
        return found

    def with_hidden_waves(self, selection: Selection) -> Selection:
        """The selection with waves of a floor, where a first look was right but for a little.

        Over a long way waves that differ by a hundredth part, or lie a few degrees otherwise, have little to do with each
        other: what a grid is next to explains nothing yet, and another wave of it may look better.
        """
        terms, instances = self.problem.terms, selection.fit.instances
        term = next((k for k, own in enumerate(terms) if "wavelength" in own.resolution), None)
        if term is None or any(instance.term == term for instance in instances):
            return selection
        regression, active = selection.regression, terms[term].base_indices()
        starts = [Instance(term, tuple(sorted(shape.items())), active) for shape in terms[term].shapes]
        gains = [regression.fit((*instances, start)).log_evidence - selection.fit.log_evidence for start in starts]
        best = [starts[k] for k in np.argsort(gains)[-WAVE_STARTS:] if gains[k] > HIDDEN_WAVE]
        rivals = [refined_shape(regression, instances, start) for start in best]
        fits = [regression.fit((*instances, rival)) for rival in rivals]
        fits = [fit for fit in fits if regression.within_bounds(fit)]
        if not fits:
            return selection
        found = max(fits, key=lambda fit: fit.log_evidence)
        gain = found.log_evidence - selection.fit.log_evidence - math.log(max(terms[term].grid_size, 1))
        if gain < max(selection.threshold, STEADY_EVIDENCE):
            return selection
        self.progress(f"+ {self.label(found.instances[-1])}, which was next to what a first look saw: {gain:.1f} nats")
        # What was named while it hid may stand for a part of it: all is asked again beside the waves.
        here = self.problem, self._point
        self.problem, self._point = self.unexplained
        regression, chosen = self._grown(self.made_exact(found.instances[-1:]))
        instead = self.settle_on(self.prune(regression, chosen, selection.threshold), selection.threshold)
        if any(instance.term == term for instance in instead.fit.instances):
            return instead
        self.problem, self._point = here
        return selection

    def with_best_waves(self, selection: Selection) -> Selection:
        """The selection with the waves of a floor that fit best beside the rest of it.

        A first look chose them, beside all that is there, and they were refined from there: where wheels hardly leave their
        place other waves do nearly as well, and what these leave passes for further effects.
        """
        instances = selection.fit.instances
        index = next((k for k, i in enumerate(instances) if "wavelength" in dict(i.shape)), None)
        if index is None:
            return selection
        regression, own = selection.regression, instances[index]
        others = instances[:index] + instances[index + 1 :]
        turns = np.arange(WAVE_DIRECTIONS) * math.tau / WAVE_DIRECTIONS
        starts = [
            regression.with_shape(own, dict(own.shape) | {"wavelength": float(length), "direction": float(turn)})
            for length in WAVELENGTHS for turn in turns
        ]  # fmt: skip
        gains = [regression.fit((*others, start)).log_evidence for start in starts]
        best = [starts[k] for k in np.argsort(gains)[-WAVE_STARTS:]]
        rivals = [refined_shape(regression, others, start) for start in best]
        evidence = [regression.fit((*others, rival)).log_evidence for rival in rivals]
        chosen = int(np.argmax(evidence))
        gain = evidence[chosen] - selection.fit.log_evidence
        if gain < STEADY_EVIDENCE:
            return selection
        self.progress(f"{self.label(own)} as {self.label(rivals[chosen])}: {gain:.1f} nats")
        return self.settle_on(self.conclude((*others, rivals[chosen]), selection.threshold), selection.threshold)

    def with_outlines(self, selection: Selection) -> Selection:
        """Exchange outlines of patches for those that fit best, and note all that were tried."""
        for term in [instance.term for instance in selection.fit.instances if has_outline(instance)]:
            for _ in range(OUTLINE_ROUNDS):
                selection, gain = self._with_better_outline(selection, term)
                # Far from where the problem is exact a first order misjudges what a patch does.
                if gain < ALIKE:
                    break
            self._note_reach(selection, term)
        return selection

    def _note_reach(self, selection: Selection, term: int) -> None:
        """Note how far the outlines of a patch reach that do as well as the chosen one."""
        instance = next((other for other in selection.fit.instances if other.term == term), None)
        if instance is None or term not in self.outlines:
            return
        others = tuple(other for other in selection.fit.instances if other != instance)
        regression = selection.regression.moved(self.exact_problem(selection).with_secants(term, instance.shape))
        self.outlines[term] = reaching(regression, others, instance, self.outlines[term], DROP)

    def exact_problem(self, selection: Selection) -> RegressionProblem:
        """Return the problem as it is exact at a selection with just its shapes; the search goes on from its own."""
        here = self.problem, self._point
        self._be_exact_at(selection)
        problem = self.problem
        self.problem, self._point = here
        return problem

    def _be_exact_at(self, selection: Selection) -> None:
        """Make the problem exact at a selection with just the shapes that it has, which a search of shapes may have moved."""
        if not self._is_exact_at(selection.fit.instances):
            self._exact_at(selection.fit)

    def _with_better_outline(self, selection: Selection, term: int) -> tuple[Selection, float]:
        """The selection with the best outline of a patch, and what that gains [nats]; 0 where it has it already."""
        instance = next((other for other in selection.fit.instances if other.term == term), None)
        if instance is None:
            return selection, 0.0
        others = tuple(other for other in selection.fit.instances if other != instance)
        here = self.problem, self._point
        self._be_exact_at(selection)
        exactly, self.problem = self.problem.with_secants(term, instance.shape), self.problem.around(term, instance.shape)
        regression = selection.regression.moved(self.problem)
        outlines, tried = searched_outline(regression, others, instance, self.outlines.get(term))
        if tried is not None:
            # A first order tells those that are worth it, and the model itself which of them it is.
            outlines = [instance, *(outline for outline in outlines if outline != instance)]
            found, self.outlines[term] = settled_outline(selection.regression.moved(exactly), others, outlines, tried)
            if found != instance:
                chosen = self.made_exact((*others, found))
                instead = self.prune(self.whiten_beside(chosen), chosen, selection.threshold)
                gain = self.advantage(instead, selection.fit.instances)
                self.progress(f"{self.label(instance)} as {self.label(found)}: {gain:.1f} nats where exact")
                if gain >= STEADY_EVIDENCE and any(other.term == term for other in instead.fit.instances):
                    return instead, gain
        self.problem, self._point = here
        return selection, 0.0

    def polished(self, selection: Selection) -> Selection:
        """The selection with the shapes that cost least where the problem is exact; those of patches have been searched so."""
        for _ in range(EXACT_ROUNDS):
            better = self._with_better_shapes(selection)
            if better is None:
                break
            selection = better
        return selection

    def _with_better_shapes(self, selection: Selection) -> Selection | None:
        """One step of numbers and shapes by their slopes; None where they are as good as they get."""
        instances = selection.fit.instances
        if not any(i.shape for i in instances) or not (self._is_exact_at(instances) or self._exact_at(selection.fit)):
            return None
        here, there, tangent = (self.problem, self._point), self._point_of(selection.fit), self.problem.tangent()
        sloped, slopes = with_slopes(tangent, instances, sizes_of(instances, there), self.outlines)
        if not slopes:
            return None
        fit = selection.regression.moved(sloped).fit((*instances, *slope_instances(sloped, slopes)))
        steps, count = fit.mean[-len(slopes) :], len(there)
        if np.all(np.abs(steps) < STEADY * np.sqrt(np.diag(fit.covariance)[-len(slopes) :])):
            return None
        least = self._cost_here(selection.regression, instances) - STEADY_EVIDENCE
        for part in STEPS:
            moved = list(instances)
            for slope, step in zip(slopes, part * steps, strict=True):
                moved[slope.index] = slope.moved(moved[slope.index], float(step))
            aim = dataclasses.replace(selection.fit, instances=tuple(moved), mean=there + part * (fit.mean[:count] - there))
            self.problem = tangent
            if self._exact_at(aim) and self._cost_here(selection.regression, aim.instances) < least:
                return self.conclude(aim.instances, selection.threshold)
            self.problem, self._point = here
        return None

    def _is_exact_at(self, instances: tuple[Instance, ...]) -> bool:
        """Whether the problem is exact with just these effects in these shapes."""
        sizes = () if self.problem.point is None else self.problem.point.sizes
        return {(i.term, i.shape, i.active) for i in instances} == {(s.term, s.shape, s.active) for s in sizes}

    def _cost_here(self, regression: WhitenedRegression, instances: tuple[Instance, ...]) -> float:
        """Cost [nats] of numbers, sizes and shapes as they are where the problem is exact, under the noise of a regression."""
        there = regression.moved(self.problem)
        fit = there.fit(instances)
        return there.cost(dataclasses.replace(fit, mean=self._point_of(fit)))

    def balanced(self, selection: Selection) -> Selection:
        """The selection with what an effect and a number of the description do alike shared out as their priors say.

        By secant and slope they differ, and how much of it is whose would be told by that alone.
        """
        here, regression, tangent = (self.problem, self._point), selection.regression, self.problem.tangent()
        if tangent is self.problem or self.problem.point is None:
            return selection
        self.problem = tangent
        if self._exact_at(regression.moved(tangent).fit(selection.fit.instances)):
            there = regression.moved(self.problem)
            fit = there.fit(selection.fit.instances)
            exact = dataclasses.replace(fit, mean=self._point_of(fit))
            if there.cost(exact) <= regression.cost(selection.fit) + STEADY_EVIDENCE:
                return dataclasses.replace(selection, regression=there, fit=exact)
        self.problem, self._point = here
        return selection

    def advantage(self, selection: Selection, instances: tuple[Instance, ...]) -> float:
        """Nats of a selection over other effects, both where they are exact."""
        sets = (selection.fit, selection.regression.fit(instances))
        own, other = (self._exact_evidence(selection.regression, fit) for fit in sets)
        return own - other

    def surrogates(self, regression: WhitenedRegression, fit: Fit) -> FloatArray:
        """Whitened targets of pure noise (R, N): the residual with its spectrum kept and its phases drawn at random.

        The spectrum keeps whatever colour the whitening left; random phases break every tie with the motion. The phases
        are shared by the channels, which keeps their correlation.
        """
        residual = regression.spread(regression.whitened_residual(fit))
        targets = []
        for _ in range(self.settings.surrogates):
            shuffled = np.zeros_like(residual)
            for piece in segment_slices(self.problem.segment):
                shuffled[piece] = _phase_randomised(residual[piece], self.rng)
            targets.append(regression.gather(shuffled))
        return np.stack(targets, axis=1)

    def calibrate(self, regression: WhitenedRegression, instances: tuple[Instance, ...]) -> float:
        """Gain that noise alone reaches in the wanted share of recordings: Gumbel tail of the surrogates' largest gains."""
        fit = regression.fit(instances)
        targets = self.surrogates(regression, fit)
        largest = np.array(
            [max(c.gain for c in found) if found else 0.0 for found in regression.scan((), targets)]
        )
        largest = largest[np.isfinite(largest)]  # mostly below zero: evidence makes every parameter pay for itself
        if len(largest) < 10:
            return self.settings.smallest_threshold
        spread = float(np.std(largest)) * math.sqrt(6.0) / math.pi
        place = float(np.mean(largest)) - 0.5772 * spread
        tail = place - spread * math.log(-math.log(1.0 - self.settings.false_alarm_rate))
        # The surrogates take the noise model for the truth; nothing is made surer than that would be.
        self.noise_gain = (max(place, 0.0), max(spread, 1.0))
        self.progress(
            f"surrogates: largest gain of noise {np.median(largest):.1f} (median), threshold {tail:.1f} nats"
        )
        return max(self.settings.smallest_threshold, tail)

    def prune(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...], threshold: float
    ) -> Selection:
        """Drop the weakest term until all that remain pass every gate."""
        dropped: set[int] = set()  # terms: with a shape a little different they would come back for ever
        rejected: set[int] = set()  # of these what no other term can have made superfluous
        kept: set[int] = set()  # terms that count by the slopes of where they are not
        while True:
            fit = regression.fit(instances)
            losses, held_out, shares = EffectGates(self.problem, self.settings).judge(regression, instances, fit)
            reasons = [
                "below the threshold"
                if loss < threshold
                else "no gain held out"
                if gain <= 0.0
                else BELOW_DETAILS
                if share < 1.0
                else "beyond its bounds"
                if not within
                else ""
                if finite
                else "an infinite value does as well"
                for loss, gain, share, within, finite in zip(
                    losses, held_out, shares, regression.each_within_bounds(fit), regression.each_finite(fit), strict=True
                )
            ]
            failing = [index for index, reason in enumerate(reasons) if reason and instances[index].term not in kept]
            if not failing:
                needed = EffectGates(self.problem, self.settings).needed_together(regression, instances, fit)
                if len(needed) == len(instances):
                    break
                for instance, loss in zip(instances, losses, strict=True):
                    if instance not in needed:
                        self.note_drop(instance, loss, "little together with others")
                instances = needed
                self._exact_at(regression.fit(instances))
                regression = regression.moved(self.problem)
                continue
            index = min(failing, key=losses.__getitem__)
            loss = losses[index]
            outlined = self._outlined(regression, instances, index) if loss >= threshold else instances
            if outlined != instances:
                instances = self.made_exact(outlined)
                regression = self.whiten_beside(instances)
                continue
            if loss >= threshold and self._counts_from_without(regression, instances, index):
                kept.add(instances[index].term)
                continue
            self.note_drop(instances[index], loss, reasons[index], held_out[index])
            point = self.problem.point
            elsewhere = point is not None and any(size.term == instances[index].term for size in point.sizes)
            dropped.add(instances[index].term)
            stand_in = None
            if loss >= threshold:
                rejected.add(instances[index].term)
                stand_in = self._stand_in(regression, instances, index, threshold, dropped)
            instances = instances[:index] + instances[index + 1 :]
            if stand_in is not None:
                self.progress(f"+ {self.label(stand_in)} in its place")
                instances = (*instances, stand_in)
            if elsewhere:  # the problem is exact at another place without the dropped one
                self._exact_at(regression.fit(instances))
                regression = regression.moved(self.problem)
            exchange = self.best_exchange(regression, instances, regression.fit(instances))
            if exchange is None:
                continue
            barred = dropped if len(exchange[1]) > len(instances) else rejected
            if not any(i.term in barred for i in exchange[1] if i not in instances):
                self.progress(exchange[0])
                instances = exchange[1]
        return self.conclude(instances, threshold)

    def _counts_from_without(self, regression: WhitenedRegression, instances: tuple[Instance, ...], index: int) -> bool:
        """Whether an effect that is at work where slopes were taken passes the gates by those of where none is.

        Where a tyre takes twenty times as long to relax, all that makes it softer does so much more than anywhere else: by
        those slopes a tolerance does without the effect what no tolerance does.
        """
        point, instance = self.problem.point, instances[index]
        if point is None or not point.derived or all(size.term != instance.term for size in point.sizes):
            return False
        plain = self.unexplained[0].exact_at(point.changes, point.sizes)
        before = regression.moved(plain)
        fit = before.fit(instances)
        losses, held_out, shares = EffectGates(plain, self.settings).judge(before, instances, fit)
        if min(losses[index] / self.settings.least_peculiar, shares[index]) < 1.0 or held_out[index] <= 0.0:
            return False
        if not before.each_within_bounds(fit)[index]:
            return False
        own, without = regression.fit(instances), regression.fit(instances[:index] + instances[index + 1 :])
        gain = self._exact_evidence(regression, own) - self._exact_evidence(regression, without)
        self.progress(f"{self.label(instance)}: {gain:.1f} nats where the problem is exact with it and without")
        return gain >= self.settings.least_peculiar

    def _outlined(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...], index: int
    ) -> tuple[Instance, ...]:
        """The set with a patch of floor in the best outline, where it has not been searched yet: a disc may explain little."""
        instance, others = instances[index], instances[:index] + instances[index + 1 :]
        if not has_outline(instance) or instance.term in self.outlines:
            return instances
        (found, *_), tried = searched_outline(regression, others, instance)
        if tried is not None:
            self.outlines[instance.term] = tried
        if found != instance:
            self.progress(f"{self.label(instance)} as {self.label(found)}, before it is judged")
        return (*instances[:index], found, *instances[index + 1 :])

    def _stand_in(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...], index: int, threshold: float, barred: set[int]
    ) -> Instance | None:
        """An effect that does nearly what one does that fails its gates, and that passes them beside the others."""
        others, gates = instances[:index] + instances[index + 1 :], EffectGates(self.problem, self.settings)
        fit, without = regression.fit(instances), regression.fit(others)
        tried = 0
        for candidate in regression.scan(others)[0]:
            if not math.isfinite(candidate.gain) or without.log_evidence + candidate.gain < fit.log_evidence - FAR:
                break
            if candidate.instance.term in barred or self.repeats(candidate.instance, others):
                continue
            rival = refined_shape(regression, others, candidate.instance)
            trial = regression.fit((*others, rival))
            if trial.log_evidence < fit.log_evidence - ALIKE or not regression.within_bounds(trial):
                continue
            losses, held_out, shares = gates.judge(regression, (*others, rival), trial)
            if losses[-1] >= max(threshold, LEAST_STAND_IN) and held_out[-1] > 0.0 and shares[-1] >= 1.0:
                return rival
            tried += 1
            if tried == MOST_ALIKE:
                break
        return None

    def note_drop(self, instance: Instance, loss: float, reason: str, held_out: float | None = None) -> None:
        """Put on the ladder that an effect was dropped, and why."""
        label = self.label(instance)
        self.progress(f"- {label}: {loss:.1f} nats, {reason}")
        self.ladder.append(LadderStep(f"drop {label}", loss, held_out, reason, instance))

    def conclude(self, instances: Sequence[Instance], threshold: float) -> Selection:
        """Settle on a set: noise, fit and figures as they are with just these effects."""
        chosen = tuple(instances)
        regression = self.whiten_beside(chosen)
        fit = regression.fit(chosen)
        losses, held_out, _ = EffectGates(self.problem, self.settings).judge(regression, chosen, fit)
        named = [
            LadderStep(self.label(instance), losses[index], held_out[index], "named")
            for index, instance in enumerate(chosen)
        ]
        return Selection(regression, fit, threshold, tuple(losses), tuple(held_out), (*self.ladder, *named))


def _with_known(fit: Fit, values: Mapping[int, float], deviations: FloatArray) -> Fit:
    """Return a fit with some numbers of its last instance known, by position; `deviations` (K,) is what was expected of them.

    Its evidence is larger by how much surer of these values one is with the recordings than before.
    """
    first = len(fit.mean) - len(fit.instances[-1].active)
    rows, there = [first + k for k in values], np.array(list(values.values()))
    covariance, away = fit.covariance[np.ix_(rows, rows)], there - fit.mean[rows]
    step = np.linalg.solve(covariance, away)
    surer = float(np.sum(np.log(deviations)) + 0.5 * np.sum((there / deviations) ** 2))
    surer -= 0.5 * float(np.linalg.slogdet(covariance)[1] + away @ step)
    mean = fit.mean + fit.covariance[:, rows] @ step
    return dataclasses.replace(fit, mean=mean, log_evidence=fit.log_evidence + surer)


def _terms(instances: Sequence[Instance]) -> tuple[int, ...]:
    """Which terms are at work, and how often."""
    return tuple(sorted(instance.term for instance in instances))


def _phase_randomised(values: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Random phases on the spectrum of (T, C); the mean is drawn like its slow neighbours, since a fit has removed it."""
    spectrum = np.fft.rfft(values, axis=0)
    phases = np.exp(2j * np.pi * rng.random(len(spectrum)))[:, None]
    randomised = spectrum * phases
    neighbours = np.sqrt(np.mean(np.abs(spectrum[1 : SLOW_ORDINATES + 1]) ** 2, axis=0))
    randomised[0] = neighbours * rng.standard_normal()
    result: FloatArray = np.fft.irfft(randomised, n=len(values), axis=0)
    return result
