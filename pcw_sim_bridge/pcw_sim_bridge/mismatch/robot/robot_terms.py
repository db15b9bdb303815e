"""Every effect that a robot's channels can show, as a candidate with its columns.

An effect on joints is a candidate at each caster and at all of them together, on each axis that it can stand at. Its
columns are differences of the channels with it at work, by the effect's own function. Parameters that shape an effect
are searched on a grid where there is one to search on; everything else is left at its default.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.effect import Effect, EffectParameter
from pcw_description.effects.kinds import (
    ActuatorEffect,
    ChassisForceEffect,
    ClockEffect,
    ContactEffect,
    DescriptionEffect,
    EncoderEffect,
    GravityEffect,
    ImuEffect,
    JointTorqueEffect,
    TransmissionEffect,
)
from pcw_description.effects.low_friction_patch import EDGE
from pcw_description.effects.registry import all_effects
from pcw_description.robot_description import AXIS_NAMES, RobotDescription

from ..all_cores import on_all_cores
from ..axis.axis_channels import kernel_arguments
from ..regression.composed_columns import Columns, Placed, Turning, frozen
from ..regression.regression_problem import FloatArray, LinearParameter, Shape, Term, term_key
from .channel_differences import ChannelDifferences
from .first_look import Chosen, ChosenShapes, Looked, common_orders, orders, patches, waves, windows
from .robot_effects import signals_of, torque_along
from .robot_nuisances import CHANGED_BY, FLOOR

DIRECTIONS = 8  # of a grid over all directions
HEIGHTS = 0.5  # of the typical height, the distance of neighbours
LARGEST_TWIST = 0.5  # [rad], of a gear under its joint's largest torque; one that gives way by more is none, or has play
TURNED = 0.3  # [rad], of a ripple's phase, by a zero of the steering that was re-tuned; less is a detail
LEANING = 2e-4  # [rad], of a floor that was re-tuned; what it adds to an accelerometer is lost in the noise of most
# Of itself, by which a play in a gear is known at best: when a motor runs free is seen through the channels' filter, and one
# of a steering does so more often than one of a drive.
OF_A_PLAY = {"drive": 0.08, "steer": 0.12}
SQUARED_STEP = 0.5  # of the typical size, where what is in proportion to its square is taken: below it there is none
# What a leftover may depend on that an effect of a kind explains.
VARIABLES_OF: dict[type[Effect], tuple[str, ...]] = {
    DescriptionEffect: ("acceleration",), ChassisForceEffect: ("speed", "v_x", "v_y"),
}  # fmt: skip
_ARGUMENT_NAMES = {"position": "angle", "velocity": "velocity", "force": "torque", "normal_force": "normal_force"}


def robot_terms(
    robot: RobotDescription, differences: ChannelDifferences, looked: Looked, exact_clocks: bool = False,
    keys: Collection[str] | None = None,
) -> list[Term]:
    """Return all candidates whose effects show in the channels.

    Args:
        robot: the nominal robot.
        differences: what its channels differ by.
        looked: what a first look needs.
        exact_clocks: the problem's exact residual holds what clocks are off by.
        keys: of those that are wanted, see `term_key`; None: all.
    """
    return _TermMaker(robot, differences, looked, exact_clocks).terms(keys)


class _TermMaker:
    """Makes the candidates of one problem."""

    def __init__(
        self, robot: RobotDescription, differences: ChannelDifferences, looked: Looked, exact_clocks: bool
    ) -> None:
        self.robot, self.differences, self.looked, self.exact_clocks = robot, differences, looked, exact_clocks
        self.layout = differences.model.layout
        self._of_joint: dict[tuple[int, int], Chosen] = {}

    def terms(self, keys: Collection[str] | None) -> list[Term]:
        """The candidates of some keys; None: of all."""
        # Of one caster, each and all are the same.
        everything = list(dict.fromkeys([*((name,) for name in self.robot.caster_names), self.robot.caster_names]))
        wanted: list[tuple[Effect, tuple[str, ...], str | None, int | None]] = []
        recordings = np.unique(self.looked.recording).tolist()
        for effect in all_effects().values():
            if isinstance(effect, ActuatorEffect):
                continue
            targets = everything if effect.target_kind == "caster" else [(effect.target_kind,)]
            if _look_of(effect) in ("patches", "waves"):  # the floor is under all wheels
                targets = [self.robot.caster_names]
            # What comes from outside at one time may come in one recording alone, or in each as if it were simulated.
            occasions = [None, *recordings] if _look_of(effect) == "windows" and len(recordings) > 1 else [None]
            wanted += [
                (effect, target, axis, occasion)
                for axis in effect.axes or (None,)
                for target in targets
                for occasion in occasions
            ]
        if keys is not None:
            wanted = [one for one in wanted if term_key(one[0].name, *one[1:]) in keys]
        return [term for term in on_all_cores(lambda one: self._term(*one), wanted) if term is not None]

    def _term(self, effect: Effect, target: tuple[str, ...], axis: str | None, recording: int | None) -> Term | None:
        if isinstance(effect, JointTorqueEffect):
            return self._joint_term(effect, target, axis)
        return self._difference_term(effect, target, axis, recording)

    # -- torques on joints --------------------------------------------------------------------------------------

    def _joint_term(self, effect: JointTorqueEffect, target: tuple[str, ...], axis: str | None) -> Term | None:
        if not self.layout.balanced:
            return None
        shapes, among = self._shapes(effect, target, axis)
        if not shapes:
            return None

        def columns(shape: Shape) -> FloatArray:
            return self._joint_columns(effect, target, axis, shape)

        first = columns(shapes[0])
        if not first.any():
            return None
        balance = self.layout.balance
        size = np.sqrt(np.mean(self.differences.measured[:, balance] ** 2))
        parameters = []
        for k, parameter in enumerate(effect.linear_parameters):
            scale = float(np.sqrt(np.mean(first[:, balance, k] ** 2)))
            deviation = float(size) / max(scale, 1e-12)
            parameters.append(
                LinearParameter(
                    parameter.name, parameter.unit, parameter.lower, parameter.upper, deviation,
                    refinement=parameter.name == "asymmetry",
                )
            )
        arguments = [_ARGUMENT_NAMES[argument] for argument in kernel_arguments(effect.name)]
        orders = [shape[p.name] for shape in shapes for p in effect.nonlinear_parameters if p.unit == "1/rad"]
        searched = [p for p in effect.nonlinear_parameters if p.default is None]

        def headed(changes: Mapping[str, float]) -> Columns | None:
            turned = [changes.get(f"steer_zero/{name}", 0.0) for name in target]
            if max(map(abs, turned)) * max(orders) < TURNED:
                return None
            return lambda shape: self._joint_columns(effect, target, axis, shape, turned)

        return Term(
            effect=effect.name,
            axis=axis,
            log_prior=effect.log_prior,
            target=target,
            parameters=tuple(parameters),
            shapes=shapes,
            columns=_once_more(shapes[0], first, columns),
            arguments=tuple(f"{axis or effect.axis}_{argument}/{name}" for argument in arguments for name in target),
            resolution={p.name: self._spacing(p, target, axis or effect.axis) for p in searched},
            repeatable=among > 0,
            grid_size=among,
            is_exact=True,
            at_joints=True,
            noisy="force" in kernel_arguments(effect.name),
            headed=headed if orders and (axis or effect.axis) == "steer" else None,
        )

    def _joint_columns(
        self, effect: JointTorqueEffect, target: Sequence[str], axis: str | None, shape: Shape,
        turned: Sequence[float] | None = None,
    ) -> FloatArray:
        """Columns (T, C, P) of an effect at work on some casters with common parameters, each turned [rad] by so much."""
        column = AXIS_NAMES.index(axis or effect.axis)
        casters = [self.robot.caster_index(name) for name in target]
        torques = []

        def parts(position: FloatArray, velocity: FloatArray, force: FloatArray, load: FloatArray) -> FloatArray:
            by_name = effect.regressor(position, velocity, force, load, shape)
            return np.stack([by_name[p.name] for p in effect.linear_parameters], axis=1)

        for motion, normal in zip(self.differences.motions, self.differences.normal, strict=True):
            found = np.zeros((*motion.position.shape, len(effect.linear_parameters)))
            for i, by in zip(casters, turned or len(casters) * [0.0], strict=True):
                signals = motion.position[:, i], motion.velocity[:, i], motion.balanced_torque[:, i]
                (position, *others), row = signals_of(effect, column, self.robot.gear_coupling[i], signals)
                along = torque_along(effect, (position + by, *others, normal[:, i]), parts)
                found[:, i] = row[:, None] * along[:, None, :]
            torques.append(found)
        return self.differences.of_torque(torques)

    def _shapes(
        self, effect: JointTorqueEffect, target: Sequence[str], axis_name: str | None
    ) -> tuple[tuple[dict[str, float], ...], int]:
        """Grid of an effect's shaping parameters, and how many it was chosen from; empty where there is none to search on."""
        shapes: list[dict[str, float]] = [{}]
        axis, among = AXIS_NAMES.index(axis_name or effect.axis), 0
        speeds = np.concatenate([np.abs(motion.velocity[:, :, axis]).ravel() for motion in self.differences.motions])
        top = float(np.quantile(speeds, 0.98))
        for parameter in effect.nonlinear_parameters:
            if parameter.default is not None:
                values = [parameter.default]
            elif parameter.unit == "rad/s":
                values = [float(value) for value in np.geomspace(0.05, 0.5, 4) * top]
            elif parameter.unit == "1/rad":
                chosen = self._common_orders([self.robot.caster_index(name) for name in target], axis)
                values, among = [float(value) for value in chosen.values], chosen.among
            else:
                return (), 0
            shapes = [{**shape, parameter.name: value} for shape in shapes for value in values]
        return tuple(shapes), among * max(len(shapes), 1)

    def _common_orders(self, casters: Sequence[int], axis: int) -> Chosen:
        """Orders of the ripples that most of some joints have; a single one is also asked for what most of all have."""
        each = {i: self._orders(i, axis) for i in casters}
        common = self._of_most(casters, axis)
        if len(casters) == 1 and common:
            own, width = list(common), self._width(casters[0], axis)
            common += [o for o in self._of_most(range(self.robot.n), axis) if all(abs(o - other) > width for other in own)]
        return Chosen(np.array(common), max(chosen.among for chosen in each.values()))

    def _of_most(self, casters: Sequence[int], axis: int) -> list[float]:
        """Orders that most of the joints have which turned far enough to tell."""
        able = [i for i in casters if len(self._orders(i, axis).values)]
        return common_orders([self._orders(i, axis).values for i in able], [self._width(i, axis) for i in able])

    def _width(self, i: int, axis: int) -> float:
        """How far two orders may differ that a joint does not tell apart [1/rad]."""
        return math.tau / max(float(np.ptp(self.looked.angle[:, i, axis])), 1e-9)

    def _spacing(self, parameter: EffectParameter, target: Sequence[str], axis: str) -> tuple[str, float]:
        """Spacing of the grid of a shaping parameter; of an order, a quarter of what the joint that turned farthest tells."""
        if parameter.unit != "1/rad":
            return "log", 2.15
        return "linear", 0.25 * min(self._width(self.robot.caster_index(name), AXIS_NAMES.index(axis)) for name in target)

    def _orders(self, i: int, axis: int) -> Chosen:
        """Orders of the ripples that a torque at one joint would have to have, to be in what is left."""
        if (i, axis) not in self._of_joint:
            response = self.differences.of_unit_torque(i, axis)
            held, _ = self.looked.held_against(response[:, :, None])
            chosen = orders(held[:, 0], self.looked.angle[:, i, axis], self.looked.rate)
            # A ripple that the description holds may be larger or smaller.
            described = self._described_orders(i, axis)
            self._of_joint[i, axis] = dataclasses.replace(chosen, values=np.concatenate([described, chosen.values]))
        return self._of_joint[i, axis]

    def _described_orders(self, i: int, axis: int) -> FloatArray:
        """Orders of the ripples that the description holds at one joint."""
        own = self.robot.caster_names[i], AXIS_NAMES[axis]
        return np.array([
            instance.parameters["order"] for instance in self.robot.physics
            if "order" in instance.parameters and own[0] in instance.target
            and (instance.axis or all_effects()[instance.name].axis) == own[1]
        ])  # fmt: skip

    # -- everything else ----------------------------------------------------------------------------------------

    def _difference_term(
        self, effect: Effect, target: tuple[str, ...], axis: str | None, recording: int | None
    ) -> Term | None:
        """A candidate by differences of the whole channel model, in one recording or all; None if no channel shows it."""
        searched = self._searched(effect)
        if not searched or (isinstance(effect, ContactEffect) and not (self.layout.balanced or self._rolls_unevenly(effect))):
            return None
        stands = target == ("chassis",) and not isinstance(effect, GravityEffect)
        if self.layout.lifted and (isinstance(effect, ContactEffect) or stands):
            return None  # no wheel touches the ground, and the chassis shows nothing but how it leans
        if not (self.layout.balanced or self.layout.imu) and target == ("chassis",):
            return None  # loads and slopes would show as what tyres slip under forces that nobody measured
        if isinstance(effect, TransmissionEffect) and not self._has_rotors(target, axis or effect.axis):
            return None
        neutral = {p.name: self._neutral(p, target) for p in searched}
        if any(math.isnan(value) for value in neutral.values()):
            return None
        look = _look_of(effect)
        looked = self.looked if recording is None else self.looked.only(recording)
        chosen = self._looked_for(looked, effect, look, neutral) if look else self._grid(effect)
        if chosen is None or not chosen.shapes:
            return None
        shapes = chosen.shapes

        own = np.full(len(looked.time), True) if recording is None else looked.recording == recording

        def columns(shape: Shape, names: Sequence[str], lean: FloatArray | None = None) -> FloatArray:
            found = np.stack([self._difference(effect, target, axis, shape, neutral, name, lean) for name in names], axis=2)
            return np.where(own[:, None, None], found, 0.0)

        everything = columns(shapes[0], [p.name for p in searched])
        seen = np.abs(everything).max(axis=(0, 1)) > 0.0
        if not seen.any():
            return None
        shown = [self._sensible(p, effect, target, axis) for p, visible in zip(searched, seen, strict=True) if visible]
        names = [p.name for p in shown]
        remembered = _once_more(shapes[0], everything[:, :, seen], lambda shape: columns(shape, names))
        turning = next((p.name for p in effect.parameters if p.name in chosen.resolution and p.is_direction), None)

        def leaning(changes: Mapping[str, float]) -> Columns | None:
            lean = np.array([*(changes.get(name, 0.0) for name in FLOOR), 0.0])
            if np.abs(lean).max() < LEANING:
                return None
            return lambda shape: columns(shape, names, lean)

        return Term(
            effect=effect.name,
            axis=axis,
            log_prior=effect.log_prior,
            target=target,
            shapes=shapes,
            columns=self._put_together(remembered, chosen, turning),
            arguments=VARIABLES_OF.get(type(effect), ()),
            parameters=tuple(
                dataclasses.replace(_linear(p, neutral[p.name], room), sum_of=_changed(effect, p, target))
                for p, room in zip(shown, self._room(everything[:, :, seen]), strict=True)
            ),
            # A shift of noisy samples is no column: see `ClockEffect` in robot_effects. A secant would be one.
            is_exact=not isinstance(effect, ClockEffect) or self.exact_clocks,
            is_curved=not (isinstance(effect, ClockEffect) and self.exact_clocks),
            resolution=chosen.resolution,
            blur=self._blur_of_times() if look == "windows" else _blur_of_borders() if look == "patches" else {},
            unsure={"play": OF_A_PLAY[axis or effect.axis]} if "play" in names else {},
            settled=_heights(effect) if {"x", "y"} == set(chosen.resolution) else {},
            grid_size=chosen.among,
            turning=turning is not None,
            # Where no torque was measured, tyres slip under the forces that the motion asks for, and its noise is in these.
            noisy=isinstance(effect, TransmissionEffect) or (effect.name.startswith("tyre_") and not self.layout.balanced),
            unlike_errors=(
                "play" in names
                or (isinstance(effect, EncoderEffect) and turning is not None)
                or (isinstance(effect, DescriptionEffect) and effect.target_kind == "imu")
            ),
            once=look in ("windows", "patches"),
            recording=recording,
            headed=leaning if isinstance(effect, ImuEffect) else None,
        )

    def _blur_of_times(self) -> dict[str, float]:
        """Standard deviations [s] of when something begins, and how long it lasts, of which samples are all that is known.

        Simulators begin it with a step of theirs, and stamps of a real robot say when a sample was sent: without this an
        interval is that of a clock without steps, a tenth of a sample wide.
        """
        deviation = 1.0 / (min(motion.rate for motion in self.differences.motions) * math.sqrt(12.0))
        return {"start": deviation, "duration": math.sqrt(2.0) * deviation}

    def _sensible(
        self, parameter: EffectParameter, effect: Effect, target: Sequence[str], axis: str | None
    ) -> EffectParameter:
        """The parameter with the bounds that it has on this robot.

        A gear that twists and one that plays are alike where torques are small, and the softest of all fits most noise.
        """
        if not isinstance(effect, TransmissionEffect) or not parameter.reciprocal:
            return parameter
        column = AXIS_NAMES.index(axis or effect.axis)
        largest = max(float(self.robot.torque_limit[self.robot.caster_index(name), column]) for name in target)
        softest = largest / LARGEST_TWIST
        return dataclasses.replace(parameter, lower=float(np.clip(softest, parameter.lower, parameter.typical)))

    def _searched(self, effect: Effect) -> tuple[EffectParameter, ...]:
        """The parameters of an effect that are searched for; of clocks those of the sensors that are there."""
        if not isinstance(effect, ClockEffect):
            return effect.searched_parameters
        there = {"imu/data": self.layout.imu, "ground_truth/odom": self.layout.pose}
        topics = [topic for topic, is_there in there.items() if is_there]
        return tuple(p for p in effect.parameters if any(effect.offset(topic, _only(effect, p)) for topic in topics))

    def _room(self, columns: FloatArray) -> FloatArray:
        """Coefficients (P,) with which columns (T, C, P) are as large as all that the description leaves in some channel."""
        valid = self.looked.valid[:, :, None]
        left = np.sqrt(np.sum(np.where(valid, self.differences.residual[:, :, None], 0.0) ** 2, axis=0))
        sizes = np.sqrt(np.sum(np.where(valid, columns, 0.0) ** 2, axis=0))
        room: FloatArray = np.min(np.where(sizes > 0.0, left / np.maximum(sizes, 1e-300), np.inf), axis=0)
        room[np.isinf(room)] = 0.0
        return room

    def _looked_for(self, looked: Looked, effect: Effect, look: str, neutral: Mapping[str, float]) -> ChosenShapes:
        """Where and when an effect may be at work, by a first look; its other parameters at their defaults."""
        rest = {p.name: p.default for p in effect.parameters if p.default is not None and p.name not in neutral}
        if look == "windows":
            always = {**rest, **neutral, "start": 0.0, "duration": 1e6}
            names = [p.name for p in effect.searched_parameters]
            columns = [self._difference(effect, ("chassis",), None, always, neutral, name) for name in names]
            found = windows(looked, np.stack(columns, axis=2))
        elif look == "patches":
            everywhere = {**rest, **neutral, "x": 0.0, "y": 0.0, "length": 1e4, "width": 1e4}
            name = effect.searched_parameters[0].name
            casters = self.robot.caster_names
            columns = [self._difference(effect, (caster,), None, everywhere, neutral, name) for caster in casters]
            found = patches(looked, np.stack(columns, axis=2))
        else:
            climbing = [self.differences.of_climbing(i) for i in range(self.robot.n)]
            found = waves(looked, np.stack(climbing, axis=2))
        return dataclasses.replace(found, shapes=tuple({**rest, **shape} for shape in found.shapes))

    def _difference(
        self, effect: Effect, target: tuple[str, ...], axis: str | None, at: Shape, neutral: Mapping[str, float], name: str,
        lean: FloatArray | None = None,
    ) -> FloatArray:
        """Column (T, C) of one parameter of an effect, the others as in `at` or neutral; lean: see `of_effect`."""
        step, value = _step(effect.parameter(name), neutral[name])
        values = {p.name: 0.0 for p in effect.searched_parameters} | {**at, **neutral, name: value}
        return self.differences.of_effect(EffectInstance(effect.name, target, values, axis), lean) / step

    def _put_together(
        self, columns: Columns, chosen: ChosenShapes, turning: str | None
    ) -> Columns:
        """Columns of all shapes from those of a few, where a direction or a place on the robot shapes them."""
        if turning is not None:
            return Turning(columns, turning)
        if {"x", "y"} == set(chosen.resolution):
            return Placed(columns, np.max(np.abs(self.robot.steer_axis), axis=0))
        return columns

    def _has_rotors(self, target: Sequence[str], axis: str) -> bool:
        """Whether there are motors that a gear could let turn on their own."""
        casters = [self.robot.casters[self.robot.caster_index(name)] for name in target]
        return self.layout.balanced and all(getattr(caster.rotors, axis) > 0.0 for caster in casters)

    def _rolls_unevenly(self, effect: ContactEffect) -> bool:
        """Whether an effect on contacts shows in how wheels roll, whatever the forces: by where they are in their turn."""
        searched = effect.searched_parameters
        return any(p.is_direction for p in effect.parameters if p not in searched) and not _look_of(effect)

    def _neutral(self, parameter: EffectParameter, target: Sequence[str]) -> float:
        """Value at which the parameter changes nothing; NaN where that is another one for every target."""
        if isinstance(parameter.neutral, float):
            return parameter.neutral
        if parameter.reciprocal:
            return parameter.upper
        if parameter.neutral:
            part, _, attribute = parameter.neutral.rpartition(".")
            if part == "contact":  # casters may have tyres of their own
                owners: Sequence[object] = [self.robot.tyres[self.robot.caster_index(name)] for name in target]
            else:
                owners = [operator.attrgetter(part)(self.robot) if part else self.robot]
            described = {float(getattr(owner, attribute)) for owner in owners}
            return described.pop() if len(described) == 1 else math.nan
        return 0.0

    def _grid(self, effect: Effect) -> ChosenShapes | None:
        """Grid of the shaping parameters of an effect and its spacing; None where one can neither be searched nor left."""
        reach = np.max(np.abs(self.robot.steer_axis), axis=0)
        # Wheels on one line say nothing of how far the robot reaches across it.
        reach = np.where(reach > 0.0, reach, 0.5 * np.asarray(self.robot.chassis.size[:2]))
        searched = {p.name for p in (*effect.searched_parameters, *self._searched(effect))}
        shapes: list[dict[str, float]] = [{}]
        resolution: dict[str, tuple[str, float]] = {}
        for parameter in effect.parameters:
            if parameter.name in searched:
                continue
            if parameter.name in ("x", "y"):
                span = float(reach["xy".index(parameter.name)])
                values = [-0.7 * span, 0.0, 0.7 * span]
                resolution[parameter.name] = ("linear", 0.35 * span)
            elif parameter.is_direction:
                values = [k * math.tau / DIRECTIONS for k in range(DIRECTIONS)]
                resolution[parameter.name] = ("linear", 0.5 * math.tau / DIRECTIONS)
            elif parameter.default is not None:
                values = [parameter.default]
            else:
                return None
            shapes = [{**shape, parameter.name: value} for shape in shapes for value in values]
        return ChosenShapes(tuple(shapes), 0, resolution)


