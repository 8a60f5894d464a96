"""Fixtures: samples as a recorder receives them, a recorder process, a report, and a browser that shows the report."""

import itertools
import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from brakeline.logs.log_analysis import AnalysisOptions, LogAnalysis, analyse_runs
from brakeline.logs.report_page import write
from brakeline.logs.watch.live_page_server import LivePageServer
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Bus, BusSettings, Sample
from brakeline.messaging.bus.topic_keys import names_of
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.topics import HEALTH, TOPICS
from tests.browser import Page, drawn
from tests.logs.sample_log import mixed
from tests.waiting import until

Say = Callable[..., Sample]
Start = Callable[..., "subprocess.Popen[bytes]"]

RECORDER = """
import sys
from pathlib import Path
from brakeline.logs.recorder import LogSettings, Rotation, main
from brakeline.messaging.bus import BusSettings
settings = LogSettings(Path(sys.argv[2]), {"run": {"method": "none"}}, rotation=Rotation(*map(float, sys.argv[3:])))
main(BusSettings(connect=(sys.argv[1],)), settings)
"""


@pytest.fixture
def say() -> Say:
    """Return a function that creates samples: numbered by key, each a second after the previous one."""
    numbers: dict[str, itertools.count[int]] = {}
    seconds = itertools.count(1)

    def make(key: str, message: Any, time: float = 0.0, run: int = 1) -> Sample:
        topic = next(topic for topic in TOPICS if type(message) is topic.message)
        now = next(seconds) * 10**9
        number = next(numbers.setdefault(key, itertools.count(1)))
        source = names_of(topic, key).get("source", "a")
        message.header.MergeFrom(pb.Header(sequence=number, source=source, run=run, wall_time=now, time=time))
        return Sample(topic, key, message.SerializeToString(), now + 1000)

    return make


@pytest.fixture
def router() -> Iterator[Bus]:
    with Bus(BusSettings(listen=(free_endpoint(),)), "launcher") as bus:
        yield bus


@pytest.fixture
def start(router: Bus) -> Iterator[Start]:
    """Return a function that starts a recorder and waits until it records."""
    files: list[str] = []
    router.subscribe(HEALTH, lambda sample: files.append(sample.message().notes["file"]), source="recorder")
    with ExitStack() as stack:

        def launch(run: Path, *rotation: float) -> "subprocess.Popen[bytes]":
            files.clear()
            words = [sys.executable, "-c", RECORDER, router.settings.listen[0], str(run), *map(str, rotation)]
            child = stack.enter_context(subprocess.Popen(words))
            stack.callback(child.kill)
            until(lambda: any(Path(file).parent == run.parent for file in files))
            return child

        yield launch


@pytest.fixture(scope="session")
def analysis(tmp_path_factory: pytest.TempPathFactory) -> LogAnalysis:
    return analyse_runs(mixed(tmp_path_factory.mktemp("page") / "<b>mixed"), AnalysisOptions(pictures=True))


@pytest.fixture(scope="session")
def report(analysis: LogAnalysis, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The report of a log, and the figures of `analyse --json`."""
    path = tmp_path_factory.mktemp("report") / "report.html"
    write(path, analysis.figures(), analysis.by_label())
    return path, json.loads(json.dumps(analysis.figures()))


@pytest.fixture
def tab(browser: Page) -> Iterator[Page]:
    """A page of a browser that other tests have used, without what they left there."""
    browser.complaints.clear()
    browser.requests.clear()
    yield browser
    browser.media()
    browser.size(1280, 900)


@contextmanager
def watched(tab: Page, server: LivePageServer) -> Iterator[None]:
    """Open the live page, and leave it again before its server ends."""
    tab.open(server.url)
    tab.until("document.body.dataset.drawn > 0")
    try:
        yield
    finally:
        tab.call("Page.navigate", url="about:blank")


@pytest.fixture(scope="module")
def page(report: tuple[Path, dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with drawn(report[0], tmp_path_factory.mktemp("browser")) as page:
        yield page
