"""Batches decide as the single path does: the same kinds, the same inputs, and nothing verified that it would not."""

import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from brakeline.deploy.data.certification import certify
from brakeline.errors import BadRequest
from brakeline.messaging.moving_obstacles import split_moving
from brakeline.messaging.obstacle import Obstacle, Shapes
from brakeline.messaging.obstacle_motion import Motion
from brakeline.messaging.robot import Disc
from brakeline.messaging.scan import Scan
from brakeline.safety.filter import plan_search
from brakeline.safety.filter.backup_plan import UNVERIFIED, BackupPlan
from brakeline.safety.filter.batch import lane_decisions, qp_batch, search_batch
from brakeline.safety.filter.batch.batch_filter import BatchFilter
from brakeline.safety.filter.batch.decision_arrays import KINDS
from brakeline.safety.filter.batch.qp_batch import QPBatch
from brakeline.safety.filter.batch.request_arrays import RequestArrays
from brakeline.safety.filter.batch.row_by_row import RowByRow
from brakeline.safety.filter.filter import WORTH_A_BATCH, Filter
from brakeline.safety.filter.qp_solver import INFEASIBLE
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, RECOVERING, Request
from brakeline.safety.filter.reservation import OtherReservations
from brakeline.safety.filter.widening import PastWindow
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.service.in_process import InProcess
from tests.robots import GROUND
from tests.safety.test_one_step import CONFIG, ROBOT, driven, two_inputs
from tests.safety.test_one_step import scenes as among_posts

SAME = 1e-6
WORTH = 3 * WORTH_A_BATCH  # of the ground robot
FORMS = ("ground direct", "ground recursion", "two discs", "two inputs", "one-step", "real time", "quadrotor direct")
POST = Obstacle("cylinder", (0.26, 0.0), (0.1,))
LONG = Disc((0.08, 0.02), 0.07), Disc((-0.08, 0.0), 0.09)
EQUAL = ("kind", "verified", "at_least", "contained", "compared", "for_clearance", "model", "bound", "judges", "reason")


@pytest.fixture
def filters(models, data):
    made = {
        "ground recursion": lambda: Filter(models["residual", "recursion"]),
        "two discs": lambda: Filter(fit_model_set(replace(data, robot=replace(data.robot, body=LONG)), ModelConfig())),
        "two inputs": two_inputs,
        "one-step": one_step,
        "real time": lambda: Filter(certify(replace(driven(trajectories=3), robot=ROBOT.in_real_time()), CONFIG)[0]),
    }
    return lambda form: made[form]() if form in made else Filter.load(form.split()[0])


@cache
def ground():
    return Filter.load("ground")


@cache
def one_step():
    return Filter(certify(driven(trajectories=3), CONFIG)[0])


def shape(rng, at, d):
    """An obstacle of any kind at a point."""
    size, kind = tuple(rng.uniform(0.05, 0.3, 3)), rng.choice(["box", "cylinder", "sphere", "wall"])
    sizes = {"box": size[:d], "cylinder": size[: d - 1], "sphere": size[:1], "wall": ()}[kind]
    return Obstacle(kind, tuple(at), sizes, rng.uniform(-3, 3), rng.uniform(-0.05, 0.05))


def scene(rng, ready, crowd=0.5):
    """A request of a robot that moves or stands among up to five obstacles; some with widenings and predicted sets."""
    robot, d, scale = ready.robot, ready.robot.position_dim, min(ready.reach, 2.5)
    share = rng.choice([0.0, 0.3, 1.0])
    before = share * rng.uniform(robot.low(), robot.high())
    state = robot.state_at_inputs(before) + rng.uniform(-1, 1, robot.state_dim) * np.array(robot.measurement_bound)
    state[:d] = rng.uniform(-50, 50, d)
    if robot.heading is not None:
        state[robot.heading] = rng.uniform(-3, 3)
    near = []
    for _ in range(int(rng.integers(0, 6)) if rng.random() < crowd else 0):
        way = rng.normal(size=d)
        way *= (robot.footprint + rng.uniform(0.15, 2.0) * scale + 0.2) / np.linalg.norm(way)
        near.append(shape(rng, state[:d] + way, d))
    braking = np.vstack([before * share for share in robot.stop_profile()])
    predicted = ready.decide(plain(ready, state, before, before, braking)).predicted if rng.random() < 0.5 else None
    return replace(
        plain(ready, state, rng.uniform(robot.low(), robot.high()), before, braking),
        obstacles=Shapes.of(near, d),
        model=rng.choice([ready.version, UNVERIFIED, "other"]) if share else "",
        predicted=predicted,
        widening=float(rng.choice([1.0, 1.0, 1.3])),
        turn_aside=len(near) % 2 == 0,
    )


