"""`decide`: what it lets through is clear of the obstacles, closest to the proposal, and never a dead end."""

from dataclasses import replace

import numpy as np
import pytest

from messaging.robots import Disc
from messaging.shapes import Obstacle, Shapes, rotate
from safety.certificates import KINDS, Certificate
from safety.commitment import UNVERIFIED, Commitment, Prediction, correction_penalty
from safety.filter import Filter, _Attempt
from safety.model_set import ModelSet, Recipe
from safety.request import ADJUSTED, ALLOWED, FAILSAFE, BadRequest, Request
from tests.robots import GROUND, QUADROTOR
from tests.safety.unicycle import FIX, Unicycle

NONE = Shapes.of([], 2)
STILL = np.zeros((3, 2))


def cylinder(x, y, radius=0.1):
    return Obstacle("cylinder", (x, y), (radius,))


def request(state=(0, 0, 0, 0, 0), action=(0.25, 0.0), obstacles=(), **more):
    """Standing still by default."""
    state = np.array(state, float)
    return Request(
        state=state,
        action=np.array(action, float),
        input_in_force=more.pop("input_in_force", state[3:].copy()),
        plan=more.pop("plan", STILL),
        obstacles=obstacles if isinstance(obstacles, Shapes) else Shapes.of(list(obstacles), 2),
        **more,
    )


def random_request(rng, count=4, nearest=0.27):
    heading, v, w = rng.uniform(-3, 3), rng.uniform(0, 0.25), rng.uniform(-0.5, 0.5)
    angles, ways = rng.uniform(-np.pi, np.pi, count), rng.uniform(nearest, 0.45, count)
    around = [cylinder(1 + r * np.cos(a), 2 + r * np.sin(a)) for a, r in zip(angles, ways, strict=True)]
    return request((1, 2, heading, v, w), rng.uniform([0, -0.5], [0.25, 0.5]), around)


def same(one, other):
    """Equal in every bit but the times."""
    for name in ("plan", "tube_center", "tube_half_width"):
        if getattr(one, name).tobytes() != getattr(other, name).tobytes():
            return False
    if one.predicted.center.tobytes() != other.predicted.center.tobytes():
        return False
    names = (
        "kind",
        "margin",
        "at_least",
        "model",
        "reason",
        "verified",
        "contained",
        "compared",
        "solver",
        "iterations",
    )
    return all(getattr(one, name) == getattr(other, name) for name in names)


# --- an exact check of its own ------------------------------------------------------------------------------------


def fits(model: ModelSet, ask: Request, free):
    """Smallest distance of the tube under a free input to the obstacles less footprint and Z_v, written out slowly.

    By sampling the boundary of each step's set and of the hull of two steps: no half-spaces.
    """
    z = np.concatenate([ask.state[3:], ask.input_in_force, free])
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    corners = [np.zeros((1, 2))]
    for step in model.steps:
        half = (np.abs(step.W @ z) @ step.M.T + np.abs(z) @ step.kappa.T + step.w)[:2]
        corners.append(step.C[:2] @ z + half * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]))
    bulge = np.abs(z) @ model.bulges.kappa.T + model.bulges.w
    latch = (np.abs(z) @ model.latch.kappa.T + model.latch.w)[0]
    noise = np.array(GROUND.measurement_bound[:2]) * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    worst = np.inf
    for k in range(len(model.steps)):
        pairs = [(a, b) for a in corners[k] for b in corners[k + 1]]
        share = np.linspace(0, 1, 9)[:, None]
        chords = np.concatenate([a + share * (b - a) for a, b in pairs])
        grown = (chords[:, None] + GROUND.footprint * circle + bulge[k] * circle).reshape(-1, 2)
        world = ask.state[:2] + rotate(grown, ask.state[2])
        world = (world[:, None] + noise).reshape(-1, 2)
        worst = min(worst, float(ask.obstacles.distance(world).min()))
    stopped = corners[-1][:, None] + (GROUND.footprint + latch) * circle
    world = ask.state[:2] + rotate(stopped.reshape(-1, 2), ask.state[2])
    return min(worst, float(ask.obstacles.distance((world[:, None] + noise).reshape(-1, 2)).min()))


# --- kinds --------------------------------------------------------------------------------------------------------


def test_far_from_everything_the_proposal_is_allowed(ready):
    decision = ready.decide(request(action=(0.2, -0.3), obstacles=[cylinder(2, 0)]))
    assert decision.kind == ALLOWED
    assert decision.reason == decision.solver == ""
    assert np.array_equal(decision.plan, [[0.2, -0.3], [0, 0], [0, 0]])
    assert decision.verified
    assert decision.contained
    assert not decision.compared


