"""What all figures of the report share: colours, frame, legend, and a PNG at the end.

Matplotlib is imported when the first figure is drawn, without pyplot: no display, no global state.
"""

from __future__ import annotations

import dataclasses
import io
import re
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

# Okabe and Ito's colours, told apart by colour-blind readers too; widths and order tell them apart in grey print.
MEASURED, BEFORE, AFTER, SHADE = "#8b929c", "#d55e00", "#0072b2", "#f0c808"
LABELS = {"measured": "measured", "before": "nominal model", "after": "patched model"}
RESOLUTION = 130  # dots per inch
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


Task = tuple[Callable[..., Any], tuple[Any, ...]]  # a function and its arguments


@dataclasses.dataclass(frozen=True)
class Drawing:
    """One figure: the name of its file without suffix, its content, its size on paper [CSS pixels], what it shows."""

    name: str
    png: bytes
    width: int
    height: int
    description: str


def done(tasks: Sequence[Task]) -> list[Any]:
    """Return what tasks make, one after the other."""
    return [function(*arguments) for function, arguments in tasks]


def pretty_unit(unit: str) -> str:
    """Return a unit as it is printed: "N m s/rad" -> "N·m·s/rad", "m/s^2" -> "m/s²"; "1" is none."""
    if unit.strip() in ("", "1", "-"):
        return ""
    raised = re.sub(r"\^(-?\d+)", lambda match: match[1].translate(SUPERSCRIPTS), unit.strip())
    return re.sub(r"(?<=\S)[ *]+(?=\S)", "·", raised)


def new_figure(width: float, height: float) -> Any:
    """Return a figure of its own [inch], without any display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=RESOLUTION, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def finish(figure: Any, name: str, description: str) -> Drawing:
    """Draw a figure as PNG."""
    from PIL import Image  # what matplotlib itself writes PNG with; here without alpha, and quickly

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Glyph")  # a name in a script that the font lacks
        figure.canvas.draw()
    buffer = io.BytesIO()
    pixels = np.ascontiguousarray(np.asarray(figure.canvas.buffer_rgba())[:, :, :3])
    Image.fromarray(pixels).save(buffer, "png", compress_level=2, dpi=(RESOLUTION, RESOLUTION))
    width, height = figure.get_size_inches()
    return Drawing(name, buffer.getvalue(), round(96 * width), round(96 * height), description)


def dress(axes: Any, ylabel: str, unit: str, xlabel: str | None = None, log_y: bool = False) -> None:
    """Grid, frame and labels. Names come from files: nothing in them is TeX."""
    axes.grid(True, color="#e4e7eb", linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color("#9aa1ab")
    axes.locator_params(nbins=7 if axes.get_position().width < 0.7 else 9, axis="x")
    if not log_y:
        axes.locator_params(nbins=6, axis="y")
    axes.tick_params(colors="#3b424c", labelsize=8.5, length=3)
    axes.set_ylabel(f"{ylabel} [{pretty_unit(unit) or '1'}]", fontsize=9, color="#20252c", parse_math=False)
    if xlabel is not None:
        axes.set_xlabel(xlabel, fontsize=9, color="#20252c", parse_math=False)


def legend(axes: Any) -> None:
    """Put the legend above the axes."""
    legend = axes.legend(
        loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, fontsize=8.5, frameon=False, handlelength=1.6,
        columnspacing=1.4, borderaxespad=0.1,
    )
    for handle in legend.get_lines():
        handle.set_linewidth(2.5)
