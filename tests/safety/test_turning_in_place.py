"""Turning in place: a round robot may turn beside anything, and a long one may not sweep an obstacle."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from brakeline.messaging.obstacle import Shapes, rotate
from brakeline.messaging.robot import Disc
from brakeline.messaging.robot_description import robot_from_description
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.model.turning_in_place import standing_limits
from brakeline.safety.model.validation import upper_bound, validate
from brakeline.safety.model.windows import FREE
from brakeline.safety.service.in_process import InProcess
from tests.robots import GROUND, QUADROTOR
from tests.safety.asked import cylinder
from tests.safety.test_closed_loop import ROOM, drive
from tests.safety.unicycle import Unicycle

ROBOT = robot_from_description(
    {
        "name": "quick-turner",
        "period": 0.2,
        "sight": 2.5,
        "state": {
            "x": {"unit": "m", "role": "position", "error": 0.005},
            "y": {"unit": "m", "role": "position", "error": 0.005},
            "heading": {"unit": "rad", "role": "heading", "error": 0.005},
            "v": {"unit": "m/s", "error": 0.01, "follows": "speed"},
            "w": {"unit": "rad/s", "error": 0.01, "follows": "turn rate"},
        },
        "input": {
            "speed": {"unit": "m/s", "low": 0.0, "high": 0.6, "moves": True},
            "turn rate": {"unit": "rad/s", "low": -1.5, "high": 1.5, "moves": False},
        },
        "plan": {"horizon": 5, "free": 1, "brake": 3},
        "body": [{"at": [0.0, 0.0], "radius": 0.15}],
    }
)
LONG = (Disc((0.12, 0.0), 0.1), Disc((0.0, 0.0), 0.15), Disc((-0.12, 0.0), 0.1))
FAST = 1.5  # rad/s


def wandering(rng, count):
    """Return inputs that follow no plan: targets held for a while, some of them turns in place, and stops."""
    inputs = []
    while len(inputs) < count:
        target = rng.uniform(ROBOT.low(), ROBOT.high())
        if rng.random() < 0.4:
            target = np.array([0.0, rng.choice([-FAST, FAST, target[1]])])
        inputs += [target] * int(rng.integers(1, 8))
        if rng.random() < 0.15:
            inputs += [np.zeros(2)] * int(rng.integers(6, 12))
    return np.array(inputs[:count])


def record(seed, trajectories=30, turns=True):
    parts = []
    for i in range(trajectories):
        rng = np.random.default_rng((seed, i))
        vehicle = Unicycle((0.0, 0.0, rng.uniform(-3, 3)), rng)
        inputs = wandering(rng, 200)
        if not turns:
            inputs[inputs[:, 0] == 0.0] = 0.0
        parts.append(vehicle.trajectory(inputs))
    return Dataset(ROBOT, tuple(parts))


def fitted(data, **changes):
    """Fit a model set to free driving of the robot, which may have another shape than the recorded one."""
    return fit_model_set(replace(data, robot=replace(ROBOT, **changes)), ModelConfig(windows=FREE))


@pytest.fixture(scope="module")
def driving():
    return record(0)


@pytest.fixture(scope="module")
def turner(driving):
    return fitted(driving)


def pillars(gap, count, body=0.15):
    away = body + gap + 0.1
    angles = np.pi / 2 + 2 * np.pi * np.arange(count) / count
    return [cylinder(away * np.cos(a), away * np.sin(a), 0.1) for a in angles]


def turn(ready, obstacles, rate, noise=0.0, steps=80, sides=(-1.0, 1.0)):
    """Propose turns in place to these sides in closed loop.

    Returns the answers, the angle turned [rad], and the least distance of the body to an obstacle [m].
    """
    rng = np.random.default_rng(1)
    vehicle, safety = Unicycle((0.0, 0.0, 0.0), rng), InProcess(ready, accept_bound=1.0)
    shapes, answers, angle, least, side = Shapes.of(obstacles, 2), [], 0.0, np.inf, 0.0
    for k in range(steps):
        side = rng.choice(sides) if k % 5 == 0 else side
        proposal = np.array([abs(rng.normal(0.0, noise)) if noise else 0.0, side * rate])
        answers.append(safety.decide(vehicle.measure(), proposal, obstacles))
        _, turned = vehicle.step(answers[-1].action)
        angle += abs(turned)
        for disc in ready.robot.body:
            center = vehicle.state[:2] + rotate(np.array(disc.at), vehicle.state[2])
            least = min(least, float(shapes.distance(center).min()) - disc.radius)
    return answers, angle, least


@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize("rate", [0.5, FAST])
def test_a_round_robot_turns_on_the_spot_between_pillars(turner, count, rate):
    """With one bound for all plans, the filter would brake each turn at 3 cm."""
    decisions, angle, least = turn(Filter(turner), pillars(0.03, count), rate)
    assert {decision.kind for decision in decisions} == {ALLOWED}
    assert all(decision.verified for decision in decisions)
    assert sum(not decision.contained for decision in decisions) <= 1
    assert angle > 0.7 * 80 * ROBOT.period * rate
    assert least > 0.03 - 0.005


@pytest.mark.parametrize("rate", [0.5, FAST])
def test_a_proposal_that_also_creeps_is_adjusted_to_turning(turner, rate):
    decisions, angle, least = turn(Filter(turner), pillars(0.04, 4), rate, noise=0.02)
    assert {decision.kind for decision in decisions} <= {ALLOWED, ADJUSTED}
    assert all(decision.verified for decision in decisions)
    assert angle > 0.6 * 80 * ROBOT.period * rate and least > 0.0


def test_the_ground_robot_turns_in_place_too(ready):
    decisions, angle, _ = turn(ready, pillars(0.03, 4, body=GROUND.footprint), 0.5)
    assert {decision.kind for decision in decisions} == {ALLOWED} and angle > 6.0


def test_the_predictors_in_place_hold_on_fresh_data(turner, driving):
    fresh = record(1, trajectories=120)
    report = validate(turner, driving, fresh)
    assert report.in_place_windows > 500
    assert report.bound_in_place == upper_bound(report.in_place_violations, report.in_place_windows)
    assert report.in_place_violations <= 0.01 * report.in_place_windows and report.bound_in_place < 0.03
    narrow = replace(
        turner.in_place, steps=tuple(replace(s, kappa=0.6 * s.kappa, w=0.6 * s.w) for s in turner.in_place.steps)
    )
    some = replace(fresh, trajectories=fresh.trajectories[:60])
    worse = validate(replace(turner, in_place=narrow), driving, some)
    assert worse.in_place_violations > 0.1 * worse.in_place_windows
    # The tube of all plans verifies solvers' answers in place, so it is judged on them, too.
    general = tuple(replace(s, kappa=0.1 * s.kappa, w=0.1 * s.w) for s in turner.steps)
    worse = validate(replace(turner, steps=general), driving, some)
    assert worse.in_place_violations > 0.1 * worse.in_place_windows


def test_fresh_turns_stay_in_the_tubes_that_were_verified_for_them(turner):
    """Compare true positions at the end of every period with the decision's sets, from standing and from turning."""
    ready, rng, outside, plans, obstacles = Filter(turner), np.random.default_rng(5), 0, 400, pillars(0.04, 4)
    for _ in range(plans):
        vehicle, safety = Unicycle((0.0, 0.0, rng.uniform(-3, 3)), rng), InProcess(ready, accept_bound=1.0)
        for _ in range(int(rng.integers(4))):  # in force before
            vehicle.step(before := np.array([0.0, rng.uniform(-FAST, FAST)]))
            safety.backup_plan.input_in_force = before
        answer = safety.decide(vehicle.measure(), np.array([0.0, rng.uniform(-FAST, FAST)]), obstacles)
        assert answer.kind == ALLOWED
        left = False
        for u, center, half in zip(answer.plan, answer.tube_center, answer.tube_half_width, strict=True):
            vehicle.step(u)
            left |= bool((np.abs(vehicle.state[:2] - center) > half).any())
        outside += left
    assert outside <= 0.01 * plans


