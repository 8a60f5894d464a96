"""Test the first minute with the program: the README's first screen, and the next commands that the program names."""

import re
import shlex
import subprocess
from pathlib import Path

from tests.system.runs import BRAKELINE
from tests.waiting import PATIENCE

ROOT = Path(__file__).parent.parent.parent


def printed(folder: Path, *words: object) -> str:
    """Return what a command prints in a folder. The command must succeed."""
    done = subprocess.run(
        [*BRAKELINE, *map(str, words)], check=False, capture_output=True, text=True, timeout=2 * PATIENCE, cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_first_screen_leads_from_the_demo_to_a_report_a_replay_and_an_evaluation(data_folder, tmp_path):
    screen = (ROOT / "README.md").read_text().partition("## Data flow")[0]
    assert "    make demo " in screen and "    make test " in screen, "the two commands"
    recipe = (ROOT / "Makefile").read_text().partition("demo: setup\n")[2].splitlines()[0]
    assert recipe.strip() == "$(BIN)/brakeline demo"

    output = printed(tmp_path, "demo", "--steps", 600, "--out", "runs/first", "--verbose")
    alone, filtered, *_ = output.splitlines()
    assert alone.startswith("the stored policy alone") and not alone.endswith(" 0 collisions")
    assert filtered.startswith("the same episodes behind the filter") and filtered.endswith(" 0 collisions")
    assert re.search(r"^live page: http://127\.0\.0\.1:\d+/$", output, re.M)
    assert "log:    runs/first/run.mcap" in output
    commands = [shlex.split(line.removeprefix("next:")) for line in output.splitlines() if line.startswith("next:")]
    assert [command[:2] for command in commands] == [["brakeline", name] for name in ("replay", "evaluate", "analyse")]
    for command in commands:
        few = ("--episodes", 2) if command[1] == "evaluate" else ()
        assert printed(tmp_path, *command[1:], *few)
    assert "<svg" in (tmp_path / "report.html").read_text() or "<script" in (tmp_path / "report.html").read_text()
