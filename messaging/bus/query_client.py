"""Ask queries: the first one goes to all services, and the next ones to the service that answered first."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass

import zenoh
from google.protobuf.message import DecodeError

from brakeline.errors import Late, NoReply, Refused
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus.topic_keys import own_key
from brakeline.messaging.bus.zenoh_sessions import as_bus_error

RENEWED = 30.0  # time after which all services are asked again, as there may be a new or a less busy one [s]
HELD = 1.0  # time for which a late service keeps its place [s]: asking all makes all of them later
AGAIN = 0.1  # share of the deadline within which all are asked if the chosen service is gone
PATIENT = 1.0  # deadline from which a query waits for a busy link instead of being dropped [s]


@dataclass(frozen=True)
class _Chosen:
    """The service that answered first, and since when (time.monotonic) queries go to it alone."""

    key: str
    since: float

    @property
    def age(self) -> float:
        """Time since the service was chosen [s]."""
        return time.monotonic() - self.since


class QueryClient:
    """Asks the queries of a session. Zenoh's target BEST_MATCHING would ask one replica at every linked router."""

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._queriers: dict[tuple[str, float], zenoh.Querier] = {}
        self._chosen: dict[str, _Chosen] = {}

    def ask(self, key: str, payload: bytes, timeout: float) -> bytes:
        """Return the answer of a service at `key`. See `Bus.ask`."""
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
        """Ask the services at `at`: the shared key, which chooses the first one that answers, or the chosen one's."""
        refusal: Refused | None = None
        late, begun = False, time.monotonic()
        with as_bus_error(f"cannot ask {key}"):
            querier = self._querier(at, timeout)
            for reply in querier.get(payload=payload, attachment=f"{timeout:.6g}"):
                if reply.ok is not None:
                    if at == key and reply.replier_id is not None:
                        self._choose(key, own_key(key, reply.replier_id.zid))
                    return reply.ok.payload.to_bytes()
                assert reply.err is not None
                if reply.err.encoding == zenoh.Encoding.APPLICATION_PROTOBUF:
                    refusal = _refusal(reply.err.payload.to_bytes())
                else:  # Zenoh's own error: its timer ran out
                    late = True
        self._forget(key, HELD if late or refusal is not None else 0.0)
        if refusal is not None:  # the service may be busy
            raise refusal
        if late or time.monotonic() - begun >= timeout:  # a busy Zenoh may end a query without the error of its timer
            raise Late(f"no answer to {key} within {timeout * 1e3:.0f} ms")
        raise NoReply(f"nobody answers {key}: is the service running, and on the same bus?")

    def _choose(self, key: str, own: str) -> None:
        with self._lock:
            if (before := self._chosen.get(key)) is not None and before.key != own:
                self._leave(before)
            self._chosen[key] = _Chosen(own, time.monotonic())

    def _forget(self, key: str, held: float) -> None:
        """Forget the chosen service, unless it was chosen within the last `held` seconds."""
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
                # At a short deadline, drop, so that the caller never stalls; at a long one, wait: nothing is lost.
                block = timeout >= PATIENT
                self._queriers[key, timeout] = self._session.declare_querier(
                    key,
                    target=zenoh.QueryTarget.ALL,
                    consolidation=zenoh.ConsolidationMode.NONE,  # the first answer counts
                    timeout=timeout,
                    priority=zenoh.Priority.REAL_TIME,
                    # of the answer too
                    congestion_control=zenoh.CongestionControl.BLOCK if block else zenoh.CongestionControl.DROP,
                    express=True,
                )
            return self._queriers[key, timeout]


def _refusal(payload: bytes) -> Refused:
    """Return the error that a service replied; of a broken service, that its reply is no error message."""
    try:
        return Refused(pb.Error.FromString(payload))
    except DecodeError as error:
        return Refused(pb.Error(type="BadReply", message=f"not an error message: {error}"))
