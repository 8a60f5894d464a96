"""The stacked tube agrees with its definition. That it holds fresh plans: `test_model_set.py`."""

import numpy as np
import pytest

from brakeline.safety.filter.reachable_tube import RecursionMaps, stack_direct, stack_recursive
from brakeline.safety.model.error_bounds import ErrorBound

pytestmark = pytest.mark.fast


def test_a_direct_tube_has_the_half_widths_of_its_steps(model):
    tube = model.tube()
    for z in np.random.default_rng(0).uniform(-0.3, 0.3, (20, 6)):
        for k, step in enumerate(model.steps):
            by_hand = np.abs(step.W @ z) @ step.M.T + np.abs(z) @ step.kappa.T + step.w
            assert np.allclose(tube.half_widths(z)[k], by_hand[:2], rtol=1e-9)
            assert np.allclose(tube.centers(z)[k], step.C[:2] @ z)
        assert np.allclose(
            tube.magnitudes(z)[-1], np.abs(z) @ model.stopping_distance.kappa[0] + model.stopping_distance.w[0]
        )
        assert np.allclose(
            tube.magnitudes(z)[-4:-1], model.chord_deviations.kappa @ np.abs(z) + model.chord_deviations.w
        )


def random_certificate(rng, n, nz, g, rows):
    return ErrorBound(
        0.5 * rng.normal(size=(n, nz)),
        rng.normal(size=(rows, nz)),
        0.1 * rng.uniform(size=(g, rows)),
        0.1 * rng.uniform(size=(g, nz)),
        0.1 * rng.uniform(size=g),
        rng.normal(size=(n, g)),
    )


def slow_recursion(steps, z_of, y_0, horizon):
    """Lemma 2 with explicit zonotopes: every step's generators from the whole set of regressors, one at a time."""
    center, generators, sets = y_0, [], []
    for k in range(horizon):
        step, n = steps[k], len(y_0)
        regressor = z_of(center, k)
        zeros = np.zeros(len(regressor) - n)
        lengths = []
        for j in range(len(step.w)):
            length = step.w[j] + step.kappa[j] @ np.abs(regressor) + step.M[j] @ np.abs(step.W @ regressor)
            for g in generators:
                moved = np.concatenate([g, zeros])
                length += step.kappa[j] @ np.abs(moved) + step.M[j] @ np.abs(step.W @ moved)
            lengths.append(length)
        generators = [step.C[:, :n] @ g for g in generators]
        generators += [lengths[j] * step.generators[:, j] for j in range(len(step.w))]
        center = step.C @ regressor
        sets.append((center, np.array(generators).T))
    return sets


@pytest.mark.parametrize("seed", range(5))
def test_the_recursion_is_the_explicit_one(seed):
    rng = np.random.default_rng(seed)
    n, m, horizon = 2, 1, 4
    steps = [random_certificate(rng, n, n + 2 * m, g=3, rows=5) for _ in range(horizon)]
    first = np.hstack([np.eye(n), np.zeros((n, m + horizon * m))])
    how = RecursionMaps((0, 1), 0, m, np.eye(horizon), first)
    tube = stack_recursive(steps, how, n)
    y_0, u_prev, plan = rng.normal(size=n), rng.normal(size=m), rng.normal(size=horizon)
    inputs = np.concatenate([u_prev, plan])
    sets = slow_recursion(steps, lambda y, k: np.concatenate([y, inputs[k : k + 2]]), y_0, horizon)
    z = np.concatenate([y_0, u_prev, plan])
    directions = rng.normal(size=(30, n))
    sizes = tube.magnitudes(z)[: tube.generators]
    for k, (center, generators) in enumerate(sets):
        assert np.allclose(tube.centers(z)[k], center)
        reach = np.abs(directions @ tube.directions[k]) @ sizes
        assert np.allclose(reach, np.abs(directions @ generators).sum(1), rtol=1e-9)


def test_relative_coordinates_are_carried_on():
    """Position is predicted as displacement and is no regressor: the sets of the steps add up."""
    step = ErrorBound(
        np.array([[0.2], [0.5]]), np.zeros((0, 1)), np.zeros((2, 0)), np.zeros((2, 1)), np.ones(2), np.eye(2)
    )
    how = RecursionMaps((1,), 1, 0, np.zeros((0, 0)), np.array([[0.0], [1.0]]))
    tube = stack_recursive([step] * 3, how, 1)
    assert np.allclose(tube.centers(np.array([10.0]))[:, 0], [2.0, 3.0, 3.5])
    assert np.allclose(tube.half_widths(np.array([10.0]))[:, 0], [1.0, 2.2, 3.5])


def test_parallel_rows_are_merged_without_loss():
    rng = np.random.default_rng(5)
    row = rng.normal(size=(1, 4))
    W = np.vstack([row, -2.0 * row, rng.normal(size=(2, 4)), np.zeros((1, 4))])
    step = ErrorBound(rng.normal(size=(2, 4)), W, rng.uniform(size=(2, 5)), np.zeros((2, 4)), np.ones(2), np.eye(2))
    nothing = ErrorBound(np.zeros((1, 4)), np.zeros((0, 4)), np.zeros((1, 0)), np.zeros((1, 4)), np.zeros(1), np.eye(1))
    tube = stack_direct([step], 2, nothing, nothing)
    assert len(tube.W) == 3
    for z in rng.normal(size=(20, 4)):
        assert np.allclose(tube.magnitudes(z)[:2], step.magnitudes(z))
