"""Write files atomically: a reader finds the old content or the new content, never a part."""

from __future__ import annotations

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def write_atomically(path: Path, payload: bytes) -> None:
    """Write a file and create its folders. Of several concurrent writers, the last one wins. A link stays a link.

    Raises:
        OSError: the file cannot be written; its old content stays.
    """
    target = Path(os.path.realpath(path))
    target.parent.mkdir(parents=True, exist_ok=True)
    _replace(target, payload, 0o666)


@contextmanager
def whole_or_nothing(path: Path) -> Iterator[Path]:
    """Give a path to write to. That file gets the name `path` when the block ends; an error leaves `path` as it was.

    What is no ordinary file, such as a pipe or /dev/stdout, is written to directly.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    if (path.exists() and not path.is_file()) or Path("/dev") in path.absolute().parents:
        yield path
        return
    target = path.resolve()  # of a link
    beside = _beside(target)
    try:
        yield beside
        beside.replace(target)
    finally:
        beside.unlink(missing_ok=True)


def write_secret(path: Path, payload: bytes) -> None:
    """Write a file atomically that only its owner can ever read."""
    path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
    _replace(path, payload, 0o600)


def _replace(path: Path, payload: bytes, mode: int) -> None:
    """Write a temporary file with a random name beside the file, and rename it."""
    beside = _beside(path)
    try:
        with open(beside, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            file.write(payload)
        beside.replace(path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def _beside(path: Path) -> Path:
    return path.with_name(f"{path.name}.{secrets.token_hex(4)}.new")
