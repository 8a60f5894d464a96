"""Start safety services and routers in processes of their own, with keys and with requests that their keys accept."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import psutil

from benchmarks import situations
from benchmarks.timing import processor_time
from brakeline.deploy.interpreter import spawning
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.bus.certificate_authority import Authority
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.robot import robot_named
from brakeline.messaging.topics import DECIDE, JOIN
from brakeline.safety.model.model_config import AUTO
from brakeline.safety.service.plan_token import PlanAuthenticator, write_key
from brakeline.safety.service.server import BatchHandler, ModelRegistry, ServiceCounts

START_TIMEOUT = 60.0  # s
GROUND = "ground"

Begin = Callable[[Any, BusSettings, str], int]


def serve(settings: BusSettings, name: str, ready: Event, stop: Event) -> None:
    """Run a safety service of the ground robot until `stop` is set."""
    models = ModelRegistry()
    models.install(situations.model(mode=AUTO))
    authenticator = None if settings.keys is None else PlanAuthenticator.of(settings.keys)
    with Bus(settings, name) as bus:
        bus.serve(DECIDE, BatchHandler(models, ServiceCounts(), authenticator))
        if settings.keys is None:  # a query of the bus alone
            bus.serve(JOIN, lambda payload, asker: payload, robot=GROUND)
        ready.set()
        stop.wait()


def route(settings: BusSettings, name: str, ready: Event, stop: Event) -> None:
    """Run a router until `stop` is set."""
    with Bus(settings, name):
        ready.set()
        stop.wait()


@contextmanager
def piped(target: Callable[..., None], arguments: Sequence[tuple[Any, ...]]) -> Iterator[list[Connection]]:
    """Start a process for each tuple of arguments, to which its end of a pipe is added; end them with the block.

    Yields:
        The other ends of the pipes. A closed pipe asks a process to end.
    """
    spawn, started, pipes = spawning(), list[Any](), list[Connection]()
    for one in arguments:
        mine, theirs = spawn.Pipe()
        started.append(spawn.Process(target=target, args=(*one, theirs), daemon=True))
        pipes.append(mine)
        started[-1].start()
    try:
        yield pipes
    finally:
        for pipe in pipes:
            pipe.close()
        for process in started:
            process.join(5.0)


@contextmanager
def processes() -> Iterator[Begin]:
    """Yield a function that starts `serve` or `route` and returns the process id. All end with the block.

    Raises:
        RuntimeError: a process did not start.
    """
    spawn, started = spawning(), list[Any]()
    stop = spawn.Event()

    def begin(target: Any, settings: BusSettings, name: str) -> int:
        ready = spawn.Event()
        process = spawn.Process(target=target, args=(settings, name, ready, stop), daemon=True)
        started.append(process)
        process.start()
        if not ready.wait(START_TIMEOUT):
            raise RuntimeError(f"{name} did not start")
        return int(process.pid or 0)

    try:
        yield begin
    finally:
        stop.set()
        for process in started:
            process.join(5.0)
            if process.is_alive():
                process.kill()


@contextmanager
def cells(replicas: int, keys: Path) -> Iterator[tuple[list[str], list[int], list[int]]]:
    """Start routers, each linked to the first, with a service each.

    Yields:
        The endpoints, and the process ids of the services and of the routers.
    """
    endpoints = [free_endpoint("tls") for _ in range(replicas)]
    with processes() as begin:
        routers = [
            begin(route, BusSettings(listen=(e,), connect=tuple(endpoints[:1] if i else ()), keys=keys), f"router-{i}")
            for i, e in enumerate(endpoints)
        ]
        services = [begin(serve, BusSettings(connect=(e,), keys=keys), f"safety-{i}") for i, e in enumerate(endpoints)]
        time.sleep(1.0)  # until every router knows the declarations
        yield endpoints, services, routers


def keys_for(folder: Path, *names: str) -> Path:
    """Make the keys of processes and the key of the plan tokens. Returns the folder."""
    authority = Authority(folder)
    for name in names:
        authority.issue(name)
    write_key(folder)
    return folder


def with_plan_tokens(requests: list[pb.Request], keys: Path) -> list[pb.Request]:
    """Add the plan tokens that services with these keys accept from the process `client`."""
    authenticator = PlanAuthenticator.of(keys)
    for request in requests:
        request.plan_token = authenticator.plan_token(request, robot_named(request.robot), "client")
    return requests


def used(pids: list[int]) -> float:
    """Return the processor time of processes so far [s]."""
    return sum(processor_time(psutil.Process(pid)) for pid in pids)
