"""The sets of consistent models of benchmarks/consistent_models.py contain what they must."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog

from benchmarks.consistent_models import ConsistentModels, LeastSquaresZonotope, ModelTubes, Noise
from brakeline.messaging.robot import robot_named
from brakeline.safety.model.one_step import features_for

pytestmark = pytest.mark.fast
DIFF = robot_named(str(Path(__file__).parents[2] / "examples" / "own_log" / "diff.toml"))


def recorded(seed, count=60, features=3, outputs=2):
    draw = np.random.default_rng(seed)
    phi, truth = draw.normal(size=(count, features)), draw.normal(size=(outputs, features))
    sizes = draw.uniform(0.1, 0.3, (count, outputs))
    return phi, phi @ truth.T + 0.7 * draw.uniform(-sizes, sizes), sizes, truth


def test_least_squares_zonotope_is_what_the_recursion_gives():
    phi, y, sizes, _ = recorded(0)
    center, P, rows = np.zeros((3, 2)), 1e9 * np.eye(3), np.zeros((0, 3))
    for f, target in zip(phi, y, strict=True):
        K = P @ f / (f @ P @ f + 1.0)
        center += np.outer(K, target - f @ center)
        P = (np.eye(3) - np.outer(K, f)) @ P
        rows = np.vstack([rows @ (np.eye(3) - np.outer(K, f)).T, -K])
    found = LeastSquaresZonotope.fit(phi, y, sizes)
    np.testing.assert_allclose(found.C, center.T, atol=1e-6)
    np.testing.assert_allclose(np.abs(found.H), np.abs(rows), atol=1e-6)
    low, high = found.spread(phi[:5])
    np.testing.assert_allclose(high, np.abs(phi[:5] @ rows.T) @ sizes, atol=1e-5)
    np.testing.assert_allclose(low, -high)


def test_consistent_models_are_the_constrained_matrix_zonotope():
    """Its definition: A = (Y − Σ β G) Φ⁺ with |β| <= 1 and (Y − Σ β G) Φ⊥ = 0, one β for each sample and output."""
    phi, y, sizes, truth = recorded(1, count=12)
    found, wanted = ConsistentModels.fit(phi, y, sizes), np.random.default_rng(2).normal(size=(6, 3))
    low, high = found.spread(wanted)
    pseudo, null = np.linalg.pinv(phi.T), np.linalg.svd(phi)[0][:, 3:]
    for j, (target, size) in enumerate(zip(y.T, sizes.T, strict=True)):
        assert (np.abs(target - phi @ found.C[j]) <= size).all()  # else it would leave samples out
        for p, least, most in zip(wanted, low[:, j], high[:, j], strict=True):
            effect = -size * (pseudo @ p)  # of β on A φ
            constraint = {"A_eq": (size[:, None] * null).T, "b_eq": target @ null, "bounds": (-1.0, 1.0)}
            middle = target @ pseudo @ p - found.C[j] @ p
            assert middle - linprog(-effect, **constraint).fun == pytest.approx(most, abs=1e-8)
            assert middle + linprog(effect, **constraint).fun == pytest.approx(least, abs=1e-8)
    off = wanted @ (truth - found.C).T
    assert (low - 1e-9 <= off).all() and (off <= high + 1e-9).all()
    assert (np.abs(truth - found.C) <= found.box + 1e-9).all()


@pytest.mark.parametrize("fit", [LeastSquaresZonotope.fit, ConsistentModels.fit])
def test_tubes_hold_the_rollouts_of_every_consistent_model(fit):
    draw = np.random.default_rng(4)
    v = draw.uniform(-1.0, 1.0, (150, 6)) * [0.6, 1.5, 0.6, 1.5, 0.6, 1.5]
    features = features_for(DIFF, v, 2, 0)
    features = features.subset(np.flatnonzero((features.terms <= v.shape[1]).all(1)))  # monomials alone
    noise, truth = Noise(np.full((5, 6), 0.001), np.full(5, 0.002)), 0.1 * draw.normal(size=(5, len(features.terms)))
    sizes = noise.sizes(v)
    models = fit(features(v), features(v) @ truth.T + draw.uniform(-sizes, sizes), sizes)
    z = draw.uniform(-0.6, 0.6, (10, 2 + 2 + 6 * 2))
    center, half = ModelTubes(DIFF, features, models, noise)(z)
    for _ in range(20):
        s, p, heading, inputs = z[:, :2], np.zeros((10, 2)), np.zeros(10), z[:, 2:].reshape(10, 7, 2)
        for k in range(1, 7):
            at = np.hstack([s, inputs[:, k], inputs[:, k - 1]])
            y = features(at) @ truth.T + draw.choice([-1.0, 1.0], (10, 5)) * noise.sizes(at)
            cos, sin = np.cos(heading), np.sin(heading)
            p = p + np.column_stack([cos * y[:, 0] - sin * y[:, 1], sin * y[:, 0] + cos * y[:, 1]])
            heading, s = heading + y[:, 2], y[:, 3:]
            assert (np.abs(p - center[:, k - 1]) <= half[:, k - 1] + 1e-12).all()
