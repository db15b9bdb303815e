"""Gives what came nearest to an effect the benefit of the doubt, where nothing is named of what no noise explains."""

from __future__ import annotations

import dataclasses

from ..search.evidence_selection import BELOW_DETAILS
from .explanation import HALF_AS_SURE, Explanation, explanation_by
from .findings import FLAG_PROBABILITY, some_of


def with_the_nearest(explanation: Explanation) -> Explanation:
    """Return the explanation with what came nearest to an effect, half as sure, where nothing else tells what is amiss.

    What does less than the model may misjudge is, by itself, as likely that. Where noise and tolerances do not explain what
    channels hold, it is as likely the effect: that the model of a healthy robot leaves that, too, is rare. Errors of the model
    look like several effects as a rule, and held-out data have to bear it out.
    """
    search, nearest = explanation.search, explanation.nearest()
    names = (channel.name for channel in search.problem.channels)
    beyond = [name for name, p in zip(names, explanation.p_values, strict=True) if p < FLAG_PROBABILITY]
    told = bool(explanation.named or explanation.leftovers or explanation.withdrawn)
    # Of a bench nothing says what its model misjudges.
    if told or not beyond or search.problem.drifts is None or nearest is None or nearest.outcome != BELOW_DETAILS:
        return explanation
    assert nearest.refused is not None
    here = search.place
    instead = explanation_by(explanation, (nearest.refused,))
    selection = instead.selection
    stands = bool(instead.named) and selection.losses[0] >= selection.threshold and selection.held_out[0] > 0.0
    if not stands or any(entry.ambiguous_with for entry in instead.named):
        search.place = here
        return explanation
    remark = (
        f"{search.label(instead.named[0].instance)} does less than what the model itself may misjudge. It is named because "
        f"noise and tolerances alone do not explain {some_of(beyond)}, and nothing else explains more of that: half as sure."
    )
    named = tuple(dataclasses.replace(entry, probability=HALF_AS_SURE * entry.probability) for entry in instead.named)
    doubtful = frozenset(entry.instance for entry in named)
    return dataclasses.replace(instead, named=named, remarks=(*explanation.remarks, remark), doubtful=doubtful)