def scenes(ready, count, crowd=0.5, seed=0):
    rng = np.random.default_rng(seed)
    return [scene(rng, ready, crowd) for _ in range(count)]


def plain(ready, state, action, before, plan):
    return Request(state, action, before, plan, Shapes.of([], ready.robot.position_dim), known_free=True)


def apart(one, other):
    """Return the largest difference of two decisions' numbers."""
    parts = [(one.plan, other.plan), (one.tube_center, other.tube_center), (one.margin, other.margin)]
    parts += [(one.tube_half_width, other.tube_half_width), (one.predicted.center, other.predicted.center)]
    parts += [(one.predicted.half_width, other.predicted.half_width), (one.predicted.heading, other.predicted.heading)]
    parts += [] if one.score is None else [(one.score, other.score), (one.plan_score, other.plan_score)]
    if other.blocked_by is not None and len(other.blocked_by.normal):
        parts += [(one.blocked_by.normal, other.blocked_by.normal), (one.blocked_by.at, other.blocked_by.at)]
        parts += [(one.blocked_by.room, other.blocked_by.room)]
    return max(float(np.abs(np.asarray(a) - b).max(initial=0.0)) for a, b in parts)


def check_same(ready, requests, answers=None):
    """Check that the answers of a new batch, or these, are those of the single path. Return the answers."""
    answers = answers or BatchFilter(ready).decide(RequestArrays.of(requests))
    for row, request in enumerate(requests):
        batch, single = answers.row(row), ready.decide(request)
        for name in EQUAL:
            assert getattr(batch, name) == getattr(single, name), (row, name)
        assert (batch.score is None) == (single.score is None)
        assert (batch.blocked_by and batch.blocked_by.by) == (single.blocked_by and single.blocked_by.by)
        assert apart(batch, single) < SAME, row
    return answers


@pytest.fixture(autouse=True)
def _whole_searches(monkeypatch):
    """Let no tail of a search go to the single path for its small number of lanes."""
    monkeypatch.setattr(search_batch, "FEW", 1)


@pytest.mark.parametrize("form", FORMS)
def test_a_batch_decides_as_the_single_path(filters, form):
    ready = filters(form)
    requests = scenes(ready, 100, crowd=0.8)
    answers = check_same(ready, requests, ready.decide_batch(RequestArrays.of(requests)))
    kinds = {KINDS[kind] for row, kind in enumerate(answers.kind) if row not in answers.singly}
    assert {ALLOWED, ADJUSTED} <= kinds <= {ALLOWED, ADJUSTED, FAILSAFE}
    assert len(answers.singly) < 0.5 * len(requests)
    assert all(answers.row(row - 100).reason == answers.row(row).reason for row in range(100)), "from the end"


@pytest.mark.parametrize("form", ["ground direct", "two discs", "one-step"])
def test_a_batch_turns_blocked_robots_aside(filters, form):
    ready, rng, requests = filters(form), np.random.default_rng(1), []
    robot = ready.robot
    for _ in range(150):
        way, heading = rng.choice([1.0, -1.0]) if robot.low()[0] < 0.0 else 1.0, rng.uniform(-3, 3)
        before = np.array([way * 0.8 * robot.high()[0], 0.0])
        state = robot.state_at_inputs(before)
        state[robot.heading] = heading
        bearing = heading + rng.uniform(-0.3, 0.3) + (0.0 if way > 0.0 else np.pi)
        at = (robot.footprint + 0.1 + rng.uniform(0.0, 0.2)) * np.array([np.cos(bearing), np.sin(bearing)])
        braking = np.vstack([before * share for share in robot.stop_profile()])
        ask = plain(ready, state, before + rng.uniform(-0.1, 0.1, 2), before, braking)
        posts = [Obstacle("cylinder", tuple(at), (0.1,)), shape(rng, state[:2] + rng.normal(size=2), 2)]
        around = Shapes.of(posts[: rng.integers(1, 3)], 2)
        requests.append(replace(ask, obstacles=around, turn_aside=rng.random() < 0.9))
    answers = check_same(ready, requests)
    turned = [int(answers.turned[row]) for row in range(150) if row not in answers.singly]
    assert {1, -1} <= set(turned)


