"""Builds the regression problem of a robot: its channels, what a healthy one may differ in, and every candidate effect.

The channels are those of `rolling_model`. Every number of the description that may differ within its tolerance is a
nuisance column, and every effect a candidate; both by differences of the whole model, so that none is derived by hand.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Collection, Mapping, Sequence

import numpy as np
from scipy import ndimage

from pcw_description.contact.contact_model import LAMBDA, LATERAL_LAMBDA, LATERAL_MU, MU
from pcw_description.effects.drive_coulomb_friction import SMOOTHING_SPEED
from pcw_description.errors import PcwError
from pcw_description.recording import Recording
from pcw_description.robot_description import AXIS_NAMES, DRIVE, GRAVITY, STEER, RobotDescription

from ...plants.true_robot import as_it_really_is
from ..all_cores import on_all_cores
from ..errors import MismatchError
from ..found_effect import effect_instance
from ..readings.unresolved_motion import unresolved_rate
from ..regression.noise_model import channel_deviations
from ..regression.regression_problem import (
    BoolArray,
    Channel,
    FloatArray,
    Nuisance,
    RegressionProblem,
    Sites,
    SizedTerm,
    Term,
)
from ..regression.signal_filter import SignalFilter, derivative
from .channel_differences import ChannelDifferences
from .clock_leads import clock_leads
from .first_look import Looked, remainder
from .held_steerings import held_steerings
from .joint_balance import torque_of_motion
from .lost_torques import DRY_SPEED, by_joint, lost_torques
from .robot_effects import ChannelModel, true_motion, with_leads, with_pose
from .robot_motion import SHORTEST_SEGMENT, RobotMotion, choose_cutoff, has_balance, has_torques, read_motions
from .robot_nuisances import (
    FLOOR,
    LOOP_BANDWIDTH,
    MODEL_DEVIATION,
    VariedNumber,
    floor_nuisances,
    largest_unreported_part,
    robot_nuisances,
    varied_numbers,
)
from .robot_terms import robot_terms
from .rolling_model import (
    INERTIAL,
    WRENCH,
    ChannelLayout,
    ModelNumbers,
    RollingState,
    at_place,
    rolling_state,
    twists,
)
from .seeming_geometry import seeming_numbers
from .sudden_slip import spinning, sudden_slip
from .torque_errors import INSTRUMENTS, with_balanced_torques
from .turned_steering import TurnedSteering, turned_steering

# Slip that the model may hold: a floor, and that part of the speed up to which a tyre grips more the more it slips.
SLIP_FLOOR, SLIP_PART = 0.03, 0.75
GROSS = 3.0  # times that; a tracker or a gyro that parts from all wheels by so much at once says that these spin
# Part of a tyre's friction up to which its force says how much it slips: at the peak any slip goes with the same force.
USED_PART = 0.8
# By up to about this part the model misjudges slips: the loads of four wheels on a floor that is not flat are anybody's guess.
SLIP_DEVIATION = 0.3
ROLLS_TRUE = 1e-5  # [m/s]; no wheel and no floor is so true that what wheels slip by less says anything
TILT_DEVIATION = 1e-3  # [rad]; floors are no more level, and no chassis on its wheels stands any straighter
ROUNDING = 1e-9  # of what wheels roll; contradictions below it are those of arithmetic
SLOWER = 3.0  # so much less than the residual's is the cut-off of variables with the same noise, which grows with its cube
RINGING = 1.5  # periods of the cut-off over which the filter's answer to a blow is felt
SHAKING_PART = 0.5  # of that slip; what a tyre carries on average while it slips to and fro is less than at its average slip
# [rad]; a caster that swings so far while it rolls drags by about half its cornering stiffness times the square of that: a
# thousandth of its load, and as much as the noise of a balance. At 0.07 rad four of them brake a robot of 40 kg by 20 N.
LARGEST_SWING = 0.01
SHAKEN_PART = 0.05  # of the samples in which wheels shake is worth a word
LIMITED_PART = 0.3  # of the samples in which their friction is used up is, too
# What every model has a little wrong, of each wheel by itself, and not always by as much; and an IMU leans with the chassis.
DRIFTING = ("torque_constant_error", "tyre_longitudinal_stiffness", "tyre_lateral_stiffness", "imu_bias")
# Part of a tolerance over which a number's column is taken anew: by a wider one's curvature an effect on it would be told
# from the number itself, which is the same thing.
TANGENT_STEP = 0.01
# The effect that says by how much the stamps of IMU and tracker are ahead, and its numbers in that order.
CLOCKS, CLOCK_NUMBERS = "clock_offset", ("offset", "tracker_offset")
# Channels and what they differ by, which samples of them may be judged, and the numbers that a healthy robot may differ in.
Prepared = tuple[ChannelDifferences, BoolArray, tuple[Nuisance, ...]]
STILL_SPEED = 0.2  # [rad/s]; joints slower than this may be held by dry friction of unknown size
# The same of a joint that is judged by itself: slower [rad/s] for so long [s].
HELD_SPEED, HELD_TIME = 0.05, 0.1
WHOLE_SPEED = 0.15  # [rad/s]; from it on a dry friction that is smoothed over 0.05 rad/s is all there


class RobotProblemBuilder:
    """Builds the regression problem of a robot from its recordings."""

    def __init__(
        self, robot: RobotDescription, recordings: Sequence[Recording], cutoff: float | None = None, live: bool = False,
        lifted: bool = False, leads: FloatArray | None = None, held: BoolArray | None = None,
    ) -> None:
        """Filter the recordings.

        Args:
            robot: the nominal robot.
            recordings: opened with this robot.
            cutoff: of the channel filter [Hz]; None chooses it from the noise of the encoders.
            live: these are windows of a running robot, or what they are judged by: see `quiet_torque`.
            lifted: the wheels were off the ground; see `joint_balance`.
            leads: by how much other recordings of this robot say that the stamps of IMU and tracker are ahead (2,) [s]; None
                has these say so.

            held: which steerings (n,) are known from other recordings of this robot to stick; None has these say so.

        Raises:
            MismatchError: no piece is long enough; or off the ground, where torques are all there is, none were recorded.
        """
        self.robot = robot
        balanced = has_torques(recordings) if lifted else has_balance(robot, recordings)
        if lifted and not balanced:
            raise MismatchError("off the ground motors are all that can be judged; allowed: joint_states with effort")
        self.cutoff = cutoff if cutoff is not None else choose_cutoff(robot, recordings, lifted)
        motions: list[RobotMotion] = []
        for index, recording in enumerate(recordings):
            motions += read_motions(robot, recording, index, self.cutoff, balanced, live)
        if not motions:
            raise MismatchError(f"no contiguous piece of at least {SHORTEST_SEGMENT:g} s in the recordings")
        imu = any(np.isfinite(motion.imu).any() for motion in motions) and not lifted
        # An IMU may have a gyro alone, or an accelerometer.
        sensed = [any(np.isfinite(motion.imu[:, k]).any() for motion in motions) for k in range(len(INERTIAL))]
        self.unmeasured = tuple(name for name, there in zip(INERTIAL, sensed, strict=True) if imu and not there)
        pose = any(np.isfinite(motion.tracked_twist).any() for motion in motions) and not lifted
        self.layout = ChannelLayout(robot.caster_names, balanced, imu, pose, len(robot.fixed_axle), lifted)
        # Numbers that effects in the description already change belong to the nominal model.
        described = as_it_really_is(robot)
        self.numbers = ModelNumbers.of(described)
        self._read = motions
        self.model = ChannelModel(described, self.numbers, self.layout)
        self.motions = self._motions_of(self.model)
        # By how much clocks are ahead that are far off; columns are taken as if that were known.
        self._leads, self._said = np.zeros(2), leads
        self._seeming: ModelNumbers | None = None
        # Steerings that dry friction holds while they stand; how large it is where too little would be judged without these.
        self.held, self._known_held, self._holding = np.zeros(robot.n, dtype=bool), held, np.zeros(robot.n)
        self.filters = [SignalFilter(motion.rate, self.cutoff) for motion in self.motions]

    @property
    def balanced(self) -> bool:
        """Whether there are channels of forces: torques were recorded, of casters with an offset."""
        return self.layout.balanced

    def channels(self) -> tuple[Channel, ...]:
        """Channels that these recordings can fill."""
        return self.layout.channels()

    @property
    def leads(self) -> FloatArray | None:
        """By how much the stamps of IMU and tracker are ahead (2,) [s], as far as that is known; None: not by much."""
        return self._leads if self._leads.any() else None

    def build(self, with_terms: bool = True, keys: Collection[str] | None = None) -> RegressionProblem:
        """Return the regression problem of all recordings.

        Args:
            with_terms: False leaves out candidate effects: residual and tolerances alone are many times cheaper.
            keys: of the candidates that are wanted; None: all.
        """
        differences, valid, nuisances = self._prepared if with_terms else self._as_read()
        along = self._along_motions(differences)
        stamps = [f.decimate(m.time) for f, m in zip(self.filters, self.motions, strict=True)]
        time = np.concatenate(stamps)
        segment = np.concatenate([np.full(len(t), i) for i, t in enumerate(stamps)])
        recording = np.array([motion.recording for motion in self.motions])[segment]
        rate = float(np.mean([f.decimated_rate for f in self.filters]))
        terms: tuple[Term, ...] = ()
        places, headings = self._wheels()
        shaken, limited, stuck = self._shaken(), self._at_the_limit(differences), self._sticking()
        if with_terms:
            coupling = self.robot.gear_coupling  # what ripples over an angle is a motor
            angle = differences.filtered([np.einsum("nki,tni->tnk", coupling, motion.position) for motion in self.motions])
            left, deviation = remainder(differences.residual, valid, nuisances)
            looked = Looked(left, deviation, valid, time, recording, rate, angle, places, headings)
            terms = tuple(robot_terms(self.robot, differences, looked, bool(self._leads.any()), keys))
        slips = self._misjudged_slips(differences)
        exact = functools.partial(self._exact, differences, terms)
        residual, nominal = differences.residual, None
        if self._leads.any() and (found := exact({}, ())):
            residual, nominal = found[0], ChannelDifferences(self.model, self._motions_of(self.model), self.filters).residual
        return RegressionProblem(
            channels=self.channels(),
            time=time,
            segment=segment,
            recording=recording,
            rate=rate,
            measured=differences.measured,
            residual=residual,
            nominal=nominal,
            valid=valid,
            nuisances=nuisances,
            terms=terms,
            variables=self._variables(along),
            misjudged=self._misjudged(differences, slips),
            misjudged_slips=slips,
            scale_deviation=self._scale_deviation(),
            drifts=_drifts(terms) if self.layout.balanced else None,
            sites=self._sites(differences, along) if with_terms and self.layout.balanced else None,
            wheel_places=places,
            exact=exact,
            derive=functools.partial(self._derive, differences, terms),
            softened=self._softened if self.layout.balanced else None,
            remarks=(*shaken, *limited, *stuck),
            apart=self.layout.lifted,
            shaken=bool(shaken),
            limited=bool(limited),
        )

    def turned_steering(self, limited: bool) -> TurnedSteering | None:
        """Return the steering whose zero is far off, where wheels work against each other by it alone; see there."""
        if not self.layout.balanced or self.layout.lifted:
            return None

        def slides(numbers: ModelNumbers) -> float:
            return float(np.mean(np.concatenate([slipping(numbers, motion, self.layout) for motion in self.motions])))

        return turned_steering(self.model, self.motions, self.filters, limited, slides)

    @functools.cached_property
    def _prepared(self) -> Prepared:
        """What candidates are made from: with clocks and torques put right that would be taken for something else."""
        if self.layout.lifted:  # no clock tells anything beside that of the joints, and what one of them loses no other brings
            self._read = self._as_moved()
            self.motions = self._motions_of(self.model)
            return self._as_read()
        # Behind wheels that spin a robot is late; clocks that are late themselves must not tell that they do.
        slides = [wheels_slide(self.numbers, motion, self.layout) for motion in self.motions]
        self._leads = clock_leads(self.motions, self.numbers, slides) if self._said is None else self._said
        if self._leads.any():
            self.motions = self._motions_of(self.model, leads=self._leads)
        if self.layout.balanced:
            differences = ChannelDifferences(self.model, self.motions, self.filters)
            instruments = robot_nuisances(self.robot, differences, INSTRUMENTS)
            lost = lost_torques(differences, self._valid(differences, at_peak=True), instruments, self._at_peak)
            if lost is not None:
                self._read = [dataclasses.replace(motion, lost=own) for motion, own in zip(self._read, lost, strict=True)]
                self.motions = self._motions_of(self.model, leads=self._leads)
                differences = ChannelDifferences(self.model, self.motions, self.filters)
            valid = self._valid(differences)
            standing = [self._standing(motion)[:, STEER::2].astype(float) for motion in self.motions]
            held, holding = self._known_held, np.zeros(self.robot.n)
            if held is None:
                found = held_steerings(self.robot, differences, valid, differences.filtered(standing) > 0.5, instruments)
                held, holding = found.sticks, np.where(found.dispensable, 0.0, found.friction)
            self._read = with_balanced_torques(self._read, differences, valid, instruments)
            self.motions = self._motions_of(self.model, leads=self._leads)
            self.held, self._holding = held, holding
        return self._as_read()

    def _as_moved(self) -> list[RobotMotion]:
        """What was read of joints off the ground, with the torques of their motion for those without noise."""
        found = []
        for read, motion, own in zip(self._read, self.motions, self.filters, strict=True):
            torque = own.smooth(torque_of_motion(motion, self.numbers, self.model.around(motion)))
            rate = derivative(torque, read.rate)
            found.append(dataclasses.replace(read, balanced_torque=torque, quiet_torque=torque, torque_rate=rate))
        return found

    def _as_read(self) -> Prepared:
        """The same of the motions as they are."""
        differences = ChannelDifferences(self.model, self.motions, self.filters)
        return differences, self._valid(differences), tuple(robot_nuisances(self.robot, differences))

    def _exact(
        self, differences: ChannelDifferences, terms: Sequence[Term], changes: Mapping[str, float], sizes: Sequence[SizedTerm]
    ) -> tuple[FloatArray, Sequence[str]] | None:
        """Residual (T, C) with numbers changed and effects at work, all at once; None where they cannot be.

        Where clocks are ahead and no effect says so it is what the first order that is taken there makes of that.
        """
        varied = [n for n in varied_numbers(self.robot, differences) if n.label in changes]
        pieces, unsaid = [], _unsaid(self._leads, terms, sizes)
        straight = iter(differences.straight)
        for recording in dict.fromkeys(motion.recording for motion in self._read):
            # What happened in one recording alone was not at work in another.
            own = [size for size in sizes if terms[size.term].recording in (None, recording)]
            model = self._model_at(varied, terms, changes, own)
            if model is None:
                return None
            for motion in self._motions_of(model, recording, unsaid):
                around, tyres = model.around(motion), next(straight)
                if tyres is not None and tyres.in_place:
                    around = dataclasses.replace(around, straight=tyres)
                measured, predicted = model.sides(motion, around)
                pieces.append(np.nan_to_num(measured - predicted))
        residual = differences.filtered(pieces)
        if unsaid.any():
            residual += differences.of_effect(effect_instance(CLOCKS, ("clock",), dict(zip(CLOCK_NUMBERS, unsaid)), None))
        return residual, [*(n.label for n in varied), *(name for name in FLOOR if name in changes)]

    def _derive(
        self, differences: ChannelDifferences, terms: Sequence[Term], changes: Mapping[str, float], sizes: Sequence[SizedTerm]
    ) -> Mapping[str, FloatArray] | None:
        """Columns (T, C) of the numbers where they are changed so and effects are at work; None where they cannot be."""
        varied = varied_numbers(self.robot, differences)
        lasting = [size for size in sizes if terms[size.term].recording is None]
        model = self._model_at([n for n in varied if n.label in changes], terms, changes, lasting)
        if model is None:
            return None
        motions = self._motions_of(model, leads=_unsaid(self._leads, terms, lasting))
        in_place = any(tyres is not None and tyres.in_place for tyres in differences.straight)
        there = ChannelDifferences(model, motions, self.filters, differences.straight if in_place else None)
        columns = on_all_cores(lambda n: there.of_numbers(n.vary, TANGENT_STEP * n.deviation), varied)
        found = {n.label: column for n, column in zip(varied, columns, strict=True)}
        return found | {nuisance.name: nuisance.column for nuisance in floor_nuisances(self.robot, there)}

    def _softened(self, changes: Mapping[str, float]) -> tuple[FloatArray, Sequence[str]]:
        """Factors (C,) on what torques do to the channels with softer tyres, and the numbers that are torques.

        What is not a balance of forces shows them by the slips that they cause alone.
        """
        factors = np.full(len(self.channels()), 1.0 + changes.get("contact.stiffness", 0.0))
        factors[self.layout.balance] = 1.0
        return factors, [name for name in changes if name.startswith("torque_constant/")]

    def _model_at(
        self,
        varied: Sequence[VariedNumber],
        terms: Sequence[Term],
        changes: Mapping[str, float],
        sizes: Sequence[SizedTerm],
    ) -> ChannelModel | None:
        """The channel model with numbers changed and effects at work; None where they cannot be."""
        # On a floor that leans what is off in a centre of mass is felt as a moment, too.
        east, north = (changes.get(name, 0.0) for name in FLOOR)
        slope = {"angle": math.asin(min(math.hypot(east, north), 1.0)), "direction": math.atan2(north, east)}
        instances = [effect_instance("ground_slope", ("chassis",), slope, None)] if slope["angle"] else []
        for size in sizes:
            term = terms[size.term]
            if term.is_exact:
                values = dict(size.shape) | size.values(term.parameters)
                instances.append(effect_instance(term.effect, term.target, values, term.axis))
        try:
            described = as_it_really_is(dataclasses.replace(self.robot, physics=(*self.robot.physics, *instances)))
        except PcwError:
            return None
        numbers = ModelNumbers.of(described)
        for number in varied:
            number.vary(numbers, changes[number.label])
        return ChannelModel(described, numbers, self.layout)

    def _motions_of(
        self, model: ChannelModel, recording: int | None = None, leads: FloatArray | None = None
    ) -> list[RobotMotion]:
        """What was read in one recording, or in all, as the joints of a model moved, with clocks ahead (2,) [s] put right."""
        motions = [true_motion(model.robot, motion) for motion in self._read if recording in (None, motion.recording)]
        if leads is not None and leads.any():
            motions = [with_leads(motion, *leads) for motion in motions]
        if self.layout.lifted:
            return [dataclasses.replace(motion, pose=_standing_at(motion.pose)) for motion in motions]
        return with_pose(motions, model.numbers)

    def _wheels(self) -> tuple[FloatArray, FloatArray]:
        """Places (T, n, 2) [m] and headings (T, n) [rad] of the wheels in the world."""
        places, headings = [], []
        for motion, own in zip(self.motions, self.filters, strict=True):
            places.append(own.decimate(self.model.wheel_places(motion).swapaxes(0, 1)))
            headings.append(own.decimate(motion.pose[:, 2:] + self.numbers.headings(motion.position)))
        return np.concatenate(places), np.concatenate(headings)

    def _scale_deviation(self) -> float:
        """Relative deviation of what all torque constants share, and of what the model neglects."""
        shared = self.robot.tolerance("torque_constant").value / float(np.sqrt(2 * self.robot.n))
        return float(np.hypot(shared, MODEL_DEVIATION)) if self.layout.balanced else 0.0

    def _misjudged(self, differences: ChannelDifferences, slips: FloatArray) -> FloatArray:
        """What the model may misjudge in each sample (T, C): `slips` (T, C), see below, and what an IMU leans.

        Besides what joints lose where their dry friction reverses, what encoders do not resolve, and what drives that hold
        speeds do not report while what accelerates their joints changes: a caster that flips is accelerated anew every moment;
        and what dry friction holds of steerings that stand, where too little is left without them.
        """
        found, consistency = slips.copy(), self.layout.consistency
        if slips[:, consistency].size:
            found[:, consistency] = np.sqrt(slips[:, consistency] ** 2 + self._unresolved() ** 2 + ROLLS_TRUE**2)
        if self.layout.imu:
            found[:, self.layout.inertial][:, 1:] = GRAVITY * TILT_DEVIATION
        lost = [motion.lost for motion in differences.motions if motion.lost is not None]
        doubts = [own.doubt for own in lost]
        if self.layout.balanced and any(np.any(motion.loops) for motion in differences.motions):
            # What a report lacks lags behind what accelerates its joint, by about as long as the loop takes.
            part = largest_unreported_part(differences.motions) / LOOP_BANDWIDTH
            loops = [part * derivative(motion.loops[..., 0], motion.rate) for motion in differences.motions]
            doubts = [np.hypot(own, more) for own, more in zip(doubts, loops, strict=True)] if lost else loops
        if self._holding.any():
            held = [self._held_back(motion) for motion in differences.motions]
            doubts = [np.hypot(own, more) for own, more in zip(doubts, held, strict=True)] if doubts else held
        if doubts:
            each = [by_joint(own.reshape(len(own), -1, 1)) for own in doubts]
            found = np.sqrt(found**2 + np.sum(differences.of_torque(each) ** 2, axis=2))
        return found

    def _misjudged_slips(self, differences: ChannelDifferences) -> FloatArray:
        """What the model may misjudge of slips (T, C): a part of those there are."""
        found, predicted = np.zeros_like(differences.predicted), differences.predicted
        lost = [motion.lost for motion in differences.motions if motion.lost is not None]
        if lost:
            predicted = predicted - differences.of_torque([own.torque[..., None] for own in lost])[:, :, 0]
        slips = predicted[:, self.layout.consistency]
        if slips.size:
            found[:, self.layout.consistency] = SLIP_DEVIATION * np.sqrt(np.mean(slips**2, axis=1, keepdims=True))
        return found

    def _unresolved(self) -> FloatArray:
        """By how much encoders miss what wheels do along and across (T, 2n) [m/s], a standard deviation."""
        found = []
        for motion, own in zip(self.motions, self.filters, strict=True):
            drive, steer = np.moveaxis(unresolved_rate(motion.velocity, motion.resolution, self.cutoff), 2, 0)
            offset = np.abs(self.numbers.caster_offset)
            along = np.hypot(self.numbers.radius * drive, offset[:, 1] * steer)
            found.append(own.decimate(np.stack([along, offset[:, 0] * steer], axis=2).reshape(len(motion.time), -1)))
        return np.concatenate(found)

    def _seeming_numbers(self, differences: ChannelDifferences) -> ModelNumbers:
        """The numbers by which wheels slide least."""
        if self._seeming is None and self.layout.redundant:
            self._seeming = seeming_numbers(
                self.numbers, varied_numbers(self.robot, differences), self.motions,
                lambda numbers, motion: slipping(numbers, motion, self.layout), SLIP_FLOOR,
            )
        return self._seeming or self.numbers

    def _at_peak(self, motion: RobotMotion) -> BoolArray:
        """Samples (T,) of a true motion in which tyres use so much friction that their slip is open."""
        state = rolling_state(motion.without_lost(), self.numbers, self.layout, self.model.around(motion))
        return used_friction(self.numbers, state) > USED_PART

    def _valid(self, differences: ChannelDifferences, at_peak: bool = False) -> BoolArray:
        """Samples (T, C) that the rolling model can judge: moving, no gross slip or shaking, sensor there.

        Args:
            differences: of these motions.
            at_peak: also those in which tyres use so much friction that their slip is open.
        """
        if self.layout.lifted:
            stands = [
                (self._standing(motion) | ~known).astype(float)
                for motion, known in zip(self.motions, differences.known, strict=True)
            ]
            return differences.filtered(stands) < 0.1
        pieces, slides, seeming = [], [], self._seeming_numbers(differences)
        for motion, known, state in zip(self.motions, differences.known, differences.on_ground, strict=True):
            bad = slipping(seeming, motion, self.layout)
            if self.layout.balanced and not at_peak:
                bad |= used_friction(self.numbers, state) > USED_PART
            slides.append(bad)
            bad = disturbed(bad, max(round(RINGING * motion.rate / self.cutoff), 1))
            if self.layout.balanced:
                bad |= np.all(np.abs(motion.velocity[:, :, DRIVE]) < STILL_SPEED, axis=1)
                bad |= self._stuck(motion) & ~self._holding.any()
            pieces.append((bad[:, None] | ~known).astype(float))
        valid = (differences.filtered(pieces) < 0.1) & ~self._silent(differences)
        # A slip that is hundreds of times larger than all others is felt farther, and says that tyres slip otherwise.
        usual = channel_deviations(differences.residual, valid)
        reached = np.any(valid & (np.abs(differences.left_by(slides)) > usual), axis=1)
        return valid & ~reached[:, None]

    def _stuck(self, motion: RobotMotion) -> BoolArray:
        """Samples (T,) in which a steering that sticks stands, or turns so slowly that a smoothed friction is not whole."""
        return np.asarray(self._standing(motion, WHOLE_SPEED)[:, STEER::2][:, self.held].any(axis=1), dtype=bool)

    def _held_back(self, motion: RobotMotion) -> FloatArray:
        """What dry friction may hold of each joint (T, n, 2) [N m]: while a steering that sticks stands, up to all of it."""
        found = np.zeros_like(motion.velocity)
        found[:, :, STEER] = self._holding * (1.0 - np.abs(np.tanh(motion.velocity[:, :, STEER] / DRY_SPEED)))
        return found

    def _standing(self, motion: RobotMotion, speed: float = HELD_SPEED) -> BoolArray:
        """Samples (T, 2n) in which a joint may be held by dry friction of unknown size: all but short moments of reversal."""
        rows = max(round(HELD_TIME * motion.rate), 1)
        slow = np.abs(motion.velocity).reshape(len(motion.time), -1) < speed
        held: BoolArray = ndimage.binary_opening(slow, np.ones((rows, 1), dtype=bool))
        return held

    def _sticking(self) -> tuple[str, ...]:
        """Which steerings stick, and how many samples are not judged for that."""
        names = [name for name, held in zip(self.robot.caster_names, self.held, strict=True) if held]
        if not names:
            return ()
        part = np.mean(np.concatenate([self._stuck(motion) for motion in self.motions]))
        what = "say nothing of torques, and were not judged."
        if self._holding.any():
            what = "say little of torques, but hardly any others are left. Turn the wheels more, and reverse."
        return (
            f"Dry friction holds the steering of {' and '.join(names)} against whatever is applied to it while it stands. The "
            f"{100 * part:.0f} % of the samples in which it hardly turns {what}",
        )

    def _silent(self, differences: ChannelDifferences) -> BoolArray:
        """Channels (C,) in which wheels say nothing of one another, such as those of one axle that never turn."""
        silent = np.zeros(len(self.channels()), dtype=bool)
        contradicted = np.max(np.abs(differences.measured[:, self.layout.consistency]), axis=0, initial=0.0)
        rolled = max(float(np.max(np.abs(motion.velocity[:, :, DRIVE]))) for motion in self.motions)
        silent[self.layout.consistency] = contradicted < ROUNDING * rolled * float(np.max(self.numbers.radius))
        return silent

    def _at_the_limit(self, differences: ChannelDifferences) -> tuple[str, ...]:
        """That friction is used up in many samples, which are not judged, and what that may come from."""
        if not self.layout.balanced or self.layout.lifted:
            return ()
        used = np.concatenate([used_friction(self.numbers, state) for state in differences.on_ground])
        part = float(np.mean(used > USED_PART))
        if part < LIMITED_PART:
            return ()
        return (
            f"In {100 * part:.0f} % of the samples torques use more than {100 * USED_PART:.0f} % of a wheel's friction: its "
            "slip may be anything, and they were not judged. If the robot drives gently its wheels work against each other, a "
            "zero or a radius being far off, or torques are in other units than N m at the joints.",
        )

    def _shaken(self) -> tuple[str, ...]:
        """That wheels shake or casters swing, which keeps samples from being judged and can be mended."""
        shaken = np.concatenate([motion.shaking > SHAKING_PART * SLIP_FLOOR for motion in self.motions])
        swings = np.concatenate([motion.swing for motion in self.motions])
        swung = swings > LARGEST_SWING
        told: tuple[str, ...] = ()
        if np.mean(swung) >= SHAKEN_PART:
            told = (
                f"In {100 * np.mean(swung):.0f} % of the samples casters swing about their steering axes by up to "
                f"{np.quantile(swings, 0.99):.2f} rad, faster than {self.motions[0].cutoff:.3g} Hz, and were not judged: "
                "casters do that by themselves where they roll fast and nothing holds their steerings (shimmy), and it costs "
                "speed.",
            )
        if np.mean(shaken) < SHAKEN_PART:
            return told
        worst = max(self.motions, key=lambda motion: float(np.mean(motion.shaking)))
        frequency, speed = worst.shaking_frequency, float(np.quantile(worst.shaking, 0.95))
        return (
            *told,
            f"In {100 * np.mean(shaken):.0f} % of the samples wheels shake at about {frequency:.0f} Hz, by up to "
            f"{speed:.2f} m/s at the ground, and were not judged. A loop of the drives may be too stiff for the tyres and the "
            "delay: lower its gains and record anew.",
        )

    def _along_motions(self, differences: ChannelDifferences) -> dict[str, list[FloatArray]]:
        """What a leftover may depend on, one array per motion."""
        found: dict[str, list[FloatArray]] = {}
        for motion, normal in zip(self.motions, differences.normal, strict=True):
            signals = {"time": motion.time}
            if not self.layout.lifted:
                twist, _ = twists(self.numbers, self.numbers.headings(motion.position), motion.velocity)
                signals["speed"] = np.hypot(twist[:, 0], twist[:, 1])
                signals |= {name: twist[:, k] for k, name in enumerate(("v_x", "v_y", "omega"))}
                signals |= {name: motion.pose[:, k] for k, name in enumerate(("x", "y", "yaw"))}
            for i, caster in enumerate(self.robot.caster_names):
                signals[f"steer_angle/{caster}"] = motion.position[:, i, STEER]
                signals[f"drive_angle/{caster}"] = motion.position[:, i, DRIVE]
                if not self.layout.lifted:
                    signals[f"drive_normal_force/{caster}"] = normal[:, i]
                for axis, axis_name in enumerate(AXIS_NAMES):
                    signals[f"{axis_name}_velocity/{caster}"] = motion.velocity[:, i, axis]
                    signals[f"{axis_name}_torque/{caster}"] = motion.balanced_torque[:, i, axis]
            for name, values in signals.items():
                found.setdefault(name, []).append(np.ascontiguousarray(values))
        return found

    def _variables(self, along: Mapping[str, Sequence[FloatArray]]) -> dict[str, FloatArray]:
        """What a leftover may depend on, each (T,).

        Without forces the residual is what wheels say of the motion, and holds the noise of their speeds: a variable that
        holds it too is smoothed.
        """
        smooth = self.filters if self.layout.balanced else [SignalFilter(f.rate, self.cutoff / SLOWER) for f in self.filters]

        pieces = []
        for k, (own, slower) in enumerate(zip(self.filters, smooth, strict=True)):
            signals = np.stack([parts[k] for parts in along.values()], axis=1)
            timed = [name == "time" for name in along]
            pieces.append(own.decimate(np.where(timed, signals, slower.smooth(signals))))
        return dict(zip(along, np.concatenate(pieces).T, strict=True))

    def _sites(self, differences: ChannelDifferences, along: Mapping[str, Sequence[FloatArray]]) -> Sites:
        """Where an unknown torque or force may act: every joint, and forces and a moment on the chassis."""
        n = self.robot.n
        joints = tuple(f"{axis}_torque/{caster}" for caster in self.robot.caster_names for axis in AXIS_NAMES)
        bodies = () if self.layout.lifted else WRENCH
        borders = np.cumsum([len(motion.time) for motion in self.motions])[:-1]

        def columns(forces: FloatArray) -> FloatArray:
            torques, chassis = forces[:, : 2 * n].reshape(len(forces), n, 2, -1), forces[:, 2 * n :]
            found = differences.of_torque(np.split(torques, borders)) if torques.any() else None
            if found is None or chassis.any():
                wrench = np.zeros((len(forces), len(self.channels()), forces.shape[2]))
                wrench[:, : len(WRENCH)] = -chassis
                pushed = differences.filtered(np.split(wrench, borders))
                found = pushed if found is None else found + pushed
            return found

        variables = {name: np.concatenate(parts) for name, parts in along.items()}
        return Sites((*joints, *bodies), variables, float(SMOOTHING_SPEED.default or 0.0), columns)


def _standing_at(pose: FloatArray) -> FloatArray:
    """The pose (T, 3) of a robot that stands where it was tracked (T, 3), or anywhere."""
    known = pose[np.isfinite(pose).all(axis=1)]
    return np.tile(np.median(known, axis=0) if len(known) else np.zeros(3), (len(pose), 1))


def _unsaid(leads: FloatArray, terms: Sequence[Term], sizes: Sequence[SizedTerm]) -> FloatArray:
    """Return by how much clocks are ahead (2,) [s] that no effect at work is about."""
    said = any(terms[size.term].effect == CLOCKS for size in sizes)
    return np.zeros(2) if said else leads


def allowed_slip(numbers: ModelNumbers, twist: FloatArray) -> FloatArray:
    """Return the largest slip (T,) that the model may hold, in a motion of the twists (T, 3) [m/s]."""
    reach = float(np.max(np.linalg.norm(numbers.steer_axis, axis=1)))
    speed = np.hypot(twist[:, 0], twist[:, 1]) + np.abs(twist[:, 2]) * reach
    allowed: FloatArray = SLIP_FLOOR + SLIP_PART * float(np.min(numbers.tyres[:, [LAMBDA, LATERAL_LAMBDA]])) * speed
    return allowed


def sliding(numbers: ModelNumbers, motion: RobotMotion, layout: ChannelLayout) -> BoolArray:
    """Return the rows (T,) of a motion in which wheels slide, shake, or use so much friction that their slip is open."""
    return slipping(numbers, motion, layout) | wheels_slide(numbers, motion, layout)


def wheels_slide(numbers: ModelNumbers, motion: RobotMotion, layout: ChannelLayout) -> BoolArray:
    """Return the rows (T,) of a motion in which wheels slide, or nearly so, by what joints alone say."""
    bad = np.zeros(len(motion.time), dtype=bool)
    if layout.redundant:
        twist, contradiction = twists(numbers, numbers.headings(motion.position), motion.velocity)
        bad |= np.max(np.linalg.norm(contradiction, axis=2), axis=1) > allowed_slip(numbers, twist)
    if layout.balanced:
        bad |= used_friction(numbers, rolling_state(motion, numbers, layout)) > USED_PART
    return bad


def slipping(numbers: ModelNumbers, motion: RobotMotion, layout: ChannelLayout) -> BoolArray:
    """Return the rows (T,) of a motion in which wheels are seen to slide or shake."""
    twist, contradiction = twists(numbers, numbers.headings(motion.position), motion.velocity)
    allowed = allowed_slip(numbers, twist)
    reach = float(np.max(np.linalg.norm(numbers.steer_axis, axis=1)))
    tracked, rolled = motion.tracked_twist, at_place(twist, numbers.tracked)
    if layout.redundant:
        bad: BoolArray = np.max(np.linalg.norm(contradiction, axis=2), axis=1) > allowed
        # Wheels that spin all together do not contradict each other.
        bad |= sudden_slip(tracked, rolled, motion.rate, reach, GROSS * allowed)
        bad |= spinning(tracked, rolled, reach, GROSS * allowed)
        turned = np.column_stack([twist[:, :2], motion.imu[:, 0]])
        bad |= sudden_slip(turned, twist, motion.rate, reach, GROSS * allowed)
    else:
        bad = sudden_slip(tracked, rolled, motion.rate, reach, allowed)
    return bad | (motion.shaking > SHAKING_PART * allowed) | (motion.swing > LARGEST_SWING)


def used_friction(numbers: ModelNumbers, state: RollingState) -> FloatArray:
    """Return the force of the tyre that is used most, as a part of its friction (T,)."""
    friction = np.minimum(numbers.tyres[:, MU], numbers.tyres[:, LATERAL_MU]) * state.grip
    used: FloatArray = np.max(np.linalg.norm(state.force, axis=2) / friction, axis=1)
    return used


def disturbed(bad: BoolArray, reach: int) -> BoolArray:
    """Return which samples (T,) feel what happens in bad ones (T,), through a filter that is felt so many samples away.

    What a filter makes of forces that no model follows reaches beyond the slip itself. Between two slips both are felt, and
    there is no calm in less time than one of them takes to be forgotten.
    """
    calm = ~ndimage.binary_dilation(bad, iterations=reach)
    opened: BoolArray = ndimage.binary_opening(np.pad(calm, reach, mode="edge"), iterations=reach)
    return ~opened[reach:-reach]


def _drifts(terms: Sequence[Term]) -> FloatArray | None:
    """Columns (T, C, K) of what the model itself has wrong; None without terms."""
    own = [term for term in terms if term.effect in DRIFTING and len(term.target) == 1]
    columns = [term.columns(term.shapes[0])[:, :, list(term.base_indices())] for term in own]
    return np.concatenate(columns, axis=2) if columns else None
