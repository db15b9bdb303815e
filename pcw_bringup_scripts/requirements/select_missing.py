"""Print the entries of a hashed lock file that this interpreter lacks, for a set-up on top of an installed ROS 2.

There, ROS itself, numpy, scipy and the rest come from the system, and a second copy of the same library from the lock would
shadow it. What is printed is again a hashed lock file, complete for `install --no-deps`.

    python select_missing.py LOCK > MISSING
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
import sys
from pathlib import Path

# Distributions whose system package may come without Python metadata, and the module that shows that it is there.
MODULE_OF = {"pybullet": "pybullet", "pin": "pinocchio"}


def entries(lock_text: str) -> list[tuple[str, str]]:
    """Return (distribution name, whole entry with its hashes) for each requirement of the lock file."""
    found = re.findall(r"^([A-Za-z0-9][\w.-]*)(==[^\\\n]*(?:\\\n[^\\\n]*)*)$", lock_text, flags=re.MULTILINE)
    return [(name, name + rest) for name, rest in found]


def is_installed(name: str) -> bool:
    """Whether the distribution can be imported here, whatever its version."""
    try:
        importlib.metadata.distribution(name)
    except importlib.metadata.PackageNotFoundError:
        return name in MODULE_OF and importlib.util.find_spec(MODULE_OF[name]) is not None
    return True


def main() -> None:
    """Read the lock file named on the command line and print what is missing."""
    for name, entry in entries(Path(sys.argv[1]).read_text(encoding="utf-8")):
        if not name.startswith("ros-") and not is_installed(name):
            print(entry)


if __name__ == "__main__":
    main()