def test_a_batch_lets_standing_robots_turn_in_place():
    ready, rng, requests = ground(), np.random.default_rng(2), []
    robot = ready.robot
    for _ in range(80):
        action = np.array([rng.choice([0.0, 0.0, 0.2]), rng.uniform(-0.5, 0.5)])
        stand = plain(ready, np.zeros(5), action, np.zeros(2), np.zeros((3, 2)))
        bearings, away = rng.uniform(-3, 3, 4), robot.footprint + 0.1 + rng.uniform(-0.02, 0.2, 4)
        posts = [
            Obstacle("cylinder", (r * np.cos(angle), r * np.sin(angle)), (0.1,))
            for angle, r in zip(bearings, away, strict=True)
        ]
        around = Shapes.of(posts[: rng.integers(0, 5)], 2)
        requests.append(replace(stand, obstacles=around, widening=float(rng.choice([1.0, 1.5]))))
    answers = check_same(ready, requests)
    in_place = [row for row in range(80) if ready.turns_in_place(regressors(ready, requests[row]))]
    allowed = [row for row in in_place if KINDS[answers.kind[row]] == ALLOWED]
    assert 20 < len(allowed) < len(in_place) < 80
    assert not set(allowed) & set(answers.singly)


def regressors(ready, request):
    z_0 = np.concatenate([request.state[list(ready.robot.regressor)], request.input_in_force])
    return ready.inputs.regressors(z_0, ready.inputs.limited(request.action, request.input_in_force))


def test_the_number_of_lanes_at_once_changes_no_decision(monkeypatch):
    monkeypatch.setattr(lane_decisions, "PLAN_ROWS", 50)  # seven lanes
    check_same(ground(), scenes(ground(), 50, crowd=0.8))


def test_where_the_qps_find_nothing_for_a_rollout_a_verified_input_of_the_pattern_is_found(monkeypatch):
    ready = one_step()
    requests = [replace(request, model=ready.version) for request in among_posts(150)]

    def impossible(self, rows, z_0, proposal):
        no = np.zeros(z_0.shape[1], dtype=bool)
        return np.zeros((self.free, len(no))), no, ~no, np.zeros(len(no))

    monkeypatch.setattr(QPBatch, "solve", impossible)
    monkeypatch.setattr(plan_search, "solve", lambda program: INFEASIBLE)
    answers = check_same(ready, requests)
    adjusted = [row for row in range(len(answers)) if KINDS[answers.kind[row]] == ADJUSTED]
    assert set(adjusted) <= set(answers.singly) and (answers.margin[adjusted] >= 0.0).all()
    shares = []  # of what bounds and slew allow, from -1 to 1
    for row in adjusted:
        middle, change = ready.builder.reachable(requests[row].input_in_force)
        shares.append((answers.plan[row, 0] - middle) / change)
    apart = np.abs(shares - np.round(shares)).max(axis=1)
    assert (apart < 1e-9).sum() > 20, "the others turn in place"
    assert any(row not in answers.singly for row in range(len(answers)) if KINDS[answers.kind[row]] == FAILSAFE)


def test_a_tube_that_leads_farther_than_the_filter_looks_has_the_reason_of_the_single_path():
    ready = one_step()
    answers = check_same(ready, [replace(request, widening=100.0) for request in scenes(ready, 40)])
    assert any("looks ahead" in answers.row(row).reason for row in range(len(answers)) if row not in answers.singly)


def test_past_windows_are_scored():
    ready, rng = one_step(), np.random.default_rng(3)
    robot = ready.robot
    requests = []
    for plain_request in (scene(rng, ready) for _ in range(40)):
        widening, state_widening = rng.uniform(1.0, 1.5, 2)
        request = replace(plain_request, widening=widening, state_widening=state_widening)
        states = np.tile(request.state, (robot.horizon, 1)) + 0.01 * rng.normal(size=(robot.horizon, robot.state_dim))
        past = PastWindow(states, np.tile(request.input_in_force, (robot.horizon + 1, 1)), bool(rng.random() < 0.5))
        requests.append(replace(request, past=past if rng.random() < 0.5 else None))
    answers = check_same(ready, requests)
    assert 5 < sum(bool(scored) for scored in answers.scored) < 35
    assert (answers.plan_score < answers.score)[answers.scored].any()


