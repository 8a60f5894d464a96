"""The rivals with a unicycle by hand: what they let pass, what they adjust, and when they brake."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from brakeline.deploy.data.rival_pretraining import BarrierConfig, PredictiveConfig, config_for, made_by, pretrain
from brakeline.errors import BadModel, BadRequest, UnknownTask
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.task import Rivals, with_task
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE
from brakeline.safety.methods import decode, ready
from brakeline.safety.model.model_config import CBF, PSF
from brakeline.safety.rivals.predictive_filter import PredictiveFilter
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.unicycle_barrier import UnicycleBarrier
from tests.robots import GROUND, QUADROTOR
from tests.safety.asked import cylinder, request

BARRIER = UnicycleBarrier(Pretrained(GROUND, CBF, {}, asdict(BarrierConfig(0.05, 1.0, 0.0))))
PREDICTIVE = PredictiveFilter(Pretrained(GROUND, PSF, {}, asdict(PredictiveConfig(lag=0.05, margin=0.01))))
SOFT = PredictiveFilter(Pretrained(GROUND, PSF, {}, asdict(PredictiveConfig(lag=0.05, margin=0.01, soft=1.0))))
FAST = np.array([0.25, 0.0])  # the proposal by default


def wall(x: float) -> Obstacle:
    return Obstacle("wall", (x, 0.0), (), yaw=np.pi)


@pytest.mark.parametrize("method", [BARRIER, PREDICTIVE])
def test_free_driving_passes(method):
    for decision in (method.decide(request()), method.decide(request(obstacles=[cylinder(2.0, 0.0)]))):
        assert decision.kind == ALLOWED and not decision.verified
        assert decision.plan.tolist() == [[0.25, 0.0], [0.0, 0.0], [0.0, 0.0]]


@pytest.mark.parametrize("method", [BARRIER, PREDICTIVE])
@pytest.mark.parametrize("obstacle", [cylinder(0.24, 0.0), Obstacle("box", (0.24, 0.0), (0.2, 0.2)), wall(0.14)])
def test_a_proposal_at_an_obstacle_is_adjusted_whatever_its_shape(method, obstacle):
    """The surface is 0.14 m ahead of the centre of a body of 0.105 m."""
    decision = method.decide(request(obstacles=[obstacle], state=(0.0, 0.0, 0.0, 0.25, 0.0)))
    assert decision.kind in (ADJUSTED, FAILSAFE) and decision.plan[0, 0] < 0.2 and decision.reason


def test_the_barrier_keeps_its_row_at_an_obstacle():
    near = BARRIER.decide(request(obstacles=[cylinder(0.4, 0.0)]))
    h = 0.4 - 0.05 - 0.1 - 0.105 - 0.05
    assert near.kind == ADJUSTED and near.plan[0] == pytest.approx([h, 0.0], abs=1e-6)  # v <= α h
    assert BARRIER.decide(request(obstacles=[cylinder(0.2, 0.0)])).kind == FAILSAFE  # too near: only backwards would do


def test_the_predictive_filter_predicts_the_motion_with_its_lag():
    """Against fine Euler steps of the same equations."""
    plans = np.array([[[0.25, 0.5], [0.1, -0.5], [0.0, 0.0]]])
    state, tau, fine = np.array([0.3, -0.2, 0.7, 0.1, -0.3]), 0.05, 2000
    place, heading, speeds = state[:2].copy(), state[2], state[3:].copy()
    for k in range(3):
        for _ in range(fine):
            place += 0.2 / fine * speeds[0] * np.array([np.cos(heading), np.sin(heading)])
            heading += 0.2 / fine * speeds[1]
            speeds += 0.2 / fine * (plans[0, k] - speeds) / tau
    predicted = PREDICTIVE.positions(state, plans)[0]
    assert predicted.shape == (12, 2) and predicted[-1] == pytest.approx(place, abs=1e-4)


def test_the_predictive_filter_finds_the_closest_clear_plan():
    """Straight at a wall, the fastest input that stops before it; a grid of inputs finds none that is closer."""
    ask = request(obstacles=[wall(0.14)], state=(0.0, 0.0, 0.0, 0.1, 0.0))
    decision = PREDICTIVE.decide(ask)
    assert decision.kind == ADJUSTED and -1e-4 <= decision.margin < 1e-3 and not decision.plan[-1].any()
    away = np.linalg.norm((decision.plan[0] - FAST) / [0.25, 1.0])
    for speed in np.linspace(0.0, 0.25, 26):
        for turn in np.linspace(-0.5, 0.5, 11):
            plan = np.array([[speed, turn], [0.0, 0.0], [0.0, 0.0]])
            clear = PREDICTIVE._room(ask, plan, 0.01) >= 0.0
            assert not clear or np.linalg.norm((plan[0] - FAST) / [0.25, 1.0]) >= away - 1e-2


def test_the_predictive_filter_goes_on_with_its_last_plan_where_it_finds_none():
    last = np.array([[0.05, 0.1], [0.02, 0.0], [0.0, 0.0]])
    decision = PREDICTIVE.decide(request(obstacles=[cylinder(0.2, 0.0)], state=(0.0, 0.0, 0.0, 0.25, 0.0), plan=last))
    assert decision.kind == FAILSAFE and np.array_equal(decision.plan, last) and "last one" in decision.reason


@pytest.mark.parametrize(("wanted", "kind"), [((0.0, 0.5), ALLOWED), ((-0.1, 0.0), ALLOWED), ((0.25, 0.0), ADJUSTED)])
def test_a_robot_that_stands_inside_a_soft_margin_may_turn_and_drive_away(wanted, kind):
    """With a hard margin, it has no plan until its episode ends."""
    inside = request(obstacles=[wall(0.105 + 0.01 - 0.001)], action=wanted)
    decision = SOFT.decide(inside)
    assert decision.kind == kind and decision.plan[0, 0] <= 1e-4
    assert PREDICTIVE.decide(inside).kind == FAILSAFE


@pytest.mark.parametrize("soft", [-0.1, 1.1, np.nan])
def test_a_softness_outside_0_to_1_is_refused(soft):
    """Above 1, each plan could come nearer than the last one."""
    with pytest.raises(BadModel, match="soft is"):
        PredictiveFilter(replace(SOFT.model, settings=SOFT.model.settings | {"soft": soft}))


@pytest.mark.parametrize("method", [BARRIER, PREDICTIVE])
def test_what_they_cannot_decide_is_refused_or_braked(method):
    assert method.decide(request(action=(np.nan, 0.0))).kind == FAILSAFE
    broken = Shapes.of([cylinder(0.4, 0.0)], 2)
    for name in ("center", "rho", "margin"):
        wrong = replace(broken, **{name: getattr(broken, name) * np.nan})
        with pytest.raises(BadRequest, match="NaN or infinity"):
            method.decide(replace(request(), obstacles=wrong))
    with pytest.raises(BadRequest, match="nothing is known"):
        method.decide(replace(request(), known_free=False))
    with pytest.raises(BadModel, match=r"without (lag|ahead)"):
        type(method)(replace(method.model, settings={"margin": 0.0, "rate": 1.0}))
    with pytest.raises(BadModel, match="speed and turn rate"):
        type(method)(replace(method.model, robot=replace(GROUND, action_slew=(0.1, 0.1), late=True)))


def test_a_setting_of_a_task_that_a_rival_lacks_is_refused():
    task = replace(GROUND.task, rivals=Rivals(cbf={"ratte": 2.0}))
    with pytest.raises(UnknownTask, match=r"rivals\.cbf .*no setting ratte, but ahead, rate"):
        config_for(CBF, with_task(GROUND, task))


@pytest.mark.parametrize("robot", [GROUND, QUADROTOR], ids=lambda robot: robot.name)
@pytest.mark.parametrize("name", [CBF, PSF])
def test_their_models_hold_settings_and_cost_no_recording(name, robot):
    config = config_for(name, robot)
    model = pretrain(robot, config)
    assert made_by(model, robot, config) and not made_by(model, robot, replace(config, margin=0.5))
    assert (model.about["samples"], model.about["collisions"], dict(model.networks)) == ("0", "0", {})
    again = decode(model.encode())
    assert again.version == model.version and ready(again).settings == ready(model).settings
