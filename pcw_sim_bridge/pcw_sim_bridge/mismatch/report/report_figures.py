"""Figures of the report: measured, nominal and patched over time, and what is left over.

A curve of any length is drawn as the envelope of its minima and maxima, so that a spike of one sample is seen and drawing
stays fast.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..findings.findings import Findings, LocationFinding, Trace
from ..regression.regression_problem import BoolArray, FloatArray
from .report_drawing import (
    AFTER,
    BEFORE,
    LABELS,
    MEASURED,
    SHADE,
    Drawing,
    Task,
    dress,
    finish,
    legend,
    new_figure,
)

MOST_TRACES = 3  # each is three figures, and reading them takes longer than drawing them
WINDOW = 5.0  # [s] of the close-up
ENVELOPE_BINS = 700  # about one per pixel column
SCATTER_POINTS = 1200
CURVE_BINS = 24
NEARLY_ALL = 0.9
LONGEST_PAUSE = 0.05  # of the time shown; a longer pause between pieces is cut short
EPOCH = 1e6  # [s]; stamps beyond are of a calendar, and shown from the first one


@dataclasses.dataclass(frozen=True)
class TraceFigures:
    """The figures of one trace, and the rms of its residual before and after."""

    channel: str
    unit: str
    role: str
    rms_before: float
    rms_after: float
    duration: float
    shaded: bool
    over_time: Drawing
    window: Drawing | None
    against_variable: Drawing


@dataclasses.dataclass(frozen=True)
class Timeline:
    """Sample times as drawn: pieces one after the other, long pauses and backward jumps cut to a short gap.

    Attributes:
        shown: (T,) [s].
        starts: first sample of every piece.
        cut: whether a pause was cut, so that `shown` is not the recording's clock.
    """

    shown: FloatArray
    starts: tuple[int, ...]
    cut: bool

    @property
    def pieces(self) -> list[slice]:
        """The contiguous pieces."""
        return [slice(a, b) for a, b in zip(self.starts, [*self.starts[1:], len(self.shown)])]


def time_origin(findings: Findings) -> float:
    """Return what is subtracted from stamps before they are shown: zero, or the first one where they are a calendar's."""
    firsts = [float(np.nanmin(trace.time)) for trace in findings.traces if np.isfinite(trace.time).any()]
    firsts += [interval[0] for place in findings.locations for interval in place.intervals]
    earliest = min(firsts, default=0.0)
    return earliest if abs(earliest) > EPOCH else 0.0


def trace_drawings(findings: Findings) -> list[Task]:
    """Return what draws the traces of the channels in which nominal and patched model differ most, a task for each."""
    origin = time_origin(findings)
    tasks: list[Task] = []
    for number, trace in enumerate(telling(findings.traces), start=1):
        places = [p for p in findings.locations if trace.channel in p.channels] if trace.role == "fit" else []
        stem = f"{number:02d}_{file_stem(trace.channel)}_{file_stem(trace.role)}"
        tasks.append((draw_trace, (trace, stem, origin, places)))
    return tasks


def telling(traces: Sequence[Trace]) -> list[Trace]:
    """At most about `MOST_TRACES` traces, both roles of a channel together, first the channels that a patch helps most."""

    def gain(trace: Trace) -> float:
        before, after = (root_mean_square(trace.measured - side) for side in (trace.before, trace.after))
        return before / after if after > 0.0 else 0.0

    channels: dict[str, list[Trace]] = {}
    for trace in traces:
        channels.setdefault(trace.channel, []).append(trace)
    best = sorted(channels.values(), key=lambda own: -np.nan_to_num(max(map(gain, own))))
    chosen: list[Trace] = []
    for own in best:
        if chosen and len(chosen) + len(own) > MOST_TRACES:
            break
        chosen += own
    return chosen


def draw_trace(trace: Trace, stem: str, origin: float, places: Sequence[LocationFinding] = ()) -> TraceFigures:
    """Draw one trace.

    Args:
        trace: the channel over time.
        stem: what the names of the figures begin with.
        origin: subtracted from the stamps [s].
        places: locations whose intervals are shaded.
    """
    time = np.asarray(trace.time, dtype=float) - origin
    line = timeline(time)
    curves = {
        "measured": np.asarray(trace.measured, dtype=float),
        "before": np.asarray(trace.before, dtype=float),
        "after": np.asarray(trace.after, dtype=float),
    }
    residuals = {name: curves["measured"] - curves[name] for name in ("before", "after")}
    rms = {name: root_mean_square(residual) for name, residual in residuals.items()}
    intervals = [interval for place in places for interval in place.intervals]
    within = np.zeros(len(time), dtype=bool)
    for start, end in intervals:
        within |= (time >= start - origin) & (time <= end - origin)
    if np.count_nonzero(within) > NEARLY_ALL * len(within):
        within[:] = False  # a shade over everything tells nothing
    window = worst_window(line.shown, residuals["before"])
    subject = f"{trace.channel} ({'held out' if trace.role == 'holdout' else 'fitted'})"
    return TraceFigures(
        channel=trace.channel,
        unit=trace.unit,
        role=trace.role,
        rms_before=rms["before"],
        rms_after=rms["after"],
        duration=float(line.shown[-1] - line.shown[0]) if len(time) else 0.0,
        shaded=bool(within.any()),
        over_time=_over_time(
            trace, f"{stem}_time", line, curves, residuals, within, window,
            f"{subject} over time: measured, nominal and patched model, and below the residuals; rms residual "
            f"{rms['before']:.3g} {trace.unit} nominal, {rms['after']:.3g} {trace.unit} patched.",
        ),
        window=None if window is None else _close_up(
            trace, f"{stem}_window", line, curves, window,
            f"{subject}: the {WINDOW:g} s in which the nominal model is furthest off.",
        ),
        against_variable=_against_variable(
            trace, f"{stem}_residual", residuals,
            f"Residual of {subject} against {trace.variable_name}: bin means and the middle 80 %, nominal and patched.",
        ),
    )


