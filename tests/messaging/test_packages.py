"""`safety`, `sim` and others are names on PyPI too: ours must be the ones that are imported."""

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", ["brakeline", "messaging", "sim", "safety", "actors", "learner", "logs", "deploy"])
def test_the_package_is_this_checkouts(name: str) -> None:
    file = importlib.import_module(name).__file__
    assert file is not None
    assert Path(file).is_relative_to(ROOT / name)
