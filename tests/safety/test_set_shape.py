"""How the half-widths of a rollout's sets follow from the errors of recorded windows."""

import numpy as np
import pytest

from brakeline.safety.model.driving_kinds import JUMPING, START
from brakeline.safety.model.set_factors import SetFactors
from brakeline.safety.model.set_shape import Shape, spread_features
from tests.safety.test_turning_in_place import ROBOT

N, KNOWN, M = ROBOT.horizon, ROBOT.regressor_dim, ROBOT.action_dim


def windows(count, seed=0):
    return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, KNOWN + N * M))


def test_a_steady_ramp_does_not_jump_beyond_its_first_change():
    ramp = np.arange(N + 1.0)[:, None] * np.ones(M)
    z = np.concatenate([np.zeros(KNOWN - M), ramp.ravel()])[None]
    assert spread_features(ROBOT, z)[-1, 0, -M:] == pytest.approx(np.full(M, 1.0 / N))


def test_the_error_bounds_of_a_shape_have_its_half_widths():
    z, rng = windows(50), np.random.default_rng(1)
    shape = Shape(rng.uniform(0.0, 1.0, (N, 2, KNOWN + 2 * M)), rng.uniform(0.0, 1.0, (N, 2)))
    for k in range(1, N + 1):
        bound = shape.bound(ROBOT, k, slice(2), np.array([1.0, 3.0]))
        assert bound.half_widths(z) == pytest.approx(shape.widths(ROBOT, z)[:, k - 1] * [1.0, 3.0])


def test_a_window_in_a_thousand_does_not_decide_about_the_shape():
    z, errors = windows(2000), np.random.default_rng(2).uniform(-1.0, 1.0, (2000, N, 1))
    wild = errors.copy()
    wild[[7, 1400]] *= 50.0
    tight, loose = Shape.around(ROBOT, z, wild, outside=0.001), Shape.around(ROBOT, z, wild)
    assert sorted(np.flatnonzero(tight.scores(ROBOT, z, wild) > 1.0)) == [7, 1400]
    assert (loose.scores(ROBOT, z, wild) <= 1.0 + 1e-9).all()
    assert tight.widths(ROBOT, z).mean() < 0.3 * loose.widths(ROBOT, z).mean()


def test_each_kind_of_driving_has_its_share_outside_and_only_starts_have_a_factor_of_their_own():
    plan = np.concatenate([np.full(3000, 0.5), np.full(100, 2.0), np.full(30, 3.0)])
    first = np.full(len(plan), 0.9)
    first[-1] = 1.2
    at = np.arange(len(plan))
    kinds = {START: at >= 3100, "rare": (at >= 3000) & (at < 3100), JUMPING: at == 7}
    factors = SetFactors.of(plan, first, kinds, 0.001)
    assert (factors.plan, factors.first, factors.start) == (2.0, 1.0, 1.5)
    assert factors.shares(plan, first, kinds).max() == 1.0
    assert SetFactors.of(plan, first, kinds, 0.05).plan == 2.0  # of the hundred rare ones, five may be outside


def test_inputs_that_jump_widen_the_set_of_the_next_state_but_not_those_of_plans():
    plan, first = np.full(3000, 0.5), np.full(3000, 0.9)
    plan[7] = first[7] = 4.0
    at = np.arange(3000)
    factors = SetFactors.of(plan, first, {START: at < 3, JUMPING: at == 7}, 0.001)
    assert (factors.plan, factors.first, factors.start) == (1.0, 4.0, 1.0)
