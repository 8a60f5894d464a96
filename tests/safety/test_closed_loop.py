"""The filter and a simulated robot in closed loop: nothing is hit, and a test notices each part that a model omits."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.messaging.obstacle import Obstacle, Shapes, rotate
from brakeline.messaging.robot import Disc
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE
from brakeline.safety.service.in_process import InProcess
from tests.robots import GROUND
from tests.safety.asked import cylinder, fits, request
from tests.safety.unicycle import Unicycle

ROOM = [
    Obstacle("wall", (-0.8, 0.0)),
    Obstacle("wall", (0.8, 0.0), (), np.pi),
    Obstacle("wall", (0.0, -0.8), (), np.pi / 2),
    Obstacle("wall", (0.0, 0.8), (), -np.pi / 2),
    cylinder(0.35, 0.35, 0.12),
    Obstacle("box", (-0.4, 0.4), (0.2, 0.3), 0.4),
]
CORRIDOR = [
    Obstacle("wall", (0.0, -0.2), (), np.pi / 2),
    Obstacle("wall", (0.0, 0.2), (), -np.pi / 2),
    Obstacle("wall", (0.7, 0.0), (), np.pi),
    Obstacle("wall", (-0.7, 0.0)),
]


def drive(ready, obstacles, policy, steps, seed):
    """Drive at a policy's proposals behind the filter.

    Returns the decisions by kind, the least clearance of the disc [m], the violations, the longest wait for a turn in
    periods, and the length of the way [m].
    """
    rng, shapes = np.random.default_rng(seed), Shapes.of(obstacles, 2)
    robot, safety = Unicycle((0, 0, 0), rng), InProcess(ready, accept_bound=1.0)
    counts, least, way = dict.fromkeys((ALLOWED, ADJUSTED, FAILSAFE), 0), np.inf, 0.0
    violations = waiting = longest = 0
    for k in range(steps):
        state, action = robot.measure(), np.array(policy(k, rng))
        answer = safety.decide(state, action, obstacles)
        counts[answer.kind] += 1
        violations += not answer.contained
        before = robot.state.copy()
        path, turned = robot.step(answer.action)
        wants = abs(action[1]) > 0.3
        waiting = waiting + 1 if wants and abs(turned) < 0.01 else (0 if wants else waiting)
        longest, way = max(longest, waiting), way + float(np.linalg.norm(path[-1]))
        least = min(least, shapes.distance(before[:2] + rotate(path, before[2])).min() - ready.robot.footprint)
    return counts, least, violations, longest, way


def wild(k, rng):
    return rng.uniform([-0.1, -0.7], [0.4, 0.7])


def pushing(k, rng):
    """Drive ahead at full speed for a while, then turn in place: both must be possible again and again."""
    return (0.25, 0.0) if k % 60 < 30 else (0.0, 0.5 if (k // 60) % 2 else -0.5)


@pytest.mark.parametrize("policy", [wild, pushing])
@pytest.mark.parametrize("obstacles", [ROOM, CORRIDOR], ids=["room", "corridor"])
def test_the_robot_hits_nothing_and_does_not_get_stuck(ready, obstacles, policy):
    counts, least, violations, longest, _ = drive(ready, obstacles, policy, 800, seed=11)
    assert least > 0.0
    assert violations <= 2
    assert counts[ADJUSTED] > 10
    assert counts[ALLOWED] > 160
    assert longest < 100


@pytest.mark.parametrize(
    "which", [("set-membership", "direct"), ("matrix-zonotope", "direct"), ("residual", "recursion")]
)
def test_the_other_model_sets_hit_nothing_either(models, which):
    counts, least, violations, *_ = drive(Filter(models[which]), ROOM, wild, 150, seed=12)
    assert least > 0.0
    assert violations <= (1 if which[0] == "residual" else 0)
    assert counts[ALLOWED] + counts[ADJUSTED] > 40


EXTRA = 0.02  # m: this robot keeps to its chords and stops at once, so its bounds on both are raised first


def widened(model, part, by):
    bound = getattr(model, part)
    return replace(model, **{part: replace(bound, w=bound.w + by)})


MUTANTS = {
    "footprint": lambda model: replace(model, robot=replace(GROUND, body=(Disc((0.0, 0.0), 0.05),))),
    "width": lambda model: replace(
        model, steps=tuple(replace(step, kappa=0.1 * step.kappa, w=0.1 * step.w) for step in model.steps)
    ),
    "measurement error": lambda model: replace(
        model, robot=replace(GROUND, measurement_bound=(0.0, 0.0, *GROUND.measurement_bound[2:]))
    ),
    "chord_deviations": lambda model: widened(model, "chord_deviations", -EXTRA),
    "stopping_distance": lambda model: widened(model, "stopping_distance", -EXTRA),
}


@pytest.mark.parametrize("name", MUTANTS)
def test_no_verified_tube_touches_a_wall_unless_the_model_omits_a_part(model, name):
    """From right before the wall to well off, the true tubes of verified inputs are compared with the wall."""
    honest = widened(model, name, EXTRA) if hasattr(model, name) else model

    def too_near(filter):
        """Return whether the filter verifies an input whose true tube touches the wall."""
        for x in np.linspace(0.11, 0.2, 60):
            ask = request((0, 0, 0, 0.2, 0), (0.25, 0.0), [Obstacle("wall", (x, 0.0), (), np.pi)])
            decision = filter.decide(ask)
            if decision.kind != FAILSAFE and fits(honest, ask, decision.plan[0]) <= 0.0:
                return True
        return False

    assert not too_near(Filter(honest))
    assert too_near(Filter(MUTANTS[name](honest)))
