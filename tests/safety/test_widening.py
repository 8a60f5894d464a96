"""The widening of the sets that follows from how much of them was used (docs/method.md §15)."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brakeline.deploy.data.certification import certify
from brakeline.errors import BadRequest
from brakeline.messaging.obstacle import Shapes
from brakeline.messaging.robot import Disc, Limit
from brakeline.safety.filter.backup_plan import BackupPlan, Prediction
from brakeline.safety.filter.batch.obstacle_arrays import ObstacleArrays
from brakeline.safety.filter.batch.plan_batch import BackupPlanBatch
from brakeline.safety.filter.batch.request_arrays import PredictionArrays, RequestArrays
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import Request
from brakeline.safety.filter.widening import MODELS, MOST, RESERVE, WINDOWS, PastWindow, Widening, widening_factor
from brakeline.safety.gym import SafetyWrapper
from brakeline.safety.model.model_config import MOST_OUTSIDE
from brakeline.safety.service.client import request_message
from brakeline.safety.service.in_process import InProcess
from brakeline.safety.service.wire import decision_of, decision_reply, request_of
from brakeline.sim.navigation_env import NavigationEnv
from tests.robots import GROUND
from tests.safety.asked import cylinder
from tests.safety.test_one_step import CONFIG, certified, driven, ready, request
from tests.safety.test_turning_in_place import ROBOT, wandering
from tests.safety.unicycle import Unicycle

N = ROBOT.horizon
POSTS = [cylinder(0.3, 0.25, 0.1), cylinder(-0.4, -0.3, 0.1)]


def test_the_factor_is_a_tenth_above_the_largest_recent_score_and_never_below_one():
    widening = Widening(ROBOT)
    assert widening.factor == 1.0
    for score in (0.5, 2.0, 0.1):
        widening.judge(score)
    assert widening.factor == pytest.approx(2.0 * RESERVE)
    for _ in range(WINDOWS - 2):
        widening.judge(0.3)
    assert widening.factor == pytest.approx(2.0 * RESERVE)
    widening.judge(0.3)
    assert widening.factor == 1.0
    widening.judge(np.nan)
    assert widening.factor == MOST


def test_as_many_windows_as_may_leave_the_sets_do_not_widen_them():
    widening, share = Widening(ROBOT), 0.005
    for score in (2.0, 1.5, 3.0):  # 0.5 % of 600 windows are three
        widening.judge(score, share)
    assert widening.factor == 1.0
    widening.judge(1.4, share)
    assert widening.factor == pytest.approx(1.4 * RESERVE)
    widening.judge(0.1, 0.001)  # not one of 600
    assert widening.factor == pytest.approx(3.0 * RESERVE)
    widening.judge(np.nan, share)
    assert widening.factor == MOST, "a window without a score is no window that may leave its sets"


@given(scores=arrays(float, WINDOWS, elements=st.floats(0.0, 50.0)), share=st.floats(0.0, MOST_OUTSIDE))
def test_no_more_windows_than_may_leave_the_sets_are_beyond_the_factor(scores, share):
    factor = widening_factor(scores, share)
    assert factor >= 1.0 and (scores > factor).mean() <= share + 1e-9
    assert factor <= widening_factor(scores, 0.0)


def test_a_share_from_the_network_that_is_none_lets_no_window_out():
    for share, kept in ((0.01, 0.01), (0.5, 0.0), (-1.0, 0.0), (np.nan, 0.0)):
        reply = decision_reply(replace(ready().decide(request(np.zeros(5), np.zeros(2), np.zeros(2), POSTS))), 0.0)
        reply.decision.outside_share = share
        assert decision_of(reply.decision, ROBOT).outside_share == kept


def test_the_filter_says_what_share_its_model_set_lets_out():
    model = certified()[0]
    loose = replace(model, model_config=replace(model.model_config, outside=0.02))
    ask = request(np.zeros(5), np.zeros(2), np.zeros(2), POSTS)
    assert Filter(loose).decide(ask).outside_share == 0.02
    assert Filter.load("ground").outside_share == 0.0, "it scores single periods, of which none may be outside"


def test_a_window_holds_the_last_periods_without_a_gap():
    widening = Widening(ROBOT)
    inputs = np.arange(2.0 * (N + 3)).reshape(-1, 2)
    for k in range(1, N + 2):
        assert widening.past is None or k == N + 1
        widening.executed(np.full(5, float(k)), inputs[k - 1], inputs[k])
    past = widening.past
    assert past.states[:, 0].tolist() == list(range(2, N + 2))
    assert past.inputs.tolist() == inputs[1 : N + 2].tolist()
    widening.interrupt()
    assert widening.past is None


def test_sets_are_wider_at_an_episodes_start_and_windows_from_there_are_judged_by_those():
    model = certified()[0]
    safety = Filter(replace(model, one_step=replace(model.one_step, start=1.5)))
    ask = request(np.zeros(5), np.array([0.2, 0.1]), np.zeros(2), POSTS)
    past = PastWindow(np.zeros((ROBOT.horizon, 5)), np.full((ROBOT.horizon + 1, 2), 0.01))
    at_start, later = safety.decide(ask), safety.decide(replace(ask, past=past))
    fixed = PastWindow(past.states, np.frombuffer(past.inputs.tobytes()).reshape(past.inputs.shape))
    assert safety.decide(replace(ask, past=fixed)) == later, "a read-only array"
    noise = np.array(ROBOT.measurement_bound[:2])
    assert at_start.tube_half_width - noise == pytest.approx(1.5 * (later.tube_half_width - noise))
    assert at_start.margin < later.margin
    from_start = safety.scores(replace(ask, past=replace(past, from_start=True)))
    assert from_start == pytest.approx((later.score / 1.5, later.plan_score / 1.5))


def test_a_window_knows_whether_its_plan_was_decided_without_a_past_window():
    widening, without = Widening(ROBOT), []
    for k in range(4 * N):
        without.append(widening.past is None)  # the request at the start of period k
        if (past := widening.past) is not None:
            assert past.from_start == without[k - N]
        widening.executed(np.zeros(5), np.zeros(2), np.zeros(2))
    widening.interrupt()
    for _ in range(N):
        widening.executed(np.zeros(5), np.zeros(2), np.zeros(2))
    assert widening.past.from_start


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        *(({"widening": factor}, "widening") for factor in (0.99, 0.0, -1.0, np.nan, np.inf)),
        *(({"state_widening": factor}, "state_widening") for factor in (0.99, 0.0, -1.0, np.nan, np.inf)),
        ({"past": PastWindow(np.zeros((N, 5)), np.zeros((N, 2)))}, "past"),
        ({"past": PastWindow(np.zeros((N - 1, 5)), np.zeros((N + 1, 2)))}, "past"),
        ({"past": PastWindow(np.full((N, 5), np.nan), np.zeros((N + 1, 2)))}, "NaN"),
    ],
)
def test_a_factor_below_one_and_a_window_of_another_size_or_with_nan_are_refused(changes, said):
    with pytest.raises(BadRequest, match=said):
        ready().decide(replace(request(np.zeros(5), np.zeros(2), np.zeros(2), POSTS), **changes))


@pytest.mark.parametrize("of", ["one-step", "direct"])
def test_every_set_grows_by_the_factor_and_the_margin_falls(of):
    safety, robot = (ready(), ROBOT) if of == "one-step" else (Filter.load("ground"), GROUND)
    plan = np.zeros((robot.horizon, 2))
    ask = Request(np.zeros(5), np.array([0.1, 0.2]), np.zeros(2), plan, Shapes.of(POSTS, 2))
    stated, wide = safety.decide(ask), safety.decide(replace(ask, widening=3.0))
    noise = np.array(robot.measurement_bound[:2])
    growth = safety.constraints.growth  # of the sets of plans, where the client sees single periods only
    assert growth == 1.0 if of == "one-step" else growth == pytest.approx(1.072, abs=1e-3)
    assert wide.tube_half_width - noise == pytest.approx(3.0 * growth * (stated.tube_half_width - noise))
    assert wide.predicted.half_width == pytest.approx(3.0 * stated.predicted.half_width)
    assert wide.margin < stated.margin
    moving = replace(ask, state=np.array([0.0, 0.0, 0.0, 0.1, 0.0]), input_in_force=np.array([0.1, 0.0]))
    assert not safety.decide(replace(moving, widening=1e3)).verified


def test_errors_of_speeds_alone_widen_the_set_of_the_next_state_and_not_those_of_plans():
    """Only positions decide about obstacles; the speed after a period says whether the robot is where it should be."""
    safety, widening = ready(), Widening(ROBOT)
    ask = request(np.zeros(5), np.array([0.2, 0.1]), np.zeros(2), POSTS)
    fast, far = np.zeros((2, N, 5))
    fast[1, 3], far[1:, 0] = 0.5, 0.5  # m/s, measured once; m
    stopped = np.zeros((N + 1, 2))
    of_speed = safety.decide(replace(ask, past=PastWindow(fast, stopped)))
    of_position = safety.decide(replace(ask, state=far[-1], past=PastWindow(far, stopped)))
    assert of_speed.plan_score < 1.0 < of_speed.score
    assert of_position.plan_score == of_position.score > 1.0

    for _ in range(N):
        widening.executed(np.zeros(5), np.zeros(2), np.zeros(2))
    widening.judge(3.0, plan_score=0.5)
    assert widening.factor == 1.0 and widening.state_factor == pytest.approx(3.0 * RESERVE)
    assert list(widening.left) == [False], "the plan stayed in its tube"
    stated, wide = safety.decide(ask), safety.decide(replace(ask, state_widening=widening.state_factor))
    assert (wide.tube_half_width == stated.tube_half_width).all() and wide.margin == stated.margin
    # A robot whose position is beyond its stated set has left its plan's tube: it must not be in the predicted set.
    factors = np.where(np.arange(5) < 2, 1.0, 3.0 * RESERVE)
    assert wide.predicted.half_width == pytest.approx(factors * stated.predicted.half_width)
    less = safety.decide(replace(ask, widening=2.0, state_widening=1.5))
    both = safety.decide(replace(ask, widening=2.0))
    assert (less.predicted.half_width == both.predicted.half_width).all(), "as much as those of plans at least"


LONG = Disc((0.15, 0.0), 0.08), Disc((-0.15, 0.0), 0.08)
SLOW = Limit("slow", (0.0, 0.0, 0.0, 1.0, 0.0), 0.5)


@pytest.mark.parametrize(
    ("changes", "coordinate"), [({"body": LONG}, 2), ({"limits": (SLOW,)}, 3)], ids=["discs", "limit"]
)
def test_errors_of_what_decides_about_obstacles_and_limits_widen_the_sets_of_plans(changes, coordinate):
    """A long robot that turns farther than predicted hits with its ends. Only its middle was scored."""
    robot = replace(ROBOT, **changes)
    safety = Filter(certify(replace(driven(trajectories=3), robot=robot), CONFIG)[0])
    ask = replace(request(np.zeros(5), np.zeros(2), np.zeros(2), [], robot), known_free=True)
    for after in (1, N - 1):  # periods
        states = np.zeros((N, 5))
        states[after:, coordinate] = 0.5
        asked = replace(ask, state=states[-1], past=PastWindow(states, np.zeros((N + 1, 2))))
        assert safety.scores(asked)[1] > 3.0
        answers = safety.decide_batch(RequestArrays.of([asked]))
        assert answers.plan_score[0] == pytest.approx(safety.scores(asked)[1])
        assert bool(answers.singly) == bool(robot.limits)


def test_a_service_that_does_not_score_plans_apart_widens_them_by_the_whole_score():
    """Its replies lack the score of plans, as those of a version before."""
    plan, still = BackupPlan(ROBOT), np.zeros((N, 2))
    box = Prediction(np.zeros(5), np.full(5, 0.1), 0.0)
    for score in (None, 2.0):
        plan.accept(still, "model", box, True, judges=True, score=score)
    assert plan.widening.factor == plan.widening.state_factor == pytest.approx(2.0 * RESERVE)


def test_a_model_set_that_scores_no_windows_is_widened_by_what_each_period_uses():
    plan, widening = BackupPlan(GROUND), []

    def period(used, **decided):
        """Measure a state that uses a share of its predicted set. The next decision's sets are as wide as asked."""
        half = np.array([0.01, 0.02, 0.03, 0.04, 0.05])
        before = plan.predicted or Prediction(np.zeros(5), half, 0.0)
        plan.measured(before.center + before.half_width * [0.0, 0.0, 0.0, -used, 0.5 * used])
        predicted = Prediction(np.full(5, 0.1), half * plan.widening.factor, 0.3)
        plan.accept(np.zeros((GROUND.horizon, 2)), "one", predicted, True, **decided)
        widening.append(plan.widening.factor)

    for used in (0.0, 0.99, 2.0, 0.8, 1.2, 0.1):
        period(used)
    assert widening == pytest.approx([1.0, 1.0, 2.0 * RESERVE, 2.0 * RESERVE, 2.4 * RESERVE**2, 2.4 * RESERVE**2])
    period(5.0, judges=True)
    assert widening[-1] == widening[-2], "this filter scores windows itself"
    assert list(plan.widening.left) == [False], "one of so few periods counts as a plan: they overlap"
    plan.reset()
    period(9.0)
    assert widening[-1] == widening[-2], "an episode has begun: nothing was predicted"


