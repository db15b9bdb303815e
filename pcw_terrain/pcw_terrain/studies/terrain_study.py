"""Terrain estimation on one wheel, measured: figures 5.19 and 5.20 [Li2009], accuracy, coverage, gate, changes, cost.

    python -m pcw_terrain.studies.terrain_study [--seeds 200] [--first-seed 0] [--out FOLDER]

writes terrain.md, fig_5_19 and fig_5_20 (.csv and .svg). Every figure in them comes out of this run; costs are of the machine
that it ran on. 200 seeds take a few minutes on one core.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pcw_description.robot_description import ContactDescription, FloatArray, LateralContact

from ..terrain_classes import classify, table
from ..terrain_estimator import (
    CHANGES,
    IS_VALID,
    LAMBDA_P,
    LAMBDA_VARIANCE,
    MU_P,
    MU_VARIANCE,
    TerrainEstimator,
    TerrainParameters,
    WheelReading,
)
from ..thesis_rls import ThesisRls, ThesisRlsParameters
from .one_wheel_ground import GroundRun, GroundWheel, run_wheel

RATE, DURATION = 1000.0, 12.0  # of the readings [Hz], of a run [s]
THESIS_MU, THESIS_LAMBDA = 0.8, 0.1  # of the figures
NORMAL = 1.96  # standard deviations of a 95 % interval
EVERY = 10  # readings between results that are looked at
DETECTED, SETTLED = 0.3, 0.8  # within which a change of ground should be [s]


def ground(mu_p: float, lambda_p: float, relaxation: float = 0.02) -> ContactDescription:
    """Return a Kiencke contact, the same in all directions."""
    lateral = LateralContact(mu_p=mu_p, lambda_p=lambda_p)
    return ContactDescription(model="kiencke", mu_p=mu_p, lambda_p=lambda_p, lateral=lateral, relaxation_length=relaxation)


def readings_of(wheel: GroundWheel, run: GroundRun) -> FloatArray:
    """Return what the estimators are given (T, 6)."""
    nothing = np.zeros(len(run.time))
    return np.column_stack(
        [
            run.measured_rolling_speed, run.measured_velocity, run.measured_torque / wheel.radius,
            np.full(len(run.time), wheel.normal_force), nothing, nothing,
        ]
    )  # fmt: skip


def estimator_of(wheel: GroundWheel) -> TerrainEstimator:
    """Return the estimator that knows the wheel and its tyre's relaxation, but not the ground."""
    assert wheel.contact is not None
    contact = ground(0.5, 0.15, wheel.contact.relaxation_length)
    return TerrainEstimator(TerrainParameters(contact=contact, inertia=wheel.inertia / wheel.radius**2))


def thesis_run(seed: int, mu_p: float | None = None, lambda_p: float | None = None) -> tuple[GroundWheel, GroundRun]:
    """Return a run with the thesis's settings: sinusoidal torque with high harmonics, velocities with +-10 % of noise.

    The thesis gives neither ground nor amplitude: both are drawn, the latter so that the slip passes its critical value.
    """
    rng = np.random.default_rng([seed, 519])
    mu, critical = mu_p or rng.uniform(0.2, 1.0), lambda_p or rng.uniform(0.06, 0.25)
    wheel = GroundWheel(contact=ground(mu, critical))
    frequency, velocity, part = rng.uniform(0.4, 1.0), rng.uniform(3.0, 6.0), rng.uniform(1.0, 1.15)
    moments = np.arange(round(DURATION * RATE)) / RATE
    peak = mu * wheel.normal_force * wheel.radius * (1.0 + wheel.inertia / (wheel.mass * wheel.radius**2))
    torque = part * peak * np.sin(math.tau * frequency * moments + rng.uniform(0.0, 1.0))
    return wheel, run_wheel(wheel, RATE, DURATION, velocity, rng, torque=torque)


def swept_run(seed: int, greatest: tuple[float, float], duration: float = DURATION) -> tuple[GroundWheel, GroundRun]:
    """Return a run whose slip ratio swings between zero and a part of the critical one."""
    rng = np.random.default_rng([seed, 520])
    mu, critical = rng.uniform(0.2, 1.0), rng.uniform(0.06, 0.25)
    wheel = GroundWheel(contact=ground(mu, critical))
    moments = np.arange(round(duration * RATE)) / RATE
    part = rng.uniform(*greatest) * critical
    slip = part * (0.5 - 0.5 * np.cos(math.tau * rng.uniform(0.4, 2.0) * moments))
    return wheel, run_wheel(wheel, RATE, duration, rng.uniform(0.3, 2.0), rng, slip=slip)


