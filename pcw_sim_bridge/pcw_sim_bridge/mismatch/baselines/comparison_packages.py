"""The packages that only the comparison needs, imported where they are used."""

from __future__ import annotations

import importlib
from typing import Any

from ..errors import MismatchError

# Not in package.xml: rosdep does not know all of them, and nobody who analyses recordings needs them.
MODULES = ("pysindy", "sklearn", "mujoco.sysid")
HOW_TO_INSTALL = "python -m pip install -r pcw_bringup_scripts/requirements/baselines.txt"


def comparison_module(name: str) -> Any:
    """Import a module that only the comparison needs.

    Raises:
        MismatchError: it is not installed, or installed without what it needs itself; says what installs it.
    """
    try:
        module = importlib.import_module(name)
    except ImportError as error:
        raise MismatchError(f"the baselines need {name}, which cannot be loaded ({error}): {HOW_TO_INSTALL}") from error
    if name == "mujoco.sysid" and not hasattr(module, "optimize"):
        # MuJoCo leaves this module empty where its extra `sysid` was not installed.
        raise MismatchError(f"the baselines need mujoco.sysid, and MuJoCo is here without its extra `sysid`: {HOW_TO_INSTALL}")
    return module


def require_packages() -> None:
    """Import every package of the comparison.

    Raises:
        MismatchError: one of them is missing.
    """
    for name in MODULES:
        comparison_module(name)
