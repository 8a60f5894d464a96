"""`Filter.decide`: verified plans keep off the obstacles and are closest to the proposal; bad requests are refused."""

from dataclasses import replace

import numpy as np
import pytest

from brakeline.errors import BadRequest
from brakeline.messaging.moving_obstacles import MovingObstacles
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.obstacle_motion import Motion
from brakeline.messaging.robot import Limit
from brakeline.safety.filter import plan_search
from brakeline.safety.filter.backup_plan import Prediction, correction_penalty
from brakeline.safety.filter.batch.request_arrays import RequestArrays
from brakeline.safety.filter.blocking_constraint import SIGHT, why_not_allowed
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.plan_search import DecisionRecord, Linearized, PlanSearch
from brakeline.safety.filter.qp_solver import INFEASIBLE
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, MOST_OBSERVED, NOT_FINITE, Request
from brakeline.safety.filter.standing import DRIVES_ALREADY
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.service.in_process import InProcess
from brakeline.safety.service.wire import decision_reply
from tests.robots import GROUND, QUADROTOR
from tests.safety.asked import cylinder, fits, random_request, request, same
from tests.safety.unicycle import FIX, Unicycle


@pytest.mark.parametrize(("speed", "gap", "widening"), [(1.0, 0.2, 1), (3.0, 0.65, 1), (6.0, 4.0, 1), (3.0, 0.65, 3)])
def test_a_robot_that_flies_when_its_program_begins_has_no_verified_plan_to_stand(speed, gap, widening):
    """Its first request names no plan, as that of a standing robot does. A client keeps its widening after a reset."""
    ready, rng = Filter.load("quadrotor"), np.random.default_rng(0)
    ahead = Shapes.of([Obstacle("sphere", (QUADROTOR.footprint + gap + 0.5, 0.0, 0.0), (0.5,))], 3)
    hover = np.zeros((QUADROTOR.horizon, 3))
    flying = np.array([0.0, 0.0, 0.0, speed, *np.zeros(5)])
    first = Request(state=flying, action=np.array([5.0, 0, 0]), input_in_force=hover[0], plan=hover, obstacles=ahead)
    decision = ready.decide(replace(first, widening=float(widening)))
    assert (decision.kind, decision.verified) == (FAILSAFE, False)
    bound = np.array(QUADROTOR.measurement_bound)
    for state in rng.uniform(-bound, bound, (50, 9)):  # one that stands, as it may be measured
        near = Shapes.of([Obstacle("sphere", (QUADROTOR.footprint + 0.55, 0.0, 0.0), (0.5,))], 3)
        decision = ready.decide(replace(first, state=state, action=np.full(3, np.nan), obstacles=near))
        assert (decision.kind, decision.verified) == (FAILSAFE, True)


def test_nothing_is_verified_before_the_input_in_force_of_a_robot_that_flies_is_known():
    """Its first request names the input of a robot that stands, and the tube of a proposal would begin with that."""
    ready = Filter.load("quadrotor")
    rest, nothing = np.zeros((QUADROTOR.horizon, 3)), Shapes.of([], 3)
    flies, hovers, tilts = np.zeros((3, 9))
    flies[3], hovers[:], tilts[3:6] = 3.0, QUADROTOR.measurement_bound, 0.1
    first = [
        Request(state, np.full(3, 0.5), rest[0], rest, nothing, known_free=True) for state in (flies, hovers, tilts)
    ]
    kinds = [(FAILSAFE, False), (ALLOWED, True), (ALLOWED, True)]
    assert [(one.kind, one.verified) for one in map(ready.decide, first)] == kinds
    batch = ready.decide_batch(RequestArrays.of(first))
    assert [(batch.row(i).kind, batch.row(i).verified) for i in range(3)] == kinds
    assert batch.row(0).reason == DRIVES_ALREADY
    client = InProcess(ready)
    for kind in (FAILSAFE, ALLOWED):  # it brakes for one period, and then its input is known
        assert client.decide(flies, first[0].action, known_free=True).kind == kind
    client = InProcess(ready)
    client.decide(hovers, np.zeros(3), known_free=True)
    client.fallback()  # something moves it meanwhile: this is no first request, and the reason fits it all the same
    answer = client.decide(flies, np.zeros(3), known_free=True)
    assert answer.reason == DRIVES_ALREADY and "after a period without a decision" in answer.reason


