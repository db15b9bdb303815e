"""The report: its JSON is the contract's, its page stands alone, its folder appears whole or not at all."""

import dataclasses
import json
import math
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pcw_sim_bridge.mismatch.analysis import _far_off
from pcw_sim_bridge.mismatch.errors import MismatchError
from pcw_sim_bridge.mismatch.findings.findings import (
    REFUSED,
    VERDICTS,
    ChannelFinding,
    ChannelProof,
    EffectFinding,
    Findings,
    FitFinding,
    InputFinding,
    LadderFinding,
    LocationFinding,
    ParameterFinding,
    Place,
    ResidualMap,
    RetunedFinding,
    RolloutProof,
    Trace,
    UnknownFinding,
)
from pcw_sim_bridge.mismatch.report import report, report_figures
from pcw_sim_bridge.mismatch.report.report import check_output, write_report
from pcw_sim_bridge.mismatch.report.report_figures import (
    MOST_TRACES,
    binned,
    envelope,
    telling,
    timeline,
    worst_window,
)
from pcw_sim_bridge.mismatch.report.report_maps import binned_rms, draw_maps

PATCHED = {
    "format": "pcw_robot/1",
    "name": "thesis",
    "chassis": {"mass": 74.0, "com": [0.0, 0.0, 0.25]},
    "physics": [
        {
            "name": "drive_coulomb_friction",
            "target": ["rear_left"],
            "parameters": {"coulomb": 0.412, "asymmetry": 0.0},
        },
        {"name": "ground_slope", "target": ["chassis"], "parameters": {"pitch": 0.0081}},
    ],
}


def make_trace(
    channel: str, unit: str, role: str, samples: int = 4000, rate: float = 120.0, size: float = 1.0
) -> Trace:
    """A drive with dry friction that the nominal model lacks: a sine of force, and a step at every reversal."""
    rng = np.random.default_rng(len(channel) + samples)
    clock = np.arange(samples) / rate
    speed = np.sin(0.9 * clock) + 0.6 * np.sin(2.3 * clock + 1.0)
    nominal = size * (1.8 * np.cos(0.9 * clock) + 2.4 * np.cos(2.3 * clock + 1.0))
    friction = 0.9 * size * np.tanh(speed / 0.05) * (1.0 + 0.7 * (clock > 0.6 * clock[-1]))
    measured = nominal + friction + 0.08 * size * rng.standard_normal(samples)
    return Trace(
        channel,
        unit,
        role,
        clock,
        measured,
        nominal,
        nominal + 0.98 * friction,
        "drive speed [rad/s]",
        8.0 * speed,
    )


