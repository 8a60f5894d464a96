"""One finished run for the tests that look at its log, and processes that end with their test."""

import subprocess
from pathlib import Path

import pytest

from tests.system.runs import BRAKELINE
from tests.waiting import PATIENCE


@pytest.fixture(scope="session")
def demo(data_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The folder in which `brakeline demo` has run, and what it printed."""
    folder = tmp_path_factory.mktemp("demo")
    words = (*BRAKELINE, "demo", "--steps", "800", "--out", "runs/first", "--verbose")
    done = subprocess.run(words, check=False, capture_output=True, text=True, timeout=2.0 * PATIENCE, cwd=folder)
    assert done.returncode == 0, done.stderr
    return folder, done.stdout


@pytest.fixture(scope="session")
def logged_run(demo: tuple[Path, str]) -> Path:
    """The folder of its run: two actors, and a learner that is warming up."""
    return demo[0] / "runs" / "first"


@pytest.fixture
def start(tmp_path):
    """`start("safety", "ground", ...)` runs a command until the end of the test."""
    started = []

    def run(*words):
        name = f"{words[0]}-{len(started)}"
        with (tmp_path / f"{name}.out").open("w") as out:
            started.append(subprocess.Popen([*BRAKELINE, *map(str, words)], stdout=out, stderr=out))
        return started[-1]

    yield run
    for process in started:
        process.kill()
        process.wait()
