"""The score of a challenge, on answers and reports whose figures can be counted by hand."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from pcw_description import load_robot
from pcw_description.robot_file import robot_to_mapping
from pcw_sim_bridge.mismatch.__main__ import main
from pcw_sim_bridge.mismatch.challenge.judgement import Judgement
from pcw_sim_bridge.mismatch.challenge.score import (
    CaseSet,
    Figure,
    calibration_error,
    figures,
    missed,
    overlap,
    score,
    wilson,
)
from pcw_sim_bridge.mismatch.challenge.score_page import page, text
from pcw_sim_bridge.mismatch.challenge.sealed_answers import HASH_FILE, seal
from pcw_sim_bridge.mismatch.errors import MismatchError

ROBOT = robot_to_mapping(load_robot("thesis"))
RUN = {"path": "recordings/run_1", "excitation": "chirps", "duration": 30.0, "seed": 1, "active": True}
FRICTION = {"coulomb": 0.5, "asymmetry": 0.0, "smoothing_speed": 0.05}


def concealed(name: str = "drive_coulomb_friction", target: str = "front_left", **changes: Any) -> dict[str, Any]:
    return {
        "name": name, "target": target.split("+"), "axis": None, "parameters": FRICTION, "outside": False, "size": 9.0,
        "channel": "chassis_force/x", "evidence": 100.0, "region": {"speed": [0.0, 0.4]}, "onset": None, "place": None,
        **changes,
    }  # fmt: skip


def answer(kind: str, *effects: dict[str, Any], **changes: Any) -> dict[str, Any]:
    return {
        "case": "case_0001", "kind": kind, "masking": None, "plant": "reduced", "controller": "computed_torque",
        "robot": "thesis", "noise": 1.0, "effects": list(effects), "deviations": {}, "retuned": {}, "nominal": ROBOT,
        "true": ROBOT, "runs": [RUN], **changes,
    }  # fmt: skip


def named(name: str = "drive_coulomb_friction", target: str = "front_left", **changes: Any) -> dict[str, Any]:
    parameters = {"coulomb": {"value": 0.51, "unit": "N m", "ci95": [0.48, 0.54]}}
    return {
        "name": name, "target": target.split("+"), "probability": 0.99, "parameters": parameters, "statement": "",
        "ambiguous_with": [], "experiment": None, **changes,
    }  # fmt: skip


def report(*effects: dict[str, Any], unknown: tuple[dict[str, Any], ...] = (), **changes: Any) -> dict[str, Any]:
    places = [
        {"channels": [], "casters": e["target"], "axis": "drive", "intervals_s": [[4.0, 9.0]], "region": {"speed": [0.1, 0.4]},
         "place_m": None}
        for e in effects
    ]  # fmt: skip
    proof = {"source": "", "inverse_nrmse": [0.5, 0.1], "rollout": {"v_x": [0.4, 0.2]}, "gap_closed": 0.98,
             "rollout_gap_closed": 0.9, "harm": 0.0}
    return {
        "verdict": "explained" if effects else "no_mismatch", "effects": list(effects), "locations": places,
        "unknown": list(unknown), "fit": {"holdout": proof}, **changes,
    }  # fmt: skip


def leftover(variable: str, share: float = 0.5) -> dict[str, Any]:
    return {"channel": "chassis_force/x", "depends_on": [variable], "expression": None, "share_explained": share}


def judged(case: dict[str, Any], said: dict[str, Any] | None) -> Judgement:
    return Judgement(case, said, {"seconds": 3.0, "cpu_seconds": 2.0, "peak_bytes": 2**28})


def figure(cases: list[Judgement], section: int, label: str) -> Figure:
    [found] = [f for f in figures(cases) if f.section == section and f.label == label]
    return found


SINGLE = answer("single", concealed())


@pytest.mark.parametrize(
    ("said", "outcome"),
    [
        (report(named()), "right"),
        (report(named("rolling_resistance", ambiguous_with=["drive_coulomb_friction"])), "in a look-alike set"),
        (report(named(target="rear_left", ambiguous_with=["drive_coulomb_friction/front_left"])), "in a look-alike set"),
        (report(named("rolling_resistance", "rear_left", ambiguous_with=["drive_coulomb_friction"])), "wrong name"),
        (report(named(), named("payload_mass", "chassis")), "right beside others"),
        (report(named(target="rear_left")), "wrong name"),
        (report(unknown=(leftover("time"),)), "unknown only"),
        (report(), "nothing named"),
        (None, "no report"),
    ],
)
def test_outcomes_of_a_single(said: dict[str, Any] | None, outcome: str) -> None:
    assert judged(SINGLE, said).outcome == outcome
    assert missed(judged(SINGLE, said)) == (outcome not in ("right", "in a look-alike set"))


def test_a_pair_is_right_only_as_a_whole() -> None:
    pair = answer("pair", concealed(), concealed("payload_mass", "chassis", parameters={"mass": 9.0}))
    assert judged(pair, report(named("payload_mass", "chassis"), named())).outcome == "right"
    assert judged(pair, report(named())).outcome == "wrong name"
    alike = named("torque_constant_error", "front_left", ambiguous_with=["payload_mass"])
    assert judged(pair, report(alike, named())).outcome == "in a look-alike set"


def test_one_effect_told_caster_by_caster_is_one_effect() -> None:
    both = answer("single", concealed(target="front_left+front_right"))
    parts = report(named(), named(target="front_right"))
    assert judged(both, parts).outcome == "right"
    assert judged(both, report(named())).outcome == "wrong name"
    assert judged(both, parts).parameter_errors() == []


def test_what_both_axes_say_in_place_of_one_thing_is_a_look_alike_of_it() -> None:
    """Torques that are all wrong by one factor, at the drives and at the steerings, stand for a mass."""
    payload = answer("single", concealed("payload_mass", "chassis", parameters={"mass": 9.0}))
    casters = "front_left+front_right"
    sides = [named("torque_constant_error", casters, ambiguous_with=["payload_mass"], probability=0.5) for _ in range(2)]
    assert judged(payload, report(*sides)).outcome == "in a look-alike set"
    alone = [named("torque_constant_error", casters) for _ in range(2)]
    assert judged(payload, report(*alone)).outcome == "wrong name"


def test_a_number_is_held_against_what_the_description_has_not_got() -> None:
    """Somebody has tuned 0.4 mm of an offset of 3.4 mm into the description: 3.0 mm are missing."""
    offset = concealed("caster_offset_error", parameters={"x": 0.0034, "y": 0.0})
    said = {"x": {"value": 0.003, "unit": "m", "ci95": [0.0029, 0.0031]}}
    found = {}
    for tuned in (0.0, 0.0004):
        case = answer("masked", offset, retuned={"caster_offset.x/front_left": tuned})
        [error] = judged(case, report(named("caster_offset_error", parameters=said))).parameter_errors()
        found[tuned] = error
    assert not found[0.0].covered and found[0.0].error > 0.1
    assert found[0.0004].covered and found[0.0004].error < 1e-9


def test_statistics_by_known_numbers() -> None:
    """Wilson against an independent implementation; the others counted by hand."""
    for count, total in ((0, 150), (1, 150), (75, 150), (120, 120), (1, 3)):
        other = stats.binomtest(count, total).proportion_ci(method="wilson")
        assert wilson(count, total) == pytest.approx((other.low, other.high), abs=1e-6)
    assert calibration_error([0.95] * 20, [True] * 19 + [False]) == pytest.approx(0.0)
    assert calibration_error([0.95] * 10 + [0.55] * 10, [True] * 5 + [False] * 5 + [True] * 10) == pytest.approx(0.45)
    assert np.isnan(calibration_error([], []))
    assert overlap((0.0, 2.0), (1.0, 3.0)) == pytest.approx(1.0 / 3.0)
    assert overlap((0.0, 1.0), (2.0, 3.0)) == 0.0


def test_names_are_counted_above_the_floor() -> None:
    faint = answer("single", concealed(size=1.0))
    cases = [judged(SINGLE, report(named()))] * 3 + [judged(SINGLE, report()), judged(faint, report())]
    found = figure(cases, 1, "outright right")
    assert (found.value, found.of, found.met) == (0.75, "3 of 4 singles above the floor", False)
    assert found.interval == wilson(3, 4)
    assert figure(cases, 1, "right or in set, below the floor").of == "0 of 1 singles and pairs below it"


def test_false_alarms_and_harm_on_healthy_cases() -> None:
    healthy = answer("none")
    worse = report(fit={"holdout": {"inverse_nrmse": [0.1, 0.1], "rollout": {}, "gap_closed": 0.0, "harm": 0.05}})
    unchanged = report(fit={"holdout": {"inverse_nrmse": [0.1, 0.1], "rollout": {}, "gap_closed": 0.0, "harm": 0.0}})
    cases = [judged(healthy, unchanged), judged(healthy, worse), judged(healthy, report(named())), judged(healthy, None)]
    assert figure(cases, 2, "false alarm: an effect named").of == "1 of 3 healthy cases"
    assert figure(cases, 6, "harm above 1 %").of == "1 of 3 healthy cases"
    assert figure(cases, 6, "largest harm").value == pytest.approx(0.05)


def test_outside_the_library() -> None:
    outside = answer("outside", concealed("heading_friction", "rear_left", outside=True, parameters={"size": 0.3}))
    good = report(unknown=(leftover("speed", 0.2), leftover("steer_angle/rear_left", 0.6)))
    cases = [
        judged(outside, good),
        judged(outside, report(unknown=(leftover("time"),))),
        judged(outside, report(named(probability=0.9))),
        judged(outside, report(named(probability=0.5), unknown=(leftover("steer_angle/front_left"),))),
    ]
    assert figure(cases, 3, "said so").value == 0.75
    assert figure(cases, 3, "leading variable right").of == "2 of 3 of those that say so"
    assert figure(cases, 3, "a name with more than 0.8").value == 0.25
    assert [missed(j) for j in cases] == [False, True, True, True]


def test_location() -> None:
    push = concealed("external_push", "chassis", parameters={"force_x": 9.0}, onset=4.05, region={"speed": [0.1, 0.3]})
    patch = concealed("low_friction_patch", target="front_left+rear_left", parameters={"factor": 0.3, "x": 1.0, "y": 0.0},
                      place={"x": 1.0, "y": 0.0, "radius": 0.3})  # fmt: skip
    seen = report(named("low_friction_patch", "front_left+rear_left"))
    seen["locations"][0]["place_m"] = {"x": 1.03, "y": 0.04, "radius": 0.2}
    cases = [
        judged(answer("single", push), report(named("external_push", "chassis"))),
        judged(answer("single", patch), seen),
        judged(SINGLE, report(named("rolling_resistance"))),
        judged(SINGLE, report(named(target="rear_left"))),
    ]
    assert figure(cases, 4, "onset, median error").value == pytest.approx(0.05)
    assert figure(cases, 4, "patch centre, median error").value == pytest.approx(0.05)
    assert figure(cases, 4, "casters").of == "1 of 2 cases with a location, above the floor"
    assert figure(cases, 4, "region, median overlap").value == pytest.approx(0.75)  # 2/3, 3/4, 3/4


def test_a_patch_is_as_wide_as_it_is_long_the_other_way_round() -> None:
    """An outline is told with the longer side as its length; that it was drawn the other way is no error."""
    drawn = {"x": 0.6, "y": 0.3, "length": 0.4, "width": 0.6, "yaw": 0.1, "roundness": 0.9, "factor": 0.5}
    patch = concealed("low_friction_patch", parameters=drawn)
    told = drawn | {"length": 0.6, "width": 0.4, "yaw": 0.1 - 0.5 * math.pi}
    parameters = {name: {"value": value, "unit": "", "ci95": [value - 0.01, value + 0.01]} for name, value in told.items()}
    errors = judged(answer("single", patch), report(named("low_friction_patch", parameters=parameters))).parameter_errors()
    assert len(errors) == 7
    assert all(error.covered and error.error < 1e-9 for error in errors)


def test_numbers_and_their_intervals() -> None:
    slope = concealed("ground_slope", "chassis", parameters={"angle": 0.02, "direction": 3.1})
    said = named("ground_slope", "chassis", parameters={
        "angle": {"value": 0.021, "unit": "rad", "ci95": [0.0205, 0.0215]},
        "direction": {"value": -3.1, "unit": "rad", "ci95": [-3.3, -2.9]},
    })  # fmt: skip
    errors = judged(answer("single", slope), report(said)).parameter_errors()
    assert [(e.parameter, e.covered) for e in errors] == [("angle", False), ("direction", True)]
    assert [e.error for e in errors] == pytest.approx([0.05, (2 * np.pi - 6.2) / np.pi])
    arm = concealed("imu_lever_arm", "imu", parameters={"x": 0.04, "y": 0.03})
    said = named("imu_lever_arm", "imu", parameters={
        "x": {"value": 0.045, "unit": "m", "ci95": [0.03, 0.06]}, "y": {"value": 0.03, "unit": "m", "ci95": [0.02, 0.04]},
    })  # fmt: skip
    assert [e.error for e in judged(answer("single", arm), report(said)).parameter_errors()] == pytest.approx([0.1, 0.0])


def test_the_gap_of_the_simulation_and_the_harm_are_those_of_the_report() -> None:
    told = judged(SINGLE, report(named()))
    assert told.rollout_gap() == 0.9
    assert told.harm() == 0.0
    assert figure([told], 6, "gap closed, channels, median").value == 0.98


def challenge(folder: Path, cases: list[tuple[dict[str, Any], dict[str, Any] | None]]) -> Path:
    """Write a challenge whose reports are there already; returns the answer file."""
    answers = [{**a, "case": f"case_{k:04d}"} for k, (a, _) in enumerate(cases, 1)]
    sealed = folder.with_name("sealed.json")
    seal(sealed, {"seed": 5, "count": len(cases), "options": {}}, answers, folder)
    for own, (_, said) in zip(answers, cases, strict=True):
        if said is not None:
            (folder / "reports" / own["case"]).mkdir(parents=True)
            (folder / "reports" / own["case"] / "report.json").write_text(json.dumps(said))
    return sealed


def test_the_page_has_every_figure_and_every_miss(tmp_path: Path) -> None:
    wrong = report(named("rolling_resistance", "rear_left"))
    cases = [(SINGLE, report(named())), (SINGLE, wrong), (answer("none"), report()), (SINGLE, None)]
    sealed = challenge(tmp_path / "ch", cases)
    found = score([CaseSet(tmp_path / "ch", sealed)], lambda message: None)
    written, printed = page(found), text(found)
    assert found.sources[0].digest in written and "seed 5" in printed
    [misses] = [table for table in found.tables if table.title.startswith("Misses")]
    assert [row[0] for row in misses.rows] == ["case_0002", "case_0004"]
    row = next(line for line in written.splitlines() if line.startswith("| case_0002"))
    assert "drive_coulomb_friction of front_left (coulomb 0.5; 9.0 floors)" in row
    assert "rolling_resistance of rear_left (0.99)" in row
    assert "33.3 %" in written  # one of three singles
    for f in found.figures:
        assert f.label in written and f.label in printed
    [confusion] = [table for table in found.tables if table.title == "Concealed and named"]
    assert confusion.rows[0] == ("drive_coulomb_friction", "2", "0", "1", "0", "rolling_resistance 1")


def test_what_is_named_as_often_stands_in_the_order_of_its_name(tmp_path: Path) -> None:
    others = ("rolling_resistance", "imu_scale", "drive_viscous_friction", "imu_scale")
    wrong = [(SINGLE, report(named(other, "rear_left"))) for other in others]
    found = score([CaseSet(tmp_path / "ch", challenge(tmp_path / "ch", wrong))], lambda message: None)
    [confusion] = [table for table in found.tables if table.title == "Concealed and named"]
    assert confusion.rows[0][-1] == "imu_scale 2, drive_viscous_friction 1, rolling_resistance 1"


def test_cases_of_several_seeds_are_counted_together(tmp_path: Path) -> None:
    sealed = challenge(tmp_path / "one" / "ch", [(SINGLE, report(named()))])
    wrong = report(named("rolling_resistance", "rear_left"))
    more = challenge(tmp_path / "two" / "again", [(SINGLE, wrong), (answer("none"), report())])
    sets = [CaseSet(tmp_path / "one" / "ch", sealed), CaseSet(tmp_path / "two" / "again", more)]
    found = score(sets, lambda message: None)
    [misses] = [table for table in found.tables if table.title.startswith("Misses")]
    assert [row[0] for row in misses.rows] == ["again/case_0001"]
    right = next(f for f in found.figures if f.section == 1 and f.label.startswith("right"))
    assert right.value == 0.5
    assert all(source.digest in page(found) for source in found.sources)


def test_each_folder_has_its_answers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["challenge", "score", "one", "two", "--answers", "one.json"]) == 2
    assert "--answers has 1 entries for 2 DIR; allowed: one for each" in capsys.readouterr().err


def test_answers_that_are_not_those_sealed_are_refused(tmp_path: Path) -> None:
    sealed = challenge(tmp_path / "ch", [(SINGLE, report())])
    sealed.write_text(sealed.read_text().replace("drive_coulomb_friction", "rolling_resistance"))
    with pytest.raises(MismatchError, match="SHA-256"):
        score([CaseSet(tmp_path / "ch", sealed)], lambda message: None)
    (tmp_path / "ch" / HASH_FILE).unlink()
    with pytest.raises(MismatchError, match=HASH_FILE):
        score([CaseSet(tmp_path / "ch", sealed)], lambda message: None)


def test_baselines_on_the_same_cases() -> None:
    """A method names targets, too, and a remark is no error: one seemed never to have run, and none to be right."""
    said = {"name": "other", "named": ["drive_coulomb_friction/front_left", "x"], "inverse_nrmse": [0.4, 0.2], "seconds": 2.0,
            "remark": "48 numbers"}
    own = dataclasses.replace(judged(SINGLE, report()), baselines=[said])
    failed = {"name": "third", "named": [], "inverse_nrmse": None, "seconds": 0.1, "remark": "no data"}
    healthy = dataclasses.replace(judged(answer("none"), report()), baselines=[said, failed])
    from pcw_sim_bridge.mismatch.challenge.score import tables

    [table] = [t for t in tables([own, healthy]) if t.title.startswith("Other methods")]
    ours, other, third = table.rows
    assert ours[:2] == ("mismatch analyze", "2 of 2") and ours[2:6] == ("0 of 1", "0 of 1", "0 (0)", "0 of 1")
    assert other == ("other", "2 of 2", "0 of 1", "1 of 1", "2 (2)", "1 of 1", "0.50", "0 of 2", "2.0 s")
    assert third == ("third", "0 of 1", *7 * [""])