def test_a_filter_that_has_decided_a_batch_can_be_copied():
    """A vector of many environments has one: it could not be given to other processes any more."""
    ready = Filter.load("ground")
    requests = RequestArrays.of(scenes(ready, 20))
    answers = ready.decide_batch(requests)
    assert np.array_equal(copy.deepcopy(ready).decide_batch(requests).plan, answers.plan)


def test_row_by_row_a_filter_states_what_it_states_in_each_row():
    ready = one_step()
    requests = RequestArrays.of(scenes(ready, 3))
    answers, whole = RowByRow(ready).decide_batch(requests), ready.decide_batch(requests)
    for name in ("bound", "judges", "outside_share"):
        assert getattr(answers, name) == getattr(whole, name) == getattr(answers.row(2), name)
    assert answers.judges and answers.bound > 0.0 and answers.outside_share > 0.0


@pytest.mark.parametrize(("crowd", "rows"), [(0.9, 40), (0.0, 5)])
def test_torch_gives_the_same_answers_in_its_own_tensors(crowd, rows):
    torch = pytest.importorskip("torch")
    ready, requests = ground(), RequestArrays.of(scenes(ground(), rows, crowd))
    theirs, ours = ready.decide_batch(requests.mapped(torch.asarray)), ready.decide_batch(requests)
    assert isinstance(theirs.plan, torch.Tensor) and set(theirs.singly) == set(ours.singly)
    assert theirs.kind.tolist() == ours.kind.tolist()
    for name in ("plan", "margin", "tube_center", "tube_half_width", "predicted_center", "predicted_half_width"):
        assert np.abs(np.asarray(getattr(theirs, name)) - getattr(ours, name)).max() < SAME
    assert theirs.row(0).kind == ours.row(0).kind


def test_obstacles_may_have_empty_slots_with_any_numbers():
    ready, requests = ground(), scenes(ground(), 30, crowd=0.9)
    arrays = RequestArrays.of(requests)
    empty = np.arange(arrays.obstacles.rho.shape[1]) >= arrays.obstacles.count[:, None]
    assert empty.any()
    arrays.obstacles.center[empty] = 1e3
    arrays.obstacles.rho[empty] = 7.0
    check_same(ready, requests, ready.decide_batch(arrays))
    arrays.obstacles.center[empty] = arrays.state[:, None, :2].repeat(empty.shape[1], axis=1)[empty]
    check_same(ready, requests, ready.decide_batch(arrays))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_verify_nothing(value):
    ready = ground()
    requests = RequestArrays.of([replace(request, model=ready.version) for request in scenes(ready, 20)])
    requests.action[3, 0] = value
    answers = ready.decide_batch(requests)
    assert KINDS[answers.kind[3]] == FAILSAFE and 3 in answers.singly
    check_same(ready, [requests.row(row) for row in range(20)], answers)
    requests.state[5, 3] = value
    with pytest.raises(BadRequest, match="row 5"):
        ready.decide_batch(requests)


@pytest.mark.parametrize("part", ["center", "rho", "half", "margin", "axes"])
def test_an_obstacle_that_is_not_finite_is_no_free_space(part):
    ready = ground()
    post = Shapes.of([POST], 2)
    one = plain(ready, np.zeros(5), np.array([0.25, 0.0]), np.zeros(2), np.zeros((3, 2)))
    requests = RequestArrays.of([replace(one, obstacles=post) for _ in range(4)])
    getattr(requests.obstacles, part)[2] = np.nan
    answers = ready.decide_batch(requests)
    assert 2 in answers.singly and KINDS[answers.kind[2]] in (FAILSAFE, RECOVERING)
    assert {KINDS[kind] for kind in answers.kind[[0, 1, 3]]} == {ADJUSTED}


IMPOSSIBLE = {"center": (np.inf, 1e90), "axes": (1e90, 0.5, 0.0), "half": (-1.0, 1e200), "rho": (-0.3, np.inf)}
IMPOSSIBLE |= {"round": (0.5, -1.0), "margin": (-np.inf, 1e90)}


