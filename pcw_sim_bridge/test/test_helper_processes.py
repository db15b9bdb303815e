"""Processes beside an analysis: what they do is what would have been done here, errors too, and they end with us."""

import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from pcw_description import load_robot, ros_messages
from pcw_description.errors import RecordingError
from pcw_description.recording import Recording
from pcw_description.recording_writer import RecordingWriter
from pcw_sim_bridge.mismatch.report import helper_processes
from pcw_sim_bridge.mismatch.report.helper_processes import HelperProcesses

THESIS = load_robot("thesis")


@pytest.fixture
def helpers(monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1})  # on one core there would be none
    with HelperProcesses() as made:
        yield made


def bag(path: Path, samples: int = 40) -> Path:
    names = list(THESIS.joint_names)
    with RecordingWriter(path) as writer:
        for row in range(samples):
            values = np.random.default_rng(row).standard_normal((3, len(names)))
            stamp = 1_000_000_000 + 2_000_000 * row
            writer.write("/joint_states", ros_messages.joint_state(stamp, names, *values), stamp)
            writer.write("/imu/data", ros_messages.imu(stamp, values[0, :3], values[1, :3]), stamp)
    return path


def process_of(number: int) -> tuple[int, int]:
    return number, os.getpid()


def squared(number: float) -> float:
    if number < 0.0:
        raise ValueError(f"{number} is less than nothing")
    return number**2


def die_elsewhere(own: int) -> int:
    if os.getpid() != own:
        os._exit(3)
    return own


def test_tasks_are_done_side_by_side_and_come_in_their_order(helpers: HelperProcesses) -> None:
    done = helpers.do([(process_of, (number,)) for number in range(7)])
    assert [number for number, _ in done] == list(range(7))
    assert len({process for _, process in done}) == 2 and os.getpid() not in {process for _, process in done}
    assert helpers.do([]) == []
    large = np.zeros(3_000_000)  # more than a pipe holds
    assert [len(result) for result in helpers.do([(np.negative, (large,))] * 5)] == 5 * [len(large)]


def test_an_error_is_raised_as_if_it_were_made_here(helpers: HelperProcesses) -> None:
    with pytest.raises(ValueError, match="less than nothing"):
        helpers.do([(squared, (number,)) for number in (1.0, -1.0, 2.0)])
    assert helpers.do([(squared, (3.0,))]) == [9.0]


def test_what_a_process_that_dies_left_undone_is_done_here(helpers: HelperProcesses) -> None:
    assert helpers.do([(die_elsewhere, (os.getpid(),))] * 5 + [(squared, (3.0,))]) == 5 * [os.getpid()] + [9.0]


def test_a_recording_that_was_read_meanwhile_is_the_same(helpers: HelperProcesses, tmp_path: Path) -> None:
    paths = [bag(tmp_path / f"run_{samples}", samples) for samples in (40, 50, 60)]
    helpers.begin(paths, "thesis", {})
    for path in [*paths, paths[0]]:  # the last is read anew
        read, expected = helpers.open(path, THESIS, {}), Recording.open(path, THESIS)
        for field in ("stamp_ns", "position", "velocity", "effort"):
            np.testing.assert_array_equal(getattr(read.joint_states, field), getattr(expected.joint_states, field))
        assert read.imu is not None and expected.imu is not None
        np.testing.assert_array_equal(read.imu.gyro, expected.imu.gyro)
        assert (read.warnings, read.sha256, read.duration) == (expected.warnings, expected.sha256, expected.duration)
        [columns], [wanted] = read.columns("imu/data"), expected.columns("imu/data")
        np.testing.assert_array_equal(columns.numbers["linear_acceleration.x"], wanted.numbers["linear_acceleration.x"])
    assert helpers.do([(squared, (3.0,))]) == [9.0]


def test_what_cannot_be_read_is_told_by_who_asks(helpers: HelperProcesses, tmp_path: Path) -> None:
    (tmp_path / "no.mcap").write_bytes(b"nothing of the kind")
    good = bag(tmp_path / "run")
    helpers.begin([tmp_path / "no.mcap", good], "thesis", {})
    with pytest.raises(RecordingError, match=r"no\.mcap"):
        helpers.open(tmp_path / "no.mcap", THESIS, {})
    assert len(helpers.open(good, THESIS, {}).joint_states.stamp) == 40


def test_a_large_recording_is_not_sent(
    helpers: HelperProcesses, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(helper_processes, "LARGEST_READ", 1000)
    path = bag(tmp_path / "run")
    helpers.begin([path], "no_such_robot", {})  # which a helper would stumble over
    assert len(helpers.open(path, THESIS, {}).joint_states.stamp) == 40


def test_on_one_core_all_is_done_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0})
    path = bag(tmp_path / "run")
    with HelperProcesses() as helpers:
        helpers.begin([path], "thesis", {})
        assert len(helpers.open(path, THESIS, {}).joint_states.stamp) == 40
        assert helpers.do([(process_of, (1,))]) == [(1, os.getpid())]


def test_where_no_process_can_be_forked_all_is_done_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> int:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 1})
    monkeypatch.setattr(os, "fork", refuse)
    with HelperProcesses() as helpers:
        assert helpers.do([(process_of, (1,))]) == [(1, os.getpid())]


def test_a_decoded_recording_is_small(tmp_path: Path) -> None:
    """It is sent from process to process: most of what is read from files is what the series were decoded from."""
    whole = Recording.open(bag(tmp_path / "run", 400), THESIS)
    _ = whole.warnings, whole.sha256
    light = whole.decoded()
    assert len(pickle.dumps(light)) < 0.6 * len(pickle.dumps(whole))


def test_they_end_when_who_began_them_is_killed() -> None:
    program = (
        "import os, time; os.sched_getaffinity = lambda process: {0, 1}\n"
        "from pcw_sim_bridge.mismatch.report.helper_processes import HelperProcesses\n"
        "made = HelperProcesses()\n"
        "print(*(helper.process.pid for helper in made._helpers), flush=True)\n"
        "time.sleep(60.0)\n"
    )
    run = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    assert run.stdout is not None
    pids = [int(pid) for pid in run.stdout.readline().split()]
    assert len(pids) == 2 and all(Path(f"/proc/{pid}").exists() for pid in pids)
    run.send_signal(signal.SIGKILL)
    run.wait()
    until = time.monotonic() + 20.0
    while any(map(_runs, pids)) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(map(_runs, pids))


def _runs(pid: int) -> bool:
    try:
        # Of a process whose parent is gone and which nobody has waited for there is a name left.
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
