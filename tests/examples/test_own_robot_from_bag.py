"""examples/own_robot_from_bag.py, as it stands."""

import re
import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_robot_from_bag.py"


def test_it_comes_to_decisions():
    ran = subprocess.run([sys.executable, str(EXAMPLE)], capture_output=True, text=True, timeout=300, check=False)
    said = ran.stdout
    assert ran.returncode == 0, ran.stderr
    assert re.search(r"known to \d+ cm", said), said
    assert "next: brakeline certify" in said and "free" in said
