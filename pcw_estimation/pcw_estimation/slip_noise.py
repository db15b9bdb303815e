"""How far the sensed velocities of a healthy robot's wheel centres lie from any motion of a rigid body.

Of a sensed velocity w = B q_dot (4.1), with its longitudinal and lateral component in the frame of the wheel, the variance is

    longitudinal:  (r drive_noise)^2    + (rolling_fraction |w|)^2 + s^2
    lateral:       (b_x steer_noise)^2  + (lateral_fraction |w|)^2 + s^2
    s^2 = (steering_length phi_dot)^2 + (heading_delay phi_dot |w|)^2 + (turning_length omega)^2

The first terms are noise and quantisation of the encoders. The second are errors of radius and steering zero and the creep
of a tyre that transmits a force; the third are errors of the caster offset, of the time at which the heading was read, and of
the places of the steering axes. They grow with speed, steering rate and turning rate; that is why no fixed threshold works.

Before anything was measured the numbers follow from `sensors` and `tolerances` of the robot file (`of_robot`); after a drive
known to be healthy they are learned (`calibrate_slip`).
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pcw_description.compiled import compiled
from pcw_description.errors import nearest_name
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription

from .errors import EstimationError

FORMAT = "pcw_slip_noise/1"
# A velocity that is known better than this is none that an encoder gives [m/s].
LEAST_FLOOR = 1e-4
# A tyre creeps by up to so much of its critical slip in ordinary driving, one standard deviation [1].
CREEP_SHARE = 0.05
# Studentised residual that counts as slip. Of Gaussian noise 6e-7 of all samples exceed it, those of `confirm_time` in a row
# never; of robots whose geometry is off by their tolerances about as many.
DEFAULT_GATE = 5.0


@dataclasses.dataclass(frozen=True)
class SlipNoise:
    """Standard deviations of the sensed velocities of a healthy robot; see the module's docstring.

    Attributes:
        drive_noise: of one measured drive speed [rad/s].
        steer_noise: of one measured steering speed [rad/s].
        rolling_fraction: longitudinal, per speed of the wheel [1].
        lateral_fraction: lateral, per speed of the wheel [1].
        steering_length: both, per steering rate [m].
        heading_delay: both, per steering rate and speed of the wheel [s].
        turning_length: both, per turning rate of the robot [m].
        gate: studentised residual above which a component slips [1].
    """

    drive_noise: float
    steer_noise: float
    rolling_fraction: float
    lateral_fraction: float
    steering_length: float
    heading_delay: float
    turning_length: float
    gate: float = DEFAULT_GATE

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            EstimationError: names the field, its value and what is allowed.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
            least = 2.0 if field.name == "gate" else 0.0
            if not is_number or not math.isfinite(value) or value < least:
                raise EstimationError(f"{field.name} = {value!r} is not allowed; allowed: a finite number, at least {least:g}")

    @classmethod
    def of_robot(cls, robot: RobotDescription) -> SlipNoise:
        """Return what `sensors`, `tolerances` and `contact` of a robot file say."""
        encoders = robot.sensors.encoders
        # Two readings, each off by up to half a count of the motor, make one velocity.
        per_count = math.tau * encoders.rate / math.sqrt(6.0)
        gear = np.abs(np.linalg.inv(robot.gear_matrix))
        counts = np.array([encoders.drive_counts, encoders.steer_counts])
        quantisation = per_count * np.sqrt(np.sum((gear / counts) ** 2, axis=2)).max(axis=0)
        radius = robot.tolerance("wheel_radius").value
        if not robot.tolerance("wheel_radius").relative:
            radius /= float(robot.wheel_radius.min())
        heading = robot.tolerance("steer_zero").value
        offset = robot.tolerance("caster_offset").value
        if robot.tolerance("caster_offset").relative:
            offset *= float(np.abs(robot.caster_offset).max())
        axis = robot.tolerance("steer_axis").value
        if robot.tolerance("steer_axis").relative:
            axis *= float(np.abs(robot.steer_axis).max())
        creep = CREEP_SHARE * max(tyre.lambda_p for tyre in robot.tyres)
        creep_lateral = CREEP_SHARE * max(tyre.lateral.lambda_p for tyre in robot.tyres)
        return cls(
            drive_noise=float(math.hypot(quantisation[DRIVE], encoders.velocity_noise)),
            steer_noise=float(math.hypot(quantisation[STEER], encoders.velocity_noise)),
            rolling_fraction=math.sqrt(radius**2 + heading**2 + creep**2),
            lateral_fraction=math.hypot(heading, creep_lateral),
            steering_length=offset,
            heading_delay=0.5 / encoders.rate,  # a speed taken from two angles is half a period older than the later one
            turning_length=math.hypot(axis, offset),
        )

    def array(self) -> FloatArray:
        """Return the numbers in the order of the fields, for the kernels (8,)."""
        return np.array([getattr(self, field.name) for field in dataclasses.fields(self)], dtype=np.float64)

    def save(self, path: str | Path, robot_name: str, provenance: str = "") -> None:
        """Write a YAML file that `load_slip_noise` reads."""
        content: dict[str, Any] = {"format": FORMAT, "robot": robot_name}
        if provenance:
            content["provenance"] = provenance
        content |= {name: float(f"{value:.6g}") for name, value in dataclasses.asdict(self).items()}
        Path(path).write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def load_slip_noise(path: str | Path, robot: RobotDescription) -> SlipNoise:
    """Read a file that the calibration wrote.

    Raises:
        EstimationError: the file cannot be read, is of another format or of another robot, or holds a key or a number that
            is not allowed; names the field, its value and what is allowed.
    """
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        allowed = "allowed: a file that `calibrate` wrote"
        raise EstimationError(f"slip noise {str(path)!r} cannot be read: {error}; {allowed}") from None
    except yaml.YAMLError as error:
        raise EstimationError(f"slip noise {str(path)!r} is no YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        found = content.get("format") if isinstance(content, dict) else type(content).__name__
        raise EstimationError(f"{path}: format = {found!r} is not allowed; allowed: {FORMAT!r}")
    if content.get("robot") != robot.name:
        raise EstimationError(
            f"{path}: robot = {content.get('robot')!r} is not allowed; allowed: {robot.name!r}, the robot it is to be used for"
        )
    fields = [field.name for field in dataclasses.fields(SlipNoise)]
    for key in content:
        if key not in (*fields, "format", "robot", "provenance"):
            raise EstimationError(f"{path}: {key} = {content[key]!r} is not known; {nearest_name(str(key), fields)}")
    for name in fields[:-1]:
        if name not in content:
            raise EstimationError(f"{path}: {name} = None is not allowed; allowed: a finite number, at least 0")
    try:
        return SlipNoise(**{name: content[name] for name in fields if name in content})
    except EstimationError as error:
        raise EstimationError(f"{path}: {error}") from None


@compiled
def sensed_kernel(caster_offset, wheel_radius, joint_velocity):  # type: ignore[no-untyped-def]
    """Return B q_dot, the sensed velocities of the wheel centres in the frames of the wheels (n, 2) [m/s]."""
    sensed = np.empty(joint_velocity.shape)
    for i in range(len(wheel_radius)):
        sensed[i, 0] = wheel_radius[i] * joint_velocity[i, 0] + caster_offset[i, 1] * joint_velocity[i, 1]
        sensed[i, 1] = -caster_offset[i, 0] * joint_velocity[i, 1]
    return sensed


@compiled
def variance_kernel(caster_offset, wheel_radius, joint_velocity, sensed, omega, noise):  # type: ignore[no-untyped-def]
    """Return the variances (n, 2) [m^2/s^2] of the sensed velocities, and the part of them that is white (n, 2)."""
    variance, white = np.empty(sensed.shape), np.empty(sensed.shape)
    for i in range(len(wheel_radius)):
        rate = joint_velocity[i, 1]
        speed_squared = sensed[i, 0] * sensed[i, 0] + sensed[i, 1] * sensed[i, 1]
        both = (noise[4] * rate) ** 2 + (noise[5] * rate) ** 2 * speed_squared + (noise[6] * omega) ** 2
        white[i, 0] = (wheel_radius[i] * noise[0]) ** 2 + (caster_offset[i, 1] * noise[1]) ** 2 + LEAST_FLOOR**2
        white[i, 1] = (caster_offset[i, 0] * noise[1]) ** 2 + LEAST_FLOOR**2
        variance[i, 0] = white[i, 0] + noise[2] * noise[2] * speed_squared + both
        variance[i, 1] = white[i, 1] + noise[3] * noise[3] * speed_squared + both
    return variance, white
