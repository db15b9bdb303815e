"""Findings as a folder: report.html, report.json, robot_patched.yaml and figures.

The page stands alone: style and figures are inside, nothing is fetched, no script runs. The folder appears complete or
not at all: it is written under a hidden name beside its place and renamed at the end.
"""

from __future__ import annotations

import base64
import contextlib
import json
import math
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import yaml

from pcw_description.effects.registry import PATH_VARIABLE

from ..errors import MismatchError
from ..findings.findings import (
    VERDICTS,
    ChannelProof,
    Findings,
    ParameterFinding,
    RetunedFinding,
    RolloutProof,
)
from .report_drawing import SUPERSCRIPTS, Drawing, Task, done, pretty_unit
from .report_figures import TraceFigures, time_origin, trace_drawings
from .report_maps import draw_maps

HTML, JSON, PATCHED, FIGURES, EFFECTS = "report.html", "report.json", "robot_patched.yaml", "figures", "effects"
WITH_LAWS = "robot_with_laws.yaml"  # in the folder of effects
TEMPLATE = "report.html.j2"
BEYOND_TOLERANCE = 3.0  # tolerances; a number that moved further is not healthy re-tuning
# Where report.json may say null instead of a number that does not exist (NaN); anywhere else NaN is an error.
NULLABLE = frozenset({"ladder[].held_out_gain"})
PERSONS = {"coulomb": "Coulomb", "stribeck": "Stribeck"}
SHORT_LIST = 12  # rows of the ladder that are shown unfolded

HEADLINES = {
    "no_mismatch": "{nothing}.",
    "explained": "Explained. The following, added to the description, accounts for what was recorded.",
    "partly_explained": "Partly explained. Beside what can be named there is a leftover from outside the library of effects.",
    "unexplained": "Not explained. Recording and model part, and no effect of the library accounts for it.",
    "insufficient_data": "Not enough data to judge.",
}
BADGES = {
    "no_mismatch": "no mismatch",
    "explained": "explained",
    "partly_explained": "partly explained",
    "unexplained": "unexplained",
    "insufficient_data": "insufficient data",
}


# -- the folder -----------------------------------------------------------------------------------------------------


def check_output(out: Path, force: bool = False) -> None:
    """Make sure that a report can be written to `out`; to be called before an analysis takes its time.

    Args:
        out: the folder of the report; it need not exist, nor its parents.
        force: whether an earlier report there may be replaced.

    Raises:
        MismatchError: `out` is a file or a folder with something in it that may not be replaced, or cannot be made.
    """
    try:
        _check_output(out, force)
    except OSError as error:
        raise MismatchError(f"--out {out}: cannot be written: {error.strerror or error}") from error


def _check_output(out: Path, force: bool) -> None:
    place = out.resolve()
    if place.exists():
        if not place.is_dir():
            raise MismatchError(f"--out {out}: is a file; a folder is wanted")
        if place.is_mount():
            raise MismatchError(f"--out {out}: is a mount point, which cannot be replaced; name a folder inside it")
        entries = sorted(entry.name for entry in place.iterdir())
        if entries and not _is_report(place):
            foreign = ", ".join([name for name in entries if name not in (HTML, JSON, PATCHED)][:3]) or ", ".join(entries)
            raise MismatchError(
                f"--out {out}: the folder is not empty and holds more than an earlier report ({foreign}); name another one"
                if JSON in entries
                else f"--out {out}: the folder is not empty ({foreign}); name another one"
            )
        if entries and not force:
            raise MismatchError(
                f"--out {out}: the folder holds an earlier report; replace it with --force or name another one"
            )
    parent = place.parent
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir():
        raise MismatchError(f"--out {out}: {parent} is a file; a folder is wanted")
    # Permissions, read-only file systems and quotas: only trying tells.
    probe = parent / _hidden_name(place)
    probe.mkdir()
    probe.rmdir()


def _is_report(folder: Path) -> bool:
    """Whether a folder holds a report and nothing else, so that replacing it loses nothing of value."""
    names = {entry.name for entry in folder.iterdir()}
    if JSON not in names or not names <= {HTML, JSON, PATCHED, FIGURES, EFFECTS}:
        return False
    figures = folder / FIGURES
    if not figures.exists():
        return True
    if figures.is_symlink() or not figures.is_dir():
        return False
    return all(entry.suffix in (".png", ".svg") and entry.is_file() for entry in figures.iterdir())


