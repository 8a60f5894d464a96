"""A short log, some minutes of data, and the command line and the readers of foreign logs within this process."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from mcap.reader import make_reader

from brakeline.deploy.cli import main
from brakeline.deploy.data import importer
from brakeline.deploy.data.sources.isolated_reader import read_here
from brakeline.safety.model.dataset import Dataset
from tests.deploy.drive import drive
from tests.fuzz.mutations import flipped


@pytest.fixture(scope="session")
def log(data_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """150 steps in the dense arena: the filter steps in often."""
    path = tmp_path_factory.mktemp("drive") / "run.mcap"
    drive(path)
    return path


@pytest.fixture
def damaged(log: Path, tmp_path: Path) -> Path:
    """The same log with a changed byte in its last request and in its last step, each of which is a chunk."""
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    whole = log.read_bytes()
    for chunk in summary.chunk_indexes[-2:]:
        whole = flipped(whole, chunk.chunk_start_offset + chunk.chunk_length // 2, 3)
    path = tmp_path / "damaged" / "run.mcap"
    path.parent.mkdir()
    path.write_bytes(whole)
    return path


@pytest.fixture
def command(capsys):
    """`command("evaluate", "ground")`: exit status, stdout, stderr."""

    def run(*words):
        try:
            status = main([str(word) for word in words])
        except SystemExit as end:
            status = end.code
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return run


@pytest.fixture
def figures(command):
    """The one JSON object that a command prints, and nothing else."""

    def run(*words):
        status, out, err = command(*words, "--json")
        assert status == 0, err
        assert out.endswith("\n") and out.count("\n") == 1
        return json.loads(out)

    return run


@pytest.fixture(scope="session")
def few_data(data_folder, tmp_path_factory) -> Path:
    """The first minutes of the session's recording, as a data set of its own."""
    data = Dataset.load(data_folder / "ground" / "record.safetensors")
    path = tmp_path_factory.mktemp("few") / "few.safetensors"
    replace(data, trajectories=data.trajectories[:24]).save(path)
    return path


@pytest.fixture
def reading_here(monkeypatch):
    """Read foreign logs in this process: starting one takes longer than reading a minute of driving."""
    monkeypatch.setattr(importer, "read_isolated", lambda reader, path, limits: read_here(reader, path))
