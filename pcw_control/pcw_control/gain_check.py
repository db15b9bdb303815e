"""What delay the velocity loops of a robot bear with given gains: the command `gain_check`.

    ros2 run pcw_control gain_check [ROBOT ...] [--velocity-gain 20] [--delay 0.001] [--write FOLDER]

For every wheel centre k_p is the gain on its speed: velocity_gain times its effective mass in computed torque, 2 w m in
RMRC; see `delay_margin`. The margin is that of a robot at rest whose tyres have no damping, which is a bound from below.
Without --velocity-gain it is the gain that the controllers derive for the robot, `ComputedTorqueParameters.of_robot`.
Exit code 0 when every robot bears the delay, 1 when one does not, 2 on bad input.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pcw_description.errors import PcwError
from pcw_description.new_file import require_new_file
from pcw_description.robot_description import RobotDescription
from pcw_description.robot_file import load_robot, shipped_robots

from .computed_torque import ComputedTorqueParameters
from .delay_margin import (
    BANDWIDTH,
    DELAY,
    delay_margin,
    derived_bandwidth,
    effective_mass,
    own_mass,
    tyre_resonance,
)
from .errors import ControlError
from .force_guided import ForceGuidedParameters
from .reference_motion import derived_steer_acceleration


def report(robot: RobotDescription, velocity_gain: float | None, delay: float) -> tuple[list[str], bool]:
    """Return what there is to say of one robot, and whether it bears the delay [s]; no gain is the one it derives [1/s]."""
    derived = ComputedTorqueParameters.of_robot(robot).velocity_gain
    gain = derived if velocity_gain is None else velocity_gain
    mass = effective_mass(robot)
    w = derived_bandwidth(robot, BANDWIDTH)
    lines = [
        f"{robot.name}: joint_states at {robot.sensors.encoders.rate:g} Hz; steering turns round at up to "
        f"{derived_steer_acceleration(robot):.0f} rad/s^2",
        "  wheel centre             mass    own mass  resonance   margin, computed torque   margin, RMRC",
    ]
    margins = {"computed torque": delay_margin(robot, gain * mass), "RMRC": delay_margin(robot, 2.0 * w * mass)}
    for i, name in enumerate(robot.caster_names):
        for j, axis in enumerate(("along", "across")):
            lines.append(
                f"  {name + ', ' + axis:22s} {mass[i, j]:6.2f} kg {own_mass(robot)[i, j]:8.2f} kg "
                f"{tyre_resonance(robot)[i, j]:6.0f} rad/s {1e3 * margins['computed torque'][i, j]:17.2f} ms "
                f"{1e3 * margins['RMRC'][i, j]:17.2f} ms"
            )
    least = min(float(np.min(margin)) for margin in margins.values())
    advised = 2.0 * derived_bandwidth(robot, gain / 2.0, delay)
    # What is derived for a delay bears just that delay, to rounding.
    bears = bool(np.min(margins["computed torque"]) >= delay * (1.0 - 1e-9))
    if float(np.min(delay_margin(robot, advised * mass))) >= delay * (1.0 - 1e-9):
        advice = f"advised: {advised:.1f} 1/s"
    else:
        advice = "nor does any gain that still moves it: shorten the delay"
    lines.append(
        f"  least margin {1e3 * least:.2f} ms; velocity_gain {gain:.4g} 1/s{' (derived)' if velocity_gain is None else ''} "
        + (f"bears {1e3 * delay:g} ms" if bears else f"does not bear {1e3 * delay:g} ms; {advice}")
        + f"; RMRC and SME-RMRC derive {w:.1f} rad/s"
    )
    return lines, bears


def parameter_file(robot: RobotDescription, delay: float) -> str:
    """Return the gains of a robot as a ROS parameter file: both poles of computed torque at w, as the delay allows."""
    w, found = derived_bandwidth(robot, BANDWIDTH, delay), ForceGuidedParameters.of_robot(robot, delay)
    names = ("velocity_gain", "position_gain", "integral_gain", "tracking_gain")
    gains = {**{name: getattr(found, name) for name in names}, "bandwidth": w}
    return "\n".join([
        f"# Gains of {robot.name}, written by `gain_check --delay {delay:g} --write`: both poles at {w:.2f} rad/s.",
        "/**:",
        "  ros__parameters:",
        *(f"    {name}: {value:.2f}" for name, value in gains.items()),
        "",
    ])  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the check."""
    parser = argparse.ArgumentParser(prog="gain_check", description="Say what delay a robot's control loops bear.")
    parser.add_argument("robots", nargs="*", metavar="ROBOT", help="robot files or shipped names (default: all shipped ones)")
    parser.add_argument(
        "--velocity-gain", type=float, help="k_d of computed torque [1/s] (default: what the controllers derive)"
    )
    parser.add_argument("--delay", type=float, default=DELAY, help="to bear, besides the hold [s] (default: %(default)s)")
    parser.add_argument("--write", type=Path, metavar="FOLDER", help="write the derived gains, a parameter file per robot")
    options = parser.parse_args(arguments)
    try:
        if not 0.0 <= options.delay <= 0.1:
            raise ControlError(f"--delay {options.delay!r} s is not allowed; allowed: 0 to 0.1 s")
        if options.velocity_gain is not None:
            ComputedTorqueParameters(velocity_gain=options.velocity_gain)
        names, all_bear = options.robots or [name for name in shipped_robots() if _torque_controlled(name)], True
        robots = [load_robot(name) for name in names]
        if options.write is not None:
            options.write.mkdir(parents=True, exist_ok=True)
            for robot in robots:
                require_new_file(options.write / f"{robot.name}.yaml", "--write")
        for robot in robots:
            lines, bears = report(robot, options.velocity_gain, options.delay)
            all_bear = all_bear and bears
            print("\n".join(lines))
            if options.write is not None:
                path = options.write / f"{robot.name}.yaml"
                path.write_text(parameter_file(robot, options.delay), encoding="utf-8")
                print(f"  gains for {1e3 * options.delay:g} ms written to {path}")
    except PcwError as error:
        print(f"gain_check: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"gain_check: --write {options.write}: {error.strerror or error}; allowed: a folder", file=sys.stderr)
        return 2
    return 0 if all_bear else 1


def _torque_controlled(name: str) -> bool:
    try:
        load_robot(name).require_torque_control()
    except PcwError:
        return False
    return True


if __name__ == "__main__":
    raise SystemExit(main())
