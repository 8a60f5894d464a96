"""A clock for time stamps that goes on evenly, also when somebody sets the computer's clock."""

from __future__ import annotations

import time

_START = time.time_ns() - time.monotonic_ns()


def steady_time_ns() -> int:
    """Return the time in ns since the Unix epoch, by the computer's clock at the start of this process.

    If somebody sets the clock later, this time goes on as before: differences between two times of a process are
    durations.
    """
    return _START + time.monotonic_ns()
