"""The rivals with a velocity by hand: what they let pass and adjust, and that by their equations they touch nothing."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from brakeline.deploy.data.rival_pretraining import PredictiveConfig, VelocityBarrierConfig, config_for, pretrain
from brakeline.errors import BadModel
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, Request
from brakeline.safety.methods import decode, ready
from brakeline.safety.model.model_config import CBF, PSF
from brakeline.safety.rivals.predictive_filter import PredictiveFilter
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.velocity_barrier import VelocityBarrier
from tests.robots import GROUND, QUADROTOR

CONFIG = VelocityBarrierConfig(lag=0.35, deceleration=3.0, rate=2.0, margin=0.3)
BARRIER = VelocityBarrier(Pretrained(QUADROTOR, CBF, {}, asdict(CONFIG)))
PREDICTIVE = PredictiveFilter(Pretrained(QUADROTOR, PSF, {}, asdict(PredictiveConfig(lag=0.35, margin=0.1))))
BODY, LAG, SLEW, PERIOD = 0.3, 0.35, 0.8, QUADROTOR.period
FINE = 400  # steps of a period, for the equations


def asked(velocity=(0.0, 0.0, 0.0), proposal=(1.0, 0.0, 0.0), before=None, obstacles=()) -> Request:
    velocity = np.array(velocity)
    before = velocity if before is None else np.array(before)
    state = np.concatenate([np.zeros(3), velocity, np.zeros(3)])
    plan = np.zeros((QUADROTOR.horizon, 3))
    return Request(state, np.array(proposal), before, plan, Shapes.of(list(obstacles), dim=3), known_free=True)


def ball(x: float, y: float = 0.0, z: float = 0.0, radius: float = 1.0) -> Obstacle:
    return Obstacle("sphere", (x, y, z), (radius,))


def path_of(plan, velocity):
    """Return the path (T, 3) of a plan, by fine Euler steps of the equations, and of six periods of standing."""
    place, path = np.zeros(3), []
    for u in [*plan, *np.zeros((6, 3))]:
        for _ in range(FINE):
            velocity = velocity + PERIOD / FINE * (u - velocity) / LAG
            place = place + PERIOD / FINE * velocity
            path.append(place)
    return np.array(path)


@pytest.mark.parametrize("method", [BARRIER, PREDICTIVE])
def test_free_flight_passes_and_is_not_verified(method):
    for obstacles in ((), [ball(9.0)], [ball(-1.5)]):
        decision = method.decide(asked((1.0, 0.0, 0.0), (1.5, 0.0, 0.0), obstacles=obstacles))
        assert decision.kind == ALLOWED and not decision.verified and decision.plan[0].tolist() == [1.5, 0.0, 0.0]


def test_the_row_of_an_obstacle_holds_at_the_adjusted_input():
    distance, speed = 2.0, 2.0
    near = BARRIER.decide(asked((speed, 0.0, 0.0), (speed + 0.8, 0.0, 0.0), obstacles=[ball(distance + 1.0)]))
    stoppable = np.sqrt(2.0 * 3.0 * (distance - BODY - 0.3))
    h, falls = stoppable - speed, 3.0 * speed / stoppable
    most = speed + 0.35 * (2.0 * h - falls)  # of the velocity's lag: h' = -falls - (u - v) / lag = -2 h
    assert near.kind == ADJUSTED and near.plan[0] == pytest.approx([most, 0.0, 0.0], abs=1e-5)


def test_the_predictive_filter_predicts_the_lag_until_the_vehicle_stands():
    plan, velocity = np.random.default_rng(0).uniform(-2.0, 2.0, (QUADROTOR.horizon, 3)), np.array([1.0, -2.0, 0.5])
    predicted, exact = PREDICTIVE.positions(asked(velocity).state, plan[None])[0], path_of(plan, velocity)
    assert predicted == pytest.approx(exact[FINE // 4 - 1 :: FINE // 4], abs=5e-3)
    assert np.linalg.norm(exact[-1] - exact[-FINE // 4]) < 0.01, "it stands"


def test_the_predictive_filter_avoids_an_obstacle_ahead_within_bounds_and_slew():
    velocity = np.array([3.0, 0.0, 0.0])
    decision = PREDICTIVE.decide(asked(velocity, (3.8, 0.0, 0.0), obstacles=[ball(4.0)]))
    assert decision.kind == ADJUSTED and not decision.verified and not decision.plan[-1].any()
    assert np.abs(np.diff(np.vstack([velocity, decision.plan]), axis=0)).max() <= SLEW + 1e-6
    assert np.abs(decision.plan).max() <= 5.0
    clear = np.linalg.norm(path_of(decision.plan, velocity) - [4.0, 0.0, 0.0], axis=1).min() - 1.0 - BODY
    assert clear >= 0.1 - 0.02, "between the samples, too"


def test_without_an_input_within_the_slew_it_brakes():
    fast = BARRIER.decide(asked((4.0, 0.0, 0.0), (4.0, 0.0, 0.0), obstacles=[ball(1.8)]))
    assert fast.kind == FAILSAFE and fast.plan[0, 0] < 4.0 and "no input" in fast.reason
    assert BARRIER.decide(asked(proposal=(np.nan, 0.0, 0.0))).kind == FAILSAFE


@pytest.mark.parametrize("method", [BARRIER, PREDICTIVE])
def test_by_its_own_equations_it_touches_nothing(method):
    rng, nearest = np.random.default_rng(0), np.inf
    obstacles = [
        ball(3.0),
        ball(-2.5, 2.5),
        ball(0.0, -3.5, 1.0),
        ball(0.0, 1.0, 3.5),
        Obstacle("box", (0, 0, -3.0), (9, 9, 1)),
    ]
    shapes = Shapes.of(obstacles, dim=3)
    for _ in range(10):
        position, velocity, before, goal = np.zeros(3), np.zeros(3), np.zeros(3), rng.uniform(-5.0, 5.0, 3)
        plan = np.zeros((QUADROTOR.horizon, 3))
        for period in range(60):
            goal = rng.uniform(-5.0, 5.0, 3) if period % 8 == 0 else goal
            proposal = np.clip(goal, before - SLEW, before + SLEW)
            state = np.concatenate([position, velocity, np.zeros(3)])
            ask = replace(asked(velocity, proposal, before), state=state, obstacles=shapes, plan=plan)
            plan = method.decide(ask).plan
            before, plan = plan[0], np.vstack([plan[1:], np.zeros((1, 3))])
            for _ in range(20):
                velocity = velocity + 0.01 / LAG * (before - velocity)
                position = position + 0.01 * velocity
            nearest = min(nearest, float(shapes.distance(position).min()) - BODY)
    assert 0.0 < nearest < 0.6, "it comes near, and never touches"


@pytest.mark.parametrize(("name", "method"), [(CBF, VelocityBarrier), (PSF, PredictiveFilter)])
def test_their_models_are_for_vehicles_that_follow_velocities(name, method):
    model = pretrain(QUADROTOR, config_for(name, QUADROTOR))
    assert isinstance(ready(decode(model.encode())), method)
    for wrong in (GROUND if method is VelocityBarrier else replace(GROUND, late=True), replace(QUADROTOR, late=True)):
        with pytest.raises(BadModel, match="velocities"):
            method(replace(model, robot=wrong))
    with pytest.raises(BadModel, match="without lag"):
        method(replace(model, settings={"rate": 1.0, "margin": 0.0, "deceleration": 3.0}))
