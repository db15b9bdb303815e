"""The numbers of a robot's description that a healthy robot may differ in, as columns of its channels."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from pcw_description.contact.contact_model import DAMPING_TIME, LENGTH, with_friction
from pcw_description.robot_description import AXIS_NAMES, RobotDescription

from ..all_cores import on_all_cores
from ..regression.regression_problem import FloatArray, Nuisance
from .channel_differences import ChannelDifferences
from .robot_motion import RobotMotion
from .rolling_model import ModelNumbers

Vary = Callable[[ModelNumbers, float], None]
# (tolerance, label, nominal value, variation)
Deviation = tuple[str, str, float, Vary]
Index = int | tuple[int | slice, ...]

# A mass, a length, a gain is not sought beyond this factor of what the description says.
FARTHEST = 4.0
# By about this part the rolling model misjudges forces, whatever the noise: tyres are quasi-static in it. Seen as the error
# of friction concealed in simulated robots, which is more of one sign than noise makes it.
MODEL_DEVIATION = 0.007
INERTIAS = ("module.", "wheel.inertia", "rotors.")  # of numbers in whose place the model's own errors come
FLOOR = ("ground.slope.x", "ground.slope.y")
# [rad/s]; of the velocity loops of drives, and the largest part of their torque that their reports may lack.
LOOP_BANDWIDTH, LARGEST_UNREPORTED = 50.0, 0.3
# [1/s]; of what wheels bear more or less than at rest, so much may come and go within the cycles of drives that hold speeds:
# a fortieth of it every 5 ms.
LOAD_UNREST = 5.0
# Numbers of tyres, and how late a wheel follows its heading, which is the later the more its contact yields: most of all in
# other simulations, by soft constraints.
LOOSE = ("contact.", "heading_lead")
# What parameters of effects change per unit: a number of the chassis, or the beginnings of names of one of each caster, and by
# how much.
CHANGED_BY = {
    ("steer_zero_offset", "offset"): ("steer_zero", -1.0),
    ("wheel_radius_error", "error"): ("wheel_radius", 1.0),
    ("caster_offset_error", "x"): ("caster_offset.x", 1.0),
    ("caster_offset_error", "y"): ("caster_offset.y", 1.0),
    ("payload_offset", "x"): ("chassis.com.x", 1.0),
    ("payload_offset", "y"): ("chassis.com.y", 1.0),
    ("payload_offset", "z"): ("chassis.com.z", 1.0),
}
CROSSTALK = "torque_crosstalk"
FREQUENCY_DEVIATION = 0.2  # of the chassis on its springs, relative


@dataclasses.dataclass(frozen=True)
class VariedNumber:
    """A number of the channel model that a healthy robot may differ in; the first four as those of `Nuisance`."""

    label: str
    unit: str
    nominal: float
    deviation: float
    vary: Vary

    @property
    def changes(self) -> tuple[float, float]:
        """Least and largest change that makes sense: of all these numbers only positive quantities are not zero nominally."""
        if self.nominal == 0.0:
            return -math.inf, math.inf
        return self.nominal / FARTHEST - self.nominal, self.nominal * FARTHEST - self.nominal


def robot_nuisances(
    robot: RobotDescription, differences: ChannelDifferences, kinds: tuple[str, ...] = ("",)
) -> list[Nuisance]:
    """Return every number that has a tolerance and shows in the channels, and the lean of the floor.

    Args:
        robot: the nominal robot; differences: its channels.
        kinds: how the names of those begin that are wanted.
    """
    varied = [number for number in varied_numbers(robot, differences) if number.label.startswith(kinds)]
    columns = on_all_cores(lambda n: differences.of_numbers(n.vary, 0.5 * n.deviation), varied)
    found = [
        Nuisance(
            n.label, n.unit, n.nominal, math.hypot(n.deviation, _misjudged(n, column, differences)), column, n.changes,
            loose=n.label.startswith(LOOSE),
        )
        for n, column in zip(varied, columns, strict=True)
        if column.any() or not differences.model.layout.lifted  # off the ground most numbers do nothing
    ]
    return found + [number for number in floor_nuisances(robot, differences) if number.name.startswith(kinds)]


def _misjudged(number: VariedNumber, column: FloatArray, differences: ChannelDifferences) -> float:
    """Change of a small inertia that does to the forces what the model misjudges of them: it is known no better by them."""
    if not number.label.startswith(INERTIAS) or not len(column):
        return 0.0
    balance = differences.model.layout.balance
    size = float(np.sqrt(np.mean(column[:, balance] ** 2)))
    forces = float(np.sqrt(np.mean(differences.measured[:, balance] ** 2)))
    return min(MODEL_DEVIATION * forces / max(size, 1e-300), number.nominal)


def varied_numbers(robot: RobotDescription, differences: ChannelDifferences) -> list[VariedNumber]:
    """Return all of these that are numbers of the channel model."""
    found = []
    layout = differences.model.layout
    sampling = max(motion.sampling for motion in differences.motions)
    # Nobody knows either which headings a simulation took its rates from, or how a drive makes its angles from its counts.
    found.append(VariedNumber("heading_lead", "s", 0.0, 0.5 * sampling, _entry("heading_lead")))
    if layout.balanced:
        # A drive reports the torque of some instant within its own cycle; nobody knows which.
        found.append(VariedNumber("torque_lag", "s", 0.0, sampling, _entry("torque_lag")))
        # Nor does anybody know how much rubber damps: by that a soft tyre would be found too short or too long.
        found.append(VariedNumber("contact.damping_time", "s", DAMPING_TIME, 0.5 * DAMPING_TIME, _entry("damping_time")))
        found += _unreported(differences)
        if any(np.any(motion.loops) for motion in differences.motions):
            # Torques that leap once a cycle make loads come and go, and what comes takes up slip each time: next to nothing
            # at speed, and most of it where a robot stops hard, as if there were less friction.
            found.append(VariedNumber("contact.load_unrest", "1/s", 0.0, LOAD_UNREST, _entry("load_unrest")))
        found += _crosstalk(robot)
    if layout.imu:
        found += _within_cycle(differences)
    found += _suspension(differences)
    deviations = list(_geometry(robot))
    if layout.balanced:
        deviations += _dynamics(robot, differences.model.numbers)
    deviations += _fixed_axle(robot)
    deviations += _tyres(robot)
    if layout.imu:
        deviations += _inertial_sensor()
    if layout.pose:
        deviations += _tracker(robot)
    for k, (sensor, there) in enumerate((("imu", layout.imu), ("tracker", layout.pose))):
        if there:
            deviations.append(("clock.offset", f"clock.offset.{sensor}", 0.0, _entry("clock", k)))
    for tolerance, label, nominal, vary in deviations:
        known = robot.tolerance(tolerance)
        deviation = known.value * abs(nominal) if known.relative else known.value
        if label == "clock.offset.tracker" and not layout.balanced and tolerance not in robot.tolerances:
            # How old a reading is that waits for its message: anything within a cycle of slow joint_states.
            deviation = max(deviation, *(motion.sampling for motion in differences.motions))
        if deviation > 0.0:
            found.append(VariedNumber(label, known.unit, nominal, deviation, vary))
    return found


def _entry(name: str, index: Index | None = None) -> Vary:
    """Vary one number, one entry of an array, or with no index all of it."""

    def vary(numbers: ModelNumbers, step: float) -> None:
        if index is None:
            setattr(numbers, name, getattr(numbers, name) + step)
        else:
            getattr(numbers, name)[index] += step

    return vary


def _scaled(column: int, nominal: float, described: FloatArray) -> Vary:
    """Vary a column of the modules' numbers in proportion to what is described (n,), wherever they are by now."""
    relative = described / nominal

    def vary(numbers: ModelNumbers, step: float) -> None:
        numbers.modules[:, column] += step * relative

    return vary


