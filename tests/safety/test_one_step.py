"""A model set that rolls one learned period out: tight from minutes of free driving, exact where it decides.

How an adversary and a planner drive behind one: `tests/examples/test_own_log.py`.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brakeline.deploy.data.certification import certify
from brakeline.errors import BadData, BadModel, ErrorBoundError
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.robot_description import robot_from_description
from brakeline.safety.filter import plan_search
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import ADJUSTED, ALLOWED, FAILSAFE, Request
from brakeline.safety.model import one_step_fitting, one_step_regression
from brakeline.safety.model.calibration_samples import samples_of
from brakeline.safety.model.dataset import Dataset, Trajectory
from brakeline.safety.model.driving_kinds import JUMPING, RESTLESS, START, driving_kinds
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import DIRECT, ONE_STEP, ModelConfig, ModelSet
from brakeline.safety.model.one_step_fitting import choose, fit_one_step
from brakeline.safety.model.one_step_regression import Regression
from brakeline.safety.model.set_factors import SetFactors
from brakeline.safety.model.set_shape import Shape, shares, spread_features, typical_plans
from brakeline.safety.model.validation import validate_one_step
from brakeline.safety.model.windows import FREE, non_overlapping_starts
from tests.safety.asked import cylinder
from tests.safety.test_turning_in_place import ROBOT, record
from tests.safety.toys import puck

CONFIG = ModelConfig(mode=ONE_STEP)
MINUTES = 6  # trajectories of 40 s each make four minutes


@cache
def driven(seed=1, trajectories=MINUTES):
    return record(seed, trajectories)


@cache
def certified():
    return certify(driven(), CONFIG)


@cache
def ready():
    return Filter(certified()[0])


@cache
def two_inputs():
    """The filter of a robot that chooses two inputs of a plan."""
    robot = replace(ROBOT, free_steps=2, horizon=ROBOT.horizon + 1)
    return Filter(certify(replace(driven(trajectories=3), robot=robot), CONFIG)[0])


def request(state, action, before, obstacles, robot=ROBOT):
    plan = np.vstack([before * share for share in robot.stop_profile()])
    return Request(np.asarray(state), np.asarray(action), np.asarray(before), plan, Shapes.of(obstacles, 2))


def scenes(count, seed=0, robot=ROBOT):
    """Requests of a driving robot among three obstacles within a metre."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        before = rng.uniform(ROBOT.low(), ROBOT.high())
        state = np.array([0.0, 0.0, rng.uniform(-3, 3), *before])
        angles, away = rng.uniform(-np.pi, np.pi, 3), rng.uniform(0.27, 0.6, 3)
        posts = [cylinder(r * np.cos(a), r * np.sin(a), 0.08) for a, r in zip(angles, away, strict=True)]
        yield request(state, rng.uniform(ROBOT.low(), ROBOT.high()), before, posts, robot)


def test_a_proposal_is_allowed_if_another_verified_plan_than_braking_begins_with_it(monkeypatch):
    """A robot that chooses two inputs of a plan may evade an obstacle before which it could not stop."""
    ready = two_inputs()
    asked = list(scenes(600, robot=ready.robot))
    decisions = [ready.decide(ask) for ask in asked]
    monkeypatch.setattr(plan_search, "AS_PROPOSED", -1.0)  # no QP's answer becomes the proposal
    evading = adjusted = 0
    for ask, decision in zip(asked, decisions, strict=True):
        z_0 = np.concatenate([ask.state[list(ROBOT.regressor)], ask.input_in_force])
        braking = ready.inputs.plan(ready.inputs.regressors(z_0, ask.action))
        if decision.kind != ALLOWED or np.allclose(decision.plan, braking):
            continue
        evading += 1
        assert (decision.plan[0] == ask.action).all()
        assert decision.verified and decision.margin >= 0.0 and decision.reason == ""
        closest = ready.decide(ask)
        assert closest.plan[0] == pytest.approx(ask.action, abs=2e-3 * 3.0)
        adjusted += closest.kind == ADJUSTED
    assert adjusted > 10 > evading - adjusted, "braking after it was verified for few, with too little clearance"


