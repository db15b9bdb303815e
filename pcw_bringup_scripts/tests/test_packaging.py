"""The six packages are what colcon, rosdep and `ros2 run` expect, and the installation holds all that the sources hold."""

from __future__ import annotations

import ast
import importlib.metadata
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from catkin_pkg.package import parse_package

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGES = (
    "pcw_description",
    "pcw_estimation",
    "pcw_control",
    "pcw_terrain",
    "pcw_sim_bridge",
    "pcw_bringup_scripts",
)
MAY_STAND_AT_THE_TOP = {*PACKAGES, "README.md", "LICENSE"}

# The rosdep key that brings a module, where it is not the module's own name (as it is for ROS packages).
KEY_OF_MODULE = {
    "PIL": "python3-pil",
    "can": "python3-can",
    "canopen": "canopen-pip",
    "cantools": "python3-cantools-pip",
    "jinja2": "python3-jinja2",
    "markupsafe": "python3-markupsafe",
    "lz4": "mcap-ros2-support",
    "matplotlib": "python3-matplotlib",
    "mcap": "mcap-ros2-support",
    "mcap_ros2": "mcap-ros2-support",
    "mujoco": "python3-mujoco-pip",
    "numba": "python3-numba",
    "numpy": "python3-numpy",
    "pybullet": "python3-pybullet-pip",
    "pytest": "python3-pytest",
    "quadprog": "quadprog-pip",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "yaml": "python3-yaml",
    "zstandard": "mcap-ros2-support",
}
# Modules that rosdep has no key for: only an extra may bring them.
WITHOUT_KEY = {"distributed", "threadpoolctl"}
# Needed without being imported.
NOT_IMPORTED = {"ros2launch", "python3-msgpack"}


def prefix_of(package: str) -> Path:
    """The folder that the package is installed in."""
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix and (Path(prefix) / "share/ament_index/resource_index/packages" / package).is_file():
            return Path(prefix)
    pytest.fail(f"{package} is in no prefix of AMENT_PREFIX_PATH: run ./pcw_bringup_scripts/test, or build and source it")


