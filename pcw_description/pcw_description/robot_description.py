"""The robot description format `pcw_robot/1`: the single source of numbers for nodes, simulators, URDF and analyser.

Conventions (EQUATIONS in `SYMBOLS.md`): SI units, `base_link` with x forward, y left, z up and its origin on the
ground below the reference point of the robot. Joint arrays have the shape (n, 2): the first index is the caster in
the order of the file, the second is `DRIVE` or `STEER`. Contact arrays use `LONGITUDINAL` and `LATERAL` likewise.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from .description_fields import quantity, section, text
from .effect_instance import EffectInstance
from .errors import DescriptionError, KinematicsError, nearest_name

FORMAT = "pcw_robot/1"
DRIVE, STEER = 0, 1
LONGITUDINAL, LATERAL = 0, 1
AXIS_NAMES = ("drive", "steer")
CONTACT_MODELS = ("kiencke", "magic_formula", "dugoff", "burckhardt", "lugre")

# Two steering axes closer than this are one axis: no module of these robots is this thin.
MINIMUM_AXIS_DISTANCE = 0.01
# Below this offset steering cannot push the wheel sideways with a usable torque.
MINIMUM_CASTER_OFFSET = 1e-3
# Fixed wheels whose axles lie so close to one line roll about one axle; further apart they drag in every curve.
AXLE_DISTANCE, AXLE_ANGLE = 0.02, 0.02  # [m], [rad]
# A wheel sinks in by so much under its share of the weight [m], with this damping ratio, where `suspension` says nothing else.
STATIC_DEFLECTION = 1.5e-3
SUSPENSION_DAMPING_RATIO = 0.4
GRAVITY = 9.81  # [m/s^2]
POSSIBLE_MARGIN = 1.01  # above the inertia that a module of points and a flat wheel would have

FloatArray = npt.NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Chassis:
    """Everything that does not turn with a caster."""

    mass: float = quantity("kg", "mass without the caster modules", above=0.0, maximum=1e5)
    inertia_zz: float = quantity("kg m^2", "inertia about the vertical through the centre of mass", above=0.0, maximum=1e6)
    com: tuple[float, float, float] = quantity(
        "m", "centre of mass in base_link; z above the ground", length=3, minimum=-10.0, maximum=10.0,
        hint="a larger value may be in mm",
    )
    size: tuple[float, float, float] = quantity(
        "m", "length, width, height of the body, for looks and default inertias", length=3, above=0.0, maximum=20.0
    )
    inertia_xx: float | None = quantity("kg m^2", "inertia about x; default: a box of `size`", above=0.0, default=None)
    inertia_yy: float | None = quantity("kg m^2", "inertia about y; default: a box of `size`", above=0.0, default=None)

    def principal_inertias(self) -> tuple[float, float, float]:
        """Return (I_xx, I_yy, I_zz) about the centre of mass [kg m^2], with box defaults filled in."""
        length, width, height = self.size
        box_xx = self.mass * (width**2 + height**2) / 12.0
        box_yy = self.mass * (length**2 + height**2) / 12.0
        # A box of that size may contradict the stated I_zz; then the two move as little as the triangle inequality asks.
        half_sum = max(0.5 * (box_xx + box_yy), 0.5005 * self.inertia_zz)
        half_difference = 0.5 * (box_xx - box_yy)
        half_difference = math.copysign(min(abs(half_difference), 0.4995 * self.inertia_zz), half_difference)
        return (
            self.inertia_xx if self.inertia_xx is not None else half_sum + half_difference,
            self.inertia_yy if self.inertia_yy is not None else half_sum - half_difference,
            self.inertia_zz,
        )


@dataclasses.dataclass(frozen=True)
class Module:
    """The part of a caster that turns about the steering axis: fork, wheel and what hangs on them."""

    mass: float = quantity("kg", "mass of fork and wheel together", above=0.0, maximum=1e4)
    inertia_zz: float = quantity(
        "kg m^2", "inertia of fork and wheel about the vertical through their centre of mass", above=0.0, maximum=1e4
    )
    com: tuple[float, float] = quantity(
        "m", "centre of mass in the wheel frame, from the steering axis", length=2, minimum=-1.0, maximum=1.0
    )


@dataclasses.dataclass(frozen=True)
class Wheel:
    """The rolling part; its mass is part of the module's mass."""

    mass: float = quantity("kg", "mass of the wheel", above=0.0, maximum=1e4)
    inertia_axle: float = quantity("kg m^2", "inertia about the axle, without the motor", above=0.0, maximum=1e4)
    width: float = quantity("m", "width of the tread", above=0.0, maximum=1.0)


