"""Sliding-mode observers of one wheel: its velocity over the ground from its own motor and encoder, (4.13)-(4.15) [Li2009].

    I_rho rho_ddot = tau_rho - r F_x,      M v_x_dot = F_x,      F_x = mu(lambda) F_z

The observer as printed corrects v_x_hat by the error of rho_dot, through the slope of mu. That slope changes its sign at
lambda_p: past the peak the correction drives v_x_hat away from v_x, and at the peak there is none. Here the two halves are
apart. The sliding mode (`joint_sliding_mode`) finds the force, which needs no friction curve:

    F_m = (I_rho / r) a_load_hat

and the velocity follows from the force, drawn to the lower root of mu(lambda) = F_m / F_z as far as that can be trusted
(`low_root_trust`):

    v_x_hat_dot = F_m / M + k w (r rho_dot_hat (1 - lambda_low(F_m / F_z)) - v_x_hat),      0 <= w <= 1.

While w is 1 the mass that explains the acceleration is learned within its tolerance; it serves while w is 0. What cannot be
known from these signals is a common scale: r, v_x, 1/F, M/r^2 may all be wrong together, and an error of the radius is an
error of the velocity by the same part.

A wheel that has already broken loose when the observer begins is on the upper root; no velocity is vouched for until it grips.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.contact.contact_model import LAMBDA, MU, friction_coefficient, slip_of_force
from pcw_description.robot_description import FloatArray

from .errors import EstimationError, require, require_dt
from .joint_sliding_mode import from_angle, from_speed
from .low_root_trust import (
    EXPLAINED_FLOOR,
    EXPLAINED_SHARE,
    MASS_TOLERANCE,
    TRUST_SIZE,
    corrected_bound,
    grown_bound,
    root_error,
    share_corrected,
    trust_of_root,
    velocity_of_slip,
)
from .slip_estimate import WheelEstimate, WheelMeasurement, WheelModel, ratio_of

MEASURED = ("speed", "angle")
# A learned mass forgets over this time [s], and begins to count from this much squared acceleration [m^2/s^3].
LEARNING_MEMORY, LEARNING_PRIOR = 2.0, 0.5
# Beyond twice the tolerance of the mass and this much, forces and accelerations contradict each other (logarithm).
CONTRADICTION_FLOOR = 0.05
# Slip acceleration is averaged over this time [s]: noise and a controller's ripple are no slip.
SLIP_ACCELERATION_MEMORY = 0.01
# Forces are looked at after so many time constants of the joint observers, by speed or angle, and vouched for after so many.
FOUND_BY_SPEED, FOUND_BY_ANGLE = 3.0, 5.0
SETTLED_TIME_CONSTANTS = 5.0

# Layout of the numbers of the observer; those of trust come first.
BANDWIDTH, LAYER, LINEAR_SHARE, ANGLE_ONLY, ACCURACY, ACCURACY_FLOOR = range(TRUST_SIZE, TRUST_SIZE + 6)
_INERTIA, _RADIUS, _MASS, _NORMAL_FORCE = range(4)
# Layout of the state.
_COUNT, _TIME, _ANGLE, _SPEED, _LOAD, _VELOCITY, _BOUND, _QUIET = range(8)
_WEIGHT, _LEARNED_MM, _LEARNED_MA, _ERROR, _RUNS_AWAY, _LATE, _TORQUE = range(8, 15)
_STATE = 15


@dataclasses.dataclass(frozen=True)
class SlidingModeParameters:
    """Gains and tolerances of the sliding-mode observers, of one wheel and of a robot.

    Attributes:
        measured: "speed" (4.14) or "angle" (4.15).
        bandwidth: of the joint observers within their layer [rad/s]; None: 300 for speed, 200 for angle.
        layer: half width of the boundary layer, in [rad/s] for speed and [rad] for angle; None: 1.0 and 0.01.
        linear_share: share of the joint observers' gain that grows beyond the layer, in [0.2, 1].
        correction_rate: k, at which a conflict is corrected at full trust [1/s].
        full_trust_use, no_trust_use: use of friction up to which the lower root is trusted fully, and from which not at all.
        slip_acceleration, slip_acceleration_share: of a wheel that grips, constant [m/s^2] and per acceleration [1].
        conflict_floor, conflict_share: error of a trusted root, constant [m/s] and per speed [1]: radius and friction curve.
        recapture_time: after which a quiet root in conflict is believed [s].
        mass_tolerance: error of the mass, relative [1].
        accuracy, accuracy_floor: a velocity is valid while its bound is below accuracy times speed plus the floor [1], [m/s].
    """

    measured: str = "speed"
    bandwidth: float | None = None
    layer: float | None = None
    linear_share: float = 0.5
    correction_rate: float = 80.0
    full_trust_use: float = 0.6
    no_trust_use: float = 0.85
    slip_acceleration: float = 0.6
    slip_acceleration_share: float = 0.25
    conflict_floor: float = 0.01
    conflict_share: float = 0.03
    recapture_time: float = 0.15
    mass_tolerance: float = 0.1
    accuracy: float = 0.1
    accuracy_floor: float = 0.03

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            EstimationError: names the field, its value and what is allowed.
        """
        if self.measured not in MEASURED:
            raise EstimationError(f"measured = {self.measured!r} is not allowed; allowed: {', '.join(MEASURED)}")
        for name in ("bandwidth", "layer"):
            if getattr(self, name) is not None:
                require(name, getattr(self, name), above=0.0)
        require("linear_share", self.linear_share, minimum=0.2, maximum=1.0)
        require("full_trust_use", self.full_trust_use, above=0.0, maximum=0.94)
        require("no_trust_use", self.no_trust_use, above=self.full_trust_use, maximum=0.95)
        require("mass_tolerance", self.mass_tolerance, minimum=0.0, maximum=0.5)
        for name in ("correction_rate", "slip_acceleration", "conflict_floor", "recapture_time", "accuracy", "accuracy_floor"):
            require(name, getattr(self, name), above=0.0)
        for name in ("slip_acceleration_share", "conflict_share"):
            require(name, getattr(self, name), minimum=0.0, maximum=10.0)

    def numbers(self) -> FloatArray:
        """Return the parameters as the kernels take them."""
        by_angle = self.measured == "angle"
        bandwidth = self.bandwidth if self.bandwidth is not None else (200.0 if by_angle else 300.0)
        layer = self.layer if self.layer is not None else (0.01 if by_angle else 1.0)
        return np.array(
            [
                self.correction_rate,
                self.full_trust_use,
                self.no_trust_use,
                self.slip_acceleration,
                self.slip_acceleration_share,
                self.conflict_floor,
                self.conflict_share,
                self.recapture_time,
                self.mass_tolerance,
                bandwidth,
                layer,
                self.linear_share,
                float(by_angle),
                self.accuracy,
                self.accuracy_floor,
            ]
        )


