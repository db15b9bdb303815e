"""Synthetic bench axes with known physics: what the tests and the false-alarm count of the analyser run on.

A case draws an axis (kind, size, sensors, noise of several colours), a motion, and a true inertia within tolerance; the
effects' own kernels act in the simulated plant, and position and force come out as a bench would record them. Nothing
here is used by the analyser.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import signal

from pcw_description.axis_recording import TARGET, AxisDescription, AxisRecording, parse_axis_description
from pcw_description.compiled import compiled, joint_torque_list
from pcw_description.effect_instance import EffectInstance
from pcw_description.effects.kinds import JointTorqueEffect
from pcw_description.effects.registry import get

from ..regression.regression_problem import FloatArray

SUBSTEPS = 10
MOTIONS = ("sines", "moves", "chirp")


@dataclasses.dataclass(frozen=True)
class BenchCase:
    """An axis as described, a recording of it as it is, and the truth."""

    axis: AxisDescription
    recordings: tuple[AxisRecording, ...]
    truth: tuple[EffectInstance, ...]
    true_inertia: float
    motion: str
    force_scale: float
    top_speed: float


@compiled
def _simulate(  # type: ignore[no-untyped-def]
    kernels,
    parameters,
    counts,
    reference,
    speed,
    acceleration,
    disturbance,
    inertia,
    gravity,
    stiffness,
    damping,
    step,
    substeps,
):
    """Follow a reference with computed force and PD; returns position, velocity and motor force at every sample."""
    samples = reference.shape[0]
    position, velocity = reference[0], speed[0]
    positions, forces = np.empty(samples), np.empty(samples)
    for k in range(samples):
        force = (
            inertia * acceleration[k]
            + gravity * math.sin(reference[k])
            + stiffness * (reference[k] - position)
            + damping * (speed[k] - velocity)
        )
        positions[k], forces[k] = position, force
        for _ in range(substeps):
            total = force + disturbance[k] - gravity * math.sin(position)
            start = 0
            for index in range(len(kernels)):
                added, _ = kernels[index](
                    position, velocity, force, 0.0, parameters[start : start + counts[index]]
                )
                total += added
                start += counts[index]
            velocity += step / substeps * total / inertia
            position += step / substeps * velocity
    return positions, forces


def reference_motion(
    kind: str, duration: float, rate: float, top_speed: float, travel: float, rng: np.random.Generator
) -> FloatArray:
    """Reference position (T,) of one of `MOTIONS`, scaled to a top speed and about a travel."""
    time = np.arange(int(duration * rate)) / rate
    if kind == "sines":
        slow = top_speed / travel
        speed = sum(
            rng.uniform(0.3, 1.0) * np.sin(slow * rng.uniform(0.7, 6.0) * time + rng.uniform(0, 2 * np.pi))
            for _ in range(5)
        )
    elif kind == "chirp":
        low, high = 0.5 * top_speed / travel / (2 * np.pi), min(4.0, 0.02 * rate)
        speed = signal.chirp(time, max(low, 0.05), duration, high, method="logarithmic", phi=-90)
    else:
        speed = np.zeros_like(time)
        start = 0
        while start < len(time):
            hold = int(rng.uniform(0.3, 1.5) * rate)
            speed[start : start + hold] = rng.choice([-1.0, 1.0]) * rng.choice([0.0, 0.25, 0.5, 0.75, 1.0])
            start += hold
        ramp = np.ones(max(2, int(0.15 * rate)))
        speed = signal.convolve(speed, ramp / ramp.sum(), mode="same")
    speed = np.asarray(speed) * top_speed / np.max(np.abs(speed))
    position = np.cumsum(speed) / rate
    drift = np.linspace(0.0, 1.0, len(time)) * position[-1]
    smooth = signal.butter(2, min(0.45 * rate, 15.0), fs=rate, output="sos")
    result: FloatArray = signal.sosfiltfilt(smooth, position - drift)
    return result


def coloured_noise(samples: int, rate: float, rng: np.random.Generator) -> FloatArray:
    """Noise of unit variance: white plus red with a random corner and share."""
    white = rng.standard_normal(samples)
    corner = 10.0 ** rng.uniform(-1.0, 1.3)
    pole = np.exp(-2 * np.pi * corner / rate)
    red = signal.lfilter([1.0], [1.0, -pole], rng.standard_normal(samples + 1000))[1000:]
    share = rng.uniform(0.0, 0.8)
    noise = np.sqrt(1 - share) * white + np.sqrt(share) * red / np.std(red)
    result: FloatArray = noise / np.std(noise)
    return result


def draw_bench_case(
    rng: np.random.Generator,
    effects: Sequence[str] = (),
    magnitude: float = 0.5,
    motion: str | None = None,
    overrides: Mapping[str, Mapping[str, float]] | None = None,
    noise: float | None = None,
    recordings: int = 1,
    kind: str | None = None,
    travel: float | None = None,
    gravity: float = 0.0,
    described_arm: Mapping[str, float] | None = None,
) -> BenchCase:
    """Draw a case.

    Args:
        effects: names of the effects at work.
        magnitude: size of each effect's force against the rms of the inertial force.
        motion: one of `MOTIONS`; None draws it.
        overrides: parameters by effect, in multiples of the size that `magnitude` gives.
        noise: of the force sensor against the rms of the inertial force; None draws 0.5 to 5 %.
        kind: "linear" or "rotary"; travel: about what the motion spans [m or rad]; None draws them.
        gravity: largest torque of an arm that hangs at position 0, against the rms of the inertial force.
        described_arm: that arm as the description has it: its `moment` against the true one, its `hanging_position` [rad];
            empty for one that is right, None if the description has none.
    """
    drawn = str(rng.choice(["linear", "rotary"]))
    kind = kind or drawn
    inertia = 10.0 ** rng.uniform(-3.0, 2.0)
    spans = 10.0 ** rng.uniform(-0.7, 0.3) if kind == "linear" else 10.0 ** rng.uniform(0.3, 1.5)
    travel = spans if travel is None else travel
    top_speed = travel * rng.uniform(0.5, 2.5)
    rate = float(rng.choice([200.0, 500.0, 1000.0]))
    duration = rng.uniform(15.0, 40.0)
    motion = motion or str(rng.choice(MOTIONS))
    references = [reference_motion(motion, duration, rate, top_speed, travel, rng) for _ in range(recordings)]
    speed = np.gradient(references[0], 1.0 / rate)
    force_scale = inertia * float(np.std(np.gradient(speed, 1.0 / rate)))
    speed_scale = float(np.sqrt(np.mean(speed**2)))
    moment = gravity * force_scale
    truth = tuple(
        _instance(name, magnitude * force_scale, speed_scale, travel, rng, (overrides or {}).get(name, {}))
        for name in effects
    )
    resolution = travel * 10.0 ** rng.uniform(-6.0, -4.3)
    arm = {}
    if described_arm is not None:
        arm = {"gravity_arm": {**described_arm, "moment": moment * described_arm.get("moment", 1.0)}}
    axis = parse_axis_description(
        {
            "format": "pcw_axis/1",
            "name": "synthetic",
            "kind": kind,
            "provenance": {"all": "drawn at random"},
            "columns": {"time": "t", "position": "q", "force": "f"},
            "inertia": inertia,
            "tolerances": {"inertia": "2 %"},
        }
        | arm
    )
    true_inertia = inertia * (1.0 + 0.02 * float(np.clip(rng.standard_normal(), -2.5, 2.5)))
    level = noise if noise is not None else 10.0 ** rng.uniform(-2.3, -1.3)
    made = []
    for index, reference in enumerate(references):
        position, force = _run(reference, rate, true_inertia, moment, truth, level * force_scale, rng)
        measured = np.round(position / resolution) * resolution + 0.3 * resolution * rng.standard_normal(
            len(position)
        )
        force = force + level * force_scale * coloured_noise(len(force), rate, rng)
        time = np.arange(len(force)) / rate
        made.append(
            AxisRecording(
                path=Path(f"synthetic_{index}"),
                time=time,
                position=measured,
                velocity=None,
                force=force,
                external_force=np.zeros_like(force),
                warnings=(),
            )
        )
    return BenchCase(axis, tuple(made), truth, true_inertia, motion, force_scale, top_speed)


def _run(
    reference: FloatArray,
    rate: float,
    inertia: float,
    gravity: float,
    truth: Sequence[EffectInstance],
    disturbance: float,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    speed = np.gradient(reference, 1.0 / rate)
    acceleration = np.gradient(speed, 1.0 / rate)
    pushes = 0.5 * disturbance * coloured_noise(len(reference), rate, rng)
    kernels, values = [], [np.zeros(0)]
    for instance in truth:
        effect = get(instance.name)
        assert isinstance(effect, JointTorqueEffect)
        kernels.append(effect.torque)
        values.append(effect.values(instance.parameters))
    counts = np.array([len(v) for v in values[1:]], dtype=np.int64)
    bandwidth = 2 * np.pi * min(8.0, rate / 40.0)
    position, force = _simulate(
        joint_torque_list(kernels),
        np.concatenate(values),
        counts,
        reference,
        speed,
        acceleration,
        pushes,
        inertia,
        gravity,
        inertia * bandwidth**2,
        2.0 * inertia * bandwidth,
        1.0 / rate,
        SUBSTEPS,
    )
    return position, force


def _instance(
    name: str,
    force: float,
    speed: float,
    travel: float,
    rng: np.random.Generator,
    factors: Mapping[str, float],
) -> EffectInstance:
    smoothing = 0.004 * speed
    # Several periods over the travel, yet slow enough at ordinary speed to lie in the band of any channel.
    order = min(2 * np.pi / travel * rng.uniform(3.0, 40.0), 2 * np.pi * 12.0 / speed)
    phase = rng.uniform(0.0, 2.0 * np.pi)
    parameters: dict[str, dict[str, float]] = {
        "drive_coulomb_friction": {"coulomb": force, "asymmetry": 0.0, "smoothing_speed": smoothing},
        "drive_viscous_friction": {"viscous": force / speed, "asymmetry": 0.0},
        "drive_stribeck_friction": {
            "stribeck": 2.0 * force,
            "stribeck_speed": 0.3 * speed,
            "smoothing_speed": smoothing,
        },
        "constant_load": {"load": force * float(rng.choice([-1.0, 1.0]))},
        "motor_cogging": {
            "cosine": 1.4 * force * float(np.cos(phase)),
            "sine": 1.4 * force * float(np.sin(phase)),
            "order": order,
        },
        "load_dependent_friction": {"fraction": 0.2, "smoothing_speed": smoothing},
        "torque_constant_error": {"error": 0.2},
    }
    values = {key: value * factors.get(key, 1.0) for key, value in parameters[name].items()}
    for key, factor in factors.items():
        if key == "asymmetry":
            main = "coulomb" if name == "drive_coulomb_friction" else "viscous"
            values["asymmetry"] = factor * values[main]
    return EffectInstance(name, (TARGET,), values)
