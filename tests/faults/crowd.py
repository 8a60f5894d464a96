"""Time a 50 Hz client alone, and again while an authorised actor sends junk, sessions idle, and a listener has stopped.

python -m benchmarks crowd [--rate 5000]

The junk is noise, and requests that lack nearly all fields. One session sends as many steps a second as another one
sends requests, both with an actor's certificate. The listener may hear steps, and its process is stopped (SIGSTOP). The
client sends the requests of a trained policy, each with its deadline. All share this machine's cores with the router
and the service, so the senders of junk run at a lower priority.
"""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import zenoh

from benchmarks import situations
from benchmarks.safety_processes import cells, keys_for, used, with_plan_tokens
from benchmarks.timing import Figures, stalls
from brakeline.deploy.interpreter import spawning
from brakeline.errors import BusError, Late
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.bus.bus_settings import open_session
from brakeline.messaging.topics import DECIDE, STEP
from brakeline.safety.service.service_query import query_service

RATE = 50.0  # Hz of the asker
DEADLINE = 0.1  # s
SECONDS = 20.0  # of asking, each time
IDLE = 500  # sessions
EACH = 125  # of them in one process
JUNK = 5000  # messages /s of each sender
LARGEST = 600  # bytes of junk
BURST = 0.002  # s between two bursts of junk


def _report(pipe: Connection, figure: float) -> None:
    """Send a number to the process that started this one."""
    pipe.send_bytes(str(figure).encode())


def _reported(pipe: Connection) -> float:
    """Wait for the number that a process sends."""
    return float(pipe.recv_bytes())


def _junk(settings: BusSettings, question: bool, rate: int, sent: Connection, stop: Event) -> None:
    """Send noise until the event is set; report the number of messages a second."""
    os.nice(10)
    random = Random(question)
    noise = [random.randbytes(random.randrange(1, LARGEST)) for _ in range(256)]
    noise += [
        pb.RequestBatch(requests=[pb.Request(robot="ground", state=[0.0] * n)]).SerializeToString() for n in range(9)
    ]
    session: Any = open_session(settings, "actor-0")  # Any: parts of its stubs are untyped
    with session:
        step = f"{settings.prefix}/{STEP.at(robot='ground', source='actor-0')}"
        publisher = session.declare_publisher(step, congestion_control=zenoh.CongestionControl.BLOCK)
        decide = f"{settings.prefix}/{DECIDE.at(robot='ground', source='actor-0')}"
        drop = zenoh.CongestionControl.DROP
        querier = session.declare_querier(decide, timeout=DEADLINE, congestion_control=drop)

        def send(payload: bytes) -> None:
            if question:
                querier.get(lambda reply: None, payload=payload)
            else:
                publisher.put(payload)

        begun, count = time.monotonic(), 0
        while not stop.is_set():
            for _ in range(int((time.monotonic() - begun) * rate) - count):
                send(noise[count % len(noise)])
                count += 1
            time.sleep(BURST)
        _report(sent, count / (time.monotonic() - begun))


def _idle(settings: BusSettings, sessions: int, up: Connection, stop: Event) -> None:
    """Open sessions that send nothing."""
    with ExitStack() as stack:
        for _ in range(sessions):
            stack.enter_context(open_session(settings, "actor-0"))
        _report(up, sessions)
        stop.wait()


def _listen(settings: BusSettings, up: Connection, _: Event) -> None:
    """Subscribe to steps, for ever: the parent stops this process, and then kills it."""
    with Bus(settings, "recorder") as bus:
        bus.subscribe(STEP, lambda sample: None)
        _report(up, 1)
        threading.Event().wait()


@contextmanager
def _crowd(settings: BusSettings, rate: int) -> Iterator[dict[str, float]]:
    """Start everything that could starve a client; yield figures that are complete at the end."""
    spawn, said = spawning(), {"junk steps /s": 0.0, "junk questions /s": 0.0, "idle sessions": 0.0}
    stop, started = spawn.Event(), []

    def begin(target: Any, *given: Any) -> Connection:
        mine, theirs = spawn.Pipe(duplex=False)
        started.append(spawn.Process(target=target, args=(settings, *given, theirs, stop), daemon=True))
        started[-1].start()
        return mine

    try:
        _reported(begin(_listen))
        idle = [begin(_idle, EACH) for _ in range(IDLE // EACH)]
        said["idle sessions"] = sum(_reported(pipe) for pipe in idle)
        os.kill(started[0].pid or 0, signal.SIGSTOP)
        senders = {"junk steps /s": begin(_junk, False, rate), "junk questions /s": begin(_junk, True, rate)}
        time.sleep(3.0)  # until they send
        yield said
        stop.set()
        said |= {name: _reported(pipe) for name, pipe in senders.items()}
    finally:
        stop.set()
        started[0].kill()  # the listener
        for process in started:
            process.join(10.0)
            if process.is_alive():
                process.kill()


def _ask(settings: BusSettings, questions: list[pb.Request]) -> dict[str, float]:
    """Send requests at 50 Hz; return figures of the answers."""
    took: list[float] = []
    late = unanswered = 0
    with Bus(settings, "client") as bus:
        begun = time.monotonic()
        for number in range(int(SECONDS * RATE)):
            time.sleep(max(0.0, begun + number / RATE - time.monotonic()))
            before = time.perf_counter()
            try:
                query_service(bus, [questions[number % len(questions)]], DEADLINE)
            except Late:
                late += 1
            except BusError:
                unanswered += 1
            else:
                took.append(time.perf_counter() - before)
    p50, p99, most = np.percentile(took or [np.nan], (50, 99, 100)) * 1e3
    counts = {"asked": SECONDS * RATE, "late": late, "no answer": unanswered}
    return counts | {"p50 ms": p50, "p99 ms": p99, "longest ms": most}


def run(rate: int = JUNK) -> Figures:
    """Compare answers without and with junk messages of each kind at `rate` [1/s]."""
    with tempfile.TemporaryDirectory() as name:
        keys = keys_for(Path(name) / "keys", "router-0", "safety-0", "client", "actor-0", "recorder")
        questions = with_plan_tokens(situations.messages("trained"), keys)
        with cells(1, keys) as (endpoints, services, routers):
            settings = BusSettings(connect=tuple(endpoints), keys=keys)
            alone = _ask(settings, questions)
            with _crowd(settings, rate) as said:
                processes = {"service": services, "router": routers}
                before = {which: used(pids) for which, pids in processes.items()}
                with stalls(0.001) as lost:
                    crowded = _ask(settings, questions)
                crowded["the machine's longest stall ms"] = 1e3 * lost.worst
                for which, pids in processes.items():
                    crowded[f"{which}, cores"] = (used(pids) - before[which]) / SECONDS
    return {"alone": alone, "in the crowd": crowded | said}