@pytest.mark.parametrize("way", [0.28, 0.35, 0.45, 0.7])
def test_the_margin_is_the_way_to_the_obstacle_however_far_it_is(model, ready, way):
    """Obstacles beyond the reach of any plan decide nothing, but they are what is near."""
    ask = request(obstacles=[cylinder(way, 0.0)])
    decision = ready.decide(ask)
    clear = fits(model, ask, decision.action)
    assert clear - 0.01 <= decision.margin <= clear + 1e-3
    assert decision.at_least == (way - 0.1 > ready.reach), "beyond the reach it is a lower bound, and said to be"


def test_where_nothing_is_near_the_margin_says_that_it_is_only_a_bound(ready):
    for obstacles in ([], [cylinder(2.0, 0.0)]):
        decision = ready.decide(request(action=(0.2, -0.3), obstacles=obstacles))
        assert decision.at_least
        assert ready.reach < decision.margin < GROUND.sight - GROUND.footprint
    behind = ready.decide(request(action=(0.2, -0.3), obstacles=[cylinder(-0.31, 0.0), cylinder(0.34, 0.0)]))
    alone = ready.decide(request(action=(0.2, -0.3), obstacles=[cylinder(0.34, 0.0)]))
    assert behind.margin == alone.margin < ready.reach, "near but behind, one farther away is closer to the tube"


def test_allowed_is_the_proposal_clipped_to_the_bounds(ready):
    decision = ready.decide(request(action=(7.0, -3.0)))
    assert decision.kind == ALLOWED
    assert np.array_equal(decision.action, [0.25, -0.5])
    assert correction_penalty(GROUND, (7.0, -3.0), np.zeros(2), decision.action, 1.0) == 0.0


def test_the_penalty_counts_from_what_bounds_and_slew_let_pass():
    before, wanted = np.array([1.0, 0.0, -4.9]), (5.0, 0.1, -9.0)
    assert correction_penalty(QUADROTOR, wanted, before, (1.8, 0.1, -5.0), 2.0) == pytest.approx(0.0)
    assert correction_penalty(QUADROTOR, wanted, before, (0.8, 0.1, -5.0), 2.0) == pytest.approx(0.2)
    assert correction_penalty(QUADROTOR, (np.nan, 0.1, np.inf), before, (0.2, 0.1, -4.1), 1.0) == pytest.approx(0.0)


def test_a_slew_limit_is_kept():
    """On a robot that has one; the model set is a made-up integrator's."""
    robot = replace(GROUND, action_slew=(0.05, 0.1))

    def certificate(C, w):
        n, nz = C.shape
        return Certificate(C, np.zeros((0, nz)), np.zeros((n, 0)), np.zeros((n, nz)), np.full(n, w), np.eye(n))

    steps = []
    for _ in range(3):
        C = np.zeros((5, 6))
        C[0, 4] = C[2, 5] = 0.2
        steps.append(certificate(C, 0.002))
    domain = np.array([[-0.1, -0.6, 0.0, -0.5], [0.3, 0.6, 0.25, 0.5]])
    nothing = certificate(np.zeros((3, 6)), 0.001), certificate(np.zeros((1, 6)), 0.001)
    ready = Filter(ModelSet(robot, Recipe(), tuple(steps), *nothing, domain, np.eye(6), {}))
    found = ready.decide(request((0, 0, 0, 0.2, 0), (0.0, 0.5), [cylinder(2, 0)]))
    assert found.kind == ALLOWED
    assert np.allclose(found.action, [0.15, 0.1])
    for x in np.linspace(0.24, 0.28, 9):
        found = ready.decide(request((0, 0, 0, 0.15, 0), (0.25, 0.5), [cylinder(x, 0.02)]))
        if found.kind != FAILSAFE:
            assert 0.1 - 1e-12 <= found.action[0] <= 0.2 + 1e-12
            assert abs(found.action[1]) <= 0.1 + 1e-12