def _hidden_name(place: Path) -> str:
    return f".{place.name[:60]}.{secrets.token_hex(4)}.partial"


@contextlib.contextmanager
def _appearing_folder(out: Path, force: bool) -> Iterator[Path]:
    """Give a hidden folder that takes the place of `out` when the block ends well, and vanishes when it does not."""
    place = out.resolve()
    made = [folder for folder in place.parents if not folder.exists()]
    place.parent.mkdir(parents=True, exist_ok=True)
    hidden = place.with_name(_hidden_name(place))
    try:
        hidden.mkdir()
        yield hidden
        check_output(out, force)  # once more: minutes may have passed
        old = None
        if place.exists() and any(place.iterdir()):
            old = place.with_name(_hidden_name(place))
            place.rename(old)
        try:
            hidden.rename(place)
        except BaseException:
            if old is not None:
                old.rename(place)
            raise
        if old is not None:
            shutil.rmtree(old, ignore_errors=True)
    except BaseException:
        shutil.rmtree(hidden, ignore_errors=True)
        for folder in made:
            with contextlib.suppress(OSError):
                folder.rmdir()
        raise


def write_report(
    findings: Findings,
    patched: Mapping[str, Any] | None,
    out: Path,
    force: bool = False,
    with_laws: Mapping[str, Any] | None = None,
    do: Callable[[Sequence[Task]], list[Any]] = done,
) -> Path:
    """Write report.html, report.json, robot_patched.yaml, figures/ and effects/ to a folder, all of them or nothing.

    Args:
        findings: what the analysis says.
        patched: the description with what was found, or the nominal one where nothing was; None leaves the file out.
        out: the folder; made, with its parents, if need be.
        force: replace an earlier report there.
        with_laws: the description with the effects that were generated, too; None leaves the file out.
        do: returns what all tasks make.

    Returns:
        The path of report.html.

    Raises:
        MismatchError: `out` cannot be used (see `check_output`), or a number in the findings is not finite.
    """
    check_output(out, force)
    content = report_json(findings)
    patched_text = None if patched is None else _yaml(patched)
    try:
        with _appearing_folder(out, force) as folder:
            _write(folder / JSON, content)
            if patched_text is not None:
                _write(folder / PATCHED, patched_text)
            for leftover in findings.unknown:
                if leftover.effect is not None:
                    (folder / EFFECTS).mkdir(exist_ok=True)
                    _write(folder / EFFECTS / f"{leftover.effect.name}.py", leftover.effect.source)
            if with_laws is not None:
                _write(folder / EFFECTS / WITH_LAWS, f"# Where {PATH_VARIABLE} names this folder.\n{_yaml(with_laws)}")
            # First that which takes longest.
            on_maps = [] if findings.residual_map is None else [(draw_maps, (findings.residual_map,))]
            drawn = do([*on_maps, *trace_drawings(findings)])
            maps, figures = (drawn[0], drawn[1:]) if on_maps else (None, drawn)
            (folder / FIGURES).mkdir()
            for drawing in (maps, *(d for t in figures for d in (t.over_time, t.window, t.against_variable))):
                if drawing is not None:
                    (folder / FIGURES / f"{drawing.name}.png").write_bytes(drawing.png)
            _write(folder / HTML, report_html(findings, figures, maps, patched))
    except OSError as error:
        raise MismatchError(f"--out {out}: cannot be written: {error.strerror or error}") from error
    return out / HTML


def _write(path: Path, text: str) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())


def report_json(findings: Findings) -> str:
    """Return the text of report.json: strict JSON, without NaN.

    Raises:
        MismatchError: a number is not finite where INTERFACES section 6 wants one; the message says which.
    """
    if findings.verdict not in VERDICTS:
        raise MismatchError(f"verdict: {findings.verdict!r} is not allowed; one of {', '.join(VERDICTS)}")
    content = _plain(findings.to_json(), "", NULLABLE)
    return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _yaml(mapping: Mapping[str, Any]) -> str:
    return yaml.safe_dump(_plain(mapping, ""), sort_keys=False, allow_unicode=True, default_flow_style=None, width=110)


