"""Compiled kernels: an edit of one takes effect in all that call it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

import pcw_description
from pcw_description import compiled

CALLEE = "from pcw_description.compiled import compiled\n\n\n@compiled\ndef friction(slip):\n    return {value} * slip\n"
CALLER = (
    "from pcw_description.compiled import compiled\n\nfrom .callee import friction\n\n\n"
    "@compiled\ndef force(slip):\n    return 10.0 * friction(slip)\n"
)


@pytest.mark.skipif(not compiled.NUMBA_AVAILABLE, reason="nothing is cached without numba")
def test_an_edited_kernel_takes_effect_in_its_callers(tmp_path: Path) -> None:
    """Numba's own cache keeps the old machine code of a caller whose callee, in another file, has changed.

    A plant went on with the old friction curve after the curve's file was edited; so would a robot after an update.
    """
    package = tmp_path / "kernels_under_test"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "caller.py").write_text(CALLER)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(pcw_description.__file__).parents[1])]),
    }

    def run() -> tuple[float, int]:
        """Return the force and how often the caller's machine code came from the cache; it was said before if it would not."""
        script = (
            "from pcw_description.compiled import awaits_compiling; from kernels_under_test.caller import force; "
            "awaits = awaits_compiling(force); print(force(1.0), sum(force.stats.cache_hits.values()), int(awaits))"
        )
        output = subprocess.run(
            [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True, timeout=120
        )
        force, hits, awaits = output.stdout.split()
        assert int(awaits) == 1 - int(hits)
        return float(force), int(hits)

    (package / "callee.py").write_text(CALLEE.format(value=2.0))
    assert run() == (20.0, 0)
    assert run() == (20.0, 1)
    (package / "callee.py").write_text(CALLEE.format(value=3.0))
    assert run() == (30.0, 0)
