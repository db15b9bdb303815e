"""Robot descriptions as YAML files: reading, with an error for each thing that is wrong, and writing."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from .contact.contact_model import tyre_parameters
from .description_fields import parsed_file, read_provenance, read_section
from .effects.registry import read_physics
from .errors import DescriptionError, nearest_name
from .robot_description import DEFAULT_TOLERANCES, FORMAT, Caster, FixedWheel, RobotDescription, Tolerance

_TOLERANCE = re.compile(r"^\s*([0-9.eE+-]+)\s*(.*?)\s*$")


def read_tolerances(data: object, known: Mapping[str, Tolerance], key: str = "tolerances") -> dict[str, Tolerance]:
    """Read a mapping of tolerances such as `{chassis.mass: 1 %, steer_zero: 0.002 rad}`.

    Raises:
        DescriptionError: unknown name, no number, or a unit other than % or the documented one.
    """
    if not isinstance(data, Mapping):
        raise DescriptionError(key, data, "allowed: a mapping of names to tolerances")
    tolerances = {}
    for name, value in data.items():
        where = f"{key}.{name}"
        if name not in known:
            raise DescriptionError(where, value, f"unknown key; {nearest_name(str(name), known)}")
        unit = known[name].unit
        allowed = f"allowed: a positive number with its unit, such as '1 %' or '{known[name]}' (unit {unit})"
        match = _TOLERANCE.match(str(value))
        try:
            number = float(match.group(1)) if match else math.nan
        except ValueError:
            number = math.nan
        found_unit = match.group(2) if match else ""
        if not (math.isfinite(number) and number > 0.0) or found_unit not in ("%", unit):
            raise DescriptionError(where, value, allowed)
        relative = found_unit == "%"
        tolerances[str(name)] = Tolerance(number / 100.0 if relative else number, unit, relative)
    return tolerances


def parse_robot(data: Mapping[str, Any]) -> RobotDescription:
    """Read a robot description from a mapping, as it comes from YAML.

    `caster_defaults` holds what all casters share; each entry of `casters` overrides it key by key.

    Raises:
        DescriptionError: names the key, the value and what is allowed.
    """
    if not isinstance(data, Mapping):
        raise DescriptionError("robot description", data, "allowed: a mapping of keys to values")
    content = dict(data)
    found = content.get("format")
    if found != FORMAT:
        raise DescriptionError("format", found, f"allowed: {FORMAT}")
    defaults = content.pop("caster_defaults", None)
    defaults = {} if defaults is None else defaults
    if not isinstance(defaults, Mapping):
        raise DescriptionError("caster_defaults", defaults, "allowed: a mapping with the keys of a caster")
    casters = content.get("casters")
    if not isinstance(casters, list):
        raise DescriptionError("casters", casters, "allowed: a list of casters")
    content["casters"] = tuple(
        read_section(Caster, _merged(defaults, item, f"casters[{index}]"), f"casters[{index}]")
        for index, item in enumerate(casters)
    )
    fixed_wheels = content.get("fixed_wheels")
    if fixed_wheels is None:
        fixed_wheels = []
    if not isinstance(fixed_wheels, list):
        raise DescriptionError("fixed_wheels", fixed_wheels, "allowed: a list of wheels that do not steer")
    content["fixed_wheels"] = tuple(
        read_section(FixedWheel, item, f"fixed_wheels[{index}]") for index, item in enumerate(fixed_wheels)
    )
    content["provenance"] = read_provenance(content.get("provenance"))
    tolerances, physics = content.get("tolerances"), content.get("physics")
    content["tolerances"] = {} if tolerances is None else read_tolerances(tolerances, DEFAULT_TOLERANCES)
    names = [caster.name for caster in content["casters"]]
    content["physics"] = () if physics is None else read_physics(physics, names)
    _check_shape(content, "")
    for index, item in enumerate(casters):
        _check_shape({**defaults, **item}, f"casters[{index}].")
    robot: RobotDescription = read_section(RobotDescription, content, "")
    for tyre in (robot.contact, *robot.tyres):
        tyre_parameters(tyre)  # only the friction curve knows the names of its shape numbers
    return robot


def _check_shape(owner: Mapping[str, Any], where: str) -> None:
    contact = owner.get("contact")
    shape = contact.get("shape") if isinstance(contact, Mapping) else None
    if shape is not None and not (isinstance(shape, Mapping) and all(_is_number(value) for value in shape.values())):
        raise DescriptionError(f"{where}contact.shape", shape, "allowed: a mapping of names to finite numbers")


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300


def _merged(defaults: Mapping[str, Any], own: object, where: str) -> dict[str, Any]:
    if not isinstance(own, Mapping):
        raise DescriptionError(where, own, "allowed: a mapping that describes one caster")
    merged = dict(defaults)
    for key, value in own.items():
        base = defaults.get(key)
        merged[key] = {**base, **value} if isinstance(base, Mapping) and isinstance(value, Mapping) else value
    return merged


def robots_directory() -> Path:
    """Return the folder of the shipped robot descriptions, in an installation or in the source tree."""
    module = Path(__file__).resolve()
    source = module.parents[1] / "config" / "robots"
    # An installed module is <prefix>/lib/pythonX.Y/site-packages/pcw_description/robot_file.py.
    return source if source.is_dir() else module.parents[4] / "share" / "pcw_description" / "config" / "robots"


def shipped_robots() -> tuple[str, ...]:
    """Return the names of the shipped robot descriptions."""
    return tuple(sorted(path.stem for path in robots_directory().glob("*.yaml")))


def load_robot(robot: str | Path) -> RobotDescription:
    """Load a robot description from a file, or a shipped one by its name.

    Args:
        robot: path of a YAML file, or a name such as "thesis" (see `shipped_robots`).

    Raises:
        DescriptionError: no such robot, or the file is not valid.
    """
    return parsed_file(robot_path(robot), parse_robot)


def robot_path(robot: str | Path) -> Path:
    """Return the path of a description that is given as one, or as the name of a shipped robot.

    Raises:
        DescriptionError: neither a path of a YAML file nor such a name.
    """
    path = Path(robot)
    if path.suffix in (".yaml", ".yml"):
        return path
    names = shipped_robots()
    if str(robot) not in names:
        near = nearest_name(str(robot), names)
        raise DescriptionError("robot", str(robot), f"neither a .yaml file nor a shipped robot; {near}")
    return robots_directory() / f"{robot}.yaml"


def robot_to_mapping(robot: RobotDescription) -> dict[str, Any]:
    """Return the mapping that `parse_robot` reads back to an equal robot."""
    data: dict[str, Any] = {
        "format": robot.format,
        "name": robot.name,
        "provenance": dict(robot.provenance),
        "chassis": _plain(robot.chassis),
        "casters": [_plain(caster) for caster in robot.casters],
        "contact": _plain(robot.contact),
        "sensors": _plain(robot.sensors),
    }
    if robot.fixed_wheels:
        data["fixed_wheels"] = [_plain(wheel) for wheel in robot.fixed_wheels]
    if robot.suspension is not None:
        data["suspension"] = _plain(robot.suspension)
    if robot.tolerances:
        data["tolerances"] = {name: str(tolerance) for name, tolerance in robot.tolerances.items()}
    data["physics"] = [effect.to_mapping() for effect in robot.physics]
    return data


def save_robot(robot: RobotDescription, path: str | Path) -> None:
    """Write a robot description that `load_robot` reads back."""
    Path(path).write_text(yaml.safe_dump(robot_to_mapping(robot), sort_keys=False, allow_unicode=True), encoding="utf-8")


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        items = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return {name: _plain(item) for name, item in items if item is not None and item != {}}
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value