def test_adjusted_is_the_closest_input_that_can_be_verified(ready):
    """Against a fine grid of inputs, each checked by the filter's own exact check of it as a proposal's tube."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.linspace(0, 0.25, 41), np.linspace(-0.5, 0.5, 41)), -1).reshape(-1, 2)
    width = GROUND.high() - GROUND.low()
    adjusted = 0
    for _ in range(300):
        ask = random_request(rng)
        decision = ready.decide(ask)
        if decision.kind != ADJUSTED:
            continue
        adjusted += 1
        z_0 = np.concatenate([ask.state[3:], ask.input_in_force])
        scene = ready.around.scene(ask)
        rows = ready.around.rows(scene, np.concatenate([z_0, ready.inputs.limited(ask.action, ask.input_in_force)]))
        kept = ready._comfortable(rows, z_0, ready.inputs.limited(ask.action, ask.input_in_force))
        taken = np.linalg.norm((decision.action - ask.action) / width)
        best = np.inf
        for u in grid:
            if ready.around.margin(kept, np.concatenate([z_0, u])) >= 0.0:
                best = min(best, np.linalg.norm((u - ask.action) / width))
        assert taken <= best + 2e-3
        if adjusted == 12:
            break
    assert adjusted == 12


@pytest.mark.parametrize("kind", KINDS)
def test_every_plan_that_leaves_is_clear_and_ends_in_a_stop(models, kind):
    model = models[kind, "direct"]
    ready = Filter(model)
    rng = np.random.default_rng(1)
    kinds = set()
    for _ in range(400):
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
        assert fits(model, ask, decision.action) > 0.0
    assert {ALLOWED, ADJUSTED} <= kinds


def test_comfort_apart_a_proposal_is_only_changed_if_its_tube_does_not_fit(ready, model):
    """The price of half-spaces: with one obstacle there is none."""
    rng = np.random.default_rng(2)
    for _ in range(300):
        ask = random_request(rng, count=1)
        roomy = fits(model, ask, ask.action) > ready.comfort + 0.02
        if roomy:
            assert ready.decide(ask).kind == ALLOWED


def test_the_tube_is_of_true_positions_and_holds_them(ready):
    rng = np.random.default_rng(3)
    outside = 0
    for _ in range(300):
        robot = Unicycle((0.3, -0.2, rng.uniform(-3, 3)), rng)
        state = robot.measure()
        decision = ready.decide(request(state, rng.uniform([0, -0.5], [0.25, 0.5]), input_in_force=np.zeros(2)))
        for k in range(3):
            robot.step(decision.plan[k])
            if k == 0:
                assert decision.predicted.contains(GROUND, robot.measure())
            off = np.abs(robot.state[:2] - decision.tube_center[k])
            outside += bool((off > decision.tube_half_width[k]).any())
    assert outside == 0


@pytest.mark.parametrize("kind", [ALLOWED, ADJUSTED, FAILSAFE])
def test_the_prediction_holds_for_every_kind(ready, kind):
    rng = np.random.default_rng(4)
    found = 0
    for _ in range(3000):
        robot = Unicycle((0, 0, rng.uniform(-3, 3)), rng)
        before = rng.uniform([0, -0.5], [0.25, 0.5])
        robot.step(before)
        state, angle = robot.measure(), rng.uniform(-0.8, 0.8)
        away = 0.24 if kind == FAILSAFE else 0.29
        place = state[:2] + away * np.array([np.cos(state[2] + angle), np.sin(state[2] + angle)])
        obstacles = [] if kind == ALLOWED else [cylinder(*place)]
        decision = ready.decide(request(state, (0.25, 0.1), obstacles, input_in_force=before, model=ready.version))
        if decision.kind != kind:
            continue
        robot.step(decision.action)
        assert decision.predicted.contains(GROUND, robot.measure())
        found += 1
        if found == 100:
            return
    raise AssertionError(f"only {found} decisions were {kind}")


# --- requests that can't be decided on -----------------------------------------------------------------------------

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("state", np.array([NAN, 0, 0, 0, 0])),
        ("state", np.array([0, 0, INF, 0, 0])),
        ("state", np.zeros(4)),
        ("state", np.array([1e9, 0, 0, 0, 0])),
        ("action", np.array([NAN, 0])),
        ("action", np.array([0, -INF])),
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
        ("observation", np.zeros(7, np.float32)),
    ],
)
def test_bad_requests_are_refused_by_the_field(ready, field, value):
    with pytest.raises(BadRequest) as caught:
        ready.decide(replace(request(), **{field: value}))
    assert caught.value.field == field
    assert ready.decide(request()).kind == ALLOWED


@pytest.mark.parametrize(
    ("field", "center", "half", "heading"),
    [
        ("predicted_center", np.full(5, NAN), np.ones(5), 0.0),
        ("predicted_center", np.zeros(4), np.ones(4), 0.0),
        ("predicted_half_width", np.zeros(5), np.full(5, INF), 0.0),
        ("predicted_half_width", np.zeros(5), np.zeros(0), 0.0),
        ("predicted_half_width", np.zeros(5), -np.ones(5), 0.0),
        ("predicted_heading", np.zeros(5), np.ones(5), NAN),
    ],
)
def test_bad_predictions_are_refused_by_the_field(ready, field, center, half, heading):
    with pytest.raises(BadRequest) as caught:
        ready.decide(request(predicted=Prediction(center, half, heading)))
    assert caught.value.field == field


def test_an_obstacle_whose_distance_is_no_number_is_never_overlooked(ready):
    near = Shapes.of([cylinder(0.4, 0)], 2)
    broken = replace(near, center=near.center * NAN)
    decision = ready.decide(request(obstacles=broken))
    assert decision.kind == FAILSAFE
    assert not decision.action.any()


# --- the committed plan -------------------------------------------------------------------------------------------


def moving(tail=((0, 0), (0, 0), (0, 0)), x=0.215, **more):
    """At full speed before an obstacle so near that only the committed plan is left."""
    more = {"input_in_force": np.array([0.25, 0.0]), "plan": np.array(tail, float)} | more
    return request((0, 0, 0, 0.25, 0.0), (0.25, 0.0), [cylinder(x, 0)], **more)


def test_failsafe_is_the_committed_plans_next_input(ready):
    tail = ((0.0, 0.1), (0, 0), (0, 0))
    decision = ready.decide(moving(tail, model=ready.version))
    assert decision.kind == FAILSAFE
    assert decision.verified
    assert np.array_equal(decision.plan, tail)
    assert decision.margin < 0.0
    assert "no verified input" in decision.reason


def test_a_plan_that_nobody_vouches_for_is_not_called_verified(ready):
    """No model's version although something moves; a plan marked as unverified; a prediction that did not hold."""
    tail = ((0.2, 0.0), (0, 0), (0, 0))
    wrong = Prediction(np.full(5, 3.0), np.full(5, 0.01), 0.0)
    for more in (
        {"model": ""},
        {"model": UNVERIFIED},
        {"model": "0123456789ab"},
        {"model": ready.version, "predicted": wrong},
        {"model": "", "plan": STILL},
    ):
        decision = ready.decide(moving(tail, **more) if "plan" not in more else moving(**more))
        assert decision.kind == FAILSAFE
        assert not decision.verified
        assert not decision.plan.any(), "brake"
        assert decision.contained == ("predicted" not in more)
    assert not ready.decide(moving(model="", plan=STILL)).verified