def imports_of(package: str) -> set[str]:
    """Top-level modules that the package and its launch files import, standard library and itself left out."""
    modules = set()
    for path in [*(REPOSITORY / package / package).rglob("*.py"), *(REPOSITORY / package).glob("launch/**/*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                modules.update(alias.name.partition(".")[0] for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                modules.add((node.module or "").partition(".")[0])
    return modules - set(sys.stdlib_module_names) - {package}


def optional_modules_of(package: str) -> set[str]:
    """Modules that only an extra of the package, other than `test`, asks for; their distributions have the same names."""
    requirements = importlib.metadata.requires(package.replace("_", "-")) or []
    found = [re.match(r"(\w+)[^;]*; extra == [\"'](\w+)[\"']", requirement) for requirement in requirements]
    return {match[1] for match in found if match and match[2] != "test"}


def tracked_files() -> list[str]:
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True)
    if listing.returncode:
        pytest.skip("not a git work tree")
    return [name for name in listing.stdout.split("\0") if name and (REPOSITORY / name).is_file()]


@pytest.mark.parametrize("package", PACKAGES)
def test_package_xml_is_valid(package):
    """A maintainer e-mail that does not parse would silently turn the package into plain Python for colcon."""
    warnings: list[str] = []
    manifest = parse_package(str(REPOSITORY / package), warnings=warnings)
    manifest.validate(warnings=warnings)
    assert warnings == []
    assert manifest.package_format == 3
    assert manifest.name == package
    assert manifest.get_build_type() == "ament_python"
    assert manifest.licenses == ["Apache-2.0"]
    assert [bool(re.fullmatch(r"[\w.+-]+@[\w-]+(\.[\w-]+)+", m.email)) for m in manifest.maintainers] == [True]
    assert "python3-pytest" in {dependency.name for dependency in manifest.test_depends}


@pytest.mark.parametrize("package", PACKAGES)
def test_versions_and_licence_agree(package):
    manifest = parse_package(str(REPOSITORY / package))
    metadata = importlib.metadata.metadata(package.replace("_", "-"))
    assert metadata["Version"] == manifest.version
    assert metadata["License"] == "Apache-2.0"
    assert "test" in metadata.get_all("Provides-Extra"), "without it `colcon test` runs nothing and calls that a success"
    changelog = (REPOSITORY / package / "CHANGELOG.rst").read_text(encoding="utf-8")
    newest, _ = re.findall(r"^(\d+\.\d+\.\d+) \((forthcoming|\d{4}-\d\d-\d\d)\)$", changelog, flags=re.MULTILINE)[0]
    assert newest == manifest.version


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_and_declared_dependencies_agree(package):
    """What an extra brings is a dependency of the tests alone, so that nobody has to install it."""
    manifest = parse_package(str(REPOSITORY / package))
    declared = {dependency.name for dependency in manifest.exec_depends}
    optional = optional_modules_of(package)
    assert optional <= imports_of(package), "an extra that nothing imports"
    tested = {dependency.name for dependency in manifest.test_depends}
    assert {KEY_OF_MODULE[module] for module in optional - WITHOUT_KEY} <= tested
    needed = {KEY_OF_MODULE.get(module, module) for module in imports_of(package) - optional}
    # The plugin that the test command loads is no part of what the package does.
    needed -= {"python3-pytest"}
    assert needed - declared == set(), "imported but not in package.xml"
    assert declared - needed - NOT_IMPORTED == set(), "in package.xml but not imported"


@pytest.mark.parametrize("package", PACKAGES)
def test_readme_says_why_each_dependency_is_there(package):
    manifest = parse_package(str(REPOSITORY / package))
    declared = {dependency.name for dependency in [*manifest.exec_depends, *manifest.test_depends]}
    readme = (REPOSITORY / package / "README.md").read_text(encoding="utf-8")
    explained = set(re.findall(r"^\| `([\w-]+)`(?: \(test\))? \| \S.*\|$", readme, flags=re.MULTILINE))
    assert declared - explained == set()


@pytest.mark.parametrize("package", PACKAGES)
def test_every_executable_stands_where_ros2_run_looks(package):
    declared = set(re.findall(r'"(\w+) = ([\w.]+:main)"', (REPOSITORY / package / "setup.py").read_text(encoding="utf-8")))
    assert declared, "a package without executables"
    installed = importlib.metadata.distribution(package.replace("_", "-")).entry_points
    assert {(entry.name, entry.value) for entry in installed if entry.group == "console_scripts"} == declared
    folder = prefix_of(package) / "lib" / package
    assert {path.name for path in folder.iterdir()} >= {name for name, _ in declared}
    for name, _ in declared:
        assert os.access(folder / name, os.X_OK), name
        assert (folder / name).read_text(encoding="utf-8").startswith("#!")


@pytest.mark.parametrize(
    ("package", "name", "value"),
    [
        (package, *match)
        for package in PACKAGES
        for match in re.findall(r'"(\w+) = ([\w.]+:main)"', (REPOSITORY / package / "setup.py").read_text(encoding="utf-8"))
    ],
)
def test_every_executable_has_its_function(package, name, value):
    [entry] = importlib.metadata.entry_points(group="console_scripts", name=name, value=value)
    assert callable(entry.load())


@pytest.mark.parametrize("package", PACKAGES)
def test_every_executable_stands_in_the_tables_of_the_readmes(package):
    """In the table of its package by a row of its own, and in the row of its package at the top."""
    declared = set(re.findall(r'"(\w+) = [\w.]+:main"', (REPOSITORY / package / "setup.py").read_text(encoding="utf-8")))
    readme = (REPOSITORY / package / "README.md").read_text(encoding="utf-8").partition("## Executables")[2]
    assert declared - set(re.findall(r"^\| `(\w+)", readme, flags=re.MULTILINE)) == set()
    top = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    [row] = re.findall(rf"^\| \[{package}\]\(.*$", top, flags=re.MULTILINE)
    assert set(re.findall(r"`(\w+)`", row)) == declared


WHERE_PAGES_LIE = ("README.md", "pcw_*/README.md", "pcw_*/docs/*.md")
PAGES = sorted(path.relative_to(REPOSITORY).as_posix() for pattern in WHERE_PAGES_LIE for path in REPOSITORY.glob(pattern))


def anchors_of(page: Path) -> set[str]:
    """What links to a heading of a page call it, as the sites that show such pages form it."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_names_is_there(page):
    """Every `ros2 run PACKAGE EXECUTABLE`, every `./pcw_bringup_scripts/...` command and every linked file and heading."""
    text = (REPOSITORY / page).read_text(encoding="utf-8")
    for package, executable in re.findall(r"(?:ros2 run|pcw_bringup_scripts/run) +(pcw_\w+) +([a-z]\w*)", text):
        declared = (REPOSITORY / package / "setup.py").read_text(encoding="utf-8")
        assert f'"{executable} = {package}.' in declared, f"{package} has no executable {executable}"
    for path in re.findall(r"\./(pcw_bringup_scripts/[\w./]+)", text):
        assert (REPOSITORY / path).is_file(), path
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)(?:#([^)\s]*))?\)", text):
        linked = (REPOSITORY / page).parent / target if target else REPOSITORY / page
        assert linked.exists(), target
        assert not anchor or anchor in anchors_of(linked), f"{target}#{anchor}"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_topic_of_a_node_stands_in_the_table_of_topics(package):
    table = (REPOSITORY / "README.md").read_text(encoding="utf-8").partition("\n## Topics\n")[2].partition("\n## ")[0]
    listed = set(re.findall(r"`([\w/]+)`", "".join(line.split("|")[1] for line in table.splitlines() if line.startswith("|"))))
    sources = (REPOSITORY / package / package / "nodes").glob("*.py")
    text = "".join(path.read_text(encoding="utf-8") for path in sources)
    topics = set(re.findall(r"create_(?:publisher|subscription)\(\w+, \"([\w/]+)\"", text))
    assert topics <= listed, sorted(topics - listed)


@pytest.mark.parametrize("package", PACKAGES)
def test_installation_holds_every_file_of_the_sources(package):
    """A folder without `__init__.py`, or a template that package_data does not name, is missing from an installation."""
    source = REPOSITORY / package / package
    [installed] = {path.parent for path in prefix_of(package).rglob(f"*-packages/{package}/__init__.py")}

    def files(folder: Path) -> set[str]:
        # Caches, of Python's or in a hidden folder, are no sources.
        return {
            path.relative_to(folder).as_posix()
            for path in folder.rglob("*")
            if path.is_file() and not any(p == "__pycache__" or p.startswith(".") for p in path.relative_to(folder).parts)
        }

    assert files(source) - files(installed) == set()
    assert {name for name in files(installed) - files(source) if name.endswith(".py")} == set()
    share = prefix_of(package) / "share" / package
    for folder in ("config", "launch"):
        if (REPOSITORY / package / folder).is_dir():
            assert files(REPOSITORY / package / folder) - files(share / folder) == set()


@pytest.mark.parametrize("package", PACKAGES)
def test_python_examples_of_a_readme_run_in_their_order(package, tmp_path):
    """In one folder: a later one may read what an earlier one has written."""
    text = (REPOSITORY / package / "README.md").read_text(encoding="utf-8")
    examples = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert examples
    for example in examples:
        done = subprocess.run([sys.executable, "-c", example], cwd=tmp_path, capture_output=True, text=True, timeout=250)
        assert done.returncode == 0, done.stderr


def test_only_the_packages_stand_at_the_top():
    visible = {name.partition("/")[0] for name in tracked_files() if not name.startswith(".")}
    assert visible - MAY_STAND_AT_THE_TOP == set()


def test_no_file_names_a_path_of_one_machine():
    machine_path = re.compile(r"(?<![\w.$}~-])/(?:home|root|Users)/\w")
    offenders = []
    for name in tracked_files():
        content = (REPOSITORY / name).read_bytes()
        if b"\0" not in content and machine_path.search(content.decode("utf-8", errors="replace")):
            offenders.append(name)
    assert offenders == []


@pytest.mark.parametrize("name", ["bootstrap", "runtime", "test", "baselines"])
def test_every_requirement_is_pinned_and_hashed(name):
    folder = REPOSITORY / "pcw_bringup_scripts/requirements"
    lock = (folder / f"{name}.txt").read_text(encoding="utf-8")
    entries = [line for line in lock.replace("\\\n", " ").splitlines() if line.strip() and not line.startswith("#")]
    assert entries
    for entry in entries:
        assert re.match(r"[\w.-]+==\S+ .*--hash=sha256:[0-9a-f]{64}", entry), entry
    assert "://" not in lock and "index-url" not in lock
    wanted = re.findall(r"^([A-Za-z][\w.-]*)", (folder / f"{name}.in").read_text(encoding="utf-8"), flags=re.MULTILINE)
    pinned = {re.split("==", entry)[0] for entry in entries}
    assert set(wanted) - pinned == set(), "run requirements/lock"
