"""Mode auto uses the model set that was put to use last, whatever the times of the files are."""

import os

import pytest

from brakeline.deploy.data.data_paths import model_path, note_mode
from brakeline.errors import BadModel
from brakeline.safety.model.model_config import AUTO, DIRECT, ONE_STEP, ModelConfig
from tests.robots import GROUND

AUTOMATIC = ModelConfig(mode=AUTO)


@pytest.fixture
def paths(tmp_path, monkeypatch):
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))
    made = {mode: model_path(GROUND, ModelConfig(mode=mode)) for mode in (DIRECT, ONE_STEP)}
    made[DIRECT].parent.mkdir(parents=True)
    return made


def test_a_touched_file_is_not_the_newest(paths):
    assert model_path(GROUND, AUTOMATIC) == paths[DIRECT], "there is none"
    paths[ONE_STEP].write_bytes(b"")
    assert model_path(GROUND, AUTOMATIC) == paths[ONE_STEP], "it is the only one"
    paths[DIRECT].write_bytes(b"")
    for mode, times in ((ONE_STEP, (4e9, 1e9)), (DIRECT, (1e9, 4e9)), (ONE_STEP, (1e9, 1e9))):
        note_mode(GROUND, ModelConfig(mode=mode))
        for path, at in zip((paths[DIRECT], paths[ONE_STEP]), times, strict=True):
            os.utime(path, (at, at))
        assert model_path(GROUND, AUTOMATIC) == paths[mode]


def test_a_damaged_note_is_named(paths):
    note_mode(GROUND, ModelConfig(mode=ONE_STEP))
    (note,) = paths[DIRECT].parent.glob("*.in_use")
    note.write_bytes(b"one-stdp")
    with pytest.raises(BadModel, match=r"one-stdp.*certify again"):
        model_path(GROUND, AUTOMATIC)
