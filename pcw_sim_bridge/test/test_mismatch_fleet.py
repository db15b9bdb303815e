"""`mismatch fleet`: whose recording is which, workers that die, going on after an interruption, and what appeared when."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pcw_description import load_robot
from pcw_sim_bridge.mismatch.__main__ import main
from pcw_sim_bridge.mismatch.errors import MismatchError
from pcw_sim_bridge.mismatch.fleet.fleet import FleetResults, FleetRobots, Task, analyse_all, find_tasks
from pcw_sim_bridge.mismatch.fleet.fleet_report import fleet_html, write_fleet_report
from pcw_sim_bridge.mismatch.fleet.fleet_trends import DAY, histories, onset, trend
from pcw_sim_bridge.mismatch.fleet.fleet_workers import LocalWorkers
from pcw_sim_bridge.simulated_run import record_run

SLED = """\
format: pcw_axis/1
name: sled
kind: linear
provenance: {all: made up for this test}
columns:
  time: {column: time, unit: s}
  position: {column: position, unit: m}
  force: {column: force, unit: N}
inertia: 20.0
tolerances: {inertia: 1 %}
physics: []
"""
START = 1.8e9  # [s since 1970]


def sled(path: Path, coulomb: float, seed: int, day: float) -> None:
    """Write a CSV of a 20 kg sled with friction, made on some day."""
    rng = np.random.default_rng(seed)
    at = np.arange(0.0, 12.0, 0.002)
    position = 0.2 * np.sin(1.7 * at) + 0.05 * np.sin(5.3 * at)
    velocity = 0.34 * np.cos(1.7 * at) + 0.265 * np.cos(5.3 * at)
    force = 20.0 * (-0.578 * np.sin(1.7 * at) - 1.4045 * np.sin(5.3 * at)) + coulomb * np.tanh(velocity / 1e-3)
    force += 0.3 * rng.standard_normal(len(at))
    path.parent.mkdir(parents=True, exist_ok=True)
    table = np.column_stack([at, position + 1e-6 * rng.standard_normal(len(at)), force])
    np.savetxt(path, table, delimiter=",", header="time,position,force", comments="")
    os.utime(path, (START + DAY * day, START + DAY * day))


def wearing_sleds(folder: Path) -> None:
    """Six days of two sleds: `press` is healthy for two days and then wears, `feeder` stays healthy; one bad file."""
    (folder / "sled.yaml").write_text(SLED)
    for day in range(6):
        sled(folder / "logs" / "press" / f"day{day}.csv", max(0.0, 2.0 + 0.5 * (day - 2)) if day >= 2 else 0.0, day, day)
        sled(folder / "logs" / "feeder" / f"day{day}.csv", 0.0, 100 + day, day)
    (folder / "logs" / "press" / "bad.csv").write_text("these are\nno numbers\n")


def fleet(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the command as a user without ROS does, for all sleds."""
    command = [sys.executable, "-m", "pcw_sim_bridge.mismatch", "fleet", "logs", "--robot", "press:=sled.yaml"]
    return subprocess.run(
        [*command, "--robot", "feed*:=sled.yaml", "--out", "out", *arguments],
        cwd=folder, capture_output=True, text=True, timeout=280, check=False,
    )


