"""The set-up: safe to run twice, honest when it cannot, and no trace in the shell that sources it but the environment."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SCRIPTS = REPOSITORY / "pcw_bringup_scripts"
ENTRY_POINTS = [SCRIPTS / "setup_env.sh", SCRIPTS / "demo", SCRIPTS / "test", SCRIPTS / "run", REPOSITORY / ".ci/run"]

set_up_here = pytest.mark.skipif(
    not (REPOSITORY / ".venv/.pcw/test").is_file(), reason="this clone was not set up by setup_env.sh"
)


def clean_environment(**changes: str) -> dict[str, str]:
    """This process's environment without what the set-up itself has put there, so that a run starts as from a new shell.

    The user's PCW_PYTHON and PCW_ROS_SETUP stay: without them a run in this clone would set it up anew, otherwise.
    """
    ours = ("ROS_", "RMW_", "FASTRTPS_", "AMENT_", "COLCON_", "VIRTUAL_ENV", "PYTHONPATH", "PIP_FIND_LINKS")
    return {**{name: value for name, value in os.environ.items() if not name.startswith(ours)}, **changes}


def bash(script: str, cwd: Path = REPOSITORY, timeout: float = 120, **changes: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", "-c", script],
        cwd=cwd,
        env=clean_environment(**changes),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=timeout,
    )


@pytest.fixture
def empty_clone(tmp_path: Path) -> Path:
    """A clone that was never set up."""
    shutil.copytree(SCRIPTS, tmp_path / "clone/pcw_bringup_scripts", ignore=shutil.ignore_patterns("__pycache__"))
    return tmp_path / "clone"


def fake_python(folder: Path, exit_code: int) -> Path:
    """An interpreter that ends with `exit_code` when it is probed."""
    path = folder / "python-fake"
    path.write_text(f"#!/bin/sh\nexit {exit_code}\n")
    path.chmod(0o755)
    return path


@pytest.mark.parametrize("script", ENTRY_POINTS, ids=lambda path: path.name)
def test_scripts_parse_and_are_executable(script):
    assert subprocess.run(["bash", "-n", str(script)], capture_output=True, text=True).stderr == ""
    assert script.stat().st_mode & stat.S_IXUSR


@set_up_here
def test_second_run_does_nothing():
    before = (REPOSITORY / ".venv/.pcw/runtime").stat().st_mtime_ns
    first = bash("pcw_bringup_scripts/setup_env.sh --test")  # whatever was edited since the tests began is built here
    assert first.returncode == 0, first.stderr
    second = bash("pcw_bringup_scripts/setup_env.sh --test")
    assert second.returncode == 0, second.stderr
    assert second.stderr.count("[pcw]") == 1 and "[pcw] ready in" in second.stderr
    assert (REPOSITORY / ".venv/.pcw/runtime").stat().st_mtime_ns == before


@set_up_here
def test_sourcing_sets_the_environment_and_nothing_else():
    done = bash(
        "set -eu; before=$(declare -F); source pcw_bringup_scripts/setup_env.sh --runtime;"
        'test "$before" = "$(declare -F)"; case $- in *e*u*|*u*e*) ;; *) exit 7;; esac;'
        'echo "$ROS_AUTOMATIC_DISCOVERY_RANGE $RMW_IMPLEMENTATION"; test -f "$FASTRTPS_DEFAULT_PROFILES_FILE";'
        'python -c "import pcw_description; print(pcw_description.__file__)"'
    )
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()
    assert first == "LOCALHOST rmw_fastrtps_cpp"
    assert str(REPOSITORY / ".colcon/install") in second


@set_up_here
def test_what_the_user_has_set_is_kept():
    done = bash(
        'source pcw_bringup_scripts/setup_env.sh --runtime; echo "$ROS_AUTOMATIC_DISCOVERY_RANGE $RMW_IMPLEMENTATION"',
        ROS_AUTOMATIC_DISCOVERY_RANGE="SUBNET",
        RMW_IMPLEMENTATION="rmw_cyclonedds_cpp",
    )
    assert done.stdout.split() == ["SUBNET", "rmw_cyclonedds_cpp"]


@set_up_here
def test_run_names_what_there_is():
    done = bash("pcw_bringup_scripts/run pcw_terrain no_such_executable")
    assert done.returncode == 2
    assert "no_such_executable" in done.stderr and "pcw_sim_bridge bridge" in done.stderr


def test_a_path_with_a_space_is_refused(tmp_path):
    """The first line of an executable cannot name an interpreter in it; without this, every node would be 'not found'."""
    shutil.copytree(SCRIPTS, tmp_path / "my robot/pcw_bringup_scripts", ignore=shutil.ignore_patterns("__pycache__"))
    done = bash("pcw_bringup_scripts/setup_env.sh", cwd=tmp_path / "my robot")
    assert done.returncode == 1
    assert "space" in done.stderr and "my robot" in done.stderr
    assert not (tmp_path / "my robot/.colcon").exists()


def test_a_failure_leaves_the_sourcing_shell_alive():
    done = bash("source pcw_bringup_scripts/setup_env.sh --no-such-option || echo still here")
    assert done.stdout == "still here\n"
    assert "Unknown argument: --no-such-option" in done.stderr and "Allowed: --runtime, --test" in done.stderr


@pytest.mark.parametrize("script", ["demo", "test", "setup_env.sh", "run"])
def test_a_python_that_does_not_run_is_named(empty_clone, script):
    done = bash(f"pcw_bringup_scripts/{script}", cwd=empty_clone, PCW_PYTHON="/nonexistent/python3.12")
    assert done.returncode == 1
    assert "PCW_PYTHON=/nonexistent/python3.12 does not run" in done.stderr
    assert "Remedy:" in done.stderr and "3.11 or 3.12" in done.stderr
    assert not (empty_clone / ".venv").exists()


@pytest.mark.parametrize(
    ("exit_code", "message"), [(3, "neither Python 3.11 nor 3.12"), (4, "cannot make virtual environments")]
)
def test_a_python_that_does_not_fit_is_named(empty_clone, exit_code, message):
    python = fake_python(empty_clone, exit_code)
    done = bash("pcw_bringup_scripts/setup_env.sh", cwd=empty_clone, PCW_PYTHON=str(python))
    assert done.returncode == 1
    assert message in done.stderr and str(python) in done.stderr


def test_no_fitting_python_at_all(empty_clone):
    """With nothing but broken interpreters on the PATH (a pyenv shim of a version that is not there is such a one)."""
    tools = empty_clone / "bin"
    tools.mkdir()
    for name in ("python3.11", "python3.12", "python3", "python"):
        fake_python(tools, 127).rename(tools / name)
    done = bash(
        "pcw_bringup_scripts/setup_env.sh",
        cwd=empty_clone,
        PATH=f"{tools}{os.pathsep}{os.environ['PATH']}",
        PCW_ROS_SETUP="none",
        PCW_PYTHON="",
    )
    assert done.returncode == 1
    assert "No Python 3.11 or 3.12 found (tried: python3.11 python3.12 python3 python)" in done.stderr
    assert "PCW_PYTHON=" in done.stderr


def test_no_network_is_said_and_the_next_run_starts_anew(empty_clone):
    """Half an environment is left behind; its stamp, written last, is missing, so it is not taken for a whole one."""
    offline = {"PIP_NO_INDEX": "1", "PIP_CONFIG_FILE": os.devnull, "PCW_ROS_SETUP": "none"}
    first = bash("pcw_bringup_scripts/setup_env.sh", cwd=empty_clone, **offline)
    assert first.returncode == 1
    assert "uv could not be installed" in first.stderr
    assert "registry could not be reached" in first.stderr and "run the command again" in first.stderr
    assert (empty_clone / ".venv").is_dir()
    second = bash("pcw_bringup_scripts/setup_env.sh", cwd=empty_clone, **offline)
    assert "unfinished or out of date: making it anew" in second.stderr


def test_a_second_set_up_waits_for_the_first(empty_clone):
    if shutil.which("flock") is None:
        pytest.skip("no flock on this machine")
    (empty_clone / ".colcon").mkdir()
    done = bash(
        "flock .colcon/lock sleep 2 & sleep 0.5; pcw_bringup_scripts/setup_env.sh",
        cwd=empty_clone,
        PCW_PYTHON="/nonexistent/python3.12",
    )
    waiting, failing = done.stderr.find("waiting for it"), done.stderr.find("does not run")
    assert 0 <= waiting < failing


def test_only_what_the_system_lacks_is_installed_on_top_of_ros(tmp_path):
    """pytest is here and stays the system's; ROS never comes from a wheel; what is missing keeps its marker and its hashes."""
    digest = "0" * 64
    missing = f"no-such-thing==1.0 ; sys_platform == 'win32' \\\n    --hash=sha256:{digest} \\\n    --hash=sha256:{digest}\n"
    lock = tmp_path / "lock.txt"
    lock.write_text(f"pytest==8.0 \\\n    --hash=sha256:{digest}\nros-rclpy==1.0 \\\n    --hash=sha256:{digest}\n{missing}")
    command = [sys.executable, str(SCRIPTS / "requirements/select_missing.py"), str(lock)]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == missing


def test_another_ros_in_the_shell_is_left_behind(empty_clone):
    """Its libraries and modules would be mixed with those of the wheels."""
    script = (SCRIPTS / "setup_env.sh").read_text(encoding="utf-8")
    function = script[script.index("_pcw_leave_other_ros() {") :].partition("\n}\n")[0] + "\n}\n"
    done = bash(
        function + '_pcw_leave_other_ros; echo "$PYTHONPATH|$LD_LIBRARY_PATH|${ROS_DISTRO-none}|${AMENT_PREFIX_PATH-none}"',
        ROS_DISTRO="humble",
        AMENT_PREFIX_PATH="/ws/install/a:/opt/ros/humble",
        PYTHONPATH="/ws/install/a/lib/python:/mine:/opt/ros/humble/lib/python3.10/site-packages",
        LD_LIBRARY_PATH="/opt/ros/humble/lib:/usr/local/lib:/other/.venv/lib/python3.11/site-packages/ros_rcl.libs",
    )
    assert done.stdout.strip() == "/mine|/usr/local/lib|none|none"
