"""Line plots as SVG, for the documentation: nothing that a study needs to install."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from html import escape

import numpy as np

COLOURS = ("#1f77b4", "#ff7f0e", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#555555")
WIDTH, HEIGHT, LEFT, RIGHT, TOP, BOTTOM = 720, 260, 62, 150, 26, 40
MOST_POINTS = 600


@dataclasses.dataclass(frozen=True)
class Line:
    """One line: a name and its points."""

    name: str
    x: np.ndarray
    y: np.ndarray


def svg(title: str, x_label: str, y_label: str, lines: Sequence[Line], spans: Sequence[tuple[float, float]] = ()) -> str:
    """Return a plot; `spans` of x are shaded."""
    x_low, x_high = min(float(line.x.min()) for line in lines), max(float(line.x.max()) for line in lines)
    y_low, y_high = min(float(line.y.min()) for line in lines), max(float(line.y.max()) for line in lines)
    margin = 0.06 * (y_high - y_low or 1.0)
    y_low, y_high = y_low - margin, y_high + margin

    def at_x(value: float) -> float:
        return LEFT + (value - x_low) / (x_high - x_low) * (WIDTH - LEFT - RIGHT)

    def at_y(value: float) -> float:
        return HEIGHT - BOTTOM - (value - y_low) / (y_high - y_low) * (HEIGHT - TOP - BOTTOM)

    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" font-family="sans-serif" font-size="11">',
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>',
        f'<text x="{LEFT}" y="16" font-size="13">{escape(title)}</text>',
    ]
    for start, end in spans:
        box = f'x="{at_x(start):.1f}" y="{TOP}" width="{at_x(end) - at_x(start):.1f}" height="{bottom - TOP}"'
        parts.append(f'<rect {box} fill="#eeeeee"/>')
    for value in _ticks(x_low, x_high):
        x = at_x(value)
        parts.append(f'<line x1="{x:.1f}" y1="{bottom}" x2="{x:.1f}" y2="{bottom + 4}" stroke="black"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{value:g}</text>')
    for value in _ticks(y_low, y_high):
        y = at_y(value)
        parts.append(f'<line x1="{LEFT}" y1="{y:.1f}" x2="{right}" y2="{y:.1f}" stroke="#dddddd"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    for number, line in enumerate(lines):
        colour = COLOURS[number % len(COLOURS)]
        chosen = np.linspace(0, len(line.x) - 1, min(len(line.x), MOST_POINTS)).astype(int)
        points = " ".join(f"{at_x(line.x[k]):.1f},{at_y(line.y[k]):.1f}" for k in chosen)
        parts.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.3"/>')
        y = TOP + 14 + 17 * number
        ends = f'x1="{right + 10}" y1="{y - 4}" x2="{right + 28}" y2="{y - 4}"'
        parts.append(f'<line {ends} stroke="{colour}" stroke-width="2"/>')
        parts.append(f'<text x="{right + 33}" y="{y}">{escape(line.name)}</text>')
    box = f'x="{LEFT}" y="{TOP}" width="{right - LEFT}" height="{bottom - TOP}"'
    parts += [
        f'<rect {box} fill="none" stroke="black"/>',
        f'<text x="{(LEFT + right) / 2:.0f}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x_label)}</text>',
        f'<text transform="translate(14 {(TOP + bottom) / 2:.0f}) rotate(-90)" text-anchor="middle">{escape(y_label)}</text>',
        "</svg>",
    ]
    return "\n".join(parts) + "\n"


def _ticks(low: float, high: float) -> list[float]:
    """Return some five round numbers between two others."""
    rough = (high - low) / 5.0
    size = 10.0 ** math.floor(math.log10(rough))
    step = size * min((1.0, 2.0, 5.0, 10.0), key=lambda factor: abs(factor * size - rough))
    return [round(k * step, 12) for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
