"""Compare groups of runs: runs that differ only in their seed form a group.

The definitions are those of rliable (Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical
Precipice", 2021) with one task: interquartile mean, percentile bootstrap over runs, performance profile and probability
of improvement. The score of a run is the share of its last episodes that reached the goal.

>>> float(interquartile_mean(np.array([0.0, 0.5, 0.7, 1.0])))
0.6
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brakeline.logs.episode_stats import Figures
from brakeline.logs.learning_curve import interventions_in
from brakeline.messaging.robot import Array

METHOD_COLORS = {  # a palette for colour-blind readers
    **{"ddpc": "#0072b2", "sailr": "#e69f00", "secas": "#009e73", "none": "#d55e00"},
    **{"lagrange": "#cc79a7", "cbf": "#56b4e9", "psf": "#5d6b7c", "sac": "#b39800", "sac-ddpc": "#000000"},
}
OTHER_COLORS = ("#56b4e9", "#cc79a7", "#5d6b7c", "#b39800")  # of groups that share their method with another
RESAMPLES = 2000
CONFIDENCE = 0.95
POINTS = 60  # steps of a curve
WINDOW = 0.1  # of the longest run: a curve's value is the rate over this many steps before
LEVELS = np.linspace(0.0, 1.0, 101)  # of a performance profile
MEAN = partial(np.mean, axis=-1)
SCORES = ("goals", "collisions", "interventions", "reward")  # of the last episodes of a run
CURVES: dict[str, tuple[str, str]] = {  # name: what is counted, over what
    "goals": ("goals", "episodes"),
    "interventions": ("interventions", "steps"),
    "reward": ("reward", "episodes"),
}


@dataclass(frozen=True)
class GroupedRun:
    """What a comparison reads of one run and robot kind.

    Attributes:
        label: name of the run.
        robot: kind.
        setup: configuration by name, with the seed; nested values are joined by dots.
        training: figures of the run's `LearningCurve`.
    """

    label: str
    robot: str
    setup: Mapping[str, Any]
    training: Figures


def interquartile_mean(values: Array) -> Array:
    """Return the mean of the middle half of the values (..., n), as `scipy.stats.trim_mean(values, 0.25)` does."""
    count = values.shape[-1]
    cut = int(0.25 * count)
    return np.asarray(np.sort(values, axis=-1)[..., cut : count - cut].mean(axis=-1))


def compare_groups(runs: Sequence[GroupedRun]) -> Figures:
    """Return the groups of several runs, and how likely a run of one group scores better than one of another.

    Returns:
        `groups`: a row for each robot kind and configuration, with its runs, seeds, scores, performance profile, curves
        and color. `improvements`: for each two groups of a robot kind, the probability that a run of the first scores
        better than a run of the second; ties count half. An interval is None for a group of one run.
    """
    members: defaultdict[tuple[str, tuple[tuple[str, str], ...]], list[GroupedRun]] = defaultdict(list)
    for run in sorted(runs, key=lambda run: run.robot):
        setup = dict(_flat(run.setup))
        key = tuple((name, str(value)) for name, value in setup.items() if name.rpartition(".")[2] != "seed")
        members[run.robot, key].append(run)
    names = _names([dict(setup) for _, setup in members])
    groups = [_group(robot, name, group) for ((robot, _), group), name in zip(members.items(), names, strict=True)]
    for group, color in zip(groups, _colors(groups), strict=True):
        group["color"] = color
    improvements = []
    for a, b in itertools.combinations(groups, 2):
        if a["robot"] == b["robot"]:
            first, second = (np.array(group["scores"]["goals"]["values"]) for group in (a, b))
            pair = {"robot": a["robot"], "of": a["name"], "over": b["name"]}
            improvements.append(pair | probability_of_improvement(first, second))
    return {"groups": groups, "improvements": improvements}


def differences(configurations: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the settings in which runs differ: for each, its value in every run; None where a run does not have it.

    Args:
        configurations: by run; nested values are joined by dots.
    """
    flat = {run: dict(_flat(values)) for run, values in configurations.items()}
    names = dict.fromkeys(name for values in flat.values() for name in values)
    rows = {name: {run: values.get(name) for run, values in flat.items()} for name in names}
    return {name: row for name, row in rows.items() if len({repr(value) for value in row.values()}) > 1}


