"""What a change of the model changes in a robot's channels: the one place that columns of nuisances and effects come from."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from pcw_description.effect_instance import EffectInstance

from ..regression.regression_problem import BoolArray, FloatArray
from ..regression.signal_filter import SignalFilter
from .joint_balance import JointResponse
from .robot_effects import ChannelModel
from .robot_motion import RobotMotion
from .rolling_model import ModelNumbers, RollingState, StraightTyres, Surroundings, rolling_state
from .torque_response import TorqueResponse

TORQUES_AT_ONCE = 64  # which the memory of a minute's recording holds easily


class ChannelDifferences:
    """The channels of some motions under a model, and under models that differ from it.

    Attributes:
        model: the channel model.
        motions: true motions, each with a pose.
        filters: of the channels, one per motion.
        measured, predicted, residual: filtered, (T, C).
        on_ground: how the wheels of each motion roll under the torques that reach the ground; straight: the tyres there. Off
            the ground there are no such states, and None for tyres.
    """

    def __init__(
        self,
        model: ChannelModel,
        motions: Sequence[RobotMotion],
        filters: Sequence[SignalFilter],
        straight: Sequence[StraightTyres | None] | None = None,
    ) -> None:
        """Take the channels of true motions, each with a pose.

        Args:
            model: the channel model; motions: the motions; filters: of the channels, one per motion.
            straight: the tyres of each motion; None: straight about the forces that there are.
        """
        self.model, self.motions, self.filters = model, motions, filters
        self._states: list[RollingState] = []
        self._around: list[Surroundings] = []
        self.normal = [model.normal_along(motion) for motion in motions]
        self.on_ground: list[RollingState] = []
        self.straight: list[StraightTyres | None] = []
        for index, (motion, normal) in enumerate(zip(motions, self.normal, strict=True)):
            around = model.around(motion)
            if model.layout.lifted:  # nothing rolls
                self._around.append(dataclasses.replace(around, normal=normal))
                self.straight.append(None)
                continue
            state = there = rolling_state(motion, model.numbers, model.layout, around)
            if motion.lost is not None:
                there = rolling_state(motion.without_lost(), model.numbers, model.layout, around)
            tyres: StraightTyres | None
            if straight is None:
                tyres = StraightTyres.about(model.numbers, there.force, there.grip, in_place=motion.lost is not None)
            else:
                tyres = straight[index]
            self._states.append(state)
            self.on_ground.append(there)
            self.straight.append(tyres)
            places = model.wheel_places(motion)
            known = dataclasses.replace(around, straight=tyres, normal=normal, places=places, wheels=state.wheels)
            self._around.append(known)
        self._sides = [model.sides(motion, around) for motion, around in zip(motions, self._around, strict=True)]
        self.known = [np.isfinite(measured) for measured, _ in self._sides]
        # Where a sensor paused stands what it would have measured: a zero there would reach samples beside it by the filter.
        sides = [(np.where(there, *both), both[1]) for there, both in zip(self.known, self._sides, strict=True)]
        self.measured, self.predicted = (self.filtered(pieces) for pieces in zip(*sides, strict=True))
        self.residual = self.measured - self.predicted
        # Off the ground nothing rolls.
        self._responses: list[JointResponse | TorqueResponse] | None = None
        if model.layout.lifted:
            self._responses = [JointResponse() for _ in motions]

    def filtered(self, pieces: Sequence[FloatArray]) -> FloatArray:
        """Filter one array (T, ...) per motion and put them on end."""
        return np.concatenate([f.apply(piece) for f, piece in zip(self.filters, pieces, strict=True)])

    def left_by(self, samples: Sequence[BoolArray]) -> FloatArray:
        """What some samples (T,) of each motion leave in the residual (T, C), as far as the filter reaches."""
        pairs = zip(self._sides, samples, strict=True)
        return self.filtered([np.where(own[:, None], np.nan_to_num(m - p), 0.0) for (m, p), own in pairs])

    def of_numbers(self, vary: Callable[[ModelNumbers, float], None], step: float) -> FloatArray:
        """Column (T, C): what the residual holds per unit by which a number of the model is off."""
        numbers = self.model.numbers.copy()
        vary(numbers, step)
        pieces = []
        for motion, around, plain in zip(self.motions, self._around, self._sides, strict=True):
            measured, predicted = self.model.sides(motion, around, numbers)
            pieces.append(np.nan_to_num(((plain[0] - plain[1]) - (measured - predicted)) / step))
        return self.filtered(pieces)

    def of_lean(self, change: FloatArray) -> FloatArray:
        """What a lean of gravity by `change` (3,) adds to the residual, (T, C)."""
        pieces = []
        for motion, around, plain in zip(self.motions, self._around, self._sides, strict=True):
            measured, predicted = self.model.sides(motion, self.model.around_leaning(motion, around, change))
            self.model.lean(motion, self.model.numbers, change, measured, predicted)
            pieces.append(np.nan_to_num((plain[0] - plain[1]) - (measured - predicted)))
        return self.filtered(pieces)

    def of_effect(self, instance: EffectInstance, lean: FloatArray | None = None) -> FloatArray:
        """What an effect adds to the residual, (T, C); lean: of gravity by so much (3,) in what the IMU senses."""
        pieces = []
        for motion, around, plain in zip(self.motions, self._around, self._sides, strict=True):
            if lean is not None:
                plain = plain[0].copy(), plain[1].copy()
                self.model.lean(motion, self.model.numbers, lean, *plain)
            measured, predicted = self.model.sides_with(motion, around, plain, instance)
            pieces.append(np.nan_to_num((plain[0] - plain[1]) - (measured - predicted)))
        return self.filtered(pieces)

    def of_climbing(self, i: int) -> FloatArray:
        """What a slope of one along the heading of wheel i adds to the residual, (T, C)."""
        pieces = []
        for motion, around, plain, normal in zip(self.motions, self._around, self._sides, self.normal, strict=True):
            climb = np.zeros(motion.position.shape) if around.climb is None else around.climb.copy()
            climb[:, i, 0] -= normal[:, i]
            measured, predicted = self.model.sides(motion, dataclasses.replace(around, climb=climb))
            pieces.append(np.nan_to_num((plain[0] - plain[1]) - (measured - predicted)))
        return self.filtered(pieces)

    def of_torque(self, torques: Sequence[FloatArray]) -> FloatArray:
        """What torques on the joints add to the residual.

        Args:
            torques: one array (T, n, 2, K) [N m] per motion.

        Returns:
            (T, C, K), per unit of each of the K torques.
        """
        parts = []
        for start in range(0, torques[0].shape[3], TORQUES_AT_ONCE):
            some = slice(start, start + TORQUES_AT_ONCE)
            pairs = zip(self._torque_responses(), self.known, torques, strict=True)
            parts.append(
                self.filtered([np.where(known[:, :, None], -r.apply(t[..., some]), 0.0) for r, known, t in pairs])
            )
        return np.concatenate(parts, axis=2)

    def wrench_of_torque(self) -> list[FloatArray]:
        """What torques on the joints add to force and moment along each motion, (T, 3, n, 2)."""
        return [r.wrench_of_torque for r in self._torque_responses() if isinstance(r, TorqueResponse)]

    def _torque_responses(self) -> list[JointResponse | TorqueResponse]:
        if self._responses is None:
            self._responses = [
                TorqueResponse(motion, self.model.numbers, self.model.layout, state, around.straight)
                for motion, state, around in zip(self.motions, self._states, self._around, strict=True)
                if around.straight is not None
            ]
        return self._responses

    def of_unit_torque(self, i: int, axis: int) -> FloatArray:
        """What a constant torque at one joint adds to the residual (T, C), per N m."""
        torques = []
        for motion in self.motions:
            torque = np.zeros((*motion.torque.shape, 1))
            torque[:, i, axis] = 1.0
            torques.append(torque)
        return self.of_torque(torques)[:, :, 0]
