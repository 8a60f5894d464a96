"""Start other Python processes with the packages of this one.

They never import a module that happens to lie in the working directory, which `python -m` and `python -c` search first.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from multiprocessing.context import SpawnContext

PYTHON = (sys.executable, "-P")


def spawning() -> SpawnContext:
    """Return the context that starts new processes. A forked one would share locks of libraries with threads."""
    os.environ["PYTHONSAFEPATH"] = "1"  # -P for the processes of multiprocessing
    return multiprocessing.get_context("spawn")
