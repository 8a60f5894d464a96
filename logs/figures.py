"""Pictures of a log: how goals, reward and interventions change while a robot learns."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from logs.metrics import Tally
from logs.reader import Paths, Record, read
from messaging.topics import STEP

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """One row per finished episode, in the order in which they ended."""

    steps: Array  # of all actors up to the episode's end
    goal: Array  # 0 or 1
    reward: Array  # summed, without the penalty
    interventions: Array  # share of the episode's steps


def curve(records: Iterable[Record]) -> Curve:
    """The learning curve of a log's steps."""
    rows: list[tuple[float, float, float, float]] = []
    tallies: dict[str, Tally] = {}
    steps = 0
    for record in records:
        if record.topic != STEP.name:
            continue
        step = record.message
        if step.step == 0:
            tallies[step.actor] = Tally()
        tally = tallies.setdefault(step.actor, Tally())
        tally.step(step)
        steps += 1
        if tally.returns:
            rows.append((steps, tally.goals, tally.returns[0], tally.interventions / tally.steps))
            tallies[step.actor] = Tally()
    columns = np.array(rows, dtype=np.float64).reshape(-1, 4).T
    return Curve(*columns)


def smooth(values: Array, window: int) -> Array:
    """Means over the last `window` values, fewer at the start."""
    sums = np.concatenate([[0.0], np.cumsum(values)])
    ends = np.arange(1, len(values) + 1)
    starts = np.maximum(0, ends - window)
    means: Array = (sums[ends] - sums[starts]) / (ends - starts)
    return means


def draw(paths: Paths, png: Path, window: int = 50) -> None:
    """Draw the learning curve of the log at `paths` to `png`, each point the mean over `window` episodes.

    Raises:
        NoLog: there is no log.
    """
    data = curve(read(paths))
    picture = Figure(figsize=(8.0, 7.0), layout="constrained")
    rows = (("goals reached", data.goal), ("reward of an episode", data.reward), ("interventions", data.interventions))
    for axes, (label, values) in zip(picture.subplots(len(rows), sharex=True), rows, strict=True):
        axes.plot(data.steps, smooth(values, window))
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    axes.set_xlabel(f"steps (means over {window} episodes)")
    png.parent.mkdir(parents=True, exist_ok=True)
    picture.savefig(png, dpi=120)
