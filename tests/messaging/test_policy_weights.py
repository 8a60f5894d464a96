import json
from dataclasses import replace

import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given
from hypothesis import strategies as st

from brakeline.errors import BadWeights
from brakeline.messaging.policy_weights import MLP, decode, encode
from tests.robots import GROUND

pytestmark = pytest.mark.fast

POLICY = MLP.untrained(GROUND, seed=1, hidden=(16, 8))
FILE = encode(GROUND, POLICY.layers, version=7, noise=0.25)


def observation(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, GROUND.task.observation_dim)


def test_round_trip_over_bytes_and_a_file(tmp_path):
    policy = decode(FILE)
    policy.save(tmp_path / "policy.safetensors")
    assert (tmp_path / "policy.safetensors").read_bytes() == FILE
    assert MLP.load(tmp_path / "policy.safetensors", GROUND).encode() == FILE
    assert (policy.robot, policy.version, policy.noise, policy.sizes) == (GROUND, 7, 0.25, (26, 16, 8, 2))
    assert policy.encode() == FILE
    assert (policy(observation(0)) == POLICY(observation(0))).all()


def test_forward_pass_is_the_formula_and_stays_within_the_bounds():
    for seed in range(20):
        x = value = observation(seed)
        for weight, bias in POLICY.layers[:-1]:
            value = np.maximum(weight @ value + bias, 0.0)
        weight, bias = POLICY.layers[-1]
        low, high = GROUND.low(), GROUND.high()
        expected = low + (np.tanh(weight @ value + bias) + 1.0) / 2.0 * (high - low)
        np.testing.assert_allclose(POLICY(x), expected, atol=1e-6)
        assert (low <= POLICY(1e3 * x)).all() and (POLICY(1e3 * x) <= high).all()


def test_an_action_outlives_the_next_call():
    policy = decode(FILE)
    first = policy(observation(0))
    copied = first.copy()
    policy(observation(1))
    assert (first == copied).all()


def test_exploration():
    policy, generator = decode(FILE), np.random.default_rng(0)
    actions = np.array([policy.explore(observation(0), generator) for _ in range(2000)])
    assert (actions >= GROUND.low()).all() and (actions <= GROUND.high()).all()
    np.testing.assert_allclose(actions[:, 1].mean(), policy(observation(0))[1], atol=0.02)
    np.testing.assert_allclose(actions[:, 1].std(), 0.25 * 0.5, atol=0.01)
    calm = MLP(GROUND, POLICY.layers)
    assert (calm.explore(observation(0), generator) == calm(observation(0))).all()


def test_untrained_policies_differ_by_seed_only():
    one, same, other = (MLP.untrained(GROUND, seed) for seed in (1, 1, 2))
    assert one.sizes == (26, 256, 256, 2)
    assert one.encode() == same.encode() != other.encode()


@given(st.binary(max_size=300) | st.integers(0, len(FILE) - 1).map(lambda length: FILE[:length]))
def test_garbage_and_a_part_of_a_file_are_refused(data):
    with pytest.raises(BadWeights):
        decode(data)


@given(st.integers(0, len(FILE) - 1), st.integers(1, 255))
def test_a_flipped_byte_is_refused_or_harmless(place, flip):
    data = bytearray(FILE)
    data[place] ^= flip
    try:
        policy = decode(bytes(data))
    except BadWeights:
        return
    assert policy.sizes[0] == 26 and policy.sizes[-1] == 2
    assert np.isfinite(policy(observation(0))).all()


def rewritten(tensors=None, **about) -> bytes:
    fields = {"robot": "ground", "layout": GROUND.learning_layout(), "version": 1, "noise": 0.1} | about
    if tensors is None:
        tensors = safetensors.numpy.load(FILE)
    return safetensors.numpy.save(tensors, {"policy": json.dumps(fields)})


TENSORS = safetensors.numpy.load(FILE)


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (rewritten(robot="submarine"), "robot"),
        (rewritten(robot=3), "robot"),
        (rewritten(layout="0" * 16), "layout"),
        (rewritten(version=-1), "version"),
        (rewritten(version="1"), "version"),
        (rewritten(noise=-0.1), "noise"),
        (rewritten(noise=True), "noise"),
        (rewritten({}), "layers"),
        (rewritten(TENSORS | {"spare": np.zeros(1, np.float32)}), "arrays"),
        (
            rewritten({k: v for k, v in TENSORS.items() if k != "layers.1.bias"} | {"x": TENSORS["layers.1.bias"]}),
            "bias",
        ),
        (rewritten(TENSORS | {"layers.0.weight": np.zeros((16, 25), np.float32)}), "layers.0"),
        (rewritten(TENSORS | {"layers.0.weight": np.zeros((16, 26), np.float64)}), "layers.0.weight"),
        (rewritten(TENSORS | {"layers.1.bias": np.full(8, np.nan, np.float32)}), "layers.1: not finite"),
        (rewritten(TENSORS | {"layers.2.bias": np.full(2, np.inf, np.float32)}), "layers.2: not finite"),
        (rewritten({k: v for k, v in TENSORS.items() if "layers.2" not in k}), "outputs"),
        (safetensors.numpy.save(TENSORS), "policy"),
        (safetensors.numpy.save(TENSORS, {"policy": "[]"}), "robot"),
    ],
)
def test_refusals_name_what_is_wrong(data, what):
    with pytest.raises(BadWeights, match=what):
        decode(data)


def test_a_policy_of_another_robot_is_refused():
    with pytest.raises(BadWeights, match="robot"):
        decode(FILE, replace(GROUND, name="other"))
    with pytest.raises(BadWeights, match="layout"):
        decode(FILE, replace(GROUND, period=0.1))