def _flat(values: Any, prefix: str = "") -> list[tuple[str, Any]]:
    if not isinstance(values, dict):
        return [(prefix.removesuffix("."), values)] if prefix else []
    return [item for name, value in values.items() for item in _flat(value, f"{prefix}{name}.")]


def _names(setups: list[dict[str, str]]) -> list[str]:
    """Return short names of configurations: the method, and further values until all names differ."""
    keys = dict.fromkeys(key for setup in setups for key in setup)
    differing = [key for key in keys if len({setup.get(key) for setup in setups}) > 1] or ["method"]
    names = [[str(setup.get(differing[0]))] for setup in setups]
    distinct = len({tuple(setup.items()) for setup in setups})  # two robot kinds may have the same
    for key in differing[1:]:
        if len({tuple(name) for name in names}) == distinct:
            break
        for name, setup in zip(names, setups, strict=True):
            name.append(f"{key} {setup.get(key)}")
    return [", ".join(name) for name in names]


def _colors(groups: list[Figures]) -> list[str]:
    """Return a color for each group: that of its method, unless another group of its robot kind has it already."""
    colors: list[str] = []
    others, taken = itertools.cycle(OTHER_COLORS), set()
    for group in groups:
        color = METHOD_COLORS.get(group["method"])
        if color is None or (group["robot"], color) in taken:
            color = next(others)
        taken.add((group["robot"], color))
        colors.append(color)
    return colors


def _group(robot: str, name: str, runs: list[GroupedRun]) -> Figures:
    scores = {score: np.array([_score(run, score) for run in runs], float) for score in SCORES}
    return {
        "robot": robot,
        "name": name,
        "method": runs[0].setup.get("method"),
        "runs": [run.label for run in runs],
        "seeds": [run.setup.get("seed") for run in runs],
        "steps": [sum(row["steps"] for row in run.training["bins"]) for run in runs],
        "scores": {name: aggregate(values) for name, values in scores.items()},
        "profile": performance_profile(scores["goals"]),
        "curves": _curves([run.training["bins"] for run in runs]),
    }


def _score(run: GroupedRun, name: str) -> float:
    last = run.training["last"]
    value = last["collisions"] / last["episodes"] if name == "collisions" and last["episodes"] else last[name]
    return float("nan") if value is None or not last["episodes"] else float(value)


def aggregate(values: Array) -> Figures:
    """Return mean and interquartile mean of the runs' scores, with intervals; NaN scores are left out.

    values (runs,), or (tasks, runs) of runs that each drove all tasks: a resample has the same runs in each task.
    """
    values = values if values.ndim > 1 else values[np.isfinite(values)]
    if not values.size:
        return {"values": [], "mean": None, "iqm": None, "mean_interval": None, "iqm_interval": None}
    return {
        "values": values.tolist(),
        "mean": float(values.mean()),
        "iqm": float(interquartile_mean(values.ravel())),
        "mean_interval": _interval(values, MEAN),
        "iqm_interval": _interval(values, interquartile_mean),
    }


def _interval(values: Array, statistic: Callable[[Array], Any]) -> list[float] | None:
    """Return the percentile bootstrap interval of a statistic over runs. A mean of shares stays within 0 and 1."""
    if values.shape[-1] < 2:
        return None
    rows = np.atleast_2d(values)
    return _percentiles(statistic(np.concatenate(list(rows[:, _resampled(rows.shape[1])]), axis=1)))


def _resampled(count: int) -> NDArray[np.intp]:
    """Return the runs (RESAMPLES, count) of each resample; the same for each call."""
    return np.random.default_rng(0).integers(count, size=(RESAMPLES, count))


