"""Chooses the set of effects that explains a recording: by evidence of sets, calibrated on surrogates, checked held out.

1. Grow: add the term of largest marginal gain, refit everything jointly, re-estimate the noise; go on with a lenient
   threshold, so that what is left at the end is noise even where the surplus terms will not stay.
2. Calibrate: phase-randomised surrogates of that noise are searched like the recording. The largest gain that noise
   alone reaches, at the wanted false-alarm rate, is the threshold.
3. Prune: drop every term whose loss in evidence stays below the threshold, that does not lower the error on held-out
   blocks, or that moves no channel by a fair part of what is left of it. Exchange terms where another one does better.
4. Settle: make the problem exact at what is left, ask whether something that was dropped is missing now, and prune again.
5. Ask of every effect whose work re-tuned numbers could do whether they do it as well once the problem is exact at those.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from .effect_gates import EffectGates
from .gathered_terms import gatherings
from .noise_model import (
    SLOW_ORDINATES,
    channel_deviations,
    fit_noise_model,
    huber_weights,
    reliability,
    white_noise_model,
)
from .regression_problem import (
    FloatArray,
    IntArray,
    RegressionProblem,
    SizedTerm,
    contiguous_blocks,
    segment_slices,
)
from .selection_settings import SelectionSettings
from .shape_search import refined_shape
from .whitened_regression import Candidate, Fit, Instance, WhitenedRegression

Progress = Callable[[str], None]
# So many times the problem is made exact where its fit came out, or this part of the way there.
EXACT_ROUNDS = 6
STEPS = (1.0, 0.5, 0.2)
RESHAPINGS = 3  # the first under the noise that a wrong shape leaves, which makes shapes alike
GROWTH = 1.01  # by which the error of a step may be more, numbers of a first order having been put right
SPLIT_AMONG = 12  # candidates that a term may have taken in
GATHERED_AMONG = 2  # candidates that several terms may be parts of
# After so many rounds that did not settle columns are taken anew; where they have been before, after twice as many.
DERIVED_AFTER = 2
# Effects of so little less evidence [nats] are alike, and at most so many are tried; those of so much less are not looked at.
ALIKE, MOST_ALIKE, FAR = 10.0, 3, 30.0
# What stands in for an effect that a gate stops must be worth so much [nats]: of little, much is alike.
LEAST_STAND_IN = 30.0
# So often a chosen set is asked whether something that was dropped should come back.
SECOND_THOUGHTS = 2
# A fit that moves less than this part of its intervals' deviations has arrived.
STEADY = 0.2
STEADY_EVIDENCE = 1.0  # nats; what a set is worth where it is exact is not asked for more exactly
# So many times the noise is estimated again, until no channel's falls by more than this.
SETTLING_ROUNDS, SETTLED = 8, 0.9


@dataclasses.dataclass(frozen=True)
class LadderStep:
    """One line of the report's ladder: what was tried, what it gained, what became of it."""

    description: str
    gain: float
    held_out_gain: float | None
    outcome: str


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