def pushed_run(seed: int) -> tuple[GroundWheel, GroundRun]:
    """Return a wheel that coasts, is driven or braked past its peak for 0.3 to 2 s, up to four times, and rests in between."""
    rng = np.random.default_rng([seed, 524])
    mu, critical = rng.uniform(0.15, 0.9), rng.uniform(0.03, 0.2)
    wheel = GroundWheel(contact=ground(mu, critical))
    peak = mu * wheel.normal_force * wheel.radius * (1.0 + wheel.inertia / (wheel.mass * wheel.radius**2))
    moments, torques, now = [0.0, 0.5], [0.0, 0.0], 0.5
    for push in range(int(rng.integers(1, 5))):
        most = (rng.choice([-1.0, 1.0]) if push else 1.0) * rng.uniform(0.9, 1.25) * peak
        lasts = rng.uniform(0.3, 2.0)
        grows = rng.uniform(0.05, 0.4) * lasts
        for duration, torque in ((grows, most), (lasts - 2.0 * grows, most), (grows, 0.0), (rng.uniform(0.3, 1.0), 0.0)):
            now += duration
            moments.append(now)
            torques.append(torque)
    time = np.arange(round(now * RATE)) / RATE
    return wheel, run_wheel(wheel, RATE, now, rng.uniform(0.3, 2.0), rng, torque=np.interp(time, moments, torques))


@dataclasses.dataclass(frozen=True)
class Accuracy:
    """What many runs say of an estimator.

    Attributes:
        reached: runs in which the slip reached lambda_p.
        valid: of these, those that end with a valid estimate.
        mu_error, lambda_error: median of the absolute relative errors of all of them, valid or not [1].
        mu_worst, lambda_worst: 95th percentile of the same.
        mu_bias, lambda_bias: median of the errors with their sign.
        mu_coverage, lambda_coverage: part of the valid ones in whose 95 % interval the truth lies; NaN where there is none.
    """

    reached: int
    valid: int
    mu_error: float
    lambda_error: float
    mu_worst: float
    lambda_worst: float
    mu_bias: float
    lambda_bias: float
    mu_coverage: float
    lambda_coverage: float


def _accuracy(errors: list[tuple[float, float]], spreads: list[tuple[float, float]], valid: list[bool]) -> Accuracy:
    error, spread, good = np.array(errors), np.array(spreads), np.array(valid)
    size = np.where(np.isfinite(error), np.abs(np.expm1(error)), np.inf)
    sign = np.where(np.isfinite(error), np.expm1(error), np.inf)
    within = np.abs(error) <= NORMAL * spread
    covered = within[good].mean(axis=0) if good.any() else np.full(2, np.nan)
    (mu, critical), (mu_worst, critical_worst) = np.median(size, axis=0), np.quantile(size, 0.95, axis=0, method="lower")
    mu_bias, critical_bias = np.median(sign, axis=0)
    return Accuracy(
        len(good),
        int(good.sum()),
        float(mu),
        float(critical),
        float(mu_worst),
        float(critical_worst),
        float(mu_bias),
        float(critical_bias),
        float(covered[0]),
        float(covered[1]),
    )