@pytest.mark.parametrize(
    ("name", "stopped", "speed"), [("quadrotor", 0.5, 0.6), ("quadrotor", 0.5, 4.9), ("ground", 0.06, 0.25)]
)
def test_a_robot_whose_description_says_when_it_stands_drives_already_above_that_speed(name, stopped, speed):
    """Its first request names the input of a robot that stands. Each proposal was allowed, and verified."""
    model = ModelSet.load(name)
    ready = Filter(replace(model, robot=replace(model.robot, stopped=stopped)))
    moves, nothing = np.zeros(len(model.robot.state)), np.zeros(len(model.robot.action))
    moves[3] = speed  # m/s
    client = InProcess(ready)
    answers = [client.decide(moves, nothing, known_free=True) for _ in range(2)]
    assert [(one.kind, one.verified) for one in answers] == [(FAILSAFE, False), (ALLOWED, True)]
    assert answers[0].reason == DRIVES_ALREADY
    rests = InProcess(ready).decide(moves * stopped / speed, nothing, known_free=True)
    assert (rests.kind, rests.verified) == (ALLOWED, True)


@pytest.mark.parametrize("speed", [0.0, 0.1, 0.2])  # m/s
def test_a_robot_that_rolls_does_not_stand_because_its_sets_were_widened(speed):
    """It rolled 0.8 m and hit the wall, and all the way its plan to stand was verified, in sets 150 times as wide."""
    client, state, answers = InProcess(Filter.load("ground")), np.zeros(5), []
    wall = [Obstacle("wall", (0.9, 0.0), yaw=np.pi)]
    for _ in range(40):
        answers.append(client.decide(state, [np.nan, 0.0], wall))
        state = np.array([state[0] + speed * GROUND.period, 0.0, 0.0, speed, 0.0])
    beyond = [answer.margin < 0.0 for answer in answers]
    assert any(beyond) == (speed > 0.0)
    assert [answer.verified for answer in answers] == [not crossed for crossed in beyond]


@pytest.mark.parametrize("way", [0.28, 0.35, 0.45, 0.7])
def test_the_margin_is_the_distance_to_the_obstacle_even_beyond_the_reach(model, ready, way):
    ask = request(obstacles=[cylinder(way, 0.0)])
    decision = ready.decide(ask)
    clear = fits(model, ask, decision.plan[0])
    assert clear - 0.01 <= decision.margin <= clear + 1e-3
    assert decision.at_least == (way - 0.1 > ready.reach), "beyond the reach, the margin is a lower bound"


def test_a_reason_says_on_which_side_of_the_edge_the_tube_ends(ready):
    sentences = []
    for way in np.linspace(0.2, 0.45, 26):
        decision = ready.decide(request(action=(0.25, 0.0), obstacles=[cylinder(way, 0.0)]))
        if (blocking := decision.blocked_by) is not None:
            where = "ends {:.3g} m beyond" if blocking.room < 0.0 else "comes within {:.3g} m of"
            sentences.append(f"the proposal's tube {where.format(abs(blocking.room))} the free space's edge")
            assert decision.reason.startswith(sentences[-1])
    assert {"ends", "comes"} <= {word for sentence in sentences for word in sentence.split()}
    assert why_not_allowed(-3.0, too_long_for=3.0).startswith(
        "the proposal's tube leads farther than the 3 m that the filter"
    )
    assert why_not_allowed(-0.2, of_space=False) == "the proposal's tube ends 0.2 (in its own unit) beyond a limit"