@pytest.mark.parametrize("safety", [ready, lambda: Filter.load("ground")], ids=["windows", "periods"])
@pytest.mark.parametrize("far", [2e4, np.nan])
def test_a_state_that_the_filter_refuses_has_no_score(safety, far):
    client, state = InProcess(safety(), accept_bound=1.0), np.zeros(5)
    for period in range(3 * N):
        state[1] = far if period == N + 1 else 0.0
        if period == N + 1:
            with pytest.raises(BadRequest):
                client.decide(state, np.zeros(2), known_free=True)
            client.fallback()
        else:
            client.decide(state, np.zeros(2), known_free=True)
        past = client.backup_plan.past
        assert past is None or (np.abs(past.states) <= 1.0).all()
    assert client.backup_plan.widening.factors == (1.0, 1.0)


@pytest.mark.parametrize("state", [[1.0, 0.0], [np.nan, 0.0]])
def test_a_set_without_width_or_a_number_is_used_up(state):
    center = np.pad(np.array(state), (0, 3))
    assert Prediction(center, np.zeros(5), 0.0).share_used(ROBOT, np.zeros(5)) == np.inf
    assert Prediction(np.zeros(5), np.zeros(5), 0.0).share_used(ROBOT, np.zeros(5)) == 0.0


@pytest.mark.parametrize("off", [0.0, 1e-12, 0.9e-9, 1.1e-9, 0.05, 0.0999, 0.1001, 0.3])
@pytest.mark.parametrize("width", [0.0, 1e-16, 1e-9, 0.1])
def test_a_set_is_used_up_where_the_state_is_outside_and_rounding_uses_nothing(off, width):
    """A simulator's exact coordinate has a width of 1e-16: rounding widened all sets by 2.6 and more."""
    sets = Prediction(np.zeros(5), np.array([0.5, 0.5, 0.5, width, 0.5]), 0.0)
    state = np.array([0.0, 0.0, 0.0, off, 0.0])
    used = sets.share_used(ROBOT, state)
    assert (used > 1.0) == (not sets.contains(ROBOT, state)) and (off > 1e-9 or used == 0.0)
    plans = BackupPlanBatch(ready(), 1)
    plans.predicted = PredictionArrays(sets.center[None], sets.half_width[None], np.zeros(1), np.ones(1, dtype=bool))
    assert plans._shares_used(state[None])[0] == used and plans.contains(state[None])[0] == (used <= 1.0)