def accuracy(runs: Sequence[tuple[GroundWheel, GroundRun]], forgetting_factors: Sequence[float]) -> dict[str, Accuracy]:
    """Return how well the thesis's estimator and ours do at the end of the same runs; those that reach lambda_p count."""
    found: dict[str, tuple[list[tuple[float, float]], list[tuple[float, float]], list[bool]]] = {}
    for wheel, run in runs:
        contact = wheel.contact
        assert contact is not None
        if np.abs(run.slip_ratio).max() < contact.lambda_p:
            continue
        readings = readings_of(wheel, run)
        last = estimator_of(wheel).run(readings, 1.0 / RATE, EVERY)[-1]
        results = {
            "ours": (
                last[MU_P],
                last[LAMBDA_P],
                math.sqrt(last[MU_VARIANCE]),
                math.sqrt(last[LAMBDA_VARIANCE]),
                last[IS_VALID],
            )
        }
        for factor in forgetting_factors:
            printed = ThesisRls(ThesisRlsParameters(factor, inertia=wheel.inertia / wheel.radius**2))
            mu_p, lambda_p = printed.run(readings, 1.0 / RATE)
            # Of the last half second: with a short memory the last value alone is mere chance.
            mu_end, lambda_end = (np.median(np.nan_to_num(v[-500:], nan=np.inf)) for v in (mu_p, lambda_p))
            results[f"as printed, forgetting {factor:g}"] = (mu_end, lambda_end, np.nan, np.nan, 0.0)
        for name, (mu, critical, mu_spread, critical_spread, valid) in results.items():
            errors, spreads, valids = found.setdefault(name, ([], [], []))
            with np.errstate(divide="ignore", invalid="ignore"):
                errors.append((float(np.log(mu / contact.mu_p)), float(np.log(critical / contact.lambda_p))))
            spreads.append((float(mu_spread), float(critical_spread)))
            valids.append(bool(valid > 0.0))
    return {name: _accuracy(*lists) for name, lists in found.items()}


def held_run(seed: int, part: tuple[float, float], duration: float = DURATION) -> tuple[GroundWheel, GroundRun]:
    """Return a wheel whose slip grows within a second to a part of lambda_p, and is held there."""
    rng = np.random.default_rng([seed, 523])
    wheel = GroundWheel(contact=ground(rng.uniform(0.2, 1.0), rng.uniform(0.06, 0.25)))
    grown = np.clip(np.arange(round(duration * RATE)) / RATE - 0.5, 0.0, 1.0)
    assert wheel.contact is not None
    slip = rng.uniform(*part) * wheel.contact.lambda_p * grown**2 * (3.0 - 2.0 * grown)
    return wheel, run_wheel(wheel, RATE, duration, rng.uniform(0.3, 2.0), rng, slip=slip)


def gated(runs: Iterable[tuple[GroundWheel, GroundRun]]) -> int:
    """Return in how many runs any estimate was called valid."""
    called = 0
    for wheel, run in runs:
        called += bool(estimator_of(wheel).run(readings_of(wheel, run), 1.0 / RATE)[:, IS_VALID].any())
    return called


@dataclasses.dataclass(frozen=True)
class ChangeTimes:
    """How a change of ground is found: times of every change, inf where it was not.

    Attributes:
        detected: [s].
        within: from when on mu_p stays within 5 % [s].
        settled: from when on it does so and is called valid [s].
    """

    detected: FloatArray
    within: FloatArray
    settled: FloatArray


def _for_good(holds: NDArray[np.bool_]) -> float:
    """Return the time [s] from which on it holds up to the end (T,)."""
    failed = np.nonzero(~holds)[0]
    last = int(failed[-1]) + 1 if len(failed) else 0
    return last / RATE if last < len(holds) else math.inf


def change_times(seeds: range, low: float = 0.2, high: float = 0.8) -> ChangeTimes:
    """Change mu_p from high to low and back, while the slip swings about lambda_p by up to a half of it."""
    detected, within, settled = [], [], []
    for seed in seeds:
        rng = np.random.default_rng([seed, 521])
        critical = rng.uniform(0.06, 0.25)
        wheel = GroundWheel(contact=ground(high, critical))
        duration, first, second = 9.0, 3.0 + rng.uniform(), 6.0 + rng.uniform()
        moments = np.arange(round(duration * RATE)) / RATE
        on_low = (moments >= first) & (moments < second)
        slip = critical * (1.0 + 0.5 * np.sin(math.tau * rng.uniform(1.0, 3.0) * moments + rng.uniform(0.0, math.tau)))
        other = critical * rng.uniform(0.8, 1.25)
        run = run_wheel(
            wheel, RATE, duration, rng.uniform(0.5, 2.0), rng, slip=slip, mu_p=np.where(on_low, low, high),
            lambda_p=np.where(on_low, other, critical),
        )  # fmt: skip
        found = estimator_of(wheel).run(readings_of(wheel, run), 1.0 / RATE)
        for begin, end, mu in ((first, second, low), (second, duration, high)):
            part = (moments >= begin) & (moments < end)
            changed = np.nonzero(found[part, CHANGES] > found[np.nonzero(part)[0][0] - 1, CHANGES])[0]
            detected.append(moments[part][changed[0]] - begin if len(changed) else np.inf)
            near = np.abs(found[part, MU_P] / mu - 1.0) <= 0.05
            within.append(_for_good(near))
            settled.append(_for_good(near & (found[part, IS_VALID] > 0.0)))
    return ChangeTimes(np.array(detected), np.array(within), np.array(settled))


