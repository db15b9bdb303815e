"""Wheel dynamics and tyres, (3.43)-(3.47): published curves, and what a simulator needs of them at any speed and
step.
"""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcw_description import DescriptionError, load_robot
from pcw_description.contact import burckhardt
from pcw_description.contact.contact_model import (
    MODELS,
    SCRUB_SPEED,
    friction_coefficient,
    scrub_torque,
    tyre_parameters,
    tyre_step,
    with_friction,
)
from pcw_description.robot_description import CONTACT_MODELS, ContactDescription, LateralContact
from pcw_description.wheel_dynamics import lateral_force_from_statics, slip_ratio, wheel_acceleration

NOMINAL = load_robot("thesis").contact
PEAKED = ("kiencke", "magic_formula", "burckhardt")


def contact(model: str, mu_p: float = 0.8, lambda_p: float = 0.1, **options) -> ContactDescription:
    """Return a contact; the lateral direction has its own numbers, so that mixing the two up shows."""
    options.setdefault("lateral", LateralContact(0.6, 0.07))
    return dataclasses.replace(NOMINAL, model=model, mu_p=mu_p, lambda_p=lambda_p, **options)


def longitudinal(tyre: np.ndarray, slips) -> np.ndarray:
    """Return mu for pure longitudinal slips."""
    return np.array([friction_coefficient(tyre, slip, 0.0)[0] for slip in slips])


def lateral(tyre: np.ndarray, slips) -> np.ndarray:
    """Return mu for pure lateral slips."""
    return np.array([friction_coefficient(tyre, 0.0, slip)[1] for slip in slips])


@pytest.mark.parametrize("model", MODELS)
def test_more_friction_stretches_a_curve_and_is_no_stiffer(model: str) -> None:
    """Three tenths more of it, reached at three tenths more slip, in both directions; under small forces nothing changes."""
    tyre = tyre_parameters(contact(model))
    [stretched] = with_friction(tyre[None], 1.3)
    for curve in (longitudinal, lateral):
        np.testing.assert_allclose(curve(stretched, [1e-5]), curve(tyre, [1e-5]), rtol=1e-3)
        if model in PEAKED:
            slips = np.linspace(0.0, 0.25, 20)
            np.testing.assert_allclose(curve(stretched, 1.3 * slips), 1.3 * curve(tyre, slips), rtol=1e-12)


def steady_friction(
    tyre: np.ndarray, slip_x: float, slip_y: float, speed: float, dt: float = 1e-3
) -> tuple[float, float]:
    """Return the coefficients that a tyre settles to at constant slip velocities [m/s] and rolling speed [m/s]."""
    z_x = z_y = f_x = f_y = 0.0
    for _ in range(int(40.0 * tyre[11] / speed / dt) + 100):
        z_x, z_y, f_x, f_y = tyre_step(tyre, z_x, z_y, slip_x, slip_y, speed, 1.0, dt)
    return f_x, f_y


# --- slip ratio and wheel ---


@pytest.mark.parametrize(
    ("rolling", "wheel", "expected"),
    [
        (1.0, 0.8, 0.2),  # traction forwards
        (0.8, 1.0, -0.2),  # braking forwards
        (-1.0, -0.8, -0.2),  # traction backwards: pushes backwards
        (-0.8, -1.0, 0.2),  # braking backwards: pushes forwards
        (0.5, 0.0, 1.0),  # spinning on the spot
        (0.0, 0.5, -1.0),  # locked
        (0.0, -0.5, 1.0),  # locked, backwards
        (0.5, -0.5, 2.0),  # spinning against the motion
        (0.3, 0.3, 0.0),  # rolling
        (0.0, 0.0, 0.0),  # at rest
    ],
)
def test_slip_ratio_in_all_quadrants(rolling: float, wheel: float, expected: float) -> None:
    """(3.43), with the sign of the force that the slip makes in all four quadrants."""
    assert slip_ratio(rolling, wheel) == pytest.approx(expected, abs=1e-15)


@given(rolling=st.floats(0.0, 10.0), wheel=st.floats(0.0, 10.0))
def test_slip_ratio_is_the_one_of_the_thesis_forwards(rolling: float, wheel: float) -> None:
    """(3.43) literally where it was meant, and odd under reversal of the motion."""
    largest = max(rolling, wheel)
    expected = (rolling - wheel) / largest if largest > 0.0 else 0.0
    assert slip_ratio(rolling, wheel) == pytest.approx(expected, rel=1e-12, abs=1e-300)
    assert slip_ratio(-rolling, -wheel) == -slip_ratio(rolling, wheel)
    assert -1.0 <= slip_ratio(rolling, wheel) <= 1.0


