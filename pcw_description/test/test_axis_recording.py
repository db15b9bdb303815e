"""Recordings of bench axes: what is wrong with a file is named, the rest of it is used."""

from pathlib import Path

import numpy as np
import pytest

from pcw_description.axis_recording import (
    AxisDescription,
    AxisRecordingError,
    parse_axis_description,
    read_axis_recording,
)
from pcw_description.errors import DescriptionError

BASE = {
    "format": "pcw_axis/1",
    "name": "servo",
    "kind": "rotary",
    "provenance": {"all": "made up for this test"},
    "columns": {"time": "t", "position": {"column": "q", "unit": "deg"}, "force": {"column": "i", "scale": 0.5}},
    "inertia": 0.01,
}


def servo(**changes: object) -> AxisDescription:
    """Return the axis with some keys changed."""
    return parse_axis_description({**BASE, **changes})


def table(path: Path, rows: np.ndarray, header: str = "t,q,i") -> Path:
    """Write rows as CSV."""
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    return path


def rows(count: int = 200) -> np.ndarray:
    """Return rows of time [s], angle [deg] and current [A]."""
    time = 0.01 * np.arange(count)
    return np.column_stack([time, 90.0 * np.sin(time), np.cos(time)])


def test_units_and_scales_are_applied_once(tmp_path: Path) -> None:
    """Degrees become radians and amperes torques, the same from every kind of file."""
    data = rows()
    table(tmp_path / "run.csv", data)
    np.savez(tmp_path / "run.npz", t=data[:, 0], q=data[:, 1], i=data[:, 2])
    for name in ("run.csv", "run.npz"):
        recording = read_axis_recording(tmp_path / name, servo())
        assert recording.position == pytest.approx(np.pi / 2 * np.sin(data[:, 0]), abs=1e-9)
        assert recording.force == pytest.approx(0.5 * data[:, 2])
        assert recording.warnings == ()
    columns = {"time": 0, "position": {"column": 1, "unit": "deg"}, "force": {"column": 2, "scale": 0.5}}
    for name, array in (("tall.npy", data), ("wide.npy", data.T)):
        np.save(tmp_path / name, array)
        numbered = read_axis_recording(tmp_path / name, servo(columns=columns))
        assert numbered.position == pytest.approx(np.pi / 2 * np.sin(data[:, 0]), abs=1e-9)


def test_bad_rows_are_counted_and_left_out(tmp_path: Path) -> None:
    """NaN, repeats, a jump back and a gap: each is told, the rest is as it was."""
    data = rows()
    data[20, 1] = np.nan
    data[40, 0] = data[39, 0]
    data[60:, 0] += 1.0
    data[80:90, 0] -= 0.5
    recording = read_axis_recording(table(tmp_path / "run.csv", data), servo())
    text = "; ".join(recording.warnings)
    for words in ("1 of 200 rows hold NaN", "1 repeated time stamps", "time jumps back 1 times; 10 samples", "gaps in time"):
        assert words in text
    assert np.all(np.diff(recording.time) > 0.0) and np.isfinite(recording.position).all()
    assert len(recording.time) == 200 - 1 - 1 - 10


@pytest.mark.parametrize(
    ("content", "header", "says"),
    [
        (rows(5), "t,q,i", "5 usable rows; at least 10"),
        (rows(), "t,angle,i", "no column 'q' for position"),
        (np.full((50, 3), np.nan), "t,q,i", "0 usable rows"),
    ],
)
def test_a_file_that_cannot_be_used_is_an_error(tmp_path: Path, content: np.ndarray, header: str, says: str) -> None:
    """The message names the file and what is wrong."""
    path = table(tmp_path / "run.csv", content, header)
    with pytest.raises(AxisRecordingError, match=says) as caught:
        read_axis_recording(path, servo())
    assert "run.csv" in str(caught.value)


def test_a_folder_and_nothing_at_all_are_told_apart(tmp_path: Path) -> None:
    """A recording of a robot is a folder; here a file is wanted."""
    with pytest.raises(AxisRecordingError, match="it is a folder; allowed for a bench axis: a file"):
        read_axis_recording(tmp_path, servo())
    with pytest.raises(AxisRecordingError, match="no such file"):
        read_axis_recording(tmp_path / "run.csv", servo())


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("empty.csv", b"", "no rows"),
        ("torn.csv", b"t,q,i\n0,1,2\n0.1,1\n", "data row 2 has 2 columns instead of 3"),
        ("binary.mat", b"\x00\x01nothing", "cannot be read"),
        ("binary.npy", b"nothing", "cannot be read"),
        ("run.xlsx", b"", "unknown kind of file"),
    ],
)
def test_a_broken_file_is_an_error(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    """Whatever its reader raises, the user gets one line with the file's name."""
    (tmp_path / name).write_bytes(content)
    with pytest.raises(AxisRecordingError, match=says) as caught:
        read_axis_recording(tmp_path / name, servo())
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"columns": {"time": "t", "position": {"column": "q", "unit": "m"}, "force": "i"}}, "allowed on a rotary axis: rad"),
        ({"columns": {"time": "t", "position": "q"}}, "columns.force"),
        ({"columns": {"time": "t", "force": "i"}}, "columns.position"),
        ({"columns": {"position": "q", "force": "i"}}, "time column or a rate"),
        ({"rate": 100.0}, "time column or a rate"),
        ({"columns": {"time": "t", "postion": "q", "force": "i"}}, "position"),
        (
            {"kind": "linear", "columns": {"time": "t", "position": "q", "force": "i"}, "gravity_arm": {"moment": 1.0}},
            "gravity",
        ),
        ({"tolerances": {"hanging_position": "0.1 rad", "inertai": "5 %"}}, "inertia"),
    ],
)
def test_a_description_that_cannot_be_meant_is_an_error(changes: dict[str, object], says: str) -> None:
    """Key, value and what is allowed."""
    with pytest.raises(DescriptionError, match=says):
        servo(**changes)