def test_where_neither_plan_is_verified_the_one_with_the_larger_margin_is_executed():
    """A quadrotor that evaded left its set by a little. Braking instead flew it straight into the obstacle."""
    ready, goes_on, brakes = two_inputs(), 0, 0
    for proposed in scenes(1500, seed=1, robot=ready.robot):
        known = np.concatenate([proposed.state[3:], proposed.input_in_force])
        evading = ready.inputs.plan(np.concatenate([known, proposed.action, 0.8 * proposed.action]))
        ask = replace(proposed, plan=evading, model="another")  # whose sets this filter does not know
        decision = ready.decide(ask)
        if decision.verified or decision.kind != FAILSAFE:
            continue
        z_0 = np.concatenate([ask.state[3:], ask.input_in_force])
        scene = ready.constraints.local_map(ask, z_0, ready.builder.reachable(ask.input_in_force))
        rest, brake = np.concatenate([z_0, evading[:2].ravel()]), np.concatenate([z_0, np.zeros(4)])
        margins = [ready.constraints.at(z, scene.widening).margin_in(scene, z) for z in (rest, brake)]
        assert (decision.plan[:2] == (evading[:2] if margins[0] > margins[1] else 0.0)).all()
        goes_on, brakes = goes_on + (margins[0] > margins[1]), brakes + (margins[0] <= margins[1])
    assert goes_on > 3 < brakes, (goes_on, brakes)


def test_four_minutes_of_free_driving_give_sets_a_quarter_as_wide_as_a_linear_predictors():
    linear = fit_model_set(driven(), replace(CONFIG, mode=DIRECT, windows=FREE, fewest=60))
    width, linear_width = (Filter(replace(m, in_place=None)).half_width(ROBOT.high()) for m in (certified()[0], linear))
    assert width < 0.25 * linear_width and width < 0.03
    report = certified()[1]
    assert report.chosen.degree >= 2, "the product of speed and turning, chosen by the out-of-fold error"
    assert report.chosen.error < 0.5 * min(c.error for c in report.candidates if c.degree == 1)


def test_a_coordinate_that_is_never_zero_leaves_the_widths_at_rest_and_the_clearance_as_they_are():
    """A voltage that changes nothing. The widths were those at zero volts: nanometres, because they grew with it."""
    described = ROBOT.description
    robot = robot_from_description(described | {"state": described["state"] | {"U": {"unit": "V", "error": 0.0}}})
    measured = []
    for of in (ROBOT, robot):
        data = driven(trajectories=3)
        volts = [np.full((len(t.states), 1), 5.0 + 2.0 * (i > 0)) for i, t in enumerate(data.trajectories)]
        parts = zip(data.trajectories, volts, strict=True)
        more = tuple(replace(t, states=np.hstack([t.states, v]) if of is robot else t.states) for t, v in parts)
        ready = Filter(fit_one_step(replace(data, robot=of, trajectories=more), CONFIG)[0])
        measured.append([*(ready.half_width(u) for u in (0.0 * of.high(), of.high())), ready.clearance_margin])
    assert measured[1] == pytest.approx(measured[0], rel=0.3)


def test_lost_rows_at_the_start_of_a_recording_leave_five_even_folds():
    """Twenty pieces of a second, and minutes without a loss: as whole trajectories, one fold would hold nearly all."""
    torn, whole = driven(seed=5, trajectories=2).trajectories
    pieces = [
        Trajectory(torn.states[i : i + 9], torn.inputs[rows], torn.paths[rows], torn.turned[rows], torn.inputs[i - 1])
        for i, rows in ((i, slice(i, i + 8)) for i in range(1, 190, 9))
    ]
    folds = np.bincount(samples_of(Dataset(ROBOT, (*pieces, whole))).fold)
    assert len(pieces) > 20 and len(folds) == 5 and folds.min() > 0.15 * folds.sum()


