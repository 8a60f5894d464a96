"""examples/two_link_arm: an arm in MuJoCo that keeps its joint limits, as a program."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "two_link_arm" / "two_link_arm.py"


def test_it_certifies_its_own_log_and_never_exceeds_a_limit(tmp_path):
    pytest.importorskip("mujoco")
    picture = tmp_path / "limits.png"
    words = [sys.executable, str(EXAMPLE), "--minutes", "5", "--accept-bound", "0.03"]
    words += ["--episodes", "10", "--steps", "50", "--picture", str(picture)]
    alone = {name: value for name, value in os.environ.items() if name != "PYTHONSAFEPATH"}  # as a person starts it
    ran = subprocess.run(words, env=alone, capture_output=True, text=True, timeout=300, check=False)
    assert ran.returncode == 0, ran.stderr
    behind, without = ran.stdout.splitlines()[-2:]
    assert "'episodes': 10, 'steps': 500, 'episodes beyond a limit': 0" in behind, behind
    assert float(re.search(r"'nearest to a limit \[rad\]': ([\d.e-]+)", behind)[1]) < 0.15
    assert int(re.search(r"'episodes beyond a limit': (\d+)", without)[1]) >= 5 and picture.stat().st_size > 1000