def test_where_nothing_is_near_the_proposal_is_allowed_within_its_bounds_and_the_margin_is_a_lower_bound(ready):
    for obstacles in ([], [cylinder(2.0, 0.0)]):
        for action, executed in (((0.2, -0.3), (0.2, -0.3)), ((7.0, -3.0), (0.25, -0.5))):
            decision = ready.decide(request(action=action, obstacles=obstacles))
            assert (decision.kind, decision.reason, decision.solver) == (ALLOWED, "", "")
            assert decision.verified and decision.contained and not decision.compared
            assert np.array_equal(decision.plan, [executed, [0, 0], [0, 0]])
            assert correction_penalty(GROUND, action, np.zeros(2), decision.plan[0], 1.0) == 0.0
            assert decision.at_least and ready.reach < decision.margin < GROUND.sight - GROUND.footprint
    behind = ready.decide(request(action=(0.2, -0.3), obstacles=[cylinder(-0.31, 0.0), cylinder(0.34, 0.0)]))
    alone = ready.decide(request(action=(0.2, -0.3), obstacles=[cylinder(0.34, 0.0)]))
    assert behind.margin == alone.margin < ready.reach, "the obstacle behind is nearer, but not to the tube"


def test_the_penalty_counts_from_what_bounds_and_slew_let_pass():
    before, wanted = np.array([1.0, 0.0, -4.9]), (5.0, 0.1, -9.0)
    assert correction_penalty(QUADROTOR, wanted, before, (1.8, 0.1, -5.0), 2.0) == pytest.approx(0.0)
    assert correction_penalty(QUADROTOR, wanted, before, (0.8, 0.1, -5.0), 2.0) == pytest.approx(0.2)
    assert correction_penalty(QUADROTOR, (np.nan, 0.1, np.inf), before, (0.2, 0.1, -4.1), 1.0) == pytest.approx(0.0)


def test_a_slew_limit_is_kept(model):
    ready = Filter(replace(model, robot=replace(GROUND, action_slew=(0.05, 0.1))))
    decision = ready.decide(request((0, 0, 0, 0.2, 0), (0.0, 0.5), [cylinder(2, 0)]))
    assert decision.kind == ALLOWED and np.allclose(decision.plan[0], [0.15, 0.1])
    kinds = set()
    for x in np.linspace(0.24, 0.32, 9):
        decision = ready.decide(request((0, 0, 0, 0.15, 0), (0.25, 0.5), [cylinder(x, 0.02)]))
        kinds.add(decision.kind)
        if decision.kind != FAILSAFE:
            assert 0.1 - 1e-12 <= decision.plan[0][0] <= 0.2 + 1e-12
            assert abs(decision.plan[0][1]) <= 0.1 + 1e-12
    assert ADJUSTED in kinds


def test_an_input_that_was_never_recorded_is_not_verified(model):
    fast, state = Filter(replace(model, robot=replace(GROUND, name="fast", action_high=(1.0, 0.5)))), np.zeros(5)
    most = model.domain[1, 2] + 0.02 * np.ptp(model.domain[:, 2])
    session = InProcess(fast, accept_bound=1.0)
    for speed, kind in ((0.2, ALLOWED), (1.0, ADJUSTED), (1.0, ADJUSTED), (0.2, ALLOWED)):
        decision = session.decide(state, (speed, 0.0), known_free=True)
        assert (decision.kind, decision.verified) == (kind, True) and decision.action[0] == min(speed, most)
        assert ("recorded" in decision.reason) == (kind == ADJUSTED) and decision.blocked_by is None
        state = decision.predicted.center
    for way in np.linspace(0.23, 0.5, 9):
        asked = request(action=(1.0, 0.1), obstacles=[cylinder(way, 0.02)])
        alone, among = fast.decide(asked), fast.decide_batch(RequestArrays.of([asked] * 2)).row(1)
        assert alone.kind == among.kind != ALLOWED and np.array_equal(alone.plan, among.plan)
        assert alone.plan[0, 0] <= most and not alone.for_clearance
    committed = np.array([(0.9, 0.0), (0.0, 0.0), (0.0, 0.0)])
    other = fast.decide(request(action=(np.nan, 0.0), plan=committed, model="another"))
    assert other.kind == FAILSAFE and not other.plan.any() and other.verified, "braking is verified, 0.9 m/s is not"


