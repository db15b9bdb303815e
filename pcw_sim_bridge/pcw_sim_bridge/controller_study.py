"""The controllers of thesis sections 5.1 and 5.2 on two plants: figures 5.2, 5.3, 5.6, 5.7 and 5.8 as data and plot.

    python -m pcw_sim_bridge.controller_study [--out pcw_control/docs] [--seeds 10]

Writes controllers.md, and a CSV and an SVG file per figure; the thesis's number stands beside ours.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pcw_control.computed_torque import ComputedTorque
from pcw_control.controller_interface import Controller, TwistReference
from pcw_control.force_distribution import jacobian_forces, weighted_forces
from pcw_control.friction_sharing import (
    BasicSolution,
    JacobianPseudoInverse,
    TractionLimitAvoidance,
    TractionLimitParameters,
)
from pcw_control.quintic_trajectory import MotionLimits, TrajectoryPoint, plan_point_to_point
from pcw_control.resolved_motion_rate import (
    ResolvedMotionRate,
    SlidingModeRate,
    SlidingModeRateParameters,
)
from pcw_control.sliding_mode import SLIDING_LAWS
from pcw_description.differential_kinematics import (
    forward_kinematics_kernel,
    joint_matrix_blocks,
    wheel_jacobian,
)
from pcw_description.effect_instance import EffectInstance
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription
from pcw_description.robot_file import load_robot

from .closed_loop import ClosedLoopRun, run_closed_loop

PLANTS = ("reduced", "pybullet")
ROBOTS = ("thesis", "tidybot2", "xr4000", "dyros_pcv", "flow_base")
CHATTER_FROM = 50.0  # [Hz]
LOAD_MISMATCH = 0.3  # of the robot's mass
STEP_SPEED = 0.1  # of fig. 5.2, twice the boundary layer: what the robot, at rest, is taken over at [m/s]


def straight(length: float, limits: MotionLimits) -> tuple[Callable[[float], TrajectoryPoint], float]:
    """Return a quintic straight ahead as a reference, and its duration."""
    trajectory = plan_point_to_point(TrajectoryPoint(np.zeros(3)), TrajectoryPoint(np.array([length, 0.0, 0.0])), limits)
    return trajectory.sample, trajectory.duration


def rms(values: FloatArray) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def chatter(run: ClosedLoopRun) -> float:
    """Return the RMS of the torques above `CHATTER_FROM` [N m]."""
    torque = run.torque.reshape(len(run.time), -1)
    spectrum = np.fft.rfft(torque - torque.mean(axis=0), axis=0)
    spectrum[np.fft.rfftfreq(len(run.time), float(np.median(np.diff(run.time)))) < CHATTER_FROM] = 0.0
    return rms(np.fft.irfft(spectrum, len(run.time), axis=0))


def incompatibility(robot: RobotDescription, run: ClosedLoopRun) -> FloatArray:
    """Return (I - A A^+) B q_dot (k, n, 2) [m/s]: how far the wheels are from moving as one."""
    return np.array([
        forward_kinematics_kernel(
            robot.steer_axis, robot.caster_offset, robot.wheel_radius, np.ascontiguousarray(q[:, STEER]),
            np.ascontiguousarray(q_dot),
        )[1]
        for q, q_dot in zip(run.joint_position, run.joint_velocity)
    ])  # fmt: skip


def overloaded(robot: RobotDescription) -> RobotDescription:
    """Return the robot with 30 % more mass than anybody told its controller, off its centre."""
    payload = EffectInstance(
        "payload_mass", ("chassis",), {"mass": LOAD_MISMATCH * robot.total_mass, "x": 0.05, "y": 0.03, "z": 0.3}
    )
    return dataclasses.replace(robot, physics=(payload,))


class Document:
    """Lines, figures and their data, all in one folder."""

    def __init__(self, out: Path) -> None:
        self.out, self.lines = out, list[str]()

    def add(self, *lines: str) -> None:
        """Add lines, and show them."""
        self.lines += lines
        print("\n".join(lines), flush=True)

    def table(self, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table."""
        self.add("", *(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows)), "")

    def figure(self, name: str, title: str, ylabel: str, time: FloatArray, curves: dict[str, FloatArray]) -> None:
        """Write the data as CSV and the plot as SVG, thinned to at most 500 instants."""
        every = slice(None, None, max(1, len(time) // 500))
        columns = {"time_s": time[every], **{label: curve[every] for label, curve in curves.items()}}
        np.savetxt(
            self.out / f"{name}.csv", np.column_stack(list(columns.values())), fmt="%.5g", delimiter=",",
            header=",".join(columns), comments="",
        )  # fmt: skip
        import matplotlib  # heavy, and only this needs it
        from matplotlib.figure import Figure

        with matplotlib.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
            figure = Figure(figsize=(7.0, 3.4), layout="constrained")
            axes = figure.add_subplot()
            for label, curve in curves.items():
                axes.plot(time[every], curve[every], linewidth=0.9, label=label.replace("_", " "))
            axes.set(xlabel="time [s]", ylabel=ylabel, title=title)
            axes.legend()
            figure.savefig(self.out / f"{name}.svg", metadata={"Date": None})
        self.add(f"![{title}]({name}.svg) [data]({name}.csv)")


def figure_5_2(document: Document) -> None:
    """Chattering and the reaching phase of the three sliding laws."""
    document.add("## Fig. 5.2: chattering, and the phase of reaching", "")
    document.add(
        f"A robot with {LOAD_MISMATCH:.0%} of load that nobody told the controller, at rest, is taken over at {STEP_SPEED} "
        f"m/s: that is the velocity error at the first sample. Chatter: RMS of all torques above {CHATTER_FROM:g} Hz. "
        "Bound of s: K T / m for the filtered law, the layer phi for the boundary layer. The filtered law "
        "holds s at its bound where the disturbance is more than K, and says for how long; the boundary layer is outside "
        "until it has reached.", "",
    )
    rows, target = [], TwistReference(np.array([STEP_SPEED, 0.0, 0.0]))
    for robot_name in ROBOTS:
        robot = load_robot(robot_name)
        for plant in PLANTS:
            chatters, reaching, curves, time = {}, {}, {}, np.zeros(0)
            for law in SLIDING_LAWS:
                controller = SlidingModeRate(robot, SlidingModeRateParameters(law=law))
                begun = _TakenOver(controller, np.array([STEP_SPEED, 0.0, 0.0]))
                run = run_closed_loop(overloaded(robot), begun, lambda _: target, 2.0, plant, seed=1)
                s = np.array([state.sliding.sliding for state in run.states])  # type: ignore[attr-defined]
                bound = np.full((robot.n, 2), controller.parameters.boundary)
                if law == "low_pass_integral":
                    bound = controller.sliding_bound(float(np.median(np.diff(run.time))))
                outside = np.nonzero(np.any(np.abs(s) > 1.02 * bound, axis=(1, 2)))[0]
                at_bound = np.any(np.abs(s) > 0.999 * bound, axis=(1, 2))
                period = float(np.median(np.diff(run.time)))
                reaching[law] = (
                    float(run.time[outside[-1]] + period) if len(outside) else 0.0, float(np.max(np.abs(s) / bound)),
                    float(np.sum(at_bound) * period),
                )
                chatters[law], time = chatter(run), run.time
                curves[law] = run.torque[:, 0, DRIVE]
            rows.append([
                robot_name, plant, *(f"{chatters[law]:.3f} N m" for law in SLIDING_LAWS),
                f"{chatters['low_pass_integral'] / chatters['plain']:.2%}",
                f"{1e3 * reaching['boundary_layer'][0]:.0f} ms", f"{1e3 * reaching['low_pass_integral'][0]:.0f} ms",
                f"{reaching['low_pass_integral'][1]:.2f}", f"{1e3 * reaching['low_pass_integral'][2]:.0f} ms",
            ])
            if robot_name == "thesis":
                document.figure(
                    f"fig_5_2_{plant}", f"Fig. 5.2, {plant} plant: drive torque of a wheel", "torque [N m]", time, curves
                )
    document.table(
        ["robot", "plant", *(f"chatter, {law.replace('_', ' ')}" for law in SLIDING_LAWS), "filtered / plain",
         "outside its bound: boundary layer", "outside: filtered", "largest s / bound, filtered",
         "at its bound: filtered"], rows,
    )
    document.add("The thesis shows curves without numbers: both quiet, the boundary layer reaches late. Bar: 5 %.", "")


class _TakenOver:
    """A controller that begins at a twist the robot does not have."""

    def __init__(self, controller: SlidingModeRate, twist: FloatArray) -> None:
        self._controller, self._twist = controller, twist
        self.robot, self.parameters, self.step = controller.robot, controller.parameters, controller.step

    def initial_state(self, twist: FloatArray | None = None) -> object:
        return self._controller.initial_state(self._twist)


def figure_5_3(document: Document) -> None:
    """Position tracking of RMRC and SME-RMRC."""
    document.add("## Fig. 5.3: position tracking error of a wheel", "")
    document.add(
        f"A quintic of 1 m straight ahead, {LOAD_MISMATCH:.0%} of unknown load. The error is of the roll angle against "
        "inverse kinematics, as the thesis takes it; RMS over all wheels.", "",
    )
    rows = []
    for robot_name in ROBOTS:
        robot = load_robot(robot_name)
        reference, duration = straight(1.0, MotionLimits(0.5, 0.5))
        for plant in PLANTS:
            errors, time = {}, np.zeros(0)
            for label, controller in (("RMRC", ResolvedMotionRate(robot)), ("SME_RMRC", SlidingModeRate(robot))):
                run = run_closed_loop(overloaded(robot), controller, reference, duration + 0.5, plant, seed=2)
                wanted = np.array([reference(t).pose[0] for t in run.time])[:, None] / robot.wheel_radius
                errors[label], time = run.joint_position[:, :, DRIVE] - run.joint_position[0, :, DRIVE] - wanted, run.time
            rows.append([
                robot_name, plant, *(f"{1e3 * rms(error):.2f} mrad" for error in errors.values()),
                f"{rms(errors['SME_RMRC']) / rms(errors['RMRC']):.3f}",
            ])
            if robot_name == "thesis":
                curves = {label: 1e3 * error[:, 0] for label, error in errors.items()}
                document.figure(f"fig_5_3_{plant}", f"Fig. 5.3, {plant} plant", "roll angle error [mrad]", time, curves)
    document.table(["robot", "plant", "RMRC", "SME-RMRC", "ratio"], rows)
    document.add("The thesis shows that the error drops \"significantly\", without a number. Bar: 0.35.", "")


def figures_5_6_to_5_8(document: Document, seeds: int) -> None:
    """Synchronisation and peak torque of three ways to share the wrench, and with limits."""
    document.add("## Figs. 5.6, 5.7 and 5.8: through A, through J, and by three forces", "")
    document.add(
        "A quintic of 2 m straight ahead of the thesis robot from random headings of the wheels. Spread: RMS of what of the "
        "wheel speeds no motion of the robot explains, (I - A A^+) B q_dot. `J`: the least sum of squared joint torques; "
        "`three forces`: a basic solution of (5.4), in which three of the eight forces carry everything. Thesis: 4.2 N m "
        "through J, 3.5 N m through A, a ratio of 0.83, on its robot from headings that it does not state.", "",
    )
    robot = load_robot("thesis")
    reference, duration = straight(2.0, MotionLimits(0.8, 0.8))
    controllers: dict[str, Callable[[], Controller]] = {
        "A": lambda: ComputedTorque(robot), "J": lambda: JacobianPseudoInverse(robot),
        "three_forces": lambda: BasicSolution(robot),
    }
    rows = []
    for plant in PLANTS:
        spreads: dict[str, list[float]] = {label: [] for label in controllers}
        peaks: dict[str, list[float]] = {label: [] for label in controllers}
        squeezes: dict[str, list[float]] = {label: [] for label in controllers}
        for seed in range(seeds):
            rng = np.random.default_rng([seed, 56])
            steer_angle = rng.uniform(-math.pi, math.pi, robot.n)
            curves, torques, time = {}, {}, np.zeros(0)
            for label, make in controllers.items():
                run = run_closed_loop(robot, make(), reference, duration + 0.2, plant, seed, steer_angle)
                uneven = incompatibility(robot, run)
                spreads[label].append(rms(uneven))
                peaks[label].append(float(np.abs(run.torque).max()))
                squeezes[label].append(rms(run.internal_force))
                curves[label], time = 1e3 * np.sqrt(np.mean(uneven[:, :, 0] ** 2, axis=1)), run.time
                torques[label] = np.abs(run.torque).max(axis=(1, 2))
            if seed == 0:
                document.figure(f"fig_5_6_{plant}", f"Fig. 5.6, {plant} plant", "spread of wheel speeds [mm/s]", time, curves)
                document.figure(
                    f"fig_5_7_{plant}", f"Figs. 5.7 (a), 5.8 (a), {plant} plant", "largest joint torque [N m]", time, torques
                )
        for label in controllers:
            spread, peak = np.array(spreads[label]), np.array(peaks[label])
            by_spread, by_peak = np.array(spreads["A"]) / spread, np.array(peaks["A"]) / peak
            rows.append([
                plant, label.replace("_", " "), f"{1e3 * np.median(spread):.2f} mm/s", f"{np.median(by_spread):.2f}",
                f"{np.median(peak):.2f} N m", f"{np.median(by_peak):.2f}", f"{np.min(by_peak):.2f} to {np.max(by_peak):.2f}",
                f"{np.median(squeezes[label]):.1f} N",
            ])
    document.table(
        ["plant", "way", "spread, median", "spread of A over it", "peak torque, median", "peak of A over it, median",
         "least to greatest", "internal force, RMS"], rows,
    )
    document.add(*_statics(robot), "")
    _with_limits(document, robot, reference, duration)


def _statics(robot: RobotDescription) -> list[str]:
    """Say over many headings how the peak torques of a push straight ahead compare."""
    B = joint_matrix_blocks(robot)
    B_inverse: FloatArray = np.linalg.inv(B).astype(np.float64)
    rng, ratios = np.random.default_rng(57), []
    for _ in range(2000):
        A, F = wheel_jacobian(robot, rng.uniform(-math.pi, math.pi, robot.n)), np.array([100.0, 0.0, 0.0])
        peaks = [
            np.abs(np.einsum("nji,nj->ni", B, force)).max()
            for force in (weighted_forces(A, F, np.ones((robot.n, 2))), jacobian_forces(A, F, B_inverse))
        ]
        ratios.append(peaks[0] / peaks[1])
    low, middle, high = np.percentile(ratios, [5, 50, 95])
    return [
        f"Over 2000 random headings, standing still, the peak torque of a push straight ahead through A is {middle:.2f} of "
        f"that through J (5 to 95 %: {low:.2f} to {high:.2f}); {np.mean(np.array(ratios) <= 0.85):.1%} of the headings reach "
        "0.85. J minimises the sum of squared torques, so its peak is seldom the higher one: only where one wheel with a "
        "short lever stands across beside several along does it get more than its share.",
    ]


def _with_limits(
    document: Document, robot: RobotDescription, reference: Callable[[float], TrajectoryPoint], duration: float
) -> None:
    """Figs. 5.7 (b), 5.8 (b): internal forces keep the limits."""
    rng = np.random.default_rng([0, 56])
    steer_angle = rng.uniform(-math.pi, math.pi, robot.n)
    free = run_closed_loop(robot, ComputedTorque(robot), reference, duration, "reduced", 0, steer_angle)
    # A limit that the pseudo-inverse breaks by a fifth.
    peak = np.abs(free.torque).max(axis=(0, 1))
    casters = tuple(
        dataclasses.replace(
            c, limits=dataclasses.replace(c.limits, drive_torque=float(peak[0]) / 0.96, steer_torque=float(peak[1]) / 0.96)
        )
        for c in robot.casters
    )
    limited = dataclasses.replace(robot, casters=casters)
    share, rows = 0.8, []
    for plant in PLANTS:
        controller = TractionLimitAvoidance(limited, TractionLimitParameters(traction_share=share))
        run = run_closed_loop(robot, controller, reference, duration, plant, 0, steer_angle)
        used = np.abs(run.torque).max(axis=(0, 1)) / np.array([peak[0] / 0.96, peak[1] / 0.96])
        error = run.pose[-1] - reference(duration).pose
        rows.append([plant, f"{used[0]:.4f}", f"{used[1]:.4f}", f"{1e3 * np.hypot(*error[:2]):.1f} mm"])
    document.add(
        "### With limits, figs. 5.7 (b) and 5.8 (b)", "",
        f"TLA with a = {share}, the torque limits set so that the pseudo-inverse would use 0.96 of them at its peak.",
    )
    document.table(["plant", "largest drive torque / limit", "largest steering torque / limit", "off the goal"], rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and write the document."""
    parser = argparse.ArgumentParser(prog="controller_study", description="Controllers of thesis sections 5.1 and 5.2.")
    parser.add_argument("--seeds", type=int, default=6, help="headings for figs. 5.6 to 5.8 (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("pcw_control/docs"), help="folder to write to")
    options = parser.parse_args(arguments)
    if options.seeds < 1:
        parser.error(f"argument --seeds: {options.seeds} is not allowed; allowed: at least 1")
    options.out.mkdir(parents=True, exist_ok=True)
    document = Document(options.out)
    document.add(
        "# Controllers of thesis sections 5.1 and 5.2", "",
        f"Written by `python -m pcw_sim_bridge.controller_study --seeds {options.seeds}`; nothing here is typed in. All runs "
        "are with the sensors of the robot files at 500 Hz, torque limits included.", "",
    )
    figure_5_2(document)
    figure_5_3(document)
    figures_5_6_to_5_8(document, options.seeds)
    (options.out / "controllers.md").write_text("\n".join(document.lines).rstrip() + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
