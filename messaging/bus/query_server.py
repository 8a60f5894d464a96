"""Answer queries: of each client in turn, and none whose deadline has passed."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import zenoh

from brakeline.errors import Busy, Expired, Malformed, NoModel, UnknownRobot
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus.fair_queue import FairQueue
from brakeline.messaging.bus.identity import identity_of
from brakeline.messaging.bus.subscription import ReceiverThreads
from brakeline.messaging.message_checks import NAME
from brakeline.messaging.rejected_messages import RejectedMessages

MOST_AT_ONCE = 256  # queries that a thread takes over from Zenoh before it looks after the queue
ONE_NAME = "a query names one asker in its key, with up to 100 letters, digits, '_', '.' and '-'"
LONGEST = 10.0  # longest time that a query waits; the default for one without a deadline [s]


@dataclass(frozen=True)
class PendingQuery:
    """A query and its deadline (time.monotonic)."""

    query: zenoh.Query
    asker: str  # name in the key, which the router has compared with the certificate
    until: float


Answer = Callable[
    [bytes, str], bytes
]  # from the payload of a query and the name of the asker to the payload of the reply


class QueryServer(ReceiverThreads):
    """Answers the queries of all receivers, one at a time, of each identity in turn.

    Two threads receive in turn at each receiver: one notes the time of new queries while the other one answers. The
    thread that receives a query while no thread answers starts to answer, since waking another thread takes 0.1 ms.

    The attachment of a query is its timeout in seconds, as text. It counts from the receipt, because the clocks of two
    machines may differ.
    """

    def __init__(
        self,
        name: str,
        receivers: Sequence[Any],
        handler: Answer,
        asker_in: Callable[[str], str],
        rejected: RejectedMessages,
    ) -> None:
        """Start to answer. asker_in: returns the name of the asker in the key of a query."""
        self._handler, self._asker_in, self._rejected = handler, asker_in, rejected
        self._turns = FairQueue[PendingQuery]()
        self._state = threading.Lock()
        self._answering = False
        runs = []
        for receiver in receivers:
            run = partial(self._take, receiver.handler, threading.Lock())
            runs += [run, run]
        super().__init__(name, receivers, runs)

    def _take(self, queries: Any, receiving: threading.Lock) -> None:
        while True:
            try:
                with receiving:
                    arrived = [queries.recv(), *_waiting(queries)]
            except zenoh.ZError:  # closed
                return
            answering = True in [self._admit(query) for query in arrived]
            while answering and (pending := self._next()) is not None:
                with self._rejected.skip_on_error(self._name):
                    self._answer(pending)

    def _admit(self, query: zenoh.Query) -> bool:
        """Add a query to the queue. Return whether no thread answers now."""
        asker = self._asker_in(str(query.key_expr))
        pending = PendingQuery(query, asker, time.monotonic() + _patience(query))
        with self._state:
            left_out = self._turns.add(identity_of(asker), pending)
            idle, self._answering = not self._answering, True
        if left_out is not None:
            with left_out.query as one:
                self._pass_over(one, Busy("too many queries wait"))
        return idle

    def _next(self) -> PendingQuery | None:
        """Return the next query; None: the queue is empty, and this thread stops answering."""
        with self._state:
            self._answering = len(self._turns) > 0
            return self._turns.next() if self._answering else None

    def _answer(self, pending: PendingQuery) -> None:
        """Answer a query, at least with an error: without any reply, the service looks dead."""
        with pending.query as query:
            if time.monotonic() > pending.until:
                self._pass_over(query, Expired("the deadline of the query has passed"))
                return
            try:
                if not NAME.fullmatch(pending.asker):
                    raise Malformed(f"{pending.asker[:100]!r} cannot ask: {ONE_NAME}")
                answer = self._handler(query.payload.to_bytes() if query.payload else b"", pending.asker)
                query.reply(query.key_expr, answer, express=True)
            except (NoModel, UnknownRobot) as error:  # another service on the bus may have the model
                self._pass_over(query, error)
            except Exception as error:
                _refuse(query, error)
                raise

    def _pass_over(self, query: zenoh.Query, reason: Exception) -> None:
        """Refuse a query that the machine is too slow for, or that is for another service; the log has a warning."""
        _refuse(query, reason)
        self._rejected.reject(self._name, reason, logging.WARNING)


def _waiting(queries: Any) -> Iterator[zenoh.Query]:
    """Yield the queries that have arrived, at most `MOST_AT_ONCE`.

    A thread that receives one at a time waits for the interpreter's lock before each: the one that answers holds it.
    """
    for _ in range(MOST_AT_ONCE):
        if (query := queries.try_recv()) is None:
            return
        yield query


def _refuse(query: zenoh.Query, error: Exception) -> None:
    refusal = pb.Error(type=type(error).__name__, field=str(getattr(error, "field", "")), message=str(error))
    query.reply_err(refusal.SerializeToString(), encoding=zenoh.Encoding.APPLICATION_PROTOBUF)


def _patience(query: zenoh.Query) -> float:
    """Return the timeout of a query [s]."""
    try:
        timeout = float(query.attachment.to_string()) if query.attachment is not None else LONGEST
    except (ValueError, zenoh.ZError):
        return LONGEST
    return timeout if 0.0 < timeout < LONGEST else LONGEST