def test_the_stated_shares_hold_on_fresh_driving_overall_and_in_every_kind_of_driving():
    model, report = certified()
    fresh = samples_of(driven(seed=77, trajectories=40))
    widths = np.stack([step.half_widths(fresh.z) for step in model.steps], axis=1)
    off = np.abs(fresh.after - model.one_step.rollouts(ROBOT, fresh.z))
    widths *= model.one_step.stretches(ROBOT, fresh.z)[..., None]
    begun = fresh.start[:, 1] >= ROBOT.horizon
    widths[~begun] *= model.one_step.start
    first = (off[:, 0] > widths[:, 0]).any(1)
    outside = (off[..., :2] > widths[..., :2]).any((1, 2)) | first
    outside |= (fresh.chords > model.chord_deviations.half_widths(fresh.z)).any(1)
    assert outside.mean() < report.bound_plan and outside[begun].mean() < report.bound_plan
    assert first.mean() < report.bound_step
    assert report.violations == 0 and report.marginal == 1 / (report.windows + 1) < 0.01
    assert outside[begun].mean() < report.marginal
    assert {START, RESTLESS, "standing", "fast and turning"} <= {group.name for group in report.groups}
    kinds = driving_kinds(ROBOT, fresh.z, fresh.start)
    for group in report.groups:
        one = kinds[group.name]
        assert outside[one].mean() <= group.bound and first[one].mean() <= group.bound_step, group.name
        assert group.bound_step >= report.bound_step, "from fewer steps"


def test_a_verified_plans_tube_is_about_the_rollout_of_its_inputs():
    kinds = []
    for ask in scenes(150):
        decision = ready().decide(ask)
        kinds.append(decision.kind)
        if decision.kind not in (ALLOWED, ADJUSTED):
            continue
        z = np.concatenate([ask.state[3:], ask.input_in_force, decision.plan.ravel()])
        ahead = certified()[0].one_step.rollouts(ROBOT, z[None])[0][:, :2]
        cos, sin = np.cos(ask.state[2]), np.sin(ask.state[2])
        assert decision.tube_center == pytest.approx(ahead @ np.array([[cos, sin], [-sin, cos]]), abs=1e-9)
    assert kinds.count(ADJUSTED) > 30


def test_the_filter_misses_few_inputs_that_a_grid_finds():
    grid = np.stack(np.meshgrid(np.linspace(0.0, 0.6, 25), np.linspace(-1.5, 1.5, 31)), -1).reshape(-1, 2)
    solvable = missed = 0
    for ask in scenes(200, seed=5):
        decision = ready().decide(ask)
        if decision.kind not in (ADJUSTED, FAILSAFE):
            continue
        safety = ready()
        z_0 = np.concatenate([ask.state[3:], ask.input_in_force])
        widened = replace(ask, widening=safety.start)  # as `decide` widens the sets at the start of an episode
        scene = safety.constraints.local_map(widened, z_0, safety.builder.reachable(ask.input_in_force))
        plans = [safety.inputs.regressors(z_0, u) for u in grid]
        if any(safety.constraints.at(z, scene.widening).margin_in(scene, z) >= 0.0 for z in plans):
            solvable += 1
            missed += decision.kind == FAILSAFE
    assert solvable > 40 and missed <= 0.05 * solvable


@given(seed=st.integers(0, 2**32 - 1))
def test_every_set_holds_all_errors_of_the_predictor_and_the_body_stays_clear(seed):
    rng = np.random.default_rng(seed)
    ask = next(scenes(1, seed))
    ask.state[2] = 0.0  # the boxes are aligned with the world: turned, they would be larger than the sets
    decision = ready().decide(ask)
    if decision.kind not in (ALLOWED, ADJUSTED) or not decision.verified:
        return
    errors = decision.tube_half_width * rng.uniform(-1.0, 1.0, (64, *decision.tube_half_width.shape))
    points = decision.tube_center + errors
    for post in range(3):
        center, radius = ask.obstacles.center[post, :2], ask.obstacles.rho[post]
        assert (np.linalg.norm(points - center, axis=-1) > radius + ROBOT.footprint).all()


