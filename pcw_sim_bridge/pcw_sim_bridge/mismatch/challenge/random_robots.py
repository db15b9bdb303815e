"""Robots for the challenge: the shipped ones, and others drawn around them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from pcw_control.motion_range import MotionRange
from pcw_description.errors import PcwError
from pcw_description.robot_description import Caster, ImuDescription, RobotDescription, TrackerDescription
from pcw_description.robot_file import load_robot

SHIPPED = ("thesis", "tidybot2", "xr4000", "dyros_pcv", "flow_base")
CASTER_COUNTS, CASTER_SHARES = (3, 4, 5), (0.2, 0.6, 0.2)
IMU_SHARE, TRACKER_SHARE = 0.85, 0.9
# A robot that cannot be driven faster than this shows nothing.
SLOWEST_TURNING = 0.1  # [m/s]


def draw_robot(rng: np.random.Generator, needs_imu: bool = False) -> RobotDescription:
    """Draw a shipped robot, or one between and around them.

    Args:
        rng: source of the draw.
        needs_imu: only a robot with an inertial sensor will do.
    """
    if rng.random() < 0.5:
        robots = [load_robot(name) for name in SHIPPED]
        fitting = [robot for robot in robots if robot.sensors.imu is not None or not needs_imu]
        return fitting[int(rng.integers(len(fitting)))]
    for _ in range(100):
        try:
            robot = _random_robot(rng, needs_imu)
            if MotionRange.of_robot(robot).turning_speed > SLOWEST_TURNING:
                return robot
        except PcwError:
            continue  # proportions that no robot has
    raise RuntimeError("no robot could be drawn; the ranges of random_robots leave none")


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(math.exp(rng.uniform(math.log(low), math.log(high))))


def _random_robot(rng: np.random.Generator, needs_imu: bool) -> RobotDescription:
    base = load_robot(SHIPPED[int(rng.integers(len(SHIPPED)))])
    length, mass = _log_uniform(rng, 0.75, 1.4), _log_uniform(rng, 0.6, 1.7)
    radius, offset, module = _log_uniform(rng, 0.8, 1.25), _log_uniform(rng, 0.85, 1.4), _log_uniform(rng, 0.8, 1.3)
    chassis = base.chassis
    size = (chassis.size[0] * length, chassis.size[1] * length, chassis.size[2])
    com = (chassis.com[0] + length * float(rng.normal(0.0, 0.01)), chassis.com[1] + length * float(rng.normal(0.0, 0.01)),
           chassis.com[2] * _log_uniform(rng, 0.8, 1.2))
    changed = dataclasses.replace(
        chassis, mass=chassis.mass * mass, inertia_zz=chassis.inertia_zz * mass * length**2, com=com, size=size,
        inertia_xx=None, inertia_yy=None,
    )

    def scaled(caster: Caster) -> Caster:
        torque = max(1.0, mass * length * radius)
        return dataclasses.replace(
            caster,
            caster_offset=(caster.caster_offset[0] * offset, caster.caster_offset[1] * offset),
            wheel_radius=caster.wheel_radius * radius,
            module=dataclasses.replace(
                caster.module, mass=caster.module.mass * module, inertia_zz=caster.module.inertia_zz * module * radius**2
            ),
            wheel=dataclasses.replace(
                caster.wheel, mass=caster.wheel.mass * module, inertia_axle=caster.wheel.inertia_axle * module * radius**2
            ),
            limits=dataclasses.replace(
                caster.limits, drive_torque=caster.limits.drive_torque * torque,
                steer_torque=caster.limits.steer_torque * torque,
            ),
        )

    mu_p, slip = rng.uniform(0.6, 1.0), _log_uniform(rng, 0.7, 1.4)
    lateral = dataclasses.replace(base.contact.lateral, mu_p=float(mu_p), lambda_p=base.contact.lateral.lambda_p * slip)
    contact = dataclasses.replace(base.contact, mu_p=float(mu_p), lambda_p=base.contact.lambda_p * slip, lateral=lateral)
    imu = ImuDescription(
        (float(rng.uniform(-0.1, 0.1)), float(rng.uniform(-0.1, 0.1)), 0.2), float(rng.choice([100.0, 200.0])), 0.002, 0.02
    )
    tracker = base.sensors.tracker or TrackerDescription(100.0, 0.0005, 0.0005)
    sensors = dataclasses.replace(
        base.sensors,
        imu=imu if needs_imu or rng.random() < IMU_SHARE else None,
        tracker=tracker if rng.random() < TRACKER_SHARE else None,
    )
    return dataclasses.replace(
        base,
        name=f"between_{base.name}",
        provenance={"all": f"drawn at random around {base.name}"},
        chassis=changed,
        casters=tuple(scaled(caster) for caster in _layout(base, length, rng)),
        contact=contact,
        sensors=sensors,
        suspension=None,
    )


def _layout(base: RobotDescription, length: float, rng: np.random.Generator) -> tuple[Caster, ...]:
    """Casters of one make at other places: where the base robot has them, or on a polygon of another number."""
    count = int(rng.choice(CASTER_COUNTS, p=CASTER_SHARES))
    if count == base.n:
        places = length * base.steer_axis * rng.uniform(0.95, 1.05, (base.n, 2))
        names = base.caster_names
    else:
        reach = length * float(np.mean(np.linalg.norm(base.steer_axis, axis=1)))
        angle = math.pi / count + 2.0 * math.pi * np.arange(count) / count
        places = reach * np.column_stack([np.cos(angle), np.sin(angle)])
        names = tuple(f"wheel_{i + 1}" for i in range(count))
    return tuple(
        dataclasses.replace(base.casters[0], name=name, steer_axis=(float(x), float(y)))
        for name, (x, y) in zip(names, places, strict=True)
    )
