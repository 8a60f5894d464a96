"""Turning on the spot: a robot that sweeps nothing by it may do so beside anything, and one that would may not."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.messaging.obstacle import Shapes, rotate
from brakeline.messaging.robot import Disc
from brakeline.messaging.robot_description import robot_from_description
from brakeline.safety.filter.backup_plan import BackupPlan
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, Request
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.model.turning_in_place import standing_limits
from brakeline.safety.model.validation import upper_bound, validate
from brakeline.safety.model.windows import FREE, PLAN
from tests.robots import GROUND, QUADROTOR
from tests.safety.asked import cylinder
from tests.safety.test_closed_loop import ROOM
from tests.safety.unicycle import Unicycle
from tests.safety.unicycle import record as record_ground

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
    """Inputs that follow no plan: targets held for a while, some of them turns on the spot, and stops."""
    inputs = []
    while len(inputs) < count:
        target = rng.uniform(ROBOT.low(), ROBOT.high())
        if rng.random() < 0.4:
            target = np.array([0.0, rng.choice([-FAST, FAST, target[1]])])
        inputs += [target] * int(rng.integers(1, 8))
        if rng.random() < 0.15:
            inputs += [np.zeros(2)] * int(rng.integers(6, 12))
    return np.array(inputs[:count])


def record(seed, trajectories=30, robot=ROBOT, turns=True):
    parts = []
    for i in range(trajectories):
        rng = np.random.default_rng((seed, i))
        vehicle = Unicycle((0.0, 0.0, rng.uniform(-3, 3)), rng)
        inputs = wandering(rng, 200)
        if not turns:
            inputs[inputs[:, 0] == 0.0] = 0.0
        states, paths, turned = [vehicle.measure()], [], []
        for u in inputs:
            path, turn = vehicle.step(u)
            states.append(vehicle.measure())
            paths.append(path)
            turned.append(turn)
        parts.append(Trajectory(np.array(states), inputs, np.array(paths), np.array(turned)))
    return Dataset(robot, tuple(parts))


@pytest.fixture(scope="module")
def driving():
    return record(0)


@pytest.fixture(scope="module")
def turner(driving):
    return fit_model_set(driving, ModelConfig(windows=FREE))


@pytest.fixture(scope="module")
def long_turner(driving):
    """The same robot with a body that is not round."""
    return fit_model_set(
        replace(driving, robot=replace(ROBOT, name="long-turner", body=LONG)), ModelConfig(windows=FREE)
    )


def pillars(gap, count, radius=0.1, body=0.15):
    away = body + gap + radius
    angles = np.pi / 2 + 2 * np.pi * np.arange(count) / count
    return [cylinder(away * np.cos(a), away * np.sin(a), radius) for a in angles]


def turn(ready, obstacles, rate, noise=0.0, steps=80, seed=1, sides=(-1.0, 1.0)):
    """Proposals to turn on the spot to these sides in closed loop; (decisions, angle turned [rad], least distance of
    the body to an obstacle [m])."""
    rng = np.random.default_rng(seed)
    robot = ready.robot
    vehicle, kept, shapes = Unicycle((0.0, 0.0, 0.0), rng), BackupPlan(robot), Shapes.of(obstacles, 2)
    decisions, angle, least, side = [], 0.0, np.inf, 0.0
    for k in range(steps):
        side = rng.choice(sides) if k % 5 == 0 else side
        proposal = np.array([abs(rng.normal(0.0, noise)) if noise else 0.0, side * rate])
        answer = ready.decide(
            Request(vehicle.measure(), proposal, kept.input_in_force, kept.plan, shapes, kept.model, kept.predicted)
        )
        decisions.append(answer)
        _, turned = vehicle.step(kept.accept(answer.plan, answer.model, answer.predicted, answer.verified))
        angle += abs(turned)
        for disc in robot.body:
            centre = vehicle.state[:2] + rotate(np.array(disc.at), vehicle.state[2])
            least = min(least, float(shapes.distance(centre).min()) - disc.radius)
    return decisions, angle, least


@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize("gap", [0.05, 0.04, 0.03])
@pytest.mark.parametrize("rate", [0.5, FAST])
def test_a_round_robot_turns_on_the_spot_between_pillars(turner, gap, count, rate):
    """All predictors in one: 80 of 80 decisions braked or slowed the turn at 3 cm, as if turning led aside by 0.2 m."""
    decisions, angle, least = turn(Filter(turner), pillars(gap, count), rate)
    assert {decision.kind for decision in decisions} == {ALLOWED}
    assert all(decision.verified for decision in decisions)
    assert sum(not decision.contained for decision in decisions) <= 1
    assert angle > 0.7 * 80 * ROBOT.period * rate
    assert least > gap - 0.005


@pytest.mark.parametrize("rate", [0.5, FAST])
def test_a_proposal_that_also_creeps_is_adjusted_to_turning(turner, rate):
    decisions, angle, least = turn(Filter(turner), pillars(0.04, 4), rate, noise=0.02)
    assert {decision.kind for decision in decisions} <= {ALLOWED, ADJUSTED}
    assert all(decision.verified for decision in decisions)
    assert angle > 0.6 * 80 * ROBOT.period * rate and least > 0.0


def test_the_shipped_kind_of_recording_supports_it_too(ready):
    for gap in (0.05, 0.04, 0.03):
        decisions, angle, _ = turn(ready, pillars(gap, 4, body=GROUND.footprint), 0.5)
        assert {decision.kind for decision in decisions} == {ALLOWED} and angle > 6.0


def test_what_the_predictors_in_place_state_holds_on_fresh_data(turner, driving):
    found = validate(turner, driving, record(1, trajectories=120))
    assert found.in_place_windows > 500
    assert found.bound_in_place == upper_bound(found.in_place_violations, found.in_place_windows)
    assert found.in_place_violations <= 0.01 * found.in_place_windows and found.bound_in_place < 0.03
    narrow = replace(
        turner.in_place, steps=tuple(replace(s, kappa=0.6 * s.kappa, w=0.6 * s.w) for s in turner.in_place.steps)
    )
    worse = validate(replace(turner, in_place=narrow), driving, record(1, trajectories=60))
    assert worse.in_place_violations > 0.1 * worse.in_place_windows


def test_fresh_turns_stay_in_the_tubes_that_were_verified_for_them(turner):
    """Of plans from standing and from turning, every period's end: true positions against the decision's sets."""
    ready, rng, outside, plans = Filter(turner), np.random.default_rng(5), 0, 400
    shapes = Shapes.of(pillars(0.04, 4), 2)
    for _ in range(plans):
        vehicle, kept = Unicycle((0.0, 0.0, rng.uniform(-3, 3)), rng), BackupPlan(ROBOT)
        for _ in range(int(rng.integers(4))):  # in force before
            vehicle.step(before := np.array([0.0, rng.uniform(-FAST, FAST)]))
            kept.input_in_force = before
        ask = Request(
            vehicle.measure(), np.array([0.0, rng.uniform(-FAST, FAST)]), kept.input_in_force, kept.plan, shapes
        )
        answer = ready.decide(ask)
        assert answer.kind == ALLOWED
        left = False
        for u, centre, half in zip(answer.plan, answer.tube_center, answer.tube_half_width, strict=True):
            vehicle.step(u)
            left |= bool((np.abs(vehicle.state[:2] - centre) > half).any())
        outside += left
    assert outside <= 0.01 * plans


@pytest.mark.parametrize("rate", [0.5, FAST])
def test_a_body_that_would_sweep_something_does_not_turn_into_it(long_turner, rate):
    """Its nose would hit the pillars beside it, which a round body of the same width passes."""
    assert long_turner.in_place is not None
    for side in (-1.0, 1.0):
        decisions, angle, least = turn(Filter(long_turner), pillars(0.04, 2), rate, sides=[side])
        assert FAILSAFE in {decision.kind for decision in decisions}
        assert 0.2 < angle < 1.3 and least > 0.0
        decisions, angle, _ = turn(Filter(long_turner), pillars(0.4, 2), rate, sides=[side])
        assert {decision.kind for decision in decisions} == {ALLOWED} and angle > 0.9 * 80 * ROBOT.period * rate


def test_they_are_used_for_plans_in_place_of_a_standing_robot_and_no_others(turner):
    ready = Filter(turner)
    box, own = ready.in_place
    standing = np.array([0.0, 0.5, 0.0, 0.5, 0.0, 1.0])  # [v, w, inputs in force, chosen inputs]
    assert ready._constraints_for(standing) is own
    for place, value in ((0, 0.05), (2, 0.01), (4, 0.01), (5, 2.0), (1, np.nan)):
        moving = standing.copy()
        moving[place] = value
        assert ready._constraints_for(moving) is ready.constraints
    assert box.shape == (2, 6)


def test_a_robot_without_such_plans_or_such_data_has_none():
    assert standing_limits(QUADROTOR) is None
    assert fit_model_set(record(2, turns=False), ModelConfig(windows=FREE)).in_place is None


def test_a_file_without_them_is_read_and_decides_by_one_tube(turner):
    before = replace(turner, in_place=None)
    again = ModelSet.decode(before.encode())
    assert again.in_place is None and again.version == before.version != turner.version
    new = ModelSet.decode(turner.encode())
    assert new.version == turner.version and np.array_equal(new.in_place.box, turner.in_place.box)
    one = Filter(again)
    assert one.in_place is None and one.clearance_margin > 5.0 * Filter(new).clearance_margin
    assert {decision.kind for decision in turn(one, pillars(0.03, 4), FAST)[0]} != {ALLOWED}


def pushing(k, rng):
    return [0.6, rng.uniform(-0.5, 0.5)] if k % 40 < 25 else [0.0, FAST if (k // 40) % 3 else -FAST]


def wild(k, rng):
    return rng.uniform([-0.1, -2.0], [0.8, 2.0])


@pytest.mark.parametrize("policy", [pushing, wild])
def test_a_robot_from_free_driving_hits_nothing_and_does_not_get_stuck(turner, policy):
    """It keeps a tenth of the clearance that one bound for all plans asks for."""
    ready, rng, shapes = Filter(turner), np.random.default_rng(2), Shapes.of(ROOM, 2)
    vehicle, kept, least, waiting, longest, way = Unicycle((0, 0, 0), rng), BackupPlan(ROBOT), np.inf, 0, 0, 0.0
    failsafe = 0
    for k in range(700):
        action = np.array(policy(k, rng))
        answer = ready.decide(
            Request(vehicle.measure(), action, kept.input_in_force, kept.plan, shapes, kept.model, kept.predicted)
        )
        failsafe += answer.kind == FAILSAFE
        before = vehicle.state.copy()
        path, turned = vehicle.step(kept.accept(answer.plan, answer.model, answer.predicted, answer.verified))
        waiting = waiting + 1 if abs(action[1]) > 0.5 and abs(turned) < 0.02 else 0
        longest, way = max(longest, waiting), way + float(np.linalg.norm(path[-1]))
        least = min(least, float(shapes.distance(before[:2] + rotate(path, before[2])).min()) - 0.15)
    assert 0.0 < least < 0.1 and longest < 12 and way > 4.0 and failsafe < 70


@pytest.mark.parametrize("certificate", ["set-membership", "matrix-zonotope"])
def test_the_other_certificates_have_them_too(driving, certificate):
    model = fit_model_set(driving, ModelConfig(certificate, windows=FREE))
    decisions, angle, _ = turn(Filter(model), pillars(0.05, 4), 0.5, steps=20)
    assert {decision.kind for decision in decisions} == {ALLOWED} and angle > 1.4


def test_recorded_plans_have_them_too():
    """The ground robot's plans, whose windows have fewer regressors than all inputs."""
    data = record_ground(trajectories=40, periods=300)
    model = fit_model_set(data, ModelConfig())
    assert model.model_config.windows == PLAN and model.in_place is not None
    found = validate(model, data, record_ground(trajectories=40, periods=300, seed=3))
    assert found.in_place_windows > 100 and found.in_place_violations <= 0.02 * found.in_place_windows
