"""Start other Python processes with the packages of this one, and end them with it.

They never import a module that happens to lie in the working directory, which `python -m` and `python -c` search first.
"""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import signal
import sys
from multiprocessing.context import SpawnContext

PYTHON = (sys.executable, "-P")
# The environment of a process beside others: two processes with two threads each are slower on two cores.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
PR_SET_PDEATHSIG = 1  # of prctl: the signal that a process gets when its parent dies


def spawning() -> SpawnContext:
    """Return the context that starts new processes. A forked one would share locks of libraries with threads."""
    os.environ["PYTHONSAFEPATH"] = "1"  # -P for the processes of multiprocessing
    return multiprocessing.get_context("spawn")


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
