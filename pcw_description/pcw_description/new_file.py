"""Files that a tool writes: what is there already stays, and what cannot be written is told before the work."""

from __future__ import annotations

from pathlib import Path

from .errors import PcwError


def require_new_file(path: Path, option: str) -> None:
    """Make sure that a file can be made.

    Args:
        path: the file.
        option: what the command line calls it.

    Raises:
        PcwError: it is there already, whatever it is, or its folder is not.
    """
    if path.exists():
        raise PcwError(f"{option} {path}: exists already and is left as it is; allowed: a new file")
    if not path.resolve().parent.is_dir():
        raise PcwError(f"{option} {path}: there is no folder {path.resolve().parent}; allowed: a file in a folder that exists")
