"""What joints say together: an effect that all of an axis have with the same number, though none shows it clearly alone.

Drives of one kind on one bus lag alike. Of gentle motion each says a little for it, and at much the same number: the evidence
for every number is added up, with the effect there as it is, and weighed against that for other effects.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import interpolate, special, stats

from ..regression.regression_problem import Term
from ..regression.whitened_regression import Instance, WhitenedRegression
from ..robot.command_tracking import PRESENCE
from ..search.shape_search import DROP
from .explanation import AMBIGUOUS, Explanation, explanation_by

FINE = 400  # numbers at which the evidence is read between those that are tried
LEAST_OF_OTHERS = 2.0  # evidence [nats] of all joints but the one that says most
LEAST_SQUARE = 1e-300  # of what an ideal simulation leaves


def in_common(explanations: Sequence[Explanation], threshold: float) -> list[Explanation]:
    """What joints say together where none says enough alone: with the one effect that all have, with the same number.

    Args:
        explanations: one per joint, without effects.
        threshold: evidence [nats] that all have to give together.

    Returns:
        Explanations with the effect, its number and its probability as all have it; empty where there is none, or one
        joint alone says it.
    """
    effects = _searched_by_one_number(explanations)
    if not effects:
        return []
    first = [_profile(explanations, effect, [e.selection.regression for e in explanations]) for effect in effects]
    # Under the noise of the set with it: under that of the set without, whatever changes slowly is noise.
    sets = [[_instance(e, profile.effect, profile.shape) for e in explanations] for profile in first]
    quietest = min(sets, key=lambda instances: _loudness(explanations, instances))
    regressions = [e.search.whiten_beside([own]) for e, own in zip(explanations, quietest, strict=True)]
    profiles = {effect: _profile(explanations, effect, regressions) for effect in effects}
    best = max(profiles, key=lambda effect: profiles[effect].evidence)
    if profiles[best].evidence < threshold:
        return []
    profile = profiles[best]
    # What one joint alone says is said of that one.
    each = [
        _evidence_as_it_is(regression, _instance(explanation, best, profile.shape))
        for explanation, regression in zip(explanations, regressions, strict=True)
    ]
    if sum(each) - max(each) < LEAST_OF_OTHERS:
        return []
    rivals = {effect: other.evidence - profile.evidence for effect, other in profiles.items() if effect != best}
    probability = 1.0 / (1.0 + math.exp(-profile.evidence) + sum(math.exp(odds) for odds in rivals.values()))
    alike = tuple(effect for effect, odds in rivals.items() if odds > -AMBIGUOUS)
    found = []
    for explanation in explanations:
        own = explanation_by(explanation, [_instance(explanation, best, profile.shape)], known=True)
        named = tuple(
            dataclasses.replace(
                entry, probability=probability, ambiguous_with=alike,
                estimates=entry.estimates | {profile.name: dataclasses.replace(
                    entry.estimates[profile.name], value=profile.value, low=profile.low, high=profile.high
                )},
            )
            for entry in own.named
        )  # fmt: skip
        found.append(dataclasses.replace(own, named=named))
    return found if sum(bool(explanation.named) for explanation in found) > 1 else []


@dataclasses.dataclass(frozen=True)
class _Profile:
    """Evidence of several joints for one number of an effect.

    Attributes:
        shape: of the effect with the best number; name: of that.
        low, high: where the evidence has fallen as at the ends of 95 %.
        evidence: against nothing, the mean over all numbers on a logarithmic scale [nats].
    """

    effect: str
    name: str
    shape: dict[str, float]
    low: float
    high: float
    evidence: float

    @property
    def value(self) -> float:
        return self.shape[self.name]


def _searched_by_one_number(explanations: Sequence[Explanation]) -> list[str]:
    """Effects that every joint has been asked for, each with one number that has several values to try."""
    each = [
        {t.effect for t in e.search.problem.terms if len(t.resolution) == 1 and len(_values(t)) > 1} for e in explanations
    ]
    return sorted(set.intersection(*each)) if each else []


def _values(term: Term) -> list[float]:
    """What is tried of the number that an effect is searched by, all others as they are at first."""
    [name] = term.resolution
    rest = {key: value for key, value in term.shapes[0].items() if key != name}
    return sorted({shape[name] for shape in term.shapes if all(shape[key] == value for key, value in rest.items())})


def _loudness(explanations: Sequence[Explanation], instances: Sequence[Instance]) -> float:
    """Log of what is left of all joints, each with its instance."""
    left = (e.search.residual_of([own]) for e, own in zip(explanations, instances, strict=True))
    return sum(math.log(max(float(np.mean(values**2)), LEAST_SQUARE)) for values in left)


def _term_of(explanation: Explanation, effect: str) -> tuple[int, Term]:
    return next((k, term) for k, term in enumerate(explanation.search.problem.terms) if term.effect == effect)


def _instance(explanation: Explanation, effect: str, shape: Mapping[str, float]) -> Instance:
    index, term = _term_of(explanation, effect)
    return Instance(index, tuple(sorted(shape.items())), term.base_indices())


def _profile(explanations: Sequence[Explanation], effect: str, regressions: Sequence[WhitenedRegression]) -> _Profile:
    """Evidence of all joints for an effect with the same number in each, by that number: where it is tried, and between."""
    term = _term_of(explanations[0], effect)[1]
    [name] = term.resolution
    rest = {key: value for key, value in term.shapes[0].items() if key != name}
    tried = sorted({value for explanation in explanations for value in _values(_term_of(explanation, effect)[1])})
    total = np.full(len(tried), term.log_prior)
    for explanation, regression in zip(explanations, regressions, strict=True):
        instances = [_instance(explanation, effect, rest | {name: value}) for value in tried]
        total += [_evidence_as_it_is(regression, instance) for instance in instances]
    fine = np.linspace(math.log(tried[0]), math.log(tried[-1]), FINE)
    heights = interpolate.PchipInterpolator(np.log(tried), total)(fine)
    near = np.exp(fine[heights > heights.max() - DROP])
    shape = rest | {name: math.exp(float(fine[np.argmax(heights)]))}
    evidence = float(special.logsumexp(heights)) - math.log(FINE)
    return _Profile(effect, name, shape, float(near[0]), float(near[-1]), evidence)


def _evidence_as_it_is(regression: WhitenedRegression, instance: Instance) -> float:
    """Evidence for an effect with its presence at one, against nothing [nats]: by the ratio of Savage and Dickey."""
    fit = regression.fit((instance,))
    after = stats.norm(fit.mean[-1], math.sqrt(fit.covariance[-1, -1])).logpdf(1.0)
    before = stats.norm(0.0, PRESENCE.deviation).logpdf(1.0)
    return float(fit.log_evidence - regression.fit(()).log_evidence + after - before)
