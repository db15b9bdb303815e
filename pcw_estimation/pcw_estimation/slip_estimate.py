"""What every slip observer is given and gives back: of one wheel on its own, and of a whole robot.

The sliding-mode observers, the Kalman filters and the current-based detector share these types, so that one can stand in for
another and a comparison treats all alike. A number that an observer cannot vouch for comes with a flag that says so.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import tyre_parameters
from pcw_description.robot_description import ContactDescription, FloatArray, RobotDescription
from pcw_description.wheel_dynamics import slip_ratio

from .errors import EstimationError, require

# Slip ratio and slip angle refer to at least this speed, below which they are noise [m/s].
RATIO_SPEED = 0.05


@dataclasses.dataclass(frozen=True)
class WheelModel:
    """One wheel that carries its share of a robot along a line, (3.45)-(3.47).

    Attributes:
        inertia: I_rho of wheel and reflected rotor about the axle [kg m^2].
        radius: r [m].
        mass: M, what the wheel has to move [kg].
        normal_force: F_z [N].
        contact: tyre and ground.
    """

    inertia: float
    radius: float
    mass: float
    normal_force: float
    contact: ContactDescription

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            EstimationError: names the field, its value and what is allowed.
        """
        for name in ("inertia", "radius", "mass", "normal_force"):
            require(name, getattr(self, name), above=0.0)

    @classmethod
    def of_robot(cls, robot: RobotDescription, caster: int, gravity: float = 9.81) -> WheelModel:
        """Return the wheel of one caster with an equal share of the robot's mass and weight."""
        share = robot.total_mass / robot.n
        inertia = robot.casters[caster].wheel.inertia_axle + float(robot.armature[caster, 0, 0])
        return cls(inertia, float(robot.wheel_radius[caster]), share, share * gravity, robot.tyres[caster])

    def tyre(self) -> FloatArray:
        """Return the numbers of the tyre as kernels take them."""
        return tyre_parameters(self.contact)


@dataclasses.dataclass(frozen=True)
class WheelMeasurement:
    """One reading of one wheel.

    Attributes:
        roll_angle: rho [rad], continuous; used by versions that measure angles.
        roll_rate: rho_dot [rad/s]; used by versions that measure speeds.
        drive_torque: tau_rho over the time since the reading before, joint side [N m].
    """

    roll_angle: float
    roll_rate: float
    drive_torque: float


@dataclasses.dataclass(frozen=True)
class WheelEstimate:
    """What an observer says of one wheel.

    Attributes:
        velocity: v_x of the wheel centre along the heading [m/s].
        roll_rate: rho_dot [rad/s].
        slip_ratio: lambda (3.43) [1], referred to at least `RATIO_SPEED`.
        force: F_x of the ground on the wheel [N].
        velocity_bound: how far `velocity` may be off, as the observer's own tolerances have it [m/s]; inf where unknown.
        velocity_valid, slip_valid, force_valid: whether the observer vouches for the number.
    """

    velocity: float
    roll_rate: float
    slip_ratio: float
    force: float
    velocity_bound: float
    velocity_valid: bool
    slip_valid: bool
    force_valid: bool


@dataclasses.dataclass(frozen=True)
class JointMeasurement:
    """One reading of all joints of a robot, arrays (n, 2) of drive and steer.

    Attributes:
        position: [rad], continuous.
        velocity: [rad/s]; not used by versions that measure angles.
        effort: torques over the time since the reading before, joint side [N m].
    """

    position: FloatArray
    velocity: FloatArray
    effort: FloatArray

    def check(self, n: int, names: tuple[str, ...] = ("position", "velocity", "effort")) -> None:
        """Check the arrays named.

        Raises:
            EstimationError: wrong shape, NaN or infinity.
        """
        for name in names:
            values = getattr(self, name)
            if values.shape != (n, 2) or not _all_finite(values):
                raise EstimationError(
                    f"joint {name} = {values.tolist()} is not allowed; allowed: finite numbers, shape ({n}, 2)"
                )


@compiled
def _all_finite(values):  # type: ignore[no-untyped-def]
    for row in range(values.shape[0]):
        for column in range(values.shape[1]):
            if not math.isfinite(values[row, column]):
                return False
    return True


@dataclasses.dataclass(frozen=True)
class SlipEstimate:
    """What an observer says of a whole robot; arrays (n, 2) are longitudinal and lateral, in the wheel frames.

    Attributes:
        twist: of base_link (3,) [m/s, m/s, rad/s].
        wheel_velocity: of the wheel centres over the ground (n, 2) [m/s].
        slip_velocity: B q_dot - A V (3.28) (n, 2) [m/s].
        slip_ratio: slip ratio (3.43) [1] and slip angle [rad] (n, 2).
        force: of the ground on the wheels (n, 2) [N].
        velocity_bound: how far a wheel-centre velocity may be off [m/s]; inf where unknown.
        velocity_valid, slip_valid, force_valid: whether the observer vouches for the numbers (n, 2).
    """

    twist: FloatArray
    wheel_velocity: FloatArray
    slip_velocity: FloatArray
    slip_ratio: FloatArray
    force: FloatArray
    velocity_bound: float
    velocity_valid: np.ndarray
    slip_valid: np.ndarray
    force_valid: np.ndarray


def ratio_of(rolling_speed: float, velocity: float) -> float:
    """Return the slip ratio (3.43), referred to at least `RATIO_SPEED`, so that a wheel at rest has none."""
    largest = max(abs(rolling_speed), abs(velocity))
    if largest >= RATIO_SPEED:
        return float(slip_ratio(rolling_speed, velocity))
    return (rolling_speed - velocity) / RATIO_SPEED


def ratios_and_angles(sensed: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return slip ratios and slip angles (n, 2) from sensed and true wheel-centre velocities (n, 2)."""
    reference = np.maximum(np.maximum(np.abs(sensed[:, 0]), np.abs(velocity[:, 0])), RATIO_SPEED)
    slip = sensed - velocity
    return np.stack([slip[:, 0] / reference, np.arctan2(slip[:, 1], reference)], axis=1)