def test_wheel_acceleration_balances_torque_and_traction() -> None:
    """(3.45): I rho_ddot = tau - F_x r, and none where they balance."""
    assert wheel_acceleration(0.02, 3.0, 20.0, 0.075) == pytest.approx((3.0 - 1.5) / 0.02)
    assert wheel_acceleration(0.02, 1.5, 20.0, 0.075) == pytest.approx(0.0, abs=1e-12)
    assert wheel_acceleration(0.02, 0.0, 20.0, 0.075) < 0.0


def test_side_force_from_steering_torque() -> None:
    """tau_phi = F_y b with b = -b_x: a trailing wheel steered counter-clockwise is pushed to the left by the ground."""
    assert lateral_force_from_statics(0.6, -0.03) == pytest.approx(20.0)


# --- curves ---


@given(slip=st.floats(0.0, 2.0), mu_p=st.floats(0.05, 1.5), lambda_p=st.floats(0.01, 0.5))
def test_kiencke_is_the_equation_of_the_thesis(slip: float, mu_p: float, lambda_p: float) -> None:
    """(3.47) literally."""
    tyre = tyre_parameters(contact("kiencke", mu_p, lambda_p))
    expected = 2.0 * mu_p * lambda_p * slip / (lambda_p**2 + slip**2)
    assert friction_coefficient(tyre, slip, 0.0)[0] == pytest.approx(expected, rel=1e-9, abs=1e-11)


@pytest.mark.parametrize("slip", [1e-3, 0.02, 0.07, 0.0999, 0.3, 1.0])
def test_every_friction_below_the_peak_belongs_to_two_slips(slip: float) -> None:
    """Kiencke: mu(lambda) = mu(lambda_p^2 / lambda), the trap of every observer that inverts the curve."""
    tyre = tyre_parameters(contact("kiencke"))
    assert friction_coefficient(tyre, slip, 0.0)[0] == pytest.approx(
        friction_coefficient(tyre, 0.01 / slip, 0.0)[0], rel=1e-12
    )


@pytest.mark.parametrize("model", PEAKED)
@pytest.mark.parametrize(("mu_p", "lambda_p"), [(0.8, 0.1), (0.1, 0.03), (1.2, 0.25)])
def test_the_peak_is_where_the_description_says(model: str, mu_p: float, lambda_p: float) -> None:
    """Along and across: mu_p at lambda_p, less everywhere else, rising before and falling after."""
    tyre = tyre_parameters(contact(model, mu_p, lambda_p))
    for curve, height, place in ((longitudinal, mu_p, lambda_p), (lateral, 0.6, 0.07)):
        assert curve(tyre, [place])[0] == pytest.approx(height, rel=1e-12)
        slips = place * np.array([0.1, 0.5, 0.9, 0.999, 1.0, 1.001, 1.1, 2.0])
        values = curve(tyre, slips)
        assert np.all(np.diff(values[:5]) > 0.0)
        assert np.all(np.diff(values[4:]) < 0.0)


def test_dugoff_reaches_95_percent_and_has_no_peak() -> None:
    """Its friction rises towards mu_p for ever; at lambda_p 95 % of it is reached."""
    tyre = tyre_parameters(contact("dugoff"))
    assert longitudinal(tyre, [0.1])[0] == pytest.approx(0.95 * 0.8, rel=1e-12)
    values = longitudinal(tyre, np.linspace(1e-3, 2.0, 400))
    assert np.all(np.diff(values) > -1e-15)
    assert values[100] < 0.8
    assert values[-1] == 0.8


def test_dugoff_is_the_published_equation() -> None:
    """mu = C s / (1 - s) f(t), t = mu_p (1 - s) / (2 C s), both branches of f, continuous where they meet (t = 1)."""
    stiffness, mu_p = 12.0, 0.8
    tyre = tyre_parameters(contact("dugoff", mu_p, shape={"stiffness": stiffness}))
    for slip in (0.01, 0.02, 0.032, 0.0325, 0.1, 0.5, 0.95):
        t = mu_p * (1.0 - slip) / (2.0 * stiffness * slip)
        expected = stiffness * slip / (1.0 - slip) * (t * (2.0 - t) if t < 1.0 else 1.0)
        assert longitudinal(tyre, [slip])[0] == pytest.approx(expected, rel=1e-12)
    meeting = mu_p / (2.0 * stiffness + mu_p)
    before, after = longitudinal(tyre, [meeting * (1.0 - 1e-9), meeting * (1.0 + 1e-9)])
    assert before == pytest.approx(after, rel=1e-7)