def demo_findings(samples: int = 4000) -> Findings:
    """Everything a report can hold."""
    return Findings(
        subject="thesis, recorded 2 times",
        verdict="partly_explained",
        inputs=(
            InputFinding(
                "runs/figure_8",
                "9f2c" * 16,
                33.3,
                "fit",
                ("joint_states: 3 gaps, the longest 0.12 s at 14.20 s",),
            ),
            InputFinding("runs/chirp.mcap", "03ab" * 16, 61.0, "holdout", ()),
        ),
        channels=(
            ChannelFinding("chassis_force/x", "N", 6.21, 0.412, 3.2e-41, True),
            ChannelFinding("chassis_force/y", "N", 0.48, 0.431, 0.18, False),
            ChannelFinding("chassis_torque/z", "N m", 1.93, 0.087, 0.0, True),
            ChannelFinding("gyro", "rad/s", 0.00212, 0.00205, 0.47, False),
            ChannelFinding("accelerometer/x", "m/s^2", 0.0817, 0.0213, 4e-9, True),
        ),
        locations=(
            LocationFinding(
                ("chassis_force/x", "chassis_torque/z"),
                ("rear_left",),
                "drive",
                ((1.0, 6.5), (12.25, 19.75), *((20.0 + k, 20.5 + k) for k in range(9))),
                {"drive_speed": (0.4, 12.7), "steer_angle": (-3.1, 3.1)},
                Place(1.25, -0.5, 0.3),
            ),
            LocationFinding(("accelerometer/x",), (), "chassis", (), {}),
        ),
        effects=(
            EffectFinding(
                "drive_coulomb_friction",
                ("rear_left",),
                0.99962,
                {
                    "coulomb": ParameterFinding(0.41234, "N m", 0.4031, 0.4216),
                    "asymmetry": ParameterFinding(-0.00213, "N m", -0.0095, 0.0052),
                },
                "Coulomb friction of 0.412 N m in the drive of rear_left.",
                ("rolling_resistance", "drive_stribeck_friction"),
                "drive at several constant speeds and reverse often; shift a payload to load the wheels unevenly",
            ),
            EffectFinding(
                "ground_slope",
                ("chassis",),
                0.941,
                {"pitch": ParameterFinding(0.0081, "rad", 0.0074, 0.0088)},
                "The ground slopes by 8.1 mrad along x.",
                (),
                None,
            ),
        ),
        unknown=(
            UnknownFinding(
                "chassis_torque/z", ("steer_angle", "drive_speed"), "0.21 sin(2 steer_angle)", 0.62
            ),
        ),
        retuned=(
            RetunedFinding("chassis.mass", "kg", 74.0, 74.31, 74.02, 74.60, 0.74),
            RetunedFinding("front_left.wheel_radius", "m", 0.075, 0.07541, 0.07537, 0.07545, 7.5e-5),
            RetunedFinding("rear_right.steer_zero", "rad", 0.0, -0.0011, -0.0014, -0.0008, 0.002),
        ),
        fit=FitFinding(
            "runs/chirp.mcap",
            (0.673, 0.0596),
            {"pose/x": (0.412, 0.021), "pose/yaw": (0.013, 0.0151)},
            0.982,
            gap_closed_ci95=(0.97, 0.99),
            inverse_ci95=((0.64, 0.71), (0.057, 0.063)),
            inverse_floor=0.05,
            channels=(ChannelProof("chassis_force/x", 0.04, 0.71, 0.0451, (0.66, 0.75), (0.042, 0.047)),),
            rollouts=(RolloutProof("yaw", 2.0, 0.011, 0.013, 0.0151, (0.012, 0.014), (0.0148, 0.0153)),),
            rollout_gap_closed=0.91,
            harm=0.16,
            harm_at="yaw after 2 s",
        ),
        ladder=tuple(
            [
                LadderFinding("drive_coulomb_friction/rear_left", 1841.2, 422.0, "named"),
                LadderFinding("ground_slope/chassis", 61.4, 18.8, "named"),
                LadderFinding(
                    "drop drive_viscous_friction/rear_left", 0.9, -0.4, "below the threshold of 6.1"
                ),
            ]
            + [LadderFinding(f"add candidate_{k}", 12.0 / (k + 1), None, "tried") for k in range(14)]
        ),
        traces=(
            make_trace("chassis_force/x", "N", "fit", samples, size=4.0),
            make_trace("chassis_torque/z", "N m", "fit", samples, size=1.3),
            make_trace("chassis_force/x", "N", "holdout", samples, size=5.0),
        ),
        notes=(
            "Without a tracked pose, a common error of all wheel radii cannot be told from the gyro's scale.",
        ),
        seconds=4.21,
        residual_map=demo_map(samples),
        absent=(("imu/data", "faults of the sensor itself cannot be seen"),),
    )


def demo_map(samples: int) -> ResidualMap:
    """A robot on a figure of eight whose residual is large on one of the loops."""
    clock = np.arange(samples) / 120.0
    path = np.stack([2.0 * np.sin(0.4 * clock), np.sin(0.8 * clock)], axis=1)
    loud = 1.0 + 20.0 * (path[:, 0] > 1.0)
    return ResidualMap(
        loud, np.ones(samples), clock, {"speed": np.abs(np.cos(clock)), "steer_angle/rear_left": np.sin(clock)}, path
    )


def minimal_findings(verdict: str = "no_mismatch", **changes: Any) -> Findings:
    """Nothing found."""
    nothing = Findings(
        "axis",
        verdict,
        (InputFinding("a.csv", "0" * 64, 3.0, "fit", ()),),
        (),
        (),
        (),
        (),
        (),
        None,
        (),
        (),
        (),
        0.5,
    )
    return dataclasses.replace(nothing, **changes)


@pytest.mark.parametrize(
    ("other", "target", "said"),
    [
        ("payload_mass", "chassis", "a part of payload_mass"),
        ("payload_mass", "rear_left", "a part of payload_mass"),
        ("payload_mass", "front_right", "payload_mass"),
        ("ground_slope", "chassis", "payload_mass"),
    ],
)
def test_a_doubted_effect_may_be_a_part_of_one_that_is_felt_there(other: str, target: str, said: str) -> None:
    """A lag of one drive was said to be perhaps a part of a dead time of another."""
    doubted = EffectFinding("x", ("rear_left",), 0.5, {}, "It is x.", ("payload_mass",), None)
    beside = EffectFinding(other, (target,), 1.0, {}, "And more.", (), None)
    summary = "\n".join(minimal_findings("explained", effects=(doubted, beside)).summary())
    assert f"It is x. (It may as well be {said}.) (Probability 0.50.) And more.\n" in summary


