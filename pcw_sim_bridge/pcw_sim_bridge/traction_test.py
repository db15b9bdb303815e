"""Measures a plant's friction curve mu(lambda): one wheel of a rig is spun, two others hold the travelling speed."""

from __future__ import annotations

import dataclasses

import numpy as np

from pcw_description.robot_description import DRIVE, GRAVITY, STEER, FloatArray, RobotDescription
from pcw_description.wheel_dynamics import slip_ratio

from .plants.plant import Plant, PlantError


@dataclasses.dataclass(frozen=True)
class TractionCurve:
    """A measured friction curve.

    Attributes:
        slip_ratio: (m,) [1], from wheel speed and true speed.
        friction: (m,) [1], from motor torque and the normal force: tau / (r F_z), inertia taken off.
    """

    slip_ratio: FloatArray
    friction: FloatArray

    @property
    def peak(self) -> tuple[float, float]:
        """Slip ratio and friction coefficient at the highest point."""
        index = int(np.argmax(self.friction))
        return float(self.slip_ratio[index]), float(self.friction[index])


def traction_rig(robot: RobotDescription) -> RobotDescription:
    """Return a tricycle of the robot's own parts: the wheel under test ahead on the centre line, two to hold the speed.

    A wheel beside the centre line would turn the robot, and the turning would change the slip to be measured. The rig's
    motors can take every wheel past its friction limit.
    """
    weight = robot.total_mass * GRAVITY
    strong = 2.0 * robot.contact.mu_p * weight * robot.casters[0].wheel_radius
    module = dataclasses.replace(
        robot.casters[0],
        limits=dataclasses.replace(robot.casters[0].limits, drive_torque=strong, steer_torque=strong),
    )
    reach = float(np.max(np.abs(robot.steer_axis)))
    places = {"test": (reach, 0.0), "left": (-reach, reach), "right": (-reach, -reach)}
    casters = tuple(
        dataclasses.replace(module, name=name, steer_axis=place) for name, place in places.items()
    )
    chassis = dataclasses.replace(robot.chassis, com=(-reach / 3.0, 0.0, robot.chassis.com[2]))
    return dataclasses.replace(
        robot, name=f"{robot.name}_traction_rig", casters=casters, chassis=chassis, physics=()
    )


def measure_traction(
    plant: Plant, speed: float, slip_ratios: FloatArray, settle: float = 1.5, average: float = 0.1
) -> TractionCurve:
    """Drive a `traction_rig` straight at `speed` and bring its first wheel to each slip ratio in turn.

    The wheel under test is speed controlled to the true speed / (1 - lambda); the others keep the robot's speed, all
    headings are held at zero.

    Args:
        plant: the plant; it is reset.
        speed: travelling speed [m/s].
        slip_ratios: wanted slip ratios, 0 <= lambda < 1, (m,).
        settle: time to reach each slip ratio [s].
        average: time over which the torque is averaged [s].

    Raises:
        PlantError: a speed or slip ratio out of range.
    """
    if not speed > 0.0:
        raise PlantError(f"speed = {speed!r} m/s is not allowed; allowed: above 0")
    slip_ratios = np.asarray(slip_ratios, dtype=float)
    if np.any((slip_ratios < 0.0) | (slip_ratios >= 1.0)):
        raise PlantError(f"slip_ratios {slip_ratios.tolist()} are not allowed; allowed: 0 to below 1")
    robot, caster = plant.robot, 0
    radius = robot.wheel_radius
    inertia = robot.casters[caster].wheel.inertia_axle + robot.armature[caster, DRIVE, DRIVE]
    # The wheel's loop is as stiff as a step allows, because the tyre holds the wheel much harder than its inertia does.
    wheel_gain = 0.3 * inertia / plant.dt
    body_gain = 20.0 * robot.total_mass * radius / (robot.n - 1)
    steer_inertia = robot.armature[:, STEER, STEER] + np.array([c.module.inertia_zz for c in robot.casters])
    plant.reset()
    measured_slip, measured_friction = [], []
    integral, body_integral = 0.0, 0.0
    wanted_speed = 0.0

    def command(target_slip: float) -> FloatArray:
        nonlocal integral, body_integral
        state = plant.state()
        torque = np.zeros((robot.n, 2))
        error = wanted_speed - state.twist[0]
        body_integral += error * plant.dt
        torque[:, DRIVE] = body_gain * (error + 5.0 * body_integral)
        wheel_error = (
            state.twist[0] / (1.0 - target_slip) / radius[caster] - state.joint_velocity[caster, DRIVE]
        )
        integral += wheel_error * plant.dt
        torque[caster, DRIVE] = wheel_gain * (wheel_error + 400.0 * integral)
        torque[:, STEER] = -steer_inertia * (
            900.0 * state.joint_position[:, STEER] + 60.0 * state.joint_velocity[:, STEER]
        )
        return torque

    while wanted_speed < speed:
        wanted_speed = min(wanted_speed + 1.0 * plant.dt, speed)
        plant.step(command(0.0))
    for target in slip_ratios:
        for _ in range(round(settle / plant.dt)):
            plant.step(command(float(target)))
        rows = []
        start = plant.state()
        for _ in range(max(round(average / plant.dt), 1)):
            plant.step(command(float(target)))
            state = plant.state()
            forward = state.twist[0] - state.twist[2] * (robot.steer_axis[caster, 1])
            ratio = slip_ratio(radius[caster] * state.joint_velocity[caster, DRIVE], forward)
            rows.append((ratio, state.motor_torque[caster, DRIVE], state.normal_force[caster]))
        ratio, torque_mean, normal = np.mean(rows, axis=0)
        elapsed = state.time - start.time
        acceleration = (state.joint_velocity[caster, DRIVE] - start.joint_velocity[caster, DRIVE]) / elapsed
        measured_slip.append(ratio)
        measured_friction.append((torque_mean - inertia * acceleration) / (radius[caster] * normal))
    return TractionCurve(np.array(measured_slip), np.array(measured_friction))
