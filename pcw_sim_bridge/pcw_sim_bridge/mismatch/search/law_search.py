"""Finds a law outside the library that explains a recording better than the names do, before the names are given out.

All hypotheses of `unknown_law` are screened on top of the named effects and in place of them. Screening takes the function
of a slow argument as constant over the length of the channels' filter, so that one filtered column per site and factor
serves all functions of all arguments; those of a joint's own speed, which is not slow, are filtered one by one. The best few
are then fitted with exact columns, jointly with names and tolerances.

A law counts if it beats the names, refined as far as they can be, by evidence and on held-out blocks, and moves the
prediction by a part that matters. A name that it makes redundant is withdrawn, unless the name alone does most of what
the law does: friction that varies by a tenth with the steering angle is friction and a leftover. If the best law does not
count, every other one that could stand for a name is judged, too: beside a name a law must be large to be told of, in its
place it is expected as small as the name is. So are plain functions of a name's own speed or torque, each alone in its
place: what a small drag leaves beside a viscous friction is too little to be found.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from pcw_description.effects.registry import all_effects

from ..all_cores import on_all_cores
from ..laws.leftover_expression import ClosedForm, closed_form, plain_forms
from ..laws.place_waves import place_waves
from ..laws.unknown_law import Combination, Factor, Law, Place, combined, factor_values, hypotheses
from ..regression.noise_model import huber_weights, robust_deviation
from ..regression.regression_problem import UNKNOWN, FloatArray, RegressionProblem, Term
from ..regression.whitened_regression import Fit, Instance, WhitenedRegression, predicted
from .evidence_selection import EffectSearch, Selection

_Base = tuple[str, Factor]
# Nats on top of the threshold of the names: there are more hypotheses, and they come from no list of known physics.
LAW_MARGIN = 15.0
# Logarithm of their number: what the best of them gains for having been chosen.
HYPOTHESES_COST = 8.0
# Nats by which plain functions in place of a name must do better, and the logarithm of how many there are: few, and of as many
# numbers as the name. In place of names that were right none came nearer than 10 nats less.
PLAIN_MARGIN, PLAIN_COST = 5.0, 2.0
# Samples of a channel count as so many fewer in the screening, where the colour of the noise is not looked at.
SCREENING_CORRELATION = 5.0
# Means of at most so many stretches are screened, none longer than this [s]: laws are slow, and the noise of forces is not.
SCREENED_STRETCHES, LONGEST_STRETCH = 400, 0.3
FINALISTS = 10
NEARLY_ALIKE = 15.0  # nats of the best law, within which others are held against it by their closed forms, too
BY_CHANNEL = 40  # laws, the best at a first look, whose gain is taken channel by channel
FOLDS = 5
# A law must move some channel by this part of the rms that it leaves there, and by this part of the measured side.
SMALLEST_SHARE, SMALLEST_PART = 0.35, 0.03
# A name stays beside a law if without the law it leaves less than this part of what both explain together.
KEPT_PART = 0.02
# A law that replaces a name must differ from it by this part of what the name does.
REPLACED_PART = 0.15
# What another function of a name's argument changes is held against the name only in channels where the name is clear: where
# it moves them, in deviations of what is left there, by this part of what it does where it is clearest.
CLEAR_PART = 0.5
# So much smaller than all that was measured a law may be expected to be that stands for a name.
SMALLER_PARTS = (0.3, 0.1, 0.03, 0.01)
MENDING_PART = 0.05
# A law that differs from a name by less than this part of what the name does leaves it this part of its probability.
TRIFLE, MOST = 0.03, 0.9
# A law of a motor's own torque that takes away more of it than this only says that the joint does not accelerate.
LARGEST_MOTOR_PART = 0.5


@dataclasses.dataclass(frozen=True)
class FoundLaw:
    """A law that counts.

    Attributes:
        gain: nats over the names; held_out: the same on held-out blocks.
        share: part of what the remaining names leave that the law explains on held-out blocks.
        names: instances that stay.
        withdrawn: instances whose name is withdrawn.
        counts: whether it is sure enough to be told. If not, it is a doubt about the names that it would withdraw.
        alike: whether the names that it would withdraw do most of what it does.
        apart: by which part of what these names do the law differs from them, where they are clearest.
        cost: logarithm of how many laws it was chosen from.
    """

    law: Law
    gain: float
    held_out: float
    share: float
    names: tuple[Instance, ...]
    withdrawn: tuple[Instance, ...]
    counts: bool
    alike: bool
    apart: float
    cost: float = HYPOTHESES_COST

    @property
    def belief(self) -> float:
        """What is left of the probability of the names that it would withdraw.

        Half of it where name and law explain nearly the same: then details of the model decide between them. Most of it where
        they are the same but for a trifle.
        """
        odds = math.exp(min(min(self.gain, self.held_out) - self.cost, 50.0))
        least = (MOST if self.apart < TRIFLE else 0.5) if self.alike else 0.0
        return max(1.0 / (1.0 + odds), least)


@dataclasses.dataclass(frozen=True)
class _Trial:
    """A law fitted with exact columns beside the names that it leaves standing."""

    law: Law
    search: EffectSearch
    names: tuple[Instance, ...]
    instance: Instance

    @property
    def instances(self) -> tuple[Instance, ...]:
        return (*self.names, self.instance)


class LawSearch:
    """Looks for one law beside or instead of the named effects of a selection."""

    def __init__(self, search: EffectSearch, selection: Selection) -> None:
        """Take a finished search; the problem must have sites."""
        self.search, self.problem = search, search.problem
        self.threshold = selection.threshold + LAW_MARGIN
        self.plain = selection.fit.instances
        terms = self.problem.terms
        # What the library can refine is not outside of it.
        self.names = tuple(
            dataclasses.replace(i, active=tuple(range(len(terms[i.term].parameters)))) for i in self.plain
        )

    def run(self) -> FoundLaw | None:
        """Return the best law, whether it counts or not; None if no law looks better than nothing."""
        trials = [*(self._trial(law, self.names) for law in self._screened()), *self._in_place_of_names()]
        if not trials:
            return None
        # All are judged under the noise that the best of them leaves: under that of a worse one it is "slow noise".
        evidences = on_all_cores(self._plain_evidence, trials)
        residual = self._left_by(trials[int(np.argmax(evidences))])
        trials = on_all_cores(lambda trial: self._pruned(residual, trial), trials)
        fits = on_all_cores(lambda trial: trial.search.whiten_at(residual).fit(trial.instances), trials)
        # Where speeds go together curves of any two of them do alike: a law of few numbers has them for a reason.
        best = max(fit.log_evidence for fit in fits)
        near = [k for k, fit in enumerate(fits) if fit.log_evidence > best - NEARLY_ALIKE]
        simple = {k: self._evidence_of_a_closed_form(residual, trials[k], fits[k]) for k in near} if len(near) > 1 else {}
        order = np.argsort([-max(fit.log_evidence, simple.get(k, -math.inf)) for k, fit in enumerate(fits)])
        weights = [fits[k].mean[-len(trial.instance.active) :] for k, trial in enumerate(trials)]
        ranked = [trials[k] for k in order if not self._undoes_a_motor(trials[k].law, weights[k])]
        if not ranked:
            return None
        found = self._judged(ranked[0])
        if found.counts:
            return found
        # What fits best may do so beside the names, as a detail; another may still be what a name stands for.
        rivals = [self._judged(trial) for trial in ranked[1:] if len(trial.names) < len(self.names)]
        doubts = [rival for rival in rivals if rival.withdrawn]
        return min([found, *doubts], key=lambda one: (not one.counts, one.belief if one.withdrawn else 1.0))

    def _evidence_of_a_closed_form(self, residual: FloatArray, trial: _Trial, fit: Fit) -> float:
        """Evidence of the closed form that comes nearest to a law's curve, under the noise of a residual (T, C)."""
        own = slice(-len(trial.instance.active), None)
        form = closed_form(trial.law.basis, fit.mean[own], fit.covariance[own, own])
        if form is None:
            return -math.inf
        simple = self._trial(dataclasses.replace(trial.law, basis=form), trial.names)
        return float(simple.search.whiten_at(residual).fit(simple.instances).log_evidence)

    def _undoes_a_motor(self, law: Law, weights: FloatArray) -> bool:
        """Whether a law with weights (K,) takes away most of the motor's torque of which it is a function."""
        sites = self.problem.sites
        assert sites is not None
        torques: FloatArray | None = None
        for index, site in enumerate(sites.names):
            motor = _own(site, "torque")
            if site not in law.sites or motor not in law.depends_on:
                continue
            torques = law.torques(sites) if torques is None else torques
            # In proportion: what is half of it, against it one way and along with it the other, is a law of its own.
            given = sites.variables[motor]
            if abs((torques[:, index] @ weights) @ given) > LARGEST_MOTOR_PART * (given @ given):
                return True
        return False

    # -- screening ----------------------------------------------------------------------------------------------

    def _screened(self) -> list[Law]:
        """The most promising laws: on top of the names, and with none."""
        assert self.problem.sites is not None
        laws = [*hypotheses(self.problem.sites), *place_waves(self.problem, self.search.residual_of(self.names))]
        chosen: list[Law] = []
        sets = list(dict.fromkeys([self.names, ()]))
        for names, scores in zip(sets, _Screen(self.search, laws).scores(sets), strict=True):
            # What may stand for a name need not look better than nothing here, where small effects drown in slow noise.
            least = 0.0 if names == self.names else -math.inf
            ranked = sorted((k for k, (gain, _) in enumerate(scores) if gain > least), key=lambda k: -scores[k][0])
            # Any drag is also a function of the torque that overcomes it, which must not crowd out what it really is.
            allowed = (laws[k] for k in ranked if not self._undoes_a_motor(laws[k], scores[k][1]))
            chosen += itertools.islice(allowed, FINALISTS)
            # A name may be of the right thing and of the wrong function: that is the first suspect.
            for name in self.names:
                own = (laws[k] for k in ranked if changes_law_of(laws[k], self.problem.terms[name.term]))
                chosen += itertools.islice(own, 1)
        return list(dict.fromkeys(chosen))

    # -- finalists ----------------------------------------------------------------------------------------------

    def _trial(self, law: Law, names: tuple[Instance, ...]) -> _Trial:
        term = law.term(self.problem)
        problem = self.problem.with_terms([term])
        settings = dataclasses.replace(self.search.settings, blocks=FOLDS * self.search.settings.blocks)
        search = EffectSearch(problem, self.search.rng, settings)
        everything = tuple(range(len(term.parameters)))
        return _Trial(law, search, names, Instance(len(problem.terms) - 1, (), everything))

    def _in_place_of_names(self) -> list[_Trial]:
        """Plain functions of the joints' own speeds, or torques, each without the names of one effect that it may stand for.

        Those of speeds stand for functions of just these: a drag for a friction. Those of torques stand for all that these
        lose, and for what is lost beside them: a motor that gives less one way for a gear that rubs, or for a load.
        """
        assert self.problem.sites is not None
        terms = {name: self.problem.terms[name.term] for name in self.names}
        terms = {name: term for name, term in terms.items() if term.effect != UNKNOWN}
        torques = {_own(site, "torque") for site in self.problem.sites.names}
        trials = []
        for law in hypotheses(self.problem.sites) if terms else ():
            of_torque = all(place.arguments == _alone(_own(place.site, "torque")) for place in law.places)
            of_speed = all(place.arguments == _alone(_own(place.site, "velocity")) for place in law.places)
            free = all(place.factor == Factor() for place in law.places)
            if not free or not (of_torque or of_speed and law.basis.kind == "speed"):
                continue
            for effect in dict.fromkeys(term.effect for term in terms.values()):
                own = {i: set(t.arguments) for i, t in terms.items() if t.effect == effect}
                if of_torque:
                    own = {i: (arguments or _beside(terms[i])) & torques for i, arguments in own.items()}
                replaced = {i for i, arguments in own.items() if arguments and arguments <= set(law.depends_on)}
                if replaced and set.union(*(own[i] for i in replaced)) == set(law.depends_on):
                    others = tuple(name for name in self.names if name not in replaced)
                    trials += [self._trial(plain, others) for plain in plain_forms(law)]
        return trials

    def _left_by(self, trial: _Trial) -> FloatArray:
        return trial.search.residual_of(trial.instances)

    def _plain_evidence(self, trial: _Trial) -> float:
        return trial.search.whiten_at(self.problem.residual, white=True).fit(trial.instances).log_evidence

    def _pruned(self, residual: FloatArray, trial: _Trial) -> _Trial:
        """Drop the names that the law makes redundant; not those that depend on all that the law depends on."""
        under = trial.search.whiten_at(residual)
        names = trial.names
        while names:
            fit = under.fit((*names, trial.instance))
            margins = []
            for index, instance in enumerate(names):
                others = (*names[:index], *names[index + 1 :])
                without = under.fit((*others, trial.instance)).log_evidence
                allowed = self.threshold - LAW_MARGIN
                if _same_place(trial.law, self.problem.terms[instance.term].target):
                    # There a name may serve to mend the shape of the law.
                    allowed = max(allowed, MENDING_PART * (without - under.fit(others).log_evidence))
                protected = set(trial.law.depends_on) <= set(self.problem.terms[instance.term].arguments)
                margins.append(np.inf if protected else fit.log_evidence - without - allowed)
            index = int(np.argmin(margins))
            if margins[index] >= 0.0:
                break
            names = names[:index] + names[index + 1 :]
        return dataclasses.replace(trial, names=names)

    def _judged(self, trial: _Trial) -> FoundLaw:
        problem = trial.search.problem
        regression = trial.search.whiten_beside(trial.instances)
        with_law, without = regression.fit(trial.instances), regression.fit(self.names)
        gain = with_law.log_evidence - without.log_evidence
        scores = [_held_out_error(regression, i) for i in (trial.instances, self.names, trial.names)]
        held_out = 0.5 * (scores[1] - scores[0])
        self.search.progress(
            f"outside the library: {' and '.join(trial.law.sites)} by {', '.join(trial.law.depends_on)}:"
            f" {gain:.1f} nats, held out {held_out:.1f}"
        )
        # A name that the recording does without anyway is nothing that a law could stand for.
        idle = {
            instance
            for index, instance in enumerate(self.names)
            if without.log_evidence - regression.fit((*self.names[:index], *self.names[index + 1 :])).log_evidence
            < self.threshold - LAW_MARGIN
        }
        replaced = [i not in trial.names and i not in idle for i in self.names]
        dropped = tuple(i for i, replace in zip(self.names, replaced, strict=True) if replace)
        if dropped or not self.names:
            gain += gain_of_a_smaller_law(regression, trial.instances)
        margin, cost = (PLAIN_MARGIN, PLAIN_COST) if isinstance(trial.law.basis, ClosedForm) else (LAW_MARGIN, HYPOTHESES_COST)
        sure = min(gain, held_out) >= (margin if dropped else self.threshold)
        counts = sure and self._matters(problem, trial.law, with_law, without, replaced)
        both = max(scores[2] - scores[0], 1e-300)
        names, withdrawn = tuple(i for i in self.names if i not in dropped), dropped
        # What is surely better and yet a detail is the name and a detail beside it.
        alike = bool(dropped) and ((scores[1] - scores[0]) / both < KEPT_PART or sure and not counts)
        if alike and counts:
            names, withdrawn = self.names, ()
        plain = {i.term: i for i in self.plain}
        return FoundLaw(
            trial.law, gain, held_out, min(both / max(scores[2], 1e-300), 1.0),
            tuple(plain[i.term] if i.term in plain else i for i in names),
            tuple(plain[i.term] if i.term in plain else i for i in withdrawn), counts, alike,
            self._apart(problem, with_law, without, replaced), cost,
        )

    def _apart(self, problem: RegressionProblem, with_law: Fit, without: Fit, dropped: Sequence[bool]) -> float:
        """By which part of what the dropped names do the prediction with the law differs, where these are clearest."""
        left = np.where(problem.valid, problem.residual - predicted(problem, with_law), np.nan)
        change = np.where(problem.valid, predicted(problem, with_law) - predicted(problem, without), 0.0)
        does = np.where(problem.valid, _part_of(problem, without, dropped), 0.0)
        noise = np.array([robust_deviation(column[np.isfinite(column)]) for column in left.T])
        own, other = (np.sqrt(np.mean(values**2, axis=0)) for values in (does, change))
        clear = own / noise >= CLEAR_PART * np.max(own / noise)
        return float(np.max(other[clear] / np.maximum(own[clear], 1e-300)))

    def _matters(
        self, problem: RegressionProblem, law: Law, with_law: Fit, without: Fit, dropped: Sequence[bool]
    ) -> bool:
        """Whether the law moves the prediction of some channel by more than details and misjudgements of the model.

        Against a name that it replaces, or whose own law it changes, it is enough to differ by a fair part of what the name
        does. That something is there the name has shown; the model misjudges it by no more than it misjudges everything.
        Details are the same at all times: what changes with the time may be a smaller part of what is measured. So may a
        torque at joints where nothing is named whose shape it could mend, if it is like no error of the model.
        """
        after = predicted(problem, with_law)
        change, left = after - predicted(problem, without), problem.residual - after
        blank = np.where(problem.valid, 1.0, np.nan)
        channels = np.flatnonzero(problem.valid.any(axis=0))

        def sizes(values: FloatArray) -> FloatArray:
            return np.asarray(np.sqrt(np.nanmean((values * blank)[:, channels] ** 2, axis=0)), dtype=np.float64)

        noise = np.array([robust_deviation(left[problem.valid[:, c], c]) for c in channels])
        beside = [
            not drop and changes_law_of(law, problem.terms[instance.term])
            for instance, drop in zip(without.instances, dropped, strict=True)
        ]
        replaced, changed = _part_of(problem, without, dropped), _part_of(problem, without, beside)
        shown = sizes(changed) / np.maximum(noise, 1e-300)
        names = sizes(replaced) + np.where(shown >= CLEAR_PART * shown.max(initial=0.0), sizes(changed), 0.0)
        guessed = False
        for channel, size, signal, own, remains in zip(
            channels, sizes(change), sizes(problem.measured), names, noise, strict=True
        ):
            valid = problem.valid[:, channel]
            enough = 0.0 if "time" in law.depends_on else max(SMALLEST_PART, 3.0 * problem.scale_deviation) * signal
            if own > 0.0:
                enough = min(enough, REPLACED_PART * own)
                remains = min(remains, own)  # a name that lies below the noise gives way to a law that lies below it
            if size <= max(SMALLEST_SHARE * remains, enough):
                continue
            if problem.misjudged is None or size > float(np.sqrt(np.mean(problem.misjudged[valid, channel] ** 2))):
                return True
            guessed = True
        # Slips are the model's guess, unless they do what no slow error of its torques and tyres does.
        settings, alone = self.search.settings, not self.names and not any(site.startswith("chassis") for site in law.sites)
        unlike = alone and not _is_of_others(law)
        least = settings.least_peculiar_unlike if unlike else settings.least_peculiar
        return (guessed or alone) and self.search.whiten_at(left).peculiar(change) > least


