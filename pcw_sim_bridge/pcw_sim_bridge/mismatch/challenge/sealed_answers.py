"""The sealed answer file: written once, its SHA-256 beside the cases before any of them is recorded."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import MismatchError
from .cases import Answer

FORMAT = "pcw_mismatch_challenge/1"
HASH_FILE = "answers.sha256"


def default_answers(folder: Path) -> Path:
    """Return where the answers of a folder of cases are kept if nothing else is said: beside it."""
    return folder.with_name(folder.name + ".answers.json")


def seal(path: Path, header: Mapping[str, Any], answers: Sequence[Answer], folder: Path) -> None:
    """Write the answers, then their hash into the folder of the cases."""
    content = json.dumps({"format": FORMAT, **header, "cases": list(answers)}, indent=1, sort_keys=True).encode()
    write_whole(path, content)
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(folder / HASH_FILE, f"{hashlib.sha256(content).hexdigest()}  {path.name}\n".encode())


def open_sealed(path: Path, folder: Path) -> dict[str, Any]:
    """Return the content of an answer file whose hash is the one beside the cases.

    Raises:
        MismatchError: a file is missing, is no answer file, or has another hash.
    """
    try:
        content = path.read_bytes()
        promised = (folder / HASH_FILE).read_text(encoding="ascii").split()
    except OSError as error:
        raise MismatchError(f"{error.filename}: {error.strerror}; allowed: what `challenge make` wrote") from None
    found = hashlib.sha256(content).hexdigest()
    if not promised or promised[0] != found:
        raise MismatchError(
            f"{path} has the SHA-256 {found}, and {folder / HASH_FILE} promised {promised[0] if promised else 'nothing'}; "
            "allowed: the answers as they were sealed before the recordings were made"
        )
    answers: dict[str, Any] = json.loads(content)
    if answers.get("format") != FORMAT:
        raise MismatchError(f"{path}: format is {answers.get('format')!r}; allowed: {FORMAT}")
    return answers


def sealed_hash(folder: Path) -> str:
    """Return the hash that the answers of a folder of cases were sealed with."""
    return (folder / HASH_FILE).read_text(encoding="ascii").split()[0]


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that it is there whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_bytes(content)
    os.replace(part, path)
