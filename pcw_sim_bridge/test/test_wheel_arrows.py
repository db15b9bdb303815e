"""Arrows of contact force, load and slip: where they stand, how long they are, which way they point, their colour."""

from __future__ import annotations

import dataclasses
import io

import numpy as np
import pytest
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st

from pcw_description import load_robot, shipped_robots, wheel_centres
from pcw_description.robot_description import LateralContact
from pcw_description.urdf import robot_urdf
from pcw_sim_bridge.wheel_arrows import (
    LEAST_LENGTH,
    ArrowError,
    contact_point,
    force_arrows,
    friction_use,
    slip_arrows,
    use_colour,
)

THESIS = load_robot("thesis")
GRIP = dataclasses.replace(THESIS.contact, mu_p=0.8, lateral=LateralContact(mu_p=0.8, lambda_p=0.1))
GREEN, YELLOW, RED = (0.0, 1.0, 0.0, 1.0), (1.0, 1.0, 0.0, 1.0), (1.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize("name", shipped_robots())
def test_contact_point_is_below_the_wheel_centre_on_the_ground(name):
    """Through the URDF, which is what places the markers: the point has height 0 wherever the wheels point."""
    robot = load_robot(name)
    urdf = yourdfpy.URDF.load(io.BytesIO(robot_urdf(robot).encode()), load_meshes=False)
    steer_angle = np.linspace(-2.0, 2.5, robot.n)
    urdf.update_cfg({f"{caster}_steer": angle for caster, angle in zip(robot.caster_names, steer_angle)})
    for i, (caster, centre) in enumerate(zip(robot.caster_names, wheel_centres(robot, steer_angle))):
        fork = urdf.get_transform(f"{caster}_fork", "base_link")
        in_base = fork[:3, :3] @ contact_point(robot, i) + fork[:3, 3]
        np.testing.assert_allclose(in_base, [*centre, 0.0], atol=1e-12)


def test_force_arrows_have_the_length_and_direction_of_the_force():
    along, load = force_arrows(THESIS, 1, [30.0, -40.0, 200.0], scale=0.002)
    assert (along.kind, load.kind) == ("contact_force", "vertical_load")
    np.testing.assert_allclose(along.start, contact_point(THESIS, 1))
    np.testing.assert_allclose(along.end - along.start, [0.06, -0.08, 0.0])
    np.testing.assert_allclose(load.start, contact_point(THESIS, 1))
    np.testing.assert_allclose(load.end - load.start, [0.0, 0.0, 0.4])


def test_slip_arrow_stands_on_the_wheel_and_points_where_the_wheel_slips():
    [arrow] = slip_arrows(THESIS, 2, [0.1, -0.05], scale=2.0)
    np.testing.assert_allclose(arrow.start - contact_point(THESIS, 2), [0.0, 0.0, 2.0 * THESIS.wheel_radius[2]])
    np.testing.assert_allclose(arrow.end - arrow.start, [0.2, -0.1, 0.0])


@pytest.mark.parametrize(("share", "colour"), [(0.0, GREEN), (0.5, YELLOW), (1.0, RED), (1.7, RED)])
def test_colour_tells_the_friction_use(share, colour):
    """At 0, 50 and 100 % of mu_p F_z, in every direction along the ground."""
    for angle in np.linspace(0.0, 2.0 * np.pi, 9):
        force = [share * 0.8 * 150.0 * np.cos(angle), share * 0.8 * 150.0 * np.sin(angle), 150.0]
        assert friction_use(GRIP, force) == pytest.approx(share)
        assert use_colour(friction_use(GRIP, force)) == pytest.approx(colour, abs=1e-12)


def test_arrow_of_the_force_has_its_colour_and_that_of_the_load_has_not():
    robot = dataclasses.replace(THESIS, contact=GRIP)
    along, load = force_arrows(robot, 0, [0.0, 0.5 * 0.8 * 150.0, 150.0], 0.002)
    assert along.colour == pytest.approx(YELLOW)
    assert load.colour not in (GREEN, YELLOW, RED)


def test_friction_across_is_measured_by_the_friction_across():
    contact = dataclasses.replace(GRIP, lateral=LateralContact(mu_p=0.4, lambda_p=0.1))
    assert friction_use(contact, [0.0, 40.0, 100.0]) == pytest.approx(1.0)
    assert friction_use(contact, [40.0, 0.0, 100.0]) == pytest.approx(0.5)
    assert friction_use(contact, [80.0 * np.sqrt(0.5), 40.0 * np.sqrt(0.5), 100.0]) == pytest.approx(1.0)


def test_a_wheel_without_load_is_red_only_if_the_ground_pulls_it():
    assert use_colour(friction_use(GRIP, [0.0, 0.0, 0.0])) == GREEN
    assert use_colour(friction_use(GRIP, [1.0, 0.0, 0.0])) == RED
    assert force_arrows(THESIS, 0, [0.0, 0.0, 0.0], 0.002) == []


def test_an_arrow_too_short_to_be_seen_is_left_out():
    shortest = LEAST_LENGTH / 0.002
    assert [arrow.kind for arrow in force_arrows(THESIS, 0, [0.99 * shortest, 0.0, 100.0], 0.002)] == ["vertical_load"]
    assert len(force_arrows(THESIS, 0, [1.01 * shortest, 0.0, 100.0], 0.002)) == 2
    assert slip_arrows(THESIS, 0, [0.0, 0.0], 2.0) == []


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("place", [0, 1, 2])
def test_what_is_no_number_is_refused_by_name(bad, place):
    force = [1.0, 2.0, 3.0]
    force[place] = bad
    with pytest.raises(ArrowError, match=r"contact force of rear_left: \[.*(nan|inf).*\] N .*allowed: 3 finite numbers"):
        force_arrows(THESIS, THESIS.caster_index("rear_left"), force, 0.002)
    if place < 2:
        with pytest.raises(ArrowError, match="slip velocity of front_left"):
            slip_arrows(THESIS, 0, force[:2], 2.0)


@settings(deadline=None)  # a busy machine is slow, not wrong
@given(st.lists(st.floats(-1e4, 1e4), min_size=3, max_size=3), st.floats(1e-5, 0.1))
def test_every_finite_force_makes_finite_arrows(force, scale):
    for arrow in force_arrows(THESIS, 0, force, scale):
        assert np.isfinite([*arrow.start, *arrow.end]).all()
        assert all(0.0 <= part <= 1.0 for part in arrow.colour)
