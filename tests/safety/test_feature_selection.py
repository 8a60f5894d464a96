"""The fit of one learned period takes few features, and does not believe the errors of measured speeds."""

import numpy as np
import pytest

from brakeline.safety.model.calibration_samples import Samples
from brakeline.safety.model.feature_selection import SelectionPath
from brakeline.safety.model.one_step import features_for
from brakeline.safety.model.one_step_regression import Candidate, Regression
from tests.safety.test_turning_in_place import ROBOT

R, M = len(ROBOT.regressor), ROBOT.action_dim


def path(phi, y, penalty=1.0):
    return SelectionPath.of(phi.T @ phi, phi.T @ y, float(y @ y), len(y), penalty)


def test_the_features_that_matter_are_found_among_many():
    rng = np.random.default_rng(0)
    phi = rng.normal(size=(1000, 80)) * rng.uniform(0.01, 10.0, 80)
    y = phi[:, [3, 41, 77]] @ [2.0, -0.5, 1.0] + 0.1 * rng.normal(size=1000)
    found = path(phi, y)
    assert set(found.best(3.0)) == {3, 41, 77} <= set(found.best(1.0))
    assert len(found.best(1.0)) <= 6
    left = y - phi[:, found.order[:3]] @ np.linalg.lstsq(phi[:, found.order[:3]], y, rcond=None)[0]
    assert found.squares[3] == pytest.approx(left @ left)


def test_of_features_that_say_the_same_one_is_taken_and_of_noise_none():
    rng = np.random.default_rng(1)
    one = rng.normal(size=(500, 1))
    assert len(path(np.hstack([one, 2.0 * one, one + 1e-8 * rng.normal(size=(500, 1))]), one[:, 0]).order) == 1
    assert not len(path(rng.normal(size=(500, 20)), rng.normal(size=500), 3.0).best(3.0))
    assert not len(path(np.zeros((10, 2)), np.zeros(10)).order)


def driving(slip, noise, periods=4000):
    """Return samples of a robot whose speeds follow the inputs, the first one less while it turns."""
    rng = np.random.default_rng(2)
    inputs = np.repeat(rng.uniform(ROBOT.low(), ROBOT.high(), (periods // 4, M)), 4, axis=0)
    speeds = np.zeros((periods + 1, R))
    for k, u in enumerate(inputs):
        asked = u * [1.0 - slip * abs(speeds[k, 1]), 1.0]
        speeds[k + 1] = 0.6 * speeds[k] + 0.4 * asked
    measured = speeds + noise * rng.normal(size=speeds.shape)
    y = np.zeros((periods, ROBOT.state_dim))
    y[:, list(ROBOT.regressor)] = measured[1:]
    v = np.hstack([measured[:-1], inputs, np.vstack([np.zeros(M), inputs[:-1]])])
    folds, none = np.arange(periods) * 5 // periods, np.zeros(0)
    return Samples(v, y, folds, np.arange(periods) > 0, none, none, none, none, none, none), speeds, v


def test_instruments_see_through_the_errors_of_measured_speeds():
    s, _, v = driving(slip=0.0, noise=0.1)
    regression = Regression(ROBOT, features_for(ROBOT, v, 1, 0), s)
    decay = {}
    for instruments in (False, True):
        one_step = regression.fit(Candidate(1, 0, 3.0, instruments))
        at = [np.zeros((1, v.shape[1])) for _ in range(2)]
        at[1][0, 0] = 0.1
        low, high = (one_step.features(one)[0] @ one_step.C[ROBOT.regressor[0]] for one in at)
        decay[instruments] = (high - low) / 0.1
    assert decay[True] == pytest.approx(0.6, abs=0.03)
    assert decay[False] < 0.5, "least squares takes the errors for motion"


def test_slip_that_grows_with_the_size_of_a_speed_is_a_feature():
    s, speeds, v = driving(slip=0.3, noise=0.001)
    one_step = Regression(ROBOT, features_for(ROBOT, v, 2, 0), s).fit(Candidate(2, 0, 3.0, False))
    off = one_step.features(np.hstack([speeds[:-1], v[:, R:]])) @ one_step.C[list(ROBOT.regressor)].T - speeds[1:]
    assert np.quantile(np.abs(off[:, 0]), 0.99) < 0.005
    assert np.count_nonzero(one_step.C[ROBOT.regressor[0]]) <= 8