# Published triples (Burckhardt 1993) and the peaks that the literature quotes for them.
ROADS = {
    "dry asphalt": (1.2801, 23.99, 0.52, 0.17, 1.17),
    "wet asphalt": (0.857, 33.822, 0.347, 0.13, 0.80),
    "dry cobblestone": (1.3713, 6.4565, 0.6691, 0.40, 1.00),
    "dry concrete": (1.1973, 25.168, 0.5373, 0.16, 1.09),
    "snow": (0.1946, 94.129, 0.0646, 0.06, 0.19),
}


@pytest.mark.parametrize("road", ROADS)
def test_burckhardt_with_its_own_peak_is_the_published_curve(road: str) -> None:
    """The triple's peak is the published one, and a description with that peak gives the published curve unscaled."""
    c1, c2, c3, published_lambda, published_mu = ROADS[road]
    lambda_p, mu_p = burckhardt.peak(c1, c2, c3)
    assert lambda_p == pytest.approx(published_lambda, abs=0.006)
    assert mu_p == pytest.approx(published_mu, abs=0.006)
    tyre = tyre_parameters(contact("burckhardt", mu_p, lambda_p, shape={"c1": c1, "c2": c2, "c3": c3}))
    for slip in (0.01, 0.05, 0.1, 0.3, 1.0):
        assert longitudinal(tyre, [slip])[0] == pytest.approx(
            c1 * (1.0 - math.exp(-c2 * slip)) - c3 * slip, rel=1e-9
        )


@pytest.mark.parametrize(
    "shape", [{}, {"C": 1.3}, {"C": 1.65, "E": -5.0}, {"C": 1.9, "E": 0.9}, {"C": 2.0, "E": 0.5}]
)
def test_magic_formula_peaks_for_every_shape(shape: dict[str, float]) -> None:
    """mu_p at lambda_p for any C and E, nothing above it, and never below zero however far it slides."""
    tyre = tyre_parameters(contact("magic_formula", shape=shape))
    values = longitudinal(tyre, np.linspace(0.0, 2.0, 4001))
    assert longitudinal(tyre, [0.1])[0] == pytest.approx(0.8, rel=1e-9)
    assert values.max() <= 0.8 * (1.0 + 1e-12)
    assert longitudinal(tyre, [1e6])[0] >= -1e-4
    b, c, e = tyre[3], shape.get("C", 1.65), shape.get("E", 0.0)
    x = b * 0.37
    assert longitudinal(tyre, [0.37])[0] == pytest.approx(
        0.8 * math.sin(c * math.atan(x - e * (x - math.atan(x)))), rel=1e-12
    )


@pytest.mark.parametrize("speed", [0.2, 1.0, 3.0])
@pytest.mark.parametrize("slip", [0.01, 0.1, 0.6])
def test_lugre_settles_to_its_closed_form(speed: float, slip: float) -> None:
    """mu = C s / (1 + C s / g(v_r)), s = v_r / V, C = 2 mu_p / lambda_p: its friction depends on speed, along and
    across.
    """
    tyre = tyre_parameters(contact("lugre", shape={"mu_c": 0.5, "v_s": 0.8}))
    v_r = slip * speed
    for direction, (mu_p, lambda_p) in enumerate([(0.8, 0.1), (0.6, 0.07)]):
        g = 0.5 + (mu_p - 0.5) * math.exp(-math.sqrt(v_r / 0.8))
        expected = 2.0 * mu_p / lambda_p * slip / (1.0 + 2.0 * mu_p / lambda_p * slip / g)
        found = steady_friction(tyre, *((v_r, 0.0) if direction == 0 else (0.0, v_r)), speed)[direction]
        assert found == pytest.approx(expected, rel=1e-9)
        if speed == 1.0:
            curve = (longitudinal, lateral)[direction]
            assert curve(tyre, [slip])[0] == pytest.approx(expected, rel=1e-12)


