"""The slip observers on one wheel, measured: figures 4.3 and 4.4 [Li2009] and how the observers compare.

    python -m pcw_estimation.studies.observer_study [--seeds 200] [--out FOLDER]

writes slip_observers.md, fig_4_3 and fig_4_4 (.csv and .svg). Every figure in them comes out of this run; costs are of the
machine that it ran on.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_description.robot_description import FloatArray
from pcw_description.robot_file import load_robot

from ..motor_current_slip import WheelCurrentDetector
from ..sliding_mode_observer import SlidingModeObserver, SlidingModeParameters
from ..slip_estimate import WheelMeasurement, WheelModel
from ..slip_kalman_filter import WheelKalmanFilter
from .one_wheel import WheelRun, WheelSensors, run_wheel
from .wheel_trials import Beliefs, Maker, Summary, run_trial, summarise_trials

ROBOT = "thesis"
# Another encoder on the motor: no gear, and its differences as speeds.
COARSE = WheelSensors(counts=4096.0, rate_noise=None)
TABLE_HEAD = (
    "| {} | settling to 5 %: median | p95 | RMS of v in grip | in spin | worst run: grip | spin | wrong root | diverged |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


class EncoderAlone:
    """What an encoder says of the velocity of one wheel: v = r rho_dot."""

    def __init__(self, wheel: WheelModel) -> None:
        self._radius = wheel.radius

    def run(
        self, roll_angle: FloatArray, roll_rate: FloatArray, drive_torque: FloatArray, dt: float, velocity: float = 0.0
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Take a whole record (T,); forces and bounds are unknown."""
        unknown = np.full(len(roll_rate), np.inf)
        return self._radius * roll_rate, unknown, unknown


def by_speed(wheel: WheelModel) -> SlidingModeObserver:
    """Return the observer that measures the speed."""
    return SlidingModeObserver(wheel, SlidingModeParameters(measured="speed"))


def by_angle(wheel: WheelModel) -> SlidingModeObserver:
    """Return the observer that measures the angle."""
    return SlidingModeObserver(wheel, SlidingModeParameters(measured="angle"))


VERSIONS: dict[str, Maker] = {"speed": by_speed, "angle": by_angle}
# Name, observer, its guess of the velocity at the start [m/s] (None: its own, which is r rho_dot).
COMPARED: tuple[tuple[str, Maker, float | None], ...] = (
    ("sliding mode, speed", by_speed, 0.0),
    ("sliding mode, angle", by_angle, 0.0),
    ("Kalman filter, begun at 0", WheelKalmanFilter, 0.0),
    ("Kalman filter, begun at r rho_dot", WheelKalmanFilter, None),
    ("encoder, r rho_dot", EncoderAlone, None),
    ("motor current", WheelCurrentDetector, None),
)


def row(name: str, s: Summary) -> str:
    """Return one line of a table."""
    return (
        f"| {name} | {s.settling_median * 1e3:.0f} ms | {s.settling_p95 * 1e3:.0f} ms | {s.grip_rms:.2%} | {s.spin_rms:.2%} | "
        f"{s.worst_grip:.1%} | {s.worst_spin:.1%} | {s.wrong_roots} of {s.trials} | {s.diverged} |"
    )


def cost_per_step(maker: Maker, wheel: WheelModel) -> tuple[float, float]:
    """Return microseconds per step: called from Python, and along a record in compiled code (best of five)."""
    run, believed = run_trial(wheel, 0, Beliefs(), WheelSensors())
    observer = maker(believed)
    measurements = [WheelMeasurement(*reading) for reading in zip(run.angle, run.rate, run.torque, strict=True)]

    def stepped() -> None:
        state = observer.initial_state()
        for measurement in measurements:
            state, _ = observer.step(state, measurement, 1e-3)

    called = [stepped] if hasattr(observer, "step") else []
    called.append(lambda: observer.run(run.angle, run.rate, run.torque, 1e-3))
    best = [_best_time(function) / len(measurements) * 1e6 for function in called]
    return (best[0] if len(best) == 2 else float("nan")), best[-1]