def rotor_armature(robot: RobotDescription, axis: int) -> FloatArray:
    """Return what the rotors of one kind do to the joints (n, 2, 2) [kg m^2]; those of coupled gears turn with both joints."""
    inertia = np.array([(caster.rotors.drive, caster.rotors.steer)[axis] for caster in robot.casters])
    turned = robot.gear_matrix[:, axis]
    armature: FloatArray = inertia[:, None, None] * turned[:, :, None] * turned[:, None, :]
    return armature


def _rotor(armature: FloatArray, axis: int) -> Vary:
    """Vary rotors in proportion, by what those of the first caster do to their own joint."""

    def vary(numbers: ModelNumbers, step: float) -> None:
        relative = step / armature[0, axis, axis]
        for column, (row, other) in zip((5, 6, 7), ((0, 0), (0, 1), (1, 1)), strict=True):
            numbers.modules[:, column] += relative * armature[:, row, other]

    return vary


def _radius(index: int) -> Vary:
    """Vary a wheel's radius in the kinematics and in the dynamics, which holds its own copy."""

    def vary(numbers: ModelNumbers, step: float) -> None:
        numbers.radius[index] += step
        numbers.modules[index, 8] += step

    return vary


def _friction(numbers: ModelNumbers, step: float) -> None:
    """Vary the friction of all tyres, relative, and not what they give way under small forces: that is another number."""
    numbers.tyres = with_friction(numbers.tyres, 1.0 + step)