@pytest.mark.parametrize("version", ["0123456789ab", UNVERIFIED])
def test_an_older_models_tail_is_verified_anew(ready, version):
    """Where there is room for it; but a tube from outside the recorded domain verifies nothing."""
    for x, in_domain, verified in ((0.6, True, True), (0.6, False, False), (0.215, True, False)):
        ask = moving(((0.1, 0.2), (0, 0), (0, 0)), x, model=version)
        z_0 = np.concatenate([ask.state[3:], ask.input_in_force])
        found = ready._committed(ask, ready.around.scene(ask), z_0, _Attempt(0), in_domain)
        assert found.verified == verified
        assert np.array_equal(found.plan, ask.plan if verified else STILL)


def test_outside_the_recorded_domain_nothing_new_is_verified(ready):
    ask = request((0, 0, 0, 0.6, 0.0), (0.1, 0.0), input_in_force=np.array([0.25, 0.0]))
    decision = ready.decide(replace(ask, model="0123456789ab"))
    assert decision.kind == FAILSAFE
    assert not decision.verified
    assert "domain" in decision.reason
    trusted = ready.decide(replace(ask, model=ready.version))
    assert trusted.kind == FAILSAFE
    assert trusted.verified, "the plan was verified when it was made"


def test_after_a_violation_the_proposal_may_still_be_verified_from_the_new_measurement(ready):
    wrong = Prediction(np.full(5, 3.0), np.full(5, 0.01), 0.0)
    decision = ready.decide(request(predicted=wrong))
    assert decision.kind == ALLOWED
    assert decision.compared
    assert not decision.contained


def test_standing_still_needs_nobodys_word(ready):
    decision = ready.decide(request(obstacles=[cylinder(0.2, 0)]))
    assert decision.kind == FAILSAFE
    assert decision.verified
    assert not decision.plan.any()