@pytest.mark.parametrize("margin", [-0.05, np.nan, np.inf])
def test_a_clearance_margin_is_finite_and_not_negative(model, margin):
    with pytest.raises(ValueError, match="clearance margin"):
        Filter(model, clearance_margin=margin)


def test_adjusted_is_the_closest_input_that_can_be_verified(ready):
    """Compare with a fine grid of inputs, each checked by the exact check of its own tube."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.linspace(0, 0.25, 41), np.linspace(-0.5, 0.5, 41)), -1).reshape(-1, 2)
    width = GROUND.high() - GROUND.low()
    decisions = [(ask, ready.decide(ask)) for ask in (random_request(rng) for _ in range(250))]
    adjusted = [(ask, decision) for ask, decision in decisions if decision.kind == ADJUSTED]
    assert len(adjusted) > 12
    for ask, decision in adjusted[:12]:
        z_0 = np.concatenate([ask.state[3:], ask.input_in_force])
        scene = ready.constraints.local_map(ask, z_0, ready.builder.reachable(ask.input_in_force))
        proposal = ready.inputs.limited(ask.action, ask.input_in_force)
        z = np.concatenate([z_0, proposal])
        planes = ready.constraints.planes(scene, z)
        at = Linearized(ready.constraints, scene, z, planes, ready.constraints.slack(scene, z, planes))
        kept = PlanSearch(ready, scene, z_0, proposal, DecisionRecord(0)).with_clearance_margin(at)
        taken = np.linalg.norm((decision.plan[0] - ask.action) / width)
        possible = [u for u in grid if ready.constraints.margin(kept, np.concatenate([z_0, u])) >= 0.0]
        best = min((np.linalg.norm((u - ask.action) / width) for u in possible), default=np.inf)
        assert taken <= best + 2e-3


def test_a_verified_proposal_is_allowed_or_replaced_for_clearance_and_the_decision_says_which(ready, model):
    """With a clearance margin of zero, the filter allows exactly the proposals whose own tubes it verifies."""
    without = Filter(model, clearance_margin=0.0)
    rng, counts = np.random.default_rng(5), {}
    for _ in range(500):
        ask = random_request(rng, nearest=0.235)
        decision, verified = ready.decide(ask), without.decide(ask).kind == ALLOWED
        key = decision.kind, bool(decision.for_clearance), verified
        counts[key] = counts.get(key, 0) + 1
        if decision.for_clearance:
            assert decision.blocked_by.room >= 0.0
            assert decision_reply(decision, 0.0).decision.for_clearance
    assert counts[ADJUSTED, True, True] > 10 < counts[ADJUSTED, False, False], counts
    assert {key for key in counts if key[2]} <= {(ALLOWED, False, True), (ADJUSTED, True, True)}, counts
    assert {key for key in counts if not key[2]} <= {(ADJUSTED, False, False), (FAILSAFE, False, False)}, counts


def test_a_verified_proposal_is_allowed_where_no_input_keeps_the_clearance_margin(ready, monkeypatch):
    """If the solver finds no better input, the robot must not brake: its proposal was verified."""
    rng = np.random.default_rng(5)
    replaced = [ask for ask in (random_request(rng) for _ in range(200)) if ready.decide(ask).for_clearance]
    assert len(replaced) > 5
    monkeypatch.setattr(plan_search, "solve", lambda program: INFEASIBLE)
    for ask in replaced:
        decision = ready.decide(ask)
        assert (decision.kind, decision.for_clearance, decision.verified) == (ALLOWED, None, True)
        assert decision.plan[0] == pytest.approx(ask.action)


@pytest.mark.parametrize(("kind", "count"), [("residual", 80), ("set-membership", 30), ("matrix-zonotope", 30)])
def test_every_plan_keeps_clear_and_ends_in_a_stop(models, kind, count):
    model = models[kind, "direct"]
    ready = Filter(model)
    rng = np.random.default_rng(1)
    kinds = set()
    for _ in range(count):
        ask = random_request(rng)
        decision = ready.decide(ask)
        kinds.add(decision.kind)
        assert not decision.plan[1:].any()
        assert (decision.plan >= GROUND.low()).all()
        assert (decision.plan <= GROUND.high()).all()
        if decision.kind == FAILSAFE:
            continue
        assert decision.verified
        assert decision.margin >= 0.0
        assert fits(model, ask, decision.plan[0]) > 0.0
    assert {ALLOWED, ADJUSTED} <= kinds


def test_beside_one_obstacle_every_proposal_with_enough_clearance_is_allowed(ready, model):
    """Half-spaces cost space only between several obstacles."""
    rng, roomy = np.random.default_rng(2), 0
    for _ in range(80):
        ask = random_request(rng, count=1)
        if fits(model, ask, ask.action) > ready.clearance_margin + 0.02:
            assert ready.decide(ask).kind == ALLOWED
            roomy += 1
    assert roomy > 20


def test_the_tube_is_of_true_positions_and_holds_them(ready):
    rng = np.random.default_rng(3)
    for _ in range(150):
        robot = Unicycle((0.3, -0.2, rng.uniform(-3, 3)), rng)
        decision = ready.decide(
            request(robot.measure(), rng.uniform([0, -0.5], [0.25, 0.5]), input_in_force=np.zeros(2))
        )
        for u, center, half_width in zip(decision.plan, decision.tube_center, decision.tube_half_width, strict=True):
            robot.step(u)
            assert (np.abs(robot.state[:2] - center) <= half_width).all()


@pytest.mark.parametrize("kind", [ALLOWED, ADJUSTED, FAILSAFE])
def test_the_prediction_holds_for_every_kind(ready, kind):
    rng, compared = np.random.default_rng(4), 0
    for _ in range(1000):
        robot = Unicycle((0, 0, rng.uniform(-3, 3)), rng)
        before = rng.uniform([0, -0.5], [0.25, 0.5])
        robot.step(before)
        state, angle = robot.measure(), rng.uniform(-0.8, 0.8)
        away = 0.24 if kind == FAILSAFE else 0.29
        place = state[:2] + away * np.array([np.cos(state[2] + angle), np.sin(state[2] + angle)])
        obstacles = [] if kind == ALLOWED else [cylinder(*place)]
        decision = ready.decide(request(state, (0.25, 0.1), obstacles, input_in_force=before, model=ready.version))
        if decision.kind == kind:
            robot.step(decision.plan[0])
            assert decision.predicted.contains(GROUND, robot.measure())
            compared += 1
        if compared == 60:
            return
    raise AssertionError(f"only {compared} decisions were {kind}")


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("state", np.array([NAN, 0, 0, 0, 0])),
        ("state", np.array([0, 0, INF, 0, 0])),
        ("state", np.zeros(4)),
        ("state", np.array([1e9, 0, 0, 0, 0])),
        ("action", np.zeros(3)),
        ("input_in_force", np.array([0, NAN])),
        ("input_in_force", np.array([0.9, 0])),
        ("input_in_force", np.zeros(1)),
        ("plan", np.full((3, 2), NAN)),
        ("plan", np.zeros((2, 2))),
        ("plan", np.array([[9.0, 0], [0, 0], [0, 0]])),
        ("plan", np.array([[-0.1, 0], [0, 0], [0, 0]])),
        ("plan", np.array([[0.1, 0], [0.1, 0], [0.1, 0]])),
        ("obstacles", Shapes.of([Obstacle("sphere", (0, 0, 0), (1,))], 3)),
        ("observation", np.full(26, NAN, np.float32)),
        ("observation", np.zeros(MOST_OBSERVED + 1, np.float32)),
        ("predicted_center", Prediction(np.full(5, NAN), np.ones(5), 0.0)),
        ("predicted_center", Prediction(np.zeros(4), np.ones(4), 0.0)),
        ("predicted_half_width", Prediction(np.zeros(5), np.full(5, INF), 0.0)),
        ("predicted_half_width", Prediction(np.zeros(5), np.zeros(0), 0.0)),
        ("predicted_half_width", Prediction(np.zeros(5), -np.ones(5), 0.0)),
        ("predicted_heading", Prediction(np.zeros(5), np.ones(5), NAN)),
    ],
)
def test_a_bad_request_is_refused_with_its_field(ready, field, value):
    with pytest.raises(BadRequest) as caught:
        ready.decide(replace(request(), **{"predicted" if field.startswith("predicted") else field: value}))
    assert caught.value.field == field
    assert ready.decide(request()).kind == ALLOWED


@pytest.mark.parametrize("action", [(NAN, 0.0), (0.2, -INF), (INF, NAN)])
def test_a_proposal_that_is_not_finite_brakes_along_the_committed_plan(ready, action):
    tail = np.array([[0.1, 0.2], [0.0, 0.0], [0.0, 0.0]])
    moving = {"state": (0, 0, 0, 0.1, 0.2), "plan": tail, "model": ready.version}
    decision = ready.decide(request(action=action, **moving))
    assert (decision.kind, decision.reason, decision.verified) == (FAILSAFE, NOT_FINITE, True)
    assert np.array_equal(decision.plan, tail)
    standing = ready.decide(request(action=action))
    assert (standing.kind, standing.reason) == (FAILSAFE, NOT_FINITE) and not standing.plan.any()
    assert ready.decide(request(action=(0.2, 0.0))).kind == ALLOWED


def test_an_obstacle_with_nan_is_never_overlooked(ready):
    near = Shapes.of([cylinder(0.4, 0)], 2)
    broken = replace(near, center=near.center * NAN)
    decision = ready.decide(request(obstacles=broken))
    assert decision.kind == FAILSAFE
    assert not decision.plan[0].any()


def test_the_reach_covers_every_plan(ready):
    """Find the farthest point of any plan's tube by brute force."""
    rng = np.random.default_rng(17)
    farthest = 0.0
    for _ in range(2000):
        z = rng.uniform([*ready.domain[0], *GROUND.low()], [*ready.domain[1], *GROUND.high()])
        sizes = ready.tube.magnitudes(z)
        half = np.abs(ready.tube.directions) @ sizes[: ready.tube.generators]
        way = np.linalg.norm(np.abs(ready.tube.centers(z)) + half, axis=1).max()
        farthest = max(farthest, way + GROUND.footprint + FIX + sizes[ready.tube.generators :].max())
    assert farthest < ready.reach <= GROUND.sight


