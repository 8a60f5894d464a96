"""Start other Python processes with the packages of this one, and end them with it.

They never import a module that happens to lie in the working directory, which `python -m` and `python -c` search first.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.context import SpawnContext, SpawnProcess

PYTHON = (sys.executable, "-P")
# The environment of a process beside others: two processes with two threads each are slower on two cores.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
PR_SET_PDEATHSIG = 1  # of prctl: the signal that a process gets when its parent dies


@contextmanager
def _safe_path() -> Iterator[None]:
    """Give -P to the processes of multiprocessing that start meanwhile, and to no other child of this process."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


class _Process(SpawnProcess):
    def start(self) -> None:
        with _safe_path():
            super().start()


class _Spawning(SpawnContext):
    Process = _Process


def spawning() -> SpawnContext:
    """Return the context that starts new processes. A forked one would share locks of libraries with threads."""
    with _safe_path():
        resource_tracker.ensure_running()
    return _Spawning()


def end_with_parent(parent: int, by: signal.Signals = signal.SIGTERM) -> bool:
    """Let a signal end this process when its parent ends. Returns False if the parent has ended already.

    Args:
        parent: process id.
        by: the signal.
    """
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, by)
    return os.getppid() == parent


def end_with_spawner(by: signal.Signals = signal.SIGTERM) -> bool:
    """Let a signal end this process of `spawning` with its parent; see `end_with_parent`."""
    parent = multiprocessing.parent_process()
    return parent is not None and parent.pid is not None and end_with_parent(parent.pid, by)
