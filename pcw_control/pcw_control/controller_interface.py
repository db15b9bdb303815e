"""What every controller is given and gives back, so that one can stand in for another.

A controller is a class made from a robot and a frozen dataclass of parameters, with

    initial_state(twist) -> state
    step(state, measurement, reference, dt) -> (state, output)

`step` is pure: no clock, no topic, no memory but the state. What only some controllers use (slip, friction, a measured
wrench) is optional in the measurement; None means that nobody said anything, and each controller documents what it does then.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, ClassVar, Protocol, Self, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from pcw_description.compiled import compiled
from pcw_description.robot_description import FloatArray, RobotDescription

from .errors import ControlError
from .quintic_trajectory import TrajectoryPoint

BoolArray = npt.NDArray[np.bool_]
Instance = TypeVar("Instance")


@dataclasses.dataclass(frozen=True)
class ControllerMeasurement:
    """What a controller may be given; arrays (n, 2) are drive and steer, or longitudinal and lateral in the wheel frames.

    Attributes:
        joint_position: (n, 2) [rad].
        joint_velocity: (n, 2) [rad/s].
        pose: pose of base_link in odom, from odometry (3,) [m, m, rad]; unused when a twist is followed.
        saturated: the torque before this one had to be limited, so that integrals hold.
        slip: estimated slip velocity B q_dot - A V (3.28), of any estimator (n, 2) [m/s].
        slip_valid: whether the estimator vouches for it (n, 2); None with a slip is all of it.
        friction: peak friction coefficient under each wheel (n,) [1].
        critical_slip: slip ratio at that peak (n,) [1].
        normal_force: load of each wheel (n,) [N]; None is the robot's own weight, shared as by a rigid body on springs.
        external_wrench: what pushes the robot, measured, in base_link at its origin (3,) [N, N, N m].
    """

    joint_position: FloatArray
    joint_velocity: FloatArray
    pose: FloatArray
    saturated: bool = False
    slip: FloatArray | None = None
    slip_valid: BoolArray | None = None
    friction: FloatArray | None = None
    critical_slip: FloatArray | None = None
    normal_force: FloatArray | None = None
    external_wrench: FloatArray | None = None


@dataclasses.dataclass(frozen=True)
class TwistReference:
    """A twist of base_link in base_link to follow (3,) [m/s, m/s, rad/s]."""

    twist: FloatArray


@dataclasses.dataclass(frozen=True)
class ForceReference:
    """A wrench to feel in the directions that are force controlled, and what to do in the others.

    Attributes:
        wrench: wanted `external_wrench` in base_link (3,) [N, N, N m].
        motion: what to follow where motion is controlled.
    """

    wrench: FloatArray
    motion: TwistReference | TrajectoryPoint = dataclasses.field(default_factory=lambda: TwistReference(np.zeros(3)))


Reference: TypeAlias = TwistReference | TrajectoryPoint | ForceReference


@dataclasses.dataclass(frozen=True)
class ControllerOutput:
    """What one step gives; the torque still has to pass the torque limits.

    Attributes:
        torque: joint torques (n, 2) [N m].
        contact_force: wanted contact forces in the wheel frames (n, 2) [N], so that torque = B^T contact_force.
        wrench: operational force F asked for (3,) [N, N, N m] in base_link; A^T contact_force where it can be had.
        twist: odometric twist (3,) in base_link.
        reference_twist: twist wanted now (3,) in base_link.
        internal_force: squeeze between each pair of wheels, (5.3) with unit vectors (n (n - 1) / 2,) [N]: pairs 01, 02,
            .. 12, ..; positive pulls the two together.
    """

    torque: FloatArray
    contact_force: FloatArray
    wrench: FloatArray
    twist: FloatArray
    reference_twist: FloatArray
    internal_force: FloatArray


class Controller(Protocol):
    """What all controllers have in common."""

    parameters: Any

    def initial_state(self, twist: FloatArray | None = None) -> Any:
        """Return the state of a controller that takes over at a twist (3,) in base_link, or at rest."""

    def step(
        self, state: Any, measurement: ControllerMeasurement, reference: Reference, dt: float
    ) -> tuple[Any, ControllerOutput]:
        """Compute the torques of one cycle."""


def replaced(instance: Instance, **fields: Any) -> Instance:
    """Return a copy of a state or an output with other values of some fields.

    As `dataclasses.replace`, which takes three times as long because it looks at every field; a cycle makes several copies.
    Not for a class that checks its fields when it is made.
    """
    copy = object.__new__(type(instance))
    copy.__dict__.update(instance.__dict__)
    copy.__dict__.update(fields)
    return copy


def parameter(
    default: float | tuple[float, ...], unit: str, description: str, minimum: float = 0.0, maximum: float = 1e6,
    above: float | None = None,
) -> Any:
    """Return a dataclass field of a number, or of several of one meaning, with unit, meaning and range.

    The node makes a ROS parameter of it.
    """
    low = minimum if above is None else above
    metadata = {"unit": unit, "description": description, "range": (low, maximum), "above": above is not None}
    return dataclasses.field(default=default, metadata=metadata)


def choice(default: Any, choices: Sequence[Any], description: str) -> Any:
    """Return a dataclass field of a value out of a few, or of several such values; the node makes a ROS parameter of it."""
    return dataclasses.field(default=default, metadata={"description": description, "choices": tuple(choices)})


@dataclasses.dataclass(frozen=True)
class ControllerParameters:
    """Base of all parameters: fields made by `parameter` and `choice` are checked when an instance is made."""

    # What of the optional measurement the controller looks at: "slip", "friction", "external_wrench".
    uses: ClassVar[frozenset[str]] = frozenset()

    @classmethod
    def of_robot(cls, robot: RobotDescription) -> Self:
        """Return the parameters that suit a robot: what a controller is made with when it is given none."""
        return cls()

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ControlError: names the field, its value and what is allowed.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            reason = reason_against(field, value)
            if reason is not None:
                raise ControlError(f"{field.name} = {value!r} is not allowed; allowed: {reason}")


def reason_against(field: dataclasses.Field[Any], value: Any) -> str | None:
    """Return what would be allowed for a field made by `parameter` or `choice`; None when the value is."""
    meta = field.metadata
    default: Any = field.default
    several = isinstance(default, tuple)
    values = tuple(value) if several else (value,)
    if several and len(values) != len(default):
        return f"{len(default)} values"
    if "choices" in meta and any(one not in meta["choices"] for one in values):
        return ", ".join(str(one) for one in meta["choices"])
    if "range" not in meta:
        return None
    low, high = meta["range"]
    if all(math.isfinite(one) and low <= one <= high and not (meta["above"] and one == low) for one in values):
        return None
    least = f"above {low:g}" if meta["above"] else f"at least {low:g}"
    return f"{'finite numbers' if several else 'a finite number'}, {least}, at most {high:g}"


def settable_fields(parameters: ControllerParameters, prefix: str = "") -> Iterator[tuple[str, dataclasses.Field[Any], Any]]:
    """Yield name, field and value of all that can be set, of parameters within parameters as well (`slip.loop_delay`)."""
    for field in dataclasses.fields(parameters):
        value = getattr(parameters, field.name)
        if isinstance(value, ControllerParameters):
            yield from settable_fields(value, f"{prefix}{field.name}.")
        elif field.metadata:
            yield prefix + field.name, field, value


def with_values(parameters: ControllerParameters, value_of: Callable[[str], Any], prefix: str = "") -> ControllerParameters:
    """Return parameters of the same kind with the value of every settable field taken from its name.

    Raises:
        ControlError: a value that is not allowed.
    """
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(parameters):
        value, name = getattr(parameters, field.name), prefix + field.name
        if isinstance(value, ControllerParameters):
            changed[field.name] = with_values(value, value_of, f"{name}.")
        elif field.metadata:
            found = value_of(name)
            changed[field.name] = tuple(found) if isinstance(value, tuple) else found
    return dataclasses.replace(parameters, **changed)


def check_step(measurement: ControllerMeasurement, reference: Reference, dt: float, n: int) -> None:
    """Check what goes into a step.

    Raises:
        ControlError: dt is not positive, or a measurement or the reference is not finite or of a wrong shape.
    """
    if not (math.isfinite(dt) and dt > 0.0):
        raise ControlError(f"dt = {dt!r} s is not allowed; allowed: above 0, measured from stamps")
    # One call looks at all numbers; only where something is wrong is it looked for.
    m, motion, wrench = measurement, reference, _ZERO
    if isinstance(motion, ForceReference):
        wrench, motion = motion.wrench, motion.motion
    if isinstance(motion, TwistReference):
        a, b, c, d = motion.twist, _ZERO, _ZERO, _ZERO
    else:
        a, b, c, d = m.pose, motion.pose, motion.velocity, motion.acceleration
    push = _ZERO if m.external_wrench is None else m.external_wrench
    if (
        m.joint_position.shape == m.joint_velocity.shape == (n, 2)
        and (m.slip is None or m.slip.shape == (n, 2))
        and (m.friction is None or m.friction.shape == (n,))
        and (m.critical_slip is None or m.critical_slip.shape == (n,))
        and (m.normal_force is None or m.normal_force.shape == (n,))
        and push.shape == wrench.shape == a.shape == b.shape == c.shape == d.shape == (3,)
        and _all_finite(
            m.joint_position.ravel(), m.joint_velocity.ravel(), _NOTHING if m.slip is None else m.slip.ravel(),
            _NOTHING if m.friction is None else m.friction, _NOTHING if m.critical_slip is None else m.critical_slip,
            _NOTHING if m.normal_force is None else m.normal_force, push, wrench, a, b, c, d,
        )
    ):  # fmt: skip
        return
    _require("joint_position", measurement.joint_position, (n, 2))
    _require("joint_velocity", measurement.joint_velocity, (n, 2))
    optional = (
        ("slip", measurement.slip, (n, 2)), ("friction", measurement.friction, (n,)),
        ("critical_slip", measurement.critical_slip, (n,)), ("normal_force", measurement.normal_force, (n,)),
        ("external_wrench", measurement.external_wrench, (3,)),
    )
    for name, values, shape in optional:
        if values is not None:
            _require(name, values, shape)
    if isinstance(reference, ForceReference):
        _require("reference wrench", reference.wrench, (3,))
        reference = reference.motion
    if isinstance(reference, TwistReference):
        _require("reference twist", reference.twist, (3,))
        return
    _require("pose", measurement.pose, (3,))
    for name in ("pose", "velocity", "acceleration"):
        _require(f"reference {name}", getattr(reference, name), (3,))


def _require(name: str, values: FloatArray, shape: Sequence[int]) -> None:
    if values.shape != shape or not np.isfinite(values).all():
        raise ControlError(f"{name} = {values.tolist()} is not allowed; allowed: finite numbers, shape {tuple(shape)}")


# What stands for numbers that nobody gave.
_NOTHING, _ZERO = np.zeros(0), np.zeros(3)


@compiled
def _finite(values):  # type: ignore[no-untyped-def]
    for k in range(len(values)):
        if not math.isfinite(values[k]):
            return False
    return True


@compiled
def _all_finite(a, b, c, d, e, f, g, h, i, j, k, m):  # type: ignore[no-untyped-def]
    """Whether twelve arrays (k,), of any lengths and types, hold finite numbers only."""
    return (
        _finite(a) and _finite(b) and _finite(c) and _finite(d) and _finite(e) and _finite(f)
        and _finite(g) and _finite(h) and _finite(i) and _finite(j) and _finite(k) and _finite(m)
    )  # fmt: skip


def internal_forces(
    steer_axis: FloatArray, caster_offset: FloatArray, steer_angle: FloatArray, force: FloatArray
) -> FloatArray:
    """Return E F_con, (5.3), with unit vectors: what each pair of wheels pulls on each other along their line.

        F_int^ij = e_ij . (F_i - F_j),   e_ij = (p_j - p_i) / |p_j - p_i|

    The virtual linkage: a strut between each two contacts, whose forces add nothing to the wrench. E A = 0.

    Args:
        steer_axis, caster_offset: of the robot (n, 2) [m].
        steer_angle: headings (n,) [rad].
        force: contact forces in the wheel frames (n, 2) [N].

    Returns:
        (n (n - 1) / 2,) [N], pairs 01, 02, .. 12, ..; positive pulls the two wheels together.
    """
    found: FloatArray = internal_force_kernel(steer_axis, caster_offset, steer_angle, force)
    return found


@compiled
def internal_force_kernel(steer_axis, caster_offset, steer_angle, force):  # type: ignore[no-untyped-def]
    """As `internal_forces`; one call in every control cycle."""
    n = len(steer_angle)
    place = np.empty((n, 4))
    for i in range(n):
        c, s = math.cos(steer_angle[i]), math.sin(steer_angle[i])
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        place[i, 0], place[i, 1] = steer_axis[i, 0] + bx * c - by * s, steer_axis[i, 1] + bx * s + by * c
        place[i, 2], place[i, 3] = c * force[i, 0] - s * force[i, 1], s * force[i, 0] + c * force[i, 1]
    found = np.empty(n * (n - 1) // 2)
    k = 0
    for i in range(n):
        for j in range(i + 1, n):
            x, y = place[j, 0] - place[i, 0], place[j, 1] - place[i, 1]
            pull = x * (place[i, 2] - place[j, 2]) + y * (place[i, 3] - place[j, 3])
            found[k] = pull / math.hypot(x, y)
            k += 1
    return found


@compiled
def output_kernel(B, steer_axis, caster_offset, steer_angle, force):  # type: ignore[no-untyped-def]
    """Return `joint_torque_kernel` and `internal_force_kernel` of forces (n, 2), in one call."""
    return joint_torque_kernel(B, force), internal_force_kernel(steer_axis, caster_offset, steer_angle, force)


@compiled
def joint_torque_kernel(B, force):  # type: ignore[no-untyped-def]
    """Return tau = B^T F_con (n, 2) [N m] for blocks B (n, 2, 2) and forces in the wheel frames (n, 2); in every cycle."""
    torque = np.empty(force.shape)
    for i in range(len(force)):
        for j in range(2):
            torque[i, j] = B[i, 0, j] * force[i, 0] + B[i, 1, j] * force[i, 1]
    return torque
