"""examples/two_link_arm: an arm in MuJoCo that keeps its joint limits, as a program."""

import re

import pytest

from tests.examples.programs import run_program


def test_it_certifies_its_own_log_and_never_exceeds_a_limit(tmp_path):
    pytest.importorskip("mujoco")
    picture = tmp_path / "limits.png"
    words = ("--minutes", "5", "--accept-bound", "0.03", "--episodes", "10", "--steps", "50", "--picture", str(picture))
    behind, without = run_program("two_link_arm/two_link_arm.py", *words).splitlines()[-2:]
    assert "'episodes': 10, 'steps': 500, 'episodes beyond a limit': 0" in behind, behind
    assert float(re.search(r"'nearest to a limit \[rad\]': ([\d.e-]+)", behind)[1]) < 0.15
    assert int(re.search(r"'episodes beyond a limit': (\d+)", without)[1]) >= 5 and picture.stat().st_size > 1000
