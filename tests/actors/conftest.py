"""The buses of a learner and an actor, and the filter of the ground robot in this process."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NoReturn

import pytest

from brakeline.actors.decision_guard import Ask
from brakeline.deploy.data.model_store import model_for
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.errors import NoReply
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.safety.model.model_set import ModelConfig
from tests.robots import GROUND


def no_answer(requests: Sequence[pb.Request]) -> NoReturn:
    """Ask a safety service that does not answer."""
    raise NoReply("gone")


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