def test_factor_and_window_cross_the_wire_and_a_new_model_set_starts_without_scores():
    client, rng = InProcess(ready(), accept_bound=1.0), np.random.default_rng(0)
    plan, robot = client.backup_plan, Unicycle((0.0, 0.0, 0.0), rng)
    for action in wandering(rng, ROBOT.horizon + 3):
        answer = client.decide(robot.measure(), action, [], known_free=True)
        robot.step(answer.action)
    plan.widening.judge(3.0, plan_score=2.0)
    question = request_of(request_message(plan, robot.measure(), np.zeros(2), known_free=True), ROBOT)
    assert (question.widening, question.state_widening) == pytest.approx((2.0 * RESERVE, 3.0 * RESERVE))
    assert (question.past.states == plan.past.states).all() and (question.past.inputs == plan.past.inputs).all()
    assert question.past.from_start and plan.past.from_start
    sent = decision_reply(answer, 0.0).decision
    got = decision_of(sent, ROBOT)
    assert (got.score, got.plan_score) == (answer.score, answer.plan_score) and got.judges
    plan.accept(answer.plan, "another", answer.predicted, True, judges=True, score=5.0)
    assert plan.widening.factor == 1.0


def test_replicas_with_different_model_sets_keep_the_scores_of_each():
    """The client asks all replicas again from time to time, so the one that answers changes."""
    plan, box, still = BackupPlan(ROBOT), Prediction(np.zeros(5), np.full(5, 0.1), 0.0), np.zeros((N, 2))

    def answered(model, score=None, used=0.0):
        plan.measured(np.full(5, 0.1 * used))
        plan.accept(still, model, box, True, judges=score is not None, score=score)
        return plan.widening.factor

    answered("old"), answered("new")
    assert answered("old", 3.0) == pytest.approx(3.0 * RESERVE), "it has decided before: its score counts"
    assert answered("new", 1.5) == pytest.approx(1.5 * RESERVE)
    assert answered("old", 0.1) == pytest.approx(3.0 * RESERVE) and answered("new", 0.1) == pytest.approx(1.5 * RESERVE)
    assert answered("old", used=2.0) == pytest.approx(3.0 * RESERVE), "the new one predicted the period"
    assert answered("new", 0.1) == pytest.approx(2.0 * 3.0 * RESERVE**2), "at the widening of the request before"
    for name in range(MODELS):
        assert answered(f"later {name}", 9.0) == 1.0
    assert answered("new", 0.1) == 1.0, "a client keeps the scores of few model sets"


