"""`mismatch challenge score`: every figure that the analyser has to show, from reports and answers."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pcw_description.effects.registry import all_effects

from ..errors import MismatchError
from .cases import LEAST_EVIDENCE, Answer
from .judgement import OUTCOMES, Judgement, ParameterError
from .run import BASELINES, REPORT, USAGE
from .sealed_answers import open_sealed, sealed_hash

Progress = Callable[[str], None]
CONFIDENT = 0.8
CALIBRATION_BINS = 10
SEEN = ("right", "in a look-alike set")
WILSON_Z = 1.959964  # of 95 %


@dataclasses.dataclass(frozen=True)
class Figure:
    """One number that is shown.

    Attributes:
        section: number under "Must show".
        value: NaN where no case can tell.
        of: what it was taken from, in words.
        wanted: what it shall be, in words; "" if only told. met: whether it is; None where no case can tell.
        interval: 95 %, by Wilson, of a share.
    """

    section: int
    label: str
    value: float
    unit: str
    of: str
    wanted: str = ""
    met: bool | None = None
    interval: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True)
class Table:
    """Rows of text below a heading."""

    title: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclasses.dataclass(frozen=True)
class CaseSet:
    """Cases of one `challenge make`: their folder, their sealed answers, and the reports (None: those in the folder)."""

    folder: Path
    answers: Path
    reports: Path | None = None


@dataclasses.dataclass(frozen=True)
class Source:
    """Where scored cases come from: how they were drawn, in words, and the hash of the answers."""

    drawn: str
    digest: str


@dataclasses.dataclass(frozen=True)
class Score:
    """Everything that `score` says."""

    sources: tuple[Source, ...]
    figures: tuple[Figure, ...]
    tables: tuple[Table, ...]
    notes: tuple[str, ...]


def score(sets: Sequence[CaseSet], progress: Progress) -> Score:
    """Compare the reports of one or more sets of cases with the answers.

    Raises:
        MismatchError: the answers are not those that were sealed, or no case of a set has a report.
    """
    sources, judged = [], []
    for cases in sets:
        sealed = open_sealed(cases.answers, cases.folder)
        reports = cases.reports or cases.folder / "reports"
        answers: list[Answer] = sealed["cases"]
        reported = [a for a in answers if (reports / a["case"] / REPORT).exists()]
        if not reported:
            raise MismatchError(f"{reports} holds no report of these cases; allowed: after `challenge run`")
        progress(f"{cases.folder}: {len(reported)} of {len(answers)} cases have a report")
        options = [f"{name} {', '.join(map(str, values))}" for name, values in sealed["options"].items()]
        drawn = "; ".join([f"{len(answers)} cases, seed {sealed['seed']}", *options])
        sources.append(Source(drawn, sealed_hash(cases.folder)))
        own = [_judgement(a, reports / a["case"]) for a in answers]
        if len(sets) > 1:  # a number of a case says nothing without its folder
            own = [dataclasses.replace(j, answer={**j.answer, "case": f"{cases.folder.name}/{j.answer['case']}"}) for j in own]
        judged += own
    return Score(tuple(sources), tuple(figures(judged)), tuple(tables(judged)), tuple(_notes(judged)))


def _judgement(answer: Answer, folder: Path) -> Judgement:
    def read(name: str) -> Any:
        path = folder / name
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else None

    return Judgement(answer, read(REPORT), read(USAGE) or {}, (read(BASELINES) or {}).get("baselines", ()))


# -- statistics ---------------------------------------------------------------------------------------------------


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (E. B. Wilson, J. Am. Stat. Assoc. 22, 1927)."""
    if total == 0:
        return 0.0, 1.0
    share, z2 = count / total, WILSON_Z**2
    middle = (share + 0.5 * z2 / total) / (1.0 + z2 / total)
    half = WILSON_Z * math.sqrt(share * (1.0 - share) / total + 0.25 * z2 / total**2) / (1.0 + z2 / total)
    return max(0.0, middle - half), min(1.0, middle + half)


def calibration_error(probabilities: Sequence[float], right: Sequence[bool]) -> float:
    """Return the expected calibration error: |share right - mean probability| over bins of equal width, by their counts."""
    if not probabilities:
        return math.nan
    p, hit = np.array(probabilities), np.array(right, dtype=float)
    bins = np.minimum((p * CALIBRATION_BINS).astype(int), CALIBRATION_BINS - 1)
    apart = [abs(hit[bins == b].mean() - p[bins == b].mean()) * np.mean(bins == b) for b in np.unique(bins)]
    return float(sum(apart))


