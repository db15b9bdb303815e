"""Imports only point left, ROS stays under nodes/, and each backend's library stays in its own modules.

    pcw_description  <-  pcw_estimation, pcw_control, pcw_terrain  <-  pcw_sim_bridge  <-  pcw_bringup_scripts

The first half reads every source file; the second imports every core in a process where ROS is blocked, which also finds what
reading cannot: an import by name, or a package whose `__init__` drags its nodes in.
"""

from __future__ import annotations

import ast
import graphlib
import os
import re
import subprocess
import sys
from pathlib import Path, PurePosixPath

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]

MAY_IMPORT = {
    "pcw_description": set(),
    "pcw_estimation": {"pcw_description"},
    "pcw_control": {"pcw_description"},
    "pcw_terrain": {"pcw_description"},
    "pcw_sim_bridge": {"pcw_description", "pcw_estimation", "pcw_control", "pcw_terrain"},
    "pcw_bringup_scripts": {
        "pcw_description",
        "pcw_estimation",
        "pcw_control",
        "pcw_terrain",
        "pcw_sim_bridge",
    },
}
ROS_MODULES = {
    "ament_index_python",
    "launch",
    "launch_ros",
    "launch_testing",
    "rcl_interfaces",
    "rclpy",
    "rosbag2_py",
    "rosidl_runtime_py",
    "tf2_ros",
}
ROS_SUFFIXES = ("_msgs", "_srvs", "_interfaces")

# Imports every core module of the package named in argv[1], with the modules named in argv[2:] and all of ROS blocked.
IMPORT_CORES = """
import importlib, importlib.abc, pkgutil, sys

package, blocked = sys.argv[1], set(sys.argv[2:])

class Blocker(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top in blocked or top.endswith(("_msgs", "_srvs", "_interfaces")):
            raise ImportError("blocked by the test: " + name)

sys.meta_path.insert(0, Blocker())
names = [package]
module = importlib.import_module(package)
for found in pkgutil.walk_packages(module.__path__, package + ".", onerror=lambda name: None):
    parts = found.name.split(".")
    engine = "plants" in parts and parts[-1].startswith(("pybullet", "mujoco"))
    backend = engine or parts[-1].split("_")[-1] == "can"
    if "nodes" not in parts and not backend:
        importlib.import_module(found.name)
        names.append(found.name)
leaked = sorted(name for name in sys.modules if name.partition(".")[0] in blocked)
assert not leaked, leaked
print(len(names))
"""


def is_ros(module: str) -> bool:
    return module in ROS_MODULES or module.endswith(ROS_SUFFIXES)


