"""Columns of text as recordings: what is mapped arrives, and what is wrong is named."""

from __future__ import annotations

import copy
import gzip
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pcw_description.column_mapping import parse_column_mapping
from pcw_description.errors import DescriptionError, RecordingError
from pcw_description.import_columns import import_columns, main, put_on_end
from pcw_description.recording import Recording

MAPPING: dict[str, Any] = {
    "format": "pcw_columns/1",
    "name": "made up",
    "provenance": {"columns": "these tests"},
    "time": {"column": "t", "unit": "ms"},
    "joints": {
        "front_steer": {"position": {"column": "steer", "unit": "deg", "offset": 0.1}},
        "front_drive": {"position": {"column": "counts", "scale": -0.001, "wraps": 65536}},
    },
    "tracker": {"x": {"column": "x", "unit": "mm"}, "y": "y", "yaw": "yaw", "child_frame": "marker"},
}


def changed(**parts: Any) -> dict[str, Any]:
    """The mapping with some keys replaced; None takes one out."""
    data = copy.deepcopy(MAPPING) | parts
    return {key: value for key, value in data.items() if value is not None}


def write(path: Path, rows: int = 40) -> Path:
    """A log of a counter that begins just below its turn, and of a tracker that sees every second row."""
    lines = ["# a comment", "t,steer,counts,x,y,yaw"]
    for k in range(rows):
        pose = f"{100 * k},{0.01 * k},{0.02 * k}" if k % 2 == 0 else ",,nan"
        lines.append(f"{5000 + 20 * k},{0.5 * k},{(65500 + 100 * k) % 65536},{pose}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_what_is_mapped_arrives_in_si(tmp_path: Path) -> None:
    counts, warnings = import_columns(write(tmp_path / "log.csv"), parse_column_mapping(MAPPING), tmp_path / "bag")
    assert counts == {"/joint_states": 40, "/ground_truth/odom": 20} and not warnings
    recording = Recording.open(tmp_path / "bag")
    k = np.arange(40)
    assert recording.joint_states.stamp_ns[0] == 5_000_000_000
    np.testing.assert_allclose(recording.joint_states.stamp, 0.02 * k, atol=1e-9)
    np.testing.assert_allclose(recording.joint_states["front_steer"].position, np.radians(0.5 * k) + 0.1)
    # 65500 is 36 short of a turn.
    np.testing.assert_allclose(recording.joint_states["front_drive"].position, -0.001 * (100 * k - 36), atol=1e-12)
    truth = recording.ground_truth
    assert truth is not None and truth.child_frame_id == "marker"
    expected = np.stack([0.1 * k[::2], 0.01 * k[::2], 0.02 * k[::2]], axis=1)
    np.testing.assert_allclose(truth.pose, expected, atol=1e-9)


def test_columns_may_be_counted_and_stand_between_words(tmp_path: Path) -> None:
    path = tmp_path / "log.txt.gz"
    with gzip.open(path, "wt", encoding="utf-8") as file:
        file.writelines(f"time: {k / 50} turns: {k / 50} {-k / 50} speed: 60 -1 gyro: {k / 100} 0 1\n" for k in range(80))
    joints = {
        "a_steer": {"position": {"column": 3, "unit": "rev"}, "velocity": {"column": 6, "unit": "rpm"}},
        "a_drive": {"position": {"column": 4, "unit": "rev"}, "velocity": {"column": 7, "unit": "rev/s"}},
    }
    imu = {"yaw_rate": 9, "acceleration_x": 10, "acceleration_y": {"column": 11, "unit": "g"}}
    mapping = parse_column_mapping(changed(time=1, joints=joints, tracker=None, imu=imu))
    _, warnings = import_columns(path, mapping, tmp_path / "bag")
    assert warnings == ["stamps are moved by 1 s: in ROS a stamp of zero is none"]
    recording = Recording.open(tmp_path / "bag")
    k = np.arange(80)
    for name, speed in (("a_steer", math.tau), ("a_drive", -math.tau)):
        np.testing.assert_allclose(recording.joint_states[name].velocity, speed)
        np.testing.assert_allclose(recording.joint_states[name].position, speed * k / 50, atol=1e-9)
    assert recording.imu is not None
    np.testing.assert_allclose(recording.imu.gyro[:, 2], k / 100)
    np.testing.assert_allclose(recording.imu.acceleration[0], [0.0, 9.81, 9.81])


@pytest.mark.parametrize(("field", "unit", "factor"), [("velocity", "rpm", math.tau / 60.0), ("effort", "mN m", 1e-3)])
def test_what_was_commanded_is_imported_too(tmp_path: Path, field: str, unit: str, factor: float) -> None:
    """Of the joints that were commanded; a cell without a number is a row without a command."""
    lines = ["t,steer,drive,wanted"] + [f"{0.02 * k},0,{0.1 * k},{'' if k == 7 else 2 * k}" for k in range(80)]
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    wanted = {f"commanded_{field}": {"column": "wanted", "unit": unit}}
    joints = {"a_steer": {"position": "steer"}, "a_drive": {"position": "drive", **wanted}}
    mapping = parse_column_mapping(changed(time="t", joints=joints, tracker=None))
    counts, _ = import_columns(tmp_path / "log.csv", mapping, tmp_path / "bag")
    assert counts == {"/joint_states": 80, "/joint_commands": 79}
    commands = Recording.open(tmp_path / "bag").joint_commands
    assert commands is not None and commands.joint_names == ("a_drive",)
    expected = factor * 2.0 * np.delete(np.arange(80), 7)
    np.testing.assert_allclose(getattr(commands["a_drive"], field), expected)
    assert np.isnan(getattr(commands["a_drive"], "effort" if field == "velocity" else "velocity")).all()


def test_a_counter_is_put_on_end_over_rows_without_it() -> None:
    true = np.array([-30.0, 10.0, 90.0, 150.0, 210.0, 330.0, 220.0, 100.0, -20.0])
    seen = np.mod(true, 256.0)
    seen[3] = np.nan
    expected = true.copy()
    expected[3] = np.nan
    np.testing.assert_array_equal(put_on_end(seen, 256.0), expected)


@pytest.mark.parametrize(
    ("data", "named"),
    [
        (changed(format="pcw_column/1"), "format: 'pcw_column/1' is not allowed; allowed: pcw_columns/1"),
        (changed(joints={}), "joints: {} is not allowed"),
        (changed(joints={"front": {"position": 1}}), "joints.front: 'front' is not allowed; allowed: <caster>_steer"),
        (changed(joints={"a_steer": {}}), "joints.a_steer"),
        (changed(joints={"a_steer": {"commanded_effort": 1}}), "joints.a_steer"),
        (
            changed(
                joints={"a_steer": {"position": 1, "commanded_effort": 2}, "a_drive": {"position": 1, "commanded_velocity": 2}}
            ),
            "joints: 'commanded_velocity and commanded_effort' is not allowed; allowed: speeds or torques, never both",
        ),
        (changed(joints={"a_steer": {"angle": 1}}), "joints.a_steer.angle"),
        (changed(joints={"a_steer": {"position": {"column": 1, "unit": "m"}}}), "joints.a_steer.position.unit: 'm'"),
        (changed(joints={"a_steer": {"position": {"column": -1}}}), "joints.a_steer.position.column: -1"),
        (changed(joints={"a_steer": {"position": {"column": 1, "scale": 0.0}}}), "joints.a_steer.position.scale: 0.0"),
        (changed(joints={"a_steer": {"position": {"column": 1, "wraps": -1}}}), "joints.a_steer.position.wraps: -1"),
        (changed(time=None), "time is missing; allowed: either a time column, or a rate"),
        (changed(rate=10.0), "time: 'both' is not allowed"),
        (changed(tracker={"x": 1, "y": 2}), "tracker.yaw"),
        (changed(delimiter="pipe"), "delimiter: 'pipe'"),
        (changed(provenance={}), "provenance"),
        (changed(columns={}), "columns: {} is not allowed; unknown key"),
    ],
)
def test_what_is_wrong_with_a_mapping_is_named(data: dict[str, Any], named: str) -> None:
    with pytest.raises(DescriptionError) as caught:
        parse_column_mapping(data)
    assert named in str(caught.value)


def test_what_is_wrong_with_a_file_is_named_and_leaves_nothing(tmp_path: Path) -> None:
    good, out = write(tmp_path / "log.csv"), tmp_path / "bag"
    other = parse_column_mapping(changed(tracker={"x": "x", "y": "y", "yaw": "heading"}))
    counted = parse_column_mapping(changed(joints={"a_steer": {"position": 7}}))
    words = tmp_path / "words.csv"
    words.write_text("t,steer,counts,x,y,yaw\n1,two,3,4,5,6\n", encoding="utf-8")
    empty = tmp_path / "empty.csv"
    empty.write_text("# nothing\n", encoding="utf-8")
    for path, mapping, named in (
        (good, other, "tracker.yaw.column: no column 'heading'"),
        (good, counted, "joints.a_steer.position.column: 7 is not allowed; allowed: 0 to 5"),
        (words, parse_column_mapping(MAPPING), "column 1 holds no number but 'two'"),
        (empty, parse_column_mapping(MAPPING), "no rows"),
        (tmp_path / "absent.csv", parse_column_mapping(MAPPING), "No such file"),
    ):
        with pytest.raises(RecordingError) as caught:
            import_columns(path, mapping, out)
        assert named in str(caught.value) and str(path) in str(caught.value)
        assert not out.exists()


def test_the_command_tells_what_it_left_out_and_replaces_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, mapping, out = write(tmp_path / "log.csv"), tmp_path / "mapping.yaml", tmp_path / "bag"
    broken = log.read_text(encoding="utf-8").replace("5040,1.0", "late,one").replace("5080,", "5080,x")
    log.write_text(broken, encoding="utf-8")
    mapping.write_text(yaml.safe_dump(MAPPING), encoding="utf-8")
    call = [str(log), "--mapping", str(mapping), "--out", str(out)]
    assert main(call) == 0
    printed = capsys.readouterr()
    assert printed.out == f"{out}: 19 ground_truth/odom, 38 joint_states\n"
    assert printed.err.splitlines() == [
        f"import_columns: {log}: 3 cells are no numbers and are taken for absent",
        f"import_columns: {log}: 1 of 40 rows have no stamp and are left out",
    ]
    before = sorted(path.stat().st_mtime_ns for path in out.iterdir())
    assert main(call) == 2
    assert "exists already and is left as it is" in capsys.readouterr().err
    assert sorted(path.stat().st_mtime_ns for path in out.iterdir()) == before