def false_changes(seeds: range, duration: float) -> tuple[int, float]:
    """Return how many changes were found on steady ground, half of it driven by torque, and in how much time [s]."""
    changes = 0
    for seed in seeds:
        wheel, run = swept_run(seed, (1.0, 2.0), duration) if seed % 2 else _long_thesis_run(seed, duration)
        changes += int(estimator_of(wheel).run(readings_of(wheel, run), 1.0 / RATE, EVERY)[-1, CHANGES])
    return changes, duration * len(seeds)


def _long_thesis_run(seed: int, duration: float) -> tuple[GroundWheel, GroundRun]:
    rng = np.random.default_rng([seed, 522])
    wheel = GroundWheel(contact=ground(rng.uniform(0.2, 1.0), rng.uniform(0.06, 0.25)))
    assert wheel.contact is not None
    moments = np.arange(round(duration * RATE)) / RATE
    peak = wheel.contact.mu_p * wheel.normal_force * wheel.radius * (1.0 + wheel.inertia / (wheel.mass * wheel.radius**2))
    torque = rng.uniform(0.9, 1.05) * peak * np.sin(math.tau * rng.uniform(0.4, 1.0) * moments)
    return wheel, run_wheel(wheel, RATE, duration, rng.uniform(4.0, 6.0), rng, torque=torque)


def cost_per_step() -> tuple[float, float]:
    """Return microseconds per step of one wheel: called from Python, and in compiled code; the median of many."""
    wheel, run = swept_run(0, (1.5, 1.5), 4.0)
    estimator, readings = estimator_of(wheel), readings_of(wheel, run)
    state, spent = estimator.initial_state(), []
    for row in readings:
        reading = WheelReading(*(float(value) for value in row))
        started = time.perf_counter()
        state, _ = estimator.step(state, reading, 1.0 / RATE)
        spent.append(time.perf_counter() - started)
    started = time.perf_counter()
    estimator.run(readings, 1.0 / RATE, EVERY)
    return float(np.median(spent)) * 1e6, (time.perf_counter() - started) / len(readings) * 1e6


def figures(out: Path) -> list[str]:
    """Write figures 5.19 and 5.20, data and plot; returns the lines of the document about them."""
    import matplotlib  # heavy, and only this needs it
    from matplotlib.figure import Figure

    wheel, run = thesis_run(0, THESIS_MU, THESIS_LAMBDA)
    readings = readings_of(wheel, run)
    inertia = wheel.inertia / wheel.radius**2
    printed = {
        factor: ThesisRls(ThesisRlsParameters(factor, inertia=inertia)).run(readings, 1.0 / RATE) for factor in (0.8, 0.999)
    }
    found = estimator_of(wheel).run(readings, 1.0 / RATE)
    lines = []
    for name, index, column, truth, label in (
        ("fig_5_19", 1, LAMBDA_P, THESIS_LAMBDA, "critical slip ratio lambda_p"),
        ("fig_5_20", 0, MU_P, THESIS_MU, "peak friction coefficient mu_p"),
    ):
        variance = found[:, LAMBDA_VARIANCE if column == LAMBDA_P else MU_VARIANCE]
        known = found[:, IS_VALID] > 0.0
        ours = np.where(known, found[:, column], np.nan)
        low, high = (np.where(known, found[:, column] * np.exp(sign * NORMAL * np.sqrt(variance)), np.nan) for sign in (-1, 1))
        columns = {
            "time_s": run.time, "truth": np.full(len(run.time), truth), "printed_0.8": printed[0.8][index],
            "printed_0.999": printed[0.999][index], "ours": ours, "ours_low": low, "ours_high": high,
        }  # fmt: skip
        chosen = slice(None, None, 20)
        np.savetxt(
            out / f"{name}.csv", np.column_stack([v[chosen] for v in columns.values()]), fmt="%.5g", delimiter=",",
            header=",".join(columns), comments="",
        )  # fmt: skip
        with matplotlib.rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
            figure = Figure(figsize=(7.0, 3.4), layout="constrained")
            axes = figure.add_subplot()
            at = run.time[chosen]
            axes.plot(at, printed[0.8][index][chosen], color="tab:red", lw=0.6, label="as printed, 0.8")
            axes.plot(at, printed[0.999][index][chosen], color="tab:orange", label="as printed, 0.999")
            axes.fill_between(at, low[chosen], high[chosen], color="tab:blue", alpha=0.3, lw=0.0)
            axes.plot(at, ours[chosen], color="tab:blue", label="ours, 95 %")
            axes.axhline(truth, color="black", ls="--", lw=0.8, label="truth")
            axes.set(xlabel="time [s]", ylabel=label, ylim=(0.0, 2.5 * truth), title=f"Fig. {name[4:].replace('_', '.')}")
            axes.legend(loc="upper right", fontsize=8)
            figure.savefig(out / f"{name}.svg", metadata={"Date": None})
        end = {factor: _middle(printed[factor][index][-2000:]) for factor in printed}
        lines.append(
            f"![Fig. {name[4:].replace('_', '.')}]({name}.svg) Fig. {name[4:].replace('_', '.')}, {label} "
            f"([data]({name}.csv)): "
            f"truth {truth:g}; as printed {end[0.8]} with forgetting 0.8 and {end[0.999]} with 0.999 (medians of the last "
            f"two seconds); ours {ours[-1]:.4g}, 95 % within {low[-1]:.4g} to {high[-1]:.4g}.\n"
        )
    return lines


