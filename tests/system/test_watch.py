"""Test the live page in a browser that asks no other server, and the live view with a client of Foxglove's protocol."""

import json
import signal
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.request import urlopen

import pytest
from websockets.sync.client import connect

from tests.browser import CHROMIUM, Page
from tests.system.runs import BRAKELINE, Run
from tests.waiting import until

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="the live page in a browser: needs chromium")


@pytest.fixture(scope="module")
def run(data_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Start a run that lasts longer than the tests."""
    with Run(tmp_path_factory.mktemp("watched") / "run", "--steps", 100_000) as run:
        run.until_steps(100)
        yield run
        run.end(signal.SIGINT)


@pytest.fixture(scope="module")
def watched(run: Run) -> Iterator[dict[str, str]]:
    """Return the addresses that `brakeline watch` prints."""
    words = [*BRAKELINE, "watch", *map(str, run.there), "--port", "0", "--foxglove-port", "0", "--json"]
    watcher = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert watcher.stdout is not None
        yield json.loads(watcher.stdout.readline())
        watcher.send_signal(signal.SIGINT)
        assert watcher.wait(15.0) == 0
    finally:
        watcher.kill()
        watcher.wait()
        watcher.stdout.close()


@needs_chromium
def test_the_page_shows_robots_and_figures_and_asks_nobody_else(watched: dict[str, str], tmp_path: Path) -> None:
    with Page(tmp_path / "profile") as page:
        page.open(watched["page"])
        page.until("document.querySelectorAll('.card').length === 2 && document.body.dataset.drawn > 5")
        page.until("document.getElementById('link').textContent === 'live'")
        steps = "Number(document.querySelector('#figures dd')?.textContent)"
        before = page.until(steps)
        page.until(f"{steps} > {before}")
        page.until("document.querySelectorAll('#processes .alive').length >= 6")
        page.until("document.getElementById('run').textContent.startsWith('run: method ddpc, arena default')")
        page.until("document.getElementById('done').textContent.includes(' of 100000 steps')")
        page.until("document.querySelectorAll('.near svg rect.tube').length > 5")
        page.until("[...document.querySelectorAll('.stage canvas')].some(canvas => canvas.dataset.frames > 3)")
        page.until("document.querySelector('[data-history=ground] svg').dataset.points > 0")
        assert page.complaints == []
        assert len(page.requests) >= 4
        assert all(url.startswith((watched["page"], "data:")) for url in page.requests), page.requests


@needs_chromium
def test_the_page_cannot_ask_anybody_else(watched: dict[str, str], tmp_path: Path) -> None:
    with Page(tmp_path / "profile") as page:
        page.open(watched["page"])
        page.until("document.body.dataset.drawn > 0")
        refused = page.value("fetch('http://127.0.0.1:9/').then(() => 'answered', (error) => String(error))")
        assert "TypeError" in refused
        assert any("Content Security Policy" in complaint for complaint in page.complaints)


def test_programs_can_have_the_view_as_json(watched: dict[str, str]) -> None:
    def view() -> dict:
        with urlopen(watched["page"] + "view.json", timeout=10.0) as answer:
            assert answer.headers["Content-Type"] == "application/json"
            return json.loads(answer.read())

    def complete() -> dict | None:
        shown = view()  # a robot's arena comes with its next episode
        whole = len(shown["robots"]) == 2 and all(robot["arena"] and robot["tube"] for robot in shown["robots"])
        return shown if whole and shown["totals"] and shown["silent"] < 3.0 else None

    shown = until(complete, "both robots with their arenas")
    for robot in shown["robots"]:
        half = robot["arena"]["half"]
        assert all(abs(value) <= half for axis in "xy" for value in robot["path"][axis])
        assert all(0.0 < dx < 1.0 and 0.0 < dy < 1.0 for _, _, dx, dy in robot["tube"])
    assert shown["totals"]["ground"]["steps"] > 0 and shown["since"] is None, "counts are those of the whole run"


def test_foxglove_is_served_live_with_the_arena_for_a_late_viewer(watched: dict[str, str]) -> None:
    with connect(watched["foxglove"], subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        channels: dict[str, dict] = {}
        wanted = {f"foxglove/{what}/ground/actor-0" for what in ("arena", "decision", "lidar", "frames")}
        wanted |= {"step/ground/actor-0", "exchange/ground/actor-0"}
        while not wanted <= channels.keys():
            message = socket.recv(timeout=20.0)
            if isinstance(message, str) and (announced := json.loads(message))["op"] == "advertise":
                channels |= {channel["topic"]: channel for channel in announced["channels"]}
        assert channels["foxglove/arena/ground/actor-0"]["schemaName"] == "foxglove.SceneUpdate"
        topics = sorted(wanted)
        ids = [{"id": number, "channelId": channels[topic]["id"]} for number, topic in enumerate(topics)]
        socket.send(json.dumps({"op": "subscribe", "subscriptions": ids}))
        seen: set[str] = set()
        while seen != wanted:
            message = socket.recv(timeout=20.0)
            if isinstance(message, bytes) and message[0] == 1:
                seen.add(topics[struct.unpack_from("<I", message, 1)[0]])
