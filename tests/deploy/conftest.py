"""One short log, for the tests that read it."""

from pathlib import Path

import pytest

from tests.deploy.drive import drive


@pytest.fixture(scope="session")
def log(data_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """150 steps in the dense arena: the filter steps in often."""
    path = tmp_path_factory.mktemp("drive") / "run.mcap"
    drive(path)
    return path
