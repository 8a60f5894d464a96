"""Measure what one safety service can answer: with 1, 8 and 64 askers, and when three times as much is asked.

    python -m benchmarks limit

The service is the router itself. The askers are in several processes and send recorded requests of the trained policy
that they encoded before, so that an asker costs a small part of what the service does. First each asker asks again as
soon as it has its answer: `saturated` is the time for which the threads of the service worked or waited for a core, as
a share of the time that passed. At 1 and above, the service is the limit. Then the askers send three times the requests
that it answered at most, whatever it answers, and after that a quarter of it. If all of those are answered in time, the
service has recovered.

Other load on the machine lowers the answers a second. It changes the answers for a second of processor time less.
"""

from __future__ import annotations

import json
import os
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import zenoh

from benchmarks import situations
from benchmarks.safety_processes import piped, processes, serve, used
from benchmarks.timing import Figures
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import BusSettings, configuration
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.topics import DECIDE
from brakeline.safety.model.model_config import AUTO

ASKERS = (1, 8, 64)
PROCESSES = 4  # that the askers are in, at most
SECONDS = 4.0  # of each row
DEADLINE = 0.1  # s
OVERLOAD, CALM = 3.0, 0.25  # of the largest number of answers
SEEN = 400  # requests


@dataclass
class Outcomes:
    """What became of the questions of one process: the times of answers in time [s], and when each was asked."""

    seconds: list[float] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    first: float = float("inf")  # s from the begin until the first answer in time

    def reply(self, begun: float, asked: float, reply: zenoh.Reply) -> None:
        """Count a reply; `begun`, `asked`: time.monotonic."""
        now = time.monotonic()
        if reply.ok is not None and now - asked <= DEADLINE:
            self.seconds.append(now - asked)
            self.first = min(self.first, now - begun)
        elif reply.ok is not None:
            self.counts["late"] += 1
        elif reply.err is not None and reply.err.encoding == zenoh.Encoding.APPLICATION_PROTOBUF:
            self.counts[pb.Error.FromString(reply.err.payload.to_bytes()).type] += 1
        else:
            self.counts["no answer"] += 1