def _plain(value: Any, where: str, nullable: frozenset[str] = frozenset()) -> Any:
    """Return `value` of plain Python types, numpy's converted; NaN becomes None where `nullable` has its path."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{where}.{key}".lstrip("."), nullable) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(item, f"{where}[]", nullable) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        if where in nullable:
            return None
        raise MismatchError(f"{where}: {value} is not allowed; a finite number is wanted")
    return value


# -- numbers in words ------------------------------------------------------------------------------------------------


def number(value: float | None, digits: int = 3) -> str:
    """Return a number with so many significant digits, as it is printed: "−3.17", "4.2 × 10⁻⁵"."""
    if value is None or not math.isfinite(value):
        return "–" if value is None or math.isnan(value) else ("−∞" if value < 0.0 else "∞")
    if value == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(float(f"{value:.{digits - 1}e}"))))
    if not -4 <= exponent < 6:
        return f"{_signed(f'{value / 10.0**exponent:.{digits - 1}f}')} × 10{_superscript(exponent)}"
    return _signed(f"{value:.{max(0, digits - 1 - exponent)}f}")


def as_written(value: float) -> str:
    """Return a number of a description as it was written there: no digits that it does not have."""
    text = f"{value:.6g}"
    return number(value, 6) if "e" in text else _signed(text)


def with_interval(value: float, low: float, high: float) -> tuple[str, str]:
    """Return value and interval to the digits that the interval warrants: ("203.5", "[202.9, 204.1]")."""
    half = 0.5 * (high - low)
    largest = max(abs(value), abs(low), abs(high))
    if not (math.isfinite(half) and half > 0.0 and math.isfinite(largest)):
        return number(value, 4), f"[{number(low, 4)}, {number(high, 4)}]"
    exponent = math.floor(math.log10(largest))
    power = 0 if -4 <= exponent < 6 else 3 * (exponent // 3)
    # Two digits of the interval's half; never more than seven of the value, where the interval is absurdly narrow.
    decimals = min(max(0, 1 - math.floor(math.log10(half))) + power, 6 - exponent + power)
    texts = [_signed(f"{x / 10.0**power:.{max(0, decimals)}f}") for x in (value, low, high)]
    scale = f" × 10{_superscript(power)}" if power else ""
    return texts[0] + scale, f"[{texts[1]}, {texts[2]}]{scale}"


def probability(value: float) -> str:
    """Return a probability in per cent, never rounded to certainty."""
    if value > 0.999:
        return "> 99.9 %"
    if value < 0.001:
        return "< 0.1 %"
    return f"{100.0 * value:.{0 if 0.1 <= value <= 0.9 else 1}f} %"


def p_value(value: float) -> str:
    """Return a p-value with the digits that matter."""
    if value < 1e-300:
        return "< 10⁻³⁰⁰"
    return number(value, 1 if value < 1e-3 else 2)


def percent(value: float) -> str:
    """Return a share in per cent."""
    return f"{_signed(f'{100.0 * value:.{0 if abs(value) >= 0.1 else 1}f}')} %" if math.isfinite(value) else "–"


def change(before: float, after: float) -> str:
    """Return by how much an error changed: "−91 %", "+16 %"."""
    if not before > 0.0:
        return "–"
    text = percent((after - before) / before)
    return text if text.startswith(("−", "–", "0.0 ")) else "+" + text


def nats(value: float | None) -> str:
    """Return a logarithm of evidence: one decimal is all that it is good for."""
    return "–" if value is None or math.isnan(value) else _signed(f"{value:.1f}")


def _signed(text: str) -> str:
    if text.startswith("-"):
        text = "−" + text[1:] if float(text) != 0.0 else text[1:]
    return text


def _superscript(exponent: int) -> str:
    return str(exponent).translate(SUPERSCRIPTS)


def words(name: str) -> str:
    """Return a name of the vocabulary as words: "drive_coulomb_friction" -> "drive Coulomb friction"."""
    return " ".join(PERSONS.get(word, word) for word in name.split("_"))


def listed(names: Any, last: str = "and") -> str:
    """Return "a, b and c"."""
    items = [str(name) for name in names]
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} {last} {items[-1]}" if items else ""


def seconds(value: float) -> str:
    """Return a duration as it is said: "24.8 s", "3 min 20 s"."""
    if value < 120.0:
        return f"{number(value)} s"
    minutes, rest = divmod(round(value), 60)
    return f"{minutes} min {rest} s" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


# -- the page --------------------------------------------------------------------------------------------------------


def report_html(
    findings: Findings,
    figures: list[TraceFigures],
    maps: Drawing | None = None,
    patched: Mapping[str, Any] | None = None,
) -> str:
    """Return the text of report.html."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        number=number, probability=probability, p_value=p_value, percent=percent, words=words, listed=listed,
        unit=pretty_unit, seconds=seconds, nats=nats, data_uri=_data_uri,
    )
    physics = None if patched is None else patched.get("physics")
    nothing = findings.nothing_missing()
    return environment.get_template(TEMPLATE).render(
        findings=findings,
        headline=HEADLINES[findings.verdict].format(nothing=nothing[0].upper() + nothing[1:]),
        badge=BADGES[findings.verdict],
        effects=[
            (effect, [(name, *_with_interval(p), p.unit) for name, p in effect.parameters.items()])
            for effect in findings.effects
        ],
        retuned=[_retuned_row(item) for item in findings.retuned],
        fit_rows=_fit_rows(findings),
        proof_rows=_proof_rows(findings),
        maps=maps,
        ladder=_ladder_rows(findings),
        short_list=SHORT_LIST,
        origin=time_origin(findings),
        figures=figures,
        warnings=sum(len(item.warnings) for item in findings.inputs),
        beyond=BEYOND_TOLERANCE,
        physics=_yaml({"physics": physics}) if physics else None,
        has_patched=patched is not None,
    )