def test_lugre_slides_with_the_friction_of_each_direction() -> None:
    """Sliding sideways at speed gives the lateral friction.

    The lateral bristles were once loaded by the longitudinal stiffness, so that with a stiffer side they held 50 % too much.
    """
    tyre = tyre_parameters(
        contact("lugre", 0.8, 0.1, lateral=LateralContact(0.6, 0.02), shape={"mu_c": 0.5, "v_s": 0.01})
    )
    assert steady_friction(tyre, 5.0, 0.0, 5.0)[0] == pytest.approx(0.5, rel=0.1)
    assert steady_friction(tyre, 0.0, 5.0, 5.0)[1] == pytest.approx(0.5, rel=0.1)


@pytest.mark.parametrize("model", CONTACT_MODELS)
@given(slip_x=st.floats(-2.0, 2.0), slip_y=st.floats(-2.0, 2.0))
def test_every_curve_is_odd_and_inside_the_friction_ellipse(model: str, slip_x: float, slip_y: float) -> None:
    """Reversed slip, reversed force; force along the slip's signs; combined force within the ellipse of the two
    peaks.
    """
    tyre = tyre_parameters(contact(model))
    along, across = friction_coefficient(tyre, slip_x, slip_y)
    assert friction_coefficient(tyre, -slip_x, -slip_y) == (-along, -across)
    assert friction_coefficient(tyre, slip_x, -slip_y) == (along, -across)
    assert along * slip_x >= 0.0
    assert across * slip_y >= 0.0
    assert (along / 0.8) ** 2 + (across / 0.6) ** 2 <= 1.0 + 1e-12


@pytest.mark.parametrize("model", CONTACT_MODELS)
def test_side_slip_takes_traction_away(model: str) -> None:
    """Combined slip: sliding sideways as well leaves less force along, for the same slip ratio."""
    tyre = tyre_parameters(contact(model))
    forces = [friction_coefficient(tyre, 0.1, slip)[0] for slip in (0.0, 0.05, 0.1, 0.3)]
    assert np.all(np.diff(forces) < 0.0)


def test_all_models_are_behind_the_one_interface() -> None:
    """The names of the description are the models of the contact, in one place each."""
    assert tuple(MODELS) == CONTACT_MODELS


# --- relaxed slip ---


@pytest.mark.parametrize("model", [name for name in CONTACT_MODELS if name != "lugre"])
@pytest.mark.parametrize("speed", [0.05, 0.3, 2.0])
@pytest.mark.parametrize("slip", [(0.04, 0.0), (-0.2, 0.0), (0.0, 0.05), (0.06, -0.03)])
def test_steady_rolling_is_on_the_curve(model: str, speed: float, slip: tuple[float, float]) -> None:
    """lambda = eps / V in steady rolling, at any speed, so that mu(lambda) is the curve."""
    tyre = tyre_parameters(contact(model))
    expected = friction_coefficient(tyre, *slip)
    found = steady_friction(tyre, slip[0] * speed, slip[1] * speed, speed)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_the_force_builds_up_over_the_relaxation_length() -> None:
    """After rolling one relaxation length 1 - 1/e of the slip is there, whatever the speed."""
    tyre = tyre_parameters(contact("kiencke"))
    for speed in (0.1, 1.0):
        dt, z = 1e-5, 0.0
        for _ in range(round(NOMINAL.relaxation_length / speed / dt)):
            z, *_ = tyre_step(tyre, z, 0.0, 0.01 * speed, 0.0, speed, 1.0, dt)
        assert z / NOMINAL.relaxation_length == pytest.approx(0.01 * (1.0 - math.exp(-1.0)), rel=2e-3)


GRAVITY, LOAD = 9.81, 22.5
ROLL_INERTIA, RADIUS = 0.0202, 0.075  # wheel and reflected rotor of the thesis robot


def coasting_wheel(
    model: str, speed: float, dt: float, relaxed: bool = True, inertia: float = ROLL_INERTIA
) -> np.ndarray:
    """Return the slip velocity (k,) of a loaded wheel that is released rolling 1 % too fast, for one second."""
    tyre = tyre_parameters(dataclasses.replace(NOMINAL, model=model))
    v, rate, z = speed, 1.01 * speed / RADIUS, 0.0
    slips = []
    for _ in range(int(1.0 / dt)):
        slip, rolling = RADIUS * rate - v, max(abs(RADIUS * rate), abs(v))
        if relaxed:
            z, _, force, _ = tyre_step(tyre, z, 0.0, slip, 0.0, rolling, LOAD * GRAVITY, dt)
        else:
            force = friction_coefficient(tyre, slip_ratio(RADIUS * rate, v), 0.0)[0] * LOAD * GRAVITY
        rate += dt * wheel_acceleration(inertia, 0.0, force, RADIUS)
        v += dt * force / LOAD
        slips.append(RADIUS * rate - v)
    return np.array(slips)


