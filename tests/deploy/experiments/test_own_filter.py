"""A filter of your own, FILE.py:CLASS: `evaluate` and `compare` run it, and no file or message names code to run."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from brakeline.deploy.commands.compare_command import CompareCommand
from brakeline.deploy.data.model_store import method_for
from brakeline.deploy.experiments.comparison_cells import CellConfig
from brakeline.deploy.experiments.evaluate import Evaluation, evaluate
from brakeline.errors import BadModel, ResultError, UnknownTask
from brakeline.safety.methods import decode, ready
from brakeline.safety.model.model_config import ModelConfig
from brakeline.safety.rivals.own_code import OwnCode
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.sim.sim_conditions import Conditions, Perception
from tests.robots import GROUND

HALF = """
from brakeline import OwnFilter

class Half(OwnFilter):
    def safe_input(self, request, proposal):
        assert len(request.obstacles) and len(request.observation)
        return 0.5 * proposal

class Brake(OwnFilter):
    def safe_input(self, request, proposal):
        return None

class ByRays(OwnFilter):
    obstacles = "the observed rays"

    def safe_input(self, request, proposal):
        nearest = self.ranges(request).min()
        assert self.rays.range == 3.5 and len(self.rays.directions) == 18
        distance = request.obstacles.distance(request.state[:2]).min()
        assert distance < nearest + 0.1, "no ray goes through an obstacle"
        return proposal

class Sees(OwnFilter):
    standing_map = False

    def safe_input(self, request, proposal):
        assert request.scan is not None and not len(request.obstacles)

class Short(OwnFilter):
    def safe_input(self, request, proposal):
        return proposal[:1]

class Unwritten(OwnFilter):
    pass

HALF = 0.5
"""


@pytest.fixture
def place(tmp_path: Path) -> Callable[[str], str]:
    """Return a function from the name of a class to its place."""
    (tmp_path / "halves.py").write_text(HALF)
    return lambda name: f"{tmp_path / 'halves.py'}:{name}"


def test_an_evaluation_behind_an_own_filter_counts_its_interventions(
    data_folder: Path, place: Callable[[str], str]
) -> None:
    wanted = Evaluation("greedy", place("Half"), episodes=2)
    figures = evaluate(GROUND, wanted)
    assert figures["interventions"] == figures["steps"] > 0, "each input is halved"
    free = evaluate(GROUND, replace(wanted, method="none"))
    assert figures["mean_speed"] < 0.6 * free["mean_speed"]
    braked = evaluate(GROUND, replace(wanted, method=place("Brake"), episodes=1))
    assert braked["failsafes"] == braked["steps"] and braked["mean_speed"] < 0.01
    seen = evaluate(GROUND, replace(wanted, method=place("ByRays"), episodes=1))
    assert seen["interventions"] == 0 < seen["steps"]
    assert figures["model"] == method_for(GROUND, place("Half"), ModelConfig()).version


def test_a_comparison_trains_an_own_filter_and_notices_a_change_of_its_file(
    data_folder: Path, tmp_path: Path, place: Callable[[str], str], capsys: pytest.CaptureFixture[str]
) -> None:
    td3 = replace(CellConfig("ground", "none", 0, 1, 1).td3, hidden=(16, 16), batch=16, warmup=40)
    compare = CompareCommand(
        *(("ground",), (0,), 1500, 1, ("default",), ("none", place("ByRays"))),
        **{"at_once": 4, "conservatism": False, "td3": td3, "quiet": True},
        **{"results": tmp_path / "results", "runs": tmp_path / "runs"},
    )
    assert compare.run() == 0
    cell = json.loads((tmp_path / "results/ground/ByRays-s0.json").read_text())
    assert (
        cell["evaluations"].keys() == {"trained-ByRays-default"} and cell["study"]["code"] == cell["model"]["version"]
    )
    assert (tmp_path / "runs/ground/ByRays-s0/training.mcap").exists()
    assert "2 of 2 results are stored" not in capsys.readouterr().err and compare.run() == 0
    assert "2 of 2 results are stored in" in capsys.readouterr().err
    page = (tmp_path / "results/README.md").read_text()
    assert "| ByRays | 1 | TD3 | the observed rays | code of its own | 0 |" in page
    (tmp_path / "halves.py").write_text(HALF.replace("18", "18.0"))
    with pytest.raises(ResultError, match="another code"):
        compare.run()


def test_what_is_no_filter_is_refused_with_the_reason(data_folder: Path, place: Callable[[str], str]) -> None:
    def make(name: str) -> object:
        return ready(method_for(GROUND, place(name), ModelConfig()))

    with pytest.raises(BadModel, match=r"derive the class from brakeline\.OwnFilter"):
        make("HALF")
    with pytest.raises(BadModel, match="lacks the method safe_input"):
        make("Unwritten")
    with pytest.raises(UnknownTask, match="no code that can be loaded"):
        make("Quarter")
    with pytest.raises(BadModel, match=r"return 2 finite numbers \(speed"):
        evaluate(GROUND, Evaluation("greedy", place("Short"), episodes=1))
    scan = Conditions(perception=Perception("scan"))
    with pytest.raises(BadModel, match="decides among standing obstacles of a map alone"):  # which would be empty
        evaluate(GROUND, Evaluation("greedy", place("Brake"), episodes=1, conditions=scan))
    assert evaluate(GROUND, Evaluation("greedy", place("Sees"), episodes=1, conditions=scan))["steps"] > 0
    with pytest.raises(BadModel, match="lacks the method"):  # before the first training
        CompareCommand(("ground",), methods=("none", place("Unwritten")), runs=Path("/dev/null/no")).run()
    with pytest.raises(ValueError, match="tuning knows settings of the rivals"):
        CompareCommand(("ground",), methods=(place("Half"),), tune=True, results=Path("none")).run()


def test_a_model_in_a_file_never_names_code_to_run(data_folder: Path, place: Callable[[str], str]) -> None:
    own = method_for(GROUND, place("Half"), ModelConfig())
    assert isinstance(own, OwnCode)
    with pytest.raises(BadModel, match="no file of a model can hold"):
        own.encode()
    received = decode(Pretrained(GROUND, place("Half"), {}, {}).encode())  # as an attacker would write it
    with pytest.raises(BadModel, match="no method is called"):
        ready(received)


def test_the_example_of_the_page_stops_before_obstacles_that_the_greedy_policy_hits(
    data_folder: Path, tmp_path: Path
) -> None:
    root = Path(__file__).parents[3]
    example = root / "examples/own_filter.py"
    code, by_rays = re.findall(r"```python\n(.*?)```", (root / "docs/rivals.md").read_text(), re.DOTALL)
    assert code in example.read_text(), "the page shows the file"
    (tmp_path / "rays.py").write_text("from brakeline import OwnFilter\n\n" + by_rays)
    stopped = evaluate(GROUND, Evaluation("greedy", f"{tmp_path}/rays.py:StopByRays", episodes=4))
    assert stopped["collisions"] == 0 < stopped["failsafes"]
    wanted = Evaluation("greedy", f"{example}:SpeedLimit", episodes=8)
    assert evaluate(GROUND, wanted)["collisions"] == 0 < evaluate(GROUND, replace(wanted, method="none"))["collisions"]
