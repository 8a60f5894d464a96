"""The live page: counts of the whole run, robot kinds apart, and a run that has ended in order."""

import math
from itertools import pairwise
from typing import Any

import pytest

from brakeline.logs.metrics import Metrics
from brakeline.logs.watch.dashboard import STUCK, Dashboard
from brakeline.logs.watch.live_page_server import LivePageServer
from brakeline.logs.watch.run_history import (
    MOST_ROWS,
    RunHistory,
    history_from_note,
    history_to_note,
    run_totals,
    totals_from_health,
    totals_to_health,
)
from brakeline.messaging import brakeline_pb2 as pb
from tests.browser import Page
from tests.logs.conftest import Say, watched


def step(robot: str, actor: str, number: int, reward: float, last: bool = False) -> pb.Step:
    size = {"ground": 5, "quadrotor": 9}[robot]
    return pb.Step(
        robot=robot, actor=actor, step=number, reward=reward, state=[0.1] * size, terminated=last, goal=last, speed=0.1
    )


def health(name: str, last: bool = False, **fields: Any) -> pb.Health:
    return pb.Health(process=name, last=last, **fields)


@pytest.fixture
def mixed(say: Say) -> Dashboard:
    """A dashboard during a run of two robot kinds, each with one finished episode."""
    board = Dashboard()
    for number in range(3):
        board.add(say("step/ground/a", step("ground", "a", number, 10.0, number == 2)))
        board.add(say("step/quadrotor/b", step("quadrotor", "b", number, -1.0, number == 2)))
    board.add(say("health/learner", health("learner")))
    return board


def launched(say: Say, board: Dashboard, last: bool = False, outcome: str = "") -> None:
    """Publish the launcher's Health message, with ten times as many steps as were watched."""
    notes = {"run": "crossing", "method": "ddpc", "arena": "dense", "seed": "3", "steps": "600"}
    counts = {"steps": 30.0, "episodes": 10.0, "goals": 9.0, "collisions": 0.0, "interventions": 3.0, "failsafes": 1.0}
    figures = totals_to_health({"ground": counts | {"reward": 290.0}, "quadrotor": counts | {"reward": -30.0}})
    notes |= {"outcome": outcome} if outcome else {}
    board.add(say("health/launcher", health("launcher", last, figures=figures, notes=notes)))


def test_counts_cover_the_whole_run_or_the_page_says_that_they_do_not(say: Say, mixed: Dashboard) -> None:
    shown = mixed.view()
    assert shown["since"] is not None and shown["totals"]["ground"]["steps"] == 3
    rewards = {robot: counts["mean_reward"] for robot, counts in shown["totals"].items()}
    assert rewards == {"ground": 30.0, "quadrotor": -3.0}, "not mixed"
    launched(say, mixed)
    mixed._figures_at = -1e9
    shown = mixed.view()
    assert shown["since"] is None and shown["totals"]["ground"]["steps"] == 30
    assert shown["totals"]["ground"]["mean_reward"] == 29.0
    assert shown["run"] == {"run": "crossing", "method": "ddpc", "arena": "dense", "seed": "3", "steps": "600"}


@pytest.mark.parametrize("in_order", [True, False])
def test_a_run_that_ended_in_order_is_not_a_run_that_died(say: Say, mixed: Dashboard, in_order: bool) -> None:
    launched(say, mixed)
    assert mixed.view()["processes"] == {"launcher": "alive", "learner": "alive"}
    if in_order:
        mixed.add(say("health/learner", health("learner", last=True)))
        launched(say, mixed, last=True, outcome="finished")
    mixed._last_message -= 1000.0
    mixed._figures_at = -1e9
    shown = mixed.view()
    assert shown["run"].get("outcome") == ("finished" if in_order else None)
    assert set(shown["processes"].values()) == {"ended" if in_order else "silent"}


def test_totals_survive_a_health_message() -> None:
    metrics = Metrics()
    for number in range(4):
        metrics.add("step/ground/a", step("ground", "a", number, 2.5, number == 3))
    counted = run_totals(metrics)
    assert counted["ground"]["reward"] == 10.0 and counted["ground"]["goals"] == 1
    odd = {"restarts actor-0": 1.0, "ground steps2": 1.0, "air steps": 4.0, "air reward": math.nan, "passed over": 0.0}
    assert totals_from_health(totals_to_health(counted) | odd) == counted