# -- what is drawn ------------------------------------------------------------------------------------------------


def timeline(time: FloatArray) -> Timeline:
    """Lay the pieces of `time` (T,) end to end: a new piece starts where stamps jump back or pause."""
    if len(time) < 2:
        return Timeline(time.copy(), (0,) if len(time) else (), False)
    steps = np.diff(time)
    forward = steps[steps > 0.0]
    usual = float(np.median(forward)) if len(forward) else 1.0
    breaks = np.flatnonzero(~((steps > 0.0) & (steps <= 10.0 * usual)))
    active = float(np.sum(np.delete(steps, breaks)))
    short = max(0.02 * active, usual)
    too_long = breaks[~((steps[breaks] > 0.0) & (steps[breaks] <= LONGEST_PAUSE * active))]
    steps[too_long] = short
    shown = time[0] + np.concatenate([[0.0], np.cumsum(steps)])
    return Timeline(shown, (0, *(int(k) + 1 for k in breaks)), len(too_long) > 0)


def envelope(line: Timeline, values: FloatArray, bins: int = ENVELOPE_BINS) -> tuple[FloatArray, FloatArray]:
    """Return a curve (x, y) of at most about 2 `bins` points with the extremes of `values` (T,); NaN between pieces."""
    total = max(len(values), 1)
    xs: list[FloatArray] = []
    ys: list[FloatArray] = []
    for piece in line.pieces:
        x, y = line.shown[piece], values[piece]
        count = max(2, bins * len(y) // total)
        if len(y) > 2 * count:
            edges = np.linspace(0, len(y), count + 1).astype(int)[:-1]
            # fmin and fmax pass over NaN unless there is nothing else.
            y = np.stack([np.fmin.reduceat(y, edges), np.fmax.reduceat(y, edges)], axis=1).ravel()
            x = np.repeat(x[edges], 2)
        xs += [x, x[-1:]]
        ys += [y, np.array([np.nan])]
    return (np.concatenate(xs), np.concatenate(ys)) if xs else (np.empty(0), np.empty(0))


def worst_window(shown: FloatArray, residual: FloatArray, length: float = WINDOW) -> tuple[float, float] | None:
    """Return the interval of `length` with the largest sum of squares; None where there is not much more than that."""
    if len(shown) < 2 or shown[-1] - shown[0] < 1.5 * length:
        return None
    power = np.concatenate([[0.0], np.cumsum(np.nan_to_num(residual, nan=0.0, posinf=0.0, neginf=0.0) ** 2)])
    ends = np.searchsorted(shown, shown + length, side="right")
    fits = shown + length <= shown[-1]
    start = int(np.argmax(np.where(fits, power[ends] - power[:-1], -np.inf)))
    return float(shown[start]), float(shown[start]) + length


def root_mean_square(values: FloatArray) -> float:
    """Return the root mean square of the finite values; NaN where there is none."""
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def binned(variable: FloatArray, residual: FloatArray, bins: int = CURVE_BINS) -> FloatArray:
    """Return rows (centre, mean, 10 %, 90 %) of the residual in equal bins of the variable that hold enough samples."""
    good = np.isfinite(variable) & np.isfinite(residual)
    variable, residual = variable[good], residual[good]
    if len(variable) == 0:
        return np.empty((0, 4))
    low, high = np.percentile(variable, [0.25, 99.75])
    if not high > low:
        return np.array([[low, np.mean(residual), *np.percentile(residual, [10.0, 90.0])]])
    number = np.clip(((variable - low) / (high - low) * bins).astype(int), 0, bins - 1)
    order = np.argsort(number, kind="stable")
    groups = np.split(residual[order], np.searchsorted(number[order], np.arange(1, bins)))
    least = max(5, len(residual) // 5000)
    width = (high - low) / bins
    rows = [
        [low + (k + 0.5) * width, np.mean(group), *np.percentile(group, [10.0, 90.0])]
        for k, group in enumerate(groups)
        if len(group) >= least
    ]
    return np.array(rows) if rows else np.empty((0, 4))


def file_stem(name: str) -> str:
    """Return a name that every file system takes."""
    return re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")[:60] or "channel"


# -- drawing ------------------------------------------------------------------------------------------------------


def _curves(axes: Any, line: Timeline, curves: Mapping[str, FloatArray]) -> None:
    styles = {"measured": (MEASURED, 2.0), "before": (BEFORE, 1.1), "after": (AFTER, 1.0)}
    for name, values in curves.items():
        colour, width = styles[name]
        axes.plot(*envelope(line, values), color=colour, linewidth=width, label=LABELS[name], solid_joinstyle="round")


def _over_time(
    trace: Trace,
    name: str,
    line: Timeline,
    curves: Mapping[str, FloatArray],
    residuals: Mapping[str, FloatArray],
    within: BoolArray,
    window: tuple[float, float] | None,
    description: str,
) -> Drawing:
    """Measured and both predictions above, both residuals below, over the whole time."""
    figure = new_figure(10.0, 4.9)
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.5, 1.0))
    figure.subplots_adjust(left=0.085, right=0.985, top=0.93, bottom=0.105, hspace=0.1)
    _curves(above, line, curves)
    _curves(below, line, residuals)
    for axes in (above, below):
        if within.any():
            low, high = axes.get_ylim()
            axes.fill_between(
                *_steps(line, within, low, high), color=SHADE, alpha=0.14, linewidth=0.0, zorder=0,
            )
            axes.set_ylim(low, high)
        for start in line.starts[1:]:
            axes.axvline(line.shown[start], color="#c3c8cf", linewidth=0.7, linestyle=":", zorder=0)
        if window is not None:
            axes.axvspan(*window, facecolor="none", edgecolor="#5b6470", linewidth=0.9, linestyle="--")
    clock = "time, pauses cut [s]" if line.cut else "time [s]"
    dress(above, trace.channel, trace.unit)
    dress(below, "residual", trace.unit, clock)
    below.axhline(0.0, color="#5b6470", linewidth=0.6)
    if len(line.shown) > 1:
        margin = 0.01 * (line.shown[-1] - line.shown[0])
        below.set_xlim(line.shown[0] - margin, line.shown[-1] + margin)
    legend(above)
    figure.align_ylabels()
    return finish(figure, name, description)


