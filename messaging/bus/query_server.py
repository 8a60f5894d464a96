"""Who answers questions: each asker's in turn, none for which nobody waits any more."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import zenoh

from brakeline.errors import Busy, Expired
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus.fair_queue import FairQueue
from brakeline.messaging.bus.subscription import ReceiverThreads
from brakeline.messaging.rejected_messages import RejectedMessages

LONGEST = 10.0  # s that a question waits which does not say for how long it is of use


@dataclass(frozen=True)
class PendingQuery:
    """A query, and until when (time.monotonic) an answer is of use."""

    query: zenoh.Query
    until: float


class QueryServer(ReceiverThreads):
    """Two threads take the questions of a receiver in turn: one notes when they come in while the other answers, and
    whoever takes one in when nobody answers does it itself, for to wake another costs a tenth of a millisecond. Who
    asks at another receiver waits for its turn like the others.

    How long an answer is of use stands in a question's attachment: seconds from when it was asked, as text; they count
    from its receipt, for the clocks of two machines agree on durations only.
    """

    def __init__(
        self, name: str, receivers: Sequence[Any], handler: Callable[[bytes], bytes], rejected: RejectedMessages
    ) -> None:
        self._handler, self._rejected, self._turns = handler, rejected, FairQueue[PendingQuery]()
        self._state = threading.Lock()
        self._answering = False
        runs = []
        for receiver in receivers:
            run = partial(self._take, receiver.handler, threading.Lock())
            runs += [run, run]
        super().__init__(name, receivers, runs)

    def _take(self, questions: Any, receiving: threading.Lock) -> None:
        while True:
            try:
                with receiving:
                    query = questions.recv()
            except zenoh.ZError:  # closed
                return
            answering = self._admit(query)
            while answering and (question := self._next()) is not None:
                with self._rejected.skip_on_error(self._name):
                    self._answer(question)

    def _admit(self, query: zenoh.Query) -> bool:
        """Let a question wait for its turn; True: nobody answers now."""
        question = PendingQuery(query, time.monotonic() + _patience(query))
        with self._state:
            left_out = self._turns.add(_asker(query), question)
            idle, self._answering = not self._answering, True
        if left_out is not None:
            with left_out.query as one:
                self._pass_over(one, Busy("too many questions wait"))
        return idle

    def _next(self) -> PendingQuery | None:
        """The question whose turn it is; None: there is none, and nobody answers any more."""
        with self._state:
            self._answering = len(self._turns) > 0
            return self._turns.next() if self._answering else None

    def _answer(self, question: PendingQuery) -> None:
        """Answer one query; without an answer of some kind the service would look dead."""
        with question.query as query:
            if time.monotonic() > question.until:
                self._pass_over(query, Expired("nobody waits for this answer any more"))
                return
            try:
                answer = self._handler(query.payload.to_bytes() if query.payload else b"")
                query.reply(query.key_expr, answer, express=True)
            except Exception as error:
                _refuse(query, error)
                raise

    def _pass_over(self, query: zenoh.Query, reason: Busy | Expired) -> None:
        """That the machine does not keep up is nobody's mistake."""
        _refuse(query, reason)
        self._rejected.reject(self._name, reason, logging.WARNING)


def _refuse(query: zenoh.Query, error: Exception) -> None:
    refusal = pb.Error(type=type(error).__name__, field=str(getattr(error, "field", "")), message=str(error))
    query.reply_err(refusal.SerializeToString(), encoding=zenoh.Encoding.APPLICATION_PROTOBUF)


def _asker(query: zenoh.Query) -> str:
    """Whose turn it is: the session's; all that do not say so share one."""
    source = query.source_info
    return "" if source is None else str(source.source_id.zid)


def _patience(query: zenoh.Query) -> float:
    """[s]."""
    try:
        said = float(query.attachment.to_string()) if query.attachment is not None else LONGEST
    except (ValueError, zenoh.ZError):
        return LONGEST
    return said if 0.0 < said < LONGEST else LONGEST