def _part_of(problem: RegressionProblem, fit: Fit, which: Sequence[bool]) -> FloatArray:
    """What some of a fit's effects do to the channels (T, C)."""
    does, position = np.zeros_like(problem.residual), len(problem.nuisances)
    for instance, wanted in zip(fit.instances, which, strict=True):
        if wanted:
            columns = problem.columns(instance.term, instance.shape)[..., list(instance.active)]
            does += columns @ fit.mean[position : position + len(instance.active)]
        position += len(instance.active)
    return does


def _own(site: str, kind: str) -> str:
    """The variable that is a site's own "torque" or "velocity"."""
    if site == "axis_force":
        return "force" if kind == "torque" else kind
    return site.replace("torque", kind)


def _beside(term: Term) -> set[str]:
    """The torques of the motors beside which an effect acts on joints."""
    axis = term.axis or all_effects()[term.effect].axis
    return {f"{axis}_torque/{name}" for name in term.target} if term.at_joints else set()


def _alone(variable: str) -> tuple[Combination, ...]:
    """A variable as the only argument of a law."""
    return (((variable, 1.0),),)


def _is_fast(law: Law) -> bool:
    """Whether a law is a function of its own joint's speed alone, or with another's: that may change within a filter's length.

    The speed itself as a factor would be filtered, and what it is multiplied by is slow.
    """
    own = {place.site.replace("torque", "velocity") for place in law.places}
    names = {name for place in law.places for argument in place.arguments for name, _ in argument}
    return bool(own & names) and all(place.factor == Factor() for place in law.places)