def test_a_file_gives_the_same_model_set_and_a_damaged_one_is_refused(tmp_path):
    model = certified()[0]
    model.save(tmp_path / "model.safetensors")
    assert ModelSet.load(tmp_path / "model.safetensors").version == model.version
    one_step = model.one_step
    terms, scale = one_step.features.terms.copy(), one_step.features.scale
    terms[-1, 0] = 99
    for features in (replace(one_step.features, terms=terms), replace(one_step.features, scale=-scale)):
        damaged = replace(model, one_step=replace(one_step, features=features))
        with pytest.raises(BadModel, match="predictor of one period"):
            ModelSet.decode(damaged.encode())
    with pytest.raises(BadModel, match="version"):
        ModelSet.decode(replace(model, model_config=replace(model.model_config, mode=DIRECT)).encode())


def test_sets_grow_with_the_leverage_of_a_plan():
    one_step = certified()[0].one_step
    middle = np.concatenate([[0.2, 0.0, 0.2, 0.0], np.tile([0.2, 0.0], ROBOT.horizon)])
    corner = np.concatenate([[0.6, 1.5, 0.6, 1.5], np.tile([0.6, 1.5], ROBOT.horizon)])
    assert one_step.weight > 0.0
    stretches = one_step.stretches(ROBOT, np.stack([middle, corner, 3.0 * corner]))
    assert (stretches >= 1.0).all() and (stretches[1] > stretches[0]).all() and (stretches[2] > 3.0).any()
    state = np.array([0.0, 0.0, 0.0, 0.6, 1.5])
    ask = request(state, [0.6, 1.5], [0.6, 1.5], [cylinder(2.0, 2.0, 0.1)])
    plain = Filter(replace(certified()[0], one_step=replace(one_step, weight=0.0)))
    wide, narrow = (filt.decide(ask) for filt in (ready(), plain))
    noise = np.array(ROBOT.measurement_bound[:2])
    z = np.concatenate([state[3:], ask.input_in_force, wide.plan.ravel()])
    expected = one_step.stretches(ROBOT, z[None])[0][:, None] * (narrow.tube_half_width - noise)
    assert wide.tube_half_width - noise == pytest.approx(expected)
    assert wide.predicted.half_width == pytest.approx(
        narrow.predicted.half_width * one_step.stretches(ROBOT, z[None])[0, 0]
    )


def test_too_little_driving_and_stops_by_feedback_are_refused():
    (whole,) = driven(trajectories=1).trajectories
    few = Trajectory(whole.states[:21], whole.inputs[:20], whole.paths[:20], whole.turned[:20])
    with pytest.raises(BadData, match="record at least"):
        fit_one_step(Dataset(ROBOT, (few,)), CONFIG)
    short = [
        Trajectory(whole.states[i : i + 3], whole.inputs[i : i + 2], whole.paths[i : i + 2], whole.turned[i : i + 2])
        for i in range(0, 300, 3)
    ]
    with pytest.raises(BadData, match=r"no recording without a gap is as long as a plan .* the longest has 2 periods"):
        fit_one_step(Dataset(ROBOT, tuple(short)), CONFIG)
    with pytest.raises(ErrorBoundError, match="feedback"):
        fit_one_step(Dataset(puck("puck"), (whole,)), CONFIG)


