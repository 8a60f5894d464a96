"""What a log holds besides messages does not depend on packages that the run does not need."""

import subprocess
import sys
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from brakeline.deploy.run import log_contents
from brakeline.deploy.run.run_config import RunConfig


def test_a_run_is_recorded_without_packages_that_it_does_not_need(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A flight without torch, or a training without pymavlink, ended since its recorder did not start."""

    def version(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(log_contents, "version", version)
    versions = log_contents.metadata(RunConfig(method="none"), tmp_path)["versions"]
    assert set(versions.values()) == {"not installed"}
    imported = "import sys; sys.modules['pymavlink'] = None; import brakeline.deploy.run.log_contents"
    subprocess.run([sys.executable, "-c", imported], check=True)
