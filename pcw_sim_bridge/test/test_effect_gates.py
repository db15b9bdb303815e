"""What an effect has to stand out from before it is named."""

from types import SimpleNamespace

import pytest

from pcw_sim_bridge.mismatch.effect_gates import COMMON_FACTOR, NOISY_FACTOR, EffectGates
from pcw_sim_bridge.mismatch.selection_settings import SelectionSettings

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
    assert gates._noise_factor([SimpleNamespace(term=list(terms).index(name)) for name in named]) == factor
