"""`mujoco.sysid` on a robot: the MuJoCo plant of this package as its simulation, every number of the description freed.

MuJoCo's own contacts do not roll with slip as tyres do (EQUATIONS section 4); fitted with them, everything else would have
to make up for it. So the toolbox is given this package's plant in MuJoCo by its documented way in, a rollout of one's own.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pcw_description.effects.registry import get, read_physics
from pcw_description.errors import PcwError
from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, STEER, Caster, RobotDescription

from ...plants.true_robot import as_it_really_is
from ..errors import MismatchError
from ..regression.regression_problem import FloatArray, RegressionProblem
from ..robot.robot_channels import RobotProblemBuilder
from ..robot.robot_motion import RobotMotion
from ..robot.rolling_model import twists
from .baseline_result import Explained, joined_targets
from .candidate_columns import number_as_effect
from .comparison_packages import comparison_module
from .mujoco_identification import (
    FEWEST_WINDOWS,
    ITERATIONS,
    MOST_WINDOWS,
    WINDOW,
    FreeNumber,
    Window,
    identify,
    spread_out,
)

STEP = 2e-3  # [s]; the tyres and springs of this package stay stable up to 5 ms
FRICTIONS = {
    "drive_coulomb_friction": "coulomb",
    "drive_viscous_friction": "viscous",
    "steer_coulomb_friction": "coulomb",
    "steer_viscous_friction": "viscous",
}
# A simulation that has left all bounds counts as this far off, in the unit of its sensor.
FAR_OFF = 1e3


def identified_robot(
    robot: RobotDescription,
    recordings: Sequence[Recording],
    held_out: Sequence[Recording],
    proof: RegressionProblem,
    seconds: float,
    numbers: Sequence[FreeNumber] | None = None,
) -> Explained:
    """Fit a robot's numbers to its recordings within about so many seconds.

    Args:
        proof: problem of the held-out recordings.
        numbers: to free; default: all.

    Raises:
        MismatchError: there are no torques to drive the simulation with, or the robot cannot be simulated.
    """
    builder = RobotProblemBuilder(robot, recordings)
    if not builder.balanced:
        raise MismatchError("could not run: it needs recorded torques, and casters with an offset")
    numbers = free_numbers(robot) if numbers is None else numbers
    simulation = PlantRollout(robot, numbers)
    windows = _windows(robot, builder, simulation, seconds, len(numbers))
    found = identify(simulation.spec, windows, numbers, rollout=simulation)
    patched = with_numbers(robot, found.values)
    after = RobotProblemBuilder(patched, held_out, builder.cutoff).build().residual
    names = joined_targets([number_as_effect(name) for name in found.moved], robot.caster_names)
    return Explained(names, proof.residual - after, found.remark)


def free_numbers(robot: RobotDescription) -> list[FreeNumber]:
    """Every number of a robot that moves its joints, with its tolerance, and the friction of every joint."""
    found: list[FreeNumber] = []

    def free(tolerance: str, name: str, nominal: float, widest: float) -> None:
        known = robot.tolerance(tolerance)
        size = known.value * abs(nominal) if known.relative else known.value
        if size > 0.0:
            found.append(FreeNumber(name, nominal, size, nominal - widest, nominal + widest, size))

    chassis, first = robot.chassis, robot.casters[0]
    free("chassis.mass", "chassis.mass", chassis.mass, 0.6 * chassis.mass)
    for k, axis in enumerate("xy"):
        free("chassis.com", f"chassis.com.{axis}", chassis.com[k], 0.5 * max(np.max(np.abs(robot.steer_axis)), 0.05))
    free("chassis.inertia_zz", "chassis.inertia_zz", chassis.inertia_zz, 0.6 * chassis.inertia_zz)
    free("module.mass", "module.mass", first.module.mass, 0.3 * first.module.mass)
    free("module.inertia_zz", "module.inertia_zz", first.module.inertia_zz, 0.4 * first.module.inertia_zz)
    free("wheel.inertia_axle", "wheel.inertia_axle", first.wheel.inertia_axle, 0.4 * first.wheel.inertia_axle)
    for axis, rotor in (("drive", first.rotors.drive), ("steer", first.rotors.steer)):
        free("rotors", f"rotors.{axis}", rotor, 0.5 * rotor)
    free("contact.stiffness", "contact.stiffness", 1.0, 0.8)
    for axis in "xy":
        free("ground.slope", f"ground.slope.{axis}", 0.0, 0.2)
    for caster in robot.casters:
        free("wheel_radius", f"wheel_radius/{caster.name}", caster.wheel_radius, 0.1 * caster.wheel_radius)
        free("caster_offset", f"caster_offset.x/{caster.name}", caster.caster_offset[0], 0.3 * abs(caster.caster_offset[0]))
        free("steer_zero", f"steer_zero/{caster.name}", 0.0, 0.2)
        for axis in AXIS_NAMES:
            free("torque_constant", f"torque_constant/{caster.name}_{axis}", 1.0, 0.5)
        for effect, parameter in FRICTIONS.items():
            typical = get(effect).parameter(parameter).typical
            # A twentieth of the range off the bound, where the toolbox's authors say that it stalls.
            found.append(FreeNumber(f"{effect}/{caster.name}", 0.0, typical, 0.0, 4.0 * typical, start=0.2 * typical))
    return found


def with_numbers(robot: RobotDescription, values: Mapping[str, float]) -> RobotDescription:
    """Return the robot with the numbers of `free_numbers` as given, by name.

    Raises:
        DescriptionError: a robot that cannot be.
    """
    chassis = dataclasses.replace(
        robot.chassis,
        mass=values.get("chassis.mass", robot.chassis.mass),
        inertia_zz=values.get("chassis.inertia_zz", robot.chassis.inertia_zz),
        com=(
            values.get("chassis.com.x", robot.chassis.com[0]),
            values.get("chassis.com.y", robot.chassis.com[1]),
            robot.chassis.com[2],
        ),
    )
    stiffness = values.get("contact.stiffness", 1.0)
    contact = dataclasses.replace(
        robot.contact,
        lambda_p=robot.contact.lambda_p / stiffness,
        lateral=dataclasses.replace(robot.contact.lateral, lambda_p=robot.contact.lateral.lambda_p / stiffness),
    )
    first = robot.casters[0]
    scale = {
        name: values.get(name, nominal) / nominal if nominal else 1.0
        for name, nominal in (
            ("module.mass", first.module.mass),
            ("module.inertia_zz", first.module.inertia_zz),
            ("wheel.inertia_axle", first.wheel.inertia_axle),
            ("rotors.drive", first.rotors.drive),
            ("rotors.steer", first.rotors.steer),
        )
    }
    casters = tuple(_caster_with(caster, values, scale) for caster in robot.casters)
    physics = (*robot.physics, *read_physics(_effects(robot, values), robot.caster_names))
    return dataclasses.replace(robot, chassis=chassis, contact=contact, casters=casters, physics=physics)


def _caster_with(caster: Caster, values: Mapping[str, float], scale: Mapping[str, float]) -> Caster:
    module, wheel, rotors = caster.module, caster.wheel, caster.rotors
    offset = values.get(f"caster_offset.x/{caster.name}", caster.caster_offset[0])
    return dataclasses.replace(
        caster,
        wheel_radius=values.get(f"wheel_radius/{caster.name}", caster.wheel_radius),
        caster_offset=(offset, caster.caster_offset[1]),
        module=dataclasses.replace(
            module, mass=module.mass * scale["module.mass"], inertia_zz=module.inertia_zz * scale["module.inertia_zz"]
        ),
        wheel=dataclasses.replace(wheel, inertia_axle=wheel.inertia_axle * scale["wheel.inertia_axle"]),
        rotors=dataclasses.replace(
            rotors, drive=rotors.drive * scale["rotors.drive"], steer=rotors.steer * scale["rotors.steer"]
        ),
    )


def _effects(robot: RobotDescription, values: Mapping[str, float]) -> list[dict[str, Any]]:
    """Numbers that a description holds as effects, as entries of `physics`."""
    lean = complex(values.get("ground.slope.x", 0.0), values.get("ground.slope.y", 0.0))
    entries: list[dict[str, Any]] = [
        {"name": "ground_slope", "target": ["chassis"], "angle": abs(lean), "direction": float(np.angle(lean))}
    ]
    for name in robot.caster_names:
        target = {"target": [name]}
        for axis in AXIS_NAMES:
            error = values.get(f"torque_constant/{name}_{axis}", 1.0) - 1.0
            entries.append({"name": "torque_constant_error", **target, "axis": axis, "error": error})
        for effect, parameter in FRICTIONS.items():
            entries.append({"name": effect, **target, parameter: values.get(f"{effect}/{name}", 0.0)})
        entries.append({"name": "steer_zero_offset", **target, "offset": values.get(f"steer_zero/{name}", 0.0)})
    return entries


class PlantRollout:
    """Simulates windows for the toolbox with the MuJoCo plant, one robot per set of numbers.

    Attributes:
        spec: what the toolbox takes for the model: bodies, a motor on each joint, sensors of its angle and rate.
    """

    def __init__(self, robot: RobotDescription, numbers: Sequence[FreeNumber]) -> None:
        import mujoco

        from ...plants.mujoco_plant import MujocoPlant, mujoco_spec

        self._robot, self._numbers, self._make = robot, tuple(numbers), MujocoPlant
        self.spec = mujoco_spec(as_it_really_is(robot), held=False)
        for name in robot.joint_names:
            motor = self.spec.add_actuator(name=name, target=name)
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        for kind, suffix in ((mujoco.mjtSensor.mjSENS_JOINTPOS, "angle"), (mujoco.mjtSensor.mjSENS_JOINTVEL, "rate")):
            for name in robot.joint_names:
                sensor = self.spec.add_sensor(name=f"{name}_{suffix}", objname=name)
                sensor.type, sensor.objtype = kind, mujoco.mjtObj.mjOBJ_JOINT
        self._model = self.spec.compile()
        joints = [self._model.joint(name) for name in robot.joint_names]
        # The state is the time, positions (base: place and quaternion w, x, y, z), velocities.
        self._angles = np.array([1 + int(joint.qposadr[0]) for joint in joints])
        self._rates = np.array([1 + self._model.nq + int(joint.dofadr[0]) for joint in joints])
        self._twist = 1 + self._model.nq + np.array([0, 1, 5])
        self._plants: dict[bytes, Any] = {}

    def state(self, yaw: float, twist: FloatArray, angles: FloatArray, rates: FloatArray) -> FloatArray:
        """Full physics state of a robot that moves with a twist (3,) in base_link, joint angles and rates (n, 2)."""
        state = np.zeros(1 + self._model.nq + self._model.nv)
        state[4], state[7] = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
        state[self._angles], state[self._rates] = angles.ravel(), rates.ravel()
        c, s = np.cos(yaw), np.sin(yaw)
        state[self._twist] = [c * twist[0] - s * twist[1], s * twist[0] + c * twist[1], twist[2]]
        return state

    def __call__(
        self, models: Any, control_signal: Any, initial_states: Any, param_dicts: Any, rollout_signal_mapping: Any,
        rollout_state_mapping: Any, ctrl_mapping: Any, **ignored: Any,
    ) -> list[Any]:
        """Simulate; arguments and result are those of the toolbox's `custom_rollout`."""
        sysid = comparison_module("mujoco.sysid")
        trajectories = []
        for model, control, initial, parameters in zip(models, control_signal, initial_states, param_dicts, strict=True):
            predicted = self._simulate(control.times, control.data, initial, parameters.as_vector())
            times = control.times[1:]
            # Only its first column, the time, is read where the sensors tell all.
            state = np.zeros((len(times), len(initial)))
            state[:, 0] = times
            trajectories.append(
                sysid.SystemTrajectory(
                    model=model,
                    control=control,
                    sensordata=sysid.TimeSeries(times, predicted, rollout_signal_mapping),
                    initial_state=initial,
                    state=sysid.TimeSeries(times, state, rollout_state_mapping),
                )
            )
        return trajectories

    def values(self, vector: FloatArray) -> dict[str, float]:
        """Values by name, from the toolbox's vector in sizes."""
        return {
            number.name: number.nominal + float(change) * number.size
            for number, change in zip(self._numbers, vector, strict=True)
        }

    def _simulate(self, times: FloatArray, torque: FloatArray, initial: FloatArray, vector: FloatArray) -> FloatArray:
        """Angles and rates (L - 1, 4n) at all times but the first."""
        n = self._robot.n
        predicted = np.full((len(times) - 1, 4 * n), FAR_OFF)
        try:
            plant, offset = self._plant(vector)
            # What the encoder adds is not in the wheel's heading.
            angles = initial[self._angles].reshape(n, 2) - offset
            yaw = 2.0 * np.arctan2(initial[7], initial[4])
            v_x, v_y, omega = initial[self._twist]
            c, s = np.cos(yaw), np.sin(yaw)
            plant.reset(pose=np.array([0.0, 0.0, yaw]), steer_angle=angles[:, STEER])
            twist = np.array([c * v_x + s * v_y, c * v_y - s * v_x, omega])
            plant.set_motion(twist, angles, initial[self._rates].reshape(n, 2))
            steps = max(1, round((times[1] - times[0]) / STEP))
            for row in range(len(times) - 1):
                plant.step(torque[row].reshape(n, 2), steps)
                state = plant.state()
                predicted[row] = np.concatenate([(state.joint_position + offset).ravel(), state.joint_velocity.ravel()])
        except PcwError:
            # A robot that cannot be, or that flies apart: the optimiser turns back.
            return np.full_like(predicted, FAR_OFF)
        return predicted

    def _plant(self, vector: FloatArray) -> tuple[Any, FloatArray]:
        """Plant and encoder offsets (n, 2) of a set of numbers; the toolbox asks for the same sets window by window."""
        key = vector.tobytes()
        if key not in self._plants:
            if len(self._plants) > 2 * len(self._numbers):
                self._plants.clear()
            values = self.values(vector)
            offset = np.zeros((self._robot.n, 2))
            offset[:, STEER] = [values.get(f"steer_zero/{name}", 0.0) for name in self._robot.caster_names]
            self._plants[key] = self._make(with_numbers(self._robot, values), STEP), offset
        return self._plants[key]