def test_a_score_counts_for_the_model_set_that_gave_it_also_if_it_verified_nothing():
    """The first plan that is verified after some that were not is as wide as the robot needs."""
    plan, box, still = BackupPlan(ROBOT), Prediction(np.zeros(5), np.full(5, 0.1), 0.0), np.zeros((N, 2))

    def answered(model, score, verified=False):
        plan.accept(still, model, box, verified, judges=True, score=score)
        return plan.widening.factor

    answered("old", None)
    assert answered("old", 3.0) == pytest.approx(3.0 * RESERVE)
    assert answered("old", 0.1, verified=True) == pytest.approx(3.0 * RESERVE)
    assert answered("new", 9.0) == 1.0, "it starts without scores"
    for _ in range(WINDOWS):
        assert answered("new", 0.1) == 1.0
    assert answered("old", 0.1) == pytest.approx(3.0 * RESERVE), "the scores of the new one are not its own"


def test_a_robot_that_left_its_sets_before_its_first_verified_plan_has_wide_sets_after_it():
    client, batch, post = InProcess(ready(), accept_bound=1.0), BackupPlanBatch(ready(), 1), cylinder(0.2, 0.0, 0.1)
    for period in range(2 * N + 2):
        blocked, state = period < 2 * N, np.array([0.0, 0.03 * (period == N + 1), 0.0, 0.0, 0.0])
        near = [post] if blocked else POSTS
        assert client.decide(state, np.zeros(2), near).verified != blocked
        batch.decide(state[None], np.zeros((1, 2)), ObstacleArrays.of([Shapes.of(near, 2)]))
        assert batch.widening[0] == pytest.approx(client.backup_plan.widening.factor)
    assert client.backup_plan.widening.factor > 1.5


