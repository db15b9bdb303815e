"""The one place where joint torques are limited, last before they leave: a bad number ends here as zero torque.

In this order:

1. NaN or infinity in torque or speed: zero torque and a fault.
2. Speed fold-back per joint: torque that accelerates a joint further fades out between `foldback_start` times the speed
   limit and the limit itself; braking torque is never reduced.
3. Slew limit (optional), which is a limit of jerk: what a joint's torque may change per time.
4. Torque limits. Mode "scale" multiplies all torques by the one factor that brings the worst joint to its limit. Torques
   B^T A (A^T A)^-1 F are linear in F, so the robot gets the wanted wrench in its direction, only weaker, and no internal
   force appears. Mode "clip" cuts each joint on its own: more force, but in another direction and with the wheels
   pushing against each other.
5. Power limit (optional): the joints that drive, sum of max(tau q_dot, 0), draw no more than it. What mode "scale" does to the
   torques it does here too, "clip" takes it off the driving joints alone.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import FloatArray, RobotDescription

from .delay_margin import effective_mass
from .errors import ControlError

MODES = ("scale", "clip")


@dataclasses.dataclass(frozen=True)
class TorqueLimits:
    """The limits.

    Attributes:
        torque: largest joint torques (n, 2) [N m].
        speed: largest joint speeds (n, 2) [rad/s].
        mode: "scale" (keep the direction of the wrench) or "clip" (each joint on its own).
        foldback_start: fraction of the speed limit at which accelerating torque begins to fade.
        slew: largest change of a joint torque [N m/s], one number or (n, 2); None for no limit.
        power: largest mechanical power drawn by the driving joints together [W]; None for no limit.
    """

    torque: FloatArray
    speed: FloatArray
    mode: str = "scale"
    foldback_start: float = 0.9
    slew: float | FloatArray | None = None
    power: float | None = None

    def __post_init__(self) -> None:
        """Check the limits.

        Raises:
            ControlError: names the field, its value and what is allowed.
        """
        if self.mode not in MODES:
            raise ControlError(f"mode {self.mode!r} is not allowed; allowed: {', '.join(MODES)}")
        for name, values in (("torque", self.torque), ("speed", self.speed)):
            if values.ndim != 2 or values.shape != self.torque.shape or not np.all(values > 0.0):
                raise ControlError(f"{name} limits {values!r} are not allowed; allowed: positive numbers, shape (n, 2)")
        if not 0.0 < self.foldback_start < 1.0:
            raise ControlError(f"foldback_start = {self.foldback_start!r} is not allowed; allowed: between 0 and 1")
        if self.slew is not None and not np.all(np.asarray(self.slew) > 0.0):
            raise ControlError(f"slew = {self.slew!r} is not allowed; allowed: a positive number or None")
        if self.power is not None and not self.power > 0.0:
            raise ControlError(f"power = {self.power!r} is not allowed; allowed: a positive number or None")

    @classmethod
    def of_robot(
        cls, robot: RobotDescription, mode: str = "scale", slew: float | None = None, power: float | None = None,
        jerk: float | None = None,
    ) -> TorqueLimits:
        """Return the limits that the robot's description states.

        Args:
            robot: the robot.
            mode: "scale" or "clip".
            slew: [N m/s]; the smaller one of it and `jerk` counts.
            power: [W].
            jerk: largest jerk of a wheel centre [m/s^3]; with its effective mass m and lever a, a joint's slew is a m jerk.
        """
        rate: float | FloatArray | None = slew
        if jerk is not None:
            lever = np.stack([robot.wheel_radius, np.abs(robot.caster_offset[:, 0])], axis=1)
            rate = np.minimum(jerk * lever * effective_mass(robot), math.inf if slew is None else slew)
        return cls(robot.torque_limit, robot.speed_limit, mode=mode, slew=rate, power=power)


@dataclasses.dataclass(frozen=True)
class LimitedTorque:
    """What may be sent.

    Attributes:
        torque: joint torques (n, 2) [N m], finite and within the limits.
        fault: the request or the measured speed held NaN or infinity, and the torque is zero.
        saturated: the torque is less than what was asked for, so that an integrator should hold.
    """

    torque: FloatArray
    fault: bool
    saturated: bool


def limit_torque(
    limits: TorqueLimits, previous_torque: FloatArray, torque: FloatArray, joint_velocity: FloatArray, dt: float
) -> LimitedTorque:
    """Return the torque that may be sent; its `torque` is the next `previous_torque`, the only state there is.

    Args:
        limits: the limits.
        previous_torque: torque sent before (n, 2) [N m], for the slew limit.
        torque: torque asked for (n, 2) [N m].
        joint_velocity: measured joint speeds (n, 2) [rad/s].
        dt: measured time since the torque before [s].
    """
    if not (np.isfinite(torque).all() and np.isfinite(joint_velocity).all() and math.isfinite(dt)):
        return LimitedTorque(np.zeros_like(limits.torque), fault=True, saturated=True)
    slew = np.broadcast_to(math.inf if limits.slew is None else np.asarray(limits.slew) * max(dt, 0.0), limits.torque.shape)
    allowed, saturated = _limited(
        torque, joint_velocity, previous_torque, limits.torque, limits.speed, limits.foldback_start, slew,
        limits.mode == "scale", math.inf if limits.power is None else limits.power,
    )
    return LimitedTorque(allowed, fault=False, saturated=saturated)


@compiled
def _limited(torque, velocity, previous, largest, fastest, foldback_start, slew, scale, power):  # type: ignore[no-untyped-def]
    """Return the torque (n, 2) after steps 2 to 5 and whether it differs from `torque`; one call in every control cycle."""
    allowed = np.empty(torque.shape)
    ratio = 1.0
    for i in range(torque.shape[0]):
        for j in range(2):
            value = torque[i, j]
            if value * velocity[i, j] > 0.0:
                fade = (1.0 - abs(velocity[i, j]) / fastest[i, j]) / (1.0 - foldback_start)
                value *= min(max(fade, 0.0), 1.0)
            allowed[i, j] = min(max(value, previous[i, j] - slew[i, j]), previous[i, j] + slew[i, j])
            ratio = max(ratio, abs(allowed[i, j]) / largest[i, j])
    drawn = 0.0
    for i in range(torque.shape[0]):
        for j in range(2):
            value = allowed[i, j] / ratio if scale else allowed[i, j]
            # Dividing by a ratio just above one may leave a joint a rounding error above its limit: the clip removes it.
            allowed[i, j] = min(max(value, -largest[i, j]), largest[i, j])
            drawn += max(allowed[i, j] * velocity[i, j], 0.0)
    saturated = False
    for i in range(torque.shape[0]):
        for j in range(2):
            if drawn > power and (scale or allowed[i, j] * velocity[i, j] > 0.0):
                allowed[i, j] *= power / drawn
            saturated = saturated or allowed[i, j] != torque[i, j]
    return allowed, saturated
