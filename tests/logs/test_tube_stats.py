"""Plans that robots followed are compared with their verified tubes."""

import copy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brakeline.logs.episode_stats import closed_loop
from brakeline.logs.figure_tables import show
from brakeline.logs.learning_curve import LearningCurve
from brakeline.logs.metrics import Metrics
from brakeline.logs.tube_stats import TubeStats, figures, stated
from brakeline.messaging import brakeline_pb2 as pb
from tests.logs.sample_log import printed

N = 4  # periods of a plan
PLAN = [0.3, 0.2, 0.1, 0.0]  # of one input


def asked(step, kind, x=0.0, given=0, own=0.0, verified=True, episode=0, run=1):
    """Return an exchange at position x. The committed plan's tail begins with the given input; the robot's own plan
    leads to x + 0.1 per period, ± 0.05."""
    exchange = pb.Exchange(header=pb.Header(run=run))
    exchange.request.CopyFrom(
        pb.Request(robot="nobody", actor="a", episode=episode, step=step, state=[x], action=[0.0], plan=PLAN[given:])
    )
    decision = exchange.reply.decision
    decision.kind, decision.verified = kind, verified
    decision.plan[:] = PLAN[given:] if kind == pb.FAILSAFE else PLAN
    decision.tube_center[:] = [own + 0.1 * (k + 1) for k in range(N)]
    decision.tube_half_width[:] = [0.05] * N
    return exchange


def of(*exchanges):
    plans = TubeStats()
    for exchange in exchanges:
        plans.exchange(exchange)
    return plans


def stop(late=0, off=0.0):
    """Return a stop along a plan; the robot is `off` the tube's center by more than usual in the period `late`."""
    along = [asked(k, pb.FAILSAFE, 0.1 * min(k, N) + 0.02 + off * (k == late), min(k, 3)) for k in range(1, 6)]
    return [asked(0, pb.ALLOWED), *along, asked(6, pb.ALLOWED, 0.42, 3)]


SILENT = pb.Exchange(header=pb.Header(run=1), request=asked(1, pb.FAILSAFE, 0.3, 1).request, failure="timeout: 80")
NAN = float("nan")


FIRST = asked(0, pb.ALLOWED)
CASES = {
    "a stop in its tube": (stop(), 1, 0),
    **{f"outside in period {late}": (stop(late, 0.04), 1, 1) for late in range(2, 5)},
    "outside when the next plan begins": ([FIRST, asked(1, pb.FAILSAFE, 0.1, 1), asked(2, pb.ADJUSTED, 0.26, 2)], 1, 1),
    "a newer plan at once": ([FIRST, asked(1, pb.ALLOWED, 9.0, 1), asked(2, pb.ADJUSTED, 9.0, 1)], 0, 0),
    "no reply": ([FIRST, SILENT, asked(2, pb.ALLOWED, 0.2, 2)], 1, 1),
    "nothing was verified": ([asked(0, pb.FAILSAFE, verified=False), asked(1, pb.FAILSAFE, 9.0, 1)], 0, 0),
    **{
        name: ([FIRST, asked(**{"step": 1, "kind": pb.FAILSAFE, "x": 9.0, "given": 1} | change)], 0, 0)
        for name, change in {
            "another episode": {"episode": 1},
            "a restarted process": {"run": 2},
            "a lost exchange": {"step": 3},
            "a reply that came too late": {"given": 2},
        }.items()
    },
    "no number": ([FIRST, asked(1, pb.FAILSAFE, NAN, 1), asked(2, pb.ALLOWED, 0.2, 2)], 1, 1),
}


@pytest.mark.parametrize(("exchanges", "flown", "outside"), CASES.values(), ids=CASES)
def test_plans_that_were_followed_and_left_are_counted(exchanges, flown, outside):
    plans = of(*exchanges)
    counted = figures([plans])
    assert (counted["flown"], counted["outside"]) == (flown, outside)
    assert np.isfinite(counted["excess"]) and (counted["excess"] > 1.0) == bool(outside)
    assert figures([plans]) == counted, "the figures leave a plan in progress as it is"


