"""`mujoco.sysid` on a bench axis: one joint of MuJoCo, with all that a joint and its motor have, freed."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pcw_description.axis_recording import TARGET, AxisDescription, AxisRecording
from pcw_description.effects.registry import read_physics

from ..axis.axis_channels import AxisProblemBuilder
from ..errors import MismatchError
from ..regression.regression_problem import RegressionProblem
from .baseline_result import Explained
from .mujoco_identification import AXIS_WINDOWS, WINDOW, FreeNumber, Window, identify, spread_out

Writer = Callable[[Any, float], None]
# What MuJoCo's joint and motor have, and the name and parameter of the effect that it is.
EFFECTS = {
    "drive_coulomb_friction": "coulomb",
    "drive_viscous_friction": "viscous",
    "constant_load": "load",
}
# The lever of a gravity arm is not known, only its moment: short, so that its own inertia stays a small part.
LEVER_INERTIA = 0.01
GRAVITY = 9.81  # [m/s^2]


def identified_axis(
    axis: AxisDescription, recordings: Sequence[AxisRecording], held_out: Sequence[AxisRecording], proof: RegressionProblem
) -> Explained:
    """Fit inertia, damping, dry friction, a constant load and the gravity arm of an axis to its recordings.

    A ripple over the position, a Stribeck curve or an asymmetry is nothing that MuJoCo's joint has.

    Raises:
        MismatchError: no piece of a recording is as long as a window, or the axis has effects of its own already.
    """
    if axis.physics:
        raise MismatchError("could not run: the description holds effects, which MuJoCo's joint cannot take over")
    builder = AxisProblemBuilder(axis, recordings)
    smoothing = builder.choose_smoothing()
    free = _free(axis, builder)
    model = axis_spec(axis, 1.0 / builder.filters[0].rate)
    found = identify(model, _windows(builder), [number for number, _ in free], modifiers=[write for _, write in free])
    patched = _with_numbers(axis, found.values, smoothing)
    after = AxisProblemBuilder(patched, held_out, builder.cutoff).build(smoothing).residual
    return Explained(found.moved, proof.residual - after, found.remark)


def _free(axis: AxisDescription, builder: AxisProblemBuilder) -> list[tuple[FreeNumber, Writer]]:
    """Numbers and what writes each into a spec."""
    force = np.concatenate([motion.force for motion in builder.motions])
    speed = np.concatenate([motion.velocity for motion in builder.motions])
    size = 0.05 * float(np.sqrt(np.mean(force**2)))
    damping = size / max(float(np.sqrt(np.mean(speed**2))), 1e-12)

    def tolerance(name: str, nominal: float) -> float:
        known = axis.tolerance(name)
        return known.value * nominal if known.relative else known.value

    def inertia(spec: Any, value: float) -> None:
        _give_inertia(spec.body(TARGET), axis, value)

    def coulomb(spec: Any, value: float) -> None:
        spec.joint(TARGET).frictionloss = value

    def viscous(spec: Any, value: float) -> None:
        spec.joint(TARGET).damping = [value, 0.0, 0.0]  # of the first, second and third power of the speed

    def load(spec: Any, value: float) -> None:
        spec.actuator(TARGET).biasprm[0] = -value

    def moment(spec: Any, value: float) -> None:
        spec.body(TARGET).mass = value / (GRAVITY * _lever(axis))

    known = tolerance("inertia", axis.inertia)
    free: list[tuple[FreeNumber, Writer]] = [
        (FreeNumber("inertia", axis.inertia, known, 0.2 * axis.inertia, 5.0 * axis.inertia, known), inertia),
        # A twentieth of the range off the bound, where the toolbox's authors say that it stalls.
        (FreeNumber(f"drive_coulomb_friction/{TARGET}", 0.0, size, 0.0, 20.0 * size, start=size), coulomb),
        (FreeNumber(f"drive_viscous_friction/{TARGET}", 0.0, damping, 0.0, 20.0 * damping, start=damping), viscous),
        (FreeNumber(f"constant_load/{TARGET}", 0.0, size, -20.0 * size, 20.0 * size), load),
    ]
    if axis.gravity_arm is not None:
        nominal = axis.gravity_arm.moment
        known = tolerance("gravity_moment", nominal)
        free.append((FreeNumber("gravity_moment", nominal, known, 0.2 * nominal, 5.0 * nominal, known), moment))
    return free


def _lever(axis: AxisDescription) -> float:
    """Lever of the gravity arm [m], at which its mass has a small part of the inertia."""
    assert axis.gravity_arm is not None
    return LEVER_INERTIA * axis.inertia * GRAVITY / axis.gravity_arm.moment


def _give_inertia(body: Any, axis: AxisDescription, inertia: float) -> None:
    """Give the body its inertia along the joint; not as an armature, which MuJoCo's dry friction does not reckon with."""
    if axis.kind == "linear":
        body.mass, body.inertia = inertia, np.full(3, 1e-6 * inertia)
    else:
        body.inertia = np.full(3, inertia * (1.0 - LEVER_INERTIA if axis.gravity_arm else 1.0))
        if axis.gravity_arm is None:
            body.mass = inertia


