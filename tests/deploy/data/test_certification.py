"""A model set that is widened until it holds what it was not made from."""

import numpy as np
import pytest

from brakeline.deploy.data.certification import certify
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.model.validation import upper_bound, validate
from tests.safety.unicycle import record


@pytest.fixture(scope="module")
def data():
    """Few plans of a robot, so that its envelopes are exceeded now and then."""
    return record(trajectories=20, periods=150, seed=4)


@pytest.mark.parametrize("kind", ["residual", "set-membership"])
def test_it_is_as_wide_as_the_worst_of_the_held_out_plans_asks_for(data, kind):
    model_config = ModelConfig(kind, inflation=1.0)
    narrow, before = certify(data, model_config)
    assert before.violations > 0 and before.excess > 1.0
    wide, after = certify(data, model_config, until_held=True)
    assert after.violations == 0 and 0.9 < after.excess <= 1.0, "and no wider"
    assert wide.model_config.inflation > 1.0 and wide.version != narrow.version
    assert after.bound_plan == upper_bound(0, after.windows) < before.bound_plan
    assert after.half_width_full > before.half_width_full


def test_what_holds_already_stays_as_it_is(data):
    model_config = ModelConfig(inflation=4.0)
    assert certify(data, model_config, until_held=True)[0].version == certify(data, model_config)[0].version


def test_what_comes_later_is_outside_no_more_often_than_is_stated(data):
    """Drawn like the plans that it was widened by."""
    model, statement = certify(data, ModelConfig(inflation=1.0), until_held=True)
    found = [validate(model, data, record(trajectories=6, periods=150, seed=seed)) for seed in range(20, 26)]
    outside, plans = sum(one.violations for one in found), sum(one.windows for one in found)
    assert plans > 300 and outside / plans < statement.bound_plan
    assert np.isclose(max(one.excess for one in found) > 1.0, outside > 0)