def run_of(*messages, robot="nobody"):
    """Return the figures of plans in a run with these messages."""
    metrics = Metrics()
    for sequence, message in enumerate(messages, 1):
        kind = "exchange" if isinstance(message, pb.Exchange) else "step"
        message.header.run, message.header.sequence = message.header.run or 1, sequence
        (message.request if kind == "exchange" else message).robot = robot
        assert metrics.add(f"{kind}/{robot}/a", message)
    return metrics.figures()["plans"]


def end(step, x, **change):
    """Return the last step of an episode, with a collision at x."""
    last = {"episode": 0, "index": step + 1, "terminated": True, "collision": True, "decision": pb.FAILSAFE} | change
    return pb.Step(actor="a", step=step, state=[x], **last)


OFF = asked(1, pb.FAILSAFE, 0.1, 1)
ENDS = {
    "in the tube": ([FIRST, OFF, end(1, 0.2)], 1, 0),
    "outside at the end": ([FIRST, OFF, end(1, 9.0)], 1, 1),
    "outside, and a further episode": ([FIRST, OFF, end(1, 9.0), asked(0, pb.ALLOWED, episode=1)], 1, 1),
    "outside without an answer": ([FIRST, SILENT, end(1, 9.0, fallback=True)], 1, 1),
    "outside at a time limit": ([FIRST, OFF, end(1, 9.0, terminated=False, truncated=True)], 1, 1),
    "in the first period of the plan": ([FIRST, end(0, 9.0)], 0, 0),
    "in the first period of a newer plan": ([FIRST, asked(1, pb.ADJUSTED, 0.1, 1), end(1, 9.0)], 0, 0),
    "while it follows another stop": ([FIRST, asked(1, pb.FAILSAFE, 0.1, 1), end(1, 9.0)], 1, 0),
    "of another episode": ([FIRST, OFF, end(1, 9.0, episode=3)], 1, 0),
    "of another period": ([FIRST, OFF, end(2, 9.0)], 1, 0),
    "of another process": ([FIRST, OFF, end(1, 9.0, header=pb.Header(run=2))], 1, 0),
}
ENDS["while it follows another stop"][0][1].reply.decision.plan[:] = [0.0] * N


@pytest.mark.parametrize(("messages", "flown", "outside"), ENDS.values(), ids=ENDS)
def test_the_last_period_of_an_episode_counts(messages, flown, outside):
    """A collision ends the episode: no request follows that has the state."""
    plans = run_of(*map(copy.deepcopy, messages))
    assert (plans["flown"], plans["outside"]) == (flown, outside)


def test_a_robot_in_real_time_that_missed_periods_at_the_end_has_not_left_its_tube():
    followed = [asked(0, pb.ALLOWED), asked(1, pb.FAILSAFE, 0.1, 1)]
    assert run_of(*followed, end(1, 0.4), robot="nobody-late")["outside"] == 0
    assert run_of(*followed, end(1, 9.0), robot="nobody-late")["outside"] == 1


@settings(max_examples=30)
@given(st.data())
def test_malformed_exchanges_raise_no_error(data):
    numbers = st.lists(st.floats(width=32), max_size=6)
    plans = TubeStats()
    for step in range(4):
        exchange = asked(step, data.draw(st.sampled_from([pb.ALLOWED, pb.FAILSAFE, pb.RECOVERING, pb.UNKNOWN])))
        for field in (exchange.request.state, exchange.request.action, exchange.request.plan):
            field[:] = data.draw(numbers)
        for field in (exchange.reply.decision.plan, exchange.reply.decision.tube_center):
            field[:] = data.draw(numbers)
        plans.exchange(exchange)
    assert plans.outside <= plans.flown


NOT_SCORED = {
    "scored": 0,
    "beyond": 0,
    "beyond_plan": 0,
    "beyond_widened": 0,
    "widening": 1.0,
    "slowed": 0,
    "slow_downs": 0,
}


def test_plans_are_among_the_figures_of_a_run():
    metrics = Metrics()
    exchanges = asked(0, pb.ALLOWED), asked(1, pb.FAILSAFE, 0.9, 1), asked(2, pb.ALLOWED, 0.2, 2)
    for sequence, exchange in enumerate(exchanges, 1):
        exchange.header.sequence = sequence
        metrics.add("exchange/a", exchange)
    expected = {"flown": 1, "outside": 1, "excess": pytest.approx(16.0), "bound": None, **NOT_SCORED}
    assert metrics.figures()["plans"] == figures(metrics.plans.values()) == expected


