"""The filter and a simulated robot in closed loop: nothing is hit, and a test notices each part that a model omits."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.messaging.obstacle import Obstacle, rotate
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


def clearance(obstacles, points):
    """Return the least distance [m] of true positions (n, 2) to the solids, by their definitions."""
    distances = []
    for o in obstacles:
        offset = points - np.array(o.position)
        local = rotate(offset, -o.yaw)
        if o.kind == "wall":
            distances.append(local[:, 0])
        elif o.kind == "cylinder":
            distances.append(np.hypot(*offset.T) - o.size[0])
        else:
            distances.append(np.hypot(*np.maximum(np.abs(local) - 0.5 * np.array(o.size), 0.0).T))
    return np.min(distances)


def drive(ready, obstacles, policy, steps, seed):
    """Return the decisions' kinds, the least clearance of the disc, the violations and the longest wait for a turn."""
    rng = np.random.default_rng(seed)
    robot, safety = Unicycle((0, 0, 0), rng), InProcess(ready, accept_bound=1.0)
    counts, least, violations, waiting, longest = dict.fromkeys((ALLOWED, ADJUSTED, FAILSAFE), 0), np.inf, 0, 0, 0
    for k in range(steps):
        state, action = robot.measure(), np.array(policy(k, rng))
        answer = safety.decide(state, action, obstacles)
        counts[answer.kind] += 1
        violations += not answer.contained
        before = robot.state.copy()
        path, turned = robot.step(answer.action)
        wants = abs(action[1]) > 0.3
        waiting = waiting + 1 if wants and abs(turned) < 0.01 else (0 if wants else waiting)
        longest = max(longest, waiting)
        least = min(least, clearance(obstacles, before[:2] + rotate(path, before[2])) - GROUND.footprint)
    return counts, least, violations, longest


def wild(k, rng):
    return rng.uniform([-0.1, -0.7], [0.4, 0.7])


def pushing(k, rng):
    """Drive ahead at full speed for a while, then turn in place: both must be possible again and again."""
    return (0.25, 0.0) if k % 60 < 30 else (0.0, 0.5 if (k // 60) % 2 else -0.5)


@pytest.mark.parametrize("policy", [wild, pushing])
@pytest.mark.parametrize("obstacles", [ROOM, CORRIDOR], ids=["room", "corridor"])
def test_the_robot_hits_nothing_and_does_not_get_stuck(ready, obstacles, policy):
    counts, least, violations, longest = drive(ready, obstacles, policy, 1600, seed=11)
    assert least > 0.0
    assert violations <= 5
    assert counts[ADJUSTED] > 20
    assert counts[ALLOWED] > 320
    assert longest < 100


@pytest.mark.parametrize(
    ("which", "seed", "most"),
    [
        (("set-membership", "direct"), 12, 0),
        (("matrix-zonotope", "direct"), 12, 0),
        (("residual", "recursion"), 13, 3),
    ],
)
def test_the_other_model_sets_hit_nothing_either(models, which, seed, most):
    counts, least, violations, _ = drive(Filter(models[which]), ROOM, wild, 400, seed)
    assert least > 0.0
    assert violations <= most
    assert counts[ALLOWED] + counts[ADJUSTED] > 100


EXTRA = 0.02  # m: this robot keeps to its chords and stops at once, so its bounds on both are raised first


def widened(model, part, by):
    bound = getattr(model, part)
    return replace(model, **{part: replace(bound, w=bound.w + by)})


def without_footprint(model):
    return replace(model, robot=replace(GROUND, body=(Disc((0.0, 0.0), 0.05),)))


def with_a_tenth_of_the_width(model):
    return replace(model, steps=tuple(replace(s, kappa=0.1 * s.kappa, w=0.1 * s.w) for s in model.steps))


def without_measurement_error(model):
    return replace(model, robot=replace(GROUND, measurement_bound=(0.0, 0.0, *GROUND.measurement_bound[2:])))


MUTANTS = {
    "footprint": (None, without_footprint),
    "width": (None, with_a_tenth_of_the_width),
    "measurement error": (None, without_measurement_error),
    "chord deviation": ("chord_deviations", lambda model: widened(model, "chord_deviations", -EXTRA)),
    "stopping distance": ("stopping_distance", lambda model: widened(model, "stopping_distance", -EXTRA)),
}


def before_a_wall():
    """Yield requests in front of a wall: from right before it to well off."""
    for x in np.linspace(0.11, 0.2, 150):
        yield request((0, 0, 0, 0.2, 0), (0.25, 0.0), [Obstacle("wall", (x, 0.0), (), np.pi)])


def too_near(filter, model, ask):
    """Return whether a filter verifies an input whose true tube touches the wall."""
    decision = filter.decide(ask)
    return decision.kind != FAILSAFE and fits(model, ask, decision.plan[0]) <= 0.0


@pytest.mark.parametrize("part", [None, "chord_deviations", "stopping_distance"])
def test_no_verified_tube_touches_the_wall(model, part):
    honest = model if part is None else widened(model, part, EXTRA)
    filter = Filter(honest)
    assert not any(too_near(filter, honest, ask) for ask in before_a_wall())


@pytest.mark.parametrize("name", MUTANTS)
def test_a_part_that_the_model_omits_is_noticed(model, name):
    part, mutant = MUTANTS[name]
    honest = model if part is None else widened(model, part, EXTRA)
    filter = Filter(mutant(honest))
    assert any(too_near(filter, honest, ask) for ask in before_a_wall())


def test_without_the_footprint_the_robot_collides(model):
    _, least, _, _ = drive(Filter(without_footprint(model)), ROOM, pushing, 600, seed=16)
    assert least < 0.0