def test_a_body_that_would_sweep_something_does_not_turn_into_it(driving):
    """Its nose would hit the pillars that a round body of the same width passes."""
    long_turner = fitted(driving, name="long-turner", body=LONG)
    assert long_turner.in_place is not None
    ready = Filter(long_turner)
    for rate, side in product((0.5, FAST), (-1.0, 1.0)):
        decisions, angle, least = turn(ready, pillars(0.04, 2), rate, sides=[side])
        assert FAILSAFE in {decision.kind for decision in decisions}
        assert 0.2 < angle < 1.3 and least > 0.0
        decisions, angle, _ = turn(ready, pillars(0.4, 2), rate, sides=[side], steps=40)
        assert {decision.kind for decision in decisions} == {ALLOWED} and angle > 0.9 * 40 * ROBOT.period * rate


def test_the_predictors_in_place_serve_a_standing_robots_plans_in_place_and_no_others(turner):
    ready = Filter(turner)
    box, own = ready.in_place
    standing = np.array([0.0, 0.5, 0.0, 0.5, 0.0, 1.0])  # [v, w, inputs in force, chosen inputs]
    assert box.shape == (2, len(standing)) and ready.constraints_for(standing) is own
    for place, value in ((0, 0.05), (2, 0.01), (4, 0.01), (5, 2.0), (1, np.nan)):
        moving = standing.copy()
        moving[place] = value
        assert ready.constraints_for(moving) is ready.constraints