def _gain(index: int, axis: int) -> Vary:
    """Vary a torque constant against the mean of all.

    What they share cannot be told from the masses. Left free it would, where no commands tell a torque without its noise, be
    fitted below its value, since whoever scales down all measured forces scales down their noise with them.
    """

    def vary(numbers: ModelNumbers, step: float) -> None:
        numbers.gain[index, axis] += step
        numbers.gain -= step / numbers.gain.size

    return vary


def _suspension(differences: ChannelDifferences) -> list[VariedNumber]:
    """How far the chassis leans on its springs when it accelerates: anything between not at all and twice as described.

    And how fast: springs, dampers and inertias about level axes are seldom measured. What an IMU feels of its weight then is a
    number of its own: it may stand elsewhere on a frame that gives way, or its driver may have taken gravity out.
    """
    layout, numbers = differences.model.layout, differences.model.numbers
    if layout.lifted or not (layout.balanced or layout.imu):
        return []
    found = []
    for k, axis in enumerate("xy"):
        lean = float(numbers.sway.lean[k])
        if lean > 0.0:
            found.append(VariedNumber(f"suspension.lean.{axis}", "s^2", 0.0, lean, _entry("lean", k)))
            deviation = FREQUENCY_DEVIATION * lean
            found.append(VariedNumber(f"suspension.detuning.{axis}", "s^2", 0.0, deviation, _entry("detuning", k)))
            if layout.imu:
                found.append(VariedNumber(f"imu.lean.{axis}", "s^2", 0.0, lean, _entry("imu_lean", k)))
    return found


def _unreported(differences: ChannelDifferences) -> Iterator[VariedNumber]:
    """What a drive that holds speeds does not report of its torque: parts that nobody knows.

    Its torque leaps with every commanded speed, 2 w J (speed it is behind), and fades as the joint follows, while its integral
    grows, w^2 J times the same. Read once a cycle h, always at the same place of it, it differs from its mean by up to w h of
    what accelerates the joint, and the other way by w^2 h / 2 for each second that it is behind. Drives of a kind are taken
    for alike on the ground; off it what one of them reports otherwise would pass for a weaker motor.
    """
    motions = [motion for motion in differences.motions if np.any(motion.loops)]
    if not motions:
        return
    part = largest_unreported_part(motions)
    behind = any(np.any(motion.loops[..., 1]) for motion in motions)
    layout = differences.model.layout
    owners: Mapping[str, int | slice] = {"": slice(None)}
    if layout.lifted:
        owners = {f"/{name}": i for i, name in enumerate(layout.casters)}
    for axis, name in enumerate(AXIS_NAMES):
        for of, own in owners.items():
            yield VariedNumber(f"torque_report.{name}{of}", "1", 0.0, part, _entry("unreported", (own, axis, 0)))
            if behind:
                label, deviation = f"torque_report.{name}_behind{of}", 0.5 * LOOP_BANDWIDTH * part
                yield VariedNumber(label, "1/s", 0.0, deviation, _entry("unreported", (own, axis, 1)))


