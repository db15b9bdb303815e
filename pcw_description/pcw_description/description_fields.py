"""Reads YAML descriptions into frozen dataclasses whose fields carry their unit, bounds and meaning.

The field declaration is the single place where a key is described: validation, error messages and the
printed documentation of a format all come from it.
"""

from __future__ import annotations

import dataclasses
import datetime
import math
import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml

from .errors import DescriptionError, nearest_name

Parsed = TypeVar("Parsed")


@dataclasses.dataclass(frozen=True)
class Quantity:
    """What a number in a description may be. Bounds are inclusive unless `above` is used."""

    unit: str
    help: str
    minimum: float = -math.inf
    maximum: float = math.inf
    above: float = -math.inf
    length: int | None = None  # number of components of a vector; None for a scalar
    hint: str = ""  # what a value outside the bounds usually means

    def allowed(self) -> str:
        """Return the allowed range in words."""
        kind = "a number" if self.length is None else f"a list of {self.length} numbers"
        parts = [f"{kind} in {self.unit}" if self.unit not in ("", "1") else kind]
        if self.above > -math.inf:
            parts.append(f"above {self.above:g}")
        if self.minimum > -math.inf:
            parts.append(f"at least {self.minimum:g}")
        if self.maximum < math.inf:
            parts.append(f"at most {self.maximum:g}")
        text = "allowed: " + ", ".join(parts)
        return f"{text} ({self.hint})" if self.hint else text


def quantity(unit: str, help: str, *, default: Any = dataclasses.MISSING, **bounds: Any) -> Any:  # noqa: A002
    """Declare a numeric field: its unit, meaning and bounds (see `Quantity`)."""
    return dataclasses.field(default=default, metadata={"quantity": Quantity(unit, help, **bounds)})


def text(help: str, *, default: Any = dataclasses.MISSING, choices: Sequence[str] = ()) -> Any:  # noqa: A002
    """Declare a text field, optionally one of `choices`."""
    return dataclasses.field(default=default, metadata={"help": help, "choices": tuple(choices)})


def section(help: str, *, default: Any = dataclasses.MISSING, default_factory: Any = dataclasses.MISSING) -> Any:  # noqa: A002
    """Declare a nested section, which is another dataclass."""
    if default_factory is not dataclasses.MISSING:
        return dataclasses.field(default_factory=default_factory, metadata={"help": help})
    return dataclasses.field(default=default, metadata={"help": help})


class _Loader(yaml.SafeLoader):
    """YAML with numbers such as `1e-3` read as numbers, and a key given twice refused."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Build a mapping, refusing duplicate keys, which YAML would silently overwrite."""
        seen: set[object] = set()
        for key_node, _ in node.value:
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                line = key_node.start_mark.line + 1
                raise DescriptionError(f"line {line}", key, "it stands there a second time; allowed: each key once")
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(?:\d+\.?\d*|\.\d+)[eE][-+]?\d+$"),
    list("-+0123456789."),
)


def parse_yaml(content: str, key: str, origin: str) -> object:
    """Read YAML; an error names `key` and where the text comes from.

    Raises:
        DescriptionError: the text is not YAML.
    """
    try:
        return yaml.load(content, Loader=_Loader)  # noqa: S506 - a SafeLoader
    except yaml.YAMLError as error:
        problem = " ".join(str(error).split())
        raise DescriptionError(key, origin, f"it is not YAML ({problem}); allowed: valid YAML") from None


def load_yaml_mapping(path: str | Path) -> dict[str, Any]:
    """Load one YAML file that holds a mapping.

    Raises:
        DescriptionError: the file is absent, is not YAML, or is not a mapping.
    """
    path = Path(path)
    try:
        content = parse_yaml(path.read_text(encoding="utf-8"), "file", str(path))
    except OSError as error:
        raise DescriptionError("file", str(path), f"{error.strerror or error}; allowed: a readable YAML file") from None
    except UnicodeDecodeError:
        raise DescriptionError("file", str(path), "it is not text; allowed: a YAML file") from None
    if not isinstance(content, dict):
        found = "nothing" if content is None else f"one {type(content).__name__}"
        raise DescriptionError("file", str(path), f"it holds {found}; allowed: a mapping of keys to values")
    return content


def parsed_file(path: str | Path, parse: Callable[[dict[str, Any]], Parsed]) -> Parsed:
    """Load one YAML file and parse its mapping.

    Raises:
        DescriptionError: as `load_yaml_mapping` and `parse`; it names the file.
    """
    try:
        return parse(load_yaml_mapping(path))
    except DescriptionError as error:
        if error.key == "file":  # it is named already
            raise
        raise DescriptionError(error.key, error.value, error.allowed, str(path)) from None


