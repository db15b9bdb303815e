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
from pcw_control.force_distribution import jacobian_forces, weighted_forces_kernel
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
from pcw_control.slip_constraint_force import internal_part
from pcw_description.augmented_object_model import AugmentedObjectModel
from pcw_description.differential_kinematics import (
    forward_kinematics_kernel,
    inverse_kinematics,
    joint_matrix_blocks,
    wheel_jacobian_kernel,
)
from pcw_description.effect_instance import EffectInstance
from pcw_description.robot_description import DRIVE, STEER, FloatArray, RobotDescription
from pcw_description.robot_file import load_robot

from .closed_loop import ClosedLoopRun, run_closed_loop

PLANTS = ("reduced", "pybullet")
ROBOTS = ("thesis", "tidybot2", "xr4000", "dyros_pcv", "flow_base")
CHATTER_FROM = 50.0  # [Hz]
LOAD_MISMATCH = 0.3  # of the robot's mass
# Of the comparison of peak torques: levers b / r, lengths [m], how many headings, and instants along a motion.
PEAK_LEVERS, PEAK_LENGTHS, PEAK_HEADINGS, PEAK_INSTANTS = (0.25, 0.4, 0.6, 1.0), (0.1, 0.5, 2.0), 60, 400
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


def true_incompatibility(robot: RobotDescription, run: ClosedLoopRun) -> FloatArray:
    """Return the same of the wheels' true speeds (k, n, 2) [m/s]: (I - A A^+) eps, as (I - A A^+) A V = 0.

    The encoders' noise is as large as what the wheels of a gentle motion do, and no controller can take it away.
    """
    unit, jacobian_of = np.tile(np.eye(2), (robot.n, 1, 1)), (robot.steer_axis, robot.caster_offset)
    return np.array([
        internal_part(wheel_jacobian_kernel(*jacobian_of, np.ascontiguousarray(q[:, STEER])), unit, np.ascontiguousarray(eps))
        for q, eps in zip(run.joint_position, run.slip)
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
        "A quintic of 2 m straight ahead of the thesis robot from random headings of the wheels. Fig. 5.6 compares control by "
        "the augmented object model with and without IFM and does not say how the second shares the wrench; the text before "
        "it says how standard controllers do: they \"determine joint torques directly in terms of operational forces\". So "
        "*without* is `J`: the least sum of squared joint torques, tau = J (J^T J)^-1 F with J = B^-1 A of (3.25), the same "
        "that figs. 5.7 and 5.8 compare. `three forces` is a basic solution of (5.4), in which three of the eight forces "
        "carry everything: the other end of what (5.4) allows. Spread: RMS of what of the wheel speeds no motion of the "
        "robot explains, (I - A A^+) B q_dot, of the true speeds and of the measured ones; the encoders' noise alone is "
        "what a robot at rest shows, and stands in the last column. Thesis: 4.2 N m through J, 3.5 N m through A, a "
        "ratio of 0.83, on its robot from headings that it does not state; fig. 5.6 has no number. Bars: 0.5 for the spread, "
        "0.85 for the peak.", "",
    )
    robot = load_robot("thesis")
    reference, duration = straight(2.0, MotionLimits(0.8, 0.8))
    controllers: dict[str, Callable[[], Controller]] = {
        "A": lambda: ComputedTorque(robot), "J": lambda: JacobianPseudoInverse(robot),
        "three_forces": lambda: BasicSolution(robot),
    }
    rows = []
    for plant in PLANTS:
        found: dict[str, list[tuple[float, ...]]] = {label: [] for label in controllers}
        for seed in range(seeds):
            rng = np.random.default_rng([seed, 56])
            steer_angle = rng.uniform(-math.pi, math.pi, robot.n)
            curves, torques, time = {}, {}, np.zeros(0)
            for label, make in controllers.items():
                run = run_closed_loop(robot, make(), reference, duration + 0.2, plant, seed, steer_angle)
                uneven, still = true_incompatibility(robot, run), run.time > duration + 0.1
                seen = incompatibility(robot, run)
                found[label].append(
                    (rms(uneven), rms(seen), float(np.abs(run.torque).max()), rms(run.internal_force), rms(seen[still]))
                )
                curves[label], time = 1e3 * np.sqrt(np.mean(uneven[:, :, 0] ** 2, axis=1)), run.time
                torques[label] = np.abs(run.torque).max(axis=(1, 2))
            if seed == 0:
                document.figure(f"fig_5_6_{plant}", f"Fig. 5.6, {plant} plant", "spread of wheel speeds [mm/s]", time, curves)
                document.figure(
                    f"fig_5_7_{plant}", f"Figs. 5.7 (a), 5.8 (a), {plant} plant", "largest joint torque [N m]", time, torques
                )
        of_A = np.array(found["A"])
        for label in controllers:
            own = np.array(found[label])
            ratio, middle = of_A / np.maximum(own, 1e-12), np.median(own, axis=0)
            rows.append([
                plant, label.replace("_", " "), f"{1e3 * middle[0]:.2f} mm/s", f"{np.median(ratio[:, 0]):.2f}",
                f"{1e3 * middle[1]:.2f} mm/s", f"{np.median(ratio[:, 1]):.2f}", f"{middle[2]:.2f} N m",
                f"{np.median(ratio[:, 2]):.2f} ({ratio[:, 2].min():.2f} to {ratio[:, 2].max():.2f})", f"{middle[3]:.1f} N",
                f"{1e3 * middle[4]:.2f} mm/s",
            ])
    document.table(
        ["plant", "way", "true spread, median", "A over it", "measured spread, median", "A over it", "peak torque, median",
         "peak of A over it, median (least to greatest)", "internal force, RMS", "noise alone"], rows,
    )
    _peaks_by_heading(document, robot)
    _with_limits(document, robot, reference, duration)


def peak_torques(robot: RobotDescription, steer_angle: FloatArray, length: float, limits: MotionLimits) -> tuple[float, float]:
    """Return the largest joint torques through A and through J on a quintic straight ahead, rolling without slip [N m].

    Args:
        robot: the robot.
        steer_angle: headings at the start (n,) [rad]; they turn as the motion makes them.
        length: of the motion [m].
        limits: of the motion.
    """
    reference, duration = straight(length, limits)
    B, model, dt = joint_matrix_blocks(robot), AugmentedObjectModel(robot), duration / PEAK_INSTANTS
    B_inverse: FloatArray = np.linalg.inv(B).astype(np.float64)
    through_A = through_J = 0.0
    for k in range(PEAK_INSTANTS):
        at = reference(k * dt)
        A = wheel_jacobian_kernel(robot.steer_axis, robot.caster_offset, steer_angle)
        inertia, bias = model.evaluate(steer_angle, at.velocity)
        F = inertia @ at.acceleration + bias
        force_A, force_J = weighted_forces_kernel(A, F, np.ones(2 * robot.n)), jacobian_forces(A, F, B_inverse)
        through_A = max(through_A, float(np.abs(np.einsum("nji,nj->ni", B, force_A)).max()))
        through_J = max(through_J, float(np.abs(np.einsum("nji,nj->ni", B, force_J)).max()))
        middle = steer_angle + 0.5 * dt * inverse_kinematics(robot, steer_angle, at.velocity)[:, STEER]
        half = reference((k + 0.5) * dt).velocity
        steer_angle = steer_angle + dt * inverse_kinematics(robot, middle, half)[:, STEER]
    return through_A, through_J


def _peaks_by_heading(document: Document, robot: RobotDescription) -> None:
    """Say over many headings, lengths and levers how the peak torques through A and through J compare."""
    rows = []
    for lever in PEAK_LEVERS:
        offset = (-lever * float(robot.wheel_radius[0]), 0.0)
        made = dataclasses.replace(
            robot, casters=tuple(dataclasses.replace(caster, caster_offset=offset) for caster in robot.casters)
        )
        for length in PEAK_LENGTHS:
            rng, ratios = np.random.default_rng(57), []
            for _ in range(PEAK_HEADINGS):
                through_A, through_J = peak_torques(
                    made, rng.uniform(-math.pi, math.pi, made.n), length, MotionLimits(0.8, 0.8)
                )
                ratios.append(through_A / through_J)
            low, middle, high = np.percentile(ratios, [5, 50, 95])
            rows.append([
                f"{lever:g}", f"{length:g} m", f"{middle:.2f}", f"{low:.2f} to {high:.2f}", f"{min(ratios):.2f}",
                f"{np.mean(np.array(ratios) <= 0.85):.0%}",
            ])
    document.add(
        "### Peak torque by headings, length of the motion and lever", "",
        f"The thesis states neither its headings nor b / r nor the length of its motion, so: {PEAK_HEADINGS} random headings "
        "each, rolling without slip, straight ahead at up to 0.8 m/s^2. J minimises the sum of squared torques, so its peak "
        "is the higher one only where a wheel with a short lever stands across beside several along and gets more than its "
        "share: with n - 1 along it is A over J = ((n - 1) x^2 + 1) / (n x), x = b / r, which is 0.87 at the least for four "
        "wheels. On a long way the casters have turned in before the robot accelerates most, and both ask for the same.",
    )
    document.table(["b / r", "length", "A over J, median", "5 to 95 %", "least", "headings with at most 0.85"], rows)


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
        "are with the sensors of the robot files at their rates, torque limits included.", "",
    )
    figure_5_2(document)
    figure_5_3(document)
    figures_5_6_to_5_8(document, options.seeds)
    (options.out / "controllers.md").write_text("\n".join(document.lines).rstrip() + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
