"""A robot's effects as tables that compiled plants call: kernels, their numbers, and where each acts."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np

from pcw_description.compiled import COMPILES, array_kernel_list, compiled, joint_torque_list
from pcw_description.effects.kinds import (
    MEMORY,
    ActuatorEffect,
    ChassisForceEffect,
    ContactEffect,
    GravityEffect,
    JointTorqueEffect,
    TransmissionEffect,
)
from pcw_description.effects.registry import get
from pcw_description.robot_description import AXIS_NAMES, GRAVITY, FloatArray, RobotDescription

from .plant import PlantError

# Columns of `gears`: whether there is one, the rotor's inertia and the gear's stiffness, damping and play, joint side.
GEAR, ROTOR, STIFFNESS, DAMPING, PLAY = range(5)
GEAR_NUMBERS = 5
# Columns of `gear_state`: the motor's angle and rate, joint side, and within a step what `drivetrain` hands to its end.
ANGLE, RATE, TORQUE_AT_REST, SLOPE, MOMENTUM, INERTIA = range(6)
GEAR_STATE = 6

# What compiled code reads of `EffectTables`.
FIELDS = (
    "joint_kernels", "joint_start", "joint_place", "joint_numbers", "array_kernels", "array_start", "array_numbers",
    "memory_start", "memory", "gears", "coupling", "gear_state",
)  # fmt: skip

if COMPILES:
    from numba import types
    from numba.experimental import structref

    @structref.register
    class _TablesType(types.StructRef):  # type: ignore[misc]
        """Numba's type of a `CompiledTables`."""

    class CompiledTables(structref.StructRefProxy):  # type: ignore[misc]
        """The tables as one reference: handing over each on its own costs more than a step of a plant."""

    structref.define_proxy(CompiledTables, _TablesType, list(FIELDS))

    # Numba's own constructor is compiled anew in every process; this one comes from the cache.
    @compiled
    def _compiled_tables(  # type: ignore[no-untyped-def]
        joint_kernels, joint_start, joint_place, joint_numbers, array_kernels, array_start, array_numbers,
        memory_start, memory, gears, coupling, gear_state,
    ):  # fmt: skip
        return CompiledTables(
            joint_kernels, joint_start, joint_place, joint_numbers, array_kernels, array_start, array_numbers,
            memory_start, memory, gears, coupling, gear_state,
        )  # fmt: skip

Entry = tuple[Callable[..., None], FloatArray, int]


