"""Test the first minute with the program: the README's first screen, and the next commands that the program names."""

import shlex
import subprocess
from pathlib import Path

from tests.system.runs import BRAKELINE, brakeline
from tests.waiting import PATIENCE

ROOT = Path(__file__).parent.parent.parent


def test_the_first_screen_leads_from_the_demo_to_a_report_a_replay_and_an_evaluation(
    data_folder, tmp_path, monkeypatch
):
    screen = (ROOT / "README.md").read_text().partition("## Data flow")[0]
    assert "    make demo " in screen and "    make test " in screen, "the two commands"
    recipe = (ROOT / "Makefile").read_text().partition("demo: setup\n")[2].splitlines()[0]
    assert recipe.strip() == "$(BIN)/brakeline demo"

    monkeypatch.chdir(tmp_path)
    words = [*BRAKELINE, "demo", "--steps", "600", "--out", "runs/first"]
    demo = subprocess.run(words, check=False, capture_output=True, text=True, timeout=2 * PATIENCE)
    assert demo.returncode == 0, demo.stderr
    assert "collisions" in demo.stdout and "log:    runs/first/run.mcap" in demo.stdout
    lines = demo.stdout.splitlines()
    commands = [shlex.split(line.removeprefix("next:")) for line in lines if line.startswith("next:")]
    assert [command[:2] for command in commands] == [["brakeline", name] for name in ("analyse", "replay", "evaluate")]
    for _, name, *options in commands:
        done = brakeline(name, *options, *(("--episodes", 2) if name == "evaluate" else ()))
        assert done.returncode == 0 and done.stdout, done.stderr
    assert "<svg" in (tmp_path / "report.html").read_text() or "<script" in (tmp_path / "report.html").read_text()