@pytest.mark.parametrize("part", IMPOSSIBLE)
def test_an_impossible_obstacle_is_refused_as_such(part):
    ready = ground()
    one = plain(ready, np.zeros(5), np.array([0.25, 0.0]), np.zeros(2), np.zeros((3, 2)))
    for value in IMPOSSIBLE[part]:
        requests = RequestArrays.of([replace(one, obstacles=Shapes.of([POST], 2)) for _ in range(3)])
        getattr(requests.obstacles, part).reshape(3, -1)[2, 0] = value
        with pytest.raises(BadRequest, match="row 2") as refusal:
            ready.decide_batch(requests)
        assert refusal.value.field == "obstacles"


@pytest.mark.parametrize("margin", [-0.15, -0.3, -1e3])
@pytest.mark.parametrize("motion", [None, Motion((-1.0, 0.0), position_error=0.03, acceleration=1.0)])
def test_the_robots_centre_keeps_out_of_an_obstacle_with_any_margin(margin, motion):
    ready, decided = ground(), []
    one = plain(ready, np.zeros(5), np.array([0.25, 0.0]), np.zeros(2), np.zeros((3, 2)))
    for each in (-GROUND.footprint, margin):
        post = Obstacle("cylinder", (0.12, 0.0), (0.1,), margin=each, motion=motion)
        standing, moving = split_moving([post], 2)
        asked = replace(one, obstacles=standing, movers=moving)
        decided.append(ready.decide(asked))
        if motion is None:
            decided.append(ready.decide_batch(RequestArrays.of([asked] * 2)).row(1))
    assert len({(d.kind, d.verified, d.margin, *d.plan[0]) for d in decided}) == 1 and decided[0].kind != ALLOWED


def test_an_invalid_batch_is_refused_with_the_fields_name():
    arrays = RequestArrays.of(scenes(ground(), 4, crowd=1.0))
    around, none = arrays.obstacles, np.zeros(4, dtype=int)
    for field, changes in (
        ("state", {"state": arrays.state[:, :4]}),
        ("plan", {"plan": arrays.plan[:3]}),
        ("obstacles.margin", {"obstacles": replace(around, margin=around.margin[:, :0])}),
        ("obstacles.count", {"obstacles": replace(around, count=around.count.astype(np.uint8))}),
        ("obstacles.count", {"obstacles": replace(around, count=around.count + 9)}),
        ("model", {"model": ["a"]}),
        ("state", {"state": arrays.state.astype(np.float32)}),
        ("known_free", {"known_free": np.ones(4)}),
        ("widening", {"widening": np.array([1.0, 1.0, 0.9, 1.0])}),
        ("plan", {"plan": arrays.plan + 0.1}),
        ("obstacles", {"obstacles": replace(around, count=none), "known_free": none.astype(bool)}),
    ):
        with pytest.raises(BadRequest) as refusal:
            ground().decide_batch(replace(arrays, **changes))
        assert refusal.value.field == field


# --- what the batch does not decide itself -------------------------------------------------------------------------


def test_what_the_batch_does_not_cover_is_decided_singly(monkeypatch):
    ready = ground()
    stand = plain(ready, np.zeros(5), np.array([0.2, 0.1]), np.zeros(2), np.zeros((3, 2)))
    outside = replace(stand, state=np.array([0.0, 0.0, 0.0, 5.0, 0.0]))
    post = Shapes.of([Obstacle("cylinder", (0.25, 0.0), (0.1,))], 2)
    standing = replace(stand, action=np.array([0.2, 0.4]), obstacles=post)  # it may turn in place
    assert sorted(check_same(ready, [stand, outside, standing]).singly) == [1, 2]
    requests, batch = scenes(ready, 5), BatchFilter(ready)
    assert batch.covers
    monkeypatch.setattr(batch, "covers", False)  # as it is for some robots
    assert len(check_same(ready, requests, batch.decide(RequestArrays.of(requests))).singly) == 5


def test_an_unsure_comparison_goes_to_the_single_path(monkeypatch):
    monkeypatch.setattr(search_batch, "ROUNDING", np.inf)
    assert len(check_same(ground(), scenes(ground(), 60, crowd=1.0)).singly) > 30


