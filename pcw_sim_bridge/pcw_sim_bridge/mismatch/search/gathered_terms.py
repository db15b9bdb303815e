"""Several casters with the same fault, one by one, may be one fault of all of them.

A set that grows term by term takes a delay of all motors for a lag of each: the first lag explains more than any one delay
added to nothing, and no exchange of one term for another leads from four lags to one delay of all. So the terms of one effect
on single casters are also offered together for one term on all of these, of the same effect or of one that looks like it.

And two effects of one target that look alike may be one, in another shape: a payload at the wrong place and a centre of mass
that makes up for it are a payload at the right place.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

from pcw_description.effects.registry import all_effects

from ..regression.regression_problem import RegressionProblem
from ..regression.whitened_regression import Instance


def gatherings(
    problem: RegressionProblem, instances: Sequence[Instance]
) -> Iterator[tuple[tuple[Instance, ...], list[int]]]:
    """Yield what remains of a set without the terms of one effect on several casters, and the terms that may stand for these.

    Args:
        problem: holds the terms.
        instances: the set.
    """
    terms = problem.terms
    for effect, axis in dict.fromkeys((terms[i.term].effect, terms[i.term].axis) for i in instances):
        alike = [i for i in instances if (terms[i.term].effect, terms[i.term].axis) == (effect, axis)]
        covered = {target for i in alike for target in terms[i.term].target}
        known = all_effects().get(effect)
        if len(alike) < 2 or len(covered) < 2 or known is None:
            continue
        names = (effect, *known.look_alikes)
        taken = {i.term for i in alike}
        wider = [
            k for k, term in enumerate(terms)
            if term.effect in names and term.axis == axis and covered <= set(term.target) and k not in taken
        ]  # fmt: skip
        if wider:
            yield tuple(i for i in instances if i not in alike), wider
    for one, other in itertools.permutations(instances, 2):
        known = all_effects().get(terms[one.term].effect)
        mine, theirs = terms[one.term], terms[other.term]
        if known is None or (mine.target, mine.axis) != (theirs.target, theirs.axis):
            continue
        if theirs.effect in known.look_alikes and theirs.resolution:
            yield tuple(i for i in instances if i not in (one, other)), [other.term]