def _windows(
    robot: RobotDescription, builder: RobotProblemBuilder, simulation: PlantRollout, seconds: float, width: int
) -> list[Window]:
    """As many windows, spread over the recordings, as the time allows."""
    motions = builder.motions
    # The wide filter leaves the motion at a few hundred samples a second.
    length = max(3, round(WINDOW * motions[0].rate))
    pieces = [(k, len(motion.time)) for k, motion in enumerate(motions)]
    trial = [_window(builder, simulation, motions[k], start, length) for k, start in spread_out(pieces, length, 1)]
    if not trial:
        raise MismatchError(f"could not run: no contiguous piece of {WINDOW:g} s")
    nominal = np.zeros(width)
    simulation._simulate(trial[0].time, trial[0].torque, trial[0].initial_state, nominal)
    begun = time.monotonic()
    simulation._simulate(trial[0].time, trial[0].torque, trial[0].initial_state, nominal)
    cost = max(time.monotonic() - begun, 1e-4) * (width + 3) * ITERATIONS
    count = int(np.clip(seconds / cost, FEWEST_WINDOWS, MOST_WINDOWS))
    return [_window(builder, simulation, motions[k], start, length) for k, start in spread_out(pieces, length, count)]


def _window(
    builder: RobotProblemBuilder, simulation: PlantRollout, motion: RobotMotion, start: int, length: int
) -> Window:
    rows = slice(start, start + length)
    numbers = builder.numbers
    twist, _ = twists(numbers, motion.position[rows, :, STEER], motion.velocity[rows])
    yaw = float(np.nan_to_num(motion.yaw[start]))
    state = simulation.state(yaw, twist[0], motion.position[start], motion.velocity[start])
    size = len(twist)
    sensed = [motion.position[rows].reshape(size, -1), motion.velocity[rows].reshape(size, -1)]
    return Window(
        state, motion.time[rows] - motion.time[start], motion.torque[rows].reshape(size, -1), np.concatenate(sensed, axis=1)
    )
