"""One interface for all tyres: relaxed slip, combined slip on a friction ellipse, scrub; (3.43)-(3.47) [Li2009].

The slip ratio is singular at standstill. Its relaxed form is not:

    z_dot = eps - (V / L) z,    lambda = z / L,    V = max(|r rho_dot|, |v_wheel|)

with the slip velocity eps, and the relaxation length L; in steady rolling lambda = eps / V. It is integrated
implicitly, and the force uses z + DAMPING_TIME z_dot, which damps the tyre's spring at standstill and is nothing in
steady motion. Longitudinal and lateral slip, each relative to its own critical slip, combine in an ellipse.
"""

from __future__ import annotations

import math

import numpy as np

from ..compiled import compiled
from ..robot_description import ContactDescription, FloatArray
from . import burckhardt, dugoff, kiencke, lugre, magic_formula

MODELS = {"kiencke": kiencke, "magic_formula": magic_formula, "dugoff": dugoff, "burckhardt": burckhardt, "lugre": lugre}
_KIENCKE, _MAGIC_FORMULA, _DUGOFF, _BURCKHARDT, _LUGRE = range(len(MODELS))

# Layout of the numbers of one tyre, shape (TYRE_SIZE,).
MODEL, MU, LAMBDA, A, B, C, LATERAL_MU, LATERAL_LAMBDA, LATERAL_A, LATERAL_B, LATERAL_C, LENGTH, SCRUB = range(13)
TYRE_SIZE = 13

# What the further numbers of a curve are times a factor that stretches it along friction and slip, as powers of that factor.
_STRETCHED = {_MAGIC_FORMULA: (-1.0, 0.0, 0.0), _BURCKHARDT: (1.0, -1.0, 0.0)}

# Damping of the bristles at standstill [s]; see the module's docstring. A fifth of critical for a 20 kg wheel load.
DAMPING_TIME = 0.002
# The inverse of a friction curve stops at this part of its peak; so many steps of the secant bring it there to a percent,
# and at half the peak to 1e-5.
GREATEST_USE, INVERSION_STEPS = 0.95, 12
# Below this rolling speed turning on the spot counts as full scrub [m/s].
SCRUB_SPEED = 0.05


def tyre_parameters(contact: ContactDescription) -> FloatArray:
    """Return the numbers of a tyre as the kernels take them, (TYRE_SIZE,).

    Raises:
        DescriptionError: shape numbers that the model does not know or that have no meaning.
    """
    module = MODELS[contact.model]
    tyre = np.empty(TYRE_SIZE)
    tyre[MODEL] = list(MODELS).index(contact.model)
    tyre[[MU, LAMBDA]] = contact.mu_p, contact.lambda_p
    tyre[[A, B, C]] = module.shape_numbers(contact.mu_p, contact.lambda_p, contact.shape)
    lateral = contact.lateral
    tyre[[LATERAL_MU, LATERAL_LAMBDA]] = lateral.mu_p, lateral.lambda_p
    tyre[[LATERAL_A, LATERAL_B, LATERAL_C]] = module.shape_numbers(lateral.mu_p, lateral.lambda_p, contact.shape)
    tyre[LENGTH], tyre[SCRUB] = contact.relaxation_length, contact.scrub_radius
    return tyre


def with_friction(tyres: FloatArray, factor: float) -> FloatArray:
    """Return tyres (n, TYRE_SIZE) whose friction is so many times as large, and reached at so many times the slip.

    What they give way under small forces stays: friction and stiffness are then numbers on their own.
    """
    stretched = tyres.copy()
    stretched[:, [MU, LAMBDA, LATERAL_MU, LATERAL_LAMBDA]] *= factor
    for model, powers in _STRETCHED.items():
        rows = stretched[:, MODEL] == model
        for first in (A, LATERAL_A):
            stretched[rows, first : first + 3] *= factor ** np.array(powers)
    return stretched


@compiled
def _curve(model, slip, mu_p, lambda_p, a, b, c):  # type: ignore[no-untyped-def]
    if model == _KIENCKE:
        return kiencke.friction(slip, mu_p, lambda_p, a, b, c)
    if model == _MAGIC_FORMULA:
        return magic_formula.friction(slip, mu_p, lambda_p, a, b, c)
    if model == _DUGOFF:
        return dugoff.friction(slip, mu_p, lambda_p, a, b, c)
    if model == _BURCKHARDT:
        return burckhardt.friction(slip, mu_p, lambda_p, a, b, c)
    return lugre.friction(slip, mu_p, lambda_p, a, b, c)


@compiled
def _secant_slopes(tyre, longitudinal_slip, lateral_slip):  # type: ignore[no-untyped-def]
    """Return friction coefficient over slip, longitudinal and lateral [1], of combined steady slip."""
    model = int(tyre[MODEL])
    sx, sy = longitudinal_slip / tyre[LAMBDA], lateral_slip / tyre[LATERAL_LAMBDA]
    s = max(math.sqrt(sx * sx + sy * sy), 1e-9)  # at zero slip the slope of the curve's beginning
    along = _curve(model, s * tyre[LAMBDA], tyre[MU], tyre[LAMBDA], tyre[A], tyre[B], tyre[C])
    lateral_mu, lateral_lambda = tyre[LATERAL_MU], tyre[LATERAL_LAMBDA]
    across = _curve(
        model, s * lateral_lambda, lateral_mu, lateral_lambda, tyre[LATERAL_A], tyre[LATERAL_B], tyre[LATERAL_C]
    )
    return along / (s * tyre[LAMBDA]), across / (s * lateral_lambda)


