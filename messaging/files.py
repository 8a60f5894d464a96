"""Small files that are there whole or not at all."""

from __future__ import annotations

from pathlib import Path


def write_whole(path: Path, payload: bytes) -> None:
    """Write a file, and its folders, so that whoever reads it meanwhile finds the old one or the new one.

    Raises:
        OSError: it can't be written; what was there stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".new")
    beside.write_bytes(payload)
    beside.replace(path)
