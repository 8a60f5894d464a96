"""How other Python processes are started: with the packages that this one has, and never with a module that happens to
lie in the working directory, which `python -m` and `python -c` search first."""

from __future__ import annotations

import multiprocessing
import os
import sys
from multiprocessing.context import SpawnContext

PYTHON = (sys.executable, "-P")


def spawning() -> SpawnContext:
    """Processes started afresh: a forked one would share locks of libraries that have threads."""
    os.environ["PYTHONSAFEPATH"] = "1"  # -P for those who start Python by themselves
    return multiprocessing.get_context("spawn")
