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


def draw(training: Figures, png: Path) -> None:
    """Plot the learning curves `figures["training"]` to `png`, one column for each robot kind."""
    robots = list(training) or [""]
    picture = Figure(figsize=(8.0 * len(robots), 7.0), layout="constrained")
    grid = picture.subplots(len(ROWS), len(robots), sharex="col", squeeze=False)
    for column, robot in zip(grid.T, robots, strict=True):
        bins = training[robot]["bins"] if robot else []
        for axes, (label, value) in zip(column, ROWS, strict=True):
            axes.plot([row["until"] for row in bins], [value(row) for row in bins])
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
        column[0].set_title(robot)
        column[-1].set_xlabel("steps of all actors")
    png.parent.mkdir(parents=True, exist_ok=True)
    picture.savefig(png, dpi=120)
