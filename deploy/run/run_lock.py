"""A lock on a run's folder: one launcher at a time. The lock ends with its process, however that ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from brakeline.deploy.run.processes import launcher_pid
from brakeline.errors import LaunchError

LOCK = ".launcher.lock"


@contextmanager
def only_launcher(folder: Path) -> Iterator[None]:
    """Hold the lock of a run's folder until the block ends.

    Raises:
        LaunchError: another launcher holds it: the run is running.
    """
    lock = FileLock(folder / LOCK)
    try:
        lock.acquire(blocking=False)
    except Timeout:
        try:
            where = f" (process {launcher_pid(folder)})"
        except (OSError, ValueError, KeyError):  # it has just begun
            where = ""
        raise LaunchError(f"{folder} is running{where}: end it first, or give another --out") from None
    try:
        yield
    finally:
        lock.release()
