"""The example programs and the notebook run as they stand, and print what their texts say."""

import json
import re
import runpy
import subprocess

import gymnasium
import matplotlib
import pytest

from brakeline import BusError, Filter, SafetyClient, SafetyWrapper
from brakeline.messaging.free_ports import free_endpoint
from tests.examples.programs import EXAMPLES, run_program
from tests.system.runs import BRAKELINE
from tests.waiting import until


@pytest.mark.parametrize("kind", ["csv", "bag"])
def test_a_log_leads_to_decisions(kind):
    output = run_program("own_robot_from_log.py", kind)
    assert "pillar at 2.0 m: allowed, 0.40 m/s" in output and "pillar at 0.4 m: allowed" not in output, output
    assert re.search(r"known to \d+ cm", output) and "next: brakeline certify" in output and "free" in output, output


def test_the_cart_stops_before_the_wall(capsys):
    runpy.run_path(str(EXAMPLES / "own_policy_in_gymnasium.py"))
    distance = float(re.search(r"stands (\S+) m before it", capsys.readouterr().out)[1])
    assert 0.2 < distance < 0.4  # the radius of its body is 0.2 m


def test_the_filter_ends_the_collisions_of_a_policy_that_knows_no_obstacles():
    names = runpy.run_path(str(EXAMPLES / "my_policy.py"))
    env = gymnasium.make("brakeline.envs:brakeline/Ground-v0", arena="dense")
    assert names["drive"](env, 2) == "1 goals, 1 collisions, 0 steps changed"
    assert " 0 collisions, " in names["drive"](SafetyWrapper(env, Filter.load("ground")), 2)


def test_the_page_about_environments_changes_a_task():
    page = (EXAMPLES.parent / "docs" / "own_environments.md").read_text()
    code = page.partition("## Change the task")[2].partition("```python\n")[2].partition("```")[0]
    ground, air = code.partition("windy = ")[::2]
    names: dict[str, object] = {}
    exec(ground, names)
    env = names["env"].unwrapped
    assert (env.arena_name, env.reward.goal, env.conditions.noise.scale) == ("open", 50.0, 2.0)
    assert env.reset(seed=0)[1]["scan"] is not None
    exec("windy = " + air, names)
    assert names["env"].unwrapped.conditions.wind.speed == 3.0
    assert names["env"].reset(seed=0)[0].shape == (189,)


def test_the_notebook_runs_from_top_to_bottom(capsys):
    matplotlib.use("Agg")
    names: dict[str, object] = {}
    for cell in json.loads((EXAMPLES / "a_decision.ipynb").read_text())["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    output = capsys.readouterr().out
    assert all(line in output for line in ("0.60 m: allowed", "0.25 m: adjusted", "0.21 m: failsafe"))
    assert len(names["axes"]) == 3


@pytest.fixture
def service(data_folder):
    endpoint = free_endpoint()
    with subprocess.Popen([*BRAKELINE, "safety", "ground", "--listen", endpoint], stderr=subprocess.DEVNULL) as process:
        yield endpoint
        process.terminate()


def test_a_robot_that_asks_a_service_stops_before_the_cylinder(service, capsys):
    def answers():
        try:
            with SafetyClient.open(service, "ground", 1.0) as safety:
                return safety.decide([0.0] * 5, [0.1, 0.0], known_free=True)
        except BusError:
            return None

    until(answers, "the service answers")
    runpy.run_path(str(EXAMPLES / "ask_from_python.py"))["main"](service, 5.0)  # a deadline for a busy machine
    output = capsys.readouterr().out
    assert output.count("allowed") >= 5 and "fallback" not in output
    assert "adjusted" in output or "failsafe" in output
    positions = [float(x) for x in re.findall(r"x = (\S+) m", output)]
    assert len(positions) == 15 and 0.3 < max(positions) < 0.6 - 0.1 - 0.105


def test_the_arm_certifies_its_own_log_and_never_exceeds_a_limit(tmp_path):
    pytest.importorskip("mujoco")
    picture = tmp_path / "limits.png"
    words = ("--minutes", "5", "--accept-bound", "0.03", "--episodes", "10", "--steps", "50", "--picture", str(picture))
    behind, without = run_program("two_link_arm/two_link_arm.py", *words).splitlines()[-2:]
    assert "'episodes': 10, 'steps': 500, 'episodes beyond a limit': 0" in behind, behind
    assert float(re.search(r"'nearest to a limit \[rad\]': ([\d.e-]+)", behind)[1]) < 0.15
    assert int(re.search(r"'episodes beyond a limit': (\d+)", without)[1]) >= 5 and picture.stat().st_size > 1000
