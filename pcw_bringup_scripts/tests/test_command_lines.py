"""Every executable says what it is for, and says so of arguments that it does not know."""

import ast
import importlib.metadata
import os
import re
import subprocess
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
EXECUTABLES = sorted(
    (entry.module.partition(".")[0], entry.name, entry.module)
    for entry in importlib.metadata.entry_points(group="console_scripts")
    if entry.module.startswith("pcw_")
)
NODES = [(package, name, module) for package, name, module in EXECUTABLES if ".nodes." in module]


def test_the_executables_of_all_packages_are_found():
    assert {package for package, _, _ in EXECUTABLES} == {path.parent.name for path in REPOSITORY.glob("*/package.xml")}
    assert len(NODES) >= 16


def run(folder: Path, package: str, name: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run an executable in an empty folder; a node that starts after all is ended, and fails the test."""
    [executable] = {
        path.resolve() for prefix in os.environ["AMENT_PREFIX_PATH"].split(os.pathsep)
        if (path := Path(prefix) / "lib" / package / name).is_file()
    }  # fmt: skip
    return subprocess.run(
        [executable, *arguments],
        cwd=folder, capture_output=True, text=True, timeout=100,
        env={**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("package", "name", "module"),
    [  # every day all nodes, and a third of the rest, which take as long to import
        pytest.param(*entry, marks=() if entry in NODES or k % 3 == 0 else pytest.mark.nightly)
        for k, entry in enumerate(EXECUTABLES)
    ],
)
def test_help_is_printed_and_nothing_is_done(tmp_path, package, name, module):
    """`--help` of a recorder made a folder and recorded, that of a controller drove."""
    done = run(tmp_path, package, name, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert list(tmp_path.iterdir()) == []
    source = (REPOSITORY / package / Path(*module.split("."))).with_suffix(".py")
    if (package, name, module) in NODES:
        about = ast.get_docstring(ast.parse(source.read_text(encoding="utf-8")))
        assert done.stdout.startswith(f"{about}\n")
        assert re.search(r"^  \w+ +(bool|integer|double|string)(_array)?  default ", done.stdout, flags=re.MULTILINE)
    else:
        assert name in done.stdout


@pytest.mark.parametrize(
    ("package", "name"),
    [  # all nodes read their arguments by the same lines
        *(pytest.param(*node[:2], marks=() if k % 6 == 0 else pytest.mark.nightly) for k, node in enumerate(NODES)),
        ("pcw_bringup_scripts", "compose"),
    ],
)
def test_an_argument_that_is_none_is_refused(tmp_path, package, name):
    """`command_latency --controller slip_constraint_force` measured computed_torque, without a word."""
    done = run(tmp_path, package, name, "--not_an_option")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"{name}: ") and "'--not_an_option'" in done.stderr and done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_demonstration_that_cannot_make_its_folder_says_so(tmp_path):
    (tmp_path / "file").write_text("precious", encoding="utf-8")
    done = run(tmp_path, "pcw_bringup_scripts", "demo_run", "--out", "file/demo", "--plant", "reduced")
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "demo_run: --out file/demo: " in done.stderr and "Not a directory" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_list_of_buses_is_not_drowned_in_what_python_can_lacks_for_others(tmp_path):
    done = run(tmp_path, "pcw_sim_bridge", "can_doctor", "--list")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout
