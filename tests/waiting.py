"""Waiting for what comes about in its own time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

PATIENCE = 120.0  # s: two cores that others use too


def until(
    condition: Callable[[], Any], what: str | Callable[[], str] = "it comes about", seconds: float = PATIENCE
) -> Any:
    """Wait for the condition, and return its result. what: for the error; it may be a function."""
    deadline = time.monotonic() + seconds
    while not (result := condition()):
        assert time.monotonic() < deadline, f"not within {seconds:.0f} s: {what if isinstance(what, str) else what()}"
        time.sleep(0.02)
    return result
