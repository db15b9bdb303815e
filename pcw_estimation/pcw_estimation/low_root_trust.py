"""When the lower root of mu(lambda) may be believed, and how far off an estimate may be meanwhile.

Below its peak every friction coefficient belongs to two slip ratios. On the rising branch the force gives the slip, and with
it the velocity; on the falling one that answer is wrong, and at the peak the slope is zero and the force says nothing. Three
things that a wheel knows of itself tell the branches apart:

- use: the part of the peak that the force takes. Towards the peak the root becomes vague, and trust fades unless less is known
  from elsewhere.
- slip acceleration: a wheel that grips accelerates with its robot; one that has broken loose runs away from it.
- conflict: the velocity that the root means, against the one carried along by integrating the forces. The latter is off by no
  more than a bound that grows with the tolerance of the mass; a root outside of it is the other one.

A bound that turns out too small (a slope, a push) must not lock a good wheel out: where a root stays in conflict while nothing
else speaks against it, and the slip carried along would not make the force that is felt, the root is believed after a while.
"""

from __future__ import annotations

import math

from pcw_description.compiled import compiled

# Layout of the numbers of trust, see `sliding_mode_observer.SlidingModeParameters`.
CORRECTION_RATE, FULL_TRUST_USE, NO_TRUST_USE, SLIP_ACCELERATION, SLIP_ACCELERATION_SHARE = range(5)
CONFLICT_FLOOR, CONFLICT_SHARE, RECAPTURE_TIME, MASS_TOLERANCE = range(5, 9)
TRUST_SIZE = 9
# A carried slip explains a force that its friction matches within these parts of force and peak.
EXPLAINED_SHARE, EXPLAINED_FLOOR = 0.3, 0.05


@compiled
def root_error(numbers, use, critical_slip, speed):  # type: ignore[no-untyped-def]
    """Return how far off the velocity of the lower root may be [m/s], and how the trust in it fades with use [1].

    Whatever the force, a wheel that grips slips less than its critical slip: beyond `no_trust_use` that is all that is known.
    """
    fade = (numbers[NO_TRUST_USE] - use) / (numbers[NO_TRUST_USE] - numbers[FULL_TRUST_USE])
    fade = min(max(fade, 0.0), 1.0)
    return numbers[CONFLICT_FLOOR] + (numbers[CONFLICT_SHARE] + (1.0 - fade) * critical_slip) * speed, fade


@compiled
def trust_of_root(  # type: ignore[no-untyped-def]
    numbers, fade, error_of_root, slip_acceleration, model_acceleration, conflict, bound, explained, quiet, dt
):
    """Return the trust in the lower root in [0, 1], and for how long a quiet root has been in conflict [s].

    Args:
        numbers: (TRUST_SIZE,).
        fade, error_of_root: of `root_error` [1], [m/s].
        slip_acceleration: r rho_ddot less the acceleration of the wheel centre [m/s^2].
        model_acceleration: of the wheel centre, from forces [m/s^2].
        conflict: velocity of the root less the one carried along [m/s].
        bound: how far the latter may be off [m/s].
        explained: whether the slip carried along explains the force.
        quiet: as returned by the step before [s].
        dt: [s].
    """
    allowed = numbers[SLIP_ACCELERATION] + numbers[SLIP_ACCELERATION_SHARE] * abs(model_acceleration)
    if abs(slip_acceleration) > allowed:
        return 0.0, 0.0
    trust = fade if bound <= error_of_root else 1.0
    if abs(conflict) <= bound + error_of_root:
        return trust, 0.0
    quiet = 0.0 if explained or fade == 0.0 else quiet + dt
    return (trust if quiet > numbers[RECAPTURE_TIME] else 0.0), quiet


@compiled
def grown_bound(numbers, bound, acceleration, spent_on_wheels, dt):  # type: ignore[no-untyped-def]
    """Return the bound after dt of integration [m/s].

    The mass is not known any better, nor are the wheels' inertias, which take `spent_on_wheels` of the forces [m/s^2].
    """
    return bound + dt * numbers[MASS_TOLERANCE] * (abs(acceleration) + abs(spent_on_wheels))


@compiled
def corrected_bound(bound, share, error_of_root):  # type: ignore[no-untyped-def]
    """Return the bound after a correction that took `share` of a conflict [m/s]."""
    return bound + share * (error_of_root - bound)


@compiled
def share_corrected(numbers, trust, dt):  # type: ignore[no-untyped-def]
    """Return the share of a conflict that is corrected in dt [1]."""
    return 1.0 - math.exp(-numbers[CORRECTION_RATE] * trust * dt)


@compiled
def velocity_of_slip(rolling_speed, slip_ratio):  # type: ignore[no-untyped-def]
    """Return v_x [m/s] from r rho_dot [m/s] and a slip ratio in the direction of travel (3.43) solved for v_x.

    Args:
        rolling_speed: r rho_dot.
        slip_ratio: (r rho_dot - v_x) / max(|r rho_dot|, |v_x|), positive where the force is positive.
    """
    relative = slip_ratio if rolling_speed >= 0.0 else -slip_ratio
    relative = min(max(relative, -0.95), 0.95)
    return rolling_speed * (1.0 - relative) if relative >= 0.0 else rolling_speed / (1.0 + relative)
