"""Measure a safety decision over Zenoh: the request to a service in another process and back, with no other load.

Three services run side by side, and each request goes to all of them in turn: over TCP without keys; with keys, which
means mutual TLS, the router's access list and a token for every plan; and over a Unix socket without keys. `p50 beyond
decide` is the median of what is left without the decision itself. The bus alone sends the same bytes to a service that
returns them.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks import situations
from benchmarks.safety_processes import GROUND, keys_for, processes, serve, with_plan_tokens
from benchmarks.timing import WARM_UP, Figures, milliseconds
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.topics import JOIN
from brakeline.safety.model.model_config import AUTO
from brakeline.safety.service.service_query import query_service

REQUESTS = 500
PLAIN, KEYS, SOCKET, ALONE = "TCP", "with keys", "Unix socket", "the bus alone, TCP"


@contextmanager
def _client(how: str, listen: bool, folder: Path) -> Iterator[Bus]:
    """Connect a client to a service.

    Args:
        how: PLAIN, KEYS or SOCKET.
        listen: the service is the router itself. Else the router is in this process.
        folder: of the keys.
    """
    keys = folder if how == KEYS else None
    socket = f"unixsock-stream/{folder}/{'service' if listen else 'router'}"
    endpoint = {PLAIN: free_endpoint(), KEYS: free_endpoint("tls"), SOCKET: socket}[how]
    router, client = BusSettings(listen=(endpoint,), keys=keys), BusSettings(connect=(endpoint,), keys=keys)
    with ExitStack() as stack:
        if not listen:
            stack.enter_context(Bus(router, "router"))
        stack.enter_context(processes())(serve, router if listen else client, "safety")
        time.sleep(0.5)  # until the router knows the service's declaration
        yield stack.enter_context(Bus(client, "client"))


def _measure(listen: bool, requests: list[pb.Request]) -> Figures:
    """Return the times of each way, and the median of the extra time compared with TCP without keys."""
    seconds: dict[str, list[float]] = {PLAIN: [], KEYS: [], SOCKET: [], ALONE: []}
    decide: dict[str, list[float]] = {PLAIN: [], KEYS: [], SOCKET: []}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = keys_for(Path(name) / "keys", "safety", "router", "client")
        buses = {how: stack.enter_context(_client(how, listen, folder)) for how in decide}
        for i, request in enumerate(with_plan_tokens(requests, folder)):
            ways = list(decide)
            for how in ways[i % 3 :] + ways[: i % 3]:
                before = perf_counter()
                (reply,) = query_service(buses[how], [request], 1.0)
                seconds[how].append(perf_counter() - before)
                decide[how].append(1e-3 * reply.decision.time_ms)
            payload, before = request.SerializeToString(), perf_counter()
            buses[PLAIN].ask(JOIN, payload, 1.0, robot=GROUND)
            seconds[ALONE].append(perf_counter() - before)
    warm = {how: np.array(times[WARM_UP:]) for how, times in seconds.items()}
    figures = {how: milliseconds(times.tolist()) for how, times in warm.items()}
    for how, times in decide.items():
        figures[how]["p50 beyond decide ms"] = 1e3 * float(np.median(warm[how] - np.array(times[WARM_UP:])))
    for how in (KEYS, SOCKET):
        figures[how]["p50 more ms"] = 1e3 * float(np.median(warm[how] - warm[PLAIN]))
    return figures


def run() -> Figures:
    """Return a row for each policy and way.

    The filter allows most proposals of the trained policy at once. More than half of the random policy's need a QP.
    """
    return {
        f"{policy} policy, {name}, {how}": row
        for policy in ("trained", "random")
        for name, listen in (("service is the router", True), ("through a router", False))
        for how, row in _measure(listen, situations.messages(policy, mode=AUTO)[:REQUESTS]).items()
    }
