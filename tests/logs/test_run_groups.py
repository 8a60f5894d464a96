"""Groups of runs by rliable's definitions, against independent computations; nothing is cut or pooled in silence."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu, trim_mean

from brakeline.logs.run_groups import (
    GroupedRun,
    aggregate,
    compare_groups,
    differences,
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
)
from brakeline.logs.run_plots import draw

SHARES = st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12)


def run(label: str, method: str, seed: int, goals: float, steps: int = 2000) -> GroupedRun:
    """A run of 100 steps a bin, with two episodes in each."""
    share = {"adjusted": 0.1, "failsafes": 0.05, "reward": 100.0 * goals, "goals": goals}
    bins = [{"steps": 100, "episodes": 2, "until": 100 * k, **share} for k in range(1, steps // 100 + 1)]
    last = {"episodes": 40, "goals": goals, "collisions": 2, "interventions": 0.15, "reward": 100.0 * goals}
    setup = {"method": method, "seed": seed, "learner": {"seed": seed, "td3": {"batch": 128}}}
    return GroupedRun(label, "ground", setup, {"bins": bins, "last": last, "models": []})


@given(SHARES)
def test_the_interquartile_mean_is_that_of_scipy(values: list[float]) -> None:
    assert interquartile_mean(np.array(values)) == pytest.approx(trim_mean(values, 0.25))


@settings(max_examples=30)
@given(SHARES, SHARES)
def test_scores_of_groups_are_those_of_their_runs(first: list[float], second: list[float]) -> None:
    for values in (np.array(first), np.array(second)):
        scores, profile = aggregate(values), performance_profile(values)
        assert scores["values"] == values.tolist() and scores["mean"] == pytest.approx(np.mean(values))
        for statistic in ("mean", "iqm"):
            interval = scores[f"{statistic}_interval"]
            if len(values) == 1:
                assert interval is None, "one run says nothing about others"
            else:
                assert 0.0 <= interval[0] <= scores[statistic] + 1e-9 and scores[statistic] - 1e-9 <= interval[1] <= 1.0
        assert profile["share"] == [np.mean(values > level) for level in profile["level"]]
    better = mannwhitneyu(first, second).statistic / (len(first) * len(second))
    pair = probability_of_improvement(np.array(first), np.array(second))
    assert pair["probability"] == pytest.approx(better)


def test_runs_that_drove_every_task_are_drawn_together_for_all_of_them() -> None:
    """A good run is good in each arena: with draws of their own, two arenas would seem to know twice as much."""
    runs = np.array([0.5, 0.6, 0.7, 0.8, 0.9])
    one, two = aggregate(runs), aggregate(np.stack([runs, runs]))
    assert two["mean_interval"] == one["mean_interval"] and two["iqm_interval"] == pytest.approx(
        one["iqm_interval"], abs=0.03
    )
    profile, twice = performance_profile(runs), performance_profile(np.stack([runs, runs]))
    assert profile == twice
    worse = runs - 0.15
    assert probability_of_improvement(np.stack([runs, runs]), np.stack([worse, worse])) == probability_of_improvement(
        runs, worse
    )


@pytest.mark.long
@pytest.mark.parametrize(
    ("runs", "name", "share"), [(5, "mean", 0.83), (5, "iqm", 0.90), (4, "mean", 0.81), (3, "mean", 0.74)]
)
def test_a_bootstrap_interval_of_few_runs_is_as_narrow_as_the_pages_say(runs: int, name: str, share: float) -> None:
    """`docs/results.md` and the results page state these shares for normally distributed scores."""
    scores = np.random.default_rng(2).standard_normal((2000, runs))
    intervals = np.array([aggregate(values)[f"{name}_interval"] for values in scores])
    assert np.mean((intervals[:, 0] <= 0.0) & (intervals[:, 1] >= 0.0)) == pytest.approx(share, abs=0.025)


def test_a_run_that_ended_early_cuts_no_other() -> None:
    (group,) = compare_groups([run("long", "ddpc", 0, 0.9), run("short", "ddpc", 1, 0.5, steps=1000)])["groups"]
    curves, steps = group["curves"], group["steps"]
    assert steps == [2000, 1000] and curves["step"][-1] == 2000.0
    assert {runs for step, runs in zip(curves["step"], curves["runs"], strict=True) if step <= 1000.0} == {2}
    first, last = curves["goals"][0], curves["goals"][-1]
    assert first["mean"] == pytest.approx(0.7) and first["low"] == pytest.approx(0.5)
    assert last == {"mean": pytest.approx(0.9), "low": None, "high": None} and curves["runs"][-1] == 1
    assert curves["interventions"][0]["mean"] == pytest.approx(0.15)


def test_runs_that_differ_in_more_than_the_seed_are_not_pooled() -> None:
    other = run("c", "ddpc", 2, 0.5)
    other.setup["learner"]["td3"]["batch"] = 256  # type: ignore[index]
    groups = compare_groups([run("a", "ddpc", 0, 0.5), run("b", "ddpc", 1, 0.5), other])["groups"]
    assert [group["runs"] for group in groups] == [["a", "b"], ["c"]]
    assert [group["name"] for group in groups] == ["128", "256"]
    assert len({group["color"] for group in groups}) == 2


def test_differences_name_each_setting_and_each_run() -> None:
    settings = {"a": {"steps": 10, "td3": {"batch": 128, "tau": 0.1}}, "b": {"steps": 10, "td3": {"batch": 256}}}
    assert differences(settings) == {"td3.batch": {"a": 128, "b": 256}, "td3.tau": {"a": 0.1, "b": None}}


def test_groups_are_json_and_a_picture(tmp_path: Path) -> None:
    shares = {"none": (0.1, 0.3, 0.2), "ddpc": (0.9, 0.8)}
    runs = [run(f"{method}-{k}", method, k, goals) for method, each in shares.items() for k, goals in enumerate(each)]
    found = compare_groups([*runs, run("cbf", "cbf", 0, 0.5, 1000)])
    assert len(json.dumps(found, allow_nan=False)) < 100_000
    assert [group["name"] for group in found["groups"]] == ["none", "ddpc", "cbf"]
    assert [(pair["of"], pair["over"]) for pair in found["improvements"]] == [
        *(("none", "ddpc"), ("none", "cbf"), ("ddpc", "cbf"))
    ]
    assert [pair["probability"] for pair in found["improvements"]] == [0.0, 0.0, 1.0]
    for group, values in zip(found["groups"], shares.values(), strict=False):
        scores = group["scores"]
        assert scores["goals"]["values"] == list(values) and scores["collisions"]["mean"] == pytest.approx(0.05)
        assert group["seeds"] == list(range(len(values)))
        assert group["profile"]["share"][50] == np.mean(np.array(values) > 0.5)
    draw(found, tmp_path / "curves.svg")
    assert (tmp_path / "curves.svg").stat().st_size > 10_000


def test_runs_without_an_episode_have_no_score() -> None:
    none = dict.fromkeys(("goals", "collisions", "interventions", "reward"))
    idle = GroupedRun("idle", "ground", {"method": "ddpc"}, {"bins": [], "last": none | {"episodes": 0}, "models": []})
    found = compare_groups([idle, run("a", "none", 0, 0.5)])
    assert found["groups"][0]["scores"]["goals"]["iqm"] is None and found["improvements"][0]["probability"] is None
    json.dumps(found, allow_nan=False)
