"""Small files that are there whole or not at all."""

from __future__ import annotations

import os
import secrets
from pathlib import Path


def write_atomically(path: Path, payload: bytes) -> None:
    """Write a file, and its folders, so that whoever reads it meanwhile finds the old one or the new one; of several
    who write at once the last one's stays.

    Raises:
        OSError: it can't be written; what was there stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _replace(path, payload, 0o666)


def write_secret(path: Path, payload: bytes) -> None:
    """As `write_atomically`, in a file that only its owner can read, from its first byte on."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    _replace(path, payload, 0o600)


def _replace(path: Path, payload: bytes, mode: int) -> None:
    """By way of a file beside it, of which nobody else knows."""
    beside = path.with_name(f"{path.name}.{secrets.token_hex(4)}.new")
    try:
        with open(beside, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(payload)
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