def _middle(values: FloatArray) -> str:
    known = values[np.isfinite(values)]
    return f"{float(np.median(known)):.3g}" if len(known) else "no number"


def _row(name: str, a: Accuracy) -> str:
    def percent(value: float) -> str:
        return f"{value:.1%}" if math.isfinite(value) else "no number"

    coverage = "-" if math.isnan(a.mu_coverage) else f"{a.mu_coverage:.0%} | {a.lambda_coverage:.0%}"
    return (
        f"| {name} | {a.reached} | {a.valid if coverage != '-' else '-'} | {percent(a.mu_error)} | "
        f"{percent(a.lambda_error)} | "
        f"{percent(a.mu_worst)} | {percent(a.lambda_worst)} | {percent(a.mu_bias)} | {percent(a.lambda_bias)} | "
        f"{coverage if coverage != '-' else '- | -'} |"
    )


ACCURACY_HEAD = (
    "| estimator | runs | valid | median error mu_p | lambda_p | 95th percentile mu_p | lambda_p | bias "
    "mu_p | lambda_p | 95 % "
    "intervals hold mu_p | lambda_p |\n|---|---|---|---|---|---|---|---|---|---|---|"
)


def _times(name: str, values: FloatArray, bar: float) -> str:
    quantiles = np.quantile(values, [0.5, 0.9, 0.95, 1.0], method="higher")
    return (
        f"| {name} | "
        + " | ".join(f"{value:.2f} s" if math.isfinite(value) else "never" for value in quantiles)
        + f" | {int(np.isinf(values).sum())} | {bar:g} s: {int((values > bar).sum())} of {len(values)} |"
    )


