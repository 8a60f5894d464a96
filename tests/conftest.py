"""A small recording of the ground robot, made once a session, for the tests that need a model set; and who runs what
where tests run side by side (`pytest -n 4`)."""

import fcntl
import gc
import os
import tempfile
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings
from xdist.scheduler import LoadScopeScheduling

from benchmarks.timing import stalls
from brakeline.deploy.data import data_paths, model_store, simulated_recording
from brakeline.errors import BadModel
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from tests.accepting import BOUND
from tests.browser import CHROMIUM, Page
from tests.robots import GROUND, QUADROTOR

gc.disable()  # until all tests are collected: to search the half million objects takes a second in each process

# A machine that stalls is no failure of what is tested.
settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("patient")

STORED_FLIGHT_MODEL = Path(__file__).parent / "stored" / "quadrotor-late.safetensors"
TRAJECTORIES = 68  # the fewest whose held-out plans state the limit of 1 %, late ones too; recorded in 14 seconds


# Flights and drives in real time mostly wait, as real autopilots do. Whole runs keep both cores busy. One process runs
# the tests of one lane, in this order. Tests that need no recording come first: another lane records meanwhile.
LIVE = (
    *("tests/actors/test_vehicle_server.py", "tests/system/test_mavsdk.py", "tests/system/test_hil.py"),
    *("tests/actors/ros2/", "tests/system/test_fly.py", "tests/system/test_ros2.py"),
)
REAL_AUTOPILOTS = ("tests/system/test_real_autopilots.py", "tests/actors/test_mavlink_vehicle.py")
WHOLE_RUNS = ("tests/system/",)
LANES = (LIVE, REAL_AUTOPILOTS, WHOLE_RUNS)
ALONE = ("tests/system/test_real_autopilots.py", "tests/system/test_fly.py", "tests/system/test_ros2.py")
REST = ("tests/examples/", "tests/deploy/", "")  # the longest modules first: at the end no process waits for one
LOWER = (0, 0, 5, 10)  # by which the priority of a process is lower on each lane, and on none: nothing live waits
ASIDE = pytest.StashKey[int]()  # of a process: by how much it is lower already


def lane(nodeid: str) -> int:
    """Return the number of the lane of a test, or the number after the last one if any process may run the test."""
    return next((i for i, paths in enumerate(LANES) if nodeid.startswith(paths)), len(LANES))


def turn(nodeid: str) -> tuple[int, int]:
    """Return when a test runs: its lane, and its place there."""
    number = lane(nodeid)
    paths = (*LANES, REST)[number]
    return number, next(i for i, path in enumerate(paths) if nodeid.startswith(path))


class Rooms(LoadScopeScheduling):
    """A process for each lane, whose tests come one after the other; the rest, a module at a time, to the others and
    to those that are through: what a module shares is made once."""

    def _split_scope(self, nodeid: str) -> str:
        number = lane(nodeid)
        return f"lane {number}" if number < len(LANES) else nodeid.partition("::")[0]


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Rooms:
    return Rooms(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the lanes: they take as long as all the rest."""
    items.sort(key=lambda item: turn(item.nodeid))  # stable


def pytest_collection_finish() -> None:
    """Switch the garbage collector on, which then passes over the collected tests."""
    gc.freeze()
    gc.enable()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Let only one of the live tests run that need nearly a processor: two of them, on two lanes, starve each other."""
    if "PYTEST_XDIST_WORKER" not in os.environ or not item.nodeid.startswith(ALONE):
        return (yield)
    with (Path(tempfile.gettempdir()) / f"brakeline-tests-{os.getuid()}.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            return (yield)
        finally:
            fcntl.flock(file, fcntl.LOCK_UN)  # closing it would not do: a child may have it open, too


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Lower the priority of the process to that of the test's lane; it cannot rise again."""
    stash = item.config.stash
    before, wanted = stash.get(ASIDE, 0), LOWER[lane(item.nodeid)]
    if "PYTEST_XDIST_WORKER" in os.environ and wanted > before:
        stash[ASIDE] = wanted
        os.nice(wanted - before)


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The session's, for all who run its tests side by side."""
    own = tmp_path_factory.getbasetemp()
    return own.parent if "PYTEST_XDIST_WORKER" in os.environ else own


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """A browser for all tests of a process that open pages one after the other."""
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: no page was opened")
    with Page(tmp_path_factory.mktemp("browser")) as page:
        yield page


@pytest.fixture(scope="session")
def data_folder(shared_folder: Path) -> Iterator[Path]:
    """What `$BRAKELINE_DATA` is from here on, for this process and its children: a data set and the default model."""
    before = os.environ.get("BRAKELINE_DATA")
    folder = shared_folder / "recorded"
    folder.mkdir(exist_ok=True)
    os.environ["BRAKELINE_DATA"] = str(folder)
    simulated_recording.load_or_record(GROUND, trajectories=TRAJECTORIES)
    model_store.model_for(GROUND, ModelConfig())
    yield folder
    if before is None:
        del os.environ["BRAKELINE_DATA"]
    else:
        os.environ["BRAKELINE_DATA"] = before


@pytest.fixture(scope="session")
def flight_folder(data_folder: Path) -> Path:
    """The same, with the quadrotor's model sets: in lockstep the one that all have, in real time a stored one.

    The stored one is of 60 recorded trajectories. It takes a minute to make it again, where the simulator has changed.
    """
    config = ModelConfig()
    for robot, source in ((QUADROTOR, "quadrotor"), (QUADROTOR.in_real_time(), STORED_FLIGHT_MODEL)):
        path = data_paths.model_path(robot, config)
        if not path.exists():
            path.parent.mkdir(exist_ok=True)
            ModelSet.load(source).save(path)
        try:
            model_store.model_for(robot, config, BOUND, build=False)
        except BadModel:
            simulated_recording.load_or_record(QUADROTOR, trajectories=60)
            model_store.model_for(robot, config, BOUND)
    return data_folder


@pytest.fixture
def stalled() -> Iterator[Callable[[], float]]:
    """How long [s] this machine let a thread wait beyond the 10 ms it had asked for: nobody acts in time then."""
    with stalls(0.01) as stalled:
        yield lambda: stalled.worst
