"""Who asks: all that serve at first, and then whoever answered first, by itself, for as long as it does."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import zenoh

from brakeline.errors import Late, NoReply, Refused
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus.bus_errors import as_bus_error
from brakeline.messaging.bus.topic_keys import own_key

RENEWED = 30.0  # s after which all are asked again: there may be more of them by now, or one that is less busy
HELD = 1.0  # s for which who was late is asked again: if all are late, to ask all each time makes them later
AGAIN = 0.1  # of the deadline: all are asked when one is known to be gone before that
PATIENT = 1.0  # s of a deadline from which on a busy link is waited for: before that, question or answer is dropped


@dataclass(frozen=True)
class _Chosen:
    """Who answered first, and since when (time.monotonic) it alone is asked."""

    key: str
    since: float

    @property
    def age(self) -> float:
        return time.monotonic() - self.since


class QueryClient:
    """A session's questions. With Zenoh's own choice (BEST_MATCHING) each goes to a replica of every linked router."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._queriers: dict[tuple[str, float], zenoh.Querier] = {}
        self._chosen: dict[str, _Chosen] = {}

    def ask(self, key: str, payload: bytes, timeout: float) -> bytes:
        """The answer of one that serves `key`, within `timeout` s; errors as `Bus.ask` says."""
        begun = time.monotonic()
        chosen = self._chosen.get(key)
        if chosen is not None and chosen.age < RENEWED:
            try:
                return self._answer(key, chosen.key, payload, timeout)
            except NoReply:
                if time.monotonic() - begun > AGAIN * timeout:
                    raise
        return self._answer(key, key, payload, timeout)

    def _answer(self, key: str, at: str, payload: bytes, timeout: float) -> bytes:
        """Of whom a question reaches `at` (the shared key or one's own); who answered to all is chosen."""
        refusal: Refused | None = None
        late, begun = False, time.monotonic()
        with as_bus_error(f"cannot ask {key}"):
            querier = self._querier(at, timeout)
            source = zenoh.SourceInfo(querier.id, 0)  # whose turn it is
            for reply in querier.get(payload=payload, attachment=f"{timeout:.6g}", source_info=source):
                if reply.ok is not None:
                    if at == key and reply.replier_id is not None:
                        self._choose(key, own_key(key, reply.replier_id.zid))
                    return reply.ok.payload.to_bytes()
                assert reply.err is not None
                if reply.err.encoding == zenoh.Encoding.APPLICATION_PROTOBUF:
                    refusal = Refused(pb.Error.FromString(reply.err.payload.to_bytes()))
                else:  # Zenoh's own error reply: its timer ran out
                    late = True
        self._forget(key, HELD if late or refusal is not None else 0.0)
        if refusal is not None:  # it may be busy
            raise refusal
        if late or time.monotonic() - begun >= timeout:  # a busy Zenoh may end a question without its timer's reply
            raise Late(f"no answer to {key} within {timeout * 1e3:.0f} ms")
        raise NoReply(f"nobody answers {key}: is the service running, and on the same bus?")

    def _choose(self, key: str, own: str) -> None:
        with self._lock:
            if (before := self._chosen.get(key)) is not None and before.key != own:
                self._leave(before)
            self._chosen[key] = _Chosen(own, time.monotonic())

    def _forget(self, key: str, held: float) -> None:
        """Who was chosen, unless it was so within `held` s."""
        with self._lock:
            if (chosen := self._chosen.get(key)) is not None and chosen.age >= held:
                del self._chosen[key]
                self._leave(chosen)

    def _leave(self, chosen: _Chosen) -> None:
        for known in [known for known in self._queriers if known[0] == chosen.key]:
            del self._queriers[known]

    def _querier(self, key: str, timeout: float) -> zenoh.Querier:
        with self._lock:
            if (key, timeout) not in self._queriers:
                self._queriers[key, timeout] = self._session.declare_querier(
                    key,
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,  # the first answer is the answer
                    timeout=timeout,
                    priority=zenoh.Priority.REAL_TIME,
                    congestion_control=_congestion(timeout),  # of the answer, too
                    express=True,
                )
            return self._queriers[key, timeout]


def _congestion(timeout: float) -> zenoh.CongestionControl:
    """Who asks is never stalled past a short deadline, and loses nothing before a long one."""
    return zenoh.CongestionControl.BLOCK if timeout >= PATIENT else zenoh.CongestionControl.DROP
