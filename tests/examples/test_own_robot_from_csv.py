"""examples/own_robot_from_csv.py, as it stands."""

import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_robot_from_csv.py"


def test_it_comes_to_decisions():
    ran = subprocess.run([sys.executable, str(EXAMPLE)], capture_output=True, text=True, timeout=300, check=False)
    said = ran.stdout
    assert ran.returncode == 0, ran.stderr
    assert "pillar at 2.0 m: allowed, 0.40 m/s" in said and "pillar at 0.45 m: allowed" not in said, said
    assert "next: brakeline certify" in said and "free" in said