def _percentiles(drawn: Array, axis: int | None = None) -> list[Any]:
    tail = 50.0 * (1.0 - CONFIDENCE)
    return list(np.percentile(drawn, (tail, 100.0 - tail), axis=axis).tolist())


def performance_profile(values: Array) -> Figures:
    """Return the share of scores, (runs,) or (tasks, runs), that are above each level, with its interval."""
    values = np.atleast_2d(values if values.ndim > 1 else values[np.isfinite(values)])
    above = (values[..., None] > LEVELS).astype(float)
    profile: Figures = {"level": LEVELS.tolist(), "share": above.mean(axis=(0, 1)).tolist() if values.size else []}
    if values.shape[1] > 1:
        drawn = above[:, _resampled(values.shape[1])].mean(axis=(0, 2))
        profile["low"], profile["high"] = _percentiles(drawn, axis=0)
    return profile


def probability_of_improvement(first: Array, second: Array) -> Figures:
    """Return the probability that a run of the first group scores better than one of the second; ties count half.

    Scores are (runs,), or (tasks, runs): the mean over the tasks.
    """
    firsts, seconds = np.atleast_2d(first), np.atleast_2d(second)
    row: Figures = {"probability": None, "interval": None}
    if not firsts.size or not seconds.size:
        return row
    better = (firsts[:, :, None] > seconds[:, None]) + 0.5 * (firsts[:, :, None] == seconds[:, None])
    better = better.mean(axis=0)  # (runs of the first, of the second)
    row["probability"] = float(better.mean())
    if min(better.shape) > 1:
        generator = np.random.default_rng(0)
        rows, columns = (generator.integers(size, size=(RESAMPLES, size)) for size in better.shape)
        row["interval"] = _percentiles(better[rows[:, :, None], columns[:, None, :]].mean(axis=(1, 2)))
    return row


def _curves(runs: list[list[Figures]]) -> Figures:
    """Return the mean curves of a group over steps, with intervals where at least two runs have a value.

    `runs` counts the runs at each step. A run that ended earlier than the others leaves the mean there, and does not
    cut it.
    """
    ends = [sum(row["steps"] for row in bins) for bins in runs]
    end = max(ends, default=0)
    if not end:
        return {"step": [], "runs": []}
    grid = np.linspace(0.0, end, POINTS + 1)[1:]
    curves: Figures = {"step": grid.tolist(), "runs": [sum(bool(last >= step) for last in ends) for step in grid]}
    for name, (counted, over) in CURVES.items():
        lines = np.array([_rates(bins, counted, over, grid, WINDOW * end) for bins in runs])
        curves[name] = [_point(line[np.isfinite(line)]) for line in lines.T]
    return curves


def _point(values: Array) -> Figures:
    low, high = _interval(values, MEAN) or (None, None)
    return {"mean": float(values.mean()) if len(values) else None, "low": low, "high": high}


def _rates(bins: list[Figures], counted: str, over: str, grid: Array, window: float) -> Array:
    """Return the rate over the window before each step of the grid; NaN after the end, or if nothing ended in it."""
    ends = np.concatenate([[0.0], np.cumsum([row["steps"] for row in bins])])
    above = np.concatenate([[0.0], np.cumsum([_count(row, counted) for row in bins])])
    below = np.concatenate([[0.0], np.cumsum([0.0 if row.get(counted, 0.0) is None else row[over] for row in bins])])
    start = np.maximum(grid - window, 0.0)
    total = np.interp(grid, ends, below) - np.interp(start, ends, below)
    with np.errstate(invalid="ignore", divide="ignore"):
        rates: Array = (np.interp(grid, ends, above) - np.interp(start, ends, above)) / total
    rates[(grid > ends[-1] + 1e-9) | (total < 1e-9)] = np.nan
    return rates


def _count(row: Figures, name: str) -> float:
    """Return how much a bin adds to a rate."""
    if name == "interventions":
        return interventions_in(row) * float(row["steps"])
    return float(row[name] or 0.0) * float(row["episodes"])