def test_an_obstacle_beyond_the_reach_of_plans_counts_in_wider_tubes_of_turns(turner):
    """The map of the surroundings ends at the reach of all plans, and the tube of a turn went on behind it."""
    wide = tuple(replace(step, w=step.w + 2.0) for step in turner.in_place.steps)
    wider = replace(turner, robot=replace(ROBOT, sight=50.0), in_place=replace(turner.in_place, steps=wide))
    ready = Filter(wider, clearance_margin=0.01)
    answer = InProcess(ready, accept_bound=1.0).decide([0.0] * 5, [0.0, FAST], [cylinder(ready.reach + 0.15, 0.0)])
    assert ready.reach < 1.5 and answer.kind != ALLOWED


def test_a_robot_that_never_turns_in_place_has_no_predictors_in_place():
    assert standing_limits(QUADROTOR) is None
    assert fitted(record(2, trajectories=15, turns=False)).in_place is None


def test_a_model_set_without_predictors_in_place_decides_by_one_tube(turner):
    before = replace(turner, in_place=None)
    again = ModelSet.decode(before.encode())
    assert again.in_place is None and again.version == before.version != turner.version
    new = ModelSet.decode(turner.encode())
    assert new.version == turner.version and np.array_equal(new.in_place.box, turner.in_place.box)
    loaded = Filter(again)
    assert loaded.in_place is None and loaded.clearance_margin > 5.0 * Filter(new).clearance_margin
    assert {decision.kind for decision in turn(loaded, pillars(0.03, 4), FAST)[0]} != {ALLOWED}


def pushing(k, rng):
    return [0.6, rng.uniform(-0.5, 0.5)] if k % 40 < 25 else [0.0, FAST if (k // 40) % 3 else -FAST]


def wild(k, rng):
    return rng.uniform([-0.1, -2.0], [0.8, 2.0])


@pytest.mark.parametrize("policy", [pushing, wild])
def test_a_robot_from_free_driving_hits_nothing_and_does_not_get_stuck(turner, policy):
    counts, least, _, longest, way = drive(Filter(turner), ROOM, policy, 700, seed=3)
    assert 0.0 < least < 0.1 and longest < 12 and way > 4.0 and counts[FAILSAFE] < 70