def _best_time(function: Callable[[], Any]) -> float:
    times = []
    for _ in range(6):  # the first one compiles
        started = time.perf_counter()
        function()
        times.append(time.perf_counter() - started)
    return min(times[1:])


def figure_run(wheel: WheelModel) -> WheelRun:
    """Return the run of figures 4.3 and 4.4: a wheel under way, driven to and fro, with an observer begun at zero."""
    sensors = WheelSensors()
    moments = np.arange(round(1.0 * sensors.rate)) / sensors.rate
    peak = wheel.contact.mu_p * wheel.normal_force * wheel.radius
    return run_wheel(wheel, 0.5 * peak * np.cos(2.0 * np.pi * moments), 1.0, 0.01, sensors, np.random.default_rng(0))


def write_figure(out: Path, name: str, title: str, run: WheelRun, estimates: dict[str, FloatArray]) -> None:
    """Write the data as CSV and the plot as SVG."""
    columns = {"time_s": run.time, "v": run.velocity, "r_rho_dot": run.rolling_speed, **estimates}
    np.savetxt(
        out / f"{name}.csv", np.column_stack(list(columns.values())), fmt="%.5f", delimiter=",", header=",".join(columns),
        comments="",
    )  # fmt: skip
    import matplotlib  # heavy, and only this needs it
    from matplotlib.figure import Figure

    with matplotlib.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        figure = Figure(figsize=(7.0, 3.4), layout="constrained")
        axes = figure.add_subplot()
        axes.plot(run.time, run.velocity, color="black", label="actual")
        for label, velocity in estimates.items():
            axes.plot(run.time, velocity, linestyle="--", label=label.replace("_", " "))
        axes.set(xlabel="time [s]", ylabel="v_x [m/s]", title=title)
        axes.legend()
        figure.savefig(out / f"{name}.svg", metadata={"Date": None})


def figures(wheel: WheelModel, out: Path) -> list[str]:
    """Write figures 4.3 and 4.4; returns the lines of the document about them."""
    run = figure_run(wheel)
    lines = []
    for name, version, thesis in (("fig_4_3", "speed", 0.12), ("fig_4_4", "angle", 0.15)):
        believed = Beliefs().about(wheel, np.random.default_rng(1))
        exact, _, _ = VERSIONS[version](wheel).run(run.angle, run.rate, run.torque, 1e-3)
        wrong, _, _ = VERSIONS[version](believed).run(run.angle, run.rate, run.torque, 1e-3)
        write_figure(
            out, name, f"Fig. {name[4:].replace('_', '.')}: joint {version} measured", run,
            {"estimated": exact, "estimated_numbers_off": wrong},
        )  # fmt: skip
        settled = [
            run.time[np.nonzero(np.abs(found - run.velocity) > 0.05 * np.abs(run.velocity))[0][-1]] + 1e-3
            for found in (exact, wrong)
        ]
        lines.append(
            f"![Fig. {name[4:].replace('_', '.')}]({name}.svg) Fig. {name[4:].replace('_', '.')}, joint {version} measured "
            f"([data]({name}.csv)): settles to 5 % in {settled[0] * 1e3:.0f} ms, in {settled[1] * 1e3:.0f} ms with M, I, mu_p "
            f"and lambda_p off by up to 10 % and r by up to 1 %. The thesis reads about {thesis * 1e3:.0f} ms.\n"
        )
    return lines


def robustness(wheel: WheelModel, seeds: range) -> list[str]:
    """Return the table of the two versions under wrong numbers, other sensors and other wheels."""
    plain = dataclasses.replace(wheel, contact=dataclasses.replace(wheel.contact, relaxation_length=0.002))
    cases: list[tuple[str, WheelModel, dict[str, Any]]] = [
        ("+-10 %, r within 1 %", wheel, {}),
        ("+-10 %, r off by 1 % exactly", wheel, {"beliefs": Beliefs(radius_sign=True)}),
        ("+-20 %, r within 1 %", wheel, {"beliefs": Beliefs(error=0.2)}),
        ("+-10 %, tyre without relaxation (2 mm)", plain, {}),
        ("+-10 %, readings at 500 Hz", wheel, {"sensors": WheelSensors(rate=500.0)}),
        ("+-10 %, readings at 200 Hz", wheel, {"sensors": WheelSensors(rate=200.0)}),
        ("+-10 %, 4096 counts without gear, speed by difference", wheel, {"sensors": COARSE}),
        ("+-10 %, another wheel and ground in every run", wheel, {"other_wheels": True}),
    ]
    lines = [TABLE_HEAD.format("case, version")]
    for name, real, options in cases:
        for version, maker in VERSIONS.items():
            lines.append(row(f"{name}; {version}", summarise_trials(maker, real, seeds, **options)))
    return lines