@dataclasses.dataclass(frozen=True)
class Gears:
    """Motor angle = matrix times joint angle: drive motor = drive * rho + drive_per_steer * phi, and likewise steer."""

    drive: float = quantity("1", "turns of the drive motor per turn of the wheel", minimum=-1e4, maximum=1e4)
    steer: float = quantity("1", "turns of the steering motor per turn of the steering axis", minimum=-1e4, maximum=1e4)
    drive_per_steer: float = quantity(
        "1", "turns of the drive motor per turn of the steering axis (coupling)", default=0.0, minimum=-1e4, maximum=1e4
    )
    steer_per_drive: float = quantity(
        "1", "turns of the steering motor per turn of the wheel (coupling)", default=0.0, minimum=-1e4, maximum=1e4
    )


@dataclasses.dataclass(frozen=True)
class Rotors:
    """Inertias of the rotors about their own axes, motor side."""

    drive: float = quantity("kg m^2", "rotor inertia of the drive motor, motor side", minimum=0.0, maximum=10.0)
    steer: float = quantity("kg m^2", "rotor inertia of the steering motor, motor side", minimum=0.0, maximum=10.0)


@dataclasses.dataclass(frozen=True)
class Limits:
    """Limits of one caster, on the joint side of the gears."""

    drive_torque: float = quantity("N m", "largest drive torque, joint side", above=0.0, maximum=1e5)
    steer_torque: float = quantity("N m", "largest steering torque, joint side", above=0.0, maximum=1e5)
    drive_speed: float = quantity(
        "rad/s", "largest wheel speed", above=0.0, maximum=300.0, hint="a larger value may be in rpm or deg/s"
    )
    steer_speed: float = quantity(
        "rad/s", "largest steering speed", above=0.0, maximum=100.0, hint="a larger value may be in rpm or deg/s"
    )


@dataclasses.dataclass(frozen=True)
class LateralContact:
    """Friction across the rolling direction."""

    mu_p: float = quantity("1", "peak friction coefficient, lateral", above=0.0, maximum=5.0)
    lambda_p: float = quantity("1", "slip at the peak, lateral (tangent of the slip angle)", above=0.0, maximum=1.0)


