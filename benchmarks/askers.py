"""A thousand robots' questions, 5 a second each, against one, two and four replicas of the safety service.

python -m benchmarks askers

The questions are recorded ones of the trained policy, with keys. A replica stands behind a router of its own, and
askers are spread over the routers; each stays with the replica that answers it first. Askers, routers and services
share this machine's cores, so what is answered in time is this machine's, all of it together; the processor
time that a question costs a service and a router is what can be carried over to others.
"""

from __future__ import annotations

import heapq
import json
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks import situations
from benchmarks.timing import Figures
from brakeline.deploy.interpreter import spawning
from brakeline.errors import BusError, Late
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.bus.certificate_authority import Authority
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.robot import robot_named
from brakeline.messaging.topics import DECIDE
from brakeline.safety.service.client import query_service
from brakeline.safety.service.plan_token import PlanAuthenticator, write_key
from brakeline.safety.service.server import ModelRegistry, ServiceCounts, batch_handler

REPLICAS = (1, 2, 4)
ASKERS = (50, 200, 1000)
RATE = 5.0  # Hz
SECONDS = 4.0  # of asking
DEADLINE = 0.1  # s
CROWD = 2  # processes that askers are in
SESSIONS = 6  # of each of them: a service lets eight questions of one session wait
THREADS = 24  # of each: questions that are on their way at once


@dataclass(frozen=True)
class CrowdResult:
    """Answers to the questions of some askers; times in s."""

    answered: list[float]
    late: int
    unanswered: int
    skipped: int  # not asked, for the crowd was still busy when the next one was due


def _serve(settings: BusSettings, name: str, ready: Event, stop: Event) -> None:
    models = ModelRegistry()
    models.install(situations.model())
    assert settings.keys is not None
    with Bus(settings, name) as bus:
        bus.serve(DECIDE, batch_handler(models, ServiceCounts(), PlanAuthenticator.of(settings.keys)))
        ready.set()
        stop.wait()


def _route(settings: BusSettings, name: str, ready: Event, stop: Event) -> None:
    with Bus(settings, name):
        ready.set()
        stop.wait()


def _crowd(settings: BusSettings, questions: list[bytes], askers: int, out: Connection) -> None:
    """Askers with phases of their own, until `SECONDS` are over."""
    requests = [pb.Request.FromString(payload) for payload in questions]
    rng, lock = np.random.default_rng(askers), threading.Lock()
    with ExitStack() as stack:
        buses = [stack.enter_context(Bus(settings, f"client.{i}")) for i in range(SESSIONS)]
        begun = time.monotonic() + 0.5
        due = [(begun + float(phase), number) for number, phase in enumerate(rng.uniform(0.0, 1.0 / RATE, askers))]
        heapq.heapify(due)
        answered: list[float] = []
        counts = {"late": 0, "unanswered": 0, "skipped": 0}

        def work(bus: Bus) -> None:
            while True:
                with lock:
                    at, number = heapq.heappop(due)
                    missed = max(0, int((time.monotonic() - at) * RATE))
                    counts["skipped"] += missed
                    at += missed / RATE
                    heapq.heappush(due, (at + 1.0 / RATE, number))
                if at > begun + SECONDS:
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
    out.send_bytes(json.dumps(asdict(CrowdResult(answered, **counts))).encode())


@contextmanager
def cells(replicas: int, keys: Path) -> Iterator[tuple[list[str], list[int], list[int]]]:
    """Routers, each linked to the first, with a service each: endpoints, and process ids of services and routers."""
    spawn = spawning()
    stop, endpoints = spawn.Event(), [free_endpoint("tls") for _ in range(replicas)]
    started: list[Any] = []

    def begin(target: Any, settings: BusSettings, name: str) -> int:
        ready = spawn.Event()
        started.append(spawn.Process(target=target, args=(settings, name, ready, stop), daemon=True))
        started[-1].start()
        if not ready.wait(60.0):
            raise RuntimeError(f"{name} did not start")
        return int(started[-1].pid or 0)

    try:
        routers = [
            begin(_route, BusSettings(listen=(e,), connect=tuple(endpoints[:1] if i else ()), keys=keys), f"router-{i}")
            for i, e in enumerate(endpoints)
        ]
        services = [begin(_serve, BusSettings(connect=(e,), keys=keys), f"safety-{i}") for i, e in enumerate(endpoints)]
        time.sleep(1.0)  # until the declarations have come through
        yield endpoints, services, routers
    finally:
        stop.set()
        for process in started:
            process.join(5.0)
            if process.is_alive():
                process.kill()


def used(pids: list[int]) -> float:
    """s of processor time so far."""
    return sum(sum(psutil.Process(pid).cpu_times()[:2]) for pid in pids)


def _row(
    askers: int, endpoints: list[str], services: list[int], routers: list[int], keys: Path, questions: list[bytes]
) -> dict[str, float]:
    spawn, crowds = spawning(), max(CROWD, len(endpoints))
    pipes, started = [], []
    for i in range(crowds):
        mine, theirs = spawn.Pipe(duplex=False)
        settings = BusSettings(connect=(endpoints[i % len(endpoints)],), keys=keys)
        started.append(spawn.Process(target=_crowd, args=(settings, questions, askers // crowds, theirs), daemon=True))
        pipes.append(mine)
    before = used(services), used(routers)
    for process in started:
        process.start()
    results = [CrowdResult(**json.loads(pipe.recv_bytes())) for pipe in pipes]
    for process in started:
        process.join()
    took = np.array([second for result in results for second in result.answered] or [np.nan])
    due = sum(len(r.answered) + r.late + r.unanswered + r.skipped for r in results)
    asked = max(1, due - sum(r.skipped for r in results))
    return {
        "due /s": due / SECONDS,
        "answered /s": len(took) / SECONDS,
        "in time %": 100.0 * len(took) / due,
        "late or none %": 100.0 * sum(r.late + r.unanswered for r in results) / due,
        "never asked %": 100.0 * sum(r.skipped for r in results) / due,
        "p50 ms": 1e3 * float(np.percentile(took, 50)),
        "p99 ms": 1e3 * float(np.percentile(took, 99)),
        "service CPU ms": 1e3 * (used(services) - before[0]) / asked,
        "router CPU ms": 1e3 * (used(routers) - before[1]) / asked,
    }


def run() -> Figures:
    figures: Figures = {}
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        keys = Path(name) / "keys"
        authority = Authority(keys)
        for i in range(max(REPLICAS)):
            authority.issue(f"router-{i}")
            authority.issue(f"safety-{i}")
        authority.issue("client")
        write_key(keys)
        authenticator, asked = PlanAuthenticator.of(keys), situations.messages("trained")
        for question in asked:
            question.plan_token = authenticator.plan_token(question, robot_named(question.robot))
        questions = [question.SerializeToString() for question in asked]
        for replicas in REPLICAS:
            endpoints, services, routers = stack.enter_context(cells(replicas, keys))
            for askers in ASKERS:
                row = _row(askers, endpoints, services, routers, keys, questions)
                figures[f"{askers} askers, {replicas} replicas"] = row
            stack.pop_all().close()
    return figures