def largest_unreported_part(motions: Sequence[RobotMotion]) -> float:
    """How far what accelerates a joint whose drive holds speeds strays from its mean within a cycle, relative."""
    return min(LOOP_BANDWIDTH * max(motion.sampling for motion in motions), LARGEST_UNREPORTED)


def _within_cycle(differences: ChannelDifferences) -> Iterator[VariedNumber]:
    """What an accelerometer that is read in step with drives that hold speeds reads more than the mean of their cycle.

    The robot's acceleration leaps and fades with their torques, evenly between the part above and the part below its mean. A
    sensor of 100 Hz beside joint_states of 200 Hz meets the same instant of the cycle for ever: no scale of the sensor.
    """
    motions = [motion for motion in differences.motions if np.any(motion.loops)]
    for k, axis in enumerate("xy" if motions else ""):
        deviation = largest_unreported_part(motions) / math.sqrt(3.0)
        yield VariedNumber(f"imu.report.{axis}", "1", 0.0, deviation, _entry("accelerometer_scale", k))


def _geometry(robot: RobotDescription) -> Iterator[Deviation]:
    for i, caster in enumerate(robot.casters):
        yield "wheel_radius", f"wheel_radius/{caster.name}", caster.wheel_radius, _radius(i)
        yield "steer_zero", f"steer_zero/{caster.name}", 0.0, _entry("steer_zero", i)
        for k, axis in enumerate("xy"):
            yield "caster_offset", f"caster_offset.{axis}/{caster.name}", 0.0, _entry("caster_offset", (i, k))
            yield "steer_axis", f"steer_axis.{axis}/{caster.name}", 0.0, _entry("steer_axis", (i, k))


def _fixed_axle(robot: RobotDescription) -> Iterator[Deviation]:
    """Where the axle of fixed wheels is along their heading, and which way they roll; along itself no axle is anywhere."""
    for axle in robot.fixed_axle:
        ahead = np.array([math.cos(axle[2]), math.sin(axle[2])])

        def moved(numbers: ModelNumbers, step: float, ahead: FloatArray = ahead) -> None:
            numbers.axle[0, :2] += step * ahead

        yield "fixed_wheels.position", "fixed_wheels.position", 0.0, moved
        yield "fixed_wheels.direction", "fixed_wheels.direction", 0.0, _entry("axle", (0, 2))


def _tracker(robot: RobotDescription) -> Iterator[Deviation]:
    """Where the tracked thing is mounted, if it is not base_link itself."""
    tracker = robot.sensors.tracker
    if tracker is None or tracker.position is None:
        return
    for k, axis in enumerate("xy"):
        yield "tracker.position", f"tracker.position.{axis}", 0.0, _entry("tracked", k)
    yield "tracker.yaw", "tracker.yaw", 0.0, _entry("tracked", 2)