@pytest.mark.parametrize(
    ("formula", "is_said"), [("gyro = -2 omega", True), ("gyro = " + "+ cos(omega) " * 12, False), (None, False)]
)
def test_a_formula_is_said_where_it_is_short(formula: str | None, is_said: bool) -> None:
    left = UnknownFinding("gyro", ("omega",), formula, 0.9)
    summary = "\n".join(minimal_findings("unexplained", unknown=(left,)).summary())
    assert "Unknown: gyro depends on omega" in summary
    assert (formula is not None and f"omega, {formula}." in summary) == is_said


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a report of `demo_findings`; not to be changed."""
    return write_report(demo_findings(), PATCHED, tmp_path_factory.mktemp("demo") / "out").parent


# -- report.json ------------------------------------------------------------------------------------------------------

NUMBER, TEXT, FLAG = "number", "text", "flag"
ERRORS = {
    "floor": NUMBER, "before": NUMBER, "after": NUMBER, "before_ci95": (NUMBER, NUMBER), "after_ci95": (NUMBER, NUMBER),
}  # fmt: skip
CONTRACT = {
    "format": TEXT,
    "verdict": TEXT,
    "seconds": NUMBER,
    "inputs": [{"path": TEXT, "sha256": TEXT, "duration_s": NUMBER, "role": TEXT, "warnings": [TEXT]}],
    "channels": [
        {"name": TEXT, "unit": TEXT, "rms": NUMBER, "noise_floor": NUMBER, "p_value": NUMBER, "flagged": FLAG}
    ],
    "locations": [
        {
            "channels": [TEXT],
            "casters": [TEXT],
            "axis": TEXT,
            "intervals_s": [(NUMBER, NUMBER)],
            "region": {"*": (NUMBER, NUMBER)},
            "place_m": {"?": {"x": NUMBER, "y": NUMBER, "radius": NUMBER}},
        }
    ],
    "effects": [
        {
            "name": TEXT,
            "target": [TEXT],
            "probability": NUMBER,
            "parameters": {"*": {"value": NUMBER, "unit": TEXT, "ci95": (NUMBER, NUMBER)}},
            "statement": TEXT,
            "ambiguous_with": [TEXT],
            "experiment": {"?": TEXT},
        }
    ],
    "unknown": [
        {"channel": TEXT, "depends_on": [TEXT], "expression": {"?": TEXT}, "share_explained": NUMBER}
    ],
    # Beside what the contract has, all that is said of it more closely.
    "fit": {
        "holdout": {
            "source": TEXT,
            "inverse_nrmse": (NUMBER, NUMBER),
            "inverse_ci95": {"?": ((NUMBER, NUMBER), (NUMBER, NUMBER))},
            "inverse_floor": {"?": NUMBER},
            "rollout": {"*": (NUMBER, NUMBER)},
            "gap_closed": NUMBER,
            "gap_closed_ci95": {"?": (NUMBER, NUMBER)},
            "rollout_gap_closed": {"?": NUMBER},
            "harm": NUMBER,
            "harm_at": {"?": TEXT},
            "per_channel": [{"name": TEXT, "share": NUMBER, **ERRORS}],
            "horizons": [{"signal": TEXT, "horizon_s": NUMBER, **ERRORS}],
        }
    },
}
ADDITIONS = {"retuned", "ladder", "notes", "absent", "generated_effects"}


def check_structure(value: Any, wanted: Any, where: str = "report") -> None:
    """Compare with CONTRACT: [x] is a list of x, (x, y) a pair, {"*": x} any keys, {"?": x} x or null."""
    if wanted == NUMBER:
        assert isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value), where
    elif wanted == TEXT:
        assert isinstance(value, str), where
    elif wanted == FLAG:
        assert isinstance(value, bool), where
    elif isinstance(wanted, tuple):
        assert isinstance(value, list) and len(value) == len(wanted), where
        for k, (item, kind) in enumerate(zip(value, wanted, strict=True)):
            check_structure(item, kind, f"{where}[{k}]")
    elif isinstance(wanted, list):
        assert isinstance(value, list), where
        for k, item in enumerate(value):
            check_structure(item, wanted[0], f"{where}[{k}]")
    elif "*" in wanted:
        assert isinstance(value, dict), where
        for key, item in value.items():
            check_structure(item, wanted["*"], f"{where}.{key}")
    elif "?" in wanted:
        if value is not None:
            check_structure(value, wanted["?"], where)
    else:
        assert isinstance(value, dict) and set(value) == set(wanted), f"{where}: {sorted(value)}"
        for key, kind in wanted.items():
            check_structure(value[key], kind, f"{where}.{key}")


def read_strictly(path: Path) -> dict[str, Any]:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)
    return content


def test_json_has_the_keys_and_types_of_the_contract(demo: Path) -> None:
    content = read_strictly(demo / "report.json")
    assert set(content) - ADDITIONS == set(CONTRACT)
    assert set(content) <= set(CONTRACT) | ADDITIONS
    check_structure({key: content[key] for key in CONTRACT}, CONTRACT)
    assert content["format"] == "pcw_mismatch/1"
    assert content["verdict"] in VERDICTS
    assert content["effects"][0]["parameters"]["coulomb"]["ci95"] == [0.4031, 0.4216]
    assert content["locations"][0]["intervals_s"][1] == [12.25, 19.75]


def test_json_of_nothing_held_out_has_an_empty_fit(tmp_path: Path) -> None:
    write_report(minimal_findings(), PATCHED, tmp_path / "out")
    assert read_strictly(tmp_path / "out" / "report.json")["fit"] == {}


def test_numpy_numbers_are_written_as_numbers(tmp_path: Path) -> None:
    channel = ChannelFinding(
        "gyro", "rad/s", np.float64(0.5), np.float32(0.25), np.float64(0.0), np.bool_(True)
    )  # type: ignore[arg-type]
    patched = {"mass": np.float64(2.5), "com": (np.float64(0.0), 1), "table": np.eye(2)}
    write_report(minimal_findings(channels=(channel,)), patched, tmp_path / "out")
    content = read_strictly(tmp_path / "out" / "report.json")
    check_structure(content["channels"], CONTRACT["channels"])
    written = yaml.safe_load((tmp_path / "out" / "robot_patched.yaml").read_text())
    assert written == {"mass": 2.5, "com": [0.0, 1], "table": [[1.0, 0.0], [0.0, 1.0]]}


def test_nan_becomes_null_only_where_null_is_allowed(tmp_path: Path) -> None:
    ladder = (LadderFinding("a", 1.0, math.nan, "tried"),)
    write_report(minimal_findings(ladder=ladder), PATCHED, tmp_path / "out")
    assert read_strictly(tmp_path / "out" / "report.json")["ladder"][0]["held_out_gain"] is None

    channel = ChannelFinding("gyro", "rad/s", math.nan, 0.25, 0.0, True)
    with pytest.raises(MismatchError, match=r"channels\[\]\.rms: nan is not allowed"):
        write_report(minimal_findings(channels=(channel,)), PATCHED, tmp_path / "other")
    with pytest.raises(MismatchError, match=r"chassis\.mass: inf is not allowed"):
        write_report(minimal_findings(), {"chassis": {"mass": math.inf}}, tmp_path / "other")
    assert os.listdir(tmp_path) == ["out"]


def test_patched_description_keeps_order_and_content(demo: Path) -> None:
    text = (demo / "robot_patched.yaml").read_text()
    assert yaml.safe_load(text) == PATCHED
    assert list(yaml.safe_load(text)) == list(PATCHED)


def test_without_a_patched_description_there_is_no_such_file(tmp_path: Path) -> None:
    page = write_report(minimal_findings(), None, tmp_path / "out")
    assert sorted(os.listdir(tmp_path / "out")) == ["figures", "report.html", "report.json"]
    assert "robot_patched.yaml" not in page.read_text(encoding="utf-8")


# -- report.html ------------------------------------------------------------------------------------------------------


def test_page_refers_to_nothing_outside_itself(demo: Path) -> None:
    page = (demo / "report.html").read_text(encoding="utf-8")
    for outside in ("http:", "https:", "//cdn", "url(", "@import", "<script", "<iframe", "<object"):
        assert outside not in page, outside
    sources = [
        part.split('"')[0] for attribute in (' src="', ' href="') for part in page.split(attribute)[1:]
    ]
    assert len(sources) > 5
    assert all(source.startswith(("data:", "#")) for source in sources)


def test_every_figure_of_the_page_is_a_file_too(demo: Path) -> None:
    page = (demo / "report.html").read_text(encoding="utf-8")
    files = sorted((demo / "figures").iterdir())
    assert len(files) == 1 + 3 * len(demo_findings().traces)
    assert all(file.read_bytes().startswith(b"\x89PNG") for file in files)
    assert page.count("<img") == len(files)


def test_page_says_what_was_found_before_any_table(demo: Path) -> None:
    page = (demo / "report.html").read_text(encoding="utf-8")
    body = page[page.index("<body") :]
    opening = body[: body.index("<table")]
    for said in (
        "Partly explained.",
        "Coulomb friction of 0.412 N m in the drive of rear_left.",
        "rolling resistance or drive Stribeck friction",
        "shift a payload to load the wheels unevenly.",
        "chassis_torque/z depends on steer angle and drive speed",
        "0.673 → 0.0596",
        "98 %",
    ):
        assert said in opening, said
    order = [
        body.index(f'<section id="{name}"')
        for name in (
            "effects",
            "fit",
            "channels",
            "locations",
            "figures",
            "ladder",
            "retuned",
            "inputs",
            "notes",
            "reading",
        )
    ]
    assert order == sorted(order)


def test_page_shows_numbers_with_the_digits_they_have(demo: Path) -> None:
    page = (demo / "report.html").read_text(encoding="utf-8")
    for shown in (
        '<td class="num">0.4123</td><td class="num">[0.4031, 0.4216]</td>',
        "[−0.0095, 0.0052]",
        "&gt; 99.9 %",
        "N·m",
        "m/s²",
        "3 × 10⁻⁴¹",
        "&lt; 10⁻³⁰⁰",
        "beyond 3 tolerances",
        "worse",
    ):
        assert shown in page, shown
    assert page.count('<span class="tag part">beyond 3 tolerances</span>') == 1, (
        "only the radius moved by more than 3"
    )
    assert page.count('<span class="tag bad">worse</span>') == 2, "only the yaw got worse, in both tables"


@pytest.mark.parametrize("verdict", VERDICTS)
def test_every_verdict_renders(tmp_path: Path, verdict: str) -> None:
    page = write_report(minimal_findings(verdict), PATCHED, tmp_path / "out").read_text(encoding="utf-8")
    findings = minimal_findings(verdict)
    assert (findings.nothing_missing()[1:] if verdict == "no_mismatch" else report.HEADLINES[verdict]) in page
    assert 'id="effects"' not in page
    assert "nothing was held out" in page


def test_what_held_out_data_refuse_is_in_the_verdict() -> None:
    """7000 nats for a play, which another recording contradicted: "nothing is missing", and no word of it but in the notes."""
    refused = LadderFinding("drop gear_backlash/drive of left", -167.0, -167.0, f"{REFUSED}: the error is no smaller with it")
    verdict = dataclasses.replace(minimal_findings("no_mismatch"), ladder=(refused,)).nothing_missing()
    assert verdict.startswith("no effect is missing") and "gear_backlash/drive of left" in verdict
    assert "nothing is missing" not in verdict


def test_numbers_that_no_healthy_robot_has_are_in_the_verdict(tmp_path: Path) -> None:
    """A torque constant thirteen tolerances off was said to be "within noise and tolerances"."""
    strained = dataclasses.replace(demo_findings().retuned[0], value=68.0, healthy=2.22)
    quiet = tuple(dataclasses.replace(channel, flagged=False) for channel in demo_findings().channels)
    nothing = {"verdict": "no_mismatch", "effects": (), "locations": (), "unknown": (), "channels": quiet}
    findings = dataclasses.replace(demo_findings(), **nothing, retuned=(strained,))
    text = "no effect is missing, but the description is off by more than its tolerances in chassis.mass (8.1 tolerances)"
    assert findings.summary()[1] == f"Verdict:   {text}"
    assert text[0].upper() + text[1:] in write_report(findings, None, tmp_path / "report").read_text(encoding="utf-8")
    healthy = dataclasses.replace(findings, retuned=(dataclasses.replace(strained, value=75.0),))
    assert "within noise and tolerances" in healthy.summary()[1]


@pytest.mark.parametrize(("count", "more"), [(1, ""), (3, ""), (5, " and 2 more channels")])
def test_what_noise_does_not_explain_and_no_name_either_is_in_the_verdict(count: int, more: str) -> None:
    """All five robots of eight draws of the challenge with something missing that was too little to name had flagged channels,
    and 92 of 96 healthy ones had none: "nothing is missing: what differs is within noise and tolerances".
    """
    channels = tuple(ChannelFinding(f"channel_{k}", "N", 1.0, 0.1, 1e-6, k < count) for k in range(6))
    findings = minimal_findings("no_mismatch", channels=channels)
    told = ", ".join(f"channel_{k}" for k in range(min(count, 3)))
    assert findings.nothing_missing().endswith(f", but noise and tolerances alone do not explain {told}{more}")
    assert findings.nothing_missing().startswith("no effect stands out")
    quiet = tuple(dataclasses.replace(channel, flagged=False) for channel in channels)
    assert "nothing is missing" in dataclasses.replace(findings, channels=quiet).nothing_missing()


def test_unknown_verdict_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MismatchError, match="'perhaps' is not allowed; one of no_mismatch"):
        write_report(minimal_findings("perhaps"), PATCHED, tmp_path / "out")


def test_leftover_alone_renders(tmp_path: Path) -> None:
    findings = minimal_findings("unexplained", unknown=(UnknownFinding("axis_force", (), None, 0.4),))
    page = write_report(findings, PATCHED, tmp_path / "out").read_text(encoding="utf-8")
    assert "axis_force keeps a leftover that depends on nothing recorded." in page


def test_text_from_files_is_escaped(tmp_path: Path) -> None:
    evil = "<script>alert('$x^{')</script>"
    findings = demo_findings()
    effect = dataclasses.replace(findings.effects[0], target=(evil,), statement=f"Friction in {evil}.")
    place = dataclasses.replace(findings.locations[0], casters=(evil,))
    trace = dataclasses.replace(findings.traces[0], channel=evil, variable_name=evil, unit=evil)
    patched = {"physics": [{"name": evil}]}
    changed = dataclasses.replace(
        findings,
        subject=evil,
        effects=(effect,),
        locations=(place,),
        traces=(trace,),
        notes=(evil,),
        inputs=(InputFinding(evil, evil, 1.0, "fit", (evil,)),),
    )
    page = write_report(changed, patched, tmp_path / "out").read_text(encoding="utf-8")
    assert "<script" not in page
    assert page.count("&lt;script&gt;") >= 10


def test_incomplete_traces_are_drawn(tmp_path: Path) -> None:
    """Masked samples, a recording appended to another (the clock jumps back), stamps of a calendar, nothing at all."""
    whole = make_trace("gyro", "rad/s", "fit")
    masked = np.where(np.arange(4000) % 700 < 300, np.nan, whole.measured)
    again = np.concatenate([whole.time[:2000], whole.time[:2000]])
    traces = (
        dataclasses.replace(whole, measured=masked),
        dataclasses.replace(whole, time=again),
        dataclasses.replace(whole, time=whole.time + 1.7e9),
        dataclasses.replace(whole, measured=np.full(4000, np.nan)),
        dataclasses.replace(whole, variable=np.zeros(4000)),
        dataclasses.replace(
            whole, **{name: np.empty(0) for name in ("time", "measured", "before", "after", "variable")}
        ),
        dataclasses.replace(
            whole,
            **{
                name: getattr(whole, name)[:1] for name in ("time", "measured", "before", "after", "variable")
            },
        ),
    )
    write_report(minimal_findings(traces=traces), PATCHED, tmp_path / "out")
    assert len(os.listdir(tmp_path / "out" / "figures")) == 3 + 3 + 3 + 3 + 3 + 2 + 2


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (report.number(95.108), "95.1"),
        (report.number(-3.1648), "−3.16"),
        (report.number(0.0), "0"),
        (report.number(99.96), "100"),
        (report.number(24841.0), "24841"),
        (report.number(4.2e-5, 2), "4.2 × 10⁻⁵"),
        (report.number(None), "–"),
        (report.number(math.nan), "–"),
        (report.number(-math.inf), "−∞"),
        (report.with_interval(203.5034, 202.91, 204.09), ("203.50", "[202.91, 204.09]")),
        (report.with_interval(95.1, 60.0, 130.0), ("95", "[60, 130]")),
        (report.with_interval(4.2e-5, 3.9e-5, 4.5e-5), ("42.0 × 10⁻⁶", "[39.0, 45.0] × 10⁻⁶")),
        (report.with_interval(1.0, 1.0, 1.0), ("1.000", "[1.000, 1.000]")),
        (report.with_interval(1.0, -math.inf, math.inf), ("1.000", "[−∞, ∞]")),
        (report.probability(0.9999), "> 99.9 %"),
        (report.probability(0.97), "97.0 %"),
        (report.probability(0.5), "50 %"),
        (report.change(0.673, 0.0596), "−91 %"),
        (report.change(0.013, 0.0151), "+16 %"),
        (report.change(0.0, 0.0), "–"),
        (report.change(1.0, 1.0), "0.0 %"),
        (report.nats(-0.02), "0.0"),
        (report.words("drive_stribeck_friction"), "drive Stribeck friction"),
        (report.percent(-0.0), "0.0 %"),
        (report.as_written(0.0750), "0.075"),
        (report.seconds(24.841), "24.8 s"),
        (report.seconds(200.0), "3 min 20 s"),
        (report.seconds(7300.0), "2 h 1 min"),
        (report.listed(["a", "b", "c"], "or"), "a, b or c"),
        (report.listed([]), ""),
        (report.pretty_unit("N m s/rad"), "N·m·s/rad"),
        (report.pretty_unit("kg m^2"), "kg·m²"),
        (report.pretty_unit("1"), ""),
    ],
)
def test_numbers_in_words(text: object, shown: object) -> None:
    assert text == shown


# -- figures ------------------------------------------------------------------------------------------------------------


def test_envelope_keeps_a_spike_of_one_sample() -> None:
    clock = np.arange(20000) / 500.0
    values = np.sin(clock)
    values[12345] = 40.0
    x, y = envelope(timeline(clock), values)
    assert len(x) < 2500
    assert np.nanmax(y) == 40.0
    assert abs(x[np.nanargmax(y)] - clock[12345]) < 0.1


def test_timeline_cuts_pauses_and_backward_jumps() -> None:
    clock = np.concatenate([np.arange(100) * 0.01, 500.0 + np.arange(100) * 0.01, np.arange(100) * 0.01])
    line = timeline(clock)
    assert line.starts == (0, 100, 200)
    assert line.cut
    assert np.all(np.diff(line.shown) > 0.0)
    assert line.shown[-1] < 3.2
    steady = timeline(clock[:100])
    assert not steady.cut
    np.testing.assert_allclose(steady.shown, clock[:100], atol=1e-12)


def test_close_up_is_where_the_nominal_model_is_furthest_off() -> None:
    clock = np.arange(6000) / 100.0
    residual = np.where((clock > 31.0) & (clock < 35.0), 1.0, 0.1)
    window = worst_window(clock, residual)
    assert window is not None
    assert window[0] <= 31.0 and window[1] >= 35.0 and window[1] - window[0] == pytest.approx(5.0)
    assert worst_window(clock[:600], residual[:600]) is None, "6 s need no close-up of 5 s"


def test_bin_means_follow_the_dependence() -> None:
    rng = np.random.default_rng(5)
    speed = rng.uniform(-2.0, 2.0, 20000)
    rows = binned(speed, np.sign(speed) + 0.1 * rng.standard_normal(20000))
    np.testing.assert_allclose(rows[:, 1], np.sign(rows[:, 0]), atol=0.02)
    np.testing.assert_allclose(rows[:, 3] - rows[:, 2], 2.0 * 1.2816 * 0.1, rtol=0.12)


def test_of_many_channels_those_are_drawn_that_the_patch_changes_most() -> None:
    """Both roles of a channel together, so that fitted and held out can be compared."""
    quiet = [make_trace(f"quiet/{k}", "N", role) for k in range(9) for role in ("fit", "holdout")]
    quiet = [dataclasses.replace(trace, after=trace.before) for trace in quiet]
    loud = [make_trace("loud", "N", role) for role in ("fit", "holdout")]
    chosen = telling([*quiet, *loud])
    assert [(trace.channel, trace.role) for trace in chosen[:2]] == [("loud", "fit"), ("loud", "holdout")]
    assert len(chosen) <= MOST_TRACES


def test_bins_of_a_map_hold_the_power_that_is_there() -> None:
    """A residual that grows with the variable; a sample that could not be judged counts nowhere."""
    values = np.linspace(0.0, 2.0, 4000)
    side = 1.0 + values
    side[1000] = np.nan
    centre, level = binned_rms(values, side)
    np.testing.assert_allclose(level, 1.0 + centre, rtol=1e-3)


def test_map_of_nothing_that_could_be_judged_is_drawn() -> None:
    """All of it at a standstill; and a bench has no floor."""
    nothing = np.full(50, np.nan)
    path = np.zeros((50, 2))
    drawn = [draw_maps(ResidualMap(nothing, nothing, np.arange(50.0), {}, on_floor)) for on_floor in (path, None)]
    assert drawn[0].height > drawn[1].height


def test_long_traces_are_drawn_with_as_many_points_as_short_ones(tmp_path: Path) -> None:
    """What is drawn, and with it the time and the size of the page, does not grow with the recording."""
    sizes = []
    for samples in (5000, 20000):
        traces = tuple(make_trace(f"channel_{k}", "N", "fit", samples, 500.0) for k in range(6))
        write_report(dataclasses.replace(demo_findings(), traces=traces), PATCHED, tmp_path / str(samples))
        figures = sorted((tmp_path / str(samples) / "figures").iterdir())
        sizes.append({figure.name: figure.stat().st_size for figure in figures})
    assert (tmp_path / "20000" / "report.html").stat().st_size < 5e6
    assert sizes[0].keys() == sizes[1].keys()
    for name, size in sizes[1].items():
        assert size < 1.3 * sizes[0][name], name


# -- the folder -----------------------------------------------------------------------------------------------------------


def contents(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def test_empty_folder_is_used_and_parents_are_made(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert write_report(minimal_findings(), PATCHED, tmp_path / "empty") == tmp_path / "empty" / "report.html"
    write_report(minimal_findings(), PATCHED, tmp_path / "a" / "b" / "c")
    assert sorted(os.listdir(tmp_path / "a" / "b" / "c")) == [
        "figures",
        "report.html",
        "report.json",
        "robot_patched.yaml",
    ]
    assert os.listdir(tmp_path / "a" / "b") == ["c"]


def test_check_leaves_no_trace(tmp_path: Path) -> None:
    check_output(tmp_path / "a" / "b")
    assert os.listdir(tmp_path) == []


def test_folder_with_other_things_is_refused_even_with_force(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("years of work")
    for force in (False, True):
        with pytest.raises(MismatchError, match=r"out: the folder is not empty \(thesis.txt\)"):
            write_report(minimal_findings(), PATCHED, out, force)
    (out / "thesis.txt").unlink()
    write_report(minimal_findings(), PATCHED, out)
    (out / "figures" / "mine.blend").write_text("not ours")
    with pytest.raises(MismatchError, match="more than an earlier report"):
        write_report(minimal_findings(), PATCHED, out, force=True)
    assert (out / "figures" / "mine.blend").read_text() == "not ours"


def test_earlier_report_is_replaced_only_with_force(tmp_path: Path) -> None:
    out = tmp_path / "out"
    write_report(minimal_findings(traces=(make_trace("gyro", "rad/s", "fit"),)), PATCHED, out)
    with pytest.raises(
        MismatchError, match="out: the folder holds an earlier report; replace it with --force"
    ):
        check_output(out)
    write_report(minimal_findings(), None, out, force=True)
    assert contents(out) == ["figures", "report.html", "report.json"], "nothing of the earlier report is left"
    assert os.listdir(tmp_path) == ["out"]


def test_file_in_the_way_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(MismatchError, match="file: is a file; a folder is wanted"):
        check_output(tmp_path / "file")
    with pytest.raises(MismatchError, match="--out .*below: "):
        check_output(tmp_path / "file" / "below")
    with pytest.raises(MismatchError, match="cannot be written: File name too long"):
        check_output(tmp_path / ("x" * 300))
    with pytest.raises(MismatchError, match="--out /proc/nowhere: cannot be written"):
        check_output(Path("/proc/nowhere"))


def test_link_to_a_folder_stays_a_link(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    write_report(minimal_findings(), PATCHED, tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "disk" / "report.html").exists()


@pytest.mark.parametrize("interruption", [RuntimeError("in the middle"), KeyboardInterrupt()])
def test_interrupted_run_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, interruption: BaseException
) -> None:
    drawn = []

    def draw_two(*arguments: Any, **options: Any) -> Any:
        if len(drawn) == 2:
            raise interruption
        drawn.append(original(*arguments, **options))
        return drawn[-1]

    original = report_figures.draw_trace
    monkeypatch.setattr(report_figures, "draw_trace", draw_two)
    with pytest.raises(type(interruption)):
        write_report(demo_findings(), PATCHED, tmp_path / "a" / "out")
    assert len(drawn) == 2
    assert os.listdir(tmp_path) == []


def test_interrupted_replacement_keeps_the_earlier_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    write_report(demo_findings(), PATCHED, out)
    earlier = {path: (out / path).read_bytes() for path in contents(out) if (out / path).is_file()}

    def fail(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(report, "report_html", fail)
        with pytest.raises(KeyboardInterrupt):
            write_report(minimal_findings(), None, out, force=True)
    assert {path: (out / path).read_bytes() for path in earlier} == earlier

    renamed = Path.rename

    def fail_to_move_in(self: Path, target: Path) -> Path:
        if (
            self.name.endswith(".partial")
            and target == out
            and (self / "report.html").read_bytes() != earlier["report.html"]
        ):
            raise OSError(28, "No space left on device")
        return renamed(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", fail_to_move_in)
        with pytest.raises(MismatchError, match="cannot be written: No space left on device"):
            write_report(minimal_findings(), None, out, force=True)
    assert {path: (out / path).read_bytes() for path in earlier} == earlier
    assert os.listdir(tmp_path) == ["out"]


def test_checking_imports_neither_ros_nor_the_drawing_library() -> None:
    code = (
        "import sys; sys.modules['rclpy'] = None\n"
        "from pathlib import Path\n"
        "from pcw_sim_bridge.mismatch.report.report import check_output\n"
        "check_output(Path('never_made'))\n"
        "assert 'matplotlib' not in sys.modules\n"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, timeout=60)


# -- in a browser ---------------------------------------------------------------------------------------------------------


def open_in_chromium(page: Path, folder: Path) -> tuple[str, str, list[dict[str, Any]]]:
    """Open a page headless; returns its DOM, what the browser logged and what the page requested from a network."""
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed, so the page is not opened in a browser")
    network = folder / "network.json"
    done = subprocess.run(
        [
            chromium,
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-quic",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            f"--user-data-dir={folder / 'profile'}",
            "--enable-logging=stderr",
            "--v=0",
            f"--log-net-log={network}",
            "--host-resolver-rules=MAP * ~NOTFOUND",
            "--virtual-time-budget=3000",
            "--dump-dom",
            page.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    log = json.loads(network.read_text())
    begun = log["constants"]["logEventTypes"]["URL_REQUEST_START_JOB"]
    started = [
        event["params"]
        for event in log["events"]
        if event["type"] == begun and "url" in event.get("params", {})
    ]
    # The browser's own (its clock, its updates) do not come from an origin; those of a file come from the origin "null".
    requests = [
        r
        for r in started
        if r.get("initiator") != "not an origin" and not r["url"].startswith(("data:", "file:"))
    ]
    return done.stdout, done.stderr, requests


def test_browser_shows_the_page_without_console_message_or_request(demo: Path, tmp_path: Path) -> None:
    page = demo / "report.html"
    dom, log, requests = open_in_chromium(page, tmp_path)
    assert "Coulomb friction of 0.412 N m in the drive of rear_left." in dom
    assert dom.count("<img") == 10
    assert [line for line in log.splitlines() if "CONSOLE" in line] == []
    assert [request["url"] for request in requests] == []


def test_browser_test_can_fail(tmp_path: Path) -> None:
    """A page that complains and fetches is seen to do both."""
    page = tmp_path / "bad.html"
    page.write_text(
        "<html><body><img src='http://127.0.0.1:9/x.png'><script>console.error('complaint')</script></body></html>"
    )
    _, log, requests = open_in_chromium(page, tmp_path)
    assert [line for line in log.splitlines() if "CONSOLE" in line and "complaint" in line]
    assert [r["url"] for r in requests if r["url"].startswith("http://127.0.0.1:9/")]


@pytest.mark.parametrize(
    ("name", "says"), [("chassis.mass", "check it or its tolerance"), ("contact.mu_p", "only if the curve")]
)
def test_what_a_number_far_off_means_is_said(name: str, says: str) -> None:
    """Friction is judged where wheels use little of it: that of healthy robots was to be "checked" as a mass is."""
    assert says in _far_off(RetunedFinding(name, "1", 1.0, 0.6, 0.5, 0.7, 0.1))
