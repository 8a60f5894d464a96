"""examples/own_robot_from_csv.py, as it stands."""

import os
import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_robot_from_csv.py"


def test_it_comes_to_decisions():
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}  # as a person starts it
    words = [sys.executable, str(EXAMPLE)]
    ran = subprocess.run(words, env=alone, capture_output=True, text=True, timeout=300, check=False)
    said = ran.stdout
    assert ran.returncode == 0, ran.stderr
    assert "pillar at 2.0 m: allowed, 0.40 m/s" in said and "pillar at 0.4 m: allowed" not in said, said
    assert "next: brakeline certify" in said and "free" in said
