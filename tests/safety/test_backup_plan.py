"""What is left when nothing new can be verified: the committed plan, and who vouches for it."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.safety.filter.backup_plan import UNVERIFIED, BackupPlan, Prediction
from brakeline.safety.filter.filter import _Record
from brakeline.safety.filter.request import ALLOWED, FAILSAFE
from tests.robots import GROUND
from tests.safety.asked import STILL, cylinder, request


def moving(tail=((0, 0), (0, 0), (0, 0)), x=0.215, **more):
    """At full speed before an obstacle so near that only the committed plan is left."""
    more = {"input_in_force": np.array([0.25, 0.0]), "plan": np.array(tail, float)} | more
    return request((0, 0, 0, 0.25, 0.0), (0.25, 0.0), [cylinder(x, 0)], **more)


def test_failsafe_is_the_committed_plans_next_input(ready):
    tail = ((0.0, 0.1), (0, 0), (0, 0))
    decision = ready.decide(moving(tail, model=ready.version))
    assert decision.kind == FAILSAFE
    assert decision.verified
    assert np.array_equal(decision.plan, tail)
    assert decision.margin < 0.0
    assert "no verified input" in decision.reason


def test_a_plan_that_nobody_vouches_for_is_not_called_verified(ready):
    """No model's version although something moves; a plan marked as unverified; a prediction that did not hold."""
    tail = ((0.2, 0.0), (0, 0), (0, 0))
    wrong = Prediction(np.full(5, 3.0), np.full(5, 0.01), 0.0)
    for more in (
        {"model": ""},
        {"model": UNVERIFIED},
        {"model": "0123456789ab"},
        {"model": ready.version, "predicted": wrong},
        {"model": "", "plan": STILL},
    ):
        decision = ready.decide(moving(tail, **more) if "plan" not in more else moving(**more))
        assert decision.kind == FAILSAFE
        assert not decision.verified
        assert not decision.plan.any(), "brake"
        assert decision.contained == ("predicted" not in more)
    assert not ready.decide(moving(model="", plan=STILL)).verified


@pytest.mark.parametrize("version", ["0123456789ab", UNVERIFIED])
def test_an_older_models_tail_is_verified_anew(ready, version):
    """Where there is room for it; but a tube from outside the recorded domain verifies nothing."""
    for x, in_domain, verified in ((0.6, True, True), (0.6, False, False), (0.215, True, False)):
        ask = moving(((0.1, 0.2), (0, 0), (0, 0)), x, model=version)
        z_0 = np.concatenate([ask.state[3:], ask.input_in_force])
        found = ready._committed(
            ask, ready.constraints.local_map(ask, z_0, ready.builder.reachable(z_0[-2:])), z_0, _Record(0), in_domain
        )
        assert found.verified == verified
        assert np.array_equal(found.plan, ask.plan if verified else STILL)


def test_outside_the_recorded_domain_nothing_new_is_verified(ready):
    ask = request((0, 0, 0, 0.6, 0.0), (0.1, 0.0), input_in_force=np.array([0.25, 0.0]))
    decision = ready.decide(replace(ask, model="0123456789ab"))
    assert decision.kind == FAILSAFE
    assert not decision.verified
    assert "domain" in decision.reason
    trusted = ready.decide(replace(ask, model=ready.version))
    assert trusted.kind == FAILSAFE
    assert trusted.verified, "the plan was verified when it was made"


def test_after_a_violation_the_proposal_may_still_be_verified_from_the_new_measurement(ready):
    wrong = Prediction(np.full(5, 3.0), np.full(5, 0.01), 0.0)
    decision = ready.decide(request(predicted=wrong))
    assert decision.kind == ALLOWED
    assert decision.compared
    assert not decision.contained


def test_standing_still_needs_no_token(ready):
    decision = ready.decide(request(obstacles=[cylinder(0.2, 0)]))
    assert decision.kind == FAILSAFE
    assert decision.verified
    assert not decision.plan.any()


def test_what_was_not_verified_stays_so_until_the_robot_stands():
    kept = BackupPlan(GROUND)
    assert kept.model == ""
    kept.accept(np.array([[0.2, 0.1], [0, 0], [0, 0]]), "v1", None, True)
    assert kept.model == "v1"
    assert np.array_equal(kept.input_in_force, [0.2, 0.1])
    kept.fallback()
    assert kept.model == "", "it stands on a verified plan"
    kept.accept(np.array([[0.2, 0.1], [0, 0], [0, 0]]), "v1", None, True)
    kept.accept(STILL, "v1", None, False)
    assert kept.model == UNVERIFIED
    kept.accept(STILL, "v1", None, False)
    assert kept.model == UNVERIFIED
    kept.fallback()
    assert kept.model == "", "it has stood for a whole plan"
    kept.accept(STILL, "v1", None, False)
    kept.accept(np.array([[0.2, 0.1], [0, 0], [0, 0]]), "v2", None, True)
    assert kept.model == "v2"
    kept.reset()
    assert (kept.model, kept.predicted) == ("", None)


def test_predictions_are_boxes_in_their_own_frame():
    box = Prediction(np.array([1.0, 2.0, 3.1, 0.1, 0.0]), np.array([0.2, 0.01, 0.1, 0.1, 0.1]), np.pi / 2)
    assert box.contains(GROUND, np.array([1.0, 2.15, -3.1, 0.1, 0.0]))  # the heading wraps
    assert not box.contains(GROUND, np.array([1.15, 2.0, 3.1, 0.1, 0.0]))
    assert not box.contains(GROUND, np.array([1.0, 2.0, 3.1, 0.3, 0.0]))
    assert not box.contains(GROUND, np.array([np.nan, 2.0, 3.1, 0.1, 0.0]))


def test_a_prediction_that_did_not_hold_is_not_forgotten_because_nobody_answered(ready):
    """A robot that slid out of its set while the service was away has no verified plan any more."""
    driven = Prediction(np.array([0.05, 0.0, 0.0, 0.25, 0.0]), np.full(5, 0.01), 0.0)
    tail = np.array(((0.2, 0.0), (0, 0), (0, 0)), float)
    for x, model in ((0.05, ready.version), (0.2, UNVERIFIED)):
        kept = BackupPlan(GROUND)
        kept.accept(np.vstack([[0.25, 0.0], tail[:-1]]), ready.version, driven, True, (b"word",) * 3)
        kept.measured(np.array([x, 0.0, 0.0, 0.25, 0.0]))
        kept.fallback()
        assert kept.model == model and bool(kept.plan_token) == (model == ready.version)
    kept = BackupPlan(GROUND)
    kept.accept(np.vstack([[0.25, 0.0], tail[:-1]]), ready.version, driven, True)
    kept.fallback()  # nothing was measured where the prediction speaks of it
    assert kept.model == ready.version


@pytest.mark.parametrize("bad", [np.full(5, np.nan), np.zeros(4), np.array([0.0, 0.0, np.inf, 0.0, 0.0])])
def test_what_is_no_state_is_not_kept(bad):
    kept = BackupPlan(GROUND)
    kept.measured(np.arange(5.0))
    kept.measured(bad)
    assert np.array_equal(kept.seen, np.arange(5.0))
