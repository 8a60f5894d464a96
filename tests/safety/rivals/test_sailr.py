"""SAILR alone: it intervenes at known advantages, and executes the backup policy instead."""

import numpy as np
import pytest

from brakeline.errors import BadModel, BadRequest
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.perceptrons import Perceptrons
from brakeline.safety.filter.backup_plan import brake
from brakeline.safety.filter.request import NOT_FINITE, Request
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.sailr import Sailr
from tests.robots import GROUND, QUADROTOR

STEEP = 3.0


def logit(p: float) -> float:
    return float(np.log(p / (1.0 - p)))


EVEN = (logit(0.1), logit(0.1))


def linear(inputs: int, slopes: dict[int, float], offsets: tuple[float, float]) -> Perceptrons:
    """Two networks: offset_i + Σ slope · input."""
    weight = np.zeros((2, 1, inputs), np.float32)
    for column, slope in slopes.items():
        weight[:, 0, column] = slope
    return Perceptrons([(weight, np.array(offsets, np.float32)[:, None])])


def known(threshold=0.1, q=(0.0, 0.0), v=EVEN, robot=GROUND) -> Pretrained:
    """logit Q = q + STEEP · (first input, normalised); V is the same everywhere."""
    seen, m = robot.task.observation_dim, robot.action_dim
    networks = {"q": linear(seen + m, {seen: STEEP}, q), "v": linear(seen, {}, v)}
    return Pretrained(robot, "sailr", networks, {"threshold": threshold})


def request(action, before=(0.0, 0.0), robot=GROUND, observation=None, state=None) -> Request:
    return Request(
        state=np.zeros(robot.state_dim) if state is None else np.array(state, float),
        action=np.array(action, float),
        input_in_force=np.array(before, float),
        plan=np.zeros((robot.horizon, robot.action_dim)),
        obstacles=Shapes.of([], robot.position_dim),
        observation=np.zeros(robot.task.observation_dim, np.float32) if observation is None else observation,
    )


@pytest.mark.parametrize("threshold", [0.02, 0.1, 0.4, 0.8])
def test_sailr_intervenes_exactly_where_the_advantage_is_above_the_threshold(threshold):
    ready = Sailr(known(threshold))
    for speed in np.linspace(0.0, 0.25, 41):
        cost = 1.0 / (1.0 + np.exp(-STEEP * (speed / 0.125 - 1.0)))
        advantage = ready.advantage(np.zeros(26, np.float32), np.array([speed, 0.2]))
        assert advantage == pytest.approx(cost - 0.1, abs=1e-5)
        decision = ready.decide(request((speed, 0.2), (0.2, 0.1)))
        intervened = decision.kind == "failsafe"
        assert intervened == (advantage > threshold) and ("above" in decision.reason) == intervened
        assert np.allclose(decision.plan[0], (0.0, 0.0) if intervened else (speed, 0.2))


def test_the_larger_q_and_the_smaller_v_count_for_the_proposal_within_its_bounds():
    even = Sailr(known(q=(0.0, 0.0), v=(0.0, 0.0))).advantage(np.zeros(26, np.float32), np.array([0.125, 0.0]))
    assert even == pytest.approx(0.0, abs=1e-6)
    for q, v in (((logit(0.7), -2.0), (0.0, 0.0)), ((-2.0, logit(0.7)), (0.0, 0.0))):
        assert Sailr(known(q=q, v=v)).advantage(np.zeros(26), np.array([0.125, 0.0])) == pytest.approx(0.2, abs=1e-5)
    for v in ((logit(0.2), 0.0), (0.0, logit(0.2))):
        assert Sailr(known(v=v)).advantage(np.zeros(26), np.array([0.125, 0.0])) == pytest.approx(0.3, abs=1e-5)
    doomed = Sailr(known(threshold=0.1, q=(logit(0.95),) * 2, v=(logit(0.94),) * 2))
    assert doomed.decide(request((0.125, 0.0))).kind == "allowed", "braking does not help either"
    decision = Sailr(known(threshold=0.95)).decide(request((99.0, -99.0)))
    assert decision.kind == "allowed" and np.allclose(decision.plan[0], (0.25, -0.5)), "clipped to its bounds"


@pytest.mark.parametrize("before", [(0.0, 0.0, 0.0), QUADROTOR.low(), QUADROTOR.high(), (0.3, 0.0, -0.9)])
def test_the_backup_brakes_as_fast_as_the_slew_allows(before):
    robot, before = QUADROTOR, np.array(before)
    ready = Sailr(known(threshold=0.1, q=(9.0, 9.0), robot=robot))
    decision = ready.decide(request((5.0, 5.0, 5.0), before, robot))
    assert decision.kind == "failsafe"
    assert np.allclose(decision.plan[0], np.sign(before) * np.maximum(np.abs(before) - 0.8, 0.0))
    assert np.allclose(decision.plan[0], brake(robot, before))
    plan = np.vstack([before, decision.plan])
    assert (np.abs(np.diff(plan, axis=0)) <= 0.8 + 1e-9).all() and not decision.plan[-1].any()


def test_a_proposal_that_is_not_finite_brakes():
    before = np.array([2.0, 0.0, -1.0])
    decision = Sailr(known(robot=QUADROTOR)).decide(request((0.0, np.nan, 0.0), before, QUADROTOR))
    assert (decision.kind, decision.reason, decision.verified) == ("failsafe", NOT_FINITE, False)
    assert np.allclose(decision.plan[0], brake(QUADROTOR, before)) and not decision.plan[-1].any()


@pytest.mark.filterwarnings("ignore:.*encountered in matmul:RuntimeWarning")
@pytest.mark.parametrize("network", ["q", "v"])
def test_an_advantage_that_is_not_a_number_brakes(network):
    model = known(threshold=0.9)
    inputs = model.networks[network].inputs
    broken = Pretrained(
        GROUND, "sailr", model.networks | {network: linear(inputs, {0: 9.0, 1: -9.0}, EVEN)}, model.settings
    )
    seen = np.full(GROUND.task.observation_dim, 3e38, np.float32)
    decision = Sailr(broken).decide(request((0.25, 0.0), observation=seen))
    assert decision.kind == "failsafe" and not decision.plan.any() and "not a number" in decision.reason


def test_a_request_without_an_observation_is_refused():
    with pytest.raises(BadRequest) as refused:
        Sailr(known()).decide(request((0.1, 0.0), observation=np.zeros(0, np.float32)))
    assert refused.value.field == "observation"


def test_a_model_of_another_shape_or_method_is_refused():
    good = known()
    for wrong in (
        Pretrained(GROUND, "secas", good.networks, good.settings),
        Pretrained(GROUND, "sailr", {"q": good.networks["q"]}, good.settings),
        Pretrained(GROUND, "sailr", {"q": good.networks["v"], "v": good.networks["q"]}, good.settings),
        Pretrained(GROUND, "sailr", good.networks, {}),
    ):
        with pytest.raises(BadModel):
            Sailr(wrong)
