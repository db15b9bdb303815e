"""What the launch files start is there, takes the parameters that they give, and has the defaults that they promise.

`launch` is not everywhere installed: the files run against a stand-in that keeps what they make.
"""

import importlib
import importlib.metadata
import re
import runpy
import sys
import types
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from pcw_description.nodes.node_help import parameters_of  # noqa: E402

REPOSITORY = Path(__file__).resolve().parents[2]
FILES = {path.name: path for path in sorted(REPOSITORY.glob("*/launch/*.launch.py"))}
MODULES = (
    "launch", "launch.action", "launch.actions", "launch.conditions", "launch.launch_description_sources",
    "launch.substitutions", "launch_ros", "launch_ros.actions", "launch_ros.parameter_descriptions",
    "launch_ros.substitutions",
)  # fmt: skip
ENTRIES = {
    (entry.module.partition(".")[0], entry.name): entry.module
    for entry in importlib.metadata.entry_points(group="console_scripts")
    if entry.module.startswith("pcw_")
}


class Made:
    """Anything that a launch file makes: its class's name, and what it was made with."""

    def __init__(self, kind, given, named, defaults):
        self.kind, self.given, self.named, self._defaults = kind, given, named, defaults

    def perform(self, context):
        """The value of a LaunchConfiguration where nobody gives one."""
        return context.get(self.given[0], self._defaults.get(self.given[0]))


def executed(path, monkeypatch, **context):
    """All that a launch file makes, with the arguments of the context in place of its defaults."""
    everything, defaults = [], {}

    def maker(kind):
        def make(*given, **named):
            made = Made(kind, given, named, defaults)
            everything.append(made)
            if kind == "DeclareLaunchArgument":
                defaults[given[0]] = named["default_value"]
            return made

        return make

    for name in MODULES:
        module = types.ModuleType(name)
        module.__getattr__ = lambda kind: maker(kind)
        monkeypatch.setitem(sys.modules, name, module)
    runpy.run_path(str(path))["generate_launch_description"]()
    for made in [made for made in everything if made.kind == "OpaqueFunction"]:
        made.named["function"](context)
    return everything, defaults


def constant_of(value, defaults, kind=str):
    """What a parameter is set to where nobody gives an argument; None where that is an expression."""
    if not isinstance(value, Made):
        return value
    if value.kind == "ParameterValue":
        return constant_of(value.given[0], defaults, value.named["value_type"])
    if value.kind != "LaunchConfiguration":
        return None
    text = defaults[value.given[0]]
    return text == "true" if kind is bool else kind(text)


def test_there_are_launch_files_and_the_readmes_name_each():
    readmes = "".join(path.read_text(encoding="utf-8") for path in REPOSITORY.glob("*/README.md"))
    assert len(FILES) >= 9
    assert [name for name in FILES if name not in readmes] == []


@pytest.mark.parametrize("name", FILES)
def test_every_node_is_there_and_takes_what_it_is_given(name, monkeypatch):
    everything, defaults = executed(FILES[name], monkeypatch)
    used = {made.given[0] for made in everything if made.kind == "LaunchConfiguration"}
    assert used <= set(defaults), "an argument that is not declared"
    for made in everything:
        if made.kind not in ("Node", "LifecycleNode"):
            continue
        module = importlib.import_module(ENTRIES[made.named["package"], made.named["executable"]])
        [factory] = re.findall(r"run_node\((\w+)", Path(module.__file__).read_text(encoding="utf-8")) or [None]
        parameters = {name: value for given in made.named.get("parameters", []) for name, value in given.items()}
        if factory is None:  # a program with options of its own
            assert not parameters
            continue
        declared = {entry.name: entry for entry in parameters_of(getattr(module, factory))}
        assert set(parameters) <= set(declared)
        for parameter, value in parameters.items():
            constant, default = constant_of(value, defaults), declared[parameter].default
            if constant is not None:
                assert isinstance(constant, type(default))
                assert not isinstance(value, Made) or constant == default or (parameter, constant) in OTHERWISE
                choices = declared[parameter].choices
                assert choices is None or constant in choices


# What a launch file starts otherwise than the node by itself: slip_fusion beside odometry; no recording by default.
OTHERWISE = {("publish_odom", False), ("output", "")}


@pytest.mark.parametrize("name", FILES)
def test_every_part_is_there_and_takes_what_it_is_given(name, monkeypatch):
    everything, _ = executed(FILES[name], monkeypatch)
    for made in everything:
        if made.kind == "IncludeLaunchDescription":
            package, folder, file = made.given[0].given[0].given[0]
            path = REPOSITORY / package.given[0] / folder / file
            assert path.is_file()
            _, defaults = executed(path, monkeypatch)
            taken = set(defaults)
            for deeper in executed(path, monkeypatch)[0]:  # a file that only hands on
                if deeper.kind == "IncludeLaunchDescription":
                    taken |= set(executed(path.parent / deeper.given[0].given[0].given[0][2], monkeypatch)[1])
            assert {argument for argument, _ in made.named["launch_arguments"]} <= taken


def test_robot_state_publisher_gets_the_urdf(monkeypatch):
    everything, _ = executed(FILES["robot_description.launch.py"], monkeypatch, frames="true")
    [node] = [made for made in everything if made.kind == "Node"]
    assert node.named["package"] == "robot_state_publisher"
    assert node.named["parameters"][0]["robot_description"].lstrip().startswith("<")
