"""Locks on folders: of data, whose missing files one process writes while others wait, and of a run's launcher.

A lock ends with its process, however that ends.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from brakeline.deploy.progress import console

LOCK = ".lock"
WITHOUT_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)


@contextmanager
def folder_lock(folder: Path) -> Iterator[None]:
    """Hold the lock of `folder` until the block ends. The same process may enter it again inside the block."""
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK, is_singleton=True)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        console.print(f"another process is writing to {folder}: waiting for it to finish", markup=False)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


@contextmanager
def lock_at_once(file: Path, again: bool = False) -> Iterator[bool]:
    """Hold the lock in a file until the block ends, unless another process holds it. Yields whether it is held.

    On a file system without locks, nobody holds any: then it yields True.

    Args:
        file: the lock's file.
        again: whether the same thread may enter it again inside the block.
    """
    lock = FileLock(file, fallback_to_soft=False, is_singleton=again)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        yield False
        return
    except (NotImplementedError, OSError) as error:
        if getattr(error, "errno", errno.ENOSYS) not in WITHOUT_LOCKS:
            raise
        console.print(f"{file.parent}: its file system has no locks, so no second process is noticed", markup=False)
        yield True
        return
    try:
        yield True
    finally:
        lock.release()
