"""Builds the regression problem of a robot: its channels, what a healthy one may differ in, and every candidate effect.

The channels are those of `rolling_model`. Every number of the description that may differ within its tolerance is a
nuisance column, and every effect a candidate; both by differences of the whole model, so that none is derived by hand.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from pcw_description.effects.effect import Effect
from pcw_description.effects.kinds import (
    ChassisForceEffect,
    DescriptionEffect,
    JointTorqueEffect,
)
from pcw_description.effects.registry import all_effects
from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, DRIVE, STEER, RobotDescription

from ..plants.true_robot import as_it_really_is
from .axis_channels import kernel_arguments
from .errors import MismatchError
from .regression_problem import (
    BoolArray,
    Channel,
    FloatArray,
    LinearParameter,
    Nuisance,
    RegressionProblem,
    Shape,
    Term,
)
from .robot_effects import SEEN_KINDS, ChannelModel, Sides, with_yaw, without_reading_errors
from .robot_motion import SHORTEST_SEGMENT, RobotMotion, choose_cutoff, read_motions
from .rolling_model import ModelNumbers, normal_forces, twists
from .signal_filter import SignalFilter, derivative

# Slip that the linear model may hold: a floor and a part of the speed (real robots: robots.md, last entry).
SLIP_FLOOR, SLIP_FRACTION = 0.03, 0.15
# By about this part the rolling model misjudges forces, whatever the noise: tyres are quasi-static in it, bodies do not lean
# on their springs. Seen as the error of friction concealed in simulated robots, which is more of one sign than noise makes it.
MODEL_DEVIATION = 0.007
STILL_SPEED = 0.2  # [rad/s]; joints slower than this may be held by dry friction of unknown size
DIRECTIONS = 8  # of a grid over all directions
# What a leftover may depend on that an effect of a kind explains.
VARIABLES_OF: dict[type[Effect], tuple[str, ...]] = {
    DescriptionEffect: ("acceleration",), ChassisForceEffect: ("speed", "v_x", "v_y"),
}  # fmt: skip
WRENCH = ("chassis_force/x", "chassis_force/y", "chassis_torque/z")


class RobotProblemBuilder:
    """Builds the regression problem of a robot from its recordings."""

    def __init__(
        self, robot: RobotDescription, recordings: Sequence[Recording], cutoff: float | None = None
    ) -> None:
        """Filter the recordings.

        Args:
            robot: the nominal robot.
            recordings: opened with this robot.
            cutoff: of the channel filter [Hz]; None chooses it from the noise of the encoders.

        Raises:
            MismatchError: neither torques nor an inertial sensor were recorded, or no piece is long enough.
        """
        self.robot = robot
        with_torque = all(
            r.joint_states.effort is not None and np.isfinite(r.joint_states.effort).any() for r in recordings
        )
        self.balanced = with_torque and bool(np.all(np.abs(robot.caster_offset[:, 0]) > 1e-3))
        self.cutoff = cutoff if cutoff is not None else choose_cutoff(robot, recordings)
        self.motions: list[RobotMotion] = []
        for index, recording in enumerate(recordings):
            self.motions += read_motions(robot, recording, index, self.cutoff, self.balanced)
        if not self.motions:
            raise MismatchError(f"no contiguous piece of at least {SHORTEST_SEGMENT:g} s in the recordings")
        self.filters = [SignalFilter(m.rate, self.cutoff) for m in self.motions]
        self.has_imu = any(np.isfinite(m.imu).any() for m in self.motions)
        if not self.balanced and not self.has_imu:
            raise MismatchError(
                "neither motor torques (effort in joint_states, of casters with an offset) nor imu/data were recorded; "
                "nothing can be compared"
            )
        # Numbers that effects in the description already change belong to the nominal model.
        described = as_it_really_is(robot)
        self.numbers = ModelNumbers.of(described)
        self.motions = with_yaw([without_reading_errors(robot, motion) for motion in self.motions], self.numbers)
        self.model = ChannelModel(described, self.numbers, self.balanced, self.has_imu)

    def channels(self) -> tuple[Channel, ...]:
        """Channels that these recordings can fill."""
        names = (
            [Channel(name, "N m" if "torque" in name else "N") for name in WRENCH] if self.balanced else []
        )
        if self.has_imu:
            names.append(Channel("gyro", "rad/s", axis="imu"))
            names += [Channel(f"accelerometer/{axis}", "m/s^2", axis="imu") for axis in "xy"]
        return tuple(names)

    # -- the problem --------------------------------------------------------------------------------------------

    def build(self, with_terms: bool = True) -> RegressionProblem:
        """Return the regression problem of all recordings.

        Args:
            with_terms: False leaves out candidate effects and variables: residual and tolerances alone are many times cheaper.
        """
        sides = self._nominal = [self.model.sides(motion) for motion in self.motions]
        measured = self._filtered([np.nan_to_num(side[0]) for side in sides])
        predicted = self._filtered([side[1] for side in sides])
        residual = measured - predicted - self._known_effects(measured.shape[1])
        valid = self._valid(sides)
        stamps = [f.decimate(m.time) for f, m in zip(self.filters, self.motions, strict=True)]
        return RegressionProblem(
            channels=self.channels(),
            time=np.concatenate(stamps),
            segment=np.concatenate([np.full(len(t), i) for i, t in enumerate(stamps)]),
            recording=np.concatenate(
                [np.full(len(t), m.recording) for t, m in zip(stamps, self.motions, strict=True)]
            ),
            rate=float(np.mean([f.decimated_rate for f in self.filters])),
            measured=measured,
            residual=residual,
            valid=valid,
            nuisances=tuple(self._nuisances(sides)),
            terms=tuple(self._terms(measured)) if with_terms else (),
            variables=self._variables() if with_terms else {},
            scale_deviation=self._scale_deviation(),
        )

    def _scale_deviation(self) -> float:
        """Relative deviation of what all torque constants share, and of what the model neglects."""
        shared = self.robot.tolerance("torque_constant").value / float(np.sqrt(2 * self.robot.n))
        return float(np.hypot(shared, MODEL_DEVIATION)) if self.balanced else 0.0

    def _filtered(self, pieces: Sequence[FloatArray]) -> FloatArray:
        return np.concatenate([f.apply(piece) for f, piece in zip(self.filters, pieces, strict=True)])

    def _valid(self, sides: Sequence[Sides]) -> BoolArray:
        """Samples (T, C) that the rolling model can judge: moving, no gross slip, sensor there."""
        pieces = []
        numbers = self.numbers
        for motion, (measured, _) in zip(self.motions, sides, strict=True):
            steer_angle = np.ascontiguousarray(motion.position[:, :, STEER])
            twist, slip = twists(
                numbers.steer_axis, numbers.caster_offset, numbers.radius, steer_angle, motion.velocity
            )
            speed = np.hypot(twist[:, 0], twist[:, 1]) + np.abs(twist[:, 2]) * np.max(
                np.linalg.norm(numbers.steer_axis, axis=1)
            )
            bad = slip > SLIP_FLOOR + SLIP_FRACTION * speed
            if self.balanced:
                bad |= np.all(np.abs(motion.velocity[:, :, DRIVE]) < STILL_SPEED, axis=1)
            pieces.append(bad[:, None] | ~np.isfinite(measured))
        return self._filtered([piece.astype(float) for piece in pieces]) < 0.1

    def _difference(
        self, sides: Sequence[Sides], numbers: ModelNumbers, step: float
    ) -> FloatArray:
        """Column (T, C) of a number: what the residual of the nominal model holds per unit of its deviation."""
        pieces = []
        for motion, (measured, predicted) in zip(self.motions, sides, strict=True):
            changed_measured, changed_predicted = self.model.sides(motion, numbers)
            pieces.append(
                np.nan_to_num(((measured - predicted) - (changed_measured - changed_predicted)) / step)
            )
        return self._filtered(pieces)

    def _nuisances(self, sides: Sequence[Sides]) -> list[Nuisance]:
        nuisances = []
        for name, unit, nominal, deviation, vary in self._deviations():
            numbers = copy.deepcopy(self.numbers)
            step = 0.5 * deviation
            vary(numbers, step)
            nuisances.append(Nuisance(name, unit, nominal, deviation, self._difference(sides, numbers, step)))
        return nuisances + self._floor(sides)

    def _floor(self, sides: Sequence[Sides]) -> list[Nuisance]:
        """No floor is quite level: its inclination along both axes of the yaw."""
        tolerance = self.robot.tolerance("ground.slope")
        found = []
        for k, axis_name in enumerate("xy"):
            change = np.zeros(3)
            change[k] = tolerance.value
            pieces = []
            for motion, (measured, predicted) in zip(self.motions, sides, strict=True):
                leaning = measured.copy(), predicted.copy()
                self.model.lean(motion, change, *leaning)
                difference = (measured - predicted) - (leaning[0] - leaning[1])
                pieces.append(np.nan_to_num(difference / tolerance.value))
            column = self._filtered(pieces)
            found.append(Nuisance(f"ground.slope.{axis_name}", tolerance.unit, 0.0, tolerance.value, column))
        return found

    def _deviations(self) -> list[tuple[str, str, float, float, Callable[[ModelNumbers, float], None]]]:
        """Name, unit, nominal value, tolerance and variation of every number that a healthy robot may differ in."""
        robot = self.robot
        found: list[tuple[str, str, float, float, Callable[[ModelNumbers, float], None]]] = []

        def number(
            tolerance: str, label: str, nominal: float, vary: Callable[[ModelNumbers, float], None]
        ) -> None:
            known = robot.tolerance(tolerance)
            deviation = known.value * abs(nominal) if known.relative else known.value
            if deviation > 0.0:
                found.append((label, known.unit, nominal, deviation, vary))

        def entry(
            array: str, index: int | tuple[int, ...] | tuple[slice, int]
        ) -> Callable[[ModelNumbers, float], None]:
            def vary(numbers: ModelNumbers, step: float) -> None:
                getattr(numbers, array)[index] += step

            return vary

        def scaled(array: str, column: int, nominal: float) -> Callable[[ModelNumbers, float], None]:
            def vary(numbers: ModelNumbers, step: float) -> None:
                getattr(numbers, array)[:, column] *= 1.0 + step / nominal

            return vary

        if self.balanced:
            first = robot.casters[0]

            def lag(numbers: ModelNumbers, step: float) -> None:
                numbers.torque_lag += step

            # A drive reports the torque of some instant within its own cycle; nobody knows which.
            found.append(("torque_lag", "s", 0.0, max(m.sampling for m in self.motions), lag))
            number("chassis.mass", "chassis.mass", robot.chassis.mass, entry("chassis", 0))
            number("chassis.com", "chassis.com.x", 0.0, entry("chassis", 1))
            number("chassis.com", "chassis.com.y", 0.0, entry("chassis", 2))
            number("chassis.inertia_zz", "chassis.inertia_zz", robot.chassis.inertia_zz, entry("chassis", 3))
            number("module.mass", "module.mass", first.module.mass, scaled("modules", 0, first.module.mass))
            number(
                "module.inertia_zz",
                "module.inertia_zz",
                first.module.inertia_zz,
                scaled("modules", 3, first.module.inertia_zz),
            )
            number(
                "wheel.inertia_axle",
                "wheel.inertia_axle",
                first.wheel.inertia_axle,
                scaled("modules", 4, first.wheel.inertia_axle),
            )
            for rotor, column in (("drive", 5), ("steer", 7)):
                inertia = float(self.numbers.modules[0, column])
                if inertia > 0.0:
                    number("rotors", f"rotors.{rotor}", inertia, scaled("modules", column, inertia))
        for i, caster in enumerate(robot.casters):
            number("wheel_radius", f"wheel_radius/{caster.name}", caster.wheel_radius, self._radius(i))
            number("steer_zero", f"steer_zero/{caster.name}", 0.0, entry("steer_zero", i))
            if self.balanced:
                number("caster_offset", f"caster_offset.x/{caster.name}", 0.0, entry("caster_offset", (i, 0)))
                for axis, axis_name in enumerate(AXIS_NAMES):
                    number("torque_constant", f"torque_constant/{caster.name}_{axis_name}", 1.0, self._gain(i, axis))
        if self.has_imu:

            def scale(numbers: ModelNumbers, step: float) -> None:
                numbers.gyro_scale += step

            def bias(numbers: ModelNumbers, step: float) -> None:
                numbers.gyro_bias += step

            number("imu.scale", "imu.gyro_scale", 1.0, scale)
            number("imu.gyro_bias", "imu.gyro_bias", 0.0, bias)
            for k, axis_name in enumerate("xy"):
                number(
                    "imu.accelerometer_bias",
                    f"imu.accelerometer_bias.{axis_name}",
                    0.0,
                    entry("accelerometer_bias", k),
                )
                number("imu.position", f"imu.position.{axis_name}", 0.0, entry("imu_position", k))
            if self.balanced:

                def slip(numbers: ModelNumbers, step: float) -> None:
                    numbers.slip += step

                number("contact.stiffness", "contact.stiffness", 1.0, slip)
        return found

    def _radius(self, index: int) -> Callable[[ModelNumbers, float], None]:
        """Vary a wheel's radius in the kinematics and in the dynamics, which holds its own copy."""

        def vary(numbers: ModelNumbers, step: float) -> None:
            numbers.radius[index] += step
            numbers.modules[index, 8] += step

        return vary

    def _gain(self, index: int, axis: int) -> Callable[[ModelNumbers, float], None]:
        """Vary a torque constant against the mean of all.

        What they share cannot be told from the masses. Left free it would be fitted below its value, since whoever scales
        down all measured forces scales down their noise with them.
        """

        def vary(numbers: ModelNumbers, step: float) -> None:
            numbers.gain[index, axis] += step
            numbers.gain -= step / numbers.gain.size

        return vary

    # -- effects ------------------------------------------------------------------------------------------------

    def _joint_columns(
        self, effect: JointTorqueEffect, casters: Sequence[int], shape: Shape, at: str | None = None
    ) -> FloatArray:
        """Columns (T, C, P) of an effect at work on some casters with common parameters, at the axis `at` or its own."""
        axis = AXIS_NAMES.index(at or effect.axis)
        width = len(self.channels())
        names = [parameter.name for parameter in effect.linear_parameters]
        pieces = []
        # Small against the weight, so that the tyres' curves stay straight.
        scales = [
            1e-2
            * self.robot.total_mass
            * float(np.mean(self.numbers.radius))
            / self._torque_size(effect, name, shape)
            for name in names
        ]
        for motion, normal, nominal in zip(self.motions, self._normal, self._nominal, strict=True):
            columns = np.zeros((len(motion.time), width, len(names)))
            torques = np.zeros((len(names), len(motion.time), self.robot.n, 2))
            for i in casters:
                by_name = effect.regressor(
                    motion.position[:, i, axis],
                    motion.velocity[:, i, axis],
                    motion.torque[:, i, axis],
                    normal[:, i],
                    shape,
                )
                for k, name in enumerate(names):
                    torques[k, :, i, axis] = by_name[name]
            measured, predicted = nominal
            for k, scale in enumerate(scales):
                with_effect = self.model.sides(motion, added_torque=scale * torques[k])
                difference = (measured - predicted) - (with_effect[0] - with_effect[1])
                columns[:, :, k] = np.nan_to_num(difference) / scale
            pieces.append(columns)
        return self._filtered(pieces)

    def _torque_size(self, effect: JointTorqueEffect, name: str, shape: Shape) -> float:
        """Rough size [N m] of the torque that one unit of a parameter makes."""
        axis = AXIS_NAMES.index(effect.axis)
        motion, normal = self.motions[0], self._normal[0]
        column = effect.regressor(
            motion.position[:, 0, axis],
            motion.velocity[:, 0, axis],
            motion.torque[:, 0, axis],
            normal[:, 0],
            shape,
        )[name]
        return max(float(np.sqrt(np.mean(column**2))), 1e-9)

    @property
    def _normal(self) -> list[FloatArray]:
        """Normal forces (T, n) along every motion, computed once."""
        if not hasattr(self, "_normal_cache"):
            self._normal_cache = []
            numbers = self.numbers
            for motion in self.motions:
                angle = np.ascontiguousarray(motion.position[:, :, STEER])
                twist, _ = twists(
                    numbers.steer_axis, numbers.caster_offset, numbers.radius, angle, motion.velocity
                )
                twist_dot = derivative(twist, motion.rate)
                acceleration = twist_dot[:, :2] + twist[:, 2:] * np.stack([-twist[:, 1], twist[:, 0]], axis=1)
                self._normal_cache.append(normal_forces(numbers, angle, acceleration))
        return self._normal_cache

    def _known_effects(self, width: int) -> FloatArray:
        """What torques on joints that the description already holds add to the residual, (T, C)."""
        total = np.zeros(
            (sum(len(f.decimate(m.time)) for f, m in zip(self.filters, self.motions, strict=True)), width)
        )
        for instance in self.robot.physics:
            effect = all_effects()[instance.name]
            if self.balanced and isinstance(effect, JointTorqueEffect):
                casters = [self.robot.caster_index(name) for name in instance.target]
                shape = {p.name: instance.parameters[p.name] for p in effect.nonlinear_parameters}
                weights = np.array([instance.parameters[p.name] for p in effect.linear_parameters])
                total += self._joint_columns(effect, casters, shape, instance.axis) @ weights
        return total

    def _effect_difference(self, effect: Effect, target: Sequence[str], values: Mapping[str, float]) -> FloatArray:
        """What an effect that is no torque on a joint adds to the residual, (T, C)."""
        pieces = []
        for motion, plain in zip(self.motions, self._nominal, strict=True):
            changed = self.model.sides_with(motion, plain, effect, target, values)
            pieces.append(np.nan_to_num((plain[0] - plain[1]) - (changed[0] - changed[1])))
        return self._filtered(pieces)

    def _terms(self, measured: FloatArray) -> list[Term]:
        if not self.balanced:
            # Without forces nothing tells how much the wheels slip, and slip would be taken for an effect.
            return []
        terms = []
        casters: list[tuple[str, ...]] = [*((name,) for name in self.robot.caster_names), self.robot.caster_names]
        size = np.sqrt(np.mean(measured[:, :3] ** 2))
        for effect in all_effects().values():
            groups = casters if effect.target_kind == "caster" else [(effect.target_kind,)]
            if isinstance(effect, JointTorqueEffect):
                shapes = self._shapes(effect)
                for target in groups if shapes is not None else ():
                    indices = [self.robot.caster_index(name) for name in target]
                    terms.append(self._joint_term(effect, target, indices, shapes or (), float(size)))
            elif isinstance(effect, SEEN_KINDS) and effect.searched_parameters:
                terms += [term for target in groups if (term := self._difference_term(effect, target)) is not None]
        return terms

    def _shapes(self, effect: JointTorqueEffect) -> tuple[dict[str, float], ...] | None:
        """Grid of an effect's shaping parameters, or None for effects whose search does not pay on a rolling robot."""
        shapes: list[dict[str, float]] = [{}]
        axis = AXIS_NAMES.index(effect.axis)
        speeds = np.concatenate([np.abs(m.velocity[:, :, axis]).ravel() for m in self.motions])
        top = float(np.quantile(speeds, 0.98))
        for parameter in effect.nonlinear_parameters:
            if parameter.default is not None:
                shapes = [{**shape, parameter.name: parameter.default} for shape in shapes]
            elif parameter.unit == "rad/s":
                shapes = [
                    {**shape, parameter.name: float(v)}
                    for shape in shapes
                    for v in np.geomspace(0.05, 0.5, 4) * top
                ]
            else:
                return None
        return tuple(shapes)

    def _joint_term(
        self,
        effect: JointTorqueEffect,
        target: tuple[str, ...],
        casters: list[int],
        shapes: tuple[dict[str, float], ...],
        size: float,
    ) -> Term:
        def columns(shape: Shape) -> FloatArray:
            return self._joint_columns(effect, casters, shape)

        first = columns(shapes[0])
        variable = {
            "position": "angle",
            "velocity": "velocity",
            "force": "torque",
            "normal_force": "normal_force",
        }
        parameters = []
        for k, parameter in enumerate(effect.linear_parameters):
            scale = float(np.sqrt(np.mean(first[:, :3, k] ** 2)))
            parameters.append(
                LinearParameter(
                    parameter.name,
                    parameter.unit,
                    parameter.lower,
                    parameter.upper,
                    size / max(scale, 1e-12),
                    refinement=parameter.name == "asymmetry",
                )
            )
        return Term(
            effect=effect.name,
            log_prior=effect.log_prior,
            target=target,
            parameters=tuple(parameters),
            shapes=shapes,
            columns=columns,
            arguments=tuple(
                f"{effect.axis}_{variable[argument]}/{name}"
                for argument in kernel_arguments(effect.name)
                for name in target
            ),
            resolution={p.name: ("log", 2.15) for p in effect.nonlinear_parameters if p.default is None},
        )

    def _difference_term(self, effect: Effect, target: tuple[str, ...]) -> Term | None:
        """A candidate by differences of the whole channel model; None if no channel shows it."""
        shapes, resolution = self._grid(effect)
        if not shapes:
            return None
        searched = effect.searched_parameters

        def columns(shape: Shape, names: Sequence[str]) -> FloatArray:
            none = {p.name: 0.0 for p in searched}
            found = []
            for name in names:
                step = 0.1 * effect.parameter(name).typical
                values = {**shape, **none, name: step}
                found.append(self._effect_difference(effect, target, values) / step)
            return np.stack(found, axis=2)

        everything = columns(shapes[0], [p.name for p in searched])
        shown = [p for k, p in enumerate(searched) if np.abs(everything[:, :, k]).max() > 0.0]
        if not shown:
            return None
        names = [p.name for p in shown]
        return Term(
            effect=effect.name,
            log_prior=effect.log_prior,
            target=target,
            shapes=shapes,
            columns=lambda shape: columns(shape, names),
            arguments=VARIABLES_OF.get(type(effect), ()),
            parameters=tuple(LinearParameter(p.name, p.unit, p.lower, p.upper, 3.0 * p.typical) for p in shown),
            resolution=resolution,
        )

    def _grid(self, effect: Effect) -> tuple[tuple[dict[str, float], ...], dict[str, tuple[str, float]]]:
        """Grid of the shaping parameters of an effect and its spacing; empty where there is none to search on.

        Places on the robot and directions have one; everything else is left at its default.
        """
        reach = np.max(np.abs(self.robot.steer_axis), axis=0)
        searched = {p.name for p in effect.searched_parameters}
        shapes: list[dict[str, float]] = [{}]
        resolution: dict[str, tuple[str, float]] = {}
        for parameter in effect.parameters:
            if parameter.name in searched:
                continue
            values = [parameter.default]
            if parameter.name in ("x", "y"):
                span = float(reach["xy".index(parameter.name)])
                values = [-0.7 * span, 0.0, 0.7 * span]
                resolution[parameter.name] = ("linear", 0.35 * span)
            elif parameter.unit == "rad" and parameter.upper - parameter.lower > math.tau:
                values = [k * math.tau / DIRECTIONS for k in range(DIRECTIONS)]
                resolution[parameter.name] = ("linear", 0.5 * math.tau / DIRECTIONS)
            shapes = [{**shape, parameter.name: value} for shape in shapes for value in values if value is not None]
        return tuple(shapes), resolution

    def _variables(self) -> dict[str, FloatArray]:
        """What a leftover may depend on, each (T,)."""
        numbers = self.numbers
        variables: dict[str, list[FloatArray]] = {}

        def put(name: str, filter_: SignalFilter, values: FloatArray) -> None:
            variables.setdefault(name, []).append(filter_.apply(values))

        for filter_, motion, normal in zip(self.filters, self.motions, self._normal, strict=True):
            angle = np.ascontiguousarray(motion.position[:, :, STEER])
            twist, _ = twists(
                numbers.steer_axis, numbers.caster_offset, numbers.radius, angle, motion.velocity
            )
            variables.setdefault("time", []).append(filter_.decimate(motion.time))
            put("speed", filter_, np.hypot(twist[:, 0], twist[:, 1]))
            for k, name in enumerate(("v_x", "v_y", "omega")):
                put(name, filter_, twist[:, k])
            for i, caster in enumerate(self.robot.caster_names):
                put(f"steer_angle/{caster}", filter_, np.ascontiguousarray(angle[:, i]))
                put(f"drive_angle/{caster}", filter_, np.ascontiguousarray(motion.position[:, i, DRIVE]))
                put(f"drive_normal_force/{caster}", filter_, np.ascontiguousarray(normal[:, i]))
                for axis, axis_name in enumerate(AXIS_NAMES):
                    put(
                        f"{axis_name}_velocity/{caster}",
                        filter_,
                        np.ascontiguousarray(motion.velocity[:, i, axis]),
                    )
                    put(
                        f"{axis_name}_torque/{caster}",
                        filter_,
                        np.ascontiguousarray(motion.torque[:, i, axis]),
                    )
        return {name: np.concatenate(parts) for name, parts in variables.items()}
