"""Places on the floor where the ground is another one, as they stand under `physics:` of a robot file, and their shapes."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.errors import DescriptionError
from pcw_description.robot_description import FloatArray, RobotDescription

# What makes an effect on casters a patch of ground, whatever its name.
PLACE_AND_SIZE = frozenset({"x", "y", "length", "width"})
POINTS_PER_QUARTER = 24


@dataclasses.dataclass(frozen=True)
class GroundPatch:
    """One patch, flat on the floor, in the world frame `map`.

    Attributes:
        name: the effect that it is.
        x, y: its centre [m].
        length, width: its whole size along its own x and y [m].
        yaw: direction of its own x [rad].
        roundness: 0 is a rectangle, 1 an ellipse; between them a superellipse, |2u/length|^p + |2v/width|^p = 1 with
            p = 2/roundness [1].
        factor: friction relative to the ground around it [1]; None if the effect does not say.
        casters: for which it is there; () is all of them.
    """

    name: str
    x: float
    y: float
    length: float
    width: float
    yaw: float = 0.0
    roundness: float = 0.0
    factor: float | None = None
    casters: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            DescriptionError: names the parameter, its value and what is allowed.
        """
        for name in ("x", "y", "length", "width", "yaw", "roundness", "factor"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise DescriptionError(f"{self.name}.{name}", value, "allowed: a finite number")
        for name in ("length", "width"):
            if getattr(self, name) <= 0.0:
                raise DescriptionError(f"{self.name}.{name}", getattr(self, name), "allowed: above 0 m")
        if not 0.0 <= self.roundness <= 1.0:
            raise DescriptionError(f"{self.name}.roundness", self.roundness, "allowed: 0 to 1")

    @property
    def label(self) -> str:
        """What is written on it, such as "friction x 0.3"."""
        what = self.name.replace("_", " ") if self.factor is None else f"friction x {self.factor:g}"
        return f"{what} ({', '.join(self.casters)} only)" if self.casters else what

    def outline(self) -> FloatArray:
        """Return the corners of its outline in `map`, counter-clockwise, not closed, (4 POINTS_PER_QUARTER, 2) [m]."""
        # Midpoints of equal parts of each quarter: none lies on an axis, where the sign of a rounded sine is by chance.
        angle = (np.arange(4 * POINTS_PER_QUARTER) + 0.5) * (0.5 * math.pi / POINTS_PER_QUARTER)
        c, s = np.cos(angle), np.sin(angle)
        u = 0.5 * self.length * np.sign(c) * np.abs(c) ** self.roundness
        v = 0.5 * self.width * np.sign(s) * np.abs(s) ** self.roundness
        cos_yaw, sin_yaw = math.cos(self.yaw), math.sin(self.yaw)
        return np.column_stack([self.x + cos_yaw * u - sin_yaw * v, self.y + sin_yaw * u + cos_yaw * v])

    def triangles(self) -> FloatArray:
        """Return the triangles that fill it, three corners each, in `map`, (4 POINTS_PER_QUARTER, 3, 2) [m]."""
        corners = self.outline()
        centre = np.broadcast_to([self.x, self.y], corners.shape)
        return np.stack([centre, corners, np.roll(corners, -1, axis=0)], axis=1)


def ground_patches(robot: RobotDescription) -> tuple[GroundPatch, ...]:
    """Return the patches among the effects of a robot, in their order.

    An effect is one by its parameters and not by its name, so that those of other packages are seen as well.

    Raises:
        DescriptionError: a patch with a number that no patch has.
    """
    patches = []
    for effect in robot.physics:
        if not (effect.parameters.keys() >= PLACE_AND_SIZE and set(effect.target) <= set(robot.caster_names)):
            continue
        numbers = {field.name for field in dataclasses.fields(GroundPatch)} & effect.parameters.keys()
        everywhere = set(effect.target) == set(robot.caster_names)
        shape = {name: effect.parameters[name] for name in numbers}
        patches.append(GroundPatch(effect.name, **shape, casters=() if everywhere else effect.target))
    return tuple(patches)
