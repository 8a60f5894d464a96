"""The live page of a run that has ended links to the run's report, and stays as long as somebody has it open."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from brakeline.deploy.run.live_page import LivePage
from brakeline.logs.watch.dashboard import Dashboard
from brakeline.logs.watch.live_page_server import LivePageServer, RunReport
from tests.browser import Page
from tests.http_client import asked, port_of
from tests.logs.conftest import watched
from tests.logs.sample_log import mixed
from tests.waiting import until

HOSTILE = '"><img src=x onerror="document.title=\'owned\'"><script>document.title="owned"</script>\''
RUNNING: dict[str, Any] = {"run": HOSTILE, "method": "ddpc", "arena": "default", "seed": "0", "steps": "10"}


@pytest.fixture
def shown() -> dict[str, Any]:
    counts = {"steps": 60, "episodes": 2, "goals": 1, "collisions": 0, "interventions": 6, "failsafes": 1}
    named = {"totals": {HOSTILE: counts | {"mean_reward": 1.0}}, "history": {HOSTILE: [[50, 1, 1, 0, 5, 2.0]]}}
    return Dashboard().view() | named | {"run": dict(RUNNING), "lines": [HOSTILE], "processes": {HOSTILE: "alive"}}


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return mixed(tmp_path_factory.mktemp("logs") / "run", episodes=4)


@pytest.fixture
def server(shown: dict[str, Any], log: Path) -> Iterator[LivePageServer]:
    with LivePageServer(lambda: shown, report=RunReport(log)) as server:
        yield server


def report_of(server: LivePageServer) -> tuple[int, bytes]:
    return asked(port_of(server.url), "/report.html")


def test_the_report_is_there_when_the_run_has_ended_and_not_before(
    server: LivePageServer, shown: dict[str, Any]
) -> None:
    assert report_of(server) == (
        404,
        b"the run goes on: its report is here when it has ended\n",
    )
    shown["run"]["outcome"] = "finished"
    status, page = report_of(server)
    assert status == 200 and b"Brakeline: run" in page and b"script-src 'sha256-" in page


def test_without_a_log_the_answer_says_what_to_do(shown: dict[str, Any], tmp_path: Path) -> None:
    shown["run"]["outcome"] = "finished"
    with LivePageServer(lambda: shown) as server:
        status, words = report_of(server)
    assert status == 404 and b"--report" in words
    with LivePageServer(lambda: shown, report=RunReport(tmp_path / "none")) as server:
        status, words = report_of(server)
    assert status == 500 and b"brakeline analyse" in words


def test_the_page_links_to_the_report_which_draws_itself(
    tab: Page, server: LivePageServer, shown: dict[str, Any]
) -> None:
    with watched(tab, server):
        assert tab.value("document.getElementById('report').hidden")
        tab.until("document.querySelectorAll('[data-history] svg').length === 4")
        assert tab.value("document.querySelectorAll('img, body script:not([src])').length") == 0, "names are text"
        assert tab.value("document.title") == "brakeline: live" and tab.complaints == []
        shown["run"]["outcome"] = "finished"
        tab.until("!document.getElementById('report').hidden")
        tab.open(tab.value("document.querySelector('#report a').href"))
        tab.until("document.documentElement.dataset.drawn === 'yes'")
        assert tab.value("document.querySelectorAll('#near .card').length") > 0 and tab.complaints == []


def test_the_page_stays_while_it_is_open(server: LivePageServer, tmp_path: Path) -> None:
    page, said = LivePage(tmp_path, browser=False), list[str]()
    page.stay(said.append)
    assert said == [], "there is no page"
    page._url = server.url
    page.stay(said.append)
    assert said == [], "nobody has it open"
    with urlopen(server.url + "events", timeout=10.0) as events:
        events.readline()
        assert page._open_pages() == 1
    until(lambda: page._open_pages() == 0, "the page is closed")