@pytest.mark.parametrize("dt", [0.125e-3, 0.5e-3, 1e-3, 2e-3, 4e-3])
@pytest.mark.parametrize("speed", [0.05, 0.2, 0.7, 2.0])
def test_relaxed_slip_is_stable_where_the_ratio_is_not(speed: float, dt: float) -> None:
    """EQUATIONS section 3: from 0.125 ms to 4 ms and 0.05 m/s to 2 m/s a coasting wheel comes to roll without slip."""
    assert np.abs(coasting_wheel("kiencke", speed, dt)[-int(0.2 / dt) :]).max() < 1e-8


@pytest.mark.parametrize("model", CONTACT_MODELS)
def test_every_curve_is_stable_at_the_step_of_the_plant(model: str) -> None:
    """The other curves are stiffer at the origin, Dugoff's twice; 1 ms holds for all of them, at a crawl too."""
    for speed in (0.05, 0.5, 2.0):
        assert np.abs(coasting_wheel(model, speed, 1e-3)[-200:]).max() < 1e-8


def test_the_plain_slip_ratio_limit_cycles() -> None:
    """Why the slip is relaxed: force straight from the ratio leaves tens of mm/s of false slip at 1 ms, for ever."""
    for speed, inertia in ((0.05, ROLL_INERTIA), (1.0, 0.0042)):
        assert (
            np.abs(coasting_wheel("kiencke", speed, 1e-3, relaxed=False, inertia=inertia)[-200:]).max() > 0.02
        )
        assert np.abs(coasting_wheel("kiencke", speed, 1e-3, inertia=inertia)[-200:]).max() < 1e-8


@pytest.mark.parametrize("model", CONTACT_MODELS)
def test_a_parked_wheel_holds_against_a_push(model: str) -> None:
    """At rest the tyre is a spring with a damper: half the friction limit moves it by millimetres, and then it stands.

    A force from a slip ratio made safe by a smallest speed would let it creep for ever.
    """
    tyre = tyre_parameters(dataclasses.replace(NOMINAL, model=model))
    push = 0.5 * NOMINAL.lateral.mu_p * LOAD * GRAVITY
    v = z = moved = 0.0
    path = []
    for _ in range(4000):
        _, z, _, force = tyre_step(tyre, 0.0, z, 0.0, -v, abs(v), LOAD * GRAVITY, 1e-3)
        v += 1e-3 * (push + force) / LOAD
        moved += 1e-3 * v
        path.append(moved)
    assert 0.0 < path[-1] < 0.01
    assert abs(v) < 1e-4
    assert path[-1] - path[-500] < 1e-4


@pytest.mark.parametrize("model", CONTACT_MODELS)
def test_a_tyre_takes_energy_and_gives_none(model: str) -> None:
    """Force times slip velocity, over any motion from rest, is what is dissipated: never negative in all, nor on
    average.

    Slip wanders over several times the critical slip and the rolling speed with it, down to standstill.
    """
    rng = np.random.default_rng(9)
    tyre = tyre_parameters(contact(model))
    dt = 5e-4
    for scale in (0.002, 0.05, 0.5):
        z_x = z_y = work = 0.0
        wander = np.zeros(3)
        lowest = 0.0
        for _ in range(8000):
            wander += -wander * dt / 0.05 + math.sqrt(2.0 * dt / 0.05) * rng.normal(size=3)
            slip_x, slip_y = scale * wander[:2]
            speed = max(math.hypot(slip_x, slip_y), abs(wander[2]) * 0.3)
            z_x, z_y, f_x, f_y = tyre_step(tyre, z_x, z_y, slip_x, slip_y, speed, 1.0, dt)
            work += dt * (f_x * slip_x + f_y * slip_y)
            lowest = min(lowest, work)
        assert work > 0.0
        # The unit of work: full friction over one relaxation length.
        assert lowest > -1e-3 * 0.8 * NOMINAL.relaxation_length