def test_what_was_not_verified_stays_so_until_the_robot_stands():
    kept = Commitment(GROUND)
    assert kept.model == ""
    kept.accept(np.array([[0.2, 0.1], [0, 0], [0, 0]]), "v1", None, True)
    assert kept.model == "v1"
    assert np.array_equal(kept.input_in_force, [0.2, 0.1])
    kept.fallback()
    assert kept.model == "", "it stands on a verified plan"
    kept.accept(np.array([[0.2, 0.1], [0, 0], [0, 0]]), "v1", None, True)
    kept.accept(STILL, "v1", None, False)
    assert kept.model == UNVERIFIED
    kept.accept(STILL, "v1", None, False)
    assert kept.model == UNVERIFIED
    kept.fallback()
    assert kept.model == "", "it has stood for a whole plan"
    kept.accept(STILL, "v1", None, False)
    kept.accept(np.array([[0.2, 0.1], [0, 0], [0, 0]]), "v2", None, True)
    assert kept.model == "v2"
    kept.reset()
    assert (kept.model, kept.predicted) == ("", None)


def test_predictions_are_boxes_in_their_own_frame():
    box = Prediction(np.array([1.0, 2.0, 3.1, 0.1, 0.0]), np.array([0.2, 0.01, 0.1, 0.1, 0.1]), np.pi / 2)
    assert box.contains(GROUND, np.array([1.0, 2.15, -3.1, 0.1, 0.0]))  # the heading wraps
    assert not box.contains(GROUND, np.array([1.15, 2.0, 3.1, 0.1, 0.0]))
    assert not box.contains(GROUND, np.array([1.0, 2.0, 3.1, 0.3, 0.0]))
    assert not box.contains(GROUND, np.array([NAN, 2.0, 3.1, 0.1, 0.0]))


# --- a pure function ----------------------------------------------------------------------------------------------


def test_the_same_request_has_the_same_answer_whatever_came_between(model):
    rng = np.random.default_rng(6)
    asks = [random_request(rng) for _ in range(60)]
    first = Filter(model)
    once = [first.decide(ask) for ask in asks]
    other = Filter(ModelSet.decode(model.encode()))
    for i in rng.permutation(60):
        assert same(first.decide(asks[i]), once[i])
        assert same(other.decide(asks[i]), once[i])


def test_a_moved_and_turned_scene_has_the_same_answer(model):
    """But for Z_v, a box in the world's axes."""
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


# --- closed loop --------------------------------------------------------------------------------------------------

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


def clearance(obstacles, point):
    """Distance of a true position to the solids, by their definitions."""
    ways = []
    for o in obstacles:
        offset = np.asarray(point) - np.array(o.position)
        local = rotate(offset, -o.yaw)
        if o.kind == "wall":
            ways.append(local[0])
        elif o.kind == "cylinder":
            ways.append(np.hypot(*offset) - o.size[0])
        else:
            ways.append(np.hypot(*np.maximum(np.abs(local) - 0.5 * np.array(o.size), 0.0)))
    return min(ways)


