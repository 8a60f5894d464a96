"""One finished run for the tests that look at its log, and processes that end with their test."""

import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.system.runs import BRAKELINE, Run


@pytest.fixture(scope="session")
def whole_run(data_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """The folder of a finished run of the `debug` experiment with two actors, and the figures it printed."""
    with Run(tmp_path_factory.mktemp("runs") / "whole") as run:
        figures = run.end()
        assert run.popen.returncode == 0, run.errors.read_text()
    return run.folder, figures


@pytest.fixture(scope="session")
def logged_run(whole_run: tuple[Path, dict[str, Any]]) -> Path:
    """Its folder."""
    return whole_run[0]


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