def test_a_predictor_that_leads_absurdly_far_away_is_not_compared(monkeypatch):
    """A flight was lost to a candidate whose products fed each other until a rollout was infinite."""
    s = samples_of(driven(trajectories=3).joined())
    choice, _, regression = choose(ROBOT, s)
    assert choice.candidate.degree > 1 and not regression.diverges(choice.candidate, s.z)
    fit = Regression.fit

    def exploding(self, candidate, without=-1, weight=0.0):
        one_step = fit(self, candidate, without, weight)
        return replace(one_step, C=1e200 * one_step.C) if candidate.degree > 1 and without == 3 else one_step

    monkeypatch.setattr(Regression, "fit", exploding)
    assert regression.diverges(choice.candidate, s.z)
    assert choose(ROBOT, s)[0].candidate.degree == 1
    monkeypatch.setattr(one_step_regression, "ABSURD", 1e-3)
    with pytest.raises(BadData, match=r"leads absurdly far away.*record more driving"):
        choose(ROBOT, s)


def test_the_chosen_predictor_leads_absurdly_far_away_from_none_of_all_windows(monkeypatch):
    """Candidates are compared by some of the windows only."""
    s = samples_of(driven(trajectories=3).joined())
    monkeypatch.setattr(one_step_fitting, "MOST_TO_CHOOSE", 300)
    first, diverges = choose(ROBOT, s)[0].candidate, Regression.diverges

    def beyond_the_compared(self, candidate, z):
        return diverges(self, candidate, z) or (len(z) > 300 and candidate == first)

    monkeypatch.setattr(Regression, "diverges", beyond_the_compared)
    assert choose(ROBOT, s)[0].candidate != first


# --- the half-widths of the sets follow from the errors of recorded windows -------------------------------------------

N, KNOWN, M = ROBOT.horizon, ROBOT.regressor_dim, ROBOT.action_dim


def random_windows(count):
    return np.random.default_rng(0).uniform(-1.0, 1.0, (count, KNOWN + N * M))


def test_a_steady_ramp_does_not_jump_beyond_its_first_change():
    ramp = np.arange(N + 1.0)[:, None] * np.ones(M)
    z = np.concatenate([np.zeros(KNOWN - M), ramp.ravel()])[None]
    assert spread_features(ROBOT, z)[-1, 0, -M:] == pytest.approx(np.full(M, 1.0 / N))


def test_the_error_bounds_of_a_shape_have_its_half_widths():
    z, rng = random_windows(50), np.random.default_rng(1)
    shape = Shape(rng.uniform(0.0, 1.0, (N, 2, KNOWN + 2 * M)), rng.uniform(0.0, 1.0, (N, 2)))
    for k in range(1, N + 1):
        bound = shape.bound(ROBOT, k, slice(2), np.array([1.0, 3.0]))
        assert bound.half_widths(z) == pytest.approx(shape.widths(spread_features(ROBOT, z))[:, k - 1] * [1.0, 3.0])


def test_a_window_in_a_thousand_does_not_decide_about_the_shape():
    z, errors = random_windows(2000), np.random.default_rng(2).uniform(-1.0, 1.0, (2000, N, 1))
    wild = errors.copy()
    wild[[7, 1400]] *= 50.0
    spread, plans = spread_features(ROBOT, z), typical_plans(ROBOT, z, z[:1])
    tight, loose = (Shape.around(spread, wild, plans, outside=share) for share in (0.001, 0.0))
    assert sorted(np.flatnonzero(tight.scores(spread, wild) > 1.0)) == [7, 1400]
    assert (loose.scores(spread, wild) <= 1.0 + 1e-9).all()
    assert tight.widths(spread).mean() < 0.3 * loose.widths(spread).mean()


def test_each_kind_of_driving_has_its_share_outside_and_only_starts_have_a_factor_of_their_own():
    plan = np.concatenate([np.full(3000, 0.5), np.full(100, 2.0), np.full(30, 3.0)])
    first = np.full(len(plan), 0.9)
    first[-1] = 1.2
    at = np.arange(len(plan))
    kinds = {START: at >= 3100, "rare": (at >= 3000) & (at < 3100), JUMPING: at == 7}
    factors = SetFactors.of(plan[None], first, kinds, 0.001)
    assert (*factors.plan, factors.first, factors.start) == (2.0, 1.0, 1.5)
    assert factors.shares(plan[None], first, kinds).max() == 1.0
    assert SetFactors.of(plan[None], first, kinds, 0.05).plan == 2.0  # of the hundred rare ones, five may be outside


