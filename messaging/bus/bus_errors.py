"""Errors of the bus."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from brakeline.messaging import brakeline_pb2 as pb


class BusError(Exception):
    """Base class of the errors of the bus."""


class Unreachable(BusError):
    """No router answers at any endpoint, or the process cannot listen on an endpoint."""


class Insecure(BusError):
    """Other machines could reach this bus without authentication."""


class BadKeys(BusError):
    """A folder of keys lacks a file that is needed; the message names it."""


class NoReply(BusError):
    """No service answers this query, or the service has ended."""


class Late(BusError):
    """The deadline passed without a reply."""


class Busy(BusError):
    """The queue of queries is full."""


class Expired(BusError):
    """The deadline of a query passed while it was in the queue."""


class Malformed(BusError, ValueError):
    """The bytes are no message of the topic's type, or the message is implausible."""


class Refused(BusError):
    """The service replied with an error.

    Attributes:
        type: name of the error.
        field: the invalid field of the query, or empty.
        text: the message.
    """

    def __init__(self, error: pb.Error) -> None:
        super().__init__(f"{error.type}: {error.message}")
        self.type, self.field, self.text = error.type, error.field, error.message


@contextmanager
def as_bus_error(what: str) -> Iterator[None]:
    """Raise Zenoh's errors as `BusError`."""
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{what}: {error}") from error
