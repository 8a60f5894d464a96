"""A rival's file: a saved model is read back, and a damaged one is refused."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.errors import BadModel, BadWeights
from brakeline.messaging.perceptrons import Perceptrons
from brakeline.messaging.robot_files import ROBOTS_FOLDER
from brakeline.safety.methods import decode, load, ready
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.sailr import Sailr
from brakeline.safety.rivals.secas import Secas
from tests.robots import GROUND, QUADROTOR
from tests.safety.rivals import test_sailr, test_secas


@pytest.fixture(params=[test_secas.known, test_sailr.known])
def pretrained(request) -> Pretrained:
    return replace(request.param(), about={"samples": "7"})


def test_a_saved_model_is_read_back(pretrained, tmp_path):
    pretrained.save(tmp_path / "deep" / "model.safetensors")
    loaded = load(tmp_path / "deep" / "model.safetensors")
    assert isinstance(loaded, Pretrained)
    assert (loaded.version, loaded.settings) == (pretrained.version, pretrained.settings)
    assert loaded.about == {"samples": "7"}
    assert type(ready(loaded)) is {"secas": Secas, "sailr": Sailr}[pretrained.method]
    assert ready(loaded).version == pretrained.version
    assert (loaded.rays is None) == (pretrained.rays is None)
    if pretrained.rays is not None:
        assert np.array_equal(loaded.rays.directions, pretrained.rays.directions)
        assert loaded.rays.range == pretrained.rays.range


def test_the_version_covers_everything_that_decisions_depend_on(pretrained):
    network = next(iter(pretrained.networks))
    layers = [(w + np.float32(1e-6), b) for w, b in pretrained.networks[network].layers]
    other = replace(pretrained, networks=dict(pretrained.networks) | {network: Perceptrons(layers)})
    setting = next(iter(pretrained.settings))
    stricter = replace(pretrained, settings={setting: pretrained.settings[setting] + 1e-9})
    versions = {pretrained.version, other.version, stricter.version, replace(pretrained, robot=QUADROTOR).version}
    assert len(versions) == 4 and replace(pretrained, about={}).version == pretrained.version


def test_a_damaged_file_or_one_of_another_kind_is_refused(pretrained, tmp_path):
    whole = pretrained.encode()
    name = f'"{pretrained.method}\\"'.encode()
    for wrong in (b"", whole[:40], whole[:-4], whole[:-1] + bytes([whole[-1] ^ 1]), whole.replace(name, name[::-1])):
        if wrong != whole:
            with pytest.raises(BadModel):
                decode(wrong)
    with pytest.raises(BadModel, match="nothing here"):
        load(tmp_path / "nothing here")
    layout = GROUND.layout().encode()
    with pytest.raises(BadModel, match="another layout"):
        decode(whole.replace(layout, layout[::-1]))
    with pytest.raises(BadModel, match="no method is called 'prayer'"):
        ready(replace(pretrained, method="prayer"))


def test_the_shipped_model_set_is_read():
    model = load(ROBOTS_FOLDER / "ground.model.safetensors")
    assert isinstance(model, ModelSet) and ready(model).version == model.version


def test_perceptrons_by_their_definition():
    rng = np.random.default_rng(0)
    layers = [
        (rng.normal(size=(3, 5, 4)), rng.normal(size=(3, 5))),
        (rng.normal(size=(3, 2, 5)), rng.normal(size=(3, 2))),
    ]
    networks, x = Perceptrons(layers), rng.normal(size=4)
    (w0, b0), (w1, b1) = networks.layers
    for i, found in enumerate(networks(x)):
        assert np.allclose(found, w1[i] @ np.maximum(w0[i] @ x + b0[i], 0) + b1[i], atol=1e-5)
    assert np.array_equal(Perceptrons.of(networks.tensors("a"), "a")(x), networks(x))
    broken = networks.tensors("a") | {"a.1.bias": np.full((3, 2), np.nan, np.float32)}
    for wrong in (broken, {"b.0.weight": w0}, {}):
        with pytest.raises(BadWeights):
            Perceptrons.of(wrong, "a")
    with pytest.raises(BadWeights, match=r"layers\.1"):
        Perceptrons([layers[0], (rng.normal(size=(3, 2, 6)), layers[1][1])])
