"""A run begins with copies of the models in use, and goes on with them when it is resumed."""

import json
import os
from dataclasses import replace
from pathlib import Path

import pytest

from brakeline.actors.actor_settings import FlightSettings
from brakeline.deploy.data.data_paths import model_path, note_mode
from brakeline.deploy.run.launcher import prepare
from brakeline.deploy.run.processes import CONFIG
from brakeline.deploy.run.run_config import RunConfig, encode, load
from brakeline.deploy.run.run_models import model_in_run
from brakeline.errors import BadModel, TooLoose
from brakeline.learner import checkpoint
from brakeline.messaging.acceleration_age import about_age
from brakeline.messaging.robot import robot_named
from brakeline.safety.model.model_config import AUTO, DIRECT, ONE_STEP
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from tests.robots import GROUND

SHIPPED = ModelSet.load("ground")


def use(mode: str, factor: float) -> ModelSet:
    """Put a model set of a mode to use. factor: on its bounds."""
    first = SHIPPED.steps[0]
    model = replace(SHIPPED, steps=(replace(first, w=factor * first.w), *SHIPPED.steps[1:]))
    path = model_path(GROUND, ModelConfig(mode=mode))
    model.save(path)
    note_mode(GROUND, ModelConfig(mode=mode))
    return model


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path / "data"))
    return tmp_path / "run"


def begun(folder):
    """Return the configuration with which a run in a folder begins, as saved."""
    config = prepare(RunConfig(), folder, resume=False)
    (folder / CONFIG).write_text(encode(config))
    checkpoint.save(folder / "learner" / checkpoint.CHECKPOINT, {}, {})
    return load(folder / CONFIG)


def test_a_run_pins_the_mode_and_the_model_set_that_it_begins_with(folder, capsys):
    assert RunConfig().model_config.mode == AUTO
    first = use(DIRECT, 1.0)
    config = begun(folder)
    assert config.model_config.mode == DIRECT
    assert json.loads((folder / CONFIG).read_text())["model_config"]["mode"] == DIRECT
    capsys.readouterr()
    prepare(config, folder, resume=True)
    assert capsys.readouterr().err == "", "its model set is still in use"
    second = use(ONE_STEP, 1.1)
    assert model_path(GROUND, ModelConfig(mode=AUTO)) == model_path(GROUND, ModelConfig(mode=ONE_STEP)), "the last one"
    third = use(DIRECT, 1.2)
    assert len({model.version for model in (first, second, third)}) == 3
    capsys.readouterr()
    resumed = prepare(config, folder, resume=True)
    said = " ".join(capsys.readouterr().err.split())
    assert resumed == config
    assert f"goes on with its own model {first.version}" in said and "start a new run to use it" in said
    assert ModelSet.load(model_in_run(config, folder, GROUND)).version == first.version


def test_a_run_whose_model_set_is_lost_or_too_loose_is_not_resumed(folder):
    use(DIRECT, 1.0)
    config = begun(folder)
    with pytest.raises(TooLoose):
        prepare(replace(config, accept_bound=1e-6), folder, resume=True)
    model_in_run(config, folder, GROUND).unlink()
    with pytest.raises(BadModel, match=r"can't be resumed: no model of ground.*Start a new run"):
        prepare(config, folder, resume=True)


def test_a_vehicle_reports_accelerations_of_the_age_in_the_model_set(folder):
    late = robot_named("quadrotor-late")
    flown = ModelSet.load(Path(__file__).parents[2] / "stored" / "quadrotor-late.safetensors")
    mode = ModelConfig(mode=flown.model_config.mode)
    replace(flown, about=flown.about | about_age([0.2])).save(model_path(late, mode))
    note_mode(late, mode)
    config = RunConfig(
        robots=(late.name,),
        policy="astar",
        flights=(FlightSettings("udpin:127.0.0.1:14550"),),
        actors=1,
        accept_bound=1.0,
    )
    assert prepare(config, folder, resume=False).flights[0].acceleration_age == 0.2
    other = replace(config, flights=(replace(config.flights[0], acceleration_age=0.1),))
    with pytest.raises(BadModel, match=r"of 0\.2 s ago, not of 0\.1 s ago: leave out --acceleration-age"):
        prepare(other, folder.with_name("other"), resume=False)


# --- mode auto uses the model set that was put to use last, whatever the times of the files are -------------------


@pytest.fixture
def paths(tmp_path, monkeypatch):
    monkeypatch.setenv("BRAKELINE_DATA", str(tmp_path))
    made = {mode: model_path(GROUND, ModelConfig(mode=mode)) for mode in (DIRECT, ONE_STEP)}
    made[DIRECT].parent.mkdir(parents=True)
    return made


@pytest.mark.parametrize(("deleted", "stays"), [(ONE_STEP, DIRECT), (DIRECT, ONE_STEP)])
def test_a_model_set_in_use_that_is_gone_is_not_replaced_by_an_older_one(paths, deleted, stays):
    use(stays, 1.0), use(deleted, 1.1)
    paths[deleted].unlink()
    with pytest.raises(BadModel, match=rf"{paths[deleted]}, is gone: .* mode {stays} instead, delete .*\.in_use"):
        model_path(GROUND, ModelConfig(mode=AUTO))
    paths[stays].unlink()
    assert model_path(GROUND, ModelConfig(mode=AUTO)) == paths[DIRECT], "as if none had ever been there"


def test_a_touched_file_is_not_the_newest(paths):
    assert model_path(GROUND, ModelConfig(mode=AUTO)) == paths[DIRECT], "there is none"
    paths[ONE_STEP].write_bytes(b"")
    assert model_path(GROUND, ModelConfig(mode=AUTO)) == paths[ONE_STEP], "it is the only one"
    paths[DIRECT].write_bytes(b"")
    for mode, times in ((ONE_STEP, (4e9, 1e9)), (DIRECT, (1e9, 4e9)), (ONE_STEP, (1e9, 1e9))):
        note_mode(GROUND, ModelConfig(mode=mode))
        for path, at in zip((paths[DIRECT], paths[ONE_STEP]), times, strict=True):
            os.utime(path, (at, at))
        assert model_path(GROUND, ModelConfig(mode=AUTO)) == paths[mode]


def test_a_damaged_note_is_named(paths):
    note_mode(GROUND, ModelConfig(mode=ONE_STEP))
    (note,) = paths[DIRECT].parent.glob("*.in_use")
    note.write_bytes(b"one-stdp")
    with pytest.raises(BadModel, match=r"one-stdp.*certify again"):
        model_path(GROUND, ModelConfig(mode=AUTO))
