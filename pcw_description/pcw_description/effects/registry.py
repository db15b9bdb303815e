"""Finds every effect: the files of this folder, of the folders in PCW_EFFECTS_PATH, and entry points of other packages.

Adding one edits no list.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.metadata
import importlib.util
import os
import pkgutil
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..effect_instance import EffectInstance
from ..errors import DescriptionError, nearest_name
from .effect import Effect

ENTRY_POINT_GROUP = "pcw_description.effects"
PATH_VARIABLE = "PCW_EFFECTS_PATH"
_NOT_EFFECTS = ("effect", "kinds", "registry")


@functools.cache
def all_effects() -> Mapping[str, Effect]:
    """Return every effect by name, sorted.

    Raises:
        DescriptionError: a folder of PCW_EFFECTS_PATH that is none, a file in it that cannot be imported or holds no effect,
            or a second effect of one name.
    """
    package = importlib.import_module(__package__ or "pcw_description.effects")
    effects: dict[str, Effect] = {}
    for module_info in pkgutil.iter_modules(package.__path__):
        if module_info.name not in _NOT_EFFECTS:
            effect = importlib.import_module(f"{package.__name__}.{module_info.name}").EFFECT
            _add(effects, effect, f"{package.__name__}.{module_info.name}")
    for folder in filter(None, os.environ.get(PATH_VARIABLE, "").split(os.pathsep)):
        if not Path(folder).is_dir():
            raise DescriptionError(PATH_VARIABLE, folder, f"allowed: folders of effect files, {os.pathsep!r} between them")
        for path in sorted(Path(folder).glob("[!_]*.py")):
            _add(effects, _effect_of(path), str(path))
    for entry_point in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP):
        _add(effects, entry_point.load(), entry_point.value)
    return dict(sorted(effects.items()))


def _effect_of(path: Path) -> object:
    """Import a file and return its `EFFECT`.

    Raises:
        DescriptionError: it cannot be imported, or has none.
    """
    specification = importlib.util.spec_from_file_location(f"pcw_effects_{path.stem}", path)
    assert specification is not None and specification.loader is not None
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module  # where the cache of compiled kernels looks for it
    try:
        specification.loader.exec_module(module)
        return module.EFFECT
    except Exception as error:  # whatever a file of somebody else raises
        del sys.modules[specification.name]
        where = f"{PATH_VARIABLE}: {path}"
        raise DescriptionError(where, str(error), "allowed: a module with a module-level EFFECT") from error


@contextlib.contextmanager
def also_known(effects: Iterable[Effect]) -> Iterator[None]:
    """Take effects into the vocabulary for a while, so that a simulator can do what nobody else is to know.

    Raises:
        DescriptionError: not an effect, or a name that is taken.
    """
    vocabulary = all_effects()
    assert isinstance(vocabulary, dict)  # the cached one, which all callers see
    before = dict(vocabulary)
    try:
        for effect in effects:
            _add(vocabulary, effect, f"{effect.name} for a while")
        yield
    finally:
        vocabulary.clear()
        vocabulary.update(before)


def _add(effects: dict[str, Effect], effect: object, origin: str) -> None:
    """Take an effect into the vocabulary.

    Raises:
        DescriptionError: not an effect, or a second one of its name, which would silently change what a name means.
    """
    if not isinstance(effect, Effect):
        raise DescriptionError(f"effect {origin}", effect, "allowed: an instance of Effect")
    if effect.name in effects:
        raise DescriptionError(f"effect {origin}", effect.name, "another effect has this name; allowed: each name once")
    effects[effect.name] = effect


def get(name: str) -> Effect:
    """Return one effect.

    Raises:
        DescriptionError: there is none of that name; the nearest is suggested.
    """
    effects = all_effects()
    if name not in effects:
        raise DescriptionError("physics.name", name, f"unknown effect; {nearest_name(str(name), effects)}")
    return effects[name]


def effects_text() -> str:
    """Return all effects as text: name, target, what it is, who sees it, what it is taken for, and each parameter."""
    blocks = []
    for effect in all_effects().values():
        joints = f", axis {' or '.join(effect.axes)} (default {effect.axis})" if effect.axes else ""
        lines = [f"{effect.name} ({effect.target_kind}{joints}): {effect.summary}"]
        lines.append(f"    seen by {', '.join(effect.sensors)}; easily taken for {', '.join(effect.look_alikes)}")
        for p in effect.parameters:
            default = "must be given" if p.default is None else f"default {p.default:g}"
            lines.append(f"    {p.name} [{p.unit}]: {p.help}; {p.lower:g} to {p.upper:g}, {default}, typical {p.typical:g}")
        blocks.append("\n".join(lines))
    return "\n".join(blocks)


def read_physics(entries: object, caster_names: Sequence[str]) -> tuple[EffectInstance, ...]:
    """Read the `physics:` list of a description.

    Args:
        entries: list of mappings with `name`, `target` and the effect's parameters.
        caster_names: the casters that may be targets.

    Raises:
        DescriptionError: unknown effect, unknown target, missing or out-of-range parameter.
    """
    if not isinstance(entries, (list, tuple)):
        raise DescriptionError("physics", entries, "allowed: a list of effects")
    instances = []
    for index, entry in enumerate(entries):
        where = f"physics[{index}]"
        if not isinstance(entry, Mapping) or "name" not in entry:
            raise DescriptionError(where, entry, "allowed: a mapping with name, target and the parameters of the effect")
        name = entry["name"]
        effects = all_effects()
        if not isinstance(name, str) or name not in effects:
            raise DescriptionError(f"{where}.name", name, f"unknown effect; {nearest_name(str(name), effects)}")
        effect = effects[name]
        target = _read_target(entry.get("target"), effect, caster_names, where)
        axis = _read_axis(entry, effect, where)
        parameters: dict[str, Any] = {str(k): v for k, v in entry.items() if k not in ("name", "target", "axis")}
        instances.append(EffectInstance(effect.name, target, effect.check(parameters, where), axis))
    return tuple(instances)


def _read_axis(entry: Mapping[str, Any], effect: Effect, where: str) -> str | None:
    if "axis" not in entry:
        return None
    if entry["axis"] not in effect.axes:
        places = ", ".join(effect.axes) if effect.axes else f"no axis for {effect.name}, which acts at the {effect.axis}"
        raise DescriptionError(f"{where}.axis", entry["axis"], f"allowed: {places}")
    return str(entry["axis"])


def _read_target(target: object, effect: Effect, caster_names: Sequence[str], where: str) -> tuple[str, ...]:
    allowed = tuple(caster_names) if effect.target_kind == "caster" else (effect.target_kind,)
    if target is None:
        return allowed
    names = (target,) if isinstance(target, str) else tuple(target) if isinstance(target, (list, tuple)) else None
    if not names:
        raise DescriptionError(f"{where}.target", target, f"allowed: a list out of {', '.join(allowed)}")
    for name in names:
        if name not in allowed:
            raise DescriptionError(f"{where}.target", name, nearest_name(str(name), allowed))
    if len(set(names)) < len(names):
        raise DescriptionError(f"{where}.target", list(names), "allowed: each target once")
    return tuple(str(name) for name in names)
