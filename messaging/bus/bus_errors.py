"""What can go wrong between processes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from brakeline.messaging import brakeline_pb2 as pb


class BusError(Exception):
    """Something went wrong between processes."""


class Unreachable(BusError):
    """No router answered at any endpoint, or an endpoint cannot be listened on."""


class Insecure(BusError):
    """Others could get at this bus, and nothing would tell who they are."""


class BadKeys(BusError):
    """A folder of keys does not hold what is needed; the message says what."""


class NoReply(BusError):
    """Nobody serves this question, or who served it went away."""


class Late(BusError):
    """The deadline passed without an answer."""


class Busy(BusError):
    """So many questions of this asker wait, or of so many askers, that this one can't."""


class Expired(BusError):
    """A question that came to its turn when nobody waited for the answer any more."""


class Malformed(BusError, ValueError):
    """The bytes are not a message of the topic's type, or it says what no honest sender would."""


class Refused(BusError):
    """The service answered with an error: its `type`, the `field` that is wrong (or empty) and `text`."""

    def __init__(self, error: pb.Error) -> None:
        super().__init__(f"{error.type}: {error.message}")
        self.type, self.field, self.text = error.type, error.field, error.message


@contextmanager
def as_bus_error(what: str) -> Iterator[None]:
    """Zenoh's errors as the bus's."""
    try:
        yield
    except zenoh.ZError as error:
        raise BusError(f"{what}: {error}") from error