@compiled
def follow_joint(numbers, count, joint, torque_acceleration, angle, speed, dt):  # type: ignore[no-untyped-def]
    """Advance joint (3,), of angle, speed and load acceleration, in place; returns the sliding variable.

    The first reading is taken as it is, the load as that of steady motion; by angle alone the second one gives the speed.
    """
    by_angle = numbers[ANGLE_ONLY] > 0.0
    if count == 0:
        joint[0], joint[1], joint[2] = angle, 0.0 if by_angle else speed, torque_acceleration
        return 0.0
    if by_angle and count == 1:
        joint[0], joint[1], joint[2] = angle, (angle - joint[0]) / dt, torque_acceleration
        return 0.0
    bandwidth, layer, linear_share = numbers[BANDWIDTH], numbers[LAYER], numbers[LINEAR_SHARE]
    if by_angle:
        joint[0], joint[1], joint[2], error = from_angle(
            joint[0], joint[1], joint[2], torque_acceleration, angle, dt, bandwidth, layer, linear_share
        )
    else:
        joint[0] = angle
        joint[1], joint[2], error = from_speed(
            joint[1], joint[2], torque_acceleration, speed, dt, bandwidth, layer, linear_share
        )
    return error


@compiled
def forces_found(numbers, time):  # type: ignore[no-untyped-def]
    """Return whether the injection has had the time to find the forces."""
    return time * numbers[BANDWIDTH] >= (FOUND_BY_ANGLE if numbers[ANGLE_ONLY] > 0.0 else FOUND_BY_SPEED)


@compiled
def load_share(inertia, radius, mass):  # type: ignore[no-untyped-def]
    """Return the part of a wheel's torque that the ground takes while it rolls along with its mass [1]."""
    carried = mass * radius * radius
    return carried / (carried + inertia)


@compiled
def load_that_follows(load, change, most):  # type: ignore[no-untyped-def]
    """Return a load after a change of torque [rad/s^2]; the ground takes no more than its peak."""
    changed = load + change
    if abs(changed) > most and abs(changed) > abs(load):
        return math.copysign(max(most, abs(load)), changed)
    return changed