def counts(steps: float, collisions: float = 0.0) -> dict[str, dict[str, float]]:
    rest = {"episodes": steps // 10, "goals": steps // 20, "interventions": steps // 5, "failsafes": 0.0}
    return {"ground": {"steps": steps, "collisions": collisions, "reward": 0.5 * steps, **rest}}


def test_a_history_covers_the_run_in_a_bounded_number_of_rows() -> None:
    history = RunHistory()
    for steps in range(0, 100_000, 10):
        history.add(counts(float(steps), steps // 1000))
    rows = history.rows["ground"]
    assert MOST_ROWS // 2 <= len(rows) <= MOST_ROWS and rows[-1][0] > 90_000 and rows[0][0] < 5000
    gaps = {one[0] - before[0] for before, one in pairwise(rows)}
    assert len(gaps) == 1, "evenly spaced"
    note = history_to_note(history.rows)
    assert len(note) < 2500 and history_from_note(note) == history.rows


def test_a_reward_that_is_not_a_number_leaves_a_history_whole() -> None:
    history = RunHistory()
    history.add({"ground": counts(60.0)["ground"] | {"reward": math.nan}})
    history.add({"ground": counts(80.0)["ground"] | {"reward": math.inf}})
    assert history_from_note(history_to_note(history.rows)) == {"ground": []}


@pytest.mark.parametrize(
    "rows", ["[[1,2]]", "[[1,0,0,0,0,NaN]]", "[[2,0,0,0,0,0],[1,0,0,0,0,0]]", '"x"', "[[true,0,0,0,0,0]]"]
)
def test_a_malformed_history_is_left_out(rows: str) -> None:
    assert history_from_note(f'{{"ground": {rows}, "air": [[1,0,0,0,0,0]]}}') == {"air": [[1, 0, 0, 0, 0, 0]]}
    assert history_from_note(rows) == history_from_note("{" * 10_000) == {}


def test_histories_begin_with_the_run_not_with_the_page(say: Say, mixed: Dashboard) -> None:
    history = RunHistory()
    for steps in (50, 100, 150):
        history.add(counts(steps))
    notes = {"run": "late", "history": history_to_note(history.rows)}
    mixed.add(say("health/launcher", health("launcher", figures=totals_to_health(counts(160.0)), notes=notes)))
    mixed._figures_at = -1e9
    assert [row[0] for row in mixed.view()["history"]["ground"]] == [50, 100, 150]


def test_a_robot_that_does_not_get_away_is_stuck_until_it_moves(say: Say) -> None:
    board = Dashboard()

    def drive(x: float, number: int) -> int:
        step = pb.Step(robot="ground", actor="a", step=number, state=[x, 0.0, 0.0, 0.0, 0.0], decision=pb.FAILSAFE)
        board.add(say("step/ground/a", step))
        stuck: int = board.view()["robots"][0]["stuck"]
        return stuck

    assert [drive(0.1 * k, k) for k in range(30)] == [0] * 30, "it drives"
    waits = [drive(2.9 + 0.01 * (k % 2), 30 + k) for k in range(STUCK + 3)]
    assert not any(waits[: STUCK - 1]) and waits[-1] >= STUCK
    assert drive(4.0, 200) == 0
    waits = [drive(4.0, 201 + k) for k in range(STUCK)]
    board.add(
        say("episode/ground/a", pb.Episode(robot="ground", actor="a", episode=2, start=[0.0] * 5, goal=[1.0, 0.0]))
    )
    assert board.view()["robots"][0]["stuck"] == 0


def test_the_page_shows_counts_and_the_end_of_the_run(say: Say, mixed: Dashboard, tab: Page) -> None:
    tab.size(390, 844)
    with LivePageServer(mixed.view) as server, watched(tab, server):
        tiles = "[...document.querySelectorAll('#figures .group')].map(g => g.dataset.robot + ': ' + g.textContent)"
        tab.until(f"{tiles}.length === 2")
        assert "that were watched" in tab.value("document.getElementById('scope').textContent")
        mixed._last_message += 1000.0  # the browser takes as long as it likes
        tab.until("document.getElementById('link').textContent === 'live'")
        mixed.add(say("health/learner", health("learner", last=True)))
        launched(say, mixed, last=True, outcome="finished")
        tab.until("document.getElementById('link').textContent === 'the run has ended: finished'")
        tab.until("document.getElementById('scope').textContent.startsWith('Counts cover the whole run')")
        tab.until("document.getElementById('done').textContent === '60 of 600 steps (10 %)'")
        mixed._last_message -= 2000.0
        tab.until("document.querySelectorAll('#processes .ended').length === 2")
        assert tab.value("document.getElementById('link').className") == "ended"
        rewards = "[...document.querySelectorAll('#figures .group')].map(g => g.querySelectorAll('dd')[6].textContent)"
        assert tab.value(rewards) == ["29.0", "-3.0"]
        assert tab.value("document.documentElement.scrollWidth") <= 390, "nothing sticks out of a phone"
        assert tab.complaints == []
