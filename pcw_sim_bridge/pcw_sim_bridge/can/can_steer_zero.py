"""`can_steer_zero`: drives a known motion, finds the zeros of the steering axes and writes them back.

ros2 run pcw_sim_bridge can_steer_zero --robot thesis --can-file my_drives.yaml

It opens the buses itself: no driver may run. The robot needs two metres of free floor around it.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcw_description.errors import PcwError
from pcw_description.robot_description import RobotDescription
from pcw_description.robot_file import load_robot
from pcw_description.short_collections import short_collections

from ..run_controllers import RunController, make_controller
from ..sensors import JointReading
from ..simulated_robot import JointCommand
from .can_file import CanFile, find_can_file, on_udp, read_can_file, shipped_can_files
from .can_robot import CanRobot, TimedReading
from .command_line import end_on_signals
from .errors import CanError
from .steer_zero import SteerZeros, calibration_twist, estimate_steer_zeros, write_zeros
from .transport import Transport

# Offsets that a second motion still finds are what the first left over [rad].
GOOD_ENOUGH = 0.003


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    options = argparse.ArgumentParser(
        prog="can_steer_zero",
        description="Drive a known motion, find the zeros of the steering axes and write them back; the old file is kept. No "
        "driver may run, and the robot needs two metres of free floor around it.",
    )
    options.add_argument("--robot", default="thesis", help="robot file, or the name of a shipped robot (default: thesis)")
    options.add_argument("--can-file", required=True, help="file of the drives")
    options.add_argument("--out", type=Path, help="write this file, and leave --can-file as it is")
    options.add_argument("--duration", type=float, default=20.0, metavar="SECONDS", help="of the motion (default: 20)")
    options.add_argument("--udp-port", type=int, default=0, metavar="PORT", help="buses as UDP multicast (default: file's)")
    options.add_argument("--dry-run", action="store_true", help="write nothing")
    options.add_argument("--yes", action="store_true", help="do not ask before the robot moves")
    return options


def measure(can: CanRobot, robot: RobotDescription, duration: float) -> SteerZeros:
    """Set up the drives of `can`, drive the known motion and return the offsets; torque is off afterwards.

    Raises:
        CanError: a fault stops the robot, or the motion does not tell.
    """
    controller = _ready_controller(robot)
    # Nothing was sent meanwhile, nor while the last motion was looked at: the drives have let go by themselves.
    can.clear_faults()
    positions, velocities = [], []
    last: list[float] = []

    def answer(reading: TimedReading) -> None:
        begun = last[0] if last else reading.time
        before = last[-1] if last else reading.time
        twist = calibration_twist(reading.time - begun, duration)
        can.command(controller.command(reading.joints, twist, max(reading.time - before, 1e-4)), reading.time)
        last[:] = [begun, reading.time]
        if reading.complete:
            positions.append(reading.joints.position)
            velocities.append(reading.joints.velocity)

    can.enable()
    try:
        can.command(JointCommand(effort=np.zeros((robot.n, 2))))
        while not last or last[-1] - last[0] < duration:
            can.cycle(answer)
            if can.faults:
                raise CanError("; ".join(map(str, can.faults)))
    finally:
        can.request_disable()
    return estimate_steer_zeros(robot, np.array(positions), np.array(velocities))


def _ready_controller(robot: RobotDescription) -> RunController:
    """Return a controller whose first command takes no longer than the next: it compiles, and drives do not wait for that."""
    believed = dataclasses.replace(robot, physics=())
    still = np.zeros((robot.n, 2))
    make_controller("computed_torque", believed).command(JointReading(still, still, still), np.zeros(3), 0.01)
    short_collections()
    return make_controller("computed_torque", believed)


def calibrate(can: CanRobot, robot: RobotDescription, duration: float, passes: int = 3) -> tuple[np.ndarray, list[SteerZeros]]:
    """Measure, apply and measure again until nothing is left; returns the sum (n,) [rad] and what each pass found.

    Raises:
        CanError: see `measure`.
    """
    total, found = np.zeros(robot.n), []
    for _ in range(passes):
        found.append(measure(can, robot, duration))
        total += found[-1].offset
        can.shift_steer_zeros(found[-1].offset)
        if np.abs(found[-1].offset).max() < GOOD_ENOUGH:
            break
    return total, found


def run(robot: RobotDescription, file: CanFile, transport: Transport, duration: float) -> tuple[np.ndarray, str]:
    """Calibrate over a transport; returns the offsets (n,) [rad] and what to tell."""
    can = CanRobot(robot, file, transport, encoders_agree=False)  # their headings are not known yet
    can.configure()
    for name, result in can.home().items():
        if result != "attained":
            raise CanError(f"homing of {name}: {result}; allowed: attained")
    total, found = calibrate(can, robot, duration)
    lines = [
        f"{name}_steer: {1000 * offset:+8.2f} mrad ({np.degrees(offset):+.3f} deg) +- {1000 * sigma:.2f} mrad"
        for name, offset, sigma in zip(robot.caster_names, total, found[-1].sigma, strict=True)
    ]
    lines.append(
        f"{len(found)} motions of {duration:g} s; what no motion of a rigid robot explains: "
        f"{1000 * found[0].residual_before:.1f} mm/s before, {1000 * found[-1].residual_after:.1f} mm/s after"
    )
    return total, "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    options = parser().parse_args(arguments)
    end_on_signals()
    try:
        return _main(options)
    except PcwError as error:
        print(f"can_steer_zero: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("can_steer_zero: ended before its time; no torque is left on and nothing was written", file=sys.stderr)
        return 130


def _agreed() -> bool:
    print("The robot will move. Free floor of two metres around it? [y/N] ", end="", flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def _main(options: argparse.Namespace) -> int:
    from .python_can import PythonCanTransport

    robot = load_robot(options.robot)
    path = find_can_file(options.can_file)
    file = read_can_file(path, robot)
    if options.out is None and not options.dry_run and path == shipped_can_files().get(options.can_file):
        raise CanError(f"--can-file {options.can_file} is a shipped file, which stays; allowed: a file of yours, or --out")
    if options.out is not None and options.out.exists():
        raise CanError(f"--out {options.out} exists already and is left as it is; allowed: a new file")
    if not 5.0 <= options.duration <= 600.0:
        raise CanError(f"--duration {options.duration:g} is not allowed; allowed: 5 to 600 s")
    if options.udp_port:
        file = on_udp(file, options.udp_port)
    transport = PythonCanTransport(file.buses)
    try:
        if not options.yes and not _agreed():
            return 1
        total, said = run(robot, file, transport, options.duration)
    finally:
        transport.close()
    print(said)
    if not options.dry_run:
        kept = write_zeros(path, robot, total, options.out)
        print(f"written to {options.out or path}; the old file is {kept}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
