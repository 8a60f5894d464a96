"""A safety decision over Zenoh: the question to a service in another process and back, with nothing else running."""

from __future__ import annotations

import threading
from functools import partial
from multiprocessing.synchronize import Event

from deploy.bench import situations
from deploy.bench.timing import Figures, each
from deploy.interpreter import spawning
from messaging.bus import Bus, BusSettings
from messaging.ports import free_endpoint
from messaging.topics import DECIDE
from safety.client import ask
from safety.service import Counts, Models, answerer

QUESTIONS = 1500


def _serve(endpoint: str, listen: bool, ready: Event, stop: Event) -> None:
    models = Models()
    models.install(situations.model())
    settings = BusSettings(listen=(endpoint,)) if listen else BusSettings(connect=(endpoint,))
    with Bus(settings, "safety") as bus:
        bus.serve(DECIDE, answerer(models, Counts()))
        ready.set()
        stop.wait()


def _measure(listen: bool, policy: str) -> dict[str, float]:
    """A policy's questions to a service that is the router itself, or behind one in this process."""
    spawn = spawning()
    endpoint, ready, stop = free_endpoint(), spawn.Event(), spawn.Event()
    router = None if listen else Bus(BusSettings(listen=(endpoint,)), "router")
    service = spawn.Process(target=_serve, args=(endpoint, listen, ready, stop), daemon=True)
    service.start()
    try:
        if not ready.wait(60.0):
            raise RuntimeError("the service did not start")
        threading.Event().wait(0.5)  # until its declaration has come through
        asked = situations.messages(policy)[:QUESTIONS]
        with Bus(BusSettings(connect=(endpoint,)), "bench") as bus:
            return each([partial(ask, bus, [request], 1.0) for request in asked])
    finally:
        stop.set()
        service.join(5.0)
        if router is not None:
            router.close()


def run() -> Figures:
    """The trained policy's questions are mostly allowed at once; more than half of the random one's need a QP."""
    return {
        f"{policy} policy, {name}": _measure(listen, policy)
        for policy in ("trained", "random")
        for name, listen in (("service is the router", True), ("through a router", False))
    }
