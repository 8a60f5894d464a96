"""Measure a thousand clients at 5 Hz each against one, two and four replicas of the safety service.

    python -m benchmarks askers

The requests are recorded ones of the trained policy, with keys. Each replica is behind a router of its own, and the
clients are spread over the routers. A client stays with the replica that answers it first. Clients, routers and
services share the cores of this machine, so the share of answers in time holds for this machine only. You can use the
processor time that a request costs a service and a router for other machines.
"""

from __future__ import annotations

import heapq
import json
import tempfile
import threading
import time
from collections import Counter
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from benchmarks import situations
from benchmarks.safety_processes import cells, keys_for, piped, used, with_plan_tokens
from benchmarks.timing import Figures
from brakeline.errors import BusError, Late
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.safety.service.service_query import query_service

REPLICAS = (1, 2, 4)
CLIENTS = (50, 200, 1000)
RATE = 5.0  # Hz
SECONDS = 4.0  # of requests
DEADLINE = 0.1  # s
PROCESSES = 2  # that the clients are in, at least
SESSIONS = 6  # of each process, each with a name of its own: a service lets eight queries of one client wait
THREADS = 24  # of each process: requests that are under way at once


def _ask(settings: BusSettings, payloads: list[bytes], clients: int, out: Connection) -> None:
    """Run clients with phases of their own for `SECONDS`.

    Sends the times of the answered requests [s], and the numbers of late, unanswered and skipped requests: a request
    is skipped if the threads were still busy when the next one was due, or at the end.
    """
    requests = [pb.Request.FromString(payload) for payload in payloads]
    rng, lock = np.random.default_rng(clients), threading.Lock()
    answered, counts = list[float](), Counter[str]()
    with ExitStack() as stack:
        buses = [stack.enter_context(Bus(settings, f"client.{i}")) for i in range(SESSIONS)]
        begun = time.monotonic() + 0.5
        end = begun + SECONDS
        due = [(begun + float(phase), number) for number, phase in enumerate(rng.uniform(0.0, 1.0 / RATE, clients))]
        heapq.heapify(due)

        def work(bus: Bus) -> None:
            while (now := time.monotonic()) < end:
                with lock:
                    at, number = heapq.heappop(due)
                    missed = max(0, int((now - at) * RATE))
                    counts["skipped"] += missed
                    at += missed / RATE
                    heapq.heappush(due, (at + 1.0 / RATE, number))
                if at > end:
                    return
                time.sleep(max(0.0, at - time.monotonic()))
                before = time.perf_counter()
                try:
                    query_service(bus, [requests[(number + int(at * RATE)) % len(requests)]], DEADLINE)
                except BusError as error:
                    with lock:
                        counts["late" if isinstance(error, Late) else "unanswered"] += 1
                else:
                    answered.append(time.perf_counter() - before)

        threads = [threading.Thread(target=work, args=(buses[i % SESSIONS],)) for i in range(THREADS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    counts["skipped"] += sum(int((end - at) * RATE) + 1 for at, _ in due if at <= end)
    out.send_bytes(json.dumps([answered, counts]).encode())


def _row(
    clients: int, cell: tuple[list[str], list[int], list[int]], keys: Path, payloads: list[bytes]
) -> dict[str, float]:
    """Return the figures of so many clients. cell: what `cells` yields."""
    endpoints, services, routers = cell
    number = max(PROCESSES, len(endpoints))
    settings = [BusSettings(connect=(endpoints[i % len(endpoints)],), keys=keys) for i in range(number)]
    before = used(services), used(routers)
    answered, counts = list[float](), Counter[str]()
    with piped(_ask, [(one, payloads, clients // number) for one in settings]) as pipes:
        for pipe in pipes:
            times, numbers = json.loads(pipe.recv_bytes())
            answered += times
            counts.update(numbers)
    took, due = np.array(answered or [np.nan]), len(answered) + counts.total()
    asked = max(1, due - counts["skipped"])
    return {
        "due /s": due / SECONDS,
        "answered /s": len(answered) / SECONDS,
        "in time %": 100.0 * len(answered) / due,
        "late or none %": 100.0 * (counts["late"] + counts["unanswered"]) / due,
        "never asked %": 100.0 * counts["skipped"] / due,
        "p50 ms": 1e3 * float(np.percentile(took, 50)),
        "p99 ms": 1e3 * float(np.percentile(took, 99)),
        "service CPU ms": 1e3 * (used(services) - before[0]) / asked,
        "router CPU ms": 1e3 * (used(routers) - before[1]) / asked,
    }


def run() -> Figures:
    """Return a row for each number of clients and replicas."""
    figures: Figures = {}
    with tempfile.TemporaryDirectory() as name:
        numbers = range(max(REPLICAS))
        keys = keys_for(
            Path(name) / "keys", "client", *(f"{kind}-{i}" for i in numbers for kind in ("router", "safety"))
        )
        requests = with_plan_tokens(situations.messages("trained"), keys)
        payloads = [request.SerializeToString() for request in requests]
        for replicas in REPLICAS:
            with cells(replicas, keys) as cell:
                for clients in CLIENTS:
                    figures[f"{clients} askers, {replicas} replicas"] = _row(clients, cell, keys, payloads)
    return figures
