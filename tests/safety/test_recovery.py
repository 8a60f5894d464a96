"""Out of where not even standing can be verified: slowly, never nearer, and called what it is."""

import math

import numpy as np
import pytest

from messaging.shapes import Obstacle, Shapes
from safety.commitment import Commitment
from safety.recovery import least_violating, lower, slow_inputs
from safety.request import RECOVERING
from tests.robots import GROUND, QUADROTOR
from tests.safety.asked import request
from tests.safety.unicycle import Unicycle

BODY = GROUND.footprint


def test_slow_inputs_are_slow_and_within_bounds():
    for robot in (GROUND, QUADROTOR):
        inputs = slow_inputs(robot)
        assert (inputs >= robot.low()).all() and (inputs <= robot.high()).all()
        assert (np.abs(inputs[:, np.array(robot.translates)]).max(axis=0) <= 0.3 * robot.high().max()).all()
        assert (inputs == 0.0).all(axis=1).any()


def test_the_worst_comes_first_and_nothing_gets_worse():
    standing, ends = np.array([0.05, 0.02, -0.1]), np.ones(3, dtype=bool)
    better = np.array([[0.04, 0.02, -0.1], [0.03, 0.025, -0.1], [0.03, 0.0, -0.1], [0.05, 0.02, -0.1]])
    assert least_violating(better, standing, ends, 0.0) == 2
    assert least_violating(better[[1, 3]], standing, ends, 0.0) is None  # the one harms, the other helps nothing
    assert least_violating(better[[1]], standing, ends, 0.01) == 0
    assert lower(np.array([1.0, 0.0]), np.array([1.0, 1.0])) and not lower(np.array([1.0, 1.0]), np.array([1.0, 1.0]))


@pytest.mark.parametrize("angle", [0.0, 1.5, 3.1, -2.0])
def test_who_was_put_too_close_gets_away_and_drives_on(ready, angle):
    """The obstacle a few centimetres within the body's disc, at any bearing; a policy that wants straight ahead."""
    near = 0.1 + BODY - 0.045
    obstacles = Shapes.of([Obstacle("cylinder", (near * math.cos(angle), near * math.sin(angle)), (0.1,))], 2)
    rng = np.random.default_rng(0)
    robot, kept = Unicycle((0.0, 0.0, 0.0), rng), Commitment(GROUND)
    kinds, gaps = [], []
    for _ in range(120):
        state = robot.measure()
        ask = request(state, (0.25, 0.0), obstacles, input_in_force=kept.input_in_force, plan=kept.plan)
        decision = ready.decide(type(ask)(**vars(ask) | {"model": kept.model, "predicted": kept.predicted}))
        kinds.append(decision.kind)
        assert decision.verified or decision.kind != "allowed"
        if decision.kind == RECOVERING:
            assert (
                not decision.verified and abs(decision.plan[0][0]) <= 0.3 * 0.25 + 1e-9 and not decision.plan[-1].any()
            )
        robot.step(kept.accept(decision.plan, decision.model, decision.predicted, decision.verified))
        gaps.append(float(obstacles.distance(robot.state[:2])[0]))
    assert kinds[0] == RECOVERING
    assert min(gaps) >= gaps[0] - 0.003 and gaps[-1] > BODY
    assert kinds[-1] != RECOVERING and "allowed" in kinds


@pytest.mark.parametrize(
    "obstacle",
    [
        Obstacle("cylinder", (0.15, 0.0), (0.2,), margin=-BODY),
        Obstacle("cylinder", (-0.11, 0.08), (0.2,), margin=-BODY),
        Obstacle("box", (0.0, 0.4), (1.0, 0.95), 0.3, margin=-BODY),
        Obstacle("wall", (-0.06, 0.0), (), math.pi, margin=-BODY),
    ],
    ids=["ahead", "beside", "box", "wall"],
)
def test_who_came_to_stand_inside_of_what_only_its_middle_must_not_be_in_is_led_out(ready, obstacle):
    """A hazard counts the body's middle, so the margin takes the body off; a policy that wants straight ahead."""
    obstacles = Shapes.of([obstacle], 2)
    robot, kept = Unicycle((0.0, 0.0, 0.0), np.random.default_rng(0)), Commitment(GROUND)
    kinds, depths = [], []
    for _ in range(300):
        ask = request(robot.measure(), (0.25, 0.0), obstacles, input_in_force=kept.input_in_force, plan=kept.plan)
        decision = ready.decide(type(ask)(**vars(ask) | {"model": kept.model, "predicted": kept.predicted}))
        kinds.append(decision.kind)
        depths.append(float(np.linalg.norm(obstacles.out_of(robot.state[:2]))))
        assert decision.verified or decision.kind in (RECOVERING, "failsafe")
        assert not (decision.verified and depths[-1] > 0.0) or decision.kind == "failsafe"
        robot.step(kept.accept(decision.plan, decision.model, decision.predicted, decision.verified))
    assert kinds[0] == RECOVERING and depths[0] > 0.0
    assert max(depths) <= depths[0] + 0.003 and depths[-1] == 0.0
    assert kinds[-1] in ("allowed", "adjusted")


def test_who_only_seems_too_close_stands(ready):
    """By less than two measurements' errors: the plan that was verified counts, as ever."""
    near = 0.1 + BODY - 0.01
    decision = ready.decide(request(action=(0.25, 0.0), obstacles=[Obstacle("cylinder", (near, 0.0), (0.1,))]))
    assert decision.kind == "failsafe" and decision.verified