class EffectTables:
    """The effects of a robot that act while it moves; those of description and sensors are applied elsewhere.

    Attributes:
        joint_kernels: compiled joint torques, those of caster i from joint_start[i] to joint_start[i + 1].
        joint_place: axis, and 1 for the motor's side, (m, 2).
        joint_numbers: parameters of each, padded with zeros, (m, widest).
        array_kernels: compiled kernels of the other kinds, in the order contacts by caster, actuators by joint, forces.
        array_start: first kernel of caster 0 .. n - 1, of joint 0 .. 2n - 1, of the forces, and the end, (3n + 2,).
        array_numbers: parameters of each, (k, widest).
        memory_start: (k + 1,), which part of `memory` each actuator has.
        memory: what actuators remember.
        gears: (n, 2, GEAR_NUMBERS).
        coupling: of the robot's gears, see `RobotDescription.gear_coupling` (n, 2, 2).
        gear_state: (n, 2, GEAR_STATE).
        gravity: (3,) [m/s^2], world axes.
        compiled: the same tables, as compiled code takes them.
    """

    def __init__(self, robot: RobotDescription, dt: float) -> None:
        self._collect_joint_torques(robot)
        self._collect_arrays(robot, dt)
        self._collect_gears(robot)
        self.compiled = _compiled_tables(*(getattr(self, name) for name in FIELDS)) if COMPILES else self
        unit = np.array([0.0, 0.0, -1.0])
        for instance in robot.physics:
            effect = get(instance.name)
            if isinstance(effect, GravityEffect):
                unit += effect.gravity(instance.parameters)
        # Two slopes at once: their pulls along the floor add, and the length of gravity stays.
        along = min(float(np.hypot(unit[0], unit[1])), 1.0)
        unit[2] = -np.sqrt(1.0 - along**2)
        self.gravity = GRAVITY * unit

    def reset(self) -> None:
        """Forget what actuators remember, and put motors at rest where their joints are at zero."""
        self.memory[:] = 0.0
        self.gear_state[:] = 0.0

    def align_motors(self, joint_position: FloatArray, joint_velocity: FloatArray) -> None:
        """Let the motors behind gears move as rigid gears would have them; both (n, 2)."""
        for joint, column in ((joint_position, ANGLE), (joint_velocity, RATE)):
            self.gear_state[:, :, column] = np.einsum("nij,nj->ni", self.coupling, joint)

    def motor_motion(self, joint_position: FloatArray, joint_velocity: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return angles and rates of the motors (n, 2) as the joint motion that rigid gears would give them."""
        if not self.has_gears:
            return joint_position.copy(), joint_velocity.copy()
        return (
            as_joint_motion(self.gears, self.coupling, self.gear_state[:, :, ANGLE], joint_position),
            as_joint_motion(self.gears, self.coupling, self.gear_state[:, :, RATE], joint_velocity),
        )

    def _collect_joint_torques(self, robot: RobotDescription) -> None:
        kernels, place, numbers, start = [], [], [], [0]
        for caster in robot.caster_names:
            for instance in robot.physics:
                effect = get(instance.name)
                if isinstance(effect, JointTorqueEffect) and caster in instance.target:
                    kernels.append(effect.torque)
                    place.append((AXIS_NAMES.index(instance.axis or effect.axis), int(effect.motor_side)))
                    numbers.append(effect.values(instance.parameters))
            start.append(len(kernels))
        self.joint_kernels = joint_torque_list(kernels)
        self.joint_start = np.array(start, dtype=np.int64)
        self.joint_place = np.array(place, dtype=np.int64).reshape(-1, 2)
        self.joint_numbers = _padded(numbers)

    def _collect_arrays(self, robot: RobotDescription, dt: float) -> None:
        groups: list[Iterable[Entry]] = [list(_contacts(robot, caster)) for caster in robot.caster_names]
        groups += [list(_actuators(robot, c, axis, dt)) for c in robot.caster_names for axis in AXIS_NAMES]
        groups.append(list(_forces(robot)))
        entries = [entry for group in groups for entry in group]
        self.array_kernels = array_kernel_list([kernel for kernel, _, _ in entries])
        self.array_start = np.cumsum([0] + [len(list(group)) for group in groups]).astype(np.int64)
        self.array_numbers = _padded([numbers for _, numbers, _ in entries])
        self.memory_start = np.cumsum([0] + [memory for _, _, memory in entries]).astype(np.int64)
        self.memory = np.zeros(max(int(self.memory_start[-1]), 1))

    def _collect_gears(self, robot: RobotDescription) -> None:
        diagonal = np.einsum("nii->ni", robot.gear_matrix)
        self.coupling = robot.gear_coupling.copy()
        self.gears = np.zeros((robot.n, 2, GEAR_NUMBERS))
        self.gear_state = np.zeros((robot.n, 2, GEAR_STATE))
        for instance in robot.physics:
            effect = get(instance.name)
            if not isinstance(effect, TransmissionEffect):
                continue
            axis = AXIS_NAMES.index(instance.axis or effect.axis)
            gear = effect.gear(instance.parameters)
            for name in instance.target:
                i = robot.caster_index(name)
                rotors = robot.casters[i].rotors
                rotor = (rotors.drive, rotors.steer)[axis] * diagonal[i, axis] ** 2
                if not rotor > 0.0:
                    raise PlantError(
                        f"physics: {instance.name} lets the motor move on its own, and needs "
                        f"casters[{i}].rotors.{AXIS_NAMES[axis]} above 0"
                    )
                row = self.gears[i, axis]
                if row[GEAR]:  # in series: compliances and plays add
                    row[DAMPING] = min(row[DAMPING], gear.damping)
                    row[STIFFNESS] = 1.0 / (1.0 / row[STIFFNESS] + 1.0 / gear.stiffness)
                    row[PLAY] += gear.play
                else:
                    row[:] = 1.0, rotor, gear.stiffness, gear.damping, gear.play
        self.has_gears = bool(self.gears[:, :, GEAR].any())


@compiled
def as_joint_motion(gears, coupling, motor, joint):  # type: ignore[no-untyped-def]
    """Return the joint angles or rates (n, 2) that rigid gears would have with these motors behind the gears that are not."""
    found = np.empty_like(joint)
    for i in range(len(joint)):
        e01, e10 = coupling[i, 0, 1], coupling[i, 1, 0]
        drive = motor[i, 0] if gears[i, 0, GEAR] > 0.0 else joint[i, 0] + e01 * joint[i, 1]
        steer = motor[i, 1] if gears[i, 1, GEAR] > 0.0 else e10 * joint[i, 0] + joint[i, 1]
        determinant = 1.0 - e01 * e10
        found[i, 0] = (drive - e01 * steer) / determinant
        found[i, 1] = (steer - e10 * drive) / determinant
    return found


def _contacts(robot: RobotDescription, caster: str) -> Iterable[Entry]:
    for instance in robot.physics:
        effect = get(instance.name)
        if isinstance(effect, ContactEffect) and caster in instance.target:
            yield effect.contact, effect.values(instance.parameters), 0


def _actuators(robot: RobotDescription, caster: str, axis: str, dt: float) -> Iterable[Entry]:
    found = []
    for instance in robot.physics:
        effect = get(instance.name)
        if isinstance(effect, ActuatorEffect) and caster in instance.target and axis == (instance.axis or effect.axis):
            memory = MEMORY + effect.memory(instance.parameters, dt)
            found.append((effect.stage, effect.drive, effect.values(instance.parameters), memory))
    for _, drive, numbers, memory in sorted(found, key=lambda entry: entry[0]):
        yield drive, numbers, memory


def _forces(robot: RobotDescription) -> Iterable[Entry]:
    for instance in robot.physics:
        effect = get(instance.name)
        if isinstance(effect, ChassisForceEffect):
            yield effect.wrench, effect.values(instance.parameters), 0


def _padded(rows: list[FloatArray]) -> FloatArray:
    table = np.zeros((len(rows), max((len(row) for row in rows), default=1)))
    for row, values in zip(table, rows, strict=True):
        row[: len(values)] = values
    return table
