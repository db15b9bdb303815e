"""Slip-ratio control of one wheel, section 5.3.1 [Li2009], with the dynamics that follow from the wheel's own.

Slip ratio (3.43) and wheel (3.45): lambda = (r rho_dot - v) / max(|r rho_dot|, |v|),  r rho_ddot = r (tau - r F) / I,
v_dot = F / m, with m the mass that the wheel carries. By differentiation lambda_dot = f + g tau; a is the sign of the motion:

    driving, |r rho_dot| >= |v|: f = -F [(1 - a lambda) r^2 / I + 1 / m] / |r rho_dot|, g = (1 - a lambda) r / (I |r rho_dot|)
    braking, |v| > |r rho_dot|:  f = -F [r^2 / I + (1 + a lambda) / m] / |v|,           g = r / (I |v|)

(5.10) prints the first with I = m r^2 / 2, a solid disc that carries nothing, and without the r in the denominator of f; the
second is the one that "can be easily derived". They meet at lambda = 0.

The control is (5.12) with the low-pass filtered integral sliding mode of table 5.1: a sliding variable that begins at zero,

    tau = (lambda_d_dot + k (lambda_d - lambda) - f) / g - w_av,
    s = lambda - int (f + g (tau + w)) dt,      w = K sat(s / layer),      w_av = w / (T p + 1).

s slides from the first instant on, so that w is what f gets wrong, and the motor sees its average only. The torque in the
integral is the one within its limits, so a motor at its limit does not wind it up. F comes from the friction curve or from an
observer. Below `least_speed` the slip ratio has no meaning, and its dynamics are taken at that speed.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import DRIVE, FloatArray, RobotDescription

from .controller_interface import ControllerParameters, parameter
from .errors import ControlError

_INERTIA, _RADIUS, _MASS, _LIMIT = range(4)
_STARTED, _PREDICTED, _AVERAGE, _RATE = range(4)


@dataclasses.dataclass(frozen=True)
class SlidingWheel:
    """The wheel that is controlled.

    Attributes:
        inertia: I, of wheel and reflected rotor about the axle [kg m^2].
        radius: r [m].
        mass: m, what the wheel carries along [kg].
        torque_limit: largest torque of its motor, joint side [N m].
    """

    inertia: float
    radius: float
    mass: float
    torque_limit: float

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ControlError: names the field, its value and what is allowed.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if not 0.0 < value < math.inf:
                raise ControlError(f"{field.name} = {value!r} is not allowed; allowed: a finite number above 0")

    @classmethod
    def of_robot(cls, robot: RobotDescription, caster: int) -> SlidingWheel:
        """Return the wheel of one caster with an equal share of the robot's mass."""
        found = robot.casters[caster]
        inertia = found.wheel.inertia_axle + float(robot.armature[caster, DRIVE, DRIVE])
        limit = float(robot.torque_limit[caster, DRIVE])
        return cls(inertia, float(robot.wheel_radius[caster]), robot.total_mass / robot.n, limit)

    def numbers(self) -> FloatArray:
        """Return them as the kernels take them."""
        return np.array([self.inertia, self.radius, self.mass, self.torque_limit])


@dataclasses.dataclass(frozen=True)
class SlipRatioParameters(ControllerParameters):
    """Gains of slip-ratio control.

    Attributes:
        gain: k, rate at which an error of the slip ratio decays [1/s].
        sliding_gain: K, in torque, as part of the motor's limit [1].
        layer: width of s within which w is linear, as part of what K moves s by in one cycle [1].
        filter_time: T of the low pass [s].
        least_speed: below it the slip ratio is taken as at it [m/s].
    """

    gain: float = parameter(60.0, "1/s", "rate at which an error of the slip ratio decays", above=0.0, maximum=1e3)
    sliding_gain: float = parameter(1.0, "1", "what the sliding mode may add, part of the torque limit", maximum=2.0)
    layer: float = parameter(3.0, "1", "width of the layer, in cycles of the sliding gain", minimum=1.0, maximum=100.0)
    filter_time: float = parameter(0.004, "s", "time constant of the low pass behind the sliding mode", maximum=0.1)
    least_speed: float = parameter(0.1, "m/s", "speed below which the slip ratio is taken as at it", above=0.0, maximum=5.0)


@dataclasses.dataclass(frozen=True)
class SlipRatioMeasurement:
    """What is known of the wheel.

    Attributes:
        roll_rate: rho_dot [rad/s].
        velocity: of the wheel centre along the heading, of whatever source [m/s].
        force: F of the ground on the wheel, of the friction curve or of an observer [N]; 0 leaves it to the sliding mode.
    """

    roll_rate: float
    velocity: float
    force: float = 0.0