@pytest.mark.parametrize("model", CONTACT_MODELS)
def test_an_unloaded_wheel_feels_no_force(model: str) -> None:
    """F = mu F_z, (3.46): none without load, twice with twice the load."""
    tyre = tyre_parameters(contact(model))
    assert tyre_step(tyre, 1e-3, 1e-3, 0.1, 0.1, 1.0, 0.0, 1e-3)[2:] == (0.0, 0.0)
    single = np.array(tyre_step(tyre, 1e-3, 5e-4, 0.1, 0.1, 1.0, 50.0, 1e-3)[2:])
    double = np.array(tyre_step(tyre, 1e-3, 5e-4, 0.1, 0.1, 1.0, 100.0, 1e-3)[2:])
    np.testing.assert_allclose(double, 2.0 * single, rtol=1e-14)


def test_scrub_resists_turning_on_the_spot_and_fades_with_speed() -> None:
    """Against the turn, at most mu_p F_z R, little while rolling, and none for a contact in a point."""
    tyre = tyre_parameters(contact("kiencke", scrub_radius=0.01))
    limit = 0.8 * 100.0 * 0.01
    on_the_spot = scrub_torque(tyre, 20.0, 0.0, 100.0)
    assert -limit < on_the_spot < -0.99 * limit
    assert scrub_torque(tyre, -20.0, 0.0, 100.0) == -on_the_spot
    assert abs(scrub_torque(tyre, 1.0, 1.0, 100.0)) < 0.2 * abs(scrub_torque(tyre, 1.0, SCRUB_SPEED, 100.0))
    assert scrub_torque(tyre_parameters(contact("kiencke", scrub_radius=0.0)), 20.0, 0.0, 100.0) == 0.0


# --- refusals ---


@pytest.mark.parametrize(
    ("model", "shape", "message"),
    [
        (
            "kiencke",
            {"C": 1.5},
            r"contact\.shape\.C: 1\.5 is not allowed; allowed: no shape numbers for kiencke",
        ),
        ("magic_formula", {"c": 1.5}, r"contact\.shape\.c: 1\.5 .*unknown key; allowed: C, E"),
        ("magic_formula", {"C": 1.0}, r"contact\.shape\.C: 1\.0 is not allowed; allowed: above 1"),
        (
            "magic_formula",
            {"C": 2.5},
            r"contact\.shape\.C: 2\.5 is not allowed; .*at most 2, where it ends at zero",
        ),
        ("magic_formula", {"E": 1.0}, r"contact\.shape\.E: 1\.0 is not allowed; allowed: -20 to below 1"),
        ("dugoff", {"stifness": 20.0}, r"contact\.shape\.stifness: 20\.0 .*did you mean 'stiffness'"),
        ("dugoff", {"stiffness": -3.0}, r"contact\.shape\.stiffness: -3\.0 is not allowed; allowed: above 0"),
        ("burckhardt", {"c4": 0.1}, r"contact\.shape\.c4: 0\.1 .*unknown key; did you mean 'c"),
        (
            "burckhardt",
            {"c1": 0.05, "c2": 306.39, "c3": 0.0},
            r"contact\.shape: .*'c3': 0\.0.*allowed: c1, c3 > 0 and c1 c2 > c3",
        ),
        ("lugre", {"mu_s": 0.5}, r"contact\.shape\.mu_s: 0\.5 .*unknown key; did you mean 'mu_c'"),
        (
            "lugre",
            {"mu_c": 0.9},
            r"contact\.shape\.mu_c: 0\.9 is not allowed; allowed: above 0, at most mu_p = 0\.8",
        ),
        ("lugre", {"v_s": 0.0}, r"contact\.shape\.v_s: 0\.0 is not allowed; allowed: above 0 m/s"),
    ],
)
def test_a_shape_without_meaning_is_refused(model: str, shape: dict[str, float], message: str) -> None:
    """The message names the key, the value and what is allowed."""
    with pytest.raises(DescriptionError, match=message):
        tyre_parameters(contact(model, shape=shape))


def test_two_models_never_agree_by_accident() -> None:
    """Each name leads to its own curve: a mix-up in the dispatch would make two of them equal."""
    slips = (0.02, 0.3, 0.9)
    curves = {model: longitudinal(tyre_parameters(contact(model)), slips) for model in CONTACT_MODELS}
    for one, other in itertools.combinations(CONTACT_MODELS, 2):
        assert np.abs(curves[one] - curves[other]).max() > 1e-3
