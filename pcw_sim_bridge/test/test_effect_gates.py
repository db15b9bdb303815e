"""What an effect has to stand out from before it is named."""

from types import SimpleNamespace

import numpy as np
import pytest

from pcw_sim_bridge.mismatch.regression.regression_problem import UNKNOWN
from pcw_sim_bridge.mismatch.search.effect_gates import (
    COMMON_FACTOR,
    NOISY_FACTOR,
    NOISY_PART,
    EffectGates,
    _Left,
)
from pcw_sim_bridge.mismatch.search.selection_settings import SelectionSettings

CASTERS = ("a", "b", "c")


@pytest.mark.parametrize(
    ("named", "factor"),
    [
        (["friction"], 1.0),
        (["gear of one"], NOISY_FACTOR),
        (["gears of all"], NOISY_FACTOR * COMMON_FACTOR),
        (["friction", "gears of all"], NOISY_FACTOR * COMMON_FACTOR),
    ],
)
def test_gears_of_all_casters_stand_out_from_what_a_chassis_does_to_all_wheels(named: list[str], factor: float) -> None:
    """A chassis that pitches turns all wheels a little, like gears that wind up; it turns none alone."""
    terms = {
        "friction": SimpleNamespace(target=CASTERS, noisy=False),
        "gear of one": SimpleNamespace(target=CASTERS[:1], noisy=True),
        "gears of all": SimpleNamespace(target=CASTERS, noisy=True),
    }
    gates = EffectGates(SimpleNamespace(terms=list(terms.values())), SelectionSettings())
    instances = [SimpleNamespace(term=list(terms).index(name)) for name in named]
    assert gates._noise_factor(instances) == factor
    least = {"friction": SelectionSettings().smallest_share, "gear of one": NOISY_PART, "gears of all": 1.0}
    assert [gates._least(instance) for instance in instances] == [least[name] for name in named]


@pytest.mark.parametrize(
    ("term", "passes"),
    [
        ({"at_joints": True}, True),
        ({"is_exact": True}, False),
        ({"effect": UNKNOWN}, False),
        ({"unlike_errors": True}, True),
        ({"unlike_errors": True, "noisy": True}, False),
    ],
)
def test_what_has_a_shape_of_its_own_needs_less_to_be_told_from_errors(term: dict[str, object], passes: bool) -> None:
    """Smaller than what the model misjudges, and of a shape that its errors have not: torques at joints, errors of reading
    that turn with a joint, play. An encoder off its centre was silent with 95 nats, and so was play in all steerings with 435.
    """
    settings = SelectionSettings()
    nats = 0.5 * (settings.least_peculiar_unlike + settings.least_peculiar)
    assert (_share_with(nats, term) >= 1.0) == passes


@pytest.mark.parametrize(
    ("term", "passes"),
    [
        ({"axis": "steer"}, True),
        ({"axis": "drive", "target": CASTERS}, False),
        ({}, False),  # a tyre
    ],
)
def test_one_gear_that_winds_up_is_like_no_error_of_the_model(term: dict[str, object], passes: bool) -> None:
    """Smaller than what the model misjudges of slips: one of 145 N m/rad was silent with 327 nats. Healthy: 36 at most."""
    nats = 1.5 * SelectionSettings().least_peculiar
    assert (_share_with(nats, {"noisy": True, **term}) >= 1.0) == passes


def _share_with(nats: float, term: dict[str, object]) -> float:
    """Share of a term that does less than what the model misjudges, and that has so many nats beside its errors."""
    plain = {"effect": "friction", "target": ("a",), "axis": None, "noisy": False, "at_joints": False, "unlike_errors": False}
    problem = SimpleNamespace(
        terms=[SimpleNamespace(**plain | term), SimpleNamespace(**plain | {"target": CASTERS})], scale_deviation=0.0,
        measured=np.ones((2, 1)), valid=np.ones((2, 1), dtype=bool), drifts=np.ones((2, 1, 1)),
    )
    regression = SimpleNamespace(peculiar=lambda change: nats)
    size, left = np.array([0.5]), _Left(np.array([0.1]), np.ones((2, 1)))
    gates = EffectGates(problem, SelectionSettings())  # type: ignore[arg-type]
    return gates._share(regression, [SimpleNamespace(term=0)], size[:, None], size, left, np.array([0.0]))
