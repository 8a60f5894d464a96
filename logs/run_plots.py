"""Plot goals, reward and interventions over a training, of one run or of groups of runs."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from brakeline.logs.episode_stats import Figures
from brakeline.logs.learning_curve import interventions_in
from brakeline.logs.viewer import hex_color


def _value_or_nan(name: str) -> Callable[[Figures], float]:
    return lambda row: math.nan if row[name] is None else float(row[name])


ROWS: tuple[tuple[str, Callable[[Figures], float]], ...] = (
    ("goals reached", _value_or_nan("goals")),
    ("reward of an episode", _value_or_nan("reward")),
    ("interventions", interventions_in),
)
KINDS = (("adjusted", "adjusted"), ("failsafe", "failsafes"))  # of interventions, and their names in a row
# Of a model set that can be adapted: what a change of the robot does to its sets.
SETS: tuple[tuple[str, Callable[[Figures], float]], ...] = (
    ("windows outside the sets", _value_or_nan("beyond")),
    ("widening of the sets", _value_or_nan("widening")),
    ("half-width of a tube [m]", _value_or_nan("half_width")),
)
OF_GROUPS = {"goals": "goals reached", "reward": "reward of an episode", "interventions": "interventions"}


def draw(figures: Figures, path: Path) -> None:
    """Plot the figures of a `LogAnalysis` to a file, one column for each robot kind. Its ending says the format.

    Several runs are drawn as groups of runs that differ only in their seed: the mean, and the 95 % interval over runs.
    """
    if figures.get("groups"):
        picture = _groups(figures["groups"])
    else:
        picture = _run({robot: training for robot, training in figures["training"].items() if training["bins"]})
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.savefig(path, dpi=200)


def _run(training: Figures) -> Figure:
    """Draw one run. If its sets could be widened, three more rows show how; a line marks each new model set."""
    adapts = any(row["widening"] is not None for robot in training.values() for row in robot["bins"])
    shown = ROWS + SETS if adapts else ROWS
    picture, grid = _panels(list(training) or [""], [label for label, _ in shown])
    for column, robot in zip(grid, training, strict=False):
        bins = training[robot]["bins"]
        until = [row["until"] for row in bins]
        for axes, (label, value) in zip(column, shown, strict=True):
            axes.plot(until, [value(row) for row in bins], color=hex_color("ink"))
            for kind, name in KINDS if label == "interventions" else ():
                axes.plot(until, [row[name] for row in bins], color=hex_color(kind), label=kind, linewidth=0.9)
                axes.legend(frameon=False, fontsize=8)
            for model in training[robot]["models"][1:]:
                axes.axvline(model["from"], color="black", linestyle=":")
    return picture


def _groups(groups: list[Figures]) -> Figure:
    """Draw groups of runs: mean and interval, thin where fewer than all runs of a group go on."""
    robots = list(dict.fromkeys(group["robot"] for group in groups))
    picture, grid = _panels(robots, list(OF_GROUPS.values()))
    for group in groups:
        column, curves, runs = grid[robots.index(group["robot"])], group["curves"], len(group["runs"])
        for axes, name in zip(column, OF_GROUPS, strict=True):
            if curves["step"]:
                _curve(axes, curves, name, group["color"], f"{group['name']}, {runs} run{'s' if runs > 1 else ''}")
    for column in grid:
        column[0].legend(loc="best", frameon=False, fontsize=8)
    return picture


def _curve(axes: Axes, curves: Figures, name: str, color: str, label: str) -> None:
    value = _value_or_nan("mean")
    all_runs = max(curves["runs"])
    whole = [value(p) if runs == all_runs else math.nan for p, runs in zip(curves[name], curves["runs"], strict=True)]
    axes.plot(curves["step"], [value(point) for point in curves[name]], color=color, linewidth=0.8)
    axes.plot(curves["step"], whole, color=color, linewidth=1.8, label=label)
    low, high = ([_value_or_nan(end)(point) for point in curves[name]] for end in ("low", "high"))
    axes.fill_between(curves["step"], low, high, color=color, alpha=0.2, linewidth=0)


def _panels(robots: list[str], labels: list[str]) -> tuple[Figure, list[list[Axes]]]:
    """Return an empty picture with its panels: a list for each robot kind, from top to bottom."""
    picture = Figure(figsize=(5.0 * len(robots), 2.0 * len(labels) + 0.5), layout="constrained")
    grid = picture.subplots(len(labels), len(robots), sharex="col", squeeze=False)
    for robot, column in zip(robots, grid.T, strict=True):
        for axes, label in zip(column, labels, strict=True):
            axes.set_ylabel(label, fontsize=9)
            axes.grid(alpha=0.3)
        column[0].set_title(robot, fontsize=10)
        column[-1].set_xlabel("steps of all actors", fontsize=9)
    return picture, [list(column) for column in grid.T]