def document(seeds: range, out: Path) -> str:
    """Return the text of terrain.md."""
    factors = (0.8, 0.999)
    thesis = accuracy([thesis_run(seed) for seed in seeds], factors)
    swept = accuracy([swept_run(seed, (1.0, 2.0)) for seed in seeds], factors)
    pushed = accuracy([pushed_run(seed) for seed in seeds], ())
    below, held = (gated(make(seed, (0.2, 0.5)) for seed in seeds) for make in (swept_run, held_run))
    changes = change_times(seeds)
    wrong, steady = false_changes(range(seeds.start, seeds.start + max(len(seeds) // 10, 2)), 600.0)
    called, compiled_cost = cost_per_step()
    examples = []
    for mu, critical in ((1.15, 0.17), (0.8, 0.13), (0.05, 0.031), (0.75, 0.1), (0.35, 0.5)):
        found = classify(mu, critical, np.diag([0.03**2, 0.08**2]))
        best = found[:2]
        examples.append(f"| {mu:g} | {critical:g} | " + " | ".join(f"{c.name} {c.probability:.0%}" for c in best) + " |")
    parts = [
        "# Terrain while driving, on one wheel",
        "",
        f"Written by `python -m pcw_terrain.studies.terrain_study --seeds {len(seeds)} --first-seed {seeds.start}`; "
        "nothing here is typed in.",
        "",
        f"Readings at {RATE:g} Hz; the measured rolling speed and velocity each have a uniform error of +-10 "
        "%, fresh in every "
        "reading, and the torque three harmonics above 100 Hz of 2 % of its amplitude. Ours knows the wheel and its tyre's "
        "relaxation length; nothing of mu_p and lambda_p.",
        "",
        "## Figures 5.19 and 5.20",
        "",
        *figures(out),
        "The thesis gives no number for the ground or the torque; mu_p = 0.8 and lambda_p = 0.1 are those of "
        "our thesis robot.",
        "",
        "## Accuracy, on the same data",
        "",
        f"Runs of {DURATION:g} s, another ground each (mu_p 0.2 to 1, lambda_p 0.06 to 0.25); those in which the slip reaches "
        "lambda_p. Errors are those at the end of a run, whether it was called valid or not.",
        "",
        "Driven by a sinusoidal torque, as in the thesis:",
        "",
        ACCURACY_HEAD,
        *(_row(name, a) for name, a in thesis.items()),
        "",
        "Slip swung between 0 and one to two times lambda_p, at 0.3 to 2 m/s:",
        "",
        ACCURACY_HEAD,
        *(_row(name, a) for name, a in swept.items()),
        "",
        "Pushed past the peak by torque for 0.3 to 2 s, up to four times, and coasting in between (mu_p 0.15 to 0.9, lambda_p "
        "0.03 to 0.2); of so few readings near the peak less is known:",
        "",
        ACCURACY_HEAD,
        *(_row(name, a) for name, a in pushed.items()),
        "",
        "## Not enough slip to know",
        "",
        f"An estimate was called valid at any time in {below} of {len(seeds)} runs whose slip swung between 0 and 0.2 to 0.5 "
        f"of lambda_p, and in {held} of {len(seeds)} whose slip was held there.",
        "",
        "## Change of ground",
        "",
        "mu_p from 0.8 to 0.2 and back, lambda_p by up to a quarter as well, while the slip swings about "
        "lambda_p by a half of "
        "it, 1 to 3 times a second.",
        "",
        "| | median | 90th percentile | 95th | worst | never | later than |",
        "|---|---|---|---|---|---|---|",
        _times("detected", changes.detected, DETECTED),
        _times("mu_p within 5 %, for good", changes.within, SETTLED),
        _times("the same, and valid", changes.settled, SETTLED),
        "",
        "Called valid late are those whose slip stays small, or small against its noise, just after the change: the number "
        "may be right, but is not yet vouched for.",
        "",
        f"On steady ground, {steady / 60.0:.0f} minutes in runs of ten: {wrong} false changes.",
        "",
        "## Cost",
        "",
        f"One step of one wheel: {called:.1f} us called from Python, {compiled_cost:.2f} us along a record in compiled code.",
        "",
        "## Classes",
        "",
        table(),
        "",
        "What estimates with 3 % (mu_p) and 8 % (lambda_p) of standard deviation are called:",
        "",
        "| mu_p | lambda_p | most probable | next |",
        "|---|---|---|---|",
        *examples,
        "",
    ]
    return "\n".join(parts)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study and write what it finds."""
    parser = argparse.ArgumentParser(prog="terrain_study", description="Measure the terrain estimators on one wheel.")
    parser.add_argument("--seeds", type=int, default=200, help="runs of every case (default: %(default)s)")
    parser.add_argument("--first-seed", type=int, default=0, help="(default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("pcw_terrain/docs"), help="folder (default: %(default)s)")
    options = parser.parse_args(arguments)
    if options.seeds < 1:
        parser.error(f"argument --seeds: {options.seeds} is not allowed; allowed: at least 1")
    options.out.mkdir(parents=True, exist_ok=True)
    text = document(range(options.first_seed, options.first_seed + options.seeds), options.out)
    (options.out / "terrain.md").write_text(text, encoding="utf-8")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
