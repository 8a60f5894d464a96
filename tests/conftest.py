"""A small recording of the ground robot, made once a session, for the tests that need a model set."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from deploy import store
from messaging.robots import GROUND, QUADROTOR
from safety.model_set import Recipe

FLIGHTS = 80  # trajectories of the quadrotor, recorded in half a minute
TRAJECTORIES = 50  # enough for every check of the certificates, recorded in ten seconds


@pytest.fixture(scope="session")
def data_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What `$BRAKELINE_DATA` is from here on, for this process and its children: a data set and the default model."""
    before = os.environ.get("BRAKELINE_DATA")
    folder = tmp_path_factory.mktemp("data")
    os.environ["BRAKELINE_DATA"] = str(folder)
    store.recorded(GROUND, trajectories=TRAJECTORIES)
    store.model_for(GROUND, Recipe())
    yield folder
    if before is None:
        del os.environ["BRAKELINE_DATA"]
    else:
        os.environ["BRAKELINE_DATA"] = before


@pytest.fixture(scope="session")
def flight_folder(data_folder: Path) -> Path:
    """The same, with a data set of the quadrotor, and its models in lockstep and in real time."""
    store.recorded(QUADROTOR, trajectories=FLIGHTS)
    for robot in (QUADROTOR, QUADROTOR.in_real_time()):
        store.model_for(robot, Recipe())
    return data_folder
