"""The filter and a robot of its own, step after step: it hits nothing, and what is left out of a model is noticed."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.messaging.obstacle import Obstacle, Shapes, rotate
from brakeline.messaging.robot import Disc
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, Request
from tests.robots import GROUND
from tests.safety.asked import NONE, cylinder, fits, request
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
    """Least distance of true positions (n, 2) to the solids, by their definitions."""
    ways = []
    for o in obstacles:
        offset = points - np.array(o.position)
        local = rotate(offset, -o.yaw)
        if o.kind == "wall":
            ways.append(local[:, 0])
        elif o.kind == "cylinder":
            ways.append(np.hypot(*offset.T) - o.size[0])
        else:
            ways.append(np.hypot(*np.maximum(np.abs(local) - 0.5 * np.array(o.size), 0.0).T))
    return np.min(ways)


def drive(ready, obstacles, policy, steps, seed, start=(0, 0, 0)):
    """Kinds, smallest clearance of the disc at any sub-step, violations, longest wait for a wanted turn."""
    rng = np.random.default_rng(seed)
    robot = Unicycle(start, rng)
    kept, shapes = BackupPlan(GROUND), Shapes.of(obstacles, 2)
    counts, least, violations, waiting, longest = dict.fromkeys((ALLOWED, ADJUSTED, FAILSAFE), 0), np.inf, 0, 0, 0
    for k in range(steps):
        state, action = robot.measure(), np.array(policy(k, rng, robot))
        decision = ready.decide(
            Request(state, action, kept.input_in_force, kept.plan, shapes, kept.model, kept.predicted, known_free=True)
        )
        counts[decision.kind] += 1
        violations += not decision.contained
        executed = kept.accept(decision.plan, decision.model, decision.predicted, decision.verified)
        before = robot.state.copy()
        path, turned = robot.step(executed)
        wants = abs(action[1]) > 0.3
        waiting = waiting + 1 if wants and abs(turned) < 0.01 else (0 if wants else waiting)
        longest = max(longest, waiting)
        points = before[:2] + rotate(path, before[2])
        least = min(least, clearance(obstacles, points) - GROUND.footprint)
    return counts, least, violations, longest


def wild(k, rng, robot):
    return rng.uniform([-0.1, -0.7], [0.4, 0.7])


def pushing(k, rng, robot):
    """Full speed ahead for a while, then a turn in place: it must be possible again and again."""
    return (0.25, 0.0) if k % 60 < 30 else (0.0, 0.5 if (k // 60) % 2 else -0.5)


@pytest.mark.parametrize("policy", [wild, pushing])
@pytest.mark.parametrize("obstacles", [ROOM, CORRIDOR], ids=["room", "corridor"])
def test_the_robot_never_hits_anything_and_never_gets_stuck(ready, obstacles, policy):
    counts, least, violations, longest = drive(ready, obstacles, policy, 1600, seed=11)
    assert least > 0.0
    assert violations <= 5
    assert counts[ADJUSTED] > 20
    assert counts[ALLOWED] > 320
    assert longest < 100


@pytest.mark.parametrize("kind", ["set-membership", "matrix-zonotope"])
def test_the_other_certificates_hit_nothing_either(models, kind):
    counts, least, violations, _ = drive(Filter(models[kind, "direct"]), ROOM, wild, 800, seed=12)
    assert least > 0.0
    assert violations == 0
    assert counts[ALLOWED] + counts[ADJUSTED] > 200


def test_the_recursion_hits_nothing_either(models):
    _, least, violations, _ = drive(Filter(models["residual", "recursion"]), ROOM, wild, 800, seed=13)
    assert least > 0.0
    assert violations <= 3


def test_a_robot_that_slips_more_than_recorded_is_noticed(ready):
    rng = np.random.default_rng(14)
    robot, kept, violations = Unicycle((0, 0, 0), rng, slip=0.3), BackupPlan(GROUND), 0
    for _ in range(100):
        decision = ready.decide(
            Request(
                robot.measure(),
                np.array([0.25, 0.1]),
                kept.input_in_force,
                kept.plan,
                NONE,
                kept.model,
                kept.predicted,
                known_free=True,
            )
        )
        violations += not decision.contained
        robot.step(kept.accept(decision.plan, decision.model, decision.predicted, decision.verified))
    assert violations > 50


def without_footprint(model):
    return Filter(replace(model, robot=replace(GROUND, body=(Disc((0.0, 0.0), 0.05),))))


def with_half_the_width(model):
    thin = tuple(replace(s, kappa=0.1 * s.kappa, w=0.1 * s.w) for s in model.steps)
    return Filter(replace(model, steps=thin))


def without_measurement_error(model):
    robot = replace(GROUND, measurement_bound=(0.0, 0.0, *GROUND.measurement_bound[2:]))
    return Filter(replace(model, robot=robot))


def without_bulge(model):
    return Filter(replace(model, chord_deviations=replace(model.chord_deviations, w=model.chord_deviations.w - EXTRA)))


def without_latch(model):
    return Filter(
        replace(model, stopping_distance=replace(model.stopping_distance, w=model.stopping_distance.w - EXTRA))
    )


EXTRA = 0.02  # m; this robot hardly bulges and stops at once: let it be worse


@pytest.mark.parametrize(
    "mutant", [without_footprint, with_half_the_width, without_measurement_error, without_bulge, without_latch]
)
def test_what_is_left_out_is_noticed(model, mutant):
    chord_deviations, stopping_distance = (
        replace(model.chord_deviations, w=model.chord_deviations.w + EXTRA),
        replace(model.stopping_distance, w=model.stopping_distance.w + EXTRA),
    )
    if mutant in (without_bulge, without_latch):
        model = (
            replace(model, chord_deviations=chord_deviations)
            if mutant is without_bulge
            else replace(model, stopping_distance=stopping_distance)
        )
    ready, honest = mutant(model), Filter(model)
    noticed = 0
    for x in np.linspace(0.11, 0.2, 150):  # a wall ahead: from right before it to well off
        ask = request((0, 0, 0, 0.2, 0), (0.25, 0.0), [Obstacle("wall", (x, 0.0), (), np.pi)])
        decision, right = ready.decide(ask), honest.decide(ask)
        noticed += decision.kind != FAILSAFE and fits(model, ask, decision.plan[0]) <= 0.0
        assert right.kind == FAILSAFE or fits(model, ask, right.plan[0]) > 0.0
    assert noticed > 0


def test_dropping_the_footprint_is_a_collision(model):
    _, least, _, _ = drive(without_footprint(model), ROOM, pushing, 600, seed=16)
    assert least < 0.0
