"""Drawn robots on drawn drives: what encoders and IMU read of a motion that is known, slip included, from a seed.

Kinematics only: a chassis that moves as asked, wheels that roll or slip as asked, and headings that follow from both. What a
plant with tyres makes of slip is studied where the plants are, in pcw_sim_bridge.

    b_x phi_dot = -(n . v_p + slip_lateral),      r rho_dot = u . v_p + slip_longitudinal - b_y phi_dot

with v_p the velocity of the chassis at the wheel centre. The headings are integrated by the classical Runge-Kutta method.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_description.compiled import compiled
from pcw_description.robot_description import (
    GRAVITY,
    Caster,
    ImuDescription,
    RobotDescription,
    thinnest_module_inertia,
)
from pcw_description.robot_file import load_robot

from ..errors import EstimationError

FloatArray = np.ndarray
STEP = 1e-3  # of the simulation, and the period of the IMU [s]


@dataclasses.dataclass(frozen=True)
class Drive:
    """What was driven and what was read.

    Attributes:
        robot: as its file describes it.
        stamp: of the joint readings (T,) [s].
        position, velocity: joint readings (T, n, 2).
        imu_stamp: (S,) [s].
        gyro: (S,) [rad/s], about z.
        accelerometer: (S, 2) [m/s^2], x and y.
        pose: true pose at the joint readings (T, 3).
        twist: true twist at the joint readings (T, 3).
        slip: true slip at the joint readings (T, n, 2) [m/s].
    """

    robot: RobotDescription
    stamp: FloatArray
    position: FloatArray
    velocity: FloatArray
    imu_stamp: FloatArray
    gyro: FloatArray
    accelerometer: FloatArray
    pose: FloatArray
    twist: FloatArray
    slip: FloatArray


def drawn_robot(rng: np.random.Generator, n: int) -> RobotDescription:
    """Return a robot of n casters of drawn size, with the sensors and tolerances of the thesis robot and an IMU of 1 kHz."""
    base = load_robot("thesis")
    reach = rng.uniform(0.18, 0.40)
    turned = rng.uniform(-math.pi, math.pi)
    radius, offset = rng.uniform(0.04, 0.10), -rng.uniform(0.015, 0.040)
    side = 0.0 if rng.random() < 0.5 else rng.uniform(-0.005, 0.005)
    casters = []
    for i in range(n):
        angle = turned + 2.0 * math.pi * (i + rng.uniform(-0.15, 0.15)) / n
        distance = reach * rng.uniform(0.8, 1.2)
        casters.append(_caster(base.casters[0], f"caster_{i}", (distance * math.cos(angle), distance * math.sin(angle)),
                               (offset, side), radius))
    # A chassis that such casters carry; nothing here depends on its masses.
    chassis = dataclasses.replace(base.chassis, size=(2.0 * reach, 2.0 * reach, 0.3), inertia_zz=4.2)
    imu = ImuDescription((rng.uniform(-0.1, 0.1), rng.uniform(-0.1, 0.1), 0.2), 1.0 / STEP, 0.002, 0.02)
    sensors = dataclasses.replace(base.sensors, imu=imu)
    return dataclasses.replace(
        base, name=f"drawn_{n}", casters=tuple(casters), chassis=chassis, sensors=sensors
    )


def _caster(
    base: Caster, name: str, axis: tuple[float, float], offset: tuple[float, float], radius: float
) -> Caster:
    wheel = dataclasses.replace(base.wheel, inertia_axle=0.5 * base.wheel.mass * radius**2)
    caster = dataclasses.replace(
        base, name=name, steer_axis=axis, caster_offset=offset, wheel_radius=radius, wheel=wheel,
        module=dataclasses.replace(base.module, com=(0.4 * offset[0], 0.4 * offset[1])),
    )
    inertia = 1.5 * thinnest_module_inertia(caster) + 1e-3
    return dataclasses.replace(caster, module=dataclasses.replace(caster.module, inertia_zz=inertia))


def as_built(robot: RobotDescription, rng: np.random.Generator) -> tuple[RobotDescription, FloatArray]:
    """Return a healthy robot that differs from its file by its tolerances, and the errors of its steering zeros (n,) [rad]."""

    def drawn(name: str, nominal: float) -> float:
        tolerance = robot.tolerance(name)
        return float(rng.normal(0.0, tolerance.value * (abs(nominal) if tolerance.relative else 1.0)))

    casters = []
    for caster in robot.casters:
        (x, y), (bx, by) = caster.steer_axis, caster.caster_offset
        casters.append(
            dataclasses.replace(
                caster,
                steer_axis=(x + drawn("steer_axis", x), y + drawn("steer_axis", y)),
                caster_offset=(bx + drawn("caster_offset", bx), by + drawn("caster_offset", by)),
                wheel_radius=caster.wheel_radius + drawn("wheel_radius", caster.wheel_radius),
            )
        )
    zero = np.array([drawn("steer_zero", 1.0) for _ in range(robot.n)])
    return dataclasses.replace(robot, casters=tuple(casters)), zero


@dataclasses.dataclass(frozen=True)
class DriveStyle:
    """How a drive is drawn.

    Attributes:
        speed: largest speed [m/s].
        turning: largest turning rate [rad/s].
        acceleration: [m/s^2]; turning accelerates by as much at 0.4 m.
        hold: shortest and longest time between two changes [s].
        rest: standstill at the beginning [s].
    """

    speed: float = 1.0
    turning: float = 0.8
    acceleration: float = 1.0
    hold: tuple[float, float] = (0.5, 2.5)
    rest: float = 0.3


def drawn_twist(rng: np.random.Generator, duration: float, style: DriveStyle) -> FloatArray:
    """Return a drawn twist of base_link for every step (S, 3): changes of direction, reversals, turns and stops."""
    steps = round(duration / STEP)
    wanted = np.zeros((steps, 3))
    time = style.rest
    while time < duration:
        kind = rng.random()
        direction, speed = rng.uniform(-math.pi, math.pi), style.speed * math.sqrt(rng.uniform(0.02, 1.0))
        turning = rng.uniform(-1.0, 1.0) * style.turning
        start = round(time / STEP)
        if kind < 0.15 and start > 0:  # reversal: the wheels flip
            target = -wanted[start - 1]
        elif kind < 0.25:
            target = np.array([0.0, 0.0, turning])
        elif kind < 0.32:
            target = np.zeros(3)
        else:
            target = np.array([speed * math.cos(direction), speed * math.sin(direction), turning * (rng.random() < 0.6)])
        wanted[start:] = target
        time += rng.uniform(*style.hold)
    return _followed(wanted, np.array([style.acceleration, style.acceleration, style.acceleration / 0.4]))


@compiled
def _followed(wanted, acceleration):  # type: ignore[no-untyped-def]
    """Return a twist (S, 3) that follows another one with bounded acceleration and a lag of 50 ms."""
    steps = len(wanted)
    twist, speed = np.empty((steps, 3)), np.zeros(3)
    for k in range(steps):
        for i in range(3):
            rate = (wanted[k, i] - speed[i]) / 0.05
            speed[i] += STEP * min(max(rate, -acceleration[i]), acceleration[i])
            twist[k, i] = speed[i]
    return twist


def drive(
    robot: RobotDescription,
    twist: FloatArray,
    slip: FloatArray,
    rng: np.random.Generator,
    *,
    built: tuple[RobotDescription, FloatArray] | None = None,
    velocity_source: str = "drive",
    imu_bias: bool = True,
) -> Drive:
    """Return what the sensors of a robot read on a drive.

    Args:
        robot: the robot as its file describes it.
        twist: true twist of base_link for every step (S, 3).
        slip: slip of each wheel for every step (S, n, 2) [m/s].
        rng: of noise, tolerances and the first headings.
        built: the robot as it is, with the errors of its steering zeros; default: drawn by its tolerances.
        velocity_source: "drive": true speed with `velocity_noise`; "difference": of two encoder readings, with the same.
        imu_bias: draw the errors of IMU, its clock and the floor by the tolerances; else it only has noise.

    Raises:
        EstimationError: the encoders' rate is not a whole part of 1 kHz.
    """
    every = round(1.0 / (robot.sensors.encoders.rate * STEP))
    if abs(every * STEP * robot.sensors.encoders.rate - 1.0) > 1e-9:
        rate = robot.sensors.encoders.rate
        raise EstimationError(f"sensors.encoders.rate = {rate!r} is not allowed here; allowed: a whole part of 1000 Hz")
    true_robot, zero = built if built is not None else as_built(robot, rng)
    start = rng.uniform(-math.pi, math.pi, robot.n)
    position, velocity, pose = _rolled(
        true_robot.steer_axis, true_robot.caster_offset, true_robot.wheel_radius, start, twist, slip
    )
    position[:, :, 1] += zero
    chosen = slice(0, None, every)
    stamp = STEP * np.arange(len(twist))[chosen]
    encoders = robot.sensors.encoders
    per_radian = np.array([encoders.drive_counts, encoders.steer_counts]) / math.tau
    counts = np.round(np.einsum("nij,tnj->tni", robot.gear_matrix, position[chosen]) * per_radian)
    read = np.einsum("nij,tnj->tni", np.linalg.inv(robot.gear_matrix), counts / per_radian)
    speed = velocity[chosen].copy()
    if velocity_source == "difference":
        speed[1:] = np.diff(read, axis=0) / (every * STEP)
        speed[0] = 0.0
    speed += rng.normal(0.0, encoders.velocity_noise, speed.shape) if encoders.velocity_noise else 0.0
    gyro, accelerometer = _imu(robot, twist, pose[:, 2], rng, imu_bias)
    return Drive(
        robot, stamp, read, speed, STEP * np.arange(len(twist)), gyro, accelerometer, pose[chosen], twist[chosen], slip[chosen]
    )


def _imu(
    robot: RobotDescription, twist: FloatArray, yaw: FloatArray, rng: np.random.Generator, biased: bool
) -> tuple[FloatArray, FloatArray]:
    imu = robot.sensors.imu
    assert imu is not None
    error = (lambda name: rng.normal(0.0, robot.tolerance(name).value)) if biased else (lambda name: 0.0)
    # Its clock is not the joints', and the floor is not quite level.
    time = STEP * np.arange(len(twist))
    late = error("clock.offset")
    twist = np.stack([np.interp(time - late, time, column) for column in twist.T], axis=1)
    tilt_x, tilt_y = GRAVITY * error("ground.slope"), GRAVITY * error("ground.slope")
    tilt = np.stack([np.cos(yaw) * tilt_x + np.sin(yaw) * tilt_y, np.cos(yaw) * tilt_y - np.sin(yaw) * tilt_x], axis=1)
    x, y = imu.position[0] + error("imu.position"), imu.position[1] + error("imu.position")
    vx, vy, omega = twist.T
    at_imu = np.stack([vx - omega * y, vy + omega * x], axis=1)
    acceleration = np.gradient(at_imu, STEP, axis=0) + omega[:, None] * np.stack([-at_imu[:, 1], at_imu[:, 0]], axis=1)
    gyro = omega * (1.0 + error("imu.scale")) + error("imu.gyro_bias") + rng.normal(0.0, imu.gyro_noise, len(twist))
    bias = np.array([error("imu.accelerometer_bias"), error("imu.accelerometer_bias")])
    noise = rng.normal(0.0, imu.accelerometer_noise, acceleration.shape)
    return gyro, (acceleration + tilt) * (1.0 + error("imu.scale")) + bias + noise


@compiled
def _rates(steer_axis, caster_offset, wheel_radius, heading, twist, slip, rates):  # type: ignore[no-untyped-def]
    """Write the joint rates (n, 2) of wheels that slip."""
    for i in range(len(heading)):
        c, s = math.cos(heading[i]), math.sin(heading[i])
        bx, by = caster_offset[i, 0], caster_offset[i, 1]
        px = steer_axis[i, 0] + bx * c - by * s
        py = steer_axis[i, 1] + bx * s + by * c
        vx, vy = twist[0] - twist[2] * py, twist[1] + twist[2] * px
        rates[i, 1] = -(-s * vx + c * vy + slip[i, 1]) / bx
        rates[i, 0] = (c * vx + s * vy + slip[i, 0] - by * rates[i, 1]) / wheel_radius[i]


@compiled
def _rolled(steer_axis, caster_offset, wheel_radius, start, twist, slip):  # type: ignore[no-untyped-def]
    """Return joint angles and rates (S, n, 2) and the pose (S, 3) of a drive."""
    steps, n = len(twist), len(start)
    position, velocity, pose = np.zeros((steps, n, 2)), np.zeros((steps, n, 2)), np.zeros((steps, 3))
    k1, k2, k3, k4 = np.empty((n, 2)), np.empty((n, 2)), np.empty((n, 2)), np.empty((n, 2))
    position[0, :, 1] = start
    for k in range(steps):
        now = position[k]
        _rates(steer_axis, caster_offset, wheel_radius, now[:, 1], twist[k], slip[k], k1)
        velocity[k] = k1
        if k + 1 == steps:
            break
        middle, middle_slip = 0.5 * (twist[k] + twist[k + 1]), 0.5 * (slip[k] + slip[k + 1])
        _rates(steer_axis, caster_offset, wheel_radius, now[:, 1] + 0.5 * STEP * k1[:, 1], middle, middle_slip, k2)
        _rates(steer_axis, caster_offset, wheel_radius, now[:, 1] + 0.5 * STEP * k2[:, 1], middle, middle_slip, k3)
        _rates(steer_axis, caster_offset, wheel_radius, now[:, 1] + STEP * k3[:, 1], twist[k + 1], slip[k + 1], k4)
        position[k + 1] = now + STEP / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        yaw = pose[k, 2] + 0.5 * STEP * middle[2]
        c, s = math.cos(yaw), math.sin(yaw)
        pose[k + 1, 0] = pose[k, 0] + STEP * (c * middle[0] - s * middle[1])
        pose[k + 1, 1] = pose[k, 1] + STEP * (s * middle[0] + c * middle[1])
        pose[k + 1, 2] = pose[k, 2] + STEP * middle[2]
    return position, velocity, pose
