"""A safety decision over Zenoh: the question to a service in another process and back, with nothing else running.

Three services stand side by side, and every question goes to each in turn: over TCP without keys; with keys, which is
mutual TLS, the router's access list and a voucher for every plan; and over a Unix socket without keys.
"""

from __future__ import annotations

import multiprocessing
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from time import perf_counter

import numpy as np

from benchmarks import situations
from benchmarks.timing import WARM_UP, Figures, milliseconds
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.bus.certificate_authority import Authority
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.robot import robot_named
from brakeline.messaging.topics import DECIDE
from brakeline.safety.service.client import query_service
from brakeline.safety.service.plan_token import PlanAuthenticator, write_key
from brakeline.safety.service.server import ModelRegistry, ServiceCounts, batch_handler

QUESTIONS = 500
PLAIN, KEYS, SOCKET = "TCP", "with keys", "Unix socket"


def _serve(settings: BusSettings, ready: Event, stop: Event) -> None:
    models = ModelRegistry()
    models.install(situations.model())
    authenticator = None if settings.keys is None else PlanAuthenticator.of(settings.keys)
    with Bus(settings, "safety") as bus:
        bus.serve(DECIDE, batch_handler(models, ServiceCounts(), authenticator))
        ready.set()
        stop.wait()


@contextmanager
def _client(how: str, listen: bool, folder: Path) -> Iterator[Bus]:
    """On the bus of a service that is the router itself, or behind one in this process."""
    spawn = multiprocessing.get_context("spawn")
    ready, stop = spawn.Event(), spawn.Event()
    keys = folder if how == KEYS else None
    socket = f"unixsock-stream/{folder}/{'service' if listen else 'router'}"
    endpoint = {PLAIN: free_endpoint(), KEYS: free_endpoint("tls"), SOCKET: socket}[how]
    router = None if listen else Bus(BusSettings(listen=(endpoint,), keys=keys), "router")
    there = BusSettings(connect=(endpoint,), keys=keys)
    served = BusSettings(listen=(endpoint,), keys=keys) if listen else there
    service = spawn.Process(target=_serve, args=(served, ready, stop), daemon=True)
    service.start()
    try:
        if not ready.wait(60.0):
            raise RuntimeError("the service did not start")
        threading.Event().wait(0.5)  # until its declaration has come through
        with Bus(there, "client") as bus:
            yield bus
    finally:
        stop.set()
        service.join(5.0)
        if router is not None:
            router.close()


def _measure(listen: bool, questions: list[pb.Request]) -> Figures:
    """Times of each, and how much longer (median of the pairs) the same question takes than over TCP without keys."""
    seconds: dict[str, list[float]] = {PLAIN: [], KEYS: [], SOCKET: []}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name) / "keys"
        authority = Authority(folder)
        for process in ("safety", "router", "client"):
            authority.issue(process)
        write_key(folder)
        authenticator = PlanAuthenticator.of(folder)
        buses = {how: stack.enter_context(_client(how, listen, folder)) for how in seconds}
        for i, question in enumerate(questions):
            question.plan_token = authenticator.plan_token(question, robot_named(question.robot))
            hows = list(seconds)
            for how in hows[i % 3 :] + hows[: i % 3]:
                before = perf_counter()
                query_service(buses[how], [question], 1.0)
                seconds[how].append(perf_counter() - before)
    warm = {how: np.array(times[WARM_UP:]) for how, times in seconds.items()}
    more = {how: {"p50 more ms": 1e3 * float(np.median(times - warm[PLAIN]))} for how, times in warm.items()}
    return {how: milliseconds(times.tolist()) | (more[how] if how != PLAIN else {}) for how, times in warm.items()}


def run() -> Figures:
    """The trained policy's questions are mostly allowed at once; more than half of the random one's need a QP."""
    return {
        f"{policy} policy, {name}, {how}": row
        for policy in ("trained", "random")
        for name, listen in (("service is the router", True), ("through a router", False))
        for how, row in _measure(listen, situations.messages(policy)[:QUESTIONS]).items()
    }