def imported_modules(tree: ast.AST, package: str, path: PurePosixPath) -> set[str]:
    """Absolute names of all modules that a file imports, in functions too; relative imports resolved."""
    inside = [package, *path.parts[:-1]]
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module or "")
            names.update(f"{node.module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join([*inside[: len(inside) - node.level + 1], *filter(None, [node.module])])
            names.add(base)
            names.update(f"{base}.{alias.name}" for alias in node.names)
    return names


def violations(package: str, path: str, source: str) -> list[str]:
    """What a file at `path` inside the Python package `package` imports and must not."""
    place = PurePosixPath(path)
    in_nodes = "nodes" in place.parts[:-1]
    backend = place.name if "plants" in place.parts[:-1] else ""
    in_can_module = "can" in place.stem.split("_") or "can" in place.parts[:-1]
    found = []
    for name in sorted(imported_modules(ast.parse(source), package, place)):
        top = name.partition(".")[0]
        if top in MAY_IMPORT and top != package and top not in MAY_IMPORT[package]:
            found.append(f"{name}: {package} may import only {sorted(MAY_IMPORT[package])}")
        if is_ros(top) and not in_nodes and package != "pcw_bringup_scripts":
            found.append(f"{name}: ROS lives only under nodes/")
        if top in MAY_IMPORT and ".nodes" in name and not in_nodes and package != "pcw_bringup_scripts":
            found.append(f"{name}: a core does not import nodes")
        if top in ("pybullet", "pybullet_data", "pybullet_utils") and not backend.startswith("pybullet"):
            found.append(f"{name}: PyBullet lives only in plants/pybullet*.py")
        comparing = "baselines" in place.parts[:-1]
        if top == "mujoco" and not (backend.startswith("mujoco") or comparing):
            found.append(f"{name}: MuJoCo lives only in plants/mujoco*.py, and in mismatch/baselines, which compares with it")
        if top == "can" and not in_can_module:
            found.append(f"{name}: python-can lives only in the CAN modules")
    return found


def source_files() -> list[tuple[str, str]]:
    """(package, path inside the Python package) of every source file."""
    found = []
    for package in MAY_IMPORT:
        folder = REPOSITORY / package / package
        found += [(package, path.relative_to(folder).as_posix()) for path in sorted(folder.rglob("*.py"))]
    return found


def test_every_package_has_source_files():
    """Otherwise the test below would pass on nothing."""
    assert {package for package, _ in source_files()} == set(MAY_IMPORT)


@pytest.mark.parametrize(("package", "path"), source_files())
def test_imports_only_point_left(package, path):
    source = (REPOSITORY / package / package / path).read_text(encoding="utf-8")
    assert violations(package, path, source) == []


def module_name(package: str, path: str) -> str:
    parts = [package, *PurePosixPath(path).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def arrows_between_modules() -> dict[str, set[str]]:
    """What every module imports. Imports inside a function and imports for types alone count too: they are arrows as well."""
    modules = {module_name(package, path): (package, path) for package, path in source_files()}
    arrows = {}
    for name, (package, path) in modules.items():
        tree = ast.parse((REPOSITORY / package / package / path).read_text(encoding="utf-8"))
        used = imported_modules(tree, package, PurePosixPath(path)) & set(modules)
        # `from . import x` names the package that x is in; the package's own __init__ is not what is meant.
        arrows[name] = {other for other in used if other != name and not name.startswith(f"{other}.")}
    return arrows


def test_no_modules_import_each_other_in_a_circle():
    graphlib.TopologicalSorter(arrows_between_modules()).prepare()  # raises CycleError, which names the circle


def test_folders_of_the_analyser_import_only_those_before_them_in_its_guide():
    inside = "pcw_sim_bridge.mismatch."
    guide = (REPOSITORY / "pcw_sim_bridge" / "docs" / "mismatch.md").read_text(encoding="utf-8")
    folders = re.findall(r"^\| `(\w+)` \| ", guide.partition("## Where it is in the source")[2], re.MULTILINE)
    paths = [path.split("/") for _, path in source_files()]
    assert set(folders) == {path[1] for path in paths if path[0] == "mismatch" and len(path) > 2}
    for name, used in arrows_between_modules().items():
        own = name.removeprefix(inside).partition(".")[0]
        if own in folders and name.startswith(inside):
            others = {other.removeprefix(inside).partition(".")[0] for other in used if other.startswith(inside)}
            assert others & set(folders) <= set(folders[: folders.index(own) + 1]), name


@pytest.mark.parametrize(
    ("package", "path", "source"),
    [
        ("pcw_description", "odometry.py", "import pcw_control"),
        ("pcw_control", "torque_limits.py", "from pcw_estimation.odometry import update"),
        ("pcw_control", "torque_limits.py", "def f():\n    import pcw_sim_bridge.plants"),
        ("pcw_estimation", "encoder_slip.py", "import rclpy"),
        ("pcw_estimation", "encoder_slip.py", "from sensor_msgs.msg import JointState"),
        ("pcw_estimation", "encoder_slip.py", "from .nodes import odometry"),
        ("pcw_estimation", "sub/encoder_slip.py", "from ..nodes.odometry import main"),
        ("pcw_sim_bridge", "plants/reduced.py", "import pybullet as p"),
        ("pcw_sim_bridge", "pybullet.py", "import pybullet"),
        ("pcw_sim_bridge", "plants/factory.py", "def f():\n    import mujoco.viewer"),
        ("pcw_sim_bridge", "plants/pybullet_plant.py", "from mujoco import MjModel"),
        ("pcw_sim_bridge", "plants/mujoco_plant.py", "import pybullet"),
        ("pcw_control", "scanner.py", "import can"),
    ],
)
def test_what_must_not_be_imported_is_found(package, path, source):
    assert len(violations(package, path, source)) >= 1


@pytest.mark.parametrize(
    ("package", "path", "source"),
    [
        ("pcw_control", "nodes/computed_torque.py", "import rclpy\nfrom pcw_control import computed_torque"),
        ("pcw_sim_bridge", "plants/pybullet.py", "import pybullet"),
        ("pcw_sim_bridge", "plants/mujoco_plant.py", "def f():\n    import mujoco.viewer"),
        ("pcw_sim_bridge", "plants/reduced.py", "from pcw_description.contact import kiencke"),
        ("pcw_bringup_scripts", "compose.py", "import rclpy\nfrom pcw_control.nodes import computed_torque"),
        ("pcw_control", "motor_can.py", "import can"),
    ],
)
def test_what_may_be_imported_is_left_alone(package, path, source):
    assert violations(package, path, source) == []


@pytest.mark.parametrize("package", [name for name in MAY_IMPORT if name != "pcw_bringup_scripts"])
def test_cores_import_where_ros_is_blocked(package):
    """In the installation: every module outside nodes/ and the backends, with ROS, both engines and python-can blocked."""
    blocked = sorted(ROS_MODULES | {"pybullet", "mujoco", "can"} | (set(MAY_IMPORT) - MAY_IMPORT[package] - {package}))
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_CORES, package, *blocked],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONWARNINGS": "ignore"},
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-1]) >= 1


def test_the_blocker_blocks():
    """A package that needs ROS at import fails in the process above, which is what makes its success mean something."""
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_CORES, "email", "email.message", "email"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode != 0
    assert "blocked by the test: email" in done.stderr
