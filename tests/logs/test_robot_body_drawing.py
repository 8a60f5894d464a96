"""A body of several discs is drawn as such, where the robot is and as it stands: in Foxglove, films, reports, watch."""

import math
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from brakeline.deploy.run.episode_render import Film, Frame, _Stage
from brakeline.logs import foxglove_scene
from brakeline.logs.episode_view import discs
from brakeline.logs.watch.dashboard import RobotPanel
from brakeline.messaging.robot import robot_named
from brakeline.sim.arena import staged_arena
from tests.browser import CHROMIUM, Page
from tests.robots import GROUND

ROOT = Path(__file__).parents[2]
CAR = robot_named(str(ROOT / "examples" / "car" / "car.toml"))
AT, HEADING = np.array([1.0, 2.0]), math.pi / 2


def test_foxglove_has_a_drum_a_disc() -> None:
    drums = foxglove_scene._body(CAR, "actor-0", 0).cylinders
    assert [(d.pose.position.x, d.pose.position.y, d.size.x) for d in drums] == [(0.11, 0, 0.31), (-0.11, 0, 0.31)]


def test_a_film_has_them_at_the_heading() -> None:
    none = np.zeros((0, 2))
    film = Film(CAR, staged_arena(), [Frame(AT, HEADING, "allowed", none, none, none, 0.0)], AT, "cut")
    drawn = _Stage(film, Figure().subplots())._body(AT, HEADING, "allowed")
    middles = np.array([circle.center for circle in drawn[:2]])
    assert np.allclose(middles, [(1.0, 2.11), (1.0, 1.89)]) and [c.radius for c in drawn[:2]] == [0.155, 0.155]
    assert (
        np.allclose(drawn[2].get_xydata()[1], (1.0, 2.0 + CAR.front_extent))
        and pytest.approx(0.265) == CAR.front_extent
    )


def test_pages_are_told_of_all_of_them() -> None:
    assert discs(CAR) == [[0.11, 0.0, 0.155], [-0.11, 0.0, 0.155]] and discs(GROUND) == [[0.0, 0.0, GROUND.footprint]]
    assert RobotPanel(CAR, "actor-0").view()["discs"] == discs(CAR)


def test_a_report_draws_them_at_the_heading(tmp_path: Path) -> None:
    if CHROMIUM is None:
        pytest.skip("there is no Chromium: the report was not driven in a browser")
    script = "\n".join((ROOT / "logs" / "page" / name).read_text() for name in ("svg.js", "arena.js"))
    (tmp_path / "page.html").write_text(f"<!doctype html><body></body><script>{script}</script>")
    view = "{ x: (a) => 100 * a, y: (a) => -100 * a, per: 100 }"
    episode = f"{{ x: [1], y: [2], heading: [Math.PI / 2], footprint: {CAR.footprint}, discs: {discs(CAR)} }}"
    with Page(tmp_path / "browser") as page:
        page.open((tmp_path / "page.html").as_uri())
        page.value(f"document.body.innerHTML = '<svg>' + robot({view}, {episode}, 0).join('') + '</svg>'")
        seen = "[...document.querySelectorAll('circle')].map((c) => ['cx', 'cy', 'r'].map((n) => +c.getAttribute(n)))"
        assert np.allclose(page.value(seen), [(100, -211, 15.5), (100, -189, 15.5)])