@compiled
def late_load(numbers, before, load, dt):  # type: ignore[no-untyped-def]
    """Return by how much a load that goes on changing like this is found late [rad/s^2]: two or three time constants."""
    return (3.0 if numbers[ANGLE_ONLY] > 0.0 else 2.0) / numbers[BANDWIDTH] * abs(load - before) / dt


@compiled
def learned_mass_ratio(tolerance, model_squared, model_times_seen):  # type: ignore[no-untyped-def]
    """Return true over nominal mass [1], within its tolerance, from sums of accelerations by forces and as seen."""
    ratio = (model_squared + LEARNING_PRIOR) / max(model_times_seen + LEARNING_PRIOR, 1e-9)
    return min(max(ratio, 1.0 - tolerance), 1.0 + tolerance)


@compiled
def mass_contradicted(tolerance, model_squared, model_times_seen):  # type: ignore[no-untyped-def]
    """Return whether forces and accelerations are further apart than any mass within its tolerance explains.

    Either the description does not match the robot, or the wheels are on the upper root and stay there: a wheel held at a slip
    ratio runs away from its robot by the factor 1 / (1 - lambda).
    """
    ratio = (model_squared + LEARNING_PRIOR) / max(model_times_seen + LEARNING_PRIOR, 1e-9)
    return model_squared > LEARNING_PRIOR and abs(math.log(ratio)) > 2.0 * tolerance + CONTRADICTION_FLOOR


@compiled
def _advance(wheel, tyre, numbers, state, angle, speed, torque, dt):  # type: ignore[no-untyped-def]
    """Advance the state (_STATE,) in place; returns r rho_dot [m/s] and F_m [N]."""
    inertia, radius, mass, normal_force = wheel[_INERTIA], wheel[_RADIUS], wheel[_MASS], wheel[_NORMAL_FORCE]
    count = state[_COUNT]
    torque_acceleration = torque / inertia
    # While the wheel grips its load follows its torque at once; what is left for the injection to find is slow.
    change = load_share(inertia, radius, mass) * state[_WEIGHT] * (torque_acceleration - state[_TORQUE])
    state[_LOAD] = load_that_follows(state[_LOAD], change, radius * tyre[MU] * normal_force / inertia)
    state[_TORQUE] = torque_acceleration
    load_before = state[_LOAD]
    state[_ERROR] = follow_joint(numbers, count, state[_ANGLE : _LOAD + 1], torque_acceleration, angle, speed, dt)
    rolling = radius * state[_SPEED]
    force = inertia * state[_LOAD] / radius
    state[_COUNT] = count + 1.0
    state[_TIME] += dt
    by_angle = numbers[ANGLE_ONLY] > 0.0
    if count == 0.0 or (by_angle and count == 1.0):
        # Nothing is known yet but that a driven wheel does not push the ground backwards.
        state[_BOUND] = max(abs(rolling - state[_VELOCITY]), abs(rolling))
        return rolling, force
    tolerance = numbers[MASS_TOLERANCE]
    acceleration = force / (mass * learned_mass_ratio(tolerance, state[_LEARNED_MM], state[_LEARNED_MA]))
    velocity = state[_VELOCITY] + dt * acceleration
    rolling_acceleration = radius * (torque_acceleration - state[_LOAD])
    per_acceleration = inertia / (radius * mass)
    bound = grown_bound(
        numbers, state[_BOUND], acceleration, per_acceleration * rolling_acceleration / radius, dt
    )
    # Forces that change are found late. That is told, but is no reason to believe another root.
    state[_LATE] += dt * per_acceleration * late_load(numbers, load_before, state[_LOAD], dt)
    slip, _ = slip_of_force(tyre, force, 0.0, normal_force)
    root = velocity_of_slip(rolling, slip)
    reference = max(abs(rolling), abs(velocity), 1e-6)
    carried, _ = friction_coefficient(tyre, (rolling - velocity) / reference, 0.0)
    peak = tyre[MU] * normal_force
    explained = abs(carried * normal_force - force) <= EXPLAINED_SHARE * abs(force) + EXPLAINED_FLOOR * peak
    # Forces that are not found yet say nothing of grip: until then every reading begins anew.
    found = forces_found(numbers, state[_TIME])
    averaged = 1.0 - math.exp(-dt / SLIP_ACCELERATION_MEMORY) if found else 1.0
    state[_RUNS_AWAY] += averaged * (rolling_acceleration - acceleration - state[_RUNS_AWAY])
    error_of_root, fade = root_error(numbers, abs(force) / peak, tyre[LAMBDA], reference)
    trust, state[_QUIET] = trust_of_root(
        numbers, fade, error_of_root, state[_RUNS_AWAY], acceleration, root - velocity, bound, explained,
        state[_QUIET], dt,
    )  # fmt: skip
    trust = trust if found else 0.0
    share = share_corrected(numbers, trust, dt)
    velocity += share * (root - velocity)
    state[_LATE] *= 1.0 - share
    if trust > 0.0:
        bound = corrected_bound(max(bound, abs(root - velocity)), share, error_of_root)
    decay = math.exp(-dt / LEARNING_MEMORY)
    state[_LEARNED_MM] *= decay
    state[_LEARNED_MA] *= decay
    if fade == 1.0 and trust == 1.0 and bound <= 2.0 * error_of_root:
        nominal = force / mass
        state[_LEARNED_MM] += dt * nominal * nominal
        state[_LEARNED_MA] += dt * nominal * rolling_acceleration * (1.0 - abs(slip))
    state[_VELOCITY], state[_BOUND], state[_WEIGHT] = velocity, bound, trust
    return rolling, force


