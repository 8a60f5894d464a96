"""SECAS alone: the closed form against the QP, and decisions under known constraints."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.errors import BadModel, BadRequest
from brakeline.messaging.perceptrons import Perceptrons
from brakeline.messaging.ray_directions import planar_rays
from brakeline.safety.filter.backup_plan import UNVERIFIED
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.secas import Constraints, Secas, closed_form, quadratic
from tests.robots import GROUND, QUADROTOR
from tests.safety.rivals.test_sailr import request
from tests.safety.served import ServiceClient

WIDE = np.full(3, 10.0)
SAME = 5e-3  # of scaled input: where the price of a violation ends is known to the solver's accuracy by its curvature
vectors = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).map(np.array)


@settings(max_examples=60)
@given(vectors, vectors.filter(lambda g: np.linalg.norm(g) > 0.1), st.floats(-1.0, 1.0))
def test_the_closed_form_is_the_qp_with_one_constraint(r, g, d):
    G, bound = g[None], np.array([d])
    mine, (qp, _, _) = closed_form(r, G, bound), quadratic(r, G, bound, -WIDE, WIDE)
    assert np.allclose(mine, qp, atol=SAME)
    assert g @ mine <= d + 1e-9
    assert np.array_equal(mine, r) == (g @ r <= d)


@settings(max_examples=60)
@given(vectors, st.integers(0, 2**31))
def test_the_closed_form_is_the_qp_where_one_of_several_is_active(r, seed):
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(4, 3))
    G /= np.linalg.norm(G, axis=1, keepdims=True)
    d = G @ r + rng.uniform(0.5, 1.0, 4)
    d[2] -= 1.2  # the one that is violated
    mine = closed_form(r, G, d)
    assert G[2] @ mine == pytest.approx(d[2]), "the violated constraint is met"
    if (G @ mine <= d).all():
        assert np.allclose(mine, quadratic(r, G, d, -WIDE, WIDE)[0], atol=SAME)


@settings(max_examples=60)
@given(st.integers(0, 2**31))
def test_the_qp_is_the_closest_of_all_inputs_that_meet_every_constraint(seed):
    rng = np.random.default_rng(seed)
    r, G = rng.uniform(-1, 1, 2), rng.normal(size=(5, 2))
    G /= np.linalg.norm(G, axis=1, keepdims=True)
    inside = rng.uniform(-0.8, 0.8, 2)
    d = G @ inside + rng.uniform(0.0, 0.3, 5)
    a, _, _ = quadratic(r, G, d, -np.ones(2), np.ones(2))
    assert (G @ a <= d + SAME).all() and (np.abs(a) <= 1.0 + SAME).all()
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 161)] * 2), -1).reshape(-1, 2)
    best = np.linalg.norm(grid[(grid @ G.T <= d).all(1)] - r, axis=1).min(initial=np.inf)
    assert np.linalg.norm(a - r) <= best + SAME


def test_the_worst_violation_is_minimal_if_no_input_meets_all_constraints():
    G, d = np.array([[1.0, 0.0], [-1.0, 0.0]]), np.array([-0.4, -0.2])  # a <= -0.4 and a >= 0.2
    a, _, _ = quadratic(np.array([0.9, 0.3]), G, d, -np.ones(2), np.ones(2))
    assert a == pytest.approx([-0.1, 0.3], abs=1e-3)


def test_a_constraint_that_the_input_does_not_move_is_left_alone():
    r = np.array([0.3, -0.2])
    for G in (np.zeros((2, 2)), np.full((1, 2), 1e-5)):
        assert np.array_equal(closed_form(r, G, np.full(len(G), -1.0)), r)
        assert quadratic(r, G, np.full(len(G), -1.0), -np.ones(2), np.ones(2))[0] == pytest.approx(r, abs=1e-4)


# --- decisions -----------------------------------------------------------------------------------------------------

CLEARANCE = 0.2
REACT = np.array([0.06, 0.0])  # m that a sector comes nearer at full speed


def known(g=REACT, robot=GROUND, **settings) -> Pretrained:
    """g_i is the same everywhere."""
    count, m = Constraints(robot, robot.task.rays).count, robot.action_dim
    layers = [(np.zeros((count, m, robot.task.observation_dim), np.float32), np.tile(np.float32(g), (count, 1)))]
    settings = {"clearance": CLEARANCE} | settings
    return Pretrained(robot, "secas", {"g": Perceptrons(layers)}, settings, rays=robot.task.rays)


def seen(ahead: float, beside: float = 3.5) -> np.ndarray:
    """An observation with something in the sector of the ninth ray."""
    rays = np.full(18, beside)
    rays[8] = ahead
    return np.concatenate([rays / 3.5, np.zeros(8)]).astype(np.float32)


def test_far_from_everything_the_proposal_passes_and_else_the_speed_is_cut_to_what_the_linear_model_allows():
    ready = Secas(known())
    decision = ready.decide(request((0.25, 0.4), observation=seen(1.0)))
    assert decision.kind == "allowed" and np.allclose(decision.plan[0], (0.25, 0.4)) and decision.reason == ""
    assert decision.margin > 0 and not decision.verified and decision.solver == ""
    for ahead in (0.25, 0.23, 0.21):
        decision = ready.decide(request((0.25, 0.4), observation=seen(ahead)))
        allowed = (ahead - CLEARANCE) / REACT[0]  # of full speed
        assert decision.kind == "adjusted" and "sector 2" in decision.reason
        assert decision.plan[0] == pytest.approx((0.25 * allowed, 0.4), abs=1e-5)
        assert decision.margin == pytest.approx(0.0, abs=1e-5)
        assert not decision.plan[-1].any() and len(decision.plan) == GROUND.horizon
    too_near = ready.decide(request((0.25, 0.4), observation=seen(0.15)))  # the correction would be to drive backwards
    assert too_near.plan[0] == pytest.approx((0.0, 0.4), abs=1e-4) and too_near.margin < 0


@pytest.mark.filterwarnings("ignore:.*encountered in matmul:RuntimeWarning")
def test_a_linear_model_that_is_not_finite_brakes():
    model = known()
    (weight, bias), *_ = model.networks["g"].layers
    weight[:, 0, :2] = 9.0, -9.0
    broken = Pretrained(GROUND, "secas", {"g": Perceptrons([(weight, bias)])}, model.settings, rays=GROUND.task.rays)
    decision = Secas(broken).decide(request((0.25, 0.4), observation=np.full(26, 3e38, np.float32)))
    assert decision.kind == "failsafe" and not decision.plan.any() and "not finite" in decision.reason


def test_a_robot_that_approaches_counts_as_nearer():
    constraints = Constraints(GROUND, GROUND.task.rays)
    still, moving = (constraints(seen(0.3), np.array([0, 0, 0, v, 0])) for v in (0.0, 0.25))
    assert still[2] == pytest.approx(-0.3, abs=1e-6)
    assert 0.04 < moving[2] - still[2] <= 0.25 * constraints.stopping
    assert moving[0] == pytest.approx(still[0], abs=0.05), "the side does not come nearer"
    far, less = constraints(seen(3.5), np.zeros(5)), constraints(seen(2.0, beside=1.0), np.zeros(5))
    assert np.array_equal(far, less), "ranges beyond near count as equal"


@pytest.mark.parametrize("robot", [GROUND, QUADROTOR])
def test_every_ray_is_in_one_sector(robot):
    constraints = Constraints(robot, robot.task.rays)
    assert sorted(np.concatenate(constraints.sectors)) == list(range(len(robot.task.rays.directions)))
    assert np.allclose(np.linalg.norm(constraints.directions, axis=1), 1.0)


def test_a_robot_with_a_slew_is_corrected_within_it():
    before, state = np.array([3.0, 0.0, 0.0]), np.zeros(QUADROTOR.state_dim)
    state[3] = 3.0
    walls = np.full(QUADROTOR.task.observation_dim, 0.2)  # 2.4 m away all round: too near at that speed
    rival = Secas(known(g=(0.5, 0.0, 0.0), robot=QUADROTOR))
    decision = rival.decide(request((5.0, 0.0, 0.0), before, QUADROTOR, walls, state))
    assert decision.kind == "adjusted"
    assert decision.plan[0] == pytest.approx((2.2, 0.0, 0.0), abs=1e-3), "as much less as the slew allows"
    assert (np.abs(np.diff(decision.plan, axis=0)) <= 0.8 + 1e-9).all() and not decision.plan[-1].any()


@pytest.mark.parametrize(
    ("field", "wrong"),
    [
        ("observation", {"observation": np.zeros(0)}),
        ("observation", {"observation": np.full(26, np.nan)}),
        ("action", {"action": (np.nan,)}),
        ("state", {"state": (0.0, 0.0)}),
        ("input_in_force", {"before": (1.0, 0.0)}),
    ],
)
def test_a_request_that_cannot_be_decided_on_is_refused(field, wrong):
    values = {"observation": seen(1.0), "action": (0.1, 0.0)} | wrong
    with pytest.raises(BadRequest) as refused:
        Secas(known()).decide(request(**values))
    assert refused.value.field == field


def test_a_model_of_another_shape_or_method_is_refused():
    good = known()
    short = Perceptrons([(w[:3], b[:3]) for w, b in good.networks["g"].layers])
    for wrong in (
        replace(good, networks={"g": short}),
        replace(good, method="sailr"),
        replace(good, settings={}),
        replace(good, networks={}),
        replace(good, rays=planar_rays(30, 180.0, 3.5)),
    ):
        with pytest.raises(BadModel):
            Secas(wrong)


def test_a_model_without_rays_has_those_of_the_robots_usual_task():
    """Older files do not hold the rays."""
    asked = request((0.25, 0.3), observation=seen(0.25))
    older = Secas(replace(known(), rays=None))
    assert np.array_equal(older.decide(asked).plan, Secas(known()).decide(asked).plan)
    with pytest.raises(BadModel, match="pretrain it again"):
        Secas(replace(known(), rays=None, robot=replace(GROUND, name="cart")))


def test_a_service_decides_by_secas_and_without_a_reply_the_client_brakes():
    client = ServiceClient(known())
    for _ in range(2):  # the second request has an unverified plan
        answer = client.decide(np.zeros(5), [0.25, 0.3], known_free=True, observation=seen(0.25).tolist())
        assert answer.kind == "adjusted" and answer.action == pytest.approx((0.25 * 0.05 / 0.06, 0.3), abs=1e-5)
        assert client.backup_plan.model == UNVERIFIED and client.backup_plan.predicted is None
    assert not client.backup_plan.fallback().any()
