"""Fixtures: samples as a recorder receives them, a report, and a browser that shows the report."""

import itertools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from brakeline.logs.log_analysis import AnalysisOptions, analyse_runs
from brakeline.logs.report_page import render
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from brakeline.messaging.bus.topic_keys import names_of
from brakeline.messaging.topics import TOPICS
from tests.browser import Page, drawn
from tests.logs.sample_log import mixed

Say = Callable[..., Sample]


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


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The report of a log, and the figures of `analyse --json`."""
    folder = tmp_path_factory.mktemp("page")
    log = mixed(folder / "<b>mixed")
    analysis = analyse_runs(log, AnalysisOptions(pictures=True))
    path = folder / "report.html"
    path.write_text(render(analysis.figures(), analysis.by_label()), encoding="utf-8")
    return path, json.loads(json.dumps(analysis.figures()))


@pytest.fixture(scope="module")
def page(report: tuple[Path, dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with drawn(report[0], tmp_path_factory.mktemp("browser")) as page:
        yield page
