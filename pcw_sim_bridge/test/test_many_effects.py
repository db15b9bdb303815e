"""A robot that seems to have everything at once has another description, likely; what leaves a gap is not all."""

import dataclasses

import numpy as np
import pytest

from pcw_description.effect_instance import EffectInstance
from pcw_sim_bridge.mismatch.analysis import (
    MOST_AT_ONCE,
    doubted_beside_a_turn,
    doubted_in_a_crowd,
    doubted_in_a_gap,
)
from pcw_sim_bridge.mismatch.findings.explanation import NamedTerm
from pcw_sim_bridge.mismatch.regression.regression_problem import Term
from pcw_sim_bridge.mismatch.regression.whitened_regression import Instance

KINDS = ("payload_mass", "payload_offset", "wheel_radius_error", "caster_offset_error", "torque_constant_error")


def named(effect: str, caster: str) -> tuple[NamedTerm, EffectInstance]:
    """Return an effect as it is named with a probability of 0.9."""
    term = Term(effect=effect, target=(caster,), parameters=(), shapes=({},), columns=lambda shape: np.zeros((1, 1, 0)))
    entry = NamedTerm(Instance(0, (), ()), term, {}, 0.9, (), 20.0, 20.0, np.zeros((1, 1)))
    return entry, EffectInstance(effect, (caster,), {}, None)


def test_so_many_kinds_of_effects_at_once_are_half_as_sure_and_the_description_is_asked_about() -> None:
    """Another robot of nearly the same geometry passes all checks of its recordings, and differs in everything else."""
    doubted, notes = doubted_in_a_crowd([named(kind, "left") for kind in KINDS])
    assert [entry.probability for entry, _ in doubted] == pytest.approx([0.45] * len(KINDS))
    assert len(notes) == 1 and f"{len(KINDS)} different effects" in notes[0] and "description" in notes[0]


def test_many_of_the_same_kinds_are_no_crowd() -> None:
    """Four orders of a cogging, or a friction in every wheel, are what one robot may well have."""
    entries = [named(kind, caster) for kind in KINDS[:MOST_AT_ONCE] for caster in ("left", "right", "rear")]
    kept, notes = doubted_in_a_crowd(entries)
    assert [entry.probability for entry, _ in kept] == [0.9] * len(entries)
    assert notes == ()


def test_what_leaves_most_of_the_gap_is_half_as_sure() -> None:
    """Wheels that scrub without yielding passed, at a probability of 1, for gears that lose six sevenths of their torque."""
    entries = [named(KINDS[0], "left")]
    doubted, notes = doubted_in_a_gap(entries, 0.41)
    assert doubted[0][0].probability == pytest.approx(0.45)
    assert len(notes) == 1 and "41 % of the gap" in notes[0]
    for closed in (0.0, 0.6, 1.0):
        assert doubted_in_a_gap(entries, closed) == (entries, ())


def test_what_is_at_work_once_need_not_close_the_gap_of_another_recording() -> None:
    entry, instance = named("external_push", "left")
    once = dataclasses.replace(entry, term=dataclasses.replace(entry.term, once=True))
    assert doubted_in_a_gap([(once, instance)], 0.2) == ([(once, instance)], ())


@pytest.mark.parametrize("offset", [0.7, -0.7, 0.05])
def test_what_is_named_beside_a_steering_that_is_far_off_is_half_as_sure(offset: float) -> None:
    """Of a centre of mass 30 mm off beside it became an IMU half a second late, at a probability of 1, and a payload."""
    entry, _ = named("steer_zero_offset", "left")
    turn = entry, EffectInstance("steer_zero_offset", ("left",), {"offset": offset}, None)
    doubted, notes = doubted_beside_a_turn([turn, named("clock_offset", "clock")])
    assert [entry.probability for entry, _ in doubted] == [0.9, 0.9 if abs(offset) < 0.1 else pytest.approx(0.45)]
    assert len(notes) == (abs(offset) > 0.1) and all("steering of left" in note for note in notes)
    assert doubted_beside_a_turn([turn]) == ([turn], ())
