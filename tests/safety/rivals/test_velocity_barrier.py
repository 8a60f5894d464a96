"""The barrier function in the air: what it lets pass and adjusts, and that its own equations never touch anything."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from brakeline.deploy.data.rival_pretraining import VelocityBarrierConfig, config_for, made_by, pretrain
from brakeline.errors import BadModel
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, Request
from brakeline.safety.methods import decode, ready
from brakeline.safety.model.model_config import CBF
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.velocity_barrier import VelocityBarrier
from tests.robots import GROUND, QUADROTOR

CONFIG = VelocityBarrierConfig(lag=0.35, deceleration=3.0, rate=2.0, margin=0.3)
BARRIER = VelocityBarrier(Pretrained(QUADROTOR, CBF, {}, asdict(CONFIG)))
BODY = 0.3  # m


def asked(velocity=(0.0, 0.0, 0.0), proposal=(1.0, 0.0, 0.0), before=None, obstacles=()) -> Request:
    velocity = np.array(velocity)
    before = velocity if before is None else np.array(before)
    state = np.concatenate([np.zeros(3), velocity, np.zeros(3)])
    plan = np.zeros((QUADROTOR.horizon, 3))
    return Request(state, np.array(proposal), before, plan, Shapes.of(list(obstacles), dim=3), known_free=True)


def ball(x: float, y: float = 0.0, z: float = 0.0, radius: float = 1.0) -> Obstacle:
    return Obstacle("sphere", (x, y, z), (radius,))


def test_free_flight_passes_and_is_not_verified():
    for obstacles in ((), [ball(9.0)], [ball(-1.5)]):
        decision = BARRIER.decide(asked((1.0, 0.0, 0.0), (1.5, 0.0, 0.0), obstacles=obstacles))
        assert decision.kind == ALLOWED and not decision.verified and decision.plan[0].tolist() == [1.5, 0.0, 0.0]


def test_the_row_of_an_obstacle_holds_at_the_adjusted_input():
    distance, speed = 2.0, 2.0
    near = BARRIER.decide(asked((speed, 0.0, 0.0), (speed + 0.8, 0.0, 0.0), obstacles=[ball(distance + 1.0)]))
    stoppable = np.sqrt(2.0 * 3.0 * (distance - BODY - 0.3))
    h, falls = stoppable - speed, 3.0 * speed / stoppable
    most = speed + 0.35 * (2.0 * h - falls)  # of the velocity's lag: h' = -falls - (u - v) / lag = -2 h
    assert near.kind == ADJUSTED and near.plan[0] == pytest.approx([most, 0.0, 0.0], abs=1e-5)


def test_without_an_input_within_the_slew_it_brakes():
    fast = BARRIER.decide(asked((4.0, 0.0, 0.0), (4.0, 0.0, 0.0), obstacles=[ball(1.8)]))
    assert fast.kind == FAILSAFE and fast.plan[0, 0] < 4.0 and "no input" in fast.reason
    assert BARRIER.decide(asked(proposal=(np.nan, 0.0, 0.0))).kind == FAILSAFE


def test_by_its_own_equations_it_touches_nothing():
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
        for period in range(60):
            goal = rng.uniform(-5.0, 5.0, 3) if period % 8 == 0 else goal
            proposal = np.clip(goal, before - 0.8, before + 0.8)
            ask = replace(asked(velocity, proposal, before), obstacles=shapes)
            before = BARRIER.decide(replace(ask, state=np.concatenate([position, velocity, np.zeros(3)]))).plan[0]
            for _ in range(20):
                velocity = velocity + 0.01 / CONFIG.lag * (before - velocity)
                position = position + 0.01 * velocity
            nearest = min(nearest, float(shapes.distance(position).min()) - BODY)
    assert 0.0 < nearest < 0.6, "it comes near, and never touches"


def test_its_model_holds_settings_and_is_for_vehicles_that_follow_velocities():
    config = config_for(CBF, QUADROTOR)
    model = pretrain(QUADROTOR, config)
    assert made_by(model, QUADROTOR, config) and not made_by(model, QUADROTOR, replace(config, margin=0.5))
    assert isinstance(ready(decode(model.encode())), VelocityBarrier)
    with pytest.raises(BadModel, match="velocities"):
        VelocityBarrier(replace(model, robot=GROUND))
    with pytest.raises(BadModel, match="without lag"):
        VelocityBarrier(replace(model, settings={"rate": 1.0, "margin": 0.0, "deceleration": 3.0}))