def test_decide_all_keeps_the_order_and_decides_singly_what_does_not_fit():
    ready, requests = ground(), scenes(ground(), WORTH + 10)
    mover = Obstacle("cylinder", (3.0, 0.0), (0.1,), motion=Motion(velocity=(0.0, 0.1), position_error=0.01, speed=0.2))
    requests[4] = replace(requests[4], movers=split_moving([mover], 2)[1])
    for decision, request in zip(ready.decide_all(requests), requests, strict=True):
        single = ready.decide(request)
        assert decision.kind == single.kind and apart(decision, single) < SAME
    assert len(ready.decide_all(requests[:3])) == 3
    with pytest.raises(BadRequest, match="obstacles"):
        ready.decide_all([*requests, replace(requests[0], obstacles=Shapes.of([], 2), known_free=False)])


def test_what_has_no_place_in_a_batch_is_not_left_out_in_silence():
    mover = Obstacle("cylinder", (0.3, 0.0), (0.1,), motion=Motion(velocity=(0.0, 0.1), position_error=0.01, speed=0.2))
    one = replace(scenes(ground(), 1)[0], known_free=True)
    reserved = ground().standing_reservation(one.state)
    for wrong, what in (
        ({"movers": split_moving([mover], 2)[1]}, "moving obstacles"),
        ({"scan": Scan(np.ones(4), np.arange(4.0), (0.0, 0.0, 0.0))}, "a scan"),
        ({"reservation": reserved, "other_reservations": OtherReservations.to([reserved])}, "a reservation, reserv"),
    ):
        with pytest.raises(BadRequest, match=f"row 1: a batch has no place for {what}.*decide_all"):
            RequestArrays.of([one, replace(one, **wrong)])
    with pytest.raises(BadRequest, match=r"one age, not \[0.0, 0.2\]"):
        RequestArrays.of([one, replace(one, acceleration_age=0.2)])
    assert RequestArrays.of([replace(one, acceleration_age=0.2)]).acceleration_age == 0.2
    with pytest.raises(ValueError, match="at least one request"):
        RequestArrays.of([])


def test_a_client_in_process_asks_for_many_at_once(monkeypatch):
    ready, asked, decide = ground(), [], ground().decide_batch
    monkeypatch.setattr(ready, "decide_batch", lambda arrays: asked.append(len(arrays)) or decide(arrays))
    client, plans = InProcess(ready), [BackupPlan(ready.robot) for _ in range(WORTH)]
    actions = np.random.default_rng(12).uniform([0.0, -0.5], [0.25, 0.5], (len(plans), 2))
    requests = [
        client.request(*parts, known_free=True) for parts in zip(plans, np.zeros((WORTH, 5)), actions, strict=True)
    ]
    answers = client.decide_all(plans, requests)
    assert asked == [len(plans)]
    assert all((answer.plan[0] == plan.input_in_force).all() for answer, plan in zip(answers, plans, strict=True))


# --- nothing is believed -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["ground direct", "one-step"])
def test_a_wrong_answer_of_the_solver_is_not_verified(filters, form, monkeypatch):
    """The solver returns the proposal as the solution of every QP."""
    ready = filters(form)
    requests = scenes(ready, 60, crowd=1.0)

    def wrong(self, rows, z_0, proposal):
        everywhere = np.ones(proposal.shape[1], dtype=bool)
        return np.tile(proposal, (self.free // len(proposal), 1)), everywhere, ~everywhere, np.zeros(proposal.shape[1])

    monkeypatch.setattr(qp_batch.QPBatch, "solve", wrong)
    answers = BatchFilter(ready).decide(RequestArrays.of(requests))
    for row, request in enumerate(requests):
        single = ready.decide(request)
        assert row in answers.singly or KINDS[answers.kind[row]] == single.kind or single.kind in (ADJUSTED, ALLOWED)
        assert single.verified or not answers.verified[row]
        if row not in answers.singly and KINDS[answers.kind[row]] == ADJUSTED:
            assert exact_margin(ready, request, answers.plan[row][0]) >= 0.0


def exact_margin(ready, request, first):
    """Return the margin of an input, then braking, by the single path's own constraints."""
    robot = ready.robot
    z_0 = np.concatenate([request.state[list(robot.regressor)], request.input_in_force])
    reachable = ready.builder.reachable(request.input_in_force)
    around = ready.constraints.local_map(request, z_0, reachable)
    z = ready.inputs.regressors(z_0, np.ascontiguousarray(first))
    return ready.constraints_for(z, request.widening).margin_in(around, z)
