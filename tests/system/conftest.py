"""One finished run, for the tests that look at what it left."""

from pathlib import Path

import pytest

from tests.system.runs import Run


@pytest.fixture(scope="session")
def logged_run(data_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of the `debug` experiment with two actors."""
    with Run(tmp_path_factory.mktemp("logged") / "run") as run:
        figures = run.end()
        assert figures["finished"], run.errors.read_text()
    return run.folder