def overlap(one: Sequence[float], other: Sequence[float]) -> float:
    """Return intersection over union of two ranges."""
    shared = max(0.0, min(one[1], other[1]) - max(one[0], other[0]))
    union = max(one[1], other[1]) - min(one[0], other[0])
    return shared / union if union > 0.0 else 1.0


# -- figures ------------------------------------------------------------------------------------------------------


def _share(
    section: int, label: str, hits: Iterable[bool], of: str, at_least: float | None = None, at_most: float | None = None
) -> Figure:
    flags = list(hits)
    count, total = sum(flags), len(flags)
    value = count / total if total else math.nan
    wanted, met = "", None
    if at_least is not None:
        wanted, met = f">= {100 * at_least:g} %", value >= at_least if total else None
    if at_most is not None:
        wanted, met = f"<= {100 * at_most:g} %", value <= at_most if total else None
    return Figure(section, label, value, "%", f"{count} of {total} {of}", wanted, met, wilson(count, total))


def _quantile(
    section: int, label: str, values: Iterable[float | None], unit: str, of: str, quantile: float = 0.5,
    at_least: float | None = None, at_most: float | None = None,
) -> Figure:
    numbers = [value for value in values if value is not None]
    found = float(np.quantile(numbers, quantile)) if numbers else math.nan
    scale, shown = (100.0, " %") if unit == "%" else (1.0, f" {unit}" if unit != "1" else "")
    wanted, met = "", None
    if at_least is not None:
        wanted, met = f">= {scale * at_least:g}{shown}", found >= at_least if numbers else None
    if at_most is not None:
        wanted, met = f"<= {scale * at_most:g}{shown}", found <= at_most if numbers else None
    return Figure(section, label, found, unit, f"{len(numbers)} {of}", wanted, met)


def figures(judged: Sequence[Judgement]) -> list[Figure]:
    """Return every figure, in the order of "Must show"."""
    by_kind = {kind: [j for j in judged if j.kind == kind] for kind in ("none", "single", "pair", "outside", "masked")}
    inside = [j for kind in ("single", "pair", "masked") for j in by_kind[kind] if j.above_floor]
    return [
        *_naming(by_kind), *_nothing_missing(by_kind["none"]), *_outside(by_kind["outside"]), *_locating(judged),
        *_numbers(judged, inside), *_proof(by_kind["none"], inside), *_masked(by_kind["masked"]), *_cost(judged),
    ]


def _naming(by_kind: Mapping[str, Sequence[Judgement]]) -> list[Figure]:
    singles = [j for j in by_kind["single"] if j.above_floor]
    pairs = [j for j in by_kind["pair"] if j.above_floor]
    faint = [j for kind in ("single", "pair") for j in by_kind[kind] if not j.above_floor]
    of = "singles above the floor"
    return [
        _share(1, "right, or in a declared look-alike set", (j.outcome in SEEN for j in singles), of, at_least=0.95),
        _share(1, "outright right", (j.outcome == "right" for j in singles), of, at_least=0.88),
        _share(1, "right, or with others beside", (j.outcome in (*SEEN, "right beside others") for j in singles), of),
        _share(1, "exact set", (j.outcome == "right" for j in pairs), "pairs above the floor", at_least=0.80),
        _share(1, "right or in set, below the floor", (j.outcome in SEEN for j in faint), "singles and pairs below it"),
        # The floor is that of the analyser's own channels: an effect that none of them shows is below it, however large.
        _share(1, "right or in set, of any size", (j.outcome in SEEN for j in by_kind["single"]), "singles"),
    ]


def _nothing_missing(healthy: Sequence[Judgement]) -> list[Figure]:
    told = [j for j in healthy if j.report is not None]
    return [
        _share(2, "false alarm: an effect named", (bool(j.named) for j in told), "healthy cases", at_most=0.01),
        _share(2, "an unknown reported", (bool(j.report and j.report["unknown"]) for j in told), "healthy cases"),
        _share(2, "verdict no_mismatch", (bool(j.report and j.report["verdict"] == "no_mismatch") for j in told),
               "healthy cases"),
    ]


