"""The parameters of nodes: declared with unit, range and meaning, checked at the start and whenever they are set."""

from __future__ import annotations

import array
import dataclasses
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from pcw_description.errors import PcwError, nearest_name

Check = Callable[[Any], str | None]


@dataclasses.dataclass(frozen=True)
class DeclaredParameter:
    """What `declare` was told of a parameter."""

    name: str
    default: Any
    description: str
    unit: str
    range: tuple[float, float] | None
    read_only: bool
    choices: Sequence[Any] | None


class AllDeclared(Exception):
    """Ends the constructor of a node of which only the parameters are wanted."""


_sketch: list[DeclaredParameter] | None = None  # where declarations go while no node is behind them


@contextmanager
def sketch() -> Iterator[list[DeclaredParameter]]:
    """Collect what nodes declare, at no node; `all_declared` raises AllDeclared meanwhile."""
    global _sketch
    _sketch = []
    try:
        yield _sketch
    finally:
        _sketch = None


def all_declared(node: Node) -> None:
    """Say that a node has declared its parameters: what it makes, opens or publishes comes after this."""
    if _sketch is not None:
        raise AllDeclared
    setattr(node, _ALL_DECLARED_ATTRIBUTE, True)


def says_all_declared(node: Node) -> bool:
    """Whether a node that was made has said so."""
    return hasattr(node, _ALL_DECLARED_ATTRIBUTE)


def type_name(value: Any) -> str:
    """Return the ROS name of the type of a parameter's value, or of a type: double, string_array."""
    kind = value if isinstance(value, Parameter.Type) else Parameter.Type.from_parameter_value(value)
    return str(kind.name.lower())


_CHECKS_ATTRIBUTE = "_pcw_parameter_checks"
_ALL_DECLARED_ATTRIBUTE = "_pcw_all_declared"


def declare(
    node: Node,
    name: str,
    default: Any,
    description: str,
    unit: str = "",
    range: tuple[float, float] | None = None,  # noqa: A002 - the word ROS uses for it
    read_only: bool = False,
    choices: Sequence[Any] | None = None,
    check: Check | None = None,
) -> Any:
    """Declare a parameter with a full descriptor and return its value (an override included).

    The type is that of `default`; for an empty list give the type itself, `Parameter.Type.STRING_ARRAY`, and
    the value without an override is []. A value that is not finite, out of `range` (ends included), not
    among `choices`, or for which `check(value)` returns a reason is refused with that reason, now and
    later, and the old value stays.

    Raises:
        PcwError: the value given at the start is of another type, or refused.
    """
    if _sketch is not None:
        _sketch.append(DeclaredParameter(name, default, description, unit, range, read_only, choices))
        return [] if isinstance(default, Parameter.Type) else default
    if says_all_declared(node):
        raise TypeError(f"{name!r} is declared after all_declared, and so is not in the help of the node")
    descriptor = ParameterDescriptor(
        description=f"{description} [{unit}]" if unit else description, read_only=read_only
    )
    if range is not None:
        _set_range(descriptor, default, range)
    if choices is not None:
        descriptor.additional_constraints = "one of " + ", ".join(str(choice) for choice in choices)
    check_all = _checks_of(node)[name] = _combined_check(unit, range, choices, check)
    try:
        value = node.declare_parameter(name, default, descriptor).value
    except InvalidParameterTypeException:
        raise PcwError(f"parameter {name}: {_wrong_type(_given(node, name), default)}") from None
    except InvalidParameterValueException as error:
        raise PcwError(f"parameter {name}: {check_all(_given(node, name)) or error}") from None
    return [] if value is None else value


def _given(node: Node, name: str) -> Any:
    """Return the value that a parameter was given at the start."""
    return node._parameter_overrides[name].value


def _wrong_type(value: Any, default: Any) -> str:
    """Return why a value of another type than that of the default is refused."""
    example = f"; write {value}.0" if type_name(default) == "double" and type_name(value) == "integer" else ""
    return f"{value!r} is of type {type_name(value)}; allowed: {type_name(default)}{example}"


def _set_range(descriptor: ParameterDescriptor, default: Any, range: tuple[float, float]) -> None:  # noqa: A002
    low, high = range
    if isinstance(default, int) and not isinstance(default, bool):
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
    elif isinstance(default, float):
        bounds = FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
        descriptor.floating_point_range = [bounds]
    else:  # an array: ROS keeps no range for it, so it stands in words and _combined_check enforces it
        descriptor.additional_constraints = f"each from {low} to {high}"


def _combined_check(
    unit: str,
    range: tuple[float, float] | None,  # noqa: A002
    choices: Sequence[Any] | None,
    check: Check | None,
) -> Check:
    def reason_to_refuse(value: Any) -> str | None:
        is_list = isinstance(value, (list, tuple, array.array, np.ndarray))
        for entry in value if is_list else [value]:
            if isinstance(entry, float) and not math.isfinite(entry):
                return f"{entry} is not a finite number"
            if range is not None and not range[0] <= entry <= range[1]:
                return f"{entry} is outside {range[0]} .. {range[1]}{f' {unit}' if unit not in ('', '1') else ''}"
            if choices is not None and entry not in choices:
                return f"{entry!r} is not known; {nearest_name(str(entry), map(str, choices))}"
        return check(value) if check is not None else None

    return reason_to_refuse


def _checks_of(node: Node) -> dict[str, Check]:
    """The checks by parameter name, kept at the node; the first call installs the callback that uses them."""
    checks: dict[str, Check] | None = getattr(node, _CHECKS_ATTRIBUTE, None)
    if checks is not None:
        return checks
    installed: dict[str, Check] = {}

    def refuse_bad_values(parameters: list[Parameter]) -> SetParametersResult:
        for parameter in parameters:
            check = installed.get(parameter.name)
            if check is None or parameter.type_ is Parameter.Type.NOT_SET:
                continue
            reason = check(parameter.value)
            if reason is not None:
                return SetParametersResult(successful=False, reason=f"{parameter.name}: {reason}")
        return SetParametersResult(successful=True)

    setattr(node, _CHECKS_ATTRIBUTE, installed)
    node.add_on_set_parameters_callback(refuse_bad_values)
    return installed


def warn_of_unknown_overrides(nodes: Sequence[Node]) -> None:
    """Say which given parameters no node of the process knows.

    A warning and not an error, because a parameter file with `/**` is read by every node of a robot.
    """
    known = {name for node in nodes for name in _checks_of(node)}
    warned = set()
    for node in nodes:
        overrides: Mapping[str, Parameter] = getattr(node, "_parameter_overrides", {})
        for name in overrides:
            if not (node.has_parameter(name) or name in known | warned or name.startswith("qos_overrides.")):
                warned.add(name)
                hint = f"; {nearest_name(name, known)}" if known else ""
                node.get_logger().warning(f"parameter {name!r} is unknown to this node and ignored{hint}")
