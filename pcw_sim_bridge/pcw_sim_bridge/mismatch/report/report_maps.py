"""Where on the clock, in the operating region and on the floor a recording and its models part: one figure."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..findings.findings import ResidualMap
from ..regression.regression_problem import FloatArray
from .report_drawing import AFTER, BEFORE, LABELS, Drawing, dress, finish, legend, new_figure

BINS = 40
FEWEST = 5  # samples of a bin that is drawn
FLOOR_POINTS = 1500
# The path is coloured from what noise alone leaves to what this part of the samples stays below.
BRIGHTEST = 0.98


def draw_maps(residuals: ResidualMap) -> Drawing:
    """Draw the residual of all channels over their noise against time and variables, and along the path."""
    against = [("time", residuals.time), *residuals.variables.items()]
    on_floor = residuals.path is not None and bool(np.isfinite(residuals.path).all(axis=1).any())
    figure = new_figure(10.0, 6.4 if on_floor else 3.0)
    grid = figure.add_gridspec(
        2 if on_floor else 1, 6, left=0.07, right=0.915 if on_floor else 0.98, top=0.95 if on_floor else 0.9,
        bottom=0.08 if on_floor else 0.16, hspace=0.32, wspace=1.3, height_ratios=(1.0, 1.4) if on_floor else None,
    )  # fmt: skip
    width = 6 // len(against)
    first = None
    for number, (name, values) in enumerate(against):
        axes = figure.add_subplot(grid[0, number * width : (number + 1) * width])
        _against(axes, name, values, residuals)
        first = first or axes
    assert first is not None
    legend(first)
    if on_floor:
        assert residuals.path is not None
        _floor(figure, grid, residuals.path, residuals)
    return finish(
        figure,
        "00_residual_maps",
        "Residual of all channels together, over their noise: against time, against "
        + " and ".join(name for name, _ in against[1:])
        + (", and along the path on the floor, nominal and patched." if on_floor else "."),
    )


def _against(axes: Any, name: str, values: FloatArray, residuals: ResidualMap) -> None:
    """Root mean square in bins of one variable, before and after."""
    for side, colour, label in ((residuals.before, BEFORE, LABELS["before"]), (residuals.after, AFTER, LABELS["after"])):
        centre, level = binned_rms(values, side)
        axes.plot(centre, level, color=colour, linewidth=1.4, label=label)
    axes.set_yscale("log")
    axes.axhline(1.0, color="#5b6470", linewidth=0.6)
    unit = {"time": "s", "speed": "m/s", "velocity": "", "position": ""}.get(name, "rad")
    dress(axes, "residual over noise", "1", f"{name.replace('_', ' ')} [{unit}]" if unit else name, log_y=True)


def binned_rms(values: FloatArray, side: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres of equal bins of a variable and the root mean square of `side` (T,) in them, where there is enough of it."""
    good = np.isfinite(values) & np.isfinite(side)
    if not good.any():
        return np.zeros(0), np.zeros(0)
    values, power = values[good], side[good] ** 2
    low, high = float(values.min()), float(values.max())
    width = max((high - low) / BINS, 1e-12)
    number = np.clip(((values - low) / width).astype(int), 0, BINS - 1)
    count = np.bincount(number, minlength=BINS)
    total = np.bincount(number, power, minlength=BINS)
    kept = count >= min(FEWEST, count.max())
    return (low + (np.arange(BINS) + 0.5) * width)[kept], np.sqrt(total[kept] / count[kept])


def _floor(figure: Any, grid: Any, path: FloatArray, residuals: ResidualMap) -> None:
    """The path, coloured by the residual, before and after in the same colours."""
    from matplotlib.colors import LogNorm

    judged = np.isfinite(path).all(axis=1) & np.isfinite(residuals.before) & np.isfinite(residuals.after)
    rows = np.flatnonzero(judged)[:: max(1, int(judged.sum()) // FLOOR_POINTS)]
    if not len(rows):
        return
    top = float(np.quantile(residuals.before[rows], BRIGHTEST))
    norm = LogNorm(1.0, max(top, 2.0), clip=True)
    panels = [figure.add_subplot(grid[1, :3]), figure.add_subplot(grid[1, 3:])]
    for axes, side, label in zip(panels, (residuals.before, residuals.after), ("before", "after"), strict=True):
        order = rows[np.argsort(side[rows])]  # the loudest on top
        dots = axes.scatter(
            path[order, 0], path[order, 1], c=np.maximum(side[order], 1e-3), norm=norm, s=5.0, cmap="viridis", linewidths=0.0,
            rasterized=True,
        )  # fmt: skip
        axes.set_aspect("equal", adjustable="datalim")
        dress(axes, "y", "m", "x [m]")
        axes.set_title(LABELS[label], fontsize=9, loc="left", color="#20252c")
    bar = figure.colorbar(dots, cax=figure.add_axes((0.93, 0.1, 0.013, 0.42)))
    bar.set_label("residual over noise [1]", fontsize=9, color="#20252c")
    bar.ax.tick_params(labelsize=8.5)