def _once_more(
    shape: Shape, found: FloatArray, columns: Columns
) -> Columns:
    """Return `columns` with what was found at one shape kept until it is asked for; then the problem remembers it."""
    known = {frozen(shape): found}

    def kept(shape: Shape) -> FloatArray:
        once = known.pop(frozen(shape), None)
        return columns(shape) if once is None else once

    return kept


def _look_of(effect: Effect) -> str:
    """Which first look an effect needs, by what shapes it: none, "windows" of time, "patches" or "waves" of the floor."""
    names = {p.name for p in effect.parameters} - {p.name for p in effect.searched_parameters}
    for look, shaping in (("windows", {"start", "duration"}), ("waves", {"wavelength", "direction"})):
        if shaping <= names:
            return look
    return "patches" if isinstance(effect, ContactEffect) and {"x", "y", "length", "width"} <= names else ""


def _blur_of_borders() -> dict[str, float]:
    """Standard deviations [m] of where a patch is and how far it reaches, of which no wheel touches a point.

    A border is felt anywhere within the length over which a tyre stands on it: many crossings tell where far more closely than
    it is known what they tell of. That is the same for all of them, and of the two borders of a side it is not the same.
    """
    border = EDGE / math.sqrt(12.0)
    middle, side = border / math.sqrt(2.0), border * math.sqrt(2.0)
    return {"x": middle, "y": middle, "length": side, "width": side}


