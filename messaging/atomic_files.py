"""Write files atomically: a reader finds the old content or the new content, never a part."""

from __future__ import annotations

import os
import secrets
from pathlib import Path


def write_atomically(path: Path, payload: bytes) -> None:
    """Write a file and create its folders. Of several concurrent writers, the last one wins.

    Raises:
        OSError: the file cannot be written; its old content stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    _replace(path, payload, 0o666)


def write_secret(path: Path, payload: bytes) -> None:
    """Write a file atomically that only its owner can ever read."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    _replace(path, payload, 0o600)


def _replace(path: Path, payload: bytes, mode: int) -> None:
    """Write a temporary file with a random name beside the file, and rename it."""
    beside = path.with_name(f"{path.name}.{secrets.token_hex(4)}.new")
    try:
        with open(beside, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(payload)
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