def drive(ready, obstacles, policy, steps, seed, start=(0, 0, 0)):
    """Kinds, smallest clearance of the disc at any sub-step, violations, longest wait for a wanted turn."""
    rng = np.random.default_rng(seed)
    robot = Unicycle(start, rng)
    kept, shapes = Commitment(GROUND), Shapes.of(obstacles, 2)
    counts, least, violations, waiting, longest = dict.fromkeys((ALLOWED, ADJUSTED, FAILSAFE), 0), np.inf, 0, 0, 0
    for k in range(steps):
        state, action = robot.measure(), np.array(policy(k, rng, robot))
        decision = ready.decide(
            Request(state, action, kept.input_in_force, kept.plan, shapes, kept.model, kept.predicted)
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
        least = min(least, min(clearance(obstacles, p) for p in points) - GROUND.footprint)
    return counts, least, violations, longest


def wild(k, rng, robot):
    return rng.uniform([-0.1, -0.7], [0.4, 0.7])


def pushing(k, rng, robot):
    """Full speed ahead for a while, then a turn in place: it must be possible again and again."""
    return (0.25, 0.0) if k % 60 < 30 else (0.0, 0.5 if (k // 60) % 2 else -0.5)


@pytest.mark.parametrize("policy", [wild, pushing])
@pytest.mark.parametrize("obstacles", [ROOM, CORRIDOR], ids=["room", "corridor"])
def test_the_robot_never_hits_anything_and_never_gets_stuck(ready, obstacles, policy):
    counts, least, violations, longest = drive(ready, obstacles, policy, 2500, seed=11)
    assert least > 0.0
    assert violations <= 5
    assert counts[ADJUSTED] > 20
    assert counts[ALLOWED] > 500
    assert longest < 100


@pytest.mark.parametrize("kind", ["set-membership", "matrix-zonotope"])
def test_the_other_certificates_hit_nothing_either(models, kind):
    counts, least, violations, _ = drive(Filter(models[kind, "direct"]), ROOM, wild, 1200, seed=12)
    assert least > 0.0
    assert violations == 0
    assert counts[ALLOWED] + counts[ADJUSTED] > 300


def test_the_recursion_hits_nothing_either(models):
    _, least, violations, _ = drive(Filter(models["residual", "recursion"]), ROOM, wild, 1200, seed=13)
    assert least > 0.0
    assert violations <= 3


def test_a_robot_that_slips_more_than_recorded_is_noticed(ready):
    rng = np.random.default_rng(14)
    robot, kept, violations = Unicycle((0, 0, 0), rng, slip=0.3), Commitment(GROUND), 0
    for _ in range(100):
        decision = ready.decide(
            Request(
                robot.measure(), np.array([0.25, 0.1]), kept.input_in_force, kept.plan, NONE, kept.model, kept.predicted
            )
        )
        violations += not decision.contained
        robot.step(kept.accept(decision.plan, decision.model, decision.predicted, decision.verified))
    assert violations > 50


# --- mutations: what the tests above would notice -----------------------------------------------------------------


def without_footprint(model):
    return Filter(replace(model, robot=replace(GROUND, body=(Disc((0.0, 0.0), 0.05),))))


def with_half_the_width(model):
    thin = tuple(replace(s, kappa=0.1 * s.kappa, w=0.1 * s.w) for s in model.steps)
    return Filter(replace(model, steps=thin))


def without_measurement_error(model):
    robot = replace(GROUND, measurement_bound=(0.0, 0.0, *GROUND.measurement_bound[2:]))
    return Filter(replace(model, robot=robot))


def without_bulge(model):
    return Filter(replace(model, bulges=replace(model.bulges, w=model.bulges.w - EXTRA)))


def without_latch(model):
    return Filter(replace(model, latch=replace(model.latch, w=model.latch.w - EXTRA)))


EXTRA = 0.02  # m; this robot hardly bulges and stops at once: let it be worse


@pytest.mark.parametrize(
    "mutant", [without_footprint, with_half_the_width, without_measurement_error, without_bulge, without_latch]
)
def test_what_is_left_out_is_noticed(model, mutant):
    bulges, latch = replace(model.bulges, w=model.bulges.w + EXTRA), replace(model.latch, w=model.latch.w + EXTRA)
    if mutant in (without_bulge, without_latch):
        model = replace(model, bulges=bulges) if mutant is without_bulge else replace(model, latch=latch)
    ready, honest = mutant(model), Filter(model)
    noticed = 0
    for x in np.linspace(0.11, 0.2, 150):  # a wall ahead: from right before it to well off
        ask = request((0, 0, 0, 0.2, 0), (0.25, 0.0), [Obstacle("wall", (x, 0.0), (), np.pi)])
        decision, right = ready.decide(ask), honest.decide(ask)
        noticed += decision.kind != FAILSAFE and fits(model, ask, decision.action) <= 0.0
        assert right.kind == FAILSAFE or fits(model, ask, right.action) > 0.0
    assert noticed > 0


def test_dropping_the_footprint_is_a_collision(model):
    _, least, _, _ = drive(without_footprint(model), ROOM, pushing, 600, seed=16)
    assert least < 0.0


def test_the_reach_covers_every_plan(ready):
    """No obstacle beyond the reach can matter: the farthest point of any plan's tube, by brute force."""
    rng = np.random.default_rng(17)
    farthest = 0.0
    for _ in range(2000):
        z = rng.uniform([*ready.domain[0], *GROUND.low()], [*ready.domain[1], *GROUND.high()])
        sizes = ready.tube.magnitudes(z)
        half = np.abs(ready.tube.directions) @ sizes[: ready.tube.generators]
        way = np.linalg.norm(np.abs(ready.tube.centers(z)) + half, axis=1).max()
        farthest = max(farthest, way + GROUND.footprint + FIX + sizes[ready.tube.generators :].max())
    assert farthest < ready.reach <= GROUND.sight