def _is_of_others(law: Law) -> bool:
    """Whether a law goes with torques or speeds of other joints than its own.

    So does what a tyre or a body does that is another than the model's: forces and slips of a wheel are those of both motors.
    """
    moving = [name for name in law.depends_on if "torque/" in name or "velocity/" in name]
    return any(name.replace("velocity/", "torque/") not in law.sites for name in moving)


def changes_law_of(law: Law, term: Term) -> bool:
    """Whether a law is another function of what a name is a function of, at the place of that name."""
    return _same_place(law, term.target) and set(law.depends_on) <= set(term.arguments)


def _same_place(law: Law, target: Sequence[str]) -> bool:
    """Whether a law acts where an effect does: at one of its casters, on the chassis, at the axis."""
    places = {site.partition("/")[2] if "/" in site and not site.startswith("chassis") else site for site in law.sites}
    places |= {"chassis" for site in law.sites if site.startswith("chassis")}
    places |= {"axis" for site in law.sites if site == "axis_force"}
    return bool(places & set(target))


def _held_out_error(regression: WhitenedRegression, instances: Sequence[Instance]) -> float:
    """Squared whitened error of every fold, predicted from the others.

    A fold is every so many short blocks, not one long stretch: a place or a moment that was visited once cannot be
    predicted from anywhere else.
    """
    grams = regression.grams(instances)
    labels = np.arange(len(grams)) % FOLDS
    scale = regression.deviations(instances)
    total, error = grams.sum(axis=0), 0.0
    for fold in range(FOLDS):
        own = grams[labels == fold].sum(axis=0)
        known = total - own
        precision = known[:-1, :-1] * np.outer(scale, scale) + np.eye(len(scale))
        mean = scale * np.linalg.solve(precision, scale * known[:-1, -1])
        extended = np.append(-mean, 1.0)
        error += float(extended @ own @ extended)
    return error


