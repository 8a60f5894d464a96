"""One process at a time makes what is missing in a folder; others wait, and find it then."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout
from rich.console import Console

LOCK = ".lock"

console = Console(stderr=True, highlight=False, soft_wrap=True)


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Nobody else makes anything in the folder until the block ends; may be entered again inside of it."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, is_singleton=True)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        console.print(f"another process is at work in {folder}: waiting for it", markup=False)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()
