"""Errors of the bus."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from brakeline.errors import BusError


@contextmanager
def as_bus_error(what: str) -> Iterator[None]:
    """Raise Zenoh's errors as `BusError`."""
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{what}: {error}") from error
