"""A model set that is put to use lies beside its own seal, or beside none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from brakeline.deploy.data import certification
from brakeline.deploy.data.data_paths import data_root, model_path, note_mode, record_path
from brakeline.deploy.data.model_store import model_for, put_to_use
from brakeline.errors import BadData, Untrusted
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_config import AUTO, ONE_STEP, ModelConfig
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.signature import LAST, TrustedSigners, seal_of, write_signer
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
    (tmp_path / "keys" / LAST).write_text("damaged")
    with pytest.raises(Untrusted, match="damaged"):
        put_to_use(model, data, tmp_path / "keys")
    assert trust.load_model(path).version == other.version, "the model set before keeps its seal"


@pytest.fixture
def in_use(data_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """The paths of a data set, and of a damaged model set of mode one-step, which was put to use last."""
    record = record_path(GROUND).read_bytes()
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "my data"))
    config = ModelConfig(mode=ONE_STEP)
    note_mode(GROUND, config)
    model_path(GROUND, config).write_bytes(b"damaged")
    record_path(GROUND).write_bytes(record)
    return record_path(GROUND), model_path(GROUND, config)


def test_a_model_set_that_is_built_again_keeps_the_mode_that_is_in_use(
    in_use: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before, mode auto wrote a model set of mode direct into the file of mode one-step."""
    asked, model = [], ModelSet.load("ground")
    report = SimpleNamespace(violations=0, windows=1, bound_plan=0.0, bound_step=0.0)
    monkeypatch.setattr(certification, "certify", lambda _, config: (asked.append(config.mode), (model, report))[1])
    model_for(GROUND, ModelConfig(mode=AUTO), 1.0)
    assert asked == [ONE_STEP] and in_use[1].with_suffix(".replaced").read_bytes() == b"damaged"


def test_a_model_set_stays_where_it_is_if_it_cannot_be_built_again(in_use: tuple[Path, Path]) -> None:
    """A description with a mistake moved it away. When the mistake was mended, a model set of another mode was used."""
    record, path = in_use
    replace(Dataset.load(record), about={"origin": "import", "sources": "drive.csv"}).save(record)
    for _ in range(2):
        with pytest.raises(BadData, match=r"import the log again"):
            model_for(replace(GROUND, period=0.1), ModelConfig(mode=AUTO))
        assert model_path(GROUND, ModelConfig(mode=AUTO)) == path and path.read_bytes() == b"damaged"


def test_an_empty_variable_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """A compose file or a script sets it so. The data would be in the working directory itself."""
    monkeypatch.setenv("BRAKELINE_DATA", "")
    assert data_root() == Path("data")
