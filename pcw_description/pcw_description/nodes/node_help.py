"""The command line of a node: what `--help` prints, and what is said of an argument that is none of ROS.

The parameters are those that the constructor of a node declares. It runs without a node behind it and ends at `all_declared`,
so that nothing is published, opened or made.
"""

from __future__ import annotations

import array
import difflib
import shutil
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rclpy.lifecycle import LifecycleNodeMixin
from rclpy.node import Node
from rclpy.parameter import Parameter

from .node_parameters import AllDeclared, DeclaredParameter, sketch, type_name

NARROWEST, WIDEST = 60, 128  # [characters]
HOW_TO_GIVE = """\
Parameters are given as

    --ros-args -p NAME:=VALUE -p NAME:=VALUE
    --ros-args --params-file FILE.yaml

A double is written with a point (2.0, not 2). What is fixed is read at the start, the rest can be set while the node runs.
`--ros-args -r FROM:=TO` renames a topic, `-r __ns:=/NAMESPACE` puts all of them into a namespace."""


# --- The parameters of a node that is not made ----------------------------------------------------------


def parameters_of(factory: Callable[[], Node]) -> list[DeclaredParameter]:
    """Return what a node would declare, without making it."""
    with sketch() as declared, _no_node_behind():
        try:
            factory()
        except AllDeclared:
            return declared
    raise TypeError(f"{factory.__name__} does not say all_declared(self) after its parameters")


@contextmanager
def _no_node_behind() -> Iterator[None]:
    """Have the constructors of rclpy's nodes do nothing."""
    bases: tuple[Any, ...] = (Node, LifecycleNodeMixin)
    kept = [base.__init__ for base in bases]
    for base in bases:
        base.__init__ = lambda self, *_, **__: None
    try:
        yield
    finally:
        for base, constructor in zip(bases, kept):  # noqa: B905 - made from it
            base.__init__ = constructor


# --- Help -----------------------------------------------------------------------------------------------


def help_text(factories: Sequence[Callable[[], Node]]) -> str:
    """Return what an executable is for, by the docstring of its module, and the parameters of its nodes."""
    about = (sys.modules[factories[0].__module__].__doc__ or "").strip()
    return "\n\n".join([about, HOW_TO_GIVE, *map(parameter_table, factories)])


def parameter_table(factory: Callable[[], Node]) -> str:
    """Return the parameters of a node: name, type, default and what is allowed, and below what each means."""
    declared = parameters_of(factory)
    if not declared:
        return "  (no parameters)"
    names = max(len(entry.name) for entry in declared)
    kinds = max(len(type_name(entry.default)) for entry in declared)
    width = min(max(shutil.get_terminal_size((WIDEST, 0)).columns, NARROWEST), WIDEST)
    indent = " " * min(names + kinds + 6, width // 2)
    lines = []
    for entry in declared:
        start = f"  {entry.name:{names}}  {type_name(entry.default):{kinds}}  "
        facts = "; ".join(filter(None, [f"default {_default(entry)}", _allowed(entry)]))
        for text, first in ((facts, start), (entry.description, indent)):
            lines += textwrap.wrap(text, width, initial_indent=first, subsequent_indent=indent, break_on_hyphens=False)
    return "\n".join(lines)


def _default(entry: DeclaredParameter) -> str:
    value = [] if isinstance(entry.default, Parameter.Type) else entry.default
    unit = f" {entry.unit}" if entry.unit not in ("", "1") else ""
    return f"{_as_given(value)}{unit}"


def _as_given(value: Any) -> str:
    """Return a value as it stands on the command line."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple, array.array)):
        return f"[{', '.join(map(_as_given, value))}]"
    return str(value) if value != "" else "''"


def _allowed(entry: DeclaredParameter) -> str:
    facts = []
    if entry.range is not None:
        facts.append(f"{entry.range[0]:.12g} to {entry.range[1]:.12g}")
    if entry.choices is not None:
        facts.append("one of " + ", ".join(map(str, entry.choices)))
    if entry.read_only:
        facts.append("fixed")
    return "; ".join(facts)


# --- Arguments that are none ----------------------------------------------------------------------------


def refusal(arguments: Sequence[str], factories: Sequence[Callable[[], Node]]) -> str:
    """Return what is said of arguments that ROS does not take: the first of them, and the form that was meant."""
    argument = arguments[0]
    name, _, value = argument.lstrip("-").replace(":=", "=").partition("=")
    if not value and argument.startswith("-") and len(arguments) > 1 and not arguments[1].startswith("-"):
        value = arguments[1]
    if argument == "-p" and value:  # what ROS takes, without the word before it
        name, _, value = value.partition(":=")
    known = {entry.name: entry for factory in factories for entry in parameters_of(factory)}
    near = difflib.get_close_matches(name.replace("-", "_"), known, n=1)
    if near:
        entry = known[near[0]]
        if isinstance(entry.default, float) and value.lstrip("+-").isdigit():
            value += ".0"
        meant = f"did you mean --ros-args -p {entry.name}:={value or _as_given(entry.default)} ?"
    elif ":=" in argument:
        meant = f"did you mean --ros-args -r {argument} ?"
    else:
        meant = "allowed: parameters, as --ros-args -p NAME:=VALUE; --help lists them"
    return f"argument {argument!r} is not allowed; {meant}"
