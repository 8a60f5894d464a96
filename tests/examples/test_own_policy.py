"""examples/own_policy_in_gymnasium.py: it stops before the wall that its policy drives at."""

import re
import runpy
from pathlib import Path


def test_it_stops_before_the_wall(capsys):
    runpy.run_path(str(Path(__file__).parents[2] / "examples" / "own_policy_in_gymnasium.py"))
    left = float(re.search(r"stands (\S+) m from it", capsys.readouterr().out)[1])
    assert 0.2 < left < 0.4  # its body has 0.2 m
