"""Named grounds with published friction curves, and robots put on them.

Burckhardt's curve mu = c1 (1 - exp(-c2 s)) - c3 s with his triples for roads (M. Burckhardt, Fahrwerktechnik:
Radschlupf-Regelsysteme, Vogel 1993; the table is repeated in U. Kiencke and L. Nielsen, Automotive Control Systems,
Springer 2005). They were measured with car tyres: for the small hard wheels of an indoor robot they give the shape and the
order of magnitude, not the number. The thesis shows curves of several terrains (fig. 5.18 [Li2009]) without a
number; it fits the Kiencke curve (3.47) to them, which `curve="kiencke"` does here by the peak.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from pcw_description.contact import burckhardt
from pcw_description.errors import DescriptionError, PcwError, nearest_name
from pcw_description.robot_description import (
    CONTACT_MODELS,
    ContactDescription,
    LateralContact,
    RobotDescription,
)
from pcw_description.robot_file import load_robot

BURCKHARDT = "Burckhardt 1993"


@dataclasses.dataclass(frozen=True)
class Ground:
    """One ground.

    Attributes:
        name: name in the catalogue.
        c1, c2, c3: the published triple of Burckhardt's curve [1].
        source: where the triple comes from.
        note: what to know before using it; may be empty.

    Raises:
        DescriptionError: a triple without a peak.
    """

    name: str
    c1: float
    c2: float
    c3: float
    source: str
    note: str = ""

    def __post_init__(self) -> None:
        burckhardt.peak(self.c1, self.c2, self.c3)

    @property
    def mu_p(self) -> float:
        """Peak friction coefficient [1]."""
        return burckhardt.peak(self.c1, self.c2, self.c3)[1]

    @property
    def lambda_p(self) -> float:
        """Slip ratio at the peak [1]."""
        return burckhardt.peak(self.c1, self.c2, self.c3)[0]

    def friction(self, slip: float) -> float:
        """Return the published mu(slip) [1] for a slip ratio of either sign; the sign of mu is that of the slip."""
        size = abs(slip)
        return math.copysign(self.c1 * -math.expm1(-self.c2 * size) - self.c3 * size, slip)


def _catalogue(*grounds: Ground) -> Mapping[str, Ground]:
    return MappingProxyType({ground.name: ground for ground in grounds})


GROUNDS: Mapping[str, Ground] = _catalogue(
    Ground("dry_asphalt", 1.2801, 23.99, 0.52, BURCKHARDT),
    Ground("wet_asphalt", 0.857, 33.822, 0.347, BURCKHARDT),
    Ground("dry_concrete", 1.1973, 25.168, 0.5373, BURCKHARDT),
    Ground("dry_cobblestone", 1.3713, 6.4565, 0.6691, BURCKHARDT, "peaks at 40 % slip: no wheel is held there by accident"),
    Ground("wet_cobblestone", 0.4004, 33.7080, 0.1204, BURCKHARDT),
    Ground("snow", 0.1946, 94.129, 0.0646, BURCKHARDT),
    Ground(
        "ice", 0.05, 306.39, 0.001, BURCKHARDT,
        "c3 is printed as 0 or 0.001; with 0 the curve has no peak, so 0.001 is used: at most 0.001 of mu",
    ),
)


def ground(name: str) -> Ground:
    """Return a ground by its name.

    Raises:
        DescriptionError: there is none of that name; the nearest is suggested.
    """
    if name not in GROUNDS:
        raise DescriptionError("ground", name, f"unknown ground; {nearest_name(str(name), GROUNDS)}")
    return GROUNDS[name]


def contact_on(contact: ContactDescription, place: Ground, curve: str = "burckhardt") -> ContactDescription:
    """Return the contact of the same tyre on another ground.

    The peak is the ground's, along and across (the published triples do not tell the two apart); relaxation length and
    scrub radius belong to the tyre and stay. With `curve` "burckhardt" mu(slip) is the published one, with another it
    has the same peak (thesis: "kiencke").

    Raises:
        DescriptionError: unknown curve.
    """
    if curve not in CONTACT_MODELS:
        raise DescriptionError("curve", curve, nearest_name(str(curve), CONTACT_MODELS))
    return dataclasses.replace(
        contact,
        model=curve,
        mu_p=place.mu_p,
        lambda_p=place.lambda_p,
        lateral=LateralContact(mu_p=place.mu_p, lambda_p=place.lambda_p),
        shape={"c1": place.c1, "c2": place.c2, "c3": place.c3} if curve == "burckhardt" else {},
    )


def robot_on(robot: RobotDescription, place: Ground | str, curve: str = "burckhardt") -> RobotDescription:
    """Return the robot with its nominal ground replaced, by a ground or by its name; see `contact_on`."""
    found = ground(place) if isinstance(place, str) else place
    return dataclasses.replace(
        robot,
        contact=contact_on(robot.contact, found, curve),
        provenance={**robot.provenance, "contact": f"{found.name}: {found.source}, as {curve} curve; tyre as before"},
    )


def table() -> str:
    """Return the catalogue as a Markdown table."""
    lines = ["| ground | mu_p | lambda_p | c1 | c2 | c3 | source |", "| --- | --- | --- | --- | --- | --- | --- |"]
    for entry in GROUNDS.values():
        source = f"{entry.source}; {entry.note}" if entry.note else entry.source
        numbers = [f"{entry.mu_p:.4f}", f"{entry.lambda_p:.4f}", *(f"{number:g}" for number in (entry.c1, entry.c2, entry.c3))]
        lines.append("| " + " | ".join([entry.name, *numbers, source]) + " |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the catalogue, or the contact section of a robot on one ground; exit 0, or 2 for bad input."""
    parser = argparse.ArgumentParser(prog="grounds", description="Print the catalogue of grounds.")
    parser.add_argument("ground", nargs="?", help="print the `contact:` section for this ground instead")
    parser.add_argument("--robot", default="thesis", help="whose tyre stands on it: a .yaml file or a shipped robot")
    parser.add_argument("--curve", default="burckhardt", choices=CONTACT_MODELS, help="friction curve with the ground's peak")
    options = parser.parse_args(arguments)
    if options.ground is None:
        print(table())
        return 0
    try:
        contact = contact_on(load_robot(options.robot).contact, ground(options.ground), options.curve)
    except PcwError as error:
        print(f"grounds: {error}", file=sys.stderr)
        return 2
    print("contact:")
    for key, value in dataclasses.asdict(contact).items():
        if isinstance(value, dict):
            value = "{" + ", ".join(f"{name}: {number:.6g}" for name, number in value.items()) + "}"
        print(f"  {key}: {value if isinstance(value, str) else f'{value:.6g}'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