@dataclasses.dataclass(frozen=True)
class SlipRatioOutput:
    """What one step gives.

    Attributes:
        torque: within the motor's limit [N m].
        slip_ratio: lambda [1].
        sliding_variable: s [1].
        saturated: the limit cut the torque.
    """

    torque: float
    slip_ratio: float
    sliding_variable: float
    saturated: bool


@compiled
def slip_ratio_dynamics(inertia, radius, mass, roll_rate, velocity, force, least_speed):  # type: ignore[no-untyped-def]
    """Return lambda [1], f [1/s] and g [1/(s N m)] with lambda_dot = f + g tau; see the module's docstring."""
    rolling = radius * roll_rate
    if abs(rolling) >= abs(velocity):
        size = max(abs(rolling), least_speed)
        kept = velocity / rolling if rolling != 0.0 else 1.0  # 1 - a lambda
        if abs(rolling) < least_speed:
            kept = 1.0
        f = -force * (kept * radius * radius / inertia + 1.0 / mass) / size
        g = kept * radius / (inertia * size)
    else:
        size = max(abs(velocity), least_speed)
        kept = rolling / velocity if abs(velocity) >= least_speed else 1.0  # 1 + a lambda
        f = -force * (radius * radius / inertia + kept / mass) / size
        g = radius / (inertia * size)
    return (rolling - velocity) / size, f, g


@compiled
def _control(wheel, numbers, state, roll_rate, velocity, force, wanted, wanted_rate, dt):  # type: ignore[no-untyped-def]
    """Return the new state (4,), torque, slip ratio, sliding variable and whether the torque was cut."""
    gain, sliding, layer, filter_time, least_speed = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    limit = wheel[_LIMIT]
    ratio, f, g = slip_ratio_dynamics(
        wheel[_INERTIA], wheel[_RADIUS], wheel[_MASS], roll_rate, velocity, force, least_speed
    )
    # A wheel that spins on the spot cannot be told apart by its torque: g would be zero.
    g = max(g, 0.05 * wheel[_RADIUS] / (wheel[_INERTIA] * max(abs(wheel[_RADIUS] * roll_rate), least_speed)))
    after = np.empty(4)
    predicted = state[_PREDICTED] + dt * state[_RATE] if state[_STARTED] > 0.0 else ratio
    s = ratio - predicted
    # In torque: what is wrong about a force keeps its size in it while g grows as the wheel slows down.
    K = sliding * limit
    w = K * min(max(s / (layer * K * g * dt), -1.0), 1.0) if K > 0.0 else 0.0
    average = state[_AVERAGE] + (w - state[_AVERAGE]) * dt / (filter_time + dt)
    asked = (wanted_rate + gain * (wanted - ratio) - f) / g - average
    torque = min(max(asked, -limit), limit)
    after[_STARTED], after[_PREDICTED], after[_AVERAGE], after[_RATE] = 1.0, predicted, average, f + g * (torque + w)
    return after, torque, ratio, s, torque != asked


class SlipRatioControl:
    """The controller of one wheel; see the module's docstring.

    Args:
        wheel: the wheel.
        parameters: its gains.
    """

    def __init__(self, wheel: SlidingWheel, parameters: SlipRatioParameters | None = None) -> None:
        self.wheel, self.parameters = wheel, parameters or SlipRatioParameters()
        p = self.parameters
        self._wheel = wheel.numbers()
        self._numbers = np.array([p.gain, p.sliding_gain, p.layer, p.filter_time, p.least_speed])

    def initial_state(self) -> FloatArray:
        """Return the state before the first reading."""
        return np.zeros(4)

    def step(
        self, state: FloatArray, measurement: SlipRatioMeasurement, wanted: float, dt: float, wanted_rate: float = 0.0
    ) -> tuple[FloatArray, SlipRatioOutput]:
        """Return the torque of one cycle.

        Args:
            state: after the cycle before; it is not changed.
            measurement: the wheel now.
            wanted: lambda_d [1], positive to drive forwards and negative to brake there.
            dt: measured time since the cycle before [s].
            wanted_rate: lambda_d_dot [1/s].

        Returns:
            New state and output.

        Raises:
            ControlError: a number is not finite, dt is not positive, or |wanted| is not below 1; the state stays as it was.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise ControlError(f"dt = {dt!r} s is not allowed; allowed: above 0, measured from stamps")
        if not abs(wanted) < 1.0:
            raise ControlError(f"wanted slip ratio = {wanted!r} is not allowed; allowed: above -1 and below 1")
        for name, value in (*vars(measurement).items(), ("wanted_rate", wanted_rate)):
            if not math.isfinite(value):
                raise ControlError(f"{name} = {value!r} is not allowed; allowed: a finite number")
        after, torque, ratio, s, saturated = _control(
            self._wheel, self._numbers, state, measurement.roll_rate, measurement.velocity, measurement.force, wanted,
            wanted_rate, dt,
        )  # fmt: skip
        return after, SlipRatioOutput(float(torque), float(ratio), float(s), bool(saturated))