def comparison(wheel: WheelModel, seeds: range) -> list[str]:
    """Return the table of all methods on the same runs."""
    head = TABLE_HEAD.format("method").split("\n")
    lines = [head[0] + " cost per step | in compiled code |", head[1] + "---|---|"]
    for name, maker, velocity in COMPARED:
        summary = summarise_trials(maker, wheel, seeds, velocity=velocity)
        stepped, compiled = cost_per_step(maker, wheel)
        step = "-" if np.isnan(stepped) else f"{stepped:.1f} us"
        lines.append(row(name, summary) + f" {step} | {compiled:.2f} us |")
    return lines


def document(wheel: WheelModel, seeds: range, out: Path) -> str:
    """Return the text of slip_observers.md."""
    parts = [
        "# Slip observers on one wheel",
        "",
        f"Written by `python -m pcw_estimation.studies.observer_study --seeds {len(seeds)}`; nothing here is typed in.",
        "",
        f"The wheel is one of the `{ROBOT}` robot with a quarter of its mass: M = {wheel.mass:.2f} kg, I = {wheel.inertia:.4f}"
        f" kg m^2, r = {wheel.radius:g} m, mu_p = {wheel.contact.mu_p:g}, lambda_p = {wheel.contact.lambda_p:g}, relaxation "
        f"length {wheel.contact.relaxation_length:g} m. Encoder: 4096 counts on the motor behind a gear of 20; speeds with "
        "0.005 rad/s, torques with 0.02 N m of noise; 1000 readings a second unless stated.",
        "",
        "## Figures 4.3 and 4.4",
        "",
        *figures(wheel, out),
        "## Robustness",
        "",
        "Every run has a wheel under way at 0.4 to 1.5 m/s that drives, is given 1.1 to 1.4 times what the ground holds for "
        "0.1 to 0.3 s, drives or coasts, and brakes. The observer begins at v = 0 and believes in numbers that are off: M, I, "
        "mu_p and lambda_p by up to what is stated, r too. Errors are relative to the speed, RMS over all runs together; spin "
        "is where the slip ratio is above lambda_p.",
        "",
        *robustness(wheel, seeds),
        "",
        "An error of r cannot be seen: with r, v, 1/F and M/r^2 scaled together all measurements stay the same. An observer "
        "whose r is off by 1 % is off by 1 % in grip, whatever it does; the rest of that row is its own.",
        "",
        "## Side by side",
        "",
        "The same runs for all, +-10 % and r within 1 %.",
        "",
        *comparison(wheel, seeds),
        "",
        "The Kalman filter begun at 0 starts on the upper root and does not leave it. Begun at r rho_dot it starts with the "
        "answer, as do encoder and motor current: their settling is none. A cost per step is that of a call from Python.",
        "",
    ]
    return "\n".join(parts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and write what it finds."""
    parser = argparse.ArgumentParser(prog="observer_study", description="Measure the slip observers on one wheel.")
    parser.add_argument("--seeds", type=int, default=200, help="runs of every case (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("pcw_estimation/docs"), help="folder (default: %(default)s)")
    options = parser.parse_args(arguments)
    if options.seeds < 1:
        parser.error(f"argument --seeds: {options.seeds} is not allowed; allowed: at least 1")
    options.out.mkdir(parents=True, exist_ok=True)
    text = document(WheelModel.of_robot(load_robot(ROBOT), 0), range(options.seeds), options.out)
    (options.out / "slip_observers.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