def _outside(outside: Sequence[Judgement]) -> list[Figure]:
    seen = [j for j in outside if j.above_floor]
    of = "cases from outside, above the floor"
    leading = [right for j in seen if (right := j.leading_variable_right()) is not None]
    return [
        _share(3, "said so", (bool(j.report and j.report["unknown"]) for j in seen), of, at_least=0.90),
        _share(3, "leading variable right", leading, "of those that say so", at_least=0.80),
        _share(3, f"a name with more than {CONFIDENT:g}", (any(n.probability > CONFIDENT for n in j.named) for j in seen),
               of, at_most=0.03),
        _share(3, "a name at all", (bool(j.named) for j in seen), of),
    ]


def _locating(judged: Sequence[Judgement]) -> list[Figure]:
    seen = [j for j in judged if j.kind in ("single", "masked", "pair") and j.above_floor]
    casters = [right for j in seen if (right := j.casters_right()) is not None]
    onsets, centres, overlaps, axes = [], [], [], []
    for j in seen:
        for effect, place in j.locations():
            if effect["onset"] is not None and place["intervals_s"]:
                onsets.append(abs(place["intervals_s"][0][0] - effect["onset"]))
            if effect["place"] is not None and place["place_m"]:
                centres.append(math.dist(*((p["x"], p["y"]) for p in (effect["place"], place["place_m"]))))
            common = [name for name in place["region"] if name in effect["region"]]
            if common:
                overlaps.append(float(np.mean([overlap(place["region"][n], effect["region"][n]) for n in common])))
            if all_effects()[effect["name"]].axes:
                axes.append(place["axis"] == (effect["axis"] or all_effects()[effect["name"]].axis))
    return [
        _share(4, "casters", casters, "cases with a location, above the floor", at_least=0.98),
        _share(4, "axis, of effects that can be at either", axes, "that are named"),
        _quantile(4, "onset, median error", onsets, "s", "effects that begin", at_most=0.1),
        _quantile(4, "patch centre, median error", centres, "m", "patches with a place", at_most=0.15),
        _quantile(4, "region, median overlap", overlaps, "1", "effects with a region", at_least=0.7),
    ]


def _numbers(judged: Sequence[Judgement], inside: Sequence[Judgement]) -> list[Figure]:
    errors: list[ParameterError] = [e for j in inside for e in j.parameter_errors()]
    names = [(n.probability, n.key in j.truth) for j in judged for n in j.named]
    calibration = calibration_error([p for p, _ in names], [right for _, right in names])
    covered = _share(5, "95 % intervals that hold the true number", (e.covered for e in errors), "numbers")
    inside_band = 0.90 <= covered.value <= 0.98 if errors else None
    return [
        _quantile(5, "error of a number, median", (e.error for e in errors), "%", "numbers above the floor", at_most=0.05),
        _quantile(5, "error of a number, 90th percentile", (e.error for e in errors), "%", "numbers", 0.9),
        dataclasses.replace(covered, wanted="90 to 98 %", met=inside_band),
        Figure(5, "calibration error of the probabilities", calibration, "1", f"{len(names)} names", "<= 0.05",
               calibration <= 0.05 if names else None),
    ]


def _proof(healthy: Sequence[Judgement], inside: Sequence[Judgement]) -> list[Figure]:
    told = [j for j in inside if j.report is not None]
    inverse, rollout = [j.inverse_gap() for j in told], [j.rollout_gap() for j in told]
    harms = [harm for j in healthy if (harm := j.harm()) is not None]
    return [
        _quantile(6, "gap closed, channels, median", inverse, "1", "cases", at_least=0.95),
        _quantile(6, "gap closed, channels, 10th percentile", inverse, "1", "cases", 0.1, at_least=0.80),
        _quantile(6, "gap closed, rollout, median", rollout, "1", "cases that it shows", at_least=0.95),
        _quantile(6, "gap closed, rollout, 10th percentile", rollout, "1", "cases that it shows", 0.1, at_least=0.80),
        _share(6, "harm above 1 %", (harm > 0.01 for harm in harms), "healthy cases", at_most=0.0),
        _quantile(6, "largest harm", harms, "%", "healthy cases", 1.0),
    ]