def test_a_payload_is_noticed_within_seconds_and_the_sets_hold_again():
    """The robot answers as if it were heavier; without the widening most windows leave their sets."""
    client = InProcess(Filter(certified()[0]), accept_bound=1.0)
    rng = np.random.default_rng(3)
    robot = Unicycle((0.0, 0.0, 0.0), rng, slip=-0.05)  # it drives slower than asked
    scores, factors = [], []
    for action in wandering(rng, 300):
        factors.append(client.backup_plan.widening.factors)
        answer = client.decide(robot.measure(), action, [], known_free=True)
        scores.append((0.0, 0.0) if answer.score is None else (answer.plan_score, answer.score))
        robot.step(answer.action)
    used, widened = np.array(scores), np.array(factors)
    assert ((used[100:] > 1.0).mean(0) > (0.15, 0.3)).all()
    assert ((used[100:] > widened[100:]).mean(0) < 0.02).all()
    assert (widened[0] == 1.0).all() and 1.5 < widened[-1, 0] < widened[-1, 1] < 20.0


def test_episodes_behind_the_filter_repeat_once_the_widening_is_forgotten():
    """As docs/own_environments.md says: the scores of earlier episodes widen the sets of this one."""
    env = SafetyWrapper(NavigationEnv(GROUND, "dense"), Filter.load("ground"))

    def executed(number, forget):
        if forget:
            env.backup_plan.widening.forget()
        env.reset(options={"episode_seed": number})
        return [env.step(np.array([0.25, 0.0]))[4]["diagnostics"]["executed"] for _ in range(60)]

    fresh = executed(2, forget=True)
    env.backup_plan.widening.judge(2.0)  # the robot left a set
    assert not np.array_equal(executed(2, forget=False), fresh)
    env.backup_plan.widening.judge(2.0)
    assert np.array_equal(executed(2, forget=True), fresh)