@compiled
def friction_coefficient(tyre, longitudinal_slip, lateral_slip):  # type: ignore[no-untyped-def]
    """Return the friction coefficients (longitudinal, lateral) [1] of combined steady slip.

    Args:
        tyre: numbers of the tyre (TYRE_SIZE,).
        longitudinal_slip: lambda [1], positive for traction.
        lateral_slip: the same across, eps_y / V [1].
    """
    along, across = _secant_slopes(tyre, longitudinal_slip, lateral_slip)
    return along * longitudinal_slip, across * lateral_slip


@compiled
def slip_of_force(tyre, force_x, force_y, normal_force):  # type: ignore[no-untyped-def]
    """Return the steady slips (longitudinal, lateral) [1] under a force in the wheel frame [N]; the inverse of the curves.

    On their rising branch: a force beyond the peak of friction is taken as GREATEST_USE of it. Of the LuGre model only the
    bristles are inverted, which is its slope at small slip.
    """
    along, across = tyre[A], tyre[LATERAL_A]
    x, y = force_x / normal_force, force_y / normal_force
    if int(tyre[MODEL]) == _LUGRE:
        return x / along, y / across
    use = math.sqrt((x / tyre[MU]) ** 2 + (y / tyre[LATERAL_MU]) ** 2)
    if use > GREATEST_USE:
        x, y = x * GREATEST_USE / use, y * GREATEST_USE / use
    slip_x, slip_y = 0.0, 0.0
    for _ in range(INVERSION_STEPS):
        along, across = _secant_slopes(tyre, slip_x, slip_y)
        slip_x, slip_y = x / along, y / across
    return slip_x, slip_y


@compiled
def slip_under_load(z, load_before, load):  # type: ignore[no-untyped-def]
    """Return the relaxed slip z [m] of a tyre whose load changed since the step before [N].

    The rubber that more load brings to the ground is not sheared yet: the force stays, spread over more of it. So a tyre
    gains no energy by being loaded, and lands without a force. Less load takes its part of the force with it.
    """
    return z * (load_before / load) if load > load_before else z


@compiled
def tyre_step_with_slopes(tyre, z_x, z_y, slip_x, slip_y, speed, normal_force, dt):  # type: ignore[no-untyped-def]
    """Advance one tyre by dt.

    Args:
        tyre: numbers of the tyre (TYRE_SIZE,).
        z_x, z_y: relaxed slip [m].
        slip_x, slip_y: slip velocity eps [m/s].
        speed: max(|r rho_dot|, |v_wheel|) [m/s].
        normal_force: F_z >= 0 [N].
        dt: step [s].

    Returns:
        New z_x, z_y [m]; the force of the ground on the wheel F_x, F_y in the wheel frame [N]; and what both are more per
        slip velocity, for plants that take the new one implicitly: dz_x, dz_y [s], dF_x, dF_y [N s/m], all >= 0. The
        latter are secants of the friction curve, which are positive beyond its peak too.
    """
    length = tyre[LENGTH]
    loss_x = loss_y = speed / length
    if int(tyre[MODEL]) == _LUGRE:
        slip_speed = math.sqrt(slip_x * slip_x + slip_y * slip_y)
        loss_x += tyre[A] / length * slip_speed / lugre.sliding_friction(slip_speed, tyre[MU], tyre[B], tyre[C])
        sliding_y = lugre.sliding_friction(slip_speed, tyre[LATERAL_MU], tyre[LATERAL_B], tyre[LATERAL_C])
        loss_y += tyre[LATERAL_A] / length * slip_speed / sliding_y
    gain_x, gain_y = dt / (1.0 + dt * loss_x), dt / (1.0 + dt * loss_y)
    new_x = z_x / (1.0 + dt * loss_x) + gain_x * slip_x
    new_y = z_y / (1.0 + dt * loss_y) + gain_y * slip_y
    damping = DAMPING_TIME / dt
    lambda_x = (new_x + damping * (new_x - z_x)) / length
    lambda_y = (new_y + damping * (new_y - z_y)) / length
    along, across = tyre[A], tyre[LATERAL_A]
    if int(tyre[MODEL]) != _LUGRE:
        along, across = _secant_slopes(tyre, lambda_x, lambda_y)
    along *= normal_force
    across *= normal_force
    grip = (1.0 + damping) / length
    return (
        new_x, new_y, along * lambda_x, across * lambda_y, gain_x, gain_y, along * grip * gain_x, across * grip * gain_y
    )


@compiled
def tyre_step(tyre, z_x, z_y, slip_x, slip_y, speed, normal_force, dt):  # type: ignore[no-untyped-def]
    """Advance one tyre by dt; return new z_x, z_y [m], F_x and F_y [N]. See `tyre_step_with_slopes`."""
    new_x, new_y, force_x, force_y, _, _, _, _ = tyre_step_with_slopes(
        tyre, z_x, z_y, slip_x, slip_y, speed, normal_force, dt
    )
    return new_x, new_y, force_x, force_y


@compiled
def scrub_torque(tyre, turn_rate, speed, normal_force):  # type: ignore[no-untyped-def]
    """Return the torque of the ground on the wheel about the vertical [N m], against its turn rate over ground [rad/s].

    The patch's edge slips at turn_rate times the scrub radius; relative to the rolling speed that is its slip ratio.
    """
    radius = tyre[SCRUB]
    if radius == 0.0:
        return 0.0
    slip = turn_rate * radius / max(speed, SCRUB_SPEED) / tyre[LAMBDA]
    return -tyre[MU] * normal_force * radius * slip / math.sqrt(1.0 + slip * slip)