class EffectSearch:
    """The search on one problem. Holds the current noise model; everything random comes from `rng`."""

    def __init__(
        self,
        problem: RegressionProblem,
        rng: np.random.Generator,
        settings: SelectionSettings | None = None,
        progress: Progress = lambda message: None,
    ) -> None:
        self.problem = problem
        self.rng = rng
        self.settings = settings or SelectionSettings()
        self.progress = progress
        self.block: IntArray = contiguous_blocks(problem.segment, self.settings.blocks)
        self.ladder: list[LadderStep] = []
        # Where the problem is exact: all numbers of the description by name, of effects by term, shape and parameter.
        self._point: dict[object, float] | None = None
        # Place and spread of the Gumbel distribution of the largest gain that noise alone reaches.
        self.noise_gain = (0.0, 1.0)

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
        instances = self.over_complete()
        regression = self.whiten_at(self.residual_of(instances))
        for _ in range(3):
            before = instances
            instances = self.improve(regression, self.thin(regression, instances))
            instances = self.grow(regression, instances, self.settings.lenient_gain)
            regression = self.whiten_at(self.residual_of(instances))
            if {(i.term, i.shape) for i in before} == {(i.term, i.shape) for i in instances}:
                break
        threshold = self.calibrate(regression, instances)
        return self.retuned_away(self.against_alike(self.settle_on(self.prune(regression, instances, threshold), threshold)))

    def settle_on(self, selection: Selection, threshold: float) -> Selection:
        """Make the problem exact at what was chosen, add what was dropped too early, and choose again.

        Of two terms that can do each other's work one goes first, and it may be the wrong one: that shows when the other goes.
        """
        for count in range(SECOND_THOUGHTS + 1):
            chosen = self.made_exact(selection.fit.instances)
            regression = self.whiten_at(self.residual_of(chosen))
            wider = self.grow(regression, chosen, threshold, settling=True) if count < SECOND_THOUGHTS else chosen
            if _terms(wider) != _terms(chosen):
                here, under = (self.problem, self._point), self.whiten_at(self.residual_of(wider))
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

    def retuned_away(self, selection: Selection) -> Selection:
        """Drop effects that other numbers of the description stand in for as soon as the problem is exact at those.

        Where it is exact with an effect at work, columns of the same cause differ by their curvature: with precise sensors
        that is evidence enough for an effect that is well within a tolerance.
        """
        instances = selection.fit.instances
        own: float | None = None
        for index, instance in enumerate(instances):
            others = instances[:index] + instances[index + 1 :]
            instead = selection.regression.retuned_instead(selection.fit, index)
            if instead is None:
                continue
            evidence = self._exact_evidence(selection.regression, instead)
            loss = selection.fit.log_evidence - evidence
            if loss >= selection.threshold:
                # What a fit promises where it is not exact, re-tuning has not got either.
                own = self._exact_evidence(selection.regression, selection.fit) if own is None else own
                loss = own - evidence
            if loss < selection.threshold:
                self._note_drop(self.label(instance), loss, "re-tuning does the same")
                self._exact_at(instead)
                regression = self.whiten_at(self.residual_of(others))
                return self.retuned_away(self.prune(regression, others, selection.threshold))
        return selection

    def against_alike(self, selection: Selection) -> Selection:
        """Exchange an effect for one that does the same to first order, where that one does more when both are exact."""
        instances = selection.fit.instances
        for index, instance in enumerate(instances):
            others = instances[:index] + instances[index + 1 :]
            rivals = self._alike(selection, others, instance)
            if not rivals:
                continue
            own = self._exact_evidence(selection.regression, selection.fit)
            for rival in rivals:
                evidence = self._exact_evidence(selection.regression, selection.regression.fit((*others, rival)))
                if evidence < own + STEADY_EVIDENCE:
                    continue
                gain = evidence - own
                self.progress(f"exchange {self.label(instance)} for {self.label(rival)}: {gain:.1f} nats where exact")
                here = self.problem, self._point
                instead = self.settle_on(self.conclude((*others, rival), selection.threshold), selection.threshold)
                if any(found.term == rival.term for found in instead.fit.instances):
                    return instead
                self.problem, self._point = here  # the selection is exact there
        return selection

    def _alike(self, selection: Selection, others: tuple[Instance, ...], own: Instance) -> list[Instance]:
        """Effects that do an effect's work nearly as well, to the first order of one of the two."""
        regression, terms = selection.regression, self.problem.terms
        found = []
        for candidate in regression.scan(others)[0]:
            if not math.isfinite(candidate.gain) or candidate.instance.term == own.term:
                continue
            if not terms[candidate.instance.term].is_curved and not terms[own.term].is_curved:
                continue
            if self.repeats(candidate.instance, others):
                continue
            rival = refined_shape(regression, others, candidate.instance)
            if regression.fit((*others, rival)).log_evidence > selection.fit.log_evidence - ALIKE:
                found.append(rival)
            if len(found) == MOST_ALIKE or candidate.gain < selection.losses[selection.fit.instances.index(own)] - FAR:
                break
        return found

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

    def _exact_evidence(self, regression: WhitenedRegression, fit: Fit) -> float:
        """Log evidence of a set where it is exact, and its columns with it: what is reached there, not what is promised."""
        here, reached = (self.problem, self._point), -math.inf
        for _ in range(EXACT_ROUNDS):
            if not self._exact_at(fit):
                break
            self.problem = self.problem.derived()
            regression = regression.moved(self.problem)
            fit = regression.fit(fit.instances)
            missing = self._point_of(fit) - fit.mean
            promised = fit.log_evidence
            there = promised - 0.5 * float(missing @ np.linalg.solve(fit.covariance, missing))
            reached = max(reached, there)
            if promised - there < STEADY_EVIDENCE:
                break
        self.problem, self._point = here
        return reached if math.isfinite(reached) else fit.log_evidence

    def _point_of(self, fit: Fit) -> FloatArray:
        """Sizes (k,) of nuisances and effects where the problem is exact."""
        point = self._point or {}
        keys: list[object] = [nuisance.name for nuisance in self.problem.nuisances]
        keys += [(instance.term, instance.shape, k) for instance in fit.instances for k in instance.active]
        return np.array([point[key] for key in keys])

    def made_exact(self, instances: tuple[Instance, ...]) -> tuple[Instance, ...]:
        """Make the problem exact at the sizes of these effects and of the numbers beside them, and search shapes again.

        What their first order leaves would pass for other effects. A step that leaves more than there was is halved.
        """
        reshapings = 0
        for count in range(EXACT_ROUNDS):
            known = self.problem.point is not None and self.problem.point.derived
            if count == (2 * DERIVED_AFTER if known else DERIVED_AFTER):
                self.problem = self.problem.derived()
            residual, cost = self._left_and_cost(instances)
            fit = self.whiten_at(residual).fit(instances)
            allowed = GROWTH * self._error(residual, residual) + 2.0 * cost
            before = self.problem, self._point
            for part in STEPS:
                if not self._exact_at(fit, part):
                    if self.problem.point is None or self.problem.point.derived:
                        return self._reshaped(instances, residual, False)
                    # With the slopes of another place one arrives where those are level, and not where the error is least.
                    self.problem, again = self.problem.derived(), instances
                    break
                again = instances if reshapings == RESHAPINGS else self._reshaped(instances, residual, reshapings == 0)
                left, cost = self._left_and_cost(again)
                if self._error(left, residual) + 2.0 * cost <= allowed:
                    break
                self.problem, self._point = before
            else:
                return instances
            reshapings = RESHAPINGS if again == instances else reshapings + 1
            instances = again
        return instances

    def _reshaped(self, instances: tuple[Instance, ...], residual: FloatArray, coarse: bool) -> tuple[Instance, ...]:
        """Search the shapes again, near where they are; coarse: of what is at work once also as far as its neighbours."""
        regression = self.whiten_at(residual)
        for index, instance in enumerate(instances):
            term = self.problem.terms[instance.term]
            if not term.resolution:
                continue
            others = (*instances[:index], *instances[index + 1 :])
            around = self.problem.around(instance.term, instance.shape)
            near = regression if around is self.problem else regression.moved(around)
            found = refined_shape(near, others, instance, coarse and term.once)
            if found != instance:
                self.problem, regression = around, near
            instances = (*instances[:index], found, *instances[index + 1 :])
        return instances

    def _exact_at(self, fit: Fit, part: float = 1.0) -> bool:
        """Make the problem exact where a fit comes out, or a part of the way there; False where it has been so already."""
        problem, terms = self.problem, self.problem.terms
        keys: list[object] = [nuisance.name for nuisance in problem.nuisances]
        bounds = [nuisance.changes for nuisance in problem.nuisances]
        for instance in fit.instances:
            parameters = terms[instance.term].parameters
            keys += [(instance.term, instance.shape, k) for k in instance.active]
            bounds += [(parameters[k].lower, parameters[k].upper) for k in instance.active]
        known = {} if self._point is None else self._point
        wanted = np.array([float(np.clip(mean, *bound)) for mean, bound in zip(fit.mean, bounds, strict=True)])
        start = np.array([known.get(key, value) for key, value in zip(keys, wanted, strict=True)])
        for index, key in enumerate(keys):
            # Its column is a secant, which leads past the size that is sought as far as the effect is curved.
            power = problem.powers.get(key, 1.0)  # type: ignore[call-overload]
            if power != 1.0 and wanted[index] * start[index] > 0.0:
                wanted[index] = start[index] * (wanted[index] / start[index]) ** (1.0 / power)
        deviation = np.sqrt(np.maximum(np.diag(fit.covariance), 1e-300))
        if set(known) == set(keys) and np.all(np.abs(wanted - start) < STEADY * deviation):
            return False
        point = dict(zip(keys, start + part * (wanted - start), strict=True))
        sizes = []
        for instance in fit.instances:
            coefficients = np.zeros(len(terms[instance.term].parameters))
            coefficients[list(instance.active)] = [point[instance.term, instance.shape, k] for k in instance.active]
            sizes.append(SizedTerm(instance.term, instance.shape, coefficients))
        self._point = point
        self.problem = problem.exact_at({n.name: point[n.name] for n in problem.nuisances}, sizes)
        return self.problem is not problem

    def _error(self, residual: FloatArray, noise: FloatArray) -> float:
        """Sum of squares of a residual (T, C) in units of the deviations of another, outliers held down."""
        valid, total = self.problem.valid, 0.0
        for channel, deviation in enumerate(channel_deviations(noise, valid)):
            values = residual[valid[:, channel], channel] / deviation
            total += float(np.sum(huber_weights(values) * values**2))
        return total

    def whiten_at(self, residual: FloatArray, white: bool = False, by_channel: bool = False) -> WhitenedRegression:
        """Whiten the problem by the noise of a residual (T, C); the regression's blocks are those of time, or channels."""
        problem = self.problem
        if white:
            noise = white_noise_model(residual, problem.valid)
        else:
            noise = fit_noise_model(residual, problem.valid, problem.segment)
        # What is large at the first look may be an event, which held down like an outlier would never be found.
        weights = reliability(problem, residual, robust=not by_channel)
        return WhitenedRegression(problem, noise, weights, None if by_channel else self.block)

    def residual_of(self, instances: Sequence[Instance]) -> FloatArray:
        """Residual (T, C) of the least-squares fit of a set, with robust weights."""
        return self._left_and_cost(instances)[0]

    def _left_and_cost(self, instances: Sequence[Instance]) -> tuple[FloatArray, float]:
        """The same with what its re-tuning costs [nats]."""
        residual, cost = self.problem.residual, 0.0
        for _ in range(3):
            regression = self.whiten_at(residual, white=True)
            fit = regression.fit(instances)
            residual, cost = regression.unwhitened_residual(fit), regression.tolerance_cost(fit)
        return residual, cost

    # -- 1 grow -------------------------------------------------------------------------------------------------

    def over_complete(self) -> tuple[Instance, ...]:
        """A set that explains more than there is, by plain least squares: what it leaves is the first idea of the noise.

        Every residual that still holds a large effect looks like strong slow noise, under which nothing could be found.
        """
        instances: tuple[Instance, ...] = ()
        regression = self.whiten_at(self.problem.residual, white=True, by_channel=True)
        settled = False
        while len(instances) < self.settings.largest_set:
            step = self.best_addition(regression, instances)
            if step is None or step.gain < self.settings.lenient_gain:
                if settled:
                    break
                # Only now: the shapes of a grid fit no signal that stands far above its noise.
                self._settle(regression, instances)
                settled = True
                continue
            if sum(i.term == step.instance.term for i in instances) >= self.settings.first_repeats:
                break
            instances = (*instances, refined_shape(regression, instances, step.instance))
            instances = self.improve(regression, instances)
            left = regression.unwhitened_residual(regression.fit(instances))
            regression.rescale(channel_deviations(left, self.problem.valid))
        return instances

    def _settle(self, regression: WhitenedRegression, instances: tuple[Instance, ...]) -> None:
        """Take for noise what a set and the tolerances leave, which is less the less noise is taken for granted.

        Else many numbers, each well within its tolerance, would do for one effect: little as they explain, it would be enough.
        """
        deviations = regression.noise.taps[:, 0] ** -1.0
        for _ in range(SETTLING_ROUNDS):
            before = deviations
            deviations = channel_deviations(regression.unwhitened_residual(regression.fit(instances)), self.problem.valid)
            regression.rescale(deviations)
            if np.all(deviations > SETTLED * before):
                break

    def thin(self, regression: WhitenedRegression, instances: tuple[Instance, ...]) -> tuple[Instance, ...]:
        """Drop terms as long as that costs less than the lenient gain."""
        while instances:
            fit = regression.fit(instances)
            losses = [
                fit.log_evidence - regression.fit(instances[:i] + instances[i + 1 :]).log_evidence
                for i in range(len(instances))
            ]
            index = int(np.argmin(losses))
            if losses[index] >= self.settings.lenient_gain and regression.within_bounds(fit):
                break
            instances = instances[:index] + instances[index + 1 :]
        return instances

    def grow(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...], least_gain: float, settling: bool = False
    ) -> tuple[Instance, ...]:
        """Forward selection of all that gains so much, exchanging terms where that helps, unless the set is settling."""
        while len(instances) < self.settings.largest_set:
            step = self.best_addition(regression, instances)
            if step is None or step.gain < least_gain:
                break
            instances = (*instances, refined_shape(regression, instances, step.instance))
            self.progress(f"+ {self.label(instances[-1])}: gain {step.gain:.1f} nats")
            self.ladder.append(LadderStep(f"add {self.label(instances[-1])}", step.gain, None, "tried"))
            if not settling:
                instances = self.improve(regression, instances)
        return instances

    def best_addition(
        self, regression: WhitenedRegression, instances: Sequence[Instance]
    ) -> Candidate | None:
        """The candidate of largest gain with which every parameter of the joint fit stays within its bounds."""
        best: Candidate | None = None
        for candidate in regression.scan(instances)[0][:12]:
            if not math.isfinite(candidate.gain) or (best is not None and candidate.gain < best.gain):
                break
            if self.repeats(candidate.instance, instances):
                continue
            if regression.within_bounds(regression.fit([*instances, candidate.instance])):
                best = candidate
        return best

    def repeats(self, candidate: Instance, instances: Sequence[Instance]) -> bool:
        """Whether a repeatable term is already there with practically the same shape."""
        term = self.problem.terms[candidate.term]
        for instance in instances:
            if instance.term != candidate.term:
                continue
            if not term.repeatable:
                return True
            mine, theirs = dict(candidate.shape), dict(instance.shape)
            if all(
                abs(mine[name] - theirs[name]) < step
                for name, (kind, step) in term.resolution.items()
                if kind == "linear"
            ):
                return True
        return False

    def improve(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...]
    ) -> tuple[Instance, ...]:
        """Exchange a term for another one, or drop it, wherever the evidence of the whole set rises."""
        for _ in range(2 * self.settings.largest_set):
            fit = regression.fit(instances)
            change = self.best_exchange(regression, instances, fit)
            if change is None:
                break
            description, instances = change
            self.progress(description)
            self.ladder.append(
                LadderStep(
                    description, regression.fit(instances).log_evidence - fit.log_evidence, None, "done"
                )
            )
        return instances

    def best_exchange(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...], fit: Fit
    ) -> tuple[str, tuple[Instance, ...]] | None:
        """The first exchange or removal that raises the evidence by more than half a nat, if any."""
        for others, wider in gatherings(self.problem, instances):
            for candidate in regression.scan(others, only=wider)[0][:GATHERED_AMONG]:
                gathered = (*others, refined_shape(regression, others, candidate.instance))
                trial = regression.fit(gathered)
                if trial.log_evidence > fit.log_evidence + 0.5 and regression.within_bounds(trial):
                    return f"gather into {self.label(gathered[-1])}", gathered
        for index, instance in enumerate(instances):
            others = instances[:index] + instances[index + 1 :]
            without = regression.fit(others)
            if without.log_evidence > fit.log_evidence and regression.within_bounds(without):
                return f"drop {self.label(instance)}", others
            for candidate in regression.scan(others)[0][:3]:
                other_shape = candidate.instance.term != instance.term
                if not other_shape or without.log_evidence + candidate.gain < fit.log_evidence + 0.5:
                    continue
                if self.repeats(candidate.instance, others):
                    continue
                refined = refined_shape(regression, others, candidate.instance)
                trial = regression.fit([*others, refined])
                if trial.log_evidence > fit.log_evidence + 0.5 and regression.within_bounds(trial):
                    return f"exchange {self.label(instance)} for {self.label(refined)}", (*others, refined)
            reshaped = self.best_split(regression, others, instance, fit)
            if reshaped is not None:
                return reshaped
        return None

    def best_split(
        self, regression: WhitenedRegression, others: tuple[Instance, ...], instance: Instance, fit: Fit
    ) -> tuple[str, tuple[Instance, ...]] | None:
        """Whether an instance stands for two causes: another shape of it together with one more term.

        A single step cannot find this. A wide Stribeck curve passes for Coulomb plus a narrow one, and at its width
        adding Coulomb friction gains nothing.
        """
        own = self.problem.terms[instance.term]
        if len(own.shapes) < 2 or own.once or own.turning:  # places, times and phases do not widen to take in another cause
            return None
        for candidate in regression.scan(others)[0][:SPLIT_AMONG]:
            term = self.problem.terms[candidate.instance.term]
            if (
                candidate.instance.term == instance.term
                or term.repeatable
                or not math.isfinite(candidate.gain)
            ):
                continue
            again = regression.scan([*others, candidate.instance], only=[instance.term])[0]
            if not again or not math.isfinite(again[0].gain):
                continue
            split = (
                *others,
                candidate.instance,
                refined_shape(regression, [*others, candidate.instance], again[0].instance),
            )
            trial = regression.fit(split)
            if (
                trial.log_evidence > fit.log_evidence + self.settings.lenient_gain
                and regression.within_bounds(trial)
            ):
                return (
                    f"split {self.label(instance)} into {self.label(split[-2])} and {self.label(split[-1])}",
                    split,
                )
        return None

    # -- 2 calibrate --------------------------------------------------------------------------------------------

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

    # -- 3 prune ------------------------------------------------------------------------------------------------

    def prune(
        self, regression: WhitenedRegression, instances: tuple[Instance, ...], threshold: float
    ) -> Selection:
        """Drop the weakest term until all that remain pass every gate."""
        dropped: set[int] = set()  # terms: with a shape a little different they would come back for ever
        rejected: set[int] = set()  # of these what no other term can have made superfluous
        while True:
            fit = regression.fit(instances)
            losses, held_out, shares = EffectGates(self.problem, self.settings).judge(regression, instances, fit)
            reasons = [
                "below the threshold"
                if loss < threshold
                else "no gain held out"
                if gain <= 0.0
                else "below the details that remain"
                if share < 1.0
                else ""
                if within
                else "beyond its bounds"
                for loss, gain, share, within in zip(
                    losses, held_out, shares, regression.each_within_bounds(fit), strict=True
                )
            ]
            failing = [index for index, reason in enumerate(reasons) if reason]
            if not failing:
                needed = EffectGates(self.problem, self.settings).needed_together(regression, instances, fit)
                if len(needed) == len(instances):
                    break
                for instance, loss in zip(instances, losses, strict=True):
                    if instance not in needed:
                        self._note_drop(self.label(instance), loss, "little together with others")
                instances = needed
                self._exact_at(regression.fit(instances))
                regression = regression.moved(self.problem)
                continue
            index = min(failing, key=losses.__getitem__)
            loss = losses[index]
            self._note_drop(self.label(instances[index]), loss, reasons[index], held_out[index])
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

    def _note_drop(self, label: str, loss: float, reason: str, held_out: float | None = None) -> None:
        self.progress(f"- {label}: {loss:.1f} nats, {reason}")
        self.ladder.append(LadderStep(f"drop {label}", loss, held_out, reason))

    def conclude(self, instances: Sequence[Instance], threshold: float) -> Selection:
        """Settle on a set: noise, fit and figures as they are with just these effects."""
        chosen = tuple(instances)
        regression = self.whiten_at(self.residual_of(chosen))
        fit = regression.fit(chosen)
        losses, held_out, _ = EffectGates(self.problem, self.settings).judge(regression, chosen, fit)
        named = [
            LadderStep(self.label(instance), losses[index], held_out[index], "named")
            for index, instance in enumerate(chosen)
        ]
        return Selection(regression, fit, threshold, tuple(losses), tuple(held_out), (*self.ladder, *named))

    def label(self, instance: Instance) -> str:
        """Effect, target and shape in one short text."""
        term = self.problem.terms[instance.term]
        shape = ", ".join(f"{name} {value:.4g}" for name, value in instance.shape if name in term.resolution)
        return f"{term.key} ({shape})" if shape else term.key


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
