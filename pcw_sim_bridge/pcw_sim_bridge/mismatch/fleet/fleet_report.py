"""A fleet's histories as files: fleet.json and fleet.html, which stands alone. Each replaces the old one whole."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path

import jinja2
import markupsafe
import numpy as np

from ..errors import MismatchError
from .fleet_trends import PERIODS, ParameterHistory, RobotHistory, date, to_json

JSON, HTML, TEMPLATE = "fleet.json", "fleet.html", "fleet.html.j2"
# Drawing, in units of the SVG's own coordinates.
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 640.0, 170.0, 78.0, 12.0, 10.0, 26.0
MARGIN = 0.08  # of the values' span, above and below


def write_fleet_report(robots: Sequence[RobotHistory], folder: Path) -> Path:
    """Write fleet.json and fleet.html; return the path of the page.

    Raises:
        MismatchError: they cannot be written.
    """
    try:
        _replace(folder / JSON, json.dumps(to_json(robots), indent=1, allow_nan=False) + "\n")
        _replace(folder / HTML, fleet_html(robots))
    except OSError as error:
        raise MismatchError(f"--out {folder}: cannot be written: {error.strerror or error}") from error
    return folder / HTML


def _replace(path: Path, text: str) -> None:
    partial = path.with_name(f".{path.name}.partial")
    with partial.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    partial.replace(path)


def fleet_html(robots: Sequence[RobotHistory]) -> str:
    """Return the page."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader(__package__, "."), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["date"] = date
    return environment.get_template(TEMPLATE).render(robots=robots, timeline=timeline)


def timeline(robot: RobotHistory, label: str, history: ParameterHistory) -> markupsafe.Markup:
    """Draw a number with its intervals over the time of all recordings of a robot, and its slope where there is one.

    Ticks along the lower edge are recordings: where there is a tick and no point, the effect was not named.
    """
    low, high = float(history.low.min()), float(history.high.max())
    pad = MARGIN * (high - low) or 0.1 * abs(high) or 1.0
    low, high = low - pad, high + pad
    first, last = float(robot.times[0]), float(robot.times[-1])
    span = last - first or 1.0

    def x(time: float) -> float:
        inside = 8.0  # so that the first and the last point are not on the frame
        return LEFT + inside + (time - first) / span * (WIDTH - LEFT - RIGHT - 2.0 * inside)

    def y(value: float) -> float:
        return TOP + (high - value) / (high - low) * (HEIGHT - TOP - BOTTOM)

    floor = HEIGHT - BOTTOM
    parts = [f'<rect class="frame" x="{LEFT}" y="{TOP}" width="{WIDTH - LEFT - RIGHT}" height="{floor - TOP}"/>']
    parts += [f'<line class="tick" x1="{x(t):.1f}" x2="{x(t):.1f}" y1="{floor}" y2="{floor + 4:.0f}"/>' for t in robot.times]
    if history.trend is not None and history.trend.real:
        trend = history.trend
        ends = np.array([history.time[0], history.time[-1]])
        line = trend.start_value + trend.slope * (ends - trend.start_time) / PERIODS[trend.period]
        (x0, x1), (y0, y1) = (x(float(t)) for t in ends), (y(float(v)) for v in line)
        parts.append(f'<line class="slope" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>')
    for t, value, below, above in zip(history.time, history.value, history.low, history.high, strict=True):
        parts.append(f'<line class="ci" x1="{x(t):.1f}" x2="{x(t):.1f}" y1="{y(below):.1f}" y2="{y(above):.1f}"/>')
        parts.append(f'<circle cx="{x(t):.1f}" cy="{y(value):.1f}" r="2.6"/>')
    for value in (low + pad, high - pad):
        parts.append(f'<text class="y" x="{LEFT - 6}" y="{y(value) + 4:.1f}">{value:.3g}</text>')
    parts.append(f'<text x="{LEFT}" y="{HEIGHT - 6}">{date(first)}</text>')
    parts.append(f'<text class="y" x="{WIDTH - RIGHT}" y="{HEIGHT - 6}">{date(last)}</text>')
    # Only numbers and dates so far; the label comes from a description.
    title = markupsafe.Markup("<title>{}</title>").format(label)
    drawn = markupsafe.Markup("".join(parts))
    return markupsafe.Markup('<svg viewBox="0 0 {} {}" role="img">{}{}</svg>').format(WIDTH, HEIGHT, title, drawn)
