"""Figures equal counts made by hand. Those of a whole log: `test_log_analysis.py`, by another reader."""

import itertools
import math
import random
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from brakeline.logs.decision_stats import DecisionStats, merge_decisions
from brakeline.logs.episode_stats import EpisodeStats, closed_loop
from brakeline.logs.figure_tables import for_clearance, show
from brakeline.logs.learning_curve import LearningCurve
from brakeline.logs.metrics import Metrics
from brakeline.logs.run_plots import draw
from brakeline.logs.watch.run_history import run_totals
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.bus import Sample
from tests.logs.conftest import Say
from tests.logs.sample_log import printed


def episode(number: int, decisions: list[int], actor: str = "a", **last: object) -> list[pb.Step]:
    """Return steps with a reward of 1, each 0.1 m/s faster; the arguments set fields of the last step."""
    steps = [
        pb.Step(actor=actor, robot="ground", episode=number, step=k, reward=1.0, penalty=5.0, speed=0.1 * (k + 1))
        for k in range(len(decisions))
    ]
    for k, (step, kind) in enumerate(zip(steps, decisions, strict=True)):
        step.decision = kind  # type: ignore[assignment]
        step.decide_ms = 1.0 + k
    steps[-1].MergeFrom(pb.Step(**last))  # type: ignore[arg-type]
    return steps


def some_steps() -> list[pb.Step]:
    none, fine, changed, safe = pb.UNKNOWN, pb.ALLOWED, pb.ADJUSTED, pb.FAILSAFE
    return [
        *episode(0, [fine, changed, fine], terminated=True, goal=True, reward=10.0),
        *episode(1, [safe, safe], truncated=True, outside=True),
        *episode(2, [fine, none], terminated=True, collision=True, fallback=True, compared=True),
        *episode(3, [fine], compared=True, contained=True),  # not finished
        *episode(4, [fine, fine], collision=True),  # hit, and never finished
    ]


def test_steps_adjusted_for_clearance_are_counted_where_every_adjusted_step_says_it() -> None:
    steps = episode(0, [pb.ADJUSTED, pb.ADJUSTED, pb.ADJUSTED, pb.ALLOWED], terminated=True)
    for step, said in zip(steps, (True, True, False), strict=False):
        step.for_clearance = said
    new, old = EpisodeStats(), EpisodeStats()
    for step in steps:
        new.step(step)
    figures = closed_loop([new])
    assert (figures["interventions"], figures["adjusted"], figures["for_clearance"]) == (3, 3, 2)
    assert for_clearance(figures) == "2 of 3 adjusted steps: the filter verified the proposal too"
    for step in some_steps():  # as logged by a version that did not say
        old.step(step)
    figures = closed_loop([old])
    assert (figures["adjusted"], figures["for_clearance"]) == (1, None)
    assert closed_loop([new, old])["for_clearance"] is None and closed_loop([])["for_clearance"] == 0
    assert for_clearance(figures) == "not recorded by this method or version"
    assert for_clearance(closed_loop([])) == "0", "a run without a filter has none either"


@pytest.mark.parametrize("indexed", [True, False])
def test_the_mean_reward_leaves_out_episodes_of_which_the_log_lacks_a_part(indexed: bool) -> None:
    """Missing: the middle of episode 1, and the beginning of episode 2. All of them reached the goal."""
    steps = [step for number in range(4) for step in episode(number, [pb.ALLOWED] * 3, terminated=True, goal=True)]
    for index, step in enumerate(steps, 1):
        step.index = index if indexed else 0
    stats, curve = EpisodeStats(), LearningCurve()
    for number, step in enumerate(steps):
        if number not in (4, 6):
            stats.step(step)
            curve.step(step)
    figures, (row,) = closed_loop([stats]), curve.figures()["bins"]
    assert (figures["episodes"], figures["goals"], figures["mean_reward"]) == (4, 4, 3.0)
    assert (row["episodes"], row["goals"], row["reward"]) == (4, 1.0, 3.0)
    assert curve.figures()["last"]["reward"] == 3.0
    assert run_totals(SimpleNamespace(actors={"a": stats}))["ground"]["reward"] == 4 * 3.0  # type: ignore[arg-type]


def test_a_period_without_an_observation_takes_nothing_from_an_episode() -> None:
    """In real time a late observation leaves out a number of a step, and no index."""
    stats = EpisodeStats()
    for index, number in ((1, 1), (2, 4)):
        stats.step(pb.Step(actor="a", robot="ground", index=index, step=number, reward=1.0, truncated=index == 2))
    assert closed_loop([stats])["mean_reward"] == 2.0


