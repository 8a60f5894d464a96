"""A lock on a run's folder: one launcher at a time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from brakeline.deploy.data.build_lock import lock_at_once
from brakeline.deploy.run.processes import launcher_pid
from brakeline.errors import LaunchError

LOCK = ".launcher.lock"


@contextmanager
def only_launcher(folder: Path) -> Iterator[None]:
    """Hold the lock of a run's folder until the block ends. The same thread may enter it again inside the block.

    Raises:
        LaunchError: another launcher holds it: the run is running.
    """
    with lock_at_once(folder / LOCK, again=True) as held:
        if not held:
            raise LaunchError(f"{folder} is running{_process(folder)}: end it first, or give another --out")
        yield


def _process(folder: Path) -> str:
    """Return the process of a running launcher in brackets; empty if it has just begun."""
    try:
        return f" (process {launcher_pid(folder)})"
    except (OSError, ValueError, KeyError):
        return ""
