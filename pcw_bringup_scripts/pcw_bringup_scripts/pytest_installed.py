"""pytest plugin of the test command: tests import the installed packages, never the source tree beside them.

Tests of the source tree would pass where a module, a template or a configuration file is missing from the installation. And
where one run collects several packages, pytest (--import-mode=importlib) takes a folder such as `pcw_control/`, which holds
the package of that name but is not it, for a namespace package and puts it in the place of the real one, unless that is
already imported. So all of them are imported here, before anything is collected.
"""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

PACKAGES = (
    "pcw_description",
    "pcw_estimation",
    "pcw_control",
    "pcw_terrain",
    "pcw_sim_bridge",
    "pcw_bringup_scripts",
)

# On import, not in a hook: pytest loads the conftest files of the folders on its command line before it calls one.
FOUND_AT = {name: importlib.import_module(name).__file__ for name in PACKAGES}


def pytest_configure(config: pytest.Config) -> None:
    """Refuse to go on with a package that comes from the source tree."""
    for name, found_at in FOUND_AT.items():
        source = config.rootpath / name / name
        if found_at is None or Path(found_at).parent == source:
            raise pytest.UsageError(
                f"{name} is imported from {found_at or source}, not from an installation: run ./pcw_bringup_scripts/test, "
                "or source pcw_bringup_scripts/setup_env.sh --test first"
            )
