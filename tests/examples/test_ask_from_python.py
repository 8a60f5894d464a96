"""examples/ask_from_python.py against a real service: it drives at a cylinder and stops before it."""

import re
import runpy
import subprocess
from pathlib import Path

import pytest

from brakeline.messaging.free_ports import free_endpoint
from tests.system.runs import BRAKELINE
from tests.waiting import until

EXAMPLE = Path(__file__).parents[2] / "examples" / "ask_from_python.py"


@pytest.fixture
def service(data_folder):
    endpoint = free_endpoint()
    with subprocess.Popen([*BRAKELINE, "safety", "ground", "--listen", endpoint], stderr=subprocess.DEVNULL) as process:
        yield endpoint
        process.terminate()


def test_it_stops_before_the_cylinder(service, capsys):
    from brakeline import BusError, SafetyClient

    def answers():
        try:
            with SafetyClient.open(service, "ground", 1.0) as safety:
                return safety.decide([0.0] * 5, [0.1, 0.0], known_free=True)
        except BusError:
            return None

    until(answers, "the service answers")
    runpy.run_path(str(EXAMPLE))["main"](service, 5.0)  # however long a busy machine takes
    printed = capsys.readouterr().out
    assert printed.count("allowed") >= 5 and "fallback" not in printed
    assert "adjusted" in printed or "failsafe" in printed
    places = [float(place) for place in re.findall(r"x = (\S+) m", printed)]
    assert len(places) == 15 and 0.3 < max(places) < 0.6 - 0.1 - 0.105