def test_the_same_request_has_the_same_answer_whatever_came_between(model):
    rng = np.random.default_rng(6)
    asks = [random_request(rng) for _ in range(30)]
    first = Filter(model)
    once = [first.decide(ask) for ask in asks]
    other = Filter(ModelSet.decode(model.encode()))
    for i in rng.permutation(30):
        assert same(first.decide(asks[i]), once[i])
        assert same(other.decide(asks[i]), once[i])


def test_a_moved_and_turned_scene_has_the_same_answer(model):
    """The measurement error is zero here, because its box is aligned with the world's axes."""
    ready = Filter(replace(model, robot=replace(GROUND, measurement_bound=(0.0,) * 5)))
    rng = np.random.default_rng(7)
    for _ in range(50):
        v, w, angle, way = rng.uniform(0, 0.25), rng.uniform(-0.5, 0.5), rng.uniform(-3, 3), rng.uniform(0.25, 0.4)
        plans = []
        for at, heading in ((0.0, 0.0), (5.0, 2.0)):
            place = at + way * np.array([np.cos(angle + heading), np.sin(angle + heading)])
            plans.append(ready.decide(request((at, at, heading, v, w), (0.25, 0.2), [cylinder(*place)])))
        assert plans[0].kind == plans[1].kind
        assert np.allclose(plans[0].plan, plans[1].plan, atol=1e-5)
        assert plans[0].margin == pytest.approx(plans[1].margin, abs=1e-5)


