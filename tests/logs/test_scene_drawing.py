"""The JavaScript that the report and the live page share draws a scene from the state of the live page."""

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from brakeline.logs.watch.dashboard import Dashboard
from brakeline.logs.watch.live_page_server import FILES, LivePageServer, encode
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from tests.logs.test_allowed_hosts import asked
from tests.logs.test_foxglove import episode, step
from tests.logs.test_perception_drawing import fleet_exchange

Say = Callable[..., Sample]

LOGS = Path(__file__).parents[2] / "logs"
NODE = shutil.which("node")
DRAW = """
const document = { createElement: () => ({ append() {}, setAttribute() {}, style: {} }), getElementById: () => ({}) };
class EventSource {}
%s
const view = %s;
console.log(view.robots.map((robot) => drawScene(sceneOf(robot), [-6, -6, 6, 6], 600, robot.actor)).join(""));
"""


@pytest.fixture
def view(say: Say) -> dict[str, Any]:
    """The live page of two robots that reserve space for each other, scan a room and see a walker."""
    dashboard = Dashboard()
    for actor, x in (("a", 0.0), ("b", 2.0)):
        dashboard.add(say(f"episode/ground/{actor}", episode(actor)))
        for number in range(3):
            dashboard.add(say(f"exchange/ground/{actor}", fleet_exchange(actor, number, x)))
            dashboard.add(say(f"step/ground/{actor}", step(number, pb.RECOVERING, actor)))
    shown: dict[str, Any] = json.loads(encode(dashboard.view()))
    return shown


@pytest.mark.skipif(NODE is None, reason="there is no Node.js: the shared JavaScript was not run")
def test_the_live_page_draws_everything_that_the_filter_perceived(view: dict[str, Any]) -> None:
    scripts = "\n".join((LOGS / name).read_text() for name in ("report_page/svg.js", "report_page/scene.js"))
    page = (LOGS / "watch" / "page.js").read_text().replace("new EventSource", "({}); new EventSource")
    script = DRAW % (f"{scripts}\n{page}", json.dumps(view))
    drawn = subprocess.run([str(NODE), "-"], input=script, capture_output=True, text=True, check=True).stdout
    assert not re.findall("NaN|undefined|Infinity|null", drawn)
    counts = {name: drawn.count(f'class="{name}"') for name in ("free", "mover", "swept", "promise")}
    assert counts == {"free": 2, "mover": 2, "swept": 6, "promise": 6}
    assert drawn.count('class="hit"') > 100 and drawn.count('stroke="#7a4fc0"') == 6
    assert drawn.count("<svg") == 2 and "#8e44ad" in drawn, "recovering is violet"


def test_the_live_page_has_every_script_that_it_names() -> None:
    page = (LOGS / "watch" / "page.html").read_text()
    names = re.findall(r'(?:src|href)="(/[^"]+)"', page)
    assert set(names) == set(FILES) - {"/"}
    with LivePageServer(Dashboard().view) as server:
        assert all(asked(server, name)[0] == 200 for name in names)