def _masked(masked: Sequence[Judgement]) -> list[Figure]:
    seen = [j for j in masked if j.above_floor]
    found = [
        _share(7, "right, or in a declared look-alike set", (j.outcome in SEEN for j in seen), "masked cases above the floor",
               at_least=0.85)
    ]
    for masking in sorted({str(j.answer["masking"]) for j in seen}):
        own = [j for j in seen if j.answer["masking"] == masking]
        found.append(_share(7, f"the same, {masking}", (j.outcome in SEEN for j in own), "masked cases above the floor"))
    return found


def _cost(judged: Sequence[Judgement]) -> list[Figure]:
    seconds = [j.usage.get("seconds") for j in judged]
    minutes = [
        60.0 * j.usage["seconds"] / sum(r["duration"] for r in j.answer["runs"]) for j in judged if "seconds" in j.usage
    ]
    return [
        _quantile(10, "time of a case, median", seconds, "s", "cases"),
        _quantile(10, "time of a case, largest", seconds, "s", "cases", 1.0),
        _quantile(10, "time per minute of recording, median", minutes, "s", "cases"),
        _quantile(10, "memory, largest", (j.usage["peak_bytes"] / 2**20 for j in judged if "peak_bytes" in j.usage), "MiB",
                  "cases", 1.0),
    ]


# -- tables -------------------------------------------------------------------------------------------------------


def tables(judged: Sequence[Judgement]) -> list[Table]:
    """Return the confusion matrix, the groups, the baselines and every miss."""
    inside = [j for j in judged if j.kind in ("single", "masked", "pair") and j.above_floor]
    found = [_confusion(judged)]
    for title, group in (
        ("kind", lambda j: j.kind), ("plant", lambda j: j.answer["plant"]), ("robot", lambda j: j.answer["robot"]),
        ("manoeuvre", lambda j: j.answer["runs"][0]["excitation"]), ("size", _size_class),
    ):
        found.append(_grouped(f"By {title}", inside, group))
    found += [_parameters(inside), _baselines(judged), _misses(judged)]
    return [table for table in found if table.rows]


def _size_class(j: Judgement) -> str:
    for limit in (5, 10, 20, 50):
        if j.size < limit:
            return f"below {limit} noise floors"
    return "above"


def _confusion(judged: Sequence[Judgement]) -> Table:
    """What is concealed against what is named, of cases with one effect or none; without its empty places."""
    rows = []
    cases = [j for j in judged if len(j.truth) <= 1 and j.report is not None]
    for name in sorted({_one(j) for j in cases}):
        own = [j for j in cases if _one(j) == name]
        outcomes = Counter(j.outcome for j in own)
        said: Counter[str] = Counter()
        for j in own:
            said.update({n.key[0] for n in j.named if n.key not in j.truth} or ([] if j.named else [j.outcome]))
        most = sorted(said.items(), key=lambda item: (-item[1], item[0]))
        rows.append((
            name, str(len(own)), str(sum(not j.above_floor for j in own)), str(outcomes["right"]),
            str(outcomes["in a look-alike set"]), ", ".join(f"{other} {count}" for other, count in most),
        ))
    return Table(
        "Concealed and named", ("concealed", "cases", "below floor", "right", "in a set", "named instead or besides"),
        tuple(rows),
    )


def _one(j: Judgement) -> str:
    return j.truth[0][0] if j.truth else "nothing"


def _grouped(title: str, judged: Sequence[Judgement], group: Callable[[Judgement], str]) -> Table:
    rows = []
    for name in sorted({group(j) for j in judged}):
        own = [j for j in judged if group(j) == name]
        counts = Counter(j.outcome for j in own)
        low, high = wilson(sum(counts[o] for o in SEEN), len(own))
        rows.append((name, str(len(own)), *(str(counts[o]) for o in OUTCOMES), f"{100 * low:.0f} to {100 * high:.0f} %"))
    return Table(
        f"{title} (effects above the floor)", (title.lower(), "cases", *OUTCOMES, "right or in set, 95 %"), tuple(rows)
    )


