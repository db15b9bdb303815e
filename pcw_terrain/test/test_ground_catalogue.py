"""The catalogue of grounds: the published curve, its peak, and a robot put on it."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_description import DescriptionError, load_robot, parse_robot
from pcw_description.contact.contact_model import friction_coefficient, tyre_parameters
from pcw_description.robot_description import CONTACT_MODELS
from pcw_description.robot_file import robot_to_mapping
from pcw_terrain import GROUNDS, Ground, contact_on, ground, robot_on
from pcw_terrain.ground_catalogue import main, table

# Peaks that Burckhardt's table states beside the triples (slip ratio, friction), to the digits printed.
PUBLISHED_PEAKS = {
    "dry_asphalt": (0.17, 1.17),
    "wet_asphalt": (0.131, 0.801),
    "dry_concrete": (0.16, 1.09),
    "dry_cobblestone": (0.40, 1.00),
    "wet_cobblestone": (0.14, 0.38),
    "snow": (0.06, 0.19),
    "ice": (0.031, 0.05),
}


def test_catalogue_holds_the_published_grounds() -> None:
    assert set(GROUNDS) == set(PUBLISHED_PEAKS)
    for name, entry in GROUNDS.items():
        assert entry.name == name
        assert re.search(r"\d{4}", entry.source), "a source has a year"


@pytest.mark.parametrize("name", PUBLISHED_PEAKS)
def test_peak_is_the_published_one(name: str) -> None:
    lambda_p, mu_p = PUBLISHED_PEAKS[name]
    assert ground(name).lambda_p == pytest.approx(lambda_p, abs=0.0006)
    assert ground(name).mu_p == pytest.approx(mu_p, abs=0.0006)


@pytest.mark.parametrize("name", PUBLISHED_PEAKS)
def test_peak_is_the_maximum_of_the_curve(name: str) -> None:
    """Independent of the closed form: the largest of 20 001 values of the published formula."""
    entry = ground(name)
    slip = np.linspace(0.0, 1.0, 20_001)
    friction = entry.c1 * (1.0 - np.exp(-entry.c2 * slip)) - entry.c3 * slip
    best = int(np.argmax(friction))
    assert entry.lambda_p == pytest.approx(slip[best], abs=1e-4)
    assert entry.mu_p == pytest.approx(friction[best], abs=1e-8)
    np.testing.assert_allclose([entry.friction(s) for s in slip[::500]], friction[::500], rtol=1e-12, atol=1e-15)
    assert entry.friction(-0.1) == -entry.friction(0.1)


def test_grounds_come_in_the_order_that_drivers_know() -> None:
    order = ["dry_asphalt", "dry_concrete", "dry_cobblestone", "wet_asphalt", "wet_cobblestone", "snow", "ice"]
    peaks = [ground(name).mu_p for name in order]
    assert peaks == sorted(peaks, reverse=True)


@settings(deadline=None)
@given(name=st.sampled_from(sorted(PUBLISHED_PEAKS)), slip=st.floats(-1.0, 1.0))
def test_robot_on_a_ground_has_its_published_curve(name: str, slip: float) -> None:
    """Through the contact model that the simulators use, along and across."""
    tyre = tyre_parameters(robot_on(load_robot("thesis"), name).contact)
    along, _ = friction_coefficient(tyre, slip, 0.0)
    _, across = friction_coefficient(tyre, 0.0, slip)
    assert along == pytest.approx(ground(name).friction(slip), abs=1e-9)
    assert across == pytest.approx(ground(name).friction(slip), abs=1e-9)


@pytest.mark.parametrize("curve", CONTACT_MODELS)
def test_every_curve_has_the_peak_of_the_ground(curve: str) -> None:
    place = ground("wet_asphalt")
    contact = contact_on(load_robot("tidybot2").contact, place, curve)
    assert (contact.model, contact.mu_p, contact.lambda_p) == (curve, place.mu_p, place.lambda_p)
    along, _ = friction_coefficient(tyre_parameters(contact), place.lambda_p, 0.0)
    # Dugoff's curve reaches its plateau only beyond the peak, LuGre's depends on speed: they share what their files say.
    if curve in ("kiencke", "magic_formula", "burckhardt"):
        assert along == pytest.approx(place.mu_p, rel=1e-6)


def test_only_the_ground_changes_and_the_description_stays_valid() -> None:
    before = load_robot("thesis")
    after = robot_on(before, "snow")
    assert after.contact.relaxation_length == before.contact.relaxation_length
    assert after.provenance["contact"] == "snow: Burckhardt 1993, as burckhardt curve; tyre as before"
    assert before.contact.model == "kiencke" and "snow" not in before.provenance["contact"]
    assert dataclasses.replace(after, contact=before.contact, provenance=before.provenance) == before
    assert parse_robot(robot_to_mapping(after)) == after
    assert robot_on(before, GROUNDS["snow"]) == after


def test_mistakes_are_named() -> None:
    with pytest.raises(DescriptionError, match=r"ground: 'dry_asfalt' .* did you mean 'dry_asphalt'\? allowed: .*wet_asphalt"):
        ground("dry_asfalt")
    with pytest.raises(DescriptionError, match=r"curve: 'kienke' .* did you mean 'kiencke'\?"):
        contact_on(load_robot("thesis").contact, ground("ice"), "kienke")
    with pytest.raises(DescriptionError, match=r"c1, c3 > 0 and c1 c2 > c3 \(a peak\)"):
        Ground("glass", 0.05, 306.39, 0.0, "printed without a falling branch")


def test_catalogue_cannot_be_changed() -> None:
    with pytest.raises(TypeError):
        GROUNDS["mud"] = ground("ice")  # type: ignore[index]


def test_command_prints_the_table_of_the_readme(capsys: pytest.CaptureFixture[str]) -> None:
    """Run `grounds` and put its output between the two marks when this fails."""
    assert main([]) == 0
    printed = capsys.readouterr().out.strip()
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"<!-- grounds: begin -->\n(.*?)\n<!-- grounds: end -->", readme, re.DOTALL) == [printed] == [table()]


def test_example_of_the_readme_runs() -> None:
    readme = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    examples = re.findall(r"```python\n(.*?)```", readme, re.DOTALL)
    assert len(examples) == 2
    example = "\n".join(examples)
    names: dict[str, object] = {}
    exec(example, names)  # noqa: S102 - our own text
    assert names["robot"] == robot_on(load_robot("tidybot2"), "wet_asphalt")


def test_command_prints_a_section_that_a_robot_file_can_hold(capsys: pytest.CaptureFixture[str]) -> None:
    import yaml

    assert main(["wet_cobblestone", "--robot", "tidybot2"]) == 0
    data = robot_to_mapping(load_robot("tidybot2"))
    data.update(yaml.safe_load(capsys.readouterr().out))
    pasted, expected = parse_robot(data).contact, robot_on(load_robot("tidybot2"), "wet_cobblestone").contact
    assert pasted.model == expected.model and pasted.shape == expected.shape
    assert pasted.mu_p == pytest.approx(expected.mu_p, rel=1e-5)
    assert main(["wet_cobble"]) == 2
    assert "did you mean 'wet_cobblestone'?" in capsys.readouterr().err