def left(*bounds):
    """Return the figures of one plan per bound, whose tube was left; None: a decision without a bound."""
    plans = []
    for bound in bounds:
        first = asked(0, pb.ALLOWED)
        if bound is not None:
            first.reply.decision.bound = bound
        plans.append(of(first, asked(1, pb.FAILSAFE, 0.1, 1), asked(2, pb.ADJUSTED, 0.9, 2)))
    return figures(plans)


def test_the_excess_is_the_largest_share_of_the_half_width():
    assert of(*stop()).excess == pytest.approx(0.4) and of(*stop(3, 0.04)).excess == pytest.approx(1.2)


def test_the_stated_bound_is_reported_with_the_count():
    assert left(0.0113)["bound"] == 0.0113 and stated(left(0.0113)) == "stated: at most 1.2 %, at 99 % confidence"
    assert left(0.01, 0.26)["bound"] == 0.26, "that of the loosest"
    assert left(0.01, None)["bound"] is None and stated(left(None)) == "no bound was recorded"
    assert stated(left(NAN)) == "no bound was stated"
    shown = printed(show(closed_loop([]) | {"plans": left(0.26)}))
    assert "1, left their tube: 1 (100.0%); stated: at most 26 %, at 99 % confidence" in shown
    assert figures([]) == {"flown": 0, "outside": 0, "excess": 0.0, "bound": None, **NOT_SCORED}


def test_windows_that_the_filter_scored_are_counted_beside_what_was_stated_and_widened():
    exchanges = [asked(k, pb.ALLOWED) for k in range(4)]
    for exchange, score, widening in zip(exchanges, (0.5, 1.5, 3.0, float("nan")), (0.0, 1.0, 3.3, 3.3), strict=True):
        exchange.reply.decision.score, exchange.request.widening = score, widening
    plans = figures([of(*exchanges)])
    assert (plans["scored"], plans["beyond"], plans["beyond_widened"], plans["widening"]) == (4, 3, 2, 3.3)
    shown = printed(show(closed_loop([]) | {"plans": plans}))
    assert "3 (75.0%); 3 (75.0%) outside those of plans, 2 (50.0%) as widened, by up to 3.3 times" in shown
    exchanges[1].reply.decision.plan_score = 0.9  # its position stayed inside
    plans = figures([of(*exchanges)])
    assert (plans["beyond"], plans["beyond_plan"], plans["beyond_widened"]) == (3, 2, 1)


def test_the_widening_is_shown_where_no_window_was_scored():
    """A model set that predicts plans only."""
    exchanges, curve = [asked(k, pb.ALLOWED) for k in range(3)], LearningCurve()
    for exchange, widening in zip(exchanges, (1.0, 2.5, 2.0), strict=True):
        exchange.request.widening, exchange.reply.decision.tube_half_width[:] = widening, [0.1]
        curve.exchange(exchange)
    curve.step(pb.Step(actor="a"))
    shown = printed(show(closed_loop([]) | {"plans": figures([of(*exchanges)])}))
    assert "sets widened" in shown and "by up to 2.5 times" in shown and "windows outside" not in shown
    (row,) = curve.figures()["bins"]
    assert (row["widening"], row["half_width"], row["beyond"]) == (2.5, pytest.approx(0.1), None)


def test_steps_whose_proposal_was_limited_are_counted_and_told():
    exchanges = [asked(k, pb.ALLOWED) for k in range(6)]
    for exchange, slow in zip(exchanges, (0.0, 0.5, 0.5, 0.0, 0.0, 0.5), strict=True):
        exchange.request.slow, exchange.reply.decision.score = slow, 0.5
    found = figures([of(*exchanges)])
    assert (found["slowed"], found["slow_downs"]) == (3, 2)
    shown = printed(show(closed_loop([]) | {"plans": found, "steps": 6}))
    assert "slowed down" in shown and "3 (50.0%) of the steps, 2 times" in shown
    curve = LearningCurve()
    for exchange in exchanges:
        curve.exchange(exchange)
    curve.step(pb.Step(actor="a"))
    assert curve.figures()["bins"][0]["slowed"] == 0.5
