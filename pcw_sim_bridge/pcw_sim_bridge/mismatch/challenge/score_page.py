"""The score as text for a terminal and as a page of the documentation."""

from __future__ import annotations

import math
from collections.abc import Sequence

from .score import Figure, Score, Table

SECTIONS = {
    1: "Names", 2: "Nothing missing", 3: "Outside the library", 4: "Location", 5: "Numbers and probabilities",
    6: "Held-out proof", 7: "Masked cases", 10: "Cost",
}


def text(score: Score) -> str:
    """Return everything as plain text."""
    lines = [f"{source.drawn}: answers {source.digest}" for source in score.sources]
    for section, title in SECTIONS.items():
        own = [figure for figure in score.figures if figure.section == section]
        lines += ["", f"{section}. {title}"]
        lines += [f"  {mark(figure):4} {figure.label}: {said(figure)}" for figure in own]
    for table in score.tables:
        lines += ["", table.title, *_aligned(table)]
    return "\n".join([*lines, *(["", *score.notes] if score.notes else [])])


def page(score: Score) -> str:
    """Return everything as Markdown."""
    lines = [
        "# The challenge",
        "",
        "Written by `mismatch challenge score --markdown`; not edited by hand.",
        "",
        "SHA-256 of the answers, sealed before the recordings were made:",
        "",
        *(f"- {source.drawn}: `{source.digest}`" for source in score.sources),
    ]
    for section, title in SECTIONS.items():
        own = [figure for figure in score.figures if figure.section == section]
        rows = tuple((f.label, value(f), interval(f), f.of, f.wanted, mark(f)) for f in own)
        lines += ["", f"## {title}", "", *_markdown(("figure", "value", "95 %", "from", "wanted", ""), rows)]
    for table in score.tables:
        lines += ["", f"## {table.title}", "", *_markdown(table.head, table.rows)]
    return "\n".join([*lines, *(["", *score.notes] if score.notes else [])]) + "\n"


def value(figure: Figure) -> str:
    """Return a figure's value with its unit."""
    if math.isnan(figure.value):
        return "no case"
    if figure.unit == "%":
        return f"{100 * figure.value:.1f} %"
    return f"{figure.value:.3g}" + (f" {figure.unit}" if figure.unit != "1" else "")


def interval(figure: Figure) -> str:
    """Return a share's interval."""
    if figure.interval is None or math.isnan(figure.value):
        return ""
    return f"{100 * figure.interval[0]:.1f} to {100 * figure.interval[1]:.1f} %"


def mark(figure: Figure) -> str:
    """Return whether a figure is as wanted."""
    return "" if figure.met is None else "yes" if figure.met else "NO"


def said(figure: Figure) -> str:
    """Return a figure as a line of text."""
    spread = f" ({interval(figure)})" if interval(figure) else ""
    wanted = f", wanted {figure.wanted}" if figure.wanted else ""
    return f"{value(figure)}{spread}, {figure.of}{wanted}"


def _aligned(table: Table) -> list[str]:
    rows = [table.head, *table.rows]
    widths = [max(len(row[k]) for row in rows) for k in range(len(table.head) - 1)]
    return ["  " + "  ".join([*(f"{cell:{width}}" for cell, width in zip(row, widths)), row[-1]]).rstrip() for row in rows]


def _markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"

    return [line(head), line(["---"] * len(head)), *(line(row) for row in rows)]