@dataclasses.dataclass(frozen=True)
class ContactDescription:
    """The nominal ground and the tyre on it."""

    model: str = text("friction curve", choices=CONTACT_MODELS)
    mu_p: float = quantity("1", "peak friction coefficient", above=0.0, maximum=5.0)
    lambda_p: float = quantity("1", "slip ratio at the peak", above=0.0, maximum=1.0, hint="a larger value may be in percent")
    lateral: LateralContact = section("the same across the rolling direction")
    relaxation_length: float = quantity("m", "rolled distance over which the tyre force builds up", above=0.0, maximum=1.0)
    scrub_radius: float = quantity(
        "m", "effective radius of the contact patch for turning on the spot; 0 = a point", minimum=0.0, maximum=0.2,
        default=0.0,
    )
    shape: dict[str, float] = section("further numbers of the friction curve, by name", default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Suspension:
    """What carries the load of one wheel: its spring and the tyre together, vertical."""

    stiffness: float = quantity("N/m", "vertical stiffness of one wheel", above=0.0, maximum=1e8)
    damping: float = quantity("N s/m", "vertical damping of one wheel", minimum=0.0, maximum=1e6)


@dataclasses.dataclass(frozen=True)
class Caster:
    """One powered caster wheel."""

    name: str = text("name of the caster; its joints are NAME_steer and NAME_drive")
    steer_axis: tuple[float, float] = quantity(
        "m", "steering axis in base_link", length=2, minimum=-10.0, maximum=10.0, hint="a larger value may be in mm"
    )
    caster_offset: tuple[float, float] = quantity(
        "m", "steering axis to wheel centre in the wheel frame (b_x, b_y); a trailing wheel has b_x < 0", length=2,
        minimum=-1.0, maximum=1.0, hint="a larger value may be in mm",
    )
    wheel_radius: float = quantity("m", "rolling radius", above=0.0, maximum=1.0, hint="a larger value may be in mm")
    module: Module = section("fork and wheel, turning about the steering axis")
    wheel: Wheel = section("the rolling part")
    gears: Gears = section("gear ratios and coupling")
    rotors: Rotors = section("rotor inertias")
    limits: Limits = section("limits of torque and speed")
    contact: ContactDescription | None = section("this wheel's own tyre; default: the robot's `contact`", default=None)


@dataclasses.dataclass(frozen=True)
class FixedWheel:
    """A passive wheel that does not steer: the axle of a tricycle. It has no joint and lets nothing move along its axle."""

    name: str = text("name of the wheel")
    position: tuple[float, float] = quantity(
        "m", "wheel centre in base_link", length=2, minimum=-10.0, maximum=10.0, hint="a larger value may be in mm"
    )
    wheel_radius: float = quantity("m", "rolling radius", above=0.0, maximum=1.0, hint="a larger value may be in mm")
    direction: float = quantity(
        "rad", "heading in base_link; 0 = rolls towards +x", minimum=-math.pi, maximum=math.pi, default=0.0,
        hint="a larger value may be in degrees",
    )


@dataclasses.dataclass(frozen=True)
class Encoders:
    """Encoders on the motors."""

    drive_counts: float = quantity("counts/rev", "counts per turn of the drive motor", above=0.0, maximum=1e9)
    steer_counts: float = quantity("counts/rev", "counts per turn of the steering motor", above=0.0, maximum=1e9)
    rate: float = quantity("Hz", "rate of joint_states", above=0.0, maximum=2e4)
    velocity_noise: float = quantity("rad/s", "standard deviation of measured joint speed", minimum=0.0, default=0.0)
    torque_noise: float = quantity("N m", "standard deviation of measured motor torque, joint side", minimum=0.0, default=0.0)


@dataclasses.dataclass(frozen=True)
class ImuDescription:
    """Inertial measurement unit, axes parallel to base_link."""

    position: tuple[float, float, float] = quantity("m", "position in base_link", length=3, minimum=-10.0, maximum=10.0)
    rate: float = quantity("Hz", "rate of imu/data", above=0.0, maximum=2e4)
    gyro_noise: float = quantity("rad/s", "standard deviation of one sample", minimum=0.0, maximum=1.0)
    accelerometer_noise: float = quantity("m/s^2", "standard deviation of one sample", minimum=0.0, maximum=10.0)


@dataclasses.dataclass(frozen=True)
class TrackerDescription:
    """Whatever measures the true pose: a motion tracker, or the simulator itself."""

    rate: float = quantity("Hz", "rate of ground_truth/odom", above=0.0, maximum=2e4)
    position_noise: float = quantity("m", "standard deviation of one sample", minimum=0.0, maximum=1.0, default=0.0)
    yaw_noise: float = quantity("rad", "standard deviation of one sample", minimum=0.0, maximum=1.0, default=0.0)
    position: tuple[float, float] | None = quantity(
        "m", "in base_link, of what is tracked; without it base_link itself is", length=2, minimum=-10.0, maximum=10.0,
        hint="a larger value may be in mm", default=None,
    )
    yaw: float = quantity(
        "rad", "of what is tracked, in base_link", minimum=-math.pi, maximum=math.pi, default=0.0,
        hint="a larger value may be in degrees",
    )


    @property
    def place(self) -> tuple[float, float, float]:
        """Where what is tracked stands in base_link: x, y [m], yaw [rad]."""
        x, y = self.position or (0.0, 0.0)
        return x, y, self.yaw


@dataclasses.dataclass(frozen=True)
class Sensors:
    """What the robot measures."""

    encoders: Encoders = section("encoders and joint_states")
    imu: ImuDescription | None = section("inertial measurement unit; leave out where there is none", default=None)
    tracker: TrackerDescription | None = section("external pose; leave out where there is none", default=None)


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """How far a healthy robot may differ from its description: one standard deviation.

    Attributes:
        value: the deviation, as a fraction of the nominal number if `relative`, else in `unit`.
    """

    value: float
    unit: str
    relative: bool

    def __str__(self) -> str:
        return f"{self.value * 100:g} %" if self.relative else f"{self.value:g} {self.unit}"


# Defaults: careful workshop practice. A robot file overrides them where its builder knows better.
DEFAULT_TOLERANCES: Mapping[str, Tolerance] = {
    "chassis.mass": Tolerance(0.01, "kg", True),
    "chassis.inertia_zz": Tolerance(0.05, "kg m^2", True),
    "chassis.com": Tolerance(0.005, "m", False),
    "module.mass": Tolerance(0.01, "kg", True),
    "module.inertia_zz": Tolerance(0.05, "kg m^2", True),
    "wheel.inertia_axle": Tolerance(0.05, "kg m^2", True),
    "rotors": Tolerance(0.05, "kg m^2", True),
    "wheel_radius": Tolerance(0.001, "m", True),
    "caster_offset": Tolerance(0.0002, "m", False),
    "steer_axis": Tolerance(0.0005, "m", False),
    "steer_zero": Tolerance(0.002, "rad", False),
    "torque_constant": Tolerance(0.01, "1", True),
    "contact.mu_p": Tolerance(0.1, "1", True),
    # Tyre and whatever suspends the wheel act as one spring, and hardly anybody has measured it.
    "contact.stiffness": Tolerance(0.5, "1", True),
    "contact.relaxation_length": Tolerance(0.5, "m", True),
    # Of one wheel, along or across, against all: on a floor that is not quite flat four wheels share the load anyhow.
    "contact.stiffness_spread": Tolerance(0.1, "1", False),
    # What passes for a level floor: 2 mm in a metre.
    "ground.slope": Tolerance(0.002, "rad", False),
    # Stamps of other sensors than the encoders': a bus and a driver are between them.
    "clock.offset": Tolerance(0.001, "s", False),
    "imu.position": Tolerance(0.005, "m", False),
    "imu.gyro_bias": Tolerance(0.002, "rad/s", False),
    "imu.accelerometer_bias": Tolerance(0.05, "m/s^2", False),
    "imu.scale": Tolerance(0.005, "1", True),
    # Of what is tracked, where the description says that it is not base_link itself.
    "tracker.position": Tolerance(0.005, "m", False),
    "tracker.yaw": Tolerance(0.005, "rad", False),
    "fixed_wheels.position": Tolerance(0.002, "m", False),
    "fixed_wheels.direction": Tolerance(0.002, "rad", False),
}


@dataclasses.dataclass(frozen=True)
class RobotDescription:
    """A robot on powered casters, validated when it is made: n >= 2, or n >= 1 and wheels that do not steer."""

    format: str = text("format of this file", choices=(FORMAT,))
    name: str = text("name of the robot")
    provenance: dict[str, str] = section("where each number comes from")
    chassis: Chassis = section("everything that does not turn with a caster")
    casters: tuple[Caster, ...] = section("the casters, in the order used by every array")
    contact: ContactDescription = section("the nominal ground")
    sensors: Sensors = section("what the robot measures")
    fixed_wheels: tuple[FixedWheel, ...] = section("passive wheels that do not steer, all on one axle", default=())
    suspension: Suspension | None = section(
        "what carries the load of one wheel; default: 1.5 mm of static deflection, damped with a ratio of 0.4", default=None
    )
    tolerances: dict[str, Tolerance] = section("how far a healthy robot may differ", default_factory=dict)
    physics: tuple[EffectInstance, ...] = section("effects beyond the nominal model; empty in a nominal robot", default=())

    def __post_init__(self) -> None:
        """Check what no single field can see.

        Raises:
            DescriptionError: fewer than two casters and no fixed wheel, a name twice, two casters on one axis, fixed
                wheels that drag or leave a motion undetermined, inertias that no body has.
        """
        _check_casters(self.casters, least=1 if self.fixed_wheels else 2)
        _check_fixed_wheels(self.fixed_wheels, self.casters)
        _check_chassis(self.chassis)
        for index, caster in enumerate(self.casters):
            _check_module(caster, f"casters[{index}]")

    @property
    def n(self) -> int:
        """Number of casters."""
        return len(self.casters)

    @cached_property
    def caster_names(self) -> tuple[str, ...]:
        """Names of the casters, in order."""
        return tuple(caster.name for caster in self.casters)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the 2n joints, in the order of a flattened (n, 2) joint array."""
        return tuple(f"{name}_{axis}" for name in self.caster_names for axis in AXIS_NAMES)

    @cached_property
    def steer_axis(self) -> FloatArray:
        """Steering axes in base_link, (n, 2) [m]."""
        return _constant([caster.steer_axis for caster in self.casters])

    @cached_property
    def caster_offset(self) -> FloatArray:
        """Steering axis to wheel centre in the wheel frame, (n, 2) [m]."""
        return _constant([caster.caster_offset for caster in self.casters])

    @cached_property
    def wheel_radius(self) -> FloatArray:
        """Rolling radii, (n,) [m]."""
        return _constant([caster.wheel_radius for caster in self.casters])

    @cached_property
    def gear_matrix(self) -> FloatArray:
        """Motor angle from joint angle, (n, 2, 2), both in the order (drive, steer)."""
        return _constant(
            [
                [[c.gears.drive, c.gears.drive_per_steer], [c.gears.steer_per_drive, c.gears.steer]]
                for c in self.casters
            ]
        )

    @cached_property
    def gear_coupling(self) -> FloatArray:
        """Motor angles, joint side, from joint angles E (n, 2, 2): the rows of the gear matrix over its diagonal.

        Torques u of the motors, joint side, are E^T u on the joints.
        """
        return _constant(self.gear_matrix / np.einsum("nii->ni", self.gear_matrix)[:, :, None])

    @cached_property
    def armature(self) -> FloatArray:
        """Rotor inertias seen at the joints, N^T diag(J) N, (n, 2, 2) [kg m^2]."""
        matrices = []
        for caster, gear in zip(self.casters, self.gear_matrix, strict=True):
            matrices.append(gear.T @ np.diag([caster.rotors.drive, caster.rotors.steer]) @ gear)
        return _constant(matrices)

    @cached_property
    def felt_inertia(self) -> FloatArray:
        """Inertia that each joint feels when the robot's mass is shared by all casters, (n, 2) [kg m^2]."""
        levers = [[c.wheel_radius, c.caster_offset[0]] for c in self.casters]
        return _constant(self.own_inertia + self.total_mass / self.n * np.square(levers))

    @cached_property
    def own_inertia(self) -> FloatArray:
        """Inertia of each joint alone, as it turns where tyres slip: of rotor, wheel, module, (n, 2) [kg m^2]."""
        turned = [[c.wheel.inertia_axle, c.module.inertia_zz] for c in self.casters]
        return _constant(self.armature[:, [DRIVE, STEER], [DRIVE, STEER]] + np.array(turned))

    @cached_property
    def torque_limit(self) -> FloatArray:
        """Largest joint torques, (n, 2) [N m]."""
        return _constant([[c.limits.drive_torque, c.limits.steer_torque] for c in self.casters])

    @cached_property
    def speed_limit(self) -> FloatArray:
        """Largest joint speeds, (n, 2) [rad/s]."""
        return _constant([[c.limits.drive_speed, c.limits.steer_speed] for c in self.casters])

    @cached_property
    def fixed_axle(self) -> FloatArray:
        """The axle that all fixed wheels share, where its middle is and which way it rolls: x, y [m], heading [rad].

        (1, 3), or (0, 3) for a robot without fixed wheels.
        """
        wheels = self.fixed_wheels
        if not wheels:
            return _constant(np.zeros((0, 3)))
        first = wheels[0].direction
        # Half a turn is the same axle.
        heading = first + float(np.mean([math.remainder(wheel.direction - first, math.pi) for wheel in wheels]))
        return _constant([[*np.mean([wheel.position for wheel in wheels], axis=0), heading]])

    @property
    def total_mass(self) -> float:
        """Mass of the whole robot [kg]."""
        return self.chassis.mass + sum(caster.module.mass for caster in self.casters)

    @cached_property
    def tyres(self) -> tuple[ContactDescription, ...]:
        """The tyre of each caster on the nominal ground, (n,)."""
        return tuple(caster.contact or self.contact for caster in self.casters)

    @cached_property
    def wheel_suspension(self) -> Suspension:
        """What carries the load of one wheel, defaults filled in."""
        if self.suspension is not None:
            return self.suspension
        share = self.total_mass / (self.n + len(self.fixed_wheels))
        stiffness = share * GRAVITY / STATIC_DEFLECTION
        return Suspension(stiffness, 2.0 * SUSPENSION_DAMPING_RATIO * math.sqrt(stiffness * share))

    def with_casters(self, names: Sequence[str], change: Callable[[Caster], Caster]) -> RobotDescription:
        """Return the robot with the named casters changed, validated anew.

        Raises:
            DescriptionError: unknown name, or a change that no robot can have.
        """
        indices = {self.caster_index(name) for name in names}
        casters = [change(caster) if i in indices else caster for i, caster in enumerate(self.casters)]
        return dataclasses.replace(self, casters=tuple(casters))

    def with_tyres(
        self, names: Sequence[str], change: Callable[[ContactDescription], ContactDescription]
    ) -> RobotDescription:
        """Return the robot with the tyres of the named casters changed."""
        return self.with_casters(
            names, lambda caster: dataclasses.replace(caster, contact=change(caster.contact or self.contact))
        )

    def tolerance(self, name: str) -> Tolerance:
        """Return the tolerance of this file, or the documented default."""
        return self.tolerances.get(name, DEFAULT_TOLERANCES[name])

    def caster_index(self, name: str) -> int:
        """Return the index of a caster by name."""
        try:
            return self.caster_names.index(name)
        except ValueError:
            raise DescriptionError("caster", name, nearest_name(name, self.caster_names)) from None

    def require_torque_control(self) -> None:
        """Refuse robots whose steering cannot push the wheel sideways, and those that cannot move sideways.

        Raises:
            KinematicsError: a caster has b_x of zero, so that B is singular and no steering torque makes a side force; or
                there are fixed wheels.
        """
        self.require_casters_only("torque control and simulation")
        for caster in self.casters:
            if abs(caster.caster_offset[0]) < MINIMUM_CASTER_OFFSET:
                raise KinematicsError(
                    f"{self.name}: caster {caster.name!r} has caster_offset[0] = {caster.caster_offset[0]:g} m; "
                    f"torque control needs at least {MINIMUM_CASTER_OFFSET:g} m along the rolling direction, because the "
                    "steering torque makes the side force through that lever arm (this robot loads for kinematics and "
                    "analysis only)"
                )


    def require_casters_only(self, purpose: str) -> None:
        """Refuse robots with fixed wheels, for what knows only wheels that turn.

        Raises:
            KinematicsError: there are fixed wheels.
        """
        if self.fixed_wheels:
            names = ", ".join(wheel.name for wheel in self.fixed_wheels)
            raise KinematicsError(
                f"{self.name}: fixed_wheels are {names}; allowed for {purpose}: a robot on casters alone (a robot with fixed "
                "wheels loads for kinematics, odometry and analysis)"
            )


def _constant(values: Any) -> FloatArray:
    array = np.asarray(values, dtype=float)
    array.setflags(write=False)
    return array


def _check_casters(casters: Sequence[Caster], least: int) -> None:
    if len(casters) < least:
        raise DescriptionError(
            "casters", len(casters), "allowed: at least 2 casters (thesis section 3.1), or 1 and fixed_wheels"
        )
    names = [caster.name for caster in casters]
    for index, caster in enumerate(casters):
        where = f"casters[{index}]"
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", caster.name):
            raise DescriptionError(f"{where}.name", caster.name, "allowed: letters, digits and _, beginning with a letter")
        if names.index(caster.name) != index:
            raise DescriptionError(
                f"{where}.name", caster.name, f"allowed: each name once; casters[{names.index(caster.name)}] has it"
            )
        for earlier in range(index):
            distance = math.dist(caster.steer_axis, casters[earlier].steer_axis)
            if distance < MINIMUM_AXIS_DISTANCE:
                raise DescriptionError(
                    f"{where}.steer_axis", list(caster.steer_axis),
                    f"two casters on one axis: {casters[earlier].name!r} is {distance:g} m away; "
                    f"allowed: at least {MINIMUM_AXIS_DISTANCE:g} m apart",
                )
        gears = caster.gears
        determinant = gears.drive * gears.steer - gears.drive_per_steer * gears.steer_per_drive
        if abs(determinant) < 1e-9:
            raise DescriptionError(f"{where}.gears", determinant, "allowed: a gear matrix that can be inverted")


def _check_fixed_wheels(wheels: Sequence[FixedWheel], casters: Sequence[Caster]) -> None:
    names = [caster.name for caster in casters]
    for index, wheel in enumerate(wheels):
        where, first = f"fixed_wheels[{index}]", wheels[0]
        if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", wheel.name):
            raise DescriptionError(f"{where}.name", wheel.name, "allowed: letters, digits and _, beginning with a letter")
        if wheel.name in names:
            raise DescriptionError(f"{where}.name", wheel.name, "allowed: each name once, among the casters too")
        names.append(wheel.name)
        if abs(math.sin(wheel.direction - first.direction)) > AXLE_ANGLE:
            raise DescriptionError(
                f"{where}.direction", wheel.direction,
                f"{wheel.name!r} and {first.name!r} would drag one another in every motion; "
                f"allowed: the direction of {first.name!r}, {first.direction:g} rad, or half a turn from it",
            )
        apart = _along(first, wheel.position)
        if abs(apart) > AXLE_DISTANCE:
            raise DescriptionError(
                f"{where}.position", list(wheel.position),
                f"{wheel.name!r} is {apart:+.3g} m ahead of the axle of {first.name!r} and would drag in every curve; "
                f"allowed: at most {AXLE_DISTANCE:g} m, all fixed wheels on one axle",
            )
    if len(casters) == 1 and wheels:
        caster = casters[0]
        apart = _along(wheels[0], caster.steer_axis)
        # Above the axle the wheels agree in every motion about the point where they all are: the yaw rate is anybody's.
        if abs(apart) < 2.0 * MINIMUM_AXIS_DISTANCE + math.hypot(*caster.caster_offset):
            raise DescriptionError(
                "casters[0].steer_axis", list(caster.steer_axis),
                f"{caster.name!r} is {abs(apart):.3g} m from the axle of the fixed wheels, and turning does not show; "
                f"allowed: more than {2.0 * MINIMUM_AXIS_DISTANCE + math.hypot(*caster.caster_offset):.3g} m",
            )


def _along(wheel: FixedWheel, place: Sequence[float]) -> float:
    """How far a place is ahead of a fixed wheel, along its heading [m]."""
    c, s = math.cos(wheel.direction), math.sin(wheel.direction)
    return c * (place[0] - wheel.position[0]) + s * (place[1] - wheel.position[1])


def _check_chassis(chassis: Chassis) -> None:
    zz = chassis.inertia_zz
    # All the mass at the corners of a body of twice the stated size bounds what the number can be.
    reach = math.hypot(chassis.size[0], chassis.size[1])
    if zz > chassis.mass * reach**2:
        raise DescriptionError(
            "chassis.inertia_zz", zz,
            f"non-physical inertia for {chassis.mass:g} kg within {reach:.3g} m; "
            f"allowed: at most {chassis.mass * reach**2:.3g} kg m^2",
        )
    if zz < 1e-3 * chassis.mass * reach**2:
        raise DescriptionError(
            "chassis.inertia_zz", zz,
            f"non-physical inertia for {chassis.mass:g} kg spread over {reach:.3g} m (a placeholder?); "
            f"allowed: at least {1e-3 * chassis.mass * reach**2:.3g} kg m^2",
        )
    xx, yy, _ = chassis.principal_inertias()
    if zz > xx + yy or xx > yy + zz or yy > xx + zz:
        raise DescriptionError(
            "chassis.inertia_zz", zz,
            f"non-physical inertia: no body has I_xx = {xx:g}, I_yy = {yy:g}, I_zz = {zz:g} kg m^2; "
            "allowed: each at most the sum of the two others",
        )


def _check_module(caster: Caster, where: str) -> None:
    wheel, radius = caster.wheel, caster.wheel_radius
    if wheel.inertia_axle > wheel.mass * radius**2:
        raise DescriptionError(
            f"{where}.wheel.inertia_axle", wheel.inertia_axle,
            f"non-physical inertia: a wheel of {wheel.mass:g} kg and {radius:g} m has at most m r^2 = "
            f"{wheel.mass * radius**2:.4g} kg m^2 (a reflected rotor belongs under rotors)",
        )
    module = caster.module
    if wheel.mass >= module.mass:
        raise DescriptionError(
            f"{where}.wheel.mass", wheel.mass,
            f"allowed: below module.mass = {module.mass:g} kg, which is fork and wheel together",
        )
    least = thinnest_module_inertia(caster)
    if module.inertia_zz <= least:
        raise DescriptionError(
            f"{where}.module.inertia_zz", module.inertia_zz,
            f"non-physical inertia (a placeholder?): its wheel and the distance to it alone make {least:.4g} kg m^2; "
            "allowed: above that",
        )
    reach = math.hypot(*caster.caster_offset) + math.hypot(*module.com) + 4.0 * radius
    if module.inertia_zz > module.mass * reach**2:
        raise DescriptionError(
            f"{where}.module.inertia_zz", module.inertia_zz,
            f"non-physical inertia for {module.mass:g} kg within {reach:.3g} m of the steering axis; "
            f"allowed: at most {module.mass * reach**2:.3g} kg m^2",
        )


def thinnest_module_inertia(caster: Caster) -> float:
    """Return the least I_zz that a module with this wheel can have [kg m^2], about its centre of mass.

    A flat wheel has I_axle / 2 about a diameter, and the fork, however compact, is as far from the wheel as the two
    centres of mass say (parallel axes).
    """
    wheel, module = caster.wheel, caster.module
    fork_mass = module.mass - wheel.mass
    from_com = math.dist(module.com, caster.caster_offset)
    return wheel.inertia_axle / 2.0 + wheel.mass * from_com**2 * (1.0 + wheel.mass / fork_mass)


def possible_caster(caster: Caster) -> Caster:
    """Return the caster with inertias that matter can have, where its wheel or its place were changed alone.

    Args:
        caster: with numbers from anywhere: an effect, or a fit in which they hardly show.
    """
    wheel = dataclasses.replace(
        caster.wheel, inertia_axle=min(caster.wheel.inertia_axle, caster.wheel.mass * caster.wheel_radius**2)
    )
    caster = dataclasses.replace(caster, wheel=wheel)
    least = POSSIBLE_MARGIN * thinnest_module_inertia(caster)
    module = dataclasses.replace(caster.module, inertia_zz=max(caster.module.inertia_zz, least))
    return dataclasses.replace(caster, module=module)