def _steps(line: Timeline, within: BoolArray, low: float, high: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the shaded spans as x, lower and upper for fill_between."""
    edges = np.flatnonzero(np.diff(np.r_[False, within, False].astype(np.int8)))
    xs, tops = [], []
    for first, last in zip(edges[::2], edges[1::2]):
        x = line.shown[first], line.shown[last - 1]
        xs += [x[0], x[0], x[1], x[1]]
        tops += [low, high, high, low]
    return np.array(xs), np.full(len(xs), low), np.array(tops)


def _close_up(
    trace: Trace, name: str, line: Timeline, curves: Mapping[str, FloatArray], window: tuple[float, float], description: str
) -> Drawing:
    """Measured and both predictions in `window`."""
    figure = new_figure(5.6, 3.7)
    axes = figure.subplots()
    figure.subplots_adjust(left=0.145, right=0.975, top=0.91, bottom=0.135)
    first, last = np.searchsorted(line.shown, window)
    part = Timeline(
        line.shown[first:last], (0, *(s - int(first) for s in line.starts if first < s < last)), line.cut
    )
    _curves(axes, part, {key: values[first:last] for key, values in curves.items()})
    axes.set_xlim(*window)
    dress(axes, trace.channel, trace.unit, "time, pauses cut [s]" if line.cut else "time [s]")
    legend(axes)
    return finish(figure, name, description)


def _against_variable(trace: Trace, name: str, residuals: Mapping[str, FloatArray], description: str) -> Drawing:
    """Both residuals against the trace's variable."""
    figure = new_figure(5.6, 3.7)
    axes = figure.subplots()
    figure.subplots_adjust(left=0.145, right=0.975, top=0.91, bottom=0.135)
    variable = np.asarray(trace.variable, dtype=float)
    chosen = np.arange(0, len(variable), max(1, len(variable) // SCATTER_POINTS))
    limits = [0.0]
    for key, colour, marker in (("before", BEFORE, "s"), ("after", AFTER, "o")):
        residual = residuals[key]
        axes.plot(
            variable[chosen], residual[chosen], linestyle="none", marker=".", markersize=2.0, color=colour, alpha=0.22,
            markeredgewidth=0.0, rasterized=True,
        )
        rows = binned(variable, residual)
        if len(rows):
            axes.fill_between(rows[:, 0], rows[:, 2], rows[:, 3], color=colour, alpha=0.13, linewidth=0.0)
        axes.plot(
            rows[:, 0], rows[:, 1], color=colour, marker=marker, markersize=3.2, linewidth=1.5, label=LABELS[key]
        )
        finite = residual[np.isfinite(residual)]
        if len(finite):
            limits += list(np.percentile(finite, [0.3, 99.7]))
    span = max(limits) - min(limits)
    if span > 0.0:
        axes.set_ylim(min(limits) - 0.08 * span, max(limits) + 0.08 * span)
    axes.axhline(0.0, color="#5b6470", linewidth=0.6)
    dress(axes, f"residual of {trace.channel}", trace.unit, trace.variable_name)
    legend(axes)
    return finish(figure, name, description)