def _dynamics(robot: RobotDescription, numbers: ModelNumbers) -> Iterator[Deviation]:
    first = robot.casters[0]
    yield "chassis.mass", "chassis.mass", robot.chassis.mass, _entry("chassis", 0)
    yield "chassis.com", "chassis.com.x", 0.0, _entry("chassis", 1)
    yield "chassis.com", "chassis.com.y", 0.0, _entry("chassis", 2)
    # By which loads move from wheel to wheel when the robot accelerates, and with them what the tyres give way.
    yield "chassis.com", "chassis.com.z", 0.0, _entry("com_height")
    yield "chassis.inertia_zz", "chassis.inertia_zz", robot.chassis.inertia_zz, _entry("chassis", 3)
    for label, column, nominal in (
        ("module.mass", 0, first.module.mass),
        ("module.inertia_zz", 3, first.module.inertia_zz),
        ("wheel.inertia_axle", 4, first.wheel.inertia_axle),
    ):
        yield label, label, nominal, _scaled(column, nominal, numbers.modules[:, column].copy())
    for axis, rotor in enumerate(AXIS_NAMES):
        armature = rotor_armature(robot, axis)
        if armature[0, axis, axis] > 0.0:
            yield "rotors", f"rotors.{rotor}", float(armature[0, axis, axis]), _rotor(armature, axis)
    for i, caster in enumerate(robot.casters):
        for axis, axis_name in enumerate(AXIS_NAMES):
            yield "torque_constant", f"torque_constant/{caster.name}_{axis_name}", 1.0, _gain(i, axis)


def _crosstalk(robot: RobotDescription) -> Iterator[VariedNumber]:
    """What drives whose torques were calibrated joint by joint, and not motor by motor, err by where gears are coupled."""
    known = math.sqrt(2.0) * robot.tolerance("torque_constant").value
    for i, (name, coupling) in enumerate(zip(robot.caster_names, robot.gear_coupling, strict=True)):
        if coupling[0, 1] and known:
            yield VariedNumber(f"{CROSSTALK}/{name}", "1", 0.0, known * abs(float(coupling[0, 1])), _entry("crosstalk", i))


def common_relaxation(robot: RobotDescription) -> float:
    """Return the relaxation length of the casters' tyres, the mean of them [m]."""
    return float(np.mean([tyre.relaxation_length for tyre in robot.tyres]))


def _tyres(robot: RobotDescription) -> Iterator[Deviation]:
    yield "contact.stiffness", "contact.stiffness", 1.0, _entry("softness")
    yield "contact.mu_p", "contact.mu_p", 1.0, _friction
    length = common_relaxation(robot)

    def relaxation(numbers: ModelNumbers, step: float) -> None:
        numbers.tyres[:, LENGTH] += step

    yield "contact.relaxation_length", "contact.relaxation_length", length, relaxation
    for i, caster in enumerate(robot.caster_names):
        for axis, axis_name in enumerate(AXIS_NAMES):
            yield "contact.stiffness_spread", f"contact.stiffness/{caster}_{axis_name}", 1.0, _entry("softness", (i, axis))


def _inertial_sensor() -> Iterator[Deviation]:
    yield "imu.scale", "imu.gyro_scale", 1.0, _entry("gyro_scale")
    yield "imu.gyro_bias", "imu.gyro_bias", 0.0, _entry("gyro_bias")
    for k, axis in enumerate("xy"):
        yield "imu.scale", f"imu.accelerometer_scale.{axis}", 1.0, _entry("accelerometer_scale", k)
        yield "imu.accelerometer_bias", f"imu.accelerometer_bias.{axis}", 0.0, _entry("accelerometer_bias", k)
        yield "imu.position", f"imu.position.{axis}", 0.0, _entry("imu_position", k)


def floor_nuisances(robot: RobotDescription, differences: ChannelDifferences) -> list[Nuisance]:
    """No floor is quite level: its inclination along both axes of the yaw."""
    layout, tolerance = differences.model.layout, robot.tolerance("ground.slope")
    if not (layout.balanced or layout.imu) or tolerance.value == 0.0:
        return []
    found = []
    for k, name in enumerate(FLOOR):
        change = np.zeros(3)
        change[k] = tolerance.value
        column = differences.of_lean(change) / tolerance.value
        found.append(Nuisance(name, tolerance.unit, 0.0, tolerance.value, column))
    return found
