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
