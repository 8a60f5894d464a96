"""A model set that is put to use lies beside its own seal, or beside none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from brakeline.deploy.data.data_paths import data_root, record_path
from brakeline.deploy.data.model_store import model_for, put_to_use
from brakeline.errors import Untrusted
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_config import AUTO, ModelConfig
from brakeline.safety.service.signature import TrustedSigners, seal_of, write_signer
from tests.robots import GROUND


def test_a_model_set_is_signed_if_there_is_a_key_and_never_beside_the_seal_of_another(
    data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A first flight left the seal of the model set before, so a service with keys refused the new one."""
    data, model = Dataset.load(record_path(GROUND)), model_for(GROUND, ModelConfig())
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    write_signer(tmp_path / "keys")
    trust = TrustedSigners.load(tmp_path / "keys")
    path = put_to_use(model, data, tmp_path / "keys")
    assert trust.load_model(path).version == model.version
    other = replace(model, about=model.about | {"bound_plan": "0.5"})
    assert put_to_use(other, data, None) == path and not seal_of(path).exists()
    with pytest.raises(Untrusted, match="has no seal"):
        trust.load_model(path)
    assert put_to_use(other, data, tmp_path / "keys") == path
    assert trust.load_model(path).version == other.version
    assert model_for(GROUND, ModelConfig(mode=AUTO), accept_bound=1.0).version == other.version


def test_an_empty_variable_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A compose file or a script sets it so. The data would be in the working directory itself."""
    monkeypatch.setenv("BRAKELINE_DATA", "")
    assert data_root() == Path("data")
