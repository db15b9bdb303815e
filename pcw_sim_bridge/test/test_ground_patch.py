"""Patches of other ground: which effects are one, and whether their shapes have the area and place that they say."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_description import DescriptionError, load_robot
from pcw_description.effect_instance import EffectInstance
from pcw_sim_bridge.ground_patch import POINTS_PER_QUARTER, GroundPatch, ground_patches

THESIS = load_robot("thesis")
ALL = THESIS.caster_names
ICE = {"x": 1.0, "y": -0.5, "length": 2.0, "width": 0.6, "yaw": 0.3, "roundness": 1.0, "factor": 0.25}
SQUARE = {"x": 0.0, "y": 0.0, "length": 1.0, "width": 1.0}


def with_physics(*effects):
    return dataclasses.replace(THESIS, physics=tuple(effects))


def area(corners):
    """The area of a polygon, positive if counter-clockwise."""
    x, y = corners.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


sizes, places = st.floats(0.01, 100.0), st.floats(-50.0, 50.0)


@settings(deadline=None)  # a busy machine is slow, not wrong
@given(places, places, sizes, sizes, st.floats(-7.0, 7.0))
def test_a_rectangle_has_its_area_and_its_corners(x, y, length, width, yaw):
    corners = GroundPatch("ice", x, y, length, width, yaw).outline()
    # Cancellation: coordinates of 50 m, areas of 1e-4 m^2.
    assert area(corners) == pytest.approx(length * width, rel=1e-9, abs=1e-10)
    local = (corners - [x, y]) @ [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    np.testing.assert_allclose(np.abs(local), np.broadcast_to([0.5 * length, 0.5 * width], local.shape), atol=1e-11)


@settings(deadline=None)  # a busy machine is slow, not wrong
@given(sizes, sizes, st.floats(-7.0, 7.0))
def test_an_ellipse_has_the_area_of_its_polygon(length, width, yaw):
    corners = GroundPatch("ice", 0.0, 0.0, length, width, yaw, roundness=1.0).outline()
    m = 4 * POINTS_PER_QUARTER
    assert area(corners) == pytest.approx(0.25 * length * width * 0.5 * m * math.sin(2.0 * math.pi / m), rel=1e-9)
    assert area(corners) == pytest.approx(0.25 * math.pi * length * width, rel=1e-3)  # the eye sees an ellipse


def test_area_falls_from_rectangle_to_ellipse():
    areas = [area(GroundPatch("ice", 0.0, 0.0, 2.0, 1.0, 0.4, roundness).outline()) for roundness in np.linspace(0.0, 1.0, 6)]
    assert np.all(np.diff(areas) < 0.0)


@pytest.mark.parametrize("roundness", [0.0, 0.4, 1.0])
def test_triangles_fill_the_outline_and_face_upwards(roundness):
    patch = GroundPatch("ice", 3.0, -2.0, 2.0, 0.5, 1.1, roundness)
    pieces = [area(triangle) for triangle in patch.triangles()]
    assert min(pieces) >= -1e-12
    assert sum(pieces) == pytest.approx(area(patch.outline()))


def test_patches_are_found_by_their_parameters():
    """By no name: an effect of another package is a patch too; one on the chassis, or without a size, is none."""
    robot = with_physics(
        EffectInstance("drive_coulomb_friction", ALL, {"coulomb": 0.5, "asymmetry": 0.0}),
        EffectInstance("low_friction_patch", ALL, ICE),
        EffectInstance("wet_carpet", ("front_left", "rear_left"), {**SQUARE, "depth": 0.01}),
        EffectInstance("payload_box", ("chassis",), SQUARE),
        EffectInstance("spot", ALL, {"x": 0.0, "y": 0.0, "length": 1.0}),
    )
    ice, carpet = ground_patches(robot)
    assert ice == GroundPatch("low_friction_patch", **ICE)
    assert ice.label == "friction x 0.25"
    assert carpet.label == "wet carpet (front_left, rear_left only)"
    assert (carpet.yaw, carpet.roundness, carpet.factor) == (0.0, 0.0, None)
    assert ground_patches(THESIS) == ()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"x": math.nan}, "low_friction_patch.x: nan is not allowed; allowed: a finite number"),
        ({"factor": math.inf}, "low_friction_patch.factor: inf"),
        ({"width": 0.0}, "low_friction_patch.width: 0.0 is not allowed; allowed: above 0 m"),
        ({"roundness": 1.5}, "low_friction_patch.roundness: 1.5 is not allowed; allowed: 0 to 1"),
    ],
)
def test_a_patch_that_cannot_be_drawn_is_refused_by_name(change, complaint):
    with pytest.raises(DescriptionError, match=complaint):
        ground_patches(with_physics(EffectInstance("low_friction_patch", ALL, {**ICE, **change})))
