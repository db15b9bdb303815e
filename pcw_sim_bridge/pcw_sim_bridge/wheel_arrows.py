"""Arrows at a wheel: what the ground does to it, and how it slips.

All arrows of a caster stand in the frame `<caster>_fork` of the URDF, which turns with the heading (x forward, y left, z up)
and has its origin on the steering axis at axle height. The wheel touches the ground at (b_x, b_y, -r) in it.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from pcw_description.errors import PcwError
from pcw_description.robot_description import (
    LATERAL,
    LONGITUDINAL,
    ContactDescription,
    FloatArray,
    RobotDescription,
)

Colour = tuple[float, float, float, float]  # red, green, blue, opacity: 0 to 1 each

LOAD_COLOUR: Colour = (0.55, 0.55, 0.60, 0.8)
SLIP_COLOUR: Colour = (0.85, 0.20, 0.85, 1.0)
# A shorter arrow has no direction that could be seen, and one of no length none that could be computed [m].
LEAST_LENGTH = 1e-3


class ArrowError(PcwError):
    """A quantity that no arrow can show; the message names it, its value and what is allowed."""


@dataclasses.dataclass(frozen=True)
class Arrow:
    """A straight arrow.

    Attributes:
        kind: what it shows: "contact_force", "vertical_load" or "slip_velocity".
        start, end: points in `<caster>_fork` (3,) [m].
        colour: of the whole arrow.
    """

    kind: str
    start: FloatArray
    end: FloatArray
    colour: Colour


def contact_point(robot: RobotDescription, index: int) -> FloatArray:
    """Return where wheel `index` touches the ground, in its `<caster>_fork` (3,) [m]."""
    caster = robot.casters[index]
    return np.array([*caster.caster_offset, -caster.wheel_radius])


def friction_use(contact: ContactDescription, force: npt.ArrayLike) -> float:
    """Return how much of the peak friction a contact force takes: sqrt((F_x/mu_x)^2 + (F_y/mu_y)^2) / F_z [1].

    0 is pure rolling, 1 the friction ellipse of the nominal ground; where both directions are alike this is
    |F_t| / (mu_p F_z). A force along the ground at a wheel without load is more than any friction: infinity.

    Args:
        contact: the nominal ground.
        force: of the ground on the wheel, in the wheel frame (3,) [N].
    """
    x, y, z = np.asarray(force, dtype=float)
    needed = float(np.hypot(x / contact.mu_p, y / contact.lateral.mu_p))
    if needed == 0.0:
        return 0.0
    return needed / float(z) if z > 0.0 else float("inf")


def use_colour(use: float) -> Colour:
    """Return green at no friction use, yellow at half of it, red from all of it on; linear between."""
    share = min(max(use, 0.0), 1.0)
    return (min(1.0, 2.0 * share), min(1.0, 2.0 * (1.0 - share)), 0.0, 1.0)


def force_arrows(robot: RobotDescription, index: int, force: npt.ArrayLike, scale: float) -> list[Arrow]:
    """Return the force along the ground, coloured by the friction use, and the load, both from the contact point.

    One scale for both, so that their ratio can be seen against mu_p.

    Args:
        robot: the robot.
        index: of the caster.
        force: of the ground on the wheel, in the wheel frame (3,) [N].
        scale: length per force [m/N].

    Raises:
        ArrowError: a force that is not a finite number.
    """
    force = _finite(force, 3, f"contact force of {robot.caster_names[index]}", "N")
    along_ground, load = force * (1.0, 1.0, 0.0), force * (0.0, 0.0, 1.0)
    start = contact_point(robot, index)
    return [
        *_arrow("contact_force", start, scale * along_ground, use_colour(friction_use(robot.contact, force))),
        *_arrow("vertical_load", start, scale * load, LOAD_COLOUR),
    ]


def slip_arrows(robot: RobotDescription, index: int, slip_velocity: npt.ArrayLike, scale: float) -> list[Arrow]:
    """Return the slip velocity, above the wheel: at the contact point it would lie on the force that it makes.

    Args:
        robot: the robot.
        index: of the caster.
        slip_velocity: longitudinal and lateral, positive when the wheel turns faster than it moves (2,) [m/s].
        scale: length per speed [m per m/s].

    Raises:
        ArrowError: a slip velocity that is not a finite number.
    """
    slip = _finite(slip_velocity, 2, f"slip velocity of {robot.caster_names[index]}", "m/s")
    top = contact_point(robot, index) + (0.0, 0.0, 2.0 * robot.casters[index].wheel_radius)
    return _arrow("slip_velocity", top, scale * np.array([slip[LONGITUDINAL], slip[LATERAL], 0.0]), SLIP_COLOUR)


def _arrow(kind: str, start: FloatArray, along: FloatArray, colour: Colour) -> list[Arrow]:
    """One arrow, or none where it would be too short to be seen."""
    return [Arrow(kind, start, start + along, colour)] if np.linalg.norm(along) >= LEAST_LENGTH else []


def _finite(values: npt.ArrayLike, size: int, what: str, unit: str) -> FloatArray:
    array = np.asarray(values, dtype=float)
    if array.shape != (size,) or not np.isfinite(array).all():
        found = ", ".join(f"{value:g}" for value in array.ravel())
        raise ArrowError(f"{what}: [{found}] {unit} is not allowed; allowed: {size} finite numbers")
    return array
