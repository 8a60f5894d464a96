"""Plot goals, reward and interventions over a training."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from matplotlib.figure import Figure

from brakeline.logs.episode_stats import Figures


def _value_or_nan(name: str) -> Callable[[Figures], float]:
    return lambda row: math.nan if row[name] is None else float(row[name])


ROWS: tuple[tuple[str, Callable[[Figures], float]], ...] = (
    ("goals reached", _value_or_nan("goals")),
    ("reward of an episode", _value_or_nan("reward")),
    ("interventions", lambda row: row["adjusted"] + row["failsafes"]),
)
# Of a model set that can be adapted: what a change of the robot does to its sets.
SETS: tuple[tuple[str, Callable[[Figures], float]], ...] = (
    ("windows outside the sets", _value_or_nan("beyond")),
    ("widening of the sets", _value_or_nan("widening")),
    ("half-width of a tube [m]", _value_or_nan("half_width")),
)


def draw(training: Figures, png: Path) -> None:
    """Plot the learning curves `figures["training"]` to `png`, one column for each robot kind.

    If the sets could be widened, three more rows show how; a line marks the first decision of each model set.
    """
    robots = list(training) or [""]
    adapts = any(row["widening"] is not None for robot in training.values() for row in robot["bins"])
    shown = ROWS + SETS if adapts else ROWS
    picture = Figure(figsize=(8.0 * len(robots), 7.0 * len(shown) / len(ROWS)), layout="constrained")
    grid = picture.subplots(len(shown), len(robots), sharex="col", squeeze=False)
    for column, robot in zip(grid.T, robots, strict=True):
        bins = training[robot]["bins"] if robot else []
        for axes, (label, value) in zip(column, shown, strict=True):
            axes.plot([row["until"] for row in bins], [value(row) for row in bins])
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
            for model in training[robot]["models"][1:] if robot else []:
                axes.axvline(model["from"], color="black", linestyle=":")
        column[0].set_title(robot)
        column[-1].set_xlabel("steps of all actors")
    png.parent.mkdir(parents=True, exist_ok=True)
    picture.savefig(png, dpi=120)
