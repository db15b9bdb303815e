"""How soon an encoder that stands is found, at which speed of its joint, and whether one is found where none stands.

    python -m pcw_sim_bridge.can.trials encoders [--times 20] [--seed 0]

`encoder_stuck`: the position stands, the speed goes on. `encoder_dead`: the position stands and the speed is zero, as where a
drive takes the speed from the count; then only the other joints tell (`encoder_watch`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pcw_control.excitation import make_excitation
from pcw_description.robot_description import AXIS_NAMES, FloatArray, RobotDescription
from pcw_description.robot_file import load_robot

from ..simulate import added_physics
from .can_file import can_file_from, joint_place, read_can_file
from .starting_file import starting_content
from .trial_rig import ALLOWED_MS, FILES, Rig

SPEEDS = ((0.1, 0.25), (0.25, 0.5), (0.5, 1.0), (1.0, 2.0), (2.0, 10.0))  # of the joint when its encoder dies [rad/s]
WAIT = 20.0  # for a joint of such a speed [s]
LOOK = 1.0  # after the encoder died [s]
# What a robot may have besides, without an encoder that stands. {} is the first caster.
HEALTHY = (
    "", "{{name: steer_zero_offset, target: [{}], offset: 0.05}}", "{{name: wheel_radius_error, target: [{}], error: 0.003}}",
    "{{name: gear_backlash, target: [{}], axis: drive, play: 0.005}}",
    "{{name: steer_coulomb_friction, target: [{}], coulomb: 0.5}}",
    "{{name: low_friction_patch, target: [{}], factor: 0.2, x: 0.5, length: 1.0, width: 4.0}}",
    "{{name: payload_mass, target: [chassis], mass: 20.0}}",
)  # fmt: skip
ROBOTS = ("thesis", "tidybot2", "xr4000", "flow_base", "dyros_pcv")
EXCITATIONS = ("figure8", "random_goals")


@dataclasses.dataclass(frozen=True)
class Found:
    """One encoder that was made to stand.

    Attributes:
        speed: of its joint then [rad/s].
        after: until the torque was zero at every drive [s]; None: not within `LOOK`.
        turned: by how much the joint turned until then [rad].
    """

    speed: float
    after: float | None
    turned: float


def one_encoder(rig: Rig, fault: str, axis: str, speeds: tuple[float, float], rng: np.random.Generator) -> Found | None:
    """Let one encoder stand while its joint turns at such a speed; None if none did in time."""
    can = rig.can
    can.enable()
    rig.wander(float(rng.uniform(2.0, 40.0)))
    rig.cycles(int(rng.integers(50, 300)))
    of_axis = np.array([name.endswith(f"_{axis}") for name in rig.robot.joint_names])
    end = rig.emulated.time + WAIT
    while True:
        assert can.reading is not None and not can.faults, can.faults
        speed = np.abs(can.reading.joints.velocity).ravel()
        fitting = np.flatnonzero(of_axis & (speed >= speeds[0]) & (speed < speeds[1]))
        if len(fitting) or rig.emulated.time > end:
            break
        rig.cycles(1)
    if not len(fitting):
        can.request_disable()
        rig.cycles(5)
        return None
    which = int(rng.choice(fitting))
    name = rig.robot.joint_names[which]
    place = joint_place(rig.robot, name)
    rig.transport.receive(float(rng.uniform(0.0, can.period)))
    begun, before = rig.emulated.time, rig.emulated.plant.state().joint_position[place]
    rig.timer.begin(fault, name)
    while not can.faults and rig.emulated.time < begun + LOOK:
        rig.cycles(1)
    turned = abs(float(rig.emulated.plant.state().joint_position[place] - before))
    rig.cycles(3)
    zero = rig.timer.reactions[-1]["zero_after_ms"] if can.faults else None
    rig.emulated.inject("heal", "all")
    can.request_disable()
    rig.cycles(25)
    can.clear_faults()
    return Found(float(speed[which]), None if zero is None else zero * 1e-3, turned)


def run_encoders(times: int, seed: int) -> tuple[str, bool]:
    """Do both studies; returns a table and whether there was no false alarm."""
    robot, rng = load_robot("thesis"), np.random.default_rng(seed)
    lines = ["joint  its speed says    speed [rad/s]  times  found  in 50 ms  median  largest  turned at most"]
    for fault, says in (("encoder_stuck", "that it turns"), ("encoder_dead", "zero")):
        rigs = [Rig(robot, read_can_file(name, robot), seed) for name in FILES]
        for rig in rigs:
            rig.can.configure()
        for axis in AXIS_NAMES:
            for speeds in SPEEDS:
                tried = [one_encoder(rig, fault, axis, speeds, rng) for rig in rigs for _ in range(times)]
                lines.append(_line(axis, says, speeds, [found for found in tried if found is not None]))
    said, alarms = run_false_alarms(seed)
    return "\n".join(lines) + "\n\n" + said, alarms == 0


def _line(axis: str, says: str, speeds: tuple[float, float], tried: Sequence[Found]) -> str:
    found = [f for f in tried if f.after is not None]
    quick = sum(f.after is not None and f.after * 1000.0 <= ALLOWED_MS for f in tried)
    after = [1000.0 * f.after for f in found if f.after is not None]
    numbers = f"{np.median(after):4.0f} ms  {max(after):5.0f} ms" if after else f"{'':16}"
    turned = f"{max(f.turned for f in found):8.3f} rad" if found else ""
    return (f"{axis:6} {says:15} {speeds[0]:6.2f} to {speeds[1]:5.2f}  {len(tried):5}  {len(found):5}  {quick:8}  {numbers}"
            f"  {turned}").rstrip()  # fmt: skip


def run_false_alarms(seed: int, duration: float = 12.0) -> tuple[str, int]:
    """Drive healthy and other robots whose encoders all work; returns a line and how many were stopped for an encoder."""
    alarms, runs, stopped = [], 0, []
    for name in ROBOTS:
        believed = load_robot(name)
        for i, physics in enumerate(HEALTHY):
            effects = added_physics(physics.format(believed.caster_names[0]), believed.caster_names) if physics else ()
            robot = dataclasses.replace(believed, physics=effects)
            protocol = ("cia402", "odrive")[i % 2]
            content = starting_content(believed, protocol, rate=200.0, largest_load=1.0)
            excitation = make_excitation(EXCITATIONS[i % 2], believed, None, seed + i)
            faults = healthy_run(robot, believed, content, excitation.twist, duration, seed)
            runs += 1
            what = f"{name} {physics.format(believed.caster_names[0])}"
            if any(fault.startswith("encoder") for fault in faults):
                alarms.append(f"{what}: {faults[0]}")
            elif faults:
                stopped.append(f"{what}: {faults[0]}")
    line = f"{runs} runs of {duration:g} s on {len(ROBOTS)} robots whose encoders work: {len(alarms)} stopped for an encoder"
    return "\n".join([line, *(f"  {what}" for what in alarms + stopped)]), len(alarms)


def healthy_run(
    robot: RobotDescription,
    believed: RobotDescription,
    content: Mapping[str, Any],
    twist: Callable[[float], FloatArray | None],
    duration: float,
    seed: int,
) -> list[str]:
    """Drive `robot`, which is taken for `believed`, along a twist; returns what stopped it."""
    rig = Rig(robot, can_file_from(content, believed), seed, believed)
    rig.can.configure()
    rig.can.enable()
    rig.wander(0.0)
    begun = rig.emulated.time
    rig.twist = lambda time: twist(time - begun)
    while rig.emulated.time < begun + duration and not rig.can.faults:
        rig.cycles(1)
    rig.emulated.close()
    return [str(fault) for fault in rig.can.faults]