def _heights(effect: Effect) -> dict[str, tuple[float, float, float]]:
    """How high something is whose place on the robot is searched: forces hardly say it, but a chassis on springs does."""
    return {p.name: (HEIGHTS * p.typical, p.lower, p.upper) for p in effect.parameters if p.name == "z"}


def _only(effect: Effect, parameter: EffectParameter) -> dict[str, float]:
    """Parameters of an effect of which one alone is not zero."""
    return {p.name: float(p is parameter) for p in effect.parameters}


def _changed(effect: Effect, parameter: EffectParameter, target: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """Numbers of the chassis or of several casters that a parameter changes and nothing else, by name, and how much per unit.

    Of one caster an effect keeps its own columns, which are secants where it is far off: by the numbers' slopes one of two
    wheels that were 0.2 m off was re-tuned.
    """
    number, factor = CHANGED_BY.get((effect.name, parameter.name), ("", 0.0))
    if effect.target_kind == "chassis":
        return ((number, factor),) if number else ()
    return tuple((f"{number}/{caster}", factor) for caster in target) if number and len(target) > 1 else ()


def _step(parameter: EffectParameter, neutral: float) -> tuple[float, float]:
    """Step of the linear coefficient that a difference is taken over, and the parameter's value there."""
    if parameter.reciprocal:
        step, distance = 0.1 * _typical_inverse(parameter), neutral - parameter.pole
        return step, parameter.pole + 1.0 / (step + 1.0 / distance)
    if parameter.squared:
        value = SQUARED_STEP * parameter.typical
        return value**2, value
    step = 0.1 * parameter.typical
    return step, neutral + step


def _typical_inverse(parameter: EffectParameter) -> float:
    """Typical coefficient of a reciprocal parameter: of a relative error, about as large as that."""
    return parameter.typical if parameter.pole else 1.0 / parameter.typical


def _linear(parameter: EffectParameter, neutral: float, room: float) -> LinearParameter:
    """The parameter as a regression coefficient: its inverse, its square, or its distance from where it changes nothing.

    It may be three times what is typical of large robots, and it may do all that there is to be done.
    """
    if parameter.reciprocal:
        lower, upper = (1.0 / (end - parameter.pole) for end in (parameter.upper, parameter.lower))
        there = 1.0 / (neutral - parameter.pole)
        return LinearParameter(
            parameter.name, parameter.unit, lower - there, upper - there, max(3.0 * _typical_inverse(parameter), room),
            origin=neutral, reciprocal=True, pole=parameter.pole,
            # Of stiffness there may be none to be seen beside what the effect is: at a bound it would rule that out.
            refinement=parameter.default is not None,
            usual=None if parameter.default is None else 1.0 / (parameter.default - parameter.pole) - there,
        )
    if parameter.squared:
        deviation = max(3.0 * parameter.typical**2, room)
        return LinearParameter(parameter.name, parameter.unit, 0.0, parameter.upper**2, deviation, squared=True)
    return LinearParameter(
        parameter.name, parameter.unit, parameter.lower - neutral, parameter.upper - neutral,
        max(3.0 * parameter.typical, room), origin=neutral,
        number=parameter.neutral if isinstance(parameter.neutral, str) else "",
    )
