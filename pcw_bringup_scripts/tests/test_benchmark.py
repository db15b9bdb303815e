"""The benchmark measures everything it names and never judges by its exit status."""

from __future__ import annotations

import json
import math

import pytest

from pcw_bringup_scripts import benchmark


@pytest.mark.nightly  # compiles nearly all kernels there are
def test_one_run_prints_and_writes_every_figure(tmp_path, capsys):
    file = tmp_path / "figures.json"
    assert benchmark.main(["--repeats", "1", "--json", str(file)]) == 0
    content = json.loads(file.read_text())
    assert content["format"] == "pcw_benchmark/1"
    assert content["machine"]["cores"]
    table = capsys.readouterr().out
    targets = {}
    for result in content["results"]:
        assert result["note"] == ""
        assert math.isfinite(result["best"]) and result["best"] > 0.0
        assert result["best"] == result["median"]  # one repeat
        assert result["name"] in table
        if result["target"] is not None:
            targets[result["name"].partition(" ")[0], result["unit"], result["target"]] = result["reached"]
    # The targets of the package set, each with a mark, whichever it is.
    assert set(targets) == {
        ("forward", "us", 20.0),
        ("slip", "us", 15.0),
        ("the", "us", 15.0),
        ("slip", "us", 5.0),
        ("Lambda", "us", 5.0),
        ("slip", "us", 40.0),
        ("angle-only", "us", 40.0),
        ("terrain", "us", 20.0),
        ("reduced", "x real time", 800.0),
        ("reduced", "x real time", 200.0),
        ("PyBullet", "x real time", 8.0),
        ("reduced", "x real time", 300.0),
        ("PyBullet", "x real time", 6.0),
    }
    assert table.count("  ok\n") == sum(targets.values())
    assert table.count("  MISSED\n") == len(targets) - sum(targets.values())


def test_less_is_better_for_a_time_and_more_for_a_rate():
    for value, is_less in ((4.9, True), (5.1, False)):
        assert benchmark.Result("it", "us", 5.0, best=value, median=value).reached is is_less
        assert benchmark.Result("it", "x real time", 5.0, best=value, median=value).reached is not is_less
    assert benchmark.Result("it", "us", None, best=1.0, median=1.0).reached is None
    assert benchmark.Result("it", "us", 5.0, note="not installed").reached is None


def test_what_cannot_run_says_why():
    def prepare(robot):
        raise ImportError("No module named 'pybullet'")

    result = benchmark.measure(benchmark.Task("plant", "x real time", 8.0, prepare), robot=None, repeats=3)
    assert result.best is None
    assert benchmark.row(result).endswith("No module named 'pybullet'")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--robot", "thesiss"], "did you mean 'thesis'"),
        (["--robot", "mpo700"], "torque control needs at least 0.001 m"),
        (["--repeats", "0"], "--repeats: 0 is not allowed; allowed: at least 1"),
        (["--json", "no/such/folder/figures.json"], "no/such/folder; allowed: a file in a folder that exists"),
        (["--json", "."], "--json .: exists already and is left as it is; allowed: a new file"),
    ],
)
def test_bad_input_ends_with_status_2_and_one_line(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        benchmark.main(arguments)
    assert end.value.code == 2
    assert message in capsys.readouterr().err