def _parameters(judged: Sequence[Judgement]) -> Table:
    errors = [e for j in judged for e in j.parameter_errors()]
    rows = []
    for key in sorted({(e.effect, e.parameter) for e in errors}):
        own = [e for e in errors if (e.effect, e.parameter) == key]
        rows.append((
            f"{key[0]}.{key[1]}", str(len(own)), f"{100 * float(np.median([e.error for e in own])):.1f} %",
            str(sum(e.covered for e in own)),
        ))
    return Table("Numbers", ("number", "found", "median error", "in their interval"), tuple(rows))


def _baselines(judged: Sequence[Judgement]) -> Table:
    """Other people's methods, and ours on the cases that they had; those of a method are the cases that it ran on."""
    by_name: dict[str, list[tuple[Judgement, Mapping[str, Any]]]] = {}
    for j in judged:
        for entry in (_as_baseline(j), *j.baselines) if j.baselines else ():
            by_name.setdefault(str(entry["name"]), []).append((j, entry))
    rows = []
    for name, entries in by_name.items():
        ran = [(j, e) for j, e in entries if e.get("inverse_nrmse")]
        hidden = [(set(j.truth), {_key(said) for said in e["named"]}) for j, e in ran if j.truth]
        healthy = [e for j, e in ran if j.kind == "none"]
        counts = [len(e["named"]) for _, e in ran]
        errors = [e["inverse_nrmse"] for _, e in ran]
        ratios = [after / before for before, after in errors]
        times = [e["seconds"] for _, e in ran if "seconds" in e]
        rows.append((
            name, f"{len(ran)} of {len(entries)}",
            _ratio(sum(truth == named for truth, named in hidden), len(hidden)),
            _ratio(sum(truth <= named for truth, named in hidden), len(hidden)),
            f"{np.median(counts):.0f} ({max(counts)})" if counts else "",
            _ratio(sum(bool(e["named"]) for e in healthy), len(healthy)),
            f"{np.median(ratios):.2f}" if ratios else "", _ratio(sum(ratio > 1.0 for ratio in ratios), len(ratios)),
            f"{np.median(times):.1f} s" if times else "",
        ))
    head = (
        "method", "ran", "these effects and no other", "these among others", "names, median (most)", "names on healthy cases",
        "held-out error left, median", "held-out error grew", "time, median",
    )  # fmt: skip
    return Table("Other methods on the same cases", head, tuple(rows))


def _as_baseline(j: Judgement) -> Mapping[str, Any]:
    """What the analyser says of a case, as other methods' results are kept."""
    if j.report is None:
        return {"name": "mismatch analyze", "named": [], "inverse_nrmse": None}
    fit = j.report["fit"]
    return {
        "name": "mismatch analyze", "named": ["/".join((n.key[0], "+".join(n.key[1]))) for n in j.named],
        "inverse_nrmse": fit and fit["holdout"]["inverse_nrmse"], **j.usage,
    }  # fmt: skip


def _key(named: str) -> tuple[str, frozenset[str]]:
    """An effect and its target, or whatever else a method has named."""
    name, _, target = named.partition("/")
    return name, frozenset(target.split("+"))


def _ratio(count: int, total: int) -> str:
    return f"{count} of {total}" if total else ""


def missed(j: Judgement) -> bool:
    """Whether a case is a miss: anything but what it should be."""
    if j.kind == "none":
        return j.outcome != "nothing named"
    if j.kind == "outside":
        return bool(j.named) or j.leading_variable_right() is not True
    return j.outcome not in SEEN


def _misses(judged: Sequence[Judgement]) -> Table:
    rows = tuple(
        (
            j.answer["case"], j.answer["masking"] or j.kind, j.answer["plant"], j.answer["robot"],
            j.answer["runs"][0]["excitation"], j.concealed, j.said,
        )
        for j in judged if missed(j)
    )
    return Table("Misses, all of them", ("case", "kind", "plant", "robot", "manoeuvre", "concealed", "said"), rows)


def _notes(judged: Sequence[Judgement]) -> list[str]:
    without = [j.answer["case"] for j in judged if j.report is None]
    faint = [e for j in judged for e in j.answer["effects"] if e["evidence"] < LEAST_EVIDENCE]
    notes = []
    if without:
        notes.append(f"{len(without)} cases have no report: {', '.join(without)}. An effect in them counts as missed.")
    if faint:
        notes.append(
            f"{len(faint)} effects are no larger than what re-tuning within tolerances explains to {LEAST_EVIDENCE:g} nats."
        )
    return notes