class Askers:
    """The askers of one process, each with a name of its own: the service answers names in turn."""

    def __init__(self, session: zenoh.Session, names: Sequence[str], payloads: Sequence[bytes]) -> None:
        self.payloads = payloads
        self._queriers = [
            session.declare_querier(
                f"brakeline/{DECIDE.at(robot='ground', source=name)}",
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=DEADLINE,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
            for name in names
        ]

    def again_and_again(self) -> Outcomes:
        """Let each asker ask as soon as it has its answer, for `SECONDS`."""
        outcomes, begun = Outcomes(), time.monotonic()

        def work(querier: zenoh.Querier) -> None:
            for payload in _endless(self.payloads):
                if (asked := time.monotonic()) > begun + SECONDS:
                    return
                for reply in querier.get(payload=payload, attachment=f"{DEADLINE}"):
                    outcomes.reply(begun, asked, reply)

        threads = [threading.Thread(target=work, args=(querier,)) for querier in self._queriers]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return outcomes

    def at_a_rate(self, rate: float) -> Outcomes:
        """Ask `rate` questions a second in turn for `SECONDS`, whether they are answered or not."""
        outcomes, begun = Outcomes(), time.monotonic()
        for number, payload in enumerate(islice(_endless(self.payloads), int(rate * SECONDS))):
            time.sleep(max(0.0, begun + number / rate - time.monotonic()))
            take = partial(outcomes.reply, begun, time.monotonic())
            querier = self._queriers[number % len(self._queriers)]
            querier.get(take, payload=payload, attachment=f"{DEADLINE}")
            outcomes.counts["asked"] += 1
        time.sleep(2.0 * DEADLINE)
        return outcomes


def _endless(payloads: Sequence[bytes]) -> Iterator[bytes]:
    while True:
        yield from payloads


def _ask(settings: BusSettings, names: Sequence[str], payloads: list[bytes], pipe: Connection) -> None:
    """Run the askers of a process: each message is a rate, -1 for as soon as possible; the answer is the outcomes."""
    os.nice(5)  # the service comes first, so that it is the limit
    with zenoh.open(configuration(settings, "client")) as session:
        askers = Askers(session, names, payloads)
        pipe.send_bytes(b"ready")
        with suppress(EOFError):
            while rate := float(pipe.recv_bytes()):
                outcomes = askers.again_and_again() if rate < 0.0 else askers.at_a_rate(rate)
                pipe.send_bytes(json.dumps([outcomes.seconds, outcomes.counts, outcomes.first]).encode())


class Crowd:
    """Processes with askers."""

    def __init__(self, pipes: Sequence[Connection], service: int) -> None:
        self._pipes, self._service = pipes, service

    def row(self, rate: float = 0.0) -> dict[str, float]:
        """Let the askers ask at a rate in all, or as fast as they get answers, and return the figures."""
        before, waited, began = used([self._service]), _waited(self._service), time.monotonic()
        for pipe in self._pipes:
            pipe.send_bytes(str(rate / len(self._pipes) or -1.0).encode())
        outcomes = Outcomes()
        for pipe in self._pipes:
            seconds, counts, first = json.loads(pipe.recv_bytes())
            outcomes.seconds += seconds
            outcomes.counts.update(counts)
            outcomes.first = min(outcomes.first, first)
        worked, took = used([self._service]) - before, np.array(outcomes.seconds or [np.nan])
        counts, answered = outcomes.counts, len(outcomes.seconds)
        asked = counts.pop("asked", 0) or answered + counts.total()
        return {
            "asked /s": asked / SECONDS,
            "in time /s": answered / SECONDS,
            "in time %": 100.0 * answered / max(1, asked),
            "refused %": 100.0 * (counts["Busy"] + counts["Expired"]) / max(1, asked),
            "late, none %": 100.0 * (counts["late"] + counts["no answer"]) / max(1, asked),
            "p50 ms": 1e3 * float(np.percentile(took, 50)),
            "p99 ms": 1e3 * float(np.percentile(took, 99)),
            "first ms": 1e3 * outcomes.first,
            "saturated": (worked + _waited(self._service) - waited) / (time.monotonic() - began),
            "CPU ms": 1e3 * worked / max(1, answered),
        }


def _waited(pid: int) -> float:
    """Return for how long the threads of a process have waited for a core so far [s]."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return 1e-9 * sum(int((task / "schedstat").read_text().split()[1]) for task in tasks)


@contextmanager
def _crowd(endpoint: str, askers: int, payloads: list[bytes], service: int) -> Iterator[Crowd]:
    number, settings = min(PROCESSES, askers), BusSettings(connect=(endpoint,))
    names = [[f"client.{i}-{k}" for k in range(askers // number)] for i in range(number)]
    with piped(_ask, [(settings, some, payloads) for some in names]) as pipes:
        for pipe in pipes:
            pipe.recv_bytes()
        time.sleep(1.0)  # until every asker knows the service
        yield Crowd(pipes, service)


def run() -> Figures:
    """Return a row for each number of askers, for the overload, and for the time after it."""
    requests = situations.messages("trained", mode=AUTO)[:SEEN]
    payloads = [pb.RequestBatch(requests=[one], nonce=bytes(16)).SerializeToString() for one in requests]
    figures: Figures = {}
    with processes() as begin:
        endpoint = free_endpoint()
        service = begin(serve, BusSettings(listen=(endpoint,)), "safety")
        for askers in ASKERS:
            with _crowd(endpoint, askers, payloads, service) as crowd:
                figures[f"{askers} askers"] = crowd.row()
                if askers == ASKERS[-1]:
                    most = max(row["in time /s"] for row in figures.values())
                    figures["three times as much"] = crowd.row(OVERLOAD * most)
                    figures["a quarter, right after it"] = crowd.row(CALM * most)
    return figures