def test_a_fleet_says_what_appeared_when_and_a_second_run_does_nothing_again(tmp_path: Path) -> None:
    """Friction that comes on the third day and grows; one bad file is told and not fatal; all but it is done once."""
    wearing_sleds(tmp_path)
    done = fleet(tmp_path, "--workers", "2")
    assert done.returncode == 0, done.stderr
    assert "not analysed" in done.stderr
    assert "13 of 13 recordings" in done.stderr
    report = json.loads((tmp_path / "out" / "fleet.json").read_text())
    robots = {robot["name"]: robot for robot in report["robots"]}
    assert list(robots) == ["feeder", "press"]
    assert robots["feeder"]["effects"] == []
    assert [Path(entry["path"]).name for entry in robots["press"]["failed"]] == ["bad.csv"]
    [friction] = robots["press"]["effects"]
    assert (friction["name"], friction["target"]) == ("drive_coulomb_friction", ["axis"])
    assert friction["appeared_s"] == pytest.approx(START + 2 * DAY)
    assert (friction["named_since"], friction["recordings_since"]) == (4, 4)
    slope = friction["parameters"]["coulomb"]["slope"]
    assert slope["per"] == "day"
    assert slope["ci95"][0] < 0.5 < slope["ci95"][1]
    assert slope["ci95"][1] - slope["ci95"][0] < 0.2
    assert "drive_coulomb_friction on axis appeared on 2027-01-17" in done.stdout
    page = (tmp_path / "out" / "fleet.html").read_text()
    assert page.count("<circle") == 4
    assert 'class="slope"' in page
    assert "http" not in page.replace("http-equiv", "")

    lines = (tmp_path / "out" / "results.jsonl").read_text().splitlines()
    assert len(lines) == 13
    again = fleet(tmp_path)
    assert again.returncode == 0, again.stderr
    after = (tmp_path / "out" / "results.jsonl").read_text().splitlines()
    assert after[:13] == lines
    assert [Path(json.loads(line)["path"]).name for line in after[13:]] == ["bad.csv"], "only what failed is tried again"
    assert again.stdout == done.stdout

    # A recording that changed, and a last line that a power cut has torn, are analysed again.
    sled(tmp_path / "logs" / "feeder" / "day0.csv", 0.0, 999, 0)
    (tmp_path / "logs" / "press" / "bad.csv").unlink()
    whole = [line for line in after if "bad.csv" not in line]
    torn = [line for line in whole if "press/day5.csv" in line]
    kept = [line for line in whole if line not in torn]
    (tmp_path / "out" / "results.jsonl").write_text("\n".join(kept) + "\n" + torn[0][: len(torn[0]) // 2])
    third = fleet(tmp_path)
    assert third.returncode == 0, third.stderr
    last = [json.loads(line) for line in (tmp_path / "out" / "results.jsonl").read_text().splitlines()[len(kept) :]]
    assert sorted(Path(result["path"]).name for result in last) == ["day0.csv", "day5.csv"]


@pytest.mark.nightly
def test_an_interrupted_run_keeps_what_is_done(tmp_path: Path) -> None:
    """Ctrl-C: exit code 130, whole lines only, no worker left behind, and the next run goes on from there."""
    wearing_sleds(tmp_path)
    command = [sys.executable, "-m", "pcw_sim_bridge.mismatch", "fleet", "logs", "--robot", "sled.yaml", "--out", "out"]
    running = subprocess.Popen([*command, "--workers", "1"], cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    assert running.stderr is not None
    for line in running.stderr:
        if " 4 of 13 recordings" in line:
            break
    children = Path(f"/proc/{running.pid}/task/{running.pid}/children")
    workers = children.read_text().split() if children.exists() else []
    running.send_signal(signal.SIGINT)
    said = running.stderr.read()
    assert running.wait(timeout=60) == 130
    assert "mismatch: interrupted; what is done is kept" in said
    assert "Traceback" not in said
    deadline = time.monotonic() + 20.0
    while any(_runs(int(pid)) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(_runs(int(pid)) for pid in workers)
    done = [json.loads(line) for line in (tmp_path / "out" / "results.jsonl").read_text().splitlines()]
    assert 4 <= len(done) < 13
    good = sum(result["error"] is None for result in done)
    rest = subprocess.run([*command, "--workers", "1"], cwd=tmp_path, capture_output=True, text=True, timeout=280, check=False)
    assert rest.returncode == 0, rest.stderr
    assert f"({good} done before)" in rest.stderr


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def task(name: str) -> Task:
    """Return a task that nobody has to be able to do."""
    return Task(name, "robot", "thesis", "0", {}, 0)


class Counting(LocalWorkers):
    """Workers that do something else with each task, and count what is in flight."""

    def __init__(self, count: int, work: Callable[[str], tuple[Any, ...]]) -> None:
        super().__init__(count)
        self.work, self.open, self.most, self.restarts = work, 0, 0, 0

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Run `work` of the task's path: a function and its arguments."""
        self.open += 1
        self.most = max(self.most, self.open)
        future = super().submit(*self.work(arguments[0].path))
        future.add_done_callback(self._done)
        return future

    def restart(self) -> None:
        """Count."""
        self.restarts += 1
        super().restart()

    def _done(self, future: Future[Any]) -> None:
        self.open -= 1


def test_a_recording_that_kills_its_worker_is_found_and_the_others_are_analysed() -> None:
    """A crash in compiled code ends the process: the pool breaks, and whoever was in flight is suspect."""
    names = [f"good{k}" for k in range(5)] + ["deadly"] + [f"good{k}" for k in range(5, 9)]
    with Counting(2, lambda path: (os._exit, 3) if path == "deadly" else (dict, [("path", path), ("error", None)])) as workers:
        results = list(analyse_all(map(task, names), workers))
    assert sorted(result["path"] for result in results) == sorted(names)
    assert [result["path"] for result in results if result["error"] is not None] == ["deadly"]
    assert workers.restarts == 2


def test_no_more_tasks_are_in_flight_than_keep_the_workers_busy() -> None:
    """However long the list is, and an iterator is never read ahead of what is handed out."""
    read = []

    def tasks() -> Any:
        for k in range(60):
            read.append(k)
            yield task(f"bag{k}")

    with Counting(2, lambda path: (dict, [("path", path), ("error", None)])) as workers:
        for count, _ in enumerate(analyse_all(tasks(), workers), start=1):
            assert len(read) <= count + workers.in_flight
    assert len(read) == 60
    assert workers.most <= workers.in_flight


@pytest.mark.nightly
def test_a_dask_cluster_gives_the_same_results(tmp_path: Path) -> None:
    """The same function over the wire, at a cluster that somebody else has started."""
    distributed = pytest.importorskip("distributed")
    (tmp_path / "sled.yaml").write_text(SLED)
    for day in range(2):
        sled(tmp_path / "logs" / f"day{day}.csv", 3.0, day, day)
    local = subprocess.run(
        [sys.executable, "-m", "pcw_sim_bridge.mismatch", "fleet", "logs", "--robot", "sled.yaml", "--out", "local"],
        cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False,
    )
    assert local.returncode == 0, local.stderr
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        arguments = ["logs", "--robot", "sled.yaml", "--out", "dask", "--scheduler", cluster.scheduler_address]
        done = subprocess.run(
            [sys.executable, "-m", "pcw_sim_bridge.mismatch", "fleet", *arguments],
            cwd=tmp_path, capture_output=True, text=True, timeout=200, check=False,
        )
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "dask" / "fleet.json").read_text() == (tmp_path / "local" / "fleet.json").read_text()


def test_recordings_of_robots_are_found_dated_and_given_to_their_robots(tmp_path: Path) -> None:
    """A bag folder, one that a killed recorder left, a lone .mcap; a description of its own for one robot."""
    robot = load_robot("thesis")
    record_run(robot, lambda t: np.array([0.2 * np.sin(t), 0.0, 0.0]), 1.0, 1, tmp_path / "logs" / "amr_1" / "monday")
    bag = next((tmp_path / "logs" / "amr_1" / "monday").glob("*.mcap")).read_bytes()
    for place in ("amr_2/killed/killed_0.mcap", "special/day/run.mcap", "special/day/other.mcap"):
        (tmp_path / "logs" / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "logs" / place).write_bytes(bag)
    (tmp_path / "logs" / "amr_1" / "notes.txt").write_text("not a recording of a robot")
    robots = FleetRobots.read(["special:=xr4000", "amr_*:=thesis"])
    tasks = find_tasks([tmp_path / "logs"], robots, {}, 0)
    found = [(Path(t.path).relative_to(tmp_path / "logs").as_posix(), t.robot, t.description) for t in tasks]
    assert found == [
        ("amr_1/monday", "amr_1", "thesis"),
        ("amr_2/killed", "amr_2", "thesis"),
        ("special/day/other.mcap", "special", "xr4000"),
        ("special/day/run.mcap", "special", "xr4000"),
    ]
    assert len({t.description_sha256 for t in tasks}) == 2
    results = FleetResults(tmp_path / "out")
    assert not results.holds(tasks[0])
    with pytest.raises(MismatchError, match="belongs to no robot"):
        find_tasks([tmp_path / "logs"], FleetRobots.read(["amr_*:=thesis"]), {}, 0)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["gone", "--robot", "thesis"], "gone: no such recording or folder"),
        (["empty", "--robot", "thesis"], "no recordings in empty"),
        (["logs", "--robot", "thesos"], "thesos"),
        (["logs", "--robot", "a:=thesis", "--robot", "thesis"], "allowed: PATTERN:=DESCRIPTION for each"),
        (["logs", "--robot", ":=thesis"], "allowed: DESCRIPTION, or PATTERN:=DESCRIPTION"),
        (["logs", "--robot", "b*:=sled.yaml"], "belongs to no robot"),
        (["logs", "--robot", "sled.yaml", "--workers", "0"], "--workers 0 is not allowed"),
        (["logs", "--robot", "sled.yaml", "--workers", "1", "--scheduler", "tcp://127.0.0.1:1"], "a cluster has its own"),
        (["logs/bad.csv", "--robot", "sled.yaml"], "none of the 1 recordings could be analysed"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], arguments: list[str], says: str
) -> None:
    """What is wrong is named, and there is no report."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sled.yaml").write_text(SLED)
    (tmp_path / "logs").mkdir()
    (tmp_path / "empty").mkdir()
    (tmp_path / "logs" / "bad.csv").write_text("these are\nno numbers\n")
    assert main(["fleet", *arguments, "--out", "out", "--quiet"]) == 2
    errors = capfd.readouterr().err
    assert says in errors
    assert len(errors.splitlines()) == 1
    assert not (tmp_path / "out" / "fleet.json").exists()


def test_an_onset_is_found_through_a_false_alarm_and_a_miss() -> None:
    """One name by chance early on, and one miss later, move nothing; names now and then are no onset."""
    there = np.array([0, 0, 1, 0, 0, 0, 0, 0, 1, 1, 1, 0, 1, 1, 1, 1], dtype=bool)
    assert onset(there) == (8, True)
    assert onset(np.ones(6, dtype=bool)) == (0, True)
    assert onset(np.array([1, 1, 1, 1, 1, 0, 0, 0, 0, 0, 0, 0], dtype=bool)) == (0, True)  # gone again
    assert onset(np.array([0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0], dtype=bool)) == (0, False)
    assert onset(np.array([True])) == (0, True)


def test_intervals_of_slopes_hold_the_truth_as_often_as_they_say() -> None:
    """Scatter between recordings that no single recording can know of is in the slope's interval."""
    rng = np.random.default_rng(4)
    at = START + DAY * np.sort(rng.uniform(0.0, 30.0, 12))
    for own, scatter in ((0.02, 0.0), (0.02, 0.1)):
        held = wide = 0
        for _ in range(400):
            value = 1.0 + 0.01 * (at - START) / DAY + rng.normal(0.0, np.hypot(own, scatter), len(at))
            found = trend(at, value, np.full(len(at), 2 * 1.96 * own))
            assert found is not None
            held += found.low < 0.01 < found.high
            wide += found.real
        assert 0.91 < held / 400 <= 1.0, (own, scatter)
        assert (wide > 390) == (scatter == 0.0)  # the louder one hides this slope now and then
    assert trend(at[:3], np.ones(3), np.ones(3)) is None
    assert trend(np.full(5, START), np.ones(5), np.ones(5)) is None


def result(robot: str, day: float, *effects: dict[str, Any], **changed: Any) -> dict[str, Any]:
    """Return one line of results.jsonl."""
    base = {
        "path": f"/{robot}/{day}", "robot": robot, "description": "thesis", "description_sha256": "a", "topics": {}, "seed": 0,
        "error": None, "sha256": "0", "time": START + DAY * day, "time_from": "stamps", "verdict": "explained",
        "effects": list(effects), "unknown": [], "seconds": 1.0,
    }
    return base | changed


def friction(value: float) -> dict[str, Any]:
    """Return an effect as report.json has it."""
    coulomb = {"value": value, "unit": "N m", "ci95": [value - 0.02, value + 0.02]}
    return {
        "name": "drive_coulomb_friction", "target": ["<b>front"], "probability": 1.0, "parameters": {"coulomb": coulomb},
        "ambiguous_with": ["rolling_resistance"],
    }


def test_what_was_repaired_is_gone_and_other_descriptions_do_not_mix(tmp_path: Path) -> None:
    """Ten days with friction, ten without; earlier results with another description; too short a recording."""
    lines = [result("amr", day, friction(0.3)) for day in range(10)]
    lines += [result("amr", day, verdict="no_mismatch") for day in range(10, 20)]
    lines += [result("amr", -5.0, friction(9.0), description_sha256="old")]
    lines += [result("amr", 20.5, verdict="insufficient_data"), result("amr", 21.0, error="<i>torn</i>", verdict=None)]
    lines += [result("amr", 22.0, unknown=[{"channel": "gyro", "depends_on": ["time"]}])]
    [robot] = histories(lines, {"amr": "a"})
    [effect] = robot.effects
    assert effect.gone
    assert effect.appeared is None
    said = " ".join(robot.sentences())
    assert "was there from the first recording and was named in 10 of 21 recordings since; it was last seen on" in said
    assert "and is gone" in said
    assert "may as well be rolling_resistance" in said
    assert "1 earlier result was made with another description" in said
    assert "1 recording holds too little motion" in said
    assert "left in gyro in 1 of 21 recordings" in said
    assert effect.parameters["coulomb"].trend is not None
    assert not effect.parameters["coulomb"].trend.real
    page = fleet_html([robot])
    assert "<b>front" not in page
    assert "<i>torn" not in page
    written = write_fleet_report([robot], tmp_path)
    assert written == tmp_path / "fleet.html"
    assert {entry.name for entry in tmp_path.iterdir()} == {"fleet.html", "fleet.json"}


def test_results_of_somebody_else_are_not_overwritten(tmp_path: Path) -> None:
    """A results.jsonl that is none is refused by its line."""
    (tmp_path / "results.jsonl").write_text('{"years": "of work"}\n')
    with pytest.raises(MismatchError, match=r"results.jsonl, line 1: is no result of mismatch fleet"):
        FleetResults(tmp_path)
    assert (tmp_path / "results.jsonl").read_text() == '{"years": "of work"}\n'


def test_a_changed_description_asks_for_a_new_analysis(tmp_path: Path) -> None:
    """The content of the description counts, not its name or layout."""
    (tmp_path / "sled.yaml").write_text(SLED)
    sled(tmp_path / "run.csv", 1.0, 1, 0)
    [before] = find_tasks([tmp_path / "run.csv"], FleetRobots.read([str(tmp_path / "sled.yaml")]), {}, 0)
    (tmp_path / "sled.yaml").write_text("# a comment\n" + SLED)
    [same] = find_tasks([tmp_path / "run.csv"], FleetRobots.read([str(tmp_path / "sled.yaml")]), {}, 0)
    (tmp_path / "sled.yaml").write_text(SLED.replace("20.0", "21.0"))
    [other] = find_tasks([tmp_path / "run.csv"], FleetRobots.read([str(tmp_path / "sled.yaml")]), {}, 0)
    assert before == same
    assert dataclasses.replace(other, description_sha256=before.description_sha256) == before
    assert other != before
