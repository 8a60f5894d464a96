"""A model set whose stated bound exceeds the robot's limit is refused everywhere, unless the user accepts it."""

import dataclasses
import math

import gymnasium
import numpy as np
import pytest

from brakeline.errors import TooLoose
from brakeline.logs.decision_explanation import bound_in, explain
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.stated_share import describe_verification, percent, rounded_up
from brakeline.safety.action_mapping import normalised
from brakeline.safety.filter.filter import Filter
from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.gym_vector import VectorSafetyWrapper
from brakeline.safety.model.stated_bound import accepted_bound, check_bound, plans_needed, refusal, stated_bound
from brakeline.safety.service.in_process import InProcess
from brakeline.safety.service.server import ModelRegistry
from brakeline.safety.service.wire import decision_of, decision_reply
from tests.robots import GROUND
from tests.safety.asked import request
from tests.safety.rivals.test_sailr import known as rival
from tests.safety.served import Service, ServiceClient

FLOWN = {"bound_plan": "0.2613", "windows": "15", "violations": "0", "minutes": "15"}
TIGHT = {"bound_plan": "0.0042", "windows": "1981", "violations": "2", "minutes": "200"}
LAX = dataclasses.replace(GROUND, accept_bound=0.3)


def message():
    """Return a request at rest, with nothing near."""
    sizes = {"state": [0.0] * 5, "action": [0.1, 0.0], "input_in_force": [0.0] * 2, "plan": [0.0] * 6}
    return pb.Request(robot="ground", actor="a", known_free=True, **sizes)


def said(model, about):
    return dataclasses.replace(model, about=about)


@pytest.mark.parametrize(
    "about",
    [{}, *({"bound_plan": word} for word in ("nan", "-0.1", "1.5", "inf", "-inf", "many", "", None, [0.001]))],
    ids=str,
)
def test_a_malformed_statement_counts_as_no_bound(about, model):
    assert stated_bound(about) == 1.0
    with pytest.raises(TooLoose):
        check_bound(said(model, about), LAX)
    with pytest.raises(TooLoose):
        check_bound(said(model, about), GROUND, 0.99)
    check_bound(said(model, about), GROUND, 1.0)


def test_the_limit_is_the_robots_own_unless_more_is_accepted(model):
    loose, tight = said(model, FLOWN), said(model, TIGHT)
    check_bound(tight, GROUND)
    check_bound(loose, LAX)
    check_bound(loose, GROUND, 0.27)
    check_bound(rival(0.3), GROUND)  # a rival states none
    for robot, accepted in ((GROUND, None), (GROUND, 0.26), (LAX, 0.2)):
        with pytest.raises(TooLoose):
            check_bound(loose, robot, accepted)
    with pytest.raises(TooLoose, match=r"0\.42 %"):
        check_bound(tight, GROUND, 0.001)
    for share in (0.0, -0.1, 1.1, math.nan, math.inf):
        with pytest.raises(ValueError, match="above 0"):
            accepted_bound(GROUND, share)


def test_a_refusal_says_the_bound_the_limit_and_what_to_do():
    why = refusal(GROUND, FLOWN)
    assert "at most 27 %" in why and "99 % confidence" in why and "limit of ground is 1 %" in why
    assert "Record 444 more minutes" in why, "459 held-out plans instead of 15"
    assert "--accept-bound 0.27" in why and not refusal(GROUND, FLOWN, 0.27)
    left = refusal(GROUND, FLOWN | {"violations": "3"})
    assert "3 of 15 held-out plans left their tubes" in left and "more minutes" not in left
    assert "no statement" in refusal(GROUND, {}) and "certify" in refusal(GROUND, {})


def test_a_suggested_bound_is_accepted_and_a_shown_one_is_rounded_up():
    for bound in (*np.random.default_rng(0).random(200), 0.01, 0.07, 0.29, 0.58, 1e-5, 1.0):
        assert bound <= rounded_up(bound) <= min(1.1 * bound, 1.0)
        assert float(f"{rounded_up(bound):g}") >= bound
    assert [percent(bound) for bound in (0.01, 0.0113, 0.2613)] == ["1 %", "1.2 %", "27 %"]
    assert 0.0 < rounded_up(2e-311) < 1e-299, "a reply may hold any number"
    assert plans_needed(0.01) == 459


