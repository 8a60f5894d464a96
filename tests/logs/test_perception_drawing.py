"""Foxglove, the live page and the report draw the perceived surroundings and the reservations."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from brakeline.logs import foxglove_scene
from brakeline.logs.log_analysis import AnalysisOptions, LogAnalysis, analyse_runs
from brakeline.logs.report_page import write
from brakeline.logs.watch.dashboard import Dashboard
from brakeline.logs.watch.live_page_server import LivePageServer
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import CYLINDER, Obstacle
from brakeline.messaging.obstacle_messages import obstacle_messages
from brakeline.messaging.obstacle_motion import Motion
from brakeline.messaging.range_image import RangeImage
from brakeline.messaging.scan import Scan
from brakeline.messaging.sensor_messages import scan_message, set_measurement
from brakeline.safety.perception.displayed_map import map_for_display
from tests.browser import Page
from tests.logs.conftest import Say, watched
from tests.logs.sample_log import Writer
from tests.logs.test_foxglove import Studio, episode, step
from tests.robots import GROUND, QUADROTOR

FAN = np.linspace(-np.pi, np.pi, 360, endpoint=False)
WALKER = Obstacle(CYLINDER, (1.0, 0.5), (0.2,), motion=Motion((0.5, 0.0), 0.03, 0.05, acceleration=1.0))


def fleet_exchange(actor: str, number: int = 0, x: float = 0.0) -> pb.Exchange:
    """Return the exchange of a robot in a fleet of two: with a scan, a walker, and reserved boxes around x."""
    reservation = pb.Reservation(center=[x, 0.0] * 3, half_width=[0.1, 0.2] * 3, radius=[0.15] * 3)
    decision = pb.Decision(
        kind=pb.RECOVERING, tube_center=[x, 0.0] * 3, tube_half_width=[0.01] * 6, reservation=reservation
    )
    decision.plan[:] = [0.0] * 6
    request = pb.Request(
        robot="ground",
        actor=actor,
        step=number,
        state=[x, 0.0, 0.0, 0.0, 0.0],
        action=[0.0, 0.0],
        fleet=["a", "b"],
        obstacles=obstacle_messages([WALKER]),
        scan=scan_message(Scan(np.full(360, 2.0), FAN, (x, 0.0, 0.0))),
    )
    return pb.Exchange(request=request, reply=pb.Reply(decision=decision))


def test_foxglove_draws_the_perceived_surroundings(say: Say) -> None:
    studio = Studio(say)
    for actor, x in (("a", 0.0), ("b", 2.0)):
        studio(f"episode/ground/{actor}", episode(actor))
        studio(f"exchange/ground/{actor}", fleet_exchange(actor, x=x))
        drawn = studio(f"step/ground/{actor}", step(0, pb.RECOVERING, actor))
    shown = drawn["foxglove/decision/ground/b"].entities[0]
    free, hits = shown.lines[1:]
    assert max(np.hypot(p.x - 2.0, p.y) for p in free.points) <= 2.0 and len(hits.points) == 2 * 360
    discs = [round(0.5 * cylinder.size.x, 3) for cylinder in shown.cylinders]
    swept = map_for_display(GROUND, fleet_exchange("b").request).swept[0, :, 2].round(3).tolist()
    assert 0.2 in discs and set(swept) <= set(discs)
    boxes = [
        (c.pose.position.x, round(c.size.x, 6), round(c.size.y, 6))
        for c in shown.cubes
        if c.color == foxglove_scene.RESERVED
    ]
    assert boxes == [(0.0, 0.5, 0.7)] * 3, "the other's alone"
    assert shown.texts[0].color.r == pytest.approx(142 / 255), "recovering is violet"


def test_of_a_range_image_so_few_hits_are_drawn_that_a_recorder_keeps_up() -> None:
    """Drawing all 16,200 points took half a second: the recorder fell behind and lost the end of a flight."""
    ranges = np.full((90, 180), 5.0)
    edge = 0.5 * np.pi * (1.0 - 1.0 / 90)
    exchange = pb.Exchange(request=pb.Request(robot="quadrotor", actor="q", state=[0.0] * 9, action=[0.0] * 3))
    set_measurement(exchange.request, RangeImage(ranges, (1.0, 0.0, 2.0), low=-edge, high=edge))
    exchange.reply.decision.kind = pb.ADJUSTED
    drawn = foxglove_scene.decision(QUADROTOR, pb.Step(actor="q", state=[0.0] * 9, decision=pb.ADJUSTED), exchange, 0)
    (hits,) = (line for line in drawn.entities[0].lines if line.type == line.LINE_LIST)
    assert foxglove_scene.MOST_HITS <= len(hits.points) <= 2 * foxglove_scene.MOST_HITS and drawn.ByteSize() < 2**16
    away = [np.linalg.norm([p.x - 1.0, p.y, p.z - 2.0]) for p in hits.points[::2]]
    assert np.allclose(away, 5.0)


@pytest.fixture
def drive(say: Say, tmp_path: Path) -> tuple[Dashboard, LogAnalysis]:
    """Three steps of a fleet of two, on the live page and in the analysis of their log."""
    writer, board = Writer(losses=0.0), Dashboard()

    def put(key: str, message: Any) -> None:
        writer.put(key, message)
        board.add(say(key, message))

    for actor in ("a", "b"):
        put(f"episode/ground/{actor}", episode(actor))
    for k in range(3):
        for actor, x in (("a", 0.0), ("b", 2.0)):
            put(f"exchange/ground/{actor}", fleet_exchange(actor, k, x))
            put(f"step/ground/{actor}", step(k, pb.RECOVERING, actor, clearance=0.5, truncated=k == 2))
    return board, analyse_runs(writer.write(tmp_path / "run.mcap"), AnalysisOptions(pictures=True))


def test_the_live_page_and_the_report_have_the_perceived_surroundings(drive: tuple[Dashboard, LogAnalysis]) -> None:
    board, analysis = drive
    a, b = board.view()["robots"]
    assert np.allclose(a["reservations"], [[2.0, 0.0, 0.25, 0.35]] * 3) and np.allclose(b["reservations"][0][0], 0.0)
    assert a["around"]["movers"] == [[1.0, 0.5, 0.2]] and len(a["around"]["swept"][0]) == 3
    assert len(a["around"]["free"]) > 50 < len(a["around"]["hits"])
    [(_, pictures)] = analysis.by_label().values()
    shown = {item["actor"]: item for item in pictures["galleries"]["ground"]["episodes"]}
    tube = shown["a"]["tubes"][1]
    assert tube["reservations"] == [[2.0, 0.0, 0.25, 0.35]] * 3 and shown["b"]["tubes"][1]["reservations"][0][0] == 0.0
    assert tube["movers"] == [[1.0, 0.5, 0.2]] and 20 < len(tube["free"]) <= 48 and len(tube["hits"]) <= 90
    assert shown["a"]["kinds"] == "eee"


def drawn(page: Page, name: str, *places: str) -> int:
    return int(page.value(f"document.querySelectorAll('{', '.join(f'{place} .{name}' for place in places)}').length"))


def test_browsers_draw_the_perceived_surroundings(
    drive: tuple[Dashboard, LogAnalysis], tab: Page, tmp_path: Path
) -> None:
    board, analysis = drive
    path = tmp_path / "report.html"
    write(path, analysis.figures(), analysis.by_label())
    tab.show(path)
    tab.value("document.querySelector('#picker [data-view=above]').click()")
    marks = ("free", "hit", "mover", "swept", "reservation")
    shown = {name: drawn(tab, name, "#picker", ".episode-map") for name in marks}
    assert shown == {"free": 1, "hit": 90, "mover": 1, "swept": 3, "reservation": 3}
    legend = tab.value("document.querySelector('#picker').textContent")
    assert "reserved by other robots" in legend and "recovering" in legend
    with LivePageServer(board.view) as server, watched(tab, server):
        tab.value("document.querySelectorAll('[data-view=above]').forEach(button => button.click())")
        tab.until("document.querySelectorAll('.stage svg').length === 2")
        shown = {name: drawn(tab, name, "#robots") for name in ("free", "mover", "swept", "reservation")}
        assert shown == {"free": 4, "mover": 4, "swept": 12, "reservation": 12}, "two robots, each on two maps"
        assert drawn(tab, "hit", "#robots") > 100
        robots = tab.value("document.querySelector('#robots').innerHTML")
        assert "--recovering" in robots, "recovering has its color"
        assert not re.findall("NaN|undefined|Infinity|null", robots)
        assert tab.complaints == []