def read_number(value: object, key: str, spec: Quantity) -> float:
    """Check one number against its declaration and return it as float."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise DescriptionError(key, value, spec.allowed())
    number = float(value) if abs(value) < 1e300 else math.inf  # an integer of 400 digits has no float
    if not math.isfinite(number) or number < spec.minimum or number > spec.maximum or number <= spec.above:
        raise DescriptionError(key, value, spec.allowed())
    return number


def read_section(cls: type[Any], data: object, key: str) -> Any:
    """Read a mapping into the dataclass `cls`.

    Args:
        cls: a dataclass whose fields were declared with `quantity`, `text` or `section`.
        data: what the YAML file holds at this place.
        key: dotted path of this place, for error messages; empty at the top.

    Raises:
        DescriptionError: unknown key, missing key, wrong type, or a value out of bounds.
    """
    if not isinstance(data, Mapping):
        fields = ", ".join(field.name for field in dataclasses.fields(cls) if field.init)
        raise DescriptionError(key or "file", data, f"allowed: a mapping with the keys {fields}")
    fields_by_name = {field.name: field for field in dataclasses.fields(cls) if field.init}
    prefix = f"{key}." if key else ""
    for name in data:
        if name not in fields_by_name:
            raise DescriptionError(f"{prefix}{name}", data[name], f"unknown key; {nearest_name(str(name), fields_by_name)}")
    hints = typing.get_type_hints(cls)
    values: dict[str, Any] = {}
    for name, field in fields_by_name.items():
        where = f"{prefix}{name}"
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        if data.get(name) is None:
            if required:
                raise DescriptionError(where, None, _describe(field))
            continue
        values[name] = _read_value(data[name], where, field, hints[name])
    return cls(**values)


def read_provenance(provenance: object) -> dict[str, str]:
    """Return where the numbers of a file come from, by what they describe; a text is the provenance of all.

    Raises:
        DescriptionError: missing, empty, or a source that is no text.
    """
    if isinstance(provenance, str) and provenance.strip():
        return {"all": provenance}
    if not isinstance(provenance, Mapping) or not provenance:
        allowed = "allowed: where each number comes from, its source or 'assumed' with the reason, as a text or a mapping"
        raise DescriptionError("provenance", provenance, allowed)
    for name, source in provenance.items():
        if not isinstance(source, (str, datetime.date)) or not str(source).strip():  # YAML makes a date of 2026-05-04
            raise DescriptionError(f"provenance.{name}", source, "allowed: text, a source or 'assumed' with the reason")
    return {str(name): str(source) for name, source in provenance.items()}


def _read_value(value: object, where: str, field: dataclasses.Field[Any], hint: Any) -> Any:
    spec: Quantity | None = field.metadata.get("quantity")
    if spec is not None:
        if spec.length is None:
            return read_number(value, where, spec)
        if not isinstance(value, (list, tuple)) or len(value) != spec.length:
            raise DescriptionError(where, value, spec.allowed())
        return tuple(read_number(item, f"{where}[{index}]", spec) for index, item in enumerate(value))
    if isinstance(hint, types.UnionType):  # "X | None": the None case was handled by the caller
        hint = next(member for member in typing.get_args(hint) if member is not type(None))
    if dataclasses.is_dataclass(hint):
        return read_section(hint, value, where)  # type: ignore[arg-type]
    if hint is str:
        choices = field.metadata.get("choices") or ()
        if not isinstance(value, str) or not value.strip() or (choices and value not in choices):
            near = nearest_name(str(value), choices) if choices else "allowed: text"
            raise DescriptionError(where, value, near)
        return value
    if hint is bool:
        if not isinstance(value, bool):
            raise DescriptionError(where, value, "allowed: true or false")
        return value
    return value  # lists and mappings that the format's own reader looks into


def _describe(field: dataclasses.Field[Any]) -> str:
    spec: Quantity | None = field.metadata.get("quantity")
    if spec is not None:
        return f"{spec.help}; {spec.allowed()}"
    return str(field.metadata.get("help", ""))


def document(cls: type[Any], key: str = "") -> list[tuple[str, str, str, str]]:
    """Return the documentation of a format as rows (key, unit, allowed, meaning).

    Nested sections are included, and the entries of a list of sections under `key[]`.
    """
    rows: list[tuple[str, str, str, str]] = []
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        if not field.init:
            continue
        name = f"{key}.{field.name}" if key else field.name
        spec: Quantity | None = field.metadata.get("quantity")
        hint = hints[field.name]
        required = field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        has_number = isinstance(field.default, (int, float))
        optional = "" if required else f"default {field.default:g}" if has_number else "optional"
        if isinstance(hint, types.UnionType):
            hint = next(member for member in typing.get_args(hint) if member is not type(None))
        if spec is not None:
            allowed = spec.allowed().removeprefix("allowed: ")
            rows.append((name, spec.unit, "; ".join(filter(None, (allowed, optional))), spec.help))
            continue
        choices = ", ".join(field.metadata.get("choices") or ())
        is_text = "text" if hint is str and not choices else ""
        rows.append((name, "", "; ".join(filter(None, (choices, is_text, optional))), str(field.metadata.get("help", ""))))
        items = typing.get_args(hint)
        if typing.get_origin(hint) is tuple and items and dataclasses.is_dataclass(items[0]):
            name, hint = f"{name}[]", items[0]
        if dataclasses.is_dataclass(hint) and any(f.metadata for f in dataclasses.fields(hint)):
            rows.extend(document(hint, name))  # type: ignore[arg-type]
    return rows