def gain_of_a_smaller_law(regression: WhitenedRegression, instances: Sequence[Instance]) -> float:
    """What it gains [nats] to expect the law, the last instance, to be smaller than all that was measured.

    A law beside names must be a surprise. One in place of a name is expected to be as small as the name is, and one of which
    nothing named holds a part as small as what is left.
    """
    gram, deviations = regression.grams(instances).sum(axis=0), regression.deviations(instances)
    own = len(instances[-1].active)

    def evidence(part: float) -> float:
        scale = np.append(deviations[:-own], part * deviations[-own:])
        factor = np.linalg.cholesky(gram[:-1, :-1] * np.outer(scale, scale) + np.eye(len(scale)))
        half = np.linalg.solve(factor, gram[:-1, -1] * scale)
        return float(0.5 * half @ half - np.sum(np.log(np.diag(factor))))

    return max(0.0, max(evidence(part) for part in SMALLER_PARTS) - evidence(1.0) - math.log(len(SMALLER_PARTS)))


class _Screened:
    """Products of the columns of laws, each a column of a site times functions of time, beside one set of effects.

    The sum over channels is the same for all functions, and is made once for every site and pair of sites.
    """

    def __init__(
        self,
        bases: Mapping[_Base, FloatArray],
        weight: FloatArray,
        known: FloatArray,
        target: FloatArray,
        total: float,
        rows: float,
    ) -> None:
        """Take columns (S, C) and weights (S, C), what is known (S C, k), what it leaves (S C,), its square, and how many rows
        count.
        """
        self.total, self.rows, self._weight = total, rows, weight
        self._plain, self._bases = bases, {key: base * weight for key, base in bases.items()}
        self._known, self._target = known.reshape(*weight.shape, -1), target.reshape(weight.shape)
        self._own: dict[_Base, tuple[FloatArray, FloatArray]] = {}
        self._pairs: dict[tuple[_Base, _Base], FloatArray] = {}

    def products(
        self, keys: Sequence[_Base], functions: Sequence[FloatArray]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gram matrix (F, F) of columns that are sums over sites with functions (S, F); products with known (k, F), target."""
        width = functions[0].shape[1]
        plain, cross, moment = np.zeros((width, width)), np.zeros((self._known.shape[2], width)), np.zeros(width)
        for key, own in zip(keys, functions, strict=True):
            if key not in self._own:
                base = self._bases[key]
                self._own[key] = np.einsum("sc,sck->sk", base, self._known), np.sum(base * self._target, axis=1)
            known, target = self._own[key]
            cross += known.T @ own
            moment += target @ own
            for other, others in zip(keys, functions, strict=True):
                if (key, other) not in self._pairs:
                    self._pairs[key, other] = np.sum(self._bases[key] * self._bases[other], axis=1)
                plain += own.T @ (self._pairs[key, other][:, None] * others)
        return plain, cross, moment

    def plain(self, site: str, factor: Factor) -> FloatArray:
        """The column (S, C) of a site, not weighed."""
        return self._plain[site, factor]

    def gain_by_channel(self, columns: FloatArray, weights: FloatArray) -> float:
        """Nats by which columns (S, C, F) with weights (F,) make every channel's own square less."""
        own = ((columns @ weights) * self._weight).ravel()
        known = self._known.reshape(len(own), -1)
        left = self._target - (own - known @ (known.T @ own)).reshape(self._target.shape)
        before, after = (np.sum(values**2, axis=0) for values in (self._target, left))
        seen = before > 0.0
        judged = np.sum(self._weight > 0.0, axis=0)
        rows = self.rows * judged[seen] / max(float(judged.sum()), 1.0)
        return float(0.5 * np.sum(rows * np.log(before[seen] / np.maximum(after[seen], 1e-6 * before[seen]))))

    def products_of(self, columns: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the same of whole columns (S, C, F)."""
        own = (columns * self._weight[:, :, None]).reshape(-1, columns.shape[2])
        known, target = self._known.reshape(len(own), -1), self._target.ravel()
        return own.T @ own, known.T @ own, own.T @ target


class _Screen:
    """Scores of many laws at once, by weighted least squares of the channels that they can move."""

    def __init__(self, search: EffectSearch, laws: Sequence[Law]) -> None:
        assert search.problem.sites is not None
        self.search, self.problem, self.sites, self.laws = search, search.problem, search.problem.sites, laws
        self.step = max(1, round(len(self.problem.time) / SCREENED_STRETCHES))
        length = min(self.step, max(1, round(LONGEST_STRETCH * self.problem.rate)))
        self._stretches = np.arange(0, len(self.problem.time) - length + 1, self.step)[:, None] + np.arange(length)
        self._bases = self._filtered_bases()
        self._moved = np.flatnonzero(np.any([np.abs(b).max(axis=0) > 0.0 for b in self._bases.values()], axis=0))
        middles = self._stretches[:, length // 2]
        self._variables = {name: values[middles] for name, values in self.problem.variables.items()}
        self._functions: dict[tuple[object, object], FloatArray] = {}
        fast = [law for law in self.laws if _is_fast(law)]
        self._exact = dict(zip(fast, on_all_cores(self._exact_columns, fast), strict=True))

    def scores(self, sets: Sequence[tuple[Instance, ...]]) -> list[list[tuple[float, FloatArray]]]:
        """Return roughly the nats that each law gains beside each set, penalised for its number of functions; and its weights.

        Without regard to the colour of the noise.
        """
        bases = {key: self._averaged(base) for key, base in self._bases.items()}
        return [self._scores_beside(_Screened(bases, *self._beside(instances))) for instances in sets]

    def _scores_beside(self, screened: _Screened) -> list[tuple[float, FloatArray]]:
        scores = []
        for law in self.laws:
            if law in self._exact:
                plain, cross, moment = screened.products_of(self._exact[law])
            else:
                functions = [place.weight * self._of(law, place) for place in law.places]
                keys = [(place.site, place.factor) for place in law.places]
                plain, cross, moment = screened.products(keys, functions)
            gram = plain - cross.T @ cross
            # A function that is nowhere at work, or that the tolerances make, must not be blown up.
            gram[np.diag_indices_from(gram)] += 1e-6 * np.diag(plain) + 1e-12 * np.trace(plain) + 1e-300
            weights = np.asarray(np.linalg.solve(gram, moment), dtype=np.float64)
            explained = min(float(moment @ weights), 0.999999 * screened.total)
            gain = -0.5 * screened.rows * np.log1p(-explained / screened.total)
            scores.append((float(gain - 0.5 * len(moment) * np.log(screened.rows)), weights))
        # What explains nearly all of one channel is little of all channels together; what noise there is in it shows then.
        for k in sorted(range(len(scores)), key=lambda k: -scores[k][0])[:BY_CHANNEL]:
            gain, weights = scores[k]
            own = screened.gain_by_channel(self._columns(self.laws[k], screened), weights)
            scores[k] = max(gain, float(own - 0.5 * len(weights) * np.log(screened.rows))), weights
        return scores

    def _columns(self, law: Law, screened: _Screened) -> FloatArray:
        """Columns (S, C, F) of a law, not weighed."""
        if law in self._exact:
            return self._exact[law]
        return np.sum(
            [screened.plain(p.site, p.factor)[:, :, None] * (p.weight * self._of(law, p))[:, None] for p in law.places], axis=0
        )

    def _beside(self, instances: tuple[Instance, ...]) -> tuple[FloatArray, FloatArray, FloatArray, float, float]:
        """Weights, what tolerances and set span, what they leave, its square, and independent rows, for one set."""
        problem = self.problem
        residual = self._averaged(self.search.residual_of(instances))
        valid = self._averaged(np.ones_like(problem.residual)) > 0.5
        pairs = zip(residual.T, valid.T, strict=True)
        deviation = np.array([robust_deviation(left[seen]) if seen.any() else 1.0 for left, seen in pairs])
        weight = np.where(valid, np.sqrt(huber_weights(residual / deviation)) / deviation, 0.0)
        parts = [problem.nuisance_columns() * problem.nuisance_deviations()]
        for instance in instances:
            parameters = problem.terms[instance.term].parameters
            scale = np.array([parameters[k].deviation for k in instance.active])
            parts.append(problem.columns(instance.term, instance.shape)[..., list(instance.active)] * scale)
        design = np.concatenate([self._averaged(part) for part in parts], axis=2)
        design = (design * weight[:, :, None]).reshape(weight.size, -1)
        # The tolerances come in as further rows.
        known, _ = np.linalg.qr(np.concatenate([design, np.eye(design.shape[1])]))
        known = known[: len(design)]
        target = (self._averaged(problem.residual) * weight).ravel()
        projection = known.T @ target
        total = max(float(target @ target - projection @ projection), 1e-300)  # nothing may be judged for half a stretch
        rows = max(float(valid.sum()) * min(self.step / SCREENING_CORRELATION, 1.0), 1.0)
        return weight, known, target - known @ projection, total, rows

    def _averaged(self, values: FloatArray) -> FloatArray:
        """Means over the stretches (S, M, ...) of values (T, C, ...) in the channels that laws move; zero if not judged."""
        judged = self.problem.valid[self._stretches][:, :, self._moved]
        picked = values[self._stretches][:, :, self._moved]
        means: FloatArray = np.where(judged.reshape(*judged.shape, *(1,) * (values.ndim - 2)), picked, 0.0).mean(axis=1)
        return means

    def _filtered_bases(self) -> dict[tuple[str, Factor], FloatArray]:
        """One filtered column (T, C) per site and factor."""
        wanted = list(dict.fromkeys((p.site, p.factor) for law in self.laws for p in law.places))
        found: dict[tuple[str, Factor], FloatArray] = {}
        for start in range(0, len(wanted), 8):
            keys = wanted[start : start + 8]
            first = factor_values(self.sites.variables, keys[0][1])
            torques = np.zeros((len(first), len(self.sites.names), len(keys)))
            for k, (site, factor) in enumerate(keys):
                torques[:, self.sites.names.index(site), k] = factor_values(self.sites.variables, factor)
            columns = self.sites.columns(torques)
            found |= {key: columns[:, :, k] for k, key in enumerate(keys)}
        return found

    def _exact_columns(self, law: Law) -> FloatArray:
        return self._averaged(self.sites.columns(law.torques(self.sites)))

    def _of(self, law: Law, place: Place) -> FloatArray:
        key = (law.basis, place.arguments)
        if key not in self._functions:
            self._functions[key] = law.basis.functions([combined(self._variables, a) for a in place.arguments])
        return self._functions[key]
