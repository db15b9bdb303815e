"""Simulates the runs of a case: into memory to see how large an effect is, or into the recording that is handed out."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_control.excitation import make_excitation
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.effect import Effect
from pcw_description.effects.registry import also_known
from pcw_description.recording_series import ImuSeries, IntArray, JointSeries, OdometrySeries, TwistSeries
from pcw_description.robot_description import FloatArray, RobotDescription

from ...plants.factory import make_plant
from ...plants.plant import Plant
from ...run_controllers import make_controller
from ...sensors import ImuReading, JointReading
from ...simulated_robot import JointCommand, Sample, SimulatedRobot, TrackedPose
from ...simulated_run import START_NS, drive, record_run
from ...stamping import HEALTHY, StampingParameters, TopicStamps
from .outside_effects import OUTSIDE_EFFECTS, CrossJointLaw, LawPlant

FINE_COUNTS = 1e8  # [counts/rev], far below every noise


@dataclasses.dataclass(frozen=True)
class Run:
    """One recording of a case.

    Attributes:
        path: folder below that of the case.
        excitation: name in `pcw_control.excitation`; `duration` [s] and `seed` of it, the seed also of all noise.
        active: whether the concealed effects are at work.
    """

    path: str
    excitation: str
    duration: float
    seed: int
    active: bool = True


@dataclasses.dataclass(frozen=True)
class SimulatedRecording:
    """What `Recording.open` would read of a run, without the file."""

    path: Path
    robot: RobotDescription
    joint_states: JointSeries
    joint_commands: JointSeries
    imu: ImuSeries | None
    ground_truth: OdometrySeries
    cmd_vel: TwistSeries | None
    odom: None = None
    contact: Mapping[str, object] = dataclasses.field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def duration(self) -> float:
        """From the first joint state to the last [s]."""
        return float(self.joint_states.stamp[-1])


@dataclasses.dataclass(frozen=True)
class World:
    """What a case's runs have in common.

    Attributes:
        nominal: the robot as its user describes it, and as its controller believes.
        true: the healthy robot as it is, its `physics` the deviations that no description holds.
        plant, controller: names.
    """

    nominal: RobotDescription
    true: RobotDescription
    plant: str
    controller: str = "computed_torque"

    def with_effects(self, effects: Sequence[EffectInstance]) -> RobotDescription:
        """Return the true robot with effects at work that a plant knows by their kind."""
        kinds = [e for e in effects if not isinstance(_outside(e), CrossJointLaw)]
        return dataclasses.replace(self.true, physics=(*self.true.physics, *kinds))

    def quiet(self) -> World:
        """Return the world with sensors that have no noise and encoders that count finely."""
        sensors = self.true.sensors
        changed: dict[str, Any] = {}
        for part in ("encoders", "imu", "tracker"):
            own = getattr(sensors, part)
            if own is not None:
                noises = {f.name: 0.0 for f in dataclasses.fields(own) if f.name.endswith("_noise")}
                changed[part] = dataclasses.replace(own, **noises)
        changed["encoders"] = dataclasses.replace(changed["encoders"], drive_counts=FINE_COUNTS, steer_counts=FINE_COUNTS)
        true = dataclasses.replace(self.true, sensors=dataclasses.replace(sensors, **changed))
        return dataclasses.replace(self, true=true)

    def make(self, robot: RobotDescription, effects: Sequence[EffectInstance]) -> Plant:
        """Make the plant of a robot, with the laws at work that are of no kind."""
        plant: Plant = make_plant(self.plant, robot)
        for instance in effects:
            law = _outside(instance)
            if isinstance(law, CrossJointLaw):
                plant = LawPlant(plant, law, instance.target, instance.parameters)
        return plant


def simulate(world: World, run: Run, effects: Sequence[EffectInstance]) -> SimulatedRecording:
    """Simulate a run in memory.

    Raises:
        PlantError: the plant leaves what it can compute.
    """
    with known_while_simulated(effects):
        robot = world.with_effects(effects)
        simulated = SimulatedRobot(world.make(robot, effects), run.seed)
        excitation = make_excitation(run.excitation, world.nominal, run.duration, run.seed)
        collected = _Collector(TopicStamps(StampingParameters(), run.seed, robot))
        try:
            drive(simulated, make_controller(world.controller, world.nominal), excitation.twist, run.duration, collected)
        finally:
            simulated.close()
    return collected.recording(world.nominal)


def record(
    world: World, run: Run, effects: Sequence[EffectInstance], path: Path, stamping: StampingParameters = HEALTHY
) -> None:
    """Write the recording of a run: what `simulate` gives, as messages, with the stamps and losses of a real robot.

    Raises:
        PcwError: as `record_run`.
    """
    with known_while_simulated(effects):
        robot = world.with_effects(effects)
        excitation = make_excitation(run.excitation, world.nominal, run.duration, run.seed)
        record_run(
            robot, excitation.twist, run.duration, run.seed, path, controlled_as=world.nominal,
            controller_name=world.controller, plant=world.make(robot, effects), stamping=stamping,
        )


def _outside(instance: EffectInstance) -> Effect | None:
    return OUTSIDE_EFFECTS[instance.name].effect if instance.name in OUTSIDE_EFFECTS else None


def known_while_simulated(effects: Sequence[EffectInstance]):  # type: ignore[no-untyped-def]
    """The effects from outside the library are in the vocabulary while, and only while, they are simulated."""
    found = [effect for e in effects if (effect := _outside(e)) is not None]
    return also_known([effect for effect in found if not isinstance(effect, CrossJointLaw)])


class _Collector:
    """Keeps the readings of a run as arrays."""

    def __init__(self, stamps: TopicStamps) -> None:
        self._stamps = stamps
        self._joints: list[tuple[int, JointReading]] = []
        self._imu: list[tuple[int, ImuReading]] = []
        self._truth: list[tuple[int, TrackedPose]] = []
        self._twist: list[tuple[int, FloatArray]] = []
        self._commands: list[tuple[int, JointCommand]] = []

    def sample(self, sample: Sample) -> None:
        reading, now = sample.reading, sample.time_ns + START_NS
        if isinstance(reading, JointReading):
            self._joints.append((self._stamps.stamp("joint_states", now)[0], reading))
        elif isinstance(reading, ImuReading):
            self._imu.append((self._stamps.stamp("imu/data", now)[0], reading))
        elif isinstance(reading, TrackedPose):
            self._truth.append((self._stamps.stamp("ground_truth/odom", now)[0], reading))

    def answer(self, time_ns: int, twist: FloatArray | None, command: JointCommand) -> None:
        if twist is not None:
            self._twist.append((self._stamps.stamp("cmd_vel", time_ns + START_NS)[0], twist))
        self._commands.append((self._joints[-1][0], command))

    def recording(self, robot: RobotDescription) -> SimulatedRecording:
        """Return everything so far, time counted from the first joint reading."""
        start = self._joints[0][0]

        def stamps(entries: Sequence[tuple[int, object]]) -> tuple[FloatArray, IntArray]:
            stamp_ns: IntArray = np.array([stamp for stamp, _ in entries], dtype=np.int64)
            return ((stamp_ns - start) * 1e-9).astype(np.float64), stamp_ns

        names = robot.joint_names
        joints = [reading for _, reading in self._joints]
        nothing = np.full((len(self._commands), robot.n, 2), np.nan)
        commands = [command for _, command in self._commands]
        by_effort = commands[0].effort is not None
        wanted = np.array([c.effort if c.effort is not None else c.velocity for c in commands])
        imu = None
        if self._imu:
            imu = ImuSeries(
                *stamps(self._imu),
                np.array([r.angular_velocity for _, r in self._imu]),
                np.array([r.linear_acceleration for _, r in self._imu]),
            )
        return SimulatedRecording(
            path=Path("simulated"),
            robot=robot,
            joint_states=JointSeries(
                *stamps(self._joints), names, np.array([r.position for r in joints]),
                np.array([r.velocity for r in joints]), np.array([r.effort for r in joints]),
            ),
            joint_commands=JointSeries(
                *stamps(self._commands), names, nothing, nothing if by_effort else wanted, wanted if by_effort else nothing
            ),
            imu=imu,
            ground_truth=OdometrySeries(
                *stamps(self._truth), np.array([r.pose for _, r in self._truth]),
                np.array([r.truth.twist for _, r in self._truth]), "odom", "base_link",
            ),
            cmd_vel=TwistSeries(*stamps(self._twist), np.array([t for _, t in self._twist])) if self._twist else None,
        )