def _data_uri(png: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(png).decode("ascii")


def _with_interval(parameter: ParameterFinding) -> tuple[str, str]:
    return with_interval(parameter.value, parameter.low, parameter.high)


def _retuned_row(item: RetunedFinding) -> dict[str, Any]:
    value, interval = with_interval(item.value, item.low, item.high)
    if item.tolerance > 0.0:
        moved = abs(item.value - item.nominal) / item.tolerance
    else:
        moved = 0.0 if item.value == item.nominal else math.inf
    return {
        "name": item.name,
        "unit": item.unit,
        "nominal": as_written(item.nominal),
        "value": value,
        "interval": interval,
        "tolerance": number(item.tolerance, 2),
        "moved": moved,
        "beyond": moved > BEYOND_TOLERANCE,
    }


def _fit_rows(findings: Findings) -> list[dict[str, Any]]:
    """Rows of the held-out table: the channels together, and every signal after half a second."""
    fit = findings.fit
    if fit is None:
        return []
    row = _fit_row("inverse: measured side of the channels (NRMSE)", *fit.inverse_nrmse)
    if fit.inverse_ci95 is not None and fit.inverse_floor is not None:
        row |= {"before_interval": _interval(fit.inverse_ci95[0]), "after_interval": _interval(fit.inverse_ci95[1])}
        row["floor"] = fit.inverse_floor
    return [row, *(_fit_row(f"rollout: {signal}", *pair) for signal, pair in fit.rollout.items())]


def _proof_rows(findings: Findings) -> list[dict[str, Any]]:
    """Rows of the table of every channel, and of every signal at every horizon, with intervals and floors."""
    fit = findings.fit
    if fit is None:
        return []
    named: list[tuple[str, ChannelProof | RolloutProof]] = [(entry.name, entry) for entry in fit.channels]
    named += [(f"{entry.signal} after {entry.horizon:g} s", entry) for entry in fit.rollouts]
    return [
        _fit_row(name, entry.before, entry.after)
        | {
            "floor": entry.floor,
            "before_interval": _interval(entry.before_ci95),
            "after_interval": _interval(entry.after_ci95),
        }
        for name, entry in named
    ]


def _fit_row(name: str, before: float, after: float) -> dict[str, Any]:
    """One error before and after; bars are relative to the larger of the two."""
    largest = max(before, after) or 1.0
    return {
        "name": name,
        "before": before,
        "after": after,
        "before_interval": None,
        "after_interval": None,
        "floor": None,
        "before_bar": 100.0 * before / largest,
        "after_bar": 100.0 * after / largest,
        "change": change(before, after),
        # Worse by more than rounding: one per cent is what counts as harm.
        "worse": after > 1.01 * before,
    }


def _interval(pair: tuple[float, float]) -> str:
    return f"[{number(pair[0])}, {number(pair[1])}]"


def _ladder_rows(findings: Findings) -> list[tuple[Any, float]]:
    """Candidates with the length of their bar [%], on a logarithmic scale: gains span decades."""
    lengths = [math.log1p(max(step.gain, 0.0)) for step in findings.ladder]
    longest = max(lengths, default=0.0) or 1.0
    return [(step, 100.0 * length / longest) for step, length in zip(findings.ladder, lengths)]