def axis_spec(axis: AxisDescription, step: float) -> Any:
    """MjSpec of one joint with a motor."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.timestep = step
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.gravity = [0.0, 0.0, -GRAVITY]
    spec.compiler.degree = False
    body = spec.worldbody.add_body(name=TARGET)
    kind = mujoco.mjtJoint.mjJNT_SLIDE if axis.kind == "linear" else mujoco.mjtJoint.mjJNT_HINGE
    # About y gravity pulls a mass below the axis back with -M sin(angle).
    direction = [1.0, 0.0, 0.0] if axis.kind == "linear" else [0.0, 1.0, 0.0]
    body.add_joint(name=TARGET, type=kind, axis=direction)
    body.explicitinertial = True
    _give_inertia(body, axis, axis.inertia)
    if axis.gravity_arm is not None:
        hanging = axis.gravity_arm.hanging_position
        body.ipos = _lever(axis) * np.array([np.sin(hanging), 0.0, -np.cos(hanging)])
        body.mass = axis.gravity_arm.moment / (GRAVITY * _lever(axis))
    motor = spec.add_actuator(name=TARGET, target=TARGET)
    motor.trntype, motor.biastype = mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtBias.mjBIAS_AFFINE
    for name, sensed in (("position", mujoco.mjtSensor.mjSENS_JOINTPOS), ("velocity", mujoco.mjtSensor.mjSENS_JOINTVEL)):
        sensor = spec.add_sensor(name=name, objname=TARGET)
        sensor.type, sensor.objtype = sensed, mujoco.mjtObj.mjOBJ_JOINT
    return spec


def _windows(builder: AxisProblemBuilder) -> list[Window]:
    motions = builder.motions
    rate = builder.filters[0].rate
    length = max(3, round(WINDOW * rate))
    pieces = [(k, len(motion.time)) for k, motion in enumerate(motions)]
    chosen = spread_out(pieces, length, AXIS_WINDOWS)
    if not chosen:
        raise MismatchError(f"could not run: no contiguous piece of {WINDOW:g} s")
    windows = []
    for k, start in chosen:
        motion, rows = motions[k], slice(start, start + length)
        sensed = np.stack([motion.position[rows], motion.velocity[rows]], axis=1)
        state = np.r_[0.0, sensed[0]]
        windows.append(Window(state, np.arange(length) / rate, motion.force[rows, None], sensed))
    return windows


def _with_numbers(axis: AxisDescription, values: dict[str, float], smoothing: float) -> AxisDescription:
    entries = []
    for effect, parameter in EFFECTS.items():
        entry: dict[str, Any] = {"name": effect, "target": [TARGET], parameter: values[f"{effect}/{TARGET}"]}
        if effect == "drive_coulomb_friction":
            entry["smoothing_speed"] = smoothing
        entries.append(entry)
    arm = axis.gravity_arm
    if arm is not None:
        arm = dataclasses.replace(arm, moment=values["gravity_moment"])
    physics = read_physics(entries, (TARGET,))
    return dataclasses.replace(axis, inertia=values["inertia"], gravity_arm=arm, physics=physics)
