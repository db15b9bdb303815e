"""What kind of ground an estimate looks like: published curves, a probability for each, and for none of them.

    p(class | m) ~ p(class) N(m; log of the class's numbers, covariance + spread^2),     m = (log mu_p, log lambda_p)

with a class "none of these" that is spread evenly over all that is possible. The published numbers are those of car tyres,
most of them: for another wheel they are the kind of ground and not its numbers, which is what `spread` stands for.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from pcw_description.robot_description import FloatArray

from .errors import TerrainError, require
from .ground_catalogue import GROUNDS
from .terrain_estimator import (
    GREATEST_CRITICAL_SLIP,
    GREATEST_FRICTION,
    LEAST_CRITICAL_SLIP,
    LEAST_FRICTION,
)

NONE = "none of these"
# How far wheels and grounds of one kind differ, as standard deviations of logarithms; assumed.
FRICTION_SPREAD, SLIP_SPREAD = 0.12, 0.3
NONE_PRIOR = 0.1
# Quoted from memory; the tables of other sources say 0.5 to 0.7 for gravel roads, and 0.2 to 0.3 net of soil resistance for
# wheels on dry sand.
UNCHECKED = "from memory, not checked against the book: "
TABOREK = UNCHECKED + "Taborek 1957, in Wong, Theory of Ground Vehicles"


@dataclasses.dataclass(frozen=True)
class TerrainClass:
    """One kind of ground.

    Attributes:
        name: what it is called.
        mu_p: peak friction coefficient [1].
        lambda_p: critical slip ratio [1].
        source: where the numbers come from.
        assumed: which of them are not published, in words; "" for none.
        friction_spread, slip_spread: standard deviations of their logarithms within the class [1].
    """

    name: str
    mu_p: float
    lambda_p: float
    source: str
    assumed: str = ""
    friction_spread: float = FRICTION_SPREAD
    slip_spread: float = SLIP_SPREAD

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            TerrainError: names the field, its value and what is allowed.
        """
        require(f"{self.name}.mu_p", self.mu_p, minimum=LEAST_FRICTION, maximum=GREATEST_FRICTION)
        require(f"{self.name}.lambda_p", self.lambda_p, minimum=LEAST_CRITICAL_SLIP, maximum=GREATEST_CRITICAL_SLIP)
        require(f"{self.name}.friction_spread", self.friction_spread, above=0.0)
        require(f"{self.name}.slip_spread", self.slip_spread, above=0.0)


def _library() -> Mapping[str, TerrainClass]:
    published = [TerrainClass(g.name, g.mu_p, g.lambda_p, g.source) for g in GROUNDS.values()]
    others = [
        TerrainClass("gravel", 0.6, 0.3, TABOREK, "lambda_p: assumed, loose grounds peak at large slip"),
        TerrainClass(
            "sand", 0.53, 0.45, UNCHECKED + "Wong, Theory of Ground Vehicles, dry sand, friction angle 28 degrees",
            "mu_p: tan of the friction angle, soil resistance left out; lambda_p: assumed, shear grows over centimetres",
            0.25, 0.4,
        ),
        TerrainClass("linoleum", 0.7, 0.08, "none", "mu_p and lambda_p: assumed, hard rubber on a clean dry floor", 0.2, 0.4),
    ]  # fmt: skip
    return MappingProxyType({entry.name: entry for entry in (*published, *others)})


CLASSES: Mapping[str, TerrainClass] = _library()


@dataclasses.dataclass(frozen=True)
class ClassProbability:
    """How probable a class is [1]."""

    name: str
    probability: float


def classify(
    mu_p: float,
    lambda_p: float,
    covariance: FloatArray,
    library: Mapping[str, TerrainClass] = CLASSES,
    prior: Mapping[str, float] | None = None,
) -> tuple[ClassProbability, ...]:
    """Return all classes and `NONE`, the most probable first; the probabilities add up to 1.

    Args:
        mu_p, lambda_p: estimate [1].
        covariance: of their logarithms (2, 2).
        library: the classes.
        prior: how probable classes are beforehand, not necessarily adding up to 1; None: `NONE_PRIOR` for none of them, and
            the rest shared alike.

    Raises:
        TerrainError: an estimate that is not positive, a covariance that is none, or a prior of an unknown class.
    """
    require("mu_p", mu_p, above=0.0)
    require("lambda_p", lambda_p, above=0.0)
    covariance = np.asarray(covariance, dtype=float)
    if covariance.shape != (2, 2) or not np.isfinite(covariance).all() or np.linalg.eigvalsh(covariance)[0] < -1e-12:
        raise TerrainError(f"covariance = {covariance.tolist()} is not allowed; allowed: (2, 2), positive semidefinite")
    weights = (
        dict(prior) if prior is not None else {NONE: NONE_PRIOR} | dict.fromkeys(library, (1.0 - NONE_PRIOR) / len(library))
    )
    for name in weights:
        if name != NONE and name not in library:
            raise TerrainError(f"prior of {name!r} is not allowed; allowed: {NONE!r}, {', '.join(library)}")
        require(f"prior of {name}", weights[name], minimum=0.0)
    everything = math.log(GREATEST_FRICTION / LEAST_FRICTION) * math.log(GREATEST_CRITICAL_SLIP / LEAST_CRITICAL_SLIP)
    found = {NONE: weights.get(NONE, 0.0) / everything}
    for name, entry in library.items():
        spread = covariance + np.diag([entry.friction_spread**2, entry.slip_spread**2])
        off = np.array([math.log(mu_p / entry.mu_p), math.log(lambda_p / entry.lambda_p)])
        density = math.exp(-0.5 * float(off @ np.linalg.solve(spread, off))) / (math.tau * math.sqrt(np.linalg.det(spread)))
        found[name] = weights.get(name, 0.0) * density
    total = sum(found.values())
    if total <= 0.0:
        raise TerrainError(f"prior = {dict(weights)!r} is not allowed; allowed: {NONE!r} or a class near by above 0")
    ordered = sorted(found.items(), key=lambda item: -item[1])
    return tuple(ClassProbability(name, value / total) for name, value in ordered)


def table(library: Mapping[str, TerrainClass] = CLASSES) -> str:
    """Return the classes as a Markdown table."""
    lines: Sequence[str] = (
        "| class | mu_p | lambda_p | source | assumed |", "| --- | --- | --- | --- | --- |",
        *(f"| {c.name} | {c.mu_p:.4g} | {c.lambda_p:.4g} | {c.source} | {c.assumed or '-'} |" for c in library.values()),
    )  # fmt: skip
    return "\n".join(lines)