def test_a_kind_of_driving_that_leaves_by_one_coordinate_widens_that_one_alone():
    rng, at = np.random.default_rng(0), np.arange(4000)
    plan, rare = rng.uniform(0.0, 1.5, (3, 4000)), (at >= 3000) & (at < 3500)
    plan[1, 3000:3008] = 6.0
    kinds = {START: at < 0, JUMPING: at < 0, "rare": rare}
    for outside in (0.003, 0.01):
        factors = SetFactors.of(plan, np.zeros(4000), kinds, outside)
        assert factors.plan[[0, 2]].max() <= 1.5 and factors.plan[1] == 6.0
        used = factors.shares(plan, np.zeros(4000), kinds)
        assert (used > 1.0).mean() <= outside and (used[rare] > 1.0).mean() <= outside
    assert SetFactors.of(plan, np.zeros(4000), kinds, 0.02).plan[1] < 1.5, "eight of five hundred may be outside"
    assert SetFactors.of(plan, np.zeros(4000), kinds, 0.003, same=True).plan.tolist() == [6.0] * 3


def test_pieces_of_a_recording_with_many_gaps_are_no_starts_of_their_own():
    """Otherwise no window, or few, would calibrate the sets of a robot that drives on."""
    plan, at = np.full(3000, 0.5), np.arange(3000)
    plan[::10] = 2.0
    for starts, expected in ((3000, (2.0, 1.0)), (1000, (2.0, 1.0)), (700, (1.0, 2.0))):
        plan[at >= starts] = 0.5
        factors = SetFactors.of(plan[None], plan, {START: at < starts, JUMPING: at < 0}, 0.001)
        assert (*factors.plan, factors.start) == expected and factors.first == factors.plan


def test_an_error_that_is_no_number_counts_as_outside():
    errors, widths = np.array([np.nan, 0.1, np.inf, 0.0, 0.0, 0.1]), np.array([0.2, 0.2, np.inf, 0.0, np.inf, np.nan])
    assert shares(errors, widths).tolist() == [np.inf, 0.5, np.inf, 0.0, 0.0, np.inf]
    first = np.full(2000, 0.5)
    kinds = {START: np.arange(2000) < 50, JUMPING: np.zeros(2000, dtype=bool)}
    for place in (7, 1400):
        plan = np.full((1, 2000), 2.0)
        plan[0, place] = np.nan
        factors = SetFactors.of(plan, first, kinds, 0.01)
        assert factors.plan == 2.0 and np.flatnonzero(factors.shares(plan, first, kinds) > 1.0).tolist() == [place]
        assert max(SetFactors.of(plan, first, kinds, 0.0).plan, SetFactors.of(plan, first, kinds, 0.0).start) == np.inf
    model, calibration = fit_one_step(driven(trajectories=3), CONFIG)
    apart = np.flatnonzero(non_overlapping_starts(calibration.samples.start, N))
    before = validate_one_step(model, calibration)
    calibration.scores[apart[:5]] = calibration.first_scores[apart[:5]] = np.nan
    report = validate_one_step(model, calibration)
    assert report.violations == before.violations + 5 and report.step_violations >= before.step_violations + 5
    assert report.bound_plan > before.bound_plan and report.excess == np.inf


def test_inputs_that_jump_widen_the_set_of_the_next_state_but_not_those_of_plans():
    plan, first = np.full((1, 3000), 0.5), np.full(3000, 0.9)
    plan[0, 7] = first[7] = 4.0
    at = np.arange(3000)
    factors = SetFactors.of(plan, first, {START: at < 3, JUMPING: at == 7}, 0.001)
    assert (*factors.plan, factors.first, factors.start) == (1.0, 4.0, 1.0)
