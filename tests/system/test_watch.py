"""Watch a run with two safety services from outside until its launcher dies: `status`, `query`, page and Foxglove.

The live page is in a browser that asks no other server, the live view has a client of Foxglove's protocol.
"""

import json
import signal
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from websockets.sync.client import connect

from brakeline.learner.checkpoint import exists
from brakeline.logs.reader import open_log
from tests.browser import CHROMIUM, Page
from tests.robots import GROUND
from tests.system.runs import BRAKELINE, Run, brakeline, refused
from tests.waiting import until

PROCESSES = {"safety-0", "safety-1", "recorder", "learner", "actor-0", "actor-1"}


@pytest.fixture(scope="module")
def run(data_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Start a run that lasts longer than the tests; the last test ends it."""
    with Run(tmp_path_factory.mktemp("watched") / "run", "--steps", 100_000, "--replicas", 2) as run:
        run.until_steps(200)
        yield run


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


@pytest.mark.skipif(CHROMIUM is None, reason="the live page in a browser: needs chromium")
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
        refused = page.value("fetch('http://127.0.0.1:9/').then(() => 'answered', (error) => String(error))")
        assert "TypeError" in refused, "it cannot ask anybody else"
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


def test_status_and_query_of_a_run_in_progress(run: Run, tmp_path: Path) -> None:
    status = brakeline("status", *run.there)
    assert status.returncode == 0 and "safety-1" in status.stdout and "learning ground" in status.stdout
    shown = json.loads(brakeline("status", *run.there, "--json").stdout)
    assert {"launcher", *PROCESSES} <= set(shown["alive"])
    assert shown["processes"]["safety-0"]["model ground"] and shown["learners"]["ground"]["steps"] > 0
    query = ("query", "ground", *run.there, "--timeout", 10)
    near = (*query, "--obstacle", "cylinder 0.25 0 0.1")
    answer = json.loads(brakeline(*near, "--json").stdout)
    assert answer.keys() >= {"kind", "action", "plan", "tube_center", "margin", "time_ms", "model"}
    assert answer["kind"] in ("allowed", "adjusted", "failsafe") and answer["margin"] >= 0.0
    assert len(answer["plan"]) == len(answer["tube_center"]) == len(answer["tube_half_width"]) == GROUND.horizon
    assert answer["kind"] in brakeline(*near).stdout
    for far, said in ((3.5, ("allowed",)), (0.0, ("adjusted", "failsafe"))):  # all free about it; nothing seen
        scan = {"ranges": [far] * 360, "angles": np.radians(range(360)).tolist(), "pose": [0.0, 0.0, 0.0]}
        (tmp_path / "scan.json").write_text(json.dumps(scan))
        scanned = brakeline(*query, "--scan", tmp_path / "scan.json", "--json")
        assert json.loads(scanned.stdout)["kind"] in said
    assert "BadRequest" in refused("query", "ground", *run.there, "--known-free", "--state", 1, 2)
    assert "acceleration of 0 s ago" in refused(
        "query", "ground", *run.there, "--known-free", "--acceleration-age", 0.2
    )


def test_each_process_imports_only_what_it_needs(run: Run) -> None:
    """Else each costs seconds at its start, and hundreds of megabytes."""

    def loading(library: str) -> set[str]:
        return {name for name, paths in loaded.items() if library in paths}

    loaded = {name: " ".join(part.path for part in child.memory_maps()) for name, child in run.children().items()}
    assert loading("libtorch") == {"learner"} and loading("libmujoco") == {"actor-0", "actor-1"}
    # Numba brings SciPy's linear algebra; all else of SciPy would come on top.
    assert not loading("/scipy/sparse/") & {"actor-0", "actor-1"}


def test_a_service_dies_and_then_the_launcher(run: Run) -> None:
    """The last test of this run."""
    victims = run.children()
    assert victims.keys() == PROCESSES
    victims["safety-0"].kill()
    run.until_steps(200)  # some are taken before it is back
    assert not [e for e in run.metrics.figures()["no_decision"] if e not in ("NoReply", "Late")]
    until(lambda: run.children().get("safety-0", victims["safety-0"]).pid != victims["safety-0"].pid, "a new one")
    assert run.children().keys() == PROCESSES
    run.popen.kill()
    run.popen.wait()
    until(lambda: run.children() == {}, "no process is left without its launcher")
    log = open_log(run.folder)
    steps = [record.message for record in log if record.topic == "step"]
    assert log.cuts == [], "the recorder ended in order"
    assert len(steps) > 350 and not any(step.collision for step in steps)
    assert exists(run.folder / "learner" / "checkpoint"), "and so did the learner"