@compiled
def _run(wheel, tyre, numbers, state, angle, speed, torque, dt, velocity, force, bound):  # type: ignore[no-untyped-def]
    for k in range(len(angle)):
        _, force[k] = _advance(wheel, tyre, numbers, state, angle[k], speed[k], torque[k], dt)
        velocity[k], bound[k] = state[_VELOCITY], state[_BOUND] + state[_LATE]


class SlidingModeObserver:
    """The observer of one wheel; see the module's docstring.

    Args:
        wheel: the wheel.
        parameters: gains and tolerances; `measured` says which version it is.
    """

    def __init__(self, wheel: WheelModel, parameters: SlidingModeParameters | None = None) -> None:
        self.wheel, self.parameters = wheel, parameters or SlidingModeParameters()
        self._wheel = np.array([wheel.inertia, wheel.radius, wheel.mass, wheel.normal_force])
        self._tyre, self._numbers = wheel.tyre(), self.parameters.numbers()

    def initial_state(self, velocity: float = 0.0) -> FloatArray:
        """Return the state before the first reading, with a guess of the velocity [m/s]."""
        state = np.zeros(_STATE)
        state[_VELOCITY] = velocity
        return state

    def step(self, state: FloatArray, measurement: WheelMeasurement, dt: float) -> tuple[FloatArray, WheelEstimate]:
        """Take one reading.

        Args:
            state: after the reading before; it is not changed.
            measurement: what is not measured by this version may be NaN.
            dt: measured time since the reading before [s]; of the first one any.

        Returns:
            New state and estimate.

        Raises:
            EstimationError: a reading that is needed is not finite, or dt is not positive; the caller keeps its state.
        """
        require_dt(dt)
        by_angle = self.parameters.measured == "angle"
        require("roll_angle" if by_angle else "roll_rate", measurement.roll_angle if by_angle else measurement.roll_rate)
        require("drive_torque", measurement.drive_torque)
        state = state.copy()
        rolling, force = _advance(
            self._wheel, self._tyre, self._numbers, state, measurement.roll_angle, measurement.roll_rate,
            measurement.drive_torque, dt,
        )  # fmt: skip
        velocity, bound, numbers = float(state[_VELOCITY]), float(state[_BOUND] + state[_LATE]), self._numbers
        speed = max(abs(velocity), abs(rolling))
        settled = bool(
            state[_TIME] > SETTLED_TIME_CONSTANTS / numbers[BANDWIDTH] and abs(state[_ERROR]) <= numbers[LAYER]
        )
        contradicted = mass_contradicted(numbers[MASS_TOLERANCE], state[_LEARNED_MM], state[_LEARNED_MA])
        valid = bool(settled and not contradicted and bound <= numbers[ACCURACY] * speed + numbers[ACCURACY_FLOOR])
        ratio = ratio_of(rolling, velocity)
        estimate = WheelEstimate(velocity, float(state[_SPEED]), ratio, float(force), bound, valid, valid, settled)
        return state, estimate

    def run(
        self, roll_angle: FloatArray, roll_rate: FloatArray, drive_torque: FloatArray, dt: float, velocity: float = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Take a whole record (T,) at a constant step, compiled.

        Returns:
            Velocity [m/s], force [N] and bound [m/s], each (T,).
        """
        require_dt(dt)
        results = np.empty((3, len(roll_angle)))
        _run(
            self._wheel, self._tyre, self._numbers, self.initial_state(velocity), roll_angle, roll_rate, drive_torque, dt,
            results[0], results[1], results[2],
        )  # fmt: skip
        return results[0], results[1], results[2]