# --- the blocking constraint names the right obstacle, its true edge and the true violation --------------------------


def blocked(ready, requests):
    for question in requests:
        decision = ready.decide(question)
        if decision.kind != ALLOWED and decision.blocked_by is not None:
            yield question, decision
        else:
            assert decision.blocked_by is None


def test_the_edge_touches_the_blocking_obstacle_and_has_all_of_it_behind(ready):
    rng, seen = np.random.default_rng(0), 0
    for question, decision in blocked(ready, (random_request(rng, 6, 0.22) for _ in range(120))):
        stopped, shapes = decision.blocked_by, question.obstacles
        assert stopped.by == "cylinder" and 0.0 <= stopped.after <= ready.robot.horizon * ready.robot.period + 1e-9
        levels = (shapes.center - stopped.at) @ stopped.normal - shapes.rho  # of the nearest point of each
        assert np.abs(levels).min() < 1e-6, "it is the supporting half-space of one of them"
        assert np.linalg.norm(stopped.normal) == pytest.approx(1.0)
        assert (question.state[:2] - stopped.at) @ stopped.normal < 0.0, "the robot is on the free side"
        seen += 1
    assert seen > 30


def test_the_room_is_the_margin_of_the_proposals_tube(ready):
    rng = np.random.default_rng(1)
    for question, decision in blocked(ready, (random_request(rng) for _ in range(60))):
        z_0 = np.concatenate([question.state[ready.regressor], question.input_in_force])
        z = ready.inputs.regressors(z_0, ready.inputs.limited(question.action, question.input_in_force))
        scene = ready.constraints.local_map(question, z_0, ready.builder.reachable(question.input_in_force))
        assert decision.blocked_by.room == pytest.approx(ready.constraints.margin(ready.constraints.rows(scene, z), z))


