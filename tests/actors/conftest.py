"""Services that answer, services that do not, and what else actors talk to."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NoReturn

import pytest

from brakeline.actors.decision_guard import Ask
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.errors import NoReply
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.byte_links import open_link
from brakeline.messaging.free_ports import free_endpoint
from brakeline.safety.model.model_set import ModelConfig
from brakeline.sim.autopilot.autopilot_server import TruthSender, WallClock, serve
from brakeline.sim.autopilot.endpoint import Autopilot
from tests.robots import GROUND

STALL = 0.05  # s; after a longer one (`stalled`), a flight in real time may have missed a period of 0.2 s


def no_answer(requests: Sequence[pb.Request]) -> NoReturn:
    """Ask a safety service that does not answer."""
    raise NoReply("gone")


@contextmanager
def served(autopilot: Autopilot, truth: TruthSender | None = None) -> Iterator[str]:
    """Run an autopilot in a thread. Yields the URL that reaches it."""
    link, stop = open_link("udpin:127.0.0.1:0"), threading.Event()
    thread = threading.Thread(target=serve, args=([autopilot], link, WallClock(), stop.is_set, truth))
    thread.start()
    try:
        yield f"udpout:127.0.0.1:{link.port}"  # type: ignore[union-attr]
    finally:
        stop.set()
        thread.join()
        link.close()


@pytest.fixture
def buses() -> Iterator[tuple[Bus, Bus]]:
    endpoint = free_endpoint()
    with (
        Bus(BusSettings(listen=(endpoint,)), "learner") as learner,
        Bus(BusSettings(connect=(endpoint,)), "actor-0") as actor,
    ):
        yield learner, actor


@pytest.fixture(scope="module")
def ask(data_folder: Path) -> Ask:
    return in_process(model_for(GROUND, ModelConfig()))
