"""Fits find what the data were made from, and the same seed finds the same."""

import numpy as np
import pytest

from brakeline.errors import BadData
from brakeline.learner.rival_networks import FitConfig, fit_cost, fit_linear
from tests.robots import GROUND

HOW = FitConfig(hidden=(32, 32), rate=3e-3, batch=64, epochs=25)


def drawn(count=4000):
    rng = np.random.default_rng(3)
    return rng.uniform(-1, 1, (count, 3)), rng.uniform(-1, 1, (count, 2)), rng


def test_linear_models_of_an_input_that_depend_on_the_state():
    seen, action, rng = drawn()
    g = np.stack([np.stack([seen[:, 0], np.abs(seen[:, 1])], 1), np.stack([np.full(len(seen), 0.5), -seen[:, 2]], 1)])
    change = np.einsum("kbm,bm->bk", g, action) + rng.normal(0, 0.01, (len(seen), 2))
    networks, errors = fit_linear(seen, action, change, HOW, seed=1)
    assert (networks.count, networks.inputs, networks.outputs) == (2, 3, 2)
    assert (errors[0] < 0.05).all() and (errors[1] > 0.3).all()
    assert np.allclose(networks(np.array([0.5, -0.6, 0.2])), [[0.5, 0.6], [0.5, -0.2]], atol=0.12)


def test_costs_are_probabilities():
    seen, action, rng = drawn()
    danger = 1.0 / (1.0 + np.exp(-4.0 * (seen[:, 0] + action[:, 0])))
    x = np.hstack([seen, action])
    networks, error = fit_cost(GROUND, x, (rng.random(len(x)) < danger).astype(float), 2, HOW, seed=1)
    assert networks.count == 2 and error < 0.3
    odds = networks(np.array([0.9, 0, 0, 0.9, 0])), networks(np.array([-0.9, 0, 0, -0.9, 0])), networks(np.zeros(5))
    assert (odds[0] > 2).all() and (odds[1] < -2).all() and (np.abs(odds[2]) < 1.5).all()
    assert not np.array_equal(*networks(np.ones(5))), "two opinions, not one"


def test_the_seed_decides_alone():
    seen, action, _ = drawn(500)
    short = FitConfig(hidden=(8,), batch=64, epochs=2)
    fits = [fit_linear(seen, action, seen[:, :1], short, seed)[0].tensors("g") for seed in (1, 1, 2)]
    assert all(np.array_equal(fits[0][name], fits[1][name]) for name in fits[0])
    assert not all(np.array_equal(fits[0][name], fits[2][name]) for name in fits[0])


def test_too_few_samples_and_senseless_numbers_are_refused():
    with pytest.raises(BadData, match="10 samples"):
        fit_cost(GROUND, np.zeros((10, 2)), np.zeros(10), 1, HOW, 0)
    for wrong in ({"batch": 0}, {"epochs": 0}, {"hidden": ()}, {"held_out": 0.0}):
        with pytest.raises(ValueError, match="1 or more"):
            FitConfig(**({"hidden": (4,)} | wrong))