def test_a_wall_a_box_a_mover_a_limit_and_the_sight_have_their_names(ready):
    def name(filter=ready, movers=None, obstacles=(), state=(0, 0, 0, 0.25, 0)):
        return filter.decide(request(state, (0.25, 0.0), obstacles, movers=movers)).blocked_by.by

    assert name(obstacles=[Obstacle("wall", (0.16, 0.0), (), np.pi), cylinder(-1.0, 0.0)]) == "wall"
    assert name(obstacles=[cylinder(-1.0, 0.0), Obstacle("box", (0.3, 0.0), (0.3, 0.3))]) == "box"
    walker = Obstacle("cylinder", (0.45, 0.0), (0.1,), motion=Motion((0.0, 0.0), 0.0, 0.0, speed=0.5))
    assert name(movers=MovingObstacles.of([walker], 2), obstacles=[cylinder(-1.0, 0.0)]) == "moving cylinder"
    slow = replace(ready.robot, limits=(Limit("walking pace", (0.0, 0.0, 0.0, 1.0, 0.0), 0.1),))
    assert name(Filter(replace(ready.model, robot=slow)), state=(0, 0, 0, 0.05, 0)) == "walking pace"
    assert name(Filter(replace(ready.model, robot=replace(ready.robot, sight=0.15)))) == SIGHT
