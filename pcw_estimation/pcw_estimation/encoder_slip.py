"""Slip from the consistency of the encoders alone, (4.1)-(4.5) [Li2009].

    p_dot = B q_dot                         sensed velocities of the wheel centres          (4.1)
    V = A^+ p_dot                           twist that fits them best                       (4.2)
    p_dot_hat = A V                         what a wheel without slip would have sensed     (4.3)
    eps_hat = p_dot - p_dot_hat = (I - A A^+) B q_dot                                       (4.4), (4.5)

The projection spreads the slip of one wheel over all, and it is blind to slip that looks like a motion of the robot.
Which wheels the others are right to mistrust is decided by `slip_procedure`, (4.6)-(4.8), and better by `slip_consensus`.

When is a wheel slipping? On a real robot with nominal geometry the residual grows with speed and steering rate without any
slip. Logs of the DYROS PCV: up to 7 mm/s at standstill; above 0.1 m/s the worst wheel has a median of 5-6 % of the speed,
with 29 to 115 mm/s in the last percentile. Hence a threshold of three terms,

    threshold = floor + speed_fraction * v + steering_length * max |phi_dot|,

v the root mean square speed of the wheel centres in the fitted motion, the same for all wheels because the projection
shares their errors among them. Steering-zero errors (0.6 to 1.5 degrees on that robot) and radius errors make the second
term, errors of the caster offset the third.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.differential_kinematics import forward_kinematics_kernel, wheel_jacobian_kernel
from pcw_description.robot_description import LONGITUDINAL, STEER, FloatArray, RobotDescription

from .errors import EstimationError, require_not_negative
from .slip_verdict import SlipFinding, Verdict


@dataclasses.dataclass(frozen=True)
class EncoderSlipParameters:
    """When a residual counts as slip; the defaults raise no alarm on the healthy real robot above.

    Attributes:
        floor: residual of a healthy robot at standstill [m/s].
        speed_fraction: residual per speed of a healthy robot: a last percentile of some 15 % [1].
        steering_length: residual per steering rate [m/s per rad/s].
        confirm_time: a residual counts as slip once it has been above the threshold for so long [s].
        ratio_speed: slip ratio and slip angle refer to at least this speed, below which they are noise [m/s].
    """

    floor: float = 0.010
    speed_fraction: float = 0.15
    steering_length: float = 0.002
    confirm_time: float = 0.010
    ratio_speed: float = 0.05

    def __post_init__(self) -> None:
        """Check the parameters.

        Raises:
            EstimationError: names the field, its value and what is allowed.
        """
        require_not_negative(self, positive=("floor", "ratio_speed"))


@dataclasses.dataclass(frozen=True)
class EncoderSlipState:
    """How long each residual has been above its threshold (n, 2) [s]; 0 while it is below."""

    time_above: FloatArray


@dataclasses.dataclass(frozen=True)
class EncoderSlipOutput:
    """What the encoders say about slip; arrays (n, 2) are longitudinal and lateral.

    Attributes:
        slip: eps_hat in the wheel frames (n, 2) [m/s].
        ratio: slip ratio (longitudinal) [1] and slip angle (lateral) [rad] (n, 2).
        twist: twist of base_link that fits all wheels best (3,).
        threshold: [m/s].
        slipping: the wheel runs ahead of its motion over the ground (n, 2).
        skidding: the wheel lags behind, as when it is braked or blocked (n, 2).
    """

    slip: FloatArray
    ratio: FloatArray
    twist: FloatArray
    threshold: float
    slipping: np.ndarray
    skidding: np.ndarray


def initial_state(robot: RobotDescription) -> EncoderSlipState:
    """Return the state before the first measurement.

    Raises:
        KinematicsError: the robot has fixed wheels, whose slip no encoder shows.
    """
    robot.require_casters_only("slip from encoders")
    return EncoderSlipState(np.zeros((robot.n, 2)))


def step(
    robot: RobotDescription,
    parameters: EncoderSlipParameters,
    state: EncoderSlipState,
    joint_position: FloatArray,
    joint_velocity: FloatArray,
    dt: float,
) -> tuple[EncoderSlipState, EncoderSlipOutput]:
    """Estimate slip from one measurement of the joints.

    Args:
        robot: the robot.
        parameters: when a residual counts as slip.
        state: state after the measurement before.
        joint_position: (n, 2) [rad].
        joint_velocity: (n, 2) [rad/s].
        dt: measured time since the measurement before [s]; 0 for the first one.

    Returns:
        New state and output.

    Raises:
        EstimationError: a measurement is not finite or dt is negative; the caller keeps its state.
    """
    if not (math.isfinite(dt) and dt >= 0.0):
        raise EstimationError(f"dt = {dt!r} s is not allowed; allowed: at least 0, measured from stamps")
    for name, values in (("joint_position", joint_position), ("joint_velocity", joint_velocity)):
        if values.shape != (robot.n, 2) or not np.isfinite(values).all():
            raise EstimationError(
                f"{name} = {values.tolist()} is not allowed; allowed: finite numbers, shape ({robot.n}, 2)"
            )
    steer_angle = np.ascontiguousarray(joint_position[:, STEER])
    twist, slip, _ = forward_kinematics_kernel(
        robot.steer_axis, robot.caster_offset, robot.wheel_radius, steer_angle, np.ascontiguousarray(joint_velocity)
    )
    fitted = (wheel_jacobian_kernel(robot.steer_axis, robot.caster_offset, steer_angle) @ twist).reshape(-1, 2)
    sensed = fitted + slip
    speed = math.sqrt(float(np.mean(np.sum(fitted**2, axis=1))))
    steering_rate = float(np.max(np.abs(joint_velocity[:, STEER])))
    threshold = parameters.floor + parameters.speed_fraction * speed + parameters.steering_length * steering_rate
    time_above = np.where(np.abs(slip) > threshold, state.time_above + dt, 0.0)
    confirmed = (np.abs(slip) > threshold) & (time_above >= parameters.confirm_time)
    # Ahead or behind is meant along the motion over the ground; of a standing robot along the wheel's own.
    direction = np.where(np.abs(fitted) > parameters.floor, np.sign(fitted), np.sign(sensed))
    output = EncoderSlipOutput(
        slip=slip,
        ratio=_slip_ratio_and_angle(fitted, sensed, slip, parameters.ratio_speed),
        twist=twist,
        threshold=threshold,
        slipping=confirmed & (slip * direction > 0.0),
        skidding=confirmed & (slip * direction < 0.0),
    )
    return EncoderSlipState(time_above), output


def _slip_ratio_and_angle(fitted: FloatArray, sensed: FloatArray, slip: FloatArray, least_speed: float) -> FloatArray:
    """Return slip ratio (3.43) and slip angle (n, 2); both referred to at least `least_speed` [m/s]."""
    along = np.maximum(np.abs(fitted[:, LONGITUDINAL]), np.abs(sensed[:, LONGITUDINAL]))
    along = np.maximum(along, least_speed)
    return np.stack([slip[:, 0] / along, np.arctan2(slip[:, 1], along)], axis=1)


class SlipProjection:
    """The same with the interface of `SlipConsensus`: (4.4) with the threshold of three terms, and no wheel left out."""

    def __init__(self, robot: RobotDescription, parameters: EncoderSlipParameters | None = None) -> None:
        self.robot, self.parameters = robot, parameters or EncoderSlipParameters()

    def initial_state(self) -> EncoderSlipState:
        """Return the state before the first measurement."""
        return initial_state(self.robot)

    def step(
        self, state: EncoderSlipState, joint_position: FloatArray, joint_velocity: FloatArray, dt: float
    ) -> tuple[EncoderSlipState, SlipFinding]:
        """See `step`; the covariance follows from the mean squared residual, as in (4.2) no wheel is left out."""
        state, output = step(self.robot, self.parameters, state, joint_position, joint_velocity, dt)
        jacobian = wheel_jacobian_kernel(
            self.robot.steer_axis, self.robot.caster_offset, np.ascontiguousarray(joint_position[:, STEER])
        )
        freedom = 2 * self.robot.n - 3
        covariance = float(np.sum(output.slip**2)) / freedom * np.linalg.inv(jacobian.T @ jacobian)
        threshold = np.full(output.slip.shape, output.threshold)
        flagged = output.slipping | output.skidding
        verdict = Verdict.SLIP if flagged.any() else Verdict.CONSISTENT
        return state, SlipFinding(
            output.twist, covariance, output.slip, output.ratio, threshold, np.abs(output.slip) > threshold, output.slipping,
            output.skidding, verdict,
        )