def test_every_use_in_process_refuses_a_loose_model_set(model, tmp_path):
    loose = said(model, FLOWN)
    loose.save(tmp_path / "model.safetensors")
    for use in (
        lambda **how: InProcess(Filter(loose), **how),
        lambda **how: ModelRegistry(**how).install(loose),
        lambda **how: ModelRegistry(limits={"ground": 0.2}, **how).install(loose),
    ):
        with pytest.raises(TooLoose, match=r"accept-bound 0\.27"):
            use()
        use(accept_bound=0.27)
    ModelRegistry(limits={"ground": 0.3}).install(loose)
    registry = ModelRegistry()
    registry.install(said(model, TIGHT))
    in_use = registry.filters["ground"]
    with pytest.raises(TooLoose):
        registry.install(loose)
    assert registry.filters["ground"] is in_use, "the service goes on with its model set"
    for wrap, env in (
        (SafetyWrapper, Nothing()),
        (VectorSafetyWrapper, gymnasium.vector.SyncVectorEnv([Nothing])),
    ):
        with pytest.raises(TooLoose):
            wrap(env, Filter(loose))
    with pytest.raises(TooLoose):
        SafetyWrapper.load(Nothing(), tmp_path / "model.safetensors")
    with pytest.raises(TooLoose):
        InProcess(Filter(said(model, {})))


class Nothing(gymnasium.Env):
    """An environment where nothing happens."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(2), {"state": np.zeros(5), "obstacles": []}


def test_a_wrapper_with_a_client_keeps_the_limit_that_it_was_given(model):
    loose, free = said(model, FLOWN), normalised(GROUND)
    client = InProcess(Filter(loose), accept_bound=1.0)
    SafetyWrapper(Nothing(), client, actions=free), SafetyWrapper(Nothing(), client, actions=free, accept_bound=0.27)
    with pytest.raises(TooLoose, match=r"accept-bound 0\.27"):
        SafetyWrapper(Nothing(), client, actions=free, accept_bound=0.01)
    served = SafetyWrapper(Nothing(), ServiceClient(loose), actions=free, accept_bound=0.01)
    served.reset()
    for _ in range(2):  # a second step names no other environment
        with pytest.raises(TooLoose, match=r"at most 27 % .* accept_bound is 1 %"):
            served.step(np.zeros(2))
    for bad in (-1.0, 0.0, 7.0, math.nan):
        for one in (client, ServiceClient(loose)):
            with pytest.raises(ValueError, match="share above 0"):
                SafetyWrapper(Nothing(), one, actions=free, accept_bound=bad)


def test_every_decision_carries_the_bound_but_that_of_an_old_log_or_of_a_rival(model):
    for about, bound in ((TIGHT, 0.0042), ({}, 1.0), ({"bound_plan": "nan"}, 1.0)):
        decision = Service(said(model, about)).decision(message())
        assert bound_in(decision) == bound
        assert decision_of(decision, GROUND).bound == bound
    old = decision_reply(dataclasses.replace(Filter(model).decide(request()), bound=None), 0.0).decision
    assert not old.HasField("bound") and decision_of(old, GROUND).bound is None
    old.bound = math.nan
    assert decision_of(old, GROUND).bound == 1.0, "NaN counts as no bound"


def test_verified_is_described_with_its_bound(model):
    words = "verified; at most 1.2 % of such plans leave their tube, at 99 % confidence"
    assert describe_verification(True, 0.0113) == words
    assert describe_verification(False, 0.001) == "not verified"
    assert "no bound" in describe_verification(True, None) and "states no bound" in describe_verification(True, 1.0)
    question = message()
    decision = pb.Decision(kind=pb.ALLOWED, verified=True, plan=[0.0] * 6, bound=0.26)
    assert "at most 26 %" in explain(GROUND, question, decision).trust
    decision.kind, decision.reason = pb.FAILSAFE, "the proposal's tube comes too near"
    about = explain(GROUND, question, decision)
    assert "verified before (at most 26 % of such plans leave their tube)" in about.sentence and not about.trust
