"""Test the first minute with the program: the README's first screen, and the next commands that the program names."""

import shlex
import subprocess
from pathlib import Path

from tests.system.runs import BRAKELINE
from tests.waiting import PATIENCE

ROOT = Path(__file__).parent.parent.parent


def said(folder: Path, *words: object) -> str:
    """Return what a command prints in a folder. The command must succeed."""
    done = subprocess.run(
        [*BRAKELINE, *map(str, words)], check=False, capture_output=True, text=True, timeout=2 * PATIENCE, cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_first_screen_leads_from_the_demo_to_a_report_a_replay_and_an_evaluation(data_folder, tmp_path):
    screen = (ROOT / "README.md").read_text().partition("## Data flow")[0]
    assert "    make demo " in screen and "    make test " in screen, "the two commands"
    model_config = (ROOT / "Makefile").read_text().partition("demo: setup\n")[2].splitlines()[0]
    assert model_config.strip() == "$(BIN)/brakeline demo"

    told = said(tmp_path, "demo", "--steps", 600, "--out", "runs/first")
    assert "collisions" in told and "log:    runs/first/run.mcap" in told
    following = [shlex.split(line.removeprefix("next:")) for line in told.splitlines() if line.startswith("next:")]
    assert [words[:2] for words in following] == [["brakeline", name] for name in ("analyse", "replay", "evaluate")]
    for words in following:
        few = ("--episodes", 2) if words[1] == "evaluate" else ()
        assert said(tmp_path, *words[1:], *few)
    assert "<svg" in (tmp_path / "report.html").read_text() or "<script" in (tmp_path / "report.html").read_text()