def test_without_steps_and_without_a_filter_there_are_no_numbers() -> None:
    figures = closed_loop([])
    assert figures["steps"] == figures["episodes"] == 0
    assert [figures[name] for name in ("mean_speed", "max_speed", "mean_reward", "decision_ms")] == [None] * 4
    tally = EpisodeStats()
    tally.step(pb.Step(speed=0.1))
    assert closed_loop([tally])["decision_ms"] is None
    empty = printed(show(Metrics().figures()))
    assert "steps" in empty, "an empty run can be shown"
    assert "no step has a predicted set" in empty, "0 would claim that steps were compared"


def put(metrics: Metrics, sample: Sample) -> None:
    metrics.add(sample.key, sample.message())


def test_only_messages_that_are_recorded_can_be_missing(say: Say) -> None:
    metrics = Metrics()
    put(metrics, say("health/a", pb.Health(process="a", published={"log/a": 1, "weights/ground": 3})))
    assert metrics.topics()["log/a"]["missing"] == 1
    assert "weights/ground" not in metrics.topics()


def test_processes_and_learners(say: Say) -> None:
    metrics = Metrics()
    for sample in (
        say("health/a", pb.Health(process="a", figures={"rate": 1.0}), run=1),
        say("health/a", pb.Health(process="a", notes={"model": "v2"}, last=True), run=2),
        say("metrics/ground", pb.LearnerMetrics(robot="ground", updates=5)),
        say("metrics/ground", pb.LearnerMetrics(robot="ground", updates=9, critic_loss=0.5, updates_per_s=100.0)),
        say("exchange/ground/a", pb.Exchange(request=pb.Request(action=[math.nan, 0.0]), round_trip_ms=3.0)),
    ):
        put(metrics, sample)
    figures = metrics.figures()
    process, learner = figures["processes"]["a"], figures["learners"]["ground"]
    assert (process["starts"], process["alive"], process["notes"]) == (2, False, {"model": "v2"})
    assert (learner["updates"], learner["critic_loss"]) == (9, 0.5)
    assert figures["not_finite"] == 1 and figures["seconds"] == 4.0


def test_the_time_in_which_robots_waited_for_the_service_is_shown(say: Say) -> None:
    """Such periods are no steps."""
    metrics, line = Metrics(), "standing without an answer"
    put(metrics, say("health/actor-0", pb.Health(process="actor-0", figures={"waits": 0.0, "waited_s": 0.0})))
    assert line not in printed(show(metrics.figures()))
    put(metrics, say("health/actor-0", pb.Health(process="actor-0", figures={"waits": 40.0, "waited_s": 6.25})))
    put(metrics, say("health/actor-1", pb.Health(process="actor-1", figures={"waits": 2.0, "waited_s": 1.0})))
    assert re.search(rf"{line} +7\.2 s, 42 queries", printed(show(metrics.figures())))


def run_of_two_actors(say: Say) -> dict[str, list[Sample]]:
    chance = random.Random(1)
    samples: dict[str, list[Sample]] = {}
    for actor in "ab":
        samples[actor] = []
        for number in range(20):
            for step in episode(number, [chance.choice([1, 1, 2, 3]) for _ in range(7)], actor, terminated=True):
                step.reward, step.speed, step.decide_ms = (chance.random() for _ in range(3))
                samples[actor].append(say(f"step/ground/{actor}", step))
    return samples


def test_the_figures_do_not_depend_on_how_actors_are_interleaved(say: Say) -> None:
    samples = run_of_two_actors(say)
    one, two = Metrics(), Metrics()
    for sample in samples["a"] + samples["b"]:
        put(one, sample)
    for sample in itertools.chain(*zip(samples["b"], samples["a"], strict=True)):
        put(two, sample)
    assert one.figures() == two.figures()


def test_learning_curves_are_drawn(tmp_path: Path) -> None:
    training = LearningCurve()
    for step in some_steps() * 20:
        training.step(step)
    draw({"training": {"ground": training.figures()}}, tmp_path / "pictures" / "curve.png")
    draw({"training": {}}, tmp_path / "pictures" / "none.svg")
    assert (tmp_path / "pictures" / "curve.png").stat().st_size > 10_000


def test_times_that_are_none_warn_nobody() -> None:
    decisions = DecisionStats()
    decision = pb.Decision(kind=pb.ALLOWED, queue_ms=math.inf, time_ms=math.inf)
    decisions.exchange(pb.Exchange(round_trip_ms=math.inf, reply=pb.Reply(decision=decision)))
    assert merge_decisions([decisions]).figures()["latency_ms"]["allowed"]["network"] is None
