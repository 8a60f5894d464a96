"""Foxglove, films, the report and the live page draw every disc of a body at its pose."""

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from brakeline.deploy.run.episode_render import Film, Frame, _FilmAxes
from brakeline.logs import foxglove_scene
from brakeline.logs.decision_view import body_discs, decision_view
from brakeline.logs.viewer import viewer_file
from brakeline.logs.watch.dashboard import RobotPanel
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.robot import robot_named
from tests.arenas import staged_arena
from tests.browser import Page
from tests.robots import GROUND

ROOT = Path(__file__).parents[2]
CAR = robot_named(str(ROOT / "examples" / "car" / "car.toml"))
AT, HEADING = np.array([1.0, 2.0]), math.pi / 2


def test_foxglove_has_a_cylinder_for_each_disc() -> None:
    drums = foxglove_scene._body(CAR, "actor-0", 0).cylinders
    assert [(d.pose.position.x, d.pose.position.y, d.size.x) for d in drums] == [(0.11, 0, 0.31), (-0.11, 0, 0.31)]


def test_a_film_draws_the_body_at_its_heading() -> None:
    film = Film(CAR, staged_arena(), [Frame(AT, HEADING, "allowed", decision_view(None, pb.Exchange()))], AT, "cut")
    drawn = _FilmAxes(film, Figure().subplots())._body(AT, HEADING, "allowed")
    middles = np.array([circle.center for circle in drawn[:2]])
    assert np.allclose(middles, [(1.0, 2.11), (1.0, 1.89)]) and [c.radius for c in drawn[:2]] == [0.155, 0.155]
    assert np.allclose(drawn[2].get_xydata()[1], (1.0, 2.265))


def test_pages_have_all_discs_of_the_body() -> None:
    assert body_discs(CAR) == [[0.11, 0.0, 0.155], [-0.11, 0.0, 0.155]]
    assert body_discs(GROUND) == [[0.0, 0.0, GROUND.footprint]]
    assert RobotPanel(CAR, "actor-0").view()["discs"] == body_discs(CAR)


def test_the_report_draws_the_body_at_its_heading(tab: Page, tmp_path: Path) -> None:
    script = "\n".join(map(viewer_file, ("svg.js", "plan.js")))
    (tmp_path / "page.html").write_text(f"<!doctype html><body></body><script>{script}</script>")
    view = "{ x: (a) => 100 * a, y: (a) => -100 * a, per: 100, pick: ([x, y]) => [x, y] }"
    episode = f"{{ pose: [1, 2, Math.PI / 2], footprint: {CAR.footprint}, discs: {body_discs(CAR)} }}"
    tab.open((tmp_path / "page.html").as_uri())
    tab.value(f"document.body.innerHTML = '<svg>' + bodyMarks({view}, {episode}).join('') + '</svg>'")
    seen = "[...document.querySelectorAll('circle')].map((c) => ['cx', 'cy', 'r'].map((n) => +c.getAttribute(n)))"
    assert np.allclose(tab.value(seen), [(100, -211, 15.5), (100, -189, 15.5)])
